"""Lay points without identity on a surface: find their rigid pose, how well it is known, and what the surface leaves
open.

Points are moved until their distances from the nearest places on the surface are least (iterated closest points with
point-to-plane steps; Besl & McKay 1992, Chen & Medioni 1992), from many starts. With the moved points x_i about their
middle c, the nearest place's normal n_i and the distance r_i, a step d = (turn, shift) solves

    sum w_i J_i J_i' d = -sum w_i J_i r_i,    J_i = ((x_i - c) x n_i, n_i).

What a body of revolution, a cylinder or a plane leaves open is where J'J has next to nothing (Gelfand et al. 2003). It
is asked with normals that are smoothed over the triangles, as the edges of a faceted sphere say nothing of the body's
turn, and without points near sharp edges: that they do not hang over a rim bounds a pose, but does not measure it.
Distances of neighbours are alike (noise and shape are): what patches share counts once for each of a few groups. An
error that reaches across the whole body is a motion to a fit, and cannot be told from one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from livedeform.common.errors import InputError
from livedeform.common.frames import apply, transform
from livedeform.common.types import Array
from livedeform.fem_node.mesh.triangle_distance import TriangleTree, closest_features

FEWEST = 50  # points
COARSE, FINE, JUDGED = 200, 2000, 800  # points of the search, of the fit, and of what is told of it
TURNS = 60  # starts of the search, spread evenly over all rotations
STEPS, LAST_STEPS = 15, 60
PATCHES = 40  # of points, whose mean distances tell what neighbours share
GROUPS = 8  # in which what neighbours share may be: bends of half the body's size
OPEN = 2e-3  # share of what the best known direction has, below which a direction is open
UNKNOWN = 0.03  # of the points' size: what is known worse is open as well
NO_FIT = 0.05  # of the points' size: a larger distance (rms) is no fit
ALIKE = 1.5  # times the best pose's distance: another pose that is as near is a rival
OTHER = 0.1  # of the points' size, by which it lies elsewhere (rms)
SMOOTH = np.cos(np.radians(30.0))  # normals further apart are of two faces
SEED = 20210531


@dataclass(frozen=True)
class CloudPose:
    """A pose ``T_phantom_cloud`` (4, 4) with the distances' ``rms`` m, robustly, of the ``share`` of points that lie on
    the surface; the ``middle`` (3,) m of the points and the ``covariance`` (6, 6) of (turn rad, shift m) about it;
    ``held``: in words, what the surface leaves open and was kept as the points came."""

    T_phantom_cloud: Array
    rms: float
    share: float
    middle: Array
    covariance: Array
    held: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Put it in a line."""
        turn, shift = np.sqrt(np.diag(self.covariance))[:3], np.sqrt(np.diag(self.covariance))[3:]
        kept = f", of what the surface tells; kept as it came: {', and '.join(self.held)}" if self.held else ""
        return (
            f"registered to the surface at rest: distance {1e3 * self.rms:.3f} mm rms of {100 * self.share:.0f} % of "
            f"the points; one sigma ({_three(1e3 * shift)}) mm and ({_three(1e3 * turn)}) mrad about their middle{kept}"
        )

    def moved(self, points: Array) -> Array:
        """Return points (n, 3) m in the phantom's frame."""
        return apply(self.T_phantom_cloud, points)

    def sigma_at(self, points: Array) -> float:
        """Return by how much (m, rms, one sigma) the pose's uncertainty moves points (n, 3) m in the phantom's
        frame."""
        arms = points - self.middle
        square = np.einsum("nij,jk,nik->n", _moves(arms), self.covariance, _moves(arms))
        return float(np.sqrt(np.mean(square)))


@dataclass(frozen=True)
class _Target:
    """A surface to lay points on: a ``tree`` of triangles, places (k, 3) m on it with their normals, the triangles'
    ``width`` m, and sharp ``edges`` (e, 2, 3) m."""

    tree: TriangleTree
    places: Array
    normals: Array
    width: float
    edges: Array


