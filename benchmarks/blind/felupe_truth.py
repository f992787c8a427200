"""A truth that nobody here wrote: elements, law and assembly by felupe (Dutzler 2022), with its 20-node hexahedra.

    pip install 'livedeform[benchmark]'

Shared with `livedeform.synthetic.truth` are the shapes of body and probe and what the effects mean. The elements
(reduced integration, displacements alone), the neo-Hookean law, the assembly of both and of the weight are felupe's;
contact is a plain penalty at points of the surface, and Newton's method is written out below. Without a pressure of
their own these elements are too stiff where the body is nearly incompressible: see `docs/evidence/blind-test.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix

from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.types import Array
from livedeform.synthetic.solved_motion import KeyStates, has_clock, path_lengths, solved_times
from livedeform.synthetic.trajectory import ProbePath
from livedeform.synthetic.true_effects import World
from livedeform.synthetic.truth.hexmesh import IntArray
from livedeform.synthetic.truth.probe import TruthProbe

try:
    from pypardiso import spsolve
except ImportError:  # not on this platform, or not installed
    from scipy.sparse.linalg import spsolve

PENALTY = 1e5  # of the modulus per m of overclosure: 10 um where the pressure is the modulus
SOFT = 4e-6  # m: over this gap contact sets in gradually
TOLERANCE = 2e-7  # m, of the last correction
LONGEST = 0.004  # m that a node goes at most in one iteration
ITERATIONS, HALVINGS = 40, 6
SAME = 1e-7  # m, to which two poses are the same
TOUCHES = 0.001  # m off the body at rest, from which a pose is solved
LIFT = np.array([0.0, 0.0, 0.003])  # m, from where the first pose of a run is reached if it is too far from rest
# the eight corners, then the twelve middles of edges, in VTK's order: places in the 3 x 3 x 3 lattice
_PLACES = [
    *[(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 2), (2, 0, 2), (2, 2, 2), (0, 2, 2)],
    *[(1, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0), (1, 0, 2), (2, 1, 2), (1, 2, 2), (0, 1, 2)],
    *[(0, 0, 1), (2, 0, 1), (2, 2, 1), (0, 2, 1)],
]
TWENTY = np.array([9 * i + 3 * j + k for i, j, k in _PLACES])
EIGHT = np.array([0, 6, 8, 2, 3, 7, 5, 1])  # of a face's 3 x 3 lattice


def serendipity(hexes: IntArray, values: Array) -> Array:
    """Return ``values`` (n, 3) with those in the middles of faces and elements as 20 nodes make them."""
    out = values.copy()
    lattice = list(product(range(3), repeat=3))
    corners = [a for a, place in enumerate(lattice) if 1 not in place]
    edges = [a for a, place in enumerate(lattice) if place.count(1) == 1]
    for a, place in enumerate(lattice):
        if place.count(1) < 2:
            continue
        axis = [d for d in range(3) if place[d] != 1]  # that of the face; none of the element's middle
        on = [b for b in corners if all(lattice[b][d] == place[d] for d in axis)]
        along = [b for b in edges if all(lattice[b][d] == place[d] for d in axis)]
        share = 0.5 if axis else 0.25
        out[hexes[:, a]] = share * values[hexes[:, along]].sum(1) - 0.25 * values[hexes[:, on]].sum(1)
    return out


class FelupeTruth:
    """Solve a world's body with felupe; see `livedeform.synthetic.solved_motion.TruthSolver`.

    Takes effects on stiffness (fields that do not change in time), volume, weight, gravity and the base. Raises
    InputError for any other, and without felupe; ConvergenceError where Newton's method gives up.
    """

    def __init__(self, world: World, shape: TruthProbe) -> None:
        _refuse(world)
        self.mesh = replace(world.mesh, nodes=serendipity(world.mesh.hexes, world.mesh.nodes))
        self.physics, self.shape = world.physics, shape
        self.used = np.unique(self.mesh.hexes[:, TWENTY])
        self._number = np.full(len(self.mesh.nodes), -1)
        self._number[self.used] = np.arange(len(self.used))
        self._build()
        self._at_rest: dict[float, Array] = {}

    def _build(self) -> None:
        """Set up felupe's body and weight, the base, and the points of contact."""
        fe = _felupe()
        mesh = fe.Mesh(self.mesh.nodes[self.used], self._number[self.mesh.hexes[:, TWENTY]], "hexahedron20")
        self._points = mesh.points
        region = fe.RegionQuadraticHexahedron(mesh, quadrature=fe.GaussLegendre(order=1, dim=3))
        self._field = fe.FieldContainer([fe.Field(region, dim=3)])
        factor = self._moduli(fe.Field(region, dim=3, values=mesh.points).interpolate())
        E, nu = self.physics.youngs_modulus, self.physics.poisson_ratio
        neo_hooke = fe.NeoHooke(mu=factor * E / (2 * (1 + nu)), bulk=factor * E / (3 * (1 - 2 * nu)))
        neo_hooke.chunksize = None  # a part of the cells at a time, it would take the moduli of all
        law = Grown(neo_hooke)
        self._law, self._solid = law, fe.SolidBody(law, self._field)
        weight = self.physics.density * np.asarray(self.physics.gravity, float)
        self._weight = fe.SolidBodyForce(self._field, values=list(weight)).assemble.vector().toarray().ravel()
        faces = self.mesh.faces[:, EIGHT]
        is_base = (np.abs(self.mesh.nodes[faces][:, :, 2]) < 1e-9).all(1)
        quadrature, quad = fe.GaussLegendre(order=3, dim=2), fe.element.QuadraticQuad()
        shape = np.stack([quad.function(p) for p in quadrature.points])
        slope = np.stack([quad.gradient(p) for p in quadrature.points])
        tangents = np.einsum("qal,fad->fqld", slope, self.mesh.nodes[faces])
        area = np.linalg.norm(np.cross(tangents[:, :, 0], tangents[:, :, 1]), axis=2) * quadrature.weights
        self._shape, self._faces, self._area = shape, self._number[faces[~is_base]], area[~is_base]
        self._hold(self._number[faces[is_base]], area[is_base])

    def _moduli(self, places: Array) -> Array:
        """Return the factor of the moduli at the quadrature points, ``places`` (3, q, m) m."""
        factor = np.ones(places.shape[1:])
        for one in self.physics.modulus:
            factor = factor * one(places.reshape(3, -1).T, 0.0).reshape(factor.shape)
        return factor

    def _hold(self, base: IntArray, area: Array) -> None:
        """Find the free unknowns and, of a base that slips, its springs."""
        n = len(self.used)
        on_base = np.zeros(n, bool)
        on_base[base] = True
        if self.physics.base_free is not None:
            on_base &= ~self.physics.base_free(self._points)
        held = np.zeros((n, 3), bool)
        held[on_base, 2] = True
        self._springs = csr_matrix((3 * n, 3 * n))
        if self.physics.base_stiffness is None:
            held[on_base] = True
        else:
            M = self.physics.base_stiffness * np.einsum("fq,qa,qb->fab", area, self._shape, self._shape)
            self._springs = _scattered(np.einsum("fab,ij->faibj", M, np.diag([1.0, 1.0, 0.0])), base, n)
        self._free_unknowns = np.flatnonzero(~held.ravel())

    def rest(self) -> Array:
        """Return the places (n, 3) m of the mesh's nodes at rest."""
        return self._free(float(self._expansions(np.zeros(1))[0]))

    def close(self) -> None:
        """Give nothing back: there is nothing but arrays."""

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
        return near & (np.abs(warm - warm[k]) < 1e-9)

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
            self._law.growth = (1.0 + warm) ** 3
            u = np.zeros_like(self._points)
            for share in (0.25, 0.5, 0.75, 1.0):
                u = self._newton(u, share, None)[0]
            self._at_rest[key] = self._everywhere(u)
        return self._at_rest[key]

    def pressed(self, poses: Sequence[Array], warm: Array, rest: Array) -> list[tuple[Array, Array]]:
        """Return the nodes' places (n, 3) m and the probe's wrench (6,) N, N m at each pose, reached from above."""
        u = (rest - self.mesh.nodes)[self.used]
        before = poses[0].copy()
        before[:3, 3] += LIFT
        out = []
        for T, w in zip(poses, warm, strict=True):
            self._law.growth = (1.0 + float(w)) ** 3
            u, wrench = self._go(u, before, T, HALVINGS)
            out.append((self._everywhere(u), wrench))
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
        free = self._free_unknowns
        residual, touching = self._residual(u, share, T)
        for _ in range(ITERATIONS):
            tangent = self._solid.assemble.matrix(self._field) + self._springs
            if touching is not None:
                tangent = tangent + touching.stiffness
            step = np.zeros(u.size)
            step[free] = spsolve(tangent.tocsr()[free][:, free].tocsr(), residual[free])
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
        self._field[0].values[:] = u
        with np.errstate(all="ignore"):
            inner = self._solid.assemble.vector(self._field).toarray().ravel()
        out = share * self._weight - inner - self._springs @ u.ravel()
        touching = None if T is None else self._contact(u, T)
        if touching is not None:
            out += touching.force
        held = np.ones(out.size, bool)
        held[self._free_unknowns] = False
        out[held] = 0.0
        return out, touching

    def _contact(self, u: Array, T: Array) -> Touching | None:
        """Return what the probe does to the body at a pose; None where it does not touch."""
        R, x = T[:3, :3], self._points + u
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
        return Touching(force.ravel(), _scattered(blocks, self._faces[near], len(u)), np.r_[forces.sum((0, 1)), torque])

    def _everywhere(self, u: Array) -> Array:
        """Return the places (n, 3) m of all 27-node lattices' nodes."""
        full = np.zeros_like(self.mesh.nodes)
        full[self.used] = u
        places: Array = self.mesh.nodes + serendipity(self.mesh.hexes, full)
        return places


