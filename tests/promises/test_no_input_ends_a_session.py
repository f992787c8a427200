"""No input ends a node or a session: what cannot be read is one line, or is counted and said."""

from __future__ import annotations

import os
import sqlite3
import zlib
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import fuzz
import numpy as np
import pytest

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.pictures import read_compressed_image
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.types import decode
from livedeform.common.errors import LivedeformError, RecordingError
from livedeform.inspection import inspect_bag

SEED = 20_240
DEFAULT, ALL = 220, 2000  # cases


def tried(folder: Path, n_cases: int, first: int = 0, only: str = "") -> tuple[Counter[str], list[str]]:
    """Every target in turn, or ``only`` one, ``n_cases`` in all: how many were refused, by target, and what else was
    raised."""
    targets = fuzz.targets(folder)
    assert tuple(targets) == fuzz.TARGETS
    names = [only] if only else list(targets)
    refused: Counter[str] = Counter()
    wrong = []
    for k in range(first, first + n_cases):
        name = names[k % len(names)]
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
@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_two_thousand_changed_messages_and_files_of_each_kind_are_read_or_refused(name: str, tmp_path: Path):
    refused, wrong = tried(tmp_path, ALL, first=DEFAULT, only=name)
    print(f"{name}: {ALL} cases, {refused[name]} refused, {len(wrong)} failures")
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


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE topics SET name = NULL WHERE id = 1",
        "UPDATE topics SET type = X'0102' WHERE id = 1",
        "UPDATE messages SET data = 3000000000 WHERE id = 1",
        "UPDATE messages SET data = 'text' WHERE id = 1",
        "UPDATE messages SET data = NULL WHERE id = 1",
        "UPDATE messages SET timestamp = 1.5 WHERE id = 1",
    ],
)
def test_a_database_with_other_things_in_its_columns_is_refused(change: str, tmp_path: Path):
    """Sqlite keeps anything anywhere; a number for bytes would be that many zeros."""
    (tmp_path / "messages").mkdir()
    path = fuzz.sqlite_bag(tmp_path / "db", fuzz.recorded(tmp_path / "messages").values())
    with sqlite3.connect(path) as database:
        database.execute("PRAGMA writable_schema = ON")
        text = "UPDATE sqlite_master SET sql = replace(replace(sql, 'NOT NULL', ''), 'INTEGER NOT', '')"
        database.execute(text)
    database.close()
    with sqlite3.connect(path) as database:
        database.execute(change)
    database.close()
    for use in (inspect_bag, load_recording):
        with pytest.raises(RecordingError) as raised:
            use(path)
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kind", ["a device", "a pipe"])
def test_what_is_neither_a_file_nor_a_folder_is_no_recording(kind: str, tmp_path: Path):
    """A pipe is not waited for."""
    path = Path(os.devnull) if kind == "a device" else tmp_path / "pipe"
    if kind == "a pipe":
        os.mkfifo(path)
    for use in (read_bag, load_recording, inspect_bag):
        with pytest.raises(RecordingError, match=f"{path}: is no recording; name a .mcap file"):
            use(path)


def test_a_picture_of_900_million_pixels_is_not_decoded():
    def part(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    size = (30_000).to_bytes(4, "big")
    head = part(b"IHDR", size + size + bytes([8, 2, 0, 0, 0]))
    png = b"\x89PNG\r\n\x1a\n" + head + part(b"IDAT", zlib.compress(bytes(1000))) + part(b"IEND", b"")
    message = SimpleNamespace(data=png, format="png", header=SimpleNamespace(frame_id=""))
    with pytest.raises(RecordingError, match=r"cannot be read|over 64 million"):
        read_compressed_image(message, 0)


def _nodes(folder: Path, name: str) -> tuple[Any, dict[str, Callable[[Any], None]]]:
    """A node and what it does with the messages of its topics."""
    from livedeform.common.ros import messages as m
    from livedeform.compare_node.node import CompareNode
    from livedeform.fem_node.node import FemNode
    from livedeform.stereo_node.node import StereoNode

    given = {"experiment": str(folder)}
    if name == "compare_node":
        compare = CompareNode(given | {"stale_after": 0.0})
        return compare, {t.STEREO_MARKERS: compare.on_measured, t.FEM_MARKERS: compare.on_predicted}
    if name == "fem_node":  # every pose is answered, before the handler returns
        fem = FemNode(given | {"newest_only": False})
        return fem, {t.PROBE_POSE: fem.on_pose, t.STEREO_MARKERS: fem.on_measured}
    stereo = StereoNode(given | {"model_prior": True})

    def on_pair(message: Any) -> None:
        stereo.on_picture(stereo.pairs.add_left, message)
        stereo.on_picture(stereo.pairs.add_right, message)

    def on_prediction(message: Any) -> None:
        stereo._prior.add(m.from_predicted_markers(message))

    others = {t.FEM_MARKERS: on_prediction, t.STEREO_MARKERS: stereo.on_markers}
    return stereo, {t.LEFT_IMAGE: on_pair} | others | {t.LEFT_CAMERA_INFO: partial(stereo.on_camera, "left")}


def live_through(name: str, folder: Path, n: int) -> None:
    """What the node cannot use becomes an error for its status topic; what follows is worked on."""
    pytest.importorskip("rclpy")
    from livedeform.common.ros.session import ros
    from livedeform.run.running import isolated

    (folder / "sound").mkdir()
    messages = fuzz.recorded(folder / "sound")
    refused = 0
    with isolated(), ros([], handle_signals=False):
        node, handlers = _nodes(folder / "sound", name)
        sound = {topic: decode(messages[topic]) for topic in handlers}
        for k in range(n):
            topic = list(handlers)[k % len(handlers)]
            try:
                handlers[topic](fuzz.changed_message(sound[topic], np.random.default_rng([SEED, k])))
            except LivedeformError as error:
                refused += 1
                assert "\n" not in str(error)
        for topic, handle in handlers.items():
            handle(sound[topic])
        node.finish()
        assert refused > 0.1 * n
        node.destroy_node()


NODES = {"compare_node": 150, "stereo_node": 150, "fem_node": 40}


@pytest.mark.parametrize("name", NODES)
def test_a_node_lives_through_changed_messages(name: str, tmp_path: Path):
    live_through(name, tmp_path, NODES[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", NODES)
def test_a_node_lives_through_2000_changed_messages(name: str, tmp_path: Path):
    live_through(name, tmp_path, 2000)


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
