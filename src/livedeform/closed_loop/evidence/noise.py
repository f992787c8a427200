"""The covariance of what may separate measurement and model without any missing effect, as one Gaussian: C + Z P^-1
Z^T.

``C`` is block-diagonal over the markers (and the force's axes). A marker's block over all key moments holds

- the measuring noise of the window means,
- the uncertainty of the marker's declared place: the same vector at all moments, so it cannot be averaged away,
- the discretisation error of the model, relative to how far the marker has moved, common to the moments of one press.

``Z`` are columns common to many markers, with priors: the rigid registration of each recording, smooth relative model
errors per press, and the parameters that the experiment gives a sigma. Everything that decides between effects sees
residuals only after these have been allowed for (Kennedy & O'Hagan 2001; Brynjarsdottir & O'Hagan 2014 on why).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg.blas import dtrsm

from livedeform.closed_loop.settings import AllowanceSettings
from livedeform.common.types import Array


@dataclass(frozen=True)
class ModelErrors:
    """Sizes of what is not measuring noise: ``place_sigma`` (m,) m of the markers' declared places; ``relative``
    model error as a share of the marker's motion, and beyond it ``local`` (m,) of single markers (near the probe and at
    edges); ``absolute`` m, model error of the shape at rest; ``force_relative`` the same of the force."""

    place_sigma: Array
    relative: float = 0.01
    absolute: float = 0.0
    force_relative: float = 0.03
    local: Array | None = None

    def of(self, marker: int) -> float:
        """The relative error of one marker."""
        return self.relative if self.local is None else float(np.hypot(self.relative, self.local[marker]))


@dataclass(frozen=True)
class Rows:
    """Labels of the data: row r is axis ``axis`` of marker ``marker`` (or -1: force) at moment ``moment``; ``fold``
    is its block for cross-validation and ``group`` its covariance block. Rows of a group are contiguous."""

    marker: np.ndarray
    moment: np.ndarray
    axis: np.ndarray
    fold: np.ndarray
    bounds: np.ndarray

    @property
    def n(self) -> int:
        return len(self.marker)

    def take(self, points: Array, forces: Array | None = None) -> Array:
        """Rows of ``points`` (k, m, 3, ...) and ``forces`` (k, 3, ...)."""
        is_force = self.marker < 0
        out = np.empty((self.n, *points.shape[3:]))
        p = ~is_force
        out[p] = points[self.moment[p], self.marker[p], self.axis[p]]
        if is_force.any():
            if forces is None:
                raise ValueError("these rows need forces")
            out[is_force] = forces[self.moment[is_force], self.axis[is_force]]
        return out


def rows_of(points: Array, forces: Array | None, folds: np.ndarray) -> Rows:
    """The rows of what was measured: ``points`` (k, m, 3) with NaN where not seen, ``forces`` (k, 3) or None,
    ``folds`` (k,)."""
    marker, moment, axis, sizes = [], [], [], []
    for i in range(points.shape[1]):
        seen = np.flatnonzero(np.isfinite(points[:, i]).all(axis=1))
        if not len(seen):
            continue
        moment.append(np.repeat(seen, 3))
        axis.append(np.tile([0, 1, 2], len(seen)))
        marker.append(np.full(3 * len(seen), i))
        sizes.append(3 * len(seen))
    if forces is not None:
        for a in range(3):
            seen = np.flatnonzero(np.isfinite(forces[:, a]))
            if len(seen):
                moment.append(seen)
                axis.append(np.full(len(seen), a))
                marker.append(np.full(len(seen), -1))
                sizes.append(len(seen))
    moments = np.concatenate(moment)
    return Rows(
        np.concatenate(marker), moments, np.concatenate(axis), np.asarray(folds)[moments], np.r_[0, np.cumsum(sizes)]
    )


@dataclass(frozen=True)
class Covariance:
    """C, as its diagonal blocks over ``rows.bounds``."""

    rows: Rows
    blocks: tuple[Array, ...]

    def roughened(self, size: float) -> Covariance:
        """Add white noise of ``size`` m to the points."""
        parts = [self.rows.marker[a:b] >= 0 for a, b in pairwise(self.rows.bounds)]
        return replace(self, blocks=tuple(C + size**2 * np.diag(p) for C, p in zip(self.blocks, parts, strict=True)))

    @cached_property
    def whitener(self) -> Whitener:
        """The whitener of all rows."""
        return self.whitener_of(np.ones(self.rows.n, bool))

    def whitener_of(self, keep: np.ndarray) -> Whitener:
        """Return the whitener of the rows where ``keep`` (n,) is True."""
        factors, picks = [], []
        for (a, b), block in zip(pairwise(self.rows.bounds), self.blocks, strict=True):
            pick = np.flatnonzero(keep[a:b])
            if len(pick):
                picks.append(a + pick)
                part = block if len(pick) == b - a else block[np.ix_(pick, pick)]
                factors.append(np.asarray(np.linalg.cholesky(part), float))
        return Whitener(tuple(picks), tuple(factors))


@dataclass(frozen=True)
class Whitener:
    """Inverse Cholesky factor of (a part of) C: ``whiten`` turns residuals into uncorrelated ones of variance one."""

    picks: tuple[np.ndarray, ...]
    factors: tuple[Array, ...]

    def whiten(self, x: Array) -> Array:
        """L^-1 x for ``x`` (n, ...) over all rows; returns the kept rows."""
        columns = x.reshape(len(x), -1)
        if not (self.picks and columns.size):  # no block of time but one, left out: it is predicted by the priors
            return x[: sum(map(len, self.picks))]
        # (L^-1 x)^T = x^T L^-T, in the order that BLAS stores matrices: nothing is copied
        parts = zip(self.picks, self.factors, strict=True)
        white = np.concatenate([dtrsm(1.0, L.T, columns[p].T, side=1, overwrite_b=1).T for p, L in parts])
        return np.asarray(white.reshape(len(white), *x.shape[1:]))

    def color(self, w: Array, n: int) -> Array:
        """L w: draws with covariance C, in the order of all ``n`` rows, from white ``w`` (kept, ...)."""
        out = np.zeros((n, *w.shape[1:]))
        at = 0
        for p, L in zip(self.picks, self.factors, strict=True):
            out[p] = L @ w[at : at + len(p)]
            at += len(p)
        return out


@dataclass(frozen=True)
class Steady:
    """An error of each marker's measuring that lasts, of a size whose ``roots`` (k, m, 3, 3) m are square roots of its
    covariances: a share of it that ``varies`` is the same at all moments of one of the marker's ``looks`` (k, m), the
    rest at all moments."""

    looks: np.ndarray
    roots: Array
    varies: float = 1.0

    def of(self, marker: int, moment: np.ndarray, axis: np.ndarray) -> Array:
        """Return its covariance (n, n) m2 between a marker's rows at a ``moment`` (n,) along an ``axis`` (n,) each."""
        root = self.roots[moment, marker, axis]
        return np.asarray((1.0 - self.varies + self.varies * _same(self.looks[moment, marker])) * (root @ root.T))


