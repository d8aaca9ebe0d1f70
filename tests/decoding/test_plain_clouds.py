"""Clouds without a grid and clouds in arrays and texts, measured and as a reference."""

from __future__ import annotations

import json
import struct

import cv2
import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from characterisation.cloud_files import write_cloud
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.capture.recordings import organised_cloud
from mitsim.decoding.input_clouds import read_cloud
from mitsim.decoding.plain_clouds import read_plain_cloud
from tests.shell import mitsim_here

WIDTH, HEIGHT = 60, 45
GRID = ViewGrid(200.0, 200.0, 29.5, 22.0, WIDTH, HEIGHT)


def plane(offset=0.0):
    """Points (H, W, 3) [mm] of the plane z = 600 + offset, with a hole."""
    rays = GRID.rays()
    points = (rays / rays[..., 2:] * (600.0 + offset)).astype(np.float32)
    points[5:8, 10:20] = np.nan
    return points


def ply(points, names="xyz"):
    rows = points.reshape(-1, 3)
    head = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n{}end_header\n"
    return head.format(len(rows), "".join(f"property float {a}\n" for a in names)).encode() + rows.tobytes()


def save(path, points):
    """Write points as the suffix asks; arrays keep their rows and columns, all others are lists of points.

    The lists have one point more at their end, or else the grid would be found from them.
    """
    rows = np.concatenate([points.reshape(-1, 3), np.full((1, 3), np.nan, np.float32)])
    if path.suffix == ".npy":
        np.save(path, points)
    elif path.suffix == ".mat":
        x, y, z = np.moveaxis(points.astype(float), -1, 0)
        savemat(path, {"about": "text", "scale": 1.0, "X": x, "Y": y, "Z": z})
    elif path.suffix == ".ply":
        path.write_bytes(ply(rows))
    elif path.suffix == ".pcd":
        head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {len(rows)}\nHEIGHT 1\nDATA binary\n"
        path.write_bytes(head.encode() + rows.tobytes())
    elif path.suffix == ".csv":
        path.write_text("x,y,z,intensity\n" + "".join(f"{x},{y},{z},7\n" for x, y, z in rows.tolist()))
    else:
        path.write_text("# scan\n" + "".join(f"{x} {y} {z}\n" for x, y, z in rows.tolist()).replace("nan", "-nan(ind)"))
    return path


