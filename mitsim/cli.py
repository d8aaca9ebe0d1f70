"""The command line: every stage of the pipeline as a command, in the order in which ``--help`` lists them.

Data goes to files or stdout, talk and progress to stderr. Exit codes: 0 done and passed, 1 ran but a check failed,
2 usage or bad input, 3 the machine lacks something. Heavy imports stand inside the commands, so that ``--help`` is
quick.
"""

from __future__ import annotations

import sys

import typer

from characterisation.whole_files import FULL
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
from mitsim.errors import InputError, MissingEnvironmentError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Simulate 3D vision sensors, characterise them, and find where to put them.",
)

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
    fit.fit,
    sheets.datasheet,
    calibrations.calibrate,
    studies.report,
):
    app.command(name=command.__name__.rstrip("_"))(command)
app.add_typer(export.app, name="export")
app.add_typer(validations.app, name="validate")


def main() -> None:
    """Run the command line; what users can mend ends in a message and an exit code, not in a traceback."""
    try:
        app()
    except InputError as error:
        print(f"mitsim: {error}", file=sys.stderr)
        sys.exit(2)
    except MissingEnvironmentError as error:
        print(f"mitsim: {error}", file=sys.stderr)
        sys.exit(3)
    except OSError as error:
        if error.errno not in FULL:
            raise
        print(
            f"mitsim: {error.filename or 'what was to be written'}: no room for it ({error.strerror}); "
            "what was finished before it is kept: make room, and run the same command again",
            file=sys.stderr,
        )
        sys.exit(3)
    except KeyboardInterrupt:
        print("mitsim: stopped; what was finished is kept", file=sys.stderr)
        sys.exit(130)
