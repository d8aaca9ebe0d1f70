"""The page in a real browser, without a network."""

import base64
import re
import shutil
import subprocess

import numpy as np
import pytest

from mitsim.capture.png import decode_png

from .conftest import CHECKED

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

pytestmark = [pytest.mark.browser, pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")]


def browse(page, tmp_path, *arguments: str) -> str:
    command = [
        BROWSER,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-background-networking",
        "--hide-scrollbars",
        "--disable-dev-shm-usage",
        "--no-first-run",
        f"--user-data-dir={tmp_path / 'profile'}",
        *arguments,
        page.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout


def test_page_parses_into_what_was_written(report, tmp_path):
    dom = browse(report, tmp_path, "--dump-dom")
    assert len(re.findall(r"<script>", dom)) == 1  # the one that runs; the others are data
    assert len(re.findall(r'<svg role="img"', dom)) == 10
    images = re.findall(r'<img src="data:image/png;base64,([^"]+)"', dom)
    assert len(images) == 2 * len(CHECKED)
    for image in images:
        assert decode_png(base64.b64decode(image), "left").shape == (24, 32)
    assert "</html>" in dom and dom.count("<section") == 12


@pytest.mark.parametrize(("scheme", "paper"), [(1, 253), (0, 22)])
def test_page_is_painted_in_light_and_in_dark(report, tmp_path, scheme, paper):
    shot = tmp_path / "page.png"
    browse(
        report,
        tmp_path,
        f"--blink-settings=preferredColorScheme={scheme}",
        "--window-size=900,9000",
        f"--screenshot={shot}",
    )
    import cv2

    pixels = cv2.imread(str(shot)).astype(int)
    assert pixels.shape == (9000, 900, 3)
    assert abs(pixels[2, 2, 2] - paper) <= 1
    colourful = (pixels.max(axis=2) - pixels.min(axis=2)) > 60
    assert colourful.mean() > 0.02  # discs are there, not only writing
    assert len(np.unique(pixels @ [1, 256, 65536])) > 200
