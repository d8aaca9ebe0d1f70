"""What goes wrong because of what a user gave, or what the machine lacks, said so that the user can mend it.

One rule for the whole project: an error that a user can cause is an :class:`InputError`, and it carries what was
wrong, where, the value found, what is allowed, and what to do. The command line prints it in one message and ends
with exit code 2. Everything else (an ``IndexError``, say) is a bug of ours and keeps its traceback.
"""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Any

#: characters of a path, field or value that a message repeats
_LONGEST = 800


class InputError(ValueError):
    """A file, field or argument that cannot be used.

    Parameters
    ----------
    where
        The file, or the argument of a command, that holds the fault.
    field
        The field inside it (``campaign.distances_mm``), or "" when the whole file is meant.
    found
        What stands there, in the user's words.
    allowed
        What could stand there.
    hint
        What to do, if that is more than to write something allowed.
    """

    def __init__(self, where: str | Path, field: str, found: Any, allowed: str, hint: str = "") -> None:
        self.where, self.field, self.found, self.allowed, self.hint = str(where), field, found, allowed, hint
        place = f"{_shortened(where)}: {_shortened(field)}" if field else _shortened(where)
        super().__init__(f"{place}: found {_shortened(found)}; allowed: {allowed}" + (f". {hint}" if hint else ""))

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel between processes whole."""
        return type(self), (self.where, self.field, str(self.found), self.allowed, self.hint)


class MissingEnvironmentError(RuntimeError):
    """Something that must be installed, plugged in or switched on is not; the message says what to do."""


def _shortened(value: Any) -> str:
    """A value of a user's as text, its middle left out where it is longer than anyone reads."""
    text = str(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"


def nearest(name: str, known: list[str]) -> str:
    """Return ``did you mean 'x'?`` for the known name nearest to a misspelt one, or an empty string."""
    close = get_close_matches(name, known, n=1, cutoff=0.6)
    return f"did you mean {close[0]!r}?" if close else ""
