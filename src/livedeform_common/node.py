"""The base of every node: counted messages, parameters from a dataclass, a status, errors that do not kill the node."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time

from livedeform_common.errors import LivedeformError
from livedeform_common.traffic import Traffic

P = TypeVar("P")
LEVELS = {
    "OK": DiagnosticStatus.OK,
    "WARN": DiagnosticStatus.WARN,
    "ERROR": DiagnosticStatus.ERROR,
    "STALE": DiagnosticStatus.STALE,
}


def quality(depth: int = 100, *, best_effort: bool = False) -> QoSProfile:
    """Reliable, or best effort for sensors that offer no more; the last ``depth`` messages are kept."""
    reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability)


class CountingNode(Node):
    """A node whose messages are counted in ``traffic``.

    A ``LivedeformError`` in a callback becomes a status message: bad input does not end a node. Any other exception is a
    defect and passes through the executor.
    """

    def __init__(self, name: str, status_topic: str | None = None, parameters: Mapping[str, Any] | None = None) -> None:
        overrides = [Parameter(key, value=value) for key, value in (parameters or {}).items()]
        super().__init__(name, parameter_overrides=overrides)
        self.traffic = Traffic()
        self._status = self.publisher(DiagnosticArray, status_topic) if status_topic else None

    def declared(self, kind: type[P]) -> P:
        """Parameters from a dataclass: a name, a type and a default each."""
        return kind(**{f.name: self.declare_parameter(f.name, f.default).value for f in fields(kind)})  # type: ignore[arg-type]

    def subscribe(
        self, kind: type, topic: str, handle: Callable[[Any], None], qos: QoSProfile | None = None, *, raw: bool = False
    ) -> None:
        """Calls ``handle(message)`` (bytes if ``raw``) for every message."""

        def callback(message: Any, info: Mapping[str, Any]) -> None:
            self.traffic.receive(topic, info.get("publication_sequence_number"))
            try:
                handle(message)
            except LivedeformError as error:
                self.status(0, "ERROR", str(error))
            finally:
                self.traffic.handled[topic] += 1

        self.create_subscription(kind, topic, callback, qos or quality(), raw=raw)

    def publisher(self, kind: type, topic: str, qos: QoSProfile | None = None) -> Callable[[Any], None]:
        """A function that publishes and counts."""
        publisher: Publisher = self.create_publisher(kind, topic, qos or quality())

        def publish(message: Any) -> None:
            self.traffic.sent[topic] += 1
            publisher.publish(message)

        return publish

    def status(self, stamp_ns: int, level: str, message: str, values: Mapping[str, Any] | None = None) -> None:
        """One line and some values about this node, on its status topic; warnings and errors go to the log, too."""
        if level in ("WARN", "ERROR"):
            logger = self.get_logger()
            (logger.warning if level == "WARN" else logger.error)(message)
        if self._status is not None:
            self._status(diagnostics(self.get_name(), stamp_ns, level, message, values or {}))

    def lost(self) -> Counter[str]:
        """Messages that were published and never arrived here, by topic."""
        return self.traffic.lost


def diagnostics(
    name: str, stamp_ns: int, level: str, message: str, values: Mapping[str, Any]
) -> DiagnosticArray:
    """A DiagnosticArray of one status; values as text that reads back exactly."""
    pairs = [KeyValue(key=key, value=value if isinstance(value, str) else repr(value)) for key, value in values.items()]
    status = DiagnosticStatus(level=LEVELS[level], name=name, message=message, hardware_id="livedeform", values=pairs)
    array = DiagnosticArray(status=[status])
    array.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
    return array
