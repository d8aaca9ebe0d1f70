"""Draw the interreflected light of a view: its share of each pixel, and the face from which most of it comes.

Signal chain: image of the part -> camera of pixels so large that the part has about :data:`_PIXELS` of them -> light of
each pixel by the face that it met before -> two pictures, and for each face its share with the faces it comes from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from characterisation.plots.style import FIELD, OTHER_SHAPE, SEQUENTIAL, SHAPES, bare, drawing
from characterisation.region_of_interest import Roi
from characterisation.words.numbers import percent
from mitsim.report.style import colour_scale, legend_patch
from mitsim.scene.light_transport.light_from_faces import LightFromFaces, light_from_faces
from mitsim.scene.load import Scene
from mitsim.scene.visible_surfaces import VisibleSurfaces
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform

#: width of the figure [in]
_WIDTH_IN = 9.4

#: width of each of its two pictures [in]
_WIDE_IN = 4.1

#: about the number of pixels of the part, which bounds the time; chosen
_PIXELS = 16_000

#: paths of each pixel; chosen
_SAMPLES = 256

#: seed of the paths: a report made again shows the same picture
_SEED = 1

#: number of faces with a colour of their own
_COLOURED = len(SHAPES)

#: largest number of faces in the list; chosen
_LISTED = 12

#: largest number of faces that are named as sources of the light on a face; chosen
_SOURCES = 3

#: share below which a face is not named as a source
_LEAST = 0.005


def bounced_light(scene: Scene, sensor: Sensor, pose: Transform, visible: VisibleSurfaces) -> LightFromFaces:
    """Estimate the light of a view by face, in the part of the image that shows the part.

    Parameters
    ----------
    scene, sensor, pose
        The scene, the sensor, and world_from_sensor.
    visible
        Surfaces that the reference camera sees from there.
    """
    rows, columns = np.nonzero(visible.shape >= 0)
    camera = sensor.rig.reference
    step = max(1, math.floor(math.sqrt(len(rows) / _PIXELS)))
    coarse = camera.binned(step)
    if not len(rows):
        return light_from_faces(scene, coarse, sensor.projector, pose, 1, _SEED)
    shown = np.zeros((coarse.height, coarse.width), bool)
    shown[np.minimum(rows // step, coarse.height - 1), np.minimum(columns // step, coarse.width - 1)] = True
    return light_from_faces(scene, coarse, sensor.projector, pose, _SAMPLES, _SEED, Roi.around(shown, 2))


def bounce_figure(light: LightFromFaces, names: Sequence[str], title: str) -> Figure:
    """Draw the share of interreflected light, and the main source of each pixel."""
    share = light.share
    main = np.where(np.nan_to_num(share) > 0, light.by_face.argmax(axis=0), -1)
    order = np.argsort(-light.by_face.sum(axis=(1, 2)), kind="stable")
    strong = [int(k) for k in order[:_COLOURED] if light.by_face[k].any()]
    colours = {k: SHAPES[rank] for rank, k in enumerate(strong)}
    height, width = share.shape
    with drawing():
        lines = [line for line in (_line(light, names, k) for k in range(len(names))) if line]
        shown = lines[:_LISTED] + ([f"and {len(lines) - _LISTED} more faces"] if len(lines) > _LISTED else [])
        tall = min(max(_WIDE_IN * height / width, 1.4), 5.0)
        below = 0.2 * max(len(shown), math.ceil(len(strong) / 2)) + 0.35
        figure = Figure((_WIDTH_IN, tall + below + 0.6))
        scale = figure.get_size_inches()[1]
        bottom, part = below / scale, tall / scale
        wide = _WIDE_IN / _WIDTH_IN
        left, right = (figure.add_axes((x, bottom, wide, part)) for x in (0.01, 0.99 - wide))
        drawn = left.imshow(np.ma.masked_invalid(share), cmap=SEQUENTIAL, vmin=0, vmax=1)
        scale_axes = figure.add_axes((0.02 + wide, bottom, 0.012, part))
        colour_scale(figure, drawn, None, "share of the light [1]", extend="neither", cax=scale_axes)
        right.imshow(_sources(main, share, colours))
        for axes, words in ((left, "light that met another face before"), (right, "the face that most of it met")):
            axes.set_facecolor(FIELD)
            bare(axes)
            axes.set_title(words, loc="left")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
        handles = [legend_patch(colour, names[k]) for k, colour in colours.items()]
        if len(strong) < len({int(k) for k in np.unique(main) if k >= 0}):
            handles.append(legend_patch(OTHER_SHAPE, "other faces"))
        at, words = bottom - 0.06 / scale, "\n".join(shown) or "no face is lit"
        figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.99 - wide, at), ncols=2, borderaxespad=0.0)
        figure.text(0.01, at - 0.03 / scale, words, va="top", fontsize=8, linespacing=1.5)
    return figure


def _sources(main: NDArray[np.integer], share: NDArray[np.floating], colours: dict[int, str]) -> NDArray[np.float64]:
    """Return an image (H, W, 3): the colour of the main source, paler where the share is small."""
    palette = np.array([to_rgb(colours.get(k, OTHER_SHAPE)) for k in range(int(main.max(initial=0)) + 1)] + [(1, 1, 1)])
    strength = np.clip(np.nan_to_num(share), 0, 1)[..., None] ** 0.5
    image = strength * palette[main] + (1 - strength) * np.ones(3)
    image[~np.isfinite(share)] = to_rgb(FIELD)
    return np.asarray(image)


def _line(light: LightFromFaces, names: Sequence[str], shape: int) -> str:
    """Describe the light of a face: ``pillar1: 91 % of its light met another face before: plane 90 %, pillar2 1 %``."""
    shares = light.shares_of(shape)
    if not np.isfinite(shares).all():
        return ""
    best = [int(k) for k in np.argsort(-shares, kind="stable")[:_SOURCES] if shares[k] >= _LEAST]
    met = f"{names[shape]}: {percent(float(shares.sum()))} of its light met another face before"
    return ": ".join(filter(None, [met, ", ".join(f"{names[k]} {percent(float(shares[k]))}" for k in best)]))
