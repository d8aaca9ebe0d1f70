"""Exposures of a study's virtual measurements: planned for a view, kept in its folder, told as a table.

Signal chain: study and view -> plan (:mod:`mitsim.exposures.exposure_plan`), or the exposures that the study gives ->
``exposures/view_0012.json`` -> maker of the same virtual measurements with them, and trials of their own.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from pydantic import ConfigDict, Field

from characterisation.atomic_io import atomic_write, write_json
from characterisation.checked_files import read_json_object
from characterisation.documents import Document, validate
from characterisation.errors import InputError
from mitsim.exposures.exposure_plan import ExposurePlan, PlanRules, plan_exposures
from mitsim.exposures.exposure_sweep import ExposureSweep, Look
from mitsim.progress import say
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study import ExposureTable, Study
from mitsim.text_table import aligned
from mitsim.views import View
from mitsim.virtual.mapped import MappedMeasurements
from mitsim.virtual.race import Maker
from mitsim.virtual.rendered import RenderedMeasurements
from mitsim.virtual.trials import TrialFolder

#: limits of exposures that a sensor file has if it says nothing: no device's
_NO_LIMITS = (1e-9, 1e3)

#: raised when the same light would be planned otherwise
PLAN_VERSION = 1


@runtime_checkable
class Exposable(Protocol):
    """A maker whose exposure can be chosen."""

    def exposed_as(self, planned: PlannedExposure | None) -> Maker:
        """The same measurements, exposed otherwise."""


@dataclass(frozen=True)
class Exposed:
    """What makes the trials of one view, its ``digest``, and how they are exposed; ``planned`` None by the sensor."""

    maker: Maker
    digest: str
    planned: PlannedExposure | None

    def trials(self, study: Study, folder: Path, own: TrialFolder) -> TrialFolder:
        """Where the trials are kept in a folder: of the sensor's own exposure with all others, in its ``own``."""
        if self.planned is None:
            return own
        return TrialFolder(folder / "planned_trials", self.digest, list(study.task.measurements))


def exposed_for(
    study: Study, view: View, here: RenderedMeasurements | MappedMeasurements, maker: Maker, digest: str, folder: Path
) -> Exposed:
    """The measurements of a view with the exposure that the study asks for: see :func:`planned_for`.

    ``maker`` makes the trials of ``digest``, ``here`` or in other processes.
    """
    planned = planned_for(study, view, here, digest, folder)
    if planned is None:
        return Exposed(maker, digest, None)
    assert isinstance(maker, Exposable)  # a map was refused
    return Exposed(maker.exposed_as(planned), with_exposure(digest, planned), planned)


class _Kept(Document):
    """The part of a kept plan that virtual measurements need."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    digest: str
    exposures_s: list[float] = Field(min_length=1, max_length=7)
    power: float = Field(gt=0, le=1)


def planned_for(
    study: Study, view: View, here: RenderedMeasurements | MappedMeasurements, digest: str, folder: Path
) -> PlannedExposure | None:
    """How captures of a view are exposed: as the study says, or as planned; None by the sensor's own rule.

    A plan that the ``folder`` keeps of the same ``digest`` is not made again.

    Raises
    ------
    InputError
        If measurements come from a map, which has the exposure that it was made with.
    """
    table = study.file.exposure
    if table is None:
        return None
    maker = rendered(study, here)
    if table.exposures_s is not None:
        given = PlannedExposure(tuple(sorted(table.exposures_s)), table.power)
        _check_given(study, given, table)
        return given
    rules = PlanRules(table.most, table.within)
    path = plan_path(folder, view.number)
    told = with_exposure(digest, None, asdict(rules))
    if path.exists():
        try:
            kept = validate(path, read_json_object(path), _Kept)
        except InputError:
            kept = None
        if kept is not None and kept.digest == told:
            return PlannedExposure(tuple(kept.exposures_s), kept.power)
    plan = plan_view(study, maker, view, rules)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, plan_document(study, plan) | {"digest": told})
    say(f"view {view.number}: {plan_in_words(plan)}")
    return plan.exposure


def plan_view(study: Study, maker: RenderedMeasurements, view: View, rules: PlanRules) -> ExposurePlan:
    """Plan the exposures of one view, from one tracing of its light."""
    policy = study.sensor.exposure
    if policy.limits_s == _NO_LIMITS:
        say(f"{study.sensor.name} states no limits of its exposure: any is taken as possible")
    own = PlannedExposure(policy.exposures(None, float(study.sensor.imager.full_well)))
    sweep = ExposureSweep(maker, view)
    if not study.sensor.merges_exposures:
        say(f"{study.sensor.name} cannot merge exposures: one is planned")
        rules = PlanRules(1, rules.within)
    return plan_exposures(sweep.look, own, policy.limits_s, rules, sweep.dimmable, view.number)


def rendered(study: Study, here: RenderedMeasurements | MappedMeasurements) -> RenderedMeasurements:
    """The maker, if it renders.

    Raises
    ------
    InputError
        If it draws clouds from a map.
    """
    if not isinstance(here, RenderedMeasurements):
        raise InputError(
            study.path,
            "exposure",
            "exposures to be planned, and measurements drawn from a map",
            "measurements that are rendered",
            'a map has the exposure that it was made with: set measure.by = "render"',
        )
    return here


def _check_given(study: Study, given: PlannedExposure, table: ExposureTable) -> None:
    shortest, longest = study.sensor.exposure.limits_s
    for seconds in given.exposures_s:
        if not shortest <= seconds <= longest:
            raise InputError(
                study.path,
                "exposure.exposures_s",
                f"{seconds:g} s",
                f"{shortest:g} to {longest:g} s",
                f"what {study.sensor.name} can do",
            )
    if len(given.exposures_s) > 1 and not study.sensor.merges_exposures:
        raise InputError(
            study.path,
            "exposure.exposures_s",
            f"{len(given.exposures_s)} exposures",
            "one",
            f"{study.sensor.name} cannot merge any",
        )


def plan_path(folder: Path, view: int) -> Path:
    """Where a folder keeps the plan of a view."""
    return folder / "exposures" / f"view_{view:04d}.json"


def with_exposure(digest: str, planned: PlannedExposure | None, more: Any = None) -> str:
    """Sixteen hexadecimal digits of a trial's digest and of how it is exposed."""
    told = repr([PLAN_VERSION, digest, None if planned is None else asdict(planned), more])
    return hashlib.sha256(told.encode()).hexdigest()[:16]


