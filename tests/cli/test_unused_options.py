"""Options without an effect in the mode of a command: refused, whatever their value, before any work."""

import pytest

from tests.shell import mitsim_here

RECORDED = ("calibrate", "corners.csv", "-o", "out.toml", "--board", "11x8x30:glass")
MEASURE = ("measure", "cloud.ply", "--plane", "a")
ACCEPTANCE = ("measure", "acceptance", "cloud.ply", "--sphere", "a=30")
CHECK = ("check", "part.xml")
MANY = ("render", "part.xml", "-o", "out", "--many", "plan.toml")
ONE = ("render", "part.xml", "-o", "out", "--position", 0, 0, 500)
EDIT = ("part", "part.xml", "--edit")
STEP = ("part", "part.step", "-o", "out")
MESH = ("part", "part.stl", "-o", "out")
CLOUD = ("export", "cloud", "cloud.ply", "-o")
RESULTS = ("export", "results", "run", "-o", "out.csv")
FIT = ("fit", "sensor", "capture", "--sensor", "ensenso-n10", "-o", "out.toml")


@pytest.mark.parametrize(
    ("command", "option", "why"),
    [
        *((RECORDED, option, "recorded corners") for option in (("--poses", 20), ("--drift", "a=1"), ("--check", 5))),
        (RECORDED, ("--seed", 1), "recorded corners"),
        (("calibrate", "verify", "capture", "--board", "11x8x30:glass"), ("--printed", 2e-4), "no --dots"),
        *((MEASURE, option, "no --task") for option in (("-D", "a=1"), ("--pose", "pose.json"), ("--view", 0))),
        (MEASURE, ("--seed", 2), "no --simulated"),
        (MEASURE, ("--variant", "llvm_ad_mono"), "no --task and no --simulated"),
        (MEASURE, ("--bright-dots",), "no --dots"),
        (("measure", "cloud.ply", "--picture", "out.png"), ("--points-in", "workspace"), "no feature"),
        *((ACCEPTANCE, option, "no --simulated") for option in (("--seed", 1), ("--variant", "llvm_ad_mono"))),
        (ACCEPTANCE, ("--baseline", 50), "no --plane"),
        (("compare", "real", "simulated", "-o", "out"), ("--sensor", "ensenso-n10"), "a capture SIMULATED"),
        *((MANY, option, "--many") for option in (("--target", 0, 0, 0), ("--roll", 5))),
        *((ONE, option, "no --many") for option in (("--processes", 1), ("--scheduler", "tcp://host:8786"))),
        (CHECK, ("--target", 0, 0, 1), "no --position"),
        (CHECK, ("--view", 3), "no --pose"),
        ((*CHECK, "--pose", "pose.json"), ("--roll", 3), "--pose"),
        *(
            (EDIT, option, "part.xml")
            for option in (("-o", "new"), ("--metal", "gold"), ("--Ra", 0.8), ("--angle", 20))
        ),
        (MESH, ("--port", 0), "no --edit"),
        (STEP, ("--angle", 20), "part.step"),
        *((MESH, option, "part.stl") for option in (("--chord", 0.01), ("--sensor", "ensenso-n10"))),
        (
            ("map", "make", "campaign.toml", "-o", "out", "--captures", "captures"),
            ("--processes", 2),
            "--captures",
        ),
        (("study", "talk", "talk.toml", "-o", "out", "--kept"), ("--minutes", 5), "--kept"),
        ((*CLOUD, "out.pcd"), ("--view", 3), "no --pose"),
        *(((*CLOUD, "out.e57"), option, ".e57") for option in (("--in", "sensor"), ("--unit", "m"))),
        *((RESULTS, (option, "x"), ".csv") for option in ("--laboratory", "--country", "--customer", "--serial")),
        *((FIT, option, "no --study") for option in (("--minutes", 5), ("--campaign", "campaign.toml"), ("--yes",))),
    ],
)
def test_an_option_without_an_effect_is_refused(command, option, why, tmp_path):
    done = mitsim_here(*command, *option, code=2, cwd=tmp_path)
    name = {"-D": "-D", "-o": "--output"}.get(option[0], option[0])
    assert done.stderr.startswith(f"mitsim: {name}: found {why}; allowed: ")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_pose_that_points_in_the_sensor_frame_do_not_need_is_refused(tmp_path):
    (tmp_path / "pose.json").write_text('{"world_from_sensor": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}')
    done = mitsim_here(*CLOUD, "out.ply", "--pose", "pose.json", code=2, cwd=tmp_path)
    assert done.stderr.startswith("mitsim: --pose: found points in the sensor frame; allowed: --in part")
