"""One finding about a scene: its severity, what it is about, and advice.

- An *error* cannot work: a feature of the task without a shape, an inside-out part.
- A *warning* gives results that the author does not expect.
- A *note* is information.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class SceneFinding:
    """One finding: its severity, the shape or feature it is about ("" for the scene), the problem and the advice."""

    severity: Severity
    about: str
    what: str
    advice: str

    def __str__(self) -> str:
        about = f"{self.about}: " if self.about else ""
        return f"{self.severity}: {about}{self.what}. {self.advice}"