def covariance_of(
    rows: Rows,
    covariances: Array,
    motion: Array,
    presses: np.ndarray,
    errors: ModelErrors,
    *,
    force: Array | None = None,
    force_sigma: float = 0.0,
    steady: Steady | None = None,
    settings: AllowanceSettings,
) -> Covariance:
    """C for window means with ``covariances`` (k, m, 3, 3), of markers that moved by ``motion`` (k, m) m from rest,
    in the presses ``presses`` (k,); ``force`` (k, 3) predicted, with noise ``force_sigma`` N."""
    blocks = []
    for g in range(len(rows.bounds) - 1):
        part = slice(rows.bounds[g], rows.bounds[g + 1])
        moment, axis = rows.moment[part], rows.axis[part]
        i = rows.marker[rows.bounds[g]]
        same_press, same_axis = _same(presses[moment]), _same(axis)
        if i < 0:
            # of the whole force for each of its axes: a coarse contact patch also tilts it
            size = np.linalg.norm(force, axis=1)[moment] if force is not None else np.zeros(len(moment))
            block = np.eye(len(moment)) * (force_sigma**2 + (settings.force_single * size.max(initial=0.0)) ** 2)
            common = settings.force_common
            block += errors.force_relative**2 * np.outer(size, size) * ((1.0 - common) * same_press + common)
        else:
            block = _same(moment) * _among(covariances[moment, i], axis)
            if steady is not None:
                block += steady.of(int(i), moment, axis)
            block = 0.5 * (block + block.T)
            block += same_axis * (errors.place_sigma[i] ** 2 + errors.absolute**2)
            size = motion[moment, i]
            relative = errors.of(i)
            block += same_axis * same_press * relative**2 * np.outer(size, size)
            # what no part above describes; it also keeps the block well conditioned
            block += np.eye(len(moment)) * (settings.floor**2 + (settings.single * relative * size) ** 2)
        blocks.append(block)
    return Covariance(rows, tuple(blocks))


def _same(labels: np.ndarray) -> np.ndarray:
    """Return which pairs of rows have the same label (n, n)."""
    return np.asarray(labels[:, None] == labels[None, :])


def _among(covariances: Array, axis: np.ndarray) -> Array:
    """Entries (n, n) of each row's covariance (n, 3, 3) between its axis and the others'."""
    return np.asarray(covariances[np.arange(len(axis))[:, None], axis[:, None], axis[None, :]])


