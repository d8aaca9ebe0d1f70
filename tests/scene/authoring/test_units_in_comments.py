"""Units in the comments of meshes, as programs and people write them."""

import pytest

from mitsim.scene.authoring.units import commented_unit


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        *(
            (words, 1.0)
            for words in ("units are in mm", "units in (mm)", "units in [mm]", "unit is in mm", "unit in: mm")
        ),
        *(
            (words, 1.0)
            for words in ("File units = mm", "units: mm", "unit mm", "unit in mm", "mm as units", "unit 'mm'")
        ),
        *(
            (words, 25.4)
            for words in ("units = in", "unit: in", "units in inches", "File units = inches", "units are inch")
        ),
        *((words, 1000.0) for words in ("units are in meters", "units (m)")),
        *((words, None) for words in ("units in", "unit is", "a unit in the factory", "no word of it")),
    ],
)
def test_a_unit_is_read_as_it_is_meant(text, unit):
    """``in`` before a unit was read as inch: a box of 60 mm became 1524 mm, without a remark."""
    assert commented_unit(".obj", f"# {text}\nv 0 0 0\n".encode()) == unit
    if len(text) < 60:
        assert commented_unit(".stl", f"solid box, {text}\n".encode()) == unit
