"""Tell which captures a sensor or a calibration was fitted to: compared with one of them, it shows the fit."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from characterisation.files.documents import Document, validate
from characterisation.files.errors import InputError


class FittedCapture(Document):
    """A capture that decided fitted numbers: its ``name``, and the digest of its images (:func:`images_digest`)."""

    name: str = Field(min_length=1, max_length=4096)
    images_sha256: str = Field(pattern="^[0-9a-f]{64}$")


class _Records(Document):
    fitted_to: tuple[FittedCapture, ...] = Field(default=(), max_length=10000)


def images_digest(images: Mapping[str, NDArray[np.generic]]) -> str:
    """Return the SHA-256 of the grey levels (P, H, W) of all cameras; names, calibration and folder do not count."""
    return joined_digest(stack_digest(stack) for stack in images.values())


def note_images(found: dict[str, str], images: Mapping[str, NDArray[np.generic]], where: str | Path) -> None:
    """Add the digest of a capture's images to those ``found``, and reject a copy of one of them.

    Images of one level each may be equal by rounding, in the dark. Raises InputError if the images are those of another
    capture.
    """
    if all(stack.min() == stack.max() for stack in images.values()):
        return
    digest = images_digest(images)
    if digest in found:
        hint = "the same noise twice is not a repeat"
        raise InputError(where, "images", f"those of {found[digest]}", "each capture once", hint)
    found[digest] = str(where)


def stack_digest(stack: NDArray[np.generic]) -> bytes:
    """Return the digest of the images (P, H, W) of one camera."""
    return hashlib.sha256(f"{stack.dtype}{stack.shape}".encode() + stack.tobytes()).digest()


def joined_digest(stacks: Iterable[bytes]) -> str:
    """Return the digest of a capture's images from those of its cameras (:func:`stack_digest`)."""
    return hashlib.sha256(b"".join(stacks)).hexdigest()


def records_of(fitted_to: Iterable[FittedCapture]) -> dict[str, Any]:
    """Return the settings of a simulated capture that state the fit of its sensor; empty without a fit."""
    listed = [capture.model_dump() for capture in fitted_to]
    return {"fitted_to": listed} if listed else {}


def recorded_in(settings: Mapping[str, Any], where: str | Path) -> tuple[FittedCapture, ...]:
    """Return the captures that the sensor of a simulated capture was fitted to, by its settings.

    Raises InputError if the settings state them in another form.
    """
    return validate(where, {"fitted_to": settings.get("fitted_to", [])}, _Records).fitted_to


def shows_the_fit(fitted_to: Iterable[FittedCapture], images: Mapping[str, NDArray[np.generic]], subject: str) -> str:
    """Return a sentence if ``subject`` was fitted to these images, else an empty text."""
    fitted = tuple(fitted_to)
    digest = images_digest(images) if fitted else ""
    name = next((capture.name for capture in fitted if capture.images_sha256 == digest), None)
    if name is None:
        return ""
    return (
        f"{subject} was fitted to these images ({name}): agreement with them shows the fit, not a prediction; use a "
        "capture that had no part in it"
    )
