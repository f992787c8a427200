"""The truth's body: quasi-static equilibrium in small steps of time, with everything that the scenarios ask for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.synthetic.truth import kernels
from livedeform.synthetic.truth.hexmesh import HexMesh, IntArray, face_gradient, face_shape, gauss, hex_shape
from livedeform.synthetic.truth.linear import Factors
from livedeform.synthetic.truth.probe import OPENING, TruthContact, TruthProbe, tractions

Field = Callable[[Array, float], Array]  # stress-free places (n, 3), time -> factor (n,)
PEELING_MOVE = 5e-4  # m that the probe goes at most at a time while it may stick: what lets go depends on the way
ROUNDS = 40  # of contact at one pose, at most; where a probe sticks, one ring of points lets go after the other
CONTACT_POINTS = 4  # along each side of a face: twice as many take twice the iterations, for 0.1-0.8 % of a force


@dataclass(frozen=True)
class TruthPhysics:
    """What the true phantom is like; see the interfaces' names of effects for the meaning of the values.

    ``modulus`` multiplies both moduli, ``growth`` is the stress-free volume ratio, both fields of place and time.
    ``base_stiffness`` Pa/m (None: bonded); ``base_free``: places of the base that are not held; ``prony`` ((g, tau),
    ..);
    ``plastic`` (fraction, threshold); ``fibre`` (stiffness / mu, direction); ``tether``: (place on the surface,
    radius m,
    end of the string, stiffness N/m, slack m): it pulls when longer than at the start plus slack.
    """

    youngs_modulus: float
    poisson_ratio: float = 0.49
    density: float = 1000.0
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    stiffening: float = 0.0
    modulus: tuple[Field, ...] = ()
    growth: Field | None = None
    prony: tuple[tuple[float, float], ...] = ()
    plastic: tuple[float, float] | None = None
    base_stiffness: float | None = None
    base_free: Callable[[Array], NDArray[np.bool_]] | None = None
    fibre: tuple[float, tuple[float, float, float]] | None = None
    tether: tuple[Array, float, Array, float, float] | None = None
    friction: float = 0.0
    adhesion: float = 0.0

    def changed(self, **changes: object) -> TruthPhysics:
        return replace(self, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class TruthState:
    """One solved moment: places ``x`` (n, 3) m; force (3,) N and torque (3,) N m of the probe on the body, the torque
    about the phantom's origin; Newton iterations spent."""

    time: float
    x: Array
    force: Array
    torque: Array
    n_iterations: int


@dataclass
class _Memory:
    """What the body carries from step to step."""

    x: Array
    contact: TruthContact
    time: float
    T: Array | None
    stress: Array  # isochoric elastic second Piola stress of the last step
    viscous: Array  # (terms, m, q, 3, 3)
    plastic: Array  # (m, q, 3, 3) logarithm of F_p
    worst: Array  # (m, q) largest |h| so far
    iterations: int = field(default=0)


