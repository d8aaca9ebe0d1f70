"""What is expected of measurements, against measuring drawn clouds."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.stats import binom

from characterisation.features.credibility import check_surface, places_seen
from characterisation.features.fits import fit_surface
from characterisation.features.pose_fit import fit_pose
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import Surface
from characterisation.tasks.covariance import ExpectedPoints, expected_fit
from characterisation.tasks.measurement_model import evaluate, measurement_model
from characterisation.tasks.prediction import (
    ExpectedInput,
    expected_inputs,
    expected_measurement,
    joint_quadratic_form,
)
from characterisation.tasks.task_file import Task

EYE = np.array([0.0, -350.0, 400.0])
SIGMA = 0.2


TASK = Task.model_validate(
    {
        "features": {
            "plane": {"kind": "plane", "point_mm": [0, 0, 0], "direction": [0, 0, 1]},
            "pillar": {"kind": "cylinder", "point_mm": [0, 0, 0], "direction": [0, 0, 1], "radius_mm": 20},
            "wall": {"kind": "plane", "point_mm": [0, 60, 0], "direction": [0, -1, 0]},
        },
        "measurements": {
            "radius": {"kind": "radius", "features": ["pillar"], "nominal": 20, "unit": "mm"},
            "angle": {"kind": "plane_axis_angle", "features": ["plane", "pillar"], "nominal": 0, "unit": "deg"},
            "corner": {"kind": "plane_angle", "features": ["plane", "wall"], "nominal": 90, "unit": "deg"},
            "flat": {"kind": "flatness", "features": ["plane"], "nominal": 0, "unit": "mm"},
            "place": {"kind": "pose_position", "features": ["plane", "pillar", "wall"], "nominal": 0, "unit": "mm"},
        },
    }
)


def on_surface(name: str, rng: np.random.Generator, count: int = 700) -> NDArray[np.float64]:
    """Points (n, 3) of a feature that the eye sees."""
    u, v = rng.random((2, count))
    if name == "plane":
        return np.column_stack([120 * u - 60, 80 * v - 100, 0 * u])
    if name == "wall":
        return np.column_stack([120 * u - 60, 0 * u + 60, 70 * v])
    angle = np.radians(-90 + 110 * (u - 0.5))
    return np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), 60 * v])


def seen(name: str, points: NDArray[np.float64]) -> ExpectedPoints:
    many = np.ones(len(points))
    ray = (points - EYE) / np.linalg.norm(points - EYE, axis=1, keepdims=True)
    pixel = np.stack([np.arange(len(points)) * 40, np.zeros(len(points), int)], axis=1)  # far apart: independent
    return ExpectedPoints(
        points,
        ray,
        pixel,
        np.tile([0.0, 0.0, 1.0], (len(points), 1)),
        many,
        0 * many,
        SIGMA * many,
        many,
        0 * many,
        0 * many,
        500 * many,
        1.0,
        1e-3,
    )


@pytest.fixture(scope="module")
def clouds() -> dict[str, NDArray[np.float64]]:
    rng = np.random.default_rng(1)
    return {name: on_surface(name, rng) for name in TASK.features}


@pytest.fixture(scope="module")
def inputs(clouds: dict[str, NDArray[np.float64]]) -> dict[object, ExpectedInput]:
    return expected_inputs(TASK, {name: seen(name, points) for name, points in clouds.items()}, 100)  # type: ignore[return-value]


def drawn(clouds: dict[str, NDArray[np.float64]], rng: np.random.Generator) -> dict[str, NDArray[np.float64]]:
    out = {}
    for name, points in clouds.items():
        ray = (points - EYE) / np.linalg.norm(points - EYE, axis=1, keepdims=True)
        out[name] = points + SIGMA * rng.normal(size=(len(points), 1)) * ray
    return out


@pytest.fixture(scope="module")
def fits_of_draws(clouds: dict[str, NDArray[np.float64]]) -> list[dict[str, Surface]]:
    """Fits of all features in 150 draws of their noise."""
    rng = np.random.default_rng(2)
    return [
        {name: fit_surface(points, TASK.features[name].nominal(), EYE) for name, points in drawn(clouds, rng).items()}
        for _ in range(150)
    ]


@pytest.mark.parametrize("name", ["radius", "angle", "corner"])
def test_the_scatter_of_measured_values_is_what_was_expected(name, fits_of_draws, inputs) -> None:
    model = measurement_model(TASK, name)
    scale = np.degrees(1.0) if TASK.measurements[name].unit == "deg" else 1.0
    errors = []
    for fits in fits_of_draws:
        value, _ = evaluate(model.value, [fits[q.features[0]] for q in model.inputs])
        errors.append(scale * value - TASK.measurements[name].nominal)
    found = expected_measurement(TASK, name, inputs)
    # a root mean square of 150 is known to 1/sqrt(300) = 5.8 %; three of these
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(found.uncertainty, rel=0.18)
    assert found.uncertainty == pytest.approx(np.sqrt(np.sum(np.square(found.contributions))))
    assert found.chance == 1.0 and found.reason == ""


def test_a_datum_plane_is_expected_at_its_points_wherever_its_nominal_point_lies(clouds) -> None:
    """The middle of the wall's points is some 35 mm over the nominal point of the task."""
    rng, found = np.random.default_rng(4), []
    side = np.column_stack([np.full(700, -200.0), *(100 * rng.random((2, 700)))])
    points = {"plane": clouds["plane"], "wall": clouds["wall"], "side": side, "pillar": clouds["pillar"]}
    for height in (0.0, 35.0, 70.0):
        document = TASK.model_dump(exclude_none=True)
        document["features"]["wall"]["point_mm"] = (0, 60, height)
        document["features"]["side"] = {"kind": "plane", "point_mm": (-200, 0, 0), "direction": (1, 0, 0)}
        document["features"]["pillar"]["outline_mm"] = ((0, 0, 0), (0, 0, 60))
        wanted = {"kind": "position", "features": ("pillar", "plane", "wall", "side"), "nominal": 0, "unit": "mm"}
        document["measurements"] = {"stand": wanted}
        task = Task.model_validate(document)
        inputs = expected_inputs(task, {name: seen(name, points[name]) for name in task.features}, 100)
        found.append(expected_measurement(task, "stand", inputs).uncertainty)
    assert found == pytest.approx([found[0]] * 3, rel=0.03)
    values = []
    for _ in range(100):
        fits = {
            name: fit_surface(measured, task.features[name].nominal(), EYE)
            for name, measured in drawn(points, rng).items()
        }
        model = measurement_model(task, "stand")
        values.append(model.value(*[fits[quantity.features[0]] for quantity in model.inputs]))
    # a root mean square of 100 is known to 7 %; three of these
    assert np.sqrt(np.mean(np.square(values))) == pytest.approx(found[0], rel=0.21)


