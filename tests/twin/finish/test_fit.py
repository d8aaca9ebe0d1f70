"""The simulator fitted to captures: recovery, honesty of the uncertainty, bad input."""

from __future__ import annotations

import json
import math
import os
import tomllib
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.interpolate import Akima1DInterpolator
from typer.testing import CliRunner

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.region_of_interest import Roi
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.program import app
from mitsim.scene.differentiable import Directions, SpecularLobe
from mitsim.scene.load import load_scene
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.scatter import Deviation
from mitsim.sensor.image_formation import expose
from mitsim.sensor.imager import Imager
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.speckle import speckle_field
from mitsim.sensor.transforms import look_at
from mitsim.sensor.unknowns import UnknownsTable
from mitsim.twin.finish.dots import compare_dots
from mitsim.twin.finish.electrons import PixelNoise, linearised, pixel_noise
from mitsim.twin.finish.estimate import fit_views
from mitsim.twin.finish.find_specimen import find_coupon
from mitsim.twin.finish.finish import ALPHA_RANGE, metal_finish
from mitsim.twin.finish.observation import CouponCapture, CouponView, observe
from mitsim.twin.finish.posterior import _tabulated, finish_posterior
from mitsim.twin.finish.run import KNOWN_BLOCK_PX, UNKNOWN_BLOCK_PX, fit_captures
from mitsim.twin.finish.specimen import known_specimen, specimen_in_cloud
from mitsim.twin.finish.white_coupon import WhiteCouponRenderer

REAL_DATA = Path(os.environ.get("MITSIM_REAL_DATA") or Path(__file__).resolve().parents[3].parent / "shared" / "real")
CORNERS = np.array([[x, y, 0.0] for x in (-60, 60) for y in (-60, 60)])
IMAGER = Imager(6.0, 0.27, 20000.0, 35.0, 20.0, 0.01, 8, 4.0, 1.8)


@pytest.fixture(scope="module")
def coupon(scenes):
    return scenes / "coupon" / "coupon.xml"


@pytest.fixture(scope="module")
def ground(coupon):
    return metal_finish(load_scene(coupon, 850.0).finishes[0], 850.0, "coupon")


@pytest.fixture(scope="module")
def bench(n10):
    return WhiteCouponRenderer(n10, samples=4)


def pose_at(tilt_deg, azimuth_deg, distance=600.0):
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    eye = distance * np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    return look_at(eye, [0, 0, 0], [0, 0, 1])


@pytest.fixture(scope="module")
def captures(n10, coupon, tmp_path_factory):
    """Three noisy captures of ground aluminium of Ra 0.46 um, as a campaign takes them."""
    simulated = SimulatedSensor(n10)
    scene = load_scene(coupon, n10.wavelength_nm, {"Ra": "0.46"})
    folder = tmp_path_factory.mktemp("coupon")
    for number, (tilt, azimuth) in enumerate([(14, 210), (22, 60), (36, 300)]):
        pose = pose_at(tilt, azimuth)
        around = pose.inverse().points(CORNERS)
        capture = simulated.capture(scene, pose, rendering=Rendering(samples=4), seed=number, around=around)
        write_capture(capture, folder / f"pose_{number}")
    return sorted(folder.iterdir())


# electrons ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "imager",
    [
        IMAGER,
        replace(IMAGER, bits=12, gamma=2.0),
        replace(IMAGER, bits=10, black_level=10.0, companding=((300.0, 300.0), (1100.0, 500.0), (4096.0, 1024.0))),
    ],
    ids=["linear", "gamma", "companding"],
)
def test_grey_levels_are_taken_back_to_electrons(imager):
    """Without noise, to half a grey level; companding cuts to whole converter levels first, one of them more."""
    electrons = np.linspace(50.0, 0.95 * imager.full_well, 500)[None]
    levels = expose(electrons, imager, None, Noise.only("quantisation"), None)
    back = linearised(levels, imager)[0]
    edges = linearised(np.arange(imager.full_scale + 1), imager)
    width = np.maximum(np.diff(edges, prepend=edges[0]), np.diff(edges, append=edges[-1]))[levels[0]]
    cut = 1.0 / imager.gain if imager.companding else 0.0
    assert (np.abs(back - electrons[0]) <= 0.501 * width + cut).all()


