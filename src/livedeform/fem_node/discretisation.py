"""Estimate how much of a prediction is its elements' doing: solve the same moment with smaller ones where it matters.

Elements are halved where the probe presses, where a load acts and where a bond ends (`refinement.with_finer_edges`):
there stresses change within an element. That takes about half of the error away (``benchmarks/refined_mesh.py``), so
the error is taken for twice as much as it changes. Against meshes with all elements halved twice that was 0.6 times
what it should be under a ball, 1.2 under a load (``tests/fem_node/test_discretisation.py``): it says which digit is not
to be believed, it is no bound.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.pose_track import PoseTrack
from livedeform.fem_node.path.timeline import probe_pose
from livedeform.fem_node.path.walk import WalkSettings
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.refinement import with_finer_edges
from livedeform.fem_node.simulator import Recorded, Simulator

OF_CHANGE = 2.0  # the error over what smaller elements change of it
ROUGHLY = WalkSettings(path_step=1e-3, between=4.0)  # where a probe rubs, on both meshes alike


@dataclass(frozen=True)
class DiscretisationError:
    """The markers' error by the elements at the moment ``stamp_ns``: its ``rms`` and ``largest`` length m, the rms of
    their ``motion`` m there, and the ``unknowns`` of both meshes. ``markers`` (m, 3) m are the model's own, reached at
    once."""

    rms: float
    largest: float
    motion: float
    stamp_ns: int
    unknowns: tuple[int, int]
    markers: Array

    @property
    def share(self) -> float:
        """The error over the motion; NaN without any."""
        return self.rms / self.motion if self.motion > 0.0 else float("nan")

    def line(self) -> str:
        """Say it in a line."""
        share = f"{100.0 * self.share:.1f} % of their motion" if self.motion > 0.0 else "they do not move"
        wrong = f"they get the markers wrong by about {1e3 * self.rms:.3f} mm rms"
        return f"elements: {wrong} ({share}) at the deepest moment"

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON file holds."""
        numbers = asdict(self) | {"share_of_motion": self.share}
        del numbers["markers"]
        return numbers


def discretisation_error(model: PhantomModel, recorded: Recorded) -> DiscretisationError:
    """Estimate the elements' error of the model's markers at the last moment of what is ``recorded``; their motion is
    from the first one on, and without a probe, or where that moves none, from where they were scanned.

    The body is taken without relaxation, plastic set and inertia: these change little of what its elements get wrong,
    and would want its whole history on both meshes. Friction stays: without its hold a slender body may lean away.
    `ConvergenceError` or `MeshError` where it cannot be told.
    """
    space, markers = model.space, model.markers
    physics = replace(model.physics, prony=None, plastic_set=None, inertia=None)
    own = Simulator(space.mesh, space.kind, markers.points, markers.still)
    before = _markers(own, physics, recorded)
    pose_at = PoseTrack(recorded.poses).at if recorded.poses else None
    pose = probe_pose(physics.probe, pose_at, recorded.stamps_ns[-1])
    mesh = with_finer_edges(space.mesh, space.kind, physics, [pose], 1)
    finer = Simulator(mesh, space.kind, markers.points, markers.still)
    finer.start_from(own, physics)
    after = _markers(finer, physics, recorded)
    moving = ~markers.still
    error = OF_CHANGE * np.linalg.norm((after - before)[-1, moving], axis=1)
    motion = np.linalg.norm((before[-1] - before[0])[moving], axis=1)
    if pose is None or not motion.any():
        motion = np.linalg.norm((before[-1] - markers.points)[moving], axis=1)
    unknowns, stamp_ns = (own.space.n_dof, finer.space.n_dof), int(recorded.stamps_ns[-1])
    return DiscretisationError(_rms(error), float(error.max()), _rms(motion), stamp_ns, unknowns, before[-1])


def _markers(simulator: Simulator, physics: Physics, recorded: Recorded) -> Array:
    """Return the markers (moments, m, 3) m; `ConvergenceError` if a moment has no equilibrium."""
    predictions = simulator.simulate(physics, recorded, (), ROUGHLY).predictions
    for prediction in predictions:
        if not prediction.converged:
            raise ConvergenceError(prediction.message, where="the discretisation error")
    return np.array([p.markers for p in predictions])


def _rms(lengths: Array) -> float:
    return float(np.sqrt(np.mean(lengths**2)))
