"""Solid angles of triangles: together they tell whether a point lies within a closed surface."""

from __future__ import annotations

import numpy as np

from characterisation.files.arrays import Floats


def solid_angles(triangles: Floats) -> Floats:
    """Return signed solid angles (n,) [sr] of triangles (n, 3, 3) from the origin; positive for outward normals.

    Those of a closed surface add to 4 pi from inside and to 0 from outside (Van Oosterom and Strackee, IEEE Trans.
    Biomed. Eng. 30, 1983).
    """
    a, b, c = np.moveaxis(triangles, 1, 0)
    la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    ab, bc, ca = ((first * second).sum(axis=1) for first, second in ((a, b), (b, c), (c, a)))
    return np.asarray(2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb))
