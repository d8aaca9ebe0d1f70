"""The emulators in this process, in a time of their own that passes only when somebody waits."""

from __future__ import annotations

from mitsim.capture.devices.serial_line import TICK_S, Clock, SerialLine
from mitsim.capture.devices.stage import start_stage
from tests.capture.devices.emulation import Faults, Journal
from tests.capture.devices.emulator_process import connection
from tests.capture.devices.grbl_emulator import Grbl
from tests.capture.devices.ptu_emulator import PanTiltUnit

BYTE_S, STEP_S = 1e-4, 0.01


class EmulatedPort:
    """What a device says is changed by ``spoil(number of the reply, bytes)`` before it is heard."""

    def __init__(self, device, spoil=lambda number, said: said):
        self.device, self.spoil = device, spoil
        self.time, self.heard, self.count, self.open = 0.0, bytearray(), 0, True
        self.clock = Clock(lambda: self.time, self.wait)

    def wait(self, seconds):
        end = self.time + seconds
        while self.time < end:  # the device lives on meanwhile
            self.time = min(end, self.time + STEP_S)
            self.listen()

    def listen(self):
        self.device.tick(self.time)
        said, self.device.output = bytes(self.device.output), bytearray()
        if said:
            self.count += 1
            self.heard += self.spoil(self.count, said)

    @property
    def in_waiting(self):
        self.listen()
        return len(self.heard)

    def read(self, size=1):
        self.listen()
        if not self.heard:
            self.wait(TICK_S)
        said, self.heard = bytes(self.heard[:size]), self.heard[size:]
        self.time += BYTE_S * len(said)
        return said

    def write(self, data):
        self.time += BYTE_S * len(data)
        self.device.receive(data, self.time)
        self.listen()
        return len(data)

    def close(self):
        self.open = False


class TalkingPort:
    """Gives its chunks one at a time, and lets 20 ms pass where there is none."""

    def __init__(self, *chunks, endless=b""):
        self.chunks, self.endless, self.time = list(chunks), endless, 0.0

    def clock(self):
        return Clock(lambda: self.time, self.pass_time)

    def pass_time(self, seconds):
        self.time += seconds

    @property
    def in_waiting(self):
        return len(self.chunks[0]) if self.chunks else len(self.endless)

    def read(self, size=1):
        self.time += 0.001
        if self.chunks:
            chunk = self.chunks.pop(0)
            if chunk[size:]:
                self.chunks.insert(0, chunk[size:])
            return chunk[:size]
        self.time += 0.004 if self.endless else 0.02
        return self.endless[:size]

    def write(self, data):
        return len(data)

    def close(self):
        pass


def device(kind, *faults, **settings):
    settings = {name.lstrip("_"): value for name, value in settings.items()}
    return {"ptu": PanTiltUnit, "grbl": Grbl}[kind](Faults(faults), Journal(None), settings)


def emulated(kind, *faults, spoil=lambda number, said: said, settings=None, **changes):
    """A live stage on an emulated port, and the port."""
    port = EmulatedPort(device(kind, *faults, **(settings or {})), spoil)
    table = connection(kind, "emulated", **changes)
    return start_stage(table, SerialLine(port, table.where, port.clock)), port


def true_angles(stage, port):
    """Where the emulated axes are now [deg], whatever was said about it."""
    axes, now = port.device.axes, port.time
    out = []
    for axis in stage.connection.axes:
        if axis.channel in "PT":
            own = axes[axis.channel].at(now) * stage._controller.resolution[0]
        else:
            own = axes["XYZ".index(axis.channel)].at(now)
        out.append(axis.angle(own))
    return out
