"""`ForwardModel` on the finite-element phantom: predictions at key moments and their tangents with respect to any
effect.

Tangents. At the equilibrium x of a moment, r(x, p) = 0, so dx/dp = -K^-1 dr/dp. dr/dp is a difference of residuals:
each column has a *variant* of the physics, a small step away in its coordinate, whose changed items are evaluated at
the base's x. Memory needs no more: the variant's items commit its own path x + h dx/dp, so that after the first
moment they differ by their past as well. The contact's multipliers must follow: K is assembled with springs that are
much stiffer than the solver's (`ProbeContact.stiffen`).

Speed. A body without memory may be solved at its moments in any order and from any guess: the nearest pose that is
solved already, or the same moment of an earlier run with other parameter values.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from closed_loop.catalogue import Candidate
from closed_loop.evidence import Observation, poses_at
from closed_loop.forward import Column, Run
from fem_node.assembly import System
from fem_node.carried import CarriedPoints
from fem_node.contact import Local, ProbeContact, make_contact
from fem_node.continuum import Continuum
from fem_node.effects import EFFECTS as MECHANICAL
from fem_node.effects import apply_effects
from fem_node.element import ElementKind, Space, make_space
from fem_node.items import Moment
from fem_node.loads import Weight, facets_in
from fem_node.mechanics import Mechanics
from fem_node.physics import Physics
from fem_node.pose_track import PoseTrack
from fem_node.rest_shape import InverseProblem, changed_shapes, unloaded_shape
from fem_node.solver import SolverSettings
from fem_node.supports import Springs, _common_axis, make_supports, supported_nodes
from fem_node.tet_mesh import TetMesh
from fem_node.timeline import PoseAt, Timeline
from livedeform_common.errors import ConvergenceError
from livedeform_common.frames import transform
from livedeform_common.types import Array, EffectValues
from stereo_node.effects import Surface, View, distort_all

STEP = 0.002  # of a coordinate's step: residuals are smooth, and accurate to round-off
CLOCK_STEP = 0.02  # s, over which a recorded force's rate is taken: its noise is that of single readings
MOST_SLOPES = 12  # columns whose displacements are kept, for the guess of the next run
SETTINGS = SolverSettings(smallest_step=0.25)  # a moment that needs more load steps is left out


@dataclass(frozen=True)
class Setting:
    """All that does not change while the loop runs: the mesh, the declared physics (with the experiment's own
    effects), the markers in the scanned configuration, and how each recording looks at them (by its name)."""

    mesh: TetMesh
    element: ElementKind
    physics: Physics
    declared: tuple[EffectValues, ...]
    markers: Array
    still: np.ndarray
    views: Mapping[str, View]
    clock_start_ns: int


Coordinates = dict[tuple[str, int], float]  # of the effects in force, by the candidate's name and coordinate


@dataclass
class _Guess:
    """A solved moment: displacements, the contact's state, the pose, and what the displacements do when coordinates
    change from ``z`` by one: ``slopes``."""

    x: Array
    contact: Any
    pose: Array | None
    z: Coordinates
    slopes: dict[tuple[str, int], Array]

    def at(self, z: Coordinates) -> Array:
        """The displacements to be expected at other coordinates."""
        x = self.x
        for name, slope in self.slopes.items():
            if name in z:
                x = x + (z[name] - self.z[name]) * slope
        return x


class FemModel:
    """Runs jobs on ``processes`` workers; use it as a context manager. One process runs them here. ``body``: one that
    has solved some of the moments already; the workers start from what it knows."""

    def __init__(self, setting: Setting, processes: int = 2, body: Body | None = None) -> None:
        self.setting, self.processes = setting, processes
        self._pool: ProcessPoolExecutor | None = None
        self._body = body

    def __enter__(self) -> Self:
        if self.processes > 1:
            self._pool = ProcessPoolExecutor(
                self.processes,
                mp_context=get_context("fork"),
                initializer=_start_worker,
                initargs=(self._body or Body(self.setting),),
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        """See `ForwardModel`. Tangent columns go with the recording's run; each secant column is a run of its own."""
        is_secant = [_is_secant(c) for c in columns]
        tangents = [c for c, s in zip(columns, is_secant, strict=True) if not s]
        secants = [c for c, s in zip(columns, is_secant, strict=True) if s]
        jobs: list[tuple] = [(effects, o, tangents) for o in observations]
        for column in secants:
            candidate = column.candidate
            others = [e for e in effects if e.name != candidate.name]
            switched_on = candidate.values(np.array(column.z) + candidate.kick)
            jobs += [([*others, switched_on], o, ()) for o in observations]
        runs = self._map(jobs)
        n = len(observations)
        out = []
        for i, base in enumerate(runs[:n]):
            kicked = [runs[n * (1 + j) + i] for j in range(len(secants))]
            out.append(_with_secants(base, kicked, secants, is_secant))
        return out

    def _map(self, jobs: list[tuple]) -> list[Run]:
        if self._pool is not None:
            return list(self._pool.map(_work, jobs, chunksize=1))
        if self._body is None:
            self._body = Body(self.setting)
        return [self._body.simulate(*job) for job in jobs]


