"""An error of each marker's measuring that a tracker states and repeats do not show: it lasts, and how long is told by
the markers themselves.

Pixels, or a dot's shape, make an error that is another one wherever the marker is looked at from elsewhere; a ball off
its centre, or a place that another device has measured, the same one for good. The first is averaged down by many
looks, the second is not, and what is common to all looks is then no evidence for anything.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livedeform.closed_loop.evidence.noise import ModelErrors, Steady
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.common.types import Array

FIELDS = 4  # of what neighbours share at a moment: a constant, and a slope along each axis
PIXEL = 20.0  # looks, by what `AllowanceSettings.look` is


def steady_of(
    observations: Sequence[Observation],
    points: Array,
    left: Array,
    errors: ModelErrors,
    motion: Array,
    blocks: np.ndarray,
    look: float,
) -> Steady:
    """Return what the tracker states and repeats do not show, of markers that are predicted at ``points`` (k, m, 3) m.

    A marker is looked at in the same way until it is ``look`` m rms from there; what varies from look to look may be
    another one in each of the ``blocks`` (k,).
    ``left`` (k, m, 3) m is measured minus predicted, NaN where not seen; what of it comes with ``motion`` (k, m) m may
    be the model's.
    """
    lasts = [(1.0 - o.noise.repeated) * o.noise.covariance for o in observations]
    looks, varies = looks_at(points, look), 1.0
    each = [np.broadcast_to(C, (o.n_moments, *C.shape)) for C, o in zip(lasts, observations, strict=True)]
    if any(C.any() for C in lasts):
        repeated = [o.covariances * o.noise.repeated for o in observations]
        size, noise = (np.diagonal(np.concatenate(C), axis1=2, axis2=3) for C in (each, repeated))
        relative = np.array([errors.of(i) for i in range(points.shape[1])])
        model = np.repeat(((relative * motion) ** 2)[..., None], 3, axis=2)
        alone = unshared_by_neighbours(left, points[0])
        alone = np.where(far_apart(points, PIXEL * look), alone, np.nan)
        varies = varying_share(alone, np.repeat(looks[..., None], 3, axis=2), size, noise, model)
    roots = [np.broadcast_to(_root(C), (o.n_moments, *C.shape)) for C, o in zip(lasts, observations, strict=True)]
    labels = looks * (int(blocks.max()) + 1) + blocks[:, None]
    return Steady(labels, np.concatenate(roots), varies)


def far_apart(points: Array, pixel: float) -> np.ndarray:
    """Tell along which axes (m, 3) a marker at ``points`` (k, m, 3) m moves by a ``pixel`` m: along others what varies
    from look to look may stay the same. All, where no marker moves as far."""
    moved: np.ndarray = np.ptp(points, axis=0) > pixel
    return moved if moved.any() else np.ones_like(moved)


def looks_at(points: Array, look: float) -> np.ndarray:
    """Number the looks (k, m) at markers at ``points`` (k, m, 3) m: one lasts while a marker is within ``look`` m rms
    of where it was first, and goes on when it comes back."""
    looks = np.full(points.shape[:2], -1)
    for k in range(len(points)):
        near = np.sqrt(np.mean((points - points[k]) ** 2, axis=2)) < look
        looks[near & (looks < 0) & (looks[k] < 0)] = k
    return looks


def unshared_by_neighbours(left: Array, places: Array) -> Array:
    """Return what is ``left`` (k, m, 3) m without what all markers have in common at a moment, a rigid motion and a
    stretch, as large as it would be with that; ``places`` (m, 3) m."""
    out, fields = np.full(left.shape, np.nan), np.column_stack([np.ones(len(places)), places - places.mean(axis=0)])
    for k, row in enumerate(left):
        seen = np.isfinite(row).all(axis=1)
        columns = fields[seen] if seen.sum() > 2 * FIELDS else fields[seen, :1]
        if seen.sum() > columns.shape[1]:
            alone = row[seen] - columns @ np.linalg.lstsq(columns, row[seen], rcond=None)[0]
            out[k, seen] = alone * np.sqrt(len(columns) / (len(columns) - columns.shape[1]))
    return out


def varying_share(left: Array, looks: np.ndarray, size: Array, noise: Array, model: Array) -> float:
    """Find the share of an error of variance ``size`` (k, m, 3) m2 that is another one in each of a marker's ``looks``
    (k, m, 3), by how much more than their ``noise`` (k, m, 3) m2 the looks' means of what is ``left`` (k, m, 3) m
    differ. One where no marker has several looks, which does not tell it.

    Moments of which much may be the ``model``'s error (k, m, 3) m2 count less; what there is of it counts as varying,
    and so does what chance (two sigma) may have taken off: that an error is the same for good has to show.
    """
    n, seen = looks[0].size, np.isfinite(left)
    which, group, counts = np.unique(
        (looks * n + np.arange(n).reshape(looks.shape[1:]))[seen], return_inverse=True, return_counts=True
    )

    def mean(x: Array) -> Array:
        return np.bincount(group, x[seen], minlength=len(which)) / counts

    error, of_size, of_noise, own = mean(left), mean(size), mean(noise) / counts, which % n
    weight = (of_size + of_noise + mean(model)) ** -2.0  # of a square whose variance that is
    total = np.bincount(own, weight, minlength=n)[own]
    apart = weight * (error - np.bincount(own, weight * error, minlength=n)[own] / total) ** 2
    free, several = weight * (1.0 - weight / total), np.bincount(own, minlength=n)[own] > 1
    if not several.any():
        return 1.0
    expected = np.sum((free * of_size)[several])
    found = np.sum((apart - free * of_noise)[several]) / expected
    spread = free * (max(found, 0.0) * of_size + of_noise)
    return float(np.clip(found + 2.0 * np.sqrt(2.0 * np.sum(spread[several] ** 2)) / expected, 0.0, 1.0))


def _root(covariances: Array) -> Array:
    """Return the symmetric square roots (m, 3, 3) m of ``covariances`` (m, 3, 3) m2."""
    values, vectors = np.linalg.eigh(covariances)
    return np.asarray(np.einsum("mik,mk,mjk->mij", vectors, np.sqrt(np.maximum(values, 0.0)), vectors))
