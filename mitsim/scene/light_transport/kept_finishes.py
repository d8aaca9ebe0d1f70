"""Finishes of kept paths: what the paths are sampled with, and how narrow a lobe they resolve.

Signal chain: description of a finish at its best estimate -> a finish with wide and narrow lobes, to sample the
paths with -> width of the narrowest; and description of a drawn finish -> the same with no lobe narrower than that.

A path carries the product of BSDFs at directions that are kept (:mod:`mitsim.scene.light_transport.kept_paths`). A
drawn lobe that is much narrower than those the paths were sampled with holds few of the paths, each of which then
carries much: noise several times the mean. Therefore kept light is evaluated with lobes of at least a smallest width
(path-space regularisation: Kaplanyan and Dachsbacher, Computer Graphics Forum 32, 2013). It spreads the light between
faces by that width at most. Direct light has the lobe as drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

#: share of the samples that go to all sides
_DIFFUSE_SHARE = 0.2

#: factors on the width of the lobes that replace each lobe, the narrowest last; chosen among few. With two lobes, as
#: once, whose narrow one was a quarter as wide as the best estimate, three of four finishes drawn for a milled block
#: have a narrower one. In 14 worlds of that block (stepped_block__david, view 1), the median difference of its second
#: step from light rendered anew with 196 paths was 0.25 mm; with three lobes it is 0.04. The noise is higher, since
#: less is blurred: tests/benchmarks/drawn_noise.py prints both
_FACTORS = (1.25, 0.35, 0.1)

#: share of each of these lobes in the samples; chosen with them
_SHARES = (0.4, 0.3, 0.3)

_DIFFUSE = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}

#: keys of the widths of a lobe
_WIDTHS = ("alpha", "alpha_u", "alpha_v")


def broad(description: dict[str, Any]) -> dict[str, Any]:
    """Return a finish to sample with, for a finish given by its description, that covers others about it.

    Every lobe of microfacets becomes several of GGX, whose tail decreases slowly: a wider one, and narrow ones for
    smoother finishes, or such along marks of any direction. A part of the light is scattered to all sides. A coherent
    lobe keeps its width, which is that of the form of a face.
    """
    if not any(_lobes(description)):
        return _blend(description, _DIFFUSE, _DIFFUSE_SHARE)
    lobes, total = _scaled(description, _FACTORS[0]), _SHARES[0]
    for factor, share in zip(_FACTORS[1:], _SHARES[1:], strict=True):
        total += share
        lobes = _blend(lobes, _scaled(description, factor), share / total)
    return _blend(lobes, _DIFFUSE, _DIFFUSE_SHARE)


def least_width(description: dict[str, Any]) -> float:
    """Return the width [1] of the narrowest lobe that the paths sampled for a finish resolve; 0 if it has no lobe.

    ``description`` is the finish of which :func:`broad` makes the one to sample with. Coherent lobes, which the paths
    are sampled with, do not count.
    """
    widths = [width for lobe in _lobes(description) for width in _widths(lobe).values()]
    return _FACTORS[-1] * min(widths, default=0.0)


def resolved(description: dict[str, Any], width: float) -> dict[str, Any]:
    """Return a finish whose lobes are at least as wide as a width [1], but for coherent lobes."""
    return _with_lobes(description, lambda lobe: lobe | {key: max(lobe[key], width) for key in _widths(lobe)})


def _widths(lobe: dict[str, Any]) -> dict[str, float]:
    return {key: lobe[key] for key in _WIDTHS if key in lobe}


def _lobes(description: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield every lobe of microfacets of a finish, but for coherent ones."""
    for key, value in description.items():
        if isinstance(value, dict) and key != "mirror":
            yield from _lobes(value)
    if "distribution" in description:
        yield description


def _with_lobes(description: dict[str, Any], change: Callable[[dict[str, Any]], dict[str, Any]]) -> dict[str, Any]:
    """Return a finish with every lobe of microfacets changed, but for coherent ones."""
    out = {
        key: _with_lobes(value, change) if isinstance(value, dict) and key != "mirror" else value
        for key, value in description.items()
    }
    return change(out) if "distribution" in out else out


def _scaled(description: dict[str, Any], factor: float) -> dict[str, Any]:
    """Return a finish whose lobes are of GGX and wider by a factor."""

    def scaled(lobe: dict[str, Any]) -> dict[str, Any]:
        wider = {key: min(factor * width, 1.0) for key, width in _widths(lobe).items()}
        return lobe | {"distribution": "ggx"} | wider

    return _with_lobes(description, scaled)


def _blend(first: dict[str, Any], second: dict[str, Any], share: float) -> dict[str, Any]:
    return {"type": "blendbsdf", "weight": share, "first": first, "second": second}
