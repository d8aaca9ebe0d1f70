"""The talk, made again for a small case: two samples, twenty views, a coarse sensor."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from characterisation.files.errors import InputError
from mitsim.capture.folder import write_capture
from mitsim.sensor.transforms import Transform
from mitsim.talk.make import make, missing_results
from mitsim.talk.measured import _nearest, measured_errors
from mitsim.talk.page import write_talk
from mitsim.talk.plan import _file_digest, pieces_of
from mitsim.talk.results import Results
from mitsim.talk.talk_file import read_talk
from tests.shell import ROOT, mitsim_here
from tests.smaller_sensors import coarse_sensor

SCENES = ROOT / "scenes"


def small_talk(folder: Path) -> Path:
    """Write the file of a small talk, whose sensor has pixels of nine times the area."""
    sensor = coarse_sensor("ensenso-n10", 3, folder)
    with sensor.open("a", encoding="utf-8") as file:
        file.write('\n[unknowns.unit]\nmask = "own"\n')
    path = folder / "talk.toml"
    for name in ("task.toml", "matt_white.xml", "two_pillars.xml"):  # with pillars that coarse pixels resolve
        text = (SCENES / "two_pillars" / name).read_text(encoding="utf-8")
        for old, new in (("35", "42"), ("70.0", "84.0"), ("20", "38")):
            text = re.sub(rf"(?<![\d.]){re.escape(old)}(?!\d)", new, text)
        (folder / name).write_text(text, encoding="utf-8")
    path.write_text(
        f"""
sensor = "ensenso-n10.toml"
map = "ensenso-n10"
task = "task.toml"
trials = 2
light_path_depth = 1
samples_per_pixel = 4
opening_sensors = ["ensenso-n10.toml"]
noise_sensors = ["ensenso-n10.toml"]
sphere = {{ measurement = "pillar1_radius", sample = "Ra 0.37" }}
examples = [{{ measurement = "pillar1_radius", sample = "matt white", slide = "20" }}]
[[finishes]]
name = "polished"
scene = "{SCENES / "talk" / "metal.xml"}"
[[samples]]
name = "matt white"
scene = "matt_white.xml"
[[samples]]
name = "Ra 0.37"
scene = "two_pillars.xml"
parameters = {{ plane_Ra = 0.37, pillar_Ra = 0.37 }}
[coupons]
campaign = "coupons.toml"
subdivisions = 1
refined = 1
tilts_deg = [0, 40]
validated_distances_mm = [600]
poses = 2
shown_roughness_um = 0.37
[views]
subdivisions = 1
lowest_elevation_deg = 30
standoffs_mm = [520, 600]
[views.stage]
axes = [
    {{ name = "pan", direction = [0, 1, 0], limits_deg = [-60, 60] }},
    {{ name = "tilt", direction = [1, 0, 0], limits_deg = [-95, 20] }},
    {{ name = "turn", direction = [0, 0, 1], limits_deg = [-170, 170] }},
]
""",
        encoding="utf-8",
    )
    coupon = SCENES / "coupon"
    (folder / "coupons.toml").write_text(
        f"""
