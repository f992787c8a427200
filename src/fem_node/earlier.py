"""What the body went through in earlier recordings, where it remembers that for good: a plastic set.

The probe's paths of these recordings are passed before the first prediction, thinned to key poses: linear motion
between them is nowhere further than ``TOLERANCE`` from the recorded one at the same time (splits at the farthest pose,
Meratnia & de By 2004), so that depths, dwells and turning points stay; none is further than ``SPACING`` from the next.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from fem_node.model import PhantomModel
from fem_node.physics import Physics
from fem_node.timeline import LEVER
from livedeform_common.errors import InputError
from livedeform_common.frames import pose_matrix
from livedeform_common.recording import load_poses
from livedeform_common.types import Array, Pose

TOLERANCE = 1e-4  # m
SPACING = 2e-3  # m, along the path: a probe that slides leaves a set all the way
TIMES_TOLD = 10  # per recording


def remembers_for_good(physics: Physics) -> bool:
    """Whether a body is another one after a press, however long it rests."""
    return physics.plastic_set is not None


def bags_of(text: str) -> list[Path]:
    """The paths of the node's parameter ``after``: one string, as `joined` makes it."""
    return [Path(part) for part in text.split(os.pathsep) if part]


def joined(bags: Sequence[Path]) -> str:
    """Paths as one ROS parameter: an empty list has no type there."""
    return os.pathsep.join(str(bag) for bag in bags)


def earlier_poses(bags: Sequence[Path], start_ns: int) -> list[list[Pose]]:
    """The poses of each of ``bags`` (the earliest first); ``InputError`` where one has none, or is not over when the
    next begins, or when the recording that begins at ``start_ns`` does (0: not known)."""
    out: list[list[Pose]] = []
    for bag in bags:
        poses = load_poses(bag)
        if not poses:
            raise InputError(
                "has no probe poses that the body could have gone through",
                where=f"--after {bag}",
                remedy="leave it out, or name the recording with /probe/pose",
            )
        if out and poses[0].stamp_ns <= out[-1][-1].stamp_ns:
            raise InputError(
                "does not begin after the recording that is named before it",
                where=f"--after {bag}",
                remedy="name the earliest first, each once",
            )
        out.append(poses)
    if start_ns and out and out[-1][-1].stamp_ns >= start_ns:
        raise InputError(
            "is not earlier than the recording that is run",
            where=f"--after {bags[-1]}",
            remedy="name recordings that had ended when the run's --bag began",
        )
    return out


def pass_earlier(
    model: PhantomModel, bags: Sequence[Path], start_ns: int, progress: Callable[[str], None]
) -> PhantomModel:
    """The model, which has gone through the recordings ``bags`` (the earliest first) as far as it remembers that."""
    recordings = earlier_poses(bags, start_ns)
    if not recordings:
        return model
    if not remembers_for_good(model.physics):
        progress("earlier recordings are skipped: nothing in the model remembers them for good (no plastic_set)")
        return model
    model.reset(recordings[0][0].stamp_ns)
    for bag, poses in zip(bags, recordings, strict=True):
        keys = key_poses(poses)
        missed = 0
        for k, pose in enumerate(keys):
            if k % max(len(keys) // TIMES_TOLD, 1) == 0:
                progress(f"going through {bag}: {k} of {len(keys)} key poses")
            missed += not model.predict(pose).converged
        if missed:
            progress(f"warning: {bag}: no equilibrium at {missed} of {len(keys)} key poses; their set is missing")
    return model


def key_poses(poses: Sequence[Pose]) -> list[Pose]:
    """The poses that say the path, see the module's text; first and last are among them."""
    face = LEVER * np.vstack([np.zeros(3), np.eye(3)])  # points of the probe that also tell a turn
    T = np.array([pose_matrix(pose) for pose in poses])
    path = (np.einsum("fij,kj->fki", T[:, :3, :3], face) + T[:, None, :3, 3]).reshape(len(poses), -1, 3)
    t = np.array([pose.stamp_ns - poses[0].stamp_ns for pose in poses], float)
    kept = _corners(t, path)
    for i, j in pairwise(kept.copy()):
        kept += _on_the_way(path, i, j)
    return [poses[i] for i in sorted(kept)]


def _corners(t: Array, path: Array) -> list[int]:
    """Numbers of the poses between which motion is linear in time within the tolerance."""
    kept, open_ends = [0], [len(t) - 1]
    while open_ends:
        i, j = kept[-1], open_ends[-1]
        share = ((t[i : j + 1] - t[i]) / max(t[j] - t[i], 1.0))[:, None, None]
        off = np.linalg.norm(path[i : j + 1] - path[i] - share * (path[j] - path[i]), axis=2).max(axis=1)
        worst = int(np.argmax(off))
        if off[worst] > TOLERANCE and 0 < worst < j - i:
            open_ends.append(i + worst)
        else:
            kept.append(open_ends.pop())
    return kept if len(t) > 1 else [0]


def _on_the_way(path: Array, i: int, j: int) -> list[int]:
    """Numbers of the poses between i and j that are about a spacing apart."""
    way = np.linalg.norm(np.diff(path[i : j + 1], axis=0), axis=2).max(axis=1).cumsum()
    n = int(np.ceil(way[-1] / SPACING)) if len(way) else 0
    wanted = way[-1] * np.arange(1, n) / n if n else np.zeros(0)
    return [int(k) for k in np.unique(i + 1 + np.searchsorted(way, wanted)) if i < k < j]
