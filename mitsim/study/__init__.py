"""A study: a part, a task, a sensor and the candidate views.

:mod:`~mitsim.study.tables` defines the TOML file. :mod:`~mitsim.study.reading` reads it and all files that it names.
"""

from mitsim.study.reading import MINIMUM_POINTS as MINIMUM_POINTS
from mitsim.study.reading import Study as Study
from mitsim.study.reading import finishes_of_features as finishes_of_features
from mitsim.study.reading import open_study as open_study
from mitsim.study.reading import read_map as read_map
from mitsim.study.reading import report_doubts as report_doubts
from mitsim.study.reading import with_plan as with_plan
from mitsim.study.tables import CharacterisationTable as CharacterisationTable
from mitsim.study.tables import ExposureTable as ExposureTable
from mitsim.study.tables import RaceTable as RaceTable
from mitsim.study.tables import RemediesTable as RemediesTable
from mitsim.study.tables import SetTable as SetTable
from mitsim.study.tables import StatementTable as StatementTable
from mitsim.study.tables import StudyFile as StudyFile
