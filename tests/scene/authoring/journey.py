"""How long a bracket takes from its STEP file to a statement, without an editor.

``python -m tests.scene.authoring.journey`` measures it.

The clock starts with ``mitsim part --edit``. A headless Chromium then works on the page by keyboard and mouse, as a
person would:

- it renames a face, and gives two faces a finish of their own,
- it defines a distance, a size with two limits, a perpendicularity and an angle.

A person reads and thinks for longer, so seconds are printed by step. At the end the study that the page wrote is run,
with ``--minutes`` for its race.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.report.chromium import Chromium
from tests.scene.authoring.author import Author
from tests.scene.authoring.bracket import bracket, write_step


def main() -> int:
    """Print the seconds of every step; the exit code is that of the run."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--sensor", default="ensenso-n10")
    asked.add_argument("--minutes", type=float, default=2.0)
    given = asked.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_step([("bracket", bracket(), None)], folder / "bracket.step")
        began = time.monotonic()

        def told(what: str) -> None:
            print(f"{time.monotonic() - began:6.0f} s  {what}", flush=True)

        command = [
            sys.executable,
            "-m",
            "mitsim",
            "part",
            folder / "bracket.step",
            "-o",
            folder / "made",
            "--Ra",
            "0.4",
            "--sensor",
            given.sensor,
            "--edit",
        ]
        serving = subprocess.Popen([str(one) for one in command], stdout=subprocess.PIPE, text=True)
        assert serving.stdout is not None
        address = next(line.strip() for line in serving.stdout if line.startswith("http://"))
        told("mitsim part --edit serves its page")
        with Chromium(folder / "profile", width=1150, height=860) as browser:
            page = Author(browser, address)
            told("the page is there")
            page.choose("bore_12mm_left")
            page.type("#author-name", "datum_bore")
            for faces, kind, tolerance in (
                (("datum_bore", "bore_12mm_right"), "axis_distance", "0.4"),
                (("boss_20mm",), "diameter", "+0.1 -0.5"),
                (("front_at_y18mm", "top_at_z12mm"), "perpendicularity", "0.5"),
                (("top_at_z12mm", "chamfer_45deg"), "plane_angle", "1"),
            ):
                page.choose(*faces)
                page.measure(kind, tolerance)
            page.choose("seat_18mm", "boss_20mm")
            page.pick("#author-finish", "+")
            page.type("[aria-label^='Ra of finish_2']", "0.2")
            told("named, finished and measured")
            browser.tell("document.getElementById('author-done').click()")
            browser.until("document.getElementById('author-status').textContent.startsWith('Done')", 300)
            assert browser.problems == [], browser.problems
        assert serving.wait(60) == 0
        told("saved; the command has ended")
        run = [
            sys.executable,
            "-m",
            "mitsim",
            "run",
            folder / "made/study.toml",
            "-o",
            folder / "run",
            "--minutes",
            given.minutes,
        ]
        code = subprocess.run([str(one) for one in run], check=False).returncode
        told(f"mitsim run ends with exit code {code}; a report of {(folder / 'run/report.html').stat().st_size} bytes")
    return code if code not in (0, 1) else 0  # 1: a tolerance that does not fit is an answer too


if __name__ == "__main__":
    sys.exit(main())
