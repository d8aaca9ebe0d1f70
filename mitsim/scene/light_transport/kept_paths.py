"""Keep the paths of interreflected light of one view, and evaluate them for any finish without tracing.

Signal chain: *broad* finishes -> camera paths and photons, traced once
(:mod:`mitsim.scene.light_transport.kept_tracing`) -> candidates: pixel, weight, code coordinate, and the two directions
at each surface -> the few that matter (this module) -> BSDFs of a drawn finish at the kept directions -> product along
each path -> sum over the paths of each pixel.

A path through the surfaces x_1 (at the camera) ... x_n (at the projector) carries

    radiance = w * f_1(i_1, o_1) * ... * f_n(i_n, o_n) * code(u, v, L)

where f_k is the BSDF with its cosine, i_k points along the path toward the camera and o_k toward the projector. The
weight w holds everything else: arriving light, densities of the directions, and the balance heuristic between camera
paths and photons. Densities and heuristic are those of the finish that the paths were *sampled* with. They are
functions of the path alone, so the estimate is unbiased for every other finish (importance sampling: Kahn and Marshall
1953). Its variance is small if the sampled finish covers the others: a defensive mixture (Hesterberg,
Technometrics 37, 1995; :func:`~mitsim.scene.light_transport.kept_finishes.broad`).

Most candidates carry next to nothing. Each is kept with the probability p = min(1, c / t), and its weight is divided by
p (Russian roulette: Arvo and Kirk, SIGGRAPH 1990). Here c is the root mean square of its light over some finishes that
may be drawn, which makes the variance over those finishes least for a number of paths. Decisions are systematic along a
Z-order curve of the pixels: any part of the image keeps as many paths as it should, within one.

A material whose finish is never drawn, such as a stock BSDF of the scene's author, is part of the weight.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Singles
from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque, to_device, vectors_to_host
from mitsim.scene.light_transport.low_discrepancy import z_positions
from mitsim.scene.light_transport.projected_codes import ProjectedLight

#: number of candidates whose light is found together
_AT_ONCE = 1 << 19


@dataclass(frozen=True)
class CandidatePaths:
    """Paths from projector to camera over two and more surfaces, on the host.

    ``pixel`` (n,) is the index in the region, ``weight`` (n,) is w. ``code`` (n, 3) is what the code depends on: u, v
    [1] and L [mm]. ``material`` (n, m) numbers the drawn finish of each surface, -1 for none. ``toward`` (n, m, 6) are
    the local directions i and o.
    """

    pixel: NDArray[np.int32]
    weight: Singles
    code: Singles
    material: NDArray[np.int16]
    toward: Singles

    def __len__(self) -> int:
        return len(self.pixel)

    def chosen(
        self, index: NDArray[np.integer] | NDArray[np.bool_] | slice, weight: Singles | None = None
    ) -> CandidatePaths:
        """Return some of the paths, with other weights if given."""
        kept = self.weight[index] if weight is None else weight
        return CandidatePaths(self.pixel[index], kept, self.code[index], self.material[index], self.toward[index])

    @classmethod
    def joined(cls, parts: Sequence[CandidatePaths], surfaces: int) -> CandidatePaths:
        """Return the paths of several parts, as if all had the largest number of surfaces."""

        def wide(values: NDArray[Any], fill: int) -> NDArray[Any]:
            pad = [(0, 0)] * values.ndim
            pad[1] = (0, surfaces - values.shape[1])
            return np.pad(values, pad, constant_values=fill)

        if not parts:
            nothing = np.empty((0, surfaces, 6), np.float32)
            return cls(
                np.empty(0, np.int32), nothing[:, 0, 0], nothing[:, 0, :3], np.empty((0, surfaces), np.int16), nothing
            )
        return cls(
            np.concatenate([part.pixel for part in parts]),
            np.concatenate([part.weight for part in parts]),
            np.concatenate([part.code for part in parts]),
            np.concatenate([wide(part.material, -1) for part in parts]),
            np.concatenate([wide(part.toward, 0) for part in parts]),
        )


class Vertices:
    """The surfaces of paths, sorted by material: their BSDFs are evaluated with one call for each material.

    ``materials`` (k, 2) are the numbers of the materials and of their surfaces, ``directions`` (6, n) their i and o.
    """

    def __init__(self, materials: NDArray[np.integer], directions: Singles) -> None:
        self._parts, first = list[tuple[int, Any, Any]](), 0
        for number, count in materials.tolist():
            rows = directions[:, first : first + count]
            self._parts.append((number, *[mi.Vector3f(*map(to_device, rows[k : k + 3])) for k in (0, 3)]))
            first += count
        self._count = 1 + first

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what the surfaces are made of, by the names of the parameters."""
        parts = [np.concatenate([vectors_to_host(each).T for each in part[1:]]) for part in self._parts]
        return {
            "materials": np.array([(number, dr.width(row)) for number, row, _ in self._parts], int).reshape(-1, 2),
            "directions": np.concatenate(parts, axis=1) if parts else np.empty((6, 0), np.float32),
        }

    def __len__(self) -> int:
        return self._count

    def factors(self, bsdfs: Sequence[Any]) -> Any:
        """Return the factor of each surface for these materials; the first is 1."""
        out, values, first = dr.ones(mi.Float, self._count), [], 1
        for number, incoming, outgoing in self._parts:
            surface = dr.zeros(mi.SurfaceInteraction3f, dr.width(incoming))
            surface.wi = incoming
            values.append(bsdfs[number].eval(mi.BSDFContext(), surface, outgoing, True)[0])
        dr.eval(values)
        for value in values:
            dr.scatter(out, value, dr.arange(mi.UInt32, first, first + dr.width(value)))
            first += dr.width(value)
        return out


