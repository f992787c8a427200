"""The phantom as a whole: probe poses in, predictions out, in the order of their stamps."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from fem_node.carried import CarriedPoints
from fem_node.declared import declared_physics
from fem_node.effects import apply_effects
from fem_node.element import ElementKind, Space, make_space
from fem_node.items import Moment
from fem_node.mechanics import Mechanics
from fem_node.mesh import load_or_make_mesh
from fem_node.physics import Physics
from fem_node.rest_shape import unloaded_shape
from fem_node.solver import SolverSettings
from fem_node.tet_mesh import TetMesh
from livedeform_common import frames
from livedeform_common.errors import ConvergenceError
from livedeform_common.experiment import Experiment
from livedeform_common.types import Array, EffectValues, Ids, Pose, Prediction

DEFAULT_ELEMENT: ElementKind = "p2p0"
_QUARTERS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])  # a quadratic facet as four flat triangles


class PhantomModel:
    """Predicts surface, markers, lesions and force.

    ``ids`` (n,), ``markers`` (n, 3) m and ``still`` (n,) bool (markers on the support) and ``lesions`` (l, 3) m are in the
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
        points = np.zeros((0, 3)) if markers is None else markers
        self.ids = np.arange(len(points), dtype=np.uint32) if ids is None else ids
        self._markers = CarriedPoints(space, points, still)
        self._lesions = CarriedPoints(space, np.zeros((0, 3)) if lesions is None else lesions)
        unloaded = None
        if physics.scan_fraction != 0.0:
            tell("recovering the unloaded shape from the scanned one")
            unloaded = unloaded_shape(space, physics, settings=settings, threads=threads)
        self.mechanics = Mechanics(space, physics, unloaded, settings=settings, threads=threads)
        self._start_ns: int | None = None
        self._clock_ns = physics.clock_start_ns
        self._now_ns: int | None = None
        self._rest: tuple[Moment, object] | None = None

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
        """The model of an experiment; ``effects`` default to the experiment's own, ``mesh`` to the cached or made one."""
        mesh = mesh if mesh is not None else load_or_make_mesh(experiment.phantom, progress=progress)
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
        try:
            return self._try(self._now_ns or 0, [replace(self._moment(None, 0, active=True), dt=np.inf)])
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
        return self._try(stamp_ns, self._moments(pose, stamp_ns))

    def reset(self, start_ns: int | None = None) -> None:
        """Forgets history and the recording's start (or sets it). The drifts' clock goes on from the first recording."""
        self.mechanics.reset()
        self._start_ns, self._now_ns = start_ns, None

    # -- moments ---------------------------------------------------------------------------------------------------

    def _moments(self, pose: Pose | None, stamp_ns: int) -> list[Moment]:
        """The moments to pass to reach ``stamp_ns``: at first the state at rest, and the release if it lies between."""
        release_ns = self._start_ns + round(1e9 * self.physics.release)
        moments = []
        now = self._now_ns
        if now is None:
            now = self._start_ns
            moments.append(replace(self._moment(None, now, active=release_ns <= now), dt=np.inf))
        if now < release_ns <= stamp_ns:
            before = self._moment(pose, release_ns, active=False)
            moments.append(replace(before, dt=1e-9 * (release_ns - now)))
            moments.append(replace(self._moment(pose, release_ns, active=True), dt=0.0))
            now = release_ns
        last = self._moment(pose, stamp_ns, active=stamp_ns >= release_ns)
        moments.append(replace(last, dt=1e-9 * max(stamp_ns - now, 0)))
        return moments

    def _moment(self, pose: Pose | None, stamp_ns: int, *, active: bool) -> Moment:
        T = None
        if pose is not None and self.physics.probe is not None:
            T = frames.pose_matrix(pose)
            T[:3, 3] += T[:3, :3] @ self.physics.probe.offset
        since = 0.0 if self._clock_ns is None else 1e-9 * (stamp_ns - self._clock_ns)
        gravity = self.physics.gravity if active else np.zeros(3)
        return Moment(time=since, dt=0.0, gravity=gravity, load=float(active), pose=T)

    def _try(self, stamp_ns: int, moments: Sequence[Moment]) -> Prediction:
        saved, began = self.mechanics.save(), clock.perf_counter()
        iterations, message, converged = 0, "", True
        try:
            for moment in moments:
                iterations += self.mechanics.advance(moment).n_iterations
            self._now_ns = stamp_ns
        except ConvergenceError as error:
            self.mechanics.restore(saved)
            converged, message = False, str(error)
        return self._prediction(stamp_ns, converged, message, iterations, clock.perf_counter() - began)

    # -- results ---------------------------------------------------------------------------------------------------

    def _prediction(self, stamp_ns: int, converged: bool, message: str, iterations: int, seconds: float) -> Prediction:
        u = self.mechanics.u
        force, torque = self.mechanics.wrench()
        nodes, triangles = self.surface
        spoil = 1.0 if converged else np.nan
        return Prediction(
            stamp_ns=stamp_ns,
            ids=self.ids,
            markers=spoil * self._markers.positions(u),
            surface=spoil * (self.space.nodes[nodes] + u[nodes]),
            surface_nodes=nodes.astype(np.uint32),
            triangles=triangles,
            lesions=spoil * self._lesions.positions(u),
            force=spoil * force,
            torque=spoil * torque,
            converged=converged,
            message=message,
            n_iterations=iterations,
            solve_seconds=seconds,
        )

    @cached_property
    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Surface nodes (m,) and triangles (k, 3) that index them; a quadratic facet is four triangles."""
        facets = self.space.facets
        triangles = facets[:, _QUARTERS].reshape(-1, 3) if self.space.quadratic else facets
        nodes, rows = np.unique(triangles, return_inverse=True)
        return nodes, rows.reshape(-1, 3)
