"""Patches of a coupon: F and sigma come back, discs are the talk's ellipses, and every column says what it claims."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.coupon.discs import disc_offsets
from characterisation.coupon.metrics import density_fraction
from characterisation.coupon.patch_table import overall
from characterisation.coupon.patches import Coupon, measure_patches, patch_centres
from characterisation.coupon.view_frame import in_view_frame, view_frame
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid

GRID = ViewGrid(626.0, 626.0, 375.5, 239.5, 752, 480)
BASELINE = np.array([1.0, 0.0, 0.0])


def tilted(tilt_deg, azimuth_deg):
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    return np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])


def coupon_at(centre, normal, width=120.0, height=120.0):
    across = np.cross([0.0, 1.0, 0.0], normal)
    return Coupon(np.asarray(centre, float), normal, across / np.linalg.norm(across), width, height)


def ideal_cloud(coupon, sigma=0.0, keep=1.0, rng=None, grid=GRID):
    """What a perfect sensor sees of a coupon, with noise along its rays and random loss."""
    rays = grid.rays()
    with np.errstate(divide="ignore"):
        distance = (coupon.centre @ coupon.normal) / (rays @ coupon.normal)
    along = np.cross(coupon.normal, coupon.across)
    offset = rays * distance[..., None] - coupon.centre
    on = (distance > 0) & (np.abs(offset @ coupon.across) <= coupon.width / 2)
    on &= np.abs(offset @ along) <= coupon.height / 2
    if rng is not None:
        distance = distance + rng.normal(0, 1, distance.shape) * sigma
        on &= rng.random(distance.shape) < keep
    points = np.where(on[..., None], rays * distance[..., None], np.nan).astype(np.float32)
    status = np.where(on, Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    return PointCloud(points, status, grid, "ideal", "simulated", BASELINE)


@pytest.mark.parametrize("angle", [0, 10, 18, 24])
@pytest.mark.parametrize("tilt", [0, 40, 60])
def test_an_ideal_sensor_recovers_everything_over_the_whole_field(angle, tilt):
    """F of the patches is 1; so is the talk's rho, counted on a known area, once it has its cos^3."""
    direction = np.array([np.sin(np.radians(angle)), 0.1, np.cos(np.radians(angle))])
    centre = direction / np.linalg.norm(direction) * 600
    normal = -centre / 600
    turn = np.radians(tilt)
    normal = np.cos(turn) * normal + np.sin(turn) * np.array([0, 1, 0]) * np.sign(-normal[1])
    coupon = coupon_at(centre, normal / np.linalg.norm(normal))
    cloud = ideal_cloud(coupon)
    patches = measure_patches(cloud, coupon)
    assert patches.sizes["patch"] > 5
    assert (patches.recovered_fraction == 1).all()
    assert (patches.false_fraction == 0).all()

    # the talk's rho: points on the whole coupon, of known area, cell by cell
    points = cloud.points[cloud.valid].astype(float)
    along = np.cross(coupon.normal, coupon.across)
    s, t = (points - coupon.centre) @ coupon.across, (points - coupon.centre) @ along
    cells = []
    for s0 in np.arange(-60, 60, 30):
        for t0 in np.arange(-60, 60, 30):
            middle = coupon.centre + (s0 + 15) * coupon.across + (t0 + 15) * along
            count = ((s >= s0) & (s < s0 + 30) & (t >= t0) & (t < t0 + 30)).sum()
            view = middle / np.linalg.norm(middle)
            cells.append(
                density_fraction(
                    count,
                    900.0,
                    np.linalg.norm(middle),
                    -view @ coupon.normal,
                    GRID.angular_pitch,
                    GRID.cos_off_axis(middle),
                )
            )
    assert np.isclose(np.mean(cells), 1.0, atol=0.02)


