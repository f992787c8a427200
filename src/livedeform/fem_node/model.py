"""The phantom as a whole: probe poses in, predictions out, in the order of their stamps."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from livedeform.common.errors import ConvergenceError
from livedeform.common.experiment.yaml_file import Experiment
from livedeform.common.types import Array, EffectValues, Ids, Pose, Prediction
from livedeform.fem_node.declared import declared_physics
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.element.element import ElementKind, Space, make_space
from livedeform.fem_node.embedded_points import EmbeddedPoints
from livedeform.fem_node.items.supports import check_caught
from livedeform.fem_node.mesh.generate import MeshReport, load_or_make, read_surface
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.path.direction import Direction
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.pose_track import PoseTrack
from livedeform.fem_node.path.start import WarmStart, coordinates_of
from livedeform.fem_node.path.timeline import Instant, PoseAt, Timeline
from livedeform.fem_node.path.unloaded import UnloadedShapes
from livedeform.fem_node.path.walk import WALK, Walk, WalkSettings, sensitivities_of
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.solve.solver import SolverSettings

DEFAULT_ELEMENT: ElementKind = "p2p0"
_QUARTERS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])  # a quadratic facet as four flat triangles


@dataclass(frozen=True)
class Simulation:
    """``predictions`` of n moments, and their derivatives along p directions: ``d_markers`` (n, markers, 3, p) and
    ``d_forces`` (n, 3, p), NaN where there is no solution."""

    predictions: list[Prediction]
    d_markers: Array
    d_forces: Array

    def copy_moment(self, k: int, twin: int, stamp_ns: int) -> None:
        """Let moment number ``k``, the next one, be what moment number ``twin`` was."""
        self.predictions.append(replace(self.predictions[twin], stamp_ns=stamp_ns, n_iterations=0, solve_seconds=0.0))
        self.d_markers[k], self.d_forces[k] = self.d_markers[twin], self.d_forces[twin]


class PhantomModel:
    """Predicts surface, markers, lesions and force.

    ``ids`` (n,), ``markers`` (n, 3) m and ``still`` (n,) bool (markers on the support) and ``lesions`` (l, 3) m are
    in the scanned configuration. ``shapes``: unloaded shapes that are known already of bodies on the same mesh. The
    recording starts at the first stamp that `predict` sees, or at ``start_ns``.
    """

    def __init__(
        self,
        space: Space,
        physics: Physics,
        *,
        ids: Ids | None = None,
        markers: Array | EmbeddedPoints | None = None,
        still: np.ndarray | None = None,
        lesions: Array | None = None,
        settings: SolverSettings | None = None,
        threads: int | None = None,
        progress: Callable[[str], None] | None = None,
        shapes: UnloadedShapes | None = None,
    ) -> None:
        self.space, self.physics = space, physics
        if not isinstance(markers, EmbeddedPoints):
            markers = EmbeddedPoints(space, np.zeros((0, 3)) if markers is None else markers, still)
        self._markers = markers
        self.ids = np.arange(len(markers.points), dtype=np.uint32) if ids is None else ids
        self._lesions = EmbeddedPoints(space, np.zeros((0, 3)) if lesions is None else lesions)
        self._shapes = UnloadedShapes(space, settings, threads) if shapes is None else shapes
        if physics.scan_fraction != 0.0 and progress is not None:
            progress("recovering the unloaded shape from the scanned one")
        self.mechanics = Mechanics(space, physics, self._shapes.of(physics), settings=settings, threads=threads)
        self._start_ns: int | None = None
        self._clock_ns = physics.clock_start_ns
        self._now_ns: int | None = None
        self._last_pose: Pose | None = None
        self.mesh_report: MeshReport | None = None  # None where the mesh was handed in

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
        """Make the model of an experiment; ``effects`` default to the experiment's own, ``mesh`` to the cached or made
        one."""
        report = None
        if mesh is None:  # a surface always comes with an element size (schema)
            mesh, report = load_or_make(experiment.phantom, progress=progress)  # type: ignore[arg-type]
        declared, space = declared_physics(experiment), make_space(mesh, element)
        if experiment.phantom.surface is not None:
            check_caught(space, declared.supports, *read_surface(experiment.phantom.surface, experiment.phantom.unit))
        markers = experiment.markers
        model = cls(
            space,
            apply_effects(declared, experiment.effects if effects is None else effects),
            ids=markers.ids,
            markers=markers.points,
            still=np.asarray(markers.kinds) == "support",
            lesions=np.array([lesion.centre for lesion in experiment.lesions], float).reshape(-1, 3),
            settings=settings,
            threads=threads,
            progress=progress,
        )
        model.mesh_report = report
        return model

    # -- predicting ------------------------------------------------------------------------------------------------

    def rest(self, *, needed: bool = False) -> Prediction:
        """Predict the relaxed body under weight and loads, without the probe, at the last converged prediction; before
        the first one (it is stamped 0 then) at the recording's start, or, where that is not known, the clock's. The
        state of `predict` is not touched. Where it is ``needed``, ``ConvergenceError`` if there is no equilibrium."""
        saved = self.mechanics.save()
        known = (self._now_ns, self._start_ns, self._clock_ns)
        at_ns = next((ns for ns in known if ns is not None), 0)
        line = Timeline(at_ns, at_ns if self._clock_ns is None else self._clock_ns, 0.0)
        try:
            at_rest = Instant(at_ns, np.inf, active=True, with_probe=False)
            rest = self._solved(self._now_ns or 0, lambda: Walk(self.mechanics, line).through([at_rest], at_ns))
        finally:
            self.mechanics.restore(saved)
        if needed and not rest.converged:
            raise ConvergenceError(rest.message, where="the body at rest")
        return rest

    def predict(self, pose: Pose | None, stamp_ns: int | None = None) -> Prediction:
        """Predict the moment ``stamp_ns`` (default: the pose's own, corrected by the probe's time offset) at ``pose``.

        Stamps should not go back: history (relaxation, slip, plastic set) goes on from the last converged prediction. A
        stamp before that is solved as if no time had passed, and time goes on from it, as after a clock that was set;
        poses that only come late are for the caller to leave out (`live.triggers.AtPoses`). Without convergence
        everything is as before the call.
        """
        if stamp_ns is None:
            stamp_ns = self.moment_of(pose)
        if self._start_ns is None:
            self._start_ns = stamp_ns
        if self._clock_ns is None:
            self._clock_ns = self._start_ns
        line = self._timeline(self._start_ns, self._clock_ns, pressed=pose is not None)
        walk = Walk(self.mechanics, line, self._live_track(pose, stamp_ns), self._now_ns)
        prediction = self._solved(stamp_ns, lambda: walk.to(stamp_ns))
        if prediction.converged:
            self._now_ns = stamp_ns
            self._last_pose = pose
        return prediction

    def moment_of(self, pose: Pose | None) -> int:
        """Return when (ns) the probe was at ``pose``: its stamp, corrected by the probe's time offset."""
        delay = 0.0 if self.physics.probe is None else self.physics.probe.time_offset
        return 0 if pose is None else pose.stamp_ns - round(1e9 * delay)

    def _timeline(
        self, start_ns: int, clock_ns: int, *, pressed: bool, sensitivities: Sequence[Direction] = ()
    ) -> Timeline:
        physics, memory = self.physics, self.mechanics.memory
        beside = [] if memory.rings else [direction.physics for direction in sensitivities]  # motion needs none
        delays = tuple(sorted({load.delay for each in (physics, *beside) for load in each.loads}))
        hung = bool(memory.hung) and not pressed
        return Timeline(start_ns, clock_ns, physics.release, dynamic=bool(memory.rings), hung=hung, delays=delays)

    def _live_track(self, pose: Pose | None, stamp_ns: int) -> PoseAt | None:
        """Return the probe's track: at ``pose`` at the stamp; with inertia, on its way there from the last pose."""
        if pose is None:
            return None
        known = [replace(pose, stamp_ns=stamp_ns)]
        if self._last_pose is not None and self._now_ns is not None and self._now_ns < stamp_ns:
            known.insert(0, replace(self._last_pose, stamp_ns=self._now_ns))
        delay = 0.0 if self.physics.probe is None else 1e9 * self.physics.probe.time_offset
        track = PoseTrack(known)
        return lambda stamp: track.at(stamp - delay)  # the stamp has been corrected already

    def reset(self, start_ns: int | None = None) -> None:
        """Forget history and the recording's start (or set it). The drifts' clock goes on from the first
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
        walk_settings: WalkSettings = WALK,
        warm: WarmStart | None = None,
    ) -> Simulation:
        """Predict the moments ``stamps_ns`` (rising) from the state at rest, with derivatives along each direction.

        ``poses`` is the recorded track, as dense as it was recorded (it is interpolated, also for a time offset); None
        without a probe. ``start_ns``: the recording's start (default: the first stamp). ``walk_settings``: how exactly
        the path is followed between the stamps, and sensitivities are worked out. ``warm``: solved moments of bodies
        that are little different, to start from. The state of `predict` is kept.
        """
        saved = self.mechanics.save()
        self.mechanics.reset()
        first = int(stamps_ns[0]) if start_ns is None else start_ns
        clock_ns = next((c for c in (self.physics.clock_start_ns, self._clock_ns) if c is not None), first)
        if warm is not None:
            warm.coordinates = coordinates_of(sensitivities)
        shapes = self._shapes.along(self.physics, self.mechanics.unloaded, sensitivities)
        walk = Walk(
            self.mechanics,
            self._timeline(first, clock_ns, pressed=bool(poses), sensitivities=sensitivities),
            PoseTrack(poses).at if poses else None,
            sensitivities=sensitivities_of(self.mechanics, sensitivities, shapes, walk_settings.corrections),
            warm=warm,
            walk_settings=walk_settings,
        )
        try:
            return self._along(walk, [int(s) for s in stamps_ns], len(sensitivities))
        finally:
            self.mechanics.restore(saved)

    def _along(self, walk: Walk, stamps_ns: Sequence[int], p: int) -> Simulation:
        """Predict the stamps of a walk; one with the same answer as an earlier one is not solved again, and a body in
        motion that is lost stays lost."""
        n, every = len(stamps_ns), range(p)
        out = Simulation([], np.full((n, len(self.ids), 3, p), np.nan), np.full((n, 3, p), np.nan))
        for k, stamp_ns in enumerate(stamps_ns):
            if k and self.mechanics.memory.rings and not out.predictions[-1].converged:
                out.predictions.append(replace(out.predictions[-1], stamp_ns=stamp_ns))
                continue
            wanted: Sequence[int] = every
            twin = walk.twin(stamp_ns)
            if twin is not None:
                out.copy_moment(k, stamps_ns.index(twin), stamp_ns)
                wanted = [] if walk.sensitivities is None else list(walk.sensitivities.passing)
                if not wanted:
                    continue
                out.predictions.pop()
            out.predictions.append(self._solved(stamp_ns, partial(walk.to, stamp_ns, wanted)))
            if walk.sensitivities is not None and out.predictions[-1].converged:
                d_markers, d_forces = walk.sensitivities.derivatives(self._markers, wanted)
                out.d_markers[k][..., wanted], out.d_forces[k][:, wanted] = d_markers, d_forces
        return out

    def _solved(self, stamp_ns: int, solve: Callable[[], int]) -> Prediction:
        """Predict the moment ``stamp_ns`` once ``solve`` has found it in some iterations; NaN if it does not."""
        began, iterations, message, converged = clock.perf_counter(), 0, "", True
        try:
            iterations = solve()
        except ConvergenceError as error:
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
        """Return where surface, markers and lesions are at the unknowns ``x`` (n_dof,), without the probe's wrench.

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

    @property
    def markers(self) -> EmbeddedPoints:
        """The markers, in the scanned configuration."""
        return self._markers

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