class TruthBody:
    """A body on its base z = 0. ``rest`` is the equilibrium at the start; ``step`` goes on to a time and a probe
    pose."""

    tolerance = 5e-7  # m, of the last Newton correction
    gap_tolerance = 2e-5  # m, by which contact may be off: what penetrates as well as what is pushed from afar

    def __init__(self, mesh: HexMesh, physics: TruthPhysics, shape: TruthProbe | None = None) -> None:
        self.mesh, self.physics, self.shape = mesh, physics, shape
        self._elements()
        self._faces()
        self._hold()
        self._graph()
        n_q = self.w.shape[1]
        m = len(mesh.hexes)
        self.memory = _Memory(
            mesh.nodes.copy(),
            TruthContact.none(self.face_area.size),
            0.0,
            None,
            np.zeros((m, n_q, 3, 3)),
            np.zeros((len(physics.prony), m, n_q, 3, 3)),
            np.zeros((m, n_q, 3, 3)),
            np.zeros((m, n_q)),
        )

    # ---- set-up

    def _elements(self) -> None:
        points, weights = gauss(3, 3)
        shape, local = hex_shape(points)
        self.G0, det = kernels.gradients(self.mesh.nodes, self.mesh.hexes, local)
        self.w0 = np.ascontiguousarray(det * weights)
        self.G, self.w = self.G0, self.w0
        self.psi = np.column_stack([np.ones(len(points)), points])
        self.places = np.einsum("qa,mad->mqd", shape, self.mesh.nodes[self.mesh.hexes])
        self._stress_now = np.zeros((*self.w0.shape, 3, 3))  # of the last assembly
        lumped = np.einsum("mq,qa->ma", self.w0, shape)
        self.volume = np.bincount(self.mesh.hexes.reshape(-1), lumped.reshape(-1), len(self.mesh.nodes))

    def _faces(self) -> None:
        points, weights = gauss(CONTACT_POINTS, 2)
        self.face_N = face_shape(points)
        dN = face_gradient(points)
        corners = self.mesh.nodes[self.mesh.faces]
        tangents = np.einsum("qla,fad->fqld", dN, corners)
        area = np.linalg.norm(np.cross(tangents[:, :, 0], tangents[:, :, 1]), axis=2) * weights
        self.is_base = (np.abs(corners[:, :, 2]) < 1e-9).all(1)
        self.free_faces = self.mesh.faces[~self.is_base]
        self.base_faces = self.mesh.faces[self.is_base]
        self.face_area = area[~self.is_base]
        self.base_area = area[self.is_base]

    def _hold(self) -> None:
        nodes = self.mesh.nodes
        on_base = np.zeros(len(nodes), bool)
        on_base[self.base_faces] = True
        if self.physics.base_free is not None:
            on_base &= ~self.physics.base_free(nodes)
        self.held_nodes = on_base
        held = np.zeros((len(nodes), 3), bool)
        held[on_base, 2] = True
        if self.physics.base_stiffness is None:
            held[on_base] = True
        self.free = np.flatnonzero(~held.reshape(-1))
        self.spring_block = np.zeros(0)
        if self.physics.base_stiffness is not None:
            M = np.einsum("fq,qa,qb->fab", self.base_area, self.face_N, self.face_N) * self.physics.base_stiffness
            self.spring_block = np.einsum("fab,ij->faibj", M, np.diag([1.0, 1.0, 0.0]))

    def _graph(self) -> None:
        """The matrix's pattern, and where each element's and face's entries go."""
        n = len(self.mesh.nodes)
        hexes = self.mesh.hexes
        rows = np.repeat(hexes, 27, axis=1).reshape(-1)
        cols = np.tile(hexes, (1, 27)).reshape(-1)
        keys, inverse = np.unique(rows * n + cols, return_inverse=True)
        row, col = keys // n, keys % n
        start = np.searchsorted(row, np.arange(n + 1))
        # row 3a + i holds the triples of all neighbours of a
        width = np.diff(start)
        row_start = 9 * start[:-1]
        pair_at = row_start[row] + 3 * (np.arange(len(keys)) - start[row])
        stride = 3 * width[row]
        at = pair_at[:, None] + stride[:, None] * np.arange(3)
        self._keys, self._at, self._n = keys, at, n
        self.position = np.ascontiguousarray(at[inverse].reshape(len(hexes), 27, 27, 3).astype(np.int64))
        self.free_position = self._face_position(self.free_faces)
        self.base_position = self._face_position(self.base_faces)
        self.n_data = 9 * len(keys)
        dof_row = np.repeat(np.arange(3 * n), np.repeat(3 * width, 3))
        dof_col = np.empty(self.n_data, np.int64)
        for i in range(3):
            for j in range(3):
                dof_col[at[:, i] + j] = 3 * col + j
        number = np.full(3 * n, -1)
        number[self.free] = np.arange(len(self.free))
        keep = (number[dof_row] >= 0) & (number[dof_col] >= 0)
        self.factors = Factors(number[dof_row[keep]], number[dof_col[keep]], np.flatnonzero(keep), len(self.free))

    def _face_position(self, faces: IntArray) -> Array:
        rows = np.repeat(faces, 9, axis=1).reshape(-1).astype(np.int64)
        cols = np.tile(faces, (1, 9)).reshape(-1).astype(np.int64)
        found = np.searchsorted(self._keys, rows * self._n + cols)
        return np.ascontiguousarray(self._at[found].reshape(len(faces), 9, 9, 3))

    # ---- the fields at a time

    def _moduli(self, time: float) -> tuple[Array, Array]:
        E, nu = self.physics.youngs_modulus, self.physics.poisson_ratio
        factor = np.ones(self.w0.shape)
        for one in self.physics.modulus:
            factor = factor * one(self.places.reshape(-1, 3), time).reshape(factor.shape)
        return factor * E / (2 * (1 + nu)), factor * E / (3 * (1 - 2 * nu))

    def _stress_free(self, time: float) -> None:
        """Gradients and volumes of the stress-free state: F_e = F (J_s^1/3 F_p)^-1."""
        if self.physics.growth is None and self.physics.plastic is None:
            return
        growth = np.ones(self.w0.shape)
        if self.physics.growth is not None:
            growth = self.physics.growth(self.places.reshape(-1, 3), time).reshape(growth.shape)
        inverse = growth[:, :, None, None] ** (-1 / 3) * np.eye(3)
        if self.physics.plastic is not None:
            values, vectors = np.linalg.eigh(self.memory.plastic)
            inverse = inverse @ np.einsum("...ij,...j,...kj->...ik", vectors, np.exp(-values), vectors)
        self.G = np.ascontiguousarray(np.einsum("mqkl,mqka->mqla", inverse, self.G0))
        self.w = self.w0 * growth

    # ---- solving

    def rest(self, gravity_steps: int = 3) -> TruthState:
        """Equilibrium at time 0 without the probe, relaxed: what a scanner sees after a long rest."""
        for s in range(1, gravity_steps + 1):
            state = self._equilibrium(None, 0.0, 0.0, s / gravity_steps, relaxed=True)
        if self.physics.plastic is not None:
            state = self._plastic_rounds(None, 0.0, 0.0, relaxed=True)
        self._remember(None, 0.0, 0.0, relaxed=True)
        return state

    def step(self, T: Array | None, time: float, longest_move: float = 0.0008) -> TruthState:
        """Go on to ``time`` (s) with the probe at T_phantom_probe (None: away); large moves are cut into small ones."""
        start, t0 = self.memory.T, self.memory.time
        if self.physics.adhesion > 0.0:
            longest_move = min(longest_move, PEELING_MOVE)
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
                state = self._plastic_rounds(pose, t, t - self.memory.time, relaxed=False)
                self._remember(pose, t, t - self.memory.time, relaxed=False)
                done, spent = to, spent + state.n_iterations
            except ConvergenceError:
                self.memory.x, self.memory.contact = kept
                depth += 1
                share /= 2
                if depth > 8:
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

    def _face_places(self, x: Array) -> Array:
        """(p, 3) m of all quadrature points of the free faces."""
        places: Array = np.einsum("qa,fad->fqd", self.face_N, x[self.free_faces]).reshape(-1, 3)
        return places

    @staticmethod
    def _local(T: Array, points: Array) -> Array:
        return (points - T[:3, 3]) @ T[:3, :3]

    def _plastic_rounds(self, T: Array | None, time: float, dt: float, *, relaxed: bool) -> TruthState:
        state = self._equilibrium(T, time, dt, 1.0, relaxed=relaxed)
        if self.physics.plastic is not None:
            for _ in range(6):
                if self._flow() < 2e-4:
                    break
                state = self._equilibrium(T, time, dt, 1.0, relaxed=relaxed)
        return state

    def _flow(self) -> float:
        """Plastic strain after the largest isochoric Hencky strain so far; returns the largest change."""
        fraction, threshold = self.physics.plastic or (0.0, 1.0)
        F = np.einsum("mad,mqka->mqdk", self.memory.x[self.mesh.hexes], self.G0)
        values, vectors = np.linalg.eigh(np.einsum("mqij,mqik->mqjk", F, F))
        h = 0.5 * np.log(values)
        h -= h.mean(-1, keepdims=True)
        size = np.sqrt((h * h).sum(-1))
        grown = size > np.maximum(self.memory.worst, threshold)
        strain = np.einsum("mqij,mqj,mqkj->mqik", vectors, h, vectors)
        share = fraction * (1.0 - threshold / np.maximum(size, 1e-12))
        new = np.where(grown[:, :, None, None], share[:, :, None, None] * strain, self.memory.plastic)
        change = float(np.abs(new - self.memory.plastic).max())
        self.memory.plastic = new
        self.memory.worst = np.where(grown, size, self.memory.worst)
        return change

    def _equilibrium(self, T: Array | None, time: float, dt: float, gravity: float, *, relaxed: bool) -> TruthState:
        """Newton's method, with the contact's multipliers and anchors updated round it until nothing penetrates."""
        self._stress_free(time)
        mu, K = self._moduli(time)
        branch, history = self._viscous(dt, relaxed=relaxed)
        total = 0
        for _ in range(ROUNDS):
            n_iterations, contact = self._newton(T, mu, K, branch, history, gravity * self._weight())
            total += n_iterations
            if T is None or contact is None:
                break
            state = self.memory.contact
            # both ways: what penetrates, and what is still pushed though it has come off
            wrong = float(np.abs(contact.pressure - state.pressure).max(initial=0.0)) / self._penalty()
            state.pressure = contact.pressure
            peeled = state.glued & (contact.gap > OPENING) & (contact.pressure <= -self.physics.adhesion)
            if self.physics.adhesion > 0.0:
                state.glued = (state.glued | (contact.pressure > 0.0)) & ~peeled
            if not peeled.any() and wrong < self.gap_tolerance:
                break
        else:
            raise ConvergenceError(f"contact is {1e6 * wrong:.0f} um off after {ROUNDS} rounds")
        force, torque = self._wrench(contact)
        return TruthState(time, self.memory.x.copy(), force, torque, total)

    def _newton(self, T, mu, K, branch, history, load):  # type: ignore[no-untyped-def]
        """Solve r(x) = 0 with a line search along each correction; ``ConvergenceError`` if that fails."""

        curvature, symmetric = True, self.physics.friction == 0.0

        def evaluate(x):  # type: ignore[no-untyped-def]
            data, force = np.zeros(self.n_data), np.zeros_like(x)
            smallest, contact = self._assemble(x, T, mu, K, branch, history, data, force, curvature)
            sound = smallest > 0.0 and bool(np.isfinite(force).all())
            return sound, data, (load - force).reshape(-1)[self.free], contact

        x = self.memory.x
        sound, data, residual, contact = evaluate(x)
        if not sound:
            raise ConvergenceError("an element is inside out")
        for iteration in range(1, 41):
            curvature = iteration <= 8  # what has not converged by then cycles: leave out what can make it do so
            correction = self.factors.solve(data, residual, symmetric=symmetric)
            largest = float(np.abs(correction).max())
            if not np.isfinite(largest) or largest > 0.5:
                raise ConvergenceError("the tangent is singular")
            if largest < self.tolerance:
                self.memory.x = _moved(x, self.free, correction)
                return iteration, contact
            correction *= min(1.0, 0.004 / largest)
            if symmetric and residual @ correction < 0.0:  # the tangent is indefinite there: go downhill all the same
                correction = -correction
            x, (sound, data, residual, contact) = self._along(x, correction, residual, evaluate)
            if not sound:
                raise ConvergenceError("an element turned inside out")
        raise ConvergenceError(f"no equilibrium after {iteration} iterations (last correction {largest:.2g} m)")

    def _along(self, x, correction, residual, evaluate):  # type: ignore[no-untyped-def]
        """Go along a correction until the energy's slope has turned little: with contact the full step overshoots."""
        start = float(residual @ correction)
        share, low, high = 1.0, 0.0, 1.0
        slope_low, slope_high, bounded = start, 0.0, False
        for _ in range(7):
            trial = _moved(x, self.free, share * correction)
            found = evaluate(trial)
            slope = float(found[2] @ correction) if found[0] else -np.inf
            if slope > -0.4 * abs(start) and (not bounded or slope < 0.6 * abs(start)):
                break
            if slope < 0.0:
                high, slope_high, bounded = share, slope, True
            else:
                low, slope_low = share, slope
            if not np.isfinite(slope_high):
                share = 0.5 * (low + high)
            else:
                fraction = slope_low / (slope_low - slope_high)
                share = low + (high - low) * min(max(fraction, 0.1), 0.9)
        return trial, found

    def _assemble(self, x, T, mu, K, branch, history, data, force, curvature):  # type: ignore[no-untyped-def]
        fibre, direction = self.physics.fibre or (0.0, (0.0, 0.0, 1.0))
        smallest = kernels.assemble(
            x, self.mesh.hexes, self.G, self.w, self.psi, mu, K, self.physics.stiffening, fibre,
            np.asarray(direction, float), branch, history, self.position, data, force, self._stress_now, True,
        )  # fmt: skip
        if self.physics.base_stiffness is not None:
            u = (x - self.mesh.nodes)[self.base_faces]
            np.add.at(force, self.base_faces, np.einsum("faibj,fbj->fai", self.spring_block, u))
            kernels.scatter_faces(self.spring_block, self.base_faces, self.base_position, data)
        self._tether(x, data, force)
        contact = None if T is None or self.shape is None else self._contact(x, T, data, force, curvature)
        return smallest, contact

    def _contact(self, x: Array, T: Array, data: Array, force: Array, curvature: bool):  # type: ignore[no-untyped-def]
        assert self.shape is not None
        n_q = self.face_N.shape[0]
        self._points = self._face_places(x)
        t = tractions(
            self.shape,
            T,
            self._points,
            self.memory.contact,
            self._penalty(),
            self.physics.friction,
            self.physics.adhesion,
        )
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

    def _tether(self, x: Array, data: Array, force: Array) -> None:
        if self.physics.tether is None:
            return
        place, radius, end, stiffness, slack = self.physics.tether
        if not hasattr(self, "_tethered"):
            near = np.unique(self.free_faces)
            near = near[np.linalg.norm(self.mesh.nodes[near] - place, axis=1) < radius]
            self._tethered = near
            self._string = np.linalg.norm(self.mesh.nodes[near].mean(0) - end) + slack
        middle = x[self._tethered].mean(0)
        v = middle - end
        length = float(np.linalg.norm(v))
        stretch = length - self._string
        if stretch <= 0.0:
            return
        n, k = v / length, len(self._tethered)
        force[self._tethered] += stiffness * stretch * n / k
        # each node's own diagonal block alone: a secant that converges, not the full rank-one tangent
        block = stiffness * (np.outer(n, n) + stretch / length * (np.eye(3) - np.outer(n, n))) / k
        for a in self._tethered:
            at = self._at[np.searchsorted(self._keys, a * self._n + a)]
            for i in range(3):
                data[at[i] : at[i] + 3] += block[i]

    def _penalty(self) -> float:
        return 5.0 * self.physics.youngs_modulus / 0.002

    def _weight(self) -> Array:
        return self.physics.density * self.volume[:, None] * np.asarray(self.physics.gravity)

    def _wrench(self, contact) -> tuple[Array, Array]:  # type: ignore[no-untyped-def]
        if contact is None:
            return np.zeros(3), np.zeros(3)
        forces = contact.traction * self.face_area.reshape(-1, 1)
        return forces.sum(0), np.cross(self._points, forces).sum(0)

    # ---- memory

    def _viscous(self, dt: float, *, relaxed: bool) -> tuple[float, Array]:
        """1 + sum gamma exp(-dt/2 tau), and the past's part of the stress (Holzapfel 2000, 6.10):
        Q <- exp(-dt/tau) Q + gamma exp(-dt/2 tau) (S_new - S_old), gamma = g / (1 - sum g) of the relaxed stress."""
        history = np.zeros_like(self.memory.stress)
        if not self.physics.prony or relaxed:
            return 1.0, history
        left = 1.0 - sum(g for g, _ in self.physics.prony)
        branch = 1.0
        for k, (g, tau) in enumerate(self.physics.prony):
            gamma = g / left * np.exp(-dt / (2 * tau))
            branch += gamma
            history += np.exp(-dt / tau) * self.memory.viscous[k] - gamma * self.memory.stress
        return branch, history

    def _remember(self, T: Array | None, time: float, dt: float, *, relaxed: bool) -> None:
        memory = self.memory
        if self.physics.prony:
            stress = self._stress_now
            if not relaxed:
                left = 1.0 - sum(g for g, _ in self.physics.prony)
                for k, (g, tau) in enumerate(self.physics.prony):
                    gamma = g / left * np.exp(-dt / (2 * tau))
                    memory.viscous[k] = np.exp(-dt / tau) * memory.viscous[k] + gamma * (stress - memory.stress)
            memory.stress = stress.copy()
        if T is not None and self.physics.friction > 0.0 and self.shape is not None:
            self._move_anchors(T)
        memory.T, memory.time = T, time

    def _move_anchors(self, T: Array) -> None:
        """Anchors follow sliding points, so that the spring's force is what was found; open points forget theirs."""
        assert self.shape is not None
        state = self.memory.contact
        t = tractions(self.shape, T, self._points, state, self._penalty(), self.physics.friction, self.physics.adhesion)
        state.anchor = self._local(T, self._points) + t.shear / (self._penalty() / 3.0)


def _moved(x: Array, free: IntArray, correction: Array) -> Array:
    moved = x.copy()
    moved.reshape(-1)[free] += correction
    return moved


def _between(a: Array, b: Array, s: float) -> Array:
    """The pose s of the way from a to b (4, 4)."""
    T = np.eye(4)
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    T[:3, :3] = a[:3, :3] @ Rotation.from_rotvec(s * turn).as_matrix()
    T[:3, 3] = (1 - s) * a[:3, 3] + s * b[:3, 3]
    return T