def _sorted_surfaces(material: NDArray[np.int16], toward: Singles) -> tuple[NDArray[Any], Singles, NDArray[np.uint32]]:
    """Return materials and directions of :class:`Vertices`, and the indices (m, n) of the factors of each path."""
    flat = material.ravel()
    order = np.argsort(flat, kind="stable")
    order = order[np.searchsorted(flat[order], 0) :]
    index = np.zeros(material.shape, np.uint32)
    index.ravel()[order] = np.arange(1, len(order) + 1, dtype=np.uint32)
    materials = np.stack(np.unique(flat[order], return_counts=True), axis=-1)
    return materials, toward.reshape(-1, 6)[order].T, index.T


class KeptPaths:
    """The paths of one camera's region, ready on the device for any finish; ``arrays`` as :meth:`arrays` returns."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]], roi: Roi) -> None:
        self.roi, self.count = roi, len(arrays["weight"])
        self._vertices = Vertices(arrays["materials"], arrays["directions"])
        self._pixels = arrays["pixels"]
        self._first, self._counts = mi.UInt32(arrays["first"]), mi.UInt32(arrays["counts"])
        self._weight, self._length = to_device(arrays["weight"]), to_device(arrays["length"])
        self._uv = mi.Point2f(*map(to_device, arrays["uv"]))
        self._indices = [mi.UInt32(np.ascontiguousarray(indices)) for indices in arrays["indices"]]

    @classmethod
    def of(cls, paths: CandidatePaths, roi: Roi) -> KeptPaths:
        """Return paths in the order of their pixels."""
        pixels, first, counts = np.unique(paths.pixel, return_index=True, return_counts=True)
        if len(paths) and (np.diff(paths.pixel) != 0).sum() + 1 != len(pixels):
            raise ValueError("paths of one pixel must follow one another")
        materials, directions, indices = _sorted_surfaces(paths.material, paths.toward)
        arrays = {
            "pixels": pixels,
            "first": first.astype(np.uint32),
            "counts": counts.astype(np.uint32),
            "weight": paths.weight,
            "uv": paths.code.T[:2],
            "length": paths.code[:, 2],
            "indices": indices,
            "materials": materials,
            "directions": directions,
        }
        return cls(arrays, roi)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that the paths are made of, for the same paths in another process."""
        return {
            "pixels": self._pixels,
            "first": np.asarray(self._first),
            "counts": np.asarray(self._counts),
            "weight": np.asarray(self._weight),
            "uv": np.stack([np.asarray(self._uv.x), np.asarray(self._uv.y)]),
            "length": np.asarray(self._length),
            "indices": np.stack([np.asarray(indices) for indices in self._indices]),
            **self._vertices.arrays(),
        }

    @property
    def bytes(self) -> int:
        """Memory that the paths need on the device."""
        return 24 * len(self._vertices) + self.count * (16 + 4 * len(self._indices))

    def codes(self, bsdfs: Sequence[Any], light: ProjectedLight, motion: NDArray[np.float64] | None = None) -> Singles:
        """Return the light (codes, height, width) of each code of a region, for the BSDFs of the drawn finishes.

        Each pixel sums its paths in their order, so that the same paths give the same bytes. ``motion`` is an affine
        map (2, 3) of texture coordinates from where the paths were traced to where the part is, None for none.
        """
        out = np.zeros((light.codes, self.roi.height * self.roi.width), np.float32)
        if not self.count:
            return out.reshape(light.codes, self.roi.height, self.roi.width)
        factors = self._vertices.factors(bsdfs)
        radiance = self._weight
        for indices in self._indices:
            radiance = radiance * dr.gather(mi.Float, factors, indices)
        dr.eval(radiance)
        last = self._first + self._counts
        rows = None if motion is None else [[opaque(float(value)) for value in row] for row in motion]

        def running(k: Any, *sums: Any) -> Any:
            return k < last

        def step(k: Any, *sums: Any) -> Any:
            carried = dr.gather(mi.Float, radiance, k)
            uv, length = dr.gather(mi.Point2f, self._uv, k), dr.gather(mi.Float, self._length, k)
            if rows is not None:
                uv = mi.Point2f(*[across * uv.x + down * uv.y + offset for across, down, offset in rows])
            values = light.values(uv, length, mi.Bool(True))
            return (k + 1, *[s + carried * value for s, value in zip(sums, values, strict=True)])

        start = (mi.UInt32(self._first), *[dr.zeros(mi.Float, len(self._pixels)) for _ in range(light.codes)])
        _, *sums = dr.while_loop(start, running, step, label="kept_paths")
        dr.eval(sums)
        for row, values in zip(out, sums, strict=True):
            row[self._pixels] = np.asarray(values)
        return out.reshape(light.codes, self.roi.height, self.roi.width)


