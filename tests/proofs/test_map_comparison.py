"""What maps do not know: sizes that are put in come out again."""

import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.study.virtual.beyond_map import BeyondMap, Sizes, beyond_map
from tests.proofs.map_comparison import (
    LEVELS,
    ComparedCase,
    beyond_map_document,
    beyond_quantiles,
    fitted_sizes,
    inside,
    judged_table,
)


def case(drawn_std, beyond_std, seed, kind="coded", sealed=False, predicted=0.02):
    """Normal errors of 4 measurements from 20 views in 12 worlds: the rendered ones have more."""
    rng = np.random.default_rng(seed)
    shape = (4, 20, 12)
    drawn = predicted * drawn_std * rng.standard_normal(shape)
    rendered = predicted * (drawn_std * rng.standard_normal(shape) + beyond_std * rng.standard_normal(shape))
    table = SimpleNamespace(part=f"part_{seed}", finish="white")
    told = SimpleNamespace(table=table, sealed=sealed, usable_for_fitting=not sealed, name=f"part_{seed}__x__white")
    return ComparedCase(told, "x", kind, tuple("abcd"), drawn, rendered, np.full(shape[:2], predicted))


def test_the_sizes_of_normal_errors_come_out_again():
    cases = [case(1.0, 3.0, seed) for seed in range(4)]
    sizes = fitted_sizes(cases, resamples=50)
    normal = np.abs(np.random.default_rng(0).standard_normal(400_000))
    expected = 3.0 * np.quantile(normal, LEVELS)
    found = np.array(sizes.size)
    assert found[4:] == pytest.approx(expected[4:], rel=0.12)
    assert list(beyond_quantiles(cases)) == sizes.size
    assert (np.array(sizes.low) <= found + 1e-9).all() and (found <= np.array(sizes.high) + 1e-9).all()
    drawn = sizes.draw(np.random.default_rng(1), 100_000)
    assert drawn.std() == pytest.approx(3.0, rel=0.08) and abs(drawn.mean()) < 0.05


def test_intervals_hold_with_what_is_beyond_the_map_and_not_without():
    cases = [case(1.0, 3.0, seed) for seed in range(4)]
    other = case(1.0, 3.0, 9)
    count, of = inside(other, beyond_quantiles(cases))
    assert of == 960 and 0.92 < count / of < 0.98
    assert inside(other, None)[0] / of == pytest.approx(0.46, abs=0.08)  # P(|z| < 1.96 / sqrt(10))


def test_nothing_is_found_beyond_a_map_that_knows_all():
    assert beyond_quantiles([case(1.0, 0.0, seed) for seed in range(3)]).max() < 0.7


def test_an_open_case_is_judged_by_the_others_and_sealed_ones_lend_nothing():
    wild = case(1.0, 50.0, 5, sealed=True)
    cases = [case(1.0, 3.0, 1), case(1.0, 3.0, 2), wild]
    rows = {row[0]: row for row in judged_table(cases)}
    assert rows["part_1"][7] == pytest.approx(0.95, abs=0.04)
    assert rows["part_5"][3] and rows["part_5"][7] < 0.4
    assert rows["part_1"][4] == pytest.approx(np.sqrt(10), rel=0.2)


def test_the_file_names_its_cases_and_its_command():
    kinds = ("matched", "coded", "time_of_flight")
    cases = [case(1.0, 2.0, n, kind) for n, kind in enumerate(kinds)] + [case(1.0, 9.0, 7, sealed=True)]
    text = beyond_map_document("python -m tests.proofs maps x.toml -o y.toml", cases)
    read = BeyondMap.model_validate(tomllib.loads(text))
    assert read.cases == ["part_0__x__white", "part_1__x__white", "part_2__x__white"]
    assert read.coded == fitted_sizes([cases[1]])
    with pytest.raises(ValueError, match="no view with both"):
        beyond_map_document("c", cases[:2])


def test_the_file_that_comes_along_is_read():
    shipped = beyond_map()
    assert shipped.command.startswith("python -m tests.proofs maps scenes/parts/validation.toml")
    assert {name.split("__")[1] for name in shipped.cases} >= {"kinect-v2", "ensenso-n10", "zivid-2-m70"}


@pytest.mark.parametrize("change", [{"levels": [0.5, 0.4]}, {"size": [2.0, 1.0]}, {"low": [0.0]}])
def test_sizes_out_of_order_are_refused(change):
    table = {"levels": [0.4, 0.5], "size": [1.0, 2.0], "low": [0.0, 1.0], "high": [2.0, 3.0]}
    with pytest.raises(ValueError, match=r"ascending|as many"):
        Sizes.model_validate(table | change)
