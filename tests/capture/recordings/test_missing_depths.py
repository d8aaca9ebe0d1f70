"""Points whose z alone says that nothing was measured, in clouds that are measured."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.decoding.input_clouds import read_cloud

rows, columns = np.mgrid[:60, :80]
DEPTH = 600 + 0.3 * columns + 0.2 * rows
CLOUD = np.stack([(columns - 39.5) * DEPTH / 80, (rows - 29.5) * DEPTH / 80, DEPTH], axis=-1)
HIDDEN = np.random.default_rng(1).random(DEPTH.shape) < 0.2


def marked(z):
    """Return the cloud, with x and y of hidden points as they come, and their z."""
    out = CLOUD.copy()
    out[HIDDEN] = np.random.default_rng(2).uniform(-50, 50, (HIDDEN.sum(), 3))
    out[HIDDEN, 2] = z
    return out


@pytest.mark.parametrize("suffix", [".npy", ".csv"])
@pytest.mark.parametrize("z", [10000.0, -1.0, -9999.0])
def test_a_depth_that_no_surface_has_is_left_out(tmp_path, capsys, suffix, z):
    """OpenCV's reprojectImageTo3D sets z to 10000 (handleMissingValues), or -f B of a disparity of -1."""
    path = tmp_path / f"a{suffix}"
    points = marked(z)
    np.save(path, points) if suffix == ".npy" else np.savetxt(path, points.reshape(-1, 3), delimiter=",")
    cloud = read_cloud(path).cloud
    np.testing.assert_allclose(cloud.points[cloud.valid], CLOUD[~HIDDEN], rtol=1e-6)
    assert f"{HIDDEN.sum()} points are all at z = {z:g}: left out" in capsys.readouterr().err


def test_a_face_of_a_part_in_its_own_frame_stays(tmp_path):
    """A cloud sampled from CAD has exact faces: at z = 0, or below all others."""
    rng = np.random.default_rng(3)
    base = np.c_[rng.uniform(0, 90, (3000, 2)), np.zeros(3000)]
    top = np.c_[rng.uniform(20, 60, (1000, 2)), rng.uniform(20, 40, 1000)]
    for shift in (0.0, 12.0):
        points = np.add(np.concatenate([base, top]), [300, 0, shift])
        np.savetxt(tmp_path / "a.xyz", points)
        assert read_cloud(tmp_path / "a.xyz").cloud.valid.sum() == len(points)
