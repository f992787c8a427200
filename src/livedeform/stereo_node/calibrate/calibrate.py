"""Stereo calibration from pictures of a board: which pictures to trust, which lens model, and how good the result is.

Everything that is reported as accuracy is measured on pictures that did not enter the calibration that is judged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.common.errors import CalibrationError
from livedeform.common.types import Array
from livedeform.stereo_node.calibrate.board_size import check_size, is_board
from livedeform.stereo_node.calibrate.boards import Board, BoardView, find_board
from livedeform.stereo_node.calibrate.bundle import FREE, Bundle, Pair, adjust, board_pose_equations, start_bundle
from livedeform.stereo_node.camera.camera import StereoRig
from livedeform.stereo_node.camera.triangulate import triangulate
from livedeform.stereo_node.detect.blobs import Picture
from livedeform.stereo_node.detect.circles import with_middles

MIN_PAIRS = 4
OUTLIER = 2.5  # times the median residual of a picture pair
MODELS = ("k1", "k1k2", "brown4", "brown5", "rational")
N_FOLDS = 5
COVER_GRID = (8, 6)
FEW = 6  # steps of a fit that starts from the same one with some more pictures
Progress = Callable[[str], None]


@dataclass(frozen=True)
class HeldOut:
    """What a lens model leaves on pictures that it has not seen: mean and standard error of the pairs' mean square
    reprojection (px2, board pose free)."""

    model: str
    released: bool
    mean_square_px: float
    standard_error: float


@dataclass(frozen=True)
class Length:
    """A known length on a picture pair that was not used: ``n_squares`` long, nominal and measured m, and ``printed``
    m, what the other pictures say of this board's own print (nominal if the board was not released); the predicted
    standard deviations from the corners' noise and from the calibration, distance m and tilt rad of the board."""

    pair: str
    n_squares: int
    true: float
    printed: float
    measured: float
    sigma_noise: float
    sigma_calibration: float
    distance: float
    tilt: float
    outlier: bool

    @property
    def error(self) -> float:
        """measured - true, m."""
        return self.measured - self.true

    @property
    def sigma(self) -> float:
        """Both parts together, m."""
        return float(np.hypot(self.sigma_noise, self.sigma_calibration))


@dataclass(frozen=True)
class Coverage:
    """How the boards fill the field (share of 8 x 6 cells with a point, per camera), their tilt range (rad),
    distances (m).
    """

    left: float
    right: float
    tilt: tuple[float, float]
    distance: tuple[float, float]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is missing, as sentences."""
        out = []
        for side, share in (("left", self.left), ("right", self.right)):
            if share < 0.6:
                out.append(
                    f"the boards cover {share:.0%} of the {side} picture: take pictures near its edges and corners"
                )
        if np.degrees(self.tilt[1]) < 20:
            out.append(
                f"no board is tilted by more than {np.degrees(self.tilt[1]):.0f} degrees: the focal "
                f"length is weak, tilt it to 30-45"
            )
        if self.distance[1] < 1.15 * self.distance[0]:
            out.append("all boards are at the same distance: bring some nearer and farther")
        return tuple(out)


@dataclass(frozen=True)
class Calibration:
    """A stereo calibration and what is known of it."""

    bundle: Bundle
    rig: StereoRig
    board: Board
    used: tuple[str, ...]
    outliers: tuple[tuple[str, float], ...]  # name, residual rms px
    models: tuple[HeldOut, ...]
    lengths: tuple[Length, ...]
    coverage: Coverage
    epipolar_rms_px: float  # on held-out pairs
    reprojection_rms_px: float

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Every parameter with its standard deviation; baseline in m, as ``baseline``."""
        sigmas = np.sqrt(np.diag(self.bundle.covariance))
        out = {n: (float(v), float(s)) for n, v, s in zip(self.bundle.names, self.bundle.values, sigmas, strict=True)}
        t = self.bundle.rig_pose[3:]
        direction = t / np.linalg.norm(t)
        sigma = float(np.sqrt(direction @ self.bundle.covariance[-3:, -3:] @ direction))
        return out | {"baseline": (float(np.linalg.norm(t)), sigma)}


