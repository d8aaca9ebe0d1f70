"""What stands where a study was expected: errors that say where a study comes from."""

import pytest

from characterisation.files.errors import InputError
from mitsim.study import open_study


@pytest.fixture
def part(tmp_path):
    """A folder as ``mitsim part`` leaves it: a scene, a task, no study."""
    (tmp_path / "part.xml").write_text("<!-- made -->\n<scene/>", encoding="utf-8")
    (tmp_path / "task.toml").write_text("", encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize(("name", "found"), [("study.toml", "no such file"), ("part.xml", "a scene"), ("", "a folder")])
def test_a_part_without_a_study_is_told_what_writes_one(part, name, found):
    """``did you mean 'task.toml'?``, and a parser's complaint of XML, led nowhere."""
    with pytest.raises(InputError, match=rf"found {found}; .*--edit writes study\.toml") as error:
        open_study(part / name)
    assert "did you mean" not in str(error.value)


def test_a_misspelt_study_is_named(part):
    (part / "study.toml").write_text("", encoding="utf-8")
    with pytest.raises(InputError, match=r"did you mean 'study\.toml'"):
        open_study(part / "studdy.toml")
    with pytest.raises(InputError, match=r"a folder; .*there is study\.toml"):
        open_study(part)
