"""A small experiment for the graph: a block of gel on a table, a probe that presses it, and recordings of that."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "stereo_node"))  # the renderer of the stereo tests

import scene

from livedeform.common import topics as t
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import RawMessage
from livedeform.common.bags.write import BagWriter
from livedeform.common.types import Image, MarkerFrame, Pose, Prediction
from livedeform.fem_node.mesh.generate import write_mesh
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.run.graph import Player
from livedeform.run.scene import written
from livedeform.stereo_node.camera.calibration_file import write_camera
from livedeform.stereo_node.camera.rig import StereoRig

SIZE = (0.04, 0.04, 0.03)
START_NS = 1_700_000_000_000_000_000
STEP_NS = 50_000_000  # 20 poses per second
OFFSET = np.array([3e-4, -4e-4, 1.2e-3])  # m, what is added to the measured markers: 1.3 mm


GRID = [(x, y, SIZE[2]) for x in np.linspace(-0.016, 0.016, 3) for y in np.linspace(-0.016, 0.016, 3)]
MARKERS = (*GRID, (0.02, 0.0, 0.015), (0.0, -0.02, 0.015))


def write_experiment(
    folder: Path,
    *,
    probe: bool = True,
    threshold: float = 0.005,
    markers: Sequence[tuple[float, float, float]] = MARKERS,
    **changes: object,
) -> Path:
    """``folder/experiment.yaml`` and its files; ``changes`` replace whole sections."""
    folder.mkdir(parents=True, exist_ok=True)
    write_mesh(folder / "block.vtu", block_mesh(SIZE, (2, 2, 2)))
    lines = ["id,x,y,z", *(f"{i},{x:.6g},{y:.6g},{z:.6g}" for i, (x, y, z) in enumerate(markers, start=1))]
    (folder / "markers.csv").write_text("\n".join(lines) + "\n")
    document: dict[str, object] = {
        "version": 1,
        "name": "small-block",
        "phantom": {
            "mesh": "block.vtu",
            "configuration": "unloaded",
            "density": 1000.0,
            "material": {"model": "neo_hookean", "youngs_modulus": 8000.0, "poisson_ratio": 0.49},
            "support": [{"region": {"below_z": 0.0005}, "type": "fixed"}],
            "markers": "markers.csv",
            "lesions": [{"name": "t1", "centre": [0.0, 0.0, 0.015], "diameter": 0.008}],
        },
        "thresholds": {"error": threshold},
    }
    if probe:
        document["probe"] = {"shape": {"box": [0.016, 0.012, 0.02]}, "edge_radius": 0.003}
    (folder / "experiment.yaml").write_text(yaml.safe_dump({**document, **changes}))
    return folder


def press(n: int = 12, depth: float = 0.003) -> list[Pose]:
    """A probe that comes from 1 mm above the block, presses it and goes back."""
    gap = 1e-3 - (depth + 1e-3) * np.sin(np.pi * np.arange(n) / (n - 1))
    down = np.array([1.0, 0.0, 0.0, 0.0])  # +z of the probe points down, into the tissue
    return [Pose(START_NS + i * STEP_NS, np.array([0.002, 0.001, SIZE[2] + g]), down) for i, g in enumerate(gap)]


def frame(stamp_ns: int, ids: np.ndarray, points: np.ndarray, sigma: float = 5e-5) -> MarkerFrame:
    n = len(ids)
    return MarkerFrame(
        stamp_ns, np.asarray(ids, np.uint32), points, np.tile(np.eye(3) * sigma**2, (n, 1, 1)), np.full(n, 0.1)
    )


def write_bag(path: Path, poses: Sequence[Pose], frames: Sequence[MarkerFrame]) -> Path:
    """Both streams in the order of their stamps; at the same stamp the markers come first."""
    with BagWriter(path, {"made_by": "tests"}) as bag:
        writer = RecordingWriter(bag)
        for item in sorted([*frames, *poses], key=lambda x: (x.stamp_ns, isinstance(x, Pose))):
            if isinstance(item, Pose):
                writer.pose(item)
            else:
                writer.marker_frame(item)
    return path


# --- with pictures ---------------------------------------------------------------------------------------------------

LOOK = scene.Look(radius=0.0012)


def write_picture_experiment(folder: Path) -> tuple[Path, StereoRig, np.ndarray]:
    """The block with irregular markers on its top, seen by two cameras; also the rig and the true T_phantom_left."""
    rng = np.random.default_rng(7)
    places: list[np.ndarray] = []
    while len(places) < 24:
        p = rng.uniform(-0.018, 0.018, 2)
        if all(np.linalg.norm(p - q) > 0.0055 for q in places):
            places.append(p)
    rig = scene.make_test_rig(width=640, height=480, focal=700.0, baseline=0.06, converge=0.15)
    folder.mkdir(parents=True, exist_ok=True)
    write_camera(rig.left, folder / "left.yaml")
    write_camera(rig.right, folder / "right.yaml")
    stereo = {"left": "left.yaml", "right": "right.yaml", "pose": "registered", "detector": {"type": "blob"}}
    write_experiment(folder, markers=[(x, y, SIZE[2]) for x, y in places], stereo=stereo)
    return folder, rig, scene.looking_down(distance=0.25, tilt=0.2)


def pictures(rig: StereoRig, T_phantom_left: np.ndarray, prediction: Prediction, seed: int = 0) -> tuple[Image, Image]:
    """What the two cameras see of predicted markers."""
    up = np.tile([0.0, 0.0, 1.0], (len(prediction.ids), 1))
    return scene.pair(rig, T_phantom_left, prediction.markers, up, LOOK, seed, prediction.stamp_ns)


def write_picture_bag(path: Path, poses: Sequence[Pose], pairs: Sequence[tuple[Image, Image]]) -> Path:
    """Poses, and left and right pictures after the pose of the same stamp."""
    with BagWriter(path, {"made_by": "tests"}) as bag:
        writer = RecordingWriter(bag)
        for pose, (left, right) in zip(poses, pairs, strict=True):
            writer.pose(pose)
            writer.image(left, t.LEFT_IMAGE)
            writer.image(right, t.RIGHT_IMAGE)
    return path


# --- raw messages ----------------------------------------------------------------------------------------------------


def stamp_of(data: bytes) -> int:
    """Header stamp (ns) of a little-endian message."""
    return int.from_bytes(data[4:8], "little") * 1_000_000_000 + int.from_bytes(data[8:12], "little")


@dataclass(frozen=True)
class Filmed:
    """An experiment with pictures: its folder, its bag, what the model says, and the pictures."""

    folder: Path
    bag: Path
    direct: list[Prediction]
    pairs: list[tuple[Image, Image]]


def play(player: Player, write: Callable[[RecordingWriter], None]) -> None:
    """Send the messages that ``write`` makes to whoever listens."""
    for topic, kind, data in written(write):
        player.play(RawMessage(topic, kind, 0, data))
