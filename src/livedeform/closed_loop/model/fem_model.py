"""The finite-element phantom at key moments: predictions and their tangents with respect to any effect.

Tangents. At the equilibrium x of a moment, r(x, p) = 0, so dx/dp = -K^-1 dr/dp. dr/dp is a difference of residuals:
each column has a *variant* of the physics, a small step away in its coordinate, whose changed items are evaluated at
the base's x. Memory needs no more: the variant's items commit its own path x + h dx/dp, so that after the first
moment they differ by their past as well. The contact's multipliers must follow: K is assembled with springs that are
much stiffer than the solver's (`ProbeContact.stiffen`). Of a probe that rubs these tangents are not to be trusted: they
leave out what slid and stuck on the way (`closed_loop.model.workers` takes differences of runs).

Speed. A body without memory may be solved at its moments in any order and from any guess: the nearest pose that is
solved already, or the same moment of an earlier run with other parameter values.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from livedeform.closed_loop.candidates import Candidate
from livedeform.closed_loop.evidence.observation import Observation, poses_at
from livedeform.closed_loop.forward import Column, Key, Run
from livedeform.closed_loop.model.guesses import Coordinates, Guess, Guesses
from livedeform.closed_loop.model.moving import MovingPath
from livedeform.closed_loop.model.tangent import Variant, same
from livedeform.common.errors import ConvergenceError
from livedeform.common.frames import transform
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.contact.contact import make_contact
from livedeform.fem_node.effects import EFFECTS as MECHANICAL
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.element.element import ElementKind, Space, make_space
from livedeform.fem_node.embedded_points import CarriedPoints
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.pose_track import PoseTrack
from livedeform.fem_node.path.timeline import Instant, PoseAt, Timeline
from livedeform.fem_node.path.unloaded import InverseProblem, changed_shapes, unloaded_shape
from livedeform.fem_node.physics.memory import as_scanned, memory_of
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.solve.solver import Solution, SolverSettings
from livedeform.stereo_node.effects import Surface, View, distort_all

STEP = 0.002  # of a coordinate's step: residuals are smooth, and accurate to round-off
CLOCK_STEP = 0.02  # s, over which a recorded force's rate is taken: its noise is that of single readings
ALIKE = 3e-3  # m between poses at which two meshes are apart by about the same
FAR_AWAY = 1e-4  # m between two runs' displacements, from which the one is no start for the other's next moment
MOST_SLOPES = 12  # columns whose displacements are kept, for the guess of the next run
STROKE = 1e-3  # m that a probe that rubs moves at a time: 4 um rms beside the live graph's half (docs/loop.md)
ROUGHER = 4.0  # contact on the way between two moments, than at them
RUBBING = ("probe_friction", "probe_adhesion")
SETTINGS = SolverSettings(smallest_step=0.25)  # a moment that needs more load steps is left out
IN_MOTION = replace(SETTINGS, tolerance=3e-7)  # a step of time is wrong by far more (`fem_node.items.dynamics`)


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


class Body:
    """Simulates one recording at a time; keeps solved moments and unloaded shapes for the next."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self.space: Space = make_space(setting.mesh, setting.element)
        self.carried = CarriedPoints(self.space, setting.markers, setting.still)
        self.guesses = Guesses()
        self._starts: dict[Key, Guess] = {}  # what another mesh has solved
        self._unloaded: list[tuple[Physics, Array]] = []

    def simulate(
        self, effects: Sequence[EffectValues], o: Observation, columns: Sequence[Column], *, strokes: bool = True
    ) -> Run:
        """One recording with ``effects`` on top of the declared ones, and its tangent columns. What rubs or sticks
        goes from moment to moment in short ``strokes``, or at once: roughly."""
        began = time.perf_counter()
        physics = self.physics(effects)
        whole = o.with_all_before() if memory_of(physics).sets else o  # what stays was put there by all presses
        mechanical = [c for c in columns if c.candidate.name in MECHANICAL]
        settings = SETTINGS if physics.inertia is None else IN_MOTION
        mechanics = Mechanics(self.space, physics, self.unloaded(physics), settings=settings)
        pairs, shapes = self._changes(effects, physics, mechanics, mechanical)
        variants: list[Variant] = []
        path: _Path | MovingPath
        if physics.inertia is not None:
            changes = [(changed, h, shape) for (_, changed, h), shape in zip(pairs, shapes, strict=True)]
            path = MovingPath(self.carried, mechanics, whole, changes)
        else:
            variants = [Variant(self.space, mechanics, *pair, s, whole) for pair, s in zip(pairs, shapes, strict=True)]
            z = {(c.candidate.name, c.coordinate): c.z[c.coordinate] for c in mechanical}
            z = z if len(z) == len(mechanical) <= MOST_SLOPES else {}
            path = _Path(self, self.guesses.of(effects), mechanics, whole, variants, z, strokes)
        points, forces, d_points, d_forces = (x if x is None else x[-o.n_moments :] for x in path.follow())
        assert points is not None and d_points is not None  # forces alone may be missing
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

    @property
    def started(self) -> set[Key]:
        """The moments that another mesh has solved."""
        return set(self._starts)

    def start_from(self, other: Body) -> None:
        """Takes the moments at which the same body on another mesh was pressed as guesses: displacements by its shape
        functions, pressures from its nearest contact points. Not where there is more to a moment than these."""
        physics = self.physics([])
        if physics.probe is None or self.space.n_pressure or memory_of(physics).of_the_way:
            return
        at = CarriedPoints(other.space, self.space.nodes)
        own, theirs = (make_contact(b.space, physics.probe, physics.material.youngs_modulus) for b in (self, other))
        nearest = KDTree(theirs.places).query(own.places)[1]
        for key, guess in other.guesses.of([]).items():
            if guess.contact is not None and guess.contact[0].touches.any():
                u = at.positions(guess.x.reshape(-1, 3)) - self.space.nodes
                own.start_like(guess.contact[0], nearest, u)
                self._starts[key] = Guess(u.ravel(), own.save(), guess.pose, guess.z, {})

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
        key = as_scanned(physics)
        for known, shape in self._unloaded:
            if same(known, key):
                return shape
        shape = unloaded_shape(self.inverse(physics))
        self._unloaded = [*self._unloaded[-20:], (key, shape)]
        return shape

    def inverse(self, physics: Physics) -> InverseProblem:
        """The inverse problem of these physics."""
        return InverseProblem(self.space, physics)

    def _changes(
        self, effects: Sequence[EffectValues], physics: Physics, base: Mechanics, columns: Sequence[Column]
    ) -> tuple[list[tuple[Physics, Physics, float]], list[Array | None]]:
        """For each column the physics, the one that is changed by a small step, the step, and its unloaded shape."""
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
        return pairs, self._changed_shapes(physics, base.unloaded, pairs)

    def _changed_shapes(
        self, physics: Physics, unloaded: Array | None, pairs: Sequence[tuple[Physics, Physics, float]]
    ) -> list[Array | None]:
        """The unloaded shape of each changed physics; the same object as ``unloaded`` where it does not change."""
        wanted = [
            k
            for k, (reference, changed, _) in enumerate(pairs)
            if (reference.scan_fraction or changed.scan_fraction)
            and not same(as_scanned(reference), as_scanned(changed))
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
        view = self.setting.views.get(o.name) or next(iter(self.setting.views.values()))
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


class _Path:
    """The moments of one recording, solved one after another, with the columns of the variants."""

    def __init__(
        self,
        body: Body,
        guesses: MutableMapping[Key, Guess],
        mechanics: Mechanics,
        o: Observation,
        variants: Sequence[Variant],
        z: Coordinates,
        strokes: bool,
    ) -> None:
        self.body, self.guesses, self.mechanics, self.o = body, guesses, mechanics, o
        self.variants, self.z, self.strokes = variants, z, strokes
        self.physics = mechanics.physics
        self.memory = memory_of(self.physics)
        self.passing = [j for j, v in enumerate(variants) if v.passing]  # columns that differ between equal moments
        self.solved: dict[int, Guess] = {}  # by moment
        self.away = 0.0  # m, how far the last moment's solution was from that of an earlier run
        self.surfaces: dict[int, Surface] = {}  # by stamp
        self.line = Timeline(o.start_ns, self.physics.clock_start_ns or 0, self.physics.release)
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
        twins: dict[int, Array | None] = {}  # by moment: displacements, if the probe touches nothing there
        for i in range(k):
            twin = self._twin(poses, i, twins)
            if twin is not None:
                points[i], forces[i] = points[twin], forces[twin]
                d_points[i], d_forces[i] = d_points[twin], d_forces[twin]
                self.surfaces[int(o.stamps_ns[i])] = self.surfaces[int(o.stamps_ns[twin])]
                if not self.passing:
                    continue
            try:
                way: Iterable[Instant] = self.line.instants(now, int(o.stamps_ns[i]), self.mechanics.pace)
                if self.strokes:
                    way = self.line.in_strokes(way, self.physics, self.pose_at, STROKE)
                for instant in way:
                    moment = self.line.moment(self.physics, instant, self.pose_at)
                    self._solve(i, instant.stamp_ns, moment, first=not started)
                    started = True
                    if moment.dt == np.inf or p == 0:
                        self._commit_variants(moment, i)
            except ConvergenceError:
                m.x = self.solved[max(self.solved)].x.copy() if self.solved else m.x
                continue
            now = int(o.stamps_ns[i])
            twins[i] = None if m.contact is not None and m.contact.state.touches.any() else m.x
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

    def _twin(self, poses: list[Array | None], i: int, twins: Mapping[int, Array | None]) -> int | None:
        """An earlier moment with the same answer: of the same pose, or the probe touches nothing at either."""
        if self.memory.reasons:
            return None
        if _released(self.physics, self.o, i) != _released(self.physics, self.o, max(i - 1, 0)):
            return None
        contact = self.mechanics.contact
        for j, x in twins.items():
            same_load = _released(self.physics, self.o, i) == _released(self.physics, self.o, j)
            if not same_load:
                continue
            if _same_pose(poses[i], poses[j]) or (x is not None and (contact is None or contact.misses(x, poses[i]))):
                return j
        return None

    def _solve(self, i: int, stamp_ns: int, moment: Moment, *, first: bool) -> None:
        m = self.mechanics
        if m.contact is not None and self.memory.rubs:
            m.contact.exactness = 1.0 if stamp_ns == int(self.o.stamps_ns[i]) else ROUGHER
        at_rest = "", int(moment.gravity.any() or moment.load > 0.0)  # where every recording begins
        key = at_rest if first else (self.o.name, stamp_ns)  # on the way to moment number i, or there
        guess = self.guesses.get(at_rest) if first else self._guess(i, key, moment)
        solution = None if guess is None else self._solve_from(guess, moment)
        if solution is None and self.memory.of_the_way:
            solution = self._solve_dragged(moment)
        if solution is None:
            solution = m.solver.solve(m.x, moment, m.moment)
        m.commit(solution.x, moment)
        before = self.guesses.get(key)
        self.away = 0.0 if before is None else float(np.abs(m.x - before.at(self.z)).max())
        state = m.contact.save() if m.contact is not None else None
        self.solved[i] = self.guesses[key] = Guess(m.x.copy(), state, moment.pose, self.z, {})

    def _solve_from(self, guess: Guess, moment: Moment) -> Solution | None:
        """The equilibrium from a guess; None if that leads nowhere: then nothing has changed."""
        m = self.mechanics
        saved = m.save()
        if m.contact is not None and guess.contact is not None:
            if self.memory.of_the_way:
                m.contact.begin_like(guess.contact[0])
            else:
                m.contact.restore(guess.contact)
        try:
            return m.solver.solve(guess.at(self.z), moment, m.moment)
        except ConvergenceError:
            m.restore(saved)
            return None

    def _solve_dragged(self, moment: Moment) -> Solution | None:
        """The equilibrium from where the probe drags what it touches; None if that leads nowhere: it may have come a
        long way."""
        m = self.mechanics
        saved = m.save()
        try:
            return m.solver.solve_at_once(m.dragged(moment), moment)
        except ConvergenceError:
            m.restore(saved)
            return None

    def _guess(self, i: int, key: Key, moment: Moment) -> Guess | None:
        """The same moment of an earlier run or of another mesh, or without memory the solved moment with the nearest
        pose."""
        known = self.guesses.get(key) or self._start(i, moment)
        strayed = self.memory.of_the_way and self.away > FAR_AWAY
        if known is not None and _near(known.pose, moment.pose) < 2e-3 and not strayed:
            return known
        if self.memory.of_the_way or not self.solved:
            return None
        best = min(self.solved.values(), key=lambda g: _near(g.pose, moment.pose))
        return best if _near(best.pose, moment.pose) < _near(self.mechanics.moment.pose, moment.pose) - 1e-9 else None

    def _start(self, i: int, moment: Moment) -> Guess | None:
        """What another mesh has solved, put right by what it got wrong at the nearest moment that is solved here."""
        starts = self.body._starts
        start = starts.get(self._key(i))
        done = [(g, starts[self._key(j)]) for j, g in self.solved.items() if self._key(j) in starts]
        if start is None or not done:
            return start
        found, before = min(done, key=lambda pair: _near(pair[0].pose, moment.pose))
        return start.put_right(before, found) if _near(found.pose, moment.pose) < ALIKE else start

    def _key(self, i: int) -> Key:
        return self.o.name, int(self.o.stamps_ns[i])

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
            forces: dict[int, Array] = {}
            r = np.column_stack([v.residual_change(m, i, held, part, forces) for v in variants])
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
        solved = self.guesses.get(self._key(i))
        if solved is not None and solved.z is self.z:
            names = list(self.z)
            solved.slopes = {names[j]: dx[:, k].copy() for k, j in enumerate(fresh) if names}

    def _commit_variants(self, moment: Moment, i: int) -> None:
        for variant in self.variants:
            variant.start(moment, self.mechanics)


# --- small functions
# --------------------------------------------------------------------------------------------------------


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


__all__ = ["RUBBING", "Body", "Candidate", "Setting", "pose_matrices"]
