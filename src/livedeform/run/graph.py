"""The three nodes, a player and a recorder in one process, on one executor.

Lock step: a message is published, the executor spins until every node has handled it and everything that it gave rise
to, then comes the next. Nothing is lost, and two runs give the same numbers. Real time: messages are published when
they are due, or late, but never before those that were published are heard: nothing is lost there either, and what a
model is too slow for is told by its own counts.
"""

from __future__ import annotations

import importlib
import math
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor, TimeoutObject
from rclpy.node import Node
from rclpy.utilities import get_rmw_implementation_identifier, ok
from std_msgs.msg import Float64

from livedeform.common import topics as t
from livedeform.common.bags.types import RawMessage
from livedeform.common.errors import LivedeformError
from livedeform.common.ros.node import CountingNode
from livedeform.common.ros.session import LONG_SENSOR, QUEUE_DEPTH, RELIABLE, SENSOR, StopFlag, ros
from livedeform.run.recorder import RunRecorder

MATCH_SECONDS = 30.0
SETTLE_SECONDS = 10.0  # without any message being handled
APART_SECONDS = 0.5  # at most, between two calls of what is done in between
IDLE_SPINS = 5  # in a row that found nothing to do: the queues are empty


def message_type(name: str) -> type:
    """The class of ``package/msg/Name``."""
    package, _, kind = name.split("/")
    found: type = getattr(importlib.import_module(f"{package}.msg"), kind)
    return found


def installed(name: str) -> type | None:
    """The class of ``package/msg/Name``; None where its package is not installed."""
    try:
        return message_type(name)
    except ModuleNotFoundError:
        return None


class Player(CountingNode):
    """Publishes serialised messages."""

    def __init__(self, topics: Iterable[str]) -> None:
        super().__init__("player")
        self._publish = {topic: self.publisher(message_type(t.TOPICS[topic].type), topic) for topic in topics}

    def play(self, raw: RawMessage) -> None:
        self._publish[raw.topic](bytes(raw.data))

    def unheard(self) -> list[str]:
        """Return the topics of which a reliable listener has not acknowledged everything yet."""
        return [topic for topic, outlet in self.outlets.items() if not outlet.wait_for_all_acked(Duration())]


class RecorderNode(CountingNode):
    """Hears every topic of the interface and writes what comes; with ``show`` publishes what is derived of it for
    viewers, as far as the types of messages are installed (tf2_msgs is no part of the wheels)."""

    def __init__(self, recorder: RunRecorder, *, best_effort: bool = False, show: bool = False) -> None:
        super().__init__("recorder")
        for topic in t.TOPICS.values():
            if topic.publisher == "recorder":  # it writes that itself
                continue
            quality = None
            if best_effort and topic.input:  # it may come from a tracker that is not reliable
                quality = SENSOR if topic.type in (t.IMAGE, t.COMPRESSED_IMAGE) else LONG_SENSOR
            write = partial(recorder.write, topic.name, topic.type)
            self.subscribe(message_type(topic.type), topic.name, write, quality, raw=True)
        self._viewers: dict[str, Callable[[Any], None]] = {}
        if show:
            for topic in t.TOPICS.values():
                if topic.publisher == "recorder" and (kind := installed(topic.type)) is not None:
                    self._viewers[topic.name] = self.publisher(kind, topic.name)
            recorder.show = self.show

    def show(self, topic: str, type_name: str, data: bytes) -> None:
        """Publish one derived message."""
        if topic in self._viewers:
            self._viewers[topic](data)


class Apart:
    """A node on an executor and a thread of its own: it hears while others compute. ``idle`` is called in between."""

    def __init__(self, node: CountingNode, idle: Callable[[], None]) -> None:
        self.node = node
        self.failure: BaseException | None = None  # that ended the thread
        self._idle, self._ending = idle, threading.Event()
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, name=node.get_name(), daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        try:
            while not self._ending.is_set():
                self._executor.spin_once(timeout_sec=APART_SECONDS)
                self._idle()
        except BaseException as error:
            self.failure = error

    def end(self) -> None:
        """End the thread; the node may go to another executor."""
        self._ending.set()
        self._thread.join()
        self._executor.remove_node(self.node)
        self._executor.shutdown()


