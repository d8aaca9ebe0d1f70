r"""What a matcher makes of mirror images on a curved glossy face: of the projector, a glint, and of other surfaces.

Signal chain: ideal points of a view -> how the face bends mirrored rays -> depth s' of the projector's mirror image
behind the face, and by how much the face's roughness blurs it -> share of points that lie there, where the light is
brightest -> what smoothing carries of that depth to the points beside, and what is mirrored of other surfaces.

Two cameras that look at a mirror see what is mirrored, and triangulate its image. On two directions u_1 along the
baseline and u_2, both across the view ray d and each other, light from a distance L has after the mirror, at angle of
incidence theta, the vergences (Coddington's equations as a matrix: Born and Wolf, Principles of Optics, 4.6)

    W_ij = delta_ij / L + 2 cos(theta) II(p_i, p_j),      p_i = u_i - (u_i.N / d.N) d

p_i is the step on the face over which a ray moves by u_i, and II the face's second fundamental form, positive where it
is convex: 2 kappa / cos(theta) in the plane of incidence, 2 kappa cos(theta) across it. A ray that passes the mirror x
aside is turned by W x, and passes the eye, |V| away, by (1 + |V| W) x aside. So an eye that stands aside along u_1 sees
the image turned by the share u_1.W (1 + |V| W)^-1 u_1 of its step, and both rays meet behind the face at

    s' = 1 / [u_1.W (1 + |V| W)^-1 u_1] - |V| = 1 / [W_11 - |V| W_12^2 / (1 + |V| W_22)]

In a pillar across the baseline that is half its radius. A rough face spreads the mirrored rays, by sqrt(2) alpha for
slopes of rms alpha / sqrt(2) each way, so what is mirrored is blurred over w = sqrt(2) alpha s'.

**The glint**, the projector itself. A narrow one has more of an edge than the pattern that is projected on it, and is
matched instead of it, where it is brighter than the imager can tell in its shortest exposure. With B the direct light
at the middle of it over that, d pixels away, the share

    g = MOST_TAKEN Phi((SHARP_PX - w) / SHARP_SPREAD_PX) Phi(ln(B / BRIGHT) / BRIGHT_SPREAD)

of the points in it lie at s', and half of that at REACH_PX. Of those that do not, the smoothing of the matcher moves
all toward it, by b = CARRIED s' exp(-d / CARRIED_PX) times the root of the first Phi and the second.

**Other surfaces** are mirrored with the pattern on them. On a face that is curved along the baseline theirs lies s'
behind it, and is found with it, at

    b = s' q / (1 + q),     q = PULLED exp(-(w / BLUR_PX)^2) m

m is the light by way of other surfaces over direct light, rho, as both eyes see it: the second one sees what is
mirrored s' / |V| of the baseline farther along it, and m is the geometric mean of rho here and there. A fit that knows
nothing of it finds the pillar too flat, and so too thick. A face that mirrors as a plane does shows its surroundings
far behind itself, where they are no match for it; one that is curved across the baseline alone blurs them.

From view to view b is CARRIED_SPREAD b more or less. The constants were read off the rendered two-pillar artefact, seen
by ``ensenso-n10`` in Ra 0.37, 0.46 and 0.74 with the baseline across the pillars, of some 60 000 points. b / s' was
0.07, 0.13, 0.18, 0.23, 0.29 and 0.32 at m = 0.8, 1.7, 2.4, 3.4, 4.9 and 7.3 in Ra 0.37 (w of 2.5 px), 0.06, 0.12, 0.16,
0.21, 0.24 and 0.29 in Ra 0.46 (3.0 px), and 0.02, 0.05, 0.07, 0.09, 0.12 and 0.17 in Ra 0.74 (4.5 px). Beside glints
of B over 2 it was 0.36, 0.28, 0.19, 0.12, 0.09 and 0.08 at 1.5, 4.5, 7.5, 10.5, 13.5 and 16.5 px in Ra 0.46. A code in
phase does not match, and knows no glint but as a loss of points.

Left out: a face whose other side is a pillar at the same height, which shows its pattern sharply and pulls two to five
times as much; and in Ra 0.09, where little but the glint is lit, that points 15 px from it are lost as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter1d
from scipy.special import ndtr

from mitsim.predict.predictor import Ideal, Predictor
from mitsim.scene.load import Scene
from mitsim.scene.reflections import reflections
from mitsim.sensor.frames import Transform

Floats = NDArray[np.float64]

#: share of points that a sharp and bright glint takes in its middle, the width at which it takes half of that, and how
#: fast that goes, in pixels
MOST_TAKEN, SHARP_PX, SHARP_SPREAD_PX = 0.98, 3.2, 0.55

#: direct light in the middle of a glint, over what fills the imager, at which half of that is taken; spread of its log
BRIGHT, BRIGHT_SPREAD = 1.3, 0.5

#: how far from its middle half of that is taken, and how fast that goes, in pixels
REACH_PX, REACH_SPREAD_PX = 7.5, 2.5

#: what smoothing carries of a sharp glint's depth to points in it and beside it, and how far in pixels
CARRIED, CARRIED_PX = 0.42, 9.0

#: by how much the image of other surfaces pulls points, and by how many pixels' blur it pulls 1/e of that
PULLED, BLUR_PX = 0.15, 3.65

#: standard deviation of what points are carried or pulled by, from view to view, over its mean
CARRIED_SPREAD = 0.8

#: the middle of a glint has this share of the most light within so many pixels along the epipolar line, and at least so
#: much over full
MIDDLE, MIDDLE_PX, LEAST_BRIGHT = 0.8, 25, 0.2

#: a mirror image that lies farther than so many pixels' width behind the face is not found with the face
NEAR_PX = 20


@dataclass(frozen=True)
class LampImage:
    """Where the projector's mirror image is found behind n ideal points, along their view rays [mm].

    ``depth`` s' (n,) by two eyes on the baseline, and ``across`` (n,) by two across it. NaN at the rim of a face, where
    a hollow face shows it before itself or nowhere, and for a sensor without projector.
    """

    depth: Floats
    across: Floats


def lamp_image(predictor: Predictor, scene: Scene, world_from_sensor: Transform, ideal: Ideal) -> LampImage:
    """The projector in every face of a view."""
    if predictor.rig.projector is None:
        return LampImage(*np.full((2, len(ideal.point)), np.nan))
    found = reflections(scene, predictor.rays, world_from_sensor, predictor.rig.baseline_direction)
    length = np.linalg.norm(ideal.point - predictor.rig.projector.centre, axis=1)
    power = found.power.reshape(3, -1)[:, ideal.pixel]
    return LampImage(*(image_depth(one, length, ideal.distance) for one in (power, power[::-1])))


def image_depth(power: Floats, length: Floats, distance: Floats) -> Floats:
    """Depth s' (n,) from the mirror's part of W_11, W_12 and W_22, (3, n), and the distances L and |V| (n,)."""
    w_11, w_12, w_22 = power[0] + 1 / length, power[1], power[2] + 1 / length
    with np.errstate(invalid="ignore", divide="ignore"):
        turned = w_11 - distance * w_12**2 / (1 + distance * w_22)
        return np.where(turned > 0, 1 / turned, np.nan)


def stands_near(depth: Floats, pixel_mm: Floats) -> NDArray[np.bool_]:
    """Whether mirror images at a ``depth`` (n,) [mm] are found with the face; not where there is none."""
    return np.asarray(depth < NEAR_PX * pixel_mm)


def blur(depth: Floats, alpha: Floats, pixel_mm: Floats) -> Floats:
    """Width w (n,) [px] over which a face of roughness ``alpha`` (n,) blurs what it shows at a ``depth`` [mm]."""
    return np.asarray(math.sqrt(2) * alpha * depth / pixel_mm)


def drawn_to_image(depth: Floats, alpha: Floats, pixel_mm: Floats, ratio: Floats) -> Floats:
    """Depth b (n,) [mm] to which the image of other surfaces at ``depth`` s' pulls points; 0 where it is not near.

    ``ratio`` m (n,), ``alpha`` NaN of a face that mirrors nothing; ``pixel_mm`` is what a pixel spans at each point.
    """
    with np.errstate(invalid="ignore"):
        q = PULLED * np.exp(-((blur(depth, alpha, pixel_mm) / BLUR_PX) ** 2)) * np.nan_to_num(ratio, posinf=1e9)
        return np.asarray(np.where(stands_near(depth, pixel_mm) & np.isfinite(q), depth * q / (1 + q), 0.0))


def glint(
    lamp: Floats, direct: Floats, alpha: Floats, ideal: Ideal, size: tuple[int, ...], pixel_mm: Floats, step: int,
    epipolar_axis: int = 1,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Share (n,) of points that lie at the mirror image of the projector, and what it displaces the others by [mm].

    ``lamp`` s' and ``alpha`` of the face, NaN for one that mirrors nothing; ``direct`` light (n,) over what fills the
    imager; ``size`` of the grid, of which ``step`` pixels of the sensor make one; ``pixel_mm`` what one of them spans;
    ``epipolar_axis`` of the image, along which disparities are.
    """
    near = stands_near(lamp, pixel_mm) & np.isfinite(alpha)
    light = np.zeros(size)
    light.reshape(-1)[ideal.pixel] = np.where(near, direct, 0.0)
    most = maximum_filter1d(light, 2 * math.ceil(MIDDLE_PX / step) + 1, axis=epipolar_axis)
    middle = (light > MIDDLE * most) & (light > LEAST_BRIGHT)
    if not middle.any():
        return np.zeros(len(lamp)), np.zeros(len(lamp))
    outside, place = distance_transform_edt(~middle, return_indices=True)
    away = step * outside.reshape(-1)[ideal.pixel]
    row_of = np.zeros(middle.size, np.int64)
    row_of[ideal.pixel] = np.arange(len(lamp))
    nearest = row_of[np.ravel_multi_index(tuple(place), size).reshape(-1)[ideal.pixel]]
    narrow = ndtr((SHARP_PX - blur(lamp, alpha, pixel_mm)[nearest]) / SHARP_SPREAD_PX)
    bright = ndtr(np.log(direct[nearest] / BRIGHT) / BRIGHT_SPREAD)
    own = ideal.shape == ideal.shape[nearest]
    taken = np.where(own, MOST_TAKEN * narrow * bright * ndtr((REACH_PX - away) / REACH_SPREAD_PX), 0.0)
    carried = CARRIED * lamp[nearest] * np.exp(-away / CARRIED_PX) * np.sqrt(narrow) * bright
    return taken, np.where(own, carried, 0.0)
