"""What is in doubt about a recording is said by info, run and diagnose alike, and of a sound one nothing is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from situations import small

from livedeform.closed_loop.inputs import _recorded_doubts
from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.checks.recorded import load_checked
from livedeform.common.experiment.yaml_file import Experiment, load_experiment
from livedeform.common.types import Array, MarkerFrame, Pose, Wrench
from livedeform.inspection import fit_findings, inspect
from livedeform.run import replay
from livedeform.run.results import doubts_of

S = 1_000_000_000
SECONDS = np.arange(0.0, 9.0, 0.05)
PLACES, IDS = np.array(small.MARKERS), np.arange(1, len(small.MARKERS) + 1, dtype=np.uint32)
DOWN = np.array([1.0, 0.0, 0.0, 0.0])


def depths(t: Array) -> Array:
    """Depth (n,) m: 5 mm above the block, and two presses of 3 mm."""
    course = sum(np.clip(np.minimum(t - a, a + 2.5 - t), 0.0, 1.0) for a in (1.5, 5.0))
    return np.asarray(-0.005 + 0.008 * course)


@dataclass
class Sent:
    """What is recorded of one moment, ``at`` s after the start; ``ahead`` s is the tracker's clock."""

    at: float
    frame: MarkerFrame
    pose: Pose
    wrench: Wrench
    cameras: Pose | None = None
    ahead: float = 0.0


def moment(at: float, depth: float) -> Sent:
    stamp, pressed = small.START_NS + round(S * at), max(depth, 0.0)
    points = PLACES + np.outer(PLACES[:, 2] / small.SIZE[2], [0.0, 0.0, -pressed / 3.0])
    pose = Pose(stamp, np.array([0.002, 0.001, small.SIZE[2] - depth]), DOWN)
    wrench = Wrench(stamp, np.array([0.0, 0.0, -1000.0 * pressed]), np.zeros(3))
    return Sent(at, small.frame(stamp, IDS, points), pose, wrench)


class Received:
    """A bag whose messages are received at ``now_ns``."""

    def __init__(self, bag: BagWriter) -> None:
        self.bag, self.now_ns = bag, 0

    def write(self, topic: str, type_name: str, log_time_ns: int, data: bytes) -> None:
        self.bag.write(topic, type_name, self.now_ns, data)


Change = Callable[[Sent], Sent]


def written(path: Path, change: Change = lambda sent: sent) -> Path:
    with BagWriter(path, {"made_by": "tests"}) as file:
        bag = Received(file)
        writer = RecordingWriter(bag)
        for at, depth in zip(SECONDS, depths(SECONDS), strict=True):
            sent = change(moment(float(at), float(depth)))
            bag.now_ns = sent.pose.stamp_ns + S // 200
            writer.pose(sent.pose)
            writer.wrench(sent.wrench)
            writer.marker_frame(replace(sent.frame, stamp_ns=sent.frame.stamp_ns + round(S * sent.ahead)))
            if sent.cameras is not None:
                writer.static_transforms({(t.FRAME_PHANTOM, t.FRAME_LEFT): sent.cameras}, sent.pose.stamp_ns)
    return path


def untared(sent: Sent) -> Sent:
    return replace(sent, wrench=replace(sent.wrench, force=sent.wrench.force - np.array([0.0, 0.0, 1.5])))


def one_id_twice(sent: Sent) -> Sent:
    return replace(sent, frame=replace(sent.frame, ids=np.where(IDS == 4, np.uint32(3), IDS)))


def ids_exchanged(sent: Sent) -> Sent:
    exchanged = np.choose(np.isin(IDS, (3, 4)) & (sent.at > 4.0), [IDS, 7 - IDS]).astype(np.uint32)
    return replace(sent, frame=replace(sent.frame, ids=exchanged))


def clock_set(sent: Sent) -> Sent:
    return replace(sent, ahead=0.25 * (sent.at > 1.0))


def force_clock_set(sent: Sent) -> Sent:
    stamp_ns = sent.wrench.stamp_ns + round(0.25 * S) * (sent.at > 1.0)
    return replace(sent, wrench=replace(sent.wrench, stamp_ns=stamp_ns))


def cameras_moved(sent: Sent) -> Sent:
    places = {0.0: -0.05, 3.0: -0.03}
    return replace(sent, cameras=Pose(0, np.array([places[sent.at], 0.0, 0.35]), DOWN) if sent.at in places else None)


DOUBTS: dict[str, tuple[Change, str]] = {
    "the wrench was not tared": (untared, "the wrench is not tared: (0.00, 0.00, -1.50) N while the probe is in the"),
    "one id for two markers": (one_id_twice, "markers whose id is there twice in a frame are left out"),
    "two markers exchange their ids": (ids_exchanged, "markers exchange their ids: 3 and 4 at 4.0"),
    "the tracker's clock was set": (clock_set, "receive time minus stamp of /stereo/markers changes by 0.250 s beside"),
    "the force sensor's clock was set": (force_clock_set, "receive time minus stamp of /probe/wrench changes by 0.250"),
    "the cameras were registered anew": (cameras_moved, "/tf_static says anew where the cameras are"),
}


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    return load_experiment(small.write_experiment(tmp_path / "experiment"))


