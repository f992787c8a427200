"""Messages that are read together give what they give one by one, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from livedeform.common import topics as t
from livedeform.common.bags import alike
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import Recording, load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import RawMessage
from livedeform.common.bags.write import BagWriter
from livedeform.common.types import MarkerFrame, Pose, Wrench

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000


def write_messages(writer: RecordingWriter, rng: np.random.Generator, n: int) -> None:
    """Poses and wrenches, and frames of 0 to 5 markers in several frames of reference, with odd covariances."""
    for k in range(n):
        stamp_ns = START_NS + k * STEP_NS
        writer.pose(Pose(stamp_ns, rng.normal(size=3), rng.normal(size=4)))
        writer.wrench(Wrench(stamp_ns, rng.normal(size=3), rng.normal(size=3)))
        m = int(rng.integers(0, 6))
        A = rng.normal(size=(m, 3, 3)) * 10.0 ** rng.integers(-9, 2)
        covariances = A @ A.transpose(0, 2, 1)
        if k % 7 == 0:
            covariances = np.where(rng.random(covariances.shape) < 0.2, rng.choice([np.nan, -1.0, np.inf]), covariances)
        ids = rng.permutation(5)[:m].astype(np.uint32)
        frame = MarkerFrame(stamp_ns, ids, rng.normal(size=(m, 3)), covariances, rng.random(m))
        writer.marker_frame(frame, frame_id="phantom" if k % 5 else "elsewhere")


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """The message with some bytes changed, in its stamp, its head or its values, or cut."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        changed[int(rng.integers(0, len(changed)))] ^= int(rng.integers(1, 256))
    return bytes(changed[: int(rng.integers(1, len(changed)))] if rng.random() < 0.2 else changed)


def recorded(path: Path, *, damage: float, n: int = 400) -> Path:
    rng = np.random.default_rng(5)
    with BagWriter(path.with_name("sound.mcap")) as bag:
        write_messages(RecordingWriter(bag), rng, n)
    with read_bag(path.with_name("sound.mcap")) as sound, BagWriter(path) as bag:
        for raw in sound.messages():
            data = damaged(raw.data, rng) if rng.random() < damage else raw.data
            bag.write(raw.topic, raw.type, raw.log_time_ns, data)
    return path


def none(raws: Sequence[RawMessage], type_name: str) -> list[alike.Alike]:
    return []


def content(recording: Recording) -> dict[str, object]:
    """Everything that a recording holds, with arrays as bytes."""

    def plain(value: object) -> object:
        if isinstance(value, np.ndarray):
            return (value.dtype.str, value.shape, value.tobytes())
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        if hasattr(value, "__dataclass_fields__"):
            return [plain(getattr(value, f.name)) for f in fields(value)]
        return value

    return {f.name: plain(getattr(recording, f.name)) for f in fields(recording)}


@pytest.mark.parametrize("damage", [0.0, 0.05, 0.9])
def test_together_and_one_by_one_are_the_same(damage: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    bag = recorded(tmp_path / "x.mcap", damage=damage)
    together = load_recording(bag)
    monkeypatch.setattr(alike, "groups", none)
    alone = load_recording(bag)
    assert sorted(together.warnings) == sorted(alone.warnings)
    said = {"warnings": sorted(alone.warnings)}
    assert content(together) | said == content(alone) | said
    assert len(together.poses) > 50 and bool(together.faults["covariance"])


def test_most_messages_are_read_together(tmp_path: Path):
    """Of other types than the topic's, or of other definitions, none."""
    with read_bag(recorded(tmp_path / "x.mcap", damage=0.0)) as bag:
        for topic in (t.PROBE_POSE, t.PROBE_WRENCH, t.STEREO_MARKERS):
            raws, kind = list(bag.messages([topic])), t.TOPICS[topic].type
            n = sum(len(found.rows) for found in alike.groups(raws, kind))
            assert n > 0.4 * len(raws) and (n == len(raws) or topic == t.STEREO_MARKERS)
            assert not list(alike.groups([replace(raw, type=t.FLOAT64) for raw in raws], kind))
            other = replace(raws[0].definition, text=raws[0].definition.text.replace("float64", "float32"))
            changed = [replace(raw, definition=other) for raw in raws]
            assert topic == t.STEREO_MARKERS or not list(alike.groups(changed, kind))
