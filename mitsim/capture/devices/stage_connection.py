"""Define the ``[stage.connection]`` table: how to reach a live stage, and how its axes relate to the campaign's.

An axis counts in degrees from the campaign's zero. The device counts in its own degrees (a PTU from the middle of its
travel; mm for GRBL): own = ``zero_deg`` + ``gear`` x angle.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from characterisation.files.documents import Document
from characterisation.files.errors import InputError
from mitsim.capture.devices.device_error import DeviceError

Kind = Literal["ptu", "grbl"]
Seconds = Annotated[float, Field(gt=0, le=600)]
Degrees = Annotated[float, Field(ge=-3600, le=3600)]

#: names of a device's own axes
CHANNELS: dict[Kind, tuple[str, ...]] = {"ptu": ("P", "T"), "grbl": ("X", "Y", "Z")}

#: default baud rates: PTU-D46 manual, section 3; GRBL 1.1, doc/markdown/commands.md
BAUD: dict[Kind, int] = {"ptu": 9600, "grbl": 115200}


class AxisConnection(Document):
    """One axis: its ``name`` in the stage, the device's ``channel``, and the conversion between them.

    - ``channel``: P (pan) or T (tilt) of a PTU, X, Y or Z of GRBL.
    - ``limits_deg``: never exceeded, whatever the device allows.
    - ``gear``: own degrees of the device per degree of the axis; negative for the opposite direction.
    - ``zero_deg``: the device's own reading at the zero of the axis.
    - ``steps_per_deg``: steps per own degree that the device must report; another device is rejected. By default any.
    """

    name: str
    channel: Literal["P", "T", "X", "Y", "Z"]
    limits_deg: tuple[Degrees, Degrees]
    gear: Annotated[float, Field(ge=-1000, le=1000)] = 1.0
    zero_deg: Degrees = 0.0
    steps_per_deg: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _possible(self) -> AxisConnection:
        if self.limits_deg[0] >= self.limits_deg[1]:
            raise ValueError("the lower limit before the upper")
        if abs(self.gear) < 1e-3:
            raise ValueError("a gear that turns the axis")
        return self

    def device_angle(self, angle: float) -> float:
        """Return the device's own reading [own deg] at an angle of the axis [deg]."""
        return self.zero_deg + self.gear * angle

    def angle(self, reading: float) -> float:
        """Return the angle of the axis [deg] at a reading of the device [own deg]."""
        return (reading - self.zero_deg) / self.gear


class StageConnection(Document):
    """Connection to a live stage.

    - ``port``: a serial port or ``socket://host:port``; ``baud``: by default 9600 (ptu), 115200 (grbl).
    - ``axes``: those of the stage, in its order.
    - ``homing``: with ``device``, the device finds its own zero (a PTU's reset, GRBL's ``$H``) and nothing moves
      before. With ``none``, its zero is taken as correct, for example set by hand before opening.
    - ``speed_deg_s`` of the axes; by default the device's own.
    - ``model``: text that the device's self-description must contain.
    - ``tolerance_deg``: largest difference of the angle read back from the requested one (default assumed).
    - ``settle_s``: settling time before the angle is read back (default assumed).
    - ``reply_timeout_s``, ``opening_timeout_s``, ``home_timeout_s``: time-outs of a reply, of the device's first line
      after opening the port, and of homing (a PTU takes up to 30 s).
    """

    kind: Kind
    port: Annotated[str, Field(min_length=1)]
    baud: int | None = Field(default=None, ge=300, le=4_000_000)
    axes: Annotated[list[AxisConnection], Field(min_length=1, max_length=3)]
    homing: Literal["device", "none"] = "device"
    speed_deg_s: Annotated[float, Field(gt=0, le=360)] | None = None
    model: str = ""
    tolerance_deg: Annotated[float, Field(gt=0, le=5)] = 0.1
    settle_s: Annotated[float, Field(ge=0, le=60)] = 0.5
    reply_timeout_s: Seconds = 2.0
    opening_timeout_s: Seconds = 5.0
    home_timeout_s: Seconds = 60.0

    @field_validator("port")
    @classmethod
    def _printable(cls, port: str) -> str:
        if not port.isprintable() or port != port.strip():
            raise ValueError("a port's name, without blanks around it")
        return port

    @model_validator(mode="after")
    def _channels(self) -> StageConnection:
        allowed = CHANNELS[self.kind]
        channels, names = [axis.channel for axis in self.axes], [axis.name for axis in self.axes]
        if wrong := [channel for channel in channels if channel not in allowed]:
            raise ValueError(f"of kind {self.kind}: channels {', '.join(allowed)}, not {wrong[0]}")
        if len(set(channels)) < len(channels) or len(set(names)) < len(names):
            raise ValueError("each channel and each name once")
        return self

    @property
    def where(self) -> str:
        """Return the name of the stage in messages."""
        return f"stage on {self.port}"

    @property
    def bits_per_second(self) -> int:
        """Return the baud rate; by default that of the kind."""
        return self.baud if self.baud is not None else BAUD[self.kind]

    def stage_fault(self, operation: str, found: str, expected: str, hint: str = "", axis: str = "") -> DeviceError:
        """Return an error of the stage, or of one ``axis`` of it."""
        return DeviceError(f"{self.where}, axis {axis}" if axis else self.where, operation, found, expected, hint)

    def speed_fault(self, allowed: str, hint: str) -> InputError:
        """Return the error of a ``speed_deg_s`` that the device does not have."""
        return InputError("stage.connection", "speed_deg_s", f"{self.speed_deg_s:g}", allowed, hint)

    def check_model(self, identity: str) -> None:
        """Reject a device that is not the ``model`` of the connection."""
        if self.model.lower() not in identity.lower():
            expected = f"a device whose name contains {self.model!r}"
            raise self.stage_fault(
                "identify", repr(identity), expected, "Check the port, or correct stage.connection.model"
            )

    def check_steps(self, index: int, steps_per_deg: float) -> None:
        """Reject a device whose steps differ from the connection's: the angles would be wrong by the ratio."""
        axis = self.axes[index]
        wanted = axis.steps_per_deg
        if wanted is not None and not math.isclose(steps_per_deg, wanted, rel_tol=1e-3):
            hint = "Check the device, or correct steps_per_deg or the device's setting"
            raise self.stage_fault(
                "identify", f"{steps_per_deg:.6g} steps in a degree", f"{wanted:.6g}", hint, axis.name
            )
