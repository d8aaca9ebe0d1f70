"""Draw the checked views: the camera images, and the predicted cloud beside the decoded one."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from characterisation.plots.clouds import REASONS as STATUS_WORDS
from characterisation.plots.clouds import depth_limits
from characterisation.plots.style import FIELD, SEQUENTIAL, drawing
from characterisation.point_cloud import PointCloud, Status
from characterisation.region_of_interest import Roi
from characterisation.words.numbers import percent
from mitsim.capture.capture import Capture
from mitsim.capture.picture import STRETCH_EXPONENT, grey_limits
from mitsim.report.findings import reason_shares
from mitsim.report.style import colour_scale
from mitsim.sensor.camera import Camera
from mitsim.sensor.png import encode_png

LARGEST_WIDTH_PX = 800

#: margin around the part in a picture of its clouds [px]; chosen
_MARGIN_PX = 8

#: meaning and colour of each status
REASONS = {status: STATUS_WORDS[status.name] for status in Status}

#: margin around the part in a camera image, relative to the part's size there; chosen
_CROP_MARGIN = 0.08

#: its minimum, for small parts [px]; chosen
_CROP_LEAST_PX = 12


def part_window(camera: Camera, points: NDArray[np.floating]) -> tuple[slice, slice]:
    """Return rows and columns of an image that show points (n, 3) [mm], sensor frame, with a margin; else all."""
    pixels = camera.project(points)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    whole = slice(0, camera.height), slice(0, camera.width)
    if not len(pixels):
        return whole
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    room = np.maximum(_CROP_MARGIN * (high - low), _CROP_LEAST_PX)
    first = np.floor(np.maximum(low - room, 0)).astype(int)
    last = np.ceil(np.minimum(high + room + 1, [camera.width, camera.height])).astype(int)
    return (slice(first[1], last[1]), slice(first[0], last[0])) if (last - first >= 2).all() else whole


def camera_images(capture: Capture, part: NDArray[np.floating] | None = None) -> tuple[dict[str, str], str]:
    """Return the first image of each camera as a PNG data URI by camera name, and a description of the display stretch.

    Images are cropped to ``part`` (n, 3) [mm], sensor frame. The grey value shown is
    ((DN - black) / (white - black))^0.7, with the same black and white for all cameras of the capture.
    """
    frames = {}
    for name, stack in capture.images.items():
        camera, image = capture.rig.cameras.get(name), stack[0]
        if part is not None and camera is not None and image.shape == (camera.height, camera.width):
            image = image[part_window(camera, part)]
        frames[name] = shrink(image)
    black, white = grey_limits(list(frames.values()))
    uris = {}
    for name, frame in frames.items():
        shown = np.rint(255 * np.clip((frame - black) / (white - black), 0, 1) ** STRETCH_EXPONENT).astype(np.uint8)
        uris[name] = "data:image/png;base64," + base64.b64encode(encode_png(shown)).decode("ascii")
    limits = f"black at {black:.0f} and white at {white:.0f} of {2**capture.bits - 1} DN"
    return uris, f"brightened for display: {limits}, exponent {STRETCH_EXPONENT}"


def shrink(image: NDArray[np.unsignedinteger]) -> NDArray[np.float64]:
    """Average blocks of whole pixels until an image is at most :data:`LARGEST_WIDTH_PX` wide."""
    step = math.ceil(image.shape[1] / LARGEST_WIDTH_PX)
    rows, columns = (size // step * step for size in image.shape)
    blocks = image[:rows, :columns].astype(float).reshape(rows // step, step, columns // step, step)
    return np.asarray(blocks.mean(axis=(1, 3)))


def draw_status(axes: Axes, status: NDArray[np.uint8], **options: Any) -> None:
    """Draw the status (H, W) of pixels in the colours of :data:`REASONS`."""
    colours = ListedColormap([REASONS[status][1] for status in Status])
    steps = BoundaryNorm(np.arange(len(Status) + 1) - 0.5, len(Status))
    axes.imshow(np.ma.masked_equal(status, Status.NO_SURFACE), cmap=colours, norm=steps, **options)
    axes.set_facecolor(FIELD)


def cloud_figure(predicted: PointCloud, decoded: PointCloud) -> Figure:
    """Draw the distance along the view ray [mm] and the status of every pixel of both clouds, cropped to the part."""
    part = Roi.around(predicted.status != Status.NO_SURFACE, _MARGIN_PX)
    cut = (part or Roi.whole(predicted.grid.width, predicted.grid.height)).slices
    clouds = {"predicted": predicted, "decoded": decoded}
    distances = [np.linalg.norm(cloud.points[cut] - cloud.grid.origin, axis=-1) for cloud in clouds.values()]
    present = sorted({Status(int(s)) for cloud in clouds.values() for s in np.unique(cloud.status[cut])})
    # the part's own depth sets the colours, since a false match can lie at any distance
    near, far = depth_limits(distances[0])
    height, width = predicted.status[cut].shape
    top, left = cut[0].start, cut[1].start
    extent = (left - 0.5, left + width - 0.5, top + height - 0.5, top - 0.5)
    tall = height > 1.1 * width  # then all four panels form one row
    across = 2.2 if tall else 4.6
    tallness = min(max(across * height / width, 1.5), 4.6)
    with drawing():
        figure = Figure((10.4, (1 if tall else 2) * (tallness + 0.3) + 1.7), layout="constrained")
        grid = np.asarray(figure.subplots(1 if tall else 2, 4 if tall else 2, sharex=True, sharey=True)).reshape(2, 2)
        for column, (title, cloud) in enumerate(clouds.items()):
            depth = grid[0, column].imshow(
                np.ma.masked_invalid(distances[column]), cmap=SEQUENTIAL, vmin=near, vmax=far, extent=extent
            )
            draw_status(grid[1, column], cloud.status[cut], extent=extent)
            grid[0, column].set_title(f"{title}: distance")
            grid[1, column].set_title(f"{title}: status")
        for axes in grid[-1] if not tall else grid.ravel():
            axes.set_xlabel("column [px]")
        for axes in grid[:, 0] if not tall else grid[0, :1]:
            axes.set_ylabel("row [px]")
        beside = {"shrink": 1.0 if tall else 0.5, "anchor": (0.0, 1.0), "aspect": 22}
        colour_scale(figure, depth, grid.ravel().tolist(), "distance along the view ray [mm]", **beside)
        shares = reason_shares([(predicted, decoded)])
        both = {status: " | ".join(map(percent, shares.get(status, (0, 0)))) for status in present}
        legend = [Patch(facecolor=REASONS[s][1], label=f"{REASONS[s][0]}: {words}") for s, words in both.items()]
        title = "share of the pixels that could show the part: predicted | decoded"
        place: dict[str, Any] = {"loc": "outside lower center", "ncols": 2, "handlelength": 1.1}
        figure.legend(handles=legend, title=title, title_fontsize=8.0, **place)
    return figure
