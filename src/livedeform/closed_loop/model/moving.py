"""The body in motion, with inertia in force: followed step by step from its release, with its columns.

A column at one moment holds what the whole motion before it did: a slightly softer body rings slower, and is more and
more out of step. So each column is a body of its own (`fem_node.path.followers`) that takes every step with the
leader, one
correction with the leader's tangent each: the linear sensitivity, carried through positions, velocities and history.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.embedded_points import CarriedPoints
from livedeform.fem_node.path.followers import Direction, Followers
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.pose_track import PoseTrack
from livedeform.fem_node.path.timeline import Timeline
from livedeform.fem_node.physics.record import Physics
from livedeform.stereo_node.effects import Surface


class MovingPath:
    """The moments of one recording, as the ``carried`` markers see them. ``changes``: changed physics, the step of the
    coordinate, the unloaded shape."""

    def __init__(
        self,
        carried: CarriedPoints,
        mechanics: Mechanics,
        o: Observation,
        changes: Sequence[tuple[Physics, float, Array | None]],
    ) -> None:
        self.carried, self.mechanics, self.o = carried, mechanics, o
        physics = mechanics.physics
        self.steps = np.array([h for _, h, _ in changes])
        directions = [Direction(str(k), changed, h) for k, (changed, h, _) in enumerate(changes)]
        self.followers = (
            Followers(mechanics, directions, [shape for _, _, shape in changes], linear=True) if changes else None
        )
        self.line = Timeline(o.start_ns, physics.clock_start_ns or 0, physics.release, dynamic=True)
        self.pose_at = PoseTrack(o.path).at if len(o.path) else None
        self.surfaces: dict[int, Surface] = {}  # by stamp

    def follow(self) -> tuple[Array, Array | None, Array, Array | None]:
        """Points (k, m, 3), forces (k, 3) and their columns (..., p); NaN from where no equilibrium is found."""
        o, m = self.o, self.mechanics
        k, n, p = o.n_moments, len(self.carried.positions(m.u)), len(self.steps)
        points, forces = np.full((k, n, 3), np.nan), np.full((k, 3), np.nan)
        d_points, d_forces = np.full((k, n, 3, p), np.nan), np.full((k, 3, p), np.nan)
        now: int | None = None
        try:
            for i, stamp in enumerate(o.stamps_ns):
                self._pass(now, int(stamp))
                now = int(stamp)
                points[i], forces[i] = self.carried.positions(m.u), m.wrench()[0]
                self.surfaces[now] = (m.space.nodes + m.u, m.space.facets[:, :3])
                if self.followers is not None:
                    d_points[i], d_forces[i] = self._columns(self.followers)
        except ConvergenceError:
            pass  # what comes after depends on what could not be solved
        has_forces = m.contact is not None and o.forces is not None
        return points, forces if has_forces else None, d_points, d_forces if has_forces else None

    def _pass(self, now: int | None, stamp: int) -> None:
        m = self.mechanics
        way = self.line.instants(now, stamp, m.pace)
        for instant in self.line.in_strokes(way, m.physics, self.pose_at):
            moment = self.line.moment(m.physics, instant, self.pose_at)
            solution = m.solve(moment, guess=m.ahead(moment))
            if self.followers is not None:
                self.followers.step(solution.x, partial(self.line.moment, instant=instant, pose_at=self.pose_at))
            m.commit(solution.x, moment)

    def _columns(self, followers: Followers) -> tuple[Array, Array]:
        """Derivatives (m, 3, p) and (3, p) of the committed moment."""
        shadow, *members = followers.members
        points, force = self.carried.positions(shadow.mechanics.u), shadow.mechanics.wrench()[0]
        d_points = [
            (self.carried.positions(f.mechanics.u) - points) / h if f.found else np.full_like(points, np.nan)
            for f, h in zip(members, self.steps, strict=True)
        ]
        d_forces = [(f.mechanics.wrench()[0] - force) / h for f, h in zip(members, self.steps, strict=True)]
        return np.stack(d_points, axis=-1), np.stack(d_forces, axis=-1)
