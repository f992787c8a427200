"""What a live session says at once: several publishers, and inputs that cannot be right."""

from __future__ import annotations

import struct
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


def test_an_id_that_is_there_twice_is_said_as_results_say_it(experiment: Path, direct: list[Prediction]):
    """From whichever frame on: markers that results leave out were looked at as if they were two places of one."""
    watch, ids = LiveWatch(load_experiment(experiment)), direct[0].ids.copy()
    ids[3] = ids[2]
    for k, pose in enumerate(small.press(70)):
        named = ids if k >= 60 else direct[0].ids
        for topic, kind, data in [
            *written(lambda w, p=pose, i=named: w.marker_frame(small.frame(p.stamp_ns, i, direct[0].markers))),
            *written(lambda w, p=pose: w.pose(p)),
        ]:
            watch.take(topic, kind, data)
    (said,) = watch.news()
    assert said.text.startswith("markers whose id is there twice in a frame are left out: nobody knows which is which")
    assert said.doubts and said.remedy


S = 1_000_000_000


@pytest.mark.parametrize(
    ("seconds", "ahead", "late", "said"),
    [
        (40.0, lambda t: 0.0, lambda t: 0.004, False),
        (40.0, lambda t: 0.25 * (t > 15.0), lambda t: 0.004, True),
        (40.0, lambda t: 0.0, lambda t: 0.004 + max(15.9 - t, 0.0) * (t > 15.0), False),
        (10.0, lambda t: 0.0, lambda t: 0.004 + max(1.0 - t, 0.0), False),
    ],
    ids=["sound", "the tracker's clock was set", "a queue was full", "a slow start"],
)
def test_a_clock_that_was_set_is_said_as_results_say_it(
    seconds: float,
    ahead: Callable[[float], float],
    late: Callable[[float], float],
    said: bool,
    experiment: Path,
    direct: list[Prediction],
):
    """By when messages come, of a tracker of 20 Hz beside poses of 50 Hz."""
    now = {"ns": 0}
    watch = LiveWatch(load_experiment(experiment), lambda: now["ns"])
    (frame,) = written(lambda w: w.marker_frame(small.frame(0, direct[0].ids, direct[0].markers)))
    (pose,) = written(lambda w: w.pose(small.press(2)[0]))
    sent = [(k / 20.0, ahead(k / 20.0), late(k / 20.0), frame) for k in range(round(20 * seconds))]
    sent += [(k / 50.0, 0.0, 0.002, pose) for k in range(round(50 * seconds))]
    for at, before, after, (topic, kind, data) in sorted(sent, key=lambda each: each[0] + each[2]):
        now["ns"] = small.START_NS + round(S * (at + after))
        stamp = small.START_NS + round(S * (at + before))
        watch.take(topic, kind, data[:4] + struct.pack("<iI", stamp // S, stamp % S) + data[12:])
    texts = [finding.text for finding in watch.news() if "receive time minus stamp" in finding.text]
    assert len(texts) == said
    if said:
        assert texts[0].startswith(
            "receive time minus stamp of /stereo/markers changes by 0.250 s beside that of /probe"
        )


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
