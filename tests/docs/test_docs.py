"""The documentation against the code: links, commands, keys, columns and examples."""

import importlib
import json
import re
import tomllib
import typing
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import typer
import xarray as xr
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from characterisation.cloud_files import write_cloud
from characterisation.coupon.patches import Coupon, measure_patches
from characterisation.files.documents import Document, validate
from characterisation.files.documents import fields_of as keys_of
from characterisation.files.errors import InputError
from characterisation.maps.building import SampleTable, build_map
from characterisation.maps.joined import with_directions
from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.scores.joining import POSE_KNOWN
from characterisation.scores.view_score import score_table, score_views, view_statistics
from characterisation.tasks.task_file import Task
from mitsim.capture.capture_document import CaptureDocument
from mitsim.capture.devices.depthai_settings import DepthaiSettings
from mitsim.cli.options import DefaultCommandGroup
from mitsim.cli.program import app
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.maps.campaign.run import _all_patches
from mitsim.maps.campaign.stage_pose import StageCalibrationFile
from mitsim.scene.surface.surface_light import nominal_light
from mitsim.sensor.rig_covariance import CovarianceFile
from mitsim.sensor.sensor_file import ImagerTable, ProjectorTable, SensorFile
from mitsim.sensor.unknowns import UnknownsTable
from mitsim.study import StudyFile
from mitsim.study.many_captures import ManyFile
from mitsim.study.run_document import RunDocument
from mitsim.study.scoring import pose_columns
from mitsim.study.statement_file import StatementDocument
from mitsim.talk.talk_file import TalkFile
from tests.proofs.laboratory.cases import LaboratoryFile
from tests.proofs.part_cases import PartCasesFile

ROOT = Path(__file__).resolve().parents[2]
PROOFS = ROOT / "tests" / "proofs" / "README.md"
PAGES = [ROOT / "README.md", PROOFS, *sorted((ROOT / "docs").rglob("*.md"))]
FORMAT_PAGES = sorted((ROOT / "docs" / "reference" / "formats").glob("*.md"))
#: text of all pages of formats; a marker stands once among them
FORMATS = "\n\n".join(page.read_text(encoding="utf-8") for page in [*FORMAT_PAGES, PROOFS])
COMMANDS = typer.main.get_command(app).commands


class UnknownsOfFile(Document):
    """The unknowns alone of a study or a sensor file."""

    unknowns: UnknownsTable


#: by the kind of a complete example, what it has to be; those of TOML files are documented with all that they hold
TOML_MODELS = {
    "campaign": CampaignFile,
    "sensor": SensorFile,
    "study": StudyFile,
    "task": Task,
    "validation": PartCasesFile,
    "laboratory": LaboratoryFile,
    "many": ManyFile,
    "talk": TalkFile,
    "covariance": CovarianceFile,
    "depthai": DepthaiSettings,
    "unknowns": UnknownsOfFile,
}
JSON_MODELS = {
    "capture": CaptureDocument,
    "stage_calibration": StageCalibrationFile,
    "statement": StatementDocument,
}

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
    """Names in backticks in the first column of the table that follows a marker comment in the pages of formats."""
    return {name for cells in table_rows(marker) for name in re.findall(r"`([^`]+)`", cells[0])}


def table_rows(marker: str) -> list[list[str]]:
    """Cells of the rows of the table that follows a marker comment; a vertical bar in a cell is written as ``\\|``."""
    assert FORMATS.count(f"<!-- {marker} -->") == 1, marker
    table = FORMATS.partition(f"<!-- {marker} -->\n")[2].partition("\n\n")[0]
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", row)[1:-1]] for row in table.splitlines()]
    assert {len(row) for row in rows} == {len(rows[0])}, marker
    return rows[2:]


def model_of(path: str) -> type[BaseModel]:
    """Model by its path."""
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


def fields_of(marker: str) -> dict[str, FieldInfo]:
    """Fields of the model of a ``keys:`` marker; of ``MODEL - BASE`` those that the base does not have."""
    path, _, base = marker.removeprefix("keys: ").partition(" - ")
    without = set(keys_of(model_of(base))) if base else set()
    return {name: field for name, field in keys_of(model_of(path)).items() if name not in without}


