"""The whole chain of a study: score, race, state, predict and record.

:mod:`~mitsim.run_study.run` runs it. :mod:`~mitsim.run_study.scoring` scores the views with the performance map.
:mod:`~mitsim.run_study.record` makes ``run.json``.
"""

from mitsim.run_study.run import claim, run_study
from mitsim.run_study.scoring import pose_columns, score_study

__all__ = ["claim", "pose_columns", "run_study", "score_study"]
