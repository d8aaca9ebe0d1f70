"""The command line as a user calls it: in a process of its own, or, for what ends in a message, in this one."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

from mitsim.cli import program as cli

ROOT = Path(__file__).resolve().parents[1]

Done = subprocess.CompletedProcess[str]
#: the exit code, or one of the codes, that a command must end with; None allows any
Codes = int | tuple[int, ...] | None


def mitsim(*arguments: object, code: Codes = 0, cwd: Path = ROOT) -> Done:
    """Run a command in its own process; a traceback is a fault of ours in any case."""
    done = subprocess.run(
        [sys.executable, "-m", "mitsim", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=500,
        check=False,
    )
    assert "Traceback" not in done.stderr, done.stderr
    return _ended(done, code)


def mitsim_here(*arguments: object, code: Codes = 0, cwd: Path = ROOT) -> Done:
    """Run a command in this process, through the same ``main``: some 3 s quicker, as nothing is imported again.

    An exception that ``main`` lets through fails the test. Signals and the encoding of streams are left alone.
    """
    given, out, err = ["mitsim", *map(str, arguments)], io.StringIO(), io.StringIO()
    with _as_a_shell(given, cwd), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main()
        except SystemExit as ended:
            found = ended.code
    done = subprocess.CompletedProcess(given, int(found or 0), out.getvalue(), err.getvalue())
    return _ended(done, code)


@contextlib.contextmanager
def _as_a_shell(given: list[str], cwd: Path) -> Iterator[None]:
    with (
        contextlib.chdir(cwd),
        mock.patch.object(sys, "argv", given),
        mock.patch.object(cli, "_stop_as_by_hand"),
        mock.patch.object(cli, "_prepare_streams"),
    ):
        yield


def _ended(done: Done, code: Codes) -> Done:
    """What was run, if it ended as it must."""
    allowed = (code,) if isinstance(code, int) else code
    assert allowed is None or done.returncode in allowed, (done.returncode, done.stderr)
    return done
