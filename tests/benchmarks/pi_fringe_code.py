"""Projector coordinates at the corners of the recordings ``pi_fringe``: a Raspberry Pi camera and a cheap projector.

Signal chain: 44 images of Gray bits, 11 of columns and 11 of rows, finest first, each followed by its inverse -> which
shown image each saved one is -> codes of pixels by least squares over all images -> a homography -> codes again, to an
eighth of a projector pixel, near it -> at each corner a local homography (Moreno and Taubin, 3DIMPVT 2012).

The recordings are not what their file names say: in some poses the camera was one image behind the projector, some
images are a mixture of two shown ones, and the exposure follows the brightness. A saved image j is therefore taken as

    s_j = A (c_0 + c_1 D_{j-1} + c_2 D_j),

A the mean of all images (the print), D_j the shown pattern, c by least squares for each image, each linear along the
rows. The three coarsest bits are even over most of a board, so that only the exposure would tell them: they are left
out, and the fourth may come out inverted. The order of the code is a multiple of 256 px. The order nearest to that
of poses with clear coarse bits is taken, unless the epipolar geometry of all poses requires another (:func:`in_order`).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

Floats = NDArray[np.float64]

#: Gray bits of an axis; those used, whose period is 512 px; parts of a projector pixel; the projector's size, assumed
BITS, USED, FINE, PROJECTOR = 11, 8, 8, (1920, 1080)
IMAGES, PERIOD = 2 * USED + 1, 2 ** (USED + 1)
#: inner corners of the board, its squares [mm]
CORNERS, SQUARE_MM = (8, 6), 10.0
#: blur of the projector's stripes [projector px], half a side of the window of a local homography [px], its stride
_BLUR, _HALF, _STRIDE = 1.0, 23, 2
#: distance from epipolar lines up to which a pose's order is taken as it is [projector px]
_EPIPOLAR_PX = 0.5
#: code [projector px] that the middle of the board has in the poses whose coarse bits are plain (0 and 1)
USUAL = (840.0, 290.0)


@dataclass(frozen=True)
class Corners:
    """Of one pose: ``camera`` and ``projector`` (n, 2) [px]; ``local`` rms of codes about their local homography."""

    pose: int
    camera: Floats
    projector: Floats
    local: float


def read_pose(folder: Path, pose: int) -> tuple[NDArray[np.uint8], tuple[int, int, int, int]]:
    """Images (44, h, w) in the order in which they were saved, and their place: column, row, width, height."""
    (left, top), (width, height), _ = json.loads((folder / "crops.json").read_text())[str(pose)]
    names = [f"{axis}_bit{bit:02d}_{what}.png" for axis in "xy" for bit in range(BITS) for what in ("on", "off")]
    images = [cv2.imread(str(folder / f"pose_{pose:03d}" / name), cv2.IMREAD_UNCHANGED) for name in names]
    stack = np.array([image if image.ndim == 2 else image[..., 1] for image in images])
    return stack, (left, top, width, height)


def camera_corners(folder: Path, pose: int) -> Floats:
    """Corners (n, 2) [px] of the board in the camera's image, ordered as the board's: no code is looked at."""
    stack, (left, top, _, _) = read_pose(folder, pose)
    return _corners(stack.astype(np.float32).mean(axis=0), pose) + np.array([left, top])


def _corners(mean: NDArray[np.floating], pose: int) -> Floats:
    levels = np.clip(mean * 255 / np.percentile(mean, 99), 0, 255).astype(np.uint8)
    done, found = cv2.findChessboardCornersSB(levels, CORNERS, flags=cv2.CALIB_CB_ACCURACY)
    if not done:
        raise ValueError(f"pose {pose}: no board of {CORNERS[0]} x {CORNERS[1]} corners")
    corners = found.reshape(-1, 2).astype(float)
    # the board looks the same turned by half a turn but for its colours
    return np.asarray(corners[::-1] if corners[-1, 0] < corners[0, 0] else corners)


def read_corners(folder: Path, pose: int) -> Corners:
    """Corners of the board in a pose, for the camera and for the projector, ordered as the board's."""
    stack, (left, top, width, height) = read_pose(folder, pose)
    mean = stack.astype(np.float32).mean(axis=0)
    corners = _corners(mean, pose)
    start = _first_homography(stack, mean)
    rows, columns = np.mgrid[0:height:_STRIDE, 0:width:_STRIDE]
    near = np.zeros(rows.shape, bool)
    for x, y in corners:
        near |= (np.abs(columns - x) <= _HALF) & (np.abs(rows - y) <= _HALF)
    places = np.stack([columns[near], rows[near]], axis=1)
    codes, lit = _fine_codes(stack, mean, places, start)
    at, off = [], []
    for corner in corners:
        window = (np.abs(places - corner) <= _HALF).all(axis=1) & lit
        here = (places[window] - corner).astype(np.float64)
        local, inside = cv2.findHomography(here, codes[window], cv2.RANSAC, 1.5)
        local, _ = cv2.findHomography(here[inside.ravel() > 0], codes[window][inside.ravel() > 0], 0)
        at.append(local[:2, 2] / local[2, 2])
        left_over = cv2.perspectiveTransform(here[:, None], local)[:, 0] - codes[window]
        off.append(np.median(np.abs(left_over)) * 1.4826)
    return Corners(pose, corners + np.array([left, top]), np.array(at), float(np.median(off)))


