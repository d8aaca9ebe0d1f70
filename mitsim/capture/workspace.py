"""Choose the frame in which a capture's cloud is written: the sensor's, or that of the device's workspace.

Signal chain: ``sensor_from_workspace`` in a capture's settings -> its inverse ->
:class:`~characterisation.cloud_files.WrittenFrame`. The setting comes from a recording whose device has a ``Link``
(:mod:`mitsim.capture.recordings.nxlib_calibration`).
"""

from __future__ import annotations

from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from characterisation.cloud_files import WrittenFrame
from characterisation.files.errors import InputError
from mitsim.capture.calibration import RigidRows
from mitsim.capture.capture import Capture
from mitsim.sensor.transforms import Transform

#: frames that ``mitsim decode --points-in`` accepts
FRAMES = ("sensor", "workspace")

_KEY = "sensor_from_workspace"

_RIGID = TypeAdapter(RigidRows)


def written_frame(capture: Capture, frame: str, where: str | Path) -> WrittenFrame | None:
    """Return the frame for a capture's cloud file; None for the sensor frame.

    Raises InputError if ``frame`` is unknown, or the capture at ``where`` has no rigid transform to its workspace.
    """
    if frame not in FRAMES:
        raise InputError("--points-in", "", repr(frame), " | ".join(FRAMES))
    if frame == "sensor":
        return None
    field, allowed = f"settings.{_KEY}", "a rigid transform, 4 x 4 by rows [mm]"
    stored = capture.settings.get(_KEY)
    if stored is None:
        hint = "import a recording whose Link has a target, or omit --points-in"
        raise InputError(where, field, "none: no workspace is known", allowed, hint)
    try:
        matrix = _RIGID.validate_python(stored)
    except ValidationError:
        found = "a matrix that is not a rigid transform"
        raise InputError(where, field, found, allowed, "import the recording again") from None
    target = ascii(str(capture.settings.get("link_target") or "workspace")[:80])  # one line of the header
    name = f"of the workspace {target} of the device's Link"
    return WrittenFrame(name, Transform.from_matrix(matrix).inverse().matrix())
