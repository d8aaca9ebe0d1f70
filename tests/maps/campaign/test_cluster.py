"""A campaign on a Dask cluster of this machine, one of whose workers is killed in mid-campaign."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from characterisation.files.errors import InputError, MissingEnvironmentError
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.maps.campaign.acquire import in_turn, simulated_source
from mitsim.maps.campaign.orders import worker_source
from mitsim.maps.campaign.run import run_campaign
from mitsim.running.cluster import Cluster
from mitsim.study import StudyFile, open_study
from mitsim.study.virtual.plan import measurements_of, trial_digest
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.spread_out import SpreadMeasurements
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.world import Trial
from tests.smaller_sensors import coarse_sensor

SCENES = Path(__file__).parents[3] / "scenes" / "two_pillars"

dask = pytest.importorskip("dask", reason="pip install distributed: campaigns on a cluster")
distributed = pytest.importorskip("distributed", reason="pip install distributed: campaigns on a cluster")
pytestmark = [pytest.mark.filterwarnings("default"), pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def coarse(tmp_path_factory):
    """The sensor file of an N10 with a quarter of the pixels."""
    return coarse_sensor("ensenso-n10", 2, tmp_path_factory.mktemp("sensor"))


@pytest.fixture(scope="module")
def cluster():
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs="ERROR"
    ) as made:
        yield made


def test_workers_give_the_same_map_though_one_is_killed(tmp_path, planned, half_n10, cluster):
    plan = planned(half_n10, distances_mm=[500], orientations=[{"up_to_deg": 40, "subdivisions": 1}])
    run_campaign(plan, in_turn(simulated_source(SimulatedSensor(half_n10), 1), plan), tmp_path / "here")
    with distributed.Client(cluster, set_as_default=False) as client:
        workers = client.run(os.getpid)
        source, killed = worker_source(Cluster(cluster.scheduler_address), plan), []

        def killing(shots):
            for number, done in enumerate(source(shots)):
                if number == 2 and not killed:
                    killed.append(next(iter(workers.values())))
                    os.kill(killed[0], signal.SIGKILL)
                yield done

        run_campaign(plan, killing, tmp_path / "there")
    assert killed
    names = [{str(p.relative_to(tmp_path / w)) for p in (tmp_path / w).rglob("*")} for w in ("here", "there")]
    assert names[0] == names[1]
    for name in ("map.nc", "samples.nc"):
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "there" / name).read_bytes()
    kept = sorted((tmp_path / "there/coupons").rglob("patches.npy"))
    assert len(kept) == len(plan.series) * len(plan.file.normals())
    assert len(np.load(kept[0])) > 10


def test_who_is_no_longer_held_leaves_the_scheduler(cluster):
    made = Cluster(cluster.scheduler_address)
    client = made.client
    assert client.status == "running"
    del made
    assert client.status == "closed"


def _failing(path):
    with Path(path).open("a") as file:
        file.write("tried\n")
    raise InputError("scene.xml", "", "a fault", "none")


def test_an_order_that_raises_is_not_repeated(tmp_path, cluster):
    with pytest.raises(InputError, match="a fault"):
        list(Cluster(cluster.scheduler_address).distribute(["one"], lambda _: str(tmp_path / "tries"), _failing))
    assert (tmp_path / "tries").read_text() == "tried\n"


def test_a_scheduler_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr("mitsim.running.cluster.CONNECT_TIMEOUT_S", 1)
    with pytest.raises(MissingEnvironmentError, match="no scheduler answers there"):
        Cluster("tcp://127.0.0.1:9")


def test_many_captures_are_the_same_on_a_cluster(tmp_path, cluster, coarse):
    from typer.testing import CliRunner

    from mitsim.cli.program import app

    (tmp_path / "plan.toml").write_text("captures = 2\n[views]\nsubdivisions = 0\nstandoff_mm = 500\n")
    call = [
        "render",
        "scenes/two_pillars/two_pillars.xml",
        "--many",
        tmp_path / "plan.toml",
        "--sensor",
        coarse,
        "--samples",
        1,
        "--depth",
        1,
    ]
    for name, options in (("here", []), ("there", ["--scheduler", cluster.scheduler_address])):
        done = CliRunner().invoke(app, [*map(str, [*call, "-o", tmp_path / name, *options])])
        assert done.exit_code == 0, (done.exception, done.stderr)
    found = [
        {str(p.relative_to(tmp_path / w)): p.read_bytes() for p in (tmp_path / w).rglob("*") if p.is_file()}
        for w in ("here", "there")
    ]
    assert found[0] and found[0] == found[1]


def _spoil():
    """Have a worker say that someone changed its shot noise, wherever it is asked."""
    import mitsim.running.build as build_module
    import mitsim.running.cluster as cluster_module

    told = build_module.own_build() | {"source": "another"}
    build_module.own_build = cluster_module.own_build = lambda: told


def _mend():
    import importlib

    import mitsim.running.build as build_module
    import mitsim.running.cluster as cluster_module

    cluster_module.own_build = importlib.reload(build_module).own_build


@pytest.mark.parametrize("joined_later", [False, True])
def test_a_worker_of_another_mitsim_takes_nothing(tmp_path, planned, cluster, monkeypatch, joined_later):
    plan = planned(distances_mm=[500], orientations=[{"up_to_deg": 10, "subdivisions": 0}])
    with distributed.Client(cluster, set_as_default=False) as client:
        client.run(_spoil)
        if joined_later:
            monkeypatch.setattr("mitsim.running.cluster._compare_builds", lambda *_: None)
        try:
            with pytest.raises(MissingEnvironmentError, match="other source files"):
                run_campaign(plan, worker_source(Cluster(cluster.scheduler_address), plan), tmp_path)
        finally:
            client.run(_mend)
    assert not list((tmp_path / "coupons").rglob("shot.json"))


def test_builds_differ_in_versions_and_in_any_file(tmp_path, monkeypatch):
    from mitsim.running import build

    mine = build.own_build()
    assert build.differences(mine, dict(mine)) == ""
    assert build.differences(mine, mine | {"python": "3.99"}) == ""
    assert build.differences(mine, mine | {"mitsim": "0.0.9"}) == f"mitsim 0.0.9 in place of {mine['mitsim']}"
    assert "mitsuba unknown" in build.differences(mine, {})
    for name in ("mitsim", "characterisation"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("")
    monkeypatch.setattr(
        build, "find_spec", lambda name: type("S", (), {"submodule_search_locations": [str(tmp_path / name)]})
    )
    before = build._source()
    (tmp_path / "mitsim/__init__.py").write_text("shot_noise = 1.5")
    assert build._source() != before


@pytest.mark.parametrize(
    "address", ["", "nonsense", "http://a:1", "tcp://127.0.0.1:99999", "tcp://[::1", "tcp://a b:1", "tcp://127.0.0.1"]
)
def test_what_can_be_no_address_is_refused(address):
    with pytest.raises(InputError, match="--scheduler"):
        Cluster(address)


def test_tls_without_certificates_is_one_message(tmp_path):
    with pytest.raises(MissingEnvironmentError, match=r"no file as ca-file, client\.cert, client\.key"):
        Cluster("tls://127.0.0.1:8786")
    (tmp_path / "ca.pem").write_text("")
    named = {"ca-file": str(tmp_path / "ca.pem"), "client": {"cert": str(tmp_path / "none.pem"), "key": None}}
    with (
        dask.config.set({"distributed.comm.tls": named}),
        pytest.raises(MissingEnvironmentError, match=r"client\.cert \(.*none\.pem\), client\.key$"),
    ):
        Cluster("tls://127.0.0.1:8786")
    files = {"ca-file": named["ca-file"], "client": dict.fromkeys(("cert", "key"), named["ca-file"])}
    with (
        dask.config.set({"distributed.comm.tls": files}),
        pytest.raises(MissingEnvironmentError, match="no scheduler answers there") as caught,
    ):
        Cluster("tls://127.0.0.1:8786")
    assert "\n" not in str(caught.value)


def test_a_scheduler_without_workers_is_told_and_given_up(planned, monkeypatch, capsys):
    monkeypatch.setattr("mitsim.running.cluster.NO_WORKER_S", 1.5)
    with (
        distributed.LocalCluster(n_workers=0, processes=True, dashboard_address=None, silence_logs="ERROR") as empty,
        pytest.raises(MissingEnvironmentError, match=r"no workers in 1\.5 s"),
    ):
        plan = planned(distances_mm=[500], orientations=[{"up_to_deg": 10, "subdivisions": 0}])
        normal = plan.file.normals()[0]
        next(worker_source(Cluster(empty.scheduler_address), plan)([plan.shot(plan.series[0], normal)]))
    assert "no workers yet, waiting" in capsys.readouterr().err


def test_virtual_measurements_are_the_same_on_a_cluster_though_a_worker_is_killed(cluster, coarse):
    study = study_of(coarse)
    unknowns = study_unknowns(study)
    here = measurements_of(study, unknowns)
    jobs = [Job(view, Trial(day)) for view in study.views[:2] for day in range(2)]
    dask_workers = Cluster(cluster.scheduler_address)
    there = SpreadMeasurements(dask_workers, here, trial_digest(study, unknowns, "render"))
    workers = dask_workers.client.run(os.getpid)
    killed, found = [], []
    for job, outcome in there.run(jobs):
        if not killed:
            killed.append(next(iter(workers.values())))
            os.kill(killed[0], signal.SIGKILL)
        found.append((job, outcome.errors))
    dask_workers.client.close()
    known = {(job.view.number, job.trial): outcome.errors for job, outcome in here.run(jobs)}
    assert len(found) == len(jobs) == len(known)
    for job, errors in found:
        expected = known[job.view.number, job.trial]
        np.testing.assert_array_equal([errors[name] for name in expected], list(expected.values()))


def study_of(sensor):
    table = {
        "scene": "two_pillars.xml",
        "parameters": {"plane_Ra": 0.37, "pillar_Ra": 0.37},
        "task": "task.toml",
        "sensor": str(sensor),
        "views": {"subdivisions": 0, "rolls_deg": [0], "lowest_elevation_deg": 20},
        "measure": {"light_path_depth": 1, "samples_per_pixel": 1},
    }
    return open_study(SCENES / "study.toml", StudyFile.model_validate(table))
