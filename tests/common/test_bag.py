"""Bags: what others recorded is read as it comes, what we write opens elsewhere, what was torn comes back."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recover import recover
from livedeform.common.bags.types import TypeDefinition, decode, encode, message_class
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import RecordingError

FLOAT = "std_msgs/msg/Float64"


def number(value: float) -> bytes:
    return encode(message_class(FLOAT)(float(value)))


def write_numbers(path: Path, n: int = 100, **options) -> Path:
    with BagWriter(path, {"seed": "3"}, **options) as bag:
        for k in range(n):
            bag.write(f"/n{k % 2}", FLOAT, 1000 + k, number(k))
    return path


def read_numbers(path: Path) -> list[float]:
    with read_bag(path) as bag:
        return [decode(raw).data for raw in bag.messages()]


# --- what others recorded --------------------------------------------------------------------------------------------


def test_split_folder_is_read_in_the_order_of_time(public_data):
    with read_bag(public_data / "bags/wbag") as bag:
        times = [raw.log_time_ns for raw in bag.messages()]
        assert bag.n_messages == len(times) == 6074
        assert times == sorted(times)
        assert (bag.start_ns, bag.end_ns) == (1000, 2998)
        assert bag.topics["HHH"].count == 726
        assert bag.warnings == []


def test_plain_mcap_folder(public_data):
    with read_bag(public_data / "bags/cdr_test") as bag:
        first = next(bag.messages(["/test_topic"]))
        assert decode(first).int32_value is not None
        assert {name: info.count for name, info in bag.topics.items()} == {"/test_topic": 3, "/array_topic": 4}


@pytest.mark.parametrize("name", ["bags/talker_sqlite3", "bags/talker_sqlite3/talker.db3"])
def test_sqlite3(public_data, name):
    """rosbags' own folder reader gives none of the 20 messages: QoS differs between metadata.yaml and the database."""
    with read_bag(public_data / name) as bag:
        texts = [decode(raw).data for raw in bag.messages(["/topic"])]
        logs = [decode(raw).msg for raw in bag.messages(["/rosout"])]  # its stored definition is a placeholder
    assert texts[0] == "Hello, world! 0" and len(texts) == 10
    assert logs[0] == "Publishing: 'Hello, world! 0'" and len(logs) == 10


def test_a_service_event_is_skipped_with_a_warning(public_data):
    with read_bag(public_data / "bags/topics_and_services.mcap") as bag:
        read = [decode(raw) for raw in bag.messages()]
        assert len(read) == bag.topics["/parameter_events"].count == 7
        assert bag.topics["/add_two_ints/_service_event"].problem
        assert any("/add_two_ints/_service_event is skipped" in line for line in bag.warnings)
        assert all("\n" not in line for line in bag.warnings)


def test_a_schema_without_a_package_is_skipped_with_a_warning(public_data):
    with read_bag(public_data / "bags/eprosima_ros2_talker.mcap") as bag:
        chatter = [decode(raw).data for raw in bag.messages(["/chatter"])]
        assert len(chatter) == 10
        assert len([decode(raw) for raw in bag.messages()]) == 20
        assert any("/ddsrecorder/status is skipped" in line for line in bag.warnings)


@pytest.mark.parametrize("make", [lambda p: p / "none.mcap", lambda p: p])
def test_nothing_there(tmp_path, make):
    with pytest.raises(RecordingError, match=r"does not exist|there is no bag"):
        read_bag(make(tmp_path))


def test_files_that_are_no_bags(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"")
    (tmp_path / "b.mcap").write_bytes(b"not a bag at all")
    (tmp_path / "c.bag").write_bytes(b"#ROSBAG V2.0\n")
    (tmp_path / "d.db3").write_bytes(b"nothing")
    for name, says in (("a", "is empty"), ("b", "is not an MCAP"), ("c", "ROS 1"), ("d", "cannot be read")):
        with pytest.raises(RecordingError, match=says):
            read_bag(next(tmp_path.glob(f"{name}.*")))


