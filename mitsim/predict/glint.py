r"""What a matcher makes of the glint on a curved glossy face: points at the mirror image of the projector.

Signal chain: ideal points of a view -> how the face bends mirrored rays -> depth s' of the projector's mirror image
behind the face, and by how much the face's roughness blurs it -> share of points that lie there, where the light is
brightest -> what smoothing carries of that depth to the points beside.

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
slopes of rms alpha / sqrt(2) each way, so the glint is w = sqrt(2) alpha s' wide. A narrow one has more of an edge than
the pattern that is projected on it, and is matched instead of it; of a broad one only the pattern has edges. Of the
points where the light is as bright as the imager can tell in its shortest exposure

    g = MOST_TAKEN Phi((SHARP_PX - w) / SHARP_SPREAD_PX)

lie at s'. Beside it points are found on the face, but the smoothing of the matcher carries some of s' to them, at d
pixels

    b = CARRIED s' exp(-(d / CARRIED_PX)^2) g / MOST_TAKEN

with s' and g of the glint, and from view to view CARRIED_SPREAD b more or less.
A fit that leaves out the glint still finds the pillar too flat, and so too thick.

The constants were read off the rendered two-pillar artefact, seen by ``ensenso-n10`` in Ra 0.09, 0.37, 0.46 and 0.74,
of some 10 000 points in glints and as many beside them. Other surfaces that a face mirrors leave no such points: where
they are as bright as direct light, points more than 15 px from a glint lie on the face, if they come back
(:mod:`mitsim.predict.interreflection`). A code in phase does not match, and knows no glint but as a loss of points.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, uniform_filter
from scipy.special import ndtr

from mitsim.predict.predictor import Ideal, Predictor
from mitsim.scene.load import Scene
from mitsim.scene.reflections import reflections
from mitsim.sensor.frames import Transform

Floats = NDArray[np.float64]

#: share of points that a sharp glint takes, the width at which it takes half of that, and how fast that goes, in pixels
MOST_TAKEN, SHARP_PX, SHARP_SPREAD_PX = 0.85, 4.6, 0.9

#: what smoothing carries of a sharp glint's depth to points beside it, at most, and how far in pixels
CARRIED, CARRIED_PX = 0.18, 10.5

#: standard deviation of what is carried, from view to view, over its mean
CARRIED_SPREAD = 0.8

#: a point follows the glint if this much of the square window about it, so many pixels each way, is bright
GLINT, WINDOW_PX = 0.5, 5

#: a glint whose image lies farther than so many pixels' width behind the face is no point of it
GLINT_NEAR_PX = 20


def lamp_depth(predictor: Predictor, scene: Scene, world_from_sensor: Transform, ideal: Ideal) -> Floats:
    """Depth s' (n,) [mm] behind each ideal point, along its view ray, of the projector's mirror image.

    NaN at the rim of a face, where a hollow face shows it before itself or nowhere, and for a sensor without one.
    """
    if predictor.rig.projector is None:
        return np.full(len(ideal.point), np.nan)
    found = reflections(scene, predictor.rays, world_from_sensor, predictor.rig.baseline_direction)
    length = np.linalg.norm(ideal.point - predictor.rig.projector.centre, axis=1)
    return image_depth(found.power.reshape(3, -1)[:, ideal.pixel], length, ideal.distance)


def image_depth(power: Floats, length: Floats, distance: Floats) -> Floats:
    """Depth s' (n,) from the mirror's part of W_11, W_12 and W_22, (3, n), and the distances L and |V| (n,)."""
    w_11, w_12, w_22 = power[0] + 1 / length, power[1], power[2] + 1 / length
    with np.errstate(invalid="ignore", divide="ignore"):
        turned = w_11 - distance * w_12**2 / (1 + distance * w_22)
        return np.where(turned > 0, 1 / turned, np.nan)


def glint(
    lamp: Floats, full: NDArray[np.bool_], alpha: Floats, ideal: Ideal, size: tuple[int, ...], pixel_mm: Floats,
    step: int,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Share (n,) of points that lie at the mirror image of the projector, and what it displaces the others by [mm].

    ``lamp`` s' and ``alpha`` of the face, NaN for one that mirrors nothing; ``full`` (n,) where the imager is; ``size``
    of the grid, of which ``step`` pixels of the sensor make one; ``pixel_mm`` what one of them spans at each point.
    """
    with np.errstate(invalid="ignore"):
        near = (lamp < GLINT_NEAR_PX * pixel_mm) & np.isfinite(alpha)
    bright = np.zeros(size, bool)
    bright.reshape(-1)[ideal.pixel] = full & near
    if not bright.any():
        return np.zeros(len(lamp)), np.zeros(len(lamp))
    sharp = ndtr((SHARP_PX - math.sqrt(2) * alpha * lamp / pixel_mm) / SHARP_SPREAD_PX)
    window = 2 * math.ceil(WINDOW_PX / step) + 1
    about = uniform_filter(bright.astype(float), window, mode="constant").reshape(-1)[ideal.pixel]
    taken = np.where(near, MOST_TAKEN * sharp * np.minimum(about / GLINT, 1.0), 0.0)
    away, place = distance_transform_edt(~bright, return_indices=True)
    row_of = np.zeros(bright.size, np.int64)
    row_of[ideal.pixel] = np.arange(len(lamp))
    nearest = row_of[np.ravel_multi_index(tuple(place), size).reshape(-1)[ideal.pixel]]
    reach = np.exp(-((away.reshape(-1)[ideal.pixel] * step / CARRIED_PX) ** 2))
    carried = np.where(ideal.shape == ideal.shape[nearest], CARRIED * sharp[nearest] * lamp[nearest] * reach, 0.0)
    return taken, carried