def test_the_scatter_of_fitted_poses_is_what_was_expected(clouds, inputs) -> None:
    rng, (quantity,) = np.random.default_rng(3), measurement_model(TASK, "place").inputs
    surfaces: dict[str, Surface] = {name: TASK.features[name].nominal() for name in TASK.features}
    point = np.append(np.mean([f.point_mm for f in TASK.features.values()], axis=0), 1.0)
    moved = np.array(
        [
            (fit_pose(drawn(clouds, rng), surfaces, np.eye(4), EYE).sensor_from_part @ point - point)[:3]
            for _ in range(60)
        ]
    )
    found = expected_measurement(TASK, "place", inputs)
    assert quantity.kind == "pose"
    # the length's root mean square over 60 draws of three components: 1/sqrt(2 * 60) = 9 % at most; three of these
    assert np.sqrt((moved**2).sum(axis=1).mean()) == pytest.approx(found.uncertainty, rel=0.27)


def test_quadratic_forms_give_the_same_uncertainty(inputs) -> None:
    for name in ("radius", "angle", "corner", "place"):
        model, found = measurement_model(TASK, name), expected_measurement(TASK, name, inputs)
        form = joint_quadratic_form(TASK, name, inputs)
        total = np.trace(form @ block_diag(*[inputs[q].fit.covariance for q in model.inputs]))
        assert np.sqrt(total) == pytest.approx(found.uncertainty, rel=1e-3)


