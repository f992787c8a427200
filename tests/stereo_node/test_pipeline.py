"""The tracker on rendered pictures: truth comes from the renderer in scene.py."""

import numpy as np
import pytest
from scene import dome_markers, looking_down, make_test_rig, pair

from livedeform_common.types import Image
from stereo_node.pipeline import StereoTracker


@pytest.fixture(scope="module")
def setup():
    rig, (markers, normals), T = make_test_rig(dist=(-0.2, 0.1, 0.001, -0.0005, 0.0)), dome_markers(), looking_down()
    return rig, markers, normals, T, pair(rig, T, markers.points, normals)


def test_registers_and_measures_without_a_pose(setup):
    rig, markers, _, _, (left, right) = setup
    frame, status = StereoTracker(rig, markers).process(left, right)
    assert status.level == "ok"
    assert status.n_identified >= 50  # measured 54: the others face away
    error = np.linalg.norm(frame.points - markers.points[frame.ids - 100], axis=1)
    assert error.max() < 2e-4  # measured 0.00006 m: no identity is wrong


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: np.zeros_like(p), "black"),
        (lambda p: p[:480, :640], "640x480"),
        (lambda p: p.astype(np.uint16) * 256, "uint16"),
    ],
)
def test_bad_pictures_are_refused_with_a_reason(setup, change, message):
    rig, markers, _, _, (left, right) = setup
    bad = Image(1, np.ascontiguousarray(change(right.pixels)), "mono16" if "16" in message else "mono8")
    frame, status = StereoTracker(rig, markers).process(left, bad)
    assert status.level == "error"
    assert message in status.message
    assert len(frame.ids) == 0


def test_a_frozen_camera_gives_no_points(setup):
    rig, markers, normals, T, (left, right) = setup
    tracker = StereoTracker(rig, markers)
    assert tracker.process(left, right)[1].level == "ok"
    newer, _ = pair(rig, T, markers.points, normals, seed=1, stamp_ns=33_000_000)
    frame, status = tracker.process(newer, Image(33_000_000, right.pixels))
    assert status.level == "error"
    assert "right picture is the same" in status.message
    assert len(frame.ids) == 0
