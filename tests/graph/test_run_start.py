"""``livedeform run --start``: the body comes to the part that is run as in a run of the whole recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small

from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Pose, Prediction
from livedeform.fem_node.model import PhantomModel
from livedeform.run import running
from livedeform.run.running import RunOptions, run

EFFECTS: dict[str, list[dict[str, object]]] = {
    "sets": [{"name": "plastic_set", "fraction": 0.3, "threshold": 0.02}],
    "relaxes": [{"name": "viscoelasticity", "g": [0.4], "tau": [0.5]}],
}
N, WITHIN, AFTER = 16, 7, 13  # poses; deep in a press, and in the air behind it
Body = tuple[Path, list[Prediction]]


def path() -> list[Pose]:
    """A press that slides by 4 mm along the block while it is deep, and the probe at rest above it."""
    k, down = np.arange(N), small.press(2)[0].orientation_xyzw
    depth = np.interp(k, [0, 5, 9, 12], [-0.003, 0.005, 0.005, -0.003])
    along = np.interp(k, [5, 9], [0.002, 0.006])
    places = np.column_stack([along, np.full(N, 0.001), small.SIZE[2] - depth])
    return [Pose(small.START_NS + i * small.STEP_NS, place, down) for i, place in enumerate(places)]


@pytest.fixture(scope="module")
def bodies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Body]:
    """The experiment of each effect, and what its model predicts along the whole of the path."""
    out = {}
    for name, effects in EFFECTS.items():
        folder = small.write_experiment(tmp_path_factory.mktemp(name), effects=effects)
        model = PhantomModel.from_experiment(load_experiment(folder))
        out[name] = folder, [model.predict(pose) for pose in path()]
    return out


def ran(body: Body, out: Path, first: int, said: list[str]) -> tuple[float, dict[str, Any]]:
    """How far (m) a run from the pose number ``first`` on is from the whole path at most, and its metrics."""
    folder, direct = body
    frames = [small.frame(p.stamp_ns, p.ids, p.markers) for p in direct]
    bag = small.write_bag(out.parent / "x.mcap", path(), frames)
    start = 1e-9 * (first - 0.5) * small.STEP_NS
    run(RunOptions(folder, bag, out, start=start), lambda text, *_: said.append(text))
    predictions = load_recording(out / "run.mcap").predictions
    assert [p.stamp_ns for p in predictions] == [p.stamp_ns for p in direct[first:]]  # nothing before is published
    off = [np.abs(a.points - b.markers).max() for a, b in zip(predictions, direct[first:], strict=True)]
    return max(off), json.loads((out / "metrics.json").read_text())


@pytest.mark.parametrize(("name", "first"), [("sets", AFTER), ("relaxes", WITHIN)])
def test_a_part_is_predicted_as_in_a_run_of_the_whole(
    name: str, first: int, bodies: dict[str, Body], tmp_path: Path
) -> None:
    """From nothing they were 1.9 and 3.5 mm off, and that was only doubted."""
    off, metrics = ran(bodies[name], tmp_path / "out", first, [])
    assert off < 1e-7  # m, as float32 has it: measured 9e-10
    assert metrics["doubts"] == [] and metrics["verdict"] == "OK"


def test_a_run_of_a_part_does_not_hold_what_was_before_it(bodies: dict[str, Body], tmp_path: Path) -> None:
    """The part itself was predicted as in a run of the whole; from its recording nobody can."""
    ran(bodies["sets"], tmp_path / "part", AFTER, [])
    run(RunOptions(bodies["sets"][0], tmp_path / "part", tmp_path / "again"), lambda *_: None)
    (doubt,) = [d for d in json.loads((tmp_path / "again" / "metrics.json").read_text())["doubts"] if "a run from" in d]
    assert doubt == "it is a run from 0.65 s on, without what the model would remember of before (plastic set)"


def test_what_the_model_cannot_go_through_is_doubted(
    bodies: dict[str, Body], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running, "pass_beginning", lambda model, poses, tell: len(poses))  # no equilibrium at any
    said: list[str] = []
    off, metrics = ran(bodies["sets"], tmp_path / "out", AFTER, said)
    assert off > 1e-3
    (doubt,) = metrics["doubts"]
    assert "leaves out presses that the model would remember (plastic set)" in doubt and f"warning: {doubt}" in said
