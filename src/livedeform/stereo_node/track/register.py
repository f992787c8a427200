"""T_phantom_left from the markers at rest, without knowing which is which.

A few measured points are compared with the markers by the lengths of the triangle that they span: three lengths within
tolerance propose a pose (RANSAC over triangles; Fischler & Bolles 1981, Irani & Raghavan 1996), which is judged by
all points with one point per marker. The best pose is refined with the points' covariances. A second pose, with other
identities, that explains the points about as well makes the answer ambiguous: that is an error, since nothing in the
pictures can decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from livedeform.common.errors import InputError
from livedeform.common.frames import (
    apply,
    fit_misplaced,
    fit_rigid,
    fit_rigid_by_noise,
    increment_jacobian,
    inverse,
    make_a_frame,
)
from livedeform.common.types import Array
from livedeform.stereo_node.track.match import assign
from livedeform.stereo_node.track.sides import sees_outside

Rows = NDArray[np.int64]
Solution = tuple[float, Array, Rows, Rows]
"""Cost, T_phantom_left (4, 4), and rows of points and markers that belong together."""
MIN_MARKERS = 4
AMBIGUITY = 0.1  # share of the matched markers by which another pose must be worse
RIVAL = 3.0  # times the best pose's residual: what fits worse than that is no rival
MAX_TRIALS = 150
MAX_TRIPLES = 40  # of one measured triangle


class RegistrationError(InputError):
    """The cameras' pose could not be found from the markers, or not uniquely."""


class SeenFromInside(RegistrationError):
    """Markers in a plane fit their places only mirrored, whatever the tolerance."""

    def __init__(self) -> None:
        super().__init__(
            "the markers lie in a plane, and fit their places only as seen from inside the body",
            where="stereo.pose",
            remedy="an axis of markers.csv runs the wrong way, or its numbers do: as seen from outside, x, y and the "
            "plane's normal towards the cameras must be right-handed",
        )


@dataclass(frozen=True)
class Registration:
    """The cameras' pose ``T_phantom_left`` (4, 4); ``covariance`` (6, 6) of (rotation vector rad, translation m) of the
    left-hand increment T <- (I + [rotation]x, translation) T about the markers' mean; ``point_rows``, ``marker_rows``
    (n,): which point is which marker; ``rms`` m of the n matched points; ``runner_up`` markers matched by the best
    other pose."""

    T_phantom_left: Array
    covariance: Array
    point_rows: Rows
    marker_rows: Rows
    rms: float
    runner_up: int


def register(
    points: Array, covariances: Array, markers: Array, tolerance: float, *, seed: int = 0, groups: Rows | None = None,
    outward: Array | None = None,
) -> Registration:  # fmt: skip
    """Register ``points`` (n, 3) m in the left frame, with ``covariances`` (n, 3, 3), to ``markers`` (m, 3) m in
    phantom.

    Some points may be false and some markers unseen. ``tolerance`` m is how far markers may lie from where they are
    declared, besides the measuring noise. ``groups`` (n, 2): rows of left and right blobs, where of several points that
    share one only one can be true. ``outward`` (3,): from which side the cameras see markers in a plane.
    ``RegistrationError`` where no pose fits, or more than one does.
    """
    if len(points) < MIN_MARKERS or len(markers) < MIN_MARKERS:
        raise RegistrationError(
            f"{min(len(points), len(markers))} markers are too few to find the cameras' pose",
            where="stereo.pose",
            remedy=f"show at least {MIN_MARKERS} markers that are not in a line, or give the pose",
        )
    sigma = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    hypotheses = _hypotheses(points, sigma, markers, tolerance, np.random.default_rng(seed))
    if not hypotheses:
        raise RegistrationError(
            f"no pose fits {len(points)} measured points to {len(markers)} markers within {tolerance * 1e3:.1f} mm",
            where="stereo.pose",
            remedy=(
                "check markers.csv (unit, configuration), the calibration, and that the first "
                "pictures show the body at rest"
            ),
        )
    found = [_refine(points, covariances, markers, T, tolerance, groups) for T in hypotheses]
    refined = sorted((r for r in found if r is not None), key=lambda r: r[0])
    if outward is not None and refined:
        refined = _from_outside(refined, markers, outward)
    runner_up = _check_unique(refined, points, markers, sigma)
    _, T, rows, cols = refined[0]
    residual = markers[cols] - apply(T, points[rows])
    return Registration(
        T, _pose_covariance(points[rows], covariances[rows], T, residual), rows, cols,
        float(np.sqrt((residual**2).sum(axis=1).mean())), runner_up,
    )  # fmt: skip


