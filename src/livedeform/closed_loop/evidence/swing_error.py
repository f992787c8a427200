"""Allow for what a model may get wrong of how a body swings after it was let go.

*Across* the plane in which the model lets it swing: it was held a little to one side, and nobody knows how. *Along* its
swing: in each period it may lose or gain a little, or get ahead. And what *rubs* takes as much off each swing, which
fades faster the smaller it is, where all that a linear material does fades at one rate.

A swing that is seen to its end is far above the noise, and of no weight in what the model is for. Without errors of
its own, what the model does not have of it settles what the model does have: the body's level and how it creeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import minimize

from livedeform.closed_loop.evidence.noise import Nuisance, Rows, join
from livedeform.closed_loop.settings import AllowanceSettings
from livedeform.common.types import Array

NOTHING = 1e-6  # of the swing's beginning: no course of its own; of the largest damping: at the bound


@dataclass(frozen=True)
class Swing:
    """A predicted swing that begins at ``start`` s with ``shape`` (m, 3) m complex, turns at ``rate`` rad/s and fades
    with ``decay`` 1/s: the real part of shape exp((i rate - decay) (t - start))."""

    start: float
    rate: float
    decay: float
    shape: np.ndarray

    @property
    def size(self) -> Array:
        """Return how far each marker swings in the beginning (m,) m."""
        return np.asarray(np.linalg.norm(self.shape, axis=1))

    @property
    def across(self) -> Array:
        """Return the two directions (2, 3) in which it swings least."""
        parts = np.concatenate([self.shape.real, self.shape.imag])
        return np.asarray(np.linalg.eigh(parts.T @ parts)[1].T[:2])


def begins_at(seconds: Array, motion: Array, begun: float) -> float:
    """Return the first of the ``seconds`` (k,) at which a body is on its way: where its ``motion`` (k, m) m is more
    than the share ``begun`` of the largest."""
    size = motion.max(axis=1)
    return float(seconds[np.argmax(size > begun * size.max())])


def swing_of(seconds: Array, points: Array, rate: float, settings: AllowanceSettings) -> Swing | None:
    """Return the swing in the predicted ``points`` (k, m, 3) m at ``seconds`` (k,), at 0.4 to 2.5 times the ``rate``
    rad/s, by least squares beside what creeps as a logarithm of time does; None where none is told from that, or by no
    more than ``settings.still`` m."""
    if rate <= 0.0 or len(points) < settings.swing_moments:
        return None
    moved = np.linalg.norm(points - points[0], axis=2)
    start = begins_at(seconds, moved, settings.begun)
    on = seconds >= start
    if on.sum() < settings.swing_moments or moved.max() < settings.still:
        return None
    t, y = seconds[on] - start, points[on].reshape(int(on.sum()), -1)
    rates, dampings = np.geomspace(*settings.swing_rates), np.geomspace(*settings.swing_dampings)
    first = min((np.log(x) for x in product(rate * rates, dampings)), key=lambda x: _swung(x, t, y)[0])
    bounds = np.log([rate * rates[[0, -1]], dampings[[0, -1]]])
    best = minimize(lambda x: _swung(x, t, y)[0], first, method="Nelder-Mead", bounds=bounds).x
    amplitudes = _swung(best, t, y)[1]
    shape = (amplitudes[0] - 1j * amplitudes[1]).reshape(points.shape[1:])
    omega, damping = (float(x) for x in np.exp(best))
    swing = Swing(start, omega, omega * damping, shape)
    least = max(settings.begun * moved.max(), settings.still)
    swings = damping < (1.0 - NOTHING) * dampings[-1] and swing.size.max() > least
    return swing if swings else None


def _swung(x: Array, t: Array, y: Array) -> tuple[float, Array]:
    """Return the sum of squares that a swing leaves of ``y`` (k, n) m at ``t`` s, with what creeps beside it, and the
    amplitudes (5, n) m of its cosine and sine first; ``x``: the logarithms of its rate in rad/s and damping ratio."""
    omega, damping = np.exp(x)
    turned, late = np.exp((1j - damping) * omega * t), np.log1p(omega * t)
    basis = np.column_stack([turned.real, turned.imag, np.ones_like(t), late, late**2])
    amplitudes = np.linalg.lstsq(basis, y, rcond=None)[0]
    return float(np.sum((y - basis @ amplitudes) ** 2)), amplitudes


def swing_error_columns(
    rows: Rows,
    seconds: Array,
    points: Array,
    recording: np.ndarray,
    rates: Sequence[float],
    share: float,
    along: float,
    settings: AllowanceSettings,
) -> Nuisance:
    """Return the columns of a swing's errors: across it for each of its periods, and, where an error ``along`` it is
    allowed, along it for each of them and one of what rubs.

    ``points`` (k, m, 3) m predicted at ``seconds`` (k,) in the recordings ``recording`` (k,), each of which was
    measured to swing at its one of the ``rates`` rad/s. Errors have a standard deviation of a ``share`` of the
    predicted swing's beginning across it, and of ``along`` as a share along it; what rubs takes a ``share`` off each
    swing. None is more than what is left of the swing. One that moves by less than
    ``settings.still`` m is none.
    """
    forces, parts = np.zeros((len(points), 3)), [Nuisance(np.zeros((rows.n, 0)), ())]
    has_data = np.isin(np.arange(len(points)), rows.moment)
    for r, rate in enumerate(rates):
        here = (recording == r) & has_data
        swing = swing_of(seconds[here], points[here], rate, settings)
        if swing is None:
            continue
        t = seconds[here] - swing.start
        motions = _across(swing, driven(t, rate, swing.decay, share))
        if along > 0.0:
            motions |= _along(swing, driven(t, swing.rate, swing.decay, along))
            motions["rubs"] = _moved(rubbing(t, swing.rate, swing.decay, share), swing.shape)
        columns = []
        for motion in motions.values():
            x = np.zeros(points.shape)
            x[here] = motion
            columns.append(rows.take(x, forces))
        parts.append(Nuisance(np.column_stack(columns), tuple(f"swing_{name}[{r}]" for name in motions)))
    return join(parts)


def _across(swing: Swing, courses: Sequence[np.ndarray]) -> dict[str, Array]:
    """Return the motions (k, m, 3) m across a swing, in two directions and two phases for each course."""
    shapes = [np.multiply.outer(swing.size, direction) for direction in swing.across]
    return {
        f"across_{n}{axis}{phase}": np.multiply.outer(part, shape)
        for n, course in enumerate(courses)
        for axis, shape in enumerate(shapes)
        for phase, part in enumerate((course.real, course.imag))
    }


def _along(swing: Swing, courses: Sequence[np.ndarray]) -> dict[str, Array]:
    """Return the motions (k, m, 3) m of a swing that is larger, or ahead, for each course."""
    return {
        f"along_{n}{phase}": _moved(course * turned, swing.shape)
        for n, course in enumerate(courses)
        for phase, turned in enumerate((1.0, 1j))
    }


def _moved(course: np.ndarray, shape: np.ndarray) -> Array:
    """Return the motion (k, m, 3) m of a complex course (k,) in a complex shape (m, 3) m."""
    return np.asarray(np.multiply.outer(course, shape).real)


def driven(t: Array, rate: float, decay: float, share: float) -> list[np.ndarray]:
    """Return a complex course (k,) at ``t`` s after the beginning for each period of the ``rate`` rad/s in which it is
    driven: it grows in the period before, and fades with the ``decay`` 1/s.

    Sizes are such that all of them together, each with a random amplitude of variance one, have at the periods' ends
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


def rubbing(t: Array, rate: float, decay: float, share: float) -> np.ndarray:
    """Return the complex course (k,) at ``t`` s of what is missing of a swing of the ``rate`` rad/s where each period
    takes a ``share`` of its beginning off, beside what fades with the ``decay`` 1/s: the sum of a geometric series, and
    no more than what is left (as of an oscillator with dry friction, whose amplitude falls by as much in each period).
    """
    turns, fade = np.maximum(rate * t, 0.0) / (2.0 * np.pi), 2.0 * np.pi * decay / rate
    lost = share * np.expm1(-fade * turns) / np.expm1(-fade)
    return np.asarray(np.minimum(lost, np.exp(-fade * turns)) * np.exp(1j * rate * t))
