"""What viewers get of a run: the probe, arrows, transforms, predictions on the pictures; layouts whose panels have
data; series for ParaView."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
import yaml
from small import Filmed

from livedeform.cli import run as command_line
from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.types import decode
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.frames import apply, inverse, pose_matrix
from livedeform.report.layouts import foxglove_layout, rviz_layout, topics_of_panel
from livedeform.run.running import RunOptions, run
from livedeform.run.scene import LONGER, LiveScene
from livedeform.stereo_node.camera.setup import rig_of


@pytest.fixture(scope="module")
def out(filmed: Filmed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene") / "out"
    run(RunOptions(filmed.folder, filmed.bag, folder), lambda *_: None)
    return folder


def messages(out: Path, topic: str) -> list:
    with read_bag(out / "run.mcap") as bag:
        return [decode(raw) for raw in bag.messages([topic])]


def test_every_pose_is_a_transform(out: Path, filmed: Filmed):
    poses = load_recording(out / "run.mcap").poses
    transforms = [message.transforms[0] for message in messages(out, t.TF)]
    assert len(transforms) == len(poses) == 6
    for entry, pose in zip(transforms, poses, strict=True):
        assert (entry.header.frame_id, entry.child_frame_id) == (t.FRAME_PHANTOM, t.FRAME_PROBE)
        p = entry.transform.translation
        np.testing.assert_allclose((p.x, p.y, p.z), pose.position)


def test_the_probe_is_where_its_pose_is(out: Path, filmed: Filmed):
    """The marker's middle is half the probe's height behind the contact face."""
    probe = load_experiment(filmed.folder).probe
    assert probe is not None
    pose = load_recording(out / "run.mcap").poses[0]
    marker = messages(out, t.SCENE_PROBE)[0]
    assert marker.header.frame_id == t.FRAME_PHANTOM
    depth = {"box": lambda s: s[2], "cylinder": lambda s: s[1], "sphere": lambda s: 2 * s}[probe.shape.kind]
    behind = depth(getattr(probe.shape, probe.shape.kind)) / 2
    middle = apply(pose_matrix(pose), np.array([[0.0, 0.0, -behind]]))[0]
    p = marker.pose.position
    np.testing.assert_allclose((p.x, p.y, p.z), middle, atol=1e-12)


def test_arrows_run_from_predicted_to_measured(out: Path):
    frames = load_recording(out / "run.mcap").errors
    drawn = messages(out, t.SCENE_ERRORS)
    assert drawn and len(drawn) <= len(frames)
    stamp = drawn[0].markers[0].header.stamp
    frame = next(f for f in frames if f.stamp_ns == stamp.sec * 10**9 + stamp.nanosec)
    arrows = drawn[0].markers[1:]
    assert [a.id for a in arrows] == frame.ids.tolist()
    ends = np.array([[(p.x, p.y, p.z) for p in a.points] for a in arrows])
    np.testing.assert_allclose(ends[:, 1] - ends[:, 0], LONGER * frame.errors, atol=1e-7)
    np.testing.assert_allclose(ends[:, 0], frame.measured - frame.errors, atol=1e-7)


def test_predictions_lie_on_the_markers_in_the_pictures(out: Path, filmed: Filmed):
    """The pictures show the model's own markers; where the left camera stands is found by registration."""
    recording = load_recording(out / "run.mcap")
    rig = rig_of(load_experiment(filmed.folder))
    assert rig is not None and recording.camera_pose is not None
    frame, spots = recording.errors[0], messages(out, t.SCENE_LEFT)[0]
    assert spots.header.frame_id == t.FRAME_LEFT
    seen = rig.project(apply(inverse(pose_matrix(recording.camera_pose)), frame.measured))[0]
    drawn = np.array([(p.x, p.y) for p in spots.points])
    assert np.linalg.norm(drawn - seen, axis=1).max() < 0.5  # px; the markers are 7 px across


def test_the_declared_calibration_and_the_status_are_there(out: Path):
    assert len(messages(out, t.LEFT_CAMERA_INFO)) == 1  # the recording has none
    with read_bag(out / "run.mcap") as bag:
        status = sum(bag.topics[name].count for name in (t.STEREO_STATUS, t.FEM_STATUS, t.COMPARE_METRICS))
        assert bag.topics[t.DIAGNOSTICS_ALL].count == status


def test_every_panel_has_data(out: Path, tmp_path: Path):
    with read_bag(out / "run.mcap") as bag:
        there = {name for name, info in bag.topics.items() if info.count}
    panels = foxglove_layout(there)["configById"]
    named = {panel: topics_of_panel(content) for panel, content in panels.items()}
    assert len(panels) == 6 and all(named.values())
    assert set().union(*named.values()) <= there
    displays = rviz_layout(there)["Visualization Manager"]["Displays"]
    assert len(displays) == 9  # all that are shipped: a grid, frames, and seven with a topic
    assert {d["Topic"]["Value"] for d in displays if "Topic" in d} <= there
    without = foxglove_layout(there - {t.LEFT_IMAGE, t.RIGHT_IMAGE, t.FEM_WRENCH})
    assert set(without["configById"]) == {"3D!main", "Plot!error", "DiagnosticSummary!nodes"}
    assert "Image" not in json.dumps(without["layout"])


def test_what_is_damaged_draws_nothing(filmed: Filmed):
    scene = LiveScene(load_experiment(filmed.folder))
    assert scene.derive(t.PROBE_POSE, t.POSE_STAMPED, b"\x00\x01\x00\x00\x07") == []
    assert scene.derive(t.COMPARE_MARKERS, t.POINT_CLOUD, b"") == []
    assert scene.derive("/something/else", t.FLOAT64, b"") == []


def test_export_for_paraview(out: Path, tmp_path: Path):
    assert command_line(["export", str(out), "--out", str(tmp_path / "pv")]) == 0
    frames = load_recording(out / "run.mcap").errors
    for name in ("surface", "markers", "probe"):
        steps = ElementTree.parse(tmp_path / "pv" / f"{name}.pvd").findall(".//DataSet")
        assert len(steps) == len(frames) == 6
        assert float(steps[1].attrib["timestep"]) > float(steps[0].attrib["timestep"])
        mesh = meshio.read(tmp_path / "pv" / steps[-1].attrib["file"])
        assert np.isfinite(mesh.points).all()
        if name == "markers":
            np.testing.assert_allclose(mesh.points, frames[-1].measured, atol=1e-9)
            np.testing.assert_allclose(mesh.point_data["error"], frames[-1].errors, atol=1e-9)
        if name == "surface":
            files = [tmp_path / "pv" / step.attrib["file"] for step in steps]
            moved = [np.linalg.norm(meshio.read(f).point_data["displacement"], axis=1).max() for f in files]
            assert max(moved) > 1e-3 and moved[-1] < 1e-6  # m: it is pressed, and released
            assert len(mesh.cells_dict["triangle"]) > 100
    assert yaml.safe_load((tmp_path / "pv" / "scene.rviz").read_text())["Visualization Manager"]
    assert json.loads((tmp_path / "pv" / "foxglove.json").read_text())["configById"]


def test_a_run_for_rerun(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "rerun", None)
        assert command_line(["view", str(out), "--rerun", "--out", str(tmp_path / "a.rrd")]) == 2
        assert "pip install 'livedeform[rerun]'" in capsys.readouterr().err
    pytest.importorskip("rerun")
    assert command_line(["view", str(out), "--rerun", "--out", str(tmp_path / "b.rrd")]) == 0
    assert (tmp_path / "b.rrd").read_bytes()[:4] == b"RRF2"
