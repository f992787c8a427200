"""A body that is let go by hand sways across the plane in which the model lets it swing: it was held a little to one
side, and the next swing may go another way than the last.

A model that is let go straight predicts nothing of it. Without an error of its own it is as loud as what swings: on the
measured beam, 0.8 mm beside swings of 10 mm bent the damping of the fit by a fifth.
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
RATES = (0.85, 0.95, 1.0, 1.05, 1.15)  # of the measured rate, tried with each
LEAST_MOMENTS = 12  # with which a swing is told from what creeps
FADED = 1e-3  # of the swing's beginning: what is left is of no weight


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


def swing_of(seconds: Array, points: Array, rate: float, still: float = 1e-5) -> Swing | None:
    """Return the swing of about the ``rate`` rad/s in the predicted ``points`` (k, m, 3) m at ``seconds`` (k,), by
    least squares beside what creeps as a logarithm of time does; None where none is told from that, or by no more than
    ``still`` m."""
    moved = np.linalg.norm(points - points[0], axis=2)
    start = begins_at(seconds, moved)
    on = seconds >= start
    if rate <= 0.0 or on.sum() < LEAST_MOMENTS or moved.max() < still:
        return None
    t, y = seconds[on] - start, points[on].reshape(int(on.sum()), -1)

    def fitted(x: Array) -> tuple[float, Array]:
        omega = rate * np.exp(x[0])
        turned, late = np.exp((1j - np.exp(x[1])) * omega * t), np.log1p(omega * t)
        basis = np.column_stack([turned.real, turned.imag, np.ones_like(t), late, late**2])
        amplitudes = np.linalg.lstsq(basis, y, rcond=None)[0]
        return float(np.sum((y - basis @ amplitudes) ** 2)), amplitudes

    tried = [np.log([r, d]) for r, d in product(RATES, DAMPING_RATIOS)]
    first = min(tried, key=lambda x: fitted(x)[0])
    bounds = np.log([(min(RATES), max(RATES)), DAMPED])
    best = minimize(lambda x: fitted(x)[0], first, method="Nelder-Mead", bounds=bounds).x
    amplitudes = fitted(best)[1]
    shape = (amplitudes[0] - 1j * amplitudes[1]).reshape(points.shape[1:])
    omega, damping = rate * float(np.exp(best[0])), float(np.exp(best[1]))
    swing = Swing(start, omega, omega * damping, shape)
    swings = damping < 0.99 * DAMPED[1] and swing.size.max() > max(BEGUN * moved.max(), still)
    return swing if swings else None


def sway_columns(
    rows: Rows, seconds: Array, points: Array, recording: np.ndarray, rates: Sequence[float], share: float
) -> Nuisance:
    """Return a swing across the predicted one that begins in each of its periods, and fades as that does: a column for
    each of two directions and two phases.

    ``points`` (k, m, 3) m predicted at ``seconds`` (k,) in the recordings ``recording`` (k,), each of which swings at
    about its one of the ``rates`` rad/s. A swing across is as large as a ``share`` of the predicted swing's beginning,
    and no larger than what is left of it.
    """
    forces, parts = np.zeros((len(points), 3)), [Nuisance(np.zeros((rows.n, 0)), ())]
    has_data = np.isin(np.arange(len(points)), rows.moment)
    for r, rate in enumerate(rates):
        here = (recording == r) & has_data
        swing = swing_of(seconds[here], points[here], rate)
        if swing is None:
            continue
        columns: list[Array] = []
        names: list[str] = []
        for number, course in enumerate(_courses(seconds[here] - swing.start, swing, share)):
            for axis, part in product(range(2), (course.real, course.imag)):
                x = np.zeros(points.shape)
                x[here] = part[:, None, None] * np.multiply.outer(swing.size, swing.across[axis])
                columns.append(rows.take(x, forces))
                names.append(f"sway[{r},{number},{axis},{len(names) % 2}]")
        parts.append(Nuisance(np.column_stack(columns), tuple(names)))
    return join(parts)


def _courses(t: Array, swing: Swing, share: float) -> list[Array]:
    """Return for each period of the swing a complex course (k,) at ``t`` s after its beginning that grows during the
    period before."""
    turns, fade = swing.rate * t / (2.0 * np.pi), 2.0 * np.pi * swing.decay / swing.rate
    out = []
    for n in range(int(np.ceil(turns.max()))):
        left = np.exp(-fade * n)
        if left < FADED:
            break
        grown = np.where(t >= 0.0, np.clip(turns - n + 1.0, 0.0, 1.0), 0.0)
        size = min(share, left) * grown * np.exp(-fade * np.maximum(turns - n, 0.0))
        out.append(size * np.exp(1j * swing.rate * t))
    return out