def find_pairs(
    pictures: Sequence[tuple[str, Picture, Picture]],
    board: Board,
    progress: Progress | None = None,
    least: int = MIN_PAIRS,
) -> list[Pair]:
    """The board in every pair of pictures (name, left, right); pairs in which one camera does not see it are left
    out, of which ``least`` must remain.
    """
    if not pictures:
        raise CalibrationError(
            "no pictures", where="--left", remedy="check the pattern: quote it, so that the shell leaves it alone"
        )
    shape = pictures[0][1].shape
    for name, left, right in pictures:
        for side, picture in (("left", left), ("right", right)):
            if picture.shape != shape:
                raise CalibrationError(
                    f"the {side} picture is {picture.shape[1]}x{picture.shape[0]}, the first is {shape[1]}x{shape[0]}",
                    where=name, remedy="calibrate with pictures of one size",
                )  # fmt: skip
        if np.array_equal(left, right):
            raise CalibrationError(
                "left and right are the same picture: the baseline would be zero",
                where=name,
                remedy="check --left and --right",
            )
    pairs: list[Pair] = []
    seen: list[tuple[Picture, BoardView]] = []
    for name, left, right in pictures:
        views = _look(left, board), _look(right, board)
        seen += [(p, v) for p, v in zip((left, right), views, strict=True) if v is not None]
        if progress:
            progress(
                f"{name}: {'board found' if all(views) else 'no board in ' + ('left' if views[0] is None else 'right')}"
            )
        if views[0] is not None and views[1] is not None:
            pairs.append(_same_way(Pair(name, views[0], views[1]), board))
    check_size(seen, board)
    if len(pairs) < least:
        raise CalibrationError(
            f"the {board.columns}x{board.rows} {board.kind} was found in {len(pairs)} of {len(pictures)} pairs",
            where="--board",
            remedy=(
                f"count the inner corners (a board of 10x7 squares is 9x6), and give at least "
                f"{least} pairs that show it whole"
            ),
        )
    return pairs


def _look(picture: Picture, board: Board) -> BoardView | None:
    view = find_board(picture, board)
    return view if view is not None and is_board(picture, view, board) else None


def _same_way(pair: Pair, board: Board) -> Pair:
    """Makes both pictures of a board without orientation count from the same end: the one that agrees with the other
    camera.
    """
    if board.kind == "charuco" or board.oriented:
        return pair
    a, b = pair.left.pixels, pair.right.pixels
    if (a[-1] - a[0]) @ (b[-1] - b[0]) < 0:
        shapes = pair.right.shapes
        turned = BoardView(pair.right.rows, b[::-1].copy(), None if shapes is None else shapes[::-1].copy())
        return replace(pair, right=turned)
    return pair


def calibrate(
    pairs: Sequence[Pair], board: Board, size: tuple[int, int], progress: Progress | None = None
) -> Calibration:
    """The whole calibration: start, outlier pictures, lens model by held-out error, final fit, known lengths on
    unused pictures.

    ``size`` is (width, height) of the pictures.
    """
    say = progress or (lambda text: None)
    points, can_release = board.points, board.oriented and len(pairs) >= 6
    start = adjust(points, pairs, start_bundle(points, pairs, size), "k1k2")
    _check_sides(start)
    seen = pairs
    for _ in range(
        2 if pairs[0].left.shapes is not None else 0
    ):  # circles: the better the poses, the better the middles
        pairs = with_middles(points, seen, start)
        start = adjust(points, pairs, start, "k1k2")
    say("looking for outlier pictures")
    kept, outliers = _without_outliers(points, pairs, adjust(points, pairs, start, "brown4", release=can_release))
    inlying = [pairs[int(i)] for i in kept]
    start = _part(start, kept)
    say("comparing lens models on pictures that were not used")
    models = _held_out(points, inlying, start, can_release)
    model, released = _simplest(models)
    final = adjust(points, inlying, start, model, release=released)
    rig = final.rig(size)
    say("measuring known lengths on pictures that were not used")
    lengths, epipolar = known_lengths(points, pairs, kept, final, board, size)
    residuals = np.concatenate([r for both in final.residuals for r in both])
    return Calibration(
        final, rig, board, tuple(p.name for p in inlying), outliers, tuple(models), tuple(lengths),
        _coverage(points, inlying, final, size), epipolar, float(np.sqrt((residuals**2).sum(axis=1).mean())),
    )  # fmt: skip


def _check_sides(bundle: Bundle) -> None:
    baseline = float(np.linalg.norm(bundle.rig_pose[3:]))
    if baseline < 1e-3:
        raise CalibrationError(
            f"the baseline comes out as {baseline * 1e3:.2f} mm",
            where="--left, --right",
            remedy="use pictures of two cameras apart",
        )
    if bundle.rig_pose[3] > 0 and abs(bundle.rig_pose[3]) > abs(bundle.rig_pose[4]):
        raise CalibrationError(
            "the right camera comes out left of the left one",
            where="--left, --right",
            remedy="exchange --left and --right",
        )