def test_the_noise_of_a_mean_is_what_exposing_makes(rng):
    """Variance of 200 pixels' mean of 4 images over 100 draws: 19800 degrees of freedom, standard error 1.0 %."""
    imager = replace(IMAGER, prnu=0.0, dsnu=0.0)
    for electrons in (500.0, 8000.0):
        draws = np.stack(
            [
                linearised(expose(np.full((4, 1, 200), electrons), imager, None, Noise(), rng), imager).mean(axis=0)[0]
                for _ in range(100)
            ]
        )
        expected = pixel_noise(imager, imager, 4, 0.0, False).variance(np.array([electrons]))[0]
        assert draws.var(axis=0, ddof=1).mean() == pytest.approx(expected, rel=0.04)


# finish ---------------------------------------------------------------------------------------------------------


@given(st.floats(0.09, 1.5))
def test_ra_and_alpha_are_inverse_on_the_rising_branch(ground, roughness):
    """The table has 61 places over a factor of 27: interpolation is off by a few parts in 10^4."""
    alpha = machined(MachinedFace("aluminium", "ground", roughness), 850.0).alpha_u
    found, uncertainty = ground.roughness(alpha, 0.01)
    assert found == pytest.approx(roughness, rel=1e-3)
    # alpha grows a little slower than Ra, or a little faster: the law's exponent is 0.6 before diffraction
    assert 0.005 * roughness < uncertainty < 0.03 * roughness


def test_no_ra_is_told_where_none_has_the_lobe(ground):
    low, high = ground.alpha_range
    assert 0.02 < low < 0.05
    assert 0.35 < high < 0.5
    assert math.isnan(ground.roughness(0.9 * low, 0.01)[0])
    assert math.isnan(ground.roughness(1.1 * high, 0.01)[0])


def test_a_finish_of_a_given_ra_is_met_by_its_alpha(ground):
    wanted = machined(MachinedFace("aluminium", "ground", 0.37), 850.0)
    found = ground.scatter(math.log(wanted.alpha_u))
    assert found.coherent == pytest.approx(wanted.coherent, abs=1e-6)
    assert found.beckmann == wanted.beckmann
    np.testing.assert_allclose(found.energy_factor, wanted.energy_factor, rtol=1e-5)


# place ----------------------------------------------------------------------------------------------------------


def test_a_plane_is_found_in_a_cloud_with_other_things_in_it(rng):
    grid = ViewGrid(500.0, 500.0, 159.5, 119.5, 320, 240)
    rays = grid.rays()
    normal, centre = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0]), np.array([10.0, 5.0, 450.0])
    points = rays * ((centre @ normal) / (rays @ normal))[..., None] + rng.normal(0, 0.3, (240, 320, 1)) * rays
    status = np.full((240, 320), Status.VALID, np.uint8)
    off = np.ones((240, 320), bool)
    off[60:180, 80:240] = False
    stray = off & (rng.random((240, 320)) < 0.3)
    points[stray] = rays[stray] * rng.uniform(300, 600, (int(stray.sum()), 1))
    status[off & ~stray] = Status.AMBIGUOUS
    points[off & ~stray] = np.nan
    cloud = PointCloud(points.astype(np.float32), status, grid, "test", "simulated")
    specimen = specimen_in_cloud(cloud, "cloud")
    assert specimen.world_from_sensor.rotation[2] == pytest.approx(normal, abs=2e-3)
    # noise 0.3 mm, and the stray points that happen to be near the plane
    assert specimen.off_plane == pytest.approx(0.3, rel=0.2)
    assert specimen.occupied.sum() * specimen.cell.prod() == pytest.approx(160 * 120 * 0.9**2, rel=0.1)
    with pytest.raises(InputError, match="points of its cloud in a plane"):
        specimen_in_cloud(replace(cloud, points=np.full_like(cloud.points, np.nan)), "cloud")


# the estimator --------------------------------------------------------------------------------------------------

POSES = [(6, 30), (14, 210), (22, 60), (40, 330)]
TRUE_ALPHA, TRUE_POWER, TRUE_SHARE, GRAIN = 0.13, 0.9, 0.1, 0.18


