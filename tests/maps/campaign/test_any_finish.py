"""Finishes that a map does not know: refused, or characterised when asked for and kept."""

from __future__ import annotations

import math
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from characterisation.files.errors import InputError
from characterisation.maps.lay import mirror_direction, tangent_at
from characterisation.maps.nearest import nearest_sample
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import shipped_maps
from mitsim.cli.options import asking
from mitsim.maps.campaign import finish_cache, missing_finishes, one_finish
from mitsim.maps.campaign.finish_cache import cache_folder, kept_finish
from mitsim.maps.campaign.missing_finishes import NeededFinishes, distances_about, map_with_finishes
from mitsim.maps.campaign.one_finish import OneFinish, one_finish_campaign, plan_of
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.scene.surface.lay import lay_left_out
from mitsim.scene.surface.named_finishes import NAMED_FINISHES
from mitsim.study import read_map
from mitsim.study.choose import read_candidates
from tests.maps.campaign.known_clouds import known_source, smooth
from tests.shell import mitsim_here

AHEAD = np.array([[0.0, 0.0, 1.0]])


def finish_of(**bsdf):
    return scene_from_dict({"one": {"type": "rectangle", "bsdf": bsdf}}, 850.0).finishes[0]


MILLED = {"type": "machined_metal", "metal": "carbon_steel", "process": "milled", "Ra": 1.6}


@pytest.fixture(scope="module")
def shipped(n10):
    return read_map("ensenso-n10", n10)


def wanted_of(n10, finish, between=(480.0, 620.0)):
    return NeededFinishes(n10, "part.xml", {"seat": finish}, between)


def test_what_is_known_is_answered_by_the_map_itself(shipped, n10, quick):
    ground = finish_of(type="machined_metal", process="ground", Ra=0.4)
    assert map_with_finishes(shipped, wanted_of(n10, ground)) is shipped
    assert map_with_finishes(shipped, wanted_of(n10, finish_of(type="matt_white"))) is shipped
    assert not quick


@pytest.mark.parametrize(
    "bsdf",
    [
        MILLED,
        {"type": "matt_white", "reflectance": 0.3},
        {"type": "gloss_paint"},
        {"type": "machined_metal", "process": "ground", "Ra": 0.8},
        {"type": "machined_metal", "process": "ground", "Ra": 0.4, "alpha": 0.097},
        {"type": "machined_metal", "process": "ground", "Ra": 0.4, "lay": "u"},
    ],
    ids=["milled", "dark white", "paint", "too rough", "alpha given", "lay"],
)
def test_what_is_not_known_is_refused_where_nobody_can_be_asked(shipped, n10, quick, bsdf):
    for ask in (None, lambda _: False):
        with pytest.raises(InputError, match=r"'seat'.*aluminium/ground Ra 0.09 to 0.74 um.*--yes") as caught:
            map_with_finishes(shipped, wanted_of(n10, finish_of(**bsdf)), ask)
        assert "about" in caught.value.hint
    assert not quick


@pytest.mark.parametrize(
    ("bsdf", "sample"),
    [
        (MILLED, "aluminium/ground Ra 0.37"),
        ({"type": "gloss_paint"}, "matt_white"),
        ({"type": "machined_metal", "process": "ground", "Ra": 0.8}, "aluminium/ground Ra 0.74"),
        (
            {"type": "machined_metal", "metal": "carbon_steel", "process": "polished", "Ra": 0.05},
            "aluminium/ground Ra 0.09",
        ),
        ({"type": "matt_white", "reflectance": 0.6}, "matt_white"),
    ],
    ids=["milled", "paint", "too rough", "polished", "grey"],
)
def test_for_screening_the_optically_nearest_sample_stands_in_and_is_named(shipped, n10, quick, bsdf, sample, capsys):
    finish = finish_of(**bsdf)
    joined = map_with_finishes(shipped, replace(wanted_of(n10, finish), screening=True))
    assert not quick
    said = capsys.readouterr().err
    assert f"optically nearest sample, {sample}" in said and "F may be off by" in said and "--yes" in said
    name, _, roughness = sample.partition(" Ra ")
    known = shipped.query(name, float(roughness or "nan"), [504.0], AHEAD)
    found = joined.query(finish.name, finish.roughness, [504.0], AHEAD, finish.light)
    assert (found.fraction[0], found.sigma[0]) == (known.fraction[0], known.sigma[0])


