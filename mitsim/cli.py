"""The command line: every stage of the pipeline as a command, in the order in which ``--help`` lists them.

Data goes to files or stdout, talk and progress to stderr. Exit codes: 0 done and passed, 1 ran but a check failed,
2 usage or bad input, 3 the machine lacks something. Heavy imports stand inside the commands, so that ``--help`` is
quick.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

import mitsim
from characterisation.atomic_io import FULL
from mitsim.commands import (
    calibrations,
    captures,
    devices,
    export,
    fit,
    machine,
    maps,
    measure,
    parts,
    sheets,
    studies,
    validations,
)
from mitsim.commands.options import Group, let_go
from mitsim.errors import InputError, MissingEnvironmentError
from mitsim.progress import be_quiet


class Commands(Group):
    """The commands, each of which lets its folders go at its end."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was asked for."""
        try:
            return super().invoke(ctx)
        finally:
            let_go()


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Simulate 3D vision sensors, characterise them, and find where to put them.",
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"mitsim {mitsim.__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[bool, typer.Option(
        "--version", callback=_version, is_eager=True, help="Print the version and exit.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing of progress.")] = False,
) -> None:  # fmt: skip
    be_quiet(quiet)


for command in (
    machine.doctor,
    studies.run,
    studies.choose,
    captures.render,
    parts.check,
    parts.part,
    devices.capture,
    captures.import_,
    captures.decode,
    measure.measure,
    maps.characterise,
    maps.compare,
    maps.predict,
    studies.score,
    studies.budget,
    studies.exposures,
    sheets.datasheet,
    calibrations.calibrate,
    studies.report,
):
    app.command(name=command.__name__.rstrip("_"))(command)
app.add_typer(export.app, name="export")
app.add_typer(fit.app, name="fit")
app.add_typer(validations.app, name="validate")


#: what the system says where a name cannot be, or is not ours to read or write
_OF_THE_USER = frozenset({
    errno.ENAMETOOLONG, errno.EACCES, errno.EPERM, errno.EROFS, errno.EISDIR, errno.ENOTDIR, errno.ELOOP, errno.ENOENT,
    errno.EEXIST, errno.ENOTEMPTY, errno.ENXIO, errno.ETXTBSY, errno.EMFILE,
})  # fmt: skip


#: exit code of a command that was stopped
_STOPPED = 130


def main() -> None:
    """Run the command line; what users can mend ends in a message and an exit code, not in a traceback."""
    _prepare_streams()
    _stop_as_by_hand()
    code = 0
    try:
        app()
    except SystemExit as done:
        code = done.code if isinstance(done.code, int) else 0 if done.code is None else 1
        if code == _STOPPED:  # as typer has a KeyboardInterrupt
            _end(_STOPPED, "stopped; what was finished is kept")
    except InputError as error:
        code = _end(2, str(error))
    except MissingEnvironmentError as error:
        code = _end(3, str(error))
    except KeyboardInterrupt:
        code = _end(_STOPPED, "stopped; what was finished is kept")
    except MemoryError:
        code = _end(3, "not enough memory for this; what was finished is kept")
    except BrokenPipeError:
        code = _end(3, "whoever read the output has gone; what was finished is kept")
    except OSError as error:
        if error.errno in FULL:
            code = _end(3, f"{error.filename or 'what was to be written'}: no room for it ({error.strerror}); "
                        "what was finished before it is kept: make room, and run the same command again")  # fmt: skip
        elif error.errno in _OF_THE_USER and error.filename is not None:
            code = _end(2, f"{error.filename}: found {error.strerror}; allowed: a place that can be read and written")
        else:
            raise
    sys.exit(_flushed(code))


def _end(code: int, text: str) -> int:
    """Tell the last word, without anything that would move a terminal's cursor, and return the exit code."""
    with suppress(OSError, ValueError):
        print(f"mitsim: {printable(text)}", file=sys.stderr, flush=True)
    return code


def printable(text: str) -> str:
    """Text with everything that a terminal would obey, and what is in no encoding, as escapes."""
    return "".join(
        one if one == "\n" or (one.isprintable() and not 0xD800 <= ord(one) < 0xE000) else ascii(one)[1:-1]
        for one in text
    )


def _prepare_streams() -> None:
    """Have output in any encoding, for any file name, and to nobody."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # it was closed before we began
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - for the whole process
        elif isinstance(stream, io.TextIOWrapper):
            with suppress(OSError, ValueError):
                stream.reconfigure(errors="backslashreplace")


def _stop_as_by_hand() -> None:
    """Have SIGTERM and SIGHUP go the way of Ctrl-C, on which devices are stopped; unless someone has set them aside."""
    if threading.current_thread() is not threading.main_thread():
        return

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, stop)


def _flushed(code: int) -> int:
    """Flush what was printed; a full disk or a closed pipe is then told here, and not by the interpreter."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError) as error:
        with suppress(OSError, ValueError):
            sys.stdout = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - for the rest
        told = getattr(error, "strerror", None) or error
        return code or _end(3, f"standard output: no room for it, or nobody who reads ({told})")
    return code