_WORKER: list[Any] = []


def _start_worker(body: Body) -> None:
    _WORKER[:] = [body]


def _work(job: tuple) -> Run:
    return _WORKER[0].simulate(*job)


def _is_secant(column: Column) -> bool:
    """Whether a column is a run of its own: what is switched on as a whole, and a bond that becomes a spring."""
    c = column.candidate
    if not len(c.amplitudes):
        return not c.tangent
    return c.name == "base_slip" and column.z[column.coordinate] == 0.0


def _with_secants(base: Run, kicked: list[Run], columns: Sequence[Column], is_secant: Sequence[bool]) -> Run:
    """The run with all columns in the order that was asked for."""
    if not kicked:
        return base
    strength = [c.candidate.kick[c.coordinate] or 1.0 for c in columns]
    secant_points = [(k.points - base.points) / s for k, s in zip(kicked, strength, strict=True)]
    order, t, s = [], 0, 0
    n_tangent = base.d_points.shape[-1]
    for secant in is_secant:
        order.append(n_tangent + s if secant else t)
        s, t = s + secant, t + (not secant)
    d_points = np.concatenate([base.d_points, np.stack(secant_points, axis=-1)], axis=-1)[..., order]
    d_forces = None
    if base.forces is not None and base.d_forces is not None:
        pairs = zip(kicked, strength, strict=True)
        secant_forces = [(k.forces - base.forces) / s for k, s in pairs if k.forces is not None]
        d_forces = np.concatenate([base.d_forces, np.stack(secant_forces, axis=-1)], axis=-1)[..., order]
    return Run(base.points, base.forces, d_points, d_forces, base.seconds + sum(k.seconds for k in kicked))


# --- one body in one process
# -------------------------------------------------------------------------------------------


