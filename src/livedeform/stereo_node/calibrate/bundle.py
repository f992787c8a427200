"""Stereo calibration as one least-squares problem: both lenses, the rig, and every board's pose (bundle adjustment).

Minimises sum |x - proj(X)|^2 over both pictures of all pairs, by Levenberg-Marquardt, with Huber weights. The
covariance of all parameters is s^2 (J^T W J)^-1. Zhang 2000 gives the start; Triggs et al. 2000 the method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.common.errors import CalibrationError
from livedeform.common.frames import transform
from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import BoardView, Pair
from livedeform.stereo_node.calibrate.normal_equations import NormalEquations, ViewEquations, normal_equations
from livedeform.stereo_node.camera.rig import StereoRig, make_rig

Model = Literal["none", "k1", "k1k2", "brown4", "brown5", "rational"]
FREE: dict[str, tuple[int, ...]] = {
    "none": (),
    "k1": (0,),
    "k1k2": (0, 1),
    "brown4": (0, 1, 2, 3),
    "brown5": (0, 1, 2, 3, 4),
    "rational": (0, 1, 2, 3, 4, 5, 6, 7),
}
"""Which of OpenCV's coefficients k1 k2 p1 p2 k3 k4 k5 k6 each model fits."""
NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
HUBER = 2.5  # residual sigmas
FLAT = np.array([3e-4, 3e-4, 1e-3])
"""m: how far a printed board's points are from their places, in and out of its plane, until the pictures tell it."""
FINEST = 1e-6  # m, of a print
FREELY = np.full(8, np.inf)
MANY, FEW = 40, 6  # steps of a fit; of one that starts from the same one with some more pictures


class LensError(CalibrationError):
    """A lens model that does not give finite points, or that the pictures do not determine."""


@dataclass(frozen=True)
class Lens:
    """A lens: fx, fy, cx, cy (px) and OpenCV's eight distortion coefficients."""

    intrinsics: Array
    coefficients: Array

    @property
    def matrix(self) -> Array:
        """(3, 3) camera matrix."""
        fx, fy, cx, cy = self.intrinsics
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


