"""However late a player is, and however much a node publishes at once: every listener handles every message."""

from __future__ import annotations

import itertools
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import small
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.types import RawMessage
from livedeform.common.ros.node import CountingNode
from livedeform.common.ros.session import QUEUE_DEPTH, ros
from livedeform.common.types import Pose, Prediction
from livedeform.run import graph as g
from livedeform.run.recorder import RunRecorder
from livedeform.run.running import RunOptions, isolated, run

SHORT = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=2, reliability=ReliabilityPolicy.RELIABLE)


def sent(bag: Path) -> list[RawMessage]:
    """The messages of a bag."""
    with read_bag(bag) as opened:
        return list(opened.messages())


@pytest.mark.parametrize("rate", [1.0, 0.1])
def test_a_player_that_is_late_waits_for_who_listens(
    rate: float, bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """By its clock ten seconds pass whenever it looks: every message is overdue, and a queue holds two."""
    messages = sent(bag)
    with isolated(True), ros([], handle_signals=False) as stop:
        hearer, player = CountingNode("hearer"), g.Player([t.PROBE_POSE, t.STEREO_MARKERS])
        heard: list[tuple[str, bytes]] = []
        for topic in player.outlets:
            hear = lambda data, topic=topic: heard.append((topic, bytes(data)))  # noqa: E731
            hearer.subscribe(g.message_type(t.TOPICS[topic].type), topic, hear, SHORT, raw=True)
        with g.Graph([hearer, player], stop) as graph:
            graph.start()
            clock = itertools.count(0.0, 10.0)
            monkeypatch.setattr(g, "time", SimpleNamespace(monotonic=lambda: next(clock)))
            for k, (raw, late) in enumerate(g.play_in_real_time(graph, player, messages, rate)):
                assert len(heard) == k and raw == messages[k]  # what it gives rise to has the time of its cause
                assert k == 0 or late > 5.0
            graph.catch_up(player.outlets)
            lost = graph.lost()
    assert heard == [(raw.topic, raw.data) for raw in messages] and not lost


def fast_bag(path: Path, direct: list[Prediction]) -> Path:
    """The press in 0.2 s: poses at 1 kHz, and frames at 333 Hz."""
    begin, end = small.START_NS, small.START_NS + 200_000_000
    poses = [replace(p, stamp_ns=begin + k * 1_000_000) for k, p in enumerate(small.press(200))]
    frames = [
        small.frame(stamp, direct[0].ids, direct[k * len(direct) // 67].markers + small.OFFSET)
        for k, stamp in enumerate(range(begin, end, 3_000_000))
    ]
    return small.write_bag(path, poses, frames)


def test_a_replay_far_too_fast_records_every_input(experiment: Path, direct: list[Prediction], tmp_path: Path):
    """A model that is too slow leaves out poses that newer ones overtook, and counts them; nothing else is left out."""
    bag = fast_bag(tmp_path / "fast.mcap", direct)
    run(RunOptions(experiment, bag, tmp_path / "out", rate=1e6), lambda *_: None)
    inputs = (t.PROBE_POSE, t.STEREO_MARKERS)
    recorded = [raw for raw in sent(tmp_path / "out" / "run.mcap") if raw.topic in inputs]
    assert [(raw.topic, raw.log_time_ns, raw.data) for raw in recorded] == [
        (raw.topic, raw.log_time_ns, raw.data) for raw in sent(bag)
    ]
    document = json.loads((tmp_path / "out" / "metrics.json").read_text())
    counts, coverage = document["counts"], document["coverage"]
    assert counts["lost_messages"] == {} and coverage["lost"] == 0 and coverage["received"] == coverage["sent"]
    model, association = counts["model"], counts["association"]
    assert (
        model["predicted"] + model["skipped"] + model["unfinished"] == 200 and coverage["skipped"] == model["skipped"]
    )
    assert association["measured_frames"] == coverage["frames_measured"] == 67
    assert coverage["frames_compared"] == association["matched_frames"] == document["n_frames"]
    assert sum(coverage["refused"].values()) == 67 - coverage["frames_compared"]


@pytest.mark.parametrize("at_frames", [False, True])
def test_a_pose_may_tell_of_more_frames_than_a_queue_is_deep(
    at_frames: bool, experiment: Path, direct: list[Prediction], tmp_path: Path
):
    """Four poses per second, and 300 frames: each pose but the first answers 75 at once."""
    apart, n = 250_000_000, 75
    assert n > QUEUE_DEPTH
    above: Pose = small.press()[0]
    poses = [replace(above, stamp_ns=small.START_NS + k * apart) for k in range(3)]
    stamps = [small.START_NS + k * apart // n for k in range(2 * n + 1)]
    frames = [small.frame(stamp, direct[0].ids, direct[0].markers + small.OFFSET) for stamp in stamps]
    bag = small.write_bag(tmp_path / "sparse.mcap", poses, frames)
    metrics = run(RunOptions(experiment, bag, tmp_path / "out", at_frames=at_frames), lambda *_: None)
    counts = json.loads((tmp_path / "out" / "metrics.json").read_text())["counts"]
    assert counts["model"]["predicted"] == (len(frames) if at_frames else len(poses))
    assert counts["lost_messages"] == {} and metrics.n_frames == len(frames)
    assert metrics.rmse.value == pytest.approx(float(np.linalg.norm(small.OFFSET)), abs=1e-7)


def test_what_nodes_publish_at_once_is_recorded(tmp_path: Path):
    """Twice what a publisher keeps, on every topic of the table that a node publishes."""
    topics = [topic for topic in t.TOPICS.values() if topic.publisher not in ("", "recorder")]
    with (
        isolated(True),
        ros([], handle_signals=False) as stop,
        RunRecorder(tmp_path / "x.mcap", {}, lambda: 0) as recorder,
    ):
        speaker = CountingNode("speaker")
        speak = {topic: speaker.publisher(g.message_type(topic.type), topic.name) for topic in topics}
        with g.Graph([speaker, g.RecorderNode(recorder)], stop) as graph:
            graph.start()
            for topic, publish in speak.items():
                for _ in range(2 * QUEUE_DEPTH):
                    publish(g.message_type(topic.type)())
            graph.catch_up(speaker.outlets)
            assert not graph.lost()
    handled = Counter({topic.name: 2 * QUEUE_DEPTH for topic in topics if topic.name != t.STEREO_REGISTRATION})
    assert recorder.counts == handled + Counter({t.TF_STATIC: 2 * QUEUE_DEPTH})


def test_results_are_handled_before_their_queue_is_full(bag: Path, monkeypatch: pytest.MonkeyPatch):
    """Each input gives rise to four messages on one topic, of which a turn handles one; its queue is no deeper."""
    messages = [raw for raw in sent(bag) if raw.topic == t.PROBE_POSE] * 10
    with isolated(True), ros([], handle_signals=False) as stop:
        hearer, player = CountingNode("hearer"), g.Player([t.PROBE_POSE])
        speak = hearer.publisher(Float64, "/result")

        def answer(_: object) -> None:
            for _k in range(4):
                speak(Float64())

        hearer.subscribe(g.message_type(t.POSE_STAMPED), t.PROBE_POSE, answer, SHORT)
        hearer.subscribe(Float64, "/result", lambda _: None)
        with g.Graph([hearer, player], stop) as graph:
            graph.start()
            clock = itertools.count(0.0, 10.0)
            monkeypatch.setattr(g, "time", SimpleNamespace(monotonic=lambda: next(clock)))
            for _ in g.play_in_real_time(graph, player, messages, 1.0):
                pass
            graph.catch_up(hearer.inlets)
            assert hearer.traffic.handled["/result"] == 4 * len(messages) and not graph.lost()


def test_the_end_waits_as_long_as_it_gets_nearer(monkeypatch: pytest.MonkeyPatch):
    """By the clock a second passes with every message, of which twenty wait; the patience is for one and a half."""
    now = [0.0]

    def hear(_: Float64) -> None:
        now[0] += 1.0

    with isolated(True), ros([], handle_signals=False) as stop:
        node = CountingNode("slow")
        node.subscribe(Float64, "/x", hear)
        speak = node.publisher(Float64, "/x")
        with g.Graph([node], stop) as graph:
            graph.start()
            monkeypatch.setattr(g, "time", SimpleNamespace(monotonic=lambda: now[0]))
            for _ in range(20):
                speak(Float64())
            graph.finish(patience=1.5)
            assert node.traffic.handled["/x"] == 20
