"""A case whose trials have errors of a known distribution: nothing is rendered."""

import csv

import numpy as np

from mitsim.study.virtual.trials import Outcome

NAMES = ["large_radius", "small_radius", "large_height", "balls_distance"]

CASES = """
sealed = []
candidates = 6
worlds = 10
raced_candidates = 4
raced_worlds = 40
stated_worlds = 400
measured = "measured"
[views]
subdivisions = 1
lowest_elevation_deg = 30
[[cases]]
part = "balls_on_plate"
sensor = "ensenso-n10"
finish = "Ra0.46"
raced = true
"""


class KnownMaker:
    """Errors with a bias of 1 and a spread that grows with the view; those of ``apart`` worlds ``wider`` times."""

    source = "render"
    made = 0

    def __init__(self, study, unknowns, apart=False, rendering=None, wider=1.0):
        self.seed, self.wider = unknowns.seed, wider if apart else 1.0

    def rendered_as(self, _):
        return self

    def run(self, jobs):
        for job in jobs:
            KnownMaker.made += 1
            rng = np.random.default_rng([self.seed, job.view.number, job.trial.day])
            errors = 1 + self.wider * (1 + job.view.number) * rng.standard_normal(len(NAMES))
            yield job, Outcome(dict(zip(NAMES, errors.tolist(), strict=True)))


def rows(path):
    """Rows of a CSV file."""
    with path.open() as stream:
        return list(csv.DictReader(stream))