class Body:
    """Simulates one recording at a time; keeps solved moments and unloaded shapes for the next."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self.space: Space = make_space(setting.mesh, setting.element)
        self.carried = CarriedPoints(self.space, setting.markers, setting.still)
        self._guesses: dict[tuple[str, int], _Guess] = {}
        self._unloaded: list[tuple[Physics, Array]] = []

    def simulate(self, effects: Sequence[EffectValues], o: Observation, columns: Sequence[Column]) -> Run:
        """One recording with ``effects`` on top of the declared ones, and its tangent columns."""
        began = time.perf_counter()
        physics = self.physics(effects)
        mechanical = [c for c in columns if c.candidate.name in MECHANICAL]
        mechanics = Mechanics(self.space, physics, self.unloaded(physics), settings=SETTINGS)
        variants = self._variants(effects, physics, mechanics, mechanical, o)
        z = {(c.candidate.name, c.coordinate): c.z[c.coordinate] for c in mechanical}
        path = _Path(self, mechanics, o, variants, z if len(z) == len(mechanical) <= MOST_SLOPES else {})
        points, forces, d_points, d_forces = path.follow()
        points, d_points = self._measured(effects, o, points, d_points, columns, path.surfaces)
        offset = 0.0 if physics.probe is None else physics.probe.time_offset
        if forces is not None and d_forces is not None:  # a late probe's wrench is late as well
            forces = forces - o.force_later(offset)
            for j, variant in enumerate(variants):
                if variant.moves_in_time:
                    rate = o.force_later(offset + CLOCK_STEP) - o.force_later(offset - CLOCK_STEP)
                    d_forces[..., j] -= rate / (2.0 * CLOCK_STEP)
        full_forces = None
        if d_forces is not None and forces is not None:
            full_forces = np.zeros((*forces.shape, len(columns)))
            full_forces[..., [i for i, c in enumerate(columns) if c.candidate.name in MECHANICAL]] = d_forces
        return Run(points, forces, d_points, full_forces, time.perf_counter() - began)

    def rest(self) -> Array:
        """The declared model's markers at rest (m, 3) m, under its weight and loads, without the probe."""
        physics = self.physics([])
        mechanics = Mechanics(self.space, replace(physics, probe=None), self.unloaded(physics), settings=SETTINGS)
        gravity = physics.gravity if physics.release <= 0.0 else np.zeros(3)
        mechanics.advance(Moment(time=0.0, dt=np.inf, gravity=gravity, load=float(physics.release <= 0.0)))
        return self.carried.positions(mechanics.u)

    def physics(self, effects: Sequence[EffectValues]) -> Physics:
        """The declared physics with effects; one of a name that is declared already replaces it."""
        names = {e.name for e in effects}
        kept = [e for e in self.setting.declared if e.name not in names]
        physics = apply_effects(self.setting.physics, [*kept, *effects])
        return replace(physics, clock_start_ns=self.setting.clock_start_ns)

    def unloaded(self, physics: Physics) -> Array | None:
        """The unloaded shape, remembered by what it depends on."""
        if physics.scan_fraction == 0.0:
            return None
        key = _scanned(physics)
        for known, shape in self._unloaded:
            if _same(known, key):
                return shape
        shape = unloaded_shape(self.inverse(physics))
        self._unloaded = [*self._unloaded[-20:], (key, shape)]
        return shape

    def inverse(self, physics: Physics) -> InverseProblem:
        """The inverse problem of these physics."""
        return InverseProblem(self.space, physics)

    def _variants(
        self,
        effects: Sequence[EffectValues],
        physics: Physics,
        base: Mechanics,
        columns: Sequence[Column],
        o: Observation,
    ) -> list[Variant]:
        pairs = []
        for column in columns:
            c, z = column.candidate, np.array(column.z)
            others = [e for e in effects if e.name != c.name]
            inside = any(e.name == c.name for e in effects)
            reference = physics if inside else self.physics([*others, c.values(z)])
            h = STEP * c.coordinates[column.coordinate].step
            if c.kick[column.coordinate] and abs(z[column.coordinate]) < 1e-12:
                h = float(c.kick[column.coordinate])  # a support gives way: to first order, in this strip
            if z[column.coordinate] + h > c.coordinates[column.coordinate].upper:
                h = -h
            z[column.coordinate] += h
            pairs.append((reference, self.physics([*others, c.values(z)]), h))
        shapes = self._changed_shapes(physics, base.unloaded, pairs)
        return [Variant(self, base, *pair, shape, o) for pair, shape in zip(pairs, shapes, strict=True)]

    def _changed_shapes(
        self, physics: Physics, unloaded: Array | None, pairs: Sequence[tuple[Physics, Physics, float]]
    ) -> list[Array | None]:
        """The unloaded shape of each changed physics; the same object as ``unloaded`` where it does not change."""
        wanted = [
            k
            for k, (reference, changed, _) in enumerate(pairs)
            if (reference.scan_fraction or changed.scan_fraction) and not _same(_scanned(reference), _scanned(changed))
        ]
        shapes = [unloaded] * len(pairs)
        if wanted:
            w = np.zeros_like(self.space.nodes) if unloaded is None else unloaded
            inverse = self.inverse(physics)
            try:
                found: list[Array | None] = list(changed_shapes(inverse, w, [pairs[k][1] for k in wanted]))
            except ConvergenceError:  # of one of them: the others are still wanted
                found = [self._one_shape(inverse, w, pairs[k][1]) for k in wanted]
            for k, shape in zip(wanted, found, strict=True):
                shapes[k] = unloaded if shape is None else shape
        return shapes

    @staticmethod
    def _one_shape(inverse: InverseProblem, w: Array, physics: Physics) -> Array | None:
        """One changed unloaded shape; None where the iteration does not follow: the column keeps the declared one."""
        try:
            return changed_shapes(inverse, w, [physics])[0]
        except ConvergenceError:
            return None

    # -- the way through the cameras
    # --------------------------------------------------------------------------------------

    def _measured(
        self,
        effects: Sequence[EffectValues],
        o: Observation,
        true: Array,
        d_true: Array,
        columns: Sequence[Column],
        surfaces: Mapping[int, Surface],
    ) -> tuple[Array, Array]:
        """What an uncorrected rig reports, and its derivatives for all columns."""
        view = self.setting.views.get(o.name) or replace(next(iter(self.setting.views.values())), start_ns=o.start_ns)
        view = replace(view, surface=surfaces.get)
        active = [*(e for e in self.setting.declared if e.name not in {x.name for x in effects}), *effects]
        active = [e for e in active if e.name not in MECHANICAL]
        points = _distorted(true, o, active, view)
        out = np.zeros((*points.shape, len(columns)))
        mechanical = 0
        for i, column in enumerate(columns):
            c = column.candidate
            if c.name in MECHANICAL:
                d = d_true[..., mechanical]
                mechanical += 1
                if active:
                    e = 1e-6 / max(float(np.nanmax(np.abs(d))), 1e-12)
                    d = (_distorted(true + e * d, o, active, view) - points) / e
                out[..., i] = d
            else:
                others = [e for e in active if e.name != c.name]
                z = np.array(column.z)
                h = c.coordinates[column.coordinate].step
                high = z.copy()
                high[column.coordinate] += h
                low = _distorted(true, o, [*others, c.values(z)], view)
                out[..., i] = (_distorted(true, o, [*others, c.values(high)], view) - low) / h
        return points, out


