"""State the claims of the talk's slides on views, with the figures of the results."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import xarray as xr

from characterisation.scores.deciles import spearman
from characterisation.tasks.task_reading import read_task
from characterisation.words.numbers import listed, two_digits, unit_symbol
from mitsim.study import MINIMUM_POINTS
from mitsim.talk import view_figures as figures
from mitsim.talk.judged_views import QUANTITIES, SCORES, JudgedViews, true_error
from mitsim.talk.make import trials_name
from mitsim.talk.results import Results
from mitsim.talk.slides import Claim, Slide, collected, largest_of, mean_of, verdict
from mitsim.talk.talk_file import ExampleEntry, Talk, sample_key

#: mean rank correlation of bins down to which agreement is very good; chosen
_VERY_GOOD = -0.8

#: mean rank correlation of bins down to which agreement is good; chosen
_GOOD = -0.5

#: R_m below which a view lacks a feature; chosen
_HIDDEN = 0.1

#: S_m of such a view, over the largest, above which it misleads; chosen
_BIASED = 0.25

#: number of bins at each end that are called bad and good views
_END = 3


def judged_of(talk: Talk, results: Results, measured: dict[str, xr.Dataset], slide: Slide) -> JudgedViews:
    """Return scores and errors of all samples that have them; ``slide`` takes the names of missing results.

    ``measured`` are errors of real captures by the key of their sample, in place of virtual ones.
    """
    names = {sample.name: sample.key for sample in talk.file.samples}
    scores = collected(results, {name: f"scores_{key}" for name, key in names.items()}, slide)
    wanted = {sample.name: trials_name(sample) for sample in talk.file.samples if sample.key not in measured}
    errors = collected(results, wanted, slide)
    errors |= {name: measured[key] for name, key in names.items() if key in measured}
    both = [name for name in names if name in scores and name in errors]
    task = read_task(talk.folder / talk.file.task)
    return JudgedViews(task, scores, {name: errors[name] for name in both})


def scoring(talk: Talk, judged: JudgedViews) -> Slide:
    """Return slide *Viewpoint Scoring*."""
    slide = Slide("Viewpoint Scoring")
    name = talk.file.sphere.sample
    if name not in judged.scores:
        slide.missing.append(f"scores_{talk.sample(name).key}")
        return slide
    scores, feature = judged.scores[name], talk.file.shown_feature
    words = f"Number of points on {feature} ({name}) over the views that the stage reaches"
    slide.pictures["reach"] = (figures.reach_figure(scores, feature), words)
    points = scores["n"].sel(feature=feature).values
    reached, outside = scores.sizes["view"], scores.sizes["outside"]
    reasons = Counter(_reason(str(words)) for words in scores["reason"].values)
    others = listed([f"{count} {why}" for why, count in reasons.most_common()])
    left_out = f" Of the others {others}." if reasons else ""
    moved = scores.attrs["moved_out"] or "No"
    slide.claims.append(
        Claim(
            "Sub divide icosahedron to sample a sphere. Ensure reachability by the tilt table.",
            f"The three-axis table reaches {reached} of {reached + outside} directions.{left_out} {moved} views moved "
            f"away to keep clear of the part. {feature} has {points.min():.0f} to {points.max():.0f} points.",
            f"{reached} of {reached + outside} directions",
            "shown",
        )
    )
    return slide


def _reason(words: str) -> str:
    """Return why a direction is left out, without the numbers of the single case."""
    kind, _, detail = words.partition(": ")
    return f"need a {detail.split()[0]} beyond its limits" if kind == "stage" and " beyond " in detail else words


def view_score(talk: Talk, judged: JudgedViews) -> Slide:
    """Return slide *The View Score*."""
    slide, shown = Slide("The View Score"), talk.file.sphere
    if shown.sample not in judged.scores:
        slide.missing.append(f"scores_{talk.sample(shown.sample).key}")
        return slide
    scores = judged.scores[shown.sample]
    shapes = list(judged.task.shapes_for(shown.measurement))
    words = f"S_f, R_f, S_m, R_m and V_m over the views: {shown.measurement}, {shown.sample}"
    slide.pictures["scores"] = (figures.scores_figure(scores, shown.measurement, shapes), words)
    here = scores.sel(measurement=shown.measurement)
    sums, product = here["S_m"].values.astype(float), here["R_m"].values.astype(float)
    blocked = product < _HIDDEN
    reach = largest_of(sums[blocked]) / sums.max() if blocked.any() else 0.0
    figure = f"S_m up to {100 * reach:.0f} % of the largest with a feature out of sight"
    findings = (
        f"{int(blocked.sum())} views see little of a feature (R_m below {_HIDDEN:g}). Their S_m is up to "
        f"{100 * reach:.0f} % of the largest."
    )
    better = reach > _BIASED
    if shown.sample in judged.errors:
        error = true_error(judged.errors[shown.sample], shown.measurement)
        valid = np.isfinite(error)
        alone = spearman(sums[valid], error[valid])
        together = spearman(np.where(here["possible"].values > 0, here["V_m"].values, 0)[valid], error[valid])
        both = f"S_m alone {_signed(alone)}, V_m {_signed(together)}"
        findings += f" Rank correlation with the true error of views: {both}."
        better = better and together < alone
        figure = f"rank correlation with error: {both}"
    slide.claims.append(
        Claim(
            "[S_m] is susceptible to bias. Doesn't take into account if all features are actually visible.",
            findings,
            figure,
            verdict(better, reach > _BIASED),
        )
    )
    return slide


def examples(talk: Talk, judged: JudgedViews) -> Slide:
    """Return slides *Example Result*."""
    slide = Slide("Example Results")
    for example in talk.file.examples:
        if example.sample not in judged.errors or example.sample not in judged.scores:
            slide.missing.append(trials_name(talk.sample(example.sample)))
            continue
        words = f"Deciles of V_m for {example.measurement} ({example.sample}), and spheres of V_m and of the true error"
        picture = figures.example_figure(judged, example.sample, example.measurement)
        slide.pictures[_picture(example)] = (picture, words)
        slide.claims.append(_example(judged, example))
    return slide


_WORDS = {
    "18": "Only very small number of views have measurable data, which are accurately predicted by the view score. We "
    "see good correlation between the view score and measurement accuracy and uncertainty.",
    "19": "Good correlation. Regions of poor accuracy and impossible measurements due to occlusion are accurately "
    "predicted. Less distinction between top 30% of views.",
    "20": "Despite ideal conditions the view angle is still very important and significant benefits can be had.",
}


#: why errors alone say little where many trials have no value
_SURVIVORS = (
    "Fits that their points do not determine are rejected, so a poor view shows its best trials alone; the score "
    "predicts which views give a value."
)


def _example(judged: JudgedViews, example: ExampleEntry) -> Claim:
    cell, errors = (judged.cell(example.sample, example.measurement, "V_m"), judged.errors[example.sample])
    values, views, share = cell["error"].values, cell["views"].values, cell["share"].values
    unit = unit_symbol(str(judged.scores[example.sample]["unit"].sel(measurement=example.measurement).item()))
    possible = int(views[1:].sum())
    count = np.isfinite(errors["error"].sel(measurement=example.measurement).values).sum(axis=1)
    tried = errors["tried"].values
    measurable = int((2 * count >= tried)[tried > 0].sum())
    if not possible:
        return _nothing_possible(judged, example, measurable, float(share[0]))
    bins = np.flatnonzero(np.isfinite(values[1:])) + 1
    correlations = [cell.attrs[f"{name}_correlation"] for name in QUANTITIES]
    ratio = float(values[bins[0]] / values[bins[-1]]) if len(bins) > 1 else math.nan
    best = [values[number] for number in bins[-3:]]
    top = max(best) / min(best) if len(best) > 1 else math.nan
    ends = "" if math.isnan(ratio) else f" ({two_digits(values[bins[0]])} to {two_digits(values[bins[-1]])} {unit})"
    findings = (
        f"{example.measurement}, {example.sample}: {possible} of {int(views.sum())} views are possible by V_m; "
        f"{measurable} have a value in half of the trials. Trials with a value: {_percent(share[0])} where V_m says "
        f"impossible, "
        f"{_percent(_mean_share(cell))} elsewhere. Rank correlation of bins with error {_signed(correlations[0])}, "
        f"standard deviation {_signed(correlations[1])}, missing values {_signed(correlations[2])}. Error of the worst "
        f"over the best bin: {_ratio(ratio)}{ends}; the best three bins differ by the factor {_ratio(top)}."
    )
    good = [correlation < _GOOD for correlation in correlations[:2] if not math.isnan(correlation)]
    predicts = correlations[2] < _GOOD
    figure = f"rank correlation {_signed(correlations[0])} with error, {_signed(correlations[1])} with deviation"
    why = _SURVIVORS if predicts and not all(good) else ""
    return Claim(
        _WORDS.get(example.slide, example.measurement),
        findings,
        figure,
        verdict(bool(good) and all(good), any(good) or predicts),
        why,
        _picture(example),
    )


def _nothing_possible(judged: JudgedViews, example: ExampleEntry, measurable: int, share: float) -> Claim:
    """Return the claim of an example without views that are possible by V_m."""
    points, shapes = judged.scores[example.sample]["n"], list(judged.task.shapes_for(example.measurement))
    most = listed([f"{float(points.sel(feature=name).max()):.0f} points of {name}" for name in shapes])
    views = points.sizes["view"]
    return Claim(
        _WORDS.get(example.slide, example.measurement),
        f"{example.measurement}, {example.sample}: V_m calls all {views} views impossible. Some are expected to show "
        f"up to {most}, but none to show {MINIMUM_POINTS} of each. Of the trials {_percent(share)} have a value "
        f"nonetheless, "
        f"by light from other faces. {measurable or 'No'} views have one in half of their trials.",
        f"0 of {views} views possible by V_m, {measurable} measurable in half of the trials",
        verdict(False, not measurable),
        "The prediction that this cannot be measured holds. Without possible views there is no correlation to test.",
        _picture(example),
    )


def _picture(example: ExampleEntry) -> str:
    return f"example_{example.measurement}_{sample_key(example.sample)}"


def _mean_share(cell: xr.Dataset) -> float:
    views, share = cell["views"].values[1:], cell["share"].values[1:]
    return float((views * np.nan_to_num(share)).sum() / views.sum()) if views.sum() else math.nan


def _percent(share: float) -> str:
    return "no views" if math.isnan(share) else f"{100 * share:.0f} %"


def _signed(value: float) -> str:
    return "unknown" if math.isnan(value) else f"{value:+.2f}".replace("-", "−")


def _ratio(value: float) -> str:
    return "unknown" if math.isnan(value) else f"{value:.1f}"


def accuracy(judged: JudgedViews) -> Slide:
    """Return slide *View Score Accuracy*."""
    slide = Slide("View Score Accuracy")
    if not judged.errors:
        return slide
    words = (
        "Mean rank of the ten bins by error, standard deviation and share of trials with a value, for V_m, predicted "
        "risk and number of points"
    )
    ranks = {kind: judged.ranks(kind) for kind in SCORES}
    slide.pictures["accuracy"] = (figures.ranks_figure(ranks), words)
    count = len(judged.task.measurements) * len(judged.errors)

    def correlations(kind: str) -> str:
        return listed([_signed(ranks[kind][quantity].attrs["correlation"]) for quantity in QUANTITIES])

    talks = [ranks["V_m"][quantity].attrs["correlation"] for quantity in ("error", "deviation")]
    good = max(talks) <= _VERY_GOOD
    trend = spearman(ranks["V_m"]["error"]["bin"].values, ranks["V_m"]["error"]["rank"].values)
    why = "The predicted risk also knows how the points constrain a fit."
    slide.claims.append(
        Claim(
            "Comparison of our predicted bin rank based on the view score and actual bin ranking are very good.",
            f"Over {count} cells, {len(judged.task.measurements)} measurements of {len(judged.errors)} samples, the "
            "mean rank correlations of bins with error, with standard deviation and with missing values are "
            + "; ".join(f"{correlations(kind)} for {name}" for kind, name in SCORES.items())
            + f". Of V_m with error, by sample (share of trials with a value): {'; '.join(_by_sample(judged))}. The "
            "mean ranks over all cells, as the talk shows them, have the rank correlation "
            f"{_signed(trend)} with the bins.",
            f"rank correlation {_signed(talks[0])} of a cell, {_signed(trend)} of the mean ranks",
            verdict(good, trend <= _VERY_GOOD),
            "" if good else why,
        )
    )
    misses = np.abs(ranks["V_m"]["error"]["rank"].values - np.arange(10, 0, -1))
    bad, best = mean_of(misses[:_END]), mean_of(misses[-_END:])
    cells = [judged.cell(sample, name, "V_m") for sample in judged.errors for name in judged.task.measurements]
    impossible = mean_of([cell["share"].values[0] for cell in cells])
    possible = mean_of([_mean_share(cell) for cell in cells])
    slide.claims.append(
        Claim(
            "Especially good at predicting bad views.",
            f"The mean rank by error misses the predicted one by {_ratio(bad)} for the three worst bins, and by "
            f"{_ratio(best)} for the three best. Of the trials of views that V_m calls impossible "
            f"{_percent(impossible)} have a value, of the others {_percent(possible)}.",
            f"ranks missed by {_ratio(bad)} for bad views, {_ratio(best)} for good ones",
            verdict(bad < best, impossible < possible / 2),
        )
    )
    return slide


def _by_sample(judged: JudgedViews) -> list[str]:
    """Return, for each sample, the mean rank correlation of the bins of V_m, and the share of trials with a value."""
    out = []
    for sample, errors in judged.errors.items():
        cells = [judged.cell(sample, name, "V_m") for name in judged.task.measurements]
        middle = mean_of([cell.attrs["error_correlation"] for cell in cells])
        tried = len(errors["measurement"]) * int(errors["tried"].sum())
        share = float(np.isfinite(errors["error"].values).sum() / tried) if tried else math.nan
        out.append(f"{sample} {_signed(middle)} ({_percent(share)})")
    return out
