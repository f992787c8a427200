"""The table of topics is the one home of what a topic is: type, latched, where it comes from."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from livedeform.common import topics as t
from livedeform.common.bags.types import encode, message_class
from livedeform.common.bags.write import BagWriter

SRC = Path(t.__file__).parents[1]


def test_every_topic_name_has_a_row_of_a_known_type():
    names = {value for name, value in vars(t).items() if name.isupper() and isinstance(value, str) and value[0] == "/"}
    assert names == set(t.TOPICS)
    for name, topic in t.TOPICS.items():
        assert topic.name == name
        assert message_class(topic.type).__msgtype__ == topic.type
        assert topic.input or topic.publisher, f"{name} comes from nowhere"


def test_only_what_is_said_once_is_latched():
    # a camera driver sends a calibration with every picture (interfaces.md, section 3: "camera or replay"): a stream
    assert {name for name, topic in t.TOPICS.items() if topic.latched} == {
        t.STEREO_REGISTRATION,
        t.FEM_MESH,
        t.TF_STATIC,
    }


@pytest.mark.parametrize("name", t.TOPICS)
def test_a_recording_offers_the_quality_of_the_table(name: str, tmp_path: Path):
    topic = t.TOPICS[name]
    with BagWriter(tmp_path / "x") as bag:
        bag.write(name, topic.type, 1, b"\x00\x01\x00\x00")
    information = yaml.safe_load((tmp_path / "x/metadata.yaml").read_text())["rosbag2_bagfile_information"]
    offered = information["topics_with_message_count"][0]["topic_metadata"]["offered_qos_profiles"]
    assert [profile["durability"] for profile in offered] == (["transient_local"] if topic.latched else [])


def test_nobody_else_says_what_type_a_topic_has():
    """A table of another file would disagree sooner or later, as those of the bags and of the graph once did."""
    pattern = re.compile(r"\bt\.[A-Z_]+: *\(?[\"'](sensor|geometry|std|visualization|diagnostic|tf2)_msgs/")
    for path in SRC.glob("**/*.py"):
        assert not pattern.search(path.read_text()), f"{path.relative_to(SRC)} has a table of topic types of its own"


def test_messages_of_every_type_can_be_written():
    assert encode(message_class(t.TRANSFORMS)([]))
