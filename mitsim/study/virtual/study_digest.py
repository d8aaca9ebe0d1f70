"""Digest of a study: of everything that determines its results.

Studies with the same digest have the same results. No other study may use the results in a folder.
"""

from __future__ import annotations

import hashlib
import json

from mitsim.study import Study
from mitsim.study.virtual.plan import map_digest


def study_digest(study: Study, trials: str) -> str:
    """Return thirty-two hexadecimal digits of everything that determines the results of a study.

    ``trials`` is the digest of its trials (:func:`mitsim.study.virtual.plan.trial_digest`), which covers sensor, scene
    with its files, task, views and unknowns.
    """
    content = {
        "trials": trials,
        "file": study.file.model_dump(mode="json"),
        "task": study.task.model_dump(mode="json"),
        "series": [] if study.campaign is None else [one.name for one in study.campaign.series],
        "campaign": None if study.campaign is None else study.campaign.file.model_dump(mode="json"),
        "map": map_digest(study),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:32]
