"""A body with a plastic set that went through earlier recordings: the set is there, and unfit ones are refused."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from bodies import plane, soft
from scipy.spatial.transform import Rotation

from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import InputError
from livedeform.common.types import Pose
from livedeform.fem_node.contact.probe_shapes import Box
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.load_history import (
    SPACING,
    TOLERANCE,
    bags_of,
    earlier_poses,
    joined,
    key_poses,
    pass_beginning,
    pass_earlier,
)
from livedeform.fem_node.path.pose_track import PoseTrack
from livedeform.fem_node.path.timeline import LEVER
from livedeform.fem_node.physics.record import PlasticSet, Probe, Support

SIZE, HEIGHT, DEPTH = 0.04, 0.03, 0.006
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
SECOND = 1_000_000_000
LAW = PlasticSet(0.3, 0.02)
MARKERS = np.array([[0.0, 0.0, HEIGHT], [0.012, 0.0, HEIGHT], [SIZE / 2, 0.0, 0.02]])


def press(start: int, n: int = 60, depth: float = DEPTH) -> list[Pose]:
    """Down in a second, a second of rest, up in a second; ``n`` poses, from the second ``start`` on."""
    t = np.linspace(0.0, 3.0, n)
    z = HEIGHT + 0.002 - (depth + 0.002) * np.minimum(np.minimum(t, 1.0), 3.0 - t)
    return [Pose(int((start + s) * SECOND), np.array([0.0, 0.0, h]), DOWN) for s, h in zip(t, z, strict=True)]


def bag(path: Path, poses: list[Pose]) -> Path:
    with BagWriter(path, {"made_by": "tests"}) as opened:
        writer = RecordingWriter(opened)
        for pose in poses:
            writer.pose(pose)
    return path


@pytest.fixture(scope="module")
def space():
    return make_space(block_mesh((SIZE, SIZE, HEIGHT), (2, 2, 2), origin=(-SIZE / 2, -SIZE / 2, 0.0)))


def model(space, law: PlasticSet | None = LAW) -> PhantomModel:
    probe = Probe(Box(0.02, 0.02, 0.02, 0.003))
    physics = soft(0.45, 4000.0, supports=(Support(plane(2, 0.0)),), plastic_set=law, probe=probe)
    return PhantomModel(space, physics, markers=MARKERS)


def test_the_rest_shape_has_the_set_of_earlier_recordings(space, tmp_path):
    first, second = press(0, depth=0.004), press(10)
    bags = [bag(tmp_path / "a.mcap", first), bag(tmp_path / "b.mcap", second)]
    later, said = press(20)[0], []
    passed = pass_earlier(model(space), bags, later.stamp_ns, said.append)
    found, at_rest = passed.predict(later), passed.rest()
    virgin, whole = model(space), model(space)
    for pose in [*first[::4], first[-1], *second[::2], second[20], second[39], second[-1]]:
        assert whole.predict(pose).converged
    expected, new = whole.predict(later), virgin.predict(later)
    lasting = np.linalg.norm(expected.markers - new.markers, axis=1).max()
    assert lasting > 3e-4  # m
    assert np.abs(found.markers - expected.markers).max() < 0.02 * lasting
    np.testing.assert_allclose(at_rest.markers, found.markers, atol=1e-7)  # cameras are registered to that
    assert any("a.mcap" in line for line in said) and not any("warning" in line for line in said)


def test_what_does_not_remember_skips_them_and_says_so(space, tmp_path):
    bags, said = [bag(tmp_path / "a.mcap", press(0))], []
    passed = pass_earlier(model(space, None), bags, 20 * SECOND, said.append)
    assert passed.predict(press(20)[0]).n_iterations == model(space, None).predict(press(20)[0]).n_iterations
    assert len(said) == 1 and "skipped" in said[0]


def test_key_poses_follow_the_path_in_place_and_time():
    t = np.linspace(0.0, 6.0, 900)
    x = 0.03 * np.sin(1.3 * t) * (t < 4.0) + 0.03 * np.sin(5.2) * (t >= 4.0)  # then it stands
    turn = Rotation.from_rotvec(np.outer(0.4 * np.sin(t), [0.0, 1.0, 0.0])).as_quat()
    poses = [Pose(int(s * SECOND), np.array([a, 0.0, 0.01]), q) for s, a, q in zip(t, x, turn, strict=True)]
    keys = key_poses(poses)
    assert keys[0] is poses[0] and keys[-1] is poses[-1] and len(keys) < 150
    track = PoseTrack(keys)
    off = [np.linalg.norm(track.at(p.stamp_ns)[:3, 3] - p.position) for p in poses]
    assert max(off) < TOLERANCE + 1e-9
    turned = [track.at(p.stamp_ns)[0, 2] - 2 * p.orientation_xyzw[1] * p.orientation_xyzw[3] for p in poses]
    assert LEVER * np.abs(turned).max() < TOLERANCE + 1e-6  # between poses a turn is not quite linear
    steps = [np.linalg.norm(b.position - a.position) for a, b in pairwise(keys)]
    assert max(steps) < SPACING + np.abs(np.diff(x)).max() + 1e-9
    assert key_poses(poses[:1]) == poses[:1]
    still = [replace(poses[0], stamp_ns=k) for k in range(5)]
    assert key_poses(still) == [still[0], still[-1]]


def test_key_poses_are_as_near_in_place_and_time_as_is_asked_for():
    poses = press(0, n=301)
    for spacing, seconds in ((5e-4, np.inf), (np.inf, 0.1), (2e-3, 0.05)):
        keys = key_poses(poses, spacing, seconds * SECOND)
        assert max(np.linalg.norm(b.position - a.position) for a, b in pairwise(keys)) < spacing + 1e-9
        assert max(b.stamp_ns - a.stamp_ns for a, b in pairwise(keys)) < seconds * SECOND + 1
        assert len(keys) < 120


def test_what_comes_before_a_part_leaves_the_set_that_all_poses_leave(space):
    """Of poses of 20 Hz, of which not all are solved."""
    poses, said = press(0, n=60), []
    whole, led = model(space), model(space)
    n_passed = 58  # the probe is in the air again
    assert pass_beginning(led, poses[:n_passed], said.append) == 0
    for pose in poses[:n_passed]:
        whole.predict(pose)
    there, without = whole.predict(poses[-1]), model(space).predict(poses[-1])
    lost, off = (np.abs(p.markers - there.markers).max() for p in (without, led.predict(poses[-1])))
    assert lost > 1e-3 and off < 2e-6  # measured 1.8e-3 and 3e-11; of poses of 40 Hz, a third of them solved, 2e-7
    assert said[0].endswith("0 of 40 key poses")


def test_recordings_that_cannot_have_been_before_are_refused(tmp_path):
    a, b = bag(tmp_path / "a.mcap", press(0)), bag(tmp_path / "b.mcap", press(10))
    empty = bag(tmp_path / "empty.mcap", [])
    assert [len(poses) for poses in earlier_poses([a, b], 20 * SECOND, 0.0)] == [60, 60]
    assert bags_of(joined([a, b])) == [a, b] and bags_of("") == []
    for bags, start, text in (
        ([a, b], 12, "b.mcap: is not earlier than the recording that is run"),
        ([b, a], 20, "a.mcap: does not begin after the recording that is named before it"),
        ([a, a], 20, "does not begin after"),
        ([empty], 20, "has no probe poses"),
    ):
        with pytest.raises(InputError, match=text):
            earlier_poses(bags, start * SECOND, 0.0)


def test_a_body_that_is_let_go_has_gone_through_nothing_before():
    """It was let go once, in the first of the earlier recordings: at the start of the run it hung already."""
    with pytest.raises(InputError, match=r"--after a\.mcap: a body that is let go is held again"):
        earlier_poses([Path("a.mcap")], 0, 1.0)
