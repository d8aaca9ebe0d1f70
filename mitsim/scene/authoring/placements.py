"""Reject mirrored and scaled components of a STEP file.

OpenCASCADE turns a mirrored component by half a turn instead, and leaves a scaled one at its size.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from characterisation.files.errors import InputError
from mitsim.scene.authoring.part21 import StepText

_BOTH = ("CARTESIAN_TRANSFORMATION_OPERATOR", "CARTESIAN_TRANSFORMATION_OPERATOR_3D")


def check_placements(path: Path, text: StepText) -> None:
    """Check that operators that place components are rigid; InputError with the number of the first that is not."""
    for entity in text.all(_BOTH[1]):
        *_, first, second, _, scale, third = (None,) * 5 + sum((entity.of(kind) or () for kind in _BOTH), ())
        axes = np.eye(3)
        for number, way in enumerate((first, second, third)):
            direction = text.follow(way)
            ratios = direction.of("DIRECTION") if direction is not None else None
            if ratios and isinstance(ratios[-1], tuple) and [type(ratio) for ratio in ratios[-1]] == [float] * 3:
                axes[number] = ratios[-1]
        mirrored = np.linalg.det(axes) < 0
        if mirrored or (isinstance(scale, float) and not math.isclose(scale, 1.0)):
            distortion = "mirrored" if mirrored else f"scaled by {scale:g}"
            hint = "save it as one part, or with a part of its own for each hand and size"
            raise InputError(
                path, f"#{entity.number}", f"a component that is placed {distortion}", "rigid placements", hint
            )
