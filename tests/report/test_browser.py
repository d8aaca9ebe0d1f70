"""The page in a real browser, without a network."""

import base64
import re

import cv2
import numpy as np
import pytest

from mitsim.sensor.png import decode_png
from tests.report.chromium import BROWSER
from tests.report.conftest import CHECKED

pytestmark = [pytest.mark.browser, pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")]


def test_page_parses_into_what_was_written(report, browser):
    browser.open(report)
    dom = browser.tell("document.documentElement.outerHTML")
    assert len(re.findall(r"<script>", dom)) == 1  # the one that runs; the others are data
    assert len(re.findall(r'<svg role="img"', dom)) == 11  # the placement twice, for wide and for narrow windows
    images = re.findall(r'<img src="data:image/png;base64,([^"]+)"', dom)
    assert len(images) == 2 * len(CHECKED)
    for image in images:
        assert decode_png(base64.b64decode(image), "left").shape == (24, 32)
    assert "</html>" in dom and dom.count("<section") == 13


@pytest.mark.parametrize(("scheme", "paper"), [("light", 253), ("dark", 22)])
def test_page_is_painted_in_light_and_in_dark(report, browser, scheme, paper):
    width, height = 900, 9000
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
    browser.open(report)
    browser.tell("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    browser.scheme(scheme)
    pixels = cv2.imdecode(np.frombuffer(browser.shot(), np.uint8), cv2.IMREAD_COLOR)
    assert pixels.shape == (height, width, 3)
    assert abs(int(pixels[2, 2, 2]) - paper) <= 1
    colourful = (pixels.max(axis=2) - pixels.min(axis=2)) > 60
    assert colourful.mean() > 0.02  # discs are there, not only writing
    assert len(np.unique(pixels[::4] @ [1, 256, 65536])) > 200
