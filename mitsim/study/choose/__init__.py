"""Choose a sensor for a task: screen, race and state all candidate sensors on one part, and compare them in a table."""

from mitsim.study.choose.candidates import CandidateSensor, Excluded, read_candidates
from mitsim.study.choose.selection import choose_sensor

__all__ = ["CandidateSensor", "Excluded", "choose_sensor", "read_candidates"]
