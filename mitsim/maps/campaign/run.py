"""Run a campaign: take missing captures, refine the orientations, and make the map.

Signal chain: campaign -> shots of the planned normals that the stage can show -> missing ones are taken and kept -> F
and sigma of each -> more normals between those that differ, repeatedly -> ``samples.nc`` and ``map.nc``.

Kept captures alone determine the next ones. A campaign that is interrupted and run again therefore ends in the same
map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.coupon.orientations import refine
from characterisation.coupon.patch_table import overall, patch_table
from characterisation.files import atomic_io
from characterisation.files.errors import InputError
from characterisation.maps.building import SampleTable, build_map
from characterisation.maps.performance_map import PerformanceMap
from characterisation.words.progress import say, track
from characterisation.words.version import __version__
from mitsim.maps.campaign.acquire import Source
from mitsim.maps.campaign.plan import Campaign, Series, Shot
from mitsim.maps.campaign.store import Finished, read_shot, remove_partial, write_shot
from mitsim.sensor.sensor_text import sensor_checksum

#: folder of the shots of a campaign
KEPT = "coupons"

#: number of damaged captures that are named one by one
NAMED = 10


def run_campaign(campaign: Campaign, source: Source, folder: str | Path) -> PerformanceMap:
    """Take every missing shot of a campaign, and make ``samples.nc`` and ``map.nc`` in ``folder``.

    Raises InputError if kept data is damaged, or the stage reaches no orientation. Raises MissingEnvironmentError if
    the disk is full.
    """
    file, captures = campaign.file, Path(folder) / KEPT
    captures.mkdir(parents=True, exist_ok=True)
    remove_partial(captures)
    normals = file.normals()
    reached = campaign.reachable(normals)
    _report_reach(normals, reached, Path(folder))
    wanted = {series: [normals[reached]] for series in campaign.series}
    done: dict[tuple[str, str], Finished] = {}
    fresh = dict(wanted)
    unresolved, level = 0, 0
    while any(len(part[-1]) for part in fresh.values()):
        shots = [campaign.shot(series, normal) for series, parts in fresh.items() for normal in parts[-1]]
        label = "characterise" if level == 0 else f"refine, level {level}"
        _take_missing(shots, done, source, captures, label)
        if file.refine is None:
            break
        fresh, unresolved = _refined(campaign, wanted, done)
        level += 1
    if unresolved:
        say(f"{unresolved} pairs of neighbouring normals differ by more than the tolerance: raise refine.subdivisions")
    return _finish(campaign, wanted, done, Path(folder), int((~reached).sum()), unresolved)


def measure_captures(campaign: Campaign, shots: Sequence[Shot], source: Source, folder: str | Path) -> PerformanceMap:
    """Measure existing captures and make their map.

    Parameters
    ----------
    campaign, shots, source, folder
        The planned campaign; shots from :func:`~mitsim.maps.campaign.acquire.found_shots`, and the source of their
        results; folder for the map and the measured shots.
    """
    captures = Path(folder) / KEPT
    captures.mkdir(parents=True, exist_ok=True)
    remove_partial(captures)
    done: dict[tuple[str, str], Finished] = {}
    _take_missing(shots, done, source, captures, "measure")
    shown: dict[Series, list[NDArray[np.float64]]] = {}
    for shot in sorted(shots, key=lambda shot: -shot.normal[2]):
        shown.setdefault(shot.series, []).append(shot.normal)
    wanted = {series: [np.array(shown[series])] for series in campaign.series if series in shown}
    return _finish(campaign, wanted, done, Path(folder), 0, 0)


def _take_missing(
    shots: Sequence[Shot], done: dict[tuple[str, str], Finished], source: Source, captures: Path, label: str
) -> None:
    """Read kept shots, and take and keep the others; a variant without a difference shares its sample's shots."""
    missing: dict[tuple[str, str], Shot] = {}
    damaged: list[InputError] = []
    for shot in shots:
        key = (shot.series.name, shot.name)
        if key in done or key in missing:
            continue
        try:
            patches = read_shot(captures, shot)
        except InputError as error:
            damaged.append(error)
            continue
        if patches is None:
            missing[key] = shot
        else:
            done[key] = patches
    if damaged:
        for fault in damaged[1:NAMED]:
            say(f"mitsim: {fault}")
        if len(damaged) > NAMED:
            say(f"mitsim: and {len(damaged) - NAMED} more")
        raise damaged[0]
    for shot, finished in track(source(list(missing.values())), label, len(missing)):
        write_shot(captures, shot, finished)
        done[shot.series.name, shot.name] = Finished(finished.patches, finished.source)


