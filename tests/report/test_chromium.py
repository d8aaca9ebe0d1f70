"""The browser that tests drive, on pages that would stop it."""

import pytest

from tests.report.chromium import BROWSER


@pytest.mark.browser
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_a_page_that_asks_before_it_is_left_does_not_stop_the_next(browser, tmp_path):
    unsaved = (
        "<button style='width: 200px; height: 200px'></button>"
        "<script>addEventListener('beforeunload', (event) => event.preventDefault())</script>"
    )
    (tmp_path / "unsaved.html").write_text(unsaved)
    (tmp_path / "next.html").write_text("<p>next</p>")
    browser.open(tmp_path / "unsaved.html")
    browser.click(50, 50)  # the browser asks only where somebody touched the page
    browser.open(tmp_path / "next.html")
    assert browser.tell("document.body.innerText") == "next"
