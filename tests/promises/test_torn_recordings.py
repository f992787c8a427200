"""Everything before a tear comes back: cut anywhere, a recording gives every message that was complete."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from livedeform.common import topics as t
from livedeform.common.bags import write
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recover import recover
from livedeform.common.bags.types import encode, message_class
from livedeform.common.bags.write import CHUNK_BYTES, BagWriter
from livedeform.common.errors import RecordingError


def payloads(n: int, largest: int = 3000) -> list[bytes]:
    """Messages of many lengths that occur nowhere else in a file."""
    rng = np.random.default_rng(3)
    return [b"\x00\x01\x00\x00" + rng.bytes(int(rng.integers(20, largest))) for _ in range(n)]


def recorded(path: Path, messages: list[bytes], compression: str = "none", per_chunk: int | None = None) -> bytes:
    """The bytes of a recording of ``messages``, by turns poses and pictures, which have chunks of their own: both ended
    after ``per_chunk`` messages, or as the writer cuts them."""
    with BagWriter(path, {"made_by": "tests"}, compression=compression) as bag:
        for k, data in enumerate(messages):
            bag.write(t.LEFT_COMPRESSED if k % 2 else t.PROBE_POSE, t.COMPRESSED_IMAGE, 1000 + k, data)
            if per_chunk and k % per_chunk == per_chunk - 1:
                bag.flush()
    return path.read_bytes()


def recovered(folder: Path, torn: bytes) -> list[bytes]:
    """What `recover` brings back, in the order of the receive times."""
    source, out = folder / "torn.mcap", folder / "back.mcap"
    source.write_bytes(torn)
    out.unlink(missing_ok=True)
    try:
        recover(source, out)
    except RecordingError as error:
        assert "no message could be recovered" in str(error)
        return []
    with read_bag(out) as bag:
        return [raw.data for raw in bag.messages()]


@pytest.mark.parametrize("per_chunk", [7, None])
def test_a_cut_at_every_record_and_at_random_bytes_loses_only_what_was_not_complete(
    per_chunk: int | None, tmp_path: Path
):
    messages = payloads(60)
    whole = recorded(tmp_path / "whole.mcap", messages, per_chunk=per_chunk)
    ends = np.array([whole.index(data) + len(data) for data in messages])  # a message's record ends with its data
    random = np.random.default_rng(4).integers(0, len(whole), 200)
    places = sorted({*ends.tolist(), *(ends - 1).tolist(), *random.tolist()})
    for place in places:
        complete = [data for data, end in zip(messages, ends, strict=True) if end <= place]
        assert recovered(tmp_path, whole[:place]) == complete, place


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_of_a_torn_compressed_chunk_comes_back_what_can_be_decompressed(compression: str, tmp_path: Path):
    """A block of a frame is decoded when it is whole: of 64 kB (lz4) or 128 kB (zstd)."""
    messages = payloads(250)
    whole = recorded(tmp_path / "whole.mcap", messages, compression)
    counts = []
    for place in np.linspace(0, len(whole), 40).astype(int):
        back = recovered(tmp_path, whole[:place])
        for kind in (messages[::2], messages[1::2]):
            of_it = [data for data in back if data in kind]
            assert of_it == kind[: len(of_it)]
        counts.append(len(back))
        written = sum(len(data) for data in back)
        assert written > place - 140_000
    assert counts[-1] == 250 and counts == sorted(counts)
    assert len(set(counts)) > 2 * len(whole) // CHUNK_BYTES


def test_a_long_recording_is_written_in_small_chunks(tmp_path: Path):
    """What a crash can take is one chunk: nothing that is written has larger ones than its largest message."""
    messages = payloads(400, 20_000)
    recorded(tmp_path / "whole.mcap", messages)
    with read_bag(tmp_path / "whole.mcap") as bag:
        summary = bag._parts[0].reader.get_summary()  # type: ignore[union-attr]
    assert summary is not None and len(summary.chunk_indexes) >= sum(map(len, messages)) / (CHUNK_BYTES + 20_000)
    assert max(index.uncompressed_size for index in summary.chunk_indexes) < CHUNK_BYTES + 25_000 <= 300_000


def test_every_chunk_before_and_after_a_damaged_one_comes_back(tmp_path: Path):
    messages = payloads(60)
    whole = bytearray(recorded(tmp_path / "whole.mcap", messages, per_chunk=10))
    place = whole.index(messages[33])
    whole[place + 8] ^= 0xFF
    lost = messages[31:40:2]  # the pictures of that chunk
    assert recovered(tmp_path, bytes(whole)) == [data for data in messages if data not in lost]


def test_poses_are_read_without_the_pictures_between_them(tmp_path: Path):
    """In the order of their receive times, whatever chunks they are in; a damaged picture does not matter to them."""
    messages = payloads(300, 20_000)
    whole = bytearray(recorded(tmp_path / "whole.mcap", messages, per_chunk=40))
    with read_bag(tmp_path / "whole.mcap") as bag:
        assert [raw.data for raw in bag.messages()] == messages
        assert [raw.data for raw in bag.messages(start_ns=1100, stop_ns=1111)] == messages[100:111]
    whole[whole.index(messages[33]) + 8] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(whole)
    with read_bag(tmp_path / "damaged.mcap") as bag:
        assert [raw.data for raw in bag.messages([t.PROBE_POSE])] == messages[::2]
        with pytest.raises(RecordingError, match=r"is damaged .*checksum"):
            list(bag.messages([t.LEFT_COMPRESSED]))


def test_a_message_received_after_2262_is_left_out_and_said(tmp_path: Path):
    data = encode(message_class(t.FLOAT64)(1.0))
    with BagWriter(tmp_path / "x.mcap") as bag:
        for log_time_ns in (5, 2**63, 7, 2**64 - 1):
            bag.write(t.COMPARE_RMSE, t.FLOAT64, log_time_ns, data)
    with read_bag(tmp_path / "x.mcap") as bag:
        assert [raw.log_time_ns for raw in bag.messages()] == [5, 7]
        assert (bag.start_ns, bag.end_ns, bag.n_messages) == (5, 7, 2)
        assert any("2 messages are left out" in line for line in bag.warnings)


def test_the_memory_of_a_recording_does_not_grow_with_its_length(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A chunk for each message, as of pictures: the index is whole, and is not kept in memory meanwhile."""
    monkeypatch.setattr(write, "CHUNK_BYTES", 100)
    data = b"\0\1\0\0" + bytes(200)
    n = 4000
    with write.BagWriter(tmp_path / "long.mcap") as bag:
        for k in range(100):
            bag.write("/a", "std_msgs/msg/Float64", k, data)
        tracemalloc.start()
        before = tracemalloc.get_traced_memory()[0]
        for k in range(100, n):
            bag.write("/a", "std_msgs/msg/Float64", k, data)
        grown = tracemalloc.get_traced_memory()[0] - before
        tracemalloc.stop()
    assert grown < 20 * n  # bytes; 480 for each chunk in mcap's own list
    with (tmp_path / "long.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None and len(summary.chunk_indexes) == n
    with read_bag(tmp_path / "long.mcap") as reader:
        assert [raw.log_time_ns for raw in reader.messages(start_ns=7, stop_ns=10)] == [7, 8, 9]
