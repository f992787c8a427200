"""A body that is let go by hand sways across the plane in which the model lets it swing: it was held a little to one
side, and nobody knows how.

A model that is let go straight predicts nothing of it. Without an error of its own a sway of a tenth of the swing is as
loud as all else that the model lacks, and the fit of what it does not lack goes with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import minimize

from livedeform.closed_loop.evidence.noise import Nuisance, Rows, join
from livedeform.common.types import Array

BEGUN = 0.01  # of the largest motion: the body is on its way
DAMPED = 1e-3, 0.7  # ratios between which the predicted swing's is looked for
DAMPING_RATIOS = np.geomspace(*DAMPED, 12)  # that are tried first
RATE_RATIOS = np.geomspace(0.4, 2.5, 28)  # of the predicted rate to the measured one, tried with each
LEAST_MOMENTS = 12  # with which a swing is told from what creeps
NOTHING = 1e-6  # of the swing's beginning: no course of its own


@dataclass(frozen=True)
class Swing:
    """A predicted swing that begins at ``start`` s with ``shape`` (m, 3) m complex, turns at ``rate`` rad/s and fades
    with ``decay`` 1/s: the real part of shape exp((i rate - decay) (t - start))."""

    start: float
    rate: float
    decay: float
    shape: Array

    @property
    def size(self) -> Array:
        """Return how far each marker swings in the beginning (m,) m."""
        return np.asarray(np.linalg.norm(self.shape, axis=1))

    @property
    def across(self) -> Array:
        """Return the two directions (2, 3) in which it swings least."""
        parts = np.concatenate([self.shape.real, self.shape.imag])
        return np.asarray(np.linalg.svd(parts, full_matrices=True)[2][1:])


def begins_at(seconds: Array, motion: Array) -> float:
    """Return the first of the ``seconds`` (k,) at which a body is on its way, by the ``motion`` (k, m) m."""
    size = motion.max(axis=1)
    return float(seconds[np.argmax(size > BEGUN * size.max())])


def swing_of(seconds: Array, points: Array, rate: float, still: float) -> Swing | None:
    """Return the swing in the predicted ``points`` (k, m, 3) m at ``seconds`` (k,), at 0.4 to 2.5 times the ``rate``
    rad/s, by least squares beside what creeps as a logarithm of time does; None where none is told from that, or by no
    more than ``still`` m."""
    if rate <= 0.0 or len(points) < LEAST_MOMENTS:
        return None
    moved = np.linalg.norm(points - points[0], axis=2)
    start = begins_at(seconds, moved)
    on = seconds >= start
    if on.sum() < LEAST_MOMENTS or moved.max() < still:
        return None
    t, y = seconds[on] - start, points[on].reshape(int(on.sum()), -1)

    def fitted(x: Array) -> tuple[float, Array]:
        omega = rate * np.exp(x[0])
        turned, late = np.exp((1j - np.exp(x[1])) * omega * t), np.log1p(omega * t)
        basis = np.column_stack([turned.real, turned.imag, np.ones_like(t), late, late**2])
        amplitudes = np.linalg.lstsq(basis, y, rcond=None)[0]
        return float(np.sum((y - basis @ amplitudes) ** 2)), amplitudes

    tried = [np.log(x) for x in product(RATE_RATIOS, DAMPING_RATIOS)]
    first = min(tried, key=lambda x: fitted(x)[0])
    bounds = np.log([(RATE_RATIOS[0], RATE_RATIOS[-1]), DAMPED])
    best = minimize(lambda x: fitted(x)[0], first, method="Nelder-Mead", bounds=bounds).x
    amplitudes = fitted(best)[1]
    shape = (amplitudes[0] - 1j * amplitudes[1]).reshape(points.shape[1:])
    omega, damping = rate * float(np.exp(best[0])), float(np.exp(best[1]))
    swing = Swing(start, omega, omega * damping, shape)
    swings = damping < 0.99 * DAMPED[1] and swing.size.max() > max(BEGUN * moved.max(), still)
    return swing if swings else None


def sway_columns(
    rows: Rows,
    seconds: Array,
    points: Array,
    recording: np.ndarray,
    rates: Sequence[float],
    share: float,
    still: float = 1e-5,
) -> Nuisance:
    """Return a sway across the predicted swing that is driven anew in each period, and fades as the swing does: a
    column for each of two directions and two phases.

    ``points`` (k, m, 3) m predicted at ``seconds`` (k,) in the recordings ``recording`` (k,), each of which was
    measured to swing at its one of the ``rates`` rad/s. The sway's standard deviation is a ``share`` of the predicted
    swing's beginning, and no more than what is left of the swing. One that moves by less than ``still`` m is none.
    """
    forces, parts = np.zeros((len(points), 3)), [Nuisance(np.zeros((rows.n, 0)), ())]
    has_data = np.isin(np.arange(len(points)), rows.moment)
    for r, rate in enumerate(rates):
        here = (recording == r) & has_data
        swing = swing_of(seconds[here], points[here], rate, still)
        if swing is None:
            continue
        size, across = swing.size, swing.across
        columns: list[Array] = []
        names: list[str] = []
        for number, driven in enumerate(_driven(seconds[here] - swing.start, rate, swing.decay, share)):
            for axis, part in product(range(2), (driven.real, driven.imag)):
                x = np.zeros(points.shape)
                x[here] = part[:, None, None] * np.multiply.outer(size, across[axis])
                columns.append(rows.take(x, forces))
                names.append(f"sway[{r},{number},{axis},{len(names) % 2}]")
        parts.append(Nuisance(np.column_stack(columns), tuple(names)))
    return join(parts)


def _driven(t: Array, rate: float, decay: float, share: float) -> list[Array]:
    """Return a complex motion (k,) at ``t`` s after the beginning for each period of the ``rate`` rad/s in which it is
    driven: it grows in the period before, and fades with the ``decay`` 1/s.

    Sizes are such that all motions together, each with a random amplitude of variance one, have at the periods' ends
    the standard deviation that is allowed: a ``share``, and no more than what is left.
    """
    turns, fade = rate * t / (2.0 * np.pi), 2.0 * np.pi * decay / rate
    out, before = [], 0.0
    for n in range(int(np.ceil(turns.max()))):
        allowed = min(share, np.exp(-fade * n))
        new = np.sqrt(max(allowed**2 - (np.exp(-fade) * before) ** 2, 0.0))
        before = allowed
        if new < NOTHING:
            continue
        grown = np.where(t >= 0.0, np.clip(turns - n + 1.0, 0.0, 1.0), 0.0)
        out.append(new * grown * np.exp(-fade * np.maximum(turns - n, 0.0) + 1j * rate * t))
    return out
