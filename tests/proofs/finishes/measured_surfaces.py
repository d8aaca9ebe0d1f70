"""Read how real metals scatter light: a goniometer, fits of the MERL spheres, and published tables.

Signal chain: files of the folder of real data -> a :class:`MeasuredSurface` for each metal, with its BRDF in the plane
of incidence and the share of light that it reflects.

The MERL spheres have no measured samples here but the ABC fits of Low et al. (ACM TOG 31(1), 2012): a lobe
A / (1 + B (1 - n.h))^C and a Lambertian part. The lobe is scaled so that both together reflect the light of the metal.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError

Floats = NDArray[np.float64]

#: processes of the goniometer's metals (origin: MT-MRT/JSSS-GonioreflectometryBRDF), None where no process of ours made
#: the surface, and whether the measured plane is across a lay: more light is in it than a round lobe has. Ra is unknown
GONIOMETER_PROCESSES = {
    "aluminium": ("polished", False),
    "brass": ("polished", False),
    "copper": ("brushed", True),
    "aluminium_ground": ("ground", True),
    "stainless": ("rolled", False),
    "stainless_brushed": ("brushed", True),
    "aluminium_sandblasted": ("grit_blasted", False),
    "steel_sandblasted": ("grit_blasted", False),
    "steel_galvanised": (None, False),
}

#: bare metals of the MERL data set, all polished spheres, and their reflectance [1]: of the metals in the visible
MERL_METALS = {
    "alum-bronze": 0.75,
    "aluminium": 0.91,
    "brass": 0.75,
    "chrome": 0.65,
    "chrome-steel": 0.60,
    "nickel": 0.63,
    "ss440": 0.60,
    "steel": 0.57,
    "tungsten-carbide": 0.50,
}

#: Ward 1992, table 1: process, share of the light that is diffuse, rho_d / (rho_d + rho_s), and alpha along and across
WARD = {
    "rolled brass": ("rolled", 0.10 / 0.43, (0.050, 0.160)),
    "rolled aluminium": ("rolled", 0.10 / 0.31, (0.040, 0.090)),
    "lightly brushed aluminium": ("brushed", 0.15 / 0.34, (0.088, 0.130)),
}

#: exit angles of the goniometer that are used, and the largest incidence [deg]; shadowing dominates beyond
EXIT_DEG, LARGEST_INCIDENCE_DEG = (15.0, 20.0, 30.0, 40.0, 45.0, 50.0), 65.0


@dataclass(frozen=True)
class MeasuredSurface:
    """BRDF of a metal in the plane of incidence, on the side of the mirror direction.

    ``incidence`` and ``exit`` (n,) [rad], ``brdf`` (n,) [1/sr], ``reflected`` (n,): share of the light that leaves in
    all directions [1]. ``process``: nearest process of :mod:`mitsim.scene.surface.processes`, None if there is none.
    ``across_lay``: whether the plane is across machining marks.
    """

    name: str
    process: str | None
    incidence: Floats
    exit: Floats
    brdf: Floats
    reflected: Floats
    across_lay: bool = False


def goniometer_surfaces(folder: Path) -> list[MeasuredSurface]:
    """Return the metals of ``brdf_metals``, at 2 to 5.7 um.

    Raises
    ------
    InputError
        If the files are missing.
    """
    rows = _rows(folder / "brdf_metals" / "brdf_in_plane.csv")
    lost = {
        (row["finish"], float(row["theta_out_deg"])): float(row["emissivity"])
        for row in _rows(folder / "brdf_metals" / "emissivity.csv")
    }
    out = []
    for name, (process, across_lay) in GONIOMETER_PROCESSES.items():
        chosen = [
            (float(row["theta_in_deg"]), float(row["theta_out_deg"]), float(row["brdf_per_sr"]))
            for row in rows
            if row["finish"] == name and float(row["brdf_per_sr"]) > 0
        ]
        incidence, leaving, brdf = np.array(chosen).T
        reflected = np.array([1 - lost[name, angle] for angle in leaving.tolist()])
        angles = np.radians(incidence), np.radians(leaving)
        out.append(MeasuredSurface(name, process, *angles, brdf, reflected, across_lay))
    return out


def merl_surfaces(folder: Path) -> list[MeasuredSurface]:
    """Return the bare metals of ``merl_fits`` at the goniometer's angles, in green light.

    Raises
    ------
    InputError
        If the file is missing.
    """
    fits = {row["material"]: row for row in _rows(folder / "merl_fits" / "merl_abc_low2012.csv")}
    incidence, leaving = (
        np.radians(one.ravel())
        for one in np.meshgrid(np.arange(1.0, LARGEST_INCIDENCE_DEG + 1), EXIT_DEG, indexing="xy")
    )
    out = []
    for name, reflectance in MERL_METALS.items():
        b, c, diffuse = (float(fits[name][key]) for key in ("B", "C", "kD_g"))
        lobe = (1 + b * (1 - np.cos((leaving - incidence) / 2))) ** -c
        # normalised over the hemisphere of half vectors, about the nominal incidence of 30 deg
        scale = max(reflectance - diffuse, 0.0) / _returned(b, c)
        shape = scale * lobe / (np.cos(incidence) * np.cos(leaving))
        brdf = shape + diffuse / np.pi
        out.append(MeasuredSurface(name, "polished", incidence, leaving, brdf, np.full(brdf.shape, reflectance)))
    return out


def _returned(b: float, c: float, incidence: float = np.radians(30.0)) -> float:
    """Return the share of light that (1 + B (1 - n.h))^-C / (cos i cos o) returns from one incidence."""
    # exit directions around the mirror direction, dense where the lobe is narrow
    polar = np.concatenate([[0.0], np.geomspace(1e-5, np.pi, 4000)])
    turn = 2 * np.pi * (np.arange(180) + 0.5) / 180
    mid, width = (polar[1:] + polar[:-1]) / 2, np.cos(polar[:-1]) - np.cos(polar[1:])
    light = np.array([-np.sin(incidence), 0.0, np.cos(incidence)])
    mirror, side = np.array([np.sin(incidence), 0.0, np.cos(incidence)]), np.array([0.0, 1.0, 0.0])
    up = np.cross(mirror, side)
    out = np.cos(mid)[:, None, None] * mirror + np.sin(mid)[:, None, None] * (
        np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * up
    )
    half = out + light
    cosine = half[..., 2] / np.linalg.norm(half, axis=-1)
    value = np.where(out[..., 2] > 0, (1 + b * (1 - cosine)) ** -c, 0.0) / np.cos(incidence)
    return float((value.mean(axis=1) * 2 * np.pi * width).sum())


def roughness_pairs(folder: Path) -> tuple[Floats, Floats]:
    """Return Sa of all wavelengths and Sa below 10 um of wavelength, (n,) [um] each, of ``metamorpha_roughness``.

    Raises
    ------
    InputError
        If the file is missing.
    """
    rows = _rows(folder / "metamorpha_roughness" / "rugosidades.csv")
    pairs = np.array([(float(a), float(b)) for a, b in ((row["Sa"], row["Sa λ<10um"]) for row in rows) if a and b])
    pairs = pairs[(pairs > 0).all(axis=1)]
    return pairs[:, 0], pairs[:, 1]


def map_and_brdf_alphas(folder: Path) -> Floats:
    """Return alpha from a height map and alpha from the BRDF, (n, 2) [1], of six blasted aluminium surfaces.

    Raises
    ------
    InputError
        If the file is missing.
    """
    rows = _rows(folder / "published_tables" / "vgonio_aluminium_alpha.csv")
    return np.array([[float(row["beckmann_alpha_from_map"]), float(row["beckmann_alpha_from_brdf"])] for row in rows])


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        raise InputError(path, "", "no such file", "the folder of real data, see docs/how-to/real-captures.md")
    lines = [line for line in path.read_text("utf-8-sig").splitlines() if line and not line.startswith("#")]
    return list(csv.DictReader(lines))
