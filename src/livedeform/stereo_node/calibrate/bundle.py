"""Stereo calibration as one least-squares problem: both lenses, the rig, and every board's pose (bundle adjustment).

Minimises sum |x - proj(X)|^2 over both pictures of all pairs, by Levenberg-Marquardt, with Huber weights. The
covariance of all parameters is s^2 (J^T W J)^-1. Zhang 2000 gives the start; Triggs et al. 2000 the method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.common.frames import transform
from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Pair
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
FLAT = np.array(
    [3e-4, 3e-4, 1e-3]
)  # m, how far a printed board's points may be from their places, in and out of its plane


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
    their declared places, zero unless it was released (Strobl & Hirzinger 2011).
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
    turns = np.array([R.as_rotvec() for R, _, _ in between])
    shifts = np.array([t_r - R.apply(t_l) for R, t_r, t_l in between])
    boards = np.array([np.concatenate([R.as_rotvec(), t]) for R, t in poses[0]])
    rig = np.concatenate([np.median(turns, axis=0), np.median(shifts, axis=0)])
    return Bundle("k1", lenses[0], lenses[1], rig, boards, np.zeros((0, 0)), np.nan, (), np.zeros_like(points))


def adjust(
    points: Array, pairs: Sequence[Pair], start: Bundle, model: str, *, release: bool = False, n_iterations: int = 40
) -> Bundle:
    """Fit the bundle with distortion ``model``, from ``start`` (with a board pose per pair).

    With ``release`` the board's points may leave their declared places, with ``FLAT`` as prior: prints stretch and
    boards bend, and all pictures together show it. The prior keeps the board's mean size, which only its maker knows.
    """
    bundle = _with_model(start, points, model, release)
    scale = np.inf
    r, J = _equations(points, pairs, bundle)
    w = np.ones(len(r))
    damping = 1e-4
    for iteration in range(n_iterations):
        prior_scale = scale if np.isfinite(scale) else float(np.sqrt(np.mean(r**2)))
        prior = _prior(len(points), prior_scale) if release else np.zeros(0)  # in units of the residual's variance
        cost = _cost(r, w, prior, bundle)
        found = _better(points, pairs, bundle, (r, J, w), prior, cost, damping)
        if found is None:
            break
        trial, r_new, J_new, new_cost, damping = found
        done = cost - new_cost < 1e-7 * cost
        bundle, r, J = trial, r_new, J_new
        damping = max(damping * 0.1, 1e-12)
        if iteration >= 3 or done:
            n_free = max(len(r) - J.shape[1], 1)
            scale = np.sqrt(float(w @ r**2) / max(w.sum() - J.shape[1], n_free / 2))
            w_new = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(r), 1e-12))
            if done and np.abs(w_new - w).max() < 1e-2:
                break
            w = w_new
    return _with_statistics(bundle, pairs, r, J, w)


def _with_model(start: Bundle, points: Array, model: str, release: bool) -> Bundle:
    """Return ``start`` with another distortion model, whose other coefficients are zero."""
    kept = np.isin(np.arange(8), FREE[model])
    left, right = (
        Lens(lens.intrinsics.copy(), np.where(kept, lens.coefficients, 0.0)) for lens in (start.left, start.right)
    )
    shape = start.shape if release else np.zeros_like(points)
    return replace(start, model=model, left=left, right=right, shape=shape, released=release)


def _cost(r: Array, w: Array, prior: Array, bundle: Bundle) -> float:
    """Return weighted sum of squares, with the prior (3 n,) of the board's shape where it is released."""
    cost = float(w @ r**2)
    return cost + float(prior @ bundle.shape.ravel() ** 2) if bundle.released else cost


def _better(
    points: Array, pairs: Sequence[Pair], bundle: Bundle, equations: tuple[Array, Array, Array], prior: Array,
    cost: float, damping: float,
) -> tuple[Bundle, Array, Array, float, float] | None:  # fmt: skip
    """Take a Levenberg-Marquardt step that does not raise the ``cost``: bundle, residual, derivative, cost, damping.

    ``equations``: residual, negative derivative, weights. None where no damping helps.
    """
    r, J, w = equations
    H, g = J.T @ (w[:, None] * J), J.T @ (w * r)
    if bundle.released:
        n_shape = 3 * len(points)
        H[-n_shape:, -n_shape:] += np.diag(prior)
        g[-n_shape:] -= prior * bundle.shape.ravel()
    for _ in range(8):
        d = np.sqrt(np.diag(H))
        step = np.linalg.solve(H / d[:, None] / d[None] + damping * np.eye(len(H)), g / d) / d
        trial = _moved(bundle, step)
        r_new, J_new = _equations(points, pairs, trial)
        new_cost = _cost(r_new, w, prior, trial)
        if new_cost <= cost * (1 + 1e-12):
            return trial, r_new, J_new, new_cost, damping
        damping = max(damping, 1e-8) * 10
    return None


