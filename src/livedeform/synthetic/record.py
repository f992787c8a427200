"""Record a scenario: its frames and poses as a bag, and what really happened beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.synthetic import render, writing
from livedeform.synthetic.body_markers import SURFACE_CUTS, BodyMarkers
from livedeform.synthetic.measuring.measure import Tracker
from livedeform.synthetic.solved_motion import StateCourse
from livedeform.synthetic.trajectory import ProbePath
from livedeform.synthetic.true_effects import World
from livedeform.synthetic.truth import hexmesh

START_NS = 1_750_000_000 * 1_000_000_000


@dataclass(frozen=True)
class ScenarioRecording:
    name: str
    trajectory: ProbePath
    x: StateCourse
    force: StateCourse
    torque: StateCourse
    start_ns: int


def record(
    out: Path, recording: ScenarioRecording, spec: Mapping[str, Any], world: World, markers: BodyMarkers,
    tracker: Tracker, mesh: hexmesh.HexMesh, rest: Array, rng: np.random.Generator, seed: int,
) -> None:  # fmt: skip
    """Write one bag and its truth."""
    trajectory, start = recording.trajectory, recording.start_ns
    painter = None
    if spec["measuring"]["kind"] == "pictures":
        painter = ScenePainter(spec, mesh, rest, markers, tracker)
    happened = _Happened()
    path = out / "bags" / recording.name
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {"scenario": str(spec["name"]), "seed": str(seed), "made_by": "livedeform synth"}
    events = _events(trajectory.duration, spec, world.time_offset, rng)
    with writing.ScenarioWriter(path, metadata) as bag:
        if painter is None:  # who finds the markers knows where the cameras are, and says so
            bag.registration(start, tracker.T_phantom_left)
        for when, kind in events:
            stamp = start + round(float(when) * 1e9)
            if kind == "pose":
                _write_pose(bag, stamp, when - world.time_offset, recording, spec, world, rng)
                continue
            x, T = recording.x(float(when)), trajectory(float(when))
            clock = float(when) + (start - START_NS) * 1e-9
            if painter is not None:
                for side, pixels in painter.pictures(x, T, clock, int(rng.integers(2**31))):
                    bag.picture(side, stamp, pixels)
                happened.painted.append((x[painter.nodes].astype(np.float32), T))
            else:
                surface = None if world.measuring.index is None else markers.surface(x)
                bag.markers(tracker.frame(stamp, clock, markers.places(x), markers.normals(x), T, surface))
            happened.markers.append(markers.places(x))
            happened.stamps.append(stamp)
            happened.forces.append(recording.force(float(when)))
    _write_motion(out / "truth" / f"{recording.name}.npz", tracker, markers, rest, painter, happened)


@dataclass
class _Happened:
    """Collect what really happened, frame by frame: stamps ns, markers (m, 3) m, forces (3,) N, painted surfaces."""

    stamps: list[int] = field(default_factory=list)
    markers: list[Array] = field(default_factory=list)
    forces: list[Array] = field(default_factory=list)
    painted: list[tuple[NDArray[np.float32], Array]] = field(default_factory=list)


def _events(
    duration: float, spec: Mapping[str, Any], time_offset: float, rng: np.random.Generator
) -> list[tuple[float, str]]:
    """Return when (s) a "frame" or a "pose" is recorded, in order: frames jitter by a millisecond, poses by none."""
    frame_times = np.arange(0.0, duration, 1.0 / float(spec["measuring"]["rate"]))
    frame_times = np.clip(frame_times + rng.uniform(-1e-3, 1e-3, len(frame_times)), 0.0, None)
    pose_times = np.arange(0.0, duration, 1.0 / float(spec["pose_rate"]))
    return sorted([(t, "frame") for t in frame_times] + [(t + time_offset, "pose") for t in pose_times])


def _write_motion(
    path: Path,
    tracker: Tracker,
    markers: BodyMarkers,
    rest: Array,
    painter: ScenePainter | None,
    happened: _Happened,
) -> None:
    """Write what really happened, and what it takes to paint the pictures again without solving."""
    scene: dict[str, Any] = {}
    if painter is not None:  # enough to paint the pictures again without solving
        scene = {
            "surface_rest": rest[painter.nodes],
            "surface": np.stack([x for x, _ in happened.painted]),
            "T_probe": np.stack([T for _, T in happened.painted]),
        }
    np.savez_compressed(
        path,
        **scene,
        stamps_ns=np.array(happened.stamps),
        markers=np.stack(happened.markers),
        rest=markers.places(rest),
        force=np.stack(happened.forces),
        T_phantom_left=tracker.declared.T_phantom_left,
    )


def _write_pose(
    bag: writing.ScenarioWriter,
    stamp: int,
    time: float,
    recording: ScenarioRecording,
    spec: Mapping[str, Any],
    world: World,
    rng: np.random.Generator,
) -> None:
    """Write the robot's report: true pose = recorded pose displaced by the offset in the probe's frame."""
    T = recording.trajectory(time)
    reported = T.copy()
    reported[:3, 3] -= T[:3, :3] @ np.array(world.probe_offset)
    bag.pose(stamp, reported)
    if spec["wrench"]:
        noise = float(spec["wrench"]["noise"])
        force = recording.force(time) + noise * rng.normal(size=3)
        bag.wrench(stamp, force, recording.torque(time) + 0.03 * noise * rng.normal(size=3))


class ScenePainter:
    """Draws the body with its markers, the support's plate with its own, and the probe."""

    def __init__(
        self, spec: Mapping[str, Any], mesh: hexmesh.HexMesh, rest: Array, markers: BodyMarkers, tracker: Tracker
    ) -> None:
        self.weights, self.faces, triangles = hexmesh.surface_triangles(mesh, SURFACE_CUTS)
        self.mesh, self.tracker = mesh, tracker
        self.nodes = np.unique(mesh.faces)
        body = self._surface(rest)
        plate, plate_triangles = _plate(markers.support)
        self.plate = plate
        outside = ~(np.abs(body[triangles][:, :, 2]) < 1e-9).all(1)
        points = np.vstack([body, plate])
        painted = markers.places(rest)[[k != "internal" for k in markers.kinds]]
        self.scene = render.Scene(
            np.vstack([triangles[outside], plate_triangles + len(body)]), points, painted, render.Paint(**spec["paint"])
        )
        ((kind, size),) = spec["probe"]["shape"].items()
        self.probe = render.probe_surface(kind, tuple(np.atleast_1d(size).tolist()))

    def _surface(self, x: Array) -> Array:
        surface: Array = np.einsum("pa,pad->pd", self.weights, x[self.mesh.faces[self.faces]])
        return surface

    def pictures(self, x: Array, T: Array, clock: float, seed: int) -> list[tuple[str, NDArray[np.uint8]]]:
        """Return each side and its picture (h, w) ``clock`` s after the first recording's start, of the nodes' places
        ``x`` (n, 3) m and the probe at ``T`` (4, 4)."""
        points = np.vstack([self._surface(x), self.plate])
        probe = (self.probe[0] @ T[:3, :3].T + T[:3, 3], self.probe[1])
        views = self.tracker.rig_at(clock).views()
        return [
            (side, render.render(self.scene, points, probe, camera, T_view, seed + i))
            for i, (side, (camera, T_view)) in enumerate(zip(("left", "right"), views, strict=True))
        ]


def _plate(support: Array) -> tuple[Array, NDArray[np.int64]]:
    """A small square of plate under each support marker, finely cut so that the marker is painted on it."""
    points, triangles = [], []
    n, half = 14, 0.006
    s = np.linspace(-half, half, n)
    grid = np.stack(np.meshgrid(s, s, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.reshape(-1) for q in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    own = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    for k, centre in enumerate(support):
        points.append(grid + centre)
        triangles.append(own + k * n * n)
    if not points:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    return np.vstack(points), np.vstack(triangles)