def test_of_a_perfect_face_flatness_is_what_its_noise_makes(inputs) -> None:
    found = expected_measurement(TASK, "flat", inputs)
    assert 0 < found.uncertainty < SIGMA
    twice = {
        q: replace(one, fit=replace(one.fit, noise_covariance=4 * one.fit.noise_covariance, shared=2 * one.fit.shared))
        for q, one in inputs.items()
    }
    assert expected_measurement(TASK, "flat", twice).uncertainty == pytest.approx(2 * found.uncertainty)


@pytest.mark.parametrize(
    ("radius", "fraction", "doubt", "chance"),
    [
        (20.0, 0.9, 0.0, 1.0),
        (20.0, 0.2, 0.0, 0.0),
        (20.0, 0.4, 0.1, 0.8413),
        (20.0, 0.2, 0.1, 0.1587),
        (0.5, 0.9, 0.0, 0.0),
    ],
)
def test_a_hole_is_possible_where_its_edge_can_be_fitted(clouds, radius, fraction, doubt, chance) -> None:
    """Fits need F of 0.3 beside the edge and twelve crossings of it; one of radius 0.5 mm has under 6 at 0.7 mm."""
    hole = {"kind": "circle", "of": ["plane"], "point_mm": [0, -60, 0], "radius_mm": radius}
    size = {"kind": "radius", "features": ["hole"], "nominal": radius, "unit": "mm"}
    task = Task.model_validate(
        {"features": {"plane": TASK.features["plane"], "hole": hole}, "measurements": {"size": size}}
    )
    face = replace(seen("plane", clouds["plane"]), thinning=40.0)  # 700 places of 120 x 80 mm
    face = replace(face, fraction=fraction * face.fraction, fraction_error=doubt * face.fraction)
    known = expected_inputs(task, {"plane": face}, 100)
    (hole_fit,) = (fit for quantity, fit in known.items() if quantity.features == ("hole",))
    if radius < 1:
        assert isinstance(hole_fit, FitError) and "crossings" in str(hole_fit)
    else:
        assert hole_fit.fit.chance == pytest.approx(chance, abs=1e-4)
    assert expected_measurement(task, "size", known).chance <= chance + 1e-4


@pytest.mark.parametrize(("cover", "visible"), [(40.0, 1.0), (10.0, 0.732), (5.0, 0.608), (0.0, 0.5), (-10.0, 0.268)])
def test_the_hidden_part_of_a_hole_s_edge_does_not_count(cover, visible) -> None:
    """A cover hides all beyond x = ``cover`` of a hole of 15 mm: u against circles fitted to the rest of its edge.

    Before, u was that of the whole edge, and a hole that is hidden by three quarters was possible.
    """
    radius, pitch, rng = 15.0, 0.4, np.random.default_rng(1)
    x, y = (values.ravel() for values in np.meshgrid(*[np.arange(-35, 35, pitch)] * 2))
    shows = (np.hypot(x, y) > radius) & (x < cover)
    face = seen("plane", np.column_stack([x, y, 0 * x])[shows])
    away = face.point - [0.0, 0.0, 500.0]
    pixel = np.rint((face.point[:, 1::-1] + 35) / pitch).astype(int)
    ray = away / np.linalg.norm(away, axis=1, keepdims=True)
    face = replace(face, ray=ray, pixel=pixel, angular_pitch=pitch / 500)
    hole = {"kind": "circle", "of": ["plane"], "point_mm": [0, 0, 0], "radius_mm": radius}
    sizes = {"size": {"kind": "radius", "features": ["hole"], "nominal": radius, "unit": "mm"}}
    task = Task.model_validate({"features": {"plane": TASK.features["plane"], "hole": hole}, "measurements": sizes})
    found = expected_measurement(task, "size", expected_inputs(task, {"plane": face}, 100))
    if visible < 0.57:
        assert found.chance == 0 and "% of the edge is visible" in found.reason
        return
    angle = np.linspace(-np.pi, np.pi, round(2 * np.sqrt(2) / np.pi * 2 * np.pi * radius / pitch), endpoint=False)
    angle = angle[radius * np.cos(angle) < cover]
    assert len(angle) / (2 * np.sqrt(2) / np.pi * 2 * np.pi * radius / pitch) == pytest.approx(visible, abs=0.01)
    design = np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))])
    noise = pitch * np.sqrt(5 / 6 / 12) * rng.standard_normal((len(angle), 4000))
    assert found.uncertainty == pytest.approx(np.linalg.lstsq(design, noise, rcond=None)[0][2].std(), rel=0.1)
    assert found.chance == 1


