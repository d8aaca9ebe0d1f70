"""State the claims of the talk's slides on flat coupons, with the figures of the results."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.coupon.view_frame import in_view_frame
from characterisation.files.arrays import Floats
from characterisation.files.documents import read_toml
from characterisation.lambert_projection import inverse_lambert_projection
from characterisation.words.numbers import two_digits
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.sensor.sensor import Sensor
from mitsim.talk import sensor_figures as figures
from mitsim.talk.coupon_pieces import roughness_of
from mitsim.talk.plan import validation_name
from mitsim.talk.results import Results
from mitsim.talk.slides import Claim, Slide, collected, largest_of, mean_of, verdict
from mitsim.talk.talk_file import Talk

#: angle around the mirror direction within which normals are in the region of self-blinding [deg]; chosen
_BLIND_DEG = 8.0

#: angles of the ring beside it [deg]; chosen
_RING_DEG = (20.0, 35.0)

#: angle around the mirror direction, and incidence from which F falls, where more detail is required [deg]
_DETAIL_DEG = (20.0, 50.0)

#: incidence from which light scatters adversely [deg]
_ADVERSE_DEG = 60.0

#: limit of the talk for the mean absolute residual
_LIMIT = 0.10


def blinding_normal(sensor: Sensor, distance: float) -> Floats:
    """Return the normal (3,) in the view frame that mirrors the projector into the camera, on its axis."""
    eye = sensor.rig.reference
    axis = eye.sensor_from_camera.rotation[:, 2]
    point = eye.centre + distance * axis
    light = (sensor.rig.projector or eye).centre - point
    back = eye.centre - point
    half = light / np.linalg.norm(light) + back / np.linalg.norm(back)
    normal = half / np.linalg.norm(half)
    return np.asarray(in_view_frame(normal[None], axis[None], sensor.rig.baseline_direction)[0])


def coupons(talk: Talk, results: Results) -> list[Slide]:
    """Return slides *Data Collection*, *Point Cloud Processing* and *Results*."""
    collection, processing = Slide("Data Collection"), Slide("Point Cloud Processing")
    maps = Slide(f"Results – {talk.sensor.name}")
    normal = blinding_normal(talk.sensor, talk.file.coupons.distance_mm)
    x, y = figures.gradient(normal[:1], normal[1:2])
    blinding = float(x[0]), float(y[0])
    datasets = collected(results, {name: name for name in ("characterised", "sub_clouds", "tilts")}, collection)
    if len(datasets) == 3:
        poses, tilts = datasets["characterised"], datasets["tilts"]
        picture = figures.collection_figure(poses, datasets["sub_clouds"], tilts, blinding)
        words = "Poses in gradient space, a cloud cut into sub-clouds, and the projected area of these over the tilt"
        collection.pictures["collection"] = (picture, words)
        collection.claims.extend([_density(poses, normal), _area(tilts)])
    if "tilts" in datasets:
        words = "F by three definitions, and sigma along V and along N, over the tilt"
        processing.pictures["processing"] = (figures.processing_figure(datasets["tilts"]), words)
        processing.claims.extend(_processing(datasets["tilts"]))
    else:
        processing.missing.append("tilts")
    if "characterised" in datasets:
        dataset = datasets["characterised"]
        of = f"Ra {dataset.attrs['Ra_um']:g} at {dataset.attrs['distance_mm']:g} mm"
        words = f"Samples, F and sigma of {of} in gradient space"
        maps.pictures["results"] = (figures.results_figure(dataset, blinding), words)
        maps.claims.append(_regions(dataset, normal))
    else:
        maps.missing.append("characterised")
    return [collection, processing, maps]


def _apart_deg(x: Floats, y: Floats, normal: Floats) -> Floats:
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    return np.degrees(np.arccos(np.clip(normals @ normal, -1, 1)))


def _density(poses: xr.Dataset, normal: Floats) -> Claim:
    apart = _apart_deg(poses["shot_x"].values.astype(float), poses["shot_y"].values.astype(float), normal)
    level = poses["level"].values
    incidence = np.degrees(np.arcsin(np.clip(np.hypot(poses["shot_x"].values, poses["shot_y"].values), 0, 1)))
    near, rim = apart <= _DETAIL_DEG[0], incidence > _DETAIL_DEG[1]
    areas = [1 - math.cos(math.radians(angle)) for angle in (*_DETAIL_DEG, 80.0)]
    regions = ((near, areas[0]), (~near & ~rim, areas[1] - areas[0]), (rim, areas[2] - areas[1]))
    blind, middle, grazing = (max(int(here.sum()), 1) / area for here, area in regions)
    added = level == 1
    few = bool(added.any()) and not bool((added & near).any())
    return Claim(
        "More density is added where more detail is required, such as around the self-blinding region.",
        f"{int((level == 0).sum())} poses were planned and {int(added.sum())} added. Within {_DETAIL_DEG[0]:g}° of the "
        f"mirror direction they are {two_digits(blind / middle)} times as dense as in the middle, beyond "
        f"{_DETAIL_DEG[1]:g}° incidence {two_digits(grazing / middle)} times.",
        f"{two_digits(blind / middle)} times as dense",
        verdict(bool(blind > middle and grazing > middle and added.any()), bool(added.any())),
        "None was added near the mirror direction, where the planned ones are dense already." if few else "",
    )


def _area(tilts: xr.Dataset) -> Claim:
    area, included = tilts["solid_angle"].values.astype(float), tilts["included_deg"].values.astype(float)
    change = largest_of(np.abs(area / area[0] - 1))
    return Claim(
        "Sub-segment the clouds to maintain a fixed projected area for each point cloud.",
        f"From {tilts['tilt'].values[0]:g}° to {tilts['tilt'].values[-1]:g}° the projected area changes by "
        f"{100 * change:.1f} %, the included angle stays {mean_of(included):.2f}°.",
        f"area changes by {100 * change:.1f} %",
        verdict(change < 0.05),
    )


def _processing(tilts: xr.Dataset) -> list[Claim]:
    along_ray, along_normal = (tilts[name].values.astype(float) for name in ("along_ray", "along_normal"))
    valid = np.isfinite(along_ray)
    first, last = np.flatnonzero(valid)[[0, -1]]
    ray, normal = along_ray[last] / along_ray[first], along_normal[last] / along_normal[first]
    definitions = ("pixels", "density", "reference")
    pixels, density, reference = (tilts[f"fraction_{name}"].values.astype(float) for name in definitions)
    apart = largest_of(np.abs(density - pixels))
    other = largest_of(np.abs(reference - pixels))
    return [
        Claim(
            "Normalised for distance and surface angle, so isolates the effect of surface finish.",
            f"F by density differs from counted pixels by {_at_most(apart)}. F by the matt-white reference differs "
            f"by up to {other:.3f}: it also removes the points that white loses at a steep tilt.",
            f"F differs by {_at_most(apart)}",
            verdict(apart < 0.05, apart < 0.1),
        ),
        Claim(
            "Important to measure along the direction of noise propagation, otherwise the noise becomes artificially "
            "influenced by surface inclination.",
            f"On matt white, from {tilts['tilt'].values[first]:g}° to {tilts['tilt'].values[last]:g}°, σ along V "
            f"changes by the factor {ray:.2f}, along N by {normal:.2f}. The cosine alone is "
            f"{math.cos(math.radians(float(tilts['tilt'].values[last]))):.2f}.",
            f"σ × {ray:.2f} along V, × {normal:.2f} along N",
            verdict(abs(math.log(ray)) < abs(math.log(normal)), True),
            ""
            if abs(math.log(ray)) < abs(math.log(normal))
            else "Noise moves a point along V alone, as the talk says. But it grows with the tilt, since a tilted face "
            "reflects less light and a matching block covers more depth. The cosine in σ along N hides this.",
        ),
    ]


def _at_most(value: float) -> str:
    return "less than 0.001" if value < 0.001 else f"at most {value:.3f}"


def _regions(dataset: xr.Dataset, normal: Floats) -> Claim:
    a, b = np.meshgrid(dataset["a"].values.astype(float), dataset["b"].values.astype(float))
    inside = np.hypot(a, b) < math.sqrt(2)
    normals = inverse_lambert_projection(np.stack([a, b], axis=-1)[inside])
    fraction = dataset["recovered_fraction"].values.astype(float)[inside]
    apart = np.degrees(np.arccos(np.clip(normals @ normal, -1, 1)))
    incidence = np.degrees(np.arccos(np.clip(normals[:, 2], -1, 1)))

    def mean(chosen: NDArray[np.bool_]) -> float:
        values = fraction[chosen & np.isfinite(fraction)]
        return float(values.mean()) if len(values) else math.nan

    blind, ring = mean(apart < _BLIND_DEG), mean((apart > _RING_DEG[0]) & (apart < _RING_DEG[1]))
    adverse = mean(incidence > _ADVERSE_DEG)
    return Claim(
        "We can see the regions of adverse scattering and self blinding which causes loss of data.",
        f"Mean F is {blind:.2f} within {_BLIND_DEG:g}° of the mirror direction, {ring:.2f} at {_RING_DEG[0]:g}° to "
        f"{_RING_DEG[1]:g}° from it, and {adverse:.2f} beyond {_ADVERSE_DEG:g}° incidence.",
        f"F {blind:.2f} at the mirror direction, {adverse:.2f} at grazing incidence, {ring:.2f} between",
        verdict(blind < ring - 0.1 and adverse < ring - 0.1, blind < ring - 0.1 or adverse < ring - 0.1),
    )


def validation(talk: Talk, results: Results) -> Slide:
    """Return slide *Simulation Validation*."""
    slide, table = Slide("Simulation Validation"), talk.file.coupons
    campaign = read_toml(talk.folder / table.campaign, CampaignFile)
    rough = sorted(map(roughness_of, campaign.samples), key=lambda ra: -math.inf if ra is None else -ra)
    cells = []
    for ra in rough:
        for distance in table.validated_distances_mm:
            name = validation_name(ra, distance)
            residuals = results.get(name)
            if residuals is None:
                slide.missing.append(name)
            else:
                cells.append(("matt white" if ra is None else f"Ra {ra:g}", distance, residuals))
    clouds = collected(results, {"clouds": "clouds"}, slide)
    if not cells or not clouds:
        return slide
    shown = f"Ra {table.shown_roughness_um:g}"
    words = f"{shown} captured and drawn from the map, F and sigma over incidence, and residuals of all samples"
    slide.pictures["validation"] = (figures.validation_figure(clouds["clouds"], cells, shown), words)
    worst = {
        name: [largest_of([float(dataset[key]) for n, _, dataset in cells if n == name]) for key in _RESIDUALS]
        for name in dict.fromkeys(name for name, _, _ in cells)
    }
    good = {name: largest_of(values) < _LIMIT for name, values in worst.items()}
    last = list(good)[-1]
    floor = largest_of([float(dataset["sigma_floor"]) for n, _, dataset in cells if n == last])
    duller = [good[name] for name in good if name != last]
    slide.claims.append(
        Claim(
            "Residual absolute mean error is less than 10 % for all but the shiniest surface.",
            "Largest mean |residual| of F and of σ at any distance: "
            + "; ".join(f"{name} {100 * f:.1f} % and {100 * s:.1f} %" for name, (f, s) in worst.items())
            + f". For {last}, {100 * floor:.1f} % of σ follow from few points alone.",
            f"{sum(good.values())} of {len(good)} samples below 10 %",
            verdict(all(duller), any(duller)),
            f"{last} stays below the limit too: a single coupon sees no other surface." if good[last] else "",
            "validation",
        )
    )
    _multiple_reflections(talk, results, slide)
    return slide


_RESIDUALS = ("fraction_residual", "sigma_residual")


def _multiple_reflections(talk: Talk, results: Results, slide: Slide) -> None:
    """Add the comparison of direct light alone with all light, on the artefact."""
    samples, lights = talk.file.samples, ("direct", "all")
    names = {(sample.name, light): f"light_{light}_{sample.key}" for sample in samples for light in lights}
    datasets = collected(results, names, slide)
    pairs = {
        sample.name: (datasets[sample.name, "direct"], datasets[sample.name, "all"])
        for sample in samples
        if all((sample.name, light) in datasets for light in lights)
    }
    if not pairs:
        return
    words = "F captured over F from the map for the artefact's features, in direct light alone and in all light"
    slide.pictures["light"] = (figures.light_figure(pairs), words)
    fractions = {name: [figures.fractions(dataset) for dataset in pair] for name, pair in pairs.items()}
    residuals = {
        name: [float(np.abs(captured - expected).mean()) if len(expected) else math.nan for expected, captured in both]
        for name, both in fractions.items()
    }
    added = {name: every - direct for name, (direct, every) in residuals.items()}
    last = list(added)[-1]
    (_, before), (_, after) = fractions[last]
    moved = mean_of(after) - mean_of(before)
    slide.claims.append(
        Claim(
            "The reason for this is on the shiny surface at distance, multiple reflection effects dominate.",
            "A flat coupon sees no other face. On the artefact the mean |residual| of F in direct light alone and in "
            "all light is "
            + "; ".join(f"{name} {100 * d:.1f} % and {100 * a:.1f} %" for name, (d, a) in residuals.items())
            + f". Light from other faces {'raises' if moved > 0 else 'lowers'} the mean F of {last} by "
            f"{abs(moved):.3f}.",
            f"{last}: {100 * residuals[last][0]:.1f} % in direct light, {100 * residuals[last][1]:.1f} % in all",
            verdict(added[last] == max(added.values()) and added[last] > residuals[last][0], added[last] > 0.01),
            ""
            if added[last] > residuals[last][0]
            else "Light from other faces moves F less than what the map misses in "
            "direct light: edges and curved faces, which flat coupons do not show.",
            "light",
        )
    )
