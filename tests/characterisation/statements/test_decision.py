"""Decision rules: closed forms, the worked examples of JCGM 106, and parts and errors that were drawn."""

import math
from statistics import NormalDist

import numpy as np
import pytest
from scipy.stats import binom, gamma, norm, t

from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.statements.decision import acceptance, decide, needed
from characterisation.statements.global_risks import global_risks
from characterisation.statements.statement import statement
from characterisation.statements.tolerance import Tolerance, plus_minus, tolerance_of
from characterisation.statements.verdict_words import Judged, in_words, result_reasons
from characterisation.tasks.decision_table import Decision
from characterisation.tasks.task_file import Task

SIMPLE = Decision(rule="simple_acceptance")


def normal_errors(u: float, count: int = 4000, bias: float = 0.0) -> np.ndarray:
    """A normal distribution as evenly likely errors, without chance."""
    return bias + u * norm.ppf((np.arange(count) + 0.5) / count)


def jcgm(consumer: float, producer: float, **process: float) -> Decision:
    return Decision(rule="jcgm_106", consumer_risk=consumer, producer_risk=producer, **process)


def task(decision: dict | None = None, kind: str = "radius", own: dict | None = None) -> dict:
    measurement = {"kind": kind, "features": ["pin"], "nominal": 5.0 if kind == "radius" else 0.0, "unit": "mm"}
    measurement |= {"tolerance": 0.2} | ({} if own is None else {"decision": own})
    pin = {"kind": "cylinder", "point_mm": [0, 0, 0], "direction": [0, 0, 1], "radius_mm": 5.0}
    pin["outline_mm"] = [[0, 0, 0], [0, 0, 10]]
    return {"features": {"pin": pin}, "measurements": {"m": measurement}} | (
        {} if decision is None else {"decision": decision}
    )


# the examples of JCGM 106:2012


def conformance_probability(reading: float, errors: np.ndarray, tolerance: Tolerance) -> float:
    """Return the probability that a part with this reading conforms, without other knowledge of it (JCGM 106, 7)."""
    value = reading - errors
    return float(((value >= tolerance.lower) & (value <= tolerance.upper)).mean())


def test_conformance_probabilities_of_jcgm_106_7():
    # 7.3.3, example 1: breakdown voltage -5.47 V with u = 0.05 V, at most -5.40 V: p_c = 0.92
    diode = Tolerance(-math.inf, -5.40, 1.0)
    assert conformance_probability(-5.47, normal_errors(0.05), diode) == pytest.approx(0.92, abs=0.005)
    # 7.4: viscosity 13.6 mm2/s with u = 1.8 mm2/s, 12.5 to 16.3 mm2/s: p_c = 0.66
    oil = Tolerance(12.5, 16.3, 1.9)
    assert conformance_probability(13.6, normal_errors(1.8), oil) == pytest.approx(0.66, abs=0.005)
    # the reading that ISO 14253-1 just accepts conforms with 97.5 %, and not with 95 %: the interval has two tails
    asked = plus_minus(0.0, 1.0)
    _, most = acceptance(normal_errors(0.1), asked)
    assert conformance_probability(most, normal_errors(0.1), asked) == pytest.approx(0.975, abs=1e-3)


def test_the_ball_bearings_of_jcgm_106_9_5_4():
    # radial error motion below 2 um; production follows a gamma distribution of mean 1 um and standard deviation
    # 0.5 um, measured with u = 0.25 um: R_C = 0.8 % and R_P = 1.7 % with the acceptance limit at 2 um; moved to 1.7 um
    # they are 0.1 % and 7 %
    errors = normal_errors(0.25)
    asked = Tolerance(-math.inf, 2.0, 2.0, jcgm(0.01, 0.02, process_mean=1.0, process_std=0.5))
    assert asked.process.mean() == pytest.approx(1.0) and asked.process.std() == pytest.approx(0.5)
    assert global_risks(errors, asked, (-math.inf, 2.0)) == pytest.approx((0.008, 0.017), abs=0.0006)
    consumer, producer = global_risks(errors, asked, (-math.inf, 1.7))
    assert consumer == pytest.approx(0.001, abs=0.0005) and producer == pytest.approx(0.07, abs=0.005)
    # the rule finds that limit from the risk
    tight = Tolerance(-math.inf, 2.0, 2.0, jcgm(consumer, 0.1, process_mean=1.0, process_std=0.5))
    limits = acceptance(errors, tight)
    assert limits == (-math.inf, pytest.approx(1.7, abs=1e-4))