def _part(bundle: Bundle, rows: NDArray[np.int64]) -> Bundle:
    return replace(bundle, boards=bundle.boards[rows])


def _without_outliers(
    points: Array, pairs: Sequence[Pair], bundle: Bundle
) -> tuple[NDArray[np.int64], tuple[tuple[str, float], ...]]:
    """Rows of pairs that agree with the others, and the names and residuals of those that do not (a board that moved
    between the two exposures, a wrong order of corners). One is taken out at a time, a quarter of them at most."""
    kept = np.arange(len(pairs))
    outliers: list[tuple[str, float]] = []
    while len(kept) > max(MIN_PAIRS, 0.75 * len(pairs)):
        rms = np.array([np.sqrt((np.concatenate(r) ** 2).sum(axis=1).mean()) for r in bundle.residuals])
        worst = int(np.argmax(rms))
        if rms[worst] < OUTLIER * np.median(rms):
            break
        outliers.append((pairs[int(kept[worst])].name, float(rms[worst])))
        kept = np.delete(kept, worst)
        start = _part(bundle, np.delete(np.arange(len(bundle.boards)), worst))
        bundle = adjust(points, [pairs[int(i)] for i in kept], start, bundle.model, release=bundle.released)
    return kept, tuple(outliers)


def _held_out(points: Array, pairs: Sequence[Pair], start: Bundle, can_release: bool) -> list[HeldOut]:
    """Every lens model (with a rigid and a released board) on pairs that it has not seen, by ``N_FOLDS``-fold
    cross-validation.
    """
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
                    _part(full, inside),
                    model,
                    release=released,
                    n_iterations=FEW,
                )
                for i in outside:
                    r = _fit_board(points + bundle.shape, pairs[int(i)], bundle, full.boards[i])
                    errors[i] = 2 * np.mean(np.clip(r**2, 0, 9 * np.median(r**2) / 0.455))
            out.append(HeldOut(model, released, float(errors.mean()), float(errors.std(ddof=1) / np.sqrt(len(errors)))))
    return out


def _simplest(models: Sequence[HeldOut]) -> tuple[str, bool]:
    """The model with fewest parameters within one standard error of the best (Hastie et al., 7.10)."""
    best = min(models, key=lambda m: m.mean_square_px)
    good = [
        m
        for m in models
        if m.mean_square_px <= best.mean_square_px + best.standard_error and m.released == best.released
    ]
    chosen = min(good, key=lambda m: len(FREE[m.model]))
    return chosen.model, chosen.released


def _fit_board(points: Array, pair: Pair, bundle: Bundle, pose: Array) -> Array:
    """Residuals of a pair whose board pose alone is fitted, the rig being given."""
    r, J = board_pose_equations(points, pair, bundle, pose)
    for _ in range(10):
        step = np.linalg.lstsq(J, r, rcond=None)[0]
        pose = pose + step
        r, J = board_pose_equations(points, pair, bundle, pose)
        if np.abs(step).max() < 1e-9:
            break
    return r


def known_lengths(
    points: Array, pairs: Sequence[Pair], kept: NDArray[np.int64], final: Bundle, board: Board, size: tuple[int, int]
) -> tuple[list[Length], float]:
    """Leave one pair out: lengths of every number of squares on it, measured by the rig that the other pairs give
    (outliers never enter a calibration, but are measured too); and the rms epipolar error px of the pairs left out."""
    lengths: list[Length] = []
    squares: list[float] = []
    position = {int(row): k for k, row in enumerate(kept)}
    for i, pair in enumerate(pairs):
        others = [int(k) for k in kept if k != i]
        start = _part(final, np.array([position[k] for k in others], np.int64))
        bundle = adjust(
            points, [pairs[k] for k in others], start, final.model, release=final.released, n_iterations=FEW
        )
        common = np.intersect1d(pair.left.rows, pair.right.rows)
        left = pair.left.pixels[np.searchsorted(pair.left.rows, common)]
        right = pair.right.pixels[np.searchsorted(pair.right.rows, common)]
        lengths += _lengths_of(pair.name, points, common, left, right, bundle, board, size, i not in position)
        error = triangulate(bundle.rig(size), left, right).reprojection_error_px
        if i in position:
            squares += list(
                2 * error**2
            )  # four residuals of one degree of freedom: both rays' share of the epipolar distance
    return lengths, float(np.sqrt(np.mean(squares)))


