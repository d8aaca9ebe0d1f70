"""The sphere of views: what stands on the page is what stands in the run's files, and nothing reaches outside it."""

import base64
import hashlib
import html
import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from characterisation.cloud_files import read_cloud
from characterisation.files.atomic_io import write_netcdf
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.report import view_clouds
from mitsim.report.page import _rolls, _standoffs, write_report
from mitsim.report.templates import joined_script
from mitsim.report.view_clouds import (
    CoordinateRaster,
    box_around,
    choose_clouds,
    fewer_triangles,
    packed_part,
    shown_cloud,
)
from mitsim.report.view_data import sites, target
from mitsim.report.view_figures import uncertainty_figure
from mitsim.report.view_sphere import LEAST_CHANCE, SCRIPTS, view_sphere
from mitsim.study.run_folder import read_run
from tests.report.conftest import CHECKED, FEATURES, MEASUREMENTS
from tests.report.test_page import Tags
from tests.report.view_sphere_run import IMPOSSIBLE, VIEWS, WITH_CLOUD


@pytest.fixture(scope="module")
def text(page) -> str:
    return page.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def data(text) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="sphere-data">(.*?)</script>', text)[1])


def copied(expecting, tmp_path):
    shutil.copytree(expecting, tmp_path / "run")
    return tmp_path / "run"


def same(told, values) -> None:
    """Lists of the page against an array: five significant digits, None where it is NaN."""
    found = np.array([[math.nan if x is None else x for x in row] for row in np.atleast_2d(np.array(told, object))])
    np.testing.assert_allclose(found.astype(float), np.atleast_2d(values), rtol=5e-5, atol=1e-12)


def test_numbers_of_the_page_are_those_of_the_scores(data, expecting):
    scores = xr.load_dataset(expecting / "scores.nc")
    assert data["views"]["number"] == scores["view"].values.tolist()
    for name in ("direction", "azimuth_deg", "elevation_deg", "roll_deg", "standoff_mm"):
        same(data["views"][name], scores[name].values)
    same(data["views"]["position"], scores["world_from_sensor"].values[:, :3, 3].round(9))
    for k, feature in enumerate(data["features"]):
        assert feature["name"] == FEATURES[k]
        for short, long in {"points": "n", "sigma": "mean_sigma", "in_sight": "R_f", "alone": "n_only_white"}.items():
            same(feature[short], scores[long].sel(feature=FEATURES[k]).values)
    assert [one["name"] for one in data["measurements"]] == list(MEASUREMENTS)
    for m, one in enumerate(data["measurements"]):
        here = scores.isel(measurement=m)
        names = {
            "uncertainty": "predicted_uncertainty",
            "chance": "chance",
            "score": "V_m",
            "score_rank": "rank",
            "rank": "uncertainty_rank",
        }
        for short, long in names.items():
            same(one[short], here[long].values)
        assert one["limit"] == here["limit"].values.tolist()
        assert one["limiting"] == here["limiting_feature"].values.tolist()
        assert one["possible"] == here["possible"].values.astype(int).tolist()
    assert data["measurements"][0]["tolerance"] == 0.52 and data["measurements"][1]["tolerance"] is None
    assert [one["features"] for one in data["measurements"]] == [[0, 1], [1]]
    assert data["checked"] == CHECKED and data["sets"][0]["views"] == [2, 7]


def test_sets_that_were_measured_and_not_chosen_are_named_with_their_excess(text):
    told = re.findall(r"also measured: [^<]*", text)
    assert told == [
        "also measured: 2 views (4, 7), 1.3 times a limit",
        "also measured: 1 view (5), a measurement without a value",
    ]


def test_a_view_is_able_with_an_uncertainty_and_a_chance_of_one_half(data):
    assert [i for i, able in enumerate(data["measurements"][0]["able"]) if not able] == list(IMPOSSIBLE)
    assert [i for i, able in enumerate(data["measurements"][1]["able"]) if not able] == [3]


def test_least_chance_is_that_of_the_score():
    from mitsim.views import view_scores

    assert view_scores.LEAST_CHANCE == LEAST_CHANCE


