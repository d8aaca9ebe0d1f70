"""One capture of a board tells a calibration that holds from one that has moved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.folder import write_capture
from mitsim.sensor.camera import Rig
from mitsim.sensor.fitted_to import images_digest
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import preset_covariance
from mitsim.sensor.published_figures import PublishedLengths
from mitsim.sensor.rig_parameters import moved
from mitsim.sensor.transforms import Transform
from mitsim.sensor.unknowns import CalibrationUnknowns, TemperatureUnknowns
from mitsim.study.calibration.accuracy import triangulated
from mitsim.study.calibration.board import Board
from mitsim.study.calibration.verification import KnownPoints, _stated_rig, corners_of_board, verify
from mitsim.study.virtual.study_unknowns import calibration_covariance, with_temperature
from mitsim.twin.sensor.run import sensor_path
from tests.shell import mitsim_here

BOARD = Board(9, 6, 18.0, "glass")
PLACE = Transform(Rotation.from_euler("xy", [12.0, -8.0], degrees=True).as_matrix(), np.array([45.0, 5.0, 560.0]))


@pytest.fixture(scope="module")
def n10():
    return load_sensor("ensenso-n10")


def seen_board(camera):
    """The image (H, W) of the board at its place: the shade of the square on each pixel's ray, two rays a side."""
    fine = 2
    steps = (np.arange(fine) + 0.5) / fine - 0.5
    x, y = np.meshgrid(*[(np.arange(size)[:, None] + steps).ravel() for size in (camera.width, camera.height)])
    rays = camera.sensor_from_camera.directions(camera.rays(np.stack([x, y], -1).reshape(-1, 2)))
    board = PLACE.inverse()
    start, way = board.points(camera.centre[None])[0], board.directions(rays)
    at = start[:2] - start[2] / way[:, 2:] * way[:, :2]
    cells = np.floor(at / BOARD.square_mm + [BOARD.columns / 2, BOARD.rows / 2]).astype(int)
    inside = ((cells >= 0) & (cells < [BOARD.columns, BOARD.rows])).all(axis=1)
    shade = np.where(inside & (cells.sum(axis=1) % 2 == 0), 30.0, 220.0)
    return cv2.resize(shade.reshape(x.shape), (camera.width, camera.height), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def good(n10):
    return capture_by(n10, n10.rig)


@pytest.fixture(scope="module")
def turned(n10):
    """A capture whose right camera has turned about its row: rows differ by some 2.5 px."""
    return capture_by(n10, moved(n10.rig, ("right.rotation_x_rad",), np.array([4e-3])))


def capture_by(sensor, true):
    images = {name: seen_board(eye)[None].astype(np.uint8) for name, eye in true.cameras.items()}
    return Capture(sensor.name, sensor.technology, "simulated", sensor.rig, images)


def test_a_rig_that_did_not_move_is_usable_and_its_board_is_where_it_is(n10, good):
    known = corners_of_board(good, BOARD, None)
    assert abs(known.scale - 1) < 4 * known.scatter < 2e-3 and np.std(known.rows_px) < 0.2
    found = verify(known, n10, n10.rig, preset_covariance(n10))
    assert found.usable and found.sentence().startswith("Use it")
    assert found.distance_mm == pytest.approx(np.linalg.norm(PLACE.points(BOARD.corners), axis=1).mean(), rel=1e-3)


@pytest.mark.parametrize(
    ("tilt_deg", "centre", "roll"),
    [((0, -8, 0), (100, 0, 0), 180), ((-8, 0, 0), (0, -90, 0), 0), ((0, 8, 0), (-80, 0, 0), -90)],
    ids=["upside down", "above", "left and on its side"],
)
def test_a_second_camera_anywhere_is_verified(n10, tilt_deg, centre, roll):
    """Before, its points were NaN, and the corners of an upside-down camera in the reverse order."""
    place = Transform.from_degrees(tilt_deg, centre) @ Transform.from_degrees((0, 0, roll), (0, 0, 0))
    right = replace(n10.rig.cameras["right"], sensor_from_camera=place)
    sensor = replace(n10, rig=replace(n10.rig, cameras=n10.rig.cameras | {"right": right}, rectification=None))
    known = corners_of_board(capture_by(sensor, sensor.rig), BOARD, None)
    assert abs(known.scale - 1) < 4 * known.scatter < 4e-3 and np.abs(known.rows_px).max() < 1.0


def test_a_camera_that_turned_about_its_row_is_to_be_calibrated_again(n10, turned):
    found = verify(corners_of_board(turned, BOARD, None), n10, n10.rig, preset_covariance(n10))
    assert abs(found.row_error_px) == pytest.approx(4e-3 * 626, rel=0.1)
    assert not found.usable and "difference of rows" in found.sentence()


def seen_through(n10, true, base):
    """The known points of ``base`` as the nominal rig measures what a true rig sees, without noise."""
    pixels = [eye.project(PLACE.points(BOARD.corners)) for eye in true.cameras.values()]
    first, second = n10.rig.cameras.values()
    points, rows = triangulated(first, pixels[0], second, second.rays(pixels[1]))
    spread = [np.sqrt(((one - one.mean(axis=0)) ** 2).sum()) for one in (points, BOARD.corners)]
    return replace(base, points=points, rows_px=rows, scale=float(spread[0] / spread[1]))


def test_a_changed_vergence_shows_in_lengths(n10, good):
    true = moved(n10.rig, ("right.rotation_y_rad",), np.array([8e-3]))  # 20 times the stated drift
    known = seen_through(n10, true, corners_of_board(good, BOARD, None))
    found = verify(known, n10, n10.rig, preset_covariance(n10))
    assert not found.usable and "error of lengths" in found.sentence()


def test_rigs_drawn_from_the_covariance_are_usable(n10, good):
    """Of 10 rigs drawn from the statement, two errors each with 5 %, at most 4 are refused (99.8 %)."""
    covariance, rng = preset_covariance(n10), np.random.default_rng(5)
    base = corners_of_board(good, BOARD, None)
    drawn = [moved(n10.rig, covariance.names, covariance.draw(rng)) for _ in range(10)]
    found = [verify(seen_through(n10, true, base), n10, n10.rig, covariance).usable for true in drawn]
    assert found.count(False) <= 4


def test_errors_of_a_camera_go_to_no_other_that_a_capture_names(n10):
    """Before, those of the left camera went to the first of the capture, its right one."""
    left, right = n10.rig.cameras.values()
    covariance = preset_covariance(n10)
    other = replace(n10.rig, cameras={"right": right, "aux": left})
    assert _stated_rig(n10, other, covariance) == (n10.rig, covariance.names)  # whose first camera is no right one
    shown, names = _stated_rig(n10, replace(n10.rig, cameras={"left": left, "aux": right}), covariance)
    assert shown.cameras["aux"] is right
    assert names == tuple(name.replace("right.", "aux.") for name in covariance.names)


def test_the_names_of_cameras_do_not_matter(n10, good, turned):
    """Before, the covariance of cameras with other names was dropped: the limit of lengths was that of the board."""
    for capture in (good, turned):
        other = dict(zip(("cam0", "cam1"), capture.rig.cameras.values(), strict=True))
        images = dict(zip(other, capture.images.values(), strict=True))
        renamed = replace(capture, rig=replace(capture.rig, cameras=other), images=images)
        known = corners_of_board(renamed, BOARD, None)
        found, same = (verify(known, n10, rig, preset_covariance(n10)) for rig in (renamed.rig, n10.rig))
        assert found.rig_uncertainty == pytest.approx(same.rig_uncertainty, rel=1e-9)
        assert found.row_uncertainty_px == pytest.approx(same.row_uncertainty_px, rel=1e-9)
        assert found.usable == (capture is good)


def test_a_board_by_two_cameras_of_a_sensor_that_measures_with_one_is_refused(n10, good):
    covariance = preset_covariance(n10)
    kept = [index for index, name in enumerate(covariance.names) if name.startswith("left.")]
    names = tuple(covariance.names[index] for index in kept)
    left = replace(covariance, names=names, covariance=covariance.covariance[np.ix_(kept, kept)])
    with pytest.raises(InputError, match="errors of left alone, but two cameras measured"):
        verify(corners_of_board(good, BOARD, None), n10, n10.rig, left)


def test_a_cloud_with_an_image_is_verified_by_the_calibration_of_its_sensor(tmp_path):
    """Before, the eye that the cloud does not state, the projector, ended the command in a traceback."""
    carmine = load_sensor("primesense-carmine-1.09")
    camera = carmine.rig.reference
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.stack([x, y], -1).astype(float))
    depths = (PLACE.rotation[:, 2] @ PLACE.translation) / (rays @ PLACE.rotation[:, 2])
    image = seen_board(camera)[None].astype(np.uint8)
    derived = {"points": (rays * depths[..., None]).astype(np.float32)}
    rig = Rig({"camera": camera})
    write_capture(Capture("a file", "point_map", "replay", rig, {"camera": image}, derived=derived), tmp_path / "cloud")
    command = ("calibrate", "verify", tmp_path / "cloud", "--board", "9x6x18:glass", "--sensor", carmine.name)
    done = mitsim_here(*command)
    assert done.stdout.splitlines()[-1].startswith("Use it")
    known = KnownPoints(PLACE.points(BOARD.corners), 1.0, 0.0, 0.0, np.empty(0), 160.0)
    covariance = calibration_covariance(carmine, carmine.unknowns.calibration, tmp_path)
    covariance = with_temperature(covariance, carmine.rig, carmine.unknowns.temperature)
    stated = verify(known, carmine, carmine.rig, covariance).rig_uncertainty
    assert f"(calibration, drift, temperature {1.96e3 * stated:.2f}" in done.stdout


