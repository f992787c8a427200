"""A truth that nobody here wrote: the body's motion by CalculiX (Dhondt 2004), from a deck written here.

    apt-get install calculix-ccx

Shared with `livedeform.synthetic.truth` are the shapes of body and probe and what the effects mean. Everything that is
solved is CalculiX': 20-node hexahedra with reduced integration, its neo-Hookean law, contact by penalty between the
surface and a meshed rigid probe, increments, and the sparse solver. In millimetres, newtons, megapascals and tonnes.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.probe_mesh import probe_mesh
from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.types import Array
from livedeform.synthetic.solved_motion import KeyStates, has_clock, path_lengths, solved_times
from livedeform.synthetic.trajectory import ProbePath
from livedeform.synthetic.true_effects import World
from livedeform.synthetic.truth import hexmesh
from livedeform.synthetic.truth.hexmesh import HexMesh, IntArray
from livedeform.synthetic.truth.physics import TruthPhysics
from livedeform.synthetic.truth.probe import TruthProbe

COMMAND = "ccx"
MM = 1e3  # per m
PENALTY = 100.0  # of the modulus per mm of overclosure
REACH = 0.010  # m from some pose of the probe, within which a face may touch
AWAY = 0.030  # m above the body, where the probe waits while the weight comes on
SAME = 1e-7  # m, to which two poses are the same
TOUCHES = 0.001  # m off the body at rest, from which a pose is solved
ROWS = 60  # of the table of moduli
# the eight corners, then the twelve middles of edges, in CalculiX' order: places in the 3 x 3 x 3 lattice
_PLACES = [
    *[(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 2), (2, 0, 2), (2, 2, 2), (0, 2, 2)],
    *[(1, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0), (1, 0, 2), (2, 1, 2), (1, 2, 2), (0, 1, 2)],
    *[(0, 0, 1), (2, 0, 1), (2, 2, 1), (0, 2, 1)],
]
TWENTY = np.array([9 * i + 3 * j + k for i, j, k in _PLACES])
_SIDES = {"S1": (2, 0), "S2": (2, 2), "S3": (1, 0), "S4": (0, 2), "S5": (1, 2), "S6": (0, 0)}  # axis, place on it
_CORNER, _MIDDLE = 3 / 76, 16 / 76  # of a face's area, lumped (Hinton, Rock & Zienkiewicz 1976)


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


@dataclass
class Deck:
    """Collect the lines of an input file; ``reference`` is the node that the probe moves with, 0 without a probe."""

    lines: list[str] = field(default_factory=list)
    reference: int = 0

    def add(self, *lines: str) -> None:
        """Add lines as they are."""
        self.lines.extend(lines)

    def nodes(self, name: str, numbers: Iterable[int], places: Array) -> None:
        """Define nodes by number and place (mm)."""
        self.add(f"*NODE,NSET={name}")
        self.add(*(f"{n},{x:.9g},{y:.9g},{z:.9g}" for n, (x, y, z) in zip(numbers, places, strict=True)))

    def elements(self, name: str, kind: str, first: int, rows: IntArray) -> None:
        """Define 20-node elements from their nodes' numbers (m, 20)."""
        self.add(f"*ELEMENT,TYPE={kind},ELSET={name}")
        for number, row in enumerate(rows, start=first):
            text = [str(n) for n in row]
            self.add(f"{number}," + ",".join(text[:14]) + ",", ",".join(text[14:]))

    def surface(self, name: str, first: int, mesh: HexMesh, faces: IntArray) -> None:
        """Define a surface by ``faces`` (k, 9) of a mesh whose elements are numbered from ``first``."""
        wanted = set(faces[:, 4].tolist())  # a face's middle is its own
        self.add(f"*SURFACE,NAME={name},TYPE=ELEMENT")
        for side, (axis, place) in _SIDES.items():
            at = [1, 1, 1]
            at[axis] = place
            middles = mesh.hexes[:, 9 * at[0] + 3 * at[1] + at[2]]
            self.add(*(f"{first + e},{side}" for e, middle in enumerate(middles.tolist()) if middle in wanted))


