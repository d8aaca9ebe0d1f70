"""Move numbers and arrays to the device and back without making them part of a kernel.

Dr.Jit compiles into a kernel: every number of Python; the alignment in memory of a NumPy array that the kernel loads;
and the count of vectors that are converted to or from NumPy as a whole. A kernel of light transport takes up to some
seconds to compile. With these functions, cameras, projectors and parts of one kind share their kernels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mitsim.scene.backend import dr, mi

#: alignment of Dr.Jit's own arrays [bytes]
_ALIGNMENT = 64


def opaque(value: float) -> Any:
    """Return a number in single precision that is not compiled into kernels."""
    return dr.opaque(mi.Float, float(value))


def opaque_index(value: int) -> Any:
    """Return an unsigned integer of 32 bits that is not compiled into kernels."""
    return dr.opaque(mi.UInt32, int(value))


def opaque_point(point: NDArray[np.floating]) -> Any:
    """Return a point (3,), in single precision, that is not compiled into kernels."""
    return mi.Point3f(*[opaque(coordinate) for coordinate in point])


def to_device(values: ArrayLike) -> Any:
    """Return numbers (n,) on the device, in single precision."""
    numbers = np.asarray(values)
    memory = np.empty(numbers.size + _ALIGNMENT // 4, np.float32)
    start = -memory.ctypes.data % _ALIGNMENT // 4
    aligned = memory[start : start + numbers.size]
    aligned[:] = numbers
    return mi.Float(aligned)


def vectors_to_device(vectors: NDArray[np.floating]) -> Any:
    """Return vectors (n, 3) on the device, in single precision."""
    return mi.Vector3f(*[to_device(component) for component in vectors.T])


def known_to_device(vectors: NDArray[np.floating]) -> tuple[Any, Any]:
    """Return unit vectors (n, 3) on the device, and a mask of those that are not NaN, or True for all."""
    finite = np.isfinite(vectors).all(axis=1)
    if finite.all():
        return vectors_to_device(vectors), True
    return vectors_to_device(np.where(finite[:, None], vectors, [0.0, 0.0, 1.0])), mi.Bool(finite)


def vectors_to_host(vectors: Any, kind: DTypeLike = np.float32) -> NDArray[Any]:
    """Return the vectors of the device as an array (n, 3) of a kind of numbers."""
    return np.stack([np.array(component, kind) for component in vectors], axis=-1)
