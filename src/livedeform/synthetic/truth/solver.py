"""The truth's body: quasi-static equilibrium in small steps of time, with everything that the scenarios ask for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.synthetic.truth import friction, kernels, newton
from livedeform.synthetic.truth.discretisation import Discretisation
from livedeform.synthetic.truth.hexmesh import HexMesh
from livedeform.synthetic.truth.history import TruthHistory
from livedeform.synthetic.truth.physics import TruthPhysics, TruthState
from livedeform.synthetic.truth.probe import OPENING, Tractions, TruthProbe, tractions
from livedeform.synthetic.truth.tether import Tether

PATH_MOVE = 5e-4  # m that the probe goes at most at a time where what sticks, slides or lets go depends on the path
ROUNDS = 40  # of contact at one pose, at most; where a probe sticks, one ring of points lets go after the other
PLASTIC_ROUNDS, PLASTIC_CHANGE = 6, 2e-4  # equilibria per step at most, and the strain's change that ends them
HALVINGS = 8  # of a step that does not converge, at most


class TruthBody(Discretisation):
    """A body on its base z = 0. ``rest`` finds the equilibrium at the start; ``step`` goes on to a time and a pose."""

    tolerance = 5e-7  # m, of the last Newton correction
    gap_tolerance = 2e-5  # m, by which contact may be off: what penetrates as well as what is pushed from afar
    slip_tolerance = 5e-6  # m, by which what sticks may give

    def __init__(self, mesh: HexMesh, physics: TruthPhysics, shape: TruthProbe | None = None) -> None:
        super().__init__(mesh, physics)
        self.physics, self.shape = physics, shape
        self.G, self.w = self.G0, self.w0  # of the stress-free state
        m, n_q = self.w0.shape
        self.memory = TruthHistory.none(mesh.nodes, self.face_area.size, (m, n_q), len(physics.prony))
        self._stress_now = np.zeros((m, n_q, 3, 3))  # of the last assembly
        self._tether = None
        if physics.tether is not None:
            self._tether = Tether.on(np.unique(self.free_faces), mesh.nodes, physics.tether)

    # ---- the fields at a time

    def _moduli(self, time: float) -> tuple[Array, Array]:
        E, nu = self.physics.youngs_modulus, self.physics.poisson_ratio
        factor = np.ones(self.w0.shape)
        for one in self.physics.modulus:
            factor = factor * one(self.places.reshape(-1, 3), time).reshape(factor.shape)
        return factor * E / (2 * (1 + nu)), factor * E / (3 * (1 - 2 * nu))

    def _stress_free(self, time: float) -> None:
        """Set the gradients and volumes of the stress-free state: F_e = F (J_s^1/3 F_p)^-1."""
        if not self.physics.growth and self.physics.plastic is None:
            return
        growth = np.ones(self.w0.shape)
        for one in self.physics.growth:
            growth = growth * one(self.places.reshape(-1, 3), time).reshape(growth.shape)
        inverse = growth[:, :, None, None] ** (-1 / 3) * np.eye(3)
        if self.physics.plastic is not None:
            values, vectors = np.linalg.eigh(self.memory.plastic)
            inverse = inverse @ np.einsum("...ij,...j,...kj->...ik", vectors, np.exp(-values), vectors)
        self.G = np.ascontiguousarray(np.einsum("mqkl,mqka->mqla", inverse, self.G0))
        self.w = self.w0 * growth

    # ---- steps

    def rest(self, gravity_steps: int = 3) -> TruthState:
        """Find the equilibrium at time 0 without the probe, relaxed: what a scanner sees after a long rest."""
        for s in range(1, gravity_steps + 1):
            state = self._equilibrium(None, 0.0, 0.0, s / gravity_steps, relaxed=True)
        if self.physics.plastic is not None:
            state = self._plastic_rounds(None, 0.0, 0.0, relaxed=True)
        self._remember(None, 0.0, 0.0, relaxed=True)
        return state

    def step(self, T: Array | None, time: float, longest_move: float = 0.0008) -> TruthState:
        """Go on to ``time`` (s) with the probe at T_phantom_probe (None: away); large moves are cut into small ones.

        Raises ConvergenceError where a step does not converge, however small.
        """
        start, t0 = self.memory.T, self.memory.time
        if self.physics.rubs:
            longest_move = min(longest_move, PATH_MOVE)
        if T is not None and start is None:
            self.memory.contact.anchor = self._local(T, self._face_places(self.memory.x))
        if self._untouched(T):
            self._remember(T, time, time - t0, relaxed=False)
            return TruthState(time, self.memory.x.copy(), np.zeros(3), np.zeros(3), 0)
        n = 1
        if T is not None and start is not None:
            n = max(1, int(np.ceil(np.linalg.norm(T[:3, 3] - start[:3, 3]) / longest_move)))
        done, share, depth, spent, state = 0.0, 1.0 / n, 0, 0, None
        while done < 1.0 - 1e-12:
            share = min(share, 1.0 - done)
            to = done + share
            kept = (self.memory.x.copy(), self.memory.contact.copy())
            try:
                pose = None if T is None else _between(start if start is not None else T, T, to)
                t = t0 + to * (time - t0)
                self._meet(pose)
                state = self._plastic_rounds(pose, t, t - self.memory.time, relaxed=False)
                self._remember(pose, t, t - self.memory.time, relaxed=False)
                done, spent = to, spent + state.n_iterations
            except ConvergenceError:
                self.memory.x, self.memory.contact = kept
                depth += 1
                share /= 2
                if depth > HALVINGS:
                    raise
        assert state is not None  # the loop runs at least once
        return replace(state, n_iterations=spent)

    def _untouched(self, T: Array | None) -> bool:
        """Return whether nothing changes: no contact before or after, and a body without memory or clock."""
        p = self.physics
        if p.prony or p.growth or p.modulus or self.memory.contact.pressure.any() or self.memory.contact.glued.any():
            return False
        self._points = self._face_places(self.memory.x)
        return T is None or self.shape is None or self.shape.distance(self._local(T, self._points))[0].min() > 0.0

    def _plastic_rounds(self, T: Array | None, time: float, dt: float, *, relaxed: bool) -> TruthState:
        state = self._equilibrium(T, time, dt, 1.0, relaxed=relaxed)
        if self.physics.plastic is not None:
            for _ in range(PLASTIC_ROUNDS):
                F = np.einsum("mad,mqka->mqdk", self.memory.x[self.mesh.hexes], self.G0)
                if self.memory.flow(F, *self.physics.plastic) < PLASTIC_CHANGE:
                    break
                state = self._equilibrium(T, time, dt, 1.0, relaxed=relaxed)
        return state

    def _remember(self, T: Array | None, time: float, dt: float, *, relaxed: bool) -> None:
        memory = self.memory
        if self.physics.prony:
            if not relaxed:
                memory.relax(self.physics.prony, dt, self._stress_now)
            memory.stress = self._stress_now.copy()
        if T is not None and self.physics.friction > 0.0 and self.shape is not None:
            self._move_anchors(T)
        if self.physics.adhesion > 0.0:  # where a step has ended: on its way a point may be pushed that ends free
            memory.contact.glued = memory.contact.glued | (memory.contact.pressure > 0.0)
        memory.T, memory.time = T, time

    def _meet(self, T: Array | None) -> None:
        """Put open points' anchors where the probe would meet them on its way to ``T`` if the surface kept still."""
        if T is None or self.shape is None or self.physics.friction == 0.0:
            return
        contact = self.memory.contact
        before, after = contact.anchor, self._local(T, self._face_places(self.memory.x))
        places = friction.met(before, after, self.shape.distance(before)[0], self.shape.distance(after)[0])
        is_open = (contact.pressure == 0.0) & ~contact.glued
        contact.anchor = np.where(is_open[:, None], places, before)

    def _move_anchors(self, T: Array) -> None:
        """Let anchors follow what does not stick. What sticks keeps its own, so that what it gives does not add up."""
        contact = self.memory.contact
        contact.anchor = np.where(contact.sticks[:, None], contact.anchor, self._local(T, self._points))

    # ---- equilibrium at one pose

    def _equilibrium(self, T: Array | None, time: float, dt: float, gravity: float, *, relaxed: bool) -> TruthState:
        """Solve by Newton's method, the contact's multipliers updated round it until nothing penetrates or gives."""
        self._stress_free(time)
        mu, K = self._moduli(time)
        branch, past = self.memory.viscous_part(() if relaxed else self.physics.prony, dt)
        total, load = 0, gravity * self._weight()
        while True:
            n_iterations, contact = self._settle(T, mu, K, branch, past, load)
            total += n_iterations
            if contact is None or not self._let_go(contact):
                break
        force, torque = self._wrench(contact)
        return TruthState(time, self.memory.x.copy(), force, torque, total)

    def _settle(
        self, T: Array | None, mu: Array, K: Array, branch: float, past: Array, load: Array
    ) -> tuple[int, Tractions | None]:
        """Solve with what is glued as it is; return the iterations spent and the contact."""
        total = 0
        for _ in range(ROUNDS):
            n_iterations, contact = self._newton(T, mu, K, branch, past, load)
            total += n_iterations
            if T is None or contact is None:
                return total, contact
            state = self.memory.contact
            # both ways: what penetrates, and what is still pushed though it has come off
            wrong = float(np.abs(contact.pressure - state.pressure).max(initial=0.0)) / self._penalty()
            slip = self._slip(contact)
            state.pressure, state.shear, state.sticks = contact.pressure, contact.shear, contact.sticks
            if wrong < self.gap_tolerance and slip < self.slip_tolerance:
                return total, contact
        raise ConvergenceError(f"contact is {1e6 * max(wrong, slip):.0f} um off after {ROUNDS} rounds")

    def _let_go(self, contact: Tractions) -> bool:
        """Let go of what has opened too far; return whether there is any. Asked where all else has settled, as it
        cannot be undone: on the way there a point may be open that ends closed."""
        state = self.memory.contact
        peeled = state.glued & (contact.gap > OPENING) & (contact.pressure <= -self.physics.adhesion)
        state.glued = state.glued & ~peeled
        return bool(peeled.any())

    def _newton(
        self, T: Array | None, mu: Array, K: Array, branch: float, past: Array, load: Array
    ) -> tuple[int, Tractions | None]:
        """Go to the equilibrium with ``load`` (n, 3) N; return the iterations spent and the contact."""

        def evaluate(x: Array) -> newton.Evaluation:
            data, force = np.zeros(self.n_data), np.zeros_like(x)
            smallest, contact = self._assemble(x, T, mu, K, branch, past, data, force)
            sound = smallest > 0.0 and bool(np.isfinite(force).all())
            return newton.Evaluation(sound, data, (load - force).reshape(-1)[self.free], contact)

        self.memory.x, n_iterations, contact = newton.solve(
            self.memory.x,
            self.free,
            evaluate,
            self.factors,
            symmetric=self.physics.friction == 0.0,
            tolerance=self.tolerance,
        )
        return n_iterations, contact

    def _assemble(
        self, x: Array, T: Array | None, mu: Array, K: Array, branch: float, past: Array, data: Array, force: Array
    ) -> tuple[float, Tractions | None]:
        """Add everything to ``data`` and ``force`` (n, 3) N; return the smallest J and the contact."""
        fibre, direction = self.physics.fibre or (0.0, (0.0, 0.0, 1.0))
        smallest = kernels.assemble(
            x, self.mesh.hexes, self.G, self.w, self.psi, mu, K, self.physics.stiffening, fibre,
            np.asarray(direction, float), branch, past, self.position, data, force, self._stress_now, True,
        )  # fmt: skip
        if self.physics.base_stiffness is not None:
            u = (x - self.mesh.nodes)[self.base_faces]
            np.add.at(force, self.base_faces, np.einsum("faibj,fbj->fai", self.spring_block, u))
            kernels.scatter_faces(self.spring_block, self.base_faces, self.base_position, data)
        self._add_tether(x, data, force)
        contact = None if T is None or self.shape is None else self._contact(x, T, data, force)
        return float(smallest), contact

    def _add_tether(self, x: Array, data: Array, force: Array) -> None:
        pulled = None if self._tether is None else self._tether.pull(x)
        if self._tether is None or pulled is None:
            return
        force[self._tether.nodes] += pulled[0]
        for a in self._tether.nodes:
            for i, at in enumerate(self.block_of_node(int(a))):
                data[at : at + 3] += pulled[1][i]

    # ---- contact

    def _contact(self, x: Array, T: Array, data: Array, force: Array) -> Tractions:
        n_q = self.face_N.shape[0]
        self._points = self._face_places(x)
        t = self._tractions(T, self._points)
        touched = np.flatnonzero((np.abs(t.pressure) > 0).reshape(-1, n_q).any(1))
        if len(touched):
            area = self.face_area[touched]
            traction = t.traction.reshape(-1, n_q, 3)[touched] * area[:, :, None]
            faces = self.free_faces[touched]
            np.add.at(force, faces, -np.einsum("qa,fqi->fai", self.face_N, traction))
            stiffness = t.stiffness.reshape(-1, n_q, 3, 3)[touched] * area[:, :, None, None]
            blocks = np.einsum("qa,fqij,qb->faibj", self.face_N, stiffness, self.face_N, optimize=True)
            kernels.scatter_faces(np.ascontiguousarray(blocks), faces, self.free_position[touched], data)
        return t

    def _tractions(self, T: Array, points: Array) -> Tractions:
        """Return what the probe at T_phantom_probe does to ``points`` (p, 3) m of the surface."""
        assert self.shape is not None  # nobody asks without a probe
        p = self.physics
        return tractions(self.shape, T, points, self.memory.contact, self._penalty(), p.friction, p.adhesion)

    def _slip(self, contact: Tractions) -> float:
        """Return how far (m) points gave in the last round that should have stuck, at most."""
        limit = self.physics.friction * np.maximum(contact.pressure, 0.0)
        return friction.unsettled(contact.shear, contact.sticks, self.memory.contact.shear, limit, self._penalty())

    @staticmethod
    def _local(T: Array, points: Array) -> Array:
        return (points - T[:3, 3]) @ T[:3, :3]

    def _penalty(self) -> float:
        return 5.0 * self.physics.youngs_modulus / 0.002

    def _weight(self) -> Array:
        weight: Array = self.physics.density * self.volume[:, None] * np.asarray(self.physics.gravity)
        return weight

    def _wrench(self, contact: Tractions | None) -> tuple[Array, Array]:
        if contact is None:
            return np.zeros(3), np.zeros(3)
        forces = contact.traction * self.face_area.reshape(-1, 1)
        return forces.sum(0), np.cross(self._points, forces).sum(0)


def _between(a: Array, b: Array, s: float) -> Array:
    """Return the pose (4, 4) at the share ``s`` of the path from ``a`` to ``b``."""
    T = np.eye(4)
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    T[:3, :3] = a[:3, :3] @ Rotation.from_rotvec(s * turn).as_matrix()
    T[:3, 3] = (1 - s) * a[:3, 3] + s * b[:3, 3]
    return T
