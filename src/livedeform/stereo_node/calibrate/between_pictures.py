"""Tell how uncertain a calibration is by what leaving out one picture pair changes: noise alone says too little.

A lens model, a print and a detector err alike in neighbouring corners, so that the corners of a picture are no
independent witnesses; the picture pairs are (nearly). The jackknife (Efron 1982) over pairs measures their scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import t as student

from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Pair
from livedeform.stereo_node.calibrate.bundle import Bundle, LensError, adjust
from livedeform.stereo_node.calibrate.lens_model import FEW

NORMAL = 1.96  # sigmas of a 95 % interval


def leave_one_out(points: Array, pairs: Sequence[Pair], final: Bundle) -> list[Bundle]:
    """Fit the same lens model to all pairs but one, for each; the whole fit where that fails."""
    out = []
    for i in range(len(pairs)):
        others = np.delete(np.arange(len(pairs)), i)
        try:
            out.append(
                adjust(
                    points,
                    [pairs[int(k)] for k in others],
                    final.with_boards(others),
                    final.model,
                    release=final.released,
                    n_iterations=FEW,
                )
            )
        except LensError:
            out.append(final)
    return out


def with_scatter(final: Bundle, without: Sequence[Bundle]) -> Bundle:
    """Return the calibration with a covariance that is, in every direction, the larger one of the noise's and of the
    scatter between pictures; the latter widened by Student's factor for so few."""
    values = np.array([b.values for b in without])
    n = len(values)
    d = values - values.mean(axis=0)
    few = float(student.ppf(0.975, n - 1) / NORMAL)
    return replace(final, covariance=larger(final.covariance, few**2 * (n - 1) / n * d.T @ d))


def larger(a: Array, b: Array) -> Array:
    """Return the covariance (p, p) whose variance along each axis of ``b`` relative to ``a`` is the larger of both."""
    scale = np.sqrt(np.diag(a))
    value, axes = np.linalg.eigh(a / scale[:, None] / scale)
    value = np.maximum(value, 1e-14 * value.max())
    root = scale[:, None] * axes * np.sqrt(value)  # a = root root^T
    whiten = (axes / np.sqrt(value)).T / scale
    ratio, turn = np.linalg.eigh(whiten @ b @ whiten.T)
    half = root @ turn
    out: Array = (half * np.maximum(ratio, 1.0)) @ half.T
    return out