@pytest.fixture(scope="module")
def plain_views(ground):
    """Four poses of one camera, 48 x 48 px each, and what it would count without noise [e-]."""
    lobe, side = SpecularLobe(ground.index), 48
    rows, columns = (grid.ravel() for grid in np.indices((side, side)))
    across, down = rows // 8, columns // 8
    views = []
    for number, (tilt, azimuth) in enumerate(POSES):
        pose = pose_at(tilt, azimuth)
        points = np.column_stack([(columns - 23.5) * 1.5, (rows - 23.5) * 1.5, np.zeros(side**2)])
        toward = [place - points for place in (pose.translation, pose.points(np.array([50.0, 0, 4.0])))]
        view, lamp = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in toward)
        unit = 4000.0 * lamp[:, 2]
        specular = lobe.reflectance(ground.scatter(math.log(TRUE_ALPHA)), Directions(view, lamp))
        mean = TRUE_POWER * unit * ((1 - TRUE_SHARE) * specular + TRUE_SHARE * ground.normal_reflectance)
        views.append(
            CouponView(
                number,
                f"pose {number}",
                "left",
                1e-3,
                columns,
                rows,
                across * (side // 8) + down,
                8,
                np.stack(np.divmod(np.arange((side // 8) ** 2), side // 8), axis=1),
                mean,
                unit,
                np.zeros(side**2),
                view,
                lamp,
                pixel_noise(IMAGER, IMAGER, 1, 0.0, False),
                (side // 8) ** 2,
                known_specimen(pose, 100.0, 100.0),
            )
        )
    return views


def noisy(views, size_px, seed):
    """Views with grain ``size_px`` pixels long, and the imager's noise."""
    rng, out = np.random.default_rng(seed), []
    for view in views:
        gain = speckle_field((48, 48), GRAIN, size_px, rng).gain.ravel()
        mean = view.electrons * gain
        out.append(replace(view, electrons=mean + rng.normal(size=mean.size) * np.sqrt(view.noise.variance(mean))))
    return out


def test_without_noise_the_truth_is_found_from_no_start_at_all(plain_views, ground):
    fit = fit_views(plain_views, ground)
    # what remains are single precision and the interpolated energy factors
    assert math.exp(fit.log_alpha.value) == pytest.approx(TRUE_ALPHA, rel=1e-4)
    assert math.exp(fit.log_power.value) == pytest.approx(TRUE_POWER, rel=2e-4)
    assert fit.wide_angle.value == pytest.approx(TRUE_SHARE, rel=1e-3)
    assert not fit.at_limit
    assert fit.reduced_chi_square < 0.01


@pytest.mark.parametrize("size_px", [0.0, 2.0], ids=["grain of a pixel", "grain of two pixels"])
def test_the_uncertainty_covers_the_truth(plain_views, ground, size_px):
    """Errors z over the stated uncertainty in 14 draws.

    Beyond 2 u: with 5 % each, more than 3 of 14 happen once in 240 times (binomial). Root mean square of z by
    covariance: sqrt(chi^2_14 / 14) lies within 0.47 and 1.61 in 99.8 %; the low end says that the uncertainty is not
    simply too large. Grain as long as two pixels is found by the correlation of neighbours; without it chi-square is
    over 1.5.
    """
    results = [fit_views(noisy(plain_views, size_px, seed), ground) for seed in range(14)]
    for name, true in (
        ("log_alpha", math.log(TRUE_ALPHA)),
        ("log_power", math.log(TRUE_POWER)),
        ("wide_angle", TRUE_SHARE),
    ):
        found = [getattr(fit, name) for fit in results]
        error = np.array([one.value - true for one in found])
        assert (np.abs(error) > 2 * np.array([one.uncertainty for one in found])).sum() <= 3, name
        z = error / np.array([one.by_covariance for one in found])
        low, high = np.sqrt(stats.chi2.ppf([0.001, 0.999], len(z)) / len(z))
        assert low < np.sqrt(np.mean(z**2)) < high, name
    chi_square = np.mean([fit.reduced_chi_square for fit in results])
    if size_px:
        # the mean of a block takes a sixteenth of such grain away, and pixels of neighbouring blocks correlate too
        assert chi_square == pytest.approx(1.0, abs=0.2)
    else:
        # 14 x 141 degrees of freedom: standard error 0.032; and grain is estimated inside the same blocks
        assert chi_square == pytest.approx(1.0, abs=0.08)
        assert np.mean([fit.grain for fit in results]) == pytest.approx(GRAIN, rel=0.03)


def test_a_posterior_covers_the_truth_and_is_narrower_than_its_prior(plain_views, ground):
    """The views were made of the lobe at tail 0. A prior of another Ra moves centres, not what they stand for."""
    views = noisy(plain_views, 0.0, 1)
    fit = fit_views(views, ground)
    alphas = []
    for roughness in (0.37, 0.74):
        prior = machined(MachinedFace("aluminium", "ground", roughness), 850.0)
        found = finish_posterior(views, ground, prior, fit, "plate")
        centre, size = found.alpha
        assert abs(math.log(TRUE_ALPHA / prior.alpha_u) / math.log(1.6) - centre) < 3 * size and size < 0.5
        alphas.append(prior.alpha_u * 1.6**centre)
        moved = Deviation(wide_angle=found.wide_angle[0]).share(prior.wide_angle, prior.wide_angle_range)
        assert moved == pytest.approx(TRUE_SHARE, rel=0.25) and found.wide_angle[1] < 1
        assert abs(found.tail[0]) < 3 * found.tail[1] and found.tail[1] < 1
    assert alphas[0] == pytest.approx(alphas[1], rel=0.01)
    told = UnknownsTable.model_validate(tomllib.loads(found.toml())["unknowns"])
    assert told.finish.centres_and_sizes("plate")["alpha"] == pytest.approx(found.alpha, abs=1e-3)


def seen_with(views, ground, alpha, share):
    """The views of a coupon with another width of its lobe and another wide-angle share."""
    lobe, out = SpecularLobe(ground.index), []
    for view in views:
        specular = lobe.reflectance(
            ground.scatter(math.log(alpha)), Directions(view.toward_camera, view.toward_projector)
        )
        mixed = (1 - share) * specular + share * ground.normal_reflectance
        out.append(replace(view, electrons=TRUE_POWER * view.unit * mixed))
    return out


@pytest.mark.parametrize(("alpha_off", "share"), [(0.6, 0.004), (-1.0, 0.03), (1.5, 0.2), (0.6, 0.0)])
def test_posteriors_cover_known_finishes(plain_views, ground, alpha_off, share):
    """Before, shares were cut at .001, so that an interval of a share near 0 had the width of the cut."""
    prior = machined(MachinedFace("aluminium", "ground", 0.37), 850.0)
    scale = np.linspace(-3, 3, 2401)
    shares = [Deviation(wide_angle=z).share(prior.wide_angle, prior.wide_angle_range) for z in scale.tolist()]
    off = np.interp(share, shares, scale)
    views = noisy(seen_with(plain_views, ground, prior.alpha_u * prior.alpha_factor**alpha_off, share), 0.0, 2)
    found = finish_posterior(views, ground, prior, fit_views(views, ground), "plate")
    assert abs(found.alpha[0] - alpha_off) < 3 * found.alpha[1] and found.alpha[1] < 0.6
    if share:
        assert abs(found.wide_angle[0] - off) < 3 * found.wide_angle[1] < 2.0
    else:
        assert found.wide_angle[0] < -2.2 and found.wide_angle[1] < 0.4  # the trials draw no share under that of -3


@pytest.mark.parametrize("roughness", [0.1, 0.2])
def test_posteriors_of_quiet_views_cover_the_finish_of_the_scene(plain_views, ground, roughness):
    """Before, a tail of 1.63 +- .05 (true 0): the likelihood falls by thousands at one tail, and a spline swung."""
    true, rng = machined(MachinedFace("aluminium", "ground", roughness), 850.0), np.random.default_rng(3)
    views = []
    for view in seen_with(plain_views[1:], ground, true.alpha_u, true.wide_angle):
        quiet = PixelNoise(*(np.array(astuple(view.noise)) / ([25.0] * 5 + [1.0])))  # of the mean of 25 images
        electrons = rng.normal(view.electrons, np.sqrt(quiet.variance(view.electrons)))
        views.append(replace(view, electrons=electrons, noise=quiet))
    found = finish_posterior(views, ground, true, fit_views(views, ground), "plate")
    for centre, size in (found.alpha, found.wide_angle, found.tail):
        assert abs(centre) < 3 * size < 3


def test_a_likely_tail_between_the_first_ones_is_found():
    """At all first tails, a narrower lobe of more power is likelier. Before, of eight captures with a saturated middle,
    alpha -1.06 +- 0.07, wide angle -0.52 +- 0.05 and tail -1.43 +- 0.44, for a true 0 of each."""

    def misfit(share):
        return ((share - 0.15) / 0.006) ** 2

    def of_tail(share):
        return [float(np.logaddexp(-0.5 * misfit(share), -30 - 140 * share)), 0.0, 0.0, 0.0, 0.0]

    fine = np.linspace(0, 1, 5001)
    logarithm = Akima1DInterpolator(*_tabulated(of_tail, misfit))(fine)[:, 0]
    weight = np.exp(logarithm - logarithm.max()) / np.exp(logarithm - logarithm.max()).sum()
    mean = float(weight @ fine)
    assert mean == pytest.approx(0.15, abs=0.001)
    assert np.sqrt(weight @ (fine - mean) ** 2) == pytest.approx(0.006, rel=0.1)


def test_a_width_that_one_view_hardly_shows_is_not_wider_than_its_prior(plain_views, ground):
    """Before, a width without its prior: 1.5 +- 3.0 (and the share 1.4 +- 3.0) of a view at 40 deg, for a true -1.0."""
    prior = machined(MachinedFace("aluminium", "ground", 0.37), 850.0)
    alpha = prior.alpha_u / prior.alpha_factor
    for seed in (1, 2):
        views = noisy(seen_with(plain_views[-1:], ground, alpha, 0.03), 0.0, seed)
        found = finish_posterior(views, ground, prior, fit_views(views, ground), "plate")
        for (centre, size), true in ((found.alpha, -1.0), (found.wide_angle, -0.87)):
            assert abs(centre - true) < 2 * size and 0.05 < size < 1.1


def test_views_without_information_leave_the_priors(plain_views, ground):
    """Views whose noise is that of a night: mean 0 and standard deviation 1, inside +-3."""
    dark = [replace(view, noise=PixelNoise(1e14, 0.0, 0.0, 0.0, 0.0, 0.01)) for view in plain_views]
    prior = machined(MachinedFace("aluminium", "ground", 0.37), 850.0)
    found = finish_posterior(dark, ground, prior, fit_views(dark, ground), "plate")
    for centre, size in (found.tail, found.alpha, found.wide_angle):
        assert centre == pytest.approx(0.0, abs=0.05) and size == pytest.approx(0.987, abs=0.03)


def test_poses_that_do_not_show_the_lobe_leave_its_width_open(plain_views, ground):
    """At 40 deg off the mirror direction only the wide-angle light is left to see."""
    fit = fit_views(noisy(plain_views[-1:], 0.0, 1), ground)
    assert fit.at_limit or fit.log_alpha.uncertainty > 0.3


def test_an_amplitude_alone_is_the_weighted_mean(plain_views):
    """Of a diffuse sheet, against the closed form of one linear parameter."""
    rng = np.random.default_rng(5)
    white = [
        replace(
            v,
            electrons=0.6 * v.unit + rng.normal(size=v.unit.size) * 30.0,
            noise=PixelNoise(900.0, 0.0, 0.0, 0.0, 0.0, 0.01),
        )
        for v in plain_views
    ]
    fit = fit_views(white, None)
    unit, counted = (
        np.concatenate([view.means(getattr(view, name)) for view in white]) for name in ("unit", "electrons")
    )
    # all blocks weigh alike: nothing but the constant noise
    assert math.exp(fit.log_power.value) == pytest.approx(unit @ counted / (unit @ unit), rel=1e-5)
    assert fit.log_alpha is None
    assert fit.wide_angle is None
    expected = 30.0 / 8 / np.sqrt(unit @ unit) / 0.6
    assert fit.log_power.by_covariance == pytest.approx(expected * max(1.0, fit.reduced_chi_square) ** 0.5, rel=0.05)


# captures -------------------------------------------------------------------------------------------------------


def test_alpha_and_power_are_recovered_from_noisy_captures(captures, tmp_path):
    """Through the command; the issue asks for 10 % from eight poses, three are enough for that."""
    result = CliRunner().invoke(
        app, ["fit", *map(str, captures), "-o", str(tmp_path / "fit.json"), "--figure", str(tmp_path / "fit.png")]
    )
    assert result.exit_code == 0, result.output
    true = machined(MachinedFace("aluminium", "ground", 0.46), 850.0)
    numbers = json.loads((tmp_path / "fit.json").read_text())
    alpha, power = numbers["alpha"], numbers["power_w"]
    assert alpha["value"] == pytest.approx(true.alpha_u, rel=0.10)
    assert abs(alpha["value"] - true.alpha_u) < 3 * alpha["uncertainty"]
    assert power["value"] == pytest.approx(1.0, abs=3 * power["uncertainty"])
    assert numbers["ra_equivalent_um"]["value"] == pytest.approx(0.46, rel=0.12)
    assert numbers["wide_angle_share"]["value"] == pytest.approx(true.wide_angle, rel=0.1)
    # six views of about 170 blocks: standard error of chi-square 0.045
    assert numbers["reduced_chi_square"] == pytest.approx(1.0, abs=0.18)
    assert numbers["source"] == "simulated"
    assert len(numbers["views"]) == 6
    ((name, entries),) = numbers["unknowns_finish"].items()
    assert set(entries) == {"alpha", "wide_angle", "tail"} and all(size < 1 for _, size in entries.values())
    assert f'[unknowns.finish.measured."{name}"]' in result.stdout
    assert result.stdout.startswith("alpha\t0.1")
    assert (tmp_path / "fit.png").stat().st_size > 10_000


def test_a_saturated_block_and_its_neighbours_are_left_out(n10, bench, captures):
    capture = read_capture(captures[1])
    specimen = known_specimen(capture.world_from_sensor, 120.0, 120.0)
    whole = observe(CouponCapture(capture, specimen, 0, "capture"), bench, KNOWN_BLOCK_PX, pattern="mean")[0]
    assert whole.censored == 0.0
    middle = np.flatnonzero((whole.grid == np.median(whole.grid, axis=0).astype(int)).all(axis=1))[0]
    pixel = np.flatnonzero(whole.block == middle)[0]
    images = {name: stack.copy() for name, stack in capture.images.items()}
    images["left"][0, whole.rows[pixel], whole.columns[pixel]] = 255
    left = observe(
        CouponCapture(replace(capture, images=images), specimen, 0, "capture"), bench, KNOWN_BLOCK_PX, pattern="mean"
    )[0]
    assert left.size == whole.size - 9
    assert left.censored == pytest.approx(9 / whole.size)
    assert (np.abs(left.grid - whole.grid[middle]).max(axis=1) > 1).all()


def test_nothing_but_saturation_is_refused(captures, ground, bench):
    capture = read_capture(captures[0])
    white = {name: np.full_like(stack, 255) for name, stack in capture.images.items()}
    specimen = known_specimen(capture.world_from_sensor, 120.0, 120.0)
    views = observe(
        CouponCapture(replace(capture, images=white), specimen, 0, "capture"), bench, KNOWN_BLOCK_PX, pattern="mean"
    )
    with pytest.raises(InputError, match=r"0 of \d+ blocks on the coupon free of saturation"):
        fit_views(views, ground)


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda coupon: replace(coupon, low=coupon.low + 1000.0), "the coupon is not in the image"),
        (lambda coupon: replace(coupon, cell=coupon.cell / 40, low=coupon.low / 40), "has two edges: it is too small"),
        (lambda coupon: replace(coupon, cell=coupon.cell / 9, low=coupon.low / 9), "half of no block of 32 x 32 px"),
    ],
)
def test_a_coupon_without_a_block_says_why(captures, bench, spoil, why):
    """It was "0 of 0 blocks on the coupon free of saturation", whatever the cause."""
    capture = read_capture(captures[0])
    specimen = spoil(known_specimen(capture.world_from_sensor, 120.0, 120.0))
    views = observe(CouponCapture(capture, specimen, 0, "capture"), bench, UNKNOWN_BLOCK_PX, pattern="mean")
    assert {view.whole for view in views} == {0}
    assert all(why in view.why_no_block for view in views)


def test_a_window_names_the_coupon_whatever_the_pose_says(captures, bench):
    """A part of the first image; the plane of its points is that of the coupon within 0.3 mm."""
    capture = read_capture(captures[0])
    camera = capture.rig.reference
    known = known_specimen(capture.world_from_sensor, 120.0, 120.0)
    low, high = (f(camera.project(known.corners()), axis=0).astype(int) for f in (np.min, np.max))
    middle, half = (low + high) // 2, (high - low) // 5
    part = Roi(*(middle - half).tolist(), *(2 * half).tolist())
    specimen = find_coupon(replace(capture, world_from_sensor=None), bench.sensor, (120.0, 120.0), "capture", part)
    there = capture.world_from_sensor.points(specimen.world_from_sensor.inverse().points(np.zeros((1, 3))))
    assert abs(there[0, 2]) < 0.3
    views = observe(CouponCapture(capture, specimen, 0, "capture"), bench, KNOWN_BLOCK_PX, pattern="mean")
    assert views[0].whole > 20
    pixels = np.stack([views[0].columns, views[0].rows], axis=-1)
    assert (pixels >= (part.left, part.top)).all()
    assert (pixels < (part.right, part.bottom)).all()


def test_dots_of_another_pattern_are_as_bright_and_sharp_as_the_file_says(n10, bench, scenes):
    """A sheet under dots of another seed: what its own dots would be, but for the draw.

    Seeds 10 to 15 have a mean power of 0.873 and a mean blur of 0.18 px, seed 10, the file's own, being a sharp draw;
    standard deviations 0.014 and 0.07 px. The bounds are three of them beyond the means.
    """
    other = replace(n10, pattern=n10.pattern.model_copy(update={"seed": 11}))
    scene, pose = load_scene(scenes / "coupon" / "matt_white.xml", 850.0), pose_at(12, 200)
    capture = SimulatedSensor(other).capture(
        scene,
        pose,
        rendering=Rendering(samples=4),
        seed=4,
        around=pose.inverse().points(CORNERS),
        noise=Noise.without("speckle"),
    )
    specimen = known_specimen(pose, 120.0, 120.0)
    views = observe(CouponCapture(capture, specimen, 0, "sheet"), bench, UNKNOWN_BLOCK_PX, pattern="level")
    for view in views:
        dots = compare_dots(view, bench)
        assert dots.power == pytest.approx(0.873, abs=0.042)
        assert dots.blur_px < 0.39
        assert dots.contrast == pytest.approx(dots.file_contrast, rel=0.1)
    fit = fit_views(views, None)
    assert math.exp(fit.log_power.value) == pytest.approx(0.85, abs=3 * 0.85 * fit.log_power.uncertainty)


def test_a_capture_without_a_pose_is_placed_by_its_cloud(n10, scenes, tmp_path):
    """A simulated sheet that does not say where it is: albedo as with the pose.

    The matcher's 0.11 px (docs/explanation/light.md) are 0.63 mm there. A place 10 mm off would change the brightness
    by 3 %.
    """
    pose = pose_at(12, 200)
    capture = SimulatedSensor(n10).capture(
        load_scene(scenes / "coupon" / "matt_white.xml", 850.0),
        pose,
        rendering=Rendering(samples=4),
        seed=4,
        around=pose.inverse().points(CORNERS),
    )
    write_capture(replace(capture, world_from_sensor=None), tmp_path / "lost")
    found = fit_captures([tmp_path / "lost"])
    assert 0.4 < found.specimens[0].off_plane < 0.9
    height = found.specimens[0].world_from_sensor.translation[2]
    assert height == pytest.approx(600 * math.cos(math.radians(12)), abs=1)
    power, uncertainty = found.power
    assert abs(power - 0.85) < 3 * uncertainty + 0.005


# bad input ------------------------------------------------------------------------------------------------------


def refused(arguments, *words):
    result = CliRunner().invoke(app, ["fit", *map(str, arguments)])
    assert isinstance(result.exception, InputError), result.exception
    for word in words:
        assert word in str(result.exception)


def test_a_capture_is_fitted_by_the_scene_that_it_was_rendered_of(captures, tmp_path):
    """Before, by the scene's default metal."""
    capture = read_capture(captures[0])
    assert capture.settings["scene_parameters"] == {"Ra": "0.46"}
    for name, values in (("copper", {"metal": "copper"}), ("list", ["copper"])):
        write_capture(replace(capture, settings={**capture.settings, "scene_parameters": values}), tmp_path / name)
    assert fit_captures([tmp_path / "copper"]).metal.metal == "copper"
    assert fit_captures([tmp_path / "copper"], parameters={"metal": "aluminium"}).metal.metal == "aluminium"
    refused([tmp_path / "list"], "scene_parameters", "a table of texts")


def test_what_does_not_go_together_is_refused(captures, tmp_path, n10, scenes):
    refused([tmp_path / "none"], "no such folder", "a capture folder")
    refused([captures[0], captures[0]], "a folder twice")
    refused([captures[0], "--scene", scenes / "two_pillars" / "two_pillars.xml"], "one flat shape")
    refused([captures[0], "--sensor", "ensenso-n01"], "did you mean 'ensenso-n10'")
    refused([captures[0], "-D", "process=grund"], "did you mean 'ground'")
    capture = read_capture(captures[0])
    write_capture(capture, tmp_path / "copy")  # it made the uncertainty of three captures smaller by a third
    refused([captures[0], tmp_path / "copy"], f"images: found those of {captures[0]}")
    untimed = capture.decoding.model_copy(update={"exposure_s": None})
    write_capture(replace(capture, decoding=untimed), tmp_path / "when")
    refused([tmp_path / "when"], "settings.exposure_s", "None")
    write_capture(replace(capture, settings={**capture.settings, "scene": "gone.xml"}), tmp_path / "what")
    refused([tmp_path / "what"], "'gone.xml'", "--scene")
    write_capture(replace(capture, sensor="N35"), tmp_path / "whose")
    refused([tmp_path / "whose"], "N35", "--sensor")
    refused([captures[0], tmp_path / "whose"], "N35", "ensenso-n10, as in")
    flipped = replace(capture, world_from_sensor=pose_at(170, 0))
    write_capture(flipped, tmp_path / "behind")
    refused([tmp_path / "behind"], "a sensor behind the coupon")


def test_a_finish_that_has_no_one_width_is_refused(coupon):
    with pytest.raises(InputError, match="matt_white for a diffuse sheet"):
        metal_finish(replace(load_scene(coupon, 850.0).finishes[0], name="powder_coat"), 850.0, "coupon")
    scatter = machined(MachinedFace("aluminium", "ground", 0.4, lay="u"), 850.0)
    with pytest.raises(InputError, match="a round lobe"):
        metal_finish(replace(load_scene(coupon, 850.0).finishes[0], scatter=scatter), 850.0, "coupon")


def test_alpha_is_looked_for_where_a_lobe_can_be():
    assert ALPHA_RANGE[0] < 0.05
    assert ALPHA_RANGE[1] >= 0.6


# a recording ----------------------------------------------------------------------------------------------------


@pytest.mark.real
def test_the_recorded_sheet_and_what_is_left_of_it(scenes, tmp_path):
    """The N35-604's sheet: block means within 15 % of the model, dots as sharp as the preset's, power by both alike.

    Measured were 0.47 +- 0.11 by the means, 0.62 and 0.67 by the dots, and a residual of 12 % of the mean. The bounds
    leave room for another machine's matcher, not for another result.
    """
    from mitsim.capture.recordings.ensenso import read_ensenso

    recording = REAL_DATA / "ensenso" / "colorized_point_cloud" / "stereo.zip"
    if not recording.is_file():
        pytest.skip(f"no recordings in {REAL_DATA}: set MITSIM_REAL_DATA, see docs/how-to/real-captures.md")
    folder = write_capture(read_ensenso(recording), tmp_path / "sheet")
    found = fit_captures([folder], "ensenso-n35", scenes / "coupon" / "matt_white.xml")
    assert found.source == "device"
    assert 1.5 < found.specimens[0].off_plane < 2.7
    assert found.specimens[0].world_from_sensor.translation[2] == pytest.approx(435, abs=5)
    power, uncertainty = found.power
    assert power == pytest.approx(0.47, abs=0.05)
    assert 0.05 < uncertainty < 0.2
    for dots in found.dots:
        assert dots.power == pytest.approx(0.645, abs=0.06)
        assert dots.blur_px < 0.4
    assert 0.05 < np.sqrt(np.mean([r.rms_relative**2 for r in found.fit.residuals])) < 0.15
    assert found.fit.neighbours > 0.8