def test_loss_and_noise_of_a_coupon_come_back(rng):
    coupon = coupon_at([20, 10, 600], tilted(35, 60))
    patches = measure_patches(ideal_cloud(coupon, sigma=0.3, keep=0.7, rng=rng), coupon)
    possible = patches.points_possible.values.sum()
    assert np.isclose(patches.points.sum() / possible, 0.7, atol=4 * np.sqrt(0.21 / possible))
    assert np.isclose(np.sqrt((patches.ray_noise_std**2).mean()), 0.3, rtol=0.05)
    inside = (patches.fraction_low <= 0.7) & (patches.fraction_high >= 0.7)
    assert inside.mean() > 0.85


def test_normal_and_distance_of_a_patch_are_those_of_its_place():
    coupon = coupon_at([0, 0, 500], tilted(30, 0))
    patches = measure_patches(ideal_cloud(coupon), coupon)
    assert np.isclose(patches.normal_x.mean(), np.sin(np.radians(30)), atol=0.02)
    assert np.isclose(np.degrees(patches.incidence.mean()), 30, atol=1)
    assert np.isclose(patches.distance.mean(), 500, rtol=0.01)
    assert patches.incidence.std() > np.radians(1)  # every patch has its own view of the coupon


def test_false_points_count_neither_as_recovered_nor_as_noise(rng):
    coupon = coupon_at([0, 0, 600], tilted(10, 0))
    cloud = ideal_cloud(coupon, sigma=0.2, keep=1.0, rng=rng)
    astray = cloud.valid & (rng.random(cloud.status.shape) < 0.25)
    points = cloud.points.copy()
    points[astray] *= 1.05
    wrong = PointCloud(points, cloud.status, GRID, "ideal", "simulated", BASELINE)
    patches = measure_patches(wrong, coupon)
    assert np.isclose(patches.recovered_fraction.mean(), 0.75, atol=0.02)
    assert np.isclose(patches.false_fraction.mean(), 0.25, atol=0.02)
    assert np.isclose(patches.ray_noise_std.mean(), 0.2, rtol=0.05)


def test_a_coupon_behind_the_sensor_has_no_patches():
    coupon = coupon_at([0, 0, -600], np.array([0.0, 0.0, 1.0]))
    cloud = ideal_cloud(coupon_at([0, 0, 600], tilted(0, 0)))
    assert measure_patches(cloud, coupon).sizes["patch"] == 0


def test_a_plate_that_reaches_behind_the_sensor_has_patches_where_it_is_seen():
    """A wide plate at 75 deg, whose near corners lie behind the sensor: as that part of it which is in front."""
    normal = tilted(75, 0)
    wide = coupon_at([0, 0, 600], normal, width=2600, height=200)
    assert (wide.corners()[:, 2] < 0).sum() == 2
    cloud = ideal_cloud(wide)
    found = measure_patches(cloud, wide)
    assert found.sizes["patch"] > 100 and (found.recovered_fraction == 1).all()
    part = measure_patches(cloud, coupon_at([0, 0, 600], normal, width=1200, height=200))
    places = [set(zip(one["row"].values, one["column"].values, strict=True)) for one in (part, found)]
    assert places[0] <= places[1]


unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@given(unit, unit)
def test_the_view_frame_is_right_handed_and_faces_the_sensor(view, baseline):
    view, baseline = np.array(view), np.array(baseline)
    view, baseline = view / np.linalg.norm(view), baseline / np.linalg.norm(baseline)
    if abs(view @ baseline) > 0.99:
        return
    frame = view_frame(view, baseline)
    assert np.allclose(frame @ frame.T, np.eye(3), atol=1e-9)
    assert np.isclose(np.linalg.det(frame), 1)
    assert np.allclose(in_view_frame(-view, view, baseline), [0, 0, 1])
    assert frame[0] @ baseline > 0


