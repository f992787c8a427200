"""Starting, spinning and stopping ROS nodes: what every node's ``main`` and the graph share."""

from __future__ import annotations

import os
import re
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, try_shutdown

from livedeform.common.errors import InputError
from livedeform.common.own_folder import own_folder
from livedeform.common.processes import expendable, heard_at_once
from livedeform.common.topics import COMPRESSED_IMAGES, IMAGES, LATCHED_DEPTH, TOPICS

Parameters = TypeVar("Parameters")

SEGMENT_BYTES = 64 * 1024 * 1024
PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"

QUEUE_DEPTH = 50  # a second and a half of pictures; a replay never fills it with inputs: they come one by one
RELIABLE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=QUEUE_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=LATCHED_DEPTH,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
# A best-effort reader matches every writer: what cameras publish with the sensor profile is heard, too.
SENSOR = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=QUEUE_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)


LONG_QUEUE = 1000  # of small messages, for who must not lose them: ten seconds of poses on a machine that is busy
LONG_SENSOR = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=LONG_QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT)


def quality(topic: str) -> QoSProfile:
    """Return the quality of service at which a topic is offered, from the table of topics."""
    return LATCHED if topic in TOPICS and TOPICS[topic].latched else RELIABLE


def heard_quality(topic: str) -> QoSProfile:
    """Return the quality of service at which a topic of the table is heard from who is reliable: as it is offered, but
    with a queue, save for pictures, that holds what a node publishes within one callback. One prediction may tell the
    errors of half a second of frames, and one pose the predictions of as many."""
    profile = copy(quality(topic))
    if topic in TOPICS and topic not in (*IMAGES, *COMPRESSED_IMAGES):
        profile.depth = LONG_QUEUE
    return profile


_PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>livedeform_shm</transport_id>
      <type>SHM</type>
      <segment_size>{segment}</segment_size>
    </transport_descriptor>
    <transport_descriptor>
      <transport_id>livedeform_udp</transport_id>
      <type>UDPv4</type>
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="livedeform" is_default_profile="true">
    <rtps>
      <userTransports>
        <transport_id>livedeform_shm</transport_id>
        <transport_id>livedeform_udp</transport_id>
      </userTransports>
      <useBuiltinTransports>false</useBuiltinTransports>
    </rtps>
  </participant>
