"""Load to hold: memory, losses and time to come back under long, fast and large input.

    python -m benchmarks.soak live [--minutes 30] [--pictures 30] [--poses 100]     slope of the memory, every loss
    python -m benchmarks.soak live --minutes 1 --pictures 200 --poses 1000          the same, too fast for the machine
    python -m benchmarks.soak large [--gb 10] [--out FOLDER]                        a recording made on the fly

``live`` plays the shipped phantom's recording round and round to `livedeform live` in a process of its own, with the
stamps of the wall clock; a picture that is played again differs in a pixel, as a camera's would. The model is prepared
along the recording's poses. ``large`` writes one recording with pictures of noise, then measures the most memory that
`info`, `run --start --duration` and `report` take. Nodes that are killed and come again are in
`pytest -m slow -s tests/graph/test_sessions.py`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import header_stamp_ns, load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import RawMessage, decode, encode
from livedeform.common.bags.write import BagWriter
from livedeform.common.ros.session import ros
from livedeform.common.types import Image
from livedeform.run import graph as g
from livedeform.run.playing import restamped
from livedeform.shipped import BREAST, shipped

CODE = "import sys; from livedeform.cli import main; sys.exit(main())"
PAGE = os.sysconf("SC_PAGE_SIZE")
SAMPLE_SECONDS = 5.0
FLICKERS = 11  # a prime: what is left of a stream that loses some is not the same twice either
WARM_UP = 0.25  # share of the session that does not count for the slope
MEET_SECONDS = 1800.0  # until the nodes hear us: the model may be made first
HEAD_SECONDS = 5.0  # for the listeners to have met us, too: what is sent before is lost, and shows in no number
TAIL = 10  # slow messages in the end, so that a loss before them shows in the numbers


def memory_mb(pid: int) -> float:
    """Resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 1e6


