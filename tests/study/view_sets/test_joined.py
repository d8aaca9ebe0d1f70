"""Virtual measurements of sets of views, of perfect clouds of two balls, against closed forms."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from characterisation.point_cloud import PointCloud, ViewGrid
from characterisation.scores.view_sets import ViewSet
from characterisation.statements.statement import statement
from characterisation.tasks.evaluation import measure
from mitsim.sensor.transforms import Transform
from mitsim.study import SetTable
from mitsim.study.view_sets.confirmed_set import TriedSet, confirmed_entry, joining_in_words, set_table, write_set_csv
from mitsim.study.view_sets.joined import JoinedMeasurements
from mitsim.study.virtual.trials import Outcome
from tests.two_balls import TASK

#: the balls are seen from 500 mm above
FROM_ABOVE = Transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 500.0]))


@dataclass(frozen=True)
class World:
    finish: int
    placed: Transform
    assumed: Transform
    seed: int


def cloud(names: tuple[str, ...], sigma: float, seed: int) -> PointCloud:
    """Points on the upper halves of some balls, in the frame of a sensor that looks down on them."""
    grid = ViewGrid(1.0, 1.0, 0.0, 0.0, 40, 2 * 20)
    rng = np.random.default_rng(seed)
    points, label = np.full((2, 800, 3), np.nan), np.full((2, 800), -1, np.int16)
    for k, name in enumerate(("left", "right")):
        if name in names:
            direction = rng.normal(size=(800, 3))
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            direction[:, 2] = np.abs(direction[:, 2])
            place = np.array([-40.0 if k == 0 else 40.0, 0, 0]) + (10 + rng.normal(0, sigma, 800))[:, None] * direction
            points[k], label[k] = FROM_ABOVE.inverse().points(place), k
    grid_points = points.reshape(40, 40, 3).astype(np.float32)
    return PointCloud(
        grid_points,
        np.isnan(grid_points[..., 0]).astype(np.uint8),
        grid,
        "s",
        "simulated",
        feature=label.reshape(40, 40),
        feature_names=("left", "right"),
    )


class Maker:
    """Stands for rendered measurements: what each view sees of the balls, and with which noise."""

    def __init__(self, seen: list[tuple[str, ...]], sigma: float = 0.0) -> None:
        self.seen, self.sigma, self.captures = seen, sigma, []
        scene = SimpleNamespace(centre=(0.0, 0.0, 0.0))
        self.study, self.corners = SimpleNamespace(scene=scene, task=TASK), np.array([[50.0, 10.0, 10.0]])
        still = Transform.identity()
        self.unknowns = SimpleNamespace(
            seed=1, draw=lambda trial: World(trial.day % 3, still, still, 1000 * trial.day + trial.capture)
        )

    def cloud_of(self, view, world):
        self.captures.append((view.number, world))
        return cloud(self.seen[view.number], self.sigma, world.seed), FROM_ABOVE

    def run(self, jobs):
        motion = FROM_ABOVE.inverse().matrix()
        for job in jobs:
            seen, _ = self.cloud_of(job.view, self.unknowns.draw(job.trial))
            yield job, Outcome.of(measure(seen, TASK, motion, 100, False))


def errors(seen, table, days=200, sigma=0.0):
    maker = Maker(seen, sigma)
    views = [SimpleNamespace(number=k) for k in range(len(seen))]
    found = dict(JoinedMeasurements(maker, views, table).run(range(days)))
    assert set(found) == set(range(days))
    return {name: np.array([found[day].errors[name] for day in range(days)]) for name in TASK.measurements}, maker


def table(**keys) -> SetTable:
    return SetTable.model_validate({"limits": {"apart": 0.1}, **keys})


def test_features_of_different_views_are_off_by_both_poses():
    found, _ = errors([("left",), ("right",)], table(joining_mm=0.2, joining_deg=0.0), sigma=0.001)
    # of 200 the standard deviation is known to 5 %
    assert found["apart"].std() == pytest.approx(math.sqrt(2) * 0.2, rel=0.12)
    assert np.abs(found["radius"]).max() < 1e-3


def test_a_set_of_one_view_knows_no_error_of_joining():
    found, _ = errors([("left", "right")], table(joining_mm=5.0, joining_deg=1.0), days=5)
    assert np.abs(found["apart"]).max() < 1e-3


def test_clouds_joined_exactly_have_no_error():
    found, _ = errors([("left",), ("right",)], table(joining="exact"), days=5)
    assert np.abs(found["apart"]).max() < 1e-3


def test_best_fit_removes_what_the_poses_were_off_where_the_views_overlap():
    known = {"joining_mm": 0.5, "joining_deg": 0.2}
    # with noise: without it, a robust fit takes one of the two balls and leaves out the other
    given, _ = errors([("left", "right"), ("left", "right")], table(**known), days=8, sigma=0.05)
    fitted, _ = errors([("left", "right"), ("left", "right")], table(joining="best_fit", **known), days=8, sigma=0.05)
    # merged without a fit the balls are smeared: a radius that is wrong by the square of the shift over the radius
    assert np.abs(fitted["radius"]).mean() < 0.3 * np.abs(given["radius"]).mean()


def test_a_view_that_overlaps_with_none_cannot_be_fitted_and_gives_no_value():
    found, _ = errors([("left",), ("right",)], table(joining="best_fit"), days=2)
    assert np.isnan(found["apart"]).all()


def test_the_part_lies_still_while_its_views_are_taken_and_noise_is_fresh():
    _, maker = errors([("left",), ("right",)], table(), days=2)
    by_day: dict[int, list[World]] = {}
    for _, world in maker.captures:
        by_day.setdefault(world.seed // 1000, []).append(world)
    for worlds in by_day.values():
        assert len({world.seed for world in worlds}) == 2
        assert worlds[0].placed is worlds[1].placed and worlds[0].assumed is worlds[1].assumed


def test_the_same_days_come_out_the_same_in_any_order():
    one, _ = errors([("left",), ("right",)], table(), days=6, sigma=0.01)
    maker = Maker([("left",), ("right",)], 0.01)
    views = [SimpleNamespace(number=k) for k in range(2)]
    again = dict(JoinedMeasurements(maker, views, table()).run([5, 2]))
    assert [again[day].errors["apart"] for day in (2, 5)] == [one["apart"][2], one["apart"][5]]


def test_what_is_written_of_a_set_says_limit_expected_and_confirmed(tmp_path):
    chosen = ViewSet((0, 1), np.array([0.08]), np.array([True]), True)
    stated = [
        statement("apart", "mm", np.random.default_rng(0).normal(0, 0.2, 60)),
        statement("radius", "mm", np.full(60, np.nan)),
    ]
    tried = TriedSet(chosen, table().limits, tuple(stated))
    assert [row.split()[-1] for row in set_table(table(), tried).splitlines()[1:]] == ["no", "-"]
    write_set_csv(tmp_path / "view_set.csv", table(), tried)
    rows = (tmp_path / "view_set.csv").read_text().splitlines()
    assert rows[1].startswith("apart,mm,0.1,0.08,60,0,") and rows[2].startswith("radius,mm,,,60,1,,,,")
    entry = confirmed_entry(stated)
    assert entry["radius"]["bias"] is None and entry["apart"]["trials"] == 60
    assert joining_in_words(table()) == "joined by robot: each pose to 0.3 mm and 0.03 deg"