# closed forms


def test_global_risks_of_normal_parts_and_errors_are_bivariate_normal():
    # JCGM 106, A.4: parts N(0, 0.5), errors N(0, 0.125), tolerance +-1; by quadrature of the double integral
    x = np.linspace(-6, 6, 20001) * 0.5
    density = norm.pdf(x, scale=0.5) * (x[1] - x[0])
    accepted = norm.cdf((1 - x) / 0.125) - norm.cdf((-1 - x) / 0.125)
    expected = (density * accepted)[abs(x) > 1].sum(), (density * (1 - accepted))[abs(x) <= 1].sum()
    asked = plus_minus(7.0, 1.0, jcgm(0.1, 0.1, process_std=0.5))
    assert global_risks(normal_errors(0.125), asked, (6.0, 8.0)) == pytest.approx(expected, abs=3e-5)
    same = plus_minus(7.0, 1.0, jcgm(0.1, 0.1, process_capability=1 / 1.5))
    assert global_risks(normal_errors(0.125), same, (6.0, 8.0)) == pytest.approx(expected, abs=3e-5)


@pytest.mark.parametrize("bias", [0.0, 0.03])
def test_iso_14253_takes_the_expanded_uncertainty_off_both_ends(bias):
    u, z = 0.01, NormalDist().inv_cdf(0.975)
    found = decide(normal_errors(u, bias=bias), plus_minus(20.0, 0.25))
    guard = bias + z * u
    assert found.accepted == pytest.approx((19.75 + guard, 20.25 - guard), abs=5e-5)
    assert found.demand == pytest.approx(guard / 0.25 / 0.25, rel=2e-3)
    assert found.verdict == "fits"
    # at the upper edge a reading is accepted if e < -guard, at the lower if e > guard
    assert found.false_accept == pytest.approx(
        max(norm.cdf(-(guard + bias) / u), norm.sf((guard - bias) / u)), abs=1e-3
    )
    assert found.false_reject == pytest.approx(1 - norm.cdf(-(guard + bias) / u), abs=1e-3)
    assert found.needed == pytest.approx(0.25 * 0.25 / z, rel=2e-3)
    assert found.consumer_risk is None


def test_a_subtracted_bias_costs_nothing():
    errors = normal_errors(0.01, bias=0.1)
    kept, gone = (decide(errors, plus_minus(20.0, 0.12, Decision(subtract_bias=flag))) for flag in (False, True))
    assert kept.verdict == "does not fit" and kept.accepted[1] - kept.accepted[0] < 0.01
    assert kept.fits_corrected and gone.fits_corrected
    assert gone.verdict == "fits" and gone.accepted == pytest.approx((19.88 + 0.0196, 20.12 - 0.0196), abs=1e-4)
    assert gone.needed == kept.needed


def test_what_is_needed_fits_and_a_little_more_does_not():
    rng = np.random.default_rng(2)
    errors = 0.02 * t.rvs(4, size=800, random_state=rng) + 0.01
    for rule in (Decision(), Decision(guard_share=0.5), SIMPLE, jcgm(0.005, 0.03, process_std=0.05)):
        asked = plus_minus(20.0, 0.15, rule)
        u = needed(errors, asked)
        centred = (errors - errors.mean()) / errors.std(ddof=1)
        assert decide(0.999 * u * centred, asked).demand < 1 < decide(1.001 * u * centred, asked).demand


@pytest.mark.parametrize("rule", [Decision(), SIMPLE, jcgm(0.005, 0.03, process_std=0.05)])
def test_what_is_needed_does_not_depend_on_the_number_of_trials(rule):
    asked = plus_minus(20.0, 0.15, rule)
    few, many = needed(np.array([-0.01, 0.012]), asked), needed(normal_errors(0.01), asked)
    assert few == pytest.approx(many, rel=0.01)


def test_a_single_value_leaves_a_measurement_not_decided_and_none_undecidable():
    assert decide(np.array([0.001]), plus_minus(20.0, 0.15)).verdict == "not decided"
    assert decide(np.array([]), plus_minus(20.0, 0.15)).verdict == "undecidable"


