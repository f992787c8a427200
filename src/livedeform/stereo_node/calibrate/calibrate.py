"""Stereo calibration from pictures of a board: which pictures to trust, which lens model, and how good the result is.

Everything that is reported as accuracy is measured on pictures that did not enter the calibration that is judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.common.errors import CalibrationError
from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Board, Pair
from livedeform.stereo_node.boards.find_pairs import MIN_PAIRS, Progress
from livedeform.stereo_node.calibrate.between_pictures import leave_one_out, with_scatter
from livedeform.stereo_node.calibrate.bundle import Bundle, LensError, adjust, board_pose, start_bundle
from livedeform.stereo_node.calibrate.circle_centres import with_middles
from livedeform.stereo_node.calibrate.coverage import BoardCoverage, coverage_of
from livedeform.stereo_node.calibrate.known_lengths import Length, known_lengths
from livedeform.stereo_node.calibrate.lens_model import (
    HeldOut,
    held_out_errors,
    simplest_model,
    with_the_rest_held,
)
from livedeform.stereo_node.camera.rig import StereoRig

__all__ = ["Calibration", "calibrate"]

MEDIAN = np.log(2.0)  # of chi-square with two degrees of freedom, over its mean
WIDE = 0.7  # of brown4's residual: a lens that it does not fit
OUTLIER = 2.5  # times the median residual of the other picture pairs
ABSURD_PX = 3.0  # rms of the corners: found to a tenth of that, they are not those of one board


@dataclass(frozen=True)
class Calibration:
    """A stereo calibration and what is known of it."""

    bundle: Bundle
    lens_model: str  # the simplest that is no worse on unseen pictures; what it leaves out is held near zero
    rig: StereoRig
    board: Board
    used: tuple[str, ...]
    outliers: tuple[tuple[str, float], ...]  # name, residual rms px
    models: tuple[HeldOut, ...]
    lengths: tuple[Length, ...]
    coverage: BoardCoverage
    epipolar_rms_px: float  # on held-out pairs
    reprojection_rms_px: float
    n_beyond: int  # corners of unused pictures where the other pictures do not tell the lens

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Every parameter with its standard deviation; baseline in m, as ``baseline``."""
        sigmas = np.sqrt(np.diag(self.bundle.covariance))
        out = {n: (float(v), float(s)) for n, v, s in zip(self.bundle.names, self.bundle.values, sigmas, strict=True)}
        t = self.bundle.rig_pose[3:]
        direction = t / np.linalg.norm(t)
        sigma = float(np.sqrt(direction @ self.bundle.covariance[-3:, -3:] @ direction))
        return out | {"baseline": (float(np.linalg.norm(t)), sigma)}


def calibrate(
    pairs: Sequence[Pair], board: Board, size: tuple[int, int], progress: Progress | None = None
) -> Calibration:
    """Calibrate: start, outlier pictures, lens model by held-out error, final fit, known lengths on unused pictures.

    ``size`` is (width, height) of the pictures. Raises ``CalibrationError`` where the result is none: corners that are
    far from where it puts them, or no length that it tells.
    """
    say = progress or (lambda text: None)
    # whether pictures count from the same end of a board that does not tell its ends shows on pictures not used
    points, can_release = board.points, len(pairs) >= MIN_PAIRS
    start = adjust(points, pairs, start_bundle(points, pairs, size), "k1k2")
    _check_sides(start)
    say("looking for outlier pictures")
    pairs, start, kept, outliers = _trusted(points, pairs, start, can_release)
    inlying = [pairs[int(i)] for i in kept]
    start = start.with_boards(kept)
    say("comparing lens models on pictures that were not used")
    models = held_out_errors(points, inlying, start, can_release, size)
    model, released = simplest_model(models)
    start, whole = with_the_rest_held(start, model, size)
    final = adjust(points, inlying, start, whole, release=released)
    say("measuring known lengths on pictures that were not used")
    without = leave_one_out(points, inlying, final)
    final = with_scatter(final, without)
    rig = final.rig(size)
    lengths, epipolar, n_beyond = known_lengths(points, pairs, kept, final, without, board, size)
    residuals = np.concatenate([r for both in final.residuals for r in both])
    rms = float(np.sqrt((residuals**2).sum(axis=1).mean()))
    if rms > ABSURD_PX or all(length.outlier for length in lengths):
        what = f"the corners are {rms:.1f} px rms from where it puts them" if rms > ABSURD_PX else "it tells no length"
        raise CalibrationError(
            f"the pictures give no calibration: {what}", where="--left, --right",
            remedy="check --board and --kind, that the pictures of a pair are of one moment, and that they are sharp",
        )  # fmt: skip
    return Calibration(
        final, model, rig, board, tuple(p.name for p in inlying), outliers, tuple(models), tuple(lengths),
        coverage_of(points, inlying, final, size), epipolar, rms, n_beyond,
    )  # fmt: skip


