"""What the nodes offer and hear is what the table of topics says."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
from rclpy.qos import DurabilityPolicy
from small import Filmed

from livedeform.common import topics as t
from livedeform.common.ros.session import descriptions, ros
from livedeform.compare_node.node import CompareNode, CompareParameters
from livedeform.fem_node.node import FemNode
from livedeform.fem_node.parameters import Parameters as FemParameters
from livedeform.run.graph import RecorderNode, message_type
from livedeform.run.recorder import RunRecorder
from livedeform.stereo_node.node import StereoNode
from livedeform.stereo_node.parameters import StereoParameters


def test_publishers_have_the_types_and_qualities_of_the_table(filmed: Filmed, tmp_path: Path):
    common = {"experiment": str(filmed.folder)}
    with ros([], handle_signals=False), RunRecorder(tmp_path / "x.mcap", {}, lambda: 0) as recorder:
        nodes = [StereoNode(common), FemNode(common | {"newest_only": False}), CompareNode(common)]
        hearer = RecorderNode(recorder)
        try:
            for node in nodes:
                for name, outlet in node.outlets.items():
                    topic = t.TOPICS[name]
                    assert topic.publisher == node.get_name()
                    assert outlet.msg_type is message_type(topic.type)
                    latched = outlet.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
                    assert latched == topic.latched, f"{node.get_name()} offers {name} otherwise than the table says"
                for name, inlet in node.inlets.items():
                    assert inlet.msg_type is message_type(t.TOPICS[name].type)
            assert set(hearer.inlets) == {name for name, topic in t.TOPICS.items() if topic.publisher != "recorder"}
            for name, inlet in hearer.inlets.items():
                latched = inlet.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
                assert latched == t.TOPICS[name].latched
        finally:
            for node in [*nodes, hearer]:
                node.destroy_node()


@pytest.mark.parametrize("name", [name for name, topic in t.TOPICS.items() if topic.publisher != "recorder"])
def test_types_are_those_of_ros(name: str):
    assert message_type(t.TOPICS[name].type).__name__ == t.TOPICS[name].type.rsplit("/", 1)[1]


@pytest.mark.parametrize("kind", [StereoParameters, FemParameters, CompareParameters])
def test_every_parameter_has_a_description(kind: type):
    """`ros2 param describe` shows what the docstring says."""
    said = descriptions(kind)
    assert set(said) == {field.name for field in fields(kind)}
    assert all(len(text) > 10 for text in said.values())