def in_order(known: list[Corners], pose: Corners) -> tuple[Corners, float]:
    """Move a pose's code by a multiple of 256 px if the epipolar geometry of known poses asks for it; rms [px]."""
    tried = [(column, row) for column in (0, -1, 1) for row in (0, -1, 1)]
    rms, moved = [], []
    for step in tried:
        moved.append(pose.projector + PERIOD / 2 * np.array(step))
        camera = np.concatenate([*(one.camera for one in known), pose.camera])
        projector = np.concatenate([*(one.projector for one in known), moved[-1]])
        matrix, _ = cv2.findFundamentalMat(camera, projector, cv2.FM_8POINT)
        lines = cv2.computeCorrespondEpilines(camera.reshape(-1, 1, 2), 1, matrix)[:, 0]
        rms.append(float(np.sqrt(np.mean(((lines[:, :2] * projector).sum(axis=1) + lines[:, 2]) ** 2))))
    best = 0 if rms[0] < _EPIPOLAR_PX else int(np.argmin(rms))
    return Corners(pose.pose, pose.camera, moved[best], pose.local), rms[best]


def _tables(blur: float) -> Floats:
    """Shown patterns of the used bits, (2 USED + 1, PERIOD * FINE), along the code: on, off of bit 0, 1, ..."""
    code = np.arange(2 * PERIOD * FINE) // FINE
    gray = code ^ (code >> 1)
    out = []
    for bit in range(USED + 1):
        lit = ((gray >> bit) & 1).astype(float)
        lit = gaussian_filter1d(lit, blur * FINE, mode="wrap") if blur > 0 else lit
        out += [lit[: PERIOD * FINE], 1 - lit[: PERIOD * FINE]]
    return np.array(out)[:IMAGES]


def _coarse_codes(levels: Floats, mixed: Floats) -> tuple[NDArray[np.intp], Floats]:
    """Codes (n,) modulo PERIOD of levels (IMAGES, n) over their mean, and what each image's model leaves (IMAGES,)."""
    shown = _tables(0.0)[:, FINE // 2 :: FINE]
    before = np.vstack([np.full((1, PERIOD), 0.5), shown[:-1]])
    low, high = np.percentile(levels[2:], [5, 95])
    model = np.stack([np.full(IMAGES, low), (1 - mixed) * (high - low), mixed * (high - low)], axis=1)
    spread = np.full(IMAGES, 0.25 * (high - low))
    spread[[0, 1, -1]] *= 8
    codes = np.zeros(levels.shape[1], np.intp)
    for _ in range(5):
        every = model[:, :1] + model[:, 1:2] * before + model[:, 2:] * shown
        weight = 1 / spread[:, None] ** 2
        codes = ((every**2 * weight).sum(axis=0) - 2 * (levels * weight).T @ every).argmin(axis=1)
        for j in range(IMAGES):
            terms = np.stack([np.ones(len(codes)), before[j, codes], shown[j, codes]], axis=1)
            model[j], spread[j] = _robust_fit(terms, levels[j])
    return codes, spread


def _robust_fit(terms: Floats, values: Floats) -> tuple[Floats, float]:
    kept = np.ones(len(values), bool)
    for _ in range(3):
        found = np.linalg.lstsq(terms[kept], values[kept], rcond=1e-6)[0]
        off = np.abs(values - terms @ found)
        spread = float(1.4826 * np.median(off[kept])) + 1e-3
        kept = off < 4 * spread
    return found, max(spread, 0.015)


def _first_homography(stack: NDArray[np.uint8], mean: Floats) -> Floats:
    """Homography from pixels of the crop to codes, by the coarse codes of some bright pixels."""
    rows, columns = np.nonzero(mean > np.percentile(mean, 45))
    chosen = np.random.default_rng(0).choice(len(rows), 6000, replace=False)
    places = np.stack([columns[chosen], rows[chosen]], axis=1).astype(float)
    folded = []
    for axis in range(2):
        levels = stack[2 * BITS * axis : 2 * BITS * axis + IMAGES, rows[chosen], columns[chosen]]
        levels = levels / mean[rows[chosen], columns[chosen]]
        tried = []
        for mixed in _delays():
            codes = _coarse_codes(levels, mixed)[0].astype(float)
            tried.append((_smooth(places, codes), codes))
            if tried[-1][0] > 0.9:
                break
        folded.append(max(tried, key=lambda one: one[0])[1])
    best = _unfolded(places, np.stack(folded, axis=1))
    if best[0] < 0.3:
        raise ValueError(f"no plane explains the code: {best[0]:.2f} of the pixels")
    middle = cv2.perspectiveTransform(np.array([[[stack.shape[2] / 2, stack.shape[1] / 2]]]), best[1])[0, 0]
    shift = PERIOD / 2 * np.rint((np.array(USUAL) - middle) / (PERIOD / 2))
    return np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1.0]]) @ best[1]


