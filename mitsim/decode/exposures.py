"""Merge a bracket of exposures into images of a greater range.

Signal chain: grey levels of each exposure -> straight response, black level off -> weighted sum over the exposures that
are not saturated -> electrons per second, in the grey levels of the shortest exposure -> 16 bits.

With x_e the signal of exposure t_e and R the wanted rate, x_e has mean R t_e and, from shot noise, a variance in
proportion to R t_e. The unbiased average of the x_e / t_e with the least variance weights them by 1 / var, that is t_e:

    R = sum_e x_e / sum_e t_e,        var(R) = sum_e var(x_e) / (sum_e t_e)^2

which is also the maximum-likelihood estimate of a Poisson rate. (Inverse-variance weights for brackets: Hasinoff,
Durand & Freeman, CVPR 2010. Noise of the same size at every exposure would give t_e^2, the weights of Robertson, Borman
& Stevenson, ICIP 1999: where read noise dominates, and the exposures are 1 : 4 : 16, our sum is 1.36 times as noisy.)

To drop an exposure the moment it saturates would keep the pixels whose noise happened to be low: a bias. So the weight
of all but the shortest exposure falls from 1 to 0 between two levels short of full scale, as the certainty of Robertson
et al. does; with a full well of 20 000 e- what bias is left is under 0.1 % of the signal. A pixel that is saturated in
the shortest exposure is saturated in all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.errors import InputError

#: shares of the range between black and full scale over which a longer exposure is faded out
_FADE = (0.8, 0.95)


@dataclass(frozen=True)
class MergedExposures:
    """Images of a linear 16-bit scale that ends where the shortest exposure saturates.

    ``levels`` (P, H, W) [merged DN]; ``saturated`` (P, H, W), shown as ``full_scale`` in ``levels``; ``black_level``
    [merged DN], to be taken off; ``full_scale`` [merged DN]; ``scale`` merged DN in a grey level of the shortest
    exposure's straight response; ``exposure_s`` of the shortest [s], which the levels belong to.
    """

    levels: NDArray[np.uint16]
    saturated: NDArray[np.bool_]
    black_level: float
    full_scale: int
    scale: float
    exposure_s: float


def merge_exposures(
    stack: NDArray[np.uint8] | NDArray[np.uint16],
    exposures_s: NDArray[np.floating] | tuple[float, ...] | list[float],
    black_level: float,
    full_scale: int,
    gamma: float = 1.0,
) -> MergedExposures:
    """Merge exposures of the same images.

    Parameters
    ----------
    stack
        (E, P, H, W) grey levels [DN] of E exposures of P images, uint8 or uint16.
    exposures_s
        (E,) exposures [s], in any order, over 0.
    black_level, full_scale
        Level of no light and largest level [DN]; a pixel at full scale is saturated.
    gamma
        Of the imager's response curve [1]: undone before the merging.

    Raises
    ------
    InputError
        For a stack of another shape or type, exposures that do not fit it, or levels outside their range.
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

    first = int(np.argmin(times))
    signal, weight = _tables(largest, black_level, full_scale, gamma)
    black = black_level * 65535 / full_scale
    scale = (65535 - black) / (full_scale - black_level)
    levels = np.empty(stack.shape[1:], np.uint16)
    saturated = stack[first] >= full_scale
    weighted = weight * signal
    for image in range(stack.shape[1]):
        total, time = signal[stack[first, image]], np.full(stack.shape[2:], times[first], np.float32)
        for exposure in range(len(stack)):
            if exposure != first:
                total += weighted[stack[exposure, image]]
                time += (weight * np.float32(times[exposure]))[stack[exposure, image]]
        total *= np.float32(times[first] * scale)
        total /= time
        total += np.float32(black)
        np.rint(total, out=total)
        np.clip(total, 0, 65535, out=total)
        levels[image] = total
        levels[image][saturated[image]] = 65535
    return MergedExposures(levels, saturated, black, 65535, scale, float(times[first]))


def _tables(
    largest: int, black_level: float, full_scale: int, gamma: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Signal [DN of the straight response] and weight [1] of every grey level 0 .. ``largest``."""
    share = (np.arange(largest + 1) - black_level) / (full_scale - black_level)
    # below black the straight curve goes on; a curved one has no light there
    straight = share if gamma == 1.0 else np.maximum(share, 0) ** gamma
    begin, end = _FADE
    weight = np.clip((end - straight) / (end - begin), 0, 1)
    return ((full_scale - black_level) * straight).astype(np.float32), weight.astype(np.float32)
