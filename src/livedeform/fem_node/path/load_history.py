"""Carry the load history over to a body that remembers it: of earlier recordings what stays for good, a plastic set,
and all of what comes before the part of a recording that is run.

The probe's paths are passed before the first prediction, thinned to key poses: linear motion
between them is nowhere further than ``TOLERANCE`` from the recorded one at the same time (splits at the farthest pose,
Meratnia & de By 2004), so that depths, dwells and turning points stay; none is further than ``SPACING`` from the next.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from livedeform.common.bags.recording import load_poses
from livedeform.common.errors import InputError
from livedeform.common.frames import apply, pose_matrix
from livedeform.common.types import Array, Pose
from livedeform.fem_node.items.viscoelastic import SHARE_OF_TAU
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.timeline import LEVER, LONGEST_PATH_STEP
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics

TOLERANCE = 1e-4  # m
SPACING = 2e-3  # m, along the path: a probe that slides leaves a set all the way
TIMES_TOLD = 10  # per recording


def remembers_for_good(physics: Physics) -> bool:
    """Return whether a body is another one after a press, however long it rests."""
    return bool(memory_of(physics).sets)


def bags_of(text: str) -> list[Path]:
    """Return the paths of the node's parameter ``after``: apart by ":", or a JSON list, as `joined` makes it."""
    if text.startswith("["):
        try:
            return [Path(str(part)) for part in json.loads(text)]
        except ValueError as error:
            raise InputError("is no JSON list of paths", where=f"after: {text}", remedy='write ["a.mcap"]') from error
    return [Path(part) for part in text.split(os.pathsep) if part]


def joined(bags: Sequence[Path]) -> str:
    """Join paths, colons in them or not, to one ROS parameter: an empty list has no type there."""
    return json.dumps([str(bag) for bag in bags]) if bags else ""


def earlier_poses(bags: Sequence[Path], start_ns: int, release: float) -> list[list[Pose]]:
    """Return the poses of each of ``bags`` (the earliest first); ``InputError`` where one has none, or is not over when
    the next begins, or when the recording that begins at ``start_ns`` does (0: not known), and of a body that is let go
    at a ``release`` (s) after each recording's start: the model lets go once."""
    if bags and release > 0.0:
        raise InputError(
            "a body that is let go is held again before each recording, which the model does not follow",
            where=f"--after {bags[0]}",
            remedy="leave --after out, or timeline.release where the body is not let go",
        )
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
    """Return the model, which has gone through the recordings ``bags`` (the earliest first) as far as it remembers
    that."""
    recordings = earlier_poses(bags, start_ns, model.physics.release)
    if not recordings:
        return model
    if not remembers_for_good(model.physics):
        progress("earlier recordings are skipped: nothing in the model remembers them for good (no plastic_set)")
        return model
    model.reset(recordings[0][0].stamp_ns)
    for bag, poses in zip(bags, recordings, strict=True):
        keys = key_poses(poses)
        if missed := _go_through(model, keys, str(bag), progress):
            progress(f"warning: {bag}: no equilibrium at {missed} of {len(keys)} key poses; their set is missing")
    return model


def pass_beginning(model: PhantomModel, poses: Sequence[Pose], progress: Callable[[str], None]) -> int:
    """Lead the model through the ``poses`` of a recording that come before the part that is run; return at how many of
    the key poses there was no equilibrium.

    What follows shall be as in a run of all of the recording, which predicts at every pose: so the key poses are as
    near to each other as the path's steps of a probe that rubs, and in time as the shortest relaxation asks.
    """
    if not poses:
        return 0
    prony = model.physics.prony
    keys = key_poses(poses, LONGEST_PATH_STEP, np.inf if prony is None else SHARE_OF_TAU * 1e9 * min(prony.tau))
    return _go_through(model, keys, "what comes before --start", progress)


def _go_through(model: PhantomModel, keys: Sequence[Pose], what: str, progress: Callable[[str], None]) -> int:
    """Predict every key pose, and forget the predictions; return how many found no equilibrium."""
    missed = 0
    for k, pose in enumerate(keys):
        if k % max(len(keys) // TIMES_TOLD, 1) == 0:
            progress(f"going through {what}: {k} of {len(keys)} key poses")
        missed += not model.predict(pose).converged
    return missed


def key_poses(poses: Sequence[Pose], spacing: float = SPACING, longest_ns: float = np.inf) -> list[Pose]:
    """Return the poses that say the path, see the module's text; first and last are among them. None is further from
    the one before than ``spacing`` m, or later by more than ``longest_ns``, where there are poses between."""
    face = LEVER * np.vstack([np.zeros(3), np.eye(3)])  # points of the probe that also tell a turn
    path = np.array([apply(pose_matrix(pose), face) for pose in poses])
    t = np.array([pose.stamp_ns - poses[0].stamp_ns for pose in poses], float)
    kept, ends = [0], [len(poses) - 1] if len(poses) > 1 else []
    while ends:
        split = _split(t, path, kept[-1], ends[-1], spacing, longest_ns)
        if split is None:
            kept.append(ends.pop())
        else:
            ends.append(split)
    return [poses[i] for i in kept]


def _split(t: Array, path: Array, i: int, j: int, spacing: float, longest_ns: float) -> int | None:
    """Return the pose between i and j that is furthest from linear motion in time, or in the middle if they are further
    apart than ``spacing`` m or ``longest_ns``; None if neither."""
    share = ((t[i : j + 1] - t[i]) / (t[j] - t[i]))[:, None, None]
    off = np.linalg.norm(path[i : j + 1] - path[i] - share * (path[j] - path[i]), axis=2).max(axis=1)
    if off.max() > TOLERANCE:
        return i + int(np.argmax(off))
    far = np.linalg.norm(path[j] - path[i], axis=1).max() > spacing or t[j] - t[i] > longest_ns
    return (i + j) // 2 if far and j - i > 1 else None
