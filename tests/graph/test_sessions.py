"""A session starts anywhere, hears a tracker that is not reliable, and goes on when a killed node comes again."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small
from processes import Conversation, conversation, raw_messages, shifted
from small import Filmed

from livedeform.common import topics as t
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.ros.session import ros
from livedeform.common.types import Pose, Prediction
from livedeform.fem_node.live.predictor import make_predictor
from livedeform.fem_node.node import FemNode
from livedeform.run.graph import Graph, Player
from livedeform.run.running import isolated

HEIGHTS = (0.0, 0.001, 0.005, 0.02, 0.1, 0.5)  # m above the body
DEPTH = 0.002


def at(height: float, k: int) -> Pose:
    """A probe over the block, pointing down."""
    place = np.array([0.002, 0.001, small.SIZE[2] + height])
    return Pose(small.START_NS + k * small.STEP_NS, place, np.array([1.0, 0.0, 0.0, 0.0]))


def session(start: float) -> list[float]:
    """Heights of a probe that comes from ``start``, presses, goes back to 500 mm in leaps, and comes again."""
    down = np.linspace(min(start, 0.002), -DEPTH, 5)
    return [start, start, *down, *down[::-1], 0.02, 0.5, 0.1, *down, 0.5]


@pytest.mark.parametrize("start", [0.0, 0.02, 0.5])
def test_a_live_model_follows_a_probe_from_anywhere(start: float, tmp_path: Path):
    """Off the body nothing presses; the second press is as the first."""
    predictor = make_predictor(load_experiment(small.write_experiment(tmp_path)), True, "", "", 0, lambda *_: None)
    heights = session(start)
    found = [predictor.predict(at(height, k)) for k, height in enumerate(heights)]
    assert all(p.converged for p in found)
    forces = np.array([np.linalg.norm(p.force) for p in found])
    assert (forces[np.array(heights) > 0.001] < 1e-9).all()
    deepest = [k for k, height in enumerate(heights) if height == -DEPTH]
    assert forces[deepest].min() > 0.05  # N; 0.11 measured
    first, last = found[deepest[0]].markers, found[deepest[-1]].markers
    assert np.abs(first - last).max() < 1e-4  # m, the live model's tolerance


@pytest.mark.slow
def test_a_live_model_starts_at_every_height(tmp_path: Path):
    experiment = load_experiment(small.write_experiment(tmp_path))
    for start in (*HEIGHTS, *np.linspace(-0.001, 0.5, 20)):
        predictor = make_predictor(experiment, True, "", "", 0, lambda *_: None)
        assert all(predictor.predict(at(height, k)).converged for k, height in enumerate(session(float(start))))


def test_a_tracker_that_is_not_reliable_is_heard(experiment: Path, direct: list[Prediction]):
    from livedeform.common.ros import messages as m
    from livedeform.common.ros.node import CountingNode
    from livedeform.common.ros.session import SENSOR, ros
    from livedeform.compare_node.node import CompareNode
    from livedeform.run.graph import Graph
    from livedeform.run.running import isolated

    with isolated(), ros([], handle_signals=False) as stop:
        compare, tracker = CompareNode({"experiment": str(experiment)}), CountingNode("tracker")
        publisher = tracker.create_publisher(type(m.to_marker_cloud(frame(direct[0]))), t.STEREO_MARKERS, SENSOR)
        with Graph([compare, tracker], stop) as graph:
            deadline = time.monotonic() + 30.0
            while not compare.traffic.received[t.STEREO_MARKERS] and time.monotonic() < deadline:
                publisher.publish(m.to_marker_cloud(frame(direct[0])))
                graph.spin_once(0.05)
            assert compare.traffic.received[t.STEREO_MARKERS]


def frame(prediction: Prediction):
    return small.frame(prediction.stamp_ns, prediction.ids, prediction.markers + small.OFFSET)


# --- a node that is killed, and comes again --------------------------------------------------------------------------


@contextmanager
def started(name: str, parameters: dict[str, object], folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A node's process; killed in the end."""
    words = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
    code = f"from livedeform.{name}.node import main; main()"
    with (folder / f"{name}.log").open("ab") as log:
        child = subprocess.Popen([sys.executable, "-c", code, "--ros-args", *words], stdout=log, stderr=log)
    try:
        yield child
    finally:
        child.kill()
        child.wait()


