"""Tables of the fitted shapes and priors of finishes, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mitsim.scene.surface.processes import LAY_FACTOR, TAIL_RANGE, WIDE_ANGLE_FACTOR
from tests.proofs.finishes.measured_surfaces import (
    WARD,
    goniometer_surfaces,
    map_and_brdf_alphas,
    merl_surfaces,
    roughness_pairs,
)
from tests.proofs.finishes.shape_fit import (
    OFF_MIRROR_DEG,
    FittedShape,
    energy_found,
    factor_of,
    fit_shape,
    peak_deg,
    places_in_prior,
    process_factor,
    roughness_factor,
    spread_of_lays,
    spread_of_shares,
)
from tests.proofs.tables import markdown, number

#: exit angles at which peaks are compared [deg]
_PEAKS_DEG = (30.0, 45.0, 60.0)


def finishes_page(folder: Path) -> str:
    """Return the fits to all surfaces in a folder of real data, the priors, and the comparison of model and data."""
    measured = [fit_shape(one) for one in goniometer_surfaces(folder)]
    shapes = measured + [fit_shape(one) for one in merl_surfaces(folder)]
    parts = [
        "## Fitted shapes\n",
        _shapes_table(shapes),
        "## Priors\n",
        _priors_table(shapes, folder),
        "## Model and goniometer\n",
        _comparison_table(measured),
    ]
    return "\n".join(parts)


def _shapes_table(shapes: Sequence[FittedShape]) -> str:
    head = ["surface", "process", "wide-angle share", "at most", "Beckmann", "alpha", "lay", "misfit, rms of ln f"]
    body = []
    for one in shapes:
        share = f"{number(one.wide_angle)}" if one.determined or one.surface.process is None else "not determined"
        lay = f"{one.lay:.2f}" if one.surface.across_lay else "-"
        row = [one.surface.name, one.surface.process or "-", share, number(one.bound), f"{one.tail:.2f}"]
        body.append([*row, f"{one.alpha:.3f}", lay, f"{one.misfit:.2f}"])
    return markdown(head, body)


def _priors_table(shapes: Sequence[FittedShape], folder: Path) -> str:
    shares = spread_of_shares(shapes, [(process, share) for process, share, _ in WARD.values()])
    lays = spread_of_lays(shapes, [(process, along / across) for process, _, (along, across) in WARD.values()])
    exponent, height, central = roughness_factor(*roughness_pairs(folder))
    alphas = map_and_brdf_alphas(folder)
    from_map = factor_of(np.log(alphas[:, 1] / alphas[:, 0]).tolist())
    over = ", ".join(f"{process_factor(ra):.2f}" for ra in (0.4, 0.8, 1.6))
    tails = [one.tail for one in shapes if one.surface.process != "grit_blasted"]
    beyond = 1 - 0.05 ** (1 / len(tails))
    above = sum(tail > TAIL_RANGE[1] for tail in tails)
    held = f"{above} of {len(tails)} above {TAIL_RANGE[1]:g}, largest {max(tails):.2f}"
    rows = [
        ["odds of the wide-angle share", str(shares), f"{WIDE_ANGLE_FACTOR:g}"],
        ["ratio of alphas of a lay", str(lays), f"{LAY_FACTOR:g}"],
        ["Beckmann share", f"{held}: at most {100 * beyond:.0f} % of metals (95 %)", f"{TAIL_RANGE}, 68 %"],
        [f"Sa below 10 um, as Sa^{exponent:.2f}", f"{height}; central 68 %: {central:.2f}", "1.6, Ra and process"],
        ["alpha over processes, at Ra 0.4, 0.8, 1.6 um", over, "1.6 and 2.0: of Ra alone, 1.66 more"],
        ["alpha of a height map to that of a BRDF", str(from_map), "1.1, height map"],
    ]
    return markdown(["one-sigma factor of", "from the data (95 % interval)", "in mitsim"], rows)


def _comparison_table(shapes: Sequence[FittedShape]) -> str:
    at = ", ".join(f"{off:g}" for off in OFF_MIRROR_DEG)
    head = ["surface", "light found", *(f"peak at exit {one:g} deg: measured, model" for one in _PEAKS_DEG)]
    body = []
    for one in shapes:
        # a blasted face has no mirror-like share: its fit is scaled to the light that is there
        balanced = not one.surface.across_lay and one.surface.process != "grit_blasted"
        energy = f"{energy_found(one):.2f}" if balanced else "-"
        peaks = [", ".join(f"{angle:.0f}" for angle in peak_deg(one, angle)) for angle in _PEAKS_DEG]
        places = "-"
        if one.surface.process is not None:
            places = ", ".join(f"{100 * place:.0f}" for place in places_in_prior(one.surface))
        body.append([one.surface.name, energy, *peaks, places])
    return markdown([*head, f"place in the prior at {at} deg off the mirror [%]"], body)
