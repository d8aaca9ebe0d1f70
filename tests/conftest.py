"""Things that many tests need."""

from __future__ import annotations

import functools
import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.testing
from hypothesis import HealthCheck, settings

from characterisation.files.threads import usable_cores
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor import Sensor

# The same examples at every run, so that a run tells of a change; HYPOTHESIS_PROFILE=explore looks for new ones.
# No deadlines: these machines are shared, and a slow moment is no fault of the code.
_PATIENT = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("fixed", derandomize=True, **_PATIENT)
settings.register_profile("explore", max_examples=1000, **_PATIENT)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))

ROOT = Path(__file__).resolve().parents[1]

#: what malloc of glibc is told: keep blocks of up to a gigabyte that are freed, instead of asking for new pages for
#: every image
KEEP_MEMORY = {"MALLOC_MMAP_THRESHOLD_": "1000000000", "MALLOC_TRIM_THRESHOLD_": "1000000000"}

#: tests that the inner loop leaves out, ``pytest -m "not slow"``: a line for each, or for a file of nothing else
SLOW = frozenset((ROOT / "tests/slow_tests.txt").read_text(encoding="utf-8").split())


def pytest_configure(config: pytest.Config) -> None:
    """Set up the processes of ``-n``, which inherit this environment, and the order in which they get files.

    No test cuts the power, so nothing waits for the disk: ``os.fsync`` does nothing. What a killed process has written
    is there without it.
    """
    os.fsync = lambda handle: None
    os.environ.setdefault("MITSIM_CACHE", "")  # no cloud of a test is kept for another
    gc.disable()  # until all files are imported: nothing dies before
    # typer would read the signatures of all commands again whenever a test calls one
    typer.main.get_command = typer.testing._get_command = functools.cache(typer.main.get_command)
    workers = getattr(config.option, "numprocesses", None)
    if not workers:
        return
    for name, value in KEEP_MEMORY.items():
        os.environ.setdefault(name, value)
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, usable_cores() // workers)))
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # or every process that a test starts would compile the program
    config.option.loadscopereorder = False  # files in the order of pytest_collection_modifyitems


@pytest.hookimpl(tryfirst=True)  # before pytest chooses by markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that ``slow_tests.txt`` lists, and run their files first: quick files fill up the end."""
    slow_files = set()
    for item in items:
        name = item.nodeid.partition("[")[0]
        if name in SLOW or name.partition("::")[0] in SLOW:
            item.add_marker(pytest.mark.slow)
            slow_files.add(item.path)
    items.sort(key=lambda item: item.path not in slow_files)


def pytest_collection_finish() -> None:
    """Collect garbage from here on, without another look at modules and tests, which stay to the end."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _one_process() -> Iterator[None]:
    """Commands in the process of a test make few trials, and several tests run at once: they start no workers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mitsim.running.executor.fitting_processes", lambda: 1)
        yield


@pytest.fixture(scope="session")
def scenes() -> Path:
    """The folder of authored scenes."""
    return ROOT / "scenes"


@pytest.fixture(scope="session")
def n10() -> Sensor:
    """The Ensenso N10 preset."""
    return load_sensor("ensenso-n10")


@pytest.fixture(scope="session")
def started_browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A headless Chromium, for tests that are marked ``browser``: one for all of them, as its start takes a second."""
    from tests.report.chromium import Chromium

    with Chromium(tmp_path_factory.mktemp("profile")) as chromium:
        yield chromium


@pytest.fixture(scope="module")
def browser(started_browser: Any) -> Any:
    """The Chromium of :func:`started_browser` on an empty page, with nothing left of what other files did."""
    started_browser.reset()
    return started_browser


@pytest.fixture(scope="module")
def no_other_scenes() -> None:
    """Free the scenes of files before this one, for tests that compile large kernels.

    Dr.Jit compiles the number of shapes of all scenes that are still there into every kernel, and Mitsuba's own
    integrators compile their materials: with other scenes before it, a kernel is another one.
    """
    from mitsim.study import many_captures as many

    many._scenes.clear()
    gc.collect()


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(20181016)