@dataclass(frozen=True)
class Bundle:
    """A calibration and the boards' poses.

    ``rig_pose`` (6,): rotation vector and translation of T_right_left; ``boards`` (n, 6) of T_left_board;
    ``covariance`` of (left lens, right lens, rig) as ``names`` lists them, ``sigma_px`` one coordinate's residual;
    ``residuals`` per pair: left (k, 2) and right (k, 2) px. ``shape`` (m, 3) m: where the board's points are beside
    their declared places, zero unless it was released (Strobl & Hirzinger 2011); ``flat`` (3,) m how far such points
    are from there, along each axis. ``held`` (8,): how large each coefficient is expected to be (one sigma), infinite
    where the pictures alone say.
    """

    model: str
    left: Lens
    right: Lens
    rig_pose: Array
    boards: Array
    covariance: Array
    sigma_px: float
    residuals: tuple[tuple[Array, Array], ...]
    shape: Array
    released: bool = False
    flat: Array = field(default_factory=FLAT.copy)
    held: Array = field(default_factory=FREELY.copy)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters in the order of ``covariance``."""
        lens = ("fx", "fy", "cx", "cy", *(NAMES[i] for i in FREE[self.model]))
        return (*(f"left.{n}" for n in lens), *(f"right.{n}" for n in lens), "rx", "ry", "rz", "tx", "ty", "tz")

    @property
    def values(self) -> Array:
        """The values of the parameters in the order of ``names``."""
        free = list(FREE[self.model])
        return np.concatenate(
            [
                self.left.intrinsics,
                self.left.coefficients[free],
                self.right.intrinsics,
                self.right.coefficients[free],
                self.rig_pose,
            ]
        )

    def with_values(self, values: Array) -> Bundle:
        """Return the bundle with other lens and rig parameters."""
        free = list(FREE[self.model])
        n = 4 + len(free)
        lenses = []
        for lens, part in ((self.left, values[:n]), (self.right, values[n : 2 * n])):
            coefficients = lens.coefficients.copy()
            coefficients[free] = part[4:]
            lenses.append(Lens(part[:4].copy(), coefficients))
        return replace(self, left=lenses[0], right=lenses[1], rig_pose=values[2 * n : 2 * n + 6].copy())

    def with_boards(self, rows: NDArray[np.int64]) -> Bundle:
        """Return the bundle with the poses of these boards only."""
        return replace(self, boards=self.boards[rows])

    def rig(self, size: tuple[int, int], names: tuple[str, str] = ("left", "right")) -> StereoRig:
        """Return the rectifiable stereo rig of pictures of ``size`` (width, height)."""
        ros = "rational_polynomial" if self.model == "rational" else "plumb_bob"
        n = 8 if self.model == "rational" else 5
        cameras = [
            (name, *size, lens.matrix, lens.coefficients[:n].copy(), ros)
            for name, lens in zip(names, (self.left, self.right), strict=True)
        ]
        T = transform(Rotation.from_rotvec(self.rig_pose[:3]).as_matrix(), self.rig_pose[3:])
        return make_rig(cameras[0], cameras[1], T)


@dataclass(frozen=True)
class Beforehand:
    """Hold what is known before the pictures, as information times the variance of a residual: of the board's points
    ``shape`` (n, 3) px2/m2, None where they are fixed, and of the lens and rig parameters ``lens`` (p,)."""

    shape: Array | None
    lens: Array


def start_bundle(points: Array, pairs: Sequence[Pair], size: tuple[int, int]) -> Bundle:
    """Start from closed forms (Zhang 2000): single cameras without distortion, then the median rig."""
    lenses, poses = [], []
    for side in ("left", "right"):
        views = [getattr(p, side) for p in pairs]
        objects = [points[v.rows].astype(np.float32) for v in views]
        pictures = [v.pixels.astype(np.float32) for v in views]
        flags = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO
        K0 = cv2.initCameraMatrix2D(objects, pictures, size, 1.0)
        _, K, d, rvecs, tvecs = cv2.calibrateCamera(
            objects, pictures, size, K0, np.zeros(5), flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS
        )
        coefficients = np.zeros(8)
        coefficients[0] = np.ravel(d)[0]
        lenses.append(Lens(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), coefficients))
        poses.append([(Rotation.from_rotvec(np.ravel(r)), np.ravel(t)) for r, t in zip(rvecs, tvecs, strict=True)])
    between = [(R_r * R_l.inv(), t_r, t_l) for (R_l, t_l), (R_r, t_r) in zip(*poses, strict=True)]
    turn = _median_turn(Rotation.concatenate([R for R, _, _ in between]))
    shifts = np.array([t_r - R.apply(t_l) for R, t_r, t_l in between])
    boards = np.array([np.concatenate([R.as_rotvec(), t]) for R, t in poses[0]])
    rig = np.concatenate([turn.as_rotvec(), np.median(shifts, axis=0)])
    return Bundle("k1", lenses[0], lenses[1], rig, boards, np.zeros((0, 0)), np.nan, (), np.zeros_like(points))


def _median_turn(turns: Rotation) -> Rotation:
    """Return the median of rotations, as seen from the one that is nearest to the others: rotation vectors jump at half
    a turn."""
    apart = [float((one.inv() * turns).magnitude().sum()) for one in turns]
    middle = turns[int(np.argmin(apart))]
    return Rotation.from_rotvec(np.median((turns * middle.inv()).as_rotvec(), axis=0)) * middle


def board_pose(points: Array, view: BoardView, lens: Lens) -> Array:
    """Return the pose (6,) of the board's ``points`` (n, 3) m before the camera with this ``lens``, by one view."""
    _, turn, shift = cv2.solvePnP(points[view.rows], view.pixels, lens.matrix, lens.coefficients)
    return np.concatenate([np.ravel(turn), np.ravel(shift)])


def adjust(
    points: Array, pairs: Sequence[Pair], start: Bundle, model: str, *, release: bool = False, again: bool = False
) -> Bundle:
    """Fit the bundle with distortion ``model``, from ``start`` (with a board pose per pair).

    With ``release`` the board's points may leave their declared places: prints stretch and boards bend, and all
    pictures together show it. How far they do is estimated with them (the prior's variance, by expectation and
    maximisation), else the intervals would be of a print that is worse than this one. The prior keeps the board's
    mean size, which only its maker knows. Coefficients that ``start`` holds (``held``) have a prior too. ``again``:
    ``start`` is the same fit with some more pictures, and its ``flat`` is kept. Raises ``LensError`` where the model
    does not give finite points, or the pictures do not determine it.
    """
    bundle = _with_model(start, points, model, release, again)
    views = _equations(points, pairs, bundle)
    w, scale, damping = np.ones(sum(len(v.r) for v in views)), np.inf, 1e-4
    for iteration in range(FEW if again else MANY):
        r = residual_of(views)
        sigma = scale if np.isfinite(scale) else float(np.sqrt(np.mean(r**2)))
        prior = _prior(bundle, sigma)
        cost = _cost(r, w, prior, bundle)
        normal = normal_of(views, w, bundle, prior)
        found = _better(points, pairs, bundle, normal, w, prior, cost, damping)
        if found is None:
            break
        bundle, views, new_cost, damping = found
        done = cost - new_cost < 1e-7 * cost
        damping = max(damping * 0.1, 1e-12)
        if iteration >= 3 or done:
            r = residual_of(views)
            scale = np.sqrt(float(w @ r**2) / _n_free(w, bundle))
            w_new = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(r), 1e-12))
            flat = _flatness(bundle, normal, scale) if release and not again else bundle.flat
            if done and np.abs(w_new - w).max() < 1e-2 and np.abs(flat / bundle.flat - 1).max() < 1e-2:
                break
            w, bundle = w_new, replace(bundle, flat=flat)
    return _with_statistics(bundle, pairs, views, w)


