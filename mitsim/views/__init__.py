"""Candidate views: possible poses of the sensor, and their poses as files for a robot or a stage.

:mod:`~mitsim.views.table` defines them in a study. :mod:`~mitsim.views.candidates` generates them, within the reach of
a stage (:mod:`~mitsim.views.reach`) and clear of the part (:mod:`~mitsim.views.collision`). :mod:`~mitsim.views.poses`
writes them to files.
"""

from mitsim.views.candidates import Candidates, LeftOut, View, candidate_views
from mitsim.views.poses import write_views
from mitsim.views.table import ViewsTable

__all__ = ["Candidates", "LeftOut", "View", "ViewsTable", "candidate_views", "write_views"]
