"""The command line: every stage of the pipeline as a command, in the order in which ``--help`` lists them.

Data goes to files or stdout; messages and progress go to stderr. Exit codes: 0 success, 1 a check failed, 2 wrong usage
or input, 3 the machine lacks something, 70 a bug, with its traceback, 130 interrupted. Commands import heavy packages
only when they run, so that ``--help`` is fast.
"""

from __future__ import annotations

import errno
import io
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option

from characterisation.files.atomic_io import FULL
from characterisation.files.errors import InputError, MissingEnvironmentError
from characterisation.files.threads import keep_blas_to_one_thread
from characterisation.words.progress import be_quiet
from characterisation.words.version import __version__
from mitsim.cli import (
    acceptance,
    calibrations,
    compare,
    decode,
    devices,
    doctor,
    export,
    fit,
    import_recording,
    maps,
    measure,
    parts,
    render,
    studies,
    talk,
)
from mitsim.cli.folder_lock import release_folders
from mitsim.cli.kept_files import note_arguments
from mitsim.cli.options import Command, Group, command_group, end_processes


class Commands(Group):
    """The commands; each releases its folders when it ends."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Note the arguments, so that no command writes over what it reads."""
        note_arguments(args)
        return list(super().parse_args(ctx, args))

    def invoke(self, ctx: Any) -> Any:
        """Run the requested command."""
        try:
            return super().invoke(ctx)
        finally:
            release_folders()


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Simulate 3D cameras, characterise them, and find where to place them to measure a part.",
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"mitsim {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    quiet: Annotated[bool, Option("--quiet", "-q", help="Do not print progress.")] = False,
) -> None:
    be_quiet(quiet)


for command in (
    doctor.doctor,
    studies.run,
    export.report,
    parts.part,
    parts.check,
    render.render,
    devices.capture,
    import_recording.import_,
    decode.decode,
    compare.compare,
):
    app.command(name=command.__name__.rstrip("_"), cls=Command)(command)
for name, group in {
    "study": command_group(
        "Take single steps of a study: predict, compare sensors, state a view, plan exposures; make the talk again.",
        studies.score,
        studies.choose,
        studies.state,
        studies.exposures,
        talk.talk,
    ),
    "calibrate": command_group(
        "Calibrate virtually or from the corners of a board, or verify a calibration by one capture.",
        calibrations.rig,
        calibrations.verify,
        default=True,
    ),
    "measure": command_group(
        "Measure planes, spheres, cylinders, dots or a task in clouds, or compute figures of acceptance tests.",
        measure.clouds,
        acceptance.acceptance,
        default=True,
    ),
    "map": command_group(
        "Make performance maps, compare and validate them, predict clouds from them, make data sheets of sensors.",
        maps.make,
        maps.compare,
        maps.validate,
        maps.predict,
        maps.sheet,
    ),
    "fit": command_group("Fit a finish or a sensor file to captures.", fit.finish, fit.sensor_, default=True),
    "export": command_group(
        "Write clouds, runs, results and maps in the formats of other programs.",
        export.cloud,
        export.run,
        export.results,
        export.targets,
        export.map_,
        export.bop,
    ),
}.items():
    app.add_typer(group, name=name)


#: errors of the system for a path that does not exist or may not be read or written
_OF_THE_USER = frozenset(
    {errno.EACCES, errno.EPERM, errno.EROFS, errno.ETXTBSY, errno.EMFILE, errno.ENXIO, errno.ENAMETOOLONG, errno.ELOOP}
    | {errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENOTEMPTY}
)

#: exit code of an interrupted command: 128 plus the number of SIGINT
_STOPPED = 130

#: exit code of a bug: EX_SOFTWARE of sysexits.h, since Python's own is that of a check
_BUG = 70


def main() -> None:
    """Run the command line of mitsim."""
    run_application(app)


def run_application(app: typer.Typer) -> None:
    """Run commands; errors that users can correct end with a message and an exit code, a bug with its traceback."""
    keep_blas_to_one_thread()
    _prepare_streams()
    _stop_as_by_hand()
    code = 0
    try:
        app()
    except SystemExit as done:
        code = done.code if isinstance(done.code, int) else 0 if done.code is None else 1
        if code == _STOPPED:  # typer turns a KeyboardInterrupt into this code
            _end(_STOPPED, "interrupted; finished work is kept")
    except InputError as error:
        code = _end(2, str(error))
    except MissingEnvironmentError as error:
        code = _end(3, str(error))
    except KeyboardInterrupt:
        code = _end(_STOPPED, "interrupted; finished work is kept")
    except MemoryError:
        code = _end(3, "out of memory; finished work is kept")
    except BrokenPipeError:
        code = _end(3, "the reader of the output has closed it; finished work is kept")
    except OSError as error:
        if error.errno in FULL:
            kept = "finished work is kept: free some space and run the same command again"
            code = _end(3, f"{error.filename or 'output'}: cannot be written ({error.strerror}); {kept}")
        elif error.errno in _OF_THE_USER and error.filename is not None:
            code = _end(2, f"{error.filename}: found {error.strerror}; allowed: a path that can be read and written")
        else:
            code = _bug()
    except Exception:
        code = _bug()
    if code:
        for process in multiprocessing.active_children():
            process.kill()  # without a result: the interpreter would wait for their orders
    else:
        end_processes()
    sys.exit(_flushed(code))


def _end(code: int, text: str) -> int:
    """Print the last message without control characters, and return the exit code."""
    with suppress(OSError, ValueError):
        print(f"mitsim: {printable(text)}", file=sys.stderr, flush=True)
    return code


def _bug() -> int:
    """Print the traceback of the exception at hand, and return the exit code."""
    with suppress(OSError, ValueError):
        traceback.print_exc()
    return _BUG


def printable(text: str) -> str:
    """Return a text with control characters and characters that have no encoding as escapes."""
    return "".join(
        character
        if character == "\n" or (character.isprintable() and not 0xD800 <= ord(character) < 0xE000)
        else ascii(character)[1:-1]
        for character in text
    )


def _prepare_streams() -> None:
    """Make output work in any encoding, for any file name, and with closed streams."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:  # closed before the start
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115 - for the whole process
        elif mode == "w" and isinstance(stream, io.TextIOWrapper):
            with suppress(OSError, ValueError):
                stream.reconfigure(errors="backslashreplace")


def _stop_as_by_hand() -> None:
    """Handle SIGTERM and SIGHUP as Ctrl-C, which stops devices, unless they have another handler."""
    if threading.current_thread() is not threading.main_thread():
        return

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, stop)


def _flushed(code: int) -> int:
    """Flush stdout, and report a full disk or a closed pipe here rather than in the interpreter."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError) as error:
        with suppress(OSError, ValueError):
            sys.stdout = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - for the rest
        cause = getattr(error, "strerror", None) or error
        return code or _end(3, f"standard output: cannot be written ({cause})")
    return code