@pytest.mark.parametrize("name", DOUBTS)
def test_a_doubt_is_said_by_every_command(name: str, tmp_path: Path, experiment: Experiment) -> None:
    change, text = DOUBTS[name]
    bag = written(tmp_path / "x.mcap", change)
    with read_bag(bag) as reader:
        (found,) = [f for f in fit_findings(reader, experiment, load_recording(bag, experiment)) if f.doubts]
    assert found.level == "WARN" and found.text.startswith(text) and found.remedy
    assert found in inspect(bag, tmp_path / "experiment").findings
    (loaded,) = load_checked([bag], [], experiment)
    assert found.text in loaded.warnings
    assert found.of_forces == (change in (untared, force_clock_set))
    assert doubts_of([found]) == (() if found.of_forces else (found.text,))  # a run reads no force that was measured
    assert found.mended == (change is ids_exchanged)  # a diagnosis leaves them out itself, and reads forces
    assert loaded.doubts == ([] if found.mended else [found.text])
    assert _recorded_doubts({"x": loaded, "y": loaded}) == [f"x, y: {text}" for text in loaded.doubts]


def test_of_a_sound_recording_nothing_is_in_doubt(tmp_path: Path, experiment: Experiment) -> None:
    bag = written(tmp_path / "x.mcap")
    with read_bag(bag) as reader:
        found = fit_findings(reader, experiment, load_recording(bag, experiment))
    assert [f.level for f in found if f.level != "NOTE"] == []


EFFECTS: dict[str, tuple[list[dict[str, object]], str]] = {
    "elastic": ([], ""),
    "it sets": ([{"name": "plastic_set", "fraction": 0.3, "threshold": 0.02}], "(plastic set)"),
    "it relaxes": ([{"name": "viscoelasticity", "g": [0.3], "tau": [5.0]}], "(relaxation)"),
    "it rubs": ([{"name": "probe_friction", "mu": 0.3}], ""),
}


@dataclass
class Part:
    """What is doubted of a recording from the middle on: where the model is led through what came before (``led``),
    and where it finds no equilibrium there (``lost``); and through how many poses it is led."""

    led: list[str]
    lost: list[str]
    n_to_pass: int


def cut(bag: Path, experiment: Experiment, start: float) -> Part:
    """What is said to be in doubt of the recording from ``start`` s on."""
    with read_bag(bag) as reader:
        whole, plan = load_recording(bag, experiment), replay.plan(reader, experiment)
        played = replay.cut(whole, reader, plan, start, None)
        assert len(played.arrivals[t.STEREO_MARKERS]) == len(played.marker_frames)
        beginning = replay.Beginning(whole, played, experiment)
        fit = fit_findings(reader, experiment, played, is_part=bool(beginning.poses))
    led = [f for f in [*fit, *beginning.findings(plan)] if f.level != "NOTE"]
    lost = beginning.left_out()
    assert all(f.level == "WARN" and f.doubts for f in [*led, *lost])
    return Part([f.text for f in led], [f.text for f in lost], len(beginning.to_pass))


@pytest.mark.parametrize("name", EFFECTS)
def test_what_a_start_in_the_middle_leaves_out_is_doubted(name: str, tmp_path: Path) -> None:
    effects, reason = EFFECTS[name]
    folder = small.write_experiment(tmp_path / "experiment")
    document = yaml.safe_load((folder / "experiment.yaml").read_text())
    (folder / "experiment.yaml").write_text(yaml.safe_dump(document | {"effects": effects}))
    experiment, bag = load_experiment(folder), written(tmp_path / "x.mcap")
    parts = {start: cut(bag, experiment, start) for start in (0.0, 1.0, 4.5, 6.0)}
    assert all(part.led == [] for part in parts.values())  # the model comes there as in a run of the whole
    assert parts[0.0].lost == parts[1.0].lost == []
    between = parts[4.5].lost
    assert len(between) == bool(reason) and all(reason in text and "--start 4.5 s" in text for text in between)
    within = parts[6.0].lost
    assert "begins within a press" in within[0] and len(within) == 1 + (name != "elastic")
    assert [part.n_to_pass for part in parts.values()] == ([0, 0, 0, 13] if name == "elastic" else [0, 20, 90, 120])


def test_a_clock_that_was_set_before_the_start_does_not_matter(tmp_path: Path, experiment: Experiment) -> None:
    bag = written(tmp_path / "x.mcap", clock_set)
    with read_bag(bag) as reader:
        whole = load_recording(bag, experiment)
        for start, n in ((0.0, 1), (4.5, 0)):
            played = replay.cut(whole, reader, replay.plan(reader, experiment), start, None)
            assert sum("a clock was set" in f.text for f in fit_findings(reader, experiment, played)) == n