def test_table_without_scripts_has_the_best_views_in_order(text):
    body = re.search(r'<tbody id="sphere-best">(.*?)</tbody>', text, re.DOTALL)[1]
    assert [int(n) for n in re.findall(r'data-view="(\d+)"', body)] == [0, 1, 2, 3, 4, 6, 7, 8, 10, 11]
    assert re.search(r">0\.010°</td><td[^>]*>52</td>", body)  # u, and a tolerance of 0.52 deg over it
    assert "Scripts are disabled" in re.search(r"<noscript>(.*?)</noscript>", text, re.DOTALL)[1]


def test_only_the_one_script_of_the_page_may_run_and_it_is_the_projects(text):
    found = re.findall(r"<script([^>]*)>(.*?)</script>", text, re.DOTALL)
    running = [body for attributes, body in found if not attributes]
    assert running == [joined_script(SCRIPTS)]
    assert {re.search('type="([^"]+)"', a)[1] for a, _ in found if a} == {"application/json", "text/plain"}
    digest = base64.b64encode(hashlib.sha256(running[0].encode()).digest()).decode()
    assert html.unescape(text).count(f"script-src 'sha256-{digest}'\">") == 1
    assert text.count("Content-Security-Policy") == 1 and "default-src 'none'" in text


def test_nothing_is_fetched_and_nothing_is_made_into_markup(text):
    tags = Tags(text)
    references = [a[key] for _, a in tags.tags for key in ("src", "href", "xlink:href", "srcset", "action") if key in a]
    assert all(r.startswith(("#", "data:image/png;base64,")) for r in references)
    assert not re.search(r"https?://|@import|url\((?!#)", text)
    refused = r"fetch\(|XMLHttp|WebSocket|import\(|eval\(|innerHTML|document\.write|Function\("
    assert not re.search(refused, joined_script(SCRIPTS))
    assert "plane<i>" not in text and "<b>$" not in text
    assert "<!--" not in joined_script(SCRIPTS) and "</" not in joined_script(SCRIPTS)


def test_every_name_that_the_script_looks_for_is_there_once(text):
    tags = Tags(text)
    ids = [a["id"] for _, a in tags.tags if "id" in a]
    assert all(ids.count(name) == 1 for name in ids if name.startswith("sphere"))
    wanted = {f"sphere-{name}" for name in re.findall(r"place\('([a-z-]+)'\)", joined_script(SCRIPTS))}
    listed = re.search(r"\[('title'.*?)\]", joined_script(SCRIPTS))[1]  # the panel's places
    wanted |= {f"sphere-{name}" for name in re.findall(r"'([a-z-]+)'", listed)}
    assert len(wanted) > 15 and wanted <= set(ids)
    acts = {a["data-act"] for _, a in tags.tags if "data-act" in a}
    assert acts == set(re.findall(r"'((?:sphere|seen)-\w+)': ", joined_script(SCRIPTS))) and len(acts) == 6


def test_pictures_and_buttons_can_be_reached_and_have_names(text):
    tags = Tags(text)
    ids = {a["id"] for _, a in tags.tags if "id" in a}
    canvases = tags.all("canvas")
    assert len(canvases) == 2
    for canvas in canvases:
        assert canvas["tabindex"] == "0" and canvas["role"] == "application"
        assert {*canvas["aria-labelledby"].split(), *canvas["aria-describedby"].split()} <= ids
    assert [a for _, a in tags.tags if a.get("role") == "status" and a.get("aria-live") == "polite"]
    assert all(button.get("type") == "button" for button in tags.all("button"))
    assert {a["href"][1:].removesuffix("-in") for a in tags.all("a")} == {a["id"] for a in tags.all("section")}


