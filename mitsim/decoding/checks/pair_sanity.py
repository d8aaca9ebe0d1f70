"""Check whether the images of two cameras and their calibration belong together.

Signal chain: coordinates along rectified rows of two cameras that see one code -> disparity, and row error by the other
coordinate or by the texture of the surface (:mod:`mitsim.decoding.checks.row_texture`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.files.arrays import Floats
from mitsim.decoding.checks.rig_sanity import COARSE, half_stripe
from mitsim.decoding.checks.row_texture import LARGEST_SPREAD, rectified, textured_row_error, uniform_light_mean
from mitsim.decoding.coded_images import CodedImages
from mitsim.decoding.matching.stereo_geometry import StereoGeometry
from mitsim.decoding.matching.texture_matches import LEAST_PAIRS, texture_matches
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.decoding.structured_light.two_cameras import find_coordinates
from mitsim.sensor.camera import Rig
from mitsim.sensor.image_role import Axis
from mitsim.sensor.light_code import roles

#: largest row error of a pair [px]; a stereo matcher begins to lose points at about this
LARGEST_ROW_ERROR = 0.3

#: least share of the first camera's decoded pixels that the second has in the same rows
_LEAST_MATCHED = 0.1

#: row error [px] of a rig that has moved; beyond, the calibration is of another rig
_MOVED = 6.0

#: half the distances [px] over which the slope of the projector rows is measured, until they span two stripes
_SLOPE_ROWS = (2.0, 4.0, 8.0, 16.0, 32.0)

#: parts of an image along either side, over each of which rows are averaged; chosen
_PARTS = 6

#: least number of pixels of a mean; chosen
_ENOUGH = 30


@dataclass(frozen=True)
class Findings:
    """Findings about a capture: ``warnings``, and ``row_error`` [px] of the second camera; NaN if unknown.

    ``row_error_source``: the source of the row error, "" if unknown.
    """

    warnings: list[str] = field(default_factory=list)
    row_error: float = float("nan")
    row_error_source: str = ""


def pair_findings(images: CodedImages, rig: Rig, geometry: StereoGeometry) -> Findings:
    """Check two cameras that see one code: exchanged, another calibration, or a row error.

    The source of the row error is the code of the rows if present, else the texture of the surface. It is unknown if
    neither gives it, or the calibration is doubtful.
    """
    exchangeable = geometry.raw_size[0] == geometry.raw_size[1]
    names = " and ".join(list(rig.cameras)[:2])
    exchanged = (
        f"the images of {names} fit the calibration if they are exchanged: check whether left and right are exchanged"
    )
    coordinates = list(images.coordinates.values())
    matches = _Matches.of(coordinates, geometry)
    if matches.decoded < 0.005:
        return Findings()
    textures, doubt = None, "check that the calibration belongs to these images"
    if not np.isfinite(matches.row_error):
        image_roles = roles(images.code, *images.size)
        textures = [uniform_light_mean(stack, image_roles, images.full_scale) for stack in images.stacks.values()]
        columns = coordinates[0]["columns"].value, coordinates[1]["columns"].value
        contradiction, other_order = _texture_contradiction((textures[0], textures[1]), columns, rig, geometry)
        if contradiction:
            fits = exchangeable and other_order
            return Findings([exchanged if fits else f"{contradiction}: {doubt}"])
    if matches.doubtful:
        if exchangeable and not _Matches.of(coordinates[::-1], geometry).doubtful:
            return Findings([exchanged])
        return Findings([f"{matches}: {doubt}"])
    offset, source = matches.row_error, "by the code of the rows"
    if textures is not None:
        offset = textured_row_error((textures[0], textures[1]), columns, geometry)
        source = "by the texture of the surface"
    return Findings(row_error_warnings(offset), offset, source) if np.isfinite(offset) else Findings()


def plain_pair_warning(images: tuple[Floats, Floats], rig: Rig, geometry: StereoGeometry) -> str:
    """Warn if two images (H, W) [DN] without a code contradict their calibration; ``geometry`` of that ``rig``."""
    names = " and ".join(list(rig.cameras)[:2])
    if images[0].shape == images[1].shape and np.array_equal(*images):
        return f"the images of {names} are the same: one is a copy of the other"
    everywhere = np.zeros(images[0].shape), np.zeros(images[1].shape)
    contradiction, other_order = _texture_contradiction(images, everywhere, rig, geometry)
    if not contradiction:
        return ""
    if other_order and geometry.raw_size[0] == geometry.raw_size[1]:
        return f"the images of {names} fit the calibration if they are exchanged: check whether they are"
    doubt = (
        "check that the calibration belongs to these images, that they are as the cameras gave them (not undistorted)"
    )
    return f"{contradiction}: {doubt}, and that R and T are not inverted"


def _texture_contradiction(
    textures: tuple[Floats, Floats], columns: tuple[Floats, Floats], rig: Rig, geometry: StereoGeometry
) -> tuple[str, bool]:
    """Describe how texture in all rows contradicts the calibration, "" if it does not; whether the other order fits."""
    pixels = texture_matches(textures, columns)
    if len(pixels[0]) < LEAST_PAIRS:
        return "", False
    errors, other = (_row_errors(*order, rig, geometry) for order in (pixels, pixels[::-1]))
    if errors.fits:
        return "", False
    return f"{errors}, by the texture of the surface", other.fits


@dataclass(frozen=True)
class _RowErrors:
    """Row error [px] of matched texture: its ``median`` and rms, ``spread``; share that lies ``behind`` the cameras."""

    median: float
    spread: float
    behind: float

    @property
    def fits(self) -> bool:
        """Return whether the calibration, or that of a rig that has moved since, explains the matches."""
        varying = np.sqrt(max(self.spread**2 - self.median**2, 0.0))
        return self.behind <= 0.5 and abs(self.median) <= _MOVED and varying <= LARGEST_SPREAD + 0.5 * abs(self.median)

    def __str__(self) -> str:
        if self.behind > 0.5:
            return f"{100 * self.behind:.0f} % of the common points lie behind the cameras"
        return f"the rows of the two cameras are {self.spread:.1f} px apart after rectification"


def _row_errors(left: Floats, right: Floats, rig: Rig, geometry: StereoGeometry) -> _RowErrors:
    """Return the row error of raw pixels (n, 2) of the first and second camera that show the same point."""
    pair, points = geometry.rectification, []
    for eye, pixels, turn, matrix in zip(
        rig.cameras.values(),
        (left, right),
        (pair.rotation_left, pair.rotation_right),
        (pair.matrix_left, pair.matrix_right),
        strict=False,
    ):
        rays = eye.rays(pixels) @ turn.T
        with np.errstate(invalid="ignore", divide="ignore"):
            points.append((rays / rays[:, 2:]) @ matrix.T)
    error = points[1][:, 1] - points[0][:, 1]
    disparity = points[0][:, 0] - points[1][:, 0] + pair.matrix_right[0, 2] - pair.matrix_left[0, 2]
    finite = np.isfinite(error)
    if finite.mean() < 0.5:
        return _RowErrors(np.inf, np.inf, 1.0)
    core = _core(error, 1.0)
    return _RowErrors(
        float(np.median(error[finite])), float(np.sqrt(np.mean(core**2))), float(np.mean(disparity[finite] <= 0))
    )


@dataclass(frozen=True)
class _Matches:
    """Correspondences of two cameras in the same rectified rows.

    Shares [1]: ``decoded`` of the first camera's pixels, ``matched`` of these, ``behind`` the cameras of the matched.
    ``row_error`` [px]: median row error of the right image; ``spread`` [px]: its variation over the image. Both are NaN
    without a code of the rows.
    """

    decoded: float
    matched: float
    behind: float
    row_error: float
    spread: float

    @classmethod
    def of(cls, coordinates: Sequence[Mapping[Axis, ProjectorCoordinate]], geometry: StereoGeometry) -> _Matches:
        maps, seen = (geometry.map_left, geometry.map_right), (geometry.seen_left, geometry.seen_right)
        height = geometry.map_left.shape[1]
        lines = np.arange(2, height - 2, max(1, height // COARSE))
        u_left, u_right = (
            rectified(coordinate["columns"].value, positions[:, lines], there[lines])
            for coordinate, positions, there in zip(coordinates, maps, seen, strict=True)
        )
        right_columns = np.stack(
            [find_coordinates(left_row, right_row)[0] for left_row, right_row in zip(u_left, u_right, strict=True)]
        )
        matched, decoded = np.isfinite(right_columns), np.isfinite(u_left)
        shift = geometry.rectification.matrix_right[0, 2] - geometry.rectification.matrix_left[0, 2]
        disparity = (np.arange(right_columns.shape[1]) - right_columns)[matched] + shift
        share = float(matched.sum() / max(decoded.sum(), 1))
        behind = float(np.mean(disparity <= 0)) if matched.any() else 0.0
        if "rows" not in coordinates[0] or not matched.any():
            return cls(float(decoded.mean()), share, behind, np.nan, np.nan)
        offset, slope = _row_by_code(coordinates, geometry, lines, right_columns)
        # the effect of a stripe, less than a step in depth
        if not np.isfinite(offset).any():
            return cls(float(decoded.mean()), share, behind, np.nan, np.nan)
        edge = 1.5 * (2 * half_stripe(coordinates[0]["rows"]) / abs(slope) + 1)
        # stripe quantisation averages out over a part of the image
        row, column = np.nonzero(matched)
        part = row * _PARTS // len(lines) * _PARTS + column * _PARTS // right_columns.shape[1]
        means = [
            float(np.mean(core)) for n in np.unique(part) if (core := _core(offset[part == n], edge)).size >= _ENOUGH
        ]
        if len(means) < 4:
            return cls(float(decoded.mean()), share, behind, np.nan, np.nan)
        middle = float(np.median(means))
        return cls(float(decoded.mean()), share, behind, middle, float(np.sqrt(np.mean(np.square(means)))))

    @property
    def doubtful(self) -> bool:
        """Return whether the matches contradict this calibration."""
        return self.matched < _LEAST_MATCHED or self.behind > 0.5 or self.spread > LARGEST_SPREAD + abs(self.row_error)

    def __str__(self) -> str:
        if self.behind > 0.5:
            return f"{100 * self.behind:.0f} % of the common points lie behind the cameras"
        if self.matched < _LEAST_MATCHED:
            share = f"{100 * self.matched:.0f} %"
            return f"only {share} of the first camera's decoded pixels have a match in the second's rectified rows"
        return f"the rows of the two cameras are {self.spread:.1f} px apart, unevenly, after rectification"


def _core(values: Floats, least: float) -> Floats:
    """Return values (n,) without those far from their median, as at edges; ``least`` distance that counts as far."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return finite
    deviation = np.abs(finite - np.median(finite))
    return np.asarray(finite[deviation <= max(4 * float(np.median(deviation)), least)])