def computed(pid: int) -> float:
    """Time (s) that a process has computed, all of its threads."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def slope(seconds: Sequence[float], megabytes: Sequence[float]) -> float:
    """Return the least-squares slope (MB/h) after the warm-up."""
    x, y = np.array(seconds), np.array(megabytes)
    late = x >= WARM_UP * x[-1]
    return float(np.polyfit(x[late], y[late], 1)[0] * 3600.0) if late.sum() > 2 else float("nan")


class Stream:
    """Messages of some topics, played round and round at a rate; each is the recorded one next in time.

    ``columns``: of each topic its messages, and of each message what is played in turn.
    """

    def __init__(self, columns: Sequence[Sequence[Sequence[RawMessage]]], rate: float) -> None:
        self.columns, self.rate, self.n = columns, rate, 0
        self._times: NDArray[np.int64] = np.array([header_stamp_ns(turns[0]) or 0 for turns in columns[0]])

    def due(self, elapsed: float) -> bool:
        return self.n / self.rate <= elapsed

    def next(self) -> Iterator[RawMessage]:
        """The next message of each topic, stamped now."""
        lasts = self._times[-1] - self._times[0]
        k = int(np.searchsorted(self._times, self._times[0] + round(self.n / self.rate * 1e9) % max(lasts, 1)))
        self.n += 1
        now = time.time_ns()
        for column in self.columns:
            turns = column[min(k, len(column) - 1)]
            raw = turns[self.n % len(turns)]
            yield replace(raw, data=restamped(raw.data, now))


def flickering(raw: RawMessage) -> list[RawMessage]:
    """The compressed picture, and others that differ in a pixel: a camera never gives the same twice."""
    message = decode(raw)
    pixels = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
    out = [raw]
    for k in range(1, FLICKERS):
        pixels[0, k] ^= 1
        coded = np.ravel(cv2.imencode(".png", pixels)[1])
        out.append(replace(raw, data=encode(replace(message, format="png", data=coded))))
    return out


def streams(bag_path: Path, pictures: float, poses: float) -> list[Stream]:
    """Pictures and poses of a recording."""
    with read_bag(bag_path) as bag:
        film = [[flickering(raw) for raw in bag.messages([topic])] for topic in t.COMPRESSED_IMAGES]
        moved = [[[raw] for raw in bag.messages([t.PROBE_POSE])]]
    return [Stream(film, pictures), Stream(moved, poses)]


def play(
    graph: g.Graph, player: g.Player, sources: Sequence[Stream], seconds: float, pid: int
) -> tuple[list[float], list[float]]:
    """Play for ``seconds``; returns when (s) how much memory (MB) the process ``pid`` had."""
    begin, when, memory = time.monotonic(), [], []
    while (elapsed := time.monotonic() - begin) < seconds:
        for source in sources:
            if source.due(elapsed):
                for raw in source.next():
                    player.play(raw)
        if elapsed >= len(when) * SAMPLE_SECONDS:
            when.append(elapsed)
            memory.append(memory_mb(pid))
        graph.spin_once(0.0002)
    for _ in range(TAIL):
        time.sleep(0.2)
        for source in sources:
            for raw in source.next():
                player.play(raw)
    time.sleep(2.0)
    return when, memory


def live(options: argparse.Namespace) -> None:
    """Print the slope of the memory, and what became of every message."""
    folder = shipped(BREAST)
    sources = streams(folder / "bags" / "a", options.pictures, options.poses)
    topics = [column[0][0].topic for source in sources for column in source.columns]
    with tempfile.TemporaryDirectory(dir=options.out) as scratch, contextlib.ExitStack() as stack:
        out, log = Path(scratch) / "out", stack.enter_context((Path(scratch) / "log").open("w+"))
        words = ["live", str(folder / "experiment"), "--out", str(out), "--expected", str(folder / "bags" / "a")]
        child = subprocess.Popen([sys.executable, "-c", CODE, *words], stdout=log, stderr=log)
        stack.callback(child.kill)
        stop = stack.enter_context(ros([], handle_signals=False))
        player = g.Player(topics)
        graph = stack.enter_context(g.Graph([player], stop))
        deadline = time.monotonic() + MEET_SECONDS
        # of each topic the recorder and a node listen
        while any(player.outlets[topic].get_subscription_count() < 2 for topic in topics):
            graph.spin_once(0.1)
            if time.monotonic() > deadline or child.poll() is not None:
                sys.exit(f"nobody listens: {(Path(scratch) / 'log').read_text()}")
        graph.spin_until(time.monotonic() + HEAD_SECONDS)
        before = computed(child.pid)
        when, memory = play(graph, player, sources, 60.0 * options.minutes, child.pid)
        last, busy = memory_mb(child.pid), (computed(child.pid) - before) / when[-1]
        child.send_signal(signal.SIGINT)
        began, before = time.monotonic(), computed(child.pid)
        while not (out / "metrics.json").is_file() and child.poll() is None:
            time.sleep(0.02)
        stopped = time.monotonic() - began, computed(child.pid) - before
        print(f"{when[-1] / 60:.1f} min, memory {memory[0]:.0f} to {last:.0f} MB (most {max(memory):.0f}), ", end="")
        print(f"slope {slope(when, memory):+.1f} MB/h after {WARM_UP * when[-1] / 60:.1f} min")
        print("memory (MB) every tenth:", *(f"{memory[k * (len(memory) - 1) // 10]:.0f}" for k in range(11)))
        print(f"it computed {busy:.2f} s a second; the machine's load was {os.getloadavg()[1]:.1f} (5 min)")
        print(f"metrics {stopped[0]:.1f} s after Ctrl-C, {stopped[1]:.1f} s of them computing", flush=True)
        child.wait()
        print(f"report {time.monotonic() - began:.0f} s after it; {disk_mb(out):.0f} MB written")
        account(json.loads((out / "metrics.json").read_text()), dict(player.traffic.sent))
        print("\n".join(line for line in (Path(scratch) / "log").read_text().splitlines() if "messages:" in line))


def disk_mb(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def account(document: dict[str, object], sent: dict[str, int]) -> None:
    """Print each listener's balance beside what was really sent."""
    counts = document["counts"]
    assert isinstance(counts, dict)
    unexplained = 0
    for name, row in counts["traffic"].items():
        topic = name.partition(": ")[2]
        told = f"{name}: {row['received']} received + {row['lost']} lost = {row['sent']}"
        if topic in sent:
            missing = sent[topic] - row["sent"] - row.get("before", 0)
            unexplained += abs(missing)
            told += f", {row.get('before', 0)} before; of {sent[topic]} sent"
        if topic in sent or row["lost"]:
            print(told)
    print(f"drops that are not counted: {unexplained}")
    print(f"model: {counts['model']}; compared: {document['coverage']}")