class Graph:
    """Nodes on one executor in this thread; a context manager that destroys them in the end.

    The node ``apart`` is on a thread of its own until the graph drains; ``idle`` is called there in between.
    """

    def __init__(
        self,
        nodes: Sequence[CountingNode],
        stop: StopFlag,
        apart: CountingNode | None = None,
        idle: Callable[[], None] = lambda: None,
    ) -> None:
        self.nodes, self.stop = [*nodes, *([] if apart is None else [apart])], stop
        self._executor = SingleThreadedExecutor()
        self._timeout = TimeoutObject(0.0)
        for node in nodes:
            self._executor.add_node(node)
        self._apart = None if apart is None else Apart(apart, idle)

    def __enter__(self) -> Graph:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.join()
        except BaseException:  # it was raised already, or hides another error
            if kind is None:
                raise
        finally:
            self._end()

    def _end(self) -> None:
        nodes: Sequence[Node] = self.nodes
        for node in nodes:
            self._executor.remove_node(node)
        self._executor.shutdown()
        for node in nodes:
            node.destroy_node()

    def spin_until(self, moment: float) -> None:
        """Handles messages until ``time.monotonic()`` reaches ``moment``, or a stop is asked for."""
        while not self.stop and (left := moment - time.monotonic()) > 0:
            self.spin_once(min(left, 0.1))

    def spin_once(self, timeout: float) -> None:
        """Handles one message, or waits ``timeout`` s for one. Of messages that are there each topic gets its turn."""
        self._timeout.timeout = timeout  # another object, or number, and rclpy forgets what else was ready
        self._executor.spin_once(timeout_sec=self._timeout)  # type: ignore[arg-type]  # which it takes
        if self._apart is not None and self._apart.failure is not None:
            raise self._apart.failure

    def join(self) -> None:
        """Take the node that was apart into this thread."""
        if self._apart is not None:
            apart, self._apart = self._apart, None
            apart.end()
            self._executor.add_node(apart.node)
            if apart.failure is not None:
                raise apart.failure

    def start(self) -> None:
        """Waits until every publisher and subscriber among the nodes have found each other, then starts the nodes.

        A message that is published before is lost, even on a reliable connection.
        """
        deadline = time.monotonic() + MATCH_SECONDS
        while lonely := self._unmatched():
            self.spin_until(time.monotonic() + 0.002)
            if self.stop:
                return
            if time.monotonic() > deadline:
                raise LivedeformError(f"the nodes do not find each other on {lonely}", remedy="run livedeform doctor")
        for node in self.nodes:
            node.start()
        self.settle()

    def _unmatched(self) -> str:
        """A topic on which a publisher and a subscriber among the nodes have not met; empty if all have."""
        talkers = Counter(topic for node in self.nodes for topic in node.outlets)
        listeners = Counter(topic for node in self.nodes for topic in node.inlets)
        for node in self.nodes:
            for topic, publisher in node.outlets.items():
                if publisher.get_subscription_count() < listeners[topic]:
                    return topic
            for topic, subscription in node.inlets.items():
                if subscription.get_publisher_count() < talkers[topic]:
                    return topic
        return ""

    def outstanding(self) -> dict[str, int]:
        """Messages by topic that were published here and are not yet handled by every listener here."""
        sent = Counter[str]()
        for node in self.nodes:
            sent.update(dict(node.traffic.sent))  # a copy: another thread may send
        missing: dict[str, int] = {}
        for node in self.nodes:
            for topic in node.inlets:
                late = sent[topic] - node.traffic.handled[topic]
                if late > 0:
                    missing[topic] = missing.get(topic, 0) + late
        return missing

    def settle(self) -> None:
        """Spins until nothing is outstanding; an error if messages got lost on the way."""
        last, patience = -1, time.monotonic() + SETTLE_SECONDS
        while missing := self.outstanding():
            self.spin_once(0.1)
            handled = sum(node.traffic.n_handled for node in self.nodes)
            if handled != last:
                last, patience = handled, time.monotonic() + SETTLE_SECONDS
            elif time.monotonic() > patience:
                raise LivedeformError(
                    f"{sum(missing.values())} messages were lost on {', '.join(missing)}",
                    remedy="livedeform doctor; another program on the same ROS_DOMAIN_ID may disturb",
                )

    def balance(self) -> dict[str, dict[str, int]]:
        """Return for each "node: topic" how many messages were sent to it, and how many of them it received and lost.

        The sum is exact where the topic is published here. Else it is by the publisher's numbers: from the first
        message that came to the last one; "before" are those before it, where there are any.
        """
        sent = Counter[str]()
        for node in self.nodes:
            sent.update(node.traffic.sent)
        rows = {}
        for node in self.nodes:
            for topic in sorted(node.inlets):
                received, gaps = node.traffic.received[topic], node.traffic.lost[topic]
                lost = sent[topic] - received if sent[topic] >= received else gaps
                if received or lost:
                    row = {"sent": received + lost, "received": received, "lost": lost}
                    if topic not in sent and node.traffic.before[topic]:
                        row["before"] = node.traffic.before[topic]
                    rows[f"{node.get_name()}: {topic}"] = row
        return rows

    def lost(self) -> dict[str, int]:
        """Return the lost messages as "node: topic"."""
        return {name: row["lost"] for name, row in self.balance().items() if row["lost"]}

    def drain(self, patience: float) -> None:
        """Handle what has arrived, for no longer than ``patience`` (s); what is left in the queues then is lost."""
        self.join()
        deadline = time.monotonic() + patience
        self._handle_while(lambda: time.monotonic() < deadline)
        for node in self.nodes:
            node.pass_over()

    def catch_up(self, topics: Iterable[str]) -> None:
        """Handle what was published on ``topics``, until a stop is asked for, and elsewhere so much that no queue is
        half full: what is published on top of a full one pushes its oldest message out. What got lost is not waited
        for."""
        wanted = list(topics)

        def behind() -> bool:
            late = self.outstanding()
            return any(topic in late for topic in wanted) or 2 * max(late.values(), default=0) > QUEUE_DEPTH

        self._handle_while(lambda: not self.stop and behind())

    def _handle_while(self, wanted: Callable[[], bool]) -> None:
        """Handle messages while that is ``wanted`` and some are there."""
        idle, handled = 0, -1
        while idle < IDLE_SPINS and wanted():
            self.spin_once(0.0)
            now = sum(node.traffic.n_handled for node in self.nodes)
            idle, handled = (idle + 1 if now == handled else 0), now

    def finish(self, patience: float | None = None) -> None:
        """The input has ended: each node in turn publishes what it held back, as the next may wait for it.

        With ``patience`` (s) messages that got lost on the way are given up when for so long those that are outstanding
        did not become fewer; they are in ``lost``.
        """
        for node in self.nodes:
            node.finish()
            if patience is None:
                self.settle()
            deadline = fewest = math.inf
            while (late := sum(self.outstanding().values())) or node.busy:
                if late < fewest and patience is not None:
                    deadline, fewest = time.monotonic() + patience, late
                if time.monotonic() >= deadline:
                    break
                self.spin_once(0.05)

    def crowded(self) -> dict[str, int]:
        """Topics with more than one publisher, here and outside, and how many."""
        counts = {topic: self.publishers(topic) for node in self.nodes for topic in node.inlets}
        return {topic: n for topic, n in counts.items() if n > 1}

    def publishers(self, topic: str) -> int:
        """Count how many publishers there are on a topic, in this process and outside."""
        return self.nodes[0].count_publishers(topic)


