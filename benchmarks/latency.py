"""End-to-end latency: from a picture's publication to that of its error, in real time, in one process.

    python benchmarks/latency.py EXPERIMENT --bag BAG [--rate 1.0] [--duration 10]

From the moment at which the right picture is played to that at which the recorder hears the answer; a frame's error
waits for the first prediction that is not older.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import header_stamp_ns
from livedeform.common.bags.types import RawMessage
from livedeform.run import running
from livedeform.run.graph import Player
from livedeform.run.recorder import RunRecorder


def arrivals(run: Path, topic: str) -> dict[int, int]:
    """Wall clock (ns) at which the message of each stamp was received."""
    with read_bag(run) as bag:
        found = {}
        for raw in bag.messages([topic]):
            stamp = header_stamp_ns(raw)
            if stamp is not None:
                found.setdefault(stamp, raw.log_time_ns)
        return found


def with_wall_clock() -> None:
    """Receive times of the recording are the wall clock's, not the replay's."""
    original = RunRecorder.__init__
    RunRecorder.__init__ = lambda self, path, metadata, clock: original(self, path, metadata, time.time_ns)  # type: ignore[method-assign]


def note_publications() -> dict[str, dict[int, int]]:
    """Wall clock (ns) at which each message of the recording is played, by topic and stamp. (The recorder may hear of a
    picture only when the nodes that share its executor have done with it.)"""
    published: dict[str, dict[int, int]] = {}
    original = Player.play

    def play(self: Player, raw: RawMessage) -> None:
        stamp = header_stamp_ns(raw)
        if stamp is not None:
            published.setdefault(raw.topic, {})[stamp] = time.time_ns()
        original(self, raw)

    Player.play = play  # type: ignore[method-assign]
    return published


def quantiles(ms: np.ndarray) -> dict[str, float]:
    return {"n": len(ms), "median_ms": round(float(np.median(ms)), 1), "p99_ms": round(float(np.percentile(ms, 99)), 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("experiment", type=Path)
    parser.add_argument("--bag", type=Path, required=True)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--duration", type=float)
    arguments = parser.parse_args()
    with_wall_clock()
    published = note_publications()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        options = running.RunOptions(
            arguments.experiment, arguments.bag, out, rate=arguments.rate, duration=arguments.duration
        )
        running.run(options, lambda *_: None)
        bag = out / "run.mcap"
        inputs = next(x for x in (t.RIGHT_IMAGE, t.RIGHT_COMPRESSED, t.STEREO_MARKERS) if x in published)
        pictures, markers = published[inputs], arrivals(bag, t.STEREO_MARKERS)
        poses, predictions = published[t.PROBE_POSE], arrivals(bag, t.FEM_MARKERS)
        errors = arrivals(bag, t.COMPARE_MARKERS)
        counts = json.loads((out / "metrics.json").read_text())["counts"]

    def between(a: dict[int, int], b: dict[int, int]) -> dict[str, float]:
        return quantiles(np.array([(b[s] - a[s]) * 1e-6 for s in a.keys() & b.keys()]))

    result = {
        "input": inputs,
        "picture_to_markers": between(pictures, markers),
        "pose_to_prediction": between(poses, predictions),
        "picture_to_error": between(pictures, errors),
        "model": counts["model"],
        "lost_messages": counts["lost_messages"],
    }
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
