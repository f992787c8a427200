"""What a run says of itself: coverage, bad stamps, interruption, and that it hears only itself."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small

from livedeform.cli import run as command_line
from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import decode
from livedeform.common.bags.write import BagWriter
from livedeform.common.ros.session import ros
from livedeform.common.types import MarkerFrame, Pose, Prediction
from livedeform.compare_node.node import CompareNode
from livedeform.run.graph import Graph, Player
from livedeform.run.running import RunOptions, isolated, run

CODE = "from livedeform.cli import main; main()"
YEAR_NS = 365 * 86_400_000_000_000


def measured(direct: list[Prediction]) -> list:
    return [small.frame(p.stamp_ns, p.ids, p.markers + small.OFFSET) for p in direct]


def results(out: Path) -> dict:
    return json.loads((out / "metrics.json").read_text())


def test_a_run_of_which_little_was_compared_is_stale(
    experiment: Path, direct: list[Prediction], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Poses for five of twelve frames: the errors of those are small, and say nothing of the press."""
    bag = small.write_bag(tmp_path / "short.mcap", small.press()[:5], measured(direct))
    assert command_line(["run", str(experiment), "--bag", str(bag), "--out", str(tmp_path / "out")]) == 1
    document = results(tmp_path / "out")
    assert document["verdict"] == "STALE"
    assert document["coverage"]["frames_compared"] == 5 and document["coverage"]["frames_measured"] == 12
    assert sum(document["coverage"]["refused"].values()) == 7
    said = capsys.readouterr().out
    assert "only 5 of 12 measured frames were compared" in said and document["reason"] in said
    assert "only 5 of 12 measured frames were compared" in (tmp_path / "out" / "report.html").read_text()