def light_of(paths: CandidatePaths, finishes: Sequence[Sequence[Any]]) -> Iterator[NDArray[np.float64]]:
    """Yield the radiance (n,) of each path for a code of 1, for the BSDFs of each of some drawn finishes."""
    materials, directions, indices = _sorted_surfaces(paths.material, paths.toward)
    vertices = Vertices(materials, directions)
    for bsdfs in finishes:
        factors = np.asarray(vertices.factors(bsdfs), np.float64)
        yield np.asarray(paths.weight * factors[indices].prod(axis=0))


def mattering(
    parts: Sequence[CandidatePaths], finishes: Sequence[Sequence[Any]], roi: Roi, count: int, seed: int
) -> CandidatePaths:
    """Return about ``count`` of the paths, chosen by their light in some finishes, in the order of their pixels.

    Parameters
    ----------
    parts
        Candidates in several parts; whole numbers of surfaces may differ.
    finishes
        For each finish that may be drawn, the BSDFs of the drawn materials.
    roi, count
        Region of the pixels, and expected number of paths.
    seed
        Of the choice.
    """
    dr.flush_malloc_cache()  # Dr.Jit keeps what it needed to trace the paths, as much as all else together
    surfaces = max((part.material.shape[1] for part in parts), default=1)
    if sum(map(len, parts)) <= count:  # all matter
        paths = CandidatePaths.joined(parts, surfaces)
        return paths.chosen(_in_z_order(paths.pixel, roi))
    size = np.concatenate([_sizes(part, finishes) for part in parts])
    pixel = np.concatenate([part.pixel for part in parts])
    order = _in_z_order(pixel, roi)
    probability = np.minimum(size[order] / _threshold(size, count), 1.0)
    reached = np.cumsum(probability) + np.random.default_rng(seed).random()
    kept = np.flatnonzero(np.floor(reached) > np.floor(np.concatenate([[0.0], reached[:-1]])))
    index, probability = order[kept], probability[kept]
    del size, pixel, order, reached
    rows, chosen, first = list[NDArray[np.integer]](), list[CandidatePaths](), 0
    for part in parts:  # never all candidates together, which are many times as large as the kept paths
        of_part = np.flatnonzero((index >= first) & (index < first + len(part)))
        rows.append(of_part)
        chosen.append(part.chosen(index[of_part] - first))
        first += len(part)
    paths = CandidatePaths.joined(chosen, surfaces)
    del chosen
    sequence = np.argsort(np.concatenate(rows))
    return paths.chosen(sequence, (paths.weight[sequence] / probability).astype(np.float32))


def _in_z_order(pixel: NDArray[np.integer], roi: Roi) -> NDArray[np.intp]:
    return np.argsort(z_positions(pixel % roi.width, pixel // roi.width), kind="stable")


def _sizes(paths: CandidatePaths, finishes: Sequence[Sequence[Any]]) -> NDArray[np.float64]:
    """Return the root mean square light (n,) of paths over some finishes."""
    size = np.zeros(len(paths))
    for first in range(0, len(paths), _AT_ONCE):
        block = slice(first, first + _AT_ONCE)
        for light in light_of(paths.chosen(block), finishes):
            size[block] += light**2
    return np.sqrt(size / max(len(finishes), 1))


def _threshold(size: NDArray[np.float64], count: int) -> float:
    """Return t with sum min(1, c / t) = ``count`` for the sizes c; tiny if all can be kept."""
    positive = np.sort(size[size > 0])[::-1]
    if len(positive) <= count:
        return float(positive[-1]) if len(positive) else 1.0
    tail_sums = np.cumsum(positive[::-1])[::-1]  # of this and all smaller ones
    kept_whole = np.arange(len(positive))  # number of larger ones, kept with certainty
    free = count - kept_whole
    possible = free > 0
    candidates = tail_sums[possible] / free[possible]
    # the first at which this one would be kept with a probability of 1 or less
    return float(candidates[np.argmax(candidates >= positive[possible])])