def lay_on(
    points: Array, vertices: Array, triangles: NDArray[np.int64], *, near: bool = False, keep: bool = False
) -> CloudPose:
    """Find the pose of ``points`` (n, 3) m on a closed surface, of which they may show a part.

    ``near``: search from where they lie, not everywhere. ``keep``: leave what the surface does not tell as it is.
    ``InputError`` where no pose fits, several do, or the surface leaves one open.
    """
    if len(points) < FEWEST:
        raise InputError(f"{len(points)} points are too few to lay on a surface", remedy=f"give {FEWEST} at least")
    rng = np.random.default_rng(SEED)
    fine = points[rng.permutation(len(points))[:FINE]]
    size = float(np.sqrt(((fine - np.median(fine, axis=0)) ** 2).sum(axis=1).mean()))
    target = _target(vertices, triangles, rng)
    starts = [np.eye(4)] if near or keep else _starts(fine, target, rng)
    found = _fits(fine, starts, target)
    T, rms, share = found[0]
    _refuse_far(rms, share, size)
    covariance, free = _known(fine, T, target, rms, size)
    middle = apply(T, fine).mean(axis=0)
    said = _in_words(free, middle, size)
    if len(free) and keep:
        T, rms, share = _fit(fine, np.eye(4), target, LAST_STEPS, free)
        told = np.eye(6) - free.T @ free  # what is kept is not told, and not uncertain in that sense
        return CloudPose(T, rms, share, apply(T, fine).mean(axis=0), told @ covariance @ told, said)
    _refuse_open(said)
    _refuse_rivals(found, fine, size)
    return CloudPose(T, rms, share, middle, covariance)


def _target(vertices: Array, triangles: NDArray[np.int64], rng: np.random.Generator, n: int = 4000) -> _Target:
    corners = vertices[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    at = rng.choice(len(triangles), n, p=area / area.sum())
    places = np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), n), corners[at])
    normals = cross[at] / (2.0 * area[at])[:, None]
    width = float(np.sqrt(area.sum() / min(len(triangles), n)))
    return _Target(TriangleTree.build(vertices, triangles), places, normals, width, _sharp(vertices, triangles))


def _sharp(vertices: Array, triangles: NDArray[np.int64]) -> Array:
    """Return the edges (e, 2, 3) m whose two triangles' normals are further apart than `SMOOTH`."""
    from trimesh import Trimesh

    body = Trimesh(vertices, triangles, process=False)
    return np.asarray(vertices[body.face_adjacency_edges[np.cos(body.face_adjacency_angles) < SMOOTH]])


def _from_edges(x: Array, edges: Array) -> Array:
    """Return the distance (n,) m of points (n, 3) from the nearest of some edges (e, 2, 3)."""
    nearest = np.full(len(x), np.inf)
    for a, b in edges:
        along = np.clip((x - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-30), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(x - a - along[:, None] * (b - a), axis=1))
    return nearest


def _starts(points: Array, target: _Target, rng: np.random.Generator) -> list[Array]:
    """Return the poses of the search, the best first: all turns with the middles on each other, fitted coarsely."""
    few = points[:COARSE]
    sets = [few.mean(axis=0), target.places.mean(axis=0)]
    turns = [*Rotation.create_group("O"), *Rotation.random(TURNS, rng=rng)]
    tried = []
    for turn in turns:
        R = turn.as_matrix()
        tried.append(_fit(few, transform(R, sets[1] - R @ sets[0]), target, STEPS))
    return [T for T, _, _ in sorted(tried, key=lambda fit: fit[1])[:12]]


def _fits(points: Array, starts: Sequence[Array], target: _Target) -> list[tuple[Array, float, float]]:
    """Fit from each start; the nearest pose first."""
    return sorted((_fit(points, T, target, LAST_STEPS) for T in starts), key=lambda fit: fit[1])


