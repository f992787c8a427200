"""What a live session says at once: several publishers, and inputs that cannot be right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import small
from std_msgs.msg import Float64

from livedeform.common.bags.read import read_bag
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.ros.node import CountingNode
from livedeform.common.ros.session import RELIABLE, ros
from livedeform.common.types import Pose, Prediction
from livedeform.run.graph import Graph
from livedeform.run.running import isolated
from livedeform.run.scene import written
from livedeform.run.watch import LiveWatch


def test_several_publishers_on_a_topic_are_counted():
    with isolated(), ros([], handle_signals=False) as stop:
        hearer = CountingNode("hearer")
        hearer.subscribe(Float64, "/x", lambda message: None)
        speakers = [CountingNode(name) for name in ("one", "two")]
        for speaker in speakers:
            speaker.create_publisher(Float64, "/x", RELIABLE)
        with Graph([hearer, *speakers], stop) as graph:
            graph.start()
            while graph.publishers("/x") < 2:
                graph.spin_once(0.01)
            assert graph.crowded() == {"/x": 2}


def watched(experiment: Path, folder: Path, direct: list[Prediction], change: Callable[[Pose], Pose]) -> list[str]:
    """What the watch says of the small press with changed poses."""
    frames = [small.frame(p.stamp_ns, p.ids, p.markers) for p in direct]
    watch = LiveWatch(load_experiment(experiment))
    with read_bag(small.write_bag(folder / "x.mcap", [change(p) for p in small.press()], frames)) as bag:
        for raw in bag.messages():
            watch.take(raw.topic, raw.type, raw.data)
    return [finding.text for finding in watch.news()]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: p, ""),
        (lambda p: replace(p, position=1e3 * p.position), "millimetres"),
        (lambda p: replace(p, orientation_xyzw=p.orientation_xyzw[[1, 2, 3, 0]]), "upside down"),
        (lambda p: replace(p, stamp_ns=p.stamp_ns + 3_600_000_000_000), "the clocks differ"),
        (lambda p: replace(p, orientation_xyzw=2.0 * p.orientation_xyzw), "norm is not 1"),
    ],
    ids=["sound", "millimetres", "upside down", "another clock", "no unit quaternion"],
)
def test_inputs_that_cannot_be_right_are_said_while_they_come(
    change: Callable[[Pose], Pose], said: str, experiment: Path, direct: list[Prediction], tmp_path: Path
):
    found = watched(experiment, tmp_path, direct, change)
    assert any(said in text for text in found) if said else not found


def test_another_frame_and_a_clock_that_is_set_back_are_said_while_they_come(
    experiment: Path, direct: list[Prediction]
):
    watch, poses = LiveWatch(load_experiment(experiment)), small.press(40)
    for k, pose in enumerate(poses):
        frame = replace(small.frame(pose.stamp_ns, direct[0].ids, direct[0].markers))
        back = 1_000_000_000 * (k >= 25) - 7
        for topic, kind, data in [
            *written(lambda w, frame=frame: w.marker_frame(frame, "tracker")),
            *written(lambda w, pose=pose, back=back: w.pose(replace(pose, stamp_ns=pose.stamp_ns - back))),
        ]:
            watch.take(topic, kind, data)
    said = " ".join(finding.text for finding in watch.news())
    assert "/stereo/markers is in the frame 'tracker'" in said and "clocks were set back" in said