def _lengths_of(
    name: str, points: Array, rows: NDArray[np.int64], left: Array, right: Array, bundle: Bundle, board: Board,
    size: tuple[int, int], outlier: bool,
) -> list[Length]:  # fmt: skip
    rig = bundle.rig(size)
    # a pair whose corners are worse than the others' (blur, a hand that moved) shows it by rays that do not meet
    own = float(np.sqrt(2 * np.mean(triangulate(rig, left, right).reprojection_error_px ** 2)))
    measured = triangulate(rig, left, right, sigma_px=max(bundle.sigma_px, own))
    X, J = measured.points, parameter_sensitivity(bundle, size, left, right)
    a, b, n = _spans(points[rows], board.square)
    difference = X[a] - X[b]
    length = np.linalg.norm(difference, axis=1)
    unit = difference / length[:, None]
    noise = np.einsum("ki,kij,kj->k", unit, measured.covariances[a] + measured.covariances[b], unit)
    d = np.einsum("ki,kip->kp", unit, J[a] - J[b])
    systematic = np.einsum("kp,pq,kq->k", d, bundle.covariance, d)
    centre = X.mean(axis=0)
    normal = np.linalg.svd(X - centre)[2][2]
    tilt = float(np.arccos(min(abs(normal @ centre) / np.linalg.norm(centre), 1.0)))
    true = np.linalg.norm(points[rows[a]] - points[rows[b]], axis=1)
    shaped = points + bundle.shape
    printed = np.linalg.norm(shaped[rows[a]] - shaped[rows[b]], axis=1)
    return [
        Length(
            name,
            int(n[k]),
            float(true[k]),
            float(printed[k]),
            float(length[k]),
            float(np.sqrt(noise[k])),
            float(np.sqrt(systematic[k])),
            float(np.linalg.norm(centre)),
            tilt,
            outlier,
        )
        for k in range(len(a))
    ]


def _spans(points: Array, square: float) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """All pairs of points on a common row or column of the board, and how many squares they are apart."""
    a, b = np.triu_indices(len(points), 1)
    step = np.abs(points[a] - points[b]) / square
    straight = (step[:, 0] < 1e-6) | (step[:, 1] < 1e-6)
    return a[straight], b[straight], np.round(step.sum(axis=1)[straight]).astype(np.int64)


def parameter_sensitivity(bundle: Bundle, size: tuple[int, int], left: Array, right: Array) -> Array:
    """(n, 3, p): derivative of the points triangulated from ``left``, ``right`` (n, 2) px with respect to the lens
    and rig parameters, in the board's gauge-free left frame, by central differences of their standard deviations."""
    sigmas = np.sqrt(np.diag(bundle.covariance))
    out = np.empty((len(left), 3, len(sigmas)))
    for k, sigma in enumerate(sigmas):
        ends = []
        for sign in (1, -1):
            values = bundle.values
            values[k] += sign * sigma
            ends.append(triangulate(bundle.with_values(values).rig(size), left, right).points)
        out[:, :, k] = (ends[0] - ends[1]) / (2 * sigma)
    return out


def systematic_covariance(bundle: Bundle, size: tuple[int, int], left: Array, right: Array) -> Array:
    """(n, 3, 3) m2: what the calibration's own uncertainty does to the points triangulated from ``left``, ``right``
    (n, 2) px.

    It is common to all points and all frames: unlike the pixel noise it does not average out.
    """
    J = parameter_sensitivity(bundle, size, left, right)
    return np.einsum("nip,pq,njq->nij", J, bundle.covariance, J)


def _coverage(points: Array, pairs: Sequence[Pair], bundle: Bundle, size: tuple[int, int]) -> Coverage:
    shares = []
    for side in ("left", "right"):
        pixels = np.concatenate([getattr(p, side).pixels for p in pairs])
        cells, _, _ = np.histogram2d(pixels[:, 0], pixels[:, 1], bins=COVER_GRID, range=((0, size[0]), (0, size[1])))
        shares.append(float((cells > 0).mean()))
    R = Rotation.from_rotvec(bundle.boards[:, :3]).as_matrix()
    middle = np.einsum("kij,j->ki", R, points.mean(axis=0)) + bundle.boards[:, 3:]
    distance = np.linalg.norm(middle, axis=1)
    tilt = np.arccos(np.clip(np.abs((R[:, :, 2] * middle).sum(axis=1)) / distance, 0, 1))
    return Coverage(
        shares[0], shares[1], (float(tilt.min()), float(tilt.max())), (float(distance.min()), float(distance.max()))
    )


def read_picture(path: str) -> Picture:
    """A grey picture from a file; ``CalibrationError`` where it is none."""
    picture = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise CalibrationError("cannot be read as a picture", where=path, remedy="give png, jpeg, bmp or tiff files")
    return picture  # type: ignore[return-value]