def test_a_face_that_is_not_measured_needs_no_finish_of_the_map_and_no_question(shipped, n10, quick, capsys):
    milled = finish_of(**MILLED)
    wanted = NeededFinishes(
        n10, "part.xml", {"seat": finish_of(type="matt_white"), "side": milled}, (480.0, 620.0), frozenset({"seat"})
    )
    joined = map_with_finishes(shipped, wanted)
    assert not quick and not capsys.readouterr().err
    assert np.isfinite(joined.query(milled.name, 1.6, [504.0], AHEAD, milled.light).sigma).all()
    with pytest.raises(InputError, match="--yes"):
        map_with_finishes(shipped, replace(wanted, measured=frozenset({"seat", "side"})))


def test_the_nearest_sample_of_an_optical_neighbour_is_at_a_small_distance_and_of_a_mirror_at_a_large_one(shipped):
    near, far = (
        nearest_sample(shipped, finish_of(type="machined_metal", process="ground", Ra=one).light) for one in (0.8, 0.02)
    )
    assert near.distance < 0.2 and far.distance > 1
    assert 0 < near.sigma_error < 0.1 < far.sigma_error and near.fraction_error < far.fraction_error <= 1


def test_it_is_characterised_once_and_kept(shipped, n10, quick, monkeypatch):
    questions = []
    milled = finish_of(**MILLED)
    joined = map_with_finishes(shipped, wanted_of(n10, milled), lambda text: not questions.append(text))
    assert len(questions) == 1
    assert "carbon_steel/milled Ra 1.6 um" in questions[0]
    assert len(quick) == 3  # at 400, 504 and 635 mm of the map's four distances
    incidence = math.radians(30)
    normal = np.array([[math.sin(incidence), 0.0, math.cos(incidence)]])
    for distance, known in ((504.0, True), (560.0, True), (760.0, False)):
        found = joined.query(milled.name, milled.roughness, [distance], normal, milled.light)
        fraction, sigma = smooth(np.array([distance]), normal)
        if known:
            assert found.fraction[0] == pytest.approx(fraction[0], abs=0.06)
            assert found.sigma[0] == pytest.approx(sigma[0], rel=0.15)
        else:
            assert math.isnan(found.fraction[0])
    monkeypatch.setattr(missing_finishes, "made_finish", None)
    again = map_with_finishes(shipped, wanted_of(n10, milled))
    assert again.data.identical(joined.data)
    assert joined.data.attrs["characterised_when_asked"].count(",") == 2


def test_what_the_map_knew_before_it_answers_as_before(shipped, n10, quick):
    joined = map_with_finishes(shipped, wanted_of(n10, finish_of(**MILLED), (504.0, 504.0)), lambda _: True)
    ground = finish_of(type="machined_metal", process="ground", Ra=0.4)
    for light in (None, ground.light):
        one, other = (m.query(ground.name, 0.4, [560.0], AHEAD, light) for m in (shipped, joined))
        assert one == other or np.array_equal([one.fraction, one.sigma], [other.fraction, other.sigma])


