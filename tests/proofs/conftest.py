import pytest

from mitsim.study import session
from tests.proofs.known_trials import CASES, KnownMaker


@pytest.fixture
def cases(tmp_path, scenes, monkeypatch):
    """The file of one case beside its part, with the known maker; nothing is made yet."""
    part = tmp_path / "balls_on_plate"
    part.mkdir()
    for name in ("balls_on_plate.xml", "task.toml"):
        (part / name).write_text((scenes / "parts/balls_on_plate" / name).read_text())
    file = tmp_path / "cases.toml"
    file.write_text(CASES)
    KnownMaker.made = 0
    monkeypatch.setattr(session, "measurements_of", KnownMaker)
    return file
