"""The body's inner forces: one item for every material, element, history and stress-free change of shape.

The mesh stays in the scanned configuration; x = X_scan + u. What changes the stress-free shape acts through one tensor per
quadrature point, G = F0^-1 Fp^-1 Js^-1/3 (F0: scanned -> unloaded shape, Fp: plastic set, Js: swelling), so that
F_e = (I + grad u) G and dV_e = det(F0) Js dV_scan:

    W(u) = sum_q w [psi(F_e) + s K U(theta)] + sum_e V_e (1 - s) K_e U(theta_e),     theta_e = sum_q w theta / V_e

with s = 0 for P2-P0, s = 1 for the elements without pressure (Simo, Taylor & Pister 1985: mean dilatation).
"""

from __future__ import annotations

import numpy as np

from fem_node.assembly import Pattern, System, add_forces, add_stiffness, deformation_gradients, node_dofs
from fem_node.element import Space
from fem_node.items import Moment, PlainItem
from fem_node.materials import make_material
from fem_node.physics import BodyShape, Physics, bind_fields
from fem_node.supports import held_facets
from livedeform_common.types import Array

_IDENTITY = np.eye(3)[None, None]


class Continuum(PlainItem):
    """The body. ``unloaded`` (n, 3) m: displacement from the scanned to the stress-free shape (None: the same)."""

    def __init__(self, space: Space, physics: Physics, unloaded: Array | None = None) -> None:
        self.space, self.physics = space, physics
        self.material = make_material(physics.material)
        e, q, a, _ = space.gradients.shape
        self._F, self._P, self._c, self._theta, self._psi = space.workspace
        self._A: Array | None = None
        self._dofs = node_dofs(space.cells)
        self._positions = None
        self._factor = np.ones((e, q))
        self._swelling = 1.0
        self.set_unloaded(unloaded)

    def attach(self, pattern: Pattern) -> None:
        """Finds the places of the element blocks in the pattern."""
        self._positions = pattern.positions(self._dofs)
        e, q, _, _ = self.space.gradients.shape
        self._A = np.empty((e, q, 9, 9))

    def couplings(self) -> list[Array]:
        """The dofs of each element."""
        return [self._dofs]

    def set_unloaded(self, unloaded: Array | None) -> None:
        """Takes a new stress-free shape: displacement (n, 3) m from the scanned one, None: the scanned one itself."""
        s = self.space
        nodes, self.unloaded_points = s.nodes, s.points
        self._start, self._J0 = None, np.ones(s.weights.shape)
        if unloaded is not None:
            F0 = np.empty((*s.weights.shape, 3, 3))
            deformation_gradients(unloaded, s.cells, s.gradients, _IDENTITY, F0)
            self._start, self._J0 = np.linalg.inv(F0), np.linalg.det(F0)
            nodes = s.nodes + unloaded
            self.unloaded_points = s.points + np.einsum("qa,eai->eqi", s.values, unloaded[s.cells])
        shape = BodyShape(nodes[: len(s.mesh.nodes)], s.mesh.boundary_triangles, held_facets(s, self.physics))
        self._fields = bind_fields(self.physics.modulus_fields, shape)
        self._set_reference(self._swelling)

    def _set_reference(self, swelling: float) -> None:
        """G, the gradients with respect to the stress-free shape, and its volumes."""
        s = self.space
        self._swelling = swelling
        scale = swelling ** (-1.0 / 3.0)
        G = _IDENTITY if self._start is None else self._start
        if self._start is None and swelling == 1.0:
            self._G, self._gradients = _IDENTITY, s.gradients
        else:
            self._G = G * scale
            self._gradients = s.gradients @ np.broadcast_to(self._G, (*s.weights.shape, 3, 3))
        self.weights = s.weights * self._J0 * swelling
        self._volumes = self.weights.sum(axis=1)

    def prepare(self, moment: Moment) -> None:
        p = self.physics
        swelling = 1.0 if p.swelling is None else float(p.swelling(moment.time))
        if swelling != self._swelling:
            self._set_reference(swelling)
        self._factor[:] = 1.0
        for field in self._fields:
            self._factor *= field(self.unloaded_points.reshape(-1, 3), moment.time).reshape(self._factor.shape)

    @property
    def mass_weights(self) -> Array:
        """Unloaded volume of each quadrature point (e, q), m3."""
        return self.space.weights * self._J0

    def deformation(self, x: Array) -> Array:
        """F_e (e, q, 3, 3) at the displacements."""
        u = x[: 3 * self.space.n_nodes].reshape(-1, 3)
        deformation_gradients(u, self.space.cells, self._gradients, self._G, self._F)
        return self._F

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        F = self.deformation(x)
        e, q, a, _ = self._gradients.shape
        flat, P = F.reshape(-1, 3, 3), self._P.reshape(-1, 3, 3)
        A = self._A.reshape(-1, 9, 9) if tangent else None
        self.material.response(flat, self._factor.reshape(-1), self._psi, P, A)
        c = self._c.reshape(-1, 3, 3)
        self.material.volume.measure(flat, self._theta, c)
        U, theta = self.material.volumetric, self._theta.reshape(e, q)
        K = self.material.bulk * self._factor
        s = self.pointwise
        w, V = self.weights, self._volumes
        mean, K_mean = (w * theta).sum(axis=1) / V, (w * K).sum(axis=1) / V
        pressure = (1.0 - s) * (K_mean * U.slope(mean))[:, None] + (s * K * U.slope(theta) if s else 0.0)
        pressure = np.broadcast_to(pressure, (e, q))
        curvature = s * K * U.curvature(theta) if s else np.zeros((e, q))
        self.material.volume.add(flat, pressure.ravel(), curvature.ravel(), c, P, A)
        add_forces(self._P, w, self.space.cells, self._gradients, system.r)
        if tangent:
            averaged = np.einsum("eq,eqij,eqaj->eai", w, self._c, self._gradients).reshape(e, 3 * a)
            factor = (1.0 - s) * K_mean * U.curvature(mean) / V
            add_stiffness(self._A, w, self._gradients, averaged, factor, self._positions, system.values)
        energy = w.ravel() @ self._psi + (1.0 - s) * (V * K_mean) @ U.value(mean)
        return float(energy + (s * np.sum(w * K * U.value(theta)) if s else 0.0))

    @property
    def pointwise(self) -> float:
        """s: the share of the volumetric energy that is not averaged."""
        if self.space.kind in ("p1", "p2"):
            return 1.0
        import os
        return min(1.0, float(os.environ.get("STAB", "0")) * self.material.shear / self.material.bulk)
