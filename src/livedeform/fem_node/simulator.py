"""One mesh with its markers, for whoever simulates many bodies on it: the closed loop.

A `Simulator` takes any physics and any recording, and starts each solution from what it solved before: the same moment
of a run with other parameters, the nearest pose, or the same moment on another mesh. Thousands of equilibria are solved
so; each is as exact as `SETTINGS` say, wherever it started.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array, Pose
from livedeform.fem_node.contact.approach import hangs
from livedeform.fem_node.contact.contact import ProbeContact
from livedeform.fem_node.element.element import ElementKind, Space, make_space
from livedeform.fem_node.embedded_points import EmbeddedPoints
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.model import PhantomModel, Simulation
from livedeform.fem_node.path.direction import Direction
from livedeform.fem_node.path.pose_track import PoseTrack
from livedeform.fem_node.path.start import (
    Key,
    Kind,
    Solved,
    SolvedMoment,
    SolvedMoments,
    WarmStart,
    fingerprint,
    pose_distance,
    transferred,
)
from livedeform.fem_node.path.timeline import probe_pose
from livedeform.fem_node.path.unloaded import UnloadedShapes
from livedeform.fem_node.path.walk import WALK, WalkSettings
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.solve.agreement import End, agree
from livedeform.fem_node.solve.solver import NOT_ENOUGH, SolverSettings

__all__ = [
    "NOT_ENOUGH",
    "Direction",
    "ElementKind",
    "Key",
    "Kind",
    "Recorded",
    "Simulation",
    "Simulator",
    "Solved",
    "WalkSettings",
]

# A moment that needs more load steps is left out. Key moments are far apart, each is a jump: tried at once, and walked
# only where that leads nowhere, or surface is pushed elsewhere than where the probe came in (walked always, the
# shipped phantom takes 1.6 times as long); walked once, not twice, which would double the price. What a solution means
# is looked at all the same (`Solver._verify`), and `Simulator.astray` tells whether it is the one that is meant. A
# moment that has no answer is given up once: from each of its starts in full, five under the gelatin cuboid's box took
# six times as long as all that have one.
SETTINGS = SolverSettings(
    smallest_step=0.25, strides=(1.0,), near_starts=False, approaches=False, single=True, once=True
)
AS_THE_GRAPH = SolverSettings(single=True)
FOLLOWED = 5e-4  # m between the poses that are followed to a moment
# a step of time is wrong by more (`fem_node.items.dynamics`), begins near its end, and is another one's tangent
IN_MOTION = replace(SETTINGS, tolerance=1e-6, keep_factor_rate=0.02, in_motion=True)


@dataclass(frozen=True)
class Recorded:
    """The part of a recording that the model needs: its ``name``, the moments ``stamps_ns`` (rising), its start, and
    the track of the probe (empty without one), as dense as it was recorded."""

    name: str
    stamps_ns: Sequence[int]
    start_ns: int
    poses: Sequence[Pose]


class Simulator:
    """Simulates any physics on one mesh; ``markers`` (m, 3) m are in the scanned configuration, and those that are
    ``still`` (m,) do not move."""

    def __init__(self, mesh: TetMesh, element: ElementKind, markers: Array, still: NDArray[np.bool_]) -> None:
        self.space: Space = make_space(mesh, element)
        self.solved = SolvedMoments()
        self.elsewhere: dict[Key, SolvedMoment] = {}  # what another mesh has solved
        self._markers = EmbeddedPoints(self.space, markers, still)
        self._shapes = UnloadedShapes(self.space)

    def simulate(
        self,
        physics: Physics,
        recorded: Recorded,
        directions: Sequence[Direction],
        walk_settings: WalkSettings,
        kind: Kind = frozenset(),
        most_iterations: float = np.inf,
    ) -> Simulation:
        """Predict a recording's moments and their derivatives (`PhantomModel.simulate`). ``kind``: what acts on the
        body besides what was declared, by which solved moments are kept. After ``most_iterations`` no more is found."""
        model = self._model(physics)
        if most_iterations < np.inf:
            model.mechanics.solver.left = most_iterations
        warm = WarmStart(self.solved.of(kind), recorded.name, elsewhere=self.elsewhere, body=fingerprint(model.physics))
        poses, stamps = recorded.poses or None, recorded.stamps_ns
        return model.simulate(
            poses, stamps, directions, start_ns=recorded.start_ns, walk_settings=walk_settings, warm=warm
        )

    def unload(self, physics: Physics, directions: Sequence[Direction]) -> None:
        """Find the unloaded shapes of a body and along directions, which are kept for its next simulations."""
        self._shapes.along(physics, self._shapes.of(physics), directions)

    def rest(self, physics: Physics) -> Array:
        """Return the markers (m, 3) m at rest at the clock's start, under what weight and loads act then, without the
        probe: a body that is let go later is held as it was scanned (`Timeline.moment`)."""
        physics = replace(physics, probe=None, inertia=None, clock_start_ns=None)
        if physics.release > 0.0:
            physics = replace(physics, gravity=physics.scan_fraction * physics.scan_gravity, loads=())
        return self._model(physics).rest().markers

    def astray(self, physics: Physics, recorded: Recorded, stamp_ns: int) -> str:
        """Say how far the moment ``stamp_ns`` of a recording, as it is simulated, is from where the graph comes to that
        follows the recorded poses from where the probe was last clear of the body; or why it does not come there.

        Empty where both are alike, and where only one equilibrium is to be expected: under a probe that is round enough
        for its elements. Of a body with a memory the path decides, and nothing can be said (but
        `rubs_on_sharp_edges`).
        """
        model = self._model(physics, AS_THE_GRAPH)
        contact = model.mechanics.contact
        if contact is None or not hangs(contact) or memory_of(physics).path_dependent:
            return ""
        stamps = _way_to(contact, physics, recorded, stamp_ns)
        followed = model.simulate(recorded.poses, stamps, start_ns=recorded.start_ns).predictions[-1]
        simulated = self.simulate(physics, recorded, (), WALK).predictions
        found = simulated[list(recorded.stamps_ns).index(stamp_ns)]
        if not (followed.converged and found.converged):
            return followed.message or found.message
        ends = [End(p.surface, p.force, 0.0) for p in (found, followed)]
        return "" if agree(ends) else ends[0].apart(ends[1])

    def rubs_on_sharp_edges(self, physics: Physics) -> str:
        """Say how sharp the probe's edges are for the elements where it also rubs on the surface or sticks to it, so
        that its path may end in several equilibria, all of them in balance; empty: they are round enough, or slide."""
        contact = self._model(physics).mechanics.contact if memory_of(physics).rubs else None
        if contact is None or not contact.approach.sharp:
            return ""
        return (
            f"edges of {1e3 * contact.shape.roundness:.2g} mm on triangles of {1e3 * contact.facet_size:.2g} mm, and "
            + ", ".join(memory_of(physics).rubs)
        )

    def start_from(self, other: Simulator, physics: Physics) -> None:
        """Start the moments at which the declared body of these ``physics`` was pressed from what the ``other`` mesh
        has solved of it."""
        self.elsewhere = transferred(other.solved.of(frozenset()), other.space, self.space, physics)

    def _model(self, physics: Physics, settings: SolverSettings = SETTINGS) -> PhantomModel:
        settings = IN_MOTION if memory_of(physics).rings else settings
        return PhantomModel(self.space, physics, markers=self._markers, settings=settings, shapes=self._shapes)


def _way_to(contact: ProbeContact, physics: Physics, recorded: Recorded, stamp_ns: int) -> list[int]:
    """Return the stamps (ns) of recorded poses that are some `FOLLOWED` apart, from the last one before ``stamp_ns`` at
    which the probe is clear of the body as it was scanned, and ``stamp_ns``."""
    assert physics.probe is not None  # it has a contact
    late, track = round(1e9 * physics.probe.time_offset), PoseTrack(recorded.poses).at
    at_rest, stamps = np.zeros(3 * contact.space.n_nodes), [stamp_ns]
    last = probe_pose(physics.probe, track, stamp_ns)
    for stamp in (pose.stamp_ns - late for pose in reversed(recorded.poses)):
        T = probe_pose(physics.probe, track, stamp)
        if T is None or stamp >= stamp_ns or pose_distance(T, last) < FOLLOWED:
            continue
        stamps.insert(0, stamp)
        last = T
        if not (contact.shape.distance(contact.seen(at_rest, T)).d < 0.0).any():
            break
    return stamps
