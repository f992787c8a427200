"""A truth that nobody here wrote: elements, law and assembly by felupe (`benchmarks.blind.felupe_body`).

    pip install 'livedeform[benchmark]'

Shared with `livedeform.synthetic.truth` are the shapes of body and probe, what the effects mean, and the calls of the
sparse solver. Contact is a plain penalty at points of the surface, and Newton's method is written out below.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from benchmarks.blind.felupe_body import FelupeBody, felupe, lattice
from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.types import Array
from livedeform.synthetic.solved_motion import KeyStates, has_clock, path_lengths, solved_times
from livedeform.synthetic.trajectory import ProbePath
from livedeform.synthetic.true_effects import World
from livedeform.synthetic.truth.hexmesh import IntArray
from livedeform.synthetic.truth.linear import Factors
from livedeform.synthetic.truth.probe import TruthProbe

PENALTY = 1e5  # of the modulus per m of overclosure: 10 um where the pressure is the modulus
SOFT = 4e-6  # m: over this gap contact sets in gradually
TOLERANCE = 2e-7  # m, of the last correction
LONGEST = 0.004  # m that a node goes at most in one iteration
ITERATIONS, HALVINGS = 40, 6
SAME = 1e-7  # m, to which two poses are the same
TOUCHES = 0.001  # m off the body at rest, from which a pose is solved
LIFT = np.array([0.0, 0.0, 0.003])  # m, from where the first pose of a run is reached if it is too far from rest
POINTS = 4  # of contact, in each direction of a face


class FelupeTruth:
    """Solve a world's body with felupe; see `livedeform.synthetic.solved_motion.TruthSolver`.

    Takes effects on stiffness (fields that do not change in time), volume, weight, gravity and the base. Raises
    InputError for any other, and without felupe; ConvergenceError where Newton's method gives up.
    """

    def __init__(self, world: World, shape: TruthProbe) -> None:
        _refuse(world)
        self.mesh, self.physics, self.shape = world.mesh, world.physics, shape
        self._body = FelupeBody(self.mesh, self.physics)
        fe = felupe()
        quad, rule = fe.element.BiQuadraticQuad(), fe.GaussLegendre(order=POINTS - 1, dim=2)
        faces = self.mesh.faces[:, lattice(quad)]
        self._shape = np.stack([quad.function(p) for p in rule.points])
        slope = np.stack([quad.gradient(p) for p in rule.points])
        tangents = np.einsum("qal,fad->fqld", slope, self.mesh.nodes[faces])
        area = np.linalg.norm(np.cross(tangents[:, :, 0], tangents[:, :, 1]), axis=2) * rule.weights
        base = (np.abs(self.mesh.nodes[faces][:, :, 2]) < 1e-9).all(1)
        self._pattern(np.zeros_like(self.mesh.nodes))
        self._faces, self._area = faces[~base], area[~base]
        self._at = self._positions(self._faces)
        self._hold(faces[base], area[base])
        self._at_rest: dict[float, Array] = {}

    def _pattern(self, u: Array) -> None:
        """Number the entries of the stiffness by row and column."""
        self._body.inner(u)
        K = self._body.stiffness()
        self._rows = np.repeat(np.arange(u.size), np.diff(K.indptr))
        self._columns = K.indices.astype(np.int64)
        self._keys = self._rows * u.size + self._columns
        if not (np.diff(self._keys) > 0).all():
            raise AssertionError("felupe's matrix is no longer sorted")

    def _positions(self, faces: IntArray) -> IntArray:
        """Return where (k, 27, 27) the entries between the unknowns of ``faces`` (k, 9) are among all of them."""
        unknowns = (3 * faces[:, :, None] + np.arange(3)).reshape(-1, 27)
        n = self.mesh.nodes.size
        found: IntArray = np.searchsorted(self._keys, unknowns[:, :, None] * n + unknowns[:, None, :])
        return found

    def _hold(self, base: IntArray, area: Array) -> None:
        """Find the free unknowns and, of a base that slips, its springs."""
        nodes = self.mesh.nodes
        on_base = np.zeros(len(nodes), bool)
        on_base[base] = True
        if self.physics.base_free is not None:
            on_base &= ~self.physics.base_free(nodes)
        held = np.zeros(nodes.shape, bool)
        held[on_base, 2] = True
        self._springs = np.zeros(len(self._keys))
        if self.physics.base_stiffness is None:
            held[on_base] = True
        else:
            M = self.physics.base_stiffness * np.einsum("fq,qa,qb->fab", area, self._shape, self._shape)
            blocks = np.einsum("fab,ij->faibj", M, np.diag([1.0, 1.0, 0.0]))
            np.add.at(self._springs, self._positions(base), blocks.reshape(-1, 27, 27))
        self._spring_matrix = csr_matrix((self._springs, (self._rows, self._columns)), (nodes.size, nodes.size))
        self._held = held.ravel()
        number = np.cumsum(~self._held) - 1
        taken = np.flatnonzero(~(self._held[self._rows] | self._held[self._columns]))
        n = int((~self._held).sum())
        self._factors = Factors(number[self._rows[taken]], number[self._columns[taken]], taken, n)

    def rest(self) -> Array:
        """Return the places (n, 3) m of the mesh's nodes at rest."""
        return self._free(float(self._expansions(np.zeros(1))[0]))

    def close(self) -> None:
        """Give back the matrix's factors."""
        self._factors.close()

    def recording(
        self, trajectory: ProbePath, clock: float, spec: Mapping[str, Any], tell: Callable[[float], None]
    ) -> KeyStates:
        """Return the key states of a recording that starts at ``clock`` s.

        A body that grows is taken to go straight from its coldest to its warmest rest: 1e-6 of its size where lengths
        grow by 1e-3.
        """
        rest = self.rest()
        times = solved_times(self.physics, trajectory, float(rest[:, 2].max()), spec)
        poses = np.stack([trajectory(float(t)) for t in times])
        if np.ptp(poses[:, :3, :3], axis=0).max() > 1e-9:
            raise InputError("this truth's probe does not turn", where="recordings", remedy="press without tilt")
        x = np.broadcast_to(rest, (len(times), *rest.shape)).copy()
        wrench = np.zeros((len(times), 6))
        warm = self._expansions(clock + times)
        if self.physics.growth:
            cold, hot = self._free(float(warm.min())), self._free(float(warm.max()))
            share = (warm - warm.min()) / max(float(np.ptp(warm)), 1e-12)
            x = cold + share[:, None, None] * (hot - cold)
        chains = list(self._chains(poses, rest, warm))
        for n, chain in enumerate(chains):
            solved = self.pressed([poses[k] for k in chain], warm[chain], rest)
            for k, (places, force) in zip(chain, solved, strict=True):
                same = self._same(poses, warm, k)
                x[same], wrench[same] = places, force
            tell((n + 1) / len(chains))
        return KeyStates(times, path_lengths(trajectory, times), x, wrench[:, :3], wrench[:, 3:])

    # ---- what is solved

    def _chains(self, poses: Array, rest: Array, warm: Array) -> Iterable[list[int]]:
        """Yield the poses that touch, each once, in runs that never rise: a rising probe loses its contact.

        Nothing depends on the way: what is solved on the way up may as well be reached from above.
        """
        surface = rest[np.unique(self.mesh.faces)]
        down: list[int] = []
        up: list[int] = []
        seen = np.zeros(len(poses), bool)
        for k, T in enumerate(poses):
            if self.shape.distance((surface - T[:3, 3]) @ T[:3, :3])[0].min() > TOUCHES:
                yield from (chain for chain in (down, up[::-1]) if chain)
                down, up = [], []
            elif not seen[k]:
                rises = bool(up) or (bool(down) and T[2, 3] > poses[down[-1], 2, 3] + SAME)
                (up if rises else down).append(k)
                seen |= self._same(poses, warm, k)
        yield from (chain for chain in (down, up[::-1]) if chain)

    @staticmethod
    def _same(poses: Array, warm: Array, k: int) -> NDArray[np.bool_]:
        """Return which moments (k,) are as moment ``k``: the same pose, and as warm."""
        near: NDArray[np.bool_] = np.abs(poses[:, :3, 3] - poses[k, :3, 3]).max(1) < SAME
        same: NDArray[np.bool_] = near & (np.abs(warm - warm[k]) < 1e-9)
        return same

    def _expansions(self, moments: Array) -> Array:
        """Return by which share (k,) each length of the body has grown at ``moments`` (k,) s."""
        growth = np.ones(len(moments))
        for one in self.physics.growth:
            growth *= [float(one(np.zeros((1, 3)), float(t))[0]) for t in moments]
        return growth ** (1 / 3) - 1.0

    def _free(self, warm: float) -> Array:
        """Return the places (n, 3) m without the probe, each length grown by the share ``warm``."""
        key = round(warm, 9)
        if key not in self._at_rest:
            self._body.growth = (1.0 + warm) ** 3
            u = np.zeros_like(self.mesh.nodes)
            for share in (0.25, 0.5, 0.75, 1.0):
                u = self._newton(u, share, None)[0]
            self._at_rest[key] = self.mesh.nodes + u
        return self._at_rest[key]

    def pressed(self, poses: Sequence[Array], warm: Array, rest: Array) -> list[tuple[Array, Array]]:
        """Return the nodes' places (n, 3) m and the probe's wrench (6,) N, N m at each pose, reached from above."""
        u = rest - self.mesh.nodes
        before = poses[0].copy()
        before[:3, 3] += LIFT
        out = []
        for T, w in zip(poses, warm, strict=True):
            self._body.growth = (1.0 + float(w)) ** 3
            u, wrench = self._go(u, before, T, HALVINGS)
            out.append((self.mesh.nodes + u, wrench))
            before = T
        return out

    def _go(self, u: Array, a: Array, b: Array, halvings: int) -> tuple[Array, Array]:
        """Go from the equilibrium ``u`` (n, 3) m at pose ``a`` to that at ``b``, by halves where it must be."""
        try:
            return self._newton(u, 1.0, b)
        except ConvergenceError:
            if halvings == 0:
                raise
        middle = b.copy()
        middle[:3, 3] = 0.5 * (a[:3, 3] + b[:3, 3])
        return self._go(self._go(u, a, middle, halvings - 1)[0], middle, b, halvings - 1)

    def _newton(self, u: Array, share: float, T: Array | None) -> tuple[Array, Array]:
        """Return the equilibrium (n, 3) m under a share of the weight, and the probe's wrench (6,) N, N m."""
        free = ~self._held
        residual, touching = self._residual(u, share, T)
        for _ in range(ITERATIONS):
            tangent = self._body.stiffness().data + self._springs
            if touching is not None:
                np.add.at(tangent, self._at[touching.faces], touching.stiffness)
            step = np.zeros(u.size)
            step[free] = self._factors.solve(tangent, residual[free], symmetric=True)
            largest = float(np.abs(step).max())
            if not np.isfinite(largest) or largest > 1.0:
                break
            step *= min(1.0, LONGEST / max(largest, TOLERANCE))
            start = float(residual @ step)
            length = 1.0
            for _ in range(8):
                trial = u + length * step.reshape(u.shape)
                residual, touching = self._residual(trial, share, T)
                slope = float(residual @ step)
                if np.isfinite(slope) and abs(slope) <= 0.8 * abs(start):
                    break
                length *= 0.5
            u = trial
            if length * largest < TOLERANCE:
                return u, np.zeros(6) if touching is None else touching.wrench
        raise ConvergenceError(f"no equilibrium after {ITERATIONS} iterations")

    def _residual(self, u: Array, share: float, T: Array | None) -> tuple[Array, Touching | None]:
        """Return load minus inner force (3 n,) N, zero where held, and the contact at a pose."""
        with np.errstate(all="ignore"):
            inner = self._body.inner(u)
        out = share * self._body.weight - inner - self._spring_matrix @ u.ravel()
        touching = None if T is None else self._contact(u, T)
        if touching is not None:
            out += touching.force
        out[self._held] = 0.0
        return out, touching

    def _contact(self, u: Array, T: Array) -> Touching | None:
        """Return what the probe does to the body at a pose; None where it does not touch."""
        R, x = T[:3, :3], self.mesh.nodes + u
        points = np.einsum("qa,fad->fqd", self._shape, x[self._faces])
        local = (points - T[:3, 3]) @ R
        near = (self.shape.distance(local.reshape(-1, 3))[0].reshape(points.shape[:2]) < SOFT).any(1)
        if not near.any():
            return None
        gap, normal, bend = self.shape.distance(local[near].reshape(-1, 3))
        ramp = np.clip((SOFT - gap) / (2.0 * SOFT), 0.0, 1.0)
        penalty = PENALTY * self.physics.youngs_modulus
        pressure = penalty * np.where(gap < -SOFT, -gap, ramp**2 * SOFT)
        slope = penalty * ramp
        n, area = normal @ R.T, self._area[near]
        bend = R @ bend @ R.T
        forces = (pressure[:, None] * n).reshape(*area.shape, 3) * area[..., None]
        K = slope[:, None, None] * n[:, :, None] * n[:, None, :] - pressure[:, None, None] * bend
        K = K.reshape(*area.shape, 3, 3) * area[..., None, None]
        blocks = np.einsum("qa,fqij,qb->faibj", self._shape, K, self._shape, optimize=True)
        force = np.zeros_like(u)
        np.add.at(force, self._faces[near], np.einsum("qa,fqi->fai", self._shape, forces))
        torque = np.cross(points[near], forces).sum((0, 1))
        wrench = np.r_[forces.sum((0, 1)), torque]
        return Touching(force.ravel(), np.flatnonzero(near), blocks.reshape(-1, 27, 27), wrench)


@dataclass(frozen=True)
class Touching:
    """Hold the contact's nodal ``force`` (3 n,) N, the ``stiffness`` (k, 27, 27) N/m of the ``faces`` (k,) that are
    near the probe, and the probe's ``wrench`` (6,) N, N m."""

    force: Array
    faces: IntArray
    stiffness: Array
    wrench: Array


def _refuse(world: World) -> None:
    """Raise InputError if the world has something that this truth cannot solve."""
    physics = world.physics
    cannot: Sequence[tuple[bool, str]] = (
        (physics.stiffening != 0.0 or physics.fibre is not None, "a law other than neo-Hookean"),
        (bool(physics.prony) or physics.plastic is not None, "a memory"),
        (physics.rubs, "friction or adhesion"),
        (physics.tether is not None, "a tether"),
        (bool(physics.modulus) and has_clock(physics), "moduli that change in time, or swell as well"),
        (world.scan_fraction != 0.0, "a scan under gravity"),
    )
    for there, what in cannot:
        if there:
            raise InputError(f"felupe's truth is not made for {what}", where="truth", remedy="use --truth own")
