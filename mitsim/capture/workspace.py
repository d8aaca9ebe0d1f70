"""The frame in which a capture's cloud is written: that of the sensor, or of the device's workspace.

Signal chain: ``sensor_from_workspace`` in a capture's settings, which the import of a device with a ``Link`` keeps
(:mod:`mitsim.recordings.nxlib_calibration`) -> its inverse -> :class:`~characterisation.cloud_files.WrittenFrame`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from characterisation.cloud_files import WrittenFrame
from characterisation.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.sensor.transforms import Transform

#: names that ``mitsim decode --points-in`` takes
FRAMES = ("sensor", "workspace")

_KEY = "sensor_from_workspace"


def written_frame(capture: Capture, frame: str, where: str | Path) -> WrittenFrame | None:
    """Return the frame for a capture's cloud file; None for the sensor frame.

    Raises
    ------
    InputError
        If ``frame`` is not known, or the capture at ``where`` does not tell its workspace by a rigid transform.
    """
    if frame not in FRAMES:
        raise InputError("--points-in", "", repr(frame), " | ".join(FRAMES))
    if frame == "sensor":
        return None
    allowed = "a rigid transform, 4 x 4 by rows [mm]"
    hint = "import a recording whose Link has a target, or leave --points-in out"
    stored = capture.settings.get(_KEY)
    if stored is None:
        raise InputError(where, f"settings.{_KEY}", "none: no workspace is known", allowed, hint)
    try:
        matrix = np.asarray(stored, float)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    rigid = matrix.shape == (4, 4) and bool(np.isfinite(matrix).all()) and matrix[3].tolist() == [0, 0, 0, 1]
    if rigid:
        turn = matrix[:3, :3]
        rigid = np.abs(turn @ turn.T - np.eye(3)).max() < 1e-6 and bool(np.linalg.det(turn) > 0)
    if not rigid:
        raise InputError(where, f"settings.{_KEY}", "no rigid transform", allowed, "import the recording again")
    target = ascii(str(capture.settings.get("link_target") or "workspace")[:80])  # stays one line of the header
    name = f"of the workspace {target} of the device's Link"
    return WrittenFrame(name, Transform.from_matrix(matrix).inverse().matrix())
