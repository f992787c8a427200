"""livedeform play: a bag onto live topics, every message once and in order, with its own stamps or with today's."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import small
from processes import conversation, process, raw_messages

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import InputError
from livedeform.run.playing import PlayOptions, chosen, messages
from livedeform.run.scene import written

PLAY = "from livedeform.cli import main; main()"


def test_what_is_played_is_what_was_recorded(bag: Path, tmp_path: Path):
    log = tmp_path / "play.log"
    with (
        conversation((), tmp_path / "heard.mcap") as talk,
        process(PLAY, "play", str(bag), "--rate", "5", "--wait", "600", out=log, ends=(0,)) as child,
    ):
        known = [raw for raw in raw_messages(bag) if t.TOPICS[raw.topic].input]
        while child.poll() is None:  # however long it takes to start
            talk.graph.spin_once(0.05)
        talk.wait("all messages", lambda: len(talk.heard) >= len(known))
    for topic in {raw.topic for raw in known}:
        heard = [data for name, data in talk.heard if name == topic]
        played = [raw.data for raw in known if raw.topic == topic]
        assert len(heard) == len(played)
        for there, here in zip(heard, played, strict=True):  # between processes DDS fills up to four bytes with zeros
            assert there[: len(here)] == here and len(there) - len(here) < 4 and not any(there[len(here) :])
        assert f"{topic}" in log.read_text()  # counted at the end


def test_stamps_of_now(bag: Path):
    with read_bag(bag) as opened:
        names = chosen(opened, None)
        recorded = [small.stamp_of(raw.data) for raw in opened.messages(names)]
        before = time.time_ns()
        moved = list(messages(opened, names, PlayOptions(now=True)))
        stamps = [small.stamp_of(raw.data) for raw in moved]
    assert before <= stamps[0] <= time.time_ns()
    assert [s - stamps[0] for s in stamps] == [s - recorded[0] for s in recorded]
    assert len({len(raw.data) for raw in moved if raw.topic == t.PROBE_POSE}) == 1


def test_a_topic_that_is_not_there_is_named(bag: Path):
    with read_bag(bag) as opened, pytest.raises(InputError, match="there is no /compare/rmse"):
        chosen(opened, ("/compare/rmse",))


STAMPS: dict[str, tuple[int, Callable[[int], int]]] = {
    "the first is not set": (0, lambda stamp_ns: 0),
    "the first is ahead": (0, lambda stamp_ns: stamp_ns + 94_608_000_000_000_000),
    "one is the last that there is": (3, lambda stamp_ns: 2**31 * 1_000_000_000 - 5),
}


@pytest.mark.parametrize("name", STAMPS)
def test_one_wrong_stamp_moves_no_other(name: str, tmp_path: Path):
    at, change = STAMPS[name]
    poses = small.press(8)
    with BagWriter(tmp_path / "x.mcap") as bag:
        for k, pose in enumerate(poses):
            stamped = replace(pose, stamp_ns=change(pose.stamp_ns)) if k == at else pose
            for topic, kind, data in written(lambda w, stamped=stamped: w.pose(stamped)):
                bag.write(topic, kind, pose.stamp_ns, data)
    with read_bag(tmp_path / "x.mcap") as opened:
        before = time.time_ns()
        stamps = [small.stamp_of(raw.data) for raw in messages(opened, [t.PROBE_POSE], PlayOptions(now=True))]
        after = time.time_ns()
    for k, (stamp, pose) in enumerate(zip(stamps, poses, strict=True)):
        if k != at:
            assert before <= stamp - (pose.stamp_ns - poses[0].stamp_ns) <= after
