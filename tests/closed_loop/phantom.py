"""A small finite-element phantom for tests: a hemi-ellipsoid, a probe with presses, and views without cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import toy

from livedeform.closed_loop.evidence.observation import Observation, poses_at
from livedeform.closed_loop.model.fem_model import Setting
from livedeform.common.types import Pose
from livedeform.fem_node.contact.probe_shapes import make_shape
from livedeform.fem_node.mesh.structured import hemi_ellipsoid_mesh
from livedeform.fem_node.physics.record import Physics, Probe, Support
from livedeform.stereo_node.effects import View

AXES = (0.05, 0.05, 0.05)


def physics(**changes: object) -> Physics:
    base = Physics(
        supports=(Support(lambda p: p[:, 2] < 1e-3),), probe=Probe(make_shape("box", (0.06, 0.015, 0.04), 0.002))
    )
    return replace(base, **changes)


def setting(n: int = 4, names: Sequence[str] = ("toy",), **changes: object) -> Setting:
    places = toy.markers()
    ids = np.arange(len(places)).astype(np.uint32)
    view = View(np.eye(4), None, places, ids, np.full(len(ids), "surface"), 0, registered=False)
    return Setting(
        mesh=hemi_ellipsoid_mesh(AXES, n),
        element="p2p0",
        physics=physics(**changes),
        declared=(),
        markers=places,
        still=np.zeros(len(places), bool),
        views={name: view for name in names},
        clock_start_ns=0,
    )


def moments(seconds: Sequence[float], poses: Sequence[Pose] | None = None, name: str = "toy") -> Observation:
    """An empty observation at these times."""
    path = list(poses) if poses is not None else toy.path()
    like = toy.record([], seed=0)
    stamps = (np.asarray(seconds) * 1e9).astype(np.int64)
    k, m = len(stamps), len(like.ids)
    position, rotation = poses_at(path, stamps)
    key = tuple(Pose(int(s), p, q) for s, p, q in zip(stamps, position, rotation.as_quat(), strict=True))
    return replace(
        like,
        name=name,
        stamps_ns=stamps,
        points=np.zeros((k, m, 3)),
        rates=np.zeros((k, m, 3)),
        covariances=np.broadcast_to(like.noise.covariance, (k, m, 3, 3)).copy(),
        single=np.zeros((k, m, 3)),
        single_covariances=np.broadcast_to(like.noise.covariance, (k, m, 3, 3)).copy(),
        weights=np.ones(k),
        poses=key,
        velocities=np.zeros((k, 3)),
        forces=np.zeros((k, 3)),
        blocks=np.arange(k) % 2,
        phases=np.full(k, "press"),
        presses=np.full(k, 1),
        n_frames=np.ones(k, int),
        n_effective=np.ones(k),
        start_ns=0,
        path=tuple(path),
    )
