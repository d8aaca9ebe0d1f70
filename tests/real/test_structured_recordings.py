"""Recordings of structured-light rigs that others built, through ``mitsim import`` with a sensor file each."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from characterisation.point_cloud import Status
from mitsim.capture.grey_image import CHANNELS, read_grey
from mitsim.capture.recordings.image_folder import read_image_folder
from mitsim.cli.program import app
from mitsim.decoding.checks.image_sanity import image_warnings
from mitsim.decoding.checks.sanity import code_findings
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.decoding.coded_images import CodedImages
from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.decoding.structured_light.phase_shift import fit_phases
from mitsim.decoding.structured_light.projector_gamma import correct_phase, gamma_from_white
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.light_code import roles
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import Transform

pytestmark = pytest.mark.real

DATA = Path(__file__).parents[1] / "data"

#: inner corners of the board of kamino_procam, and its squares [mm]
BOARD, SQUARE_MM = (7, 9), 75.0


@pytest.fixture(scope="module")
def procam(real_data, tmp_path_factory):
    """The rig, with its calibration beside its sensor file, and its geometry."""
    folder = tmp_path_factory.mktemp("procam")
    for file in (DATA / "kamino-procam.toml", real_data / "kamino_procam/calibration.json"):
        shutil.copy(file, folder)
    sensor = load_sensor(folder / "kamino-procam.toml")
    return sensor, sensor_geometry(sensor)


@pytest.fixture(scope="module", params=["capture_0", "capture_1"])
def recorded(request, procam, real_data):
    return read_image_folder(real_data / "kamino_procam" / request.param, procam[0])


def test_gray_code_shows_the_same_correspondences_as_opencv(procam, recorded):
    """OpenCV's own decoder, pixel by pixel in a raster: the same column and row wherever both have a single stripe.

    We place a pixel whose one bit is undecided on the edge between two stripes; OpenCV takes one of the two, or none.
    """
    sensor, _ = procam
    stack = recorded.images["camera"]
    projector = sensor.rig.projector
    decoder = cv2.structured_light.GrayCodePattern.create(projector.width, projector.height)
    bits, white, black = list(stack[:40]), stack[40].astype(int), stack[41].astype(int)
    decoder.setWhiteThreshold(5)
    found = decode_coordinates(
        stack, sensor.pattern, (projector.width, projector.height), sensor.settings, full_scale=255
    )
    columns, rows = found["columns"].value, found["rows"].value
    same, shared, edges = 0, 0, 0
    for row in range(4, stack.shape[1], 16):
        for column in range(4, stack.shape[2], 16):
            if white[row, column] - black[row, column] < 30:
                continue
            fault, (u, v) = decoder.getProjPixel(bits, column, row)
            mine = columns[row, column], rows[row, column]
            if fault or not np.isfinite(mine).all():
                continue
            shared += 1
            off = abs(mine[0] - u), abs(mine[1] - v)
            same += off == (0, 0)
            edges += max(off) == 0.5
    print(f"{shared} pixels shared with OpenCV: {same} the same, {edges} on an edge")
    assert shared > 1500
    assert same + edges == shared
    assert edges < 0.35 * shared


def test_the_board_lies_where_a_single_camera_sees_it(procam, recorded):
    """Triangulated points of the board against the pose that its corners have for solvePnP: within 15 mm."""
    sensor, geometry = procam
    camera = sensor.rig.reference
    cloud = capture_cloud(recorded, sensor.settings, geometry)
    white = recorded.images["camera"][40]
    done, corners = cv2.findChessboardCorners(white, BOARD)
    assert done
    corners = cv2.cornerSubPix(white, corners, (7, 7), (-1, -1), (cv2.TERM_CRITERIA_EPS, 100, 1e-4))
    board = np.zeros((BOARD[0] * BOARD[1], 3))
    board[:, :2] = np.stack(np.meshgrid(range(BOARD[0]), range(BOARD[1])), axis=-1).reshape(-1, 2) * SQUARE_MM
    _, turn, place = cv2.solvePnP(board, corners, camera.matrix, camera.distortion)
    R, place = cv2.Rodrigues(turn)[0], place.ravel()
    outline = cv2.convexHull(corners.astype(np.float32)).reshape(-1, 2)
    mask = cv2.fillConvexPoly(np.zeros(white.shape, np.uint8), np.rint(outline).astype(int), 1) > 0
    points = cloud.points[mask & cloud.valid].astype(float)
    off = (points - place) @ R[:, 2]
    print(
        f"board at {place[2]:.0f} mm: {len(points)} points, median {np.median(off):.2f} mm off the pose, "
        f"robust rms {1.4826 * np.median(np.abs(off - np.median(off))):.2f} mm"
    )
    assert len(points) > 0.5 * mask.sum()
    assert abs(np.median(off)) < 15
    assert np.mean(np.abs(off) < 15) > 0.95


@pytest.fixture(scope="module")
def mugs(real_data):
    sensor = load_sensor(DATA / "kamino-phaseshift.toml")
    return sensor, read_image_folder(real_data / "kamino_phaseshift/object2", sensor)


def test_two_ways_to_the_gamma_of_the_mugs_agree(mugs):
    """The mean level of the fringes against the gamma for which the two periods contradict each other least."""
    sensor, capture = mugs
    stack = capture.images["camera"]
    white, black = stack[30], stack[31]
    shifts = [np.array(group.shifts) for group in sensor.pattern.images[:4]]
    phases = fit_phases(stack[:12], shifts)
    used = (phases.modulation.min(axis=0) > 10) & (stack[:12].max(axis=0) < 250) & (white < 250)
    level = gamma_from_white(phases.offset, white, black, 0.5, 0.5, used)
    tried = np.arange(1.0, 3.5, 0.05)
    spread = []
    some = np.flatnonzero(used)[::5]  # of the pixels used, enough for a median
    for gamma in tried:
        first, second = (
            correct_phase(phases.phase[k].ravel()[some] - np.float32(shifts[k][0]), gamma, 3, 0.5, 0.5) + shifts[k][0]
            for k in (0, 1)
        )
        # 200/3 and 100 px beat at 200 px, three fringes of the first
        spread.append(np.median(np.abs(np.angle(np.exp(1j * (3 * (first - second) - first))))))
    least = tried[np.argmin(spread)]
    print(f"gamma of the mugs: {level:.3f} by the mean level, {least:.2f} by the two periods")
    assert abs(level - least) < 0.15


def test_glazed_mugs_decode_with_their_gamma_and_say_why_not(mugs):
    """Without the correction, half of the lit pixels contradict themselves; with it few do."""
    sensor, capture = mugs
    stack = capture.images["camera"]
    lit = stack[30].astype(int) - stack[31] > 20
    projector, shares = sensor.rig.projector, {}
    for corrected in (False, True):
        settings = sensor.settings.model_copy(update={"correct_gamma": corrected})
        found = decode_coordinates(stack, sensor.pattern, (projector.width, projector.height), settings, full_scale=255)
        shares[corrected] = [np.mean(each.status[lit] == Status.VALID) for each in found.values()]
    print(
        f"mugs: share of lit pixels, without and with gamma: {np.round(shares[False], 3)}, {np.round(shares[True], 3)}"
    )
    assert min(shares[True]) > 0.8
    assert max(shares[False]) < 0.6
    for axis, extent in (("columns", projector.width), ("rows", projector.height)):
        each = found[axis]
        told = [Status.VALID, Status.SATURATED, Status.LOW_MODULATION, Status.PHASE_INCONSISTENT]
        assert np.isin(each.status, told).all()
        assert np.array_equal(np.isnan(each.value), each.status != Status.VALID)
        assert (each.status[~lit] == Status.LOW_MODULATION).mean() > 0.9
        value = each.value[each.status == Status.VALID]
        assert -1.5 < value.min() < value.max() < extent + 0.5
        # a smooth glaze: neighbours see neighbouring places
        step = np.diff(each.value, axis=1)
        assert np.nanmedian(np.abs(step)) < 2


def test_the_calibration_beside_the_recording_is_read_as_its_author_meant(procam, real_data):
    said = json.loads((real_data / "kamino_procam/calibration.json").read_text(encoding="utf-8"))
    projector = procam[0].rig.projector
    point = np.array([[100.0, -50.0, 3500.0]])
    expected, _ = cv2.projectPoints(
        point,
        cv2.Rodrigues(np.array(said["R"]))[0],
        np.array(said["t"]),
        np.array(said["projector_K"]),
        np.array(said["projector_distortion"]),
    )
    np.testing.assert_allclose(projector.project(point), expected[:, 0], atol=2e-3)


def capture_warnings(capture, settings):
    return code_findings(CodedImages.of(capture, settings), capture.rig, recorded=True).warnings


def warnings_of(stack, code, size, settings, full_scale, camera):
    images = CodedImages({camera: stack[: len(roles(code, *size))]}, code, size, settings, full_scale, None, {})
    return image_warnings(images, camera, images.coordinates[camera])


def test_nothing_is_said_of_a_recording_that_is_right(procam, recorded):
    assert capture_warnings(recorded, procam[0].settings) == []


def test_bits_in_the_wrong_order_are_said_although_most_pixels_decode(procam, recorded):
    sensor, _ = procam
    table = sensor.pattern.model_dump()
    table["images"][0]["first"] = "least_significant"
    spoiled = replace(recorded, decoding=recorded.decoding.model_copy(update={"pattern": ImageSequence(**table)}))
    said = " ".join(capture_warnings(spoiled, sensor.settings))
    assert "the columns that camera decodes do not vary smoothly" in said or "contradict one another" in said
    assert "they fit if the bits are in the reverse order" in said


def test_a_calibration_of_other_captures_is_said(procam, recorded):
    """The projector turned by 3 deg about its y axis, across the baseline."""
    sensor, _ = procam
    projector = recorded.rig.projector
    turned = replace(
        projector, sensor_from_camera=projector.sensor_from_camera @ Transform.from_degrees((0, 3, 0), (0, 0, 0))
    )
    spoiled = replace(recorded, rig=replace(recorded.rig, projector=turned))
    assert "view rays miss the light" in " ".join(capture_warnings(spoiled, sensor.settings))


def test_the_images_of_the_mugs_are_right(mugs):
    sensor, capture = mugs
    size = sensor.rig.projector.width, sensor.rig.projector.height
    assert warnings_of(capture.images["camera"], sensor.pattern, size, sensor.settings, 255, "camera") == []


def gray(axis, bits):
    return {"show": "gray", "axis": axis, "bits": bits, "stripe_px": 1, "inverse": "each"}


@pytest.mark.parametrize("eye", ["left", "right"])
def test_the_images_of_binocular_gray_are_right_and_their_finest_bits_are_lost(real_data, eye):
    """Twelve bits each way, of which the camera resolves nine."""
    stack = np.stack(
        [read_grey(real_data / f"binocular_gray/{n:02d}-{eye}.png", channel=CHANNELS["green"]) for n in range(51)]
    )
    settings, unused = DecoderSettings(near_mm=50, far_mm=20000), {"show": "unused"}
    begin = [unused, {"show": "white"}, {"show": "black"}]

    def said(groups, extent):
        code = ImageSequence(kind="image_sequence", images=groups)
        return warnings_of(stack, code, (extent, extent), settings, 255, eye)

    left_out = unused | {"count": 6}
    assert said([*begin, gray("columns", 9), left_out, gray("rows", 9), left_out], 512) == []
    lost = said([*begin, gray("columns", 12), gray("rows", 12)], 4096)
    assert [each.partition(", stripes")[0] for each in lost] == [
        f"{eye} does not resolve the 3 finest bits of the {axis}" for axis in ("columns", "rows")
    ]


def test_the_automatic_exposure_of_pi_fringe_is_said(real_data):
    """A bit and its complement together have 121 to 341 DN."""
    folder = real_data / "pi_fringe/pose_000"
    names = [f"{axis}_bit{bit:02d}_{state}.png" for axis in "xy" for bit in range(11) for state in ("on", "off")]
    stack = np.stack([read_grey(folder / name, channel=CHANNELS["green"]) for name in names])
    groups = [gray(axis, 11) | {"first": "least_significant"} for axis in ("columns", "rows")]
    code = ImageSequence(kind="image_sequence", images=groups)
    said = warnings_of(stack, code, (1280, 720), DecoderSettings(near_mm=50, far_mm=20000), 255, "camera")
    assert len(said) == 2
    assert all("Check whether the exposure was automatic" in each for each in said)


#: of two cameras before a flat panel, whose images come rectified
PAIR = """
name = "binocular-gray"
technology = "structured_light"