</profiles>
"""


class StopFlag:
    """A flag that is true once SIGINT or SIGTERM came; the loop that spins looks at it and ends in order.

    A second signal interrupts at once, in the middle of a long computation; none does once ``finishing`` is set: what
    was recorded until then is still written. With ``at_once`` the first one interrupts.
    """

    def __init__(self) -> None:
        self.requested = self.finishing = self.at_once = False

    def request(self, signum: int = 0, frame: FrameType | None = None) -> None:
        if (self.requested or self.at_once) and signum and not self.finishing:
            self.finishing = True
            raise KeyboardInterrupt
        self.requested = True

    def __bool__(self) -> bool:
        return self.requested


def use_large_segment() -> Path | None:
    """Point Fast DDS to a profile with a 64 MB shared-memory segment; the default of 0.5 MB loses pictures.

    Must run before ``rclpy.init``. A profile that the user has set is left alone (None).
    """
    if os.environ.get(PROFILE_VARIABLE):
        return None
    folder = Path(tempfile.gettempdir()) / f"livedeform-{os.getuid()}"
    if not own_folder(folder):  # another user made it first: whoever writes there chooses our transports
        folder = Path(tempfile.mkdtemp(prefix="livedeform-"))
    path = folder / "fastdds_64mb.xml"
    text = _PROFILE.format(segment=SEGMENT_BYTES)
    if not path.is_file() or path.read_text() != text:
        draft = path.with_name(f"{path.name}.{os.getpid()}")
        draft.write_text(text)
        draft.replace(path)
    os.environ[PROFILE_VARIABLE] = str(path)
    return path


@contextmanager
def ros(args: Sequence[str] | None = None, *, handle_signals: bool = True) -> Iterator[StopFlag]:
    """Initialise rclpy for the ``with`` block and give the flag that SIGINT and SIGTERM set.

    Our own handlers, because rclpy's abort spinning in the middle of a callback (measured: 40 of 40 clean stops).
    """
    use_large_segment()
    stop = StopFlag()
    previous: dict[signal.Signals, Any] = {}
    rclpy.init(args=list(args) if args is not None else None, signal_handler_options=SignalHandlerOptions.NO)
    try:
        if handle_signals:
            for number in (signal.SIGINT, signal.SIGTERM):
                previous[number] = signal.signal(number, stop.request)
        yield stop
    finally:
        try_shutdown()
        for number, handler in previous.items():
            signal.signal(number, handler)


def spin(
    nodes: Sequence[Node], stop: StopFlag, *, idle: Callable[[], None] | None = None, timeout: float = 0.1
) -> None:
    """Spin ``nodes`` in this thread until ``stop``; ``idle`` is called between callbacks and may set the flag."""
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    try:
        while not stop and ok():
            executor.spin_once(timeout_sec=timeout)
            if idle is not None:
                idle()
    except ExternalShutdownException:
        stop.request()
    finally:
        for node in nodes:
            executor.remove_node(node)
        executor.shutdown()


def run_node(make: Callable[[], Node], args: Sequence[str] | None = None) -> None:
    """Run a node's whole ``main``: start, spin until interrupted, stop. A node keeps nothing that a stop could lose, so
    none waits: not for a model that is being made, nor for a prediction that is in hand."""
    with heard_at_once(), expendable(), ros(args) as stop:
        stop.at_once = True
        node = make()
        stop.at_once = False
        try:
            spin([node], stop)
        finally:
            node.destroy_node()


def declare(node: Node, kind: type[Parameters]) -> Parameters:
    """Declare the node's ROS parameters and return an instance of the dataclass ``kind``, whose defaults are the
    parameters'. They are read once, so setting one later is refused.

    Raises ``InputError`` for a value of another type, or outside its range (`common.node_parameters.within`).
    """
    if not is_dataclass(kind):
        raise TypeError(f"{kind.__name__} is not a dataclass")
    said = descriptions(kind)
    values = {}
    for f in fields(kind):
        descriptor = ParameterDescriptor(description=said.get(f.name, ""), read_only=True)
        if ends := f.metadata.get("within"):
            if isinstance(f.default, float):
                descriptor.floating_point_range = [FloatingPointRange(from_value=ends[0], to_value=ends[1])]
            else:
                descriptor.integer_range = [IntegerRange(from_value=ends[0], to_value=ends[1])]
        try:
            values[f.name] = node.declare_parameter(f.name, f.default, descriptor).value
        except ParameterException as error:
            allowed = f"{type(f.default).__name__}" + (f" from {ends[0]:g} to {ends[1]:g}" if ends else "")
            remedy = f"it must be a {allowed}; ros2 param describe says what it means"
            raise InputError("not a possible value", where=f"parameter {f.name}", remedy=remedy) from error
    return kind(**values)


def descriptions(kind: type) -> dict[str, str]:
    """Return what the docstring of a dataclass says of each field, each as a name in double backticks, a colon and
    text; ``ros2 param describe`` shows it."""
    text = " ".join((kind.__doc__ or "").split())
    parts = re.split(r"``(\w+)``: ", text)
    return {name: said.strip() for name, said in zip(parts[1::2], parts[2::2], strict=True)}


def parameters_yaml(node_name: str, values: Any) -> dict[str, Any]:
    """Return the content of a ``--params-file`` for one node, from an instance of its parameter dataclass."""
    return {node_name: {"ros__parameters": {f.name: getattr(values, f.name) for f in fields(values)}}}