def test_the_deepest_moments_count_more_than_frames(experiment: Path, direct: list[Prediction], tmp_path: Path):
    """Half a second without poses about the deepest moment: most frames are compared, and yet it is a warning."""
    poses = [p for k, p in enumerate(small.press(40)) if not 16 <= k <= 27]
    frames = [replace(frame, stamp_ns=small.START_NS + k * small.STEP_NS * 40 // 12)
              for k, frame in enumerate(measured(direct))]  # fmt: skip
    metrics = run(RunOptions(experiment, small.write_bag(tmp_path / "gap.mcap", poses, frames), tmp_path / "out"),
                  lambda *_: None)  # fmt: skip
    coverage = metrics.coverage
    assert coverage is not None and coverage.refused["gap"] > 0
    assert metrics.level in ("WARN", "STALE") and coverage.deepest_compared < coverage.deepest


@pytest.mark.parametrize(
    ("at", "rate"),
    [
        pytest.param(0, None, marks=pytest.mark.slow, id="0-lock step"),
        pytest.param(6, None, id="6-lock step"),
        pytest.param(0, 4.0, id="0-real time"),
        pytest.param(6, 4.0, marks=pytest.mark.slow, id="6-real time"),
    ],
)
def test_one_bad_stamp_costs_one_frame(
    at: int, rate: float | None, experiment: Path, direct: list[Prediction], tmp_path: Path
):
    frames = measured(direct)
    frames[at] = replace(frames[at], stamp_ns=frames[at].stamp_ns - 3 * YEAR_NS)
    bag = small.write_bag(tmp_path / "stamp.mcap", small.press(), frames)
    said: list[str] = []
    run(RunOptions(experiment, bag, tmp_path / "out", rate=rate), lambda text, *_: said.append(text))
    document = results(tmp_path / "out")
    assert document["coverage"]["frames_measured"] == 11
    assert document["coverage"]["refused"].get("out_of_order", 0) == 0
    if rate is None:  # in real time a busy machine may predict too few poses
        assert document["n_frames"] == 11 and document["verdict"] == "OK"
        assert document["error"]["rmse"] == pytest.approx(float(np.linalg.norm(small.OFFSET)), abs=1e-8)
    assert any("their stamps cannot be right" in text for text in said)


def test_a_threshold_that_nothing_could_be_over_is_said(experiment: Path, bag: Path, tmp_path: Path):
    run(RunOptions(experiment, bag, tmp_path / "out"), lambda *_: None)
    document = results(tmp_path / "out")
    moved = document["coverage"]["motion_largest"]
    assert moved < document["threshold"]
    assert "not even a model that does not move could be over it" in document["reason"]
    assert document["error_over_motion"] == pytest.approx(
        document["error"]["rmse"] / document["coverage"]["motion_rms"])  # fmt: skip


def test_an_interrupted_run_says_so_and_leaves_the_earlier_result(
    experiment: Path, direct: list[Prediction], tmp_path: Path
):
    """Ctrl-C in a slow replay: what was recorded is kept beside the earlier result, which stays as it was."""
    out = tmp_path / "out"
    bag = small.write_bag(tmp_path / "press.mcap", small.press(), measured(direct))
    run(RunOptions(experiment, bag, out), lambda *_: None)
    before = (out / "metrics.json").read_bytes()
    words = ["run", str(experiment), "--bag", str(bag), "--out", str(out), "--force", "--rate", "0.02"]
    child = subprocess.Popen([sys.executable, "-c", CODE, *words], stderr=subprocess.PIPE, text=True)
    assert child.stderr is not None
    for line in child.stderr:
        if line.startswith("replaying"):
            break
    child.send_signal(signal.SIGTERM)
    child.stderr.read()
    assert child.wait(60) == 1
    assert (out / "metrics.json").read_bytes() == before
    kept = tmp_path / "out.interrupted-1"
    assert results(kept)["coverage"]["interrupted"] is True and "interrupted" in results(kept)["reason"]
    assert load_recording(kept / "run.mcap").poses


def test_a_run_that_fails_leaves_the_earlier_result(experiment: Path, bag: Path, tmp_path: Path):
    out = tmp_path / "out"
    run(RunOptions(experiment, bag, out), lambda *_: None)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(bag.read_bytes()[:-200])
    for words in (["--bag", str(torn)], ["--bag", str(bag), "--start", "100"], ["--bag", str(bag), "--start", "nan"]):
        assert command_line(["run", str(experiment), *words, "--out", str(out), "--force"]) == 2
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_what_was_sent_is_received_or_lost(
    experiment: Path, direct: list[Prediction], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """A replay so fast that queues overflowed: every message, pose and frame is accounted for, and none is lost."""
    poses = small.press(400)
    frames = [replace(measured(direct)[k % 12], stamp_ns=pose.stamp_ns) for k, pose in enumerate(poses)]
    bag = small.write_bag(tmp_path / "fast.mcap", poses, frames)
    command_line(["run", str(experiment), "--bag", str(bag), "--out", str(tmp_path / "out"), "--rate", "500"])
    document = results(tmp_path / "out")
    traffic, coverage = document["counts"]["traffic"], document["coverage"]
    assert all(row["sent"] == row["received"] + row["lost"] for row in traffic.values())
    assert all(row["sent"] == 400 for name, row in traffic.items() if name.endswith(("/probe/pose", "/stereo/markers")))
    totals = [sum(row[key] for row in traffic.values()) for key in ("sent", "received", "lost")]
    assert totals == [coverage[key] for key in ("sent", "received", "lost")] and totals[2] == 0
    assert "messages: {} sent = {} received + {} lost".format(*totals) in capsys.readouterr().out
    model = document["counts"]["model"]
    heard = traffic["fem_node: /probe/pose"]["received"]
    assert heard == model["predicted"] + model["skipped"] + model["unfinished"]
    nothing = {"sent": 0, "received": 0}  # on a busy machine the replay may be over before the first answer
    recorded = traffic.get("recorder: /compare/markers", nothing)
    assert recorded["sent"] == document["counts"]["association"]["matched_frames"]
    assert recorded["received"] == document["n_frames"]


def test_replays_in_real_time_hear_only_themselves(experiment: Path, direct: list[Prediction], tmp_path: Path):
    """Two runs of other recordings at once, in the same domain: each has the frames and the error of its own."""
    bags = []
    for name, factor in (("a", 1.0), ("b", 3.0)):
        frames = [small.frame(p.stamp_ns, p.ids, p.markers + factor * small.OFFSET) for p in direct]
        bags.append(small.write_bag(tmp_path / f"{name}.mcap", small.press(), frames))
    children = [
        subprocess.Popen(
            [sys.executable, "-c", CODE, "run", str(experiment), "--bag", str(bag), "--rate", "0.25",
             "--out", str(tmp_path / bag.stem)],
            env=dict(os.environ), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        for bag in bags
    ]  # fmt: skip
    for child in children:
        threading.Timer(120.0, child.kill).start()
        child.wait()
    for bag, factor in zip(bags, (1.0, 3.0), strict=True):
        document = results(tmp_path / bag.stem)
        assert document["coverage"]["frames_measured"] == 12
        assert document["error"]["rmse"] == pytest.approx(factor * float(np.linalg.norm(small.OFFSET)), abs=2e-4)


def stop_at(k: int, seconds: float, direct: list[Prediction]) -> tuple[Pose, MarkerFrame]:
    """The pose and the markers of one moment of the press, ``seconds`` after its start."""
    stamp_ns = small.START_NS + round(seconds * 1e9)
    return replace(small.press()[k], stamp_ns=stamp_ns), replace(measured(direct)[k], stamp_ns=stamp_ns)


@pytest.mark.parametrize("seconds", [(0.0, 120.0), (0.0, 0.05, 0.1, 90.0), (0.0, 70.0, 140.0)])
def test_stops_minutes_apart_are_compared_to_the_last(
    seconds: tuple[float, ...], experiment: Path, direct: list[Prediction], tmp_path: Path
):
    """No message comes after the last stop that could show that its stamp is right; nothing says that it is wrong."""
    poses, frames = zip(*(stop_at(min(2 * k, 5), at, direct) for k, at in enumerate(seconds)), strict=True)
    bag = small.write_bag(tmp_path / "stops.mcap", poses, frames)
    run(RunOptions(experiment, bag, tmp_path / "out"), lambda *_: None)
    coverage = results(tmp_path / "out")["coverage"]
    assert coverage["frames_compared"] == coverage["frames_measured"] == len(seconds)


def set_back(seconds: float) -> Callable[[Pose | MarkerFrame], Pose | MarkerFrame]:
    middle_ns = small.START_NS + 30 * small.STEP_NS
    return lambda item: replace(item, stamp_ns=item.stamp_ns - round(seconds * 1e9) * (item.stamp_ns >= middle_ns))


DOUBTED: dict[str, tuple[Callable[[Any], Any], str]] = {
    "sound": (lambda item: item, ""),
    "angles for a quaternion": (
        lambda i: replace(i, orientation_xyzw=np.array([np.pi, 0.0, 0.4, 0.0])) if isinstance(i, Pose) else i,
        "norm is not 1",
    ),
    "a clock that was set back": (set_back(0.725), "clocks were set back"),
}  # fmt: skip


@pytest.mark.parametrize("name", DOUBTED)
def test_inputs_that_may_spoil_the_result_keep_it_from_being_sound(
    name: str, experiment: Path, direct: list[Prediction], tmp_path: Path
):
    """Terminal, page and JSON say so: before, all of these were OK."""
    change, said = DOUBTED[name]
    poses = small.press(60)
    frames = [replace(measured(direct)[k // 5], stamp_ns=pose.stamp_ns) for k, pose in enumerate(poses)]
    with BagWriter(tmp_path / "x.mcap") as bag:
        writer = RecordingWriter(Arrival(bag))
        for pose, frame in zip(poses, frames, strict=True):
            writer.pose(change(pose))
            writer.marker_frame(change(frame))
    told: list[str] = []
    run(RunOptions(experiment, tmp_path / "x.mcap", tmp_path / "out"), lambda text, *_: told.append(text))
    document = results(tmp_path / "out")
    assert document["verdict"] == ("WARN" if said else "OK")
    for text in (" ".join(told), document["reason"], (tmp_path / "out" / "report.html").read_text()):
        assert not said or said in unescape(text)


class Arrival:
    """A bag whose messages are received one after the other, whatever their stamps are."""

    def __init__(self, bag: BagWriter) -> None:
        self._bag, self._n = bag, 0

    def write(self, topic: str, type_name: str, log_time_ns: int, data: bytes) -> None:
        self._n += 1
        self._bag.write(topic, type_name, small.START_NS + self._n * small.STEP_NS // 2, data)


@pytest.mark.parametrize(("threshold", "n_poses"), [(0.005, 12), (0.0005, 12), (0.00129, 12), (0.005, 5), (0.005, 10)])
def test_the_topic_ends_with_the_level_of_the_run(
    threshold: float, n_poses: int, direct: list[Prediction], tmp_path: Path
):
    """Who watches /compare/metrics is told the run's verdict in the end: it was OK even of a model that fails."""
    folder = small.write_experiment(tmp_path / "experiment", threshold=threshold)
    bag = small.write_bag(tmp_path / "x.mcap", small.press()[:n_poses], measured(direct))
    metrics = run(RunOptions(folder, bag, tmp_path / "out"), lambda *_: None)
    with read_bag(tmp_path / "out" / "run.mcap") as recorded:
        last = [decode(raw) for raw in recorded.messages([t.COMPARE_METRICS])][-1].status[0]
    values = {pair.key: pair.value for pair in last.values}
    assert values["verdict"] == str(metrics.level) and last.message.startswith("ended")
    assert last.level == ["OK", "WARN", "ERROR", "STALE"].index(values["verdict"])
    assert float(values["rmse"]) == pytest.approx(metrics.rmse.value, rel=1e-6) and int(values["n"]) == metrics.n
    assert float(values["mean"]) == pytest.approx(metrics.mean.value, rel=1e-6)
    assert float(values["max"]) == pytest.approx(metrics.max, rel=1e-6)


@pytest.mark.parametrize(("case", "doubted", "said"), [
    ("sound", set(), ""),
    ("a frame with one marker", {6}, "fewer than half of the markers were seen"),
    ("no poses for most frames", {8, 9, 10, 11}, "measured frames were compared so far"),
])  # fmt: skip
def test_a_frame_is_not_ok_by_itself(
    case: str, doubted: set[int], said: str, experiment: Path, direct: list[Prediction], tmp_path: Path
):
    """Who watches a session sees OK of what says next to nothing: one of 11 markers, one of 9 frames."""
    frames, poses = measured(direct), small.press()
    if case == "a frame with one marker":
        frames[6] = small.frame(frames[6].stamp_ns, frames[6].ids[:1], frames[6].points[:1])
    if case == "no poses for most frames":
        poses = poses[8:]
    run(RunOptions(experiment, small.write_bag(tmp_path / "x.mcap", poses, frames), tmp_path / "out"), lambda *_: None)
    with read_bag(tmp_path / "out" / "run.mcap") as recorded:
        statuses = [decode(raw).status[0] for raw in recorded.messages([t.COMPARE_METRICS])][:-1]
    row = {str(frame.stamp_ns): k for k, frame in enumerate(frames)}
    found = {row[pair.value]: status.message for status in statuses if status.level
             for pair in status.values if pair.key == "stamp_ns"}  # fmt: skip
    assert set(found) == doubted and all(said in text for text in found.values())


def test_a_message_that_a_gate_refuses_is_counted(experiment: Path, direct: list[Prediction], tmp_path: Path):
    """Live, nobody has seen the recording before: a stamp days ahead costs its frame, and is a reason."""
    frames = measured(direct)
    frames[6] = replace(frames[6], stamp_ns=frames[6].stamp_ns + 2 * 86_400_000_000_000)
    with isolated(), ros([], handle_signals=False) as stop:
        compare = CompareNode({"experiment": str(experiment), "stale_after": 0.0, "best_effort": False})
        player = Player([t.STEREO_MARKERS])
        with Graph([compare, player], stop) as graph:
            graph.start()
            for frame in frames:
                small.play(player, lambda w, frame=frame: w.marker_frame(frame))
                graph.settle()
            counts = compare.counts()
    assert (counts["measured_frames"], counts["refused_out_of_order"]) == (12, 1)