def _delays() -> list[Floats]:
    """Shares (IMAGES,) of the image that is shown last in each saved one to start with: one for all, or a change."""
    same = [np.full(IMAGES, share) for share in (0.0, 0.3, 0.6, 1.0)]
    later = [
        np.where(np.arange(IMAGES) < at, *ends) for at in (10, 7, 5, 12, 14, 3) for ends in ((0.0, 1.0), (1.0, 0.0))
    ]
    return same + later


def _smooth(places: Floats, codes: Floats) -> float:
    """Share of pixels (n, 2) whose codes (n,) lie within 3 px of a line in their neighbourhood, of five of these."""
    wave, shares = _wave(codes), []
    middle, size = places.mean(axis=0), np.ptp(places, axis=0)
    for step in ((0, 0), (-0.3, -0.2), (0.3, -0.2), (-0.3, 0.2), (0.3, 0.2)):
        near = np.linalg.norm(places - middle - size * step, axis=1) < 60
        if near.sum() > 60:
            shares.append(_affine(places[near], wave[near])[1])
    return float(np.mean(shares))


def _wave(codes: Floats) -> Floats:
    """Codes t and PERIOD - 1 - t made one: a triangular wave."""
    half = PERIOD / 2
    return np.asarray(np.where(codes % PERIOD < half, codes % half, half - 1 - codes % half))


def _unfolded(places: Floats, folded: Floats) -> tuple[float, Floats]:
    """Homography from pixels (n, 2) to codes of which one knows multiples of PERIOD less (n, 2), either sense.

    Without the coarser bits a code t is not told from PERIOD - 1 - t: a triangular wave is left of it.
    """
    wave = _wave(folded)
    best: tuple[float, Floats] = (0.0, np.eye(3))
    for column in np.linspace(places[:, 0].min(), places[:, 0].max(), 7)[1:-1]:
        for row in np.linspace(places[:, 1].min(), places[:, 1].max(), 7)[1:-1]:
            near = np.linalg.norm(places - [column, row], axis=1) < 60
            if near.sum() < 60:
                continue
            affine, senses = [], []
            for axis in range(2):
                line, share = _affine(places[near], wave[near, axis])
                sense = np.sign(line[axis]) or 1.0
                affine.append(line * sense)
                senses.append((sense, share))
            if min(share for _, share in senses) < 0.5:
                continue
            # turned round where it falls, so that codes rise with columns and rows: -1 - wave
            shift = [0.0 if sense > 0 else -1.0 for sense, _ in senses]
            model = np.array([[*affine[0]], [*affine[1]], [0, 0, 1.0]])
            model[:2, 2] += shift
            share = 0.0
            for reach in (60, 90, 130, 190, 280, 1e9, 1e9):
                chosen = np.linalg.norm(places - [column, row], axis=1) <= reach
                told = cv2.perspectiveTransform(places[chosen][:, None], model)[:, 0]
                codes = _nearest(wave[chosen], told)
                good = (np.abs(codes - told) < (12 if reach < 1e9 else 8)).all(axis=1)
                if good.sum() < 40:
                    break
                found, inside = cv2.findHomography(places[chosen][good], codes[good], cv2.RANSAC, 3.0, maxIters=2000)
                if found is None:
                    break
                model, share = found, float(inside.sum()) / len(places)
            if share > best[0]:
                best = share, model
            if share > 0.8:
                return best
    return best


