"""What begins within a press, or after presses that the model remembers, is doubted; what begins in the air is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.beginning import check_beginning, check_left_out, check_start
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.probe_path import ProbeRecord
from livedeform.common.experiment.schema import Experiment, ProbeShape
from livedeform.common.experiment.surface import Surface
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Array, MarkerFrame, Pose, Wrench

BLOCK = trimesh.creation.box((0.06, 0.06, 0.05))  # as the experiment of `conftest.folder`, which sags by up to 4.4 mm
BLOCK.apply_translation((0.0, 0.0, 0.025))
BODY = Surface(np.asarray(BLOCK.vertices, float), np.asarray(BLOCK.faces, np.int64))
TOP, PERIOD, SAGS = 0.05, 0.02, 0.002  # m, s, and m by which the body of these recordings sags
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
SECONDS = np.arange(0.0, 12.0, PERIOD)
START_NS = 1_700_000_000_000_000_000
PLACES = np.array([[0.01 * i, 0.01 * j, TOP] for i in (-1, 0, 1) for j in (-1, 0, 1)])
KEEPS, RUBS = ("plastic set",), ("friction",)


def depth_at(t: Array, hang: float, deepest: float) -> Array:
    """Depth (n,) m in the body as given: hanging at ``hang``, presses from 2 to 5 and from 7 to 10 s."""
    course = sum(np.clip(np.minimum(t - a, a + 3.0 - t), 0.0, 1.0) for a in (2.0, 7.0))
    return np.asarray(hang + (deepest - hang) * course)


def recorded(hang: float = -0.003, deepest: float = 0.008, *, wrench: bool = True, markers: bool = False) -> Recording:
    return along(depth_at(SECONDS, hang, deepest), wrench=wrench, markers=markers)


def along(depth: Array, *, wrench: bool = True, markers: bool = False) -> Recording:
    """A ball over a body that sags: what it pushes and moves counts from `SAGS` below the given surface."""
    pushes = np.clip(depth - SAGS, 0.0, None)
    stamps = [START_NS + round(1e9 * s) for s in SECONDS]
    rng, n = np.random.default_rng(1), len(PLACES)
    noise = 0.02 * rng.standard_normal((len(depth), 3))
    force = noise - np.outer(pushes, [0.0, 0.0, 400.0])
    wrenches = [Wrench(s, f, np.zeros(3)) for s, f in zip(stamps, force, strict=True)]
    sunk = [PLACES - np.outer(np.ones(n), [0.0, 0.0, 0.3 * p]) + 2e-5 * rng.standard_normal((n, 3)) for p in pushes]
    covariances, unknown = np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    ids = np.arange(n, dtype=np.uint32)
    frames = [MarkerFrame(s, ids, p, covariances, unknown) for s, p in zip(stamps, sunk, strict=True)]
    poses = [Pose(s, np.array([0.0, 0.0, TOP - d]), DOWN) for s, d in zip(stamps, depth, strict=True)]
    forces = wrenches if wrench else []
    return Recording(Path(), stamps[0], stamps[-1], frames if markers else [], poses, forces, {}, {})


def from_second(whole: Recording, begin: float) -> Recording:
    row = int(begin / PERIOD)
    frames, poses, wrenches = (each[row:] for each in (whole.marker_frames, whole.poses, whole.wrenches))
    return replace(whole, marker_frames=frames, poses=poses, wrenches=wrenches)


@pytest.fixture
def experiment(folder: Path) -> Experiment:
    """The block, scanned without its weight, and a ball that presses it."""
    loaded = load_experiment(folder, geometry=False)
    assert loaded.probe is not None
    probe = loaded.probe.model_copy(update={"shape": ProbeShape(sphere=0.01)})
    return loaded.model_copy(update={"probe": probe})


def texts(found: list[Finding]) -> str:
    assert all(f.level == "WARN" and f.doubts and f.remedy for f in found)
    return " | ".join(f.text for f in found)


WITHIN, AIR = (2.9, 3.5, 4.2, 8.5), (0.5, 1.9, 5.5, 6.0, 11.0)


@pytest.mark.parametrize("start", WITHIN)
@pytest.mark.parametrize("by", [{"wrench": False}, {"wrench": True}, {"wrench": False, "markers": True}])
def test_a_start_within_a_press_is_doubted(start: float, by: dict[str, bool], experiment: Experiment) -> None:
    """The cameras were registered to the pressed body, and an error of 0.31 mm was said to be 0.17 mm, and OK."""
    probe = ProbeRecord(recorded(**by), experiment, BODY)
    assert "begins within a press" in texts(check_left_out(probe, start, (), ()))
    said = texts(check_start(probe, start, registers=True))
    assert "begins within a press" in said and "cameras are registered" in said
    (noted,) = check_start(probe, start, registers=False)
    assert noted.level == "NOTE" and not noted.doubts and "begins within a press" in noted.text


@pytest.mark.parametrize("start", AIR)
@pytest.mark.parametrize("by", [{"wrench": False}, {"wrench": True}, {"wrench": True, "markers": True}])
@pytest.mark.parametrize("hang", [-0.01, -0.003, 0.0015])
def test_a_start_in_the_air_is_not_doubted(
    start: float, by: dict[str, bool], hang: float, experiment: Experiment
) -> None:
    """At 1.5 mm below the surface as given, too, where the body sagged away from it."""
    probe = ProbeRecord(recorded(hang, **by), experiment, BODY)
    assert check_left_out(probe, start, (), ()) == check_start(probe, start, registers=True) == []
    assert check_beginning(probe) == []


def test_a_drift_of_all_markers_is_no_press(experiment: Experiment) -> None:
    whole = recorded(-0.02, -0.015, markers=True)
    drifts = [replace(f, points=f.points + 1e-6 * k) for k, f in enumerate(whole.marker_frames)]
    whole = replace(whole, marker_frames=drifts)
    probe = ProbeRecord(whole, experiment, BODY)
    assert all(check_left_out(probe, start, KEEPS, RUBS) == [] for start in (0.5, 6.0, 11.0))


@pytest.mark.parametrize("wrench", [False, True])
@pytest.mark.parametrize(("begin", "doubted"), [(3.5, True), (4.2, True), (0.0, False), (1.5, False), (6.0, False)])
def test_a_recording_that_begins_within_a_press_is_doubted(
    begin: float, doubted: bool, wrench: bool, experiment: Experiment
) -> None:
    """The probe is 5 mm deep at 3.5 s, and 3.4 mm at 4.2 s: less than a body that may sag so far allows for, 5.4 mm."""
    part = from_second(recorded(deepest=0.005, wrench=wrench), begin)
    found = check_beginning(ProbeRecord(part, experiment, BODY))
    assert ("begins within a press" in texts(found)) == doubted


@pytest.mark.parametrize("markers", [False, True])
def test_presses_that_the_model_remembers_are_not_left_out_without_a_word(
    markers: bool, experiment: Experiment
) -> None:
    """With a plastic set the predictions differed by 0.24 mm, and nothing said so. That is of a model that could not go
    through what came before."""
    probe = ProbeRecord(recorded(markers=markers), experiment, BODY)
    assert check_left_out(probe, 1.0, KEEPS, RUBS) == []  # nothing was pressed until then
    said = texts(check_left_out(probe, 6.0, KEEPS, RUBS))
    assert said == "--start 6 s leaves out presses that the model would remember (plastic set)"
    assert check_left_out(probe, 6.0, (), RUBS) == []  # it let go meanwhile
    within = texts(check_left_out(probe, 8.5, (), RUBS))
    assert "begins within a press" in within and "remember (friction)" in within
    assert check_left_out(probe, 0.0, KEEPS, RUBS) == []


def drawn_back(first: float, back: float, deepest: float) -> Array:
    """Depth (n,) m: ``first`` for a second, ``back`` m further out, a press from 4 to 7 s, and out again."""
    away = first - back
    return np.asarray(np.interp(SECONDS, [1.0, 2.0, 4.0, 5.0, 6.0, 7.0], [first, away, away, deepest, deepest, away]))


NOTHING, FORCES, MARKERS = {"wrench": False}, {"wrench": True}, {"wrench": False, "markers": True}


@pytest.mark.parametrize("back", [0.004, 0.05])
@pytest.mark.parametrize(
    ("deepest", "by"), [(0.004, NOTHING), (0.008, NOTHING), (0.0035, FORCES), (0.008, FORCES), (0.0028, MARKERS)]
)
def test_how_far_a_probe_is_drawn_back_tells_no_press(
    back: float, deepest: float, by: dict[str, bool], experiment: Experiment
) -> None:
    """It hovers 0.5 mm over the sagged top, which is 1.5 mm below the surface as given, and is then drawn back: half of
    all its way was a press, were it 16 mm in the air. Forces as in the air, or markers that stay, clear it where half
    of the way into the body is not reached either."""
    probe = ProbeRecord(along(drawn_back(SAGS - 0.0005, back, deepest), **by), experiment, BODY)
    assert check_beginning(probe) == check_left_out(probe, 0.5, (), ()) == []
    if by is FORCES:
        assert check_left_out(probe, 3.0, KEEPS, RUBS) == []


@pytest.mark.parametrize("back", [0.007, 0.05])
@pytest.mark.parametrize("by", [NOTHING, FORCES, MARKERS])
def test_a_press_at_first_is_doubted_however_far_the_probe_is_drawn_back(
    back: float, by: dict[str, bool], experiment: Experiment
) -> None:
    whole = along(drawn_back(0.0042, back, 0.005), **by)
    if by is FORCES:  # which no wild reading hides
        wild = replace(whole.wrenches[100], force=np.array([0.0, 0.0, 300.0]))
        whole = replace(whole, wrenches=[*whole.wrenches[:100], wild, *whole.wrenches[101:]])
    probe = ProbeRecord(whole, experiment, BODY)
    assert "begins within a press" in texts(check_beginning(probe))
    assert "remember (plastic set)" in texts(check_left_out(probe, 3.0, KEEPS, ()))
