"""The whole chain of a study: score, race, state, predict and record.

:mod:`~mitsim.run_study.session` prepares a study for virtual measurements, for all commands that make them.
:mod:`~mitsim.run_study.run` runs it. :mod:`~mitsim.run_study.scoring` scores the views with the performance map.
:mod:`~mitsim.run_study.record` makes ``run.json``.
"""

from mitsim.run_study.run import run_study
from mitsim.run_study.scoring import pose_columns, score_study
from mitsim.run_study.session import Session, StatedView

__all__ = ["Session", "StatedView", "pose_columns", "run_study", "score_study"]
