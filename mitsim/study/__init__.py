"""A study: a part, a task, a sensor and the candidate views.

:mod:`~mitsim.study.tables` defines the TOML file. :mod:`~mitsim.study.reading` reads it and all files that it names.
"""

from mitsim.study.reading import (
    MINIMUM_POINTS,
    Study,
    finishes_of_features,
    open_study,
    read_map,
    report_lays,
    with_limits,
    with_plan,
)
from mitsim.study.tables import (
    CharacterisationTable,
    CheckTable,
    ExposureTable,
    MeasureTable,
    RaceTable,
    ScoreTable,
    SetTable,
    StatementTable,
    StudyFile,
)

__all__ = [
    "MINIMUM_POINTS",
    "CharacterisationTable",
    "CheckTable",
    "ExposureTable",
    "MeasureTable",
    "RaceTable",
    "ScoreTable",
    "SetTable",
    "StatementTable",
    "Study",
    "StudyFile",
    "finishes_of_features",
    "open_study",
    "read_map",
    "report_lays",
    "with_limits",
    "with_plan",
]