class CalculiX:
    """Solve a world's body with CalculiX; see `livedeform.synthetic.solved_motion.TruthSolver`.

    Takes effects on stiffness (fields that do not change in time), volume, weight, gravity and the base. Raises
    InputError for any other, and where there is no CalculiX; ConvergenceError where CalculiX gives up.
    """

    def __init__(self, world: World, shape: TruthProbe) -> None:
        if shutil.which(COMMAND) is None:
            raise InputError(f"there is no {COMMAND}", where="--truth", remedy="apt-get install calculix-ccx")
        _refuse(world)
        self.mesh = replace(world.mesh, nodes=serendipity(world.mesh.hexes, world.mesh.nodes))
        self.physics, self.shape = world.physics, shape
        self.used = np.unique(self.mesh.hexes[:, TWENTY])
        self._at_rest: dict[float, Array] = {}

    def rest(self) -> Array:
        """Return the places (n, 3) m of the mesh's nodes at rest."""
        return self._free(float(self._expansions(np.zeros(1))[0]))

    def close(self) -> None:
        """Give nothing back: every run has ended."""

    def recording(
        self, trajectory: ProbePath, clock: float, spec: Mapping[str, Any], tell: Callable[[float], None]
    ) -> KeyStates:
        """Return the key states of a recording that starts at ``clock`` s.

        One run of CalculiX for each way down. A body that grows is taken to go straight from its coldest to its warmest
        rest: 1e-6 of its size where lengths grow by 1e-3.
        """
        rest = self.rest()
        times = solved_times(self.physics, trajectory, float(rest[:, 2].max()), spec)
        poses = np.stack([trajectory(float(t)) for t in times])
        if np.ptp(poses[:, :3, :3], axis=0).max() > 1e-9:
            raise InputError("CalculiX' probe does not turn", where="recordings", remedy="press without tilt")
        x = np.broadcast_to(rest, (len(times), *rest.shape)).copy()
        wrench = np.zeros((len(times), 6))
        warm = self._expansions(clock + times)
        if self.physics.growth:
            cold, hot = self._free(float(warm.min())), self._free(float(warm.max()))
            share = (warm - warm.min()) / max(float(np.ptp(warm)), 1e-12)
            x = cold + share[:, None, None] * (hot - cold)
        chains = list(self._chains(poses, rest, warm))
        for n, chain in enumerate(chains):
            solved = self._pressed([poses[k] for k in chain], warm[chain], rest)
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
            deck = self._body()
            self._weight_step(deck, warm)
            self._at_rest[key] = self._run(deck, 1)[0][0]
        return self._at_rest[key]

    def _pressed(self, poses: Sequence[Array], warm: Array, rest: Array) -> list[tuple[Array, Array]]:
        """Return the nodes' places (n, 3) m and the probe's wrench (6,) N, N m at each pose, reached from above."""
        deck = self._body()
        start = self._probe(deck, np.stack(poses), rest)
        self._weight_step(deck, float(warm[0]))
        for T, w in zip(poses, warm, strict=True):
            deck.add("*STEP,NLGEOM,INC=200", "*STATIC", "1.,1.", "*BOUNDARY")
            moved = MM * (T[:3, 3] - start)
            deck.add(*(f"{deck.reference},{i},{i},{d:.9g}" for i, d in enumerate(moved, start=1)))
            self._end(deck, float(w), contact=True)
        return self._run(deck, 1 + len(poses))[1:]

    def _body(self) -> Deck:
        """Return a deck with the body, its material and its support."""
        deck, physics, nodes = Deck(), self.physics, self.mesh.nodes
        deck.nodes("NBODY", self.used + 1, MM * nodes[self.used])
        deck.elements("BODY", "C3D20R", 1, self.mesh.hexes[:, TWENTY] + 1)
        deck.add("*MATERIAL,NAME=GEL", "*HYPERELASTIC,NEO HOOKE", *self._moduli(deck))
        deck.add("*DENSITY", f"{1e-12 * physics.density:.9g}")
        if physics.growth:
            deck.add("*EXPANSION,ZERO=0.", "1.", "*INITIAL CONDITIONS,TYPE=TEMPERATURE", "NBODY,0.")
        deck.add("*SOLID SECTION,ELSET=BODY,MATERIAL=GEL")
        base = self.mesh.faces[(np.abs(nodes[self.mesh.faces][:, :, 2]) < 1e-9).all(1)]
        held = np.intersect1d(base, self.used)
        if physics.base_free is not None:
            held = held[~physics.base_free(nodes[held])]
        deck.add("*NSET,NSET=BASE", *(f"{n}," for n in held + 1))
        if physics.base_stiffness is None:
            deck.add("*BOUNDARY", "BASE,1,3,0.")
        else:
            deck.add("*BOUNDARY", "BASE,3,3,0.")
            _springs(deck, nodes, base, physics.base_stiffness, 10 * len(self.mesh.hexes))
        return deck

    def _moduli(self, deck: Deck) -> list[str]:
        """Return the law's values; where they vary, as a table over a "temperature" that is the factor of the moduli.

        Nothing expands with it then: a body that swells has uniform moduli.
        """
        mu = self.physics.youngs_modulus / (2.0 * (1.0 + self.physics.poisson_ratio)) * 1e-6
        K = self.physics.youngs_modulus / (3.0 * (1.0 - 2.0 * self.physics.poisson_ratio)) * 1e-6

        def row(factor: float, *temperature: str) -> str:
            return ",".join([f"{0.5 * mu * factor:.10g}", f"{2.0 / (K * factor):.10g}", *temperature])

        if not self.physics.modulus:
            return [row(1.0)]
        factor = np.ones(len(self.used))
        for one in self.physics.modulus:
            factor = factor * one(self.mesh.nodes[self.used], 0.0)
        deck.add("*INITIAL CONDITIONS,TYPE=TEMPERATURE")
        deck.add(*(f"{n},{f:.9g}" for n, f in zip(self.used + 1, factor, strict=True)))
        table = np.geomspace(0.999 * factor.min(), 1.001 * factor.max(), ROWS)
        return [row(f, f"{f:.9g}") for f in table]

    def _probe(self, deck: Deck, poses: Array, rest: Array) -> Array:
        """Add the rigid probe and its contact; return its place (3,) m, AWAY above the highest point."""
        mesh, lower = probe_mesh(self.shape)
        R, start = poses[0, :3, :3], np.array([*poses[0, :2, 3], rest[:, 2].max() + AWAY])
        used = np.unique(mesh.hexes[:, TWENTY])
        first = int(self.used.max()) + 2
        deck.nodes("NPROBE", first + used, MM * (mesh.nodes[used] @ R.T + start))
        deck.reference = first + int(used.max()) + 1
        deck.nodes("NREF", [deck.reference, deck.reference + 1], MM * np.tile(start, (2, 1)))
        number = 1 + len(self.mesh.hexes)
        deck.elements("PROBE", "C3D20", number, first + mesh.hexes[:, TWENTY])
        deck.surface("MASTER", number, mesh, lower)
        deck.surface("SLAVE", 1, self.mesh, self._near(poses, rest))
        deck.add("*MATERIAL,NAME=HARD", "*ELASTIC", "1.,.3", "*DENSITY", "1e-12")
        deck.add("*SOLID SECTION,ELSET=PROBE,MATERIAL=HARD")
        deck.add(f"*RIGID BODY,NSET=NPROBE,REF NODE={deck.reference},ROT NODE={deck.reference + 1}")
        deck.add("*SURFACE INTERACTION,NAME=TOUCH", "*SURFACE BEHAVIOR,PRESSURE-OVERCLOSURE=LINEAR")
        deck.add(f"{PENALTY * 1e-6 * self.physics.youngs_modulus:.9g}")
        deck.add("*CONTACT PAIR,INTERACTION=TOUCH,TYPE=SURFACE TO SURFACE", "SLAVE,MASTER")
        return start

    def _near(self, poses: Array, rest: Array) -> IntArray:
        """Return the faces (k, 9) that some pose comes near, save those of the base."""
        faces = self.mesh.faces[(self.mesh.nodes[self.mesh.faces][:, :, 2] > 1e-9).any(1)]
        near = np.zeros(len(faces), bool)
        for T in poses:
            distance = self.shape.distance((rest - T[:3, 3]) @ T[:3, :3])[0]
            near |= (distance[faces] < REACH).any(1)
        return faces[near]

    def _weight_step(self, deck: Deck, warm: float) -> None:
        g = np.asarray(self.physics.gravity, float)
        size = float(np.linalg.norm(g))
        deck.add("*STEP,NLGEOM,INC=100", "*STATIC", "0.25,1.", "*DLOAD")
        deck.add("BODY,GRAV,{:.9g},{:.9g},{:.9g},{:.9g}".format(MM * size, *(g / max(size, 1e-12))))
        if deck.reference:
            deck.add("*BOUNDARY", f"{deck.reference},1,3,0.", f"{deck.reference + 1},1,3,0.")
        self._end(deck, warm)

    def _end(self, deck: Deck, warm: float, *, contact: bool = False) -> None:
        if self.physics.growth:
            deck.add("*TEMPERATURE", f"NBODY,{warm:.9g}")
        deck.add("*NODE PRINT,NSET=NBODY,FREQUENCY=1000", "U")
        if contact:
            deck.add("*CONTACT PRINT,SLAVE=SLAVE,MASTER=MASTER,FREQUENCY=1000", "CF")
        deck.add("*END STEP")

    def _run(self, deck: Deck, n_steps: int) -> list[tuple[Array, Array]]:
        """Run CalculiX; return of each step the nodes' places (n, 3) m and the probe's wrench (6,) N, N m."""
        with tempfile.TemporaryDirectory() as folder:
            Path(folder, "body.inp").write_text("\n".join([*deck.lines, ""]))
            done = subprocess.run(
                [COMMAND, "body"], cwd=folder, capture_output=True, text=True, check=False, env=dict(os.environ)
            )

            data = Path(folder, "body.dat")
            steps = read_results(data.read_text(), len(self.used)) if data.is_file() else []
        if len(steps) < n_steps:
            said = [line.strip() for line in done.stdout.splitlines() if "error" in line.lower()][:1]
            raise ConvergenceError(f"CalculiX solved {len(steps)} of {n_steps} steps: {' '.join(said)}")
        out = []
        for moved, wrench in steps:
            u = np.zeros_like(self.mesh.nodes)
            u[self.used] = moved / MM
            out.append((self.mesh.nodes + serendipity(self.mesh.hexes, u), wrench * np.repeat([1.0, 1.0 / MM], 3)))
        return out