@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_a_disc_of_the_image_is_the_ellipse_whose_radius_follows_the_tilt(tilt):
    """Projected area and count stay, one axis stays, the other grows by 1 / cos(tilt)."""
    coupon = coupon_at([0, 0, 600], tilted(tilt, 0), 60, 60)
    patches = measure_patches(ideal_cloud(coupon), coupon)
    cosine = np.cos(patches.incidence)
    pitch = GRID.angular_pitch
    # a pixel covers lambda^2 cos^3(phi), lambda cos(phi) across the radius; 3.5 deg off the axis at most
    assert np.allclose(patches.semi_minor, 6 * pitch * patches.distance, rtol=0.01)
    assert np.allclose(patches.semi_major, patches.semi_minor / cosine, rtol=0.01)
    projected = np.pi * patches.semi_major * patches.semi_minor * cosine / patches.distance**2
    assert np.allclose(projected, np.pi * 36 * pitch**2 * np.cos(patches.off_axis) ** 3, rtol=2e-3)
    assert (patches.points_possible == 113).all()
    assert np.allclose(patches.included_angle, 12 * pitch, rtol=0.01)


@pytest.mark.parametrize("tilt", [20, 45, 60])
def test_the_included_angle_is_smaller_than_that_of_a_round_patch_with_as_many_points(tilt):
    """Written out: pixels on a circle of the surface, as many as the disc has, and the widest angle between two."""
    coupon = coupon_at([0, 0, 600], tilted(tilt, 0), 60, 60)
    patches = measure_patches(ideal_cloud(coupon), coupon)
    nearest = int(patches.off_axis.values.argmin())
    # on one axis of a finer grid, so that whole pixels do not matter
    rays = ViewGrid(6260.0, 6260.0, 400.0, 400.0, 801, 801).rays().reshape(-1, 3)
    on = rays * ((coupon.centre @ coupon.normal) / (rays @ coupon.normal))[:, None]
    order = np.argsort(np.linalg.norm(on - coupon.centre, axis=1))[: round(np.pi * 60**2)]
    angles = np.arccos(np.clip(rays[order] @ rays[order[-200:]].T, -1, 1))
    assert np.isclose(angles.max() / patches.included_angle[nearest], 1 / np.sqrt(np.cos(np.radians(tilt))), rtol=0.03)


def test_a_calibrated_pitch_gives_the_fraction_by_density():
    """The grid's own pitch gives back the count of pixels; another lambda goes as its square, and tells if over 1."""
    coupon = coupon_at([120, 60, 600], tilted(40, 20))
    cloud = ideal_cloud(coupon)
    same = measure_patches(cloud, coupon, angular_pitch=GRID.angular_pitch)
    assert np.allclose(same.points_possible, 113, rtol=0.01)
    finer = measure_patches(cloud, coupon, angular_pitch=0.8 * GRID.angular_pitch)
    assert np.allclose(finer.recovered_fraction, 0.64, rtol=0.01)
    assert (finer.fraction_clipped == 0).all()
    assert ((finer.fraction_low < 0.64) & (finer.fraction_high > 0.64)).all()
    coarser = measure_patches(cloud, coupon, angular_pitch=1.1 * GRID.angular_pitch)
    assert (coarser.recovered_fraction == 1).all()
    assert np.allclose(coarser.fraction_clipped, 0.21, rtol=0.05)


def test_a_matt_white_reference_gives_the_fraction_of_what_was_there_to_be_had(rng):
    coupon = coupon_at([0, 0, 600], tilted(20, 0))
    white, metal = (ideal_cloud(coupon, keep=keep, rng=rng) for keep in (0.9, 0.45))
    patches = measure_patches(metal, coupon, reference=white)
    # relative scatter of one ratio: sqrt(0.55 / 51 + 0.1 / 102) = 0.11; of the mean of 60 patches 1.4 %, and the mean
    # of a ratio is 0.1 / 102 = 0.1 % too large
    assert patches.sizes["patch"] > 60
    assert np.isclose(patches.recovered_fraction.mean(), 0.5, rtol=4 * 0.014)
    assert ((patches.fraction_low <= 0.5) & (patches.fraction_high >= 0.5)).mean() > 0.9
    assert np.isclose(patches.points_possible.mean(), 0.9 * 113, rtol=0.02)
    swapped = measure_patches(white, coupon, reference=metal)
    assert (swapped.recovered_fraction == 1).all()
    assert np.isclose(swapped.fraction_clipped.mean(), 1.0, rtol=0.1)


