"""Plan the exposures of a study's views, store the plans, and print them.

Signal chain: study and view -> plan (:mod:`mitsim.study.exposures.exposure_plan`), or the exposures that the study
gives -> ``exposures/view_0012.json`` -> exposures for virtual measurements, table, CSV file.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import Field

from characterisation.files.atomic_io import write_json, write_text
from characterisation.files.checked_files import read_json_object
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.words.numbers import aligned
from characterisation.words.progress import say
from mitsim.running.time_limit import TimeLimit
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study import Study
from mitsim.study.exposures.exposure_plan import ExposurePlan, PlanRules, plan_exposures
from mitsim.study.exposures.exposure_sweep import ExposureResult, ExposureSweep, FeatureResult
from mitsim.study.statement_file import PartialDocument
from mitsim.study.virtual.mapped import MappedMeasurements
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.views import View

#: default exposure limits of a sensor file [s], which are not those of a device
_NO_LIMITS = (1e-9, 1e3)

#: version of the planning rules; a stored plan of another version is not used
PLAN_VERSION = 1


class _StoredPlan(PartialDocument):
    """The keys of a stored plan that virtual measurements need."""

    digest: str
    exposures_s: list[float] = Field(min_length=1, max_length=7)
    power: float = Field(gt=0, le=1)


def kept_plan(
    renderer: RenderedMeasurements,
    view: View,
    rules: PlanRules,
    folder: Path,
    digest: str,
    limit: TimeLimit | None = None,
) -> PlannedExposure:
    """Return the planned exposures of a view, kept in a folder for the ``digest`` of all that determines a trial."""
    path = folder / f"view_{view.number:04d}.json"
    digest_of_plan = with_exposure(digest, None, asdict(rules))
    if path.exists():
        try:
            stored = validate(path, read_json_object(path), _StoredPlan)
        except InputError:
            stored = None
        if stored is not None and stored.digest == digest_of_plan:
            return PlannedExposure(tuple(stored.exposures_s), stored.power)
    plan = plan_view(renderer, view, rules, limit)
    if plan.finished:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, plan_document(renderer.study, plan) | {"digest": digest_of_plan})
    say(f"view {view.number}: {plan_in_words(plan)}")
    return plan.exposure


def plan_view(
    renderer: RenderedMeasurements, view: View, rules: PlanRules, limit: TimeLimit | None = None
) -> ExposurePlan:
    """Plan the exposures of one view; its light is traced once.

    Parameters
    ----------
    renderer, view, rules
        Virtual measurements, view, and rules of the plan.
    limit
        Time, none by default. If it ends before the plan, the best single exposure that was tried is the plan.
    """
    sensor = renderer.study.sensor
    policy = sensor.exposure
    if policy.limits_s == _NO_LIMITS:
        say(f"{sensor.name} states no exposure limits: any exposure is allowed")
    default = PlannedExposure(policy.exposures(None, float(sensor.imager.full_well)))
    sweep, limit = ExposureSweep(renderer, view), limit or TimeLimit()
    if not sensor.merges_exposures:
        say(f"{sensor.name} cannot merge exposures: the plan has one exposure")
        rules = PlanRules(1, rules.within)
    return plan_exposures(sweep.evaluate, default, policy.limits_s, rules, sweep.dimmable, view.number, limit.over)


def rendered(measurements: RenderedMeasurements | MappedMeasurements) -> RenderedMeasurements:
    """Return the virtual measurements, if they are rendered.

    Raises InputError if they are drawn from a map.
    """
    if not isinstance(measurements, RenderedMeasurements):
        raise InputError(
            measurements.study.path,
            "exposure",
            "exposures, and measurements that are drawn from a map",
            "rendered measurements",
            'a map holds only for the exposure that it was made with: set measure.by = "render"',
        )
    return measurements


def stated_exposures(study: Study, exposures_s: Sequence[float], power: float) -> PlannedExposure:
    """Return the exposures [s] that a study states; InputError if the sensor cannot take or merge them."""
    planned = PlannedExposure(tuple(sorted(exposures_s)), power)
    (shortest, longest), sensor = study.sensor.exposure.limits_s, study.sensor.name
    for seconds in planned.exposures_s:
        if not shortest <= seconds <= longest:
            allowed, hint = f"{shortest:g} to {longest:g} s", f"these are the limits of {sensor}"
            raise InputError(study.path, "exposure.exposures_s", f"{seconds:g} s", allowed, hint)
    if len(planned.exposures_s) > 1 and not study.sensor.merges_exposures:
        several, hint = f"{len(planned.exposures_s)} exposures", f"{sensor} cannot merge exposures"
        raise InputError(study.path, "exposure.exposures_s", several, "one", hint)
    return planned


def with_exposure(digest: str, planned: PlannedExposure | None, more: Any = None) -> str:
    """Return the digest of trials with their exposures: 16 hexadecimal digits of a SHA-256."""
    content = repr([PLAN_VERSION, digest, None if planned is None else asdict(planned), more])
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def plan_document(study: Study, plan: ExposurePlan) -> dict[str, Any]:
    """Return a plan as JSON values; the keys are in docs/reference/formats/exposures.md."""
    return {
        "schema_version": 1,
        "study": str(study.path),
        "sensor": study.sensor.name,
        "view": plan.view,
        "exposures_s": list(plan.exposure.exposures_s),
        "power": plan.exposure.power,
        "reached": plan.reached,
        "limits_s": list(study.sensor.exposure.limits_s),
        "sets_tried": plan.sets_tried,
        "finished": plan.finished,
        "unseen": list(plan.unseen),
        "limits": {
            name: {"points": limit.points, "fraction": limit.fraction, "u_mm": _number(limit.u)}
            for name, limit in plan.limits.items()
        },
        "own": _result_values(plan.default),
        "added": [{"exposure_s": seconds} | _result_values(result) for seconds, result in plan.added],
    }


def _result_values(result: ExposureResult) -> dict[str, Any]:
    return {
        "exposures_s": list(result.exposure.exposures_s),
        "features": {
            name: {
                "points": round(feature.points, 1),
                "fraction": round(feature.fraction, 4),
                "u_mm": _number(feature.u),
            }
            for name, feature in result.features.items()
        },
    }


def _number(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None


def plan_table(plan: ExposurePlan) -> str:
    """Return a plan as a table of text: the exposures to set, and the result that each adds."""
    names = list(plan.default.features)
    times = ", ".join(f"{1e3 * seconds:.3g}" for seconds in plan.default.exposure.exposures_s)
    steps = [("sensor's own", times, plan.default.exposure.power, plan.default.features)]
    for k, (seconds, result) in enumerate(plan.added, 1):
        step_name = "1" if k == 1 else f"and {k}, merged"
        steps.append((step_name, f"{1e3 * seconds:.3g}", plan.exposure.power, result.features))
    rows = [("capture", "exposure [ms]", "power", *(f"{name}: points, F, u [um]" for name in names))]
    rows += [
        (step_name, exposure, f"{100 * power:.0f} %", *(_feature_text(features[name]) for name in names))
        for step_name, exposure, power, features in steps
    ]
    limits = [_feature_text(plan.limits[name]) if name in plan.limits else "not reached" for name in names]
    return "\n".join(aligned([*rows, ("limit", "", "", *limits)]))


def write_plan_csv(path: Path, plan: ExposurePlan) -> None:
    """Write a plan as a CSV file, with one row for each feature of each step."""
    lines, power = ["step,exposure_ms,power,feature,points,fraction,u_mm"], plan.exposure.power
    steps = [
        ("own", ";".join(f"{1e3 * seconds:.4g}" for seconds in plan.default.exposure.exposures_s), plan.default, 1.0)
    ]
    steps += [(str(k), f"{1e3 * seconds:.4g}", result, power) for k, (seconds, result) in enumerate(plan.added, 1)]
    for step, exposure, result, power in steps:
        for name, feature in result.features.items():
            u = f"{feature.u:.4g}" if math.isfinite(feature.u) else ""
            lines.append(f"{step},{exposure},{power:g},{name},{feature.points:.1f},{feature.fraction:.4f},{u}")
    write_text(path, "\n".join(lines) + "\n")


def exposure_in_words(planned: PlannedExposure) -> str:
    """Return exposures in words, such as ``0.82 and 3.3 ms, merged, at full power``."""
    times = [f"{1e3 * seconds:.3g}" for seconds in planned.exposures_s]
    several = f"{', '.join(times[:-1])} and {times[-1]} ms, merged" if len(times) > 1 else f"{times[0]} ms"
    power = "full power" if planned.power == 1 else f"{100 * planned.power:.0f} % of the power"
    return f"{several}, at {power}"


def plan_in_words(plan: ExposurePlan) -> str:
    """Return one line: the exposures to set, and whether they reach all limits."""
    if not plan.limits:
        return f"no exposure gives enough points on any feature that the task needs: {', '.join(plan.unseen)}"
    count = len(plan.exposure.exposures_s)
    text = f"expose {exposure_in_words(plan.exposure)}: "
    if not plan.finished:
        tried = f"the best of {plan.sets_tried}" if plan.sets_tried > 1 else "the only one"
        text += f"{tried} that time allowed to try"
    elif plan.reached:
        text += "every feature" if not plan.unseen else "every other feature"
        text += f" is at its limit with {count} exposure{'s' if count > 1 else ''}"
    else:
        text += "not all limits are reached, and no other set that was tried comes much closer"
    return text + (f"; too few points from this view at any exposure: {', '.join(plan.unseen)}" if plan.unseen else "")


def _feature_text(result: FeatureResult) -> str:
    u = f"{1e3 * result.u:.1f}" if math.isfinite(result.u) else "-"
    return f"{result.points:.0f}  {result.fraction:.2f}  {u}"