def test_each_shell_block_of_the_readme_works_in_an_empty_clone():
    """CI and strangers run either block alone, so each makes the environment that its later lines use."""
    blocks = re.findall(r"^```sh\n(.*?)^```", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S)
    using = [block for block in blocks if ".venv/bin/" in block]
    assert len(using) >= 2
    for block in using:
        assert block.splitlines()[0] == "python3 -m venv .venv", block


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
    assert pictures
    for picture in pictures:
        assert picture.stat().st_size < 300_000, picture.name
        assert picture in used, picture.name
    assert {path.suffix for path in (ROOT / "docs" / "images").iterdir()} == {".png"}


@by_page
def test_commands_and_their_options_exist(page):
    text = page.read_text(encoding="utf-8")
    tables = "\n".join(line for line in text.splitlines() if line.startswith("|"))
    lines = [line for block in blocks(text) for line in block.splitlines()]
    lines += re.findall(r"`([^`]+)`", tables)
    for line in lines:
        check_call(line)


def check_call(line: str) -> None:
    """If a line calls mitsim, its command and options exist."""
    call = re.match(r"(?:\S*/)?mitsim ([a-z][a-z-]*)(?= |$)(.*)", line.strip())
    if call is None:
        return
    assert call.group(1) in COMMANDS, line
    command = COMMANDS[call.group(1)]
    if hasattr(command, "commands"):  # a group: the next word is the command
        words = call.group(2).split()
        named = words[0] if words else ""
        if isinstance(command, DefaultCommandGroup) and named not in command.commands:
            named = next(iter(command.commands))
        assert named in command.commands, line
        command = command.commands[named]
    known = {flag for option in command.params for flag in option.opts} | {"--help"}
    given = re.findall(r"(?<=\s)(--?[A-Za-z][\w-]*)", call.group(2))
    assert set(given) <= known, line


def test_readme_is_short_and_the_program_has_few_commands():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.split()) <= 700
    assert len(re.findall(r"^\| `mitsim ", readme, re.MULTILINE)) <= 12
    assert len(COMMANDS) <= 16


@pytest.mark.parametrize("marker", re.findall(r"<!-- (keys: .*?) -->", FORMATS))
def test_documented_keys_are_the_fields_of_the_model(marker):
    names = [name for cells in table_rows(marker) for name in re.findall(r"`([^`]+)`", cells[0])]
    assert len(names) == len(set(names))
    assert set(names) == set(fields_of(marker))


