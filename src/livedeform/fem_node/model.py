"""The phantom as a whole: probe poses in, predictions out, in the order of their stamps."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from livedeform.common.errors import ConvergenceError
from livedeform.common.experiment.yaml_file import Experiment
from livedeform.common.types import Array, EffectValues, Ids, Pose, Prediction
from livedeform.fem_node.declared import declared_physics
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.element.element import ElementKind, Space, make_space
from livedeform.fem_node.embedded_points import CarriedPoints
from livedeform.fem_node.mesh.generate import load_or_make_mesh
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.path.followers import Direction, Followers
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.pose_track import PoseTrack
from livedeform.fem_node.path.responses import Responses, answers_linearly, forgets
from livedeform.fem_node.path.timeline import Instant, PoseAt, Timeline
from livedeform.fem_node.path.unloaded import InverseProblem, changed_shapes, unloaded_shape
from livedeform.fem_node.path.warm_start import Foreseen
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.solve.solver import SolverSettings

DEFAULT_ELEMENT: ElementKind = "p2p0"
_QUARTERS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])  # a quadratic facet as four flat triangles


@dataclass(frozen=True)
class Simulation:
    """``predictions`` of n moments; ``d_markers`` (n, markers, 3, p) and ``d_forces`` (n, 3, p): their derivatives
    along p
    directions, NaN where there is no solution. If asked for, ``states``: the solutions (None where there is none), and
    ``d_states`` (n_dof, p): how they change along the directions (None where no linear answer was asked for), to start
    other runs from (`Simulation.start`)."""

    predictions: list[Prediction]
    d_markers: Array
    d_forces: Array
    states: list[Foreseen | None]
    d_states: list[Array | None]

    def start(self, k: int, change: Array) -> Foreseen | None:
        """What is to be expected at the moment number ``k`` of a body that is ``change`` (p,) away."""
        state = self.states[k]
        d_state = self.d_states[k]
        return state if state is None or d_state is None else state._replace(x=state.x + d_state @ change)


class PhantomModel:
    """Predicts surface, markers, lesions and force.

    ``ids`` (n,), ``markers`` (n, 3) m and ``still`` (n,) bool (markers on the support) and ``lesions`` (l, 3) m are
    in the
    scanned configuration. The recording starts at the first stamp that `predict` sees, or at ``start_ns``.
    """

    def __init__(
        self,
        space: Space,
        physics: Physics,
        *,
        ids: Ids | None = None,
        markers: Array | None = None,
        still: np.ndarray | None = None,
        lesions: Array | None = None,
        settings: SolverSettings | None = None,
        threads: int | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> None:
        tell = progress or (lambda text: None)
        self.space, self.physics = space, physics
        self._settings, self._threads = settings, threads
        points = np.zeros((0, 3)) if markers is None else markers
        self.ids = np.arange(len(points), dtype=np.uint32) if ids is None else ids
        self._markers = CarriedPoints(space, points, still)
        self._lesions = CarriedPoints(space, np.zeros((0, 3)) if lesions is None else lesions)
        unloaded = None
        if physics.scan_fraction != 0.0:
            tell("recovering the unloaded shape from the scanned one")
            unloaded = unloaded_shape(self._inverse)
        self.mechanics = Mechanics(space, physics, unloaded, settings=settings, threads=threads)
        self._start_ns: int | None = None
        self._clock_ns = physics.clock_start_ns
        self._now_ns: int | None = None
        self._last_pose: Pose | None = None

    @classmethod
    def from_experiment(
        cls,
        experiment: Experiment,
        *,
        effects: Iterable[EffectValues] | None = None,
        mesh: TetMesh | None = None,
        element: ElementKind = DEFAULT_ELEMENT,
        settings: SolverSettings | None = None,
        threads: int | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> PhantomModel:
        """The model of an experiment; ``effects`` default to the experiment's own, ``mesh`` to the cached or made
        one."""
        if mesh is None:  # a surface always comes with an element size (schema)
            mesh = load_or_make_mesh(experiment.phantom, progress=progress)  # type: ignore[arg-type]
        physics = apply_effects(declared_physics(experiment), experiment.effects if effects is None else effects)
        markers = experiment.markers
        return cls(
            make_space(mesh, element),
            physics,
            ids=markers.ids,
            markers=markers.points,
            still=np.asarray(markers.kinds) == "support",
            lesions=np.array([lesion.centre for lesion in experiment.lesions], float).reshape(-1, 3),
            settings=settings,
            threads=threads,
            progress=progress,
        )

    # -- predicting ------------------------------------------------------------------------------------------------

    def rest(self) -> Prediction:
        """Under weight and loads, without the probe, relaxed. The state of `predict` is not touched."""
        saved = self.mechanics.save()
        stamp_ns = self._now_ns or 0
        line = Timeline(stamp_ns, stamp_ns if self._clock_ns is None else self._clock_ns, 0.0)
        try:
            return self._pass(line, None, stamp_ns, [Instant(stamp_ns, np.inf, active=True, with_probe=False)])
        finally:
            self.mechanics.restore(saved)

    def predict(self, pose: Pose | None, stamp_ns: int | None = None) -> Prediction:
        """The moment ``stamp_ns`` (default: the pose's own, corrected by the probe's time offset) at ``pose``.

        Stamps should not go back: history (relaxation, slip, plastic set) goes on from the last converged prediction. A
        stamp before that is solved as if no time had passed. Without convergence everything is as before the call.
        """
        if stamp_ns is None:
            stamp_ns = 0 if pose is None else pose.stamp_ns
            if pose is not None and self.physics.probe is not None:
                stamp_ns -= round(1e9 * self.physics.probe.time_offset)
        if self._start_ns is None:
            self._start_ns = stamp_ns
        if self._clock_ns is None:
            self._clock_ns = self._start_ns
        line = self._timeline(self._start_ns, self._clock_ns)
        prediction = self._pass(
            line, self._live_track(pose, stamp_ns), stamp_ns, self._way(line, self._now_ns, stamp_ns)
        )
        if prediction.converged:
            self._now_ns = stamp_ns
            self._last_pose = pose
        return prediction

    def _timeline(self, start_ns: int, clock_ns: int) -> Timeline:
        return Timeline(start_ns, clock_ns, self.physics.release, dynamic=bool(self.mechanics.memory.rings))

    def _way(self, line: Timeline, now_ns: int | None, stamp_ns: int) -> Iterator[Instant]:
        return line.instants(now_ns, stamp_ns, self.mechanics.pace)

    def _live_track(self, pose: Pose | None, stamp_ns: int) -> PoseAt | None:
        """The probe at ``pose`` at the stamp; with inertia, on its way there from the last pose."""
        if pose is None:
            return None
        known = [replace(pose, stamp_ns=stamp_ns)]
        if self._last_pose is not None and self._now_ns is not None and self._now_ns < stamp_ns:
            known.insert(0, replace(self._last_pose, stamp_ns=self._now_ns))
        delay = 0.0 if self.physics.probe is None else 1e9 * self.physics.probe.time_offset
        track = PoseTrack(known)
        return lambda stamp: track.at(stamp - delay)  # the stamp has been corrected already

    def reset(self, start_ns: int | None = None) -> None:
        """Forgets history and the recording's start (or sets it). The drifts' clock goes on from the first
        recording."""
        self.mechanics.reset()
        self._start_ns, self._now_ns, self._last_pose = start_ns, None, None

    # -- many moments, with sensitivities ----------------------------------------------------------------------------

    def simulate(
        self,
        poses: Sequence[Pose] | None,
        stamps_ns: Sequence[int],
        sensitivities: Sequence[Direction] = (),
        *,
        start_ns: int | None = None,
        starts: Sequence[Foreseen | None] | None = None,
        keep_states: bool = False,
        derive_at: Collection[int] | None = None,
    ) -> Simulation:
        """Predictions at ``stamps_ns`` (rising) from the state at rest, and their derivatives along each direction.

        ``poses`` is the recorded track, as dense as it was recorded (it is interpolated, also for a time offset); None
        without a probe. ``start_ns``: the recording's start (default: the first stamp). The state of `predict` is kept.
        ``starts``: where each stamp's solution is expected (of a run of a body that is little different), for bodies
        whose contact forgets; ``keep_states``: the run keeps its own for that. ``derive_at``: numbers of the moments
        whose derivatives are wanted (the others' are NaN where the body forgets; default: all).
        """
        saved = self.mechanics.save()
        self.mechanics.reset()
        first = int(stamps_ns[0]) if start_ns is None else start_ns
        clock_ns = next((c for c in (self.physics.clock_start_ns, self._clock_ns) if c is not None), first)
        line = self._timeline(first, clock_ns)
        pose_at = PoseTrack(poses).at if poses else None
        followers = self._followers(sensitivities) if sensitivities else None
        try:
            derived = range(len(stamps_ns)) if derive_at is None else derive_at
            return self._simulate(line, pose_at, stamps_ns, followers, len(sensitivities), starts, keep_states, derived)
        finally:
            self.mechanics.restore(saved)

    def _simulate(
        self,
        line: Timeline,
        pose_at: PoseAt | None,
        stamps_ns: Sequence[int],
        followers: Followers | Responses | None,
        n_directions: int,
        starts: Sequence[Foreseen | None] | None,
        keep_states: bool,
        derived: Collection[int],
    ) -> Simulation:
        n, p = len(stamps_ns), n_directions
        memoryless, everybody = forgets(self.physics), followers
        out = Simulation([], np.full((n, len(self.ids), 3, p), np.nan), np.full((n, 3, p), np.nan), [], [])
        now_ns: int | None = None
        for k, stamp_ns in enumerate(stamps_ns):
            way: Iterable[Instant] = self._way(line, now_ns, int(stamp_ns))
            followers = None if memoryless and k not in derived else everybody
            start = starts[k] if starts is not None else None
            if start is not None and memoryless and now_ns is None:
                way = list(way)[-1:]  # no need to come from the state at rest
            if start is not None and starts is not None and k and out.predictions[-1].converged:
                start = start.put_right(starts[k - 1], self.mechanics.foreseen())
            prediction = self._pass(line, pose_at, int(stamp_ns), way, followers, start)
            out.predictions.append(prediction)
            if keep_states:
                out.states.append(self.mechanics.foreseen() if prediction.converged else None)
                out.d_states.append(followers.d_states() if isinstance(followers, Responses) else None)
            if not prediction.converged:
                continue
            now_ns = int(stamp_ns)
            if followers is not None:
                self._differentiate(followers, out.d_markers[k], out.d_forces[k])
        return out

    @cached_property
    def _inverse(self) -> InverseProblem:
        return InverseProblem(self.space, self.physics, settings=self._settings, threads=self._threads)

    def _followers(self, directions: Sequence[Direction]) -> Followers | Responses:
        """Bodies with changed physics, each with its own unloaded shape."""
        shapes: list[Array | None] = [self.mechanics.unloaded] * len(directions)
        scanned_loaded = [
            k for k, d in enumerate(directions) if d.physics.scan_fraction != 0.0 or self.mechanics.unloaded is not None
        ]
        if scanned_loaded:
            w = self.mechanics.unloaded
            known = np.zeros(self.space.nodes.shape) if w is None else w
            changed = changed_shapes(self._inverse, known, [directions[k].physics for k in scanned_loaded])
            for k, shape in zip(scanned_loaded, changed, strict=True):
                shapes[k] = shape
        if answers_linearly(self.physics, [d.physics for d in directions]):
            return Responses(self.mechanics, directions, shapes)
        return Followers(self.mechanics, directions, shapes)

    def _differentiate(self, followers: Followers | Responses, d_markers: Array, d_force: Array) -> None:
        """Fills the derivatives (n_markers, 3, p) and (3, p) of the committed moment."""
        if isinstance(followers, Responses):
            d_markers[:], d_force[:] = followers.columns(self._markers)
            return
        shadow = followers.members[0]
        markers = self._markers.positions(shadow.mechanics.u)
        for k, member in enumerate(followers.members[1:]):
            if member.found:
                d_markers[:, :, k] = (self._markers.positions(member.mechanics.u) - markers) / member.direction.width
                d_force[:, k] = (member.force - shadow.force) / member.direction.width

    def _pass(
        self,
        line: Timeline,
        pose_at: PoseAt | None,
        stamp_ns: int,
        instants: Iterable[Instant],
        followers: Followers | Responses | None = None,
        start: Foreseen | None = None,
    ) -> Prediction:
        """Passes the instants on the way to ``stamp_ns`` (where ``start`` is expected); without convergence everything
        is as before."""
        mechanics, began = self.mechanics, clock.perf_counter()
        saved = mechanics.save()
        iterations, message, converged = 0, "", True
        try:
            for instant in line.in_strokes(instants, self.physics, pose_at):
                moment = line.moment(self.physics, instant, pose_at)
                there = instant.stamp_ns == stamp_ns and instant.with_probe
                solution = mechanics.solve(moment, foreseen=start if there else None)
                iterations += solution.n_iterations
                if followers is not None:
                    followers.step(solution.x, partial(line.moment, instant=instant, pose_at=pose_at))
                mechanics.commit(solution.x, moment)
        except ConvergenceError as error:
            mechanics.restore(saved)
            converged, message = False, str(error)
        return self._prediction(stamp_ns, converged, message, iterations, clock.perf_counter() - began)

    # -- results ---------------------------------------------------------------------------------------------------

    def _prediction(self, stamp_ns: int, converged: bool, message: str, iterations: int, seconds: float) -> Prediction:
        force, torque = self.mechanics.wrench()
        prediction = self.prediction_of(self.mechanics.x if converged else np.nan * self.mechanics.x, stamp_ns)
        spoil = 1.0 if converged else np.nan
        return replace(
            prediction,
            markers=spoil * prediction.markers,
            force=spoil * force,
            torque=spoil * torque,
            converged=converged,
            message=message,
            n_iterations=iterations,
            solve_seconds=seconds,
        )

    def prediction_of(self, x: Array, stamp_ns: int) -> Prediction:
        """Where surface, markers and lesions are at the unknowns ``x`` (n_dof,), without the probe's wrench.

        Of ``x`` only the dofs of `seen_nodes` are looked at.
        """
        u = x[: 3 * self.space.n_nodes].reshape(-1, 3)
        nodes, triangles = self.surface
        return Prediction(
            stamp_ns=stamp_ns,
            ids=self.ids,
            markers=self._markers.positions(u),
            surface=self.space.nodes[nodes] + u[nodes],
            surface_nodes=nodes.astype(np.uint32),
            triangles=triangles,
            lesions=self._lesions.positions(u),
            force=np.zeros(3),
            torque=np.zeros(3),
            converged=True,
        )

    @cached_property
    def seen_nodes(self) -> np.ndarray:
        """Nodes whose displacements predictions are made of: the surface's, and those that carry markers and
        lesions."""
        return np.unique(np.concatenate([self.surface[0], self._markers.nodes, self._lesions.nodes]))

    @cached_property
    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Surface nodes (m,) and triangles (k, 3) that index them; a quadratic facet is four triangles."""
        facets = self.space.facets
        triangles = facets[:, _QUARTERS].reshape(-1, 3) if self.space.quadratic else facets
        nodes, rows = np.unique(triangles, return_inverse=True)
        return nodes, rows.reshape(-1, 3)
