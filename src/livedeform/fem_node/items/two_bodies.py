"""Two deformable bodies that touch: bonded, with friction, or frictionless, as an item that the solver sums.

A mortar method (Puso & Laursen 2004; with quadratic displacements and linear multipliers: Puso, Laursen & Solberg
2008). The surface with the smaller facets is the secondary one. Per vertex k of it, with its hat function phi_k, the
area A_k = int phi_k dA (scanned), and the point of the primary surface that lies opposite along the normal:

    g_k = 1/A_k int phi_k (x_secondary - x_primary) dA                      gap vector, m
    r = -sum_k A_k (p_k n_k + t_k) dg_k/dx,     K = sum_k A_k dg_k/dx^T D_k dg_k/dx

with p, t and D from `contact_law` at the gap n_k . g_k and the slip g_k(x) - g_k(x of the last moment). The integrals
are exact on flat facets: each facet is cut into its overlaps with the opposite ones, so that an even pressure goes
through an interface of meshes that do not match (patch test). Who lies opposite of whom, and the normals, are frozen
while Newton iterates, which leaves an energy and a symmetric tangent; the outer iteration looks again, so that slips
may be as large as ``reach``. A bonded interface keeps the pairs that it had.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from livedeform.common.compiled import njit
from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.types import Array
from livedeform.fem_node.contact import law as contact_law
from livedeform.fem_node.element import quadrature
from livedeform.fem_node.element.element import TRIANGLE_EDGES, Space, shape_derivatives, shape_values
from livedeform.fem_node.items.loads import facets_in
from livedeform.fem_node.items.protocol import Moment, PlainItem
from livedeform.fem_node.physics.record import Interface
from livedeform.fem_node.solve.assembly import Pattern, Positions, System, node_dofs

Indices = NDArray[np.int64]

PENALTY_FACTOR = 100.0  # penalty = factor x Young's modulus / facet size; multipliers take over what it leaves
SLIDING_FACTOR = 0.1  # tangential penalty where it may slide: a softer corner between sticking and sliding
GAP_TOLERANCE = 1e-6  # m; the outer iteration ends when no vertex is further from complementarity or from sticking
DRIFT_TOLERANCE = 1e-5  # m; how far points that press on each other may have slid apart since they were paired
ROUGH = 10.0  # friction coefficient that stands for an infinite one: corners that open then still find a balance
LIMIT_TOLERANCE = 0.01  # of the largest friction limit
FIRST_SHARE, LEAST_SHARE = 0.5, 0.05  # of a friction limit's way to its new value; and of any iterate's
MAX_OUTER = 50
LEAST_OVERLAP = 1e-3  # of a vertex's area: vertices that overhang by more than the rest do not touch
_QUARTERS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])  # a quadratic facet as four flat triangles
_TOUCH = 1e-6  # Young's moduli: multiplier of what touches at the start, so that the bodies hold each other


class Pairing(NamedTuple):
    """Who lies opposite of whom. ``gaps`` (m, n) maps node positions to gap vectors of the m vertices; ``area`` (m,) m2
    of each (0: nothing opposite); ``n`` (m, 3) unit normals of the primary surface, outward; found at displacements
    ``x``."""

    gaps: csr_array
    area: Array
    n: Array
    x: Array


@dataclass(frozen=True)
class InterfaceState:
    """The interface's state per vertex: multipliers Pa, normal (m,) and tangential (m, 3); friction ``limit`` (m,) Pa;
    ``x`` of the last moment, from which slip counts."""

    pairing: Pairing
    multiplier: Array
    multiplier_t: Array
    limit: Array
    x: Array


class Relaxation:
    """A fixed-point iteration's steps, shortened by Aitken's rule (Irons & Tuck 1969): it may alternate."""

    def __init__(self, first: float) -> None:
        self._share, self._last = first, np.zeros(0)

    def __call__(self, old: Array, new: Array) -> Array:
        """Return the next guess between ``old`` and what the iteration makes of it."""
        step = (new - old).ravel()
        if len(self._last):
            change = step - self._last
            share = -self._share * float(self._last @ change) / max(float(change @ change), 1e-300)
            self._share = min(max(share, LEAST_SHARE), 1.0)
        self._last = step
        return old + self._share * (new - old)


class _Laws(NamedTuple):
    normal: contact_law.Normal
    tangential: contact_law.Tangential | None


class TwoBodies(PlainItem):
    """Contact between the facets ``secondary`` and ``primary`` (rows of ``space.facets``) of two bodies in one space.

    ``friction``: mu (0: frictionless, inf: no slip while pressed); ``bonded``: nothing moves and nothing opens;
    ``penalty`` Pa/m; ``reach`` m: the largest slip that the matrix pattern has places for.
    """

    def __init__(
        self,
        space: Space,
        secondary: Indices,
        primary: Indices,
        *,
        penalty: float,
        touch: float,
        friction: float = 0.0,
        bonded: bool = False,
        reach: float,
    ) -> None:
        self.space, self.penalty, self.bonded, self.reach = space, penalty, bonded, reach
        self.friction = np.inf if bonded else min(friction, ROUGH)
        self._penalty_t = penalty * (1.0 if bonded else SLIDING_FACTOR)
        self._secondary, self._primary = _Surface.of(space, secondary), _Surface.of(space, primary)
        self.vertices, rows = np.unique(self._secondary.triangles, return_inverse=True)
        self._rows = rows.reshape(-1, 3)
        self._areas = _areas(space.nodes, self._secondary.triangles)
        self._full = np.bincount(self._rows.ravel(), np.repeat(self._areas / 3.0, 3))
        self._pattern: Pattern | None = None
        self._blocks: list[tuple[Indices, Array, Positions]] | None = None
        self.outer = 0
        self._relax_limits, self._relax_pairs = Relaxation(FIRST_SHARE), Relaxation(1.0)
        x = np.zeros(3 * space.n_nodes)
        pairing = self._pair(x)
        m = len(self.vertices)
        closed = (pairing.area > 0.0) & (np.einsum("mi,mi->m", pairing.n, self._gaps(pairing, x)) <= GAP_TOLERANCE)
        if not np.any(pairing.area > 0.0):
            raise InputError("the two surfaces do not face each other", remedy="enlarge the interface's region")
        stuck = np.where(closed & (self.friction > 0), np.inf, 0.0)  # it sticks until the pressure is known
        self.state = InterfaceState(pairing, np.where(closed, touch, 0.0), np.zeros((m, 3)), stuck, x)

    # -- the protocol of an item ------------------------------------------------------------------------------------

    def couplings(self) -> Sequence[Indices]:
        """Return for every vertex the nodes that it may ever couple: its own facets' and those of all facets in
        reach."""
        secondary, primary = self._secondary.facets, self._primary.facets
        nodes = np.unique(np.concatenate([secondary.ravel(), primary.ravel()]))
        at = self.space.nodes[nodes]
        needed = np.zeros((len(self.vertices), len(nodes)), bool)
        own = np.searchsorted(nodes, secondary)[self._secondary.parents]
        for corner in range(3):
            needed[self._rows[:, corner, None], own] = True
        centres, radius = _spheres(self.space.nodes, primary)
        around = np.linalg.norm(at[:, None] - self.space.nodes[self.vertices], axis=2)  # (nodes, m)
        farthest = np.where(needed.T, around, 0.0).max(axis=0)
        near = np.linalg.norm(centres[:, None] - self.space.nodes[self.vertices], axis=2)
        opposite = near < (radius[:, None] + farthest + self.reach)  # (primary facets, m)
        for facet, seen in zip(np.searchsorted(nodes, primary), opposite, strict=True):
            needed[np.ix_(seen, facet)] = True
        # rows of one length: those that need fewer nodes take the nearest others
        order = np.argsort(np.where(needed.T, -1.0, around), axis=0)[: needed.sum(axis=1).max()]
        return [node_dofs(nodes[order.T])]

    def attach(self, pattern: Pattern) -> None:
        self._pattern, self._blocks = pattern, None

    def prepare(self, moment: Moment) -> None:
        self.outer = 0
        self._relax_limits, self._relax_pairs = Relaxation(FIRST_SHARE), Relaxation(1.0)

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        pairing, laws = self.state.pairing, self._laws(x, self.state.pairing)
        traction = -laws.normal.pressure[:, None] * pairing.n
        energy = laws.normal.energy
        if laws.tangential is not None:
            traction, energy = traction - laws.tangential.traction, energy + laws.tangential.energy
        force = pairing.gaps.T @ (pairing.area[:, None] * traction)
        system.r[: 3 * self.space.n_nodes] += force.ravel()
        if tangent and self._pattern is not None:
            self._add_stiffness(laws, system)
        return float(pairing.area @ energy)

    def update(self, x: Array) -> bool:
        """Look again who lies opposite of whom, and let multipliers and limits take what the laws gave; False once all
        agree."""
        s = self.state
        pairing = s.pairing
        if not self.bonded:
            pairing = self._pair(self._relax_pairs(s.pairing.x, x[: 3 * self.space.n_nodes]))
        laws, tolerance = self._laws(x, pairing), GAP_TOLERANCE * self.penalty
        pressure = laws.normal.pressure
        again = float(np.abs(pressure - s.multiplier).max()) > tolerance or self._moved(x, pairing, pressure)
        limit, multiplier_t = s.limit, s.multiplier_t
        if laws.tangential is not None:
            multiplier_t = laws.tangential.traction
            off = np.linalg.norm(multiplier_t - s.multiplier_t, axis=1).max()
            again |= float(off) > GAP_TOLERANCE * self._penalty_t
            again |= not _same_limit(s.limit, self._limits(pressure))
            limit = self._limits(pressure)
            if np.isfinite(s.limit).all() and np.isfinite(limit).all():
                limit = self._relax_limits(s.limit, limit)
        if again:
            self.outer += 1
            if self.outer > MAX_OUTER:
                raise ConvergenceError(
                    f"two bodies in contact did not settle in {MAX_OUTER} iterations",
                    where="interface",
                    remedy="apply the load in smaller steps, or refine the meshes at the interface",
                )
            self._blocks = self._blocks if pairing is s.pairing else None
            self.state = replace(s, pairing=pairing, multiplier=pressure, multiplier_t=multiplier_t, limit=limit)
        return again

    def commit(self, x: Array) -> None:
        """Count slip from here on."""
        if self.bonded:
            return
        laws = self._laws(x, self.state.pairing)
        traction = self.state.multiplier_t if laws.tangential is None else laws.tangential.traction
        self.state = replace(self.state, multiplier_t=traction, x=x[: 3 * self.space.n_nodes].copy())

    def follow(self, other: TwoBodies) -> None:
        """Take pairs, multipliers and limits of an interface that has just been solved."""
        o = other.state
        self.state = replace(
            self.state, pairing=o.pairing, multiplier=o.multiplier, multiplier_t=o.multiplier_t, limit=o.limit
        )
        self._blocks = None

    def save(self) -> tuple[InterfaceState, int]:
        return self.state, self.outer

    def restore(self, state: tuple[InterfaceState, int]) -> None:
        if state[0].pairing is not self.state.pairing:
            self._blocks = None
        self.state, self.outer = state

    # -- what is asked of the interface -----------------------------------------------------------------------------

    def force(self, x: Array) -> Array:
        """Return force (3,) N of the primary body on the secondary one."""
        laws, pairing = self._laws(x, self.state.pairing), self.state.pairing
        traction = laws.normal.pressure[:, None] * pairing.n
        if laws.tangential is not None:
            traction = traction + laws.tangential.traction
        return pairing.area @ traction

    def gap(self, x: Array) -> Array:
        """Return normal gaps (m,) m of the `vertices`, negative: penetration; NaN where nothing is opposite."""
        pairing = self._pair(x[: 3 * self.space.n_nodes])
        gap = np.einsum("mi,mi->m", pairing.n, self._gaps(pairing, x))
        return np.where(pairing.area > 0.0, gap, np.nan)

    def pressures(self, x: Array) -> Array:
        """Return contact pressures (m,) Pa (per scanned area) of the `vertices`."""
        return self._laws(x, self.state.pairing).normal.pressure

    # -- inside -----------------------------------------------------------------------------------------------------

    def _gaps(self, pairing: Pairing, x: Array) -> Array:
        """Return gap vectors (m, 3) m."""
        return np.asarray(pairing.gaps @ (self.space.nodes + x[: 3 * self.space.n_nodes].reshape(-1, 3)))

    def _laws(self, x: Array, pairing: Pairing) -> _Laws:
        s = self.state
        g = self._gaps(pairing, x)
        opposite = pairing.area > 0.0
        slip = g - self._gaps(pairing, s.x)
        gap = np.einsum("mi,mi->m", pairing.n, slip if self.bonded else g)
        attached = opposite & self.bonded
        normal = contact_law.normal(np.where(opposite, gap, np.inf), s.multiplier, self.penalty, attached, np.inf)
        if self.friction == 0.0:
            return _Laws(normal, None)
        limit = np.where(opposite, s.limit, 0.0)
        return _Laws(normal, contact_law.tangential(slip, pairing.n, s.multiplier_t, limit, self._penalty_t))

    def _limits(self, pressure: Array) -> Array:
        if self.bonded:
            return np.full(len(pressure), np.inf)
        pushed = pressure > 0.0
        return np.where(pushed, self.friction * np.where(pushed, pressure, 1.0), 0.0)

    def _moved(self, x: Array, new: Pairing, pressure: Array) -> bool:
        """Return whether points that press on each other have slid apart, or normals have turned, since they were
        paired."""
        old = self.state.pairing
        if new is old:
            return False
        g = self._gaps(old, x)
        apart = np.linalg.norm(g - np.einsum("mi,mi->m", g, old.n)[:, None] * old.n, axis=1)
        turned = np.linalg.norm(new.n - old.n, axis=1) * pressure / self.penalty
        pressed = pressure > 0.0
        return bool(np.any(pressed & ((apart > DRIFT_TOLERANCE) | (turned > GAP_TOLERANCE))))

    def _add_stiffness(self, laws: _Laws, system: System) -> None:
        pairing = self.state.pairing
        D = laws.normal.stiffness[:, None, None] * (pairing.n[:, :, None] * pairing.n[:, None, :])
        if laws.tangential is not None:
            D = D + laws.tangential.stiffness
        if self._blocks is None:
            self._blocks = self._places(pairing)
        for row, (rows, weights, positions) in enumerate(self._blocks):
            if len(rows) == 0 or not D[row].any():
                continue
            block = np.kron(np.outer(weights, weights), pairing.area[row] * D[row])
            system.add_blocks(positions, block[None])

    def _places(self, pairing: Pairing) -> list[tuple[Indices, Array, Positions]]:
        """Return per vertex the nodes it couples, their weights (n,), and where the block goes in the pattern."""
        assert self._pattern is not None
        out = []
        for first, last in zip(pairing.gaps.indptr[:-1], pairing.gaps.indptr[1:], strict=True):
            nodes = pairing.gaps.indices[first:last].astype(np.int64)
            try:
                positions = self._pattern.positions(node_dofs(nodes[None]))
            except ValueError as error:
                raise ConvergenceError(
                    f"two bodies slid on each other by more than {1e3 * self.reach:.1f} mm",
                    where="interface",
                    remedy="set the interface's reach to the largest slip that is expected",
                ) from error
            out.append((nodes, pairing.gaps.data[first:last], positions))
        return out

    def _pair(self, x: Array) -> Pairing:
        """Cut the secondary facets where they are now into their overlaps with the primary ones, and integrate."""
        s = self.space
        x = x[: 3 * s.n_nodes].copy()
        y = s.nodes + x.reshape(-1, 3)
        one, other, quadratic = self._secondary, self._primary, s.quadratic
        normals = _normals(y, one.triangles)
        own, opposite = _candidates(y, one.triangles, other.triangles, normals)
        plane = _in_plane(y[one.triangles[own]], normals[own], y[other.triangles[opposite]])
        pair, triangles = _overlaps(plane)
        own, opposite = own[pair], opposite[pair]
        barycentric, weights = quadrature.triangle(4)
        points = np.einsum("qk,tki->tqi", barycentric, triangles)  # (t, q, 2) in the secondary triangle's coordinates
        w = np.abs(_cross(triangles))[:, None] * weights * self._areas[own, None]
        phi = np.concatenate([1.0 - points.sum(axis=2, keepdims=True), points], axis=2)
        N = _values(phi @ one.corners[own], quadratic)
        where = np.einsum("tqa,tai->tqi", N, y[one.facets[one.parents[own]]])
        L = _barycentric(plane[pair], points) @ other.corners[opposite]
        L = _across(where, y[other.facets[other.parents[opposite]]], normals[own], L, quadratic)
        return self._integrate(x, normals, own, opposite, w, phi, N, _values(L, quadratic))

    def _integrate(
        self, x: Array, normals: Array, own: Indices, opposite: Indices, w: Array, phi: Array, N: Array, M: Array
    ) -> Pairing:
        """Return mortar integrals; phi (t, q, 3), N and M (t, q, b) at the points of the overlaps, w (t, q) m2."""
        m, n = len(self.vertices), self.space.n_nodes
        y = self.space.nodes + x.reshape(-1, 3)
        area = np.bincount(self._rows[own].ravel(), np.einsum("tq,tqk->tk", w, phi).ravel(), minlength=m)
        touches = area > LEAST_OVERLAP * self._full
        scale = np.where(touches, 1.0 / np.where(touches, area, 1.0), 0.0)
        parts = []
        for surface, rows_of, values, sign in ((self._secondary, own, N, 1.0), (self._primary, opposite, M, -1.0)):
            facets = surface.facets[surface.parents[rows_of]]
            block = sign * np.einsum("tq,tqk,tqb->tkb", w, phi, values)
            rows = np.broadcast_to(self._rows[own][:, :, None], block.shape)
            columns = np.broadcast_to(facets[:, None, :], block.shape)
            keep = touches[rows]
            data = block[keep] * scale[rows[keep]]
            parts.append(coo_array((data, (rows[keep], columns[keep])), shape=(m, n)).tocsr())
        at_vertices = np.zeros((m, 3))
        np.add.at(at_vertices, self._rows, (_areas(y, self._secondary.triangles)[:, None] * normals)[:, None, :])
        at_vertices /= -np.maximum(np.linalg.norm(at_vertices, axis=1, keepdims=True), 1e-300)
        return Pairing((parts[0] + parts[1]).tocsr(), np.where(touches, area, 0.0), at_vertices, x)


class _Surface(NamedTuple):
    """``facets`` (k, b), cut at their mid-edge nodes into ``triangles`` (t, 3): which facet each is of, ``parents``
    (t,), and where its corners are in it, ``corners`` (t, 3, 3) barycentric."""

    facets: Indices
    triangles: Indices
    parents: Indices
    corners: Array

    @classmethod
    def of(cls, space: Space, rows: Indices) -> _Surface:
        facets = space.facets[rows]
        parts = _QUARTERS if space.quadratic else np.array([[0, 1, 2]])
        nodes = np.concatenate([np.eye(3), np.eye(3)[TRIANGLE_EDGES].mean(axis=1)])
        parents = np.repeat(np.arange(len(facets)), len(parts))
        return cls(facets, facets[:, parts].reshape(-1, 3), parents, np.tile(nodes[parts], (len(facets), 1, 1)))


def _normals(y: Array, triangles: Indices) -> Array:
    """Return unit normals (k, 3), outward."""
    corners = y[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out: Array = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return out


def _areas(y: Array, facets: Indices) -> Array:
    """Return areas (k,) m2 between the corners."""
    corners = y[facets[:, :3]]
    return np.asarray(
        0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    )


def _spheres(y: Array, facets: Indices) -> tuple[Array, Array]:
    """Return centres (k, 3) and radii (k,) of balls around the facets."""
    corners = y[facets]
    centres = corners[:, :3].mean(axis=1)
    return centres, np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)


def _candidates(y: Array, secondary: Indices, primary: Indices, normals: Array) -> tuple[Indices, Indices]:
    """Return pairs of facets (p,), (p,) whose balls meet and that look at each other."""
    a, r = _spheres(y, secondary)
    b, s = _spheres(y, primary)
    apart = np.linalg.norm(a[:, None] - b, axis=2)
    facing = normals @ _normals(y, primary).T < 0.0
    own, opposite = np.nonzero((apart < r[:, None] + s) & facing)
    return own, opposite


def _in_plane(corners: Array, normals: Array, points: Array) -> Array:
    """Return coordinates (p, k, 2) of ``points`` (p, k, 3), projected along the normals (p, 3), in the triangles
    ``corners`` (p, 3, 3): 0, 0 at the first corner; 1, 0 at the second; 0, 1 at the third."""
    frame = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], normals], axis=2)
    inside = np.linalg.solve(frame, (points - corners[:, :1]).transpose(0, 2, 1))
    return np.ascontiguousarray(inside[:, :2].transpose(0, 2, 1), np.float64)


def _cross(triangles: Array) -> Array:
    """Return twice the signed area (t,) of plane triangles (t, 3, 2)."""
    e, f = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]


def _barycentric(triangles: Array, points: Array) -> Array:
    """Return barycentric coordinates (t, q, 3) of plane points (t, q, 2) in triangles (t, 3, 2)."""
    edges = np.stack([triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]], axis=2)
    inner = np.linalg.solve(edges, (points - triangles[:, :1]).transpose(0, 2, 1)).transpose(0, 2, 1)
    return np.concatenate([1.0 - inner.sum(axis=2, keepdims=True), inner], axis=2)


def _values(L: Array, quadratic: bool) -> Array:
    """Return shape values (t, q, b) at barycentric coordinates (t, q, 3)."""
    return shape_values(L.reshape(-1, 3), quadratic=quadratic).reshape(*L.shape[:2], -1)


def _across(where: Array, nodes: Array, normals: Array, L: Array, quadratic: bool) -> Array:
    """Return the points of (curved) facets with ``nodes`` (t, b, 3) on the normals (t, 3) through ``where`` (t, q, 3):
    Newton's method from the flat facets' barycentric coordinates ``L`` (t, q, 3)."""
    if not quadratic:
        return L
    P = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    for _ in range(3):
        dN = shape_derivatives(L.reshape(-1, 3), quadratic=True).reshape(*L.shape[:2], -1, 3)
        tangents = np.einsum("tqbk,tbi->tqik", dN[..., 1:] - dN[..., :1], nodes)
        off = np.einsum("tij,tqj->tqi", P, where - np.einsum("tqb,tbi->tqi", _values(L, True), nodes))
        J = np.einsum("tij,tqjk->tqik", P, tangents)
        normal_equations = np.einsum("tqik,tqil->tqkl", J, J)
        step = np.linalg.solve(normal_equations, np.einsum("tqik,tqi->tqk", J, off)[..., None])[..., 0]
        L = L + np.concatenate([-step.sum(axis=2, keepdims=True), step], axis=2)
    return L


def _overlaps(plane: Array) -> tuple[Indices, Array]:
    """Return overlaps of triangles (p, 3, 2) with the triangle (0, 0), (1, 0), (0, 1), cut into triangles: which pair
    (t,), corners (t, 3, 2)."""
    pairs, triangles = np.empty(4 * len(plane), np.int64), np.empty((4 * len(plane), 3, 2))
    n = _clip(plane, pairs, triangles)
    return pairs[:n], triangles[:n]


@njit(cache=True)
def _clip(plane, pairs, triangles):
    """Clip by Sutherland & Hodgman (1974) at the three edges; then a fan."""
    n_out = 0
    polygon, next_ = np.empty((9, 2)), np.empty((9, 2))
    for p in range(len(plane)):
        n = 3
        polygon[:3] = plane[p]
        for edge in range(3):
            count = 0
            for i in range(n):
                a, b = polygon[i], polygon[(i + 1) % n]
                da = a[edge] if edge < 2 else 1.0 - a[0] - a[1]
                db = b[edge] if edge < 2 else 1.0 - b[0] - b[1]
                if da >= 0.0:
                    next_[count] = a
                    count += 1
                if (da > 0.0 and db < 0.0) or (da < 0.0 and db > 0.0):
                    next_[count] = a + da / (da - db) * (b - a)
                    count += 1
            n = count
            polygon[:n] = next_[:n]
        for i in range(1, n - 1):
            twice = (polygon[i, 0] - polygon[0, 0]) * (polygon[i + 1, 1] - polygon[0, 1])
            twice -= (polygon[i, 1] - polygon[0, 1]) * (polygon[i + 1, 0] - polygon[0, 0])
            if abs(twice) > 1e-12:
                pairs[n_out] = p
                triangles[n_out, 0], triangles[n_out, 1] = polygon[0], polygon[i]
                triangles[n_out, 2] = polygon[i + 1]
                n_out += 1
    return n_out


def _same_limit(old: Array, new: Array) -> bool:
    """Return whether the friction limits have settled (infinite ones: on the same vertices)."""
    if np.isinf(new).any() or np.isinf(old).any():
        return bool(np.array_equal(old, new))
    return bool(np.abs(new - old).max(initial=0.0) <= LIMIT_TOLERANCE * new.max(initial=0.0))


def make_interface(space: Space, interface: Interface, youngs_modulus: float) -> TwoBodies:
    """Return the item of an `Interface`: its region must hold facets of exactly two bodies of the mesh."""
    facets = facets_in(space, interface.region)
    body = _bodies(space)[space.facets[facets, 0]]
    found = np.unique(body)
    if len(found) != 2:
        raise InputError(
            f"the interface's region has surface of {len(found)} bodies",
            where="interface",
            remedy="choose a region that has the touching faces of two bodies that share no node",
        )
    sides = sorted((facets[body == b] for b in found), key=lambda side: _areas(space.nodes, space.facets[side]).mean())
    size = float(np.sqrt(np.median(_areas(space.nodes, space.facets[sides[0]]))))
    return TwoBodies(
        space,
        sides[0],
        sides[1],
        penalty=PENALTY_FACTOR * youngs_modulus / size,
        touch=_TOUCH * youngs_modulus,
        friction=interface.friction,
        bonded=interface.bonded,
        reach=interface.reach,
    )


def _bodies(space: Space) -> Indices:
    """Return which connected body (n,) each vertex of the mesh belongs to."""
    tets, n = space.mesh.tets, len(space.mesh.nodes)
    rows, columns = tets[:, [0, 1, 2]].ravel(), tets[:, [1, 2, 3]].ravel()
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1].astype(np.int64))