def _flatness(bundle: Bundle, normal: NormalEquations, sigma_px: float) -> Array:
    """Return how far (3,) m the released points are from their places: the mean square of what was found and of what
    the pictures leave open."""
    assert normal.B is not None
    variance = sigma_px**2 * np.diagonal(np.linalg.inv(normal.B), axis1=1, axis2=2)
    out: Array = np.maximum(np.sqrt((bundle.shape**2 + variance).mean(axis=0)), FINEST)
    return out


def residual_of(views: Sequence[ViewEquations]) -> Array:
    """Return all pictures' residuals (m,) px."""
    r = np.concatenate([v.r for v in views])
    if not np.isfinite(r).all():
        raise LensError("the lens model gives no finite points", where="calibration", remedy="choose another model")
    return r


def normal_of(views: Sequence[ViewEquations], w: Array, bundle: Bundle, prior: Beforehand) -> NormalEquations:
    """Return the normal equations with weights ``w`` (m,) and the ``prior``."""
    p = len(bundle.values)
    shape = bundle.shape if prior.shape is not None else None
    normal = normal_equations(views, w, p + bundle.boards.size, prior.shape, shape)
    normal.H[np.arange(p), np.arange(p)] += prior.lens
    normal.g[:p] -= prior.lens * bundle.values
    return normal


def _n_free(w: Array, bundle: Bundle) -> float:
    """Return the residuals' degrees of freedom; a released shape counts, as if it had no prior."""
    n = len(bundle.values) + bundle.boards.size + (bundle.shape.size if bundle.released else 0)
    return float(max(w.sum() - n, len(w) / 4))


def _with_model(start: Bundle, points: Array, model: str, release: bool, again: bool) -> Bundle:
    """Return ``start`` with another distortion model, whose other coefficients are zero."""
    kept = np.isin(np.arange(8), FREE[model])
    left, right = (
        Lens(lens.intrinsics.copy(), np.where(kept, lens.coefficients, 0.0)) for lens in (start.left, start.right)
    )
    shape = start.shape if release else np.zeros_like(points)
    flat = start.flat if again else FLAT.copy()
    return replace(start, model=model, left=left, right=right, shape=shape, released=release, flat=flat)


def _cost(r: Array, w: Array, prior: Beforehand, bundle: Bundle) -> float:
    """Return weighted sum of squares, with that of the prior."""
    cost = float(w @ r**2 + prior.lens @ bundle.values**2)
    return cost if prior.shape is None else cost + float((prior.shape * bundle.shape**2).sum())


def _better(
    points: Array, pairs: Sequence[Pair], bundle: Bundle, normal: NormalEquations, w: Array, prior: Beforehand,
    cost: float, damping: float,
) -> tuple[Bundle, list[ViewEquations], float, float] | None:  # fmt: skip
    """Take a Levenberg-Marquardt step that does not raise the ``cost``: bundle, equations, cost, damping.

    None where no damping helps.
    """
    for _ in range(12):
        try:
            trial = _moved(bundle, *normal.step(damping))
            views = _equations(points, pairs, trial)
            new_cost = _cost(np.concatenate([v.r for v in views]), w, prior, trial)
        except np.linalg.LinAlgError:
            new_cost = np.inf
        if new_cost <= cost * (1 + 1e-12):  # false for NaN
            return trial, views, new_cost, damping
        damping = max(damping, 1e-8) * 10
    return None


def _prior(bundle: Bundle, sigma_px: float) -> Beforehand:
    """Return what is known before the pictures, of residuals of ``sigma_px``."""
    sigma = max(sigma_px, 1e-3)
    one = np.append(np.zeros(4), (sigma / bundle.held[list(FREE[bundle.model])]) ** 2)
    shape = np.tile((sigma / bundle.flat) ** 2, (len(bundle.shape), 1)) if bundle.released else None
    return Beforehand(shape, np.concatenate([one, one, np.zeros(6)]))


