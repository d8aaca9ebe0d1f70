"""Picture of the page to author with, for the docs: ``python -m tests.scene.authoring.pictures docs/images``."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from tests.report.chromium import Chromium
from tests.scene.authoring.author import Author
from tests.scene.authoring.bracket import bracket, write_step


def main(target: Path) -> None:
    """Author the bracket and write ``author_page.png``."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_step([("bracket", bracket(), None)], folder / "bracket.step")
        for arguments in (
            ["part", folder / "bracket.step", "-o", folder / "bracket", "--Ra", "0.4"],
            [
                "check",
                folder / "bracket/bracket.xml",
                "--task",
                folder / "bracket/task.toml",
                "--html",
                folder / "page.html",
            ],
        ):
            subprocess.run([sys.executable, "-m", "mitsim", *map(str, arguments)], check=True, capture_output=True)
        with Chromium(folder / "profile", width=1150, height=900) as browser:
            page = Author(browser, (folder / "page.html").as_uri())
            for faces, kind, tolerance in (
                (("bore_12mm_left", "bore_12mm_right"), "axis_distance", "0.1"),
                (("boss_20mm",), "diameter", "+0.02 -0.05"),
                (("top_at_z12mm", "chamfer_45deg"), "plane_angle", "0.5"),
                (("bottom",), "flatness", "0.05"),
            ):
                page.choose(*faces)
                page.measure(kind, tolerance)
            page.choose("seat_18mm")
            browser.tell("scrollTo(0, 0)")
            browser.scheme("light")
            image = cv2.imdecode(np.frombuffer(browser.shot(), np.uint8), cv2.IMREAD_COLOR)
            cv2.imwrite(str(target / "author_page.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
            print(target / "author_page.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
