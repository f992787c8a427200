"""``livedeform run --after``: the graph's body has the set of what it went through before."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small

from livedeform.cli import run as command_line
from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Pose
from livedeform.fem_node.model import PhantomModel

MINUTE = 60_000_000_000


def later(poses: list[Pose]) -> list[Pose]:
    return [replace(pose, stamp_ns=pose.stamp_ns + MINUTE) for pose in poses]


def test_a_set_goes_on_into_the_next_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The measured body has gone through both; the graph on the second alone agrees with it only after the first."""
    effects = [{"name": "plastic_set", "fraction": 0.3, "threshold": 0.02}]
    experiment = small.write_experiment(tmp_path / "set", effects=effects)
    first, second = small.press(9, depth=0.005), later(small.press(3, depth=0.001))
    body = PhantomModel.from_experiment(load_experiment(experiment))
    for pose in first:
        body.predict(pose)
    true = [body.predict(pose) for pose in second]
    a = small.write_bag(tmp_path / "a.mcap", first, [])
    b = small.write_bag(tmp_path / "b.mcap", second, [small.frame(p.stamp_ns, p.ids, p.markers) for p in true])

    def run(out: str, *options: str) -> float:
        words = ["run", str(experiment), "--bag", str(b), "--out", str(tmp_path / out), *options]
        assert command_line(words) == 0
        return max(float(np.abs(e.errors).max()) for e in load_recording(tmp_path / out / "run.mcap").errors)

    alone, after = run("alone"), run("after", "--after", str(a))
    assert "going through" in capsys.readouterr().err
    assert alone > 2e-4  # m
    assert after < 0.03 * alone


def test_a_recording_that_is_not_earlier_is_refused_in_a_line(
    experiment: Path, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    assert command_line(["run", str(experiment), "--bag", str(bag), "--out", str(out), "--after", str(bag)]) == 2
    error = capsys.readouterr().err
    assert "is not earlier than the recording that is run" in error and error.count("\n") == 1
    markers = small.write_bag(tmp_path / "markers.mcap", [], [small.frame(1, np.array([1]), np.zeros((1, 3)))])
    assert command_line(["run", str(experiment), "--bag", str(bag), "--out", str(out), "--after", str(markers)]) == 2
    error = capsys.readouterr().err
    assert "has no probe poses" in error and error.count("\n") == 1
    assert not out.exists()