def _with_statistics(bundle: Bundle, pairs: Sequence[Pair], views: Sequence[ViewEquations], w: Array) -> Bundle:
    r = residual_of(views)
    sigma2 = float(w @ r**2) / _n_free(w, bundle)
    prior = _prior(bundle, float(np.sqrt(sigma2)))
    undetermined = LensError(
        "the pictures do not determine the lens", where="calibration", remedy="take more pictures, tilted"
    )
    try:
        covariance = normal_of(views, w, bundle, prior).inverse(len(bundle.values)) * sigma2
    except np.linalg.LinAlgError as error:
        raise undetermined from error
    if not (np.diag(covariance) > 0).all():  # false for NaN: singular but for rounding
        raise undetermined
    residuals = [(views[2 * k].r.reshape(-1, 2), views[2 * k + 1].r.reshape(-1, 2)) for k in range(len(pairs))]
    return replace(bundle, covariance=covariance, sigma_px=float(np.sqrt(sigma2)), residuals=tuple(residuals))


def _moved(bundle: Bundle, step: Array, shape: Array | None) -> Bundle:
    n = len(bundle.values)
    moved = bundle.with_values(bundle.values + step[:n])
    return replace(
        moved,
        boards=bundle.boards + step[n:].reshape(-1, 6),
        shape=bundle.shape if shape is None else bundle.shape + shape,
    )


def _equations(points: Array, pairs: Sequence[Pair], bundle: Bundle) -> list[ViewEquations]:
    """Return both pictures' equations of every pair: lens, rig and board parameters, and the shape if released."""
    free = list(FREE[bundle.model])
    n_lens = 4 + len(free)
    n_rig = 2 * n_lens
    lens_columns = [6, 7, 8, 9, *(10 + i for i in free)]
    points = points + bundle.shape
    out = []
    for k, pair in enumerate(pairs):
        board = bundle.boards[k]
        own, rig = np.arange(n_rig + 6 + 6 * k, n_rig + 12 + 6 * k), np.arange(n_rig, n_rig + 6)
        pixels, D = projected(points[pair.left.rows], board, bundle.left)
        A = np.hstack([D[:, lens_columns], D[:, :6]])
        columns = np.concatenate([np.arange(n_lens), own])
        S = _of_points(D, board[:3]) if bundle.released else None
        out.append(ViewEquations((pair.left.pixels - pixels).ravel(), columns, A, S, pair.left.rows))
        r3, t3, dr3dr1, dr3dt1, dr3dr2, dr3dt2, dt3dr1, dt3dt1, dt3dr2, dt3dt2 = cv2.composeRT(
            board[:3], board[3:], bundle.rig_pose[:3], bundle.rig_pose[3:]
        )
        pixels, D = projected(points[pair.right.rows], np.concatenate([r3.ravel(), t3.ravel()]), bundle.right)
        of_board = D[:, :6] @ np.block([[dr3dr1, dr3dt1], [dt3dr1, dt3dt1]])
        of_rig = D[:, :6] @ np.block([[dr3dr2, dr3dt2], [dt3dr2, dt3dt2]])
        A = np.hstack([D[:, lens_columns], of_rig, of_board])
        columns = np.concatenate([np.arange(n_lens, n_rig), rig, own])
        S = _of_points(D, np.asarray(r3, float).ravel()) if bundle.released else None
        out.append(ViewEquations((pair.right.pixels - pixels).ravel(), columns, A, S, pair.right.rows))
    return out


def board_pose_equations(points: Array, pair: Pair, bundle: Bundle, pose: Array) -> tuple[Array, Array]:
    """Return residual of one pair (m,) and its negative derivative (m, 6) with respect to the board's pose ``pose``
    (6,)."""
    one = replace(bundle, boards=pose[None], shape=np.zeros_like(points), released=False)
    views = _equations(points, [pair], one)
    return np.concatenate([v.r for v in views]), np.concatenate([v.A[:, -6:] for v in views])


def _of_points(D: Array, rotation: Array) -> Array:
    """Return d pixel / d X = d pixel / d t R (k, 2, 3) of each point of the board."""
    out: Array = (D[:, 3:6] @ Rotation.from_rotvec(rotation).as_matrix()).reshape(-1, 2, 3)
    return out


def board_poses(bundle: Bundle) -> list[tuple[Array, Array]]:
    """Return rotation vector and translation (6,) of every board in the left and in the right camera."""
    out = []
    for board in bundle.boards:
        r, t = cv2.composeRT(board[:3], board[3:], bundle.rig_pose[:3], bundle.rig_pose[3:])[:2]
        out.append((board, np.concatenate([r.ravel(), t.ravel()])))
    return out


def projected(X: Array, pose: Array, lens: Lens) -> tuple[Array, Array]:
    """Return pixels (n, 2) of points (n, 3) on a board with ``pose`` (6,), and OpenCV's derivatives (2 n, >= 14)."""
    pixels, D = cv2.projectPoints(X, pose[:3], pose[3:], lens.matrix, lens.coefficients)
    return np.asarray(pixels, float).reshape(-1, 2), np.asarray(D, float)