def _prior(n: int, sigma_px: float) -> Array:
    """Return diagonal (3 n,) of the shape's prior information, times the residual's variance."""
    return np.tile((max(sigma_px, 1e-3) / FLAT) ** 2, n)


def _with_statistics(bundle: Bundle, pairs: Sequence[Pair], r: Array, J: Array, w: Array) -> Bundle:
    sigma2 = float(w @ r**2) / max(w.sum() - J.shape[1], 1.0)
    n = len(bundle.values)
    H = J.T @ (w[:, None] * J)
    if bundle.released:
        n_shape = bundle.shape.size
        H[-n_shape:, -n_shape:] += np.diag(_prior(len(bundle.shape), float(np.sqrt(sigma2))))
    d = np.sqrt(np.diag(H))
    covariance = (np.linalg.inv(H / d[:, None] / d[None]) / d[:, None] / d[None])[:n, :n] * sigma2
    residuals, at = [], 0
    for pair in pairs:
        parts = []
        for view in (pair.left, pair.right):
            size = 2 * len(view.rows)
            parts.append(r[at : at + size].reshape(-1, 2))
            at += size
        residuals.append((parts[0], parts[1]))
    return replace(bundle, covariance=covariance, sigma_px=float(np.sqrt(sigma2)), residuals=tuple(residuals))


def _moved(bundle: Bundle, step: Array) -> Bundle:
    n = len(bundle.values)
    moved = bundle.with_values(bundle.values + step[:n])
    end = n + bundle.boards.size
    shape = bundle.shape + step[end:].reshape(-1, 3) if bundle.released else bundle.shape
    return replace(moved, boards=bundle.boards + step[n:end].reshape(-1, 6), shape=shape)


def _equations(points: Array, pairs: Sequence[Pair], bundle: Bundle) -> tuple[Array, Array]:
    """Return residual (m,) and its negative derivative (m, p) for lens, rig and board parameters, and the shape if
    released."""
    free = list(FREE[bundle.model])
    n_lens, n_pairs = 4 + len(free), len(pairs)
    n_rig = 2 * n_lens
    total = 2 * sum(len(p.left.rows) + len(p.right.rows) for p in pairs)
    n_pose = n_rig + 6 + 6 * n_pairs
    r, J = np.empty(total), np.zeros((total, n_pose + (points.size if bundle.released else 0)))
    points = points + bundle.shape
    at = 0
    for k, pair in enumerate(pairs):
        board = bundle.boards[k]
        own = slice(n_rig + 6 + 6 * k, n_rig + 12 + 6 * k)
        X = points[pair.left.rows]
        pixels, D = projected(X, board, bundle.left)
        rows = slice(at, at + 2 * len(X))
        r[rows] = (pair.left.pixels - pixels).ravel()
        J[rows, own] = D[:, :6]
        J[rows, :n_lens] = D[:, [6, 7, 8, 9, *(10 + i for i in free)]]
        if bundle.released:
            _fill_shape(J[rows, n_pose:], D, board[:3], pair.left.rows)
        at = rows.stop
        X = points[pair.right.rows]
        r3, t3, dr3dr1, dr3dt1, dr3dr2, dr3dt2, dt3dr1, dt3dt1, dt3dr2, dt3dt2 = cv2.composeRT(
            board[:3], board[3:], bundle.rig_pose[:3], bundle.rig_pose[3:]
        )
        pixels, D = projected(X, np.concatenate([r3.ravel(), t3.ravel()]), bundle.right)
        rows = slice(at, at + 2 * len(X))
        r[rows] = (pair.right.pixels - pixels).ravel()
        J[rows, own] = D[:, :6] @ np.block([[dr3dr1, dr3dt1], [dt3dr1, dt3dt1]])
        J[rows, n_rig : n_rig + 6] = D[:, :6] @ np.block([[dr3dr2, dr3dt2], [dt3dr2, dt3dt2]])
        J[rows, n_lens:n_rig] = D[:, [6, 7, 8, 9, *(10 + i for i in free)]]
        if bundle.released:
            _fill_shape(J[rows, n_pose:], D, np.asarray(r3, float).ravel(), pair.right.rows)
        at = rows.stop
    return r, J


def board_pose_equations(points: Array, pair: Pair, bundle: Bundle, pose: Array) -> tuple[Array, Array]:
    """Return residual of one pair (m,) and its negative derivative (m, 6) with respect to the board's pose ``pose``
    (6,)."""
    one = replace(bundle, boards=pose[None], shape=np.zeros_like(points), released=False)
    r, J = _equations(points, [pair], one)
    return r, J[:, -6:]


def _fill_shape(J: Array, D: Array, rotation: Array, rows: NDArray[np.int64]) -> None:
    """Write d pixel / d X = d pixel / d t R of each point of the board into its own three columns."""
    dX = (D[:, 3:6] @ Rotation.from_rotvec(rotation).as_matrix()).reshape(-1, 2, 3)
    for i, row in enumerate(rows):
        J[2 * i : 2 * i + 2, 3 * row : 3 * row + 3] = dX[i]


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
