r"""What a matcher makes of a glossy face in which another surface is mirrored: points at the mirror image.

Signal chain: ideal points of a view -> the mirrored view rays, how far it is along them to the next surface, L,
and how the face bends them -> depth s' of the mirror image behind the face -> with rho, the light that
comes by way of other surfaces over direct light, and what the face's roughness leaves of the image's contrast -> how
far a point is displaced along its ray in the mean.

Two cameras that look at a mirror see what is mirrored, and triangulate its image. On two directions u_1 along the
baseline and u_2, both across the view ray d and each other, light from a distance L has after the mirror, at angle of
incidence theta, the vergences (Coddington's equations as a matrix: Born and Wolf, Principles of Optics, 4.6)

    W_ij = delta_ij / L + 2 cos(theta) II(p_i, p_j),      p_i = u_i - (u_i.N / d.N) d

p_i is the step on the face over which a ray moves by u_i, and II the face's second fundamental form, positive where it
is convex: 2 kappa / cos(theta) in the plane of incidence, 2 kappa cos(theta) across it. A ray that passes the mirror x
aside is turned by W x, and passes the eye, |V| away, by (1 + |V| W) x aside. So an eye that stands aside along u_1 sees
the image turned by the share u_1.W (1 + |V| W)^-1 u_1 of its step, and both rays meet behind the face at

    s' = 1 / [u_1.W (1 + |V| W)^-1 u_1] - |V| = 1 / [W_11 - |V| W_12^2 / (1 + |V| W_22)]

A pillar across the baseline shows a plate that stands before it within half its radius behind its own skin, so near
that the matcher's answer is smooth, and a robust fit takes it for the pillar.

A rough face spreads the mirrored rays, by sqrt(2) alpha for slopes of rms alpha / sqrt(2) each way, so the image is
blurred by w = sqrt(2) alpha s' in its own place, and a random pattern of runs about l long keeps

    C = 1 / (1 + (w / l)^2)

of its contrast. In the mean over the points that are found, a point is displaced along its ray by

    b = s' MOST k^2 / (k^2 + k_0^2),      k = rho C

The projector has a mirror image too, the glint. Where it is brighter than the imager can tell, the pattern is gone and
only the glint's own edges match: b = s' there, in the share of the points about it by which it fills their window.

``MOST``, k_0, l and ``GLINT`` were read off the rendered two-pillar artefact, seen by ``ensenso-n10``: the first three
in Ra 0.37, 0.46 and 0.74 from 16 views each, the last in Ra 0.46. A code in phase does not match: what it makes of two
codes in one pixel is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from mitsim.predict.predictor import Ideal, Predictor
from mitsim.scene.load import Scene
from mitsim.scene.reflections import reflections
from mitsim.sensor.frames import Transform

Floats = NDArray[np.float64]

#: k at which half of the largest displacement is reached, the largest one over s', and l in pixels
HALF_PULLED, MOST, RUN_PX = 2.0, 1.5, 3.3

#: a point follows the glint if this much of the square window about it, so many pixels each way, is full
GLINT, WINDOW_PX = 0.5, 5

#: a glint whose image lies farther than so many pixels' width behind the face is no point of it
GLINT_NEAR_PX = 20


@dataclass(frozen=True)
class Images:
    """Depths s' [mm] behind each ideal point, along its view ray, of what two eyes on the baseline see mirrored, (n,).

    ``surface`` of the next surface along the mirrored ray, ``lamp`` of the projector. NaN where nothing is mirrored, at
    the rim of a face, and where a hollow face shows it before itself or nowhere.
    """

    surface: Floats
    lamp: Floats


def mirror_images(predictor: Predictor, scene: Scene, world_from_sensor: Transform, ideal: Ideal) -> Images:
    """Where the mirror images are that a view shows."""
    found = reflections(scene, predictor.rays, world_from_sensor, predictor.rig.baseline_direction)
    power, length = found.power.reshape(3, -1)[:, ideal.pixel], found.distance.ravel()[ideal.pixel]
    lamp = np.full(len(length), np.nan)
    if predictor.rig.projector is not None:
        lamp = np.linalg.norm(ideal.point - predictor.rig.projector.centre, axis=1)
    return Images(*(_depth(power, np.where(np.isfinite(one), one, np.nan), ideal.distance) for one in (length, lamp)))


def _depth(power: Floats, length: Floats, distance: Floats) -> Floats:
    """Depth s' (n,) from the mirror's part of W_11, W_12 and W_22, (3, n), and the distances L and |V| (n,)."""
    w_11, w_12, w_22 = power[0] + 1 / length, power[1], power[2] + 1 / length
    with np.errstate(invalid="ignore", divide="ignore"):
        turned = w_11 - distance * w_12**2 / (1 + distance * w_22)
        return np.where(turned > 0, 1 / turned, np.nan)


def glint_share(
    images: Images, rho: Floats, ideal: Ideal, size: tuple[int, ...], pixel_mm: Floats, step: int
) -> Floats:
    """Share (n,) of points that lie at the mirror image of the projector, for the imager is full about them.

    ``rho`` is inf where the imager is full; ``size`` of the grid, of which ``step`` pixels of the sensor make one;
    ``pixel_mm`` what a pixel of the sensor spans at each point [mm].
    """
    full = np.zeros(size)
    full.reshape(-1)[ideal.pixel] = np.isinf(rho)
    about = uniform_filter(full, 2 * math.ceil(WINDOW_PX / step) + 1, mode="constant").reshape(-1)[ideal.pixel]
    with np.errstate(invalid="ignore"):
        return np.where(images.lamp < GLINT_NEAR_PX * pixel_mm, np.minimum(about / GLINT, 1.0), 0.0)


def displacement(images: Images, rho: Floats, alpha: Floats, pixel_mm: Floats, glint: Floats) -> Floats:
    """Mean displacement b (n,) [mm] along the ray, away from the sensor; 0 where nothing is mirrored.

    ``alpha`` of the face, NaN for one that mirrors nothing; ``glint`` of :func:`glint_share`.
    """
    blur = np.sqrt(2) * alpha * images.surface / pixel_mm
    with np.errstate(invalid="ignore", over="ignore"):
        k = np.minimum(rho, 1e6) / (1 + (blur / RUN_PX) ** 2)
        pulled = images.surface * MOST * k**2 / (k**2 + HALF_PULLED**2)
    return np.asarray(np.nan_to_num(pulled) * (1 - glint) + np.where(glint > 0, images.lamp, 0.0) * glint)
