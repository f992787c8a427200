"""MB/s into a bag: our writer against the bare mcap writer, and reading back, in one run.

    python benchmarks/bag_writer.py [--megabytes 300]

Payload: noisy 1280 x 720 mono8 pictures with a marker cloud each, as a stereo recording has them. CPU seconds of this
process, so that other work on the machine does not count; written to a temporary folder.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import RawMessage
from livedeform.common.bags.write import COMPRESSIONS, BagWriter
from livedeform.common.types import Image, MarkerFrame

CHUNK = 1 << 20


def payload(folder: Path, n: int) -> list[RawMessage]:
    """``n`` pictures and clouds, serialised."""
    rng = np.random.default_rng(0)
    pixels = rng.normal(110, 4, (8, 720, 1280)).clip(0, 255).astype(np.uint8)
    path = folder / "payload.mcap"
    with BagWriter(path) as bag:
        writer = RecordingWriter(bag)
        for k in range(n):
            writer.image(Image(k, pixels[k % 8], "mono8", t.FRAME_LEFT), t.LEFT_IMAGE)
            cloud = MarkerFrame(
                k, np.arange(60, dtype=np.uint32), rng.random((60, 3)), np.ones((60, 3, 3)), np.ones(60)
            )
            writer.marker_frame(cloud)
    with read_bag(path) as reader:
        return list(reader.messages())


def ours(path: Path, messages: list[RawMessage], compression: str) -> None:
    with BagWriter(path, compression=compression) as bag:
        for raw in messages:
            bag.write(raw.topic, raw.type, raw.log_time_ns, raw.data, raw.definition)


def bare(path: Path, messages: list[RawMessage], compression: str) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK, compression=COMPRESSIONS[compression])
        writer.start(profile="ros2", library="bare")
        channels: dict[str, int] = {}
        for raw in messages:
            if raw.topic not in channels:
                schema = writer.register_schema(raw.type, raw.definition.encoding, raw.definition.text.encode())
                channels[raw.topic] = writer.register_channel(raw.topic, "cdr", schema)
            writer.add_message(channels[raw.topic], raw.log_time_ns, raw.data, raw.log_time_ns)
        writer.finish()


def read(path: Path, messages: list[RawMessage], compression: str) -> None:
    with read_bag(path) as bag:
        assert sum(1 for _ in bag.messages()) == len(messages)


def cpu_seconds(work: Callable[[Path, list[RawMessage], str], None], path: Path, *arguments: Any) -> float:
    """The better of three runs."""
    best = float("inf")
    for _ in range(3):
        if work is not read:
            path.unlink(missing_ok=True)
        began = time.process_time()
        work(path, *arguments)
        best = min(best, time.process_time() - began)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=300.0)
    options = parser.parse_args()
    print(f"{'compression':13}{'ours MB/s':>11}{'mcap MB/s':>11}{'ours/mcap':>11}{'read MB/s':>11}{'size':>7}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        messages = payload(folder, max(round(options.megabytes / 0.9216), 1))
        megabytes = sum(len(raw.data) for raw in messages) / 1e6
        for compression in COMPRESSIONS:
            a, b = folder / f"ours_{compression}.mcap", folder / f"bare_{compression}.mcap"
            seconds_ours = cpu_seconds(ours, a, messages, compression)
            seconds_bare = cpu_seconds(bare, b, messages, compression)
            seconds_read = cpu_seconds(read, a, messages, compression)
            speeds = [megabytes / s for s in (seconds_ours, seconds_bare, seconds_read)]
            size = a.stat().st_size / 1e6 / megabytes
            ratio = speeds[0] / speeds[1]
            print(f"{compression:13}{speeds[0]:11.0f}{speeds[1]:11.0f}{ratio:11.2f}{speeds[2]:11.0f}{size:7.2f}")
            a.unlink()
            b.unlink()


if __name__ == "__main__":
    main()
