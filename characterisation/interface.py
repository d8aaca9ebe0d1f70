"""Functions that read and write cloud files, for programs; see ``docs/reference/interface.md``."""

from __future__ import annotations

from pathlib import Path

from characterisation.cloud_files import read_ply, write_ply
from characterisation.point_cloud import PointCloud


def read_cloud(path: str | Path) -> PointCloud:
    """Read an organised cloud from a PLY file written by :func:`write_cloud` or ``mitsim decode``.

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
        If the file is missing or truncated, or is a PLY without a pixel grid. ``mitsim import`` reads the clouds of
        other programs.

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

    The file holds the pixel grid, the status of every pixel, and each point with its row, column, feature and sigma.
    Writing is atomic: an existing file is replaced only when the new one is complete.

    Parameters
    ----------
    cloud
        Points (H, W, 3) [mm] in the sensor frame.
    path
        Path of the file. Its folder must exist.

    Raises
    ------
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> import characterisation
    >>> cloud = characterisation.read_cloud("cloud.ply")
    >>> characterisation.write_cloud(cloud, "copy.ply")
    """
    write_ply(cloud, path)
