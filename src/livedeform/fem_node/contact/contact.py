"""A rigid probe against the body's surface, as an item that the solver sums.

Contact is enforced at the quadrature points of the surface's facets near the probe (segment to rigid body):

    r_a = - sum_q w_q N_a (p n + t),    K_ab = sum_q w_q N_a N_b (eps n n^T - p H + eps_t P),

with w_q the scanned area, n and H gradient and curvature of the probe's signed distance, p and t from `contact_law`.
A facet of a round body is flat, but what the probe touches is not: the points stand where the smooth surface through
the corners is (`common.experiment.smooth_surface.bulge`), up to h^2 / 6 R outside the facet. All of it is worked out in
the frame ``probe``, where the friction's anchors live, and turned into ``phantom`` last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from livedeform.common import frames
from livedeform.common.errors import ConvergenceError
from livedeform.common.experiment.smooth_surface import bulge
from livedeform.common.types import Array
from livedeform.fem_node.contact import law as contact_law
from livedeform.fem_node.contact import verify
from livedeform.fem_node.contact.approach import SHORTER, TURNED, Approach
from livedeform.fem_node.contact.inside import is_inside
from livedeform.fem_node.contact.kernels import any_of, may_act, near_box, points_of, sum_forces, sum_stiffness
from livedeform.fem_node.contact.probe_shapes import Shape, innermost
from livedeform.fem_node.element.element import Space, shape_derivatives, shape_values
from livedeform.fem_node.items.protocol import Moment, PlainItem
from livedeform.fem_node.physics.memory import rubbing
from livedeform.fem_node.physics.record import Probe
from livedeform.fem_node.solve.assembly import Pattern, Positions, System, node_dofs

Formulation = Literal["lagrange", "penalty", "prescribed"]

DENSE = 6  # subdivisions of a facet that is looked at between its contact points
BETWEEN = 0.5  # of the distance between contact points: how deep the probe may stand in a facet between them
SUBDIVISIONS = 3  # 9 contact points per facet: the probe's edges are far smaller than a facet
PENALTY_FACTOR = 300.0  # penalty = factor x Young's modulus / facet size: it leaves some 0.01 mm to the multipliers
PURE_PENALTY_FACTOR = 1000.0  # without multipliers the penalty alone must hold the surface back
CURVATURE_LIMIT = 5.0  # Young's moduli; of higher (not yet equilibrated) pressures the curvature is left out
STIFFENING = 50.0  # of the penalty, while followers respond to a solution (`stiffen`)
GAP_TOLERANCE = 1e-5  # m; the outer iteration ends when no point is further from complementarity
ROUGH = 2.0  # of the gap tolerance, on the way to a moment: within the bound of penetrations
WARM_STARTED = 0.2  # of the gap tolerance, where multipliers were predicted: near, but not all got nearer
EXACT = 0.1  # of it where two ways must end alike: along the surface a gap's error is seen up to 25 times larger
LIMIT_TOLERANCE = 0.01  # of the largest friction limit, times the outer iteration: how far limits may still move
MARGIN = 1.5  # by which a facet may have been stretched: its points are no further from its nodes
RELAXED_AFTER = 4  # outer iterations: from then on limits go half of the way, so that they do not alternate
MAX_OUTER = 40
PENETRATION_BOUND = 2e-5  # m, the stated bound: worse than this is a ConvergenceError
ADHESION_OPENING = 2e-4  # m; the gap at which a point that has reached its strength has let go
QUARTERS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])  # a quadratic facet as four flat triangles


@dataclass(frozen=True)
class ContactLaw:
    """``formulation``; ``friction`` mu (0 frictionless, inf sticking); ``adhesion`` Pa; ``penalty`` Pa/m; ``opening`` m
    over which adhesion lets go; ``curvature_limit`` Pa: the highest pressure with curvature in the tangent."""

    formulation: Formulation
    friction: float
    adhesion: float
    penalty: float
    opening: float = ADHESION_OPENING
    curvature_limit: float = np.inf
    modulus: float = 0.0

    @property
    def strength(self) -> float:
        """Tension that an attached point bears: all of it where the surface is prescribed."""
        return np.inf if self.formulation == "prescribed" else self.adhesion

    @property
    def multiplies(self) -> bool:
        """Return whether multipliers take over from the penalty."""
        return self.formulation != "penalty"

    @property
    def sticks(self) -> float:
        """Coefficient of friction in force."""
        return np.inf if self.formulation == "prescribed" else self.friction


@dataclass(frozen=True)
class ContactState:
    """The contact's state per quadrature point (n,): multipliers Pa, friction ``limit`` Pa, ``anchor`` m and tangential
    ``multiplier_t`` Pa (n, 3) in the frame ``probe``, whether it ``touches`` and is ``attached``; ``x``, ``T`` of the
    committed moment, and the last pose ``came`` without contact (None: none yet)."""

    multiplier: Array
    multiplier_t: Array
    limit: Array
    anchor: Array
    touches: NDArray[np.bool_]
    attached: NDArray[np.bool_]
    x: Array
    T: Array | None
    came: Array | None = None


class _Points(NamedTuple):
    """The quadrature points near the probe: facets, rows in the state's arrays, y, and what the laws say."""

    facets: NDArray[np.int64]
    rows: NDArray[np.int64]
    y: Array
    gap: Array
    n: Array
    H: Array
    normal: contact_law.Normal
    tangential: contact_law.Tangential | None

    def loaded(self, q: int) -> _Points:
        """Those of the facets (of ``q`` points) where a point without friction bears or resists something."""
        bears = (self.normal.pressure != 0.0) | (self.normal.stiffness != 0.0)
        facets = bears.reshape(-1, q).any(axis=1)
        i = np.repeat(facets, q)
        normal = contact_law.Normal(*(field[i] for field in self.normal))
        return _Points(
            self.facets[facets], self.rows[i], self.y[i], self.gap[i], self.n[i], self.H[i], normal, self.tangential
        )


