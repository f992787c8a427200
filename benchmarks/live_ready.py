"""Is live prediction ready when it says so? Three nodes in processes of their own, from the first pose on.

    python -m benchmarks.live_ready [--seconds 30] [--pictures 10] [--poses 30] [--cache FOLDER]

The shipped phantom: `fem_node` prepares itself along the poses of recording a (``expected``), from an empty cache. Once
`/fem_node/get_state` answers, recording a and then b, whose press nobody rehearsed, are played with the stamps of the
wall clock. From publishing to hearing the answer, over DDS: poses to `/fem/markers`, right pictures to the error.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from lifecycle_msgs.srv import GetState

from benchmarks.soak import Stream, streams
from livedeform.common import topics as t
from livedeform.common.bags.recording import header_stamp_ns
from livedeform.common.bags.types import RawMessage
from livedeform.common.ros.node import CountingNode
from livedeform.common.ros.session import ros
from livedeform.run import graph as g
from livedeform.shipped import BREAST, shipped

NODES = ("stereo_node", "fem_node", "compare_node")
PREPARING_SECONDS = 1800.0
PERIOD = 1 / 30  # s: what a prediction may take


class Hearer(CountingNode):
    """Notes when the answer to each stamp came (monotonic seconds)."""

    def __init__(self) -> None:
        super().__init__("hearer")
        self.heard: dict[str, dict[int, float]] = {t.FEM_MARKERS: {}, t.COMPARE_MARKERS: {}}
        for topic, stamps in self.heard.items():

            def note(data: bytes, stamps: dict[int, float] = stamps, topic: str = topic) -> None:
                stamp = header_stamp_ns(RawMessage(topic, t.TOPICS[topic].type, 0, data))
                stamps.setdefault(stamp or 0, time.monotonic())

            self.subscribe(g.message_type(t.TOPICS[topic].type), topic, note, raw=True)
        self.ready = [self.create_client(GetState, f"/{name}/get_state") for name in NODES]


@contextlib.contextmanager
def node(name: str, parameters: dict[str, str], scratch: Path) -> Iterator[None]:
    """One of the console scripts."""
    file = scratch / f"{name}.yaml"
    file.write_text(json.dumps({name: {"ros__parameters": parameters}}))  # JSON is YAML
    code = f"from livedeform.{name}.node import main; main()"
    with (scratch / f"{name}.log").open("w") as log:
        child = subprocess.Popen(
            [sys.executable, "-c", code, "--ros-args", "--params-file", str(file)], stdout=log, stderr=log
        )
        try:
            yield
        finally:
            child.terminate()
            child.wait()


def play(graph: g.Graph, player: g.Player, sources: list[Stream], seconds: float) -> dict[str, dict[int, float]]:
    """Play for ``seconds``; return when (monotonic s) the message of each stamp was published."""
    sent: dict[str, dict[int, float]] = {}
    begin = time.monotonic()
    while (elapsed := time.monotonic() - begin) < seconds:
        for source in sources:
            if source.due(elapsed):
                for raw in source.next():
                    sent.setdefault(raw.topic, {})[header_stamp_ns(raw) or 0] = time.monotonic()
                    player.play(raw)
        graph.spin_once(0.0002)
    graph.spin_until(time.monotonic() + 2.0)
    return sent


def row(name: str, sent: dict[int, float], heard: dict[int, float], within: float | None) -> str:
    """Answers and their delays as one line of the table."""
    delays = np.array([heard[stamp] - at for stamp, at in sent.items() if stamp in heard]) * 1e3
    if not len(delays):
        return f"{name}: no answer to {len(sent)}"
    share = f"; {np.sum(delays <= 1e3 * within) / len(sent):.1%} of all within {1e3 * within:.0f} ms" if within else ""
    median, p99 = np.percentile(delays, [50, 99])
    return f"{name}: {len(delays)} of {len(sent)} answered, median {median:.0f} ms, p99 {p99:.0f} ms{share}"


def main() -> None:
    """Print what was answered, and how soon."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--pictures", type=float, default=10.0)
    parser.add_argument("--poses", type=float, default=30.0)
    parser.add_argument("--cache", type=Path, help="what earlier sessions kept; an empty one by default")
    options = parser.parse_args()
    folder = shipped(BREAST)
    bags = {name: streams(folder / "bags" / name, options.pictures, options.poses) for name in "ab"}
    common = {"experiment": str(folder / "experiment")}
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        scratch = Path(name)
        os.environ["XDG_CACHE_HOME"] = str(options.cache or scratch / "cache")
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        stop = stack.enter_context(ros([], handle_signals=False))
        hearer, player = Hearer(), g.Player([*t.COMPRESSED_IMAGES, t.PROBE_POSE])
        graph = stack.enter_context(g.Graph([hearer, player], stop))
        began = time.monotonic()
        stack.enter_context(node("stereo_node", common, scratch))
        stack.enter_context(node("compare_node", common, scratch))
        stack.enter_context(node("fem_node", common | {"expected": str(folder / "bags" / "a")}, scratch))
        while not all(client.service_is_ready() for client in hearer.ready):
            graph.spin_once(0.1)
            if time.monotonic() - began > PREPARING_SECONDS:
                sys.exit(f"not ready: {(scratch / 'fem_node.log').read_text()}")
        print(f"ready after {time.monotonic() - began:.0f} s; load of the machine {os.getloadavg()[0]:.1f}")
        for bag, sources in bags.items():
            sent = play(graph, player, sources, options.seconds)
            print(row(f"{bag}, poses", sent[t.PROBE_POSE], hearer.heard[t.FEM_MARKERS], PERIOD))
            right = sent[t.COMPRESSED_IMAGES[1]]
            print(row(f"{bag}, pictures to error", right, hearer.heard[t.COMPARE_MARKERS], None))


if __name__ == "__main__":
    main()
