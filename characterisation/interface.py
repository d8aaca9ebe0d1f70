"""Cloud files, as programs read and write them: see ``docs/reference/interface.md``."""

from __future__ import annotations

from pathlib import Path

from characterisation.cloud_files import read_ply, write_ply
from characterisation.point_cloud import PointCloud


def read_cloud(path: str | Path) -> PointCloud:
    """Read an organised cloud from a PLY file that :func:`write_cloud`, or ``mitsim decode``, wrote.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    PointCloud
        Points (H, W, 3) [mm] in the sensor frame, NaN where missing.

    Raises
    ------
    InputError
        If the file is missing, cut off, or a PLY without a grid. ``mitsim import`` reads other programs' clouds.

    Examples
    --------
    >>> import characterisation
    >>> cloud = characterisation.read_cloud("cloud.ply")
    >>> cloud.points.shape
    (240, 320, 3)
    """
    return read_ply(path)


def write_cloud(cloud: PointCloud, path: str | Path) -> None:
    """Write an organised cloud as binary PLY.

    The file has the points with their row, column, feature and sigma, the grid, and the status of every pixel. It is
    written whole or not at all; a file of that name is replaced.

    Parameters
    ----------
    cloud
        Points (H, W, 3) [mm] in the sensor frame.
    path
        The file; its folder must exist.

    Raises
    ------
    OSError
        If it cannot be written.

    Examples
    --------
    >>> import characterisation
    >>> cloud = characterisation.read_cloud("cloud.ply")
    >>> characterisation.write_cloud(cloud, "copy.ply")
    """
    write_ply(cloud, path)
