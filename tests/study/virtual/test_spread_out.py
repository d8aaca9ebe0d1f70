"""Workers make the trials of an order with the light paths that it names; called here as a worker calls it."""

import gc
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from mitsim.capture.simulated import kept_light
from mitsim.study import StudyFile, open_study
from mitsim.study.remedies.change import reopened
from mitsim.study.session import Session
from mitsim.study.virtual import light_file, spread_out
from mitsim.study.virtual.plan import race_rendering
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.spread_out import SpreadMeasurements
from mitsim.study.virtual.world import Trial
from tests.smaller_sensors import coarse_sensor

SCENES = Path(__file__).parents[3] / "scenes" / "two_pillars"


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    table = {
        "scene": "matt_white.xml",
        "task": "task.toml",
        "sensor": str(coarse_sensor("ensenso-n10", 2, tmp_path_factory.mktemp("sensor"))),
        "views": {"subdivisions": 0, "rolls_deg": [0], "lowest_elevation_deg": 20},
        "measure": {"light_path_depth": 2, "samples_per_pixel": 1},
    }
    return open_study(SCENES / "study.toml", StudyFile.model_validate(table))


class _Here:
    """Workers that make each order in this process."""

    on_this_machine = True

    def distribute(self, orders, _order, make, _prepared):
        return ((order, make(order)) for order in orders)


def test_the_race_has_fewer_paths_and_trials_of_its_own(study, tmp_path, monkeypatch):
    monkeypatch.setattr(spread_out, "_prepared", {})
    session = Session(study, tmp_path)
    here = session.renderer
    spread = SpreadMeasurements(_Here(), here, session.digest)
    jobs = [Job(study.views[1], Trial(day)) for day in range(2)]
    race = race_rendering(study)
    assert race.kept.samples < here.rendering.kept.samples and race.kept.kept < here.rendering.kept.kept
    assert math.isqrt(race.kept.samples) ** 2 == race.kept.samples  # stratified over the square of a pixel
    errors = []
    for maker, worker in ((here, spread), (here.rendered_as(race), spread.rendered_as(race)), (here, spread)):
        expected = [list(outcome.errors.values()) for _, outcome in maker.run(jobs)]
        np.testing.assert_array_equal([list(outcome.errors.values()) for _, outcome in worker.run(jobs)], expected)
        errors.append(np.array(expected))
    known = np.isfinite(errors[0]) & np.isfinite(errors[1])
    assert known.any() and (errors[0][known] != errors[1][known]).all()
    np.testing.assert_array_equal(errors[0], errors[2])
    assert len(spread_out._prepared) == 1
    assert session.race_trials.digest != session.trials.digest
    assert session.race_trials.folder != session.trials.folder


def test_the_light_of_a_view_is_traced_once_for_all_workers_of_this_machine(study, tmp_path, monkeypatch):
    """A worker reads it in a file, traces the same if the file is damaged, and nothing of it is left."""
    session, jobs = Session(study, tmp_path), [Job(study.views[1], Trial(day)) for day in range(6)]
    expected = [outcome.errors for _, outcome in session.renderer.run(jobs)]
    traced, files, camera_paths = [], [], kept_light.camera_paths

    def counted(*args):
        traced.append(args)
        return camera_paths(*args)

    class Workers(_Here):
        damage = False

        def distribute(self, orders, _order, make, _prepared):
            for order in orders:
                files.append(Path(order.light))
                assert files[-1].is_file() and files[-1].parent == tmp_path
                if self.damage:
                    files[-1].write_bytes(files[-1].read_bytes()[:5000])
                yield order, make(order)

    monkeypatch.setattr(kept_light, "camera_paths", counted)
    cameras = len(study.sensor.rig.cameras)
    for damage, times in ((False, 1), (True, 2)):
        monkeypatch.setattr(spread_out, "_prepared", {})
        workers, session = Workers(), Session(study, tmp_path)
        workers.damage = damage
        spread = SpreadMeasurements(workers, session.renderer, session.digest, tmp_path)
        found = [outcome.errors for _, outcome in spread.run(jobs)]
        np.testing.assert_equal(found, expected)
        assert len(traced) == times * cameras
        traced.clear()
    assert len(set(files)) == 2  # of sessions in one folder, each has its own, whatever it is of
    del spread
    gc.collect()
    assert not any(file.exists() for file in files)
    # one order of a view, several views, and workers on other machines trace for themselves
    views = [Job(study.views[number], Trial(day)) for number in (0, 1) for day in range(6)]
    elsewhere = _Here()
    elsewhere.on_this_machine = False
    for workers, some in ((_Here(), jobs[:2]), (_Here(), views), (elsewhere, jobs)):
        spread = SpreadMeasurements(workers, session.renderer, session.digest, tmp_path)
        assert spread._light_for(list(spread._rows(some))) is None


