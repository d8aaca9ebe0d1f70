"""Compute with single vectors (3,) and rows of vectors (n, 3), faster than NumPy's functions for any shape."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def tangents(direction: ArrayLike) -> Array:
    """Return two unit vectors (2, 3) that complete a direction (3,) to a right-handed frame e1, e2, direction.

    The covariance of a fit is expressed in this frame, so the choice follows a fixed rule. e1 is the coordinate axis
    least aligned with the direction, made perpendicular to it.
    """
    along = unit(direction)
    least = np.argmin(np.abs(along))
    first = 0.0 - along[least] * along
    first[least] += 1.0
    first = unit(first)
    return np.array([first, cross(along, first)])


def cross(first: Array, second: Array) -> Array:
    """Return the vector product of two vectors (3,); np.cross is ten times slower."""
    (a, b, c), (x, y, z) = first, second
    product: Array = np.array([b * z - c * y, c * x - a * z, a * y - b * x])
    return product


def unit(vector: ArrayLike) -> Array:
    """Return the vector (3,) of length 1 in the same direction."""
    array: Array = np.asarray(vector, float)
    of_length_one: Array = array / math.sqrt(array.dot(array))  # np.linalg.norm takes five times as long
    return of_length_one


def dots(a: Array, b: Array) -> Array:
    """Return the scalar products of the rows of two arrays (n, 3)."""
    products: Array = np.einsum("ij,ij->i", a, b)  # np.sum over a short last axis is five times slower
    return products


def lengths(vectors: Array) -> Array:
    """Return the lengths of the rows of an array (n, 3)."""
    out: Array = np.sqrt(dots(vectors, vectors))
    return out


def moved_rigidly(motion: ArrayLike, point: Array, *directions: Array) -> tuple[Array, ...]:
    """Move a point (3,) and directions (3,) by a (4, 4) matrix."""
    matrix = np.asarray(motion, float)
    return matrix[:3, :3] @ point + matrix[:3, 3], *(matrix[:3, :3] @ direction for direction in directions)