def _from_outside(refined: list[Solution], markers: Array, outward: Array) -> list[Solution]:
    """Return those by which the cameras see markers in a plane from ``outward`` (3,); ``RegistrationError`` where the
    others explain more: the list of the places is mirrored."""
    outside = [r for r in refined if sees_outside(r[1], markers, outward)]
    n, most = max((len(r[2]) for r in outside), default=0), len(refined[0][2])
    if n < most - max(1, AMBIGUITY * most):
        raise SeenFromInside
    return outside


def _check_unique(refined: list[Solution], points: Array, markers: Array, sigma: Array) -> int:
    """Return how many markers the best other pose matches; ``RegistrationError`` where the best matches too few, or the
    other about as many."""
    n = len(refined[0][2]) if refined else 0
    needed = max(MIN_MARKERS, int(0.3 * min(len(markers), len(points))))
    if n < needed:
        raise RegistrationError(
            f"the best pose explains {n} of {len(markers)} markers",
            where="stereo.pose",
            remedy=f"at least {needed} must be seen at rest: check markers.csv and the detector's settings",
        )
    # a rival fits as closely: on a small body with close markers a wrong pose matches many, but several times worse
    limit = RIVAL * max(_rms(points, markers, refined[0]), float(np.median(sigma)))
    rivals = [r for r in refined[1:] if _other_identities(r, refined[0]) and _rms(points, markers, r) < limit]
    runner_up = max((len(r[2]) for r in rivals), default=0)
    # any three markers fit anywhere; beyond them, what a wrong pose matches by chance scatters like a count
    by_chance = 2 * np.sqrt(max(runner_up - 3, 0))
    if runner_up >= n - max(1, AMBIGUITY * n, by_chance) + 0.5:
        raise RegistrationError(
            f"the marker pattern fits in two ways ({n} and {runner_up} of {len(markers)} markers)",
            where="stereo.pose",
            remedy=(
                "make the pattern unsymmetric by moving or adding a marker, show more of the markers, "
                "or give stereo.pose"
            ),
        )
    return runner_up


def register_named(
    points: Array, covariances: Array, markers: Array, point_rows: Rows, marker_rows: Rows, tolerance: float
) -> Registration:
    """Register where the pictures name the markers: ``points[i]`` is ``markers[i]``."""
    if len(points) < 3:
        raise RegistrationError(
            f"{len(points)} coded markers with known places are too few",
            where="stereo.pose",
            remedy="show at least 3, or give the pose",
        )
    if not make_a_frame(markers):
        raise RegistrationError(
            f"the {len(points)} coded markers with known places lie on a line: how the cameras are turned stays open",
            where="stereo.pose",
            remedy="show one more beside the line, or give the pose",
        )
    T = fit_rigid_by_noise(points, covariances, markers, fit_rigid(points, markers), tolerance / 6)
    residual = markers - apply(T, points)
    rms = float(np.sqrt((residual**2).sum(axis=1).mean()))
    if rms > tolerance:
        raise RegistrationError(
            f"the coded markers are {rms * 1e3:.1f} mm rms from their declared places",
            where="stereo.pose", remedy="check markers.csv against the tags' numbers, and its unit",
        )  # fmt: skip
    return Registration(T, _pose_covariance(points, covariances, T, residual), point_rows, marker_rows, rms, 0)


def register_either_way(
    points: Array, covariances: Array, markers: Array, ways: Sequence[Rows], tolerance: float,
    outward: Array | None = None,
) -> Registration:  # fmt: skip
    """Register ``points`` (n, 3) that pictures name in ``ways`` that look alike: each gives the rows (n,) of the
    ``markers`` (m, 3), -1 for none. ``outward`` (3,): from which side the cameras see markers in a plane.
    ``RegistrationError`` where none fits, or more than one does."""
    found, failed = [], None
    for names in ways:
        known = np.flatnonzero(names >= 0)
        try:
            found.append(
                register_named(points[known], covariances[known], markers[names[known]], known, names[known], tolerance)
            )
        except RegistrationError as error:
            failed = failed or error
    if failed is not None and not found:
        raise failed
    if outward is not None:
        found = [f for f in found if sees_outside(f.T_phantom_left, markers, outward)]
        if not found:
            raise SeenFromInside
    found.sort(key=lambda f: f.rms)
    sigma = float(np.median(np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])))
    if len(found) > 1 and found[1].rms < RIVAL * max(found[0].rms, sigma):
        raise RegistrationError(
            "the board looks alike from two sides, and fits its places both ways", where="stereo.detector.board",
            remedy="use a checkerboard of an odd and an even number of corners, as 9x6, or give stereo.pose",
        )  # fmt: skip
    return found[0]


