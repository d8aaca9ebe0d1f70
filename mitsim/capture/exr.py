"""Read the depths of an OpenEXR image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from characterisation.files.errors import InputError

#: first bytes of an OpenEXR image
EXR_MAGIC = b"\x76\x2f\x31\x01"

#: names of the channel that has depths, along the axis of the camera
_DEPTHS = ("Z", "depth.Z", "depth.V", "depth.Y", "Depth.Z", "Depth.V")


def exr_depths(path: Path) -> NDArray[Any]:
    """Return the depths (H, W) of an image: of the channel of a depth, else the one that it has, or equal ones."""
    try:
        with OpenEXR.File(str(path), separate_channels=True) as image:
            channels = {name: np.array(channel.pixels) for name, channel in image.channels().items()}
    except (RuntimeError, ValueError, KeyError) as error:
        raise InputError(path, "", str(error), "a whole OpenEXR image") from None
    named = [name for name in _DEPTHS if name in channels][:1]
    values = [channels[name] for name in named or channels if name.rpartition(".")[2] != "A"]
    if not values or any(not np.array_equal(values[0], other, equal_nan=True) for other in values[1:]):
        raise InputError(path, "channels", ", ".join(channels) or "none", f"one channel, or one named {_DEPTHS[0]}")
    return values[0].astype(np.float32) if values[0].dtype == np.float16 else values[0]