@dataclass(frozen=True)
class Nuisance:
    """Columns (n, q) that are allowed for in every model, scaled to a prior of variance one; ``names`` (q,)."""

    columns: Array
    names: tuple[str, ...]


def registration_columns(
    rows: Rows, points: Array, recording: np.ndarray, sigma_translation: float, sigma_rotation: float
) -> Nuisance:
    """Six columns per recording: a small rigid motion of all measured points; ``points`` (k, m, 3) predicted,
    ``recording`` (k,)."""
    columns, names = [], []
    k, m, _ = points.shape
    centre = points.reshape(-1, 3).mean(axis=0)
    forces = np.zeros((k, 3))
    for r in np.unique(recording):
        here = recording == r
        for a in range(3):
            shift = np.zeros((k, m, 3))
            shift[here, :, a] = sigma_translation
            turn = np.zeros((k, m, 3))
            turn[here] = sigma_rotation * np.cross(np.eye(3)[a], points[here] - centre)
            columns += [rows.take(shift, forces), rows.take(turn, forces)]
            names += [f"shift_{'xyz'[a]}[{r}]", f"turn_{'xyz'[a]}[{r}]"]
    return Nuisance(np.column_stack(columns), tuple(names))


def release_columns(rows: Rows, rates: Array, recording: np.ndarray, sigma: float) -> Nuisance:
    """Return a column per recording: all markers a little ahead or behind, as the body was let go ``sigma`` s sooner
    or later; ``rates`` (k, m, 3) m/s of the markers, ``recording`` (k,)."""
    forces, numbers = np.zeros((len(rates), 3)), np.unique(recording)
    columns = [rows.take(sigma * rates * (recording == r)[:, None, None], forces) for r in numbers]
    return Nuisance(np.column_stack(columns), tuple(f"release[{r}]" for r in numbers))


def smooth_error_columns(
    rows: Rows, places: Array, motion: Array, presses: np.ndarray, errors: ModelErrors, settings: AllowanceSettings
) -> Nuisance:
    """Relative model errors that are smooth over the body: for each press, a linear field times the marker's motion.

    ``places`` (m, 3) at rest. Neighbouring markers share the discretisation error of the elements between them, so it
    is no independent noise.
    """
    k, m = motion.shape
    spread = places - places.mean(axis=0)
    spread = spread / max(float(np.abs(spread).max()), 1e-9)
    fields = [np.ones(m), *spread.T]
    forces = np.zeros((k, 3))
    columns, names = [], []
    for press in np.unique(presses):
        here = presses == press
        if motion[here].max(initial=0.0) < settings.still:
            continue
        for f, field in enumerate(fields):
            for a in range(3):
                x = np.zeros((k, m, 3))
                x[here, :, a] = errors.relative * motion[here] * field
                columns.append(rows.take(x, forces))
                names.append(f"model_error[{press},{f},{'xyz'[a]}]")
    if not columns:
        return Nuisance(np.zeros((rows.n, 0)), ())
    return Nuisance(np.column_stack(columns), tuple(names))


def join(parts: Sequence[Nuisance]) -> Nuisance:
    """All columns side by side."""
    return Nuisance(np.column_stack([p.columns for p in parts]), tuple(n for p in parts for n in p.names))


def touch_columns(
    rows: Rows,
    points: Array,
    forces: Array | None,
    probe: Array,
    recording: np.ndarray,
    share: Array,
    sigma: float,
    settings: AllowanceSettings,
) -> Nuisance:
    """Return when the probe touches and lets go: a column for each moment of light contact, as if it were ``sigma`` m
    ahead.

    A surface of elements meets the probe a little early or late; a derivative at the moment itself does not know
    of it where the model does not touch yet, so the path to the deeper neighbour in time stands for it. ``points``
    (k, m, 3) and ``forces`` (k, 3) predicted at the poses ``probe`` (k, 3) m, ``share`` (k,) of the press's deepest.
    """
    columns, names = [], []
    for k in np.flatnonzero(share < settings.light):
        near = [j for j in (k - 1, k + 1) if 0 <= j < len(share) and recording[j] == recording[k]]
        deeper = max(near, key=lambda j: share[j], default=k)
        length = float(np.linalg.norm(probe[deeper] - probe[k]))
        if not (share[deeper] > share[k] + settings.deeper and length > settings.still):
            continue
        shift, push = np.zeros_like(points), np.zeros((len(points), 3))
        shift[k] = sigma / length * (points[deeper] - points[k])
        if forces is not None:
            push[k] = sigma / length * (forces[deeper] - forces[k])
        columns.append(rows.take(shift, push))
        names.append(f"touch[{k}]")
    return Nuisance(np.column_stack(columns) if columns else np.zeros((rows.n, 0)), tuple(names))
