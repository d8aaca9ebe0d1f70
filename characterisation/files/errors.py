"""Errors that a user can correct: bad input, or a missing part of the environment.

Every error that a user can cause is an :class:`InputError`. It carries the location, the value found, the allowed
values, and a hint on what to do. The command line prints it as one message and exits with code 2. Any other exception
(an ``IndexError``, say) is a bug and keeps its traceback.
"""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Any

#: largest number of characters of a path, field or value in a message
_LONGEST = 800


class InputError(ValueError):
    """A file, field or argument that cannot be used.

    Parameters
    ----------
    where, field
        The file or command argument that holds the fault; the field inside it (``campaign.distances_mm``), or "".
    found, allowed, hint
        The value found there; the values that are allowed; what to do, unless it is only to give one of these.
    """

    def __init__(self, where: str | Path, field: str, found: Any, allowed: str, hint: str = "") -> None:
        self.where, self.field, self.found, self.allowed, self.hint = str(where), field, found, allowed, hint
        location = f"{_shortened(where)}: {_shortened(field)}" if field else _shortened(where)
        super().__init__(f"{location}: found {_shortened(found)}; allowed: {allowed}" + (f". {hint}" if hint else ""))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle all fields, so that the error can pass between processes."""
        return type(self), (self.where, self.field, str(self.found), self.allowed, self.hint)


class MissingEnvironmentError(RuntimeError):
    """Something must be installed, connected or switched on; the message says what to do."""


def _shortened(value: Any) -> str:
    """Return a value as text, with the middle of a long text left out."""
    text = str(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"


def in_one_line(error: object, longest: int = 200) -> str:
    """Return what an error says in one line of at most some characters; its type if it says nothing."""
    return " ".join(str(error).split())[:longest] or type(error).__name__


def nearest(name: str, names: list[str]) -> str:
    """Return ``did you mean 'x'?`` for the name nearest to a misspelt one, and not that itself; or an empty string.

    Names are compared without capitals, and with spaces and underscores as hyphens.
    """
    by_spelling = {_spelling(candidate): candidate for candidate in names if candidate != name}
    close = get_close_matches(_spelling(name), list(by_spelling), n=1, cutoff=0.6)
    return f"did you mean {by_spelling[close[0]]!r}?" if close else ""


def _spelling(name: str) -> str:
    return name.casefold().replace(" ", "-").replace("_", "-")