def _refined(
    campaign: Campaign, wanted: dict[Series, list[NDArray[np.float64]]], done: dict[tuple[str, str], Finished]
) -> tuple[dict[Series, list[NDArray[np.float64]]], int]:
    """Add normals where a sample needs them, also to its variants; return them and the number of rough edges."""
    assert campaign.file.refine is not None
    fresh: dict[Series, list[NDArray[np.float64]]] = {}
    unresolved = 0
    added, largest = np.empty((0, 3)), math.radians(campaign.file.largest_deg)
    for series in campaign.series:  # a sample comes before its variants
        if series.variant is None:
            normals = np.concatenate(wanted[series])
            seen = [astuple(overall(done[series.name, campaign.shot(series, n).name].patches)) for n in normals]
            fraction, fraction_error, sigma, sigma_error = np.array(seen, float).reshape(-1, 4).T
            rough = refine(normals, fraction, fraction_error, sigma, sigma_error, campaign.file.refine, largest)
            added = rough.normals[campaign.reachable(rough.normals)] if len(rough.normals) else rough.normals
            unresolved += rough.unresolved
        wanted[series].append(added)
        fresh[series] = wanted[series]
    return fresh, unresolved


def _report_reach(normals: NDArray[np.float64], reached: NDArray[np.bool_], folder: Path) -> None:
    """Report which orientations the stage cannot show, and list them in ``unreachable.csv``."""
    listed = folder / "unreachable.csv"
    listed.unlink(missing_ok=True)
    if reached.all():
        return
    if not reached.any():
        found = "limits that exclude all orientations"
        raise InputError("campaign", "stage.axes", found, "at least one possible orientation")
    say(f"{(~reached).sum()} of {len(normals)} orientations are beyond the stage: {listed}")
    rows = [f"{n[0]:.6f},{n[1]:.6f},{math.degrees(math.acos(min(1.0, n[2]))):.3f}" for n in normals[~reached]]
    atomic_io.write_text(listed, "\n".join(["normal_x,normal_y,incidence_deg", *rows]) + "\n")


def _finish(
    campaign: Campaign,
    wanted: dict[Series, list[NDArray[np.float64]]],
    done: dict[tuple[str, str], Finished],
    folder: Path,
    unreachable: int,
    unresolved: int,
) -> PerformanceMap:
    """Pool the measured patches into the map, in the order of the plan."""
    tables = []
    for series, parts in wanted.items():
        shots = [campaign.shot(series, normal) for normal in np.concatenate(parts)]
        measured = [done[series.name, shot.name].patches for shot in shots]
        one, patches = series.sample, joined(measured, orientation=np.arange(len(measured)))
        tables.append(SampleTable(one.finish, one.roughness, series.distance, patches, series.variant, one.light))
    sources = sorted({finished.source for finished in done.values()})
    attributes = {
        "name": f"{campaign.sensor.name} map",
        "sensor": campaign.sensor.name,
        "sensor_checksum": sensor_checksum(campaign.sensor),
        "source": ", ".join(sources),
        "campaign": campaign.file.model_dump_json(exclude_defaults=True),
        "exposure_rule": campaign.exposure_rule,
        "wavelength_nm": campaign.sensor.wavelength_nm,
        "seed": campaign.file.seed,
        "captures": len(done),
        "unreachable_orientations": unreachable,
        "unresolved_edges": unresolved,
        "software": f"mitsim {__version__}",
    }
    performance = build_map(tables, attributes, math.radians(campaign.file.largest_deg))
    write_netcdf(_all_patches([table for table in tables if table.variant is None]), folder / "samples.nc")
    performance.save(folder / "map.nc")
    return performance


def joined(tables: Sequence[xr.Dataset], **number: NDArray[np.integer]) -> xr.Dataset:
    """Return the patches of several tables in one, with a further column: the ``number`` of the table of each."""
    columns = {str(name): np.concatenate([table[name].values for table in tables]) for name in tables[0].data_vars}
    sizes = [table.sizes["patch"] for table in tables]
    return patch_table(**columns, **{name: np.repeat(numbers, sizes) for name, numbers in number.items()})


def _all_patches(tables: list[SampleTable]) -> xr.Dataset:
    """Join the tables; each patch keeps the number of its sample, whose finish and Ra are coordinates."""
    keys = [(table.finish, str(table.roughness)) for table in tables]
    samples = list(dict.fromkeys(keys))
    numbers = np.array([samples.index(key) for key in keys], np.int16)
    return joined([table.patches for table in tables], sample_number=numbers).assign_coords(
        finish=("sample", [finish for finish, _ in samples]),
        roughness=("sample", [float(ra) for _, ra in samples], {"units": "um", "long_name": "roughness average Ra"}),
    )


def write_netcdf(data: xr.Dataset, path: Path) -> None:
    """Write a dataset completely or not at all, with compressed numbers."""
    numbers = [str(name) for name, variable in data.data_vars.items() if variable.dtype.kind in "fi"]
    atomic_io.write_netcdf(data, path, {name: {"zlib": True, "complevel": 2} for name in numbers})