def test_a_limit_contains_the_temperature(n10):
    """The lengths that a warm sensor measures: its baseline and focal lengths have grown by 4 per mille, by hand.

    Before, the limit was that of an exact temperature.
    """
    known = KnownPoints(PLACE.points(BOARD.corners), 1.0, 0.0, 0.0, np.empty(0), 160.0)
    none = calibration_covariance(n10, CalibrationUnknowns(scale=0.0), Path())
    longer, grown = {}, np.diag([1.004, 1.004, 1.0])
    for name, eye in n10.rig.cameras.items():
        middle = eye.matrix * [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
        longer[name] = replace(eye, matrix=grown @ (eye.matrix - middle) + middle)
    for body, focal, eyes in ((1e-4, 0.0, n10.rig.cameras), (0.0, 1e-4, longer)):
        table = TemperatureUnknowns(sensor_kelvin=40.0, body_per_kelvin=body, focal_per_kelvin=focal)
        found = verify(known, n10, n10.rig, with_temperature(none, n10.rig, table)).rig_uncertainty
        truth = seen_through(n10, replace(n10.rig, cameras=eyes), known).scale - 1 if focal else 4e-3
        assert found == pytest.approx(abs(truth), rel=0.15)  # 200 draws tell it to 5 %
    assert verify(known, n10, n10.rig, none).rig_uncertainty == pytest.approx(0, abs=1e-9)


def test_a_capture_without_the_board_is_refused(n10):
    grey = np.full((1, 480, 752), 100, np.uint8)
    blank = Capture(n10.name, n10.technology, "simulated", n10.rig, {"left": grey, "right": grey})
    with pytest.raises(InputError, match="no such board"):
        corners_of_board(blank, BOARD, None)


def test_the_command_says_use_or_calibrate_again(good, turned, tmp_path):
    write_capture(good, tmp_path / "good")
    done = mitsim_here("calibrate", "verify", tmp_path / "good", "--board", "9x6x18:glass")
    assert done.stdout.splitlines()[-1].startswith("Use it") and "difference of rows" in done.stdout
    write_capture(turned, tmp_path / "bad")
    done = mitsim_here("calibrate", "verify", tmp_path / "bad", "--board", "9x6x18:glass", code=1)
    assert done.stdout.splitlines()[-1].startswith("Calibrate again")
    done = mitsim_here("calibrate", "verify", tmp_path / "good", "--board", "9x6x15:glass", code=1)
    assert "First check the spacing of the points: it measures 1.20" in done.stdout.splitlines()[-1]
    mitsim_here("calibrate", "verify", tmp_path / "bad", code=2)


def test_a_rig_without_light_and_imager_can_be_verified(good, tmp_path):
    """Before, a sensor file with the two tables that `mitsim calibrate` prints lacked 16 keys of a simulation."""
    eyes = {name: (eye.matrix, eye.distortion) for name, eye in good.rig.cameras.items()}
    right = good.rig.cameras["right"].sensor_from_camera.inverse()
    storage = cv2.FileStorage(str(tmp_path / "unit.yml"), cv2.FILE_STORAGE_WRITE)
    for number, (matrix, distortion) in enumerate(eyes.values(), 1):
        storage.write(f"cameraMatrix{number}", matrix)
        storage.write(f"distCoeffs{number}", distortion[:5])
    for name, value in (("R", right.rotation), ("T", right.translation)):
        storage.write(name, value)
    for name, value in zip(("image_width", "image_height"), (752, 480), strict=True):
        storage.write(name, value)
    storage.release()
    covariance = sensor_path("ensenso-n10").parent / "calibrations" / "ensenso-n10.toml"
    tables = '[calibration]\nfile = "unit.yml"\ncameras = ["left", "right"]\nprojector = false\n'
    tables += f'[unknowns.calibration]\ncovariance = "{covariance}"\n'
    (tmp_path / "unit.toml").write_text('name = "unit 7"\n' + tables)
    (tmp_path / "sensor.toml").write_text('name = "unit 7"\ntechnology = "active_stereo"\n' + tables)
    (tmp_path / "images").mkdir()
    for name, images in good.images.items():
        cv2.imwrite(str(tmp_path / "images" / f"{name}_0.png"), images[0])
    mitsim_here("import", tmp_path / "images", "--calibration", tmp_path / "unit.toml", "-o", tmp_path / "capture")
    command = ("calibrate", "verify", tmp_path / "capture", "--board", "9x6x18:glass")
    done = mitsim_here(*command, "--sensor", tmp_path / "sensor.toml")
    assert done.stdout.splitlines()[-1].startswith("Use it")


def test_a_capture_that_decided_the_calibration_is_told(good, turned, tmp_path):
    """Before, `Use it` was said of the very images that the calibration was fitted to."""
    covariance = sensor_path("ensenso-n10").parent / "calibrations" / "ensenso-n10.toml"
    for place, (name, where) in enumerate((("rows", "sensor"), ("board 3", "covariance"))):
        text = {"sensor": sensor_path("ensenso-n10").read_text(), "covariance": covariance.read_text()}
        listed = f'fitted_to = [{{ name = "{name}", images_sha256 = "{images_digest(good.images)}" }}]\n'
        text[where] = listed + text[where]
        used = '\n[unknowns.calibration]\ncovariance = "covariance.toml"\n'
        (tmp_path / "covariance.toml").write_text(text["covariance"])
        (tmp_path / "sensor.toml").write_text(text["sensor"] + used)
        for capture, told in ((good, True), (turned, False)):
            write_capture(capture, tmp_path / f"capture_{place}", overwrite=True)
            command = ("calibrate", "verify", tmp_path / f"capture_{place}", "--board", "9x6x18:glass")
            done = mitsim_here(*command, "--sensor", tmp_path / "sensor.toml", code=None)
            assert (f"fitted to these images ({name})" in done.stderr) == told


def test_a_recording_of_a_type_names_its_preset(good, tmp_path):
    """A device calls itself by its maker's name, which is none of a preset."""
    write_capture(replace(good, sensor="N10-304-18"), tmp_path / "recorded")
    done = mitsim_here("calibrate", "verify", tmp_path / "recorded", "--board", "9x6x18:glass", code=2)
    assert "comes from N10-304-18" in done.stderr and "its type may be ensenso-n10" in done.stderr


def test_the_makers_curve_is_a_normal_error_of_its_share():
    curve = PublishedLengths(source="maker", share=0.7, distance_mm=[500, 700], error=[2e-3, 1e-3])
    assert curve.one_sigma(600) == pytest.approx(1.5e-3 / 1.0364, rel=1e-3)
    assert np.isnan(curve.one_sigma(400))