def _trusted(
    points: Array, seen: Sequence[Pair], start: Bundle, can_release: bool
) -> tuple[Sequence[Pair], Bundle, NDArray[np.int64], tuple[tuple[str, float], ...]]:
    """Return the pairs (of circles: with the pictures of their middles), a fit of all of them to go on from, the rows
    of those that agree, and the names and residuals of the others."""
    pairs, circles = seen, seen[0].left.shapes is not None
    for _ in range(2 if circles else 0):  # the better the poses, the better the middles
        pairs = with_middles(points, seen, start)
        start = adjust(points, pairs, start, "k1k2")
    kept, outliers = _without_outliers(points, pairs, _wide_enough(points, pairs, start, can_release))
    if not circles or not outliers:
        return pairs, start, kept, outliers
    for _ in range(2):  # what the outliers did to the poses, and by these to all middles, goes with them
        clean = adjust(points, [pairs[int(i)] for i in kept], start.with_boards(kept), "k1k2")
        boards = np.array([board_pose(points, pair.left, clean.left) for pair in pairs])
        boards[kept] = clean.boards
        start = replace(clean, boards=boards)
        pairs = with_middles(points, seen, start)
    kept = _taken_back(points, pairs, start, kept)
    agreeing = [pairs[int(i)] for i in kept]
    fit = _wide_enough(points, agreeing, start.with_boards(kept), can_release)
    rows, more = _without_outliers(points, agreeing, fit)
    return pairs, start, kept[rows], (*(o for o in outliers if o[0] not in {p.name for p in agreeing}), *more)


def _taken_back(points: Array, pairs: Sequence[Pair], start: Bundle, kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the rows ``kept`` and those of the other pairs that agree with them after all."""
    rms = float(np.median(_pair_rms(adjust(points, [pairs[int(i)] for i in kept], start.with_boards(kept), "brown4"))))
    back = []
    for row in np.setdiff1d(np.arange(len(pairs)), kept):
        rows = np.append(kept, row)
        fit = adjust(points, [pairs[int(i)] for i in rows], start.with_boards(rows), "brown4")
        if _pair_rms(fit)[-1] < OUTLIER * rms:
            back.append(int(row))
    return np.sort(np.append(kept, np.array(back, np.int64)))


def _wide_enough(points: Array, pairs: Sequence[Pair], start: Bundle, can_release: bool) -> Bundle:
    """Fit the lens by which pictures are judged: a rational one where brown4 leaves far more on the same pictures."""
    brown, model = adjust(points, pairs, start, "brown4"), "brown4"
    try:
        rational = adjust(points, pairs, start, "rational")
        if rational.sigma_px < WIDE * brown.sigma_px:
            brown, model = rational, "rational"
    except LensError:
        pass
    return adjust(points, pairs, brown, model, release=True) if can_release else brown


def _check_sides(bundle: Bundle) -> None:
    baseline = float(np.linalg.norm(bundle.rig_pose[3:]))
    if baseline < 1e-3:
        raise CalibrationError(
            f"the baseline comes out as {baseline * 1e3:.2f} mm",
            where="--left, --right",
            remedy="use pictures of two cameras apart",
        )
    x, y, _ = -Rotation.from_rotvec(bundle.rig_pose[:3]).inv().apply(bundle.rig_pose[3:])  # of the right camera
    if x < 0 and abs(x) > abs(y):
        raise CalibrationError(
            "the right camera comes out left of the left one",
            where="--left, --right",
            remedy="exchange --left and --right",
        )


def _without_outliers(
    points: Array, pairs: Sequence[Pair], bundle: Bundle
) -> tuple[NDArray[np.int64], tuple[tuple[str, float], ...]]:
    """Return rows of pairs that agree with the others, and the names and residuals of those that do not (a board that
    moved between the two exposures, a wrong order of corners). One is taken out at a time, a quarter of them at most.
    """
    kept = np.arange(len(pairs))
    outliers: list[tuple[str, float]] = []
    while len(kept) > max(MIN_PAIRS, 0.75 * len(pairs)):
        rms = _pair_rms(bundle)
        worst = int(np.argmax(rms))
        fewer = np.delete(kept, worst)
        start = bundle.with_boards(np.delete(np.arange(len(bundle.boards)), worst))
        without = adjust(points, [pairs[int(i)] for i in fewer], start, bundle.model, release=bundle.released)
        # the others by a fit without it (Belsley et al. 1980): of few, one that is wrong makes all worse
        if rms[worst] < OUTLIER * np.median(_pair_rms(without)):
            break
        outliers.append((pairs[int(kept[worst])].name, float(rms[worst])))
        kept, bundle = fewer, without
    return kept, tuple(outliers)


def _pair_rms(bundle: Bundle) -> Array:
    """Return (n,) px: how far the corners of each pair are from where the fit puts them, by their median: a single
    wrong corner does not cost a good picture."""
    return np.array([np.sqrt(np.median((np.concatenate(r) ** 2).sum(axis=1)) / MEDIAN) for r in bundle.residuals])
