"""No input ends a node or a session: what cannot be read is one line, or is counted and said."""

from __future__ import annotations

import zlib
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import fuzz
import numpy as np
import pytest

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.pictures import read_compressed_image
from livedeform.common.bags.types import decode
from livedeform.common.errors import LivedeformError, RecordingError

SEED = 20_240
DEFAULT, ALL = 220, 2000  # cases


def tried(folder: Path, n_cases: int, first: int = 0) -> tuple[Counter[str], list[str]]:
    """Every target in turn, ``n_cases`` in all: how many were refused, by target, and what else was raised."""
    targets = fuzz.targets(folder)
    refused: Counter[str] = Counter()
    wrong = []
    for k in range(first, first + n_cases):
        name = list(targets)[k % len(targets)]
        try:
            targets[name](np.random.default_rng([SEED, k]))
        except LivedeformError as error:
            refused[name] += 1
            if "\n" in str(error) or not str(error):
                wrong.append(f"case {k}, {name}: {error!s} is not one line")
        except Exception as error:
            wrong.append(f"case {k}, {name}: {type(error).__name__}: {str(error)[:200]}")
    return refused, wrong


@pytest.mark.filterwarnings("ignore")
def test_changed_messages_and_files_are_read_or_refused(tmp_path: Path):
    refused, wrong = tried(tmp_path, DEFAULT)
    assert not wrong, "\n".join(wrong)
    assert refused.total() > DEFAULT // 8  # the changes do damage


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_two_thousand_changed_messages_and_files_are_read_or_refused(tmp_path: Path):
    _, wrong = tried(tmp_path, ALL, first=DEFAULT)
    assert not wrong, "\n".join(wrong)


# --- the cases that were seen


def cloud(**changes: Any) -> SimpleNamespace:
    """A sound PointCloud2 of two points, with ``changes``."""
    rows = layouts.pack(layouts.FEM_MARKERS, points=np.ones((2, 3)), id=np.array([1, 2], np.uint32))
    listed = [
        SimpleNamespace(name=row.name, offset=row.offset, datatype=row.datatype, count=1)
        for row in layouts.field_rows(rows.dtype)
    ]
    sound = {
        "height": 1, "width": 2, "fields": listed, "is_bigendian": False, "point_step": 16, "row_step": 32,
        "data": np.frombuffer(rows.tobytes(), np.uint8),
    }  # fmt: skip
    return SimpleNamespace(**{**sound, **changes})


def with_field(**changes: Any) -> list[SimpleNamespace]:
    listed = cloud().fields
    return [*listed[:-1], SimpleNamespace(**{**vars(listed[-1]), **changes})]


CLOUDS = {
    "datatype 0": {"fields": with_field(datatype=0)},
    "datatype 9": {"fields": with_field(datatype=9)},
    "point_step 0": {"point_step": 0},
    "point_step 4e9": {"point_step": 4_000_000_000},
    "an offset beyond the point": {"fields": with_field(offset=14)},
    "an offset of 4e9": {"fields": with_field(offset=4_000_000_000)},
    "a count of 4e9": {"fields": with_field(count=4_000_000_000)},
    "a vector for an id": {"fields": with_field(count=2, offset=8)},
    "a field twice": {"fields": with_field(name="x")},
    "a field without a name": {"fields": with_field(name="")},
    "no id": {"fields": with_field(name="i")},
    "ids that are floats of no whole number": {"fields": with_field(datatype=7)},
    "4e9 points": {"width": 4_000_000_000},
    "4e9 lines": {"height": 4_000_000_000},
    "lines that overlap": {"height": 2, "width": 1, "row_step": 3},
    "no data": {"data": np.zeros(0, np.uint8)},
}


@pytest.mark.parametrize("name", CLOUDS)
def test_a_cloud_that_contradicts_itself_is_refused(name: str):
    sound = layouts.unpack(cloud())
    assert layouts.ids(sound).tolist() == [1, 2] and (layouts.points(sound) == 1.0).all()
    with pytest.raises(RecordingError) as raised:
        rows = layouts.unpack(cloud(**CLOUDS[name]))
        layouts.ids(rows)
    assert "\n" not in str(raised.value)


def test_a_picture_of_900_million_pixels_is_not_decoded():
    def part(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    size = (30_000).to_bytes(4, "big")
    head = part(b"IHDR", size + size + bytes([8, 2, 0, 0, 0]))
    png = b"\x89PNG\r\n\x1a\n" + head + part(b"IDAT", zlib.compress(bytes(1000))) + part(b"IEND", b"")
    message = SimpleNamespace(data=png, format="png", header=SimpleNamespace(frame_id=""))
    with pytest.raises(RecordingError, match=r"cannot be read|over 64 million"):
        read_compressed_image(message, 0)


def test_a_node_lives_through_changed_messages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What compare_node cannot use becomes an error for its status topic; what follows is compared."""
    pytest.importorskip("rclpy")
    from livedeform.common.ros.session import ros
    from livedeform.compare_node.node import CompareNode
    from livedeform.run.running import isolated

    (tmp_path / "sound").mkdir()
    messages = fuzz.recorded(tmp_path / "sound")
    measured, predicted = decode(messages[t.STEREO_MARKERS]), decode(messages[t.FEM_MARKERS])
    refused = 0
    with isolated(), ros([], handle_signals=False):
        node = CompareNode({"experiment": str(tmp_path / "sound"), "stale_after": 0.0})
        for k in range(150):
            rng = np.random.default_rng([SEED, k])
            handle, message = [(node.on_measured, measured), (node.on_predicted, predicted)][k % 2]
            try:
                handle(fuzz.changed_message(message, rng))
            except LivedeformError:
                refused += 1
        before = node.associator.counts.matched_frames
        node.on_measured(measured)
        node.on_predicted(predicted)
        node.finish()
        assert refused > 20 and node.associator.counts.matched_frames >= before
        node.destroy_node()


def test_simulated_time_without_a_clock_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("rclpy")
    from livedeform.common.ros.session import ros
    from livedeform.compare_node.node import CompareNode
    from livedeform.run.graph import Graph
    from livedeform.run.running import isolated

    fuzz.sound(tmp_path).write()
    monkeypatch.setattr("livedeform.common.ros.node.CLOCK_SECONDS", 0.1)
    said: list[str] = []
    monkeypatch.setattr(CompareNode, "status", lambda self, stamp_ns, level, message, values=None: said.append(message))
    with isolated(), ros([], handle_signals=False) as stop:
        node = CompareNode({"experiment": str(tmp_path), "use_sim_time": True})
        with Graph([node], stop) as graph:
            for _ in range(100):
                graph.spin_once(0.05)
                if said:
                    break
    assert len(said) == 1 and "/clock" in said[0]
