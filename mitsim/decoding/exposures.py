"""Merge a bracket of exposures into images with a high dynamic range.

Signal chain: grey levels of each exposure -> linear response without black level -> weighted mean rate of the
unsaturated exposures -> grey levels of the shortest exposure -> 16 bits -> for matchers their logarithm.

Let x_e be the signal of exposure t_e, and R the rate to estimate. The mean of x_e is R t_e, and its variance by shot
noise is proportional to R t_e. The unbiased average of the x_e / t_e with the least variance has the weights 1 / var,
which are proportional to t_e:

    R = sum_e x_e / sum_e t_e,        var(R) = sum_e var(x_e) / (sum_e t_e)^2

It is also the maximum-likelihood estimate of a Poisson rate. Inverse-variance weights for brackets are those of
Hasinoff, Durand and Freeman, CVPR 2010. Noise of equal size at every exposure would give the weights t_e^2 of
Robertson, Borman and Stevenson, ICIP 1999. Where read noise dominates and the exposures are 1 : 4 : 16, the sum used
here is 1.36 times as noisy.

An abrupt exclusion at saturation would keep the pixels whose noise is low by chance, and so bias the mean. For every
exposure but the shortest, the weight therefore falls from 1 to 0 between two levels below full scale. The certainty of
Robertson et al. does the same. With a full well of 20 000 e- the remaining bias is below 0.1 % of the signal. A pixel
that is saturated in the shortest exposure is saturated in the result.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError

#: linear levels, relative to the range from black to full scale, between which the weight of a longer exposure falls to
#: 0
_FADE = (0.8, 0.95)


#: signal under which a companded level is nearly linear, relative to full scale of the longest exposure; chosen: the
#: 8 bits of a matcher then resolve faint pixels as finely as those of the longest exposure, and bright ones by ratios
_COMPANDED_LINEAR = 1 / 16

#: level of saturation of merged images [merged DN]
MERGED_FULL_SCALE = 65535


def merge_exposures(
    stack: NDArray[np.uint8] | NDArray[np.uint16],
    exposures_s: NDArray[np.floating] | tuple[float, ...] | list[float],
    black_level: float,
    full_scale: int,
    gamma: float = 1.0,
) -> NDArray[np.uint16]:
    """Return images (P, H, W) [merged DN] merged from exposures, with the linear response of the shortest one.

    A pixel that is saturated in the shortest exposure has :data:`MERGED_FULL_SCALE`. The level without light is in the
    same ratio to it as ``black_level`` to ``full_scale``.

    ``stack``: (E, P, H, W) grey levels [DN] of E exposures of P images, uint8 or uint16. ``exposures_s``: (E,)
    exposures [s] in any order, over 0. ``black_level``, ``full_scale``: level without light and largest level [DN]; a
    pixel at full scale is saturated. ``gamma``: exponent of the imager's response curve [1], which is undone first.
    Raises InputError if the stack has another shape or type, the exposures do not fit it, or a level or gamma is not
    allowed.
    """
    if stack.ndim != 4 or stack.dtype not in (np.uint8, np.uint16) or len(stack) == 0:
        found = f"{stack.dtype} of shape {stack.shape}"
        raise InputError("exposures", "stack", found, "uint8 or uint16 of shape (exposures, images, rows, columns)")
    times = np.asarray(exposures_s, float)
    if times.shape != (len(stack),) or not bool(np.all((times > 0) & np.isfinite(times))):
        raise InputError("exposures", "exposures_s", times.tolist(), f"{len(stack)} of them, each over 0 s")
    largest = int(np.iinfo(stack.dtype).max)
    if not 1 <= full_scale <= largest:
        raise InputError("exposures", "full_scale", full_scale, f"1 to {largest} DN")
    if not 0 <= black_level < full_scale:
        raise InputError("exposures", "black_level", black_level, f"0 to under full_scale, {full_scale} DN")
    if not 0 < gamma < np.inf:
        raise InputError("exposures", "gamma", gamma, "over 0")

    shortest = int(np.argmin(times))
    signal, weight = _tables(largest, black_level, full_scale, gamma)
    black = black_level * MERGED_FULL_SCALE / full_scale
    scale = (MERGED_FULL_SCALE - black) / (full_scale - black_level)
    levels = np.empty(stack.shape[1:], np.uint16)
    weighted = weight * signal
    for image in range(stack.shape[1]):
        weighted_sum, weight_sum = signal[stack[shortest, image]], np.full(stack.shape[2:], times[shortest], np.float32)
        for exposure in range(len(stack)):
            if exposure != shortest:
                weighted_sum += weighted[stack[exposure, image]]
                weight_sum += (weight * np.float32(times[exposure]))[stack[exposure, image]]
        weighted_sum *= np.float32(times[shortest] * scale)
        weighted_sum /= weight_sum
        weighted_sum += np.float32(black)
        np.rint(weighted_sum, out=weighted_sum)
        np.clip(weighted_sum, 0, MERGED_FULL_SCALE, out=weighted_sum)
        levels[image] = weighted_sum
        levels[image][stack[shortest, image] >= full_scale] = MERGED_FULL_SCALE
    return levels


def companded(levels: NDArray[np.uint16], black_level: float, share: float) -> NDArray[np.uint16]:
    """Return merged images [merged DN] with the logarithm of the signal, for matchers of 8 bits.

    Merged levels are those of the shortest exposure. In 8 bits the faint pixels, for which the longest is taken, would
    have a few levels. A match needs no absolute levels: both cameras have the same curve.

    ``black_level`` is the level without light [merged DN], ``share`` the shortest over the longest exposure [1].
    """
    signal = (np.arange(MERGED_FULL_SCALE + 1) - black_level) / (MERGED_FULL_SCALE - black_level) / share
    logarithm = np.log1p(np.maximum(signal / _COMPANDED_LINEAR, -0.5))
    relative = (logarithm - logarithm[0]) / (logarithm[-1] - logarithm[0])
    table = np.rint(MERGED_FULL_SCALE * relative).astype(np.uint16)
    return np.asarray(table[levels])


def _tables(
    largest: int, black_level: float, full_scale: int, gamma: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the linear signal [DN] and the weight [1] of each grey level 0 .. ``largest``."""
    relative = (np.arange(largest + 1) - black_level) / (full_scale - black_level)
    # a linear response extends below black; a curved one is 0 there
    linear = relative if gamma == 1.0 else np.maximum(relative, 0) ** gamma
    begin, end = _FADE
    weight = np.clip((end - linear) / (end - begin), 0, 1)
    return ((full_scale - black_level) * linear).astype(np.float32), weight.astype(np.float32)