def _distorted(points: Array, o: Observation, effects: Sequence[EffectValues], view: View) -> Array:
    """(k, m, 3) through the measuring effects, moment by moment."""
    if not effects:
        return points
    out = np.full_like(points, np.nan)
    for k, stamp in enumerate(o.stamps_ns):
        if np.isfinite(points[k]).all():
            out[k] = distort_all(points[k], int(stamp), effects, view)
    return out


def _same(a: Any, b: Any) -> bool:
    """Equal physics, arrays included."""
    for name in a.__dataclass_fields__:
        x, y = getattr(a, name), getattr(b, name)
        if isinstance(x, np.ndarray) or isinstance(y, np.ndarray):
            if not np.array_equal(x, y):
                return False
        elif x is not y and x != y:
            return False
    return True


class _Path:
    """The moments of one recording, solved one after another, with the columns of the variants."""

    def __init__(
        self, body: Body, mechanics: Mechanics, o: Observation, variants: Sequence[Variant], z: Coordinates
    ) -> None:
        self.body, self.mechanics, self.o, self.variants, self.z = body, mechanics, o, variants, z
        self.physics = mechanics.physics
        self.memory = has_memory(self.physics)
        self.still = self.physics.swelling is None and not _drifts(self.physics) and not self.memory
        self.passing = [j for j, v in enumerate(variants) if v.passing]  # columns that differ between equal moments
        self.solved: list[_Guess] = []
        self.surfaces: dict[int, Surface] = {}  # by stamp
        dynamic = self.physics.inertia is not None
        self.line = Timeline(o.start_ns, self.physics.clock_start_ns or 0, self.physics.release, dynamic=dynamic)
        self.pose_at: PoseAt | None = PoseTrack(o.path).at if len(o.path) else None

    def follow(self) -> tuple[Array, Array | None, Array, Array | None]:
        """Points (k, m, 3), forces (k, 3) and their columns (..., p)."""
        o, m = self.o, self.mechanics
        k, n, p = o.n_moments, len(self.body.setting.markers), len(self.variants)
        points, forces = np.full((k, n, 3), np.nan), np.full((k, 3), np.nan)
        d_points, d_forces = np.full((k, n, 3, p), np.nan), np.full((k, 3, p), np.nan)
        poses = pose_matrices(self.physics, o)
        for variant in self.variants:
            variant.poses = poses if not variant.moves_probe else pose_matrices(variant.physics, o)
        now: int | None = None
        started = False
        twins: dict[int, int] = {}
        for i in range(k):
            twin = self._twin(poses, i, twins)
            if twin is not None:
                points[i], forces[i] = points[twin], forces[twin]
                d_points[i], d_forces[i] = d_points[twin], d_forces[twin]
                self.surfaces[int(o.stamps_ns[i])] = self.surfaces[int(o.stamps_ns[twin])]
                if not self.passing:
                    continue
            try:
                for instant in self.line.instants(now, int(o.stamps_ns[i])):
                    moment = self.line.moment(self.physics, instant, self.pose_at)
                    self._solve(i, moment, first=not started)
                    started = True
                    if moment.dt == np.inf or p == 0:
                        self._commit_variants(moment, i)
            except ConvergenceError:
                m.x = self.solved[-1].x.copy() if self.solved else m.x
                continue
            now = int(o.stamps_ns[i])
            twins[i] = i
            u = m.u
            points[i] = self.body.carried.positions(u)
            self.surfaces[int(o.stamps_ns[i])] = (self.body.space.nodes + u, self.body.space.facets[:, :3])
            forces[i] = m.wrench()[0]
            if p:
                fresh = self.passing if twin is not None else list(range(p))
                d_points[i][..., fresh], d_forces[i][:, fresh] = self._columns(i, fresh)
        return (
            points,
            (forces if self.physics.probe is not None and o.forces is not None else None),
            d_points,
            (d_forces if self.physics.probe is not None and o.forces is not None else None),
        )

    # -- solving
    # ---------------------------------------------------------------------------------------------------------

    def _twin(self, poses: list[Array | None], i: int, twins: Mapping[int, int]) -> int | None:
        """An earlier moment with the same answer."""
        if not self.still:
            return None
        if _released(self.physics, self.o, i) != _released(self.physics, self.o, max(i - 1, 0)):
            return None
        for j in twins:
            same_load = _released(self.physics, self.o, i) == _released(self.physics, self.o, j)
            if same_load and _same_pose(poses[i], poses[j]):
                return j
        return None

    def _solve(self, i: int, moment: Moment, *, first: bool) -> None:
        m = self.mechanics
        guess = None if first else self._guess(i, moment)
        start = m.moment
        saved = m.save()
        if guess is not None:
            if m.contact is not None and guess.contact is not None and not self.memory:
                m.contact.restore(guess.contact)
            try:
                solution = m.solver.solve(guess.at(self.z), moment, start)
            except ConvergenceError:
                m.restore(saved)
                solution = m.solver.solve(m.x, moment, start)
        else:
            solution = m.solver.solve(m.x, moment, start)
        m.commit(solution.x, moment)
        state = m.contact.save() if m.contact is not None else None
        solved = _Guess(m.x.copy(), state, moment.pose, self.z, {})
        self.solved.append(solved)
        if not first:
            self.body._guesses[self.o.name, int(self.o.stamps_ns[i])] = solved

    def _guess(self, i: int, moment: Moment) -> _Guess | None:
        """The same moment of an earlier run, or without memory the solved moment with the nearest pose."""
        known = self.body._guesses.get((self.o.name, int(self.o.stamps_ns[i])))
        if known is not None and _near(known.pose, moment.pose) < 2e-3:
            return known
        if self.memory or not self.solved:
            return None
        best = min(self.solved, key=lambda g: _near(g.pose, moment.pose))
        return best if _near(best.pose, moment.pose) < _near(self.mechanics.moment.pose, moment.pose) - 1e-9 else None

    # -- columns
    # ------------------------------------------------------------------------------------------------------------

    def _columns(self, i: int, fresh: Sequence[int]) -> tuple[Array, Array]:
        """Derivatives (m, 3, p) and (3, p) of the columns number ``fresh``."""
        m, solver = self.mechanics, self.mechanics.solver
        variants = [self.variants[j] for j in fresh]
        contact = m.contact
        saved = contact.save() if contact is not None else None
        try:
            if contact is not None:
                contact.stiffen(m.x)
            solver.factorise_at(m.x)
            held = m.held()
            part = contact.local(m.x, tangent=True) if contact is not None and contact.T is not None else None
            r = np.column_stack([v.residual_change(m, i, held, part) for v in variants])
            r[held] = 0.0
            dx = -solver.linear.solve(r)
            self._keep_slopes(i, fresh, dx)
            u = m.u
            base = self.body.carried.positions(u)
            n = 3 * self.body.space.n_nodes
            d_points = np.empty((*base.shape, len(variants)))
            d_forces = np.zeros((3, len(variants)))
            for j, variant in enumerate(variants):
                dx[:, j] += variant.imposed
                du = dx[:n, j].reshape(-1, 3)
                e = 1e-6 / max(float(np.abs(du).max()), 1e-12)
                d_points[..., j] = (self.body.carried.positions(u + e * du) - base) / e
                if contact is not None and part is not None:
                    d_forces[:, j] = variant.force_change(contact, part, dx[:, j])
        finally:
            if contact is not None and saved is not None:
                contact.restore(saved)
            solver.drop_factor()
        for j, variant in enumerate(variants):
            variant.commit(m.x + variant.h * dx[:, j], m.moment)
        return d_points, d_forces

    def _keep_slopes(self, i: int, fresh: Sequence[int], dx: Array) -> None:
        """For the guess of the next run, at other coordinates."""
        solved = self.body._guesses.get((self.o.name, int(self.o.stamps_ns[i])))
        if solved is not None and solved.z is self.z and not self.memory:
            names = list(self.z)
            solved.slopes = {names[j]: dx[:, k].copy() for k, j in enumerate(fresh) if names}

    def _commit_variants(self, moment: Moment, i: int) -> None:
        for variant in self.variants:
            variant.start(moment, self.mechanics)


