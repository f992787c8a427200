"""A force sensor that was not tared is doubted; noise, drift, threads, a turned tool and a swollen body are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.recorded import check_recording
from livedeform.common.checks.tared import check_tared
from livedeform.common.experiment.schema import Experiment, ProbeShape
from livedeform.common.experiment.surface import Surface
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Array, Pose, Wrench

BLOCK = trimesh.creation.box((0.06, 0.06, 0.05))  # as the experiment of `conftest.folder`
BLOCK.apply_translation((0.0, 0.0, 0.025))
BODY = Surface(np.asarray(BLOCK.vertices, float), np.asarray(BLOCK.faces, np.int64))
TOP, PERIOD, LARGEST = 0.05, 0.02, 3.0  # m, s and N
SECONDS = np.arange(0.0, 12.0, PERIOD)
START_NS = 1_700_000_000_000_000_000


def depth_at(t: Array, hang: float = 0.005, deepest: float = 0.006) -> Array:
    """Depth (n,) m: hanging in the air, and two presses of 3 s from 2 and from 7 s on."""
    course = sum(np.clip(np.minimum(t - a, a + 3.0 - t), 0.0, 1.0) for a in (2.0, 7.0))
    return np.asarray(-hang + (hang + deepest) * course)


def pushed(depth: Array, height: float = 0.0) -> Array:
    """Force (n, 3) N on the body, whose top is ``height`` m above the given one; up to `LARGEST`."""
    out = np.zeros((len(depth), 3))
    out[:, 2] = -LARGEST * np.clip(depth + height, 0.0, None) / 0.006
    return out


def recorded(depth: Array, force: Array, tilt: Array | float = 0.0) -> Recording:
    """Poses and wrenches; the probe is tilted by ``tilt`` (n,) rad from pressing straight down."""
    angles = np.pi + np.broadcast_to(np.asarray(tilt, float), depth.shape)
    turns = Rotation.from_rotvec(np.outer(angles, [1.0, 0.0, 0.0])).as_quat()
    stamps = [START_NS + round(1e9 * s) for s in SECONDS]
    places = [np.array([0.0, 0.0, TOP - d]) for d in depth]
    poses = [Pose(*each) for each in zip(stamps, places, turns, strict=True)]
    wrenches = [Wrench(stamp, f, np.zeros(3)) for stamp, f in zip(stamps, force, strict=True)]
    return Recording(Path(), stamps[0], stamps[-1], [], poses, wrenches, {}, {})


def said(recording: Recording, experiment: Experiment) -> list[Finding]:
    return check_tared(recording, experiment, BODY)


@pytest.fixture
def experiment(folder: Path) -> Experiment:
    """The block, scanned as it is held, and a ball that presses it."""
    loaded = load_experiment(folder, geometry=False)
    assert loaded.probe is not None
    phantom = loaded.phantom.model_copy(update={"configuration": "loaded", "scan_gravity": loaded.phantom.gravity})
    probe = loaded.probe.model_copy(update={"shape": ProbeShape(sphere=0.01)})
    return loaded.model_copy(update={"phantom": phantom, "probe": probe})


@pytest.mark.parametrize("level", [(0.0, 0.0, -1.5), (0.3, 0.0, 0.0), (-0.15, 0.15, 0.1), (0.0, 0.0, 40.0)])
@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3])
def test_a_sensor_that_was_not_tared_is_doubted(level: tuple[float, ...], noise: float, experiment: Experiment) -> None:
    """From 8 % of the largest force on; it went into the stiffness, which came out half as large again."""
    depth = depth_at(SECONDS)
    force = pushed(depth) + level + noise * np.random.default_rng(3).standard_normal((len(depth), 3))
    (found,) = said(recorded(depth, force), experiment)
    assert found.level == "WARN" and found.doubts and "not tared" in found.text and "tare" in found.remedy
    told = np.array([float(word) for word in found.text.split("(")[1].split(")")[0].split(",")])
    np.testing.assert_allclose(told, level, atol=0.005 * np.linalg.norm(level) + 0.5 * noise)


def test_the_sentence_is_as_exact_as_the_force_is_large(experiment: Experiment) -> None:
    depth = depth_at(SECONDS)
    (found,) = said(recorded(depth, pushed(depth) + np.array([0.0, 0.0, -1.5])), experiment)
    assert found.text == "the wrench is not tared: (0.00, 0.00, -1.50) N while the probe is in the air"
    (found,) = said(recorded(depth, 1e-3 * (pushed(depth) + np.array([0.0, 0.0, -1.5]))), experiment)
    assert "(0.00000, 0.00000, -0.00150) N" in found.text


@pytest.mark.parametrize("hang", [0.003, 0.02])
@pytest.mark.parametrize("first", [0, 300], ids=["begins in the air", "begins within a press"])
def test_it_is_doubted_wherever_the_probe_hangs(hang: float, first: int, experiment: Experiment) -> None:
    depth = depth_at(SECONDS, hang)
    force = pushed(depth) + np.array([0.0, 0.0, -0.5])
    begin = 0 if not first else int(3.5 / PERIOD)
    whole = recorded(depth, force)
    part = replace(whole, poses=whole.poses[begin:], wrenches=whole.wrenches[begin:])
    assert len(said(part, experiment)) == 1


def test_every_command_says_so(experiment: Experiment, folder: Path) -> None:
    """`check_recording` is what info, run, live and diagnose ask."""
    depth = depth_at(SECONDS)
    for level, n in ((-1.5, 1), (0.0, 0)):
        recording = recorded(depth, pushed(depth) + np.array([0.0, 0.0, level]))
        found = [f for f in check_recording(recording, experiment) if "tared" in f.text]
        assert len(found) == n


def _noise(seed: int) -> Array:
    return np.random.default_rng(seed).standard_normal((len(SECONDS), 3))


def _slow_noise(seed: int) -> Array:
    """Noise that lasts for half a second, of a unit scatter."""
    kernel = np.exp(-np.arange(0.0, 2.0, PERIOD) / 0.5)
    white = np.random.default_rng(seed).standard_normal((len(SECONDS) + len(kernel) - 1, 3))
    return np.array([np.convolve(x, kernel, "valid") for x in white.T]).T / np.sqrt(np.sum(kernel**2))


DEPTH = depth_at(SECONDS)
SOUND: dict[str, Callable[[int], Array]] = {
    "no noise": lambda seed: pushed(DEPTH),
    "little noise": lambda seed: pushed(DEPTH) + 0.02 * _noise(seed),
    "noise of a tenth": lambda seed: pushed(DEPTH) + 0.3 * _noise(seed),
    "noise as large as the force": lambda seed: pushed(DEPTH) + LARGEST * _noise(seed),
    "slow noise": lambda seed: pushed(DEPTH) + 0.1 * _slow_noise(seed),
    "a drift of 4 %": lambda seed: pushed(DEPTH) + np.outer(SECONDS / SECONDS[-1], [0.0, 0.0, 0.04 * LARGEST]),
    "tared to 3 %": lambda seed: pushed(DEPTH) + np.array([0.0, 0.0, 0.03 * LARGEST]),
    "a drift of 15 % after it was tared": lambda seed: (
        pushed(DEPTH) + np.outer(SECONDS / SECONDS[-1], [0.0, 0.0, 0.15 * LARGEST])
    ),
    "wild readings": lambda seed: pushed(DEPTH) + 50.0 * (np.random.default_rng(seed).random((len(DEPTH), 1)) < 0.01),
}


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("name", SOUND)
def test_a_sensor_that_was_tared_is_not_doubted(name: str, seed: int, experiment: Experiment) -> None:
    assert said(recorded(DEPTH, SOUND[name](seed)), experiment) == []


def test_a_body_that_adheres_pulls_threads_and_is_not_doubted(experiment: Experiment) -> None:
    """Where the recording begins within a press, too: then only what comes after it is in the air."""
    retreats = np.diff(DEPTH, append=DEPTH[-1]) < 0.0
    thread = retreats & (DEPTH < 0.0) & (DEPTH > -0.004)
    force = pushed(DEPTH) + np.outer(thread, [0.0, 0.0, 0.3 * LARGEST])
    whole, begin = recorded(DEPTH, force), int(3.5 / PERIOD)
    assert said(whole, experiment) == []
    assert said(replace(whole, poses=whole.poses[begin:], wrenches=whole.wrenches[begin:]), experiment) == []


@pytest.mark.parametrize("height", [-0.004, 0.001, 0.002])
def test_a_body_that_sagged_or_swelled_is_not_doubted(height: float, experiment: Experiment) -> None:
    """Swollen by 4 % of its height, it is touched before the probe is where its surface was."""
    assert said(recorded(DEPTH, pushed(DEPTH, height)), experiment) == []


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_tool_that_weighs_otherwise_when_it_is_turned_is_not_doubted(when: str, experiment: Experiment) -> None:
    """It was tared as it presses; in the air it is turned by 60 degrees for a while, and weighs on the sensor."""
    turned = (SECONDS < 1.0) if when == "before" else (SECONDS > 10.5)
    tilt = np.pi / 3.0 * turned
    weight = 2.0 * np.column_stack([np.zeros(len(tilt)), np.sin(tilt), 1.0 - np.cos(tilt)])
    assert said(recorded(DEPTH, pushed(DEPTH) + weight, tilt), experiment) == []
    assert len(said(recorded(DEPTH, pushed(DEPTH) + weight + [0.0, 0.0, 0.5], tilt), experiment)) == 1


def test_nothing_is_said_where_it_is_not_known(experiment: Experiment) -> None:
    """Of a probe that never is in the air, or never touches, and without forces."""
    untared = pushed(DEPTH) + np.array([0.0, 0.0, -1.5])
    assert said(recorded(np.full(len(DEPTH), 0.003), untared), experiment) == []
    assert said(recorded(np.full(len(DEPTH), -0.01), untared), experiment) == []
    assert said(replace(recorded(DEPTH, untared), wrenches=[]), experiment) == []


def test_a_body_that_sags_towards_the_probe_is_not_taken_for_air(experiment: Experiment) -> None:
    """Scanned without weight it may sag by 3.8 mm: a probe that presses from below is clear of it further away only."""
    phantom = experiment.phantom.model_copy(update={"gravity": (0.0, 0.0, 9.81), "scan_gravity": (0.0, 0.0, 0.0)})
    hangs = experiment.model_copy(update={"phantom": phantom})
    assert said(recorded(DEPTH, pushed(DEPTH, 0.003)), hangs) == []
    assert said(recorded(DEPTH, pushed(DEPTH, 0.006)), hangs) == []  # 1 mm more than that, and all the time