def seconds_of(pid: int) -> float:
    """Time (s) that a process has computed: what it needs does not depend on what else runs, as its age does."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


NODES = {  # what it hears, what it answers with, and the seconds of computing in which it must be back
    "compare_node": ((t.FEM_MARKERS, t.STEREO_MARKERS), t.COMPARE_MARKERS, 3.0),
    "stereo_node": (t.IMAGES, t.STEREO_MARKERS, 3.0),
    "fem_node": ((t.PROBE_POSE,), t.FEM_MARKERS, 10.0),
}


PERIOD = 1.0 / 30.0  # s, of the pictures


def answered(talk: Conversation, play: Callable[[], None], topic: str, since_ns: int) -> None:
    """Play until an answer has come to something that was played since, and not by the node that was killed before."""
    seen = len(talk.heard)

    def done() -> bool:
        nonlocal seen
        play()
        talk.graph.spin_until(time.monotonic() + PERIOD)
        new, seen = talk.heard[seen:], len(talk.heard)
        return any(name == topic and small.stamp_of(data) >= since_ns for name, data in new)

    talk.wait(f"answer on {topic}", done)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="the time is looked up in /proc")
@pytest.mark.parametrize("name", NODES)
def test_a_node_that_is_killed_five_times_comes_back(
    name: str, filmed: Filmed, tmp_path: Path, record_property: Callable[[str, object], None]
):
    topics, answer, limit = NODES[name]
    frames = [small.frame(p.stamp_ns, p.ids, p.markers) for p in filmed.direct]
    film, tracked = raw_messages(filmed.bag), raw_messages(small.write_bag(tmp_path / "t.mcap", [], frames))
    by_topic = {topic: [raw for raw in film if raw.topic == topic] for topic in (t.PROBE_POSE, *t.IMAGES)}
    by_topic[t.STEREO_MARKERS] = tracked
    by_topic[t.FEM_MARKERS] = [replace(raw, topic=t.FEM_MARKERS) for raw in tracked]
    turn = 0

    def play() -> None:
        nonlocal turn
        lap, i = divmod(turn, len(frames))
        for topic in topics:
            talk.player.play(shifted(by_topic[topic][i], lap * len(frames) * small.STEP_NS))
        turn += 1

    parameters = {"experiment": str(filmed.folder)}
    took = []
    with conversation(topics, tmp_path / f"{name}.mcap") as talk:
        for _ in range(6):  # started once, killed and started again five times
            with started(name, parameters, tmp_path) as child:
                answered(talk, play, answer, small.START_NS + turn * small.STEP_NS)
                took.append(seconds_of(child.pid))
    record_property("seconds", took)
    print(f"{name}: back after {', '.join(f'{s:.1f}' for s in took[1:])} s of computing")
    assert max(took[1:]) < limit


@pytest.mark.parametrize("last", [False, True], ids=["in between", "at the end"])
def test_a_pose_stamped_ahead_waits_for_the_next_one(last: bool, experiment: Path):
    """Live: it is left out when the next one is back in line, and predicted in the end if none comes."""
    poses = small.press(6)
    poses[-1 if last else 3] = replace(poses[-1 if last else 3], stamp_ns=small.START_NS + 30_000_000_000)
    with isolated(), ros([], handle_signals=False) as stop:
        fem = FemNode({"experiment": str(experiment), "best_effort": False})
        player = Player([t.PROBE_POSE])
        with Graph([fem, player], stop) as graph:
            graph.start()
            for pose in poses:
                small.play(player, lambda w, pose=pose: w.pose(pose))
                graph.settle()
                while fem.busy:
                    graph.spin_once(0.05)
            waits = fem.counts()
            graph.finish(60.0)
            counts = fem.counts()
    assert (waits["predicted"], waits["skipped"]) == (5, 0 if last else 1)
    assert (counts["predicted"], counts["skipped"], counts["unfinished"]) == ((6, 0, 0) if last else (5, 1, 0))
