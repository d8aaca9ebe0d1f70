"""State the claims of the talk's slides on surfaces, noise and maps, with the figures of the results."""

from __future__ import annotations

import math

import numpy as np

from characterisation.maps.performance_map import PerformanceMap
from characterisation.words.numbers import finish_name, listed
from mitsim.report.figures import matt_to_shiny
from mitsim.talk import sensor_figures as figures
from mitsim.talk.results import Results
from mitsim.talk.slides import Claim, Slide, collected, largest_of, mean_of, median_of, verdict
from mitsim.talk.talk_file import Talk, map_in, sensor_key

#: F from which a surface counts as usable
_USABLE = 0.5

#: largest distance of a distribution from the normal one that counts as predominantly Gaussian
_GAUSSIAN = 0.05


def surfaces(talk: Talk, results: Results) -> Slide:
    """Return slide *Measuring Challenging Surfaces*."""
    slide = Slide("Measuring Challenging Surfaces")
    datasets = collected(results, {finish.name: f"finish_{finish.key}" for finish in talk.file.finishes}, slide)
    if not datasets:
        return slide
    before = f"The artefact in {listed(list(datasets))} before {talk.sensor.name}"
    words = f"{before}: image, cloud, and why pixels lack a point"
    slide.pictures["surfaces"] = (figures.surfaces_figure(datasets), words)
    shares = {name: figures.share(dataset) for name, dataset in datasets.items()}
    by_feature = {
        name: (dataset["points"] / dataset["possible"].where(dataset["possible"] >= 100)).values
        for name, dataset in datasets.items()
    }
    spread = largest_of([largest_of(values) + largest_of(-values) for values in by_feature.values()])
    performance_map = map_in(talk.folder, talk.map_name)
    ends = performance_map.data["distance"].values[[0, -1]]
    near, far = (_noise_at(performance_map, distance) for distance in ends)
    values = list(shares.values())
    slide.claims.append(
        Claim(
            "Surface finish, position and orientation affect measurement quality.",
            f"Share of points: {', '.join(f'{name} {100 * value:.0f} %' for name, value in shares.items())}. "
            f"Features of one finish, which face other ways, differ by up to {100 * spread:.0f} %. From "
            f"{ends[0]:g} to {ends[1]:g} mm the σ of ground aluminium grows from {near:.2f} to {far:.2f} mm.",
            f"{100 * min(values):.0f} to {100 * max(values):.0f} % of the points, by finish",
            verdict(max(values) - min(values) > 0.1 and spread > 0.1 and far > 1.2 * near, max(values) > min(values)),
        )
    )
    return slide


def _noise_at(performance_map: PerformanceMap, distance: float) -> float:
    """Return the mean sigma [mm] of the roughest metal of a map at 25 deg, over all azimuths."""
    turn, flat = np.linspace(0, 2 * math.pi, 73)[:-1], math.sin(0.436)
    normals = np.stack([flat * np.cos(turn), flat * np.sin(turn), np.full(72, math.cos(0.436))], 1)
    finish, rough = max(((f, r) for f, r in performance_map.samples if not math.isnan(r)), key=lambda sample: sample[1])
    return mean_of(performance_map.query(finish, rough, distance, normals).sigma)


def noise(talk: Talk, results: Results) -> Slide:
    """Return slide *Noise Distributions*."""
    slide = Slide("Noise Distributions")
    datasets = collected(results, {name: f"noise_{name}" for name in map(sensor_key, talk.file.noise_sensors)}, slide)
    if not datasets:
        return slide
    words = f"Residuals of {listed(list(datasets))} on a matt-white plate, with their histograms and the normal curve"
    slide.pictures["noise"] = (figures.noise_figure(datasets), words)
    apart = {name: dataset.attrs["distance_one"] for name, dataset in datasets.items()}
    two = [name for name, dataset in datasets.items() if dataset.attrs["two"]]
    kurtosis = ", ".join(f"{name} {one.attrs['kurtosis']:+.2f}".replace("-0", "−0") for name, one in datasets.items())
    worst = max(apart.values())
    slide.claims.extend(
        [
            Claim(
                "They are predominantly gaussian.",
                f"Excess kurtosis: {kurtosis}. The distributions differ from the normal one by at most {worst:.3f}.",
                f"distributions differ by {worst:.3f} at most",
                verdict(worst < _GAUSSIAN, sorted(apart.values())[len(apart) // 2] < _GAUSSIAN),
            ),
            Claim(
                "Some fringe projection sensors can be sums of gaussians.",
                f"A sum of two normals is needed for {listed(two) if two else 'none of them'}.",
                f"needed for {len(two)} of {len(datasets)} sensors",
                verdict(bool(two)),
                ""
                if two
                else "The simulated fringes are sinusoidal and their imagers linear; a real projector's gamma and "
                "vibration, which this preset does not have, make periodic errors.",
            ),
        ]
    )
    return slide


def performance_maps(talk: Talk) -> Slide:
    """Return slide *Performance Maps*."""
    slide = Slide("Performance Maps")
    performance_map = map_in(talk.folder, talk.map_name)
    near, far = performance_map.data["distance"].values[[0, -1]]
    count = performance_map.data.sizes["distance"]
    words = f"F and sigma of {len(performance_map.samples)} samples at {count} distances, {near:g} to {far:g} mm"
    slide.pictures["maps"] = (figures.maps_figure(performance_map), words)
    order = matt_to_shiny(performance_map.samples)
    fraction, sigma = (performance_map.data[name].values[order] for name in ("recovered_fraction", "ray_noise_std"))
    usable = np.array([(values[np.isfinite(values)] >= _USABLE).mean() for values in fraction])
    noise_of = np.array([median_of(s[0][f[0] >= _USABLE]) for f, s in zip(fraction, sigma, strict=True)])
    ratio = median_of(sigma[0, -1] / sigma[0, 0])
    names = [finish_name(*performance_map.samples[number]).split(", ")[-1] for number in order]
    falls, grows = bool((np.diff(usable) <= 0.02).all()), bool((np.diff(noise_of) >= -0.02 * noise_of[:-1]).all())
    slide.claims.extend(
        [
            Claim(
                "We can see the drastic influence of distance, surface texture and surface orientation.",
                f"On matt white σ grows {ratio:.1f} times from {near:g} to {far:g} mm. F is at least {_USABLE:g} for "
                f"{', '.join(f'{100 * u:.0f} % ({n})' for n, u in zip(names, usable, strict=True))} of orientations.",
                f"σ × {ratio:.1f}; {100 * usable.max():.0f} to {100 * usable.min():.0f} % of orientations",
                verdict(ratio > 1.5 and usable.max() - usable.min() > 0.1),
            ),
            Claim(
                "More shininess and lower roughness both reduce usable surface normals and increases noise.",
                f"Median σ where F is at least {_USABLE:g}, at {near:g} mm: "
                f"{', '.join(f'{s:.3f} mm ({n})' for n, s in zip(names, noise_of, strict=True))}.",
                f"from matt to shiny: orientations {100 * usable[0]:.0f} to {100 * usable[-1]:.0f} %, "
                f"σ × {noise_of[-1] / noise_of[0]:.2f}",
                verdict(falls and grows, usable[-1] < usable[0] or noise_of[-1] > noise_of[0]),
                ""
                if falls and grows
                else "Where a shiny surface returns points, its lobe returns much light, and they are no noisier. "
                "The loss of orientations is the larger effect.",
            ),
        ]
    )
    return slide
