"""Score views within a limit of time: in which order, how many there will be time for, and how many there was.

Views far apart come first. A view that time did not reach counts as one that cannot measure.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from characterisation.words.progress import say
from mitsim.running.time_limit import TimeLimit
from mitsim.views import View

#: fewest views that are scored within a limit of time: as many as the corners of an icosahedron
FEWEST_VIEWS = 12

#: views after which the time of the screening is told; chosen
TIMED_VIEWS = 3


def scoring_order(views: Sequence[View], limit: TimeLimit | None) -> list[int]:
    """Return the indices of views in the order in which they are scored: far apart if time may not suffice for all."""
    return list(range(len(views))) if limit is None or limit.end is None else _far_apart(views)


def _far_apart(views: Sequence[View]) -> list[int]:
    """Return the indices of all views, each as far as possible from those before it in direction, roll and distance."""
    poses = [view.world_from_sensor.matrix() for view in views]
    reach = max(float(np.linalg.norm(pose[:3, 3])) for pose in poses)
    rows = np.array([[*pose[:3, :3].ravel(), *(pose[:3, 3] / reach)] for pose in poses])
    order, nearest = [0], np.linalg.norm(rows - rows[0], axis=1)
    nearest[0] = -1.0
    while len(order) < len(rows):
        order.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(rows - rows[order[-1]], axis=1))
        nearest[order[-1]] = -1.0
    return order


def say_expected(each_s: float, limit: TimeLimit, views: int) -> None:
    """Say how many views there will be time for, if not for all, from the time that a view takes."""
    if limit.left < each_s * (views - TIMED_VIEWS):
        count = max(FEWEST_VIEWS, TIMED_VIEWS + int(limit.left / each_s))
        say(f"a view takes {each_s:.1f} s: about {count} of {views} views are screened, in {each_s * count:.0f} s")


def not_scored_in_words(scores: xr.Dataset) -> str:
    """Return how many views were scored within a limit of time; empty if all were."""
    scored, views = int(scores.attrs.get("views_scored", scores.sizes["view"])), scores.sizes["view"]
    return f"only {scored} of {views} views screened, for lack of time" if scored < views else ""