def test_light_of_one_view_by_two_renderings_in_one_folder_stays_apart(study, tmp_path):
    """A statement and the change that is tried for it have one folder: a file by the view would be the last one's."""
    view, many = study.views[1], Session(study).renderer
    few = many.rendered_as(race_rendering(study))
    lights = [renderer.view_light(view) for renderer in (many, few)]
    writers = [light_file.LightFile(tmp_path) for _ in lights]
    paths = [writer.of(view.number, light.kept) for writer, light in zip(writers, lights, strict=True)]
    for path, light in zip(paths, lights, strict=True):
        read = light_file.read_light(str(path), light.rois)
        assert {name: kept.count for name, kept in read.items()} == {
            name: kept.paths.count for name, kept in light.kept.items()
        }
    assert lights[0].kept["left"].paths.count > lights[1].kept["left"].paths.count > 0


def test_light_that_does_not_fit_on_the_disk_is_no_file(study, tmp_path, monkeypatch):
    def full(path, light):
        path.write_bytes(b"some")
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(light_file, "_write", full)
    session = Session(study, tmp_path)
    spread = SpreadMeasurements(_Here(), session.renderer, session.digest, tmp_path)
    rows = list(spread._rows([Job(study.views[1], Trial(day)) for day in range(6)]))
    assert spread._light_for(rows) is None and spread._light_for(rows) is None
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("free_bytes", "kept"), [(1 << 50, True), (1 << 20, False)])
def test_a_worker_keeps_the_first_study_while_changes_are_tried_if_memory_allows(study, monkeypatch, free_bytes, kept):
    monkeypatch.setattr(spread_out, "_prepared", {})
    monkeypatch.setattr(spread_out, "available_memory", lambda: free_bytes)
    spread = SpreadMeasurements(_Here(), Session(study).renderer, "stated")
    jobs = [Job(study.views[1], Trial(0))]
    first, prepared = None, []
    for digest in ("stated", "change 1", "change 2", "stated"):
        spread._order = replace(spread._order, digest=digest)
        ((_, outcome),) = spread.run(jobs)
        first = first or outcome
        assert outcome.errors == pytest.approx(first.errors, rel=0, abs=0, nan_ok=True)
        prepared.append(list(spread_out._prepared))
    together = [["stated"], ["stated", "change 1"], ["stated", "change 2"], ["stated", "change 2"]]
    alone = [["stated"], ["change 1"], ["change 2"], ["stated"]]
    assert prepared == (together if kept else alone)


def test_orders_of_slow_trials_are_short(study, tmp_path, monkeypatch):
    session = Session(study, tmp_path)
    sizes, seconds = [], [0.1]

    class Workers:
        def distribute(self, orders, _order, _make, _prepared):
            sizes.append([len(order.jobs) for order in orders])
            return ((order, ([None] * len(order.jobs), seconds[0])) for order in orders)

    spread = SpreadMeasurements(Workers(), session.renderer, session.digest)
    jobs = [Job(study.views[1], Trial(day)) for day in range(8)]
    for each in (0.1, 2.9, 40.0):
        seconds[0] = each
        for _ in range(spread_out._REMEMBERED):
            assert [job for job, _ in spread.run(jobs)] == jobs
    assert sizes[0] == [4, 4] and sizes[-1] == [1] * 8
    assert [2] * 4 in sizes


def test_workers_and_changed_studies_open_the_map_that_was_given(study, tmp_path, monkeypatch):
    """Before, a sensor without a shipped map failed in every worker, and in every change that reopens the study."""
    sensor = tmp_path / "own.toml"
    preset = Path(study.file.sensor).read_text()
    sensor.write_text(preset.replace('name = "ensenso-n10"', 'name = "own"', 1))
    covariance = "ensenso-n10-calibration.toml"
    (tmp_path / covariance).write_text((Path(study.file.sensor).parent / covariance).read_text())
    data = PerformanceMap.load(map_path("ensenso-n10")).data.copy()
    data.attrs["sensor"] = "own"
    PerformanceMap(data).save(tmp_path / "map.nc")
    monkeypatch.chdir(tmp_path)
    own = open_study(
        SCENES / "study.toml", study.file.model_copy(update={"sensor": str(sensor)}), performance_map="map.nc"
    )
    monkeypatch.chdir(SCENES)
    assert reopened(own, {"sprayed": True}).performance_map is own.performance_map
    monkeypatch.setattr(spread_out, "_prepared", {})
    session = Session(own, tmp_path)
    jobs = [Job(own.views[1], Trial(0))]
    ((_, made),) = SpreadMeasurements(_Here(), session.renderer, session.digest).run(jobs)
    ((_, expected),) = session.renderer.run(jobs)
    np.testing.assert_array_equal(list(made.errors.values()), list(expected.errors.values()))
