"""Ground truth of each pixel of a simulated camera, and its OpenEXR image in the folder of a capture.

Reading and writing need no renderer. :mod:`mitsim.capture.simulated.truth` computes the truth.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from characterisation.files.errors import InputError

#: folder of the true images in a capture folder
FOLDER = "truth"


@dataclass(frozen=True)
class Truth:
    """Ground truth of the (H, W) pixels of one camera.

    Attributes
    ----------
    distance, depth
        (H, W) float32 [mm], along the ray and along the camera's axis; NaN without a surface.
    normal
        (H, W, 3) float32, unit, sensor frame, toward the sensor.
    feature
        (H, W) int16 index into ``feature_names``; -1 without a surface.
    feature_names
        Names of the shapes of the scene.
    projector
        (H, W, 2) float32 (column, row) of the projector pixel that looks at the same point, whether or not its light
        arrives. NaN without a surface, or if the point is behind the projector.
    lit
        (H, W) bool: inside the projector's image and not in shadow.
    indirect
        (H, W) float32 [1]: share of the light of a white frame that is interreflected; NaN without light.
    """

    distance: NDArray[np.float32]
    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    feature: NDArray[np.int16]
    feature_names: tuple[str, ...]
    projector: NDArray[np.float32]
    lit: NDArray[np.bool_]
    indirect: NDArray[np.float32]


def encode_exr(truth: Truth) -> bytes:
    """Return an OpenEXR image of 32-bit float channels; the header has the names of the features and the units."""
    channels: dict[str, NDArray[Any]] = {"distance": truth.distance, "Z": truth.depth, "feature": truth.feature}
    channels |= {f"normal.{axis}": truth.normal[..., index] for index, axis in enumerate("XYZ")}
    channels |= {f"projector.{axis}": truth.projector[..., index] for index, axis in enumerate("UV")}
    channels |= {"lit": truth.lit, "indirect": truth.indirect}
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "features": "\n".join(truth.feature_names),
        "units": "distance, Z: mm; normal: sensor frame; projector: px; feature: line of `features`, -1 for none",
    }
    arrays = {name: np.ascontiguousarray(values, np.float32) for name, values in channels.items()}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "truth.exr"
        OpenEXR.File(header, arrays).write(str(file))
        return file.read_bytes()


def read_truth(path: str | Path) -> dict[str, Truth]:
    """Read the ground truth of a capture folder, written by ``mitsim render --truth``.

    Parameters
    ----------
    path
        The folder.

    Returns
    -------
    dict of Truth
        By camera.

    Raises
    ------
    InputError
        If the folder has no truth, or a file of it cannot be read.

    See Also
    --------
    mitsim.capture.folder.read_capture : the images

    Examples
    --------
    >>> import mitsim as ms
    >>> truth = ms.read_truth("capture")["left"]  # doctest: +SKIP
    >>> truth.depth[truth.lit].mean()  # doctest: +SKIP
    """
    files = sorted(Path(path, FOLDER).glob("*.exr"))
    if not files:
        hint = "render it again with --truth, or with truth=True"
        raise InputError(path, FOLDER, "no true images", f"a capture folder with {FOLDER}/CAMERA.exr", hint)
    return {file.stem: _read_exr(file) for file in files}


def _read_exr(file: Path) -> Truth:
    try:
        with OpenEXR.File(str(file), separate_channels=True) as image:
            names = tuple(str(image.header()["features"]).split("\n"))
            known = {name: np.array(channel.pixels, np.float32) for name, channel in image.channels().items()}
        feature = known["feature"].astype(np.int16)
        if feature.max(initial=-1) >= len(names):
            raise InputError(file, "feature", int(feature.max()), f"-1 to {len(names) - 1}, a line of `features`")
        normal = np.stack([known[f"normal.{axis}"] for axis in "XYZ"], axis=-1)
        projector = np.stack([known[f"projector.{axis}"] for axis in "UV"], axis=-1)
        distance, depth, lit, indirect = known["distance"], known["Z"], known["lit"] > 0, known["indirect"]
        return Truth(distance, depth, normal, feature, names, projector, lit, indirect)
    except KeyError as error:
        raise InputError(file, "", f"no {error}", "a true image of mitsim render --truth") from None
    except RuntimeError as error:
        raise InputError(file, "", str(error), "a whole OpenEXR image") from None
