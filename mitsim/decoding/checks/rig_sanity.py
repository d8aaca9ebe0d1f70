"""Check whether images and calibration of a structured-light capture belong together.

Signal chain: images, every few pixels -> projector coordinates -> view ray of the camera, and ray or plane of light of
the projector -> distance between them, and whether they meet in front of the camera. For two cameras: coordinates along
rectified rows -> disparity, and row error by the other coordinate or by the texture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.point_cloud import PointCloud, Status
from mitsim.decoding.checks.row_texture import rectified, textured_row_error, uniform_light_mean
from mitsim.decoding.checks.texture_matches import COMPARED_ROWS, LEAST_BLOCKS, texture_matches
from mitsim.decoding.coded_images import CodedImages
from mitsim.decoding.matching.row_error import row_error
from mitsim.decoding.matching.stereo import StereoGeometry, stereo_geometry
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.decoding.structured_light.two_cameras import find_coordinates
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis
from mitsim.sensor.light_code import LightCode, axes, roles
from mitsim.sensor.transforms import Transform

Levels = NDArray[np.unsignedinteger[Any]]
Floats = NDArray[np.float64]

#: least share of the baseline across the stripes; below, depth has half the sensitivity that another axis gives
LEAST_ACROSS = 0.5

#: largest row error of a pair [px]; a stereo matcher begins to lose points at about this
LARGEST_ROW_ERROR = 0.3

#: largest median distance of view rays from their light [projector px], in addition to half a stripe
LARGEST_MISS_PX = 3.0

#: least share of the first camera's decoded pixels that the second has in the same rows; allowed variation of the row
#: error over the image [px]
_LEAST_MATCHED, _LARGEST_SPREAD = 0.1, 0.5

#: row error [px] of a rig that has moved; beyond, the calibration is of another rig
_MOVED = 6.0

#: half the distances [px] over which the slope of the projector rows is measured, until they span two stripes
_SLOPE_ROWS = (2.0, 4.0, 8.0, 16.0, 32.0)

#: parts of an image along either side for averaging rows, and least number of pixels of a mean
_PARTS, _ENOUGH = 6, 30

#: largest share of the decoded pixels that meet their light behind the camera, or not at all
_BEHIND = 0.3

#: approximate number of pixels along either side in the coarse check; side of a patch for comparing rows [px]; largest
#: and least number of patches
_COARSE, _PATCH, _MOST, _LEAST = 160, 40, 80, 8


def baseline_warning(rig: Rig, code: LightCode) -> str:
    """Return a warning if the baseline lies along the stripes of a code with one axis, or ""."""
    if rig.projector is None or len(axes(code)) != 1:
        return ""
    apart = rig.projector.sensor_from_camera.inverse().directions(rig.reference.centre - rig.projector.centre)
    axis = axes(code)[0]
    across, whole = abs(float(apart[0 if axis == "columns" else 1])), float(np.linalg.norm(apart))
    if across >= LEAST_ACROSS * whole:
        return ""
    other = "rows" if axis == "columns" else "columns"
    return (
        f"only {across:.0f} mm of the {whole:.0f} mm between camera and projector lie across the {axis} of the code: "
        f"only these determine depth. Project {other}, or check R and T of the calibration"
    )


def camera_warnings(decoded: Mapping[Axis, ProjectorCoordinate], rig: Rig, settings: DecoderSettings) -> list[str]:
    """Return warnings about one camera and a projector: rays that miss their light, or meet it behind the camera.

    ``decoded``: coordinates (H, W) that the camera sees.
    """
    eye, projector = rig.reference, rig.projector
    if projector is None or not decoded:
        return []
    step = max(1, min(eye.width, eye.height) // _COARSE)
    places = np.s_[step // 2 :: step, step // 2 :: step]
    found = {axis: each.part(places) for axis, each in decoded.items()}
    rays = eye.sensor_from_camera.directions(eye.rays(eye.pixel_grid()[places]))
    known = np.all([each.status == Status.VALID for each in found.values()], axis=0) & np.isfinite(rays).all(axis=-1)
    if known.mean() < 0.005:
        return []
    coordinates = {axis: each.value[known] for axis, each in found.items()}
    depth, miss = _meeting(eye, projector, rays[known], coordinates)
    solved = depth[~np.isnan(depth)]  # without light beyond the fold of the projector's distortion
    behind = float(np.mean(~(solved > 0))) if solved.size else 0.0
    doubt = "check that the calibration belongs to these images, and that R and T are those of cv2.stereoCalibrate"
    out = []
    if behind > _BEHIND:
        doubt = _other_place(eye, projector, rays[known], coordinates) or doubt
        return [f"{100 * behind:.0f} % of the decoded pixels meet their light behind the camera: {doubt}"]
    if len(found) == 2:
        allowed = max(LARGEST_MISS_PX, settings.epipolar_px) + max(_half_stripe(each) for each in found.values())
        error = float(np.nanmedian(np.abs(miss))) if np.isfinite(miss).any() else np.inf
        if error > allowed:
            names: tuple[Axis, Axis] = ("columns", "rows")
            turned = {one: found[other].value[known] for one, other in (names, names[::-1])}
            other = float(np.nanmedian(np.abs(_meeting(eye, projector, rays[known], turned)[1])))
            if other < allowed:
                doubt = "they fit if columns and rows are exchanged in [pattern]"
            else:
                doubt = _other_place(eye, projector, rays[known], coordinates) or doubt
            out.append(f"view rays miss the light that they decode by {error:.1f} projector px in the median: {doubt}")
    return out


def _other_place(eye: Camera, projector: Camera, rays: Floats, coordinates: dict[Axis, Floats]) -> str:
    """Return another reading of R and T with which nearly all rays meet their light in front of the camera.

    Only codes of both axes reveal it: with one axis nearly every reading gives depths.
    """
    if len(coordinates) < 2:
        return ""
    camera_from_projector = eye.sensor_from_camera.inverse() @ projector.sensor_from_camera
    inverted, turn = camera_from_projector.inverse(), camera_from_projector.rotation
    readings = {
        "they fit if R and T go from the projector's frame to the camera's: invert them": inverted,
        "they fit if T has the opposite sign": Transform(turn, -camera_from_projector.translation),
    }
    for words, place in readings.items():
        moved = replace(projector, sensor_from_camera=eye.sensor_from_camera @ place)
        depth, miss = _meeting(eye, moved, rays, coordinates)
        if np.mean(depth > 0) > 1 - _BEHIND / 3 and np.nanmedian(np.abs(miss)) < LARGEST_MISS_PX:
            return words
    return ""


def _half_stripe(coordinate: ProjectorCoordinate) -> float:
    """Return half the width of a stripe of a Gray code without fringes [px], 0 if unknown."""
    sigma = coordinate.sigma[np.isfinite(coordinate.sigma)]
    return float(np.median(sigma)) * np.sqrt(3) if sigma.size else 0.0


def _meeting(eye: Camera, projector: Camera, rays: Floats, coordinates: dict[Axis, Floats]) -> tuple[Floats, Floats]:
    """Return the distance (n,) [mm] along rays at which they meet their light, and the miss distance [projector px].

    With one axis the light is the plane of a column or row, which a lens bends slightly; rays cannot miss it.
    """
    start = eye.centre - projector.centre
    if len(coordinates) == 2:
        light = projector.sensor_from_camera.directions(
            projector.rays(np.stack([coordinates["columns"], coordinates["rows"]], axis=-1))
        )
        # closest points of two lines
        a, b, c = (np.einsum("ij,ij->i", one, other) for one, other in ((rays, rays), (rays, light), (light, light)))
        d, e = rays @ start, light @ start
        along = (b * e - c * d) / (a * c - b * b)
        place = projector.project(eye.centre + along[:, None] * rays)
        # across the epipolar line: no depth explains it
        step = projector.project(eye.centre + 1.001 * along[:, None] * rays) - place
        off = place - np.stack([coordinates["columns"], coordinates["rows"]], axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return along, (off[:, 0] * step[:, 1] - off[:, 1] * step[:, 0]) / np.linalg.norm(step, axis=1)
    ((axis, value),) = coordinates.items()
    normal = light_plane_normals(projector, value, axis)
    with np.errstate(invalid="ignore", divide="ignore"):
        return -(normal @ start) / np.einsum("ij,ij->i", normal, rays), np.zeros(len(rays))


def light_plane_normals(projector: Camera, value: Floats, axis: Axis) -> Floats:
    """Return normals (n, 3), in the sensor frame, of the planes of light of columns or rows ``value`` (n,) [px]."""
    last = (projector.height if axis == "columns" else projector.width) - 1.0
    ends = [np.full_like(value, end) for end in (0.0, last)]
    pixels = [np.stack([value, end] if axis == "columns" else [end, value], axis=-1) for end in ends]
    first, second = (projector.sensor_from_camera.directions(projector.rays_to_fold(each)) for each in pixels)
    return np.asarray(np.cross(first, second))


@dataclass(frozen=True)
class Findings:
    """Findings about a capture: ``warnings``, and ``row_error`` [px] of the second camera; NaN if unknown.

    ``row_error_source``: the source of the row error, "" if unknown.
    """

    warnings: list[str] = field(default_factory=list)
    row_error: float = float("nan")
    row_error_source: str = ""


def pair_findings(images: CodedImages, rig: Rig) -> Findings:
    """Check two cameras that see one code: exchanged, another calibration, or a row error.

    The source of the row error is the code of the rows if present, else the texture of the surface. It is unknown if
    neither gives it, or the calibration is doubtful.
    """
    geometry = stereo_geometry(rig)
    exchangeable = geometry.raw_size[0] == geometry.raw_size[1]
    names = " and ".join(list(rig.cameras)[:2])
    exchanged = (
        f"the images of {names} fit the calibration if they are exchanged: check whether left and right are exchanged"
    )
    found = list(images.coordinates.values())
    matches = _Matches.of(found, geometry)
    if matches.decoded < 0.005:
        return Findings()
    textures, doubt = None, "check that the calibration belongs to these images"
    if not np.isfinite(matches.row_error):
        image_roles = roles(images.code, *images.size)
        textures = [uniform_light_mean(stack, image_roles, images.full_scale) for stack in images.stacks.values()]
        columns = found[0]["columns"].value, found[1]["columns"].value
        contradiction, other_order = _texture_contradiction((textures[0], textures[1]), columns, rig, geometry)
        if contradiction:
            fits = exchangeable and other_order
            return Findings([exchanged if fits else f"{contradiction}: {doubt}"])
    if matches.doubtful:
        if exchangeable and not _Matches.of(found[::-1], geometry).doubtful:
            return Findings([exchanged])
        return Findings([f"{matches}: {doubt}"])
    offset, source = matches.row_error, "by the code of the rows"
    if textures is not None:
        source = "by the texture of the surface"
        offset, variation = textured_row_error((textures[0], textures[1]), columns, geometry)
        if variation > _LARGEST_SPREAD + 0.5 * abs(offset if np.isfinite(offset) else 0.0):
            swapped = textured_row_error((textures[1], textures[0]), columns[::-1], geometry) if exchangeable else None
            if swapped is not None and abs(swapped[0]) < LARGEST_ROW_ERROR and not swapped[1] > _LARGEST_SPREAD:
                return Findings([exchanged])
            told = (
                f"the rows of the two cameras vary by {variation:.1f} px over the image, by the texture of the surface"
            )
            return Findings([f"{told}: {doubt}"])
    return Findings(row_error_warnings(offset), offset, source) if np.isfinite(offset) else Findings()


def _texture_contradiction(
    textures: tuple[Floats, Floats], columns: tuple[Floats, Floats], rig: Rig, geometry: StereoGeometry
) -> tuple[str, bool]:
    """Describe how texture matched over all rows contradicts the calibration, and whether the other order fits.

    "" if the texture agrees, or does not suffice.
    """
    pixels = texture_matches(textures, columns)
    if len(pixels[0]) < LEAST_BLOCKS:
        return "", False
    step = max(1.0, textures[0].shape[0] / COMPARED_ROWS)  # rows are compared to a fraction of this
    found, other = (_row_errors(*order, rig, geometry) for order in (pixels, pixels[::-1]))
    if found.fits(step):
        return "", False
    return f"{found}, by the texture of the surface", other.fits(step)


@dataclass(frozen=True)
class _RowErrors:
    """Row error [px] of matched texture: its ``median`` and ``spread``; share that lies ``behind`` the cameras."""

    median: float
    spread: float
    behind: float

    def fits(self, step: float) -> bool:
        """Return whether the calibration explains the matches, whose rows are accurate to a share of ``step`` [px]."""
        return self.behind <= 0.5 and self.spread <= _LARGEST_SPREAD * step + 0.5 * min(abs(self.median), _MOVED)

    def __str__(self) -> str:
        if self.behind > 0.5:
            return f"{100 * self.behind:.0f} % of the common points lie behind the cameras"
        return f"the rows of the two cameras are {self.spread:.1f} px apart after rectification"


def _row_errors(left: Floats, right: Floats, rig: Rig, geometry: StereoGeometry) -> _RowErrors:
    """Return the row error of raw pixels (n, 2) of the first and second camera that show the same point."""
    pair, places = geometry.rectification, []
    for eye, pixels, turn, matrix in zip(
        rig.cameras.values(),
        (left, right),
        (pair.rotation_left, pair.rotation_right),
        (pair.matrix_left, pair.matrix_right),
        strict=False,
    ):
        rays = eye.rays(pixels) @ turn.T
        with np.errstate(invalid="ignore", divide="ignore"):
            places.append((rays / rays[:, 2:]) @ matrix.T)
    error = places[1][:, 1] - places[0][:, 1]
    disparity = places[0][:, 0] - places[1][:, 0] + pair.matrix_right[0, 2] - pair.matrix_left[0, 2]
    known = np.isfinite(error)
    if known.mean() < 0.5:
        return _RowErrors(np.inf, np.inf, 1.0)
    core = _core(error, 1.0)
    return _RowErrors(
        float(np.median(error[known])), float(np.sqrt(np.mean(core**2))), float(np.mean(disparity[known] <= 0))
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
    def of(cls, found: Sequence[Mapping[Axis, ProjectorCoordinate]], geometry: StereoGeometry) -> _Matches:
        maps, seen = (geometry.map_left, geometry.map_right), (geometry.seen_left, geometry.seen_right)
        height = geometry.map_left.shape[1]
        lines = np.arange(2, height - 2, max(1, height // _COARSE))
        u_left, u_right = (
            rectified(each["columns"].value, positions[:, lines], there[lines])
            for each, positions, there in zip(found, maps, seen, strict=True)
        )
        place = np.stack([find_coordinates(one, other)[0] for one, other in zip(u_left, u_right, strict=True)])
        matched, decoded = np.isfinite(place), np.isfinite(u_left)
        shift = geometry.rectification.matrix_right[0, 2] - geometry.rectification.matrix_left[0, 2]
        disparity = (np.arange(place.shape[1]) - place)[matched] + shift
        share = float(matched.sum() / max(decoded.sum(), 1))
        behind = float(np.mean(disparity <= 0)) if matched.any() else 0.0
        if "rows" not in found[0] or not matched.any():
            return cls(float(decoded.mean()), share, behind, np.nan, np.nan)
        offset, slope = _row_by_code(found, geometry, lines, place)
        # the effect of a stripe, less than a step in depth
        if not np.isfinite(offset).any():
            return cls(float(decoded.mean()), share, behind, np.nan, np.nan)
        edge = 1.5 * (2 * _half_stripe(found[0]["rows"]) / abs(slope) + 1)
        # stripe quantisation averages out over a part of the image
        row, column = np.nonzero(matched)
        part = row * _PARTS // len(lines) * _PARTS + column * _PARTS // place.shape[1]
        means = [
            float(np.mean(own)) for n in np.unique(part) if (own := _core(offset[part == n], edge)).size >= _ENOUGH
        ]
        if len(means) < 4:
            return cls(float(decoded.mean()), share, behind, np.nan, np.nan)
        middle = float(np.median(means))
        return cls(float(decoded.mean()), share, behind, middle, float(np.sqrt(np.mean(np.square(means)))))

    @property
    def doubtful(self) -> bool:
        """Return whether the matches contradict this calibration."""
        return self.matched < _LEAST_MATCHED or self.behind > 0.5 or self.spread > _LARGEST_SPREAD + abs(self.row_error)

    def __str__(self) -> str:
        if self.behind > 0.5:
            return f"{100 * self.behind:.0f} % of the common points lie behind the cameras"
        if self.matched < _LEAST_MATCHED:
            share = f"{100 * self.matched:.0f} %"
            return f"only {share} of the first camera's decoded pixels have a match in the second's rectified rows"
        return f"the rows of the two cameras are {self.spread:.1f} px apart, unevenly, after rectification"


def _core(values: Floats, least: float) -> Floats:
    """Return values (n,) without those far from their median, as at edges; ``least`` distance that counts as far."""
    known = values[np.isfinite(values)]
    if not known.size:
        return known
    deviation = np.abs(known - np.median(known))
    return np.asarray(known[deviation <= max(4 * float(np.median(deviation)), least)])


def _row_by_code(
    found: Sequence[Mapping[Axis, ProjectorCoordinate]],
    geometry: StereoGeometry,
    lines: NDArray[np.intp],
    place: Floats,
) -> tuple[Floats, float]:
    """Return the row error [px] of the right image at each match, and projector rows per pixel.

    The error is the projector row of the left image less that of the right, over their slope.
    """
    row, column = np.nonzero(np.isfinite(place))
    at = place[row, column]
    mine = geometry.map_left[:, lines[row], column]

    def at_right(step: float) -> Floats:
        raw = np.stack([map_coordinates(each, [lines[row] + step, at], order=1) for each in geometry.map_right])
        return np.asarray(map_coordinates(found[1]["rows"].value, raw[::-1], order=1, cval=np.nan))

    v = np.asarray(map_coordinates(found[0]["rows"].value, mine[::-1], order=1, cval=np.nan))
    # a median over less than a stripe is zero
    for half_distance in _SLOPE_ROWS:
        slope = (at_right(half_distance) - at_right(-half_distance)) / (2 * half_distance)
        usual = float(np.nanmedian(slope)) if np.isfinite(slope).any() else float("nan")
        if abs(usual) * half_distance >= 2 * _half_stripe(found[1]["rows"]):
            break
    return ((v - at_right(0.0)) / usual if abs(usual) > 1e-3 else np.full(len(v), np.nan)), usual


def measured_row_error(images: tuple[Levels, Levels], geometry: StereoGeometry, cloud: PointCloud) -> float:
    """Return the median row error [px] of the right image of a decoded pair; NaN with too few patches.

    ``images`` (H, W) raw left and right [DN], with texture; ``cloud`` on the rectified left grid.
    """
    left, right = (image.astype(float) for image in images)
    local = (cloud.points.astype(float) - geometry.grid.origin) @ geometry.grid.rotation
    disparity = geometry.rectification.disparity(local[..., 2])
    height, width = cloud.status.shape
    tops, sides = range(0, height - _PATCH + 1, _PATCH), range(0, width - _PATCH + 1, _PATCH)
    corners = [
        (row, column)
        for row in tops
        for column in sides
        if cloud.valid[row : row + _PATCH, column : column + _PATCH].mean() >= 0.5
    ]
    errors = []
    for row, column in corners[:: -(-len(corners) // _MOST) or 1]:
        rows, columns = np.nonzero(cloud.valid[row : row + _PATCH, column : column + _PATCH])
        rows, columns = rows + row, columns + column
        errors.append(row_error(left, right, geometry, rows, columns, disparity[rows, columns]))
    known = np.array(errors)[np.isfinite(errors)] if errors else np.empty(0)
    return float(np.median(known)) if len(known) >= _LEAST else float("nan")


def row_error_warnings(offset: float) -> list[str]:
    """Return the warning about a row error ``offset`` [px] of a pair, if it is large."""
    if not abs(offset) > LARGEST_ROW_ERROR:  # nor if it is unknown
        return []
    return [
        f"the rows of the two cameras are {offset:+.2f} px apart after rectification, over {LARGEST_ROW_ERROR:g} px: "
        "the calibration belongs to another rig, or the rig has moved since"
    ]