def plan_document(study: Study, plan: ExposurePlan) -> dict[str, Any]:
    """A plan as JSON values; see docs/reference/formats/exposures.md."""
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
        "unseen": list(plan.unseen),
        "limits": {
            name: {"points": one.points, "fraction": one.fraction, "u_mm": _number(one.u)}
            for name, one in plan.limits.items()
        },
        "own": _look(plan.own),
        "added": [{"exposure_s": seconds} | _look(look) for seconds, look in plan.added],
    }


def _look(look: Look) -> dict[str, Any]:
    return {
        "exposures_s": list(look.exposure.exposures_s),
        "features": {
            name: {"points": round(one.points, 1), "fraction": round(one.fraction, 4), "u_mm": _number(one.u)}
            for name, one in look.features.items()
        },
    }


def _number(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None


def plan_table(plan: ExposurePlan) -> str:
    """A plan as a table of text: what to type in, and what each exposure adds."""
    names = list(plan.own.features)
    head = ("capture", "exposure [ms]", "power", *(f"{name}: points, F, u [um]" for name in names))
    rows = [head, ("sensor's own", *_typed(plan.own.exposure), *(_cell(plan.own, name) for name in names))]
    for k, (seconds, look) in enumerate(plan.added):
        what = "1" if k == 0 else f"and {k + 1}, merged"
        rows.append(
            (what, f"{1e3 * seconds:.3g}", f"{100 * plan.exposure.power:.0f} %", *(_cell(look, name) for name in names))
        )
    limit = [
        f"{one.points:.0f}  {one.fraction:.2f}  {1e3 * one.u:.1f}" if (one := plan.limits.get(name)) else "not reached"
        for name in names
    ]
    rows.append(("limit", "", "", *limit))
    return "\n".join(aligned(rows))


def write_plan_csv(path: Path, plan: ExposurePlan) -> None:
    """The exposures and what each adds as a CSV file: a row for each feature of each step."""
    lines = ["step,exposure_ms,power,feature,points,fraction,u_mm"]
    steps = [("own", ";".join(f"{1e3 * one:.4g}" for one in plan.own.exposure.exposures_s), plan.own, 1.0)]
    steps += [
        (str(k), f"{1e3 * seconds:.4g}", look, plan.exposure.power) for k, (seconds, look) in enumerate(plan.added, 1)
    ]
    for step, exposure, look, power in steps:
        for name, one in look.features.items():
            u = f"{one.u:.4g}" if math.isfinite(one.u) else ""
            lines.append(f"{step},{exposure},{power:g},{name},{one.points:.1f},{one.fraction:.4f},{u}")
    with atomic_write(path) as file:
        file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def exposure_in_words(planned: PlannedExposure) -> str:
    """Like ``0.82 and 3.3 ms, merged, at full power``."""
    times = [f"{1e3 * seconds:.3g}" for seconds in planned.exposures_s]
    several = f"{', '.join(times[:-1])} and {times[-1]} ms, merged" if len(times) > 1 else f"{times[0]} ms"
    power = "full power" if planned.power == 1 else f"{100 * planned.power:.0f} % of the power"
    return f"{several}, at {power}"


def plan_in_words(plan: ExposurePlan) -> str:
    """One line: what to set, and whether that is all that can be had."""
    if not plan.limits:
        return f"no exposure brings enough points of any feature that is needed: {', '.join(plan.unseen)}"
    count = len(plan.exposure.exposures_s)
    said = f"expose {exposure_in_words(plan.exposure)}: "
    if plan.reached:
        said += "every feature" if not plan.unseen else "every other feature"
        said += f" is at its limit with {count} exposure{'s' if count > 1 else ''}"
    else:
        said += "the limits are not all reached, and no other set that was tried comes much nearer"
    return said + (f"; out of reach from here at any exposure: {', '.join(plan.unseen)}" if plan.unseen else "")


def _typed(planned: PlannedExposure) -> tuple[str, str]:
    return ", ".join(f"{1e3 * one:.3g}" for one in planned.exposures_s), f"{100 * planned.power:.0f} %"


def _cell(look: Look, name: str) -> str:
    one = look.features[name]
    u = f"{1e3 * one.u:.1f}" if math.isfinite(one.u) else "-"
    return f"{one.points:.0f}  {one.fraction:.2f}  {u}"
