"""Nodes start, spin and stop in order; pictures pass between processes."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from lifecycle_msgs.srv import GetState
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Float64

from livedeform.common import topics as t
from livedeform.common.errors import InputError
from livedeform.common.node_parameters import LATEST_NS, within
from livedeform.common.ros import session as ros
from livedeform.common.ros.node import CountingNode


@pytest.fixture(autouse=True)
def isolated(monkeypatch):
    """One domain per test worker: a shared one lets workers hear each other."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    monkeypatch.setenv("ROS_DOMAIN_ID", str(60 + worker))


@dataclass
class Settings:
    rate: float = 30.0
    detector: str = "blob"
    enabled: bool = True


def test_parameters_come_from_a_dataclass():
    with ros.ros(["--ros-args", "-p", "rate:=12.5", "-p", "detector:=aruco"], handle_signals=False):
        node = Node("test_parameters")
        try:
            assert ros.declare(node, Settings) == Settings(12.5, "aruco", True)
        finally:
            node.destroy_node()


@dataclass
class Limited:
    """``gap``: s. ``start_ns``: of the recording."""

    gap: float = within(0.5, 0.0, 60.0)
    start_ns: int = within(0, 0, LATEST_NS)


def test_a_parameter_says_its_meaning_and_its_range_and_is_not_changed_behind_the_nodes_back():
    with ros.ros(["--ros-args", "-p", "gap:=2.0"], handle_signals=False):
        node = Node("test_ranges")
        try:
            assert ros.declare(node, Limited) == Limited(2.0, 0)
            gap = node.describe_parameter("gap")
            assert (gap.description, gap.floating_point_range[0].to_value, gap.read_only) == ("s.", 60.0, True)
            assert node.describe_parameter("start_ns").integer_range[0].from_value == 0
            assert not node.set_parameters([Parameter("gap", value=3.0)])[0].successful
        finally:
            node.destroy_node()


@pytest.mark.parametrize(("given", "said"), [("gap:=-1.0", "float from 0 to 60"), ("start_ns:=soon", "int from 0")])
def test_an_impossible_parameter_is_one_line(given, said):
    with ros.ros(["--ros-args", "-p", given], handle_signals=False):
        node = Node("test_refused")
        try:
            with pytest.raises(InputError, match=f"parameter {given.partition(':')[0]}") as error:
                ros.declare(node, Limited)
            assert said in str(error.value)
        finally:
            node.destroy_node()


def test_parameters_file_has_the_layout_that_nodes_read(tmp_path):
    import yaml

    file = tmp_path / "parameters.yaml"
    file.write_text(yaml.safe_dump(ros.parameters_yaml("test_file", Settings(rate=5.0))))
    with ros.ros(["--ros-args", "--params-file", str(file)], handle_signals=False):
        node = Node("test_file")
        try:
            assert ros.declare(node, Settings).rate == 5.0
        finally:
            node.destroy_node()


def test_spinning_delivers_in_order_and_stops_when_asked():
    got: list[float] = []
    with ros.ros([], handle_signals=False) as stop:
        node = Node("test_spin")
        node.create_subscription(Float64, "/n", lambda message: got.append(message.data), ros.RELIABLE)
        publisher = node.create_publisher(Float64, "/n", ros.RELIABLE)

        def idle() -> None:
            if len(got) == 20:
                stop.request()
            elif publisher.get_subscription_count() and len(got) == idle.sent:
                publisher.publish(Float64(data=float(idle.sent)))
                idle.sent += 1

        idle.sent = 0
        try:
            ros.spin([node], stop, idle=idle, timeout=0.01)
        finally:
            node.destroy_node()
    assert got == [float(k) for k in range(20)]


def test_the_large_segment_leaves_a_users_profile_alone(monkeypatch):
    monkeypatch.setenv(ros.PROFILE_VARIABLE, "/mine.xml")
    assert ros.use_large_segment() is None
    assert os.environ[ros.PROFILE_VARIABLE] == "/mine.xml"
    monkeypatch.delenv(ros.PROFILE_VARIABLE)
    path = ros.use_large_segment()
    assert path is not None and str(ros.SEGMENT_BYTES) in path.read_text()