def _fit(points: Array, T: Array, target: _Target, steps: int, held: Array | None = None) -> tuple[Array, float, float]:
    """Move ``points`` onto the surface from ``T``; gives the pose, the rms distance (cut at six times the middle one)
    and the share of points within that. Nothing moves along the directions ``held`` (k, 6)."""
    last = np.inf
    for _ in range(steps):
        x = apply(T, points)
        r, normals = _distances(x, target)
        middle = x.mean(axis=0)
        J = _jacobian(x - middle, normals)
        scale = max(1.4826 * float(np.median(np.abs(r))), 1e-9)
        w = np.clip(1.0 - (r / (6.0 * scale)) ** 2, 0.0, None) ** 2  # Tukey's biweight
        unit = np.sqrt(np.einsum("ni,ni->i", J, J).max(initial=1e-30) / len(J))
        A = (J * w[:, None]).T @ J
        A += 1e-4 * len(J) * np.diag(np.where(np.arange(6) < 3, unit**2, 1.0))
        step = -np.linalg.solve(A, J.T @ (w * r))
        if held is not None:
            step -= held.T @ (held @ step)
        R = Rotation.from_rotvec(step[:3]).as_matrix()
        T = transform(R, middle + step[3:] - R @ middle) @ T
        if scale > 0.9999 * last and np.linalg.norm(step[3:]) < 1e-3 * scale:
            break
        last = scale
    r, _ = _distances(apply(T, points), target)
    cut = 6.0 * max(1.4826 * float(np.median(np.abs(r))), 1e-9)
    near = np.abs(r) <= cut
    return T, float(np.sqrt(np.mean(np.minimum(np.abs(r), cut) ** 2))), float(near.mean())


def _distances(x: Array, target: _Target) -> tuple[Array, Array]:
    """Return signed distances (n,) m from the surface, and the directions (n, 3) along which they are."""
    place, normal, _, _ = closest_features(target.tree, np.ascontiguousarray(x))
    gap = x - place
    size = np.linalg.norm(gap, axis=1)
    sign = np.where(np.einsum("ni,ni->n", gap, normal) < 0.0, -1.0, 1.0)
    along = np.where((size > 1e-9)[:, None], sign[:, None] * gap / np.maximum(size, 1e-12)[:, None], normal)
    return sign * size, along


def _moves(arms: Array) -> Array:
    """Return d(point) / d(turn, shift) (n, 3, 6) of points at ``arms`` (n, 3) m from the middle."""
    out = np.zeros((len(arms), 3, 6))
    out[:, :, :3] = np.cross(np.eye(3), arms[:, None]).transpose(0, 2, 1)
    out[:, :, 3:] = np.eye(3)
    return out


def _jacobian(arms: Array, normals: Array) -> Array:
    """Return d(distance) / d(turn, shift) (n, 6)."""
    return np.hstack([np.cross(arms, normals), normals])


def _smooth_normals(x: Array, target: _Target) -> Array:
    """Return the surface's normals (n, 3) at the points nearest places, smoothed over two triangles' width but not
    across edges."""
    place, normal, _, _ = closest_features(target.tree, np.ascontiguousarray(x))
    square = ((place[:, None] - target.places) ** 2).sum(axis=2)
    alike = normal @ target.normals.T > SMOOTH
    weight = np.exp(-0.5 * square / target.width**2) * alike
    mean = weight @ target.normals + 1e-9 * normal
    return np.asarray(mean / np.linalg.norm(mean, axis=1)[:, None])


def _known(points: Array, T: Array, target: _Target, rms: float, size: float) -> tuple[Array, Array]:
    """Return the covariance (6, 6) of a pose's (turn, shift), and the directions (k, 6) that are open."""
    x = apply(T, points[:JUDGED])
    r, _ = _distances(x, target)
    arms = x - x.mean(axis=0)
    scaled = np.concatenate([np.full(3, size), np.ones(3)])  # turns as the shift that they make at the points' size
    J = _jacobian(arms, _smooth_normals(x, target)) / scaled
    w = np.clip(1.0 - (r / (6.0 * max(rms, 1e-9))) ** 2, 0.0, None) ** 2
    w *= _from_edges(x, target.edges) > 4.0 * max(rms, 1e-9)
    A = (J * w[:, None]).T @ J
    values, vectors = np.linalg.eigh(A)
    own, shared = _variances(r, w, _patches(x))
    covariance = vectors / np.maximum(values, 1e-12 * values[-1]) @ vectors.T * (own + shared * w.sum() / GROUPS)
    sigma = np.sqrt(np.einsum("ik,ij,jk->k", vectors, covariance, vectors).clip(0.0))
    free = vectors[:, (values < OPEN * values[-1]) | (sigma > UNKNOWN * size)].T
    return covariance / np.outer(scaled, scaled), _orthonormal(free / scaled)


def _orthonormal(directions: Array) -> Array:
    """Return directions (k, 6) in (rad, m) that span the same, orthonormal."""
    return np.linalg.qr(directions.T)[0].T if len(directions) else directions


