"""The base of every node: counted messages, a status topic, and errors that do not kill the node."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from rclpy.clock import Clock
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from livedeform.common.errors import LivedeformError
from livedeform.common.processes import INTERRUPTED, end
from livedeform.common.ros.messages import from_time, to_diagnostics
from livedeform.common.ros.session import LONG_QUEUE, heard_quality, quality, run_node
from livedeform.common.ros.traffic import Traffic
from livedeform.common.stamps import StampGate

CLOCK_SECONDS = 2.0  # for the clock's publisher to be found


class CountingNode(Node):
    """A node whose messages are counted in ``traffic``.

    ``parameters`` go before a parameter file's. A ``LivedeformError`` in a callback becomes a status message: bad input
    does not end a node. Any other exception is a defect and passes through the executor.
    """

    def __init__(self, name: str, status_topic: str = "", parameters: Mapping[str, Any] | None = None) -> None:
        overrides = [Parameter(key, value=value) for key, value in (parameters or {}).items()]
        super().__init__(name, parameter_overrides=overrides)
        self.traffic = Traffic()
        self.inlets: dict[str, Subscription] = {}
        self.outlets: dict[str, Publisher] = {}
        self.gates: dict[str, StampGate[Any]] = {}
        self._handlers: dict[str, Callable[[Any], None]] = {}  # of the topics that have a gate
        self._publish_status = self.publisher(DiagnosticArray, status_topic) if status_topic else None
        if self.get_parameter("use_sim_time").value:
            self._clock_watch = self.create_timer(CLOCK_SECONDS, self._say_no_clock, clock=Clock())

    def subscribe(
        self,
        kind: type,
        topic: str,
        handle: Callable[[Any], None],
        qos: QoSProfile | None = None,
        *,
        raw: bool = False,
        gate: bool = False,
    ) -> None:
        """Call ``handle(message)`` (bytes if ``raw``) for every message; ``qos`` None: `heard_quality`.

        With ``gate``, of those with a header, not for one whose stamp is far from the others' (`StampGate`).
        """
        gatekeeper = StampGate[Any]()
        if gate:
            self.gates[topic], self._handlers[topic] = gatekeeper, handle

        def callback(message: Any, info: Mapping[str, Any]) -> None:
            self.traffic.receive(topic, self._number(subscription, info))
            try:
                with self.bad_input_said():
                    for admitted in gatekeeper.admit(from_time(message.header.stamp), message) if gate else [message]:
                        handle(admitted)
            finally:
                self.traffic.handled[topic] += 1

        subscription = self.inlets[topic] = self.create_subscription(
            kind,
            topic,
            callback,  # type: ignore[arg-type]  # rclpy's hints do not know the second argument
            copy(qos or heard_quality(topic)),  # rclpy writes overrides into it
            raw=raw,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._refuses(topic, "publisher")),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    @contextmanager
    def bad_input_said(self) -> Iterator[None]:
        """Go on behind the ``with`` block after a ``LivedeformError``, with its text as the status."""
        try:
            yield
        except LivedeformError as error:
            self.status(0, "ERROR", str(error))

    def n_refused(self, *topics: str) -> int:
        """Count the messages of ``topics`` that were left out since their stamp was far from the others'."""
        return sum(self.gates[topic].refused for topic in topics if topic in self.gates)

    def publisher(self, kind: type, topic: str) -> Callable[[Any], None]:
        """Return a function that publishes and counts; latched topics are those of the table of topics."""
        publisher = self.outlets[topic] = self.create_publisher(
            kind,
            topic,
            copy(quality(topic)),  # rclpy writes overrides into it
            event_callbacks=PublisherEventCallbacks(incompatible_qos=self._refuses(topic, "subscriber")),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

        def publish(message: Any) -> None:
            self.traffic.sent[topic] += 1
            publisher.publish(message)

        return publish

    def _refuses(self, topic: str, other: str) -> Callable[[Any], None]:
        """Return what says that a ``other`` end of the topic was found with which no message can be exchanged."""
        mine = "subscription" if other == "publisher" else "publisher"

        def say(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            key = f"qos_overrides.{topic}.{mine}.{policy.lower()}"
            remedy = f"set {key} to what the {other} has ('ros2 topic info --verbose {topic}' shows it)"
            self.status(0, "WARN", f"{topic}: a {other} has another {policy}, so no message passes; {remedy}")

        return say

    def status(self, stamp_ns: int, level: str, message: str, values: Mapping[str, Any] | None = None) -> None:
        """Publish one line and some values on the status topic; warnings and errors go to the log, too."""
        if level == "WARN":
            Node.get_logger(self).warning(message)
        elif level == "ERROR":
            Node.get_logger(self).error(message)
        if self._publish_status is not None:
            self._publish_status(to_diagnostics(stamp_ns, self.get_name(), level, message, values or {}))

    def _say_no_clock(self) -> None:
        """Warn, once, where the node's time stands still."""
        self._clock_watch.cancel()
        if self.count_publishers("/clock") == 0:
            self.status(0, "WARN", "use_sim_time is set, but nobody publishes /clock: start the simulation's clock")

    def log(self, message: str) -> None:
        """Write a line into the node's log."""
        Node.get_logger(self).info(message)

    def destroy_node(self) -> None:
        """Take the node out of the graph."""
        Node.destroy_node(self)

    def pass_over(self) -> None:
        """Count what waits in the queues as lost: it is not worked on any more."""
        for topic, subscription in self.inlets.items():
            with subscription.handle:
                for _ in range(LONG_QUEUE):
                    if (taken := subscription.handle.take_message(subscription.msg_type, True)) is None:
                        break
                    self.traffic.pass_over(topic, self._number(subscription, taken[1]))

    @staticmethod
    def _number(subscription: Subscription, info: Mapping[str, Any]) -> int | None:
        """Return the publisher's number of a message; None with several publishers, whose numbers are not one
        sequence."""
        return info.get("publication_sequence_number") if subscription.get_publisher_count() <= 1 else None

    def serve_state(self) -> None:
        """Answer ``ros2 lifecycle get``, and who waits for the service: the node is prepared and listens. There is no
        such service before."""

        def state(_: GetState.Request, response: GetState.Response) -> GetState.Response:
            response.current_state = State(id=State.PRIMARY_STATE_ACTIVE, label="active")
            return response

        self._state = self.create_service(GetState, "~/get_state", state)

    def start(self) -> None:
        """Publish what others need before anything else: everything is connected."""

    @property
    def busy(self) -> bool:
        """Tell whether the node works on something that it will publish."""
        return False

    def finish(self) -> None:
        """Publish what was held back: the input has ended."""
        for topic, gate in self.gates.items():
            for held in gate.end():
                with self.bad_input_said():
                    self._handlers[topic](held)


def run(make: Callable[[], CountingNode], args: Sequence[str] | None = None) -> None:
    """Run a node's console script: spin until interrupted (exit code 130 before it has begun); what is wrong at the
    start is one line and exit code 2."""

    def started() -> CountingNode:
        node = make()
        node.start()
        node.serve_state()
        node.log("ready")
        return node

    try:
        run_node(started, args)
    except LivedeformError as error:
        print(error, file=sys.stderr)
        end(2)
    except KeyboardInterrupt:
        end(INTERRUPTED)
    end(0)
