"""Tell how uncertain a calibration is by what leaving out one picture pair changes: noise alone says too little.

A lens model, a print and a detector err alike in neighbouring corners, so that the corners of a picture are no
independent witnesses; the picture pairs are (nearly). The jackknife (Efron 1982) over pairs measures their scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import stdtrit

from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Pair
from livedeform.stereo_node.calibrate.bundle import Bundle, LensError, adjust

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
                    again=True,
                )
            )
        except LensError:
            out.append(final)
    return out


def with_scatter(final: Bundle, without: Sequence[Bundle]) -> Bundle:
    """Return the calibration with a covariance that is, in every direction, the larger one of the noise's and of the
    scatter between pictures; the latter widened by Student's factor for so few.

    What leaving out a pair changes is scaled so that noise alone would give the noise's covariance C on the mean (Bell
    & McCaffrey 2002): with M = C^-1/2 C_without C^-1/2 its own covariance is M - 1, and its share of the information
    1 - M^-1, so the change is multiplied by M^-1/2. Unscaled, a pair that alone tells of an edge of the lens counts
    several times.
    """
    root, whiten = _root(final.covariance)
    changes = []
    for b in without:
        if b is not final:
            M = whiten @ (b.covariance * (final.sigma_px / b.sigma_px) ** 2) @ whiten.T
            value, axes = np.linalg.eigh((M + M.T) / 2)
            share = axes / np.sqrt(np.maximum(value, 1.0)) @ axes.T
            changes.append(share @ whiten @ (b.values - final.values))
    n = len(changes)
    if n < 2:
        return final
    few = float(stdtrit(n - 1, 0.975) / NORMAL)
    ratio, turn = np.linalg.eigh(few**2 * np.transpose(changes) @ np.array(changes))
    half = root @ turn
    return replace(final, covariance=(half * np.maximum(ratio, 1.0)) @ half.T)


def _root(a: Array) -> tuple[Array, Array]:
    """Return R and its inverse, (p, p) each, with a = R R^T."""
    scale = np.sqrt(np.diag(a))
    value, axes = np.linalg.eigh(a / scale[:, None] / scale)
    value = np.maximum(value, 1e-14 * value.max())
    return scale[:, None] * axes * np.sqrt(value), (axes / np.sqrt(value)).T / scale