def _variances(r: Array, w: Array, patch: NDArray[np.int64]) -> tuple[float, float]:
    """Return the variances m2 of distances (n,) with weights (n,) that each point has for itself, and that neighbours
    share: by how much the means of patches differ beyond what the first makes them."""
    n = np.bincount(patch, w)
    good = n > 1.0
    n = n[good]
    mean = np.bincount(patch, w * r)[good] / n
    square = np.bincount(patch, w * r**2)[good]
    own = float((square - n * mean**2).sum() / max((n - 1.0).sum(), 1e-12))
    shared = float((mean**2 - own / n).sum() / max(len(n) - 6, 1))  # six numbers were fitted
    return own, max(shared, 0.0)


def _patches(x: Array) -> NDArray[np.int64]:
    """Return the patch (n,) of each point: that of the nearest of `PATCHES` points far from each other."""
    chosen, away = [0], np.linalg.norm(x - x[0], axis=1)
    for _ in range(min(PATCHES, len(x)) - 1):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(x - x[chosen[-1]], axis=1))
    return np.asarray(KDTree(x[chosen]).query(x)[1], np.int64)


def _in_words(free: Array, middle: Array, size: float) -> tuple[str, ...]:
    """Say what open directions (k, 6) of (rad, m) are: shifts along axes where they are that, and turns about axes."""
    if not len(free):
        return ()
    U, turning, _ = np.linalg.svd(free[:, :3] * size)
    scaled = free * np.concatenate([np.full(3, size), np.ones(3)])
    mixed = U.T @ scaled
    part = np.concatenate([turning, np.zeros(len(mixed))])[: len(mixed)] / np.linalg.norm(mixed, axis=1)
    shifts, turns = mixed[part < 0.1][:, 3:], mixed[part >= 0.1]
    said = [f"a shift along ({_axis(shift)})" for shift in shifts]
    # a turn's axis passes where it moves nothing
    places = [middle + size * np.cross(d[:3], d[3:]) / (d[:3] @ d[:3]) for d in turns]
    if len(turns) == 3:
        return (*said, f"every turn about ({_three(1e3 * np.mean(places, axis=0))}) mm")
    said += [
        f"a turn about ({_axis(d[:3])}) through ({_three(1e3 * place)}) mm"
        for d, place in zip(turns, places, strict=True)
    ]
    return tuple(said)


def _axis(vector: Array) -> str:
    """Put a direction in words, its largest component positive."""
    unit = vector / np.linalg.norm(vector) * np.sign(vector[np.abs(vector).argmax()])
    return ", ".join(f"{v + 0.0:.2f}" for v in np.round(unit, 2))


def _refuse_far(rms: float, share: float, size: float) -> None:
    """Raise ``InputError`` where the best pose is no fit."""
    if rms > NO_FIT * size or share < 0.5:
        raise InputError(
            f"no pose lays the points on the surface: {1e3 * rms:.2f} mm rms at best, {100 * share:.0f} % of them near",
            remedy="check --units, the time of rest (--rest), and that the points are of this body; cut others away",
        )


def _refuse_open(said: Sequence[str]) -> None:
    """Raise ``InputError`` where the surface leaves something open."""
    if said:
        raise InputError(
            f"the surface does not tell the points' pose: it leaves open {', and '.join(said)}",
            remedy="measure more of the body, or bring the points into the phantom's frame there and say --keep",
        )


def _refuse_rivals(found: Sequence[tuple[Array, float, float]], points: Array, size: float) -> None:
    """Raise ``InputError`` where a pose that lies elsewhere fits as well as the first."""
    T, rms, _ = found[0]
    best = apply(T, points)
    for other, far, _ in found[1:]:
        away = float(np.sqrt(((apply(other, points) - best) ** 2).sum(axis=1).mean()))
        if far < ALIKE * rms + 1e-6 and away > OTHER * size:
            turn = np.degrees(Rotation.from_matrix(other[:3, :3] @ T[:3, :3].T).magnitude())
            raise InputError(
                f"the points fit the surface in two ways ({1e3 * rms:.3f} and {1e3 * far:.3f} mm rms), {turn:.0f} "
                "degrees apart",
                remedy="bring them nearly into the phantom's frame and say --near, or measure more of the body",
            )


def _three(values: Array) -> str:
    return ", ".join(f"{v + 0.0:.3g}" for v in values)
