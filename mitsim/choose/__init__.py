"""Choose a sensor for a task: screen, race and state all candidate sensors on one part, and compare them in a table."""

from mitsim.choose.contest import choose_sensor
from mitsim.choose.entrants import Entrant, Excluded, read_entrants

__all__ = ["Entrant", "Excluded", "choose_sensor", "read_entrants"]