def decoded(path, points):
    status = np.where(np.isfinite(points[..., 0]), Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    write_cloud(PointCloud(points, status, GRID, "known", "simulated"), path)
    return path


@pytest.mark.parametrize("name", ["a.npy", "a.mat", "a.ply", "a.pcd", "a.xyz", "a.csv"])
def test_a_cloud_without_a_camera_is_measured_and_is_a_reference(tmp_path, name):
    given = save(tmp_path / name, plane(2.0))
    read = read_cloud(given)
    np.testing.assert_allclose(read.cloud.points[read.cloud.valid], plane(2.0)[np.isfinite(plane()[..., 0])], rtol=1e-6)
    assert (read.cloud.grid.height == 1) == (name not in ("a.npy", "a.mat"))
    other = decoded(tmp_path / "decoded.ply", plane())
    there = mitsim_here("measure", given, "--plane", "all", "--against", other, "--json")
    back = mitsim_here("measure", other, "--against", given, "--json")
    values = [
        {one["name"]: one["value"] for one in json.loads(done.stdout)["clouds"][0]["measurements"]}
        for done in (there, back)
    ]
    assert values[0]["all distance"] == pytest.approx(602.0, rel=1e-3)
    assert values[0]["all flatness"] < 1e-3
    assert values[0]["difference median"] == pytest.approx(2.0, rel=0.01)  # of rays up to 8 deg from the normal
    assert values[1]["difference median"] == pytest.approx(-2.0, rel=0.01)
    assert "in mm, which" in there.stderr


def text(separator=" ", head="", columns="{x}{s}{y}{s}{z}", mark=".", missing="nan", end="\n"):
    """A text of the plane; ``mark`` is the decimal mark."""
    rows = [
        columns.format(
            s=separator, n=number, **{a: f"{v:.4f}".replace(".", mark) for a, v in zip("xyz", row, strict=True)}
        )
        for number, row in enumerate(plane(2.0).reshape(-1, 3).tolist())
    ]
    return (head + end.join(rows) + end).replace("nan", missing)


TEXTS = {
    "semicolons and decimal commas": text(";", mark=","),
    "spaces and decimal commas": text(" ", mark=","),
    "tabs, decimal commas, empty fields": text("\t", "X\tY\tZ\n", mark=",", missing=""),
    "numbered rows": text(",", "index,x,y,z\n", "{n}{s}{x}{s}{y}{s}{z}"),
    "columns in another order": text(",", "z,x,y\n", "{z}{s}{x}{s}{y}"),
    "a first row of empty fields": "x;y;z\n;;\n" + text(";", mark=",", missing=""),
    "names in quotes": text(",", '"x","y","z"\n'),
    "names with units": text(";", "x [mm]; y [mm]; z [mm]\n"),
    "names in a comment": text(" ", "//X Y Z Intensity\n", "{x}{s}{y}{s}{z}{s}7"),
    "names after other columns": text(",", "# scan\n# r,g,b,x,y,z\n", "1{s}2{s}3{s}{x}{s}{y}{s}{z}"),
    "empty fields": text(",", missing=""),
    "points and commas": text(", "),
    "quotes, semicolons and decimal commas": text(";", columns='"{x}"{s}"{y}"{s}"{z}"', mark=","),
    "a tab at the end of rows": text(",", end="\t\n"),
    "a number of points": text(" ", "2700\n"),
    "carriage returns": text(",", end="\r\n"),
}


@pytest.mark.parametrize("encoding", ["ascii", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("name", TEXTS)
def test_texts_of_many_programs(tmp_path, name, encoding):
    """Before, a decimal comma made two numbers of one, and a column of indices was x."""
    (tmp_path / "a.csv").write_bytes(TEXTS[name].encode(encoding))
    cloud, about = read_plain_cloud(tmp_path / "a.csv")
    np.testing.assert_allclose(cloud.points[cloud.valid], plane(2.0)[np.isfinite(plane()[..., 0])], atol=1e-3)
    assert "in mm, " in about


def thousands(separator, quote="", of_thousands=",", mark="."):
    """A text of the plane, 1500 mm farther away, with marks of thousands and no names."""
    points = plane(1502.0).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    marks = str.maketrans(",.", of_thousands + mark)
    rows = [[f"{quote}{value:,.4f}{quote}".translate(marks) for value in row] for row in points.tolist()]
    return "\n".join(separator.join(row) for row in rows) + "\n"


MARKED = {
    "semicolons": thousands(";"),
    "tabs": thousands("\t"),
    "spaces": thousands(" "),
    "points of thousands, decimal commas": thousands(";", of_thousands=".", mark=","),
    "quotes": thousands(",", '"'),
    "decimal commas in quotes": text(",", columns='"{x}"{s}"{y}"{s}"{z}"', mark=",", missing="0,0"),
}


@pytest.mark.parametrize("name", MARKED)
def test_commas_of_thousands_are_refused(tmp_path, name):
    """A row -12.5;7.1;2,102.5 was the point -12.5, 7.1, 2, and "-12,5","7,1","602,5" was -12, 5, 7."""
    (tmp_path / "a.csv").write_text(MARKED[name])
    with pytest.raises(InputError, match="a comma that is no separator, as of thousands"):
        read_plain_cloud(tmp_path / "a.csv")


def sized(factor, head="", separator=","):
    """A text of the plane, with its numbers multiplied."""
    rows = (plane(2.0).reshape(-1, 3) * factor).tolist()
    return head + "".join(separator.join(f"{value:.7g}" for value in row) + "\n" for row in rows)


UNITS = {
    "names in micrometres": sized(1000, "X [um],Y [um],Z [um]\n"),
    "names with a Greek letter": sized(1000, "x (µm),y (µm),z (µm)\n"),
    "names in inches": sized(1 / 25.4, "x_in,y_in,z_in\n"),
    "a line of units below": sized(0.1, "X,Y,Z\ncm,cm,cm\n"),
    "a remark": sized(1000, "# Units: micrometers\n"),
    "a table of remarks": sized(1 / 25.4, "Version,1.2\nUnit,inch\nX,Y,Z\n"),
}


@pytest.mark.parametrize("name", UNITS)
def test_the_unit_that_a_text_states_counts(tmp_path, name):
    """Before, 600,000 um were 600 m, and 15 mm were 15 m, as the median distance suggests."""
    (tmp_path / "a.csv").write_text(UNITS[name], encoding="utf-8")
    cloud, about = read_plain_cloud(tmp_path / "a.csv")
    np.testing.assert_allclose(cloud.points[cloud.valid], plane(2.0)[np.isfinite(plane()[..., 0])], rtol=1e-5)
    assert "as the file states" in about


def test_units_that_differ_or_are_not_stated_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text(sized(1, "x [mm],y [mm],z [m]\n"))
    with pytest.raises(InputError, match="coordinates in m and mm"):
        read_cloud(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text(sized(1000))
    with pytest.raises(InputError, match=r"the file does not state.*--unit um"):
        read_cloud(tmp_path / "b.csv")
    cloud = read_cloud(tmp_path / "b.csv", unit="um").cloud
    assert np.median(cloud.points[cloud.valid][:, 2]) == pytest.approx(602.0)


def test_what_a_list_of_points_cannot_have_is_said(tmp_path):
    """Before, a window was to lie within 2701 x 1 pixels, and one surface was asked for where the place was wrong."""
    (tmp_path / "a.xyz").write_text(sized(1, separator=" "))
    done = mitsim_here("measure", tmp_path / "a.xyz", "--plane", "a=5,5,20,20", code=2)
    assert "the points are a list" in done.stderr
    flat = np.random.default_rng(1).uniform(-50, 50, (500, 3)) * (1, 1, 0) + (100, 0, 5)
    np.savetxt(tmp_path / "b.xyz", flat)
    done = mitsim_here("measure", tmp_path / "b.xyz", "--plane", "a", code=1)
    assert "the origin of their frame" in done.stdout
    (tmp_path / "c.ply").write_bytes(ply(plane() * np.array([1, -1, -1], np.float32)))
    done = mitsim_here("measure", tmp_path / "c.ply", "--plane", "a", code=2)
    assert "--axes opengl; mitsim import has these options" in done.stderr


def test_the_unit_is_an_option_of_measure(tmp_path):
    """A list in mm about its own origin is nearer than 20 mm."""
    (tmp_path / "a.xyz").write_text(sized(0.02, separator=" "))
    asked = ("measure", tmp_path / "a.xyz", "--plane", "all", "--json")
    values = {}
    for options in ([], ["--unit", "mm"]):
        done = mitsim_here(*asked, *options)
        found = json.loads(done.stdout)["clouds"][0]["measurements"]
        values[len(options)] = next(one["value"] for one in found if one["name"] == "all perpendicular distance")
    assert values == {0: pytest.approx(12040.0, rel=1e-5), 2: pytest.approx(12.04, rel=1e-5)}
    assert "--unit: found 'mile'" in mitsim_here(*asked, "--unit", "mile", code=2).stderr


@pytest.mark.parametrize(
    "row", ["{n}{s}{x}{s}{y}{s}{z}", "{n}{s}7{s}{x}{s}{y}{s}{z}", "{n}{s}{n}{s}{x}{s}{y}{s}{z}{s}0.5"]
)
def test_columns_that_count_are_not_coordinates(tmp_path, row):
    """Before, the number of a row was its x."""
    (tmp_path / "a.csv").write_text(text(",", "", row, missing="nan"))
    with pytest.raises(InputError, match="columns without names, of which the first"):
        read_cloud(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("# x right, y down, z forward\n", "{x}{s}{y}{s}{z}"),
        ("# columns: x y z\n", "{x}{s}{y}{s}{z}"),
        ("# columns: n z y x\n", "{n}{s}{z}{s}{y}{s}{x}"),
    ],
)
def test_a_sentence_about_axes_names_no_columns(tmp_path, head, row):
    (tmp_path / "a.xyz").write_text(text(" ", head, row))
    cloud = read_cloud(tmp_path / "a.xyz").cloud
    np.testing.assert_allclose(cloud.points[cloud.valid], plane(2.0)[np.isfinite(plane()[..., 0])], atol=1e-3)


@pytest.mark.parametrize("mark", [(-1, -1, -1), (0, 0, -1), (-9999, -9999, -9999), (0, 0, 1e5)])
@pytest.mark.parametrize("name", ["a.xyz", "a.npy", "a.pcd"])
def test_a_point_that_is_repeated_is_missing(tmp_path, name, mark):
    """Before, 400 points at (-1, -1, -1) made a sphere of 50 mm one of 524 mm."""
    points = plane()
    points[np.isnan(points[..., 0])] = mark
    cloud = read_cloud(save(tmp_path / name, points)).cloud
    assert cloud.valid.sum() == np.isfinite(plane()[..., 0]).sum()
    assert np.isclose(cloud.points[cloud.valid][:, 2], 600).all()


def test_points_on_a_raster_repeat_and_are_kept(tmp_path):
    points = np.round(plane() / 25) * 25
    cloud = read_cloud(save(tmp_path / "a.xyz", points)).cloud
    assert cloud.valid.sum() == np.isfinite(plane()[..., 0]).sum()


def test_names_that_do_not_fit_the_columns_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3,4\n")
    with pytest.raises(InputError, match=r"the names x, y, z of 4 columns"):
        read_cloud(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("x,y\n1,2,3\n")
    with pytest.raises(InputError, match=r"the names x, y of 3 columns"):
        read_cloud(tmp_path / "a.csv")


def saved_arrays(folder):
    """The points of a plane in arrays of many shapes."""
    points = plane(2.0)
    flat = points.reshape(-1, 3)
    table = np.rec.fromarrays(flat.T, names="x,y,z")
    np.save(folder / "axis first.npy", np.moveaxis(points, -1, 0))
    np.save(folder / "by columns.npy", flat.T)
    np.save(folder / "table.npy", table)
    np.savez(folder / "beside an image.npz", image=np.full((HEIGHT, WIDTH, 3), 9, np.uint8), points=points)
    np.savez(folder / "objects.npz", points=points, about=np.array({"rms": 1}, dtype=object))
    savemat(folder / "by columns.mat", {"xyz": flat.T.astype(float)})
    savemat(folder / "structure.mat", {"cloud": {"Location": points.astype(float), "Count": 2700.0}})
    return sorted(folder.glob("*.*"))


def test_arrays_of_many_shapes(tmp_path):
    paths = saved_arrays(tmp_path)
    assert len(paths) == 7
    for path in paths:
        cloud = read_cloud(path).cloud
        np.testing.assert_allclose(cloud.points[cloud.valid], plane(2.0)[np.isfinite(plane()[..., 0])], rtol=1e-6)


def test_three_images_of_depths_are_no_points(tmp_path):
    """They have the shape of x, y and z before rows and columns, but no coordinate on both sides of the axis."""
    depth = np.full((3, HEIGHT, WIDTH), 700, np.uint16)
    np.savez(tmp_path / "a.npz", depth=depth, image=np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    with pytest.raises(InputError, match="--frame: found 3 images of depths"):
        read_cloud(tmp_path / "a.npz", "kinect-v2")
    cloud = read_cloud(tmp_path / "a.npz", "kinect-v2", frame="2").cloud
    assert cloud.points[cloud.valid][:, 2] == pytest.approx(700.0)
    assert cloud.grid.width == WIDTH


def test_a_map_of_depths_has_the_camera_of_a_sensor(tmp_path):
    np.save(tmp_path / "a.npy", np.full((HEIGHT, WIDTH), 700.0))
    with pytest.raises(InputError, match="a depth image alone"):
        read_cloud(tmp_path / "a.npy")
    assert read_cloud(tmp_path / "a.npy", "kinect-v2").cloud.points[..., 2] == pytest.approx(700.0)


def test_metres_are_recognised_and_the_rays_pass_through_the_points(tmp_path):
    cloud, about = read_plain_cloud(save(tmp_path / "a.xyz", plane() / 1000))
    assert "in m, which" in about
    seen = cloud.valid
    assert seen.sum() == np.isfinite(plane()[..., 0]).sum()
    points = cloud.points[seen].astype(float)
    assert points[:, 2] == pytest.approx(600.0, abs=1e-3)
    along = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(cloud.grid.rays()[seen], along, atol=1e-6)


def test_a_ply_with_capital_names_and_a_space_in_its_first_line(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply(plane(2.0), "XYZ").replace(b"ply\n", b"ply \n", 1))
    cloud = read_cloud(tmp_path / "a.ply").cloud
    assert cloud.points[cloud.valid][:, 2] == pytest.approx(602.0)


def test_a_cloud_that_was_exported_is_measured(tmp_path):
    """Its header names mitsim, too, but states no grid."""
    pytest.importorskip("pypcd4")
    decoded(tmp_path / "a.ply", plane(2.0))
    for name in ("b.ply", "b.pcd"):
        assert mitsim_here("export", "cloud", tmp_path / "a.ply", "-o", tmp_path / name).returncode == 0
        cloud = read_cloud(tmp_path / name).cloud
        np.testing.assert_allclose(cloud.points[cloud.valid], plane(2.0)[np.isfinite(plane()[..., 0])], rtol=1e-6)


def test_a_reference_with_a_grid_may_lie_anywhere(tmp_path):
    """An organised cloud in the frame of a robot matches no pinhole; only its points matter."""
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {WIDTH}\nHEIGHT {HEIGHT}\nDATA binary\n"
    turn = Rotation.from_rotvec([0.9, 0.4, 0.2]).as_matrix()
    moved = (plane() @ turn.T + [300, -200, 50]).astype(np.float32)
    path = tmp_path / "robot.pcd"
    path.write_bytes(head.encode() + moved.tobytes())
    with pytest.raises(InputError, match="no camera at the origin"):
        read_cloud(path)
    assert np.isfinite(read_cloud(path, reference=True).cloud.points[..., 0]).sum() == np.isfinite(moved[..., 0]).sum()


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
@pytest.mark.parametrize("organised", [False, True])
def test_a_cloud_of_another_program_is_decoded_once(tmp_path, monkeypatch, name, organised):
    """Whether it has a grid follows from the same decoding as its points."""
    path, calls = save(tmp_path / name, plane()), []
    if organised:
        without_the_last = {"a.ply": (b"vertex 2701", b"vertex 2700"), "a.pcd": (b"WIDTH 2701", b"WIDTH 2700")}
        path.write_bytes(path.read_bytes()[:-12].replace(*without_the_last[name], 1))
    for decode in ("decode_ply", "decode_pcd"):
        real = getattr(organised_cloud, decode)
        monkeypatch.setattr(organised_cloud, decode, lambda *given, real=real: calls.append(real) or real(*given))
    cloud = read_cloud(path).cloud
    assert (cloud.grid.height > 1) == organised
    assert len(calls) == 1
    assert cloud.valid.sum() == np.isfinite(plane()[..., 0]).sum()


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.npy", b"\x93NUMPY\x01\x00", "unreadable"),
        ("a.mat", b"MATLAB 5.0", "unreadable"),
        ("a.ply", b"solid of another format\nvertex 1 2 3\n", "a PLY file"),
        ("a.xyz", b"1 2 3\n4 5\n", "equal columns"),
        ("a.xyz", b"", "equal columns"),
        ("a.xyz", b"1 2 3\nfour five six\n1 2 x\n", "equal columns"),
        ("a.csv", b"x,y,z\nnan,nan,nan\n", "no points"),
    ],
)
def test_a_file_that_is_no_cloud_is_refused_in_words(tmp_path, name, content, says):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=says):
        read_cloud(tmp_path / name)


def test_an_archive_of_arrays_under_the_suffix_of_one_is_refused(tmp_path):
    with (tmp_path / "a.npy").open("wb") as file:
        np.savez(file, points=plane())
    with pytest.raises(InputError, match=r"unreadable.*np\.save"):
        read_cloud(tmp_path / "a.npy")


def test_numbers_that_a_file_of_level_4_states_are_bounded(tmp_path):
    """Its header promises 40000 x 40000 numbers, 12.8 GB, of which none follow."""
    (tmp_path / "a.mat").write_bytes(struct.pack("<5i", 0, 40_000, 40_000, 0, 2) + b"P\0")
    with pytest.raises(InputError, match=r"1,600,000,000 values; allowed: up to"):
        read_cloud(tmp_path / "a.mat")


def test_a_list_of_points_has_no_picture(tmp_path):
    done = mitsim_here(
        "measure", save(tmp_path / "a.xyz", plane()), "--plane", "all", "--picture", tmp_path / "p.png", code=2
    )
    assert "without a grid" in done.stderr
    assert not (tmp_path / "p.png").exists()


def test_a_folder_of_arrays_or_texts_is_measured(tmp_path):
    """Before, the help promised folders of these, and they were recordings of an unknown kind."""
    for name in ("1.xyz", "2.npy"):
        save(tmp_path / name, plane())
    done = mitsim_here("measure", tmp_path, "--plane", "floor")
    assert "2/2" in done.stdout
    save(tmp_path / "3.ply", plane())
    done = mitsim_here("measure", tmp_path, "--plane", "floor")
    assert "left out 1.xyz, 2.npy" in done.stderr


def test_the_command_with_the_options_of_an_error_is_named(tmp_path):
    """Before, `mitsim measure` asked for --calibration, which it lacks."""
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((48, 64), 500, np.uint16))
    done = mitsim_here("measure", tmp_path / "depth.png", "--plane", "floor", code=2)
    assert "--calibration FILE" in done.stderr and "mitsim import has these options" in done.stderr


@pytest.mark.parametrize(
    ("join", "rounded"),
    [
        (lambda rows: np.concatenate([rows, rows, rows]), None),
        (lambda rows: np.repeat(rows, 2, axis=0), None),
        (lambda rows: np.concatenate([rows, rows[::3]]), 2),
        (lambda rows: np.concatenate([rows, rows]), 0),
    ],
)
def test_a_cloud_joined_with_itself_measures_as_once(join, rounded, tmp_path, rng):
    """Each point once, and with it u, is that of the cloud; points that rounding alone made equal all count."""
    place = rng.uniform(-40, 40, (6000, 2))
    rows = np.column_stack([place, 500 + 0.3 * rng.standard_normal(6000)])
    rows = rows if rounded is None else np.round(rows, rounded)
    once, joined = tmp_path / "once.npy", tmp_path / "joined.npy"
    np.save(once, rows)
    np.save(joined, join(rows))
    cloud, about = read_plain_cloud(once)
    assert cloud.valid.sum() == 6000
    assert "copies" not in about
    found, about = read_plain_cloud(joined)
    assert f"{len(join(rows)) - 6000} points are copies of others: left out" in about
    expected, values = (np.sort(each.points[each.valid].view("f4,f4,f4").ravel()) for each in (cloud, found))
    np.testing.assert_array_equal(values, expected)
