"""The lens model: the simplest of those that leave least on pictures that they have not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Pair
from livedeform.stereo_node.calibrate.bundle import FREE, Bundle, adjust, board_pose_equations

MODELS = ("k1", "k1k2", "brown4", "brown5", "rational")
N_FOLDS = 5
FEW = 6  # steps of a fit that starts from the same one with some more pictures


@dataclass(frozen=True)
class HeldOut:
    """The error of a lens model on pictures that it has not seen: mean and standard error of the pairs' mean square
    reprojection (px2, board pose free)."""

    model: str
    released: bool
    mean_square_px: float
    standard_error: float


def held_out_errors(points: Array, pairs: Sequence[Pair], start: Bundle, can_release: bool) -> list[HeldOut]:
    """Try every lens model (with a rigid and a released board) on pairs that it has not seen, by ``N_FOLDS``-fold
    cross-validation."""
    fold = np.arange(len(pairs)) % N_FOLDS
    out = []
    for released in (False, True) if can_release else (False,):
        for model in MODELS:
            if len(pairs) < 8 and model == "rational":
                continue
            full = adjust(points, pairs, start, model, release=released)
            errors = np.empty(len(pairs))
            for k in range(N_FOLDS):
                inside, outside = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
                if not len(outside):
                    continue
                bundle = adjust(
                    points,
                    [pairs[int(i)] for i in inside],
                    full.with_boards(inside),
                    model,
                    release=released,
                    n_iterations=FEW,
                )
                for i in outside:
                    r = _fit_board(points + bundle.shape, pairs[int(i)], bundle, full.boards[i])
                    errors[i] = 2 * np.mean(np.clip(r**2, 0, 9 * np.median(r**2) / 0.455))
            out.append(HeldOut(model, released, float(errors.mean()), float(errors.std(ddof=1) / np.sqrt(len(errors)))))
    return out


def simplest_model(models: Sequence[HeldOut]) -> tuple[str, bool]:
    """Return the model with fewest parameters within one standard error of the best (Hastie et al., 7.10)."""
    best = min(models, key=lambda m: m.mean_square_px)
    good = [
        m
        for m in models
        if m.mean_square_px <= best.mean_square_px + best.standard_error and m.released == best.released
    ]
    chosen = min(good, key=lambda m: len(FREE[m.model]))
    return chosen.model, chosen.released


def _fit_board(points: Array, pair: Pair, bundle: Bundle, pose: Array) -> Array:
    """Return residuals of a pair whose board pose alone is fitted, the rig being given."""
    r, J = board_pose_equations(points, pair, bundle, pose)
    for _ in range(10):
        step = np.linalg.lstsq(J, r, rcond=None)[0]
        pose = pose + step
        r, J = board_pose_equations(points, pair, bundle, pose)
        if np.abs(step).max() < 1e-9:
            break
    return r
