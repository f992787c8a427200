"""The lens model: the simplest of those that leave least on pictures that they have not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Pair
from livedeform.stereo_node.calibrate.bundle import FREE, Bundle, LensError, adjust, board_pose_equations
from livedeform.stereo_node.camera.triangulate import triangulate

MODELS = ("k1", "k1k2", "brown4", "brown5", "rational")
N_FOLDS = 5
SMALL = {1: (0.05, 4), 2: (6e-4, 1), 3: (6e-4, 1), 4: (0.02, 6)}
"""What coefficients that a model leaves out may be, one sigma, and the power of R by which it is divided; R is the
corner's distance from the middle of the picture, in focal lengths. k2 R^4 and k3 R^6 are those of a lens without a
polynomial (equidistant) at R = 0.7; p1, p2 those of its parts out of line by R / 1000."""
HOPELESS = 9.0  # times the least mean square on a model's own pictures: it cannot be the best on others


@dataclass(frozen=True)
class HeldOut:
    """The error of a lens model on pictures that it has not seen: mean and standard error of the pairs' mean square
    reprojection (px2, board pose free), and the pairs' own. Infinite where the model gives no finite points; a model
    that does not even fit its own pictures is not tried, its mean is theirs, and its standard error NaN."""

    model: str
    released: bool
    mean_square_px: float
    standard_error: float
    by_pair: tuple[float, ...] = ()

    @property
    def tried(self) -> bool:
        """Return whether it was tried on pictures that it had not seen, and gave finite points."""
        return bool(np.isfinite(self.mean_square_px) and np.isfinite(self.standard_error))


def held_out_errors(
    points: Array, pairs: Sequence[Pair], start: Bundle, can_release: bool, size: tuple[int, int]
) -> list[HeldOut]:
    """Try every lens model (and those that fit with a released board too) on pairs that it has not seen, by
    ``N_FOLDS``-fold cross-validation; ``size`` (width, height) of the pictures."""
    out: list[HeldOut] = []
    for released in (False, True) if can_release else (False,):
        worth = [m.model for m in out if m.tried] if released else MODELS
        fits = {m: _fit(points, pairs, start, m, released) for m in worth}
        least = min((f.sigma_px**2 for f in fits.values() if f is not None), default=np.inf)
        for model, full in fits.items():
            if full is None:
                out.append(HeldOut(model, released, np.inf, np.nan))
            elif full.sigma_px**2 > HOPELESS * least:
                out.append(HeldOut(model, released, 2 * full.sigma_px**2, np.nan))
            else:
                out.append(_held_out(points, pairs, full, size))
    return out


def _fit(points: Array, pairs: Sequence[Pair], start: Bundle, model: str, released: bool) -> Bundle | None:
    try:
        return adjust(points, pairs, start, model, release=released)
    except LensError:
        return None


def _held_out(points: Array, pairs: Sequence[Pair], full: Bundle, size: tuple[int, int]) -> HeldOut:
    """Cross-validate a model from its fit to all pairs."""
    fold = np.arange(len(pairs)) % N_FOLDS
    errors = np.full(len(pairs), np.inf)
    for k in range(min(N_FOLDS, len(pairs))):
        inside, outside = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
        try:
            bundle = adjust(
                points, [pairs[int(i)] for i in inside], full.with_boards(inside), full.model,
                release=full.released, again=True,
            )  # fmt: skip
        except LensError:
            continue
        for i in outside:
            if gives_points(bundle, pairs[int(i)], size):
                r = _fit_board(points + bundle.shape, pairs[int(i)], bundle, full.boards[i])
                errors[i] = 2 * np.mean(np.clip(r**2, 0, 9 * np.median(r**2) / 0.455))
    scatter = float(errors.std(ddof=1) / np.sqrt(len(errors))) if np.isfinite(errors).all() else np.nan
    return HeldOut(full.model, full.released, float(errors.mean()), scatter, tuple(errors.tolist()))


def gives_points(bundle: Bundle, pair: Pair, size: tuple[int, int]) -> bool:
    """Tell whether the lens takes every pixel at which a corner was seen to a point in front of the cameras."""
    _, i, j = np.intersect1d(pair.left.rows, pair.right.rows, return_indices=True)
    points = triangulate(bundle.rig(size), pair.left.pixels[i], pair.right.pixels[j]).points
    return bool(np.isfinite(points).all())


def simplest_model(models: Sequence[HeldOut]) -> tuple[str, bool]:
    """Return the model with fewest parameters within one standard error of the best (Hastie et al., 7.10): that of the
    difference of the two on the same pictures.

    Raises ``LensError`` where none gives finite points.
    """
    tried = [m for m in models if m.tried]
    if not tried:
        raise LensError(
            "no lens model gives finite points on pictures that were not used",
            where="calibration",
            remedy="take more pictures, near the edges too",
        )
    best = min(tried, key=lambda m: m.mean_square_px)
    chosen = min(equals(tried, best, 1.0), key=lambda m: len(FREE[m.model]))
    return chosen.model, chosen.released


def with_the_rest_held(start: Bundle, model: str, size: tuple[int, int]) -> tuple[Bundle, str]:
    """Return ``start`` with the coefficients that ``model`` leaves out held to be small, and the model that has them.

    That pictures cannot tell them does not make them zero: on weak boards they are exchanged for the focal length, and
    its interval has to know of them. A rational lens leaves none out.
    """
    if model == "rational":
        return start, model
    R = float(np.hypot(*size)) / 2 / min(start.left.intrinsics[0], start.right.intrinsics[0])
    held = start.held.copy()
    for i, (most, power) in SMALL.items():
        if i not in FREE[model]:
            held[i] = most / R**power
    return replace(start, held=held), "brown5"


def equals(models: Sequence[HeldOut], best: HeldOut, n_errors: float) -> list[HeldOut]:
    """Return the models, with the board as free as in ``best``, that are worse than it by at most ``n_errors``
    standard errors of the difference on the same pictures."""
    out = []
    for m in models:
        if m.tried and m.released == best.released:
            worse = np.array(m.by_pair) - np.array(best.by_pair)
            if worse.mean() <= n_errors * worse.std(ddof=1) / np.sqrt(len(worse)):
                out.append(m)
    return out


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
