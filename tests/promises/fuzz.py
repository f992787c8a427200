"""Sound messages and files, and seeded changes of them: what a damaged disk, another program or an attacker may send.

A target reads one changed input and raises nothing but ``LivedeformError``; case ``k`` of a target is always the same.
"""

from __future__ import annotations

import shutil
import struct
import sys
from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

sys.path.insert(0, str(Path(__file__).parents[1] / "trust"))  # a small experiment and its recording

from situations import sound

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import _Collector, load_recording, to_image
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.recover import recover
from livedeform.common.bags.types import RawMessage, decode, encode, jazzy
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import LivedeformError
from livedeform.common.experiment.markers_file import read_markers
from livedeform.common.experiment.schema import Temperature
from livedeform.common.experiment.surface import read_mesh_boundary, read_surface
from livedeform.common.experiment.temperature_file import read_temperatures
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import CameraCalibration, Image, Pose, Wrench
from livedeform.inspection import inspect_bag
from livedeform.stereo_node.camera.calibration_file import read_camera, write_camera

Read = Callable[[np.random.Generator], None]

NUMBERS = (
    0,
    1,
    2,
    3,
    255,
    256,
    65_535,
    2**31 - 1,
    2**31,
    2**32 - 1,
    4_000_000_000,
    -1,
    -(2**31),
    2**63,
    -(2**63),
    10**400,
)
FLOATS = (0.0, -0.0, 1e-320, 1e300, -1e300, float("nan"), float("inf"), -float("inf"))
WORDS = ("", "x", "id", "mono16", "rgb8", "32FC1", "\0", "é" * 40, "../../etc")
LINES = (
    "~",
    "[]",
    "{}",
    "!!python/none x",
    "*a",
    "&a [*a]",
    "1e999",
    "0x1F",
    "2001-01-01",
    "9" * 4500,
    '"',
    "- 1",
    "<<: 3",
)


# --- changes


def changed_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes with some flipped, a stretch overwritten by a hostile number, cut off, doubled or inserted."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        if not out:
            break
        place, kind = int(rng.integers(len(out))), int(rng.integers(6))
        if kind == 0:
            out[place] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            number = int(rng.choice(np.array(NUMBERS[:11], object))) % 2**64
            wide = struct.pack("<Q", number)[: int(rng.choice([1, 2, 4, 8]))]
            out[place : place + len(wide)] = wide
        elif kind == 2:
            del out[place:]
        elif kind == 3:
            del out[place : place + int(rng.integers(1, 50))]
        elif kind == 4:
            out[place:place] = rng.bytes(int(rng.integers(1, 20)))
        else:
            out[place : place + 8] = struct.pack("<d", FLOATS[int(rng.integers(len(FLOATS)))])
    return bytes(out)


def changed_text(text: str, rng: np.random.Generator) -> bytes:
    """The text with a value of a line replaced, a line doubled or left out, or with changed bytes."""
    lines = text.splitlines()
    for _ in range(int(rng.integers(1, 3))):
        row, kind = int(rng.integers(len(lines))), int(rng.integers(4))
        word = str(rng.choice([*LINES, *WORDS, *map(str, NUMBERS), *map(str, FLOATS)]))
        if kind == 0 and ":" in lines[row]:
            lines[row] = lines[row].partition(":")[0] + ": " + word
        elif kind == 1:
            cells = lines[row].split(",")
            cells[int(rng.integers(len(cells)))] = word
            lines[row] = ",".join(cells)
        elif kind == 2:
            lines.insert(row, lines[int(rng.integers(len(lines)))])
        else:
            return changed_bytes(text.encode(), rng)
    return "\n".join(lines).encode()


def changed_message(message: Any, rng: np.random.Generator) -> Any:
    """The message object with one of its fields, however deep, set to what it must not be."""
    names = [f.name for f in fields(message) if not f.name.startswith("__")]
    name = str(rng.choice(names))
    return replace(message, **{name: _hostile(getattr(message, name), rng)})


def _hostile(value: Any, rng: np.random.Generator) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return changed_message(value, rng)
    if isinstance(value, list) and value:
        row = int(rng.integers(len(value)))
        return [*value[:row], _hostile(value[row], rng), *value[row + int(rng.integers(2)) :]]
    if isinstance(value, np.ndarray):
        return value[: int(rng.integers(len(value) + 1))] if rng.integers(2) else np.append(value, value)
    if isinstance(value, bool | np.bool_):
        return not value
    if isinstance(value, int):
        return NUMBERS[int(rng.integers(11))]
    if isinstance(value, float):
        return FLOATS[int(rng.integers(len(FLOATS)))]
    return str(rng.choice(WORDS))


# --- messages