def test_a_cloud_on_the_page_is_the_cloud_of_the_file(data, text, expecting):
    scores = xr.load_dataset(expecting / "scores.nc")
    assert sorted(map(int, data["clouds"])) == WITH_CLOUD
    box, (low, high) = data["box"], data["noise"]
    for view in WITH_CLOUD:
        raw = base64.b64decode(re.search(rf'id="sphere-cloud-{view}">([^<]*)<', text)[1])
        count = len(raw) // 8
        assert data["clouds"][str(view)]["shown"] == data["clouds"][str(view)]["count"] == count == 300
        steps = np.frombuffer(raw, "<u2", 3 * count).reshape(3, count).T
        cloud = read_cloud(expecting / "clouds" / f"predicted_{view:04d}.ply")
        pose = scores["world_from_sensor"].sel(view=view).values
        expected = cloud.points[cloud.valid].astype(float) @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(steps * box["step"] + box["origin"], expected, atol=0.51 * box["step"])
        noise, feature = np.frombuffer(raw, np.uint8, offset=6 * count).reshape(2, count)
        sigma = np.clip(cloud.sigma[cloud.valid].astype(float), low, high)
        np.testing.assert_allclose(low * (high / low) ** (noise / 254), sigma, rtol=math.log(high / low) / 254)
        of_task = {0: 1, 1: 0, -1: 255}  # the cloud numbers its own shapes
        assert feature.tolist() == [of_task[k] for k in cloud.feature[cloud.valid].tolist()]


@given(st.integers(1, 4000), st.integers(1, 60), st.integers(1, 60), st.randoms(use_true_random=False))
def test_thinning_keeps_at_most_so_many_points_and_invents_none(most, height, width, random):
    rng = np.random.default_rng(random.getrandbits(32))
    grid = ViewGrid(50, 50, width / 2, height / 2, width, height)
    points = (grid.rays() * 500).astype(np.float32)
    status = np.where(rng.random((height, width)) < 0.8, Status.VALID, Status.DROPPED).astype(np.uint8)
    points[status != Status.VALID] = np.nan
    found = shown_cloud(PointCloud(points, status, grid, "s", "predicted"), np.eye(4), [], most)
    number = int((status == Status.VALID).sum())
    assert found.count == number and len(found.points) <= most
    assert len(found.points) == number or number > most
    known = {tuple(point) for point in points[status == Status.VALID].astype(float)}
    assert {tuple(point) for point in found.points} <= known
    assert (found.feature == -1).all() and np.isnan(found.sigma).all()


def test_thinning_is_even_over_the_image():
    grid = ViewGrid(500, 500, 100, 80, 200, 160)
    cloud = PointCloud((grid.rays() * 500).astype(np.float32), np.zeros((160, 200), np.uint8), grid, "s", "predicted")
    found = shown_cloud(cloud, np.eye(4), [], 5000)
    assert 0.85 * 5000 < len(found.points) <= 5000
    pixels = grid.project(found.points)
    shares = np.histogram2d(pixels[:, 0], pixels[:, 1], bins=(4, 4), range=((-0.5, 199.5), (-0.5, 159.5)))[0]
    # a stride of 2.5 puts 20 or 21 of 50 columns and 16 of 40 rows into a cell
    assert shares.max() / shares.min() < 1.15
    assert found.spacing == pytest.approx(3 * 500 / 500, rel=0.01)  # ceil(2.53) pixels of 1/500 at 500 mm


def test_a_page_of_full_clouds_and_a_full_part_stays_small_enough():
    points = min(view_clouds.MOST_POINTS * view_clouds.MOST_CLOUDS, view_clouds.MOST_POINTS_IN_ALL)
    corners = 3 * view_clouds.MOST_TRIANGLES
    assert (8 * points + (6 + 3 + 2) * corners) * 4 / 3 < 3e6  # of some 4 MB, the other pictures taking the rest
    assert corners <= 65536  # numbers of corners are 16 bits wide


def test_clouds_of_checked_and_best_views_are_chosen_first(expecting, monkeypatch):
    scores = read_run(expecting).scores
    monkeypatch.setattr(view_clouds, "MOST_CLOUDS", 4)
    assert choose_clouds(scores, range(VIEWS), [7, 8]) == sorted([7, 8, 0, 11])  # best by u of either measurement
    assert choose_clouds(scores, [3, 6], [7, 8]) == [3, 6]
    assert choose_clouds(scores, [], []) == []
    monkeypatch.setattr(view_clouds, "MOST_CLOUDS", 100)
    assert choose_clouds(scores, range(VIEWS), []) == list(range(VIEWS))


def test_a_box_holds_places_to_half_a_step():
    rng = np.random.default_rng(3)
    places = rng.uniform(-200, 300, (500, 3)) * [1, 0.1, 0.01]
    box = box_around([places, np.empty((0, 3))])
    assert np.abs(box.steps(places) * box.step + box.origin - places).max() <= 0.5001 * box.step
    assert box_around([]) == CoordinateRaster(pytest.approx(np.zeros(3)), 1.0)