class Variant:
    """The physics a small step ``h`` away in one coordinate: only the items that differ are evaluated.

    ``passing``: its column differs between moments of equal pose. ``imposed`` (n_dof,): displacements of held nodes.
    """

    def __init__(
        self,
        body: Body,
        base: Mechanics,
        reference: Physics,
        changed: Physics,
        h: float,
        unloaded: Array | None,
        o: Observation,
    ) -> None:
        self.h, self.physics, self.o = h, changed, o
        self.poses: list[Array | None] = []
        self.imposed: Array | float = 0.0
        self._system: System | None = None
        self._direct: Array = np.zeros(0)
        self._n_nodes = body.space.n_nodes
        probe, other = changed.probe, reference.probe
        self.moves_probe = self.moves_in_time = changes_law = False
        if probe is not None and other is not None:
            self.moves_in_time = probe.time_offset != other.time_offset
            self.moves_probe = self.moves_in_time or not np.array_equal(probe.offset, other.offset)
            changes_law = (probe.friction, probe.adhesion) != (other.friction, other.adhesion)
        inner, outer = _bulk(changed), _bulk(reference)
        reshaped = unloaded is not base.unloaded
        self.continuum: Continuum | None = None
        if reshaped or not _same(inner, outer):
            self.continuum = Continuum(body.space, changed, unloaded)
        self.weight: Weight | None = None
        heavier = changed.density != reference.density or not np.array_equal(changed.gravity, reference.gravity)
        if heavier or reshaped:
            self.weight = Weight(body.space, changed.density, (self.continuum or base.continuum).mass_weights)
        self.contact: ProbeContact | None = None
        if changes_law and probe is not None:
            self.contact = make_contact(
                body.space,
                probe.shape,
                youngs_modulus=changed.material.youngs_modulus,
                formulation=probe.formulation,
                friction=probe.friction,
                adhesion=probe.adhesion,
            )
        self.gives = _gives(body.space, reference, changed)
        self.springs: list[Springs] = []
        if self.gives is None and changed.supports != reference.supports:
            supports = make_supports(body.space, changed, unloaded)
            self.springs = [item for item in supports if isinstance(item, Springs)]
        drifts = _drifts(changed) or changed.swelling is not None
        remembers = changed.prony is not None or changed.plastic_set is not None
        self.passing = drifts or remembers or self.moves_in_time or self.contact is not None

    def start(self, moment: Moment, base: Mechanics) -> None:
        """The state at rest is the history's beginning."""
        if self.continuum is not None:
            self.continuum.prepare(moment)
            self.continuum.update(base.x)
            self.continuum.commit(base.x)
        if self.contact is not None:
            self.contact.prepare(moment)
            self.contact.commit(base.x)

    def residual_change(self, base: Mechanics, i: int, held: NDArray[np.int64], part: Local | None) -> Array:
        """dr / dz (n_dof,) at the base's solution, where the contact is ``part``."""
        if self._system is None:
            self._system = System(base.solver.pattern)
        x, moment = base.x, base.moment
        r = np.zeros_like(self._system.r)
        if self.continuum is not None:
            self.continuum.prepare(moment)
            self.continuum.update(x)
            r += self._of(x, self.continuum) - self._of(x, base.continuum)
        if self.weight is not None:
            active = float(np.linalg.norm(moment.gravity)) > 0.0
            self.weight.prepare(replace(moment, gravity=self.physics.gravity) if active else moment)
            r += self._of(x, self.weight) - self._of(x, base.weight)
        if self.springs:
            before = [item for item in base.items if isinstance(item, Springs)]
            r += self._of(x, *self.springs) - self._of(x, *before)
        self._direct = np.zeros_like(r)  # of the contact
        if self.moves_probe and base.contact is not None and part is not None:
            self._direct += self._moved_probe(base.contact, part, self.poses[i], x)
        if self.contact is not None and base.contact is not None:
            self._direct += self._law_change(base.contact, x, moment)
        r += self._direct
        if self.gives is not None:
            self.imposed = self.gives(self._of(x, *base.items), held)
            e = 1e-6 / max(float(np.abs(self.imposed).max()), 1e-12)
            return (self._of(x + e * self.imposed, *base.items) - self._of(x, *base.items)) / e
        return r / self.h

    def _moved_probe(self, contact: ProbeContact, part: Local, T1: Array | None, x: Array) -> Array:
        """What the probe's step from its pose to ``T1`` changes, to first order: the surface moves the other way, and
        the tractions turn with the probe. (A difference would see points let go over less than a nanometre.)"""
        out = np.zeros_like(x)
        if contact.T is None or T1 is None:
            return out
        M = T1 @ np.linalg.inv(contact.T) - np.eye(4)
        dofs = contact.dofs[part.facets]
        places = contact.X[part.facets] + x[dofs].reshape(len(dofs), -1, 3)
        step = (places @ M[:3, :3].T + M[:3, 3]).reshape(len(dofs), -1)
        turned = part.vectors.reshape(places.shape) @ M[:3, :3].T
        np.add.at(out, dofs, turned.reshape(len(dofs), -1) - _times(part, step))
        return out

    def _law_change(self, contact: ProbeContact, x: Array, moment: Moment) -> Array:
        """Friction and adhesion: a contact of its own that has slid and stuck along the way."""
        mine = self.contact
        assert mine is not None  # the caller's
        mine.prepare(moment)
        mine.law, mine.stiffening = replace(mine.law, penalty=contact.law.penalty), contact.stiffening
        state = contact.state
        mine.state = replace(mine.state, multiplier=state.multiplier)
        for _ in range(3):
            mine.update(x)
        mine.state = replace(mine.state, multiplier=state.multiplier)
        return self._of(x, mine) - self._of(x, contact)

    def _of(self, x: Array, *items: Any) -> Array:
        assert self._system is not None  # made by residual_change
        self._system.clear(tangent=False)
        for item in items:
            item.evaluate(x, self._system, tangent=False)
        return self._system.r.copy()

    def force_change(self, contact: ProbeContact, part: Local, dx: Array) -> Array:
        """d force / dz (3,): what the contact's springs do as the body moves by ``dx``, and what the variant does to
        them at once."""
        pulled = _times(part, dx[contact.dofs[part.facets]]).reshape(-1, 3).sum(axis=0)
        n = 3 * self._n_nodes
        at_once = self._direct[:n].reshape(-1, 3).sum(axis=0) / self.h
        return np.asarray(-pulled - at_once)

    def commit(self, x: Array, moment: Moment) -> None:
        """The variant's own path goes into its memory."""
        if self.continuum is not None:
            self.continuum.commit(x)
        if self.contact is not None:
            self.contact.commit(x)