def play_in_lock_step(graph: Graph, player: Player, messages: Iterable[RawMessage]) -> Iterator[RawMessage]:
    """Plays one message after the other, each when the one before is done with; yields it before it is published."""
    for raw in messages:
        if graph.stop:
            return
        yield raw
        player.play(raw)
        graph.settle()


def play_in_real_time(
    graph: Graph, player: Player, messages: Iterable[RawMessage], rate: float
) -> Iterator[tuple[RawMessage, float]]:
    """Plays messages when they are due at ``rate`` times the recorded speed, and late where those before are not
    heard yet; yields each with how late it is (s)."""
    begin: tuple[float, int] | None = None
    for raw in messages:
        graph.catch_up(player.outlets)
        now = time.monotonic()
        begin = begin or (now, raw.log_time_ns)
        due = begin[0] + (raw.log_time_ns - begin[1]) * 1e-9 / rate
        graph.spin_until(due)
        if graph.stop:
            return
        yield raw, max(0.0, time.monotonic() - due)
        player.play(raw)


# --- for the doctor --------------------------------------------------------------------------------------------------


def middleware() -> str:
    """Starts and stops ROS; says which middleware is used."""
    with ros([], handle_signals=False):
        return f"rclpy with {get_rmw_implementation_identifier()}"


@contextmanager
def _one_node(name: str) -> Iterator[tuple[Node, SingleThreadedExecutor, StopFlag]]:
    with ros([]) as stop:
        node, executor = Node(name), SingleThreadedExecutor()
        executor.add_node(node)
        try:
            yield node, executor, stop
        finally:
            executor.shutdown()
            node.destroy_node()


def answer() -> None:
    """Sends back every number that arrives on ``/doctor/ask``, until stopped."""
    with _one_node("doctor_answer") as (node, executor, stop):
        publisher = node.create_publisher(Float64, "/doctor/answer", RELIABLE)
        node.create_subscription(Float64, "/doctor/ask", publisher.publish, RELIABLE)
        while not stop and ok():
            executor.spin_once(timeout_sec=0.05)


def ask() -> None:
    """Asks until the other process has answered."""
    with _one_node("doctor_ask") as (node, executor, stop):
        answers: list[float] = []

        def hear(message: Float64) -> None:
            answers.append(message.data)

        publisher = node.create_publisher(Float64, "/doctor/ask", RELIABLE)
        node.create_subscription(Float64, "/doctor/answer", hear, RELIABLE)
        while not stop and 42.0 not in answers:
            publisher.publish(Float64(data=42.0))
            executor.spin_once(timeout_sec=0.05)


if __name__ == "__main__":
    {"answer": answer, "ask": ask}[sys.argv[1]]()