coupon_px = 70
samples_per_pixel = 4
orientations = [{{ up_to_deg = 70, subdivisions = 1 }}]
[[samples]]
scene = "{coupon / "matt_white.xml"}"
[[samples]]
scene = "{coupon / "coupon.xml"}"
parameters = {{ Ra = 0.37 }}
""",
        encoding="utf-8",
    )
    return path


def copied(kept: Path, folder: Path, names: tuple[str, ...]) -> Path:
    """Copy some of the kept results into a folder, and return it."""
    folder.mkdir(parents=True)
    for name in names:
        (folder / f"{name}.nc").write_bytes((kept / f"{name}.nc").read_bytes())
    return folder


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'measurement = "pillar1_radius", sample = "m',
            'measurement = "pilar1_radius", sample = "m',
            "examples.measur",
        ),
        (
            'measurement = "pillar1_radius", sample = "R',
            'measurement = "pilar1_radius", sample = "R',
            "sphere.measurem",
        ),
        ('sample = "matt white"', 'sample = "mat white"', "examples.sample: .*'matt white'"),
        ("trials = 2", 'trials = 2\nshown_feature = "pillar2_axis"', "shown_feature: .*pillar1, .*'pillar2'"),
        ("distances_mm = [600]", "distances_mm = [450]", r"coupons\.shown_distance_mm: found 600\.0; allowed: 450"),
    ],
)
def test_a_name_that_a_slide_shows_is_checked_before_work(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = small_talk(tmp_path)
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_talk(path)


def test_a_capture_belongs_to_the_view_of_its_standoff(tmp_path: Path) -> None:
    talk = read_talk(small_talk(tmp_path))
    assert {view.standoff for view in talk.views} == {520.0, 600.0}
    small = Transform.from_degrees([0.5, 0, 1], [2, 1, 3])
    for view in talk.views:
        assert _nearest(talk, view.world_from_sensor @ small, tmp_path) is view
    away = Transform(np.eye(3), np.array([0.0, 0.0, -250.0]))
    with pytest.raises(InputError, match=r"0\.0 deg and (170|250) mm from the nearest view"):
        _nearest(talk, talk.views[0].world_from_sensor @ away, tmp_path)


def test_a_capture_that_is_a_tenth_too_far_belongs_to_no_view(tmp_path: Path) -> None:
    talk = read_talk(small_talk(tmp_path))
    view = max(talk.views, key=lambda one: one.standoff)
    far = Transform(np.eye(3), np.array([0.0, 0.0, -0.1 * view.standoff]))
    with pytest.raises(InputError, match="at its standoff within 5 %"):
        _nearest(talk, view.world_from_sensor @ far, tmp_path)


def test_what_a_campaign_or_task_says_enters_the_digests_of_the_pieces_that_read_it(tmp_path: Path) -> None:
    path = small_talk(tmp_path)

    def digests() -> dict[str, str]:
        _file_digest.cache_clear()
        return {piece.name: piece.digest(tmp_path) for piece in pieces_of(read_talk(path))}

    def changed(name: str, old: str, new: str) -> set[str]:
        before, text = digests(), (tmp_path / name).read_text(encoding="utf-8")
        (tmp_path / name).write_text(text.replace(old, new), encoding="utf-8")
        after = digests()
        return {re.sub("_.*", "", piece) for piece in after if after[piece] != before[piece]}

    of_coupons = {"characterised", "tilts", "sub", "clouds", "validation"}
    assert changed("coupons.toml", "samples_per_pixel = 4", "samples_per_pixel = 8") == of_coupons
    assert changed("task.toml", "[measurements", "# a remark\n[measurements") == {"finish", "scores", "light"}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Make the small talk once; return its file and its output folder."""
    folder = tmp_path_factory.mktemp("talk")
    path, output = small_talk(folder), folder / "out"
    talk, results = read_talk(path), Results(output / "kept")
    assert make(talk, results, output) == []
    write_talk(talk, results, output, [])
    return path, output


def test_the_page_has_every_slide_with_its_claims_and_pictures(made: tuple[Path, Path]) -> None:
    _, output = made
    page, text = ((output / name).read_text(encoding="utf-8") for name in ("talk.html", "the-talk.md"))
    titles = re.findall(r"^## (\d+)\. (.*)$", text, re.MULTILINE)
    assert [int(number) for number, _ in titles] == list(range(1, 12))
    assert page.count("<blockquote>") == text.count("\n> ") >= 14
    assert "Not made yet" not in page
    pictures = re.findall(r"!\[[^\]]+\]\((images/[^)]+)\)", text)
    assert page.count('src="data:image/png') == len(pictures) >= 13
    for name in pictures:
        with Image.open(output / name) as picture:
            assert np.ptp(np.asarray(picture.convert("L"))) > 100
    assert 'src="http' not in page
    assert re.search(r"\bnan\b", re.sub(r"data:[^\"]*", "", page)) is None


