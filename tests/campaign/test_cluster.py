"""A campaign on a Dask cluster of this machine, one of whose workers is killed in mid-campaign."""

import os
import signal

import numpy as np
import pytest

from mitsim.campaign.cluster import on_cluster
from mitsim.campaign.run import run_campaign
from mitsim.campaign.take import in_turn, simulated_source
from mitsim.capture.simulate import SimulatedSensor
from mitsim.errors import MissingEnvironmentError

distributed = pytest.importorskip("distributed", reason="pip install distributed: campaigns on a cluster")
pytestmark = [pytest.mark.filterwarnings("default"), pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def cluster():
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs="ERROR"
    ) as made:
        yield made


def test_workers_give_the_same_map_though_one_is_killed(tmp_path, planned, n10, cluster):
    plan = planned(distances_mm=[500], orientations=[{"up_to_deg": 40, "subdivisions": 1}])
    run_campaign(plan, in_turn(simulated_source(SimulatedSensor(n10), 1), plan), tmp_path / "here")
    with distributed.Client(cluster, set_as_default=False) as client:
        workers = client.run(os.getpid)
        source, killed = on_cluster(cluster.scheduler_address, plan), []

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


def test_a_scheduler_that_is_not_there_is_told(planned, monkeypatch):
    monkeypatch.setattr("mitsim.campaign.cluster.PATIENCE_S", 1)
    with pytest.raises(MissingEnvironmentError, match="nobody answers there"):
        on_cluster("tcp://127.0.0.1:9", planned())


def test_many_captures_are_the_same_on_a_cluster(tmp_path, cluster):
    from typer.testing import CliRunner

    from mitsim.cli import app

    (tmp_path / "plan.toml").write_text("captures = 2\n[views]\nsubdivisions = 0\nstandoff_mm = 500\n")
    call = [
        "render",
        "scenes/two_pillars/two_pillars.xml",
        "--many",
        tmp_path / "plan.toml",
        "--samples",
        1,
        "--depth",
        1,
    ]
    for name, options in (("here", []), ("there", ["--scheduler", cluster.scheduler_address])):
        done = CliRunner().invoke(app, [*map(str, [*call, "-o", tmp_path / name, *options])])
        assert done.exit_code == 0, (done.exception, done.stderr)
    found = [{str(p.relative_to(tmp_path / w)): p.read_bytes() for p in (tmp_path / w).rglob("*") if p.is_file()}
             for w in ("here", "there")]  # fmt: skip
    assert found[0] and found[0] == found[1]