class _Give:
    """A support that gives way a little: held nodes move by their traction times a compliance (first order).

    The traction is M^-1 R with the reactions R of the ``nodes`` (n,) and the mass matrix of the base's ``facets``;
    ``compliance`` m/Pa per unit of the coordinate, along ``axes`` (3,) bool.
    """

    def __init__(
        self, space: Space, facets: NDArray[np.int64], nodes: NDArray[np.int64], compliance: float, axes: Array
    ) -> None:
        values, weights, _ = space.facet_rule(4, space.facets[facets])
        blocks = np.einsum("kq,qa,qb->kab", weights, values, values)
        used, place = np.unique(space.facets[facets], return_inverse=True)
        place = place.reshape(len(facets), -1)
        n = place.shape[1]
        rows, columns = np.repeat(place, n, axis=1).ravel(), np.tile(place, (1, n)).ravel()
        self._mass = splu(csc_array((blocks.ravel(), (rows, columns)), shape=(len(used), len(used))))
        self._used, self._gives = used, np.isin(used, nodes)
        self.compliance, self.axes = compliance, axes

    def __call__(self, residual: Array, held: NDArray[np.int64]) -> Array:
        """Imposed displacements (n_dof,): the support pushes the body with ``residual`` there, and the body it back."""
        out = np.zeros_like(residual)
        for a in np.flatnonzero(self.axes):
            dofs = 3 * self._used + a
            traction = self._mass.solve(residual[dofs])
            out[dofs] = np.where(self._gives, -self.compliance * traction, 0.0)
        keep = np.zeros(len(out), bool)
        keep[held] = True
        return np.where(keep, out, 0.0)