[calibration]
file = "stereo.json"
cameras = ["left", "right"]
projector = false

[projector]
width = 4096
height = 4096

[images]
left = "*-left.png"
right = "*-right.png"

[pattern]
kind = "image_sequence"
images = [
    { show = "unused" },
    { show = "white" },
    { show = "black" },
    { show = "gray", axis = "columns", bits = 9, inverse = "each" },
    { show = "unused", count = 6 },
    ROWS
    { show = "unused", count = 6 },
]

[decoder]
triangulate = "cameras"
"""


def panel(folder, real_data, rows):
    """Cloud file of binocular_gray, and all that import and decode say."""
    K = [[640.07, 0, 642.22], [0, 640.07, 355.13], [0, 0, 1]]
    flat = {f"D{n}": [0.0] * 5 for n in (1, 2)} | {f"K{n}": K for n in (1, 2)}
    (folder / "stereo.json").write_text(json.dumps(flat | {"R": np.eye(3).tolist(), "T": [-49.97, 0, 0]}))
    (folder / "pair.toml").write_text(PAIR.replace("ROWS", rows))
    output, capture = "", folder / "capture"
    for arguments in (
        ["import", real_data / "binocular_gray", "--sensor", folder / "pair.toml", "-o", capture],
        ["decode", capture, "-o", folder / "cloud.ply"],
    ):
        done = CliRunner().invoke(app, [str(each) for each in arguments])
        assert done.exit_code == 0, done.output
        output += done.output
    return folder / "cloud.ply", output


#: windows of the panel, and standard deviation of its points about a plane [mm] when stripes were staircases
WINDOWS = {
    "left": ((420, 200, 150, 300), 1.72),
    "middle": ((600, 200, 150, 300), 1.68),
    "right": ((800, 220, 100, 290), 1.36),
}


def test_a_panel_before_two_cameras_is_flat_by_measure(real_data, tmp_path):
    """Nine bits resolved of twelve: a fifth to a twelfth is left of what stripes that were staircases made."""
    cloud, output = panel(tmp_path, real_data, '{ show = "gray", axis = "rows", bits = 9, inverse = "each" },')
    assert "warning" not in output
    assert float(re.findall(r"row error of the second camera: (\S+) px, by the code", output)[0]) == pytest.approx(
        -0.14, abs=0.02
    )
    asked = [f"{name}=" + ",".join(map(str, window)) for name, (window, _) in WINDOWS.items()]
    done = CliRunner().invoke(app, ["measure", str(cloud), "--json", *(a for one in asked for a in ("--plane", one))])
    assert done.exit_code == 0, done.output
    found = {one["name"]: one["value"] for one in json.loads(done.stdout)["clouds"][0]["measurements"]}
    for name, (_, before) in WINDOWS.items():
        assert found[f"{name} noise"] < min(0.25, before / 5)


def test_the_rows_of_the_panel_by_its_scratches(real_data, tmp_path):
    """Without the code of the rows, within 0.1 px of what that tells."""
    _, output = panel(tmp_path, real_data, '{ show = "unused", count = 18 },')
    found = float(re.findall(r"row error of the second camera: (\S+) px, by the texture", output)[0])
    assert found == pytest.approx(-0.14, abs=0.1)
