"""Nodes as processes of their own, fed over DDS from the test's process."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.types import RawMessage, decode
from livedeform.common.ros.session import ros
from livedeform.run import graph as g
from livedeform.run.recorder import RunRecorder

PATIENCE = 60.0  # s; generous: other work may run on the machine


@contextmanager
def process(code: str, *arguments: str, out: Path, ends: tuple[int, ...] = (0,)) -> Iterator[subprocess.Popen]:
    """A Python process whose output goes to the file ``out``; it is interrupted in the end, and must end cleanly, with
    one of the exit codes ``ends``."""
    with out.open("w") as log:
        child = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=log, stderr=subprocess.STDOUT)
        try:
            yield child
            if child.poll() is None:
                child.send_signal(signal.SIGINT)
            ended = child.wait(PATIENCE)
            assert ended in ends, f"exit code {ended}: {out.read_text()}"
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()


@contextmanager
def node(name: str, parameters: Mapping[str, Any], folder: Path) -> Iterator[subprocess.Popen]:
    """One of the console scripts, with a parameter file."""
    file = folder / f"{name}.yaml"
    file.write_text(json.dumps({name: {"ros__parameters": dict(parameters)}}))  # JSON is YAML
    code = f"from livedeform.{name}.node import main; main()"
    arguments = ("--ros-args", "--params-file", str(file))
    ends = (0, 130)  # 130: on a busy machine a node that takes its time is cut off
    with process(code, *arguments, out=folder / f"{name}.log", ends=ends) as child:
        yield child


class Conversation:
    """Publishes messages to nodes in other processes, one after the other, each when its answer has come."""

    def __init__(self, graph: g.Graph, player: g.Player, record: Path, heard: list[tuple[str, bytes]]) -> None:
        self.graph, self.player, self._record, self.heard = graph, player, record, heard

    def wait(self, what: str, done: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not done():
            self.graph.spin_once(0.02)
            assert time.monotonic() < deadline, f"no {what} within {PATIENCE:.0f} s"

    def count(self, topic: str) -> int:
        return sum(name == topic for name, _ in self.heard)

    def metrics(self) -> dict[str, str]:
        """Key-value pairs of the last ``/compare/metrics``."""
        for name, data in reversed(self.heard):
            if name == t.COMPARE_METRICS:
                message = decode(RawMessage(name, "diagnostic_msgs/msg/DiagnosticArray", 0, data))
                return {pair.key: pair.value for pair in message.status[0].values}
        return {}


@contextmanager
def conversation(topics: Sequence[str], record: Path) -> Iterator[Conversation]:
    """A player and a recorder in this process."""
    with ExitStack() as stack:
        stop = stack.enter_context(ros([], handle_signals=False))
        heard: list[tuple[str, bytes]] = []
        hear = lambda topic, kind, data: heard.append((topic, data))  # noqa: E731
        recorder = stack.enter_context(RunRecorder(record, {}, time.time_ns, hear))
        hearer = g.RecorderNode(recorder)
        player = g.Player(topics)
        graph = stack.enter_context(g.Graph([hearer, player], stop))
        talk = Conversation(graph, player, record, heard)
        graph.start()
        yield talk


def shifted(raw: RawMessage, by_ns: int) -> RawMessage:
    """The message with its header stamp moved."""
    sec = int.from_bytes(raw.data[4:8], "little")
    nanosec = int.from_bytes(raw.data[8:12], "little")
    stamp = sec * 1_000_000_000 + nanosec + by_ns
    head = (stamp // 1_000_000_000).to_bytes(4, "little") + (stamp % 1_000_000_000).to_bytes(4, "little")
    return replace(raw, data=raw.data[:4] + head + raw.data[12:])


def raw_messages(bag: Path) -> list[RawMessage]:
    with read_bag(bag) as reader:
        return list(reader.messages())
