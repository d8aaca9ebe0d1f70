"""Limits of a set are those of statements. The map predicts a larger error of values that fold, of a nominal part."""

from types import SimpleNamespace

import numpy as np
import pytest

from characterisation.features.fitted import with_covariance
from characterisation.tasks.covariance import ExpectedFit
from characterisation.tasks.measurement_model import InputQuantity
from characterisation.tasks.prediction import ExpectedInput
from characterisation.tasks.task_file import Task
from mitsim.study import SetTable
from mitsim.study.scoring import set_within
from mitsim.study.screened_errors import stated_shares
from tests.two_balls import TASK

NOISE = 0.02

#: the offset of two balls that are nominally concentric
BALL = {"kind": "sphere", "point_mm": [0.0, 0.0, 0.0], "radius_mm": 10.0}
CONCENTRIC = Task.model_validate(
    {
        "features": {"inner": BALL, "outer": BALL | {"radius_mm": 20.0}},
        "measurements": {
            "offset": {"kind": "point_distance", "features": ["inner", "outer"], "nominal": 0.0, "unit": "mm"},
            "radius": TASK.measurements["radius"].model_dump(exclude_unset=True) | {"features": ["inner"]},
        },
    }
)


def seen() -> dict[InputQuantity, ExpectedInput]:
    """Balls whose centres and radii are known to the noise along each axis."""
    covariance, out = NOISE**2 * np.eye(4), {}
    for name, feature in CONCENTRIC.features.items():
        surface = feature.nominal()
        fit = ExpectedFit(covariance, np.zeros((4, 3)), 1000.0, 1.0, surface.centre, NOISE)
        out[InputQuantity("feature", (name,))] = ExpectedInput(fit, with_covariance(surface, covariance))
    return out


def found(limits: dict[str, float]):
    table = SetTable(limits=limits, joining="exact")
    study = SimpleNamespace(task=CONCENTRIC, file=SimpleNamespace(set=table), scene=SimpleNamespace(centre=np.zeros(3)))
    return set_within(study, [seen()] * 4, stated_shares(CONCENTRIC), limits)


@pytest.mark.parametrize(("limit", "count"), [(1.5, 1), (1.1, 2), (0.6, None)])
def test_an_offset_is_searched_by_its_error_far_from_nominal(limit, count):
    """It is one component of an error of sqrt(2 / n) sigma along each axis; that of a perfect part is all three."""
    chosen = found({"offset": limit * NOISE, "radius": 10.0})
    if count is None:
        assert chosen.feasible.tolist() == [False, True]
        return
    assert chosen.feasible.all() and len(chosen.views) == count
    np.testing.assert_allclose(chosen.uncertainty, NOISE * np.sqrt([2 / count, 1 / count]), rtol=0.03)
