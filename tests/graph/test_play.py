"""livedeform play: a bag onto live topics, every message once and in order, with its own stamps or with today's."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import small
from processes import conversation, process, raw_messages

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.errors import InputError
from livedeform.run.playing import PlayOptions, chosen, messages

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