def test_twenty_views_of_two_samples_are_measured(made: tuple[Path, Path]) -> None:
    path, output = made
    talk, results = read_talk(path), Results(output / "kept", any_version=True)
    assert len(talk.views) == 20
    for sample in ("matt_white", "Ra_0.37"):
        errors = results.get(f"trials_{sample}")
        assert errors is not None
        assert errors["error"].shape == (7, 20, 2)
        radius = errors["error"].sel(measurement="pillar1_radius").values
        assert np.isfinite(radius).any(axis=1).sum() >= 3  # of a sensor with few pixels


def test_kept_results_are_used_until_something_they_depend_on_changes(made: tuple[Path, Path], tmp_path: Path) -> None:
    path, output = made
    talk = read_talk(path)
    again = Results(tmp_path / "kept", (output / "kept",))
    assert make(talk, again, tmp_path) == []
    assert not (tmp_path / "kept").exists()  # nothing was made
    other = Results(tmp_path / "kept", (output / "kept",))
    changed = path.with_name("changed.toml")
    changed.write_text(path.read_text(encoding="utf-8").replace("tilts_deg = [0, 40]", "tilts_deg = [0, 30]"), "utf-8")
    assert make(read_talk(changed), other, tmp_path) == []
    assert [one.name for one in (tmp_path / "kept").iterdir()] == ["tilts.nc"]


def test_missing_results_are_named_on_the_page(made: tuple[Path, Path], tmp_path: Path) -> None:
    path, output = made
    kept = copied(output / "kept", tmp_path / "kept", ("tilts", "trials_matt_white", "scores_matt_white"))
    talk, results = read_talk(path), Results(kept, any_version=True)
    missing = missing_results(talk, results)
    assert set(missing) == {file.stem for file in (output / "kept").iterdir()} - {file.stem for file in kept.iterdir()}
    page = write_talk(talk, results, tmp_path, missing).read_text(encoding="utf-8")
    assert page.count("Not made yet") >= 6
    assert "trials_Ra_0.37" in page


def test_real_captures_replace_the_virtual_measurements_of_their_sample(
    made: tuple[Path, Path], tmp_path: Path
) -> None:
    from mitsim.study.session import Session

    path, output = made
    talk = read_talk(path)
    study = talk.study(talk.sample("matt white"))
    results = Results(output / "kept", any_version=True)
    scores = results.get("scores_matt_white")
    assert scores is not None
    best = int(scores["V_m"].sel(measurement="pillar1_radius").values.argmax())
    view = study.views[best]
    renderer = Session(study).renderer
    assert renderer is not None
    capture, _ = renderer.at_best_estimates(view)
    write_capture(capture, tmp_path / "matt_white" / "first")
    found = measured_errors(talk, tmp_path)
    assert list(found) == ["matt_white"]
    tried = found["matt_white"]["tried"].values
    assert tried.sum() == tried[best] == 1
    radius = found["matt_white"]["error"].sel(measurement="pillar1_radius").values[best]
    assert abs(radius[0]) < 8.0  # mm, of a radius of 38 mm in coarse pixels
    some = Results(copied(output / "kept", tmp_path / "kept", ("scores_matt_white",)), any_version=True)
    page = write_talk(talk, some, tmp_path / "page", [], found).read_text(encoding="utf-8")
    assert "real captures" in page
    write_capture(capture, tmp_path / "wood" / "first")
    with pytest.raises(InputError, match=r"matt white, Ra 0\.37"):
        measured_errors(talk, tmp_path)


def test_command_draws_what_is_kept_and_names_what_is_missing(made: tuple[Path, Path], tmp_path: Path) -> None:
    path, output = made
    copied(output / "kept", tmp_path / "out" / "kept", ("tilts",))
    done = mitsim_here("study", "talk", path, "-o", tmp_path / "out", "--kept", code=1)
    assert re.search(r"\d+ results are missing: opening_ensenso-n10, ", done.stderr + done.stdout)
    page = (tmp_path / "out" / "talk.html").read_text(encoding="utf-8")
    assert "F by density differs" in page
    assert page.count("Not made yet") >= 8
    refused = mitsim_here("study", "talk", path, "-o", tmp_path / "out", "--kept", "--fresh", code=2)
    assert "only one of the two" in refused.stderr
