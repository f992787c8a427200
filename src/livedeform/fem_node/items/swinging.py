"""Tell for how long a body swings: what of its past motion is left at a moment is for its damping to say.

A mode of the rate w (rad/s, of the relaxed body) fades as exp(-d t), with Rayleigh's damping and the loss of what
relaxes (`fem_node.items.viscoelastic`), at the rate v that it swings at,

    2 d = alpha + beta w^2 + w^2/v L(v),   v^2 = w^2 (1 + S(v)),   S + i L = h sum b_i i v tau_i / (1 + i v tau_i),

h = 3 K / (3 K + mu_0), mu_0 at once: the least share of shear in a stiffness, as a bar that is pulled has it. Where
damping is too strong for a swing, its slower part fades no slower than in beta + alpha/w^2 seconds. The slowest of all
modes is the one of the lowest rate, and that is the largest eigenvalue 1/w^2 of K^-1 M, found by subspace iteration
(Bathe 1996, section 11.6).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.items.dynamics import STEP_ERROR
from livedeform.fem_node.physics.record import Physics

ROUNDS = 4  # of iteration; each brings a mode of the double rate forward by a factor of four

Applied = Callable[[Array], Array]  # (n, k) -> (n, k)


def seconds_of_swing(physics: Physics, rate: float) -> float:
    """Return how long (s) a swing of ``rate`` rad/s lasts until no more is left of it than a step of time may be wrong
    by: 0 without inertia, inf without damping."""
    inertia, prony = physics.inertia, physics.prony
    if inertia is None:
        return 0.0
    alpha, beta = inertia.rayleigh_alpha, inertia.rayleigh_beta
    fades = 0.5 * (alpha + beta * rate**2)
    if prony is not None:
        K, mu = physics.material.bulk_modulus, physics.material.shear_modulus
        left = 1.0 - sum(prony.g)
        b = 3.0 * K / (3.0 * K + mu / left) * np.array(prony.g) / left
        swings = rate
        for _ in range(ROUNDS):
            turns = 1j * swings * np.array(prony.tau)
            more = complex(np.sum(b * turns / (1.0 + turns)))
            swings = rate * np.sqrt(1.0 + more.real)
        fades += 0.5 * rate**2 / swings * more.imag
    if fades <= 0.0:
        return np.inf
    return float(-np.log(STEP_ERROR) * max(1.0 / fades, beta + alpha / rate**2))


def lowest_rate(times_mass: Applied, times_compliance: Applied, nodes: Array, free: Array) -> float:
    """Return the rate (rad/s) of the slowest mode, from above: of a body with the ``nodes`` (n, 3) m, whose dofs
    ``free`` (3 n,) are not held, begun from all motions as if it were rigid."""
    arms = nodes - nodes.mean(axis=0)
    rigid = [np.broadcast_to(e, arms.shape) for e in np.eye(3)] + [np.cross(e, arms) for e in np.eye(3)]
    modes = np.column_stack([motion.ravel() for motion in rigid]) * free[:, None]
    squared = 0.0  # 1/w^2
    for _ in range(ROUNDS):
        modes = np.linalg.qr(modes)[0]
        inert = times_mass(modes)
        yielded = times_compliance(inert)
        ratios = np.linalg.lstsq(modes.T @ inert, inert.T @ yielded, rcond=None)[0]
        squared = float(np.linalg.eigvals(ratios).real.max())
        modes = yielded
    return 1.0 / np.sqrt(squared) if squared > 0.0 else 0.0