def _affine(places: Floats, wave: Floats) -> tuple[Floats, float]:
    """Line (3,) through a coordinate over places by random samples, and the share of places within 3 px of it."""
    rng, terms = np.random.default_rng(1), np.column_stack([places, np.ones(len(places))])
    best, most = np.zeros(3), 0.0
    for _ in range(300):
        three = rng.choice(len(places), 3, replace=False)
        try:
            line = np.linalg.solve(terms[three], wave[three])
        except np.linalg.LinAlgError:
            continue
        share = float(np.mean(np.abs(terms @ line - wave) < 3))
        if share > most and np.abs(line[:2]).max() < 3:
            best, most = line, share
    return best, most


def _nearest(wave: Floats, told: Floats) -> Floats:
    """Codes that have a triangular wave, nearest to those told."""
    half = PERIOD // 2
    rising = wave + PERIOD * np.rint((told - wave) / PERIOD)
    falling = (PERIOD - 1 - wave) + PERIOD * np.rint((told - (PERIOD - 1 - wave)) / PERIOD)
    assert half * 2 == PERIOD
    return np.asarray(np.where(np.abs(rising - told) <= np.abs(falling - told), rising, falling))


def _fine_codes(
    stack: NDArray[np.uint8], mean: Floats, places: NDArray[np.intp], model: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Codes (n, 2) at pixels (n, 2) by all images, near a homography, and whether a pixel is bright enough."""
    tables = _tables(_BLUR)
    columns, rows = places.T
    bright = mean[rows, columns] > np.percentile(mean, 30)
    along = rows / stack.shape[1] - 0.5
    codes = cv2.perspectiveTransform(places.astype(float)[:, None], model)[:, 0]
    for turn, (reach, step) in enumerate(((8.0, 4), (6.0, 4), (4.0, 2), (3.0, 1))):
        if turn:
            model, _ = cv2.findHomography(places[bright].astype(float), codes[bright], cv2.RANSAC, 3.0)
        told = cv2.perspectiveTransform(places.astype(float)[:, None], model)[:, 0]
        new = np.empty_like(codes)
        for axis in range(2):
            images = stack[2 * BITS * axis : 2 * BITS * axis + IMAGES, rows, columns].astype(float)
            dark = images < 254
            levels = images / mean[rows, columns]
            index = _index(codes[:, axis])
            fits = []
            for j in range(1, IMAGES):
                terms = np.stack(
                    [
                        np.ones(len(along)),
                        along,
                        tables[j - 1, index],
                        tables[j - 1, index] * along,
                        tables[j, index],
                        tables[j, index] * along,
                    ],
                    axis=1,
                )
                used = bright & dark[j]
                fits.append(_robust_fit(terms[used], levels[j, used]) if used.sum() > 300 else None)
            lowest, offset = np.full(len(along), np.inf), np.zeros(len(along))
            for tried in np.arange(-reach, reach + 1e-9, step / FINE):
                here, cost = _index(told[:, axis] + tried), np.zeros(len(along))
                for j, fit in enumerate(fits, 1):
                    if fit is None:
                        continue
                    (c0, c1, c2, c3, c4, c5), spread = fit
                    seen = c0 + c1 * along + (c2 + c3 * along) * tables[j - 1, here]
                    seen += (c4 + c5 * along) * tables[j, here]
                    cost += np.where(dark[j], np.minimum(((levels[j] - seen) / spread) ** 2, 16.0), 0.0)
                better = cost < lowest
                lowest[better], offset[better] = cost[better], tried
            new[:, axis] = told[:, axis] + offset
        codes = new
    return codes, bright


def _index(code: Floats) -> NDArray[np.intp]:
    return np.asarray(np.floor((code + 0.5) * FINE).astype(np.intp) % (PERIOD * FINE))