def test_a_place_where_the_reference_has_nothing_has_no_fraction():
    coupon = coupon_at([0, 0, 600], tilted(0, 0))
    cloud = ideal_cloud(coupon)
    empty = PointCloud(np.full_like(cloud.points, np.nan), np.zeros_like(cloud.status) + 1, GRID, "ideal", "simulated")
    patches = measure_patches(cloud, coupon, reference=empty)
    assert np.isnan(patches.recovered_fraction).all()
    assert np.isnan(patches.fraction_low).all()


@pytest.mark.parametrize(
    "given",
    [
        {"radius_px": 0.5},
        {"step_px": 0},
        {"angular_pitch": 0.0},
        {"reference": "small"},
        {"reference": "same", "angular_pitch": 1e-3},
        {"reference": "moved"},
        {"radius_px": np.inf},
        {"margin_px": np.nan},
        {"margin_px": -20.0},
        {"step_px": np.inf},
        {"angular_pitch": np.inf},
    ],
)
def test_what_cannot_be_measured_is_refused(given):
    coupon = coupon_at([0, 0, 600], tilted(0, 0))
    cloud = ideal_cloud(coupon)
    small = ideal_cloud(coupon, grid=ViewGrid(626.0, 626.0, 50.0, 50.0, 100, 100))
    moved = ideal_cloud(coupon, grid=replace(GRID, cx=GRID.cx + 5))
    given = given | (
        {"reference": {"small": small, "same": cloud, "moved": moved}[given["reference"]]}
        if "reference" in given
        else {}
    )
    with pytest.raises(InputError, match="measure_patches"):
        measure_patches(cloud, coupon, **given)


@pytest.mark.parametrize(
    "change",
    [{"width": 0.0}, {"height": np.nan}, {"normal": np.array([0, 0, -2.0])}, {"across": np.array([0, 0.1, 1.0])}],
)
def test_a_coupon_that_is_no_rectangle_is_refused(change):
    coupon = coupon_at([0, 0, 600], tilted(0, 0))
    with pytest.raises(InputError, match=r"measure_patches.*coupon"):
        measure_patches(ideal_cloud(coupon), replace(coupon, **change))


def test_a_pooled_fraction_is_at_most_one():
    """By a pitch that is too large every point is more than one, and where a reference has none there is no F."""
    coupon = coupon_at([0, 0, 600], tilted(10, 0))
    cloud = ideal_cloud(coupon)
    wrong = measure_patches(cloud, coupon, angular_pitch=1.07 * GRID.angular_pitch)
    assert (wrong["points"] / wrong["points_possible"]).mean() > 1.13
    assert overall(wrong).fraction == 1.0
    half = ideal_cloud(coupon)
    half.points[:, : GRID.width // 2] = np.nan
    pooled = overall(measure_patches(half, coupon, reference=half))
    assert pooled.fraction == 1.0 and pooled.fraction_error < 0.01


def test_overlapping_patches_say_how_much_each_is_worth(rng):
    coupon = coupon_at([0, 0, 600], tilted(10, 0))
    cloud = ideal_cloud(coupon, sigma=0.2, keep=0.8, rng=rng)
    apart, dense = measure_patches(cloud, coupon, step_px=14), measure_patches(cloud, coupon, step_px=4)
    assert (apart.independent_share == 1).all()
    assert dense.sizes["patch"] > 9 * apart.sizes["patch"]
    # what is independent is about the area that they cover, in discs; gaps between discs apart are 30 %
    assert 1 < dense.independent_share.sum() / apart.sizes["patch"] < 2.5
    assert dense.independent_share.max() < 0.5


def test_patches_stay_on_the_coupon_and_in_the_image():
    coupon = coupon_at([100, 0, 600], tilted(25, 10), 300, 300)
    centres = patch_centres(GRID, coupon, 6.0, 5.0, 12.0)
    pixels = (centres[:, None] + disc_offsets(6.0)).reshape(-1, 2)
    assert (pixels >= 0).all()
    assert (pixels < [GRID.height, GRID.width]).all()
    assert np.isfinite(ideal_cloud(coupon).points[pixels[:, 0], pixels[:, 1], 2]).all()
