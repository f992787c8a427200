"""Internal markers that are seen through the body's surface: a run corrects a frame as a diagnosis predicts it, at the
frame's own moment."""

from __future__ import annotations

import itertools
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import small
import yaml
from rclpy.serialization import deserialize_message
from scene import looking_down, make_test_rig
from visualization_msgs.msg import Marker

from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.smooth_surface import corner_normals
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.frames import matrix_pose
from livedeform.common.ros import messages as m
from livedeform.common.types import MarkerFrame, Pose, Prediction
from livedeform.fem_node.mesh.generate import write_mesh
from livedeform.fem_node.mesh.structured import hemi_ellipsoid_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.run.running import RunOptions, run
from livedeform.stereo_node.camera.calibration_file import write_camera
from livedeform.stereo_node.correction import format_pose, make_view
from livedeform.stereo_node.effects import Surface, distort_all
from livedeform.stereo_node.surfaces import LONGEST_NS, PredictedSurfaces

AXES = np.array([0.04, 0.04, 0.03])
STEP_NS = 100_000_000


@dataclass(frozen=True)
class Dome:
    """An experiment with a transparent dome, the poses of a press, and what the model predicts at them."""

    folder: Path
    poses: list[Pose]
    direct: list[Prediction]


@pytest.fixture(scope="module")
def dome(tmp_path_factory: pytest.TempPathFactory) -> Dome:
    folder = tmp_path_factory.mktemp("dome")
    rig = make_test_rig()
    write_camera(rig.left, folder / "left.yaml")
    write_camera(rig.right, folder / "right.yaml")
    pose = [float(v) for v in format_pose(matrix_pose(looking_down(), 0)).split()]
    stereo = {"left": "left.yaml", "right": "right.yaml", "pose": {"position": pose[:3], "orientation_xyzw": pose[3:]},
              "detector": {"type": "blob"}}  # fmt: skip
    small.write_experiment(folder, stereo=stereo, effects=[{"name": "refraction", "index": 1.41}])
    write_mesh(folder / "block.vtu", hemi_ellipsoid_mesh(AXES, 4))
    u = np.random.default_rng(2).normal(size=(14, 3)) * [1.0, 1.0, 0.5] + [0.0, 0.0, 1.2]
    u /= np.linalg.norm(u, axis=1)[:, None]
    places = u * AXES * np.where(np.arange(14) < 8, 0.75, 0.999)[:, None]
    rows = [f"{k},{x},{y},{z},{'internal' if k < 8 else 'surface'}" for k, (x, y, z) in enumerate(places)]
    (folder / "markers.csv").write_text("\n".join(["id,x,y,z,kind", *rows]) + "\n")
    gap = 1e-3 - 5e-3 * np.sin(np.pi * np.arange(6) / 5)
    down = np.array([1.0, 0.0, 0.0, 0.0])
    poses = [Pose(small.START_NS + i * STEP_NS, np.array([0.004, 0.0, AXES[2] + g]), down) for i, g in enumerate(gap)]
    model = PhantomModel.from_experiment(load_experiment(folder))
    return Dome(folder, poses, [model.predict(pose) for pose in poses])


def between(first: Prediction, second: Prediction, share: float) -> Prediction:
    """A moment between two predictions, on the straight line."""
    stamp = first.stamp_ns + round(share * (second.stamp_ns - first.stamp_ns))
    markers, surface = ((1 - share) * getattr(first, n) + share * getattr(second, n) for n in ("markers", "surface"))
    return replace(first, stamp_ns=stamp, markers=markers, surface=surface)


def seen(dome: Dome, moments: list[Prediction]) -> list[MarkerFrame]:
    """What the cameras report through the predicted surfaces, as a diagnosis has it."""
    experiment = load_experiment(dome.folder)
    frames = []
    for p in moments:
        surface: Surface = (p.surface, p.triangles)
        view = make_view(experiment, small.START_NS, surface=lambda _, surface=surface: surface)
        frames.append(small.frame(p.stamp_ns, p.ids, distort_all(p.markers, p.stamp_ns, experiment.effects, view)))
    return frames


def off(dome: Dome, frames: list[MarkerFrame], out: Path, *, at_frames: bool = False) -> np.ndarray:
    """How far (m) the run's internal markers are from the model's, which made what it was given."""
    bag = small.write_bag(out.parent / "seen.mcap", dome.poses, frames)
    run(RunOptions(dome.folder, bag, out, at_frames=at_frames), lambda *_: None)
    assert json.loads((out / "metrics.json").read_text())["verdict"] == "OK"
    errors = load_recording(out / "run.mcap").errors
    assert len(errors) == len(frames)
    return np.concatenate([np.linalg.norm(e.errors[e.ids < 8], axis=1) for e in errors])


def test_a_run_takes_out_the_refraction_that_a_diagnosis_puts_in(dome: Dome, tmp_path: Path):
    """Triangles without common corners refracted as facets, through the surface of the pose before; and a diagnosis had
    one for each facet of a quadratic element, a run four."""
    frames = seen(dome, dome.direct)
    lifted = [np.linalg.norm(f.points - p.markers, axis=1)[:8] for f, p in zip(frames, dome.direct, strict=True)]
    assert np.mean(lifted) > 1e-3
    assert off(dome, frames, tmp_path / "out").max() < 1e-7  # measured 2e-9; it was 1e-3