def read_results(text: str, n_nodes: int) -> list[tuple[Array, Array]]:
    """Return the displacements (n, 3) mm and the contact's wrench (6,) N, N mm at the end of each whole step."""
    steps: dict[int, tuple[Array, Array]] = {}
    lines = text.splitlines()
    now = 0
    for i, line in enumerate(lines):
        time = re.search(r"and time\s+(\S+)", line)
        if time is not None:
            now = round(float(time[1]))
        if line.startswith(" displacements"):
            rows = np.array([row.split()[1:] for row in lines[i + 2 : i + 2 + n_nodes]], float)
            steps[now] = (rows, np.zeros(6))
        elif "total surface force" in line and now in steps:
            steps[now] = (steps[now][0], np.array(lines[i + 2].split(), float))
    return [steps[k] for k in sorted(steps)]


def _springs(deck: Deck, nodes: Array, base: IntArray, stiffness: float, first: int) -> None:
    """Hold the base sideways by a spring per node, ``stiffness`` Pa/m times its share of the area."""
    points, weights = hexmesh.gauss(3, 2)
    tangents = np.einsum("qla,fad->fqld", hexmesh.face_gradient(points), nodes[base])
    area = (np.linalg.norm(np.cross(tangents[:, :, 0], tangents[:, :, 1]), axis=2) * weights).sum(1)
    share = np.zeros(len(nodes))
    for a in range(9):
        if a != 4:
            np.add.at(share, base[:, a], area * (_CORNER if a in (0, 2, 6, 8) else _MIDDLE))
    for k, n in enumerate(np.flatnonzero(share)):
        for dof in (1, 2):
            deck.add(f"*ELEMENT,TYPE=SPRING1,ELSET=B{2 * k + dof}", f"{first + 2 * k + dof},{n + 1}")
            deck.add(f"*SPRING,ELSET=B{2 * k + dof}", f"{dof}", f"{stiffness * share[n] / MM:.9g}")


def _refuse(world: World) -> None:
    """Raise InputError if the world has something that this truth cannot solve."""
    physics: TruthPhysics = world.physics
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
            raise InputError(f"CalculiX' truth is not made for {what}", where="truth", remedy="use --truth own")
