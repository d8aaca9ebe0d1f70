"""Cache of maps of single finishes that were characterised on request, for this user.

::

    $XDG_CACHE_HOME/mitsim/finishes/     or ~/.cache/mitsim/finishes/
      0f3a9c1b2d4e5f60.nc    a map of one sample at one distance, named by the digest of all its inputs
      rates.json             time of a characterisation on this machine [s], by sensor

A file that is damaged, or whose content belongs to another finish, is made again.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from pathlib import Path

from characterisation.files.atomic_io import write_json
from characterisation.files.checked_files import is_file, read_json_object
from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.words.progress import say
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.maps.campaign.one_finish import OneFinish, characterise_finish

#: number of captures of a campaign at one distance: mean of twelve, ``python tests/benchmarks/any_finish.py``
USUAL_CAPTURES = 250

#: captures per second of a campaign on two idle cores, ``python tests/benchmarks/coupon_captures.py --poses 16``; for
#: any other sensor a low rate is assumed
RATES = {
    "david-sls-3": 1.37,
    "ensenso-n10": 6.18,
    "ensenso-n35": 0.94,
    "kinect-v2": 26.6,
    "oak-d-pro": 18.2,
    "photoneo-phoxi-s": 0.89,
    "primesense-carmine-1.09": 8.13,
    "realsense-d435": 11.9,
    "zivid-2-m70": 5.44,
}
OTHER_RATE = 1.0

#: age [s] after which the folder of a killed process is removed
_ABANDONED_S = 86400.0

#: attribute of a kept map
_DIGEST = "finish_digest"


def cache_folder() -> Path:
    """Return the cache folder, according to the XDG base directory specification; InputError without a home."""
    root_name = os.environ.get("XDG_CACHE_HOME", "")
    try:
        root = Path(root_name) if root_name and Path(root_name).is_absolute() else Path.home() / ".cache"
    except RuntimeError:
        raise InputError("XDG_CACHE_HOME", "", "nothing, and no home folder", "an absolute, writable path") from None
    return root / "mitsim" / "finishes"


def kept_finish(finish: OneFinish, distance: float) -> PerformanceMap | None:
    """Return the map of a finish at a distance [mm] from the cache, if it is valid; report a damaged file."""
    digest = finish.digest(distance)
    path = cache_folder() / f"{digest}.nc"
    if not is_file(path):
        return None
    try:
        performance_map = PerformanceMap.load(path)
    except InputError as error:
        say(f"{path} is not valid and is made again: {error.found}")
        return None
    if performance_map.data.attrs.get(_DIGEST) != digest or len(performance_map.samples) != 1:
        say(f"{path} is not valid and is made again: it belongs to another finish")
        return None
    return performance_map


def made_finish(finish: OneFinish, simulated: SimulatedSensor, distance: float) -> PerformanceMap:
    """Characterise a finish at a distance [mm], keep the map; MissingEnvironmentError if the disk is full."""
    folder, digest = cache_folder(), finish.digest(distance)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob("work-*"):
            if time.time() - left.stat().st_mtime > _ABANDONED_S:
                shutil.rmtree(left, ignore_errors=True)
        work = Path(tempfile.mkdtemp(prefix="work-", dir=folder))
    except OSError as error:
        found = f"a folder that cannot be created ({error.strerror})"
        raise InputError(folder, "", found, "a writable folder", "set XDG_CACHE_HOME") from None
    began = time.monotonic()
    try:
        made = characterise_finish(finish, simulated, distance, work)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    made.data.attrs |= {_DIGEST: digest, "seconds": round(time.monotonic() - began, 1)}
    made.save(folder / f"{digest}.nc", compact=True)
    return PerformanceMap.load(folder / f"{digest}.nc")  # read back, so that new and cached maps are equal


def expected_seconds(finish: OneFinish) -> float:
    """Return the expected time of :func:`made_finish` [s], from earlier runs on this machine."""
    usual = USUAL_CAPTURES / RATES.get(finish.sensor.name, OTHER_RATE)
    return _rates().get(finish.sensor.name, usual) * len(finish.turns)


def keep_rate(sensor: str, seconds: float) -> None:
    """Keep the time that a finish took at one distance and one rotation of its coupon [s]."""
    before = _rates()
    mean = seconds if sensor not in before else (before[sensor] + seconds) / 2
    write_json(cache_folder() / "rates.json", {**before, sensor: round(mean, 1)})


def _rates() -> dict[str, float]:
    try:
        stored = read_json_object(cache_folder() / "rates.json")
    except InputError:
        return {}
    return {
        str(name): float(rate)
        for name, rate in stored.items()
        if isinstance(rate, int | float) and not isinstance(rate, bool) and 0 < rate < 1e5
    }
