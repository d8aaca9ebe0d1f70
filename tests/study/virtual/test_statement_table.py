"""The table of a statement in a terminal: decimal places by JCGM 100, 7.2.6, and accepted readings."""

import numpy as np
from scipy.stats import norm

from characterisation.statements.statement import statement
from characterisation.statements.tolerance import plus_minus
from characterisation.tasks.decision_table import Decision
from mitsim.study.virtual.stated import statement_table

NORMAL = norm.ppf((np.arange(200) + 0.5) / 200)


def row(errors, size, **rule) -> str:
    stated = statement("m", "mm", errors, plus_minus(70.0, size, Decision(**rule)))
    return " ".join(statement_table([stated]).splitlines()[1].split())


def test_a_bias_much_larger_than_u_keeps_the_digits_of_u():
    assert row(12.3412 + 0.01 * NORMAL, 100.0).startswith("m mm 12.341 0.010 12.321 to 12.361 -0.020 to 0.020")


def test_large_numbers_have_no_exponents():
    assert row(134.0 + 120 * NORMAL, 600.0).startswith("m mm 134 120 -106 to 374 -240 to 240")


def test_a_few_lost_values_are_not_none_and_many_are_not_all():
    assert " 0.5 % " in row(np.append(NORMAL[:199], np.nan), 5.0)
    assert " > 99 % " in row(np.append(np.full(997, np.nan), NORMAL[:3]), 5.0)


def test_readings_that_are_accepted_after_a_correction_say_so():
    assert "69.821 to 70.179, bias subtracted" in row(5 + 0.09 * NORMAL, 0.36, subtract_bias=True)
    assert "bias subtracted" not in row(0.09 * NORMAL, 0.36)


def test_accepted_readings_of_a_single_value_are_unknown_and_not_none():
    assert row(np.array([0.1]), 5.0).endswith(" - not decided")
    assert " none " in row(9 * NORMAL, 5.0)
