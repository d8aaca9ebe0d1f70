"""The documentation against the code: links, commands, keys, columns and examples."""

import importlib
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import typer
import xarray as xr

from characterisation.cloud_files import write_ply
from characterisation.coupon.patches import Coupon, measure_patches
from characterisation.documents import validate
from characterisation.errors import InputError
from characterisation.maps.performance_map import SampleTable, build_map
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.scores.view_score import score_table, score_views, view_statistics
from characterisation.tasks.evaluation import Task
from mitsim.campaign.plan import CampaignFile
from mitsim.campaign.run import _all_patches
from mitsim.cli import app
from mitsim.report.run_folder import RunDocument
from mitsim.run_study import pose_columns
from mitsim.sensor.sensor_file import SensorFile
from mitsim.study import StudyFile
from mitsim.surface.seen import as_made
from mitsim.validation.part_cases import PartCasesFile

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FORMATS = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
COMMANDS = typer.main.get_command(app).commands
MODELS = {"campaign": CampaignFile, "sensor": SensorFile, "study": StudyFile, "task": Task,
          "validation": PartCasesFile}  # fmt: skip

by_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def blocks(text: str) -> list[str]:
    """Contents of the fenced blocks, whatever their language."""
    return re.findall(r"^```[^\n]*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def anchors(text: str) -> set[str]:
    """Anchors that a page's headings have on GitHub."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def first_column(marker: str) -> set[str]:
    """Names in backticks in the first column of the table that follows a marker comment in formats.md."""
    assert FORMATS.count(f"<!-- {marker} -->") == 1, marker
    table = FORMATS.partition(f"<!-- {marker} -->\n")[2].partition("\n\n")[0]
    rows = [row.split("|")[1] for row in table.splitlines()[2:]]
    return {name for row in rows for name in re.findall(r"`([^`]+)`", row)}


@by_page
def test_relative_links_lead_to_files_and_headings(page):
    text = page.read_text(encoding="utf-8")
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)\s]+)\)", prose):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        goal = (page.parent / path).resolve() if path else page
        assert goal.exists(), target
        if anchor:
            assert anchor in anchors(goal.read_text(encoding="utf-8")), target


def test_pictures_are_used_and_small():
    pictures = sorted((ROOT / "docs").rglob("*.png"))
    used = {
        (page.parent / target).resolve()
        for page in PAGES
        for target in re.findall(r"!\[[^\]]*\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    }
    assert 0 < len([one for one in pictures if one.parent.name == "images"]) <= 33
    for picture in pictures:
        assert picture.stat().st_size < 200_000, picture.name
        assert picture in used, picture.name
    assert {path.suffix for path in (ROOT / "docs" / "images").iterdir()} == {".png"}


@by_page
def test_commands_and_their_options_exist(page):
    text = page.read_text(encoding="utf-8")
    tables = "\n".join(line for line in text.splitlines() if line.startswith("|"))
    lines = [line for block in blocks(text) for line in block.splitlines()]
    lines += re.findall(r"`([^`]+)`", tables)
    for line in lines:
        call = re.match(r"(?:\S*/)?mitsim ([a-z][a-z-]*)(?= |$)(.*)", line.strip())
        if call is None:
            continue
        assert call.group(1) in COMMANDS, line
        command = COMMANDS[call.group(1)]
        if hasattr(command, "commands"):  # a group: the next word is the command
            words = call.group(2).split()
            assert words and words[0] in command.commands, line
            command = command.commands[words[0]]
        known = {flag for option in command.params for flag in option.opts} | {"--help"}
        given = re.findall(r"(?<=\s)(--?[A-Za-z][\w-]*)", call.group(2))
        assert set(given) <= known, line


def test_readme_lists_every_command():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    every = {
        f"{name} {one}" if one else name for name, command in COMMANDS.items()
        for one in getattr(command, "commands", {"": None})
    }  # fmt: skip
    assert {name for name in every if f"| `mitsim {name}" not in readme} == set()


@pytest.mark.parametrize("marker", re.findall(r"<!-- (keys: .*?) -->", FORMATS))
def test_documented_keys_are_the_fields_of_the_model(marker):
    def fields(path: str) -> set[str]:
        module, _, name = path.rpartition(".")
        return set(getattr(importlib.import_module(module), name).model_fields)

    model, _, base = marker.removeprefix("keys: ").partition(" - ")
    assert first_column(marker) == fields(model) - (fields(base) if base else set())


def test_every_model_of_a_toml_file_is_documented():
    documented = {path.rpartition(".")[2] for path in re.findall(r"<!-- keys: (\S+)", FORMATS)}
    seen, todo = set(), [*MODELS.values()]
    while todo:
        model = todo.pop()
        seen.add(model.__name__)
        text = " ".join(str(field.annotation) for field in model.model_fields.values())
        module = importlib.import_module(model.__module__)
        names = set(re.findall(r"[\w.]+\.(\w+)", text)) | {
            getattr(field.annotation, "__name__", "") for field in model.model_fields.values()
        }
        todo += [
            getattr(module, name) for name in names
            if hasattr(getattr(module, name, None), "model_fields") and name not in seen
        ]  # fmt: skip
    assert {"CheckTable", "Band", "ImagerTable", "MatcherSettings", "FixedExposure", "Measurement"} <= seen
    assert seen <= documented


@by_page
def test_examples_that_are_whole_files_are_valid(page):
    text = page.read_text(encoding="utf-8")
    for kind, language, content in re.findall(r"<!-- complete: (\w+) -->\n```(\w+)\n(.*?)^```", text, re.S | re.M):
        if language == "toml":
            validate(page, tomllib.loads(content), MODELS[kind])
            continue
        root = ElementTree.fromstring(content)
        assert (root.tag, kind) == ("scene", "scene")
        assert all(shape.get("id") for shape in root.iter("shape"))
        for bsdf in root.iter("bsdf"):
            given = {str(child.get("name")) for child in bsdf}
            assert given <= first_column(f"properties: {bsdf.get('type')}")
    assert text.count("<!-- complete:") == len(re.findall(r"<!-- complete: \w+ -->\n```", text))


@pytest.mark.parametrize("kind", ["machined_metal", "matt_white", "gloss_paint", "powder_coat"])
def test_documented_properties_are_those_of_the_bsdf(kind, tmp_path):
    from mitsim.scene.load import load_scene

    scene = tmp_path / "scene.xml"
    bsdf = f'<bsdf type="{kind}" id="f"><float name="Ra_max" value="1"/></bsdf>'
    scene.write_text(f'<scene version="3.0.0"><shape type="sphere" id="s">{bsdf}</shape></scene>', encoding="utf-8")
    with pytest.raises(InputError, match="an unknown property") as raised:
        load_scene(scene, 850.0)
    assert first_column(f"properties: {kind}") == set(raised.value.allowed.split(", "))


def test_documented_names_of_metals_and_processes():
    from mitsim.surface.metals import CONSTANTS
    from mitsim.surface.processes import PROCESSES

    for key, names in (("metal", CONSTANTS), ("process", PROCESSES)):
        row = next(line for line in FORMATS.splitlines() if line.startswith(f"| `{key}` | string |"))
        assert re.findall(r"`(\w+)`", row)[1:] == list(names)


def test_documented_statuses():
    rows = re.findall(r"^\| (\d+) \| `([A-Z_]+)` \|", FORMATS, re.MULTILINE)
    assert [(int(number), name) for number, name in rows] == [(status.value, status.name) for status in Status]


@pytest.fixture(scope="module")
def patches() -> xr.Dataset:
    return measure_patches(flat_cloud(), Coupon(np.array([0, 0, 500.0]), np.array([0, 0, -1.0]), np.eye(3)[0], 80, 80))


def flat_cloud() -> PointCloud:
    grid = ViewGrid(600.0, 600.0, 59.5, 59.5, 120, 120)
    rays = grid.rays()
    points = (rays * (500.0 / rays[..., 2:])).astype(np.float32)
    return PointCloud(points, np.zeros((120, 120), np.uint8), grid, "test", "simulated")


def test_documented_variables_of_samples_and_map(patches):
    table = SampleTable("matt_white", np.nan, 500.0, patches, light=as_made("matt_white", np.nan, 850.0))
    written = {*map(str, _all_patches([table]).variables), "orientation"}  # added where a campaign counts its captures
    assert first_column("columns: samples.nc") == written
    data = build_map([table], {}, 0.3, nodes=5).data
    assert first_column("columns: map.nc") == set(map(str, data.variables))


def test_documented_properties_of_a_cloud_file(tmp_path):
    write_ply(flat_cloud(), tmp_path / "cloud.ply")
    head = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header")[0].decode()
    table = FORMATS.partition("<!-- columns: cloud.ply -->\n")[2].partition("\n\n")[0]
    documented = {
        (cells[3].strip(), name)
        for cells in (row.split("|") for row in table.splitlines()[2:])
        for name in re.findall(r"`(\w+)`", cells[2])
    }
    assert documented == set(re.findall(r"^property (\w+) (\w+)$", head, re.MULTILINE))


def test_documented_columns_of_the_scores():
    task = validate(
        "test", tomllib.loads(re.findall(r"<!-- complete: task -->\n```toml\n(.*?)^```", FORMATS, re.S | re.M)[0]), Task
    )
    ones = np.ones((1, 2))
    scores = score_views(view_statistics(list(task.shapes), *[ones] * 5), task, minimum_points=1)
    for name in ("predicted_uncertainty", "chance", "uncertainty_rank", "limit", "limiting_feature", "final_rank",
                 "measured_risk", "trials"):  # fmt: skip
        scores[name] = (("measurement", "view"), np.zeros((1, 1)))
    for name in ("azimuth_deg", "elevation_deg", "roll_deg", "standoff_mm"):
        scores[name] = (("view",), np.zeros(1))
    scores["world_from_sensor"] = (("view", "i", "j"), np.eye(4)[None])
    extra = pose_columns(scores)
    columns = {"n_FEATURE" if name.startswith("n_") else name for name in score_table(scores, extra)[0]}
    assert first_column("columns: scores.csv") == columns
    section = FORMATS.partition("### scores.nc")[2].partition("###")[0]
    missing = set(map(str, scores.data_vars)) - set(re.findall(r"`(\w+)`", section))
    assert not missing


def test_documented_keys_of_a_run_hold_what_the_report_reads():
    assert set(RunDocument.model_fields) <= first_column("columns: run.json")


def test_architecture_names_code_that_exists():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for path, name in re.findall(r"`((?:mitsim|characterisation)/[\w/]+\.py)(?:: ([\w.]+))?`", text):
        source = (ROOT / path).read_text(encoding="utf-8")
        last = name.rpartition(".")[2]
        assert not last or re.search(rf"^\s*(?:def|class) {last}\b|^{last}\b", source, re.MULTILINE), (path, name)
