"""Give the true point on the view ray of each pixel of a cloud, for the errors of any decoder."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.point_cloud import PointCloud
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.poses import as_pose
from mitsim.sensor.transforms import Transform


def true_points(cloud: PointCloud, scene: Scene, pose: Transform | ArrayLike) -> NDArray[np.float64]:
    """Return the point of the scene that the view ray of each pixel of a cloud meets first.

    The rays are those of the cloud's grid, as its calibration defines them: for two cameras, those of the rectified
    left image, whose pixels are not those of the truth that :func:`mitsim.render` returns.

    Parameters
    ----------
    cloud
        Cloud, whoever decoded it; its points are not used.
    scene
        The part.
    pose
        ``world_from_sensor``.

    Returns
    -------
    numpy.ndarray
        (H, W, 3) [mm] in the sensor frame. NaN without a surface, and where only the back of a face is seen.

    Raises
    ------
    InputError
        If the pose is not a rigid motion.

    See Also
    --------
    mitsim.label : the shape that each pixel shows

    Examples
    --------
    The error of each point along its view ray:

    >>> import mitsim as ms
    >>> import numpy as np
    >>> sensor = ms.load_sensor("small.toml")
    >>> scene, pose = ms.load_scene("matt_white.xml", sensor), ms.look_at((0, -300, 400))
    >>> cloud = ms.decode(ms.render(scene, sensor, pose, samples=2, depth=1, check=False))
    >>> error = np.linalg.norm(cloud.points, axis=-1) - np.linalg.norm(ms.true_points(cloud, scene, pose), axis=-1)
    >>> bool(abs(np.nanmedian(error)) < 0.5)
    True
    """
    rays = cloud.grid.rays()
    met = cast(scene, PixelRays(cloud.grid.origin, rays), as_pose(pose, "true_points"), np.empty((0, 3)))
    return np.asarray(cloud.grid.origin + rays * met.distance[..., None].astype(float))
