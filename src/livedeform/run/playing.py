"""Play a bag onto live topics, for those without ROS's own tools: ``livedeform play``."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags.read import BagReader, read_bag
from livedeform.common.bags.recording import header_stamp_ns
from livedeform.common.bags.types import RawMessage
from livedeform.common.errors import InputError
from livedeform.common.ros.session import ros
from livedeform.common.stamps import MOST_SECONDS
from livedeform.progress import Tell
from livedeform.run import graph as g

NS = 1_000_000_000
LAST_SECONDS = 10.0  # for listeners to acknowledge the last messages
LOOKED_AT = 50  # messages, to tell how stamps and receive times are apart
STAMP_AT = 4  # bytes into a message that begins with a header: behind the four of the encapsulation


@dataclass(frozen=True)
class PlayOptions:
    """``rate`` times the recorded speed; ``topics`` (None: the recording's inputs); ``now``: stamps are moved so that
    the recording begins when it is played; ``wait`` s for somebody who listens; ``start`` and ``duration`` s."""

    rate: float = 1.0
    topics: tuple[str, ...] | None = None
    now: bool = False
    wait: float = 10.0
    start: float = 0.0
    duration: float | None = None


def play(path: Path, options: PlayOptions, tell: Tell) -> dict[str, int]:
    """Publish the messages when they are due; give how many were sent by topic. Ctrl-C ends it."""
    with read_bag(path) as bag:
        names = chosen(bag, options.topics)
        with ros([]) as stop:
            player = g.Player(names)
            with g.Graph([player], stop) as graph:
                _wait_for_listeners(graph, player, options.wait, tell)
                latest = 0.0
                for raw, late in g.play_in_real_time(graph, player, messages(bag, names, options), options.rate):
                    latest = max(latest, late)
                    at = (raw.log_time_ns - bag.start_ns) / NS
                    tell(f"playing {at:.1f} s", at * NS / max(bag.end_ns - bag.start_ns, 1))
                _wait_for_acknowledgements(graph, player, tell)
        if latest > 0.1:
            tell(f"warning: messages were up to {latest:.1f} s late; the machine is too slow for this rate")
        return dict(player.traffic.sent)


def chosen(bag: BagReader, topics: Sequence[str] | None) -> list[str]:
    """The topics to play, sorted; ``InputError`` for one that is not in the bag or of another type than the
    interface's."""
    have = {name for name, info in bag.topics.items() if info.count and name in t.TOPICS}
    wanted = set(topics) if topics is not None else {name for name in have if t.TOPICS[name].input}
    lost = sorted(wanted - have)
    if lost or not wanted:
        what = f"there is no {lost[0]} to play" if lost else "there is nothing to play"
        known = ", ".join(sorted(have)) or "no topics of livedeform"
        raise InputError(what, where=str(bag.path), remedy=f"it has {known}")
    for name in wanted:
        if bag.topics[name].type != t.TOPICS[name].type:
            what = f"{name} is {bag.topics[name].type}, not {t.TOPICS[name].type}"
            raise InputError(what, where=str(bag.path), remedy="leave it out with --topics")
    return sorted(wanted)


def messages(bag: BagReader, names: Sequence[str], options: PlayOptions) -> Iterator[RawMessage]:
    """The messages between ``start`` and ``start + duration``; with ``now`` their stamps are moved to this moment."""
    first = bag.start_ns + round(options.start * NS)
    stop = None if options.duration is None else first + round(options.duration * NS)
    played = iter(bag.messages(names, first, stop))
    if not options.now:
        yield from played
        return
    begin = list(islice(played, LOOKED_AT))
    shift = _shift(begin)
    for raw in chain(begin, played):
        stamp = header_stamp_ns(raw)
        moved = 0 if stamp is None else stamp + shift
        is_date = stamp and 0 <= moved < MOST_SECONDS * NS  # one that is not set, or wrong, stays so
        yield replace(raw, data=restamped(raw.data, moved)) if is_date else raw


def _shift(begin: Sequence[RawMessage]) -> int:
    """Return by how much (ns) stamps are to be moved, so that the recording that begins so happens from now on: by the
    first of them that is no further from its receive time than is usual."""
    known = [(stamp, raw.log_time_ns) for raw in begin if (stamp := header_stamp_ns(raw))]
    if not known:
        return 0
    usual = int(np.median([stamp - received for stamp, received in known]))
    stamp, received = next((k for k in known if abs(k[0] - k[1] - usual) < NS), known[0])
    return time.time_ns() - stamp - (begin[0].log_time_ns - received)


def restamped(data: bytes, stamp_ns: int) -> bytes:
    """The message (CDR, a header first) with another stamp."""
    order = "<" if data[1] & 1 else ">"
    whole = bytearray(data)
    struct.pack_into(f"{order}iI", whole, STAMP_AT, stamp_ns // NS, stamp_ns % NS)
    return bytes(whole)


def _wait_for_listeners(graph: g.Graph, player: g.Player, seconds: float, tell: Tell) -> None:
    """Wait until somebody listens on every topic, or for ``seconds``; say where nobody does."""
    deadline = time.monotonic() + seconds
    while (lonely := _lonely(player)) and time.monotonic() < deadline and not graph.stop:
        tell(f"waiting for somebody who listens to {lonely[0]}")
        graph.spin_until(min(time.monotonic() + 0.2, deadline))
    if lonely:
        tell(f"nobody listens to {', '.join(lonely)}; played all the same")


def _wait_for_acknowledgements(graph: g.Graph, player: g.Player, tell: Tell) -> None:
    """Wait until reliable listeners have everything: what is on its way ends with its publisher. Say who has not."""
    deadline = time.monotonic() + LAST_SECONDS
    while (unheard := player.unheard()) and time.monotonic() < deadline and not graph.stop:
        graph.spin_until(time.monotonic() + 0.05)
    if unheard:
        tell(f"warning: who listens to {', '.join(unheard)} has not acknowledged the last messages")


def _lonely(player: g.Player) -> list[str]:
    return [topic for topic, outlet in player.outlets.items() if outlet.get_subscription_count() == 0]