def test_views_of_one_direction_share_a_site_and_the_target_is_where_axes_meet(data, expecting):
    assert data["views"]["site"] == [*range(11), 10]
    directions = np.array([[0, 0, 1.0], [1, 0, 0], [0, 0, 1], [1e-9, 0, 1], [0, 1, 0]])
    assert sites(directions).tolist() == [0, 1, 0, 0, 2]
    np.testing.assert_allclose(target(read_run(expecting).scores), 0, atol=1e-9)


def test_a_part_of_few_triangles_keeps_them_and_its_edges():
    box = trimesh.creation.box((10, 20, 30))
    told = packed_part(box, box_around([box.vertices]))
    assert told["shown"] == told["count"] == 12
    normals = np.frombuffer(base64.b64decode(told["normals"]), np.int8).reshape(3, -1).T
    assert len(normals) == 24  # three of each corner: its edges are sharp
    assert sorted(map(tuple, np.abs(normals).tolist())) == sorted(8 * [(127, 0, 0), (0, 127, 0), (0, 0, 127)])
    ball = trimesh.creation.icosphere(subdivisions=3)
    told = packed_part(ball, box_around([ball.vertices]))
    assert len(base64.b64decode(told["normals"])) == 3 * len(ball.vertices)  # one of each: it is round


def test_a_part_of_many_triangles_is_merged_near_its_surface():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=50.0)
    vertices, triangles = fewer_triangles(ball.vertices, ball.faces, 2000)
    assert 500 < len(triangles) <= 2000 < len(ball.faces)
    merged = trimesh.Trimesh(vertices, triangles)
    # corners become the mean of a cell: at most its diagonal away, which for 2000 triangles is some 8 mm
    assert np.linalg.norm(merged.vertices, axis=1).min() > 45 and np.abs(merged.bounds).min() > 46
    same_vertices, same_triangles = fewer_triangles(ball.vertices, ball.faces, 100_000)
    assert same_vertices is ball.vertices and same_triangles is ball.faces


def test_a_run_without_its_part_or_clouds_still_has_the_sphere(expecting, tmp_path):
    folder = copied(expecting, tmp_path)
    (folder / "part.ply").unlink()
    for view in WITH_CLOUD:
        (folder / "clouds" / f"predicted_{view:04d}.ply").unlink()
    environment = Environment(loader=FileSystemLoader(Path(view_clouds.__file__).parent), undefined=StrictUndefined)
    template = environment.get_template("view_sphere.html.j2")
    text = template.render(sphere=view_sphere(read_run(folder)))
    assert "The run has no <code>part.ply</code>" in text and '"part":null' in text and '"clouds":{}' in text


def test_views_of_a_stage_with_a_roll_each_share_one_disc_and_several_standoffs_are_told(expecting, tmp_path):
    folder = copied(expecting, tmp_path)
    scores = xr.load_dataset(folder / "scores.nc")
    scores["roll_deg"] = ("view", 10.0 * np.arange(VIEWS))  # the last view stands 600 mm away, the others 500
    write_netcdf(scores, folder / "scores.nc")
    run = read_run(folder)
    figure = uncertainty_figure(run.scores, MEASUREMENTS[0], "deg", run.checked, 0)
    assert [axes.get_title() for axes in figure.axes if axes.get_title()] == ["all rolls"]
    assert _rolls(run) == "0° to 110°" and _standoffs(run) == "500 to 600"


@pytest.mark.parametrize("content", [b"", b"\x00garbage", b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n"])
def test_a_broken_part_is_named(expecting, tmp_path, content):
    folder = copied(expecting, tmp_path)
    (folder / "part.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"part\.ply"):
        write_report(folder)


def test_a_set_of_views_that_are_not_there_is_refused(expecting, tmp_path):
    folder = copied(expecting, tmp_path)
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    about["view_sets"][0]["views"] = [2, 77]
    (folder / "run.json").write_text(json.dumps(about), encoding="utf-8")
    with pytest.raises(InputError, match=r"run\.json: view_sets\[0\]\.views: found 77"):
        read_run(folder)
