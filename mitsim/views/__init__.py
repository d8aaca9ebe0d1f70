"""Candidate views: where the sensor could stand, and how a robot or a stage is told.

:mod:`~mitsim.views.table` is what a study says of them; :mod:`~mitsim.views.candidates` makes them, with what a stage
can show (:mod:`~mitsim.views.reach`) and what keeps clear of the part (:mod:`~mitsim.views.collision`);
:mod:`~mitsim.views.poses` writes them down.
"""

from mitsim.views.candidates import Candidates, LeftOut, View, candidate_views
from mitsim.views.poses import tell_views, write_poses
from mitsim.views.table import ViewsTable

__all__ = ["Candidates", "LeftOut", "View", "ViewsTable", "candidate_views", "tell_views", "write_poses"]