def _row_by_code(
    coordinates: Sequence[Mapping[Axis, ProjectorCoordinate]],
    geometry: StereoGeometry,
    lines: NDArray[np.intp],
    right_columns: Floats,
) -> tuple[Floats, float]:
    """Return the right image's row error [px], left less right row over slope, and projector rows per pixel."""
    row, column = np.nonzero(np.isfinite(right_columns))
    at = right_columns[row, column]
    mine = geometry.map_left[:, lines[row], column]

    def at_right(step: float) -> Floats:
        raw = np.stack(
            [map_coordinates(component, [lines[row] + step, at], order=1) for component in geometry.map_right]
        )
        return np.asarray(map_coordinates(coordinates[1]["rows"].value, raw[::-1], order=1, cval=np.nan))

    v = np.asarray(map_coordinates(coordinates[0]["rows"].value, mine[::-1], order=1, cval=np.nan))
    # a median over less than a stripe is zero
    for half_distance in _SLOPE_ROWS:
        slope = (at_right(half_distance) - at_right(-half_distance)) / (2 * half_distance)
        usual = float(np.nanmedian(slope)) if np.isfinite(slope).any() else float("nan")
        if abs(usual) * half_distance >= 2 * half_stripe(coordinates[1]["rows"]):
            break
    return ((v - at_right(0.0)) / usual if abs(usual) > 1e-3 else np.full(len(v), np.nan)), usual


def row_error_warnings(offset: float) -> list[str]:
    """Return the warning about a row error ``offset`` [px] of a pair, if it is large."""
    if not abs(offset) > LARGEST_ROW_ERROR:  # nor if it is unknown
        return []
    return [
        f"the rows of the two cameras are {offset:+.2f} px apart after rectification, over {LARGEST_ROW_ERROR:g} px: "
        "the calibration belongs to another rig, or the rig has moved since"
    ]
