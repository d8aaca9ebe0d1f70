"""What the emulated stages have in common: motion in time, faults, a journal, and a pseudo-terminal or a socket.

Emulators speak the protocols from their makers' manuals, as we read them: they test our use of a protocol, not a
device's behaviour. They run as processes of their own and use the standard library only.

    python -m ptu_emulator --pty LINK | --tcp PORT  [--fault KIND[@N] ...] [--journal FILE]

A fault ``KIND@N`` strikes while the N-th move is under way, ``KIND`` alone from the beginning; SIGUSR1 mends it.

    silence   nothing is answered any more; commands are obeyed       garbage   one reply is random bytes
    late      replies wait for LATE_S                                 half      one reply ends in the middle
    limit     the first axis runs into its end                        stale     one reply comes twice
    reset     the device restarts                                     stall     the axes stop, and nothing is said
    gone      the port vanishes (a socket listens again)              wrong     it says it is another device
"""

from __future__ import annotations

import argparse
import json
import os
import random
import select
import signal
import socket
import sys
import time
from pathlib import Path

LATE_S = 1.6
MID_MOVE = 0.4  # of its way, where a fault strikes that needs the axes to move


class Axis:
    """An axis that moves with constant speed; positions in its own units."""

    def __init__(self, position=0.0):
        self.start = self.target = float(position)
        self.began, self.seconds = 0.0, 0.0

    def at(self, now):
        if now >= self.began + self.seconds:
            return self.target
        return self.start + (self.target - self.start) * max(0.0, (now - self.began) / self.seconds)

    def go(self, now, target, seconds):
        self.start, self.target, self.began, self.seconds = self.at(now), float(target), now, seconds

    def stop(self, now):
        self.start = self.target = self.at(now)
        self.seconds = 0.0

    def moving(self, now):
        return now < self.began + self.seconds and self.start != self.target

    def progress(self, now):
        return 1.0 if self.seconds <= 0 else min(1.0, (now - self.began) / self.seconds)


class Faults:
    """Which fault strikes when; what it does to replies."""

    def __init__(self, given):
        self.planned = []
        for text in given:
            kind, _, number = text.partition("@")
            self.planned.append((kind, int(number or 0)))
        self.active = {kind for kind, number in self.planned if number == 0}
        self.planned = [(kind, number) for kind, number in self.planned if number]
        self.random = random.Random(7)
        self.held = []

    def due(self, move, progress):
        """The faults that strike now, once each."""
        struck = [kind for kind, number in self.planned if number == move and MID_MOVE <= progress < 1]
        self.planned = [(kind, number) for kind, number in self.planned if kind not in struck]
        self.active.update(struck)
        return struck

    def mend(self):
        self.active.clear()
        self.held.clear()

    def altered(self, reply, now):
        """What becomes of a reply (bytes); some faults do it once."""
        if "silence" in self.active:
            return b""
        if "late" in self.active:
            self.held.append((now + LATE_S, reply))
            return b""
        for kind in ("garbage", "half", "stale"):
            if kind in self.active:
                self.active.discard(kind)
                if kind == "garbage":
                    return self.random.randbytes(24).replace(b"\r", b"?").replace(b"\n", b"?") + b"\r\n"
                return reply.rstrip()[: len(reply) // 2] if kind == "half" else reply + reply
        return reply

    def released(self, now):
        ready = b"".join(reply for when, reply in self.held if when <= now)
        self.held = [(when, reply) for when, reply in self.held if when > now]
        return ready


class Journal:
    """One line of JSON for everything that happens to the axes."""

    def __init__(self, path):
        self.path = Path(path) if path else None

    def note(self, event, **details):
        if self.path:
            with self.path.open("a") as file:
                file.write(json.dumps({"event": event, "time": time.time(), **details}) + "\n")


def options(description):
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--pty", help="path of a link to make to the pseudo-terminal")
    parser.add_argument("--tcp", type=int, help="port to listen on, 0 for any")
    parser.add_argument("--fault", action="append", default=[])
    parser.add_argument("--journal")
    parser.add_argument("--set", action="append", default=[], help="a setting of the device, NAME=VALUE")
    return parser.parse_args()


def serve(device, arguments):
    """Connect a device to its port until the port vanishes or the process is ended."""
    signal.signal(signal.SIGUSR1, lambda *_: device.mend())
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if arguments.pty:
        _serve_pty(device, Path(arguments.pty))
    else:
        _serve_tcp(device, arguments.tcp or 0)


def _serve_pty(device, link):
    import tty

    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)  # and kept open: else the master reads an error when a client leaves
    link.unlink(missing_ok=True)
    link.symlink_to(os.ttyname(slave))
    print(link, flush=True)
    while "gone" not in device.faults.active:
        _turn(device, master, lambda: os.read(master, 4096), lambda data: os.write(master, data))
    device.journal.note("gone")
    link.unlink()
    os.close(slave)
    os.close(master)


def _serve_tcp(device, port):
    listener = socket.create_server(("127.0.0.1", port))
    print(f"socket://127.0.0.1:{listener.getsockname()[1]}", flush=True)
    while True:
        client, _ = listener.accept()
        device.opened(time.monotonic())
        with client:
            while True:
                try:
                    if not _turn(device, client, lambda c=client: c.recv(4096), client.sendall):
                        break
                except OSError:
                    break
                if "gone" in device.faults.active:
                    device.faults.active.discard("gone")
                    device.journal.note("gone")
                    break
        going = True
        while going:  # the axes go on without a client, as real ones do
            going = device.busy(time.monotonic())
            device.tick(time.monotonic())
            device.output.clear()
            time.sleep(0.01)


def _turn(device, handle, read, write):
    """One round of reading, moving and writing; false when the client has left."""
    ready, _, _ = select.select([handle], [], [], 0.01)
    now = time.monotonic()
    if ready:
        data = read()
        if not data:
            return False
        device.receive(data, now)
    device.tick(now)
    out = bytes(device.output) + device.faults.released(now)
    device.output.clear()
    if out:
        write(out)
    return True
