"""Friction of the body with its support, and how it differs from one body to a slightly changed one.

The difference is linear, on the side of each kink on which the leader is: what it has slipped is at its limit, and next
to it a changed body that has not moved yet would stick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.items.protocol import Moment, PlainItem
from livedeform.fem_node.solve.assembly import Feedback, Pattern, System, node_dofs

if TYPE_CHECKING:
    from livedeform.fem_node.items.supports import Behind, Face, Law

NOTHING = 1e-12  # m: what a limit lets stick by less is round-off
SETTLED = 1e-4  # of the largest limit, within which all stand


class FrictionSupport(PlainItem):
    """Held along the normal by stiff springs; along the surface by Coulomb friction with elastic sticking.

    At each quadrature point the traction is t = k_t (g - g_slip), limited to mu p; p is the pressure of the last outer
    iteration, so that each Newton solution has an energy (Tresca friction), and slip is committed with the step
    (Wriggers 2006, sec. 5.2 and 6.3). Its tangent is symmetric; that of a solution, where what slips along e follows
    the pressure k_n n.u, has mu k_n e n^T as well (`feedback`).
    """

    def __init__(self, space: Space, face: Face, law: Law, mu: float, behind: Behind) -> None:
        facets = space.facets[face.facets]
        self._values, self._weights, normals = space.facet_rule(2, facets)
        if face.normal is not None:
            normals = np.broadcast_to(face.normal, normals.shape)
        self._normals = np.repeat(normals, len(self._values), axis=0).reshape(len(facets), -1, 3)
        self._mu, self._law, self._behind, self._numbers = mu, law, behind, face.facets
        self._facets, self._dofs = facets, node_dofs(facets)
        self._limit = np.full(self._weights.shape, np.inf)  # mu p, Pa; it sticks until the pressure is known
        self._slip = np.zeros((*self._weights.shape, 3))
        self._slack = np.zeros(self._dofs.shape)

    def prepare(self, moment: Moment) -> None:
        """Take the stiffness (f, 1) Pa/m, along the normal and while it sticks, that the body behind has now. A body
        that rested without weight sticks again until the pressure is known: nothing else may hold it."""
        modulus = self._behind(self._numbers)[:, None]
        self._k_n, self._k_t = (np.broadcast_to(k, modulus.shape) for k in self._law(modulus))
        if self._mu > 0.0 and np.all(self._limit <= NOTHING * self._k_t):
            self._limit = np.full(self._weights.shape, np.inf)

    def set_unloaded(self, unloaded: Array | None) -> None:
        """Take where nothing has slipped: displacement (n, 3) m from the scanned shape, None: the scanned shape
        itself."""
        self._slack = np.zeros(self._dofs.shape) if unloaded is None else unloaded.ravel()[self._dofs]

    def attach(self, pattern: Pattern) -> None:
        self._positions = pattern.positions(self._dofs)

    def _gaps(self, x: Array) -> tuple[Array, Array, Array]:
        v = (x[self._dofs] - self._slack).reshape(len(self._facets), -1, 3)
        u = np.einsum("qa,kai->kqi", self._values, v)
        normal = np.einsum("kqi,kqi->kq", u, self._normals)
        tangential = u - normal[..., None] * self._normals - self._slip
        return normal, tangential, np.linalg.norm(tangential, axis=2)

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        normal, gap, length = self._gaps(x)
        trial = self._k_t * length
        slips = trial > self._limit
        limit = np.where(slips, self._limit, 0.0)
        secant = np.where(slips, limit / np.maximum(length, 1e-300), self._k_t)
        traction = (self._k_n * normal)[..., None] * self._normals + secant[..., None] * gap
        system.add_vectors(
            self._dofs, np.einsum("kq,qa,kqi->kai", self._weights, self._values, traction).reshape(len(self._dofs), -1)
        )
        if tangent:
            nn = self._normals[..., :, None] * self._normals[..., None, :]
            D = self._k_n[..., None, None] * nn + secant[..., None, None] * (np.eye(3) - nn)
            d = gap / np.maximum(length, 1e-300)[..., None]
            D -= np.where(slips, secant, 0.0)[..., None, None] * d[..., :, None] * d[..., None, :]
            n = self._dofs.shape[1]
            blocks = np.einsum("kq,qa,qb,kqij->kaibj", self._weights, self._values, self._values, D)
            system.add_blocks(self._positions, blocks.reshape(-1, n, n))
        sliding = limit * length - 0.5 * limit**2 / self._k_t
        energy = 0.5 * self._k_n * normal**2 + np.where(slips, sliding, 0.5 * self._k_t * length**2)
        return float(np.sum(self._weights * energy))

    def feedback(self, x: Array) -> Feedback | None:
        normal, gap, length = self._gaps(x)
        slips = (self._k_t * length > self._limit) & (normal > 0.0)  # as `evaluate` has it
        if self._mu == 0.0 or not slips.any():
            return None
        e = np.where(slips, self._mu * self._k_n, 0.0)[..., None] * gap / np.maximum(length, 1e-300)[..., None]
        D = e[..., :, None] * self._normals[..., None, :]
        blocks = np.einsum("kq,qa,qb,kqij->kaibj", self._weights, self._values, self._values, D)
        n = self._dofs.shape[1]
        return Feedback(self._dofs, blocks.reshape(-1, n, n))

    def update(self, x: Array) -> bool:
        normal, _, _ = self._gaps(x)
        limit = self._mu * np.maximum(
            self._k_n * normal, 0.0
        )  # outward motion is held back: pressed against the support
        scale = max(float(np.abs(limit).max()), 1e-12)
        changed = not np.allclose(limit, self._limit, rtol=0.0, atol=SETTLED * scale)
        self._limit = limit
        return changed

    def commit(self, x: Array) -> None:
        _, gap, length = self._gaps(x)
        beyond = np.maximum(length - self._limit / self._k_t, 0.0)
        self._slip = self._slip + (beyond / np.maximum(length, 1e-300))[..., None] * gap

    def follow(self, other: FrictionSupport) -> None:
        self._limit = other._limit

    def save(self) -> Any:
        return self._limit, self._slip

    def restore(self, state: Any) -> None:
        self._limit, self._slip = state

    def changes(self, x: Array, own: FrictionSupport, slip: Array, delta: Array) -> tuple[Array, Array]:
        """Return how the residual at its dofs (k, 3 b) N, and what it has slipped after the step (k, q, 3) m, change at
        the solution ``x`` (n_dof,), to first order, with the stiffness, friction and slack of a changed body's ``own``,
        what that has ``slip``ped beyond (k, q, 3) m and its move ``delta`` (n_dof,)."""
        normal, gap, length = self._gaps(x)
        slips, pressed = self._k_t * length > self._limit, np.maximum(normal, 0.0)
        nodes = (delta[self._dofs] - own._slack + self._slack).reshape(len(self._facets), -1, 3)
        moved = np.einsum("qa,kai->kqi", self._values, nodes)
        outward = np.einsum("kqi,kqi->kq", moved, self._normals)
        along = moved - outward[..., None] * self._normals - slip
        e = gap / np.maximum(length, 1e-300)[..., None]
        across = along - np.einsum("kqi,kqi->kq", along, e)[..., None] * e
        stiffer, grip = own._k_n - self._k_n, own._k_t - self._k_t
        limit = (own._mu * own._k_n - self._mu * self._k_n) * pressed
        limit += self._mu * self._k_n * np.where(normal > 0.0, outward, 0.0)
        held = np.where(slips, self._limit, 0.0)  # without what sticks whatever the pressure
        turned = (held / np.maximum(length, 1e-300))[..., None] * across
        traction = (stiffer * normal + self._k_n * outward)[..., None] * self._normals
        sticking = grip[..., None] * gap + self._k_t[..., None] * along
        traction += np.where(slips[..., None], limit[..., None] * e + turned, sticking)
        short = (limit / self._k_t - held * grip / self._k_t**2)[..., None] * e + turned / self._k_t[..., None]
        force = np.einsum("kq,qa,kqi->kai", self._weights, self._values, traction)
        return force.reshape(self._dofs.shape), slip + np.where(slips[..., None], along - short, 0.0)

    def add(self, force: Array, out: Array) -> None:
        """Add a ``force`` (k, 3 b) N at its dofs to ``out`` (n_dof,)."""
        np.add.at(out, self._dofs, force)


class _Slipped(NamedTuple):
    """Keep what the leader had slipped, and the ``change`` of it, each (k, q, 3) m."""

    slip: Array
    change: Array


class SlipAlong:
    """The friction ``own`` to a body along a direction from the ``leader``, whose slip changes from step to step."""

    def __init__(self, leader: FrictionSupport, own: FrictionSupport) -> None:
        self._leader, self._own = leader, own
        self._change = np.zeros_like(leader.save()[1])
        self._there: _Slipped | None = _Slipped(leader.save()[1], self._change)

    def load(self, x: Array) -> Array:
        """Return how the residual (n_dof,) differs while the body keeps at the leader's solution ``x``. Where the last
        steps led nowhere, and the leader went back, the slip goes back too."""
        slip = self._leader.save()[1]
        if self._there is None:
            self._there = _Slipped(slip, self._change)
        elif np.array_equal(slip, self._there.slip):
            self._change = self._there.change
        out = np.zeros_like(x)
        self._leader.add(self._changes(x, out)[0], out)
        return out

    def commit(self, x: Array, delta: Array, *, there: bool) -> None:
        """Let it slip with the step to ``x + delta`` (n_dof,); ``there``: a moment that the leader goes back to where
        what comes next leads nowhere."""
        self._change = self._changes(x, delta)[1]
        if there:
            self._there = None  # as the leader begins the next step

    def _changes(self, x: Array, delta: Array) -> tuple[Array, Array]:
        return self._leader.changes(x, self._own, self._change, delta)
