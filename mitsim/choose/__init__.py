"""Which sensor for a task: all candidates before one part, screened, raced and stated, in one table."""

from mitsim.choose.contest import choose_sensor
from mitsim.choose.entrants import Entrant, Excluded, read_entrants

__all__ = ["Entrant", "Excluded", "choose_sensor", "read_entrants"]
