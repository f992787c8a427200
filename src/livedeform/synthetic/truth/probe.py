"""The truth's rigid probe: a rounded box, cylinder or ball as a signed distance; contact by penalty and multiplier."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.synthetic.truth.friction import coulomb

MOST_STEPS, NEARLY = 200, 1e-7  # m


@dataclass(frozen=True)
class TruthProbe:
    """``kind`` box: ``size`` = length, width, height; cylinder: radius, height; sphere: radius. m.

    Frame: the middle of the contact face at the origin, +z out of the face, so that the body lies at z <= 0. ``radius``
    rounds box and cylinder.
    """

    kind: str
    size: tuple[float, ...]
    radius: float = 0.0

    def distance(self, p: Array) -> tuple[Array, Array, Array]:
        """Signed distance (n,), its gradient (n, 3) and Hessian (n, 3, 3) at ``p`` (n, 3)."""
        if self.kind == "sphere":
            v = p + np.array([0.0, 0.0, self.size[0]])
            return _radial(v, self.size[0])
        if self.kind == "cylinder":
            return self._cylinder(p)
        half = np.array([self.size[0] / 2, self.size[1] / 2, self.size[2] / 2])
        v = p + np.array([0.0, 0.0, half[2]])
        q = np.abs(v) - (half - self.radius)
        return _rounded(q, np.sign(v), self.radius)

    def comes_down_to(self, body: Array, R: Array, at: Array, gap: float = 0.0) -> float:
        """Return the height z m of its origin at which it first comes within ``gap`` m of the ``body`` (n, 3) m.

        It comes straight down at ``at`` (2,) m, turned by ``R`` (3, 3), by as much as it is clear: it passes nothing.
        -inf where it passes the body.
        """
        z = float(body[:, 2].max()) + gap + 2.0 * sum(self.size)
        lowest = float(body[:, 2].min()) - gap - 2.0 * sum(self.size)
        for _ in range(MOST_STEPS):
            clear = float(self.distance((body - np.array([at[0], at[1], z])) @ R)[0].min()) - gap
            if clear < NEARLY:
                return z
            z -= clear
            if z < lowest:
                return -np.inf
        return z

    def _cylinder(self, p: Array) -> tuple[Array, Array, Array]:
        """Find the distance in the half plane (rho, z), and turn it back to space."""
        radius, height = self.size
        rho = np.maximum(np.linalg.norm(p[:, :2], axis=1), 1e-12)
        z = p[:, 2] + height / 2
        flat = np.stack([rho, np.zeros_like(rho), z], axis=1)
        q = np.abs(flat) - (np.array([radius, 1.0, height / 2]) - self.radius)
        q[:, 1] = -1.0
        d, g2, h2 = _rounded(q, np.stack([np.ones_like(rho), np.ones_like(rho), np.sign(z)], 1), self.radius)
        e = np.stack([p[:, 0] / rho, p[:, 1] / rho, np.zeros_like(rho)], axis=1)
        k = np.broadcast_to([0.0, 0.0, 1.0], e.shape)
        t = np.cross(k, e)
        g = g2[:, :1] * e + g2[:, 2:] * k
        H = h2[:, 0, 0, None, None] * _outer(e, e) + h2[:, 2, 2, None, None] * _outer(k, k)
        H += h2[:, 0, 2, None, None] * (_outer(e, k) + _outer(k, e)) + (g2[:, 0] / rho)[:, None, None] * _outer(t, t)
        return d, g, H


def _outer(a: Array, b: Array) -> Array:
    return a[:, :, None] * b[:, None, :]


def _radial(v: Array, radius: float) -> tuple[Array, Array, Array]:
    length = np.maximum(np.linalg.norm(v, axis=1), 1e-12)
    n = v / length[:, None]
    return length - radius, n, (np.eye(3) - _outer(n, n)) / length[:, None, None]


def _rounded(q: Array, sign: Array, radius: float) -> tuple[Array, Array, Array]:
    """A box shrunk by ``radius`` and grown again: d = |max(q, 0)| + min(max q, 0) - radius."""
    positive = np.maximum(q, 0.0)
    length = np.linalg.norm(positive, axis=1)
    outside = length > 0.0
    safe = np.where(outside, length, 1.0)
    n = positive / safe[:, None]
    face = np.zeros_like(q)
    face[np.arange(len(q)), q.argmax(1)] = 1.0
    n = np.where(outside[:, None], n, face)
    active = np.where(q > 0.0, 1.0, 0.0)
    H = (np.eye(3) * active[:, None, :] - _outer(n, n)) / safe[:, None, None]
    H = np.where(outside[:, None, None], H, 0.0)
    return np.where(outside, length, q.max(1)) - radius, n * sign, H * _outer(sign, sign)


@dataclass
class TruthContact:
    """Hold what the contact remembers between steps, per face point.

    ``pressure`` (n,) and ``shear`` (n, 3) Pa are the multipliers, ``anchor`` (n, 3) m is where the point began to
    stick (an open or sliding point's is its last place), both in the probe's frame; ``glued`` (n,) is what adheres,
    ``sticks`` (n,) what friction holds.
    """

    pressure: Array
    shear: Array
    anchor: Array
    glued: NDArray[np.bool_]
    sticks: NDArray[np.bool_]

    @classmethod
    def none(cls, n: int) -> TruthContact:
        return cls(np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, bool), np.zeros(n, bool))

    def copy(self) -> TruthContact:
        return TruthContact(*(getattr(self, field.name).copy() for field in fields(self)))


@dataclass(frozen=True)
class Tractions:
    """Hold what acts on the body, per face point.

    ``traction`` (n, 3) Pa and its ``stiffness`` -dt/dx (n, 3, 3) Pa/m in the phantom's frame; ``pressure`` (n,) Pa,
    ``gap`` (n,) m, ``shear`` (n, 3) Pa in the probe's frame; ``sticks`` (n,): friction holds it.
    """

    traction: Array
    stiffness: Array
    pressure: Array
    gap: Array
    shear: Array
    sticks: NDArray[np.bool_]


OPENING = 2e-4  # m; a glued point that bears its strength and has opened this far lets go (Dugdale 1960)
SOFT = 4e-6  # m: over this gap contact sets in gradually, so that Newton does not flip points on and off


def tractions(
    shape: TruthProbe, T: Array, x: Array, state: TruthContact, penalty: float, friction: float, strength: float
) -> Tractions:
    """Return how the probe at T_phantom_probe acts on face points ``x`` (n, 3) m.

    ``penalty`` is in Pa/m, ``strength`` in Pa. Normal: pressure = max(lambda - penalty gap, -strength if glued else 0),
    free points' kink rounded. Sideways: see `truth.friction`.
    """
    R = T[:3, :3]
    local = (x - T[:3, 3]) @ R
    gap, n, H = shape.distance(local)
    trial = state.pressure - penalty * gap
    width = penalty * SOFT
    rounded = np.clip((trial + width) / (2.0 * width), 0.0, 1.0)
    free = np.where(trial > width, trial, rounded * rounded * width)
    held = np.maximum(trial, -strength)
    pressure = np.where(state.glued, held, free)
    stiffness = penalty * np.where(state.glued, trial > -strength, rounded)
    t = pressure[:, None] * n  # out of the probe, along the gradient of the gap
    K = stiffness[:, None, None] * _outer(n, n)
    K -= pressure[:, None, None] * H
    shear, sticks = np.zeros_like(local), np.zeros(len(local), bool)
    if friction > 0.0:
        trial_t = state.shear - penalty * (local - state.anchor)
        shear, sideways, sticks = coulomb(trial_t, n, H, pressure, stiffness, penalty, friction)
        K += sideways
        t = t + shear
    return Tractions(t @ R.T, R @ K @ R.T, pressure, gap, shear, sticks)
