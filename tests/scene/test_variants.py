"""The same capture on every backend that this machine has: CUDA and LLVM give one image."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from characterisation.files.errors import MissingEnvironmentError
from mitsim.capture.folder import read_capture
from mitsim.scene.backend import VARIANTS, choose_variant


def available(variant):
    try:
        return choose_variant(variant) == variant
    except MissingEnvironmentError:
        return False


def render(variant, folder, *more):
    command = [
        "render",
        "scenes/two_pillars/two_pillars.xml",
        "--position",
        "0",
        "-400",
        "300",
        "--target",
        "0",
        "0",
        "30",
    ]
    subprocess.run(
        [sys.executable, "-m", "mitsim", *command, "--variant", variant, "-o", str(folder), *more],
        check=True,
        capture_output=True,
        timeout=300,
    )
    return read_capture(folder)


@pytest.mark.skipif(not available("cuda_ad_mono"), reason="no CUDA device: one variant only")
def test_cuda_and_llvm_give_one_image(tmp_path):
    """Direct light has no random numbers: equal but for rounding, which single edges of shadows may turn over."""
    images = [render(v, tmp_path / v, "--noise", "none").images["left"][0].astype(float) for v in VARIANTS]
    off = np.abs(images[0] - images[1])
    assert images[0].max() > 1000
    assert np.quantile(off, 0.999) <= 2
    assert abs(images[0].mean() / images[1].mean() - 1) < 1e-4


@pytest.mark.skipif(not available("cuda_ad_mono"), reason="no CUDA device: one variant only")
def test_cuda_and_llvm_have_one_mean_of_interreflections(tmp_path):
    deep = ("--noise", "none", "--depth", "3", "--samples", "256")
    images = [render(v, tmp_path / v, *deep).images["left"][0].astype(float) for v in VARIANTS]
    blocks = [image[:480, :752].reshape(24, 20, 47, 16).mean(axis=(1, 3)) for image in images]
    lit = blocks[1] > 0.05 * blocks[1].max()
    assert np.median(np.abs(blocks[0] / np.where(lit, blocks[1], 1) - 1)[lit]) < 0.02


@pytest.mark.parametrize("variant", [v for v in VARIANTS if available(v)])
def test_every_variant_that_is_there_renders(variant, tmp_path):
    assert render(variant, tmp_path / "capture", "--samples", "1", "--depth", "1").images["left"].max() > 20