def _gives(space: Space, reference: Physics, changed: Physics) -> _Give | None:
    """What a change of the supports does to first order: springs instead of a bond, or a strip that is free."""
    for before, after in zip(reference.supports, changed.supports, strict=True):
        if before.type != "fixed" or before is after:
            continue
        nodes, facets = supported_nodes(space, before), facets_in(space, before.region).astype(np.int64)
        if after.type == "spring":
            normal = _common_axis(space, space.facets[facets])
            axes = np.array([a != normal for a in range(3)])
            return _Give(space, facets, nodes, 1.0, axes)
        free = np.setdiff1d(nodes, supported_nodes(space, after))
        width = 2.8 * float(np.ptp(space.nodes[nodes], axis=0).max())
        if len(free):
            return _Give(space, facets, free, width / changed.material.youngs_modulus, np.ones(3, bool))
    return None


def _bulk(physics: Physics) -> Physics:
    """What the continuum alone depends on."""
    return replace(physics, probe=None, gravity=np.zeros(3), supports=(), loads=(), density=0.0, scan_fraction=0.0)


def _times(part: Local, step: Array) -> Array:
    """The contact's forces (m, 3 b) as its nodes move by ``step`` (m, 3 b)."""
    if part.blocks is None:
        raise ValueError("the contact was worked out without its tangent")
    return np.einsum("mij,mj->mi", part.blocks, step)