@pytest.mark.parametrize("fault", ["cut", "text", "another"])
def test_a_broken_file_of_the_cache_is_made_again(shipped, n10, quick, fault, capsys):
    milled = finish_of(**MILLED)
    one = OneFinish(milled, n10, 80.0)
    first = map_with_finishes(shipped, wanted_of(n10, milled, (504.0, 504.0)), lambda _: True)
    path = cache_folder() / f"{one.digest(504.0)}.nc"
    whole = path.read_bytes()
    if fault == "another":
        path.write_bytes(shipped_maps()["ensenso-n10"].read_bytes())
    else:
        path.write_bytes(whole[: len(whole) // 2] if fault == "cut" else b"no map")
    assert kept_finish(one, 504.0) is None
    assert str(path) in capsys.readouterr().err
    with pytest.raises(InputError, match="--yes"):
        map_with_finishes(shipped, wanted_of(n10, milled, (504.0, 504.0)))
    again = map_with_finishes(shipped, wanted_of(n10, milled, (504.0, 504.0)), lambda _: True)
    assert len(quick) == 2
    one_of, other = (m.query(milled.name, 1.6, [504.0], AHEAD, milled.light) for m in (first, again))
    assert one_of.sigma == other.sigma


def test_what_a_killed_process_left_is_swept_after_a_day(shipped, n10, quick):
    for name, age in (("work-old", 2 * 86400), ("work-new", 60)):
        (cache_folder() / name).mkdir(parents=True)
        os.utime(cache_folder() / name, (time.time() - age,) * 2)
    map_with_finishes(shipped, wanted_of(n10, finish_of(**MILLED), (504.0, 504.0)), lambda _: True)
    assert [path.name for path in cache_folder().glob("work-*")] == ["work-new"]


def test_the_digest_knows_sensor_light_and_distance(n10):
    one = OneFinish(finish_of(**MILLED), n10, 80.0)
    others = [
        replace(one, finish=finish_of(**{**MILLED, "Ra": 1.7})),
        replace(one, finish=finish_of(**MILLED, alpha=0.14)),
        replace(one, finish=finish_of(**{**MILLED, "metal": "brass"})),
        replace(one, largest_deg=70.0),
        replace(one, sensor=replace(n10, working_range_mm=(400.0, 900.0))),
        replace(one, seed=2),
        replace(one, finish=finish_of(type="powder_coat")),
        replace(one, finish=finish_of(type="powder_coat", reflectance=0.7)),
    ]
    digests = {each.digest(504.0) for each in (one, *others)} | {one.digest(635.0)}
    assert len(digests) == len(others) + 2
    assert OneFinish(finish_of(**MILLED), n10, 80.0).digest(504.0) == one.digest(504.0)


def test_a_lay_is_shown_in_four_directions(n10):
    lay = finish_of(**MILLED, lay="u")
    one = OneFinish(lay, n10, 80.0)
    assert lay.light.has_lay
    assert len(one.turns) == 4
    axes = [
        campaign.shot(campaign.series[0], AHEAD[0]).sensor_from_coupon.rotation
        for campaign in (one_finish_campaign(one, 504.0, plan_of(80.0), turn) for turn in one.turns)
    ]
    for turn, turned in zip(one.turns, axes, strict=True):
        assert turned[:, 2] @ axes[0][:, 2] == pytest.approx(1.0)
        assert np.linalg.det(turned) == pytest.approx(1.0)
        assert math.degrees(math.acos(np.clip(turned[:, 0] @ axes[0][:, 0], -1, 1))) == pytest.approx(turn)


def test_a_lay_keeps_its_directions_their_mean_and_what_they_differ_by(shipped, n10, quick, monkeypatch):
    lay = finish_of(**MILLED, lay="u")

    def by_direction(_, campaign):
        level = 0.3 + 0.5 * math.sin(math.radians(campaign.lay_deg)) ** 2
        return known_source(lambda distance, normals: (0 * distance + level, 0 * distance + 0.2))

    monkeypatch.setattr(one_finish, "in_turn", by_direction)
    joined = map_with_finishes(shipped, wanted_of(n10, lay, (504.0, 504.0)), lambda _: True)
    found = joined.query(lay.name, lay.roughness, [504.0], AHEAD, lay.light)
    levels = [0.3, 0.55, 0.8, 0.55]
    assert found.fraction[0] == pytest.approx(np.mean(levels), abs=0.03)
    assert found.fraction_spread[0] == pytest.approx(np.std(levels), abs=0.03)
    for turn, level in zip(one_finish.TURNS_DEG, levels, strict=True):
        along = tangent_at(AHEAD, turn, mirror_direction(np.array([504.0]), one_finish.mirror_mm(n10)))
        in_direction = joined.query(lay.name, lay.roughness, [504.0], AHEAD, lay.light, along)
        assert in_direction.fraction[0] == pytest.approx(level, abs=0.03)
    assert lay_left_out(lay.scatter) is None
    with pytest.raises(InputError):  # the round lobe of the same name is another finish
        joined.query(lay.name, lay.roughness, [504.0], AHEAD, finish_of(**MILLED).light)


def test_sensors_that_compete_are_asked_for_once_allowed(scenes, quick, tmp_path):
    study = (scenes / "two_pillars/study.toml").read_text()
    for name in ("scene", "task"):
        study = study.replace(f'{name} = "', f'{name} = "{scenes}/two_pillars/')
    (tmp_path / "study.toml").write_text("parameters = { plane_Ra = 3.2 }\n" + study)
    questions = []
    candidates, excluded = read_candidates(
        tmp_path / "study.toml", ["ensenso-n10,kinect-v2"], lambda text: not questions.append(text)
    )
    assert [one.name for one in candidates] == ["ensenso-n10", "kinect-v2"]
    assert not excluded
    assert [text.split(":")[0] for text in questions] == ["ensenso-n10", "kinect-v2"]
    for one in candidates:
        finish = one.study.scene.finishes[one.study.scene.names.index("plane")]
        near = one.study.views[0].standoff
        known = one.study.performance_map.query(finish.name, 3.2, [near], AHEAD, finish.light)
        assert known.fraction[0] == pytest.approx(0.95, abs=0.05)  # smooth() at normal incidence


def test_a_map_of_a_device_takes_no_simulated_sample(shipped, n10, quick):
    device = PerformanceMap(shipped.data.assign_attrs(source="device"))
    with pytest.raises(InputError, match="comes from a device"):
        map_with_finishes(device, wanted_of(n10, finish_of(**MILLED)), lambda _: True)


def test_distances_about_the_views(shipped):
    assert distances_about(shipped, (504.0, 504.0)) == [504.0]
    assert distances_about(shipped, (510.0, 600.0)) == [504.0, 635.0]
    assert distances_about(shipped, (100.0, 450.0)) == [400.0, 504.0]
    assert distances_about(shipped, (700.0, 3000.0)) == [635.0, 800.0]


@pytest.mark.parametrize("sensor", sorted(shipped_maps()))
def test_shipped_maps_answer_for_the_coupons_that_they_were_made_of(sensor, scenes):
    known = PerformanceMap.load(shipped_maps()[sensor])
    wavelength = float(known.data.attrs["wavelength_nm"])
    for name, roughness in known.samples:
        parameters = {} if math.isnan(roughness) else {"Ra": str(roughness)}
        coupon = "matt_white.xml" if math.isnan(roughness) else "coupon.xml"
        shown = load_scene(scenes / "coupon" / coupon, wavelength, parameters).finishes[0]
        members, _ = known.known.representing(name, roughness, shown.light)
        assert str(known.samples[members[0]]) == str((name, roughness))


def test_the_cache_is_where_the_xdg_specification_has_it(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "mitsim/finishes"
    for given in ("", "not/absolute"):
        monkeypatch.setenv("XDG_CACHE_HOME", given)
        assert cache_folder() == Path.home() / ".cache/mitsim/finishes"
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)  # of a user without an entry, as in a container
    with pytest.raises(InputError, match="XDG_CACHE_HOME: found nothing, and no home folder"):
        cache_folder()


def test_expected_time_is_that_of_this_machine_once_it_is_known(quick, n10):
    one = OneFinish(finish_of(**MILLED), n10, 80.0)
    usual = finish_cache.expected_seconds(one)
    cache_folder().mkdir(parents=True)
    finish_cache.keep_rate(n10.name, 3 * usual)
    assert finish_cache.expected_seconds(one) == pytest.approx(3 * usual, abs=0.1)
    for text in ("[]", "[" * 100_000):  # before, a RecursionError
        (cache_folder() / "rates.json").write_text(text)
        assert finish_cache.expected_seconds(one) == usual
    assert finish_cache.expected_seconds(replace(one, finish=finish_of(**MILLED, lay="u"))) == 4 * usual


def test_yes_needs_no_question_and_scripts_have_nobody_to_ask():
    assert asking(True)("?")
    assert asking(False) is None  # pytest has no terminal


@pytest.mark.parametrize("command", ["study score", "run", "study state", "study choose", "map predict"])
def test_scripts_without_yes_end_with_a_message(command, scenes, tmp_path, monkeypatch):
    study = (scenes / "two_pillars/study.toml").read_text()
    scene = scenes / "two_pillars/two_pillars.xml"
    for name in ("scene", "task"):
        study = study.replace(f'{name} = "', f'{name} = "{scenes}/two_pillars/')
    lines = [
        f'parameters = {{ plane_Ra = "3.2" }}\n{line}' if line.startswith("scene =") else line
        for line in study.splitlines()
        if not line.startswith(("parameters", "campaign"))
    ]
    (tmp_path / "study.toml").write_text("\n".join([*lines, "[measure]", 'by = "map"']))
    arguments = {
        "map predict": [str(scene), "--map", "ensenso-n10", "--position", "0", "-300", "400", "-D", "plane_Ra=3.2"],
        "study state": [str(tmp_path / "study.toml"), "--view", "1"],
        "study choose": [str(tmp_path / "study.toml"), "--sensors", "ensenso-n10"],
    }.get(command, [str(tmp_path / "study.toml")])
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    done = mitsim_here(*command.split(), *arguments, "-o", tmp_path / "out", code=2)
    assert "--yes" in done.stderr
    assert "Ra 3.2" in done.stderr


@pytest.mark.parametrize("name", sorted(NAMED_FINISHES))
def test_named_finishes_are_materials_of_a_scene(name):
    one = NAMED_FINISHES[name]
    finish = finish_of(type=one.kind, **one.properties)
    assert finish.light is not None
    assert finish.description is not None
