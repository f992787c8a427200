"""Recorder throughput: pictures published, received and written to MCAP, against the bare mcap writer in one run.

    python benchmarks/recorder.py [--frames 300]

Prints MB per second and per CPU second, and the messages that got lost (there must be none).
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import RawMessage
from livedeform.common.bags.write import BagWriter
from livedeform.common.ros.session import ros
from livedeform.common.types import Image
from livedeform.run import graph as g
from livedeform.run.recorder import RunRecorder

WIDTH, HEIGHT = 1280, 720


def picture(folder: Path) -> bytes:
    """One noisy serialised 720p picture."""
    pixels = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)
    with BagWriter(folder / "one.mcap", {}) as bag:
        RecordingWriter(bag).image(Image(0, pixels), t.LEFT_IMAGE)
    with read_bag(folder / "one.mcap") as bag:
        return next(iter(bag.messages())).data


def bare(path: Path, data: bytes, n: int) -> tuple[float, float]:
    """Seconds and CPU seconds of the mcap library alone."""
    wall, cpu = time.perf_counter(), time.process_time()
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        channel = writer.register_channel("/x", "cdr", writer.register_schema("x", "ros2msg", b""))
        for i in range(n):
            writer.add_message(channel, i, data, i)
        writer.finish()
        stream.flush()
    return time.perf_counter() - wall, time.process_time() - cpu


def through_dds(path: Path, data: bytes, n: int) -> tuple[float, float, int, dict[str, int]]:
    """Seconds, CPU seconds, messages written and lost: published, received as bytes, written, in lock step."""
    message = RawMessage(t.LEFT_IMAGE, "sensor_msgs/msg/Image", 0, data)
    with ros([]) as stop, RunRecorder(path, {}, time.time_ns) as recorder:
        player = g.Player([t.LEFT_IMAGE])
        with g.Graph([g.RecorderNode(recorder), player], stop) as graph:
            graph.start()
            wall, cpu = time.perf_counter(), time.process_time()
            for _ in range(n):
                player.play(message)
                graph.settle()
            return time.perf_counter() - wall, time.process_time() - cpu, recorder.counts[t.LEFT_IMAGE], graph.lost()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=300)
    n = parser.parse_args().frames
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "OFF"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data = picture(folder)
        mb = n * len(data) / 1e6
        wall, cpu = bare(folder / "bare.mcap", data, n)
        ours_wall, ours_cpu, written, lost = through_dds(folder / "ours.mcap", data, n)
    result = {
        "pictures": n,
        "MB": round(mb, 1),
        "bare_mcap_MB_per_s": round(mb / wall),
        "bare_mcap_MB_per_cpu_s": round(mb / cpu),
        "recorder_MB_per_s": round(mb / ours_wall),
        "recorder_MB_per_cpu_s": round(mb / ours_cpu),
        "recorder_pictures_per_s": round(n / ours_wall, 1),
        "written": written,
        "lost": lost,
    }
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