def refine(found: Registration, points: Array, covariances: Array, markers: Array) -> Registration:
    """Fit ``found`` anew from better ``points`` (n, 3) of ``markers`` (n, 3): weighted by the points' covariances and
    by how far the markers lie from their declared places beyond these, which the residuals show."""
    T = fit_misplaced(points, covariances, markers, found.T_phantom_left)
    residual = markers - apply(T, points)
    rms = float(np.sqrt((residual**2).sum(axis=1).mean()))
    return replace(found, T_phantom_left=T, covariance=_pose_covariance(points, covariances, T, residual), rms=rms)


def _hypotheses(points: Array, sigma: Array, markers: Array, tolerance: float, rng: np.random.Generator) -> list[Array]:
    """Propose poses T_phantom_left by triangles, those that explain most markers first, without near repetitions."""
    lengths = np.linalg.norm(markers[:, None] - markers[None], axis=2)
    tree = cKDTree(markers)
    good_points = np.flatnonzero(sigma < 10 * np.median(sigma) + tolerance)
    scores: list[tuple[float, Array]] = []
    enough = 0
    for _ in range(MAX_TRIALS):
        chosen = _wide_triangle(points, good_points, lengths.max(), rng)
        if chosen is None:
            continue
        slack = 2 * (tolerance + 3 * sigma[chosen].max())
        for corners in _similar_triangles(points[chosen], markers, lengths, slack):
            T = fit_rigid(points[chosen], markers[corners])
            distance, nearest = tree.query(apply(T, points))
            near = distance < 2 * tolerance + 3 * sigma
            count = len(np.unique(nearest[near]))
            if count >= MIN_MARKERS:
                scores.append((count - float((distance[near] / (2 * tolerance + 3 * sigma[near])).mean()), T))
                enough += count > 0.5 * min(len(markers), len(points))
        if enough >= 40:  # the right pose was proposed many times, and so was any rival
            break
    scores.sort(key=lambda s: -s[0])
    kept: list[Array] = []
    middle = markers.mean(axis=0)
    for _, T in scores[:400]:
        if all(not _near(T, other, middle, lengths.max(), 3 * tolerance) for other in kept):
            kept.append(T)
        if len(kept) >= 12:
            break
    return kept


def _near(T: Array, other: Array, middle: Array, size: float, slack: float) -> bool:
    difference = other @ inverse(T)
    angle = Rotation.from_matrix(difference[:3, :3]).magnitude()
    return bool(
        np.linalg.norm(apply(difference, middle[None])[0] - middle) < 2 * slack and angle * size / 2 < 4 * slack
    )


def _wide_triangle(points: Array, rows: Rows, size: float, rng: np.random.Generator) -> Rows | None:
    """Return three points that are far from a line and from each other, but not farther than the pattern is wide."""
    best, best_area = None, 0.0
    for _ in range(12):
        chosen = rng.choice(rows, 3, replace=False)
        a, b, c = points[chosen]
        sides = [float(np.linalg.norm(d)) for d in (b - a, c - b, a - c)]
        if max(sides) > 1.1 * size or min(sides) < 0.1 * size:
            continue
        area = float(np.linalg.norm(np.cross(b - a, c - a))) / max(sides) ** 2
        if area > best_area:
            best, best_area = chosen, area
        if best_area > 0.4:
            break
    return best if best_area > 0.1 else None