# --- what we write ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("name", ["x.mcap", "x"])
def test_written_bags_are_read_by_us_and_by_rosbags(tmp_path, name, compression):
    path = write_numbers(tmp_path / name, compression=compression)
    assert read_numbers(path) == list(range(100))
    with read_bag(path) as bag:
        assert bag.metadata["seed"] == "3"
        assert [raw.log_time_ns for raw in bag.messages(start_ns=1010, stop_ns=1020)] == list(range(1010, 1020))
        assert bag.topics["/n1"].count == 50
    with AnyReader([path]) as other:
        values = [other.deserialize(data, connection.msgtype).data for connection, _, data in other.messages()]
    assert values == list(range(100))


def test_metadata_of_the_folder_is_that_of_jazzy(tmp_path):
    with BagWriter(tmp_path / "x") as bag:
        bag.write("/n", FLOAT, 5, number(1))
        kind = message_class("tf2_msgs/msg/TFMessage")
        bag.write(t.TF_STATIC, "tf2_msgs/msg/TFMessage", 7, encode(kind([])))
    information = yaml.safe_load((tmp_path / "x/metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["message_count"] == 2
    assert information["starting_time"]["nanoseconds_since_epoch"] == 5
    assert information["duration"]["nanoseconds"] == 2
    assert information["relative_file_paths"] == ["x_0.mcap"]
    latched = information["topics_with_message_count"][1]["topic_metadata"]
    assert latched["offered_qos_profiles"][0]["durability"] == "transient_local"
    assert latched["type_description_hash"].startswith("RIHS01_")


def test_a_bag_is_never_overwritten(tmp_path):
    for name in ("x.mcap", "x"):
        write_numbers(tmp_path / name)
        with pytest.raises(RecordingError, match="exists already"):
            BagWriter(tmp_path / name)
        assert len(read_numbers(tmp_path / name)) == 100


def test_an_empty_bag_is_sound(tmp_path):
    with BagWriter(tmp_path / "x"):
        pass
    with read_bag(tmp_path / "x") as bag:
        assert bag.n_messages == 0 and (bag.start_ns, bag.end_ns) == (0, 0)


def test_a_conversion_that_fails_leaves_nothing(tmp_path):
    for name in ("x.mcap", "x"):
        with pytest.raises(ZeroDivisionError), BagWriter(tmp_path / name, atomic=True) as bag:
            bag.write("/n", FLOAT, 1, number(1))
            raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_live_recording_that_is_interrupted_is_sound(tmp_path):
    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / "x.mcap") as bag:
        bag.write("/n", FLOAT, 1, number(4))
        raise KeyboardInterrupt
    assert read_numbers(tmp_path / "x.mcap") == [4.0]


def test_foreign_types_are_copied_with_their_definition(tmp_path):
    text = TypeDefinition("ros2msg", "float64 depth\nstring unit")
    data = b"\x00\x01\x00\x00" + np.float64(2.5).tobytes() + b"\x03\x00\x00\x00mm\x00"
    with BagWriter(tmp_path / "x.mcap") as bag:
        bag.write("/d", "my_msgs/msg/Depth", 1, data, text)
        with pytest.raises(RecordingError, match="unknown"):
            bag.write("/e", "my_msgs/msg/Other", 1, data)
    with read_bag(tmp_path / "x.mcap") as bag:
        message = decode(next(bag.messages()))
    assert (message.depth, message.unit) == (2.5, "mm")


def test_a_damaged_message_is_reported_not_guessed(tmp_path):
    with BagWriter(tmp_path / "x.mcap") as bag:
        bag.write("/n", FLOAT, 1, b"\x00\x01\x00\x00\x00")
    with read_bag(tmp_path / "x.mcap") as bag, pytest.raises(RecordingError, match="cannot be decoded"):
        decode(next(bag.messages()))


# --- what was torn ---------------------------------------------------------------------------------------------------


def torn_in_chunks(path: Path, n: int = 200, per_chunk: int = 20) -> Path:
    with BagWriter(path, {"seed": "3"}, compression="lz4") as bag:
        for k in range(n):
            bag.write("/n", FLOAT, k, number(k))
            if k % per_chunk == per_chunk - 1:
                bag.flush()
    return path


def test_truncation_at_any_place_loses_at_most_the_last_chunk(tmp_path):
    whole = torn_in_chunks(tmp_path / "whole.mcap").read_bytes()
    counts = []
    for i, size in enumerate(np.linspace(0, len(whole), 60).astype(int)):
        torn = tmp_path / f"torn{i}.mcap"
        torn.write_bytes(whole[:size])
        if size < len(whole):
            with pytest.raises(RecordingError):
                read_bag(torn)
        try:
            report = recover(torn, tmp_path / f"back{i}.mcap")
        except RecordingError as error:
            assert "no message could be recovered" in str(error)
            counts.append(0)
            continue
        values = read_numbers(tmp_path / f"back{i}.mcap")
        assert values == list(range(report.n_messages))
        counts.append(report.n_messages)
    assert counts == sorted(counts)
    assert set(counts) == set(range(0, 201, 20))
    assert not list(tmp_path.glob("*.partial"))


def test_a_damaged_chunk_is_left_out_and_the_rest_kept(tmp_path):
    data = bytearray(torn_in_chunks(tmp_path / "whole.mcap").read_bytes())
    data[len(data) // 2 - 40] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(bytes(data[: len(data) * 3 // 4]))
    report = recover(tmp_path / "bad.mcap", tmp_path / "back.mcap")
    assert report.n_bad_chunks <= 1
    assert 0 < report.n_messages < 200
    assert set(read_numbers(tmp_path / "back.mcap")) <= set(range(200))


def test_recovery_keeps_metadata_and_refuses_to_overwrite(tmp_path):
    path = torn_in_chunks(tmp_path / "whole.mcap")
    recover(path, tmp_path / "back.mcap")
    with read_bag(tmp_path / "back.mcap") as bag:
        assert bag.metadata["seed"] == "3"
    with pytest.raises(RecordingError, match="exists already"):
        recover(path, tmp_path / "back.mcap")


def test_a_killed_recorder_leaves_all_that_was_flushed(tmp_path):
    """kill -9 in the middle of writing: everything up to the last flush comes back."""
    script = """
        import sys, time
        from livedeform.common.bags.types import encode, message_class
        from livedeform.common.bags.write import BagWriter
        kind = message_class("std_msgs/msg/Float64")
        bag = BagWriter(sys.argv[1])
        for k in range(1000):
            bag.write("/n", "std_msgs/msg/Float64", k, encode(kind(float(k))))
            if k == 899:
                bag.flush()
        print("written", flush=True)
        time.sleep(60)
    """
    path = tmp_path / "killed.mcap"
    child = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script), str(path)], stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdout.readline() == b"written\n"
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    child.stdout.close()
    with pytest.raises(RecordingError, match="livedeform recover"):
        read_bag(path)
    assert recover(path, tmp_path / "back").n_messages >= 900
    assert read_numbers(tmp_path / "back")[:900] == list(range(900))