# --- a large recording -----------------------------------------------------------------------------------------------


def write_large(folder: Path, gigabytes: float) -> Path:
    """The shipped experiment's poses and markers, and noise for pictures, in one file."""
    experiment = shipped(BREAST) / "bags" / "a"
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
    path = folder / "large.mcap"
    recording = load_recording(experiment)
    poses = recording.poses
    step, turn = poses[1].stamp_ns - poses[0].stamp_ns, 0
    begin = poses[0].stamp_ns
    with BagWriter(path, {"made_by": "benchmarks.soak"}) as bag:
        writer = RecordingWriter(bag)
        while turn % 50 or path.stat().st_size < gigabytes * 1e9:
            stamp = begin + turn * step
            writer.pose(replace(poses[turn % len(poses)], stamp_ns=stamp))
            for topic in t.IMAGES:
                writer.image(Image(stamp, np.roll(noise, turn, 1)), topic)
            turn += 1
            if turn % 50 == 0:
                bag.flush()
    return path


def most_memory(*words: str) -> tuple[float, float, int]:
    """Run a command; returns the most memory (MB) that it had, how long (s) it took, and its exit code."""
    began = time.monotonic()
    child = subprocess.Popen([sys.executable, "-c", CODE, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert child.stdout is not None
    said = child.stdout.read().decode()
    _, status, used = os.wait4(child.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, 1):
        print(re.sub(r"(?m)^", "    ", said[-1500:]))
    return used.ru_maxrss * 1024 / 1e6, time.monotonic() - began, code


def large(options: argparse.Namespace) -> None:
    """Print the most memory that each command takes of a large recording."""
    experiment = shipped(BREAST) / "experiment"
    with tempfile.TemporaryDirectory(dir=options.out) as scratch:
        began = time.monotonic()
        bag = write_large(Path(scratch), options.gb)
        mine = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
        took = time.monotonic() - began
        print(f"{bag.stat().st_size / 1e9:.2f} GB written in {took:.0f} s with {mine:.0f} MB", flush=True)
        out = str(Path(scratch) / "out")
        part = ["--start", "2", "--duration", "2", "--out", out]
        for words in (["info", str(bag)], ["run", str(experiment), "--bag", str(bag), *part], ["report", out]):
            memory, took, code = most_memory(*words)
            print(f"{words[0]}: at most {memory:.0f} MB, {took:.0f} s, exit code {code}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    session = commands.add_parser("live", help="a live session")
    session.add_argument("--minutes", type=float, default=30.0)
    session.add_argument("--pictures", type=float, default=30.0, help="pairs per second")
    session.add_argument("--poses", type=float, default=100.0, help="per second")
    session.set_defaults(do=live)
    recording = commands.add_parser("large", help="a large recording")
    recording.add_argument("--gb", type=float, default=10.0)
    recording.set_defaults(do=large)
    for command in (session, recording):
        command.add_argument("--out", type=Path, help="where what is written, and deleted in the end, goes")
    options = parser.parse_args()
    options.do(options)


if __name__ == "__main__":
    main()