def start(code: str, *arguments: str) -> subprocess.Popen:
    environment = {key: value for key, value in os.environ.items() if key != ros.PROFILE_VARIABLE}
    command = [sys.executable, "-c", textwrap.dedent(code), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_node_stops_in_order_when_interrupted(number):
    child = start(
        """
        from rclpy.node import Node
        from livedeform.common.ros.session import run_node
        class Ready(Node):
            def __init__(self):
                super().__init__("test_ready")
                self.create_timer(0.05, lambda: print("spinning", flush=True))
            def destroy_node(self):
                print("destroyed", flush=True)
                super().destroy_node()
        run_node(Ready, [])
        print("ended", flush=True)
        """
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "spinning\n"
    child.send_signal(number)
    out, err = child.communicate(timeout=30)
    assert out.splitlines()[-2:] == ["destroyed", "ended"]
    assert child.returncode == 0 and err == ""


@pytest.mark.slow
def test_pictures_pass_between_processes():
    """720p, reliable: with the default segment of 0.5 MB up to 2 of 90 are lost, with 64 MB none (measured)."""
    reader = start(
        """
        from rclpy.node import Node
        from sensor_msgs.msg import Image
        from livedeform.common.ros.session import RELIABLE, ros, spin
        with ros([]) as stop:
            node, n = Node("test_reader"), []
            def take(message):
                n.append(message.data[0])
                if len(n) == 60:
                    stop.request()
            node.create_subscription(Image, "/pictures", take, RELIABLE)
            spin([node], stop)
            print(n == list(range(60)))
            node.destroy_node()
        """
    )
    writer = start(
        """
        import numpy as np
        from rclpy.node import Node
        from livedeform.common.ros.messages import to_image
        from livedeform.common.types import Image
        from livedeform.common.ros.session import RELIABLE, ros, spin
        from sensor_msgs.msg import Image as Message
        with ros([]) as stop:
            node = Node("test_writer")
            publisher, sent = node.create_publisher(Message, "/pictures", RELIABLE), []
            def publish():
                if publisher.get_subscription_count() and len(sent) < 60:
                    publisher.publish(to_image(Image(0, np.full((720, 1280), len(sent), np.uint8))))
                    sent.append(1)
            node.create_timer(0.05, publish)
            spin([node], stop)
            node.destroy_node()
        """
    )
    try:
        out, err = reader.communicate(timeout=60)
    finally:
        writer.send_signal(signal.SIGINT)
        writer.communicate(timeout=30)
    assert out == "True\n", err


def test_the_profile_is_written_for_the_user_only():
    path = ros.use_large_segment() or Path(os.environ[ros.PROFILE_VARIABLE])
    assert path.parent.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("overridden", [False, True])
def test_qualities_that_do_not_fit_are_one_line_and_can_be_set(overridden, monkeypatch):
    key = "qos_overrides./fem/markers.subscription.reliability"
    words = ["--ros-args", "-p", f"{key}:=best_effort"] if overridden else []
    heard: list[Float64] = []
    said: list[str] = []
    monkeypatch.setattr(CountingNode, "status", lambda self, stamp, level, text, values=None: said.append(text))
    with ros.ros(words, handle_signals=False) as stop:
        hearer, other = CountingNode("test_hearer"), Node("test_other")
        hearer.subscribe(Float64, t.FEM_MARKERS, heard.append)
        publisher = other.create_publisher(Float64, t.FEM_MARKERS, ros.SENSOR)
        until = time.monotonic() + 20.0

        def idle():
            publisher.publish(Float64(data=1.0))
            if said or heard or time.monotonic() > until:
                stop.request()

        ros.spin([hearer, other], stop, idle=idle)
        for node in (hearer, other):
            node.destroy_node()
    if overridden:
        assert heard and not said
    else:
        assert not heard and len(said) == 1 and key in said[0] and "\n" not in said[0]


def test_a_topics_override_is_that_topics_only():
    words = ["--ros-args"]
    for end, topic in (("publisher", t.FEM_MARKERS), ("subscription", t.PROBE_POSE)):
        words += ["-p", f"qos_overrides.{topic}.{end}.reliability:=best_effort"]
    with ros.ros(words, handle_signals=False):
        node = CountingNode("test_overrides")
        for topic in (t.FEM_MARKERS, t.COMPARE_MARKERS):
            node.publisher(Float64, topic)
        for topic in (t.PROBE_POSE, t.STEREO_MARKERS):
            node.subscribe(Float64, topic, print, ros.RELIABLE)
        ends = {**node.outlets, **node.inlets}
        reliability = {topic: end.qos_profile.reliability.name for topic, end in ends.items()}
        node.destroy_node()
    best = {t.FEM_MARKERS, t.PROBE_POSE}
    assert reliability == {topic: "BEST_EFFORT" if topic in best else "RELIABLE" for topic in reliability}
    assert ros.RELIABLE.reliability.name == "RELIABLE"


def test_a_prepared_node_says_that_it_is_active():
    with ros.ros(handle_signals=False) as stop:
        node, asker = CountingNode("test_prepared"), Node("test_asker")
        client = asker.create_client(GetState, "/test_prepared/get_state")
        assert not client.wait_for_service(0.2)
        node.serve_state()
        assert client.wait_for_service(20.0)
        asked = client.call_async(GetState.Request())
        until = time.monotonic() + 20.0

        def idle():
            if asked.done() or time.monotonic() > until:
                stop.request()

        ros.spin([node, asker], stop, idle=idle)
        for each in (node, asker):
            each.destroy_node()
    assert asked.result().current_state.label == "active"