def _similar_triangles(corners: Array, markers: Array, lengths: Array, slack: float) -> list[Rows]:
    """Return ordered triples of markers whose three distances are those of ``corners`` (3, 3) within ``slack`` m."""
    ab, bc, ca = (np.linalg.norm(corners[i] - corners[(i + 1) % 3]) for i in range(3))
    first, second = np.nonzero(np.abs(lengths - ab) < slack)
    if not len(first):
        return []
    third = (np.abs(lengths[second] - bc) < slack) & (np.abs(lengths[first] - ca) < slack)
    row, k = np.nonzero(third)
    triples = np.stack([first[row], second[row], k], axis=1)
    triples = triples[(triples[:, 0] != triples[:, 2]) & (triples[:, 1] != triples[:, 2])]
    if len(triples) > MAX_TRIPLES:  # a regular pattern: the closest suffice to find it and its rivals
        t = triples
        misfit = (
            np.abs(lengths[t[:, 0], t[:, 1]] - ab)
            + np.abs(lengths[t[:, 1], t[:, 2]] - bc)
            + np.abs(lengths[t[:, 2], t[:, 0]] - ca)
        )
        triples = triples[np.argsort(misfit)[:MAX_TRIPLES]]
    return list(triples)


def _refine(
    points: Array, covariances: Array, markers: Array, T: Array, tolerance: float, groups: Rows | None
) -> Solution | None:
    """Alternate assignment and weighted rigid fit; returns (cost, T, point rows, marker rows)."""
    rows = cols = np.zeros(0, np.int64)
    cost = np.inf
    for reach in (2.0, 1.5, 1.0, 1.0):
        placed = apply(T, points)
        R = T[:3, :3]
        S = R @ covariances @ R.T + np.eye(3) * tolerance**2
        difference = markers[None] - placed[:, None]
        distance2 = np.einsum("pmi,pij,pmj->pm", difference, np.linalg.inv(S), difference)
        limit = 16.0 * reach**2
        rows, cols = assign(np.where(distance2 < limit, distance2, np.inf), limit)
        rows, cols = _one_per_blob(rows, cols, distance2[rows, cols], groups)
        if len(rows) < MIN_MARKERS:
            return None
        weights = 1 / np.trace(S[rows], axis1=1, axis2=2)
        T = fit_rigid(points[rows], markers[cols], weights)
        T = fit_rigid_by_noise(points[rows], covariances[rows], markers[cols], T, tolerance)
        cost = float(distance2[rows, cols].sum() + limit * (len(markers) - len(rows)))
    return cost, T, rows, cols


def _one_per_blob(rows: Rows, cols: Rows, cost: Array, groups: Rows | None) -> tuple[Rows, Rows]:
    """Drop the worse of two matched points that were made from the same blob."""
    if groups is None or not len(rows):
        return rows, cols
    keep = np.zeros(len(rows), bool)
    used: tuple[set[int], set[int]] = (set(), set())
    for k in np.argsort(cost):
        left, right = int(groups[rows[k], 0]), int(groups[rows[k], 1])
        if left not in used[0] and right not in used[1]:
            keep[k] = True
            used[0].add(left)
            used[1].add(right)
    return rows[keep], cols[keep]


def _pose_covariance(points: Array, covariances: Array, T: Array, residual: Array) -> Array:
    """Estimate the pose's covariance (6, 6) from the points' noise, enlarged where the residual is larger than that
    noise."""
    R = T[:3, :3]
    W = np.linalg.inv(R @ covariances @ R.T)
    placed = apply(T, points)
    J = increment_jacobian(placed - placed.mean(axis=0))
    chi2 = float(np.einsum("ni,nij,nj->", residual, W, residual)) / max(3 * len(points) - 6, 1)
    return np.linalg.pinv((np.swapaxes(J, 1, 2) @ W @ J).sum(axis=0)) * max(chi2, 1.0)


def _rms(points: Array, markers: Array, solution: Solution) -> float:
    """Return root mean square distance (m) of the matched points from their markers."""
    _, T, rows, cols = solution
    return float(np.sqrt(((markers[cols] - apply(T, points[rows])) ** 2).sum(axis=1).mean()))


def _other_identities(a: Solution, b: Solution) -> bool:
    """Tell whether two solutions name the points they share differently (for the larger part)."""
    name = dict(zip(b[2].tolist(), b[3].tolist(), strict=True))
    shared = [(name[p], m) for p, m in zip(a[2].tolist(), a[3].tolist(), strict=True) if p in name]
    if not shared:
        return True
    return bool(sum(x != y for x, y in shared) > 0.5 * len(shared))