@pytest.mark.parametrize("mode", ["file", "message"])
@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_compressed_folders_of_others_are_read(tmp_path, storage, mode):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    writer = Writer(tmp_path / "x", version=9, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/n", FLOAT, typestore=get_typestore(Stores.ROS2_JAZZY))
        for k in range(10):
            writer.write(connection, k, number(k))
    assert read_numbers(tmp_path / "x") == list(range(10))


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_damaged_bytes_are_refused_or_read_but_never_crash(tmp_path, rng, request, kind):
    """40 files with 1 to 3 changed bytes, every fourth cut off, too; 800 were tried once."""
    if kind == "mcap":
        whole = torn_in_chunks(tmp_path / "whole.mcap").read_bytes()
    else:
        whole = (request.getfixturevalue("public_data") / "bags/talker_sqlite3/talker.db3").read_bytes()
    for i in range(40):
        data = bytearray(whole)
        for place in rng.integers(len(data), size=rng.integers(1, 4)):
            data[place] = rng.integers(256)
        path = tmp_path / f"damaged{i}.{kind}"
        path.write_bytes(bytes(data[: rng.integers(len(data))] if i % 4 == 0 else data))
        try:
            with read_bag(path) as bag:
                for raw in bag.messages():
                    decode(raw)
        except RecordingError as error:
            assert "\n" not in str(error)