@dataclass(frozen=True)
class Touching:
    """Hold the contact's nodal ``force`` (3 n,) N, its ``stiffness`` N/m and the probe's ``wrench`` (6,) N, N m."""

    force: Array
    stiffness: csr_matrix
    wrench: Array


class Grown:
    """Let felupe's ``law`` act on F J_s^-1/3: each volume has grown to ``growth`` J_s without stress."""

    def __init__(self, law: Any) -> None:
        self.law, self.growth, self.x = law, 1.0, law.x

    def gradient(self, x: list[Any]) -> list[Any]:
        """Return the first Piola stress of the grown body, and no variables of state."""
        stress, state = self.law.gradient([x[0] * self.growth ** (-1 / 3), x[-1]])
        return [self.growth ** (2 / 3) * stress, state]

    def hessian(self, x: list[Any]) -> list[Any]:
        """Return its derivative."""
        return [self.growth ** (1 / 3) * self.law.hessian([x[0] * self.growth ** (-1 / 3), x[-1]])[0]]


def _scattered(blocks: Array, faces: IntArray, n: int) -> csr_matrix:
    """Return the matrix (3 n, 3 n) of ``blocks`` (k, a, 3, a, 3) between the nodes of ``faces`` (k, a)."""
    unknowns = 3 * faces[:, :, None] + np.arange(3)
    rows = np.broadcast_to(unknowns[:, :, :, None, None], blocks.shape)
    columns = np.broadcast_to(unknowns[:, None, None, :, :], blocks.shape)
    return coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), (3 * n, 3 * n)).tocsr()


def _felupe() -> Any:
    try:
        import felupe
    except ImportError as error:
        raise InputError("there is no felupe", where="--truth", remedy="pip install 'livedeform[benchmark]'") from error
    return felupe


def _refuse(world: World) -> None:
    """Raise InputError if the world has something that this truth cannot solve."""
    physics = world.physics
    cannot: Sequence[tuple[bool, str]] = (
        (physics.stiffening != 0.0 or physics.fibre is not None, "a law other than neo-Hookean"),
        (bool(physics.prony) or physics.plastic is not None, "a memory"),
        (physics.friction > 0.0 or physics.adhesion > 0.0, "friction or adhesion"),
        (physics.tether is not None, "a tether"),
        (bool(physics.modulus) and has_clock(physics), "moduli that change in time, or swell as well"),
        (world.scan_fraction != 0.0, "a scan under gravity"),
    )
    for there, what in cannot:
        if there:
            raise InputError(f"felupe's truth is not made for {what}", where="truth", remedy="use --truth own")
