"""Each node in a process of its own, over DDS: the same numbers as in one process."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import small
from processes import Conversation, conversation, node, raw_messages, shifted
from small import Filmed

from livedeform.common import topics as t
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.types import RawMessage
from livedeform.common.types import Image
from livedeform.run.running import RunOptions, run

BEFORE_NS = -10_000_000_000


def meet(talk: Conversation, messages: list[RawMessage], folder: Path) -> None:
    """Plays a pose and pictures that cannot be measured until all nodes have met.

    What is published before that is lost. The tracker refuses pictures of another size and keeps nothing of them.
    """
    pose = next(m for m in messages if m.topic == t.PROBE_POSE)
    tiny = Image(small.START_NS, np.zeros((4, 4), np.uint8))
    bag = raw_messages(small.write_picture_bag(folder / "tiny.mcap", small.press(2)[:1], [(tiny, tiny)]))
    pictures = [m for m in bag if m.topic in (t.LEFT_IMAGE, t.RIGHT_IMAGE)]
    attempt = 0

    def met() -> bool:
        nonlocal attempt
        counts = talk.metrics()
        if int(counts.get("count_predicted_frames", 0)) and int(counts.get("count_measured_frames", 0)):
            return True
        for message in (pose, *pictures):
            talk.player.play(shifted(message, BEFORE_NS + attempt * 20_000_000))
        attempt += 1
        for _ in range(10):
            talk.graph.spin_once(0.02)
        return False

    talk.wait("meeting of the nodes", met)


def answers(talk: Conversation, topic: str, stamp_ns: int) -> bool:
    return any(name == topic and small.stamp_of(data) == stamp_ns for name, data in talk.heard)


def test_three_processes_agree_with_one(filmed: Filmed, tmp_path: Path):
    run(RunOptions(filmed.folder, filmed.bag, tmp_path / "one"), lambda *_: None)
    messages = raw_messages(filmed.bag)
    common = {"experiment": str(filmed.folder)}
    start = {"start_ns": small.START_NS, "best_effort": False}
    stereo = common | start | {"rest_markers": str(tmp_path / "one" / "rest_markers.csv")}
    with (
        node("stereo_node", stereo, tmp_path),
        node("fem_node", common | start | {"newest_only": False}, tmp_path),
        node("compare_node", common | {"stale_after": 0.3, "best_effort": False}, tmp_path),
        conversation((t.PROBE_POSE, t.LEFT_IMAGE, t.RIGHT_IMAGE), tmp_path / "three.mcap") as talk,
    ):
        meet(talk, messages, tmp_path)
        for message in messages:
            talk.player.play(message)
            answer = {t.PROBE_POSE: t.FEM_MARKERS, t.RIGHT_IMAGE: t.STEREO_MARKERS}.get(message.topic)
            if answer:
                stamp = small.stamp_of(message.data)
                talk.wait(f"{answer} at {stamp}", lambda a=answer, s=stamp: answers(talk, a, s))
        last = small.stamp_of(messages[-1].data)
        talk.wait("last error", lambda: answers(talk, t.COMPARE_MARKERS, last))
    one, three = load_recording(tmp_path / "one" / "run.mcap"), load_recording(tmp_path / "three.mcap")
    errors = [e for e in three.errors if e.stamp_ns >= small.START_NS]
    assert [e.stamp_ns for e in errors] == [e.stamp_ns for e in one.errors]
    for a, b in zip(one.errors, errors, strict=True):
        np.testing.assert_array_equal(a.ids, b.ids)
        np.testing.assert_array_equal(a.measured, b.measured)
        np.testing.assert_allclose(a.errors, b.errors, atol=1e-8)
    predictions = [p for p in three.predictions if p.stamp_ns >= small.START_NS]
    for a, b in zip(one.predictions, predictions, strict=True):
        np.testing.assert_allclose(a.points, b.points, atol=1e-8)
