"""Digests of a study: of everything that determines its results, and of the files that its scene names.

Studies with the same digest have the same results. No other study may use the results in a folder.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

from mitsim.study import Study


def study_digest(study: Study, trials: str) -> str:
    """Return thirty-two hexadecimal digits of everything that determines the results of a study.

    ``trials`` is the digest of its trials (:func:`mitsim.study.virtual.plan.trial_digest`), which covers sensor, scene,
    task, views and unknowns.
    """
    content = {
        "trials": trials,
        "file": _study_keys(study),
        "series": [] if study.campaign is None else [one.name for one in study.campaign.series],
        "campaign": None if study.campaign is None else study.campaign.file.model_dump(mode="json"),
        "map": None if study.performance_map is None else map_digest(study),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:32]


def _study_keys(study: Study) -> dict[str, Any]:
    """Return all keys of a study, without a missing table that older versions did not have.

    Folders of older versions then keep their digest.
    """
    table = study.file.model_dump(mode="json")
    if table["exposure"] is None:
        del table["exposure"]
    return table


def map_digest(study: Study) -> str:
    """Return the SHA-256 of the values and attributes of a study's map."""
    assert study.performance_map is not None
    data = study.performance_map.data
    digest = hashlib.sha256(repr(sorted(data.attrs.items())).encode())
    for name in sorted(map(str, data.variables)):
        values = data[name].values
        digest.update(f"{name} {values.dtype} {values.shape}".encode())
        digest.update(values.astype("U").tobytes() if values.dtype == object else values.tobytes())
    return digest.hexdigest()


def with_scene_files(digest: str, study: Study) -> str:
    """Return sixteen hexadecimal digits of a digest and of the files that the scene names.

    Without files it is the digest itself. A mesh may change while the text of the scene stays the same.
    """
    scene = Path(study.scene.where)
    text = scene.read_bytes()
    named = {match.decode("utf-8", "replace") for match in re.findall(rb'value\s*=\s*["\']([^"\']+)["\']', text)}
    named |= {str(value) for value in study.file.parameters.values()}
    files = sorted(name for name in named if len(name) < 256 and "\0" not in name and (scene.parent / name).is_file())
    if not files:
        return digest
    parts = [digest, *(hashlib.sha256((scene.parent / name).read_bytes()).hexdigest() for name in files)]
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:16]
