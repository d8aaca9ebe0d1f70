from pathlib import Path

import pytest

SCENES = Path(__file__).parents[2] / "scenes/two_pillars"


@pytest.fixture
def written(tmp_path):
    """Write the shipped validation with one sensor, two samples and few views, and with changes, elsewhere."""

    def write(*changes, name="validation"):
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        text = (SCENES / "validation.toml").read_text()
        head, *samples = text.split("[[samples]]")
        text = head + "".join("[[samples]]" + one for one in samples[:2])
        for old, new in (
            ('["ensenso-n10", "david-sls-3"]', '["ensenso-n10"]'), ("subdivisions = 2", "subdivisions = 0"),
            ("rolls_deg = [0, 90]", "rolls_deg = [0]"), *changes,
        ):  # fmt: skip
            assert old in text
            text = text.replace(old, new)
        for file in ("two_pillars.xml", "matt_white.xml", "task.toml"):
            (folder / file).write_text((SCENES / file).read_text())
        (folder / "validation.toml").write_text(text)
        return folder / "validation.toml"

    return write
