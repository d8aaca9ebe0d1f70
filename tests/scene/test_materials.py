"""BSDFs as Mitsuba has them: what they return, and what an author may say of them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.scene import backend
from mitsim.scene.bsdf_descriptions import gloss_paint_bsdf, metal_bsdf, powder_coat_bsdf
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.scene.materials import Finish
from mitsim.scene.surface.energy import directional_albedo, energy_factors
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.metals import normal_reflectance, refractive_index
from mitsim.scene.surface.paint import ALPHA_RANGE, paint
from mitsim.scene.surface.processes import LAY_FACTOR, PROCESSES
from mitsim.scene.surface.scatter import NOMINAL, Deviation

FURNACE_DEG = np.array([0, 15, 30, 45, 60])

#: where the white furnace misses its 5 % up to 60 deg: Ra of the worst, and what it returns at 60 deg
EXCEPTIONS = {"bead_blasted": (2.0, 0.944), "grit_blasted": (1.45, 0.946), "edm": (1.43, 0.944)}


def furnace(description, degrees=FURNACE_DEG, azimuths=(0.0,), side=128):
    """Directional albedo of a BSDF, one per angle, averaged over azimuths, by stratified sampling."""
    mi, dr = backend.mi, backend.dr
    bsdf = mi.load_dict(description)
    places = (np.arange(side) + 0.5) / side
    first, second = (grid.ravel() for grid in np.meshgrid(places, places))
    polar, turn = (grid.ravel() for grid in np.meshgrid(np.radians(degrees), azimuths, indexing="ij"))
    lanes = len(polar) * side**2
    # which lobe of a blend is taken must not go with where in it
    choice = np.random.default_rng(1).permutation((np.arange(side**2) + 0.5) / side**2)

    def every(values):
        return mi.Float(np.repeat(values, side**2).astype(np.float32))

    surface = dr.zeros(mi.SurfaceInteraction3f, lanes)
    surface.wi = mi.Vector3f(
        every(np.sin(polar) * np.cos(turn)), every(np.sin(polar) * np.sin(turn)), every(np.cos(polar))
    )
    surface.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    one, two, three = (mi.Float(np.tile(v, len(polar)).astype(np.float32)) for v in (choice, first, second))
    _, weight = bsdf.sample(mi.BSDFContext(), surface, one, mi.Point2f(two, three))
    return np.array(weight).reshape(len(degrees), len(azimuths), -1).mean(axis=(1, 2))


def perfect(process, roughness, lay=None):
    """The description of a face made of a perfect mirror (n = 0, k = 1), all its lobes compensated for it."""
    scatter = machined(MachinedFace(process=process, Ra=roughness, lay=lay), 850)
    factors = energy_factors(scatter.alpha_u, scatter.alpha_v, 1.0)
    return metal_bsdf((0.0, 1.0), dataclasses.replace(scatter, energy_factor=factors))


def faces():
    """Every process at both ends of its usual range; with a lay where it leaves one."""
    for name, process in PROCESSES.items():
        for roughness in process.usual:
            yield name, roughness, None
        if process.lay_ratio < 1:
            yield name, process.usual[1], "u"


@pytest.mark.parametrize(("process", "roughness", "lay"), list(faces()))
def test_a_perfect_mirror_of_any_finish_returns_all_light(process, roughness, lay):
    """White furnace: 1 % at the nominal 30 deg, 5 % up to 60 deg. Each mean is of 128^2 stratified samples or more."""
    azimuths = (0.0,) if lay is None else (np.arange(4) + 0.5) * np.pi / 8
    found = furnace(perfect(process, roughness, lay), azimuths=azimuths)
    assert abs(found[2] - 1) < 0.01
    assert np.all(np.abs(found[:4] - 1) < 0.05)
    if process not in EXCEPTIONS:
        assert abs(found[4] - 1) < 0.05


@pytest.mark.parametrize("process", list(EXCEPTIONS))
def test_the_exceptions_of_the_furnace_are_as_large_as_they_are_said_to_be(process):
    """Beckmann lobes of alpha 0.3, the worst: they lose 7 % more at 60 deg than at 30."""
    roughness, returned = EXCEPTIONS[process]
    assert np.isclose(furnace(perfect(process, roughness))[4], returned, atol=0.003)


@pytest.mark.parametrize(("kind", "describe"), [("gloss_paint", gloss_paint_bsdf), ("powder_coat", powder_coat_bsdf)])
@pytest.mark.parametrize("place", [0.0, 0.5, 1.0])
def test_a_paint_on_a_white_base_returns_all_light(kind, describe, place):
    low, high = np.log(ALPHA_RANGE[kind])
    scatter = paint(kind, 1.0, alpha=float(np.exp(low + place * (high - low))))
    found = furnace(describe(1.0, scatter))
    assert abs(found[2] - 1) < 0.01
    assert np.all(np.abs(found - 1) < 0.05)


def test_powder_coat_returns_too_much_at_grazing_incidence():
    """An exception of the furnace: nothing takes from the base what the surface reflects. Beyond 60 deg only."""
    found = furnace(powder_coat_bsdf(1.0, paint("powder_coat", 1.0, alpha=0.02)), degrees=[60, 75])
    assert np.allclose(found, [1.048, 1.21], atol=0.01)


@pytest.mark.parametrize("roughness", [0.05, 0.09, 0.37, 0.74, 1.6])
def test_metal_reflects_what_its_constants_say(roughness):
    """Aluminium at 850 nm and 30 deg, its Fresnel curve flat so far: what single scattering misses is reflected twice.

    R [wide + (1 - wide)(E + R (1 - E))], E of the lobes.
    """
    scatter = machined(MachinedFace(process="ground", Ra=roughness), 850)
    found = furnace(metal_bsdf(refractive_index("aluminium", 850), scatter), degrees=[30])
    r, nominal = normal_reflectance("aluminium", 850), np.radians(30)
    kept = scatter.beckmann * directional_albedo(nominal, scatter.alpha_u, scatter.alpha_v, "beckmann")
    kept += (1 - scatter.beckmann) * directional_albedo(nominal, *scatter.ggx_alpha, "ggx")
    coherent = scatter.coherent_at(nominal)
    kept = coherent + (1 - coherent) * kept
    expected = r * (scatter.wide_angle + (1 - scatter.wide_angle) * (kept + r * (1 - kept)))
    assert np.isclose(found[0], expected, rtol=0.005)
    assert found[0] > 0.97 * r


def test_wide_lobes_across_the_lay_and_narrow_ones_along_it():
    """BSDF value off the mirror direction by 20 deg of facet tilt: across the marks, bright; along them, dark."""
    mi, dr = backend.mi, backend.dr
    bsdf = mi.load_dict(perfect("ground", 0.4, "u"))
    surface = dr.zeros(mi.SurfaceInteraction3f, 2)
    surface.wi = mi.Vector3f(0, 0, 1)
    surface.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    tilt = np.radians(40)
    towards = mi.Vector3f(mi.Float([np.sin(tilt), 0]), mi.Float([0, np.sin(tilt)]), mi.Float(np.cos(tilt)))
    along, across = np.ravel(np.array(bsdf.eval(mi.BSDFContext(), surface, towards)))
    assert across > 2 * along


#: shape: where a ray hits it, and the directions of u and v there
DIRECTIONS = {
    "rectangle": ((0.3, 0.2, 5), (0, 0, -1), (1, 0, 0), (0, 1, 0)),
    "disk": ((0.5, 0, 5), (0, 0, -1), (1, 0, 0), (0, 1, 0)),
    "cylinder": ((5, 0, 0.5), (-1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "sphere": ((5, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, 1)),
}


@pytest.mark.parametrize("shape", list(DIRECTIONS))
def test_u_and_v_of_shapes_run_as_the_page_on_materials_says(shape):
    """Up to sign, which a lay has not."""
    backend.activate()
    mi = backend.mi
    origin, direction, u, v = DIRECTIONS[shape]
    scene = mi.load_dict({"type": "scene", "shape": {"type": shape}})
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction)))
    found = [np.ravel(np.array(axis)) for axis in (hit.sh_frame.s, hit.sh_frame.t)]
    assert np.allclose(np.abs(found), [u, v], atol=1e-5)


def load(tmp_path, bsdf, shape="rectangle", deviation=NOMINAL):
    file = tmp_path / "part.xml"
    file.write_text(
        f'<scene version="3.0.0"><shape type="{shape}" id="face">{bsdf}'
        '<transform name="to_world"><scale value="30"/></transform></shape></scene>'
    )
    return load_scene(file, 850, deviation=deviation).finishes[0]


def metal(*said):
    return f'<bsdf type="machined_metal" id="f">{"".join(said)}</bsdf>'


RA = '<float name="Ra" value="0.4"/>'
TURNED = '<string name="process" value="turned"/>'


def test_a_finish_is_looked_up_by_its_name_and_roughness_alone(tmp_path):
    found = load(tmp_path, metal(RA, '<string name="lay" value="u"/>'))
    assert found == Finish("aluminium/ground", 0.4)
    assert hash(found) == hash(Finish("aluminium/ground", 0.4))
    assert str(found) == "aluminium/ground Ra 0.4 um"
    assert "Scatter" not in repr(found)
    assert found.scatter.alpha_u < found.scatter.alpha_v
    assert found.scatter.alpha_factor == 2.0
    assert load(tmp_path, metal(RA, TURNED)).scatter.alpha_factor == 1.6


@pytest.mark.parametrize(
    ("bsdf", "name", "words"),
    [
        ('<bsdf type="gloss_paint" id="f"/>', "gloss_paint", "gloss 85 GU at 60 deg, assumed"),
        (
            '<bsdf type="powder_coat" id="f"><float name="gloss" value="10"/></bsdf>',
            "powder_coat",
            "gloss 10 GU at 60 deg",
        ),
        (
            '<bsdf type="powder_coat" id="f"><float name="alpha" value="0.2"/></bsdf>',
            "powder_coat",
            "alpha 0.2 as given",
        ),
        ('<bsdf type="matt_white" id="f"/>', "matt_white", "Lambertian by definition"),
    ],
)
def test_paints_report_what_they_are(tmp_path, bsdf, name, words):
    found = load(tmp_path, bsdf, "cylinder")
    assert found.name == name
    assert math.isnan(found.roughness)
    assert found.scatter.provenance == words
    assert found.scatter.depolarising


def test_files_lie_beside_the_scene(tmp_path, monkeypatch):
    rng = np.random.default_rng(4)
    z = np.convolve(rng.normal(size=4015), np.hanning(16), "valid") / 4
    (tmp_path / "rough.csv").write_text(
        "x_um,z_um\n" + "\n".join(f"{0.5 * i:g},{height:.6g}" for i, height in enumerate(z))
    )
    frequency = np.hypot(np.fft.fftfreq(128)[:, None], np.fft.rfftfreq(128))
    spectrum = np.fft.rfft2(rng.normal(size=(128, 128))) * np.exp(-((20 * frequency) ** 2))
    np.save(tmp_path / "map.npy", 20 * np.fft.irfft2(spectrum))
    monkeypatch.chdir("/")
    found = load(tmp_path, metal('<string name="profile" value="rough.csv"/>'))
    assert found.scatter.provenance.startswith("profile trace rough.csv")
    assert np.isclose(found.roughness, np.abs(z).mean(), rtol=0.05)
    areal = metal('<string name="height_map" value="map.npy"/><float name="spacing_um" value="20"/>')
    assert load(tmp_path, areal).scatter.provenance.startswith("height map map.npy")


@pytest.mark.parametrize(
    ("said", "field", "says"),
    [
        ((), "Ra", "looked up by Ra"),
        ((RA, '<float name="Rdq" value="0.1"/>', '<float name="gloss" value="100"/>'), "gloss", "gloss beside Rdq"),
        ((RA, '<string name="lay" value="x"/>'), "lay", "u, v, none"),
        ((RA, TURNED, '<string name="feed_marks" value="resolve"/>'), "feed_marks", "did you mean 'resolved'"),
        ((RA, '<float name="nose_radius_mm" value="0.8"/>'), "nose_radius_mm", "milled or turned"),
        ((RA, '<float name="spacing_um" value="0.8"/>'), "spacing_um", "spacing_um without height_map"),
        ((RA, '<string name="height_map" value="map.npy"/>'), "spacing_um", "found nothing"),
        (('<string name="profile" value="no.csv"/>',), "profile", "no file"),
        ((RA, '<float name="profile" value="3"/>'), "profile", "a CSV of columns x and z"),
        ((RA, '<float name="alpha" value="3"/>'), "alpha", "0.002 to 0.5"),
    ],
)
def test_what_an_author_gets_wrong_is_told(tmp_path, said, field, says):
    with pytest.raises(InputError) as caught:
        load(tmp_path, metal(*said))
    assert caught.value.field == field
    assert says in str(caught.value)
    assert "part.xml" in caught.value.where


@pytest.mark.parametrize("wavelength_nm", [365.0, 1064.0])
def test_metal_beyond_its_tabulated_constants_is_told(tmp_path, wavelength_nm):
    (tmp_path / "part.xml").write_text(
        f'<scene version="3.0.0"><shape type="rectangle">{metal(RA)}'
        '<transform name="to_world"><scale value="50"/></transform></shape></scene>'
    )
    with pytest.raises(InputError, match=f"{wavelength_nm:g} nm; allowed: 400 to 1000 nm"):
        load_scene(tmp_path / "part.xml", wavelength_nm)
    shape = {"type": "rectangle", "bsdf": {"type": "machined_metal", "Ra": 0.4}}
    with pytest.raises(InputError, match=f"{wavelength_nm:g} nm; allowed: 400 to 1000 nm"):
        scene_from_dict({"shape": shape}, wavelength_nm)


@pytest.mark.parametrize("row", ["{0}", "{0},1,2"])
def test_a_profile_with_other_columns_than_its_header_is_told(tmp_path, row):
    (tmp_path / "rough.csv").write_text("x_um,z_um\n" + "\n".join(row.format(i) for i in range(5000)))
    with pytest.raises(InputError, match="numbers in a row; allowed: two"):
        load(tmp_path, metal('<string name="profile" value="rough.csv"/>'))


def test_a_paint_cannot_be_given_twice(tmp_path):
    twice = '<float name="gloss" value="80"/><float name="alpha" value="0.02"/>'
    with pytest.raises(InputError, match="alpha beside gloss"):
        load(tmp_path, f'<bsdf type="gloss_paint" id="f">{twice}</bsdf>')


def test_a_deviation_moves_what_is_not_known_and_says_so(tmp_path):
    """Ground, Ra 0.4: factor 1.6 of alpha with the process given; share 0.1, whose odds are 0.2."""
    face = metal(RA, '<string name="process" value="ground"/>')
    best = load(tmp_path, face).scatter
    up = load(tmp_path, face, deviation=Deviation(alpha=1, wide_angle=-1)).scatter
    assert np.isclose(up.alpha_u / best.alpha_u, 1.6) and np.isclose(up.wide_angle, best.wide_angle_range[0])
    assert up.provenance == best.provenance + "; alpha +1 and wide angle -1 sigma"
    assert (up.alpha_factor, up.wide_angle_range) == (best.alpha_factor, best.wide_angle_range)
    assert up.energy_factor != best.energy_factor
    half = load(tmp_path, face, deviation=Deviation(wide_angle=0.5)).scatter
    odds = [share / (0.6 - share) for share in (best.wide_angle, half.wide_angle, best.wide_angle_range[1])]
    assert np.isclose(odds[1], math.sqrt(odds[0] * odds[2]))
    assert half.alpha_u == best.alpha_u
    far = load(tmp_path, face, deviation=Deviation(3, 3)).scatter
    assert far.alpha_u == 0.5 and best.wide_angle_range[1] < far.wide_angle < 0.6


def test_the_tail_moves_between_ggx_and_beckmann(tmp_path):
    face = metal(RA, '<string name="process" value="ground"/>')

    def tail(sigma):
        return load(tmp_path, face, deviation=Deviation(tail=sigma)).scatter.beckmann

    best = load(tmp_path, face).scatter
    assert best.beckmann_range == (tail(-1), tail(1)) and tail(0) == best.beckmann
    assert (tail(-3), tail(3)) == (0.0, 1.0)
    assert best.beckmann < tail(0.5) < tail(1) < tail(2) < 1


def test_a_lay_that_is_not_given_is_drawn_and_no_other(tmp_path):
    """The marks keep alpha across them; along them it is that of the process times the factor of the strength."""
    ground = '<string name="process" value="ground"/>'
    best = load(tmp_path, metal(RA, ground)).scatter
    found = load(tmp_path, metal(RA, ground), deviation=Deviation(lay_deg=30.0)).scatter
    assert (found.alpha_v, found.turn_deg) == (best.alpha_u, 30.0)
    assert found.alpha_u == pytest.approx(PROCESSES["ground"].lay_ratio * best.alpha_u)
    weaker = load(tmp_path, metal(RA, ground), deviation=Deviation(lay=1.0, lay_deg=30.0)).scatter
    assert weaker.alpha_u / found.alpha_u == pytest.approx(LAY_FACTOR)
    none = load(tmp_path, metal(RA, ground), deviation=Deviation(lay=3.0, lay_deg=30.0)).scatter
    assert none.alpha_u == none.alpha_v
    for given in (
        '<string name="lay" value="u"/>',
        '<string name="lay" value="none"/>',
        '<float name="alpha" value=".1"/>',
    ):
        face = metal(RA, ground, given)
        assert load(tmp_path, face, deviation=Deviation(lay_deg=30.0)).scatter == load(tmp_path, face).scatter
    polished = metal('<float name="Ra" value="0.05"/>', '<string name="process" value="polished"/>')
    assert load(tmp_path, polished, deviation=Deviation(lay_deg=30.0)).scatter.turn_deg is None


def test_drawn_finishes_have_the_same_parts():
    """A BSDF whose numbers are drawn keeps its structure, down to shares of nothing."""

    def parts(description):
        return {key: parts(value) if isinstance(value, dict) else None for key, value in description.items()}

    rng, seen = np.random.default_rng(1), []
    for process in ("ground", "polished", "grit_blasted"):
        face = MachinedFace("aluminium", process, 0.05)
        for numbers in (*rng.uniform(-3, 3, (6, 5)), np.full(5, -3.0), np.full(5, 3.0)):
            scatter = machined(face, 850.0, deviation=Deviation(*numbers.tolist(), lay_deg=20.0))
            seen.append(str(parts(metal_bsdf(refractive_index("aluminium", 850.0), scatter))))
        assert len(set(seen)) == 1
        seen.clear()


@pytest.mark.parametrize(
    "bsdf",
    [
        metal(RA, '<float name="alpha" value="0.1"/>', '<float name="wide_angle_share" value="0.05"/>'),
        '<bsdf type="matt_white" id="f"/>',
        '<bsdf type="gloss_paint" id="f"><float name="alpha" value="0.02"/></bsdf>',
    ],
)
@pytest.mark.parametrize("deviation", [Deviation(1, 1), Deviation(lay=1.0, lay_deg=30.0)])
def test_a_deviation_leaves_alone_what_is_known(tmp_path, bsdf, deviation):
    moved = load(tmp_path, bsdf, deviation=deviation).scatter
    assert repr(moved) == repr(load(tmp_path, bsdf).scatter)


def test_a_paint_moves_within_what_its_coat_can_have(tmp_path):
    """Gloss not given: a factor 1.6; more of the light stays at the surface of a coat with a narrower lobe, or less."""
    best = load(tmp_path, '<bsdf type="powder_coat" id="f"/>').scatter
    up = load(tmp_path, '<bsdf type="powder_coat" id="f"/>', deviation=Deviation(alpha=1)).scatter
    assert np.isclose(up.alpha_u, 1.6 * best.alpha_u)
    assert up.wide_angle != best.wide_angle
    dull = '<bsdf type="gloss_paint" id="f"><float name="gloss" value="12"/></bsdf>'
    assert load(tmp_path, dull, deviation=Deviation(alpha=3)).scatter.alpha_u == ALPHA_RANGE["gloss_paint"][1]


@pytest.mark.parametrize(
    ("bsdf", "most"),
    [
        (metal(RA), 1.05),
        (metal('<float name="Ra" value="0.09"/>'), 1.05),
        ('<bsdf type="matt_white" id="f"/>', 1.05),
        ('<bsdf type="matt_white" id="f"><float name="reflectance" value="0.97"/></bsdf>', 0.99 / 0.97),
    ],
)
def test_reflectance_scales_all_light_alike_and_stays_below_one(tmp_path, bsdf, most):
    mi, dr = backend.mi, backend.dr

    def seen(deviation):
        file = tmp_path / "part.xml"
        file.write_text(
            f'<scene version="3.0.0"><shape type="rectangle" id="face">{bsdf}'
            '<transform name="to_world"><scale value="30"/></transform></shape></scene>'
        )
        scene = load_scene(file, 850, deviation=deviation).mitsuba
        surface = scene.ray_intersect(mi.Ray3f(mi.Point3f(3, 4, 100), mi.Vector3f(0, 0, -1)))
        towards = mi.Vector3f([0.0, 0.3, 0.7], 0.0, dr.sqrt(1 - dr.square(mi.Float([0.0, 0.3, 0.7]))))
        return np.ravel(np.array(surface.bsdf().eval(mi.BSDFContext(), surface, towards)))

    ratio = seen(Deviation(reflectance=1)) / seen(NOMINAL)
    assert ratio == pytest.approx(most, rel=1e-5)
    assert seen(Deviation(reflectance=-1)) / seen(NOMINAL) == pytest.approx(1 / 1.05, rel=1e-5)


def test_a_deviation_is_written_as_on_a_command_line():
    assert Deviation.parse(" alpha=1, wide_angle = -1.5 ") == Deviation(1.0, -1.5)
    assert Deviation.parse("") == NOMINAL
    assert Deviation.parse("tail=-1, lay=0.5, lay_deg=120") == Deviation(tail=-1.0, lay=0.5, lay_deg=120.0)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("alfa=1", "did you mean 'alpha'"),
        ("alpha", "write alpha=1"),
        ("alpha=much", "found 'much'"),
        ("alpha=4", "-3 to 3"),
        ("alpha=nan", "-3 to 3"),
        ("alpha=1,alpha=2", "two values"),
        ("lay_deg=181", "0 to 180"),
    ],
)
def test_a_deviation_that_is_none_is_told(text, says):
    with pytest.raises(InputError, match="--deviation") as caught:
        Deviation.parse(text)
    assert says in str(caught.value)