def recorded(folder: Path) -> dict[str, RawMessage]:
    """A message of every topic that is read, from a small recording with pictures, cameras and a force."""
    case = sound(folder)
    case.write()
    picture = Image(5, np.arange(48 * 64, dtype=np.uint8).reshape(48, 64), "mono8", t.FRAME_LEFT)
    matrix, projection = np.diag([60.0, 60.0, 1.0]), np.eye(3, 4) * 60.0
    camera = CameraCalibration("left", 64, 48, matrix, np.zeros(5), np.eye(3), projection, "plumb_bob")
    path = folder / "all.mcap"
    with BagWriter(path) as bag:
        writer = RecordingWriter(bag)
        writer.marker_frame(case.frames[3])
        writer.marker_frame(case.frames[3], topic=t.FEM_MARKERS)
        writer.pose(case.poses[3])
        writer.wrench(Wrench(case.poses[3].stamp_ns, np.ones(3), np.ones(3)))
        writer.image(picture, t.LEFT_IMAGE)
        writer.compressed_image(picture, t.RIGHT_IMAGE)
        writer.camera_info(camera, 5, t.LEFT_CAMERA_INFO, t.FRAME_LEFT)
        pose = Pose(5, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
        writer.static_transforms({(t.FRAME_PHANTOM, t.FRAME_LEFT): pose}, 5)
    write_camera(camera, folder / "camera.yaml")
    with read_bag(path) as reader:
        return {raw.topic: raw for raw in reader.messages()}


def reads_message(raw: RawMessage) -> Read:
    """Reads changed messages as recordings do; what cannot be used must be counted and said."""

    def read(rng: np.random.Generator) -> None:
        changed = replace(raw, data=changed_bytes(raw.data, rng))
        if rng.integers(2):
            try:
                changed = replace(raw, data=encode(changed_message(decode(raw), rng)))
            except Exception:  # the serialiser's own: no such message can be sent
                return
        if raw.type in (t.IMAGE, t.COMPRESSED_IMAGE):
            to_image(changed)
            return
        collector = _Collector([])
        collector.take(changed)
        collector.take(raw)
        for topic in collector.items:
            collector.sorted(topic)
        collector.report()

    return read


# --- files


def reads_file(
    path: Path, change: Callable[[bytes, np.random.Generator], bytes], use: Callable[[Path], object]
) -> Read:
    """Writes changed bytes under the file's own name, in a folder of copies, and reads them."""
    data = path.read_bytes()

    def read(rng: np.random.Generator) -> None:
        path.write_bytes(change(data, rng))
        try:
            use(path)
        finally:
            path.write_bytes(data)

    return read


def _text(data: bytes, rng: np.random.Generator) -> bytes:
    return changed_text(data.decode(), rng)


def _use_bag(path: Path) -> None:
    """Looks at a bag, loads it, and recovers what is in it."""
    out = path.with_name("back.mcap")
    out.unlink(missing_ok=True)
    problems = []
    for use in (inspect_bag, load_recording, lambda p: recover(p, out)):
        try:
            use(path)
        except LivedeformError as error:
            problems.append(error)
    assert all("\n" not in str(problem) for problem in problems)


def sqlite_bag(folder: Path, messages: Iterable[RawMessage]) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    with Rosbag2Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        known = {}
        for raw in messages:
            if raw.topic not in known:
                known[raw.topic] = writer.add_connection(raw.topic, raw.type, typestore=jazzy())
            writer.write(known[raw.topic], raw.log_time_ns, raw.data)
    return next(folder.glob("*.db3"))


def _c3d(path: Path) -> Path:
    import ezc3d

    take = ezc3d.c3d()
    take["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    take["parameters"]["POINT"]["LABELS"]["value"] = ["a", "b"]
    take["data"]["points"] = np.random.default_rng(1).normal(size=(4, 2, 5))
    take.write(str(path))
    return path


def _stl(path: Path, *, binary: bool) -> Path:
    import trimesh

    box = trimesh.creation.box((0.04, 0.04, 0.03))
    data = trimesh.exchange.stl.export_stl(box) if binary else trimesh.exchange.stl.export_stl_ascii(box).encode()
    path.write_bytes(data)
    return path


TARGETS = (
    *(
        f"message of {topic}"
        for topic in (
            t.LEFT_IMAGE, t.RIGHT_COMPRESSED, t.LEFT_CAMERA_INFO, t.TF_STATIC, t.STEREO_MARKERS, t.FEM_MARKERS,
            t.PROBE_POSE, t.PROBE_WRENCH,
        )
    ),
    "experiment.yaml", "markers.csv", "temperature.csv", "camera.yaml", "MCAP", "sqlite", "STL", "STL as text", "VTU",
    "C3D",
)  # fmt: skip


def targets(folder: Path) -> dict[str, Read]:
    """Everything that reads something from outside, by name."""
    from livedeform.importing.c3d import read_c3d

    (folder / "messages").mkdir()
    messages = recorded(folder / "messages")
    found: dict[str, Read] = {f"message of {topic}": reads_message(raw) for topic, raw in messages.items()}
    inside = folder / "messages"
    (inside / "temperature.csv").write_text("time,temperature\n0,20\n1,21\n2,25\n")
    flip = changed_bytes
    files: dict[str, tuple[Path, Callable[[bytes, np.random.Generator], bytes], Callable[[Path], object]]] = {
        "experiment.yaml": (inside / "experiment.yaml", _text, load_experiment),
        "markers.csv": (inside / "markers.csv", _text, read_markers),
        "temperature.csv": (
            inside / "temperature.csv",
            _text,
            lambda path: read_temperatures(Temperature.model_construct(file=path, time=None, value=None)),
        ),
        "camera.yaml": (inside / "camera.yaml", _text, read_camera),
        "MCAP": (inside / "all.mcap", flip, _use_bag),
        "sqlite": (sqlite_bag(folder / "db", messages.values()), flip, _use_bag),
        "STL": (_stl(folder / "box.stl", binary=True), flip, read_surface),
        "STL as text": (_stl(folder / "text.stl", binary=False), _text, read_surface),
        "VTU": (inside / "block.vtu", flip, read_mesh_boundary),
        "C3D": (_c3d(folder / "take.c3d"), flip, read_c3d),
    }
    return found | {name: reads_file(*parts) for name, parts in files.items()}