@pytest.mark.parametrize(("fraction", "minimum"), [(0.1, 75), (0.1, 65), (0.5, 340), (0.9, 640)])
def test_the_chance_of_enough_points_is_that_of_random_losses(clouds, fraction, minimum) -> None:
    """Of independent pixels, whose noise area is 1 / F, the number of points is binomial."""
    face = seen("plane", clouds["plane"])
    face = replace(face, fraction=fraction * face.fraction, area=face.area / fraction)
    fit = expected_fit(TASK.features["plane"].nominal(), face, minimum)
    assert fit.chance == pytest.approx(binom.sf(minimum - 1, 700, fraction), abs=0.03)


@pytest.mark.parametrize(
    ("away_mm", "tilt_mm", "least"), [(1.2, 0.0, 0.99), (5.0, 0.0, 0.99), (1.2, 2.0, 0.5), (0.0, 8.0, 0.1)]
)
def test_the_chance_of_a_credible_fit_is_the_share_of_credible_fits(clouds, away_mm, tilt_mm, least) -> None:
    """Of faces that errors of the calibration move along the rays, all alike and tilted, in 400 draws.

    Before, a face that moves as a whole by 1.2 mm (one sigma) had a chance of 0.78, by 5 mm 0.23: its fit is credible.
    """
    rng, points, nominal = np.random.default_rng(5), clouds["plane"], TASK.features["plane"].nominal()
    shared = np.column_stack([np.full(len(points), away_mm), tilt_mm * points[:, 0] / 60])
    face = replace(seen("plane", points), shared=shared)
    places = places_seen(nominal, face.ray, EYE, points)
    credible = 0
    for _ in range(400):
        moved = (
            points + face.ray * (SIGMA * rng.standard_normal(len(points)) + shared @ rng.standard_normal(2))[:, None]
        )
        try:
            fit = fit_surface(moved, nominal, EYE)
            check_surface(fit, nominal, moved, places, EYE)
            credible += 1
        except FitError:
            pass
    assert credible / 400 > least
    assert expected_fit(nominal, face, 100).chance == pytest.approx(credible / 400, abs=0.07)


@pytest.mark.parametrize("arc_deg", [10.0, 14.0, 20.0, 40.0])
def test_the_chance_of_a_credible_arc_includes_that_of_its_radius(clouds, arc_deg) -> None:
    """Before, an arc of 10 degrees had a chance of 1: its surface is determined where it is seen, not its radius."""
    rng, nominal = np.random.default_rng(6), TASK.features["pillar"].nominal()
    angle = np.degrees(np.arctan2(clouds["pillar"][:, 1], clouds["pillar"][:, 0]))
    points = clouds["pillar"][np.abs(angle + 90) < arc_deg / 2]
    arc = seen("pillar", points)
    credible = 0
    for _ in range(200):
        moved = points + arc.ray * SIGMA * rng.standard_normal((len(points), 1))
        try:
            fit = fit_surface(moved, nominal, EYE)
            check_surface(fit, nominal, moved, places_seen(nominal, arc.ray, EYE, moved), EYE)
            credible += 1
        except FitError:
            pass
    assert expected_fit(nominal, arc, 20).chance == pytest.approx(credible / 200, abs=0.1)


def test_what_is_not_seen_makes_a_measurement_impossible(clouds) -> None:
    half = {name: seen(name, points) for name, points in clouds.items()}
    half["pillar"] = seen("pillar", clouds["pillar"][:0])
    known = expected_inputs(TASK, half, 100)
    for name in ("radius", "angle", "place"):
        found = expected_measurement(TASK, name, known)
        assert np.isnan(found.uncertainty) and found.chance == 0 and "no points are expected" in found.reason
    assert expected_measurement(TASK, "corner", known).uncertainty > 0
    (pillar,) = measurement_model(TASK, "radius").inputs
    assert isinstance(known[pillar], FitError)