@pytest.mark.parametrize("marker", re.findall(r"<!-- (keys: .*?) -->\n\| key \| type and unit \| default", FORMATS))
def test_documented_defaults_are_those_of_the_model(marker):
    fields = fields_of(marker)
    for names, _, told, _ in table_rows(marker):
        keys = re.findall(r"`([^`]+)`", names)
        cells = re.findall(r"`[^`]*`|[^,`]+", told) if told.count("`") > 2 and len(keys) > 1 else [told]
        cells = [cell.strip() for cell in cells if cell.strip()]
        assert len(cells) in (1, len(keys)), (names, told)
        for key, cell in zip(keys, cells * (len(keys) // len(cells)), strict=True):
            check_default(f"{marker}: {key}", fields[key], key, cell)


def check_default(where: str, field: FieldInfo, key: str, told: str) -> None:
    """A default in backticks is the model's; in words it is required, infinite, or follows from something else."""
    default = field.get_default(call_default_factory=True)
    if field.is_required() or (key == "kind" and told == "required"):  # a union is told apart by kind
        assert told == "required", where
    elif told.startswith("`"):
        shown = tomllib.loads(f"value = {told.strip('`')}")["value"]
        assert default == (tuple(shown) if isinstance(default, tuple) else shown), where
        assert type(default) in (type(shown), tuple, float), where
    elif told == "infinity":
        assert default == float("inf"), where
    elif told == "simulation needs it":
        unknown = default in (None, ProjectorTable(), ImagerTable()) or np.isnan(default).all()
        assert unknown, where
    elif told == "its defaults":
        assert isinstance(default, BaseModel), where
    else:
        assert told and told != "required", where
        empty = default in (None, "", [], {}, ()) or isinstance(default, BaseModel)
        assert empty or (isinstance(default, list) and isinstance(default[0], BaseModel)), where


@pytest.mark.parametrize("marker", re.findall(r"<!-- (keys: .*?) -->\n\| key \| type and unit \| default", FORMATS))
def test_documented_ranges_hold_the_limits_of_the_model(marker):
    fields = fields_of(marker)
    for names, kind, _, meaning in table_rows(marker):
        written = {float(number) for number in re.findall(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?", f"{kind} {meaning}")}
        for key in re.findall(r"`([^`]+)`", names):
            for limit in limits_of(fields[key]) - {0.0}:
                assert limit in written, (marker, key, limit)


def limits_of(value: object) -> set[float]:
    """Numbers that a field, an annotation or what is inside of it must not pass, under a million."""
    found: set[float] = set()
    for part in getattr(value, "metadata", ()) or ():
        found |= limits_of(part)
        for name in ("ge", "gt", "le", "lt"):
            limit = getattr(part, name, None)
            if limit is not None and abs(limit) < 1e6:
                found.add(float(limit))
    inner = getattr(value, "annotation", None) if isinstance(value, FieldInfo) else value
    if inner is not None and inner is not value:
        found |= limits_of(inner)
    for argument in typing.get_args(value):
        found |= limits_of(argument)
    return found


def test_every_model_of_a_toml_file_is_documented():
    documented = {path.rpartition(".")[2] for path in re.findall(r"<!-- keys: (\S+)", FORMATS)}
    seen, todo = {UnknownsOfFile.__name__}, [*TOML_MODELS.values()]
    while todo:
        model = todo.pop()
        seen.add(model.__name__)
        fields = keys_of(model).values()
        text = " ".join(str(field.annotation) for field in fields)
        module = importlib.import_module(model.__module__)
        names = set(re.findall(r"[\w.]+\.(\w+)", text)) | {
            getattr(field.annotation, "__name__", "") for field in fields
        }
        todo += [getattr(module, name) for name in names if is_table(getattr(module, name, None)) and name not in seen]
    assert {"CheckTable", "Band", "ImagerTable", "MatcherSettings", "FixedExposure", "Measurement"} <= seen
    assert seen - {UnknownsOfFile.__name__} <= documented


def is_table(value: object) -> bool:
    """Whether a value is a model, or a data class with limits for a file."""
    return hasattr(value, "model_fields") or hasattr(value, "__pydantic_config__")


def test_index_of_formats_links_every_page_and_the_pages_name_every_command():
    index = next(page for page in FORMAT_PAGES if page.name == "index.md").read_text(encoding="utf-8")
    text = " ".join(FORMATS.split())
    linked = {target.partition("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", index)}
    assert {page.name for page in FORMAT_PAGES} - {"index.md"} <= linked
    every = {
        f"{name} {one}".strip()
        for name, command in COMMANDS.items()
        for one in getattr(command, "commands", {"": None})
    } - {"measure clouds", "calibrate rig"}  # the first of their groups, called without their names
    assert {name for name in every if f"`mitsim {name}`" not in text} == set()


@pytest.mark.parametrize("page", [page for page in FORMAT_PAGES if page.name != "index.md"], ids=lambda page: page.stem)
def test_page_of_a_format_has_an_example_before_its_first_table(page):
    text = page.read_text(encoding="utf-8")
    assert 0 < text.index("\n```") < text.index("\n|")


def test_every_unknown_with_a_default_has_its_source():
    page = (ROOT / "docs" / "reference" / "unknowns.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("|")]
    sourced = {name for cells in rows for name in re.findall(r"`(\w+\.\w+)`", cells[0])}
    keys = {
        f"{group}.{key}": field.default
        for group, table in UnknownsTable.model_fields.items()
        for key, field in table.annotation.model_fields.items()
    }
    assert sourced <= set(keys)
    numbers = {key for key, default in keys.items() if type(default) in (int, float)}
    assert numbers <= sourced
    known = {
        cells[0].strip("`"): (float(cells[1]), float(cells[2])) for cells in rows if cells[0].strip("`") in POSE_KNOWN
    }
    assert known == POSE_KNOWN


@by_page
def test_examples_that_are_whole_files_are_valid(page):
    text = page.read_text(encoding="utf-8")
    for kind, language, content in re.findall(r"<!-- complete: (\w+) -->\n```(\w+)\n(.*?)^```", text, re.S | re.M):
        if language == "toml":
            validate(page, tomllib.loads(content), TOML_MODELS[kind])
            continue
        if language == "json":
            validate(page, json.loads(content), JSON_MODELS[kind])
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
    from mitsim.scene.surface.metals import CONSTANTS
    from mitsim.scene.surface.processes import PROCESSES

    for key, names in (("metal", CONSTANTS), ("process", PROCESSES)):
        rows = table_rows("properties: machined_metal")
        meaning = next(cells[-1] for cells in rows if cells[0] == f"`{key}`")
        assert re.findall(r"`(\w+)`", meaning) == list(names)


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
    counted = patches.assign(orientation=("patch", np.zeros(patches.sizes["patch"], int)))  # as a campaign counts them
    table = SampleTable("matt_white", np.nan, 500.0, counted, light=nominal_light("matt_white", np.nan, 850.0))
    assert first_column("columns: samples.nc") == set(map(str, _all_patches([table]).variables))
    data = build_map([table], {}, 0.3, nodes=5).data
    with_a_lay = with_directions(PerformanceMap(data), [PerformanceMap(data)] * 4, (50.0, 0.0)).data
    assert first_column("columns: map.nc") == set(map(str, with_a_lay.variables))


def test_documented_properties_of_a_cloud_file(tmp_path):
    write_cloud(flat_cloud(), tmp_path / "cloud.ply")
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
    for name in (
        "predicted_uncertainty",
        "chance",
        "uncertainty_rank",
        "limit",
        "limiting_feature",
        "final_rank",
        "measured_risk",
        "trials",
    ):
        scores[name] = (("measurement", "view"), np.zeros((1, 1)))
    for name in ("azimuth_deg", "elevation_deg", "roll_deg", "standoff_mm"):
        scores[name] = (("view",), np.zeros(1))
    scores["world_from_sensor"] = (("view", "i", "j"), np.eye(4)[None])
    extra = pose_columns(scores)
    columns = {"n_FEATURE" if name.startswith("n_") else name for name in score_table(scores, extra)[0]}
    assert first_column("columns: scores.csv") == columns
    section = FORMATS.partition("## scores.nc")[2].partition("##")[0]
    missing = set(map(str, scores.data_vars)) - set(re.findall(r"`(\w+)`", section))
    assert not missing


def test_documented_keys_of_a_run_hold_what_the_report_reads():
    assert set(RunDocument.model_fields) <= first_column("columns: run.json")


@by_page
def test_pages_name_code_that_exists(page):
    text = " ".join(page.read_text(encoding="utf-8").split())
    for path, name in re.findall(r"`((?:mitsim|characterisation)/[\w/]+\.py)(?:: ([\w.]+))?`", text):
        source = (ROOT / path).read_text(encoding="utf-8")
        last = name.rpartition(".")[2]
        assert not last or re.search(rf"^\s*(?:def|class) {last}\b|^{last}\b", source, re.MULTILINE), (path, name)


def test_validity_answers_every_criterion_and_names_tests_that_exist():
    text = (ROOT / "docs" / "explanation" / "validity.md").read_text(encoding="utf-8")
    rows = [row.split("|")[1:-1] for row in text.splitlines() if re.match(r"\| \d+ \|", row)]
    assert [int(row[0]) for row in rows] == list(range(1, 20))
    for _, criterion, _, answer, shown in rows:
        named = re.findall(r"`([\w/]+\.py)::(\w+)`", shown)
        assert len(named) == shown.count("`") // 2
        assert named or "not met" in answer, criterion
        for path, name in named:
            assert re.search(rf"^def {name}\(", (ROOT / path).read_text(encoding="utf-8"), re.MULTILINE), (path, name)


@by_page
def test_the_site_shows_every_list_as_a_list(page):
    """Python-Markdown wants an empty line before a list, and four spaces before a nested one."""
    lines = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S).splitlines()
    item = re.compile(r"( *)(?:-|\d+\.) ")
    inside = False
    for before, line in zip(["", *lines], lines, strict=False):
        found = item.match(line)
        if found:
            assert len(found[1]) % 4 == 0, line
            assert inside or not before.strip(), line
        inside = found is not None or (inside and bool(line.strip()))