def test_a_few_trials_without_a_value_do_not_show_that_there_is_none():
    """Of a share of one half, four in a row are lost in 6 % of the cases, five in 3 %."""
    for trials, verdict in ((1, "not decided"), (4, "not decided"), (5, "undecidable"), (40, "undecidable")):
        stated = statement("radius", "mm", np.full(trials, np.nan), plus_minus(20.0, 0.15))
        assert stated.verdict == verdict
        words = in_words(result_reasons([Judged("radius", "mm", verdict, np.nan, np.nan, without_value=1.0)]))
        assert ("no value in the few virtual measurements" in words) == (verdict == "not decided")
        assert "a single virtual measurement" not in words


def test_where_the_uncertainty_is_as_large_as_the_tolerance_nothing_is_accepted():
    found = decide(normal_errors(0.12), plus_minus(20.0, 0.2))
    assert found.accepted is None and found.verdict == "undecidable"
    assert found.needed == pytest.approx(0.2 / 4 / 1.96, rel=0.01)  # a quarter of the tolerance at 1.96 u
    assert found.false_accept == 0 and found.false_reject == found.false_reject_nominal == 1
    simple = decide(normal_errors(0.12), plus_minus(20.0, 0.2, SIMPLE))
    assert simple.verdict == "undecidable" and simple.accepted is None


@pytest.mark.parametrize("rule", [Decision(), SIMPLE])
@pytest.mark.parametrize("count", [4, 10, 40])
def test_few_trials_do_not_show_that_no_reading_can_be_accepted(rule, count):
    """The expanded uncertainty is 0.9 of the tolerance: of 4 trials 78 % said "undecidable", of 40 trials 70 %."""
    rng, asked = np.random.default_rng(5), plus_minus(20.0, 1.0, rule)
    verdicts = [decide(0.9 / 1.96 * rng.standard_normal(count), asked).verdict for _ in range(200)]
    assert verdicts.count("undecidable") <= 10  # 2.5 % of 200 are 5, with a standard deviation of 2.2
    assert decide(normal_errors(3.0 / 1.96), asked).verdict == "undecidable"


def test_simple_acceptance_accepts_to_the_edge_where_it_is_a_coin_toss():
    found = decide(normal_errors(0.01), plus_minus(20.0, 0.1, SIMPLE))
    assert found.accepted == (19.9, 20.1) and found.verdict == "fits"
    assert found.false_accept == found.false_reject == pytest.approx(0.5, abs=1e-3)
    assert found.demand == pytest.approx(4 * 0.0196 / 0.1, rel=2e-3)
    strict = Decision(rule="simple_acceptance", uncertainty_ratio=10)
    assert decide(normal_errors(0.01), plus_minus(20.0, 0.1, strict)).verdict == "does not fit"


def test_a_zone_has_no_lower_limit():
    asked = Tolerance(-math.inf, 0.2, 0.2)
    errors = np.abs(normal_errors(0.01))
    found = decide(errors, asked)
    low, high = found.accepted
    assert low == -math.inf and high == pytest.approx(0.2 - 0.01 * norm.ppf(1 - 0.0125), abs=1e-4)
    assert found.false_accept == 0  # of errors that are never negative none brings a part back
    assert found.false_reject_nominal == 0


def test_jcgm_106_has_no_guard_where_the_process_is_good_enough():
    good = decide(normal_errors(0.01), plus_minus(20.0, 0.1, jcgm(0.01, 0.01, process_std=0.02)))
    assert good.accepted == (19.9, 20.1) and good.verdict == "fits"
    poor = decide(normal_errors(0.04), plus_minus(20.0, 0.1, jcgm(0.001, 0.01, process_std=0.06)))
    assert poor.consumer_risk == pytest.approx(0.001, rel=1e-3)
    assert poor.verdict == "does not fit" and poor.producer_risk == pytest.approx(0.01 * poor.demand)


# errors and parts that were drawn


