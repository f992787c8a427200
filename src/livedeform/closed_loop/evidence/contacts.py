"""Find where the probe pressed, and how deep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.common.types import Array, Pose


def contacts_of(fitted: Sequence[Observation], limits: tuple[float, float]) -> tuple[Pose | None, float, Array]:
    """Find where the deepest press meets the body, straight above where it is deepest, and how deep it goes from there
    along the probe's axis (within ``limits`` m); and where the probe was at the deepest moments of all presses."""
    places, depth, top = [], 0.0, None
    for o in fitted:
        moved = _mean_motion(o)
        for here in _pressed_moments(o):
            last = here[int(np.argmax(moved[here]))]
            deepest = o.poses[last]
            assert deepest is not None  # of a moment with a pose
            places.append(deepest.position)
            axis = Rotation.from_quat(deepest.orientation_xyzw).as_matrix()[:, 2]
            travel = _depth_of(o, here, last, moved, axis)
            if top is None or travel > depth:
                depth, top = travel, replace(deepest, position=deepest.position - travel * axis)
    contacts = np.array(places).reshape(-1, 3)
    return top, float(np.clip(depth, *limits)), contacts


def _mean_motion(o: Observation) -> Array:
    """Return how far (k,) m the markers are from where they began, on average; 0 where none was seen."""
    d = np.linalg.norm(o.points - o.points[0], axis=2)
    seen = np.isfinite(d)
    return np.asarray(np.where(seen, d, 0.0).sum(axis=1) / seen.sum(axis=1).clip(min=1))


def _pressed_moments(o: Observation) -> list[np.ndarray]:
    """Return the moments of each press that have a pose; where noise hides them all, of each block that is not at
    rest."""
    has_pose = np.array([p is not None for p in o.poses])
    number = np.where(o.presses > 0, o.presses, -1)
    if not (o.presses > 0).any():
        number = np.where(o.phases != "rest", o.blocks, -1)
    return [np.flatnonzero((number == n) & has_pose) for n in np.unique(number[has_pose & (number >= 0)])]


def _depth_of(o: Observation, here: np.ndarray, last: int, moved: Array, axis: Array) -> float:
    """Return how far m along its ``axis`` the probe goes from the touch to its deepest moment ``last``; its way through
    the air, and sideways, does not count. The touch is where the markers' motion began, by how it goes on from the
    first moment ``here``, but not before the last moment without any."""

    def above(i: int) -> float:
        pose, deepest = o.poses[i], o.poses[last]
        return 0.0 if pose is None or deepest is None else float((deepest.position - pose.position) @ axis)

    first, before = above(here[0]), above(max(here[0] - 1, 0))
    rise = moved[last] - moved[here[0]]
    since_touch = moved[here[0]] * first / rise if rise > 0.0 else 0.0
    return max(min(first + since_touch, max(before, first)), 0.0)
