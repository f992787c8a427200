"""The body's inner forces: one item for every material, element, history and stress-free change of shape.

The mesh stays in the scanned configuration; x = X_scan + u. What changes the stress-free shape acts through one
tensor per quadrature point, G = F0^-1 Fp^-1 Js^-1/3 (F0: scanned -> unloaded shape, Fp: plastic set, Js: growth),
so that F_e = (I + grad u) G and dV_e = det(F0) Js dV_scan:

    W(u) = sum_q w [psi(F_e) + K U(theta_h)]

where the element projects the volume ratio theta(F_e) to theta_h (`fem_node.element.volume_scheme`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.element.kernels import (
    add_stiffness,
    deformation_gradients,
    determinants,
    nodal_forces,
    upper_positions,
)
from livedeform.fem_node.element.simd import LANES, work_array
from livedeform.fem_node.element.subcells import SubCells, averaged, splits
from livedeform.fem_node.element.volume_scheme import make_scheme
from livedeform.fem_node.items import plastic, viscoelastic
from livedeform.fem_node.items.dynamics import SLIP, moves
from livedeform.fem_node.items.protocol import Moment, PlainItem
from livedeform.fem_node.items.supports import held_facets
from livedeform.fem_node.materials import make_material
from livedeform.fem_node.materials.volume import SMALL_STRAIN, add_pressure
from livedeform.fem_node.physics.record import BodyShape, ModulusField, Physics, bind_fields
from livedeform.fem_node.solve.assembly import Pattern, Positions, System, add_vectors, node_dofs

_IDENTITY = np.eye(3)[None, None]
CHUNK = 32 * LANES  # elements whose tangents stay in the processor's cache between material and stiffness
PLASTIC_TOLERANCE = 1e-7  # of the plastic deformation, between two outer iterations


@dataclass(frozen=True)
class History:
    """The body's history: overstress, plastic set, and for damping its inner force (n,) N and the force's rate."""

    overstress: viscoelastic.Overstress | None
    plastic: plastic.SetState | None
    force: Array | None
    force_rate: Array | None


@dataclass
class _Force:
    """A system that only takes a residual."""

    r: Array


class Continuum(PlainItem):
    """The body. ``unloaded`` (n, 3) m: displacement from the scanned to the stress-free shape (None: the same)."""

    def __init__(self, space: Space, physics: Physics, unloaded: Array | None = None) -> None:
        self.space, self.physics = space, physics
        self.material = make_material(physics.material)
        e, q = space.weights.shape
        self._F, self._P, self._c, self._theta, self._psi = space.workspace
        self._A = np.zeros((0, 0, 9, 9, LANES))
        self._scheme = make_scheme(space)
        self._dofs = self._node_dofs = node_dofs(space.cells)
        self._forces = np.empty(self._node_dofs.shape)
        if space.n_pressure:
            self._dofs = np.concatenate([self._dofs, 3 * space.n_nodes + space.mesh.tets], axis=1)
        self._positions: Positions = np.zeros((0, 0, 0), np.int32)
        self._factor, self._steady = np.ones((e, q)), np.ones((e, q))  # of the modulus; and what of it does not change
        self._parts: SubCells | None = None
        self._growth = 1.0
        self._history = self._begin_history(e * q)
        self._step: viscoelastic.Step | None = None
        self._dt = np.inf
        self._linear_pressure: Array | None = None
        self._rate = 0.0  # beta / (s dt) of stiffness-proportional damping, s = SLIP
        self.set_unloaded(unloaded)

    def _begin_history(self, n: int) -> History:
        p = self.physics
        if p.prony is not None and not self.material.isochoric:
            raise InputError(
                f"viscoelasticity needs a material with an isochoric part, and '{self.material.name}' has none",
                remedy="use neo_hookean, mooney_rivlin, yeoh, exponential, ogden or linear",
            )
        damped = p.inertia is not None and p.inertia.rayleigh_beta > 0.0
        return History(
            overstress=None if p.prony is None else viscoelastic.relaxed(n, p.prony),
            plastic=None if p.plastic_set is None else plastic.unstrained(n),
            force=np.zeros(3 * self.space.n_nodes) if damped else None,
            force_rate=np.zeros(3 * self.space.n_nodes) if damped else None,
        )

    def attach(self, pattern: Pattern) -> None:
        """Find the places of the element blocks in the pattern."""
        self._positions = pattern.positions(self._dofs)
        n = self._node_dofs.shape[1]
        self._halves = upper_positions(self._positions[:, :n, :n])
        q = self.space.weights.shape[1]
        self._A = work_array(CHUNK // LANES * q * 81).reshape(-1, q, 9, 9, LANES)

    def couplings(self) -> list[NDArray[np.int64]]:
        """Return the dofs of each element."""
        return [self._dofs]

    def set_unloaded(self, unloaded: Array | None) -> None:
        """Take a new stress-free shape: displacement (n, 3) m from the scanned one, None: the scanned one itself."""
        s = self.space
        nodes, self.unloaded_points = s.nodes, s.points
        self._start, self._J0 = None, np.ones(s.weights.shape)
        if unloaded is not None:
            F0 = np.empty((*s.weights.shape, 3, 3))
            deformation_gradients(unloaded, s.cells, s.slopes, s.frames, _IDENTITY, F0)
            self._start, self._J0 = np.linalg.inv(F0), np.linalg.det(F0)
            nodes = s.nodes + unloaded
            self.unloaded_points = s.points + np.einsum("qa,eai->eqi", s.values, unloaded[s.cells])
        shape = BodyShape(nodes[: len(s.mesh.nodes)], s.mesh.boundary_triangles, held_facets(s, self.physics))
        self._fields = bind_fields(self.physics.modulus_fields, shape)
        if any(field.jumps for field in self._fields):
            places = (s.nodes if unloaded is None else s.nodes + unloaded)[s.cells]
            self._parts = SubCells(places, splits(s.typical_size), s.quadratic)
        self._steady = np.ones(s.weights.shape)
        for field in self._fields:
            if not field.changes_with_time:
                self._steady *= self._factor_of(field, 0.0)
        self._set_reference(self._growth)

    def _factor_of(self, field: ModulusField, time: float) -> Array:
        """Return a field's factor of the modulus (e, q)."""
        if self._parts is None or not field.jumps:
            return field(self.unloaded_points.reshape(-1, 3), time).reshape(self.space.weights.shape)
        factor = field.over(self._parts, time).reshape(len(self.space.weights), -1)
        weights = self.space.weights[0]  # of straight elements: the rule's own, times the volume
        return averaged(factor, self.space.barycentric, weights / weights.sum())

    def _set_reference(self, growth: float) -> None:
        """Set G, the points' frames with respect to the stress-free shape, and its volumes."""
        s = self.space
        self._growth = growth
        scale = growth ** (-1.0 / 3.0)
        G = _IDENTITY if self._start is None else self._start
        if self._history.plastic is not None:
            G = G @ self._history.plastic.inverse.reshape(*s.weights.shape, 3, 3)
        if self._start is None and growth == 1.0 and self._history.plastic is None:
            self._G, self._frames = _IDENTITY, s.frames
        else:
            self._G = G * scale
            self._frames = s.frames @ self._G
        self.weights = s.weights * self._J0 * growth
        self._volumes = self.weights.sum(axis=1)

    def prepare(self, moment: Moment) -> None:
        p = self.physics
        self._linear_pressure = None
        growth = p.volume_ratio(moment.time)
        if growth != self._growth:
            self._set_reference(growth)
        self._factor[:] = self._steady
        for field in self._fields:
            if field.changes_with_time:
                self._factor *= self._factor_of(field, moment.time)
        if p.prony is not None and self._history.overstress is not None:
            self._step = viscoelastic.begin(p.prony, self._history.overstress, moment.dt)
        self._dt = moment.dt if moves(p.inertia, moment) else np.inf
        self._rate = 0.0 if p.inertia is None else p.inertia.rayleigh_beta / (SLIP * self._dt)

    @property
    def surface_modulus(self) -> float:
        """Young's modulus Pa of the elements at the surface that no support holds: the geometric mean over it, without
        what changes with time."""
        E, s = self.physics.material.youngs_modulus, self.space
        free = np.flatnonzero(~held_facets(s, self.physics))
        if not self._fields or not len(free):
            return E
        _, area, _ = s.facet_rule(1)
        return E * float(np.exp(np.average(self._logarithm(self._steady, free), weights=area[free].sum(axis=1))))

    def modulus_behind(self, facets: NDArray[np.int64]) -> Array:
        """Return Young's modulus (f,) Pa of the elements behind boundary ``facets`` (f,), at the prepared moment."""
        E = self.physics.material.youngs_modulus
        return E * np.exp(self._logarithm(self._factor, facets)) if self._fields else np.full(len(facets), E)

    def _logarithm(self, factor: Array, facets: NDArray[np.int64]) -> Array:
        """Return the mean logarithm (f,) of a ``factor`` (e, q) over the elements behind boundary ``facets`` (f,)."""
        return np.asarray(np.log(factor[self.space.mesh.boundary_tets[facets]]).mean(axis=1))

    @property
    def mass_weights(self) -> Array:
        """Unloaded volume of each quadrature point (e, q), m3."""
        return self.space.weights * self._J0

    def deformation(self, x: Array) -> Array:
        """Return F_e (e, q, 3, 3) at the displacements."""
        u = x[: 3 * self.space.n_nodes].reshape(-1, 3)
        deformation_gradients(u, self.space.cells, self.space.slopes, self._frames, self._G, self._F)
        return self._F

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        h, inertia = self._history, self.physics.inertia
        if self._rate == 0.0 or inertia is None or h.force is None or h.force_rate is None:
            return self._evaluate(x, system, 1.0, tangent=tangent)
        # g + beta dg/dt with s dg/dt = (g - g_n)/dt - (1 - s) (dg/dt)_n
        energy = self._evaluate(x, system, 1.0 + self._rate, tangent=tangent)
        past = self._rate * h.force + inertia.rayleigh_beta * (1.0 - SLIP) / SLIP * h.force_rate
        system.r[: len(past)] -= past
        return energy - float(past @ x[: len(past)])

    def _evaluate(self, x: Array, system: System | _Force, scale: float, *, tangent: bool) -> float:
        """Evaluate the inner force (times ``scale``), tangent and energy."""
        F, theta, c = self.deformation(x).reshape(-1, 3, 3), self._theta, self._c.reshape(-1, 3, 3)
        self.material.volume.measure(F, theta, c)
        U, w, K = self.material.volumetric, scale * self.weights, self.material.bulk * self._factor
        pressure, curvature, volume_energy = self._scheme.pressure(U, w, K, theta.reshape(w.shape))
        if tangent and isinstance(system, System):
            self._shear_part_and_stiffness(F, w, K, pressure, curvature, system)
        else:
            self._shear_part(F, slice(None), None)
        add_pressure(pressure.ravel(), c, self._P.reshape(-1, 3, 3))
        nodal_forces(self._P, w, self.space.slopes, self._frames, self._forces)
        add_vectors(system.r, self._node_dofs, self._forces)
        return float(w.ravel() @ self._psi) + volume_energy

    def _shear_part_and_stiffness(
        self, F: Array, w: Array, K: Array, pressure: Array, curvature: Array, system: System
    ) -> None:
        """Evaluate the tangent, some elements at a time."""
        c, U, (upper, lower) = self._c.reshape(-1, 3, 3), self.material.volumetric, self._halves
        if self._linear_pressure is not None:
            pressure = self._linear_pressure
        if system.safe:  # K c c without p D: positive also where a trial step has upset the volume
            pressure = np.zeros(w.shape)
        p, k = pressure.ravel(), curvature.ravel()
        vectors, factors = self._scheme.element_term(U, w, K, self._c, self._frames)
        for first in range(0, len(w), CHUNK):
            e, b = slice(first, first + CHUNK), slice(first // LANES, (first + CHUNK) // LANES)
            n = slice(first * w.shape[1], (first + CHUNK) * w.shape[1])
            A = self._A[: len(upper[b])]
            self._shear_part(F, n, A)
            self.material.volume.add_tangent(F[n], p[n], k[n], c[n], A)
            add_stiffness(
                A, w[e], self.space.slopes, self._frames[e], vectors[e], factors[e], upper[b], lower[b], system.values
            )
        self._scheme.add_couplings(U, w, K, self._c, self._frames, self._positions, system)

    def expect(self, x: Array, dx: Array | None) -> None:
        """Let the next tangent take the pressure that the step ``dx`` from ``x`` promises to first order.

        That is Newton's method on displacement and pressure, with the pressure condensed: the pressure of the displaced
        body itself is spoilt by K times the volume error of second order. None: the exact tangent again.
        """
        self._linear_pressure = None
        if dx is None:
            return
        e, q = self.weights.shape
        F = self.deformation(x)
        c, theta = self._c.reshape(-1, 3, 3), np.empty(e * q)
        self.material.volume.measure(F.reshape(-1, 3, 3), theta, c)
        change = np.empty((e, q, 3, 3))
        du = dx[: 3 * self.space.n_nodes].reshape(-1, 3)
        deformation_gradients(du, self.space.cells, self.space.slopes, self._frames, np.zeros((1, 1, 3, 3)), change)
        theta = theta.reshape(e, q) + np.einsum("eqij,eqij->eq", self._c, change)
        K = self.material.bulk * self._factor
        self._linear_pressure = self._scheme.pressure(self.material.volumetric, self.weights, K, theta)[0]

    def _shear_part(self, F: Array, points: slice, A: Array | None) -> None:
        """Evaluate the material's response at some points, with what is left of earlier stresses."""
        step, P, psi = self._step, self._P.reshape(-1, 3, 3)[points], self._psi[points]
        factor = self._factor.reshape(-1)[points]
        self.material.response(F[points], factor if step is None else step.amplification * factor, psi, P, A)
        if step is not None and step.H is not None:
            add = viscoelastic.add_small if self.material.volume is SMALL_STRAIN else viscoelastic.add_finite
            add(step.H[points], F[points], psi, P, A)

    def stress(self, x: Array) -> tuple[Array, Array]:
        """Return deformation gradient from the unloaded shape and Cauchy stress, (e, q, 3, 3) each, at the prepared
        moment."""
        system = _Force(np.zeros(len(x)))
        self._evaluate(x, system, 1.0, tangent=False)
        F, P = self._F.reshape(-1, 3, 3), self._P.reshape(-1, 3, 3)
        J = 1.0 if self.material.volume is SMALL_STRAIN else np.linalg.det(F)[:, None, None]
        sigma = P if self.material.volume is SMALL_STRAIN else P @ F.transpose(0, 2, 1) / J
        return self._total_deformation(x).reshape(self._F.shape), sigma.reshape(self._F.shape).copy()

    # -- history -----------------------------------------------------------------------------------------------------

    def update(self, x: Array, strain: Array | None = None) -> bool:
        """Let the plastic set follow the ``strain`` (None: that at ``x``); return True while it still moves."""
        law, state = self.physics.plastic_set, self._history.plastic
        if law is None or state is None:
            return False
        reached = plastic.strained(state, self.strain(x) if strain is None else strain)
        new = plastic.inverse_set(law, reached)
        moved = float(np.abs(new - state.inverse).max())
        self._history = replace(self._history, plastic=plastic.SetState(state.largest, reached, new))
        self._set_reference(self._growth)
        return moved > PLASTIC_TOLERANCE

    def flaw(self, x: Array) -> str:
        """Elements that are turned inside out."""
        J = determinants(self.deformation(x).reshape(-1, 3, 3))
        inverted = ~(J.reshape(self.weights.shape).min(axis=1) > 0.0)
        return f"{inverted.sum()} elements are turned inside out" if inverted.any() else ""

    def set_like(self, other: Continuum) -> None:
        """Take the plastic set of what ``other`` has reached, a small change of parameters away: at the same points,
        since one that just outgrows an earlier strain turns its set by a jump."""
        law, theirs = self.physics.plastic_set, other._history.plastic
        if law is None or theirs is None:
            raise ValueError("neither of the two may be without a plastic set")
        own = plastic.SetState(theirs.largest, theirs.reached, plastic.inverse_set(law, theirs.reached))
        self._history = replace(self._history, plastic=own)
        self._set_reference(self._growth)

    def strain(self, x: Array) -> Array:
        """Return the Hencky strain (n, 3, 3) from the unloaded shape."""
        return plastic.hencky(self._total_deformation(x))

    def relaxed_stress(self, x: Array) -> Array:
        """Return the stress (n, 3, 3) that relaxes, without what is left of earlier ones."""
        F, P = self.deformation(x).reshape(-1, 3, 3), self._P.reshape(-1, 3, 3)
        self.material.response(F, self._factor.reshape(-1), self._psi, P, None)
        return P.copy() if self.material.volume is SMALL_STRAIN else viscoelastic.isochoric_stress(F, P)

    def _total_deformation(self, x: Array) -> Array:
        """Return F (e q, 3, 3) from the unloaded shape, without regard to growth and plastic set."""
        s = self.space
        F = np.empty((*s.weights.shape, 3, 3))
        u = x[: 3 * s.n_nodes].reshape(-1, 3)
        deformation_gradients(u, s.cells, s.slopes, s.frames, _IDENTITY, F)
        return (F if self._start is None else F @ self._start).reshape(-1, 3, 3)

    def commit(self, x: Array, strain: Array | None = None, stress: Array | None = None) -> None:
        history = self._history
        if history.overstress is not None and self._step is not None:
            S = self.relaxed_stress(x) if stress is None else stress
            history = replace(history, overstress=viscoelastic.end(self._step, history.overstress, S))
        if history.plastic is not None:
            reached = plastic.strained(history.plastic, self.strain(x) if strain is None else strain)
            history = replace(history, plastic=plastic.SetState(reached, reached, history.plastic.inverse))
        if history.force is not None and history.force_rate is not None:
            system = _Force(np.zeros(len(x)))
            self._evaluate(x, system, 1.0, tangent=False)
            force = system.r[: len(history.force)]
            rate = (
                np.zeros_like(force)
                if np.isinf(self._dt)
                else (force - history.force) / (SLIP * self._dt) - (1.0 - SLIP) / SLIP * history.force_rate
            )
            history = replace(history, force=force, force_rate=rate)
        self._history = history

    def save(self) -> History:
        return self._history

    def restore(self, state: History) -> None:
        changed = state.plastic is not self._history.plastic
        self._history = state
        if changed:
            self._set_reference(self._growth)