@pytest.mark.parametrize("draw", ["normal", "heavy", "skew"])
def test_false_accepts_stay_at_the_stated_risk_when_worlds_are_drawn(draw):
    """200 trials state; then parts at the edge, or of a process, are measured with errors that nobody has seen."""
    rng = np.random.default_rng(3)

    def errors(count):
        match draw:
            case "normal":
                return rng.normal(0.004, 0.01, count)
            case "heavy":
                return 0.006 * t.rvs(3, size=count, random_state=rng)
            case _:
                return gamma.rvs(2.0, scale=0.006, size=count, random_state=rng) - 0.01

    edge = tried = accepted = parts = 0
    process = jcgm(0.003, 0.2, process_std=0.05)
    for _ in range(80):
        trials = errors(200)
        for side in (-1, 1):
            low, high = acceptance(trials, plus_minus(20.0, 0.1))
            reading = 20.0 + side * 0.1 + errors(20)
            edge, tried = edge + int(((reading >= low) & (reading <= high)).sum()), tried + 20
        low, high = acceptance(trials, plus_minus(20.0, 0.1, process))
        values = rng.normal(20.0, 0.05, 400)
        reading = values + errors(400)
        accepted += int(((reading >= low) & (reading <= high) & (abs(values - 20.0) > 0.1)).sum())
        parts += 400
    # 95 % coverage, of which at most 2.5 % lie beyond either end
    assert edge <= binom.ppf(0.9995, tried, 0.025)
    assert accepted <= binom.ppf(0.9995, parts, 0.003)
    assert accepted >= binom.ppf(0.0005, parts, 0.003) * 0.8  # the risk is used, not avoided


def test_normal_guard_bands_are_too_narrow_for_heavy_tails_and_trials_are_not():
    rng = np.random.default_rng(4)
    trials = 0.01 * t.rvs(2.2, size=4000, random_state=rng)
    fresh = 0.01 * t.rvs(2.2, size=40000, random_state=rng)
    process = jcgm(0.0005, 0.4, process_std=0.04)
    asked = plus_minus(0.0, 0.1, process)
    by_trials = acceptance(trials, asked)
    middle = float(np.median(abs(trials))) / norm.ppf(0.75)  # the standard deviation that the bulk shows
    as_normal = acceptance(normal_errors(middle), asked)
    risk = [global_risks(fresh, asked, limits)[0] for limits in (by_trials, as_normal)]
    assert risk[0] == pytest.approx(0.0005, rel=0.3) and risk[1] > 1.5 * 0.0005


def test_few_trials_leave_it_open():
    rng = np.random.default_rng(5)
    errors = rng.normal(0, 0.01, 12)
    edge = decide(errors, plus_minus(0.0, 4 * max(abs(errors)) * 1.2))
    assert edge.verdict == "not decided" and edge.demand_interval[0] < 1 < edge.demand_interval[1]
    none = decide(np.empty(0), plus_minus(0.0, 1.0))
    assert none.verdict == "undecidable" and none.accepted is None


# the keys of a task


def test_the_rule_of_a_task_and_of_one_measurement():
    plain = validate("task.toml", task(), Task)
    assert tolerance_of(plain, "m") == plus_minus(5.0, 0.2)
    both = validate("task.toml", task({"rule": "simple_acceptance"}, own={"guard_share": 0.5}), Task)
    assert tolerance_of(both, "m").rule == Decision(guard_share=0.5)
    small = task()
    small["measurements"]["m"] |= {"nominal": 0.1}
    assert tolerance_of(validate("task.toml", small, Task), "m") == Tolerance(
        -math.inf, pytest.approx(0.3), pytest.approx(0.3)
    )
    zone = validate("task.toml", task(kind="cylindricity"), Task)
    assert tolerance_of(zone, "m") == Tolerance(-math.inf, 0.2, 0.2)


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ({"decision": {"rule": "jcgm_106", "consumer_risk": 0.01}}, "producer_risk"),
        ({"decision": {"rule": "jcgm_106", "consumer_risk": 0.01, "producer_risk": 0.05}}, "process_std"),
        ({"decision": {"guard_share": 0.2, "rule": "simple_acceptance"}}, "guard_share is a key of"),
        ({"decision": {"rule": "iso"}}, "iso_14253_1"),
        (
            {
                "decision": {
                    "rule": "jcgm_106",
                    "consumer_risk": 0.01,
                    "producer_risk": 0.05,
                    "process_std": 0.1,
                    "process_capability": 1.3,
                }
            },
            "not both",
        ),
        (
            {
                "kind": "cylindricity",
                "own": {"rule": "jcgm_106", "consumer_risk": 0.01, "producer_risk": 0.05, "process_capability": 1.0},
            },
            "process_mean and process_std",
        ),
    ],
)
def test_what_a_rule_lacks_is_named(table, told):
    with pytest.raises(InputError, match=told):
        validate("task.toml", task(**table), Task)