# --- small functions
# --------------------------------------------------------------------------------------------------------


def _scanned(physics: Physics) -> Physics:
    """The part of the physics on which the unloaded shape depends."""
    return replace(
        physics,
        probe=None,
        gravity=np.zeros(3),
        loads=(),
        prony=None,
        plastic_set=None,
        inertia=None,
        swelling=None,
        modulus_fields=tuple(f for f in physics.modulus_fields if type(f).__name__ != "Drift"),
    )


def has_memory(physics: Physics) -> bool:
    """Whether the answer depends on what was before."""
    probe = physics.probe
    return (
        physics.prony is not None
        or physics.plastic_set is not None
        or physics.inertia is not None
        or (probe is not None and (probe.friction > 0.0 or probe.adhesion > 0.0))
        or any(s.type == "friction" for s in physics.supports)
    )


def _drifts(physics: Physics) -> bool:
    return any(type(f).__name__ == "Drift" for f in physics.modulus_fields)


def _released(physics: Physics, o: Observation, i: int) -> bool:
    return (o.stamps_ns[i] - o.start_ns) * 1e-9 >= physics.release


def pose_matrices(physics: Physics, o: Observation) -> list[Array | None]:
    """T_phantom_probe (4, 4) at the key moments, with the probe's offsets in place and time."""
    if physics.probe is None or not len(o.path):
        return [None] * o.n_moments
    position, rotation = poses_at(o.path, o.stamps_ns, physics.probe.time_offset)
    R = rotation.as_matrix()
    return [transform(r, p + r @ physics.probe.offset) for r, p in zip(R, position, strict=True)]


def _near(a: Array | None, b: Array | None) -> float:
    """A distance between poses, m; a turn counts as 3 cm per radian."""
    if a is None or b is None:
        return 0.0 if a is b else 1.0
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]) + 0.02 * np.linalg.norm(a[:3, :3] - b[:3, :3]))


def _same_pose(a: Array | None, b: Array | None) -> bool:
    return _near(a, b) < 1e-7


__all__ = ["Body", "Candidate", "FemModel", "Setting", "has_memory"]