class Local(NamedTuple):
    """The contact's part at ``facets`` (m,): residual ``vectors`` (m, 3 b) N, ``blocks`` (m, 3 b, 3 b) N/m."""

    facets: NDArray[np.int64]
    vectors: Array
    blocks: Array | None
    energy: float

    def times(self, step: Array) -> Array:
        """The change of the residual (m, 3 b) as the facets' nodes move by ``step`` (m, 3 b) m."""
        if self.blocks is None:
            raise ValueError("the contact was worked out without its tangent")
        return np.asarray(np.einsum("mij,mj->mi", self.blocks, step))


class ProbeContact(PlainItem):
    """Contact between a rigid ``shape`` and the surface of ``space``; pose None or a moment without one: no contact.
    ``drags``: whether it drags the surface along, as `fem_node.physics.memory` says, so that its path matters."""

    def __init__(self, space: Space, shape: Shape, law: ContactLaw, *, drags: bool) -> None:
        self.space, self.shape, self.law, self.drags = space, shape, law, drags
        _, area, _ = space.facet_rule(1)
        barycentric = _grid_rule(SUBDIVISIONS)
        self.values = shape_values(barycentric, quadratic=space.quadratic)
        weights = np.repeat(area / len(barycentric), len(barycentric), axis=1)
        self.weights = weights  # (k, q)
        self.dofs = node_dofs(space.facets)
        self.positions: Positions | None = None
        self._surface, corners = np.unique(space.facets, return_inverse=True)
        self._corners, self._at_rest = corners.reshape(space.facets.shape), space.nodes[self._surface]
        k, q = weights.shape
        self.X = space.nodes[space.facets]  # (k, b, 3)
        mesh = space.mesh
        self.bulge = bulge(mesh.nodes[mesh.boundary_triangles], mesh.corner_normals, barycentric)
        self.reach = MARGIN * (_furthest_point(self.X, self.values) + float(np.abs(self.bulge).max()))
        n = k * q
        self.state = ContactState(
            np.zeros(n),
            np.zeros((n, 3)),
            np.zeros(n),
            np.zeros((n, 3)),
            np.zeros(n, bool),
            np.zeros(n, bool),
            np.zeros(3 * space.n_nodes),
            None,
        )
        self.facet_size = float(np.sqrt(2.0 * np.median(weights.sum(axis=1))))  # legs of a right-angled one
        self.approach = Approach(self)
        self.immovable = np.zeros(0, np.int64)  # facets, as `hold` says
        self.T: Array | None = None
        self.stiffening = 1.0
        self.outer = 0
        self.gap_tolerance = GAP_TOLERANCE
        self.exactness = 1.0  # of it
        self._known_normals: tuple[Array, NDArray[np.int64], Array] | None = None  # of which anchors, at which points
        self.approaches = False  # anew where the probe jumps or slides, as only a body without memory may

    # -- the protocol of an item ------------------------------------------------------------------------------------

    def attach(self, pattern: Pattern) -> None:
        """Finds the facets' places; their nodes are coupled by the elements behind them."""
        self.positions = pattern.positions(self.dofs)

    def prepare(self, moment: Moment) -> None:
        """Puts the probe at the moment's pose, and a free point's anchor where the probe would meet it on the way."""
        self.T, self.outer, self.stiffening = moment.pose, 0, 1.0
        if self.T is not None and self.law.sticks > 0:
            self.state = replace(self.state, anchor=self._anchors_on_the_way(self.T))

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        """Adds contact forces and stiffness; returns the contact's potential energy, J."""
        part = self.local(x, tangent=tangent and self.positions is not None, safe=system.safe)
        if part is None:
            return 0.0
        system.add_vectors(self.dofs[part.facets], part.vectors)
        if part.blocks is not None and self.positions is not None:
            system.add_blocks(self.positions[part.facets], part.blocks)
        return part.energy

    def local(self, x: Array, *, tangent: bool, safe: bool = False) -> Local | None:
        """Residual and tangent of the facets that the probe pushes or holds (without curvature if ``safe``), and the
        energy; None if there are none."""
        points = self._acting(x)
        if points is None:
            return None
        energy = float(self.weights.ravel()[points.rows] @ points.normal.energy)
        if points.tangential is None:
            points = points.loaded(self.weights.shape[1])
            if len(points.facets) == 0:
                return None
        else:
            energy += float(self.weights.ravel()[points.rows] @ points.tangential.energy)
        return Local(points.facets, self._forces(points), self._stiffness(points, safe) if tangent else None, energy)

    def tangent_changes(self, x: Array) -> bool:
        """Return whether points are pushed that did not touch at the committed moment, or the other way round."""
        points = self._points(x)
        pushed = np.zeros(len(self.state.touches), bool)
        if points is not None:
            pushed[points.rows] = points.normal.pressure > 0.0
        return self.outer == 0 and not np.array_equal(pushed, self.state.touches)

    def update(self, x: Array) -> bool:
        """Settle the contact as `settle`; once nothing moves, what is stretched too far lets go, until nothing does."""
        return self.settle(x) or self.let_go(x)

    def let_go(self, x: Array) -> bool:
        """Let go of the attached points that have opened too far at ``x``; return whether there are any. Asked where
        nothing else moves any more, as it cannot be undone: on the way there a point may be open that ends closed."""
        state, law = self.state, self.law
        points = self._acting(x) if state.attached.any() else None
        if points is None:
            return False
        i = points.rows
        gone = contact_law.has_let_go(points.gap, points.normal.pressure, state.attached[i], law.strength, law.opening)
        if not gone.any():
            return False
        self.state = replace(state, attached=_put(state.attached, i[gone], np.zeros(int(gone.sum()), bool)))
        self.outer = 0
        return True

    def settle(self, x: Array) -> bool:
        """Multipliers and friction limits take the values that the laws gave; False once they agree (nothing moves)."""
        points = self._acting(x)
        if points is None:
            return False
        self.outer += 1
        state, law, i = self.state, self.law, points.rows
        pressure = points.normal.pressure
        tolerance = self.exactness * self.gap_tolerance * law.penalty
        again = law.multiplies and float(np.abs(pressure - state.multiplier[i]).max()) > tolerance
        changes: dict[str, Any] = {}
        if law.multiplies:
            changes["multiplier"] = _put(state.multiplier, i, pressure)
        if law.formulation == "prescribed" and self.outer <= MAX_OUTER // 4:
            changes["attached"] = _put(state.attached, i, pressure > 0.0)
            again |= not np.array_equal(changes["attached"], state.attached)
        if points.tangential is not None:
            t, limit = points.tangential.traction, _limit(law.sticks, pressure)
            again |= not _same_limit(state.limit[i], limit, self._limit_tolerance)
            if self.outer > RELAXED_AFTER and np.isfinite(law.sticks):
                limit = 0.5 * (limit + state.limit[i])
            changes["limit"] = _put(state.limit, i, limit)
            if law.multiplies:
                slipped = float(np.linalg.norm(t - state.multiplier_t[i], axis=1).max())
                again |= slipped > tolerance
                changes["multiplier_t"] = _put(state.multiplier_t, i, t)
        if again and self.outer >= MAX_OUTER:
            self._refuse_penetration(-float(points.gap.min()))
            return False
        if again:
            self.state = replace(state, **changes)
        return again

    def commit(self, x: Array) -> None:
        """The points that touch keep their anchor if they stick, and drag it along if they slide."""
        state, points = self.state, self._points(x)
        self.exactness = 1.0
        n = len(state.multiplier)
        touches, attached, anchor = np.zeros(n, bool), np.zeros(n, bool), state.anchor
        limit, multiplier_t = np.zeros(n), np.zeros((n, 3))
        loaded = np.zeros(n, bool)
        if points is not None:
            i, pressure = points.rows, points.normal.pressure
            loaded[i] = pressure != 0.0
            touches[i] = pressure > 0.0
            if self.law.strength > 0:
                attached[i] = touches[i] | (state.attached[i] & (pressure < 0.0))
            if points.tangential is not None:
                t = points.tangential.traction
                slides = np.linalg.norm(t, axis=1) >= (1.0 - 1e-9) * state.limit[i]
                # a penalty's friction is what its spring bears, which stays stretched by it
                stretched = 0.0 if self.law.multiplies else t[slides] / self.law.penalty
                anchor = _put(anchor, i[slides], points.y[slides] + stretched)
                limit[i], multiplier_t[i] = state.limit[i], np.where(slides[:, None], t, state.multiplier_t[i])
        self.state = ContactState(
            np.where(loaded, state.multiplier, 0.0),
            multiplier_t if self.law.multiplies else np.zeros((n, 3)),
            limit,
            anchor,
            touches,
            attached,
            self._u(x).copy(),
            self.T,
            self._came(touches),
        )

    def hold(self, dofs: NDArray[np.int64]) -> None:
        """Note which of the surface cannot move, since all of its ``dofs`` are held."""
        self.immovable = np.flatnonzero(np.isin(self.dofs, dofs).all(axis=1))

    def ways(self, x: Array, start: Moment, moment: Moment) -> Sequence[Sequence[Moment]]:
        """Straight from where the probe was, or from outside along its axis; only straight where it rubs or sticks."""
        stays = self.drags and bool((self.state.touches | self.state.attached).any())
        return self.approach.ways(x, start, moment, self.state.came, anew=self.approaches, stays=stays)

    def furthest(self, x: Array, start: Moment, moment: Moment, done: float) -> float:
        """Return the part (0..1) of the way to ``moment`` that may be gone to in one step after ``done``: as far as the
        probe pushes the surface out by the side where it came in."""
        return self.approach.furthest(x, start, moment, done)

    def stride(self) -> float:
        """Return the part of these steps in which a jump is to be walked: a half under edges that are sharp for the
        elements."""
        return SHORTER if self.approach.sharp else 1.0

    def near(self, x: Array, moment: Moment) -> bool:
        """Return whether the probe is not deep in the surface at ``x``, and has not slid far since it came."""
        if moment.pose is None:
            return True
        slid = self.approaches and self.approach.slid(self.state.came, moment.pose)
        return not slid and self.approach.admissible(x, moment.pose, moment.pose)

    def is_step(self, x: Array, start: Moment, moment: Moment) -> bool:
        """Return whether the probe may go from one moment to the other at once, from the solution ``x``."""
        slid = self.approaches and self.approach.slid(self.state.came, moment.pose)
        return not slid and self.approach.is_step(x, start, moment)

    def passed(self, x: Array) -> None:
        """Drag along what rubs or sticks on the way, or note from where the probe comes."""
        if self.drags:
            self.commit(x)
            return
        points = self._points(x)
        touches = np.zeros(0, bool) if points is None else points.normal.pressure > 0.0
        self.state = replace(self.state, came=self._came(touches))

    def hurry(self, *, on_the_way: bool) -> None:
        """Solve a contact without friction roughly on the way; where that ends, multipliers are known well already."""
        if self.drags:
            return
        if on_the_way:
            self.exactness = ROUGH
        elif self.exactness == ROUGH or self.approaches:
            self.exactness = self._warm

    def reported(self, x: Array) -> Array:
        """Return the probe's force (3,) N."""
        return self.wrench(x)[0] if self.T is not None else np.zeros(3)

    def reported_within(self, x: Array) -> float:
        """Return what twice the gaps' tolerance is worth, by the contact's stiffness.

        That of a frictionless contact of area A is 2 E* sqrt(A / pi), whatever the probe's shape (Pharr, Oliver &
        Brotzen 1992); here E* is an incompressible body's.
        """
        points = self._points(x)
        if points is None:
            return 0.0
        area = float(self.weights.ravel()[points.rows][points.normal.pressure > 0.0].sum())
        stiffness = 2.0 * np.sqrt(area / np.pi) * self.law.modulus / (1.0 - 0.5**2)
        return float(2.0 * self.gap_tolerance * stiffness)

    def flaw(self, x: Array, tolerance: float = PENETRATION_BOUND) -> str:
        """Return what is wrong with the contact at the solution ``x``, whose gaps are good to ``tolerance`` m
        (`fem_node.contact.verify`); "" if nothing is."""
        if self.T is None:
            return ""
        points = self._points(x)
        if points is not None:
            touched = verify.Touched(
                points.gap,
                points.normal.pressure,
                self.weights.ravel()[points.rows],
                self.state.attached[points.rows],
                self._facing(x, points),
                self._deepest_between(x, points),
            )
            found = verify.flaw(
                touched,
                tolerance=max(tolerance, self.exactness * self.gap_tolerance),
                compliance=0.0 if self.law.multiplies else 1.0 / self.law.penalty,
                between=BETWEEN * self.facet_size / SUBDIVISIONS,
                pulls=self.law.strength,
            )
            if found:
                return found
        return "the probe is inside the body" if self.swallowed(x, self.T) else ""

    def turned(self, before: Array, T: Array | None, x: Array) -> float:
        """Return the share of the contact force at the solution ``x`` by which surface is pushed elsewhere than where
        the probe came in, if it came at once to the surface as it was at the displacements ``before``: straight from
        the pose ``T`` (4, 4), or along its axis from outside."""
        points = self._points(x)
        if points is None or not (points.normal.pressure > 0.0).any():
            return 0.0
        pushed = points.normal.pressure > 0.0
        rows, n = points.rows[pushed], points.n[pushed]
        force = self.weights.ravel()[rows] * points.normal.pressure[pushed]
        ways = [self.approach.outside(before, self.pose), *([] if T is None else [T])]
        came = [self.shape.distance(frames.apply(frames.inverse(way), self._at(rows, before))).gradient for way in ways]
        shares = [force[np.einsum("ni,ni->n", g, n) < TURNED].sum() / force.sum() for g in came]
        return float(min(shares))

    def stiffen(self, x: Array) -> None:
        """Trades the multipliers at the solution ``x`` for much stiffer springs with the same tractions there: a linear
        response about ``x`` then keeps to the constraints without any outer iteration."""
        points = self._points(x) if self.law.multiplies else None
        if points is None:
            return
        self.stiffening, penalty = STIFFENING, STIFFENING * self.law.penalty
        i, pressure = points.rows, points.normal.pressure
        multiplier = np.where(pressure != 0.0, pressure + penalty * points.gap, 0.0)
        self.state = replace(self.state, multiplier=_put(self.state.multiplier, i, multiplier))
        if points.tangential is not None:
            change = (self.stiffening - 1.0) * self.law.penalty * (points.y - self.state.anchor[i])
            self.state = replace(
                self.state, multiplier_t=_put(self.state.multiplier_t, i, self.state.multiplier_t[i] + change)
            )

    def warm_start(self, multiplier: Array | None) -> None:
        """Start the next moment from these multipliers (n,) Pa, not from the last moment's (None: from those again);
        its solution does not depend on them."""
        self.exactness = 1.0 if multiplier is None else self._warm
        if multiplier is not None:
            self.state = replace(self.state, multiplier=multiplier)

    def begin_like(self, other: ContactState) -> None:
        """The next solution starts from another one's multipliers and limits; what was before stays as it is."""
        self.state = replace(
            self.state, multiplier=other.multiplier, multiplier_t=other.multiplier_t, limit=other.limit
        )

    def moved(self, part: Local, T: Array, x: Array) -> Array:
        """Return what a small move of the probe to ``T`` (4, 4) adds to the residual (n_dof,) at ``x``, to first order:
        the surface moves the other way, and the tractions ``part`` turn with the probe."""
        out = np.zeros_like(x)
        M = T @ frames.inverse(self.pose) - np.eye(4)
        dofs = self.dofs[part.facets]
        places = self.X[part.facets] + x[dofs].reshape(len(dofs), -1, 3)
        step = (places @ M[:3, :3].T + M[:3, 3]).reshape(len(dofs), -1)
        turned = (part.vectors.reshape(places.shape) @ M[:3, :3].T).reshape(len(dofs), -1)
        np.add.at(out, dofs, turned - part.times(step))
        return out

    def follow(self, other: ProbeContact) -> None:
        """Multipliers, limits and what is attached from a contact that has just been solved; anchors stay its own. Its
        updates are taken however small they are: they are what a derivative is made of."""
        o = other.state
        self.stiffening, self.exactness = other.stiffening, 0.0
        self.state = replace(
            self.state, multiplier=o.multiplier, multiplier_t=o.multiplier_t, limit=o.limit, attached=o.attached
        )

    @property
    def places(self) -> Array:
        """Return where the contact points (n, 3) m are in the scanned configuration."""
        return np.asarray((np.matmul(self.values, self.X) + self.bulge).reshape(-1, 3))

    def start_like(self, other: ContactState, nearest: NDArray[np.int64], u: Array) -> None:
        """The pressures of another mesh's points, of which number ``nearest`` (n,) stand for these, at displacements
        ``u`` (nodes, 3) m; nothing sticks."""
        multiplier, n = other.multiplier[nearest], len(nearest)
        nothing = np.zeros(n, bool)
        self.T = other.T
        self.state = ContactState(
            multiplier, np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3)), multiplier > 0.0, nothing, u.ravel(), other.T
        )

    def save(self) -> tuple[ContactState, Array | None, int, float, float]:
        return self.state, self.T, self.outer, self.stiffening, self.exactness

    def restore(self, state: tuple[ContactState, Array | None, int, float, float]) -> None:
        self.state, self.T, self.outer, self.stiffening, self.exactness = state

    # -- what is asked of the contact -------------------------------------------------------------------------------

    def wrench(self, x: Array) -> tuple[Array, Array]:
        """Force (3,) N of the probe on the body, and its torque (3,) N m about the origin of the frame ``phantom``."""
        points = self._acting(x)
        if points is None:
            return np.zeros(3), np.zeros(3)
        traction = points.normal.pressure[:, None] * points.n
        if points.tangential is not None:
            traction = traction + points.tangential.traction
        forces = self.weights.ravel()[points.rows][:, None] * traction @ self._rotation.T
        where = frames.apply(self.pose, points.y)
        return forces.sum(axis=0), np.cross(where, forces).sum(axis=0)

    def penetration(self, x: Array) -> float:
        """The deepest penetration at the contact points, m (0 without any)."""
        points = self._points(x)
        return 0.0 if points is None else max(0.0, -float(points.gap.min()))

    def pressures(self, x: Array) -> tuple[Array, Array]:
        """Return where the surface is touched (n, 3) m, and the contact pressure there (n,) Pa, for output."""
        points = self._points(x)
        if points is None:
            return np.zeros((0, 3)), np.zeros(0)
        pressed = points.normal.pressure != 0.0
        return frames.apply(self.pose, points.y[pressed]), points.normal.pressure[pressed]

    def pressed(self, x: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Return which contact points (n,) are pushed, their pressures (n,) Pa and gaps (n,) m."""
        points = self._points(x)
        if points is None:
            return np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
        i = points.normal.pressure > 0.0
        return points.rows[i], points.normal.pressure[i], points.gap[i]

    def bearing(self, x: Array) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
        """Return the points of all facets that bear something at the solution ``x``, none or all of a facet's: rows
        (n,), pressures (n,) Pa, gradients n (n, 3) and curvatures H (n, 3, 3) 1/m of the probe's distance, and
        tangential tractions t (n, 3) Pa, in the frame ``probe``."""
        points = self._points(x)
        if points is None:
            return np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3))
        p, q = points.normal.pressure, self.weights.shape[1]
        i = np.repeat((p != 0.0).reshape(-1, q).any(axis=1), q)
        t = np.zeros_like(points.n) if points.tangential is None else points.tangential.traction
        return points.rows[i], p[i], points.n[i], points.H[i], t[i]

    def places_at(self, rows: NDArray[np.int64], x: Array) -> Array:
        """Return where the contact points number ``rows`` (n,) are at the displacements ``x``, (n, 3) m."""
        return self._at(rows, x)

    def seen_at(self, rows: NDArray[np.int64], x: Array) -> Array:
        """Return the same in the frame ``probe``."""
        return np.asarray(frames.apply(frames.inverse(self.pose), self._at(rows, x)))

    def gaps(self, x: Array) -> tuple[NDArray[np.int64], Array]:
        """Return the facets (m,) near the probe at the displacements ``x``, and the least gap (m,) m of each."""
        facets, y = self._near(self._u(x), self.pose)
        return facets, np.asarray(self.shape.distance(y).d.reshape(len(facets), len(self.values)).min(axis=1))

    def misses(self, x: Array, T: Array | None) -> bool:
        """Return whether the probe would touch nothing of the surface at ``x`` if it were at ``T`` (4, 4)."""
        if T is None:
            return True
        facets, y = self._near(self._u(x), T)
        beside = len(facets) == 0 or bool(self.shape.distance(y).d.min() > 0.0)
        return beside and not self.swallowed(x, T)

    # -- what its approach asks (`fem_node.contact.approach.Touchable`) ----------------------------------------------

    def seen(self, x: Array, T: Array) -> Array:
        """The contact points (n, 3) m near the probe at ``T`` (4, 4), in its frame, at the displacements ``x``."""
        return self._near(self._u(x), T)[1]

    def swallowed(self, x: Array, T: Array) -> bool:
        """Return whether the innermost point of the probe at ``T`` lies inside the body."""
        place = frames.apply(T, self._innermost[None])
        surface = self._at_rest + self._u(x).reshape(-1, 3)[self._surface]
        return bool(is_inside(place, surface, self._triangles)[0])

    def depth_in_held(self, x: Array, T: Array) -> float:
        """Return how deep (m) surface that cannot move is inside the probe at ``T`` (4, 4)."""
        held = self.immovable
        if not len(held):
            return 0.0
        y = np.matmul(self.values, self.X[held] + self._u(x)[self.dofs[held]].reshape(len(held), -1, 3))
        y = frames.apply(frames.inverse(T), (y + self.bulge[held]).reshape(-1, 3))
        low, high = self.shape.bounds
        y = y[((y > low) & (y < high)).all(axis=1)]
        return max(0.0, -float(self.shape.distance(y).d.min())) if len(y) else 0.0

    def depth_behind(self, x: Array, T: Array) -> float:
        """Return how far (m) the body reaches behind the face of a probe at ``T``, along the probe's axis."""
        surface = self._at_rest + self._u(x).reshape(-1, 3)[self._surface]
        return max(0.0, -float(frames.apply(frames.inverse(T), surface)[:, 2].min()))

    # -- inside -----------------------------------------------------------------------------------------------------

    @cached_property
    def _innermost(self) -> Array:
        """The point (3,) of the probe that is deepest inside it, in its frame."""
        return innermost(self.shape)

    @cached_property
    def _triangles(self) -> NDArray[np.int64]:
        """Flat triangles (m, 3) of the surface, rows of its nodes."""
        return self._corners[:, QUARTERS].reshape(-1, 3) if self.space.quadratic else self._corners

    @cached_property
    def _between(self) -> tuple[Array, Array]:
        """Shape values (d, b) at many points of a facet, and the bulge (k, d, 3) there."""
        barycentric, mesh = _grid_rule(DENSE), self.space.mesh
        values = shape_values(barycentric, quadratic=self.space.quadratic)
        return values, bulge(mesh.nodes[mesh.boundary_triangles], mesh.corner_normals, barycentric)

    @cached_property
    def _slopes(self) -> Array:
        """Derivatives (q, b, 2) of the shape functions along two edges, at the contact points."""
        dN = shape_derivatives(_grid_rule(SUBDIVISIONS), quadratic=self.space.quadratic)
        return dN[:, :, 1:] - dN[:, :, :1]

    def _facing(self, x: Array, points: _Points) -> Array:
        """Cosine (n,) between the surface's outward normal and the direction in which the probe pushes."""
        _, y = self._near_nodes(self._u(x), self.pose)
        y = y[self._corners[points.facets]]
        tangents = np.einsum("qbj,mbi->mqji", self._slopes, y).reshape(-1, 2, 3)
        outward = np.cross(tangents[:, 0], tangents[:, 1])
        return np.asarray(
            np.einsum("ni,ni->n", outward, points.n) / np.maximum(np.linalg.norm(outward, axis=1), 1e-300)
        )

    @cached_property
    def _furthest_between(self) -> float:
        """Return how far (m) any point of a facet is from the nearest contact point, at most."""
        at, contacts = np.matmul(self._between[0], self.X), np.matmul(self.values, self.X)
        return MARGIN * float(max(KDTree(c).query(p)[0].max() for p, c in zip(at, contacts, strict=True)))

    def _deepest_between(self, x: Array, points: _Points) -> float:
        """Return how deep (m) any point of the surface is inside the probe, contact points or not; 0 where it cannot
        be, since the contact points are too far outside."""
        near = points.gap.reshape(-1, self.weights.shape[1]).min(axis=1) < self._furthest_between
        facets = points.facets[near]
        values, outside = self._between
        _, y = self._near_nodes(self._u(x), self.pose)
        at = np.matmul(values, y[self._corners[facets]]) + outside[facets] @ self._rotation
        return max(0.0, -float(self.shape.distance(at.reshape(-1, 3)).d.min(initial=0.0)))

    @property
    def _limit_tolerance(self) -> float:
        """Return how far friction limits may still move, of the largest."""
        return self.exactness * LIMIT_TOLERANCE * self.outer * min(self.gap_tolerance / GAP_TOLERANCE, 1.0)

    def _refuse_penetration(self, penetration: float) -> None:
        if penetration > PENETRATION_BOUND:
            raise ConvergenceError(
                f"the contact did not settle in {MAX_OUTER} iterations (penetration {1e3 * penetration:.3f} mm)",
                where="probe contact",
                remedy="move the probe in smaller steps, or refine the mesh under it",
            )

    @property
    def pose(self) -> Array:
        """T_phantom_probe (4, 4); `ConvergenceError` if there is none."""
        if self.T is None:
            raise ConvergenceError("the probe has no pose", where="probe contact", remedy="give one")
        return self.T

    @property
    def _warm(self) -> float:
        return EXACT if self.approaches else WARM_STARTED

    def _came(self, touches: NDArray[np.bool_]) -> Array | None:
        """Return the pose now if nothing ``touches`` (n,), or nothing was known before; otherwise the one before."""
        return self.T if self.T is None or not touches.any() or self.state.came is None else self.state.came

    @property
    def _rotation(self) -> Array:
        return self.pose[:3, :3]

    @property
    def _axes(self) -> Array:
        """The probe's axes (3, 3) for compiled kernels."""
        return np.ascontiguousarray(self._rotation)

    def _u(self, x: Array) -> Array:
        return x[: 3 * self.space.n_nodes]

    def _points(self, x: Array) -> _Points | None:
        """The points of the facets that the probe may touch, with gap and tractions; None if there are none."""
        return None if self.T is None else self._said(*self._near(self._u(x), self.T))

    def _acting(self, x: Array) -> _Points | None:
        """The points of the facets that bear or resist something, or did when multipliers were last updated; None if
        there are none."""
        if self.T is None:
            return None
        facets, y = self._near(self._u(x), self.T)
        if len(facets) == 0:
            return None
        state, acts = self.state, np.empty(len(facets), np.bool_)
        may_act(y, facets, state.multiplier, state.limit, state.attached, self.shape.bounds, acts)
        return self._said(facets[acts], y.reshape(len(facets), -1, 3)[acts].reshape(-1, 3))

    def _said(self, facets: NDArray[np.int64], y: Array) -> _Points | None:
        """Ask the laws about the facets (m,) with contact points ``y`` (m q, 3) m; None without facets."""
        if len(facets) == 0:
            return None
        q = self.weights.shape[1]
        index = (facets[:, None] * q + np.arange(q)).ravel()
        distance = self.shape.distance(y)
        s, law = self.state, self.law
        penalty = self.stiffening * law.penalty
        normal = contact_law.normal(distance.d, s.multiplier[index], penalty, s.attached[index], law.strength)
        tangential = None
        if law.sticks > 0:
            n, slip = self._anchor_normals(index), y - s.anchor[index]
            tangential = contact_law.tangential(slip, n, s.multiplier_t[index], s.limit[index], penalty)
        return _Points(facets, index, y, distance.d, distance.gradient, distance.hessian, normal, tangential)

    def _anchor_normals(self, index: NDArray[np.int64]) -> Array:
        """Return the probe's normals (n, 3) at the anchors number ``index`` (n,), which stand still while the solver
        iterates, mostly at the same points."""
        known, anchor = self._known_normals, self.state.anchor
        if known is None or known[0] is not anchor or not np.array_equal(known[1], index):
            known = self._known_normals = anchor, index, self.shape.distance(anchor[index]).gradient
        return known[2]

    def _forces(self, points: _Points) -> Array:
        """Sum the tractions at the ``points`` to their facets' residual (m, 3 b) N."""
        out = np.zeros((len(points.facets), 3 * self.values.shape[1]))
        rubbing = np.zeros((0, 3)) if points.tangential is None else points.tangential.traction
        sum_forces(
            self.values, self.weights.ravel()[points.rows], self._axes, points.n, points.normal.pressure, rubbing, out
        )
        return out

    def _stiffness(self, points: _Points, safe: bool) -> Array:
        """Sum the stiffness at the ``points`` to blocks (m, 3 b, 3 b) N/m of their facets; without curvature if
        ``safe``."""
        size, (p, eps, _) = 3 * self.values.shape[1], points.normal
        out = np.zeros((len(points.facets), size, size))
        curved = np.zeros(len(p)) if safe else np.where(p < self.law.curvature_limit, p, 0.0)
        rubbing = np.zeros((0, 3, 3)) if points.tangential is None else points.tangential.stiffness
        w = self.weights.ravel()[points.rows]
        sum_stiffness(self.values, w, self._axes, points.n, eps, curved, points.H, rubbing, out)
        return out

    def _near(self, u: Array, T: Array) -> tuple[NDArray[np.int64], Array]:
        """Facets (m,) whose nodes come near the probe's box, and their quadrature points (m q, 3) in its frame."""
        facets, y = self._near_nodes(u, T)
        points = np.empty((len(facets) * len(self.values), 3))
        points_of(facets, self._corners, y, self.values, self.bulge, T, points)
        return facets, points

    def _near_nodes(self, u: Array, T: Array) -> tuple[NDArray[np.int64], Array]:
        """Facets (m,) whose nodes come near the probe's box, and all nodes of the surface (n, 3) m in its frame."""
        y = np.empty(self._at_rest.shape)
        near, facets = np.empty(len(y), np.bool_), np.empty(len(self._corners), np.bool_)
        near_box(
            self._at_rest, u.reshape(-1, 3), self._surface, frames.inverse(T), self.shape.bounds, self.reach, y, near
        )
        any_of(near, self._corners, facets)
        return np.flatnonzero(facets), y

    def _at(self, rows: NDArray[np.int64], x: Array) -> Array:
        """The contact points (n, 3) m number ``rows`` at the displacements ``x``, in the frame ``phantom``."""
        facets, q = np.divmod(rows, self.weights.shape[1])
        nodes = self.X[facets] + self._u(x)[self.dofs[facets]].reshape(len(rows), -1, 3)
        return np.asarray(np.einsum("na,nai->ni", self.values[q], nodes) + self.bulge[facets, q])

    def _anchors_on_the_way(self, T: Array) -> Array:
        """Anchors (n, 3): unchanged where the surface touches; elsewhere the point of the probe that would arrive there
        first if the surface kept still while the probe moves from its committed pose to ``T``."""
        state = self.state
        at = np.einsum("qa,kai->kqi", self.values, self.X + state.x.reshape(-1, 3)[self.space.facets])
        at = (at + self.bulge).reshape(-1, 3)
        after = frames.apply(frames.inverse(T), at)
        if state.T is None:
            return np.where(state.touches[:, None], state.anchor, after)
        before = frames.apply(frames.inverse(state.T), at)
        g0, g1 = self.shape.distance(before).d, self.shape.distance(after).d
        met = (g1 < 0) & (g0 > 0)
        s = np.where(met, g0 / np.where(met, g0 - g1, 1.0), np.where(g1 < 0, 0.0, 1.0))
        return np.where(state.touches[:, None], state.anchor, before + s[:, None] * (after - before))


def _grid_rule(n: int) -> Array:
    """Barycentric centres (n^2, 3) of the n^2 equal triangles that a triangle is cut into."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    up, down = i + j < n, i + j < n - 1
    first = np.concatenate([(i[up] + 1 / 3) / n, (i[down] + 2 / 3) / n])
    second = np.concatenate([(j[up] + 1 / 3) / n, (j[down] + 2 / 3) / n])
    return np.column_stack([first, second, 1.0 - first - second])


def _furthest_point(X: Array, values: Array) -> float:
    """Return how far the points of facets with nodes ``X`` (k, b, 3), at the shape ``values`` (q, b), are from the
    nearest of their nodes at most."""
    points = np.matmul(values, X)
    return float(np.linalg.norm(points[:, :, None] - X[:, None], axis=3).min(axis=2).max())


def _put(values: NDArray[Any], rows: NDArray[np.int64], new: NDArray[Any]) -> NDArray[Any]:
    """A copy with some rows replaced."""
    out = values.copy()
    out[rows] = new
    return out


def _limit(mu: float, pressure: Array) -> Array:
    """Friction limit mu p (n,), 0 where the surface is not pushed."""
    pushed = pressure > 0.0
    return np.where(pushed, mu if np.isinf(mu) else mu * pressure, 0.0)


def _same_limit(old: Array, new: Array, tolerance: float) -> bool:
    """Return whether the friction limits have settled (infinite ones: on the same points)."""
    if np.isinf(new).any() or np.isinf(old).any():
        return bool(np.array_equal(old, new))
    return bool(np.abs(new - old).max(initial=0.0) <= tolerance * new.max(initial=0.0))


def make_contact(space: Space, probe: Probe, youngs_modulus: float) -> ProbeContact:
    """The contact item of a probe; the penalty follows from the modulus at the surface (`Continuum.surface_modulus`)
    and the size of the facets."""
    _, weights, _ = space.facet_rule(1)
    size = float(np.sqrt(np.median(weights.sum(axis=1))))
    factor = PURE_PENALTY_FACTOR if probe.formulation == "penalty" else PENALTY_FACTOR
    law = ContactLaw(
        probe.formulation,
        probe.friction,
        probe.adhesion,
        penalty=factor * youngs_modulus / size,
        curvature_limit=CURVATURE_LIMIT * youngs_modulus,
        modulus=youngs_modulus,
    )
    return ProbeContact(space, probe.shape, law, drags=bool(rubbing(probe)))