@pytest.mark.parametrize("share", [pytest.param(0.1, marks=pytest.mark.slow), 0.5])
def test_a_frame_is_seen_through_the_surface_of_its_own_moment(share: float, dome: Dome, tmp_path: Path):
    """Frames between poses: that of the pose before was taken, and put markers off."""
    moments = [between(a, b, share) for a, b in itertools.pairwise(dome.direct)]
    assert off(dome, seen(dome, moments), tmp_path / "out").max() < 1e-7  # measured 2e-9


def test_predictions_at_frames_give_each_frame_the_surface_of_its_own_moment(dome: Dome, tmp_path: Path):
    """They followed the corrected frames, which were seen through the surface of the frame before."""
    assert off(dome, seen(dome, dome.direct), tmp_path / "out", at_frames=True).max() < 1e-7


def test_of_a_body_without_a_probe_too(dome: Dome, tmp_path: Path):
    """It swells by 2 % of its volume from one frame to the next."""
    folder = tmp_path / "swells"
    shutil.copytree(dome.folder, folder)
    document = yaml.safe_load((folder / "experiment.yaml").read_text())
    document["effects"].append({"name": "swelling", "rate": 0.2, "offset": 0.0})
    del document["probe"]
    (folder / "experiment.yaml").write_text(yaml.safe_dump(document))
    model = PhantomModel.from_experiment(load_experiment(folder))
    model.reset(small.START_NS)
    direct = [model.predict(None, pose.stamp_ns) for pose in dome.poses[:4]]
    swells = Dome(folder, [], direct)
    assert off(swells, seen(swells, direct), tmp_path / "out").max() < 1e-7


def test_a_mesh_that_is_heard_is_as_smooth_as_the_one_that_is_published(dome: Dome):
    """The message repeats each corner for each of its triangles."""
    sent = dome.direct[2]
    heard = m.from_mesh_marker(deserialize_message(m.to_mesh_data(sent), Marker))
    assert heard is not None and len(heard[0]) == len(sent.surface)
    np.testing.assert_allclose(corner_normals(*heard), corner_normals(sent.surface, sent.triangles), atol=1e-12)


MESH = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])


def at(z: float) -> np.ndarray:
    return MESH[0][[2, 0, 1]] + [0.0, 0.0, z]  # in another order than the mesh has them


def surfaces(*said: tuple[int, float]) -> PredictedSurfaces:
    out = PredictedSurfaces()
    for k, (stamp_ns, z) in enumerate(said):
        out.add(stamp_ns, at(z))
        if not k:
            out.add_mesh(stamp_ns, (MESH[0] + [0.0, 0.0, z], MESH[1]))
    return out


def height(kept: PredictedSurfaces, stamp_ns: int) -> float | None:
    found = kept.at(stamp_ns)
    if found is None:
        return None
    points, triangles = found
    np.testing.assert_allclose(points[triangles][0, :, :2], MESH[0][:, :2])
    return float(points[0, 2])


def test_a_surface_is_that_of_a_moment():
    near, far = 10**9, 10**9 + LONGEST_NS + 1
    kept = surfaces((near, 0.0), (near + 10**8, 1.0))
    assert [height(kept, near + k * 10**7) for k in (0, 3, 10)] == pytest.approx([0.0, 0.3, 1.0])
    assert height(kept, near + 2 * 10**8) == 1.0  # the last one, as far as that is near
    assert height(kept, near + 10**8 + LONGEST_NS + 1) is None and height(kept, near - LONGEST_NS - 1) is None
    assert height(surfaces((near, 0.0), (far, 1.0)), near + 10**8) is None  # not over a long gap
    kept.add(near + 2 * 10**8, np.full((3, 3), np.nan))
    assert height(kept, near + 15 * 10**7) is None and height(kept, near + 2 * 10**8) is None
    assert height(kept, near + 10**8) == 1.0


def test_a_surface_is_waited_for_as_long_as_it_may_come():
    kept = PredictedSurfaces()
    assert kept.awaited(0) and kept.at(0) is None
    kept.add_mesh(0, MESH)
    assert kept.awaited(10**9) and height(kept, 10**9) == 0.0  # the body at rest, before anything is predicted
    kept = surfaces((10**9, 0.0))
    assert not kept.awaited(10**9) and kept.awaited(10**9 + 1) and not kept.awaited(10**9 + LONGEST_NS + 1)
    kept.add(10**8, at(5.0))  # a clock that was set back
    assert height(kept, 10**8) == 5.0 and kept.awaited(2 * 10**8)


def test_markers_that_no_surface_tells_are_left_out_and_it_is_said(dome: Dome, tmp_path: Path):
    """Poses end in the middle: what is inside the body cannot be told from there on, what is on it can."""
    frames = seen(dome, dome.direct)
    late = [replace(f, stamp_ns=f.stamp_ns + (k > 3) * 2_000_000_000) for k, f in enumerate(frames)]
    bag = small.write_bag(tmp_path / "seen.mcap", dome.poses[:4], late)
    run(RunOptions(dome.folder, bag, tmp_path / "out"), lambda *_: None)
    counts = [int((f.ids < 8).sum()) for f in load_recording(tmp_path / "out" / "run.mcap").marker_frames]
    assert counts == 4 * [8] + 2 * [0]
    doubts = json.loads((tmp_path / "out" / "metrics.json").read_text())["doubts"]
    assert any("2 of 6 frames: 8 internal markers are left out: no /fem/surface is near" in d for d in doubts)
