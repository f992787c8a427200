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
from livedeform.common.checks.probe_path import ProbeRecord
from livedeform.common.checks.recorded import check_recording
from livedeform.common.checks.tared import check_tared
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.types import Array, MarkerFrame, Pose, Wrench

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
    return [f for f in check_tared(ProbeRecord(recording, experiment, BODY)) if f.level != "NOTE"]


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


@pytest.mark.parametrize("level", [0.0, -1.5])
def test_it_is_said_where_nothing_tells_whether_it_was_tared(level: float, experiment: Experiment) -> None:
    """Where the probe is never surely clear of the body, turned as it presses; a force of 1.5 N went unnoticed there,
    and nobody was told that nobody looked. Where it never touches there is nothing to tell."""
    sideways = np.pi / 3.0 * (depth_at(SECONDS) < 0.0)
    force = pushed(DEPTH) + np.array([0.0, 0.0, level])
    near, turned = recorded(np.maximum(DEPTH, -0.001), force), recorded(DEPTH, force, sideways)
    for recording in (near, turned):
        (found,) = check_tared(ProbeRecord(recording, experiment, BODY))
        assert (
            found.level == "NOTE" and not found.doubts and "whether the wrench was tared cannot be told" in found.text
        )
    away = replace(near, poses=recorded(np.full(len(DEPTH), -0.01), pushed(DEPTH)).poses)
    for recording in (away, replace(near, wrenches=[]), recorded(DEPTH, pushed(DEPTH))):
        assert check_tared(ProbeRecord(recording, experiment, BODY)) == []


def test_a_body_that_sags_towards_the_probe_is_not_taken_for_air(experiment: Experiment) -> None:
    """Scanned without weight it may sag by 3.8 mm: a probe that presses from below is clear of it further away only."""
    phantom = experiment.phantom.model_copy(update={"gravity": (0.0, 0.0, 9.81), "scan_gravity": (0.0, 0.0, 0.0)})
    hangs = experiment.model_copy(update={"phantom": phantom})
    assert said(recorded(DEPTH, pushed(DEPTH, 0.003)), hangs) == []
    assert said(recorded(DEPTH, pushed(DEPTH, 0.006)), hangs) == []  # 1 mm more than that, and all the time


SAGGED = depth_at(SECONDS, -0.0015, 0.009)  # all of it below the surface as given


def seen(recording: Recording, moved: Array, noise: float = 2e-5) -> Recording:
    """The recording with a tracker's frames of nine markers, which are ``moved`` (n,) m downwards, and jitter."""
    rng, n = np.random.default_rng(5), 9
    places = np.array([[0.01 * i, 0.01 * j, TOP] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    points = [places - [0.0, 0.0, m] + noise * rng.standard_normal((n, 3)) for m in moved]
    rest = np.arange(n, dtype=np.uint32), np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    stamps = [pose.stamp_ns for pose in recording.poses]
    frames = [MarkerFrame(at, rest[0], p, *rest[1:]) for at, p in zip(stamps, points, strict=True)]
    return replace(recording, marker_frames=frames)


@pytest.mark.parametrize(("tracked", "noise"), [(False, 0.0), (True, 0.02)])
@pytest.mark.parametrize("level", [(0.0, 0.0, -0.3), (2.0, 0.0, -5.0), (0.0, 0.0, 0.0)])
def test_a_probe_that_hovers_over_a_sagged_body_tells_too(
    level: tuple[float, ...], noise: float, tracked: bool, experiment: Experiment
) -> None:
    """It is never above the surface as given, by which nothing told the air: of a shipped experiment 5 N went unnoticed
    beside presses of 0.5 N. Where it moves on unpushed is the air."""
    force = pushed(SAGGED, -0.004) + level + noise * _noise(2)
    recording = recorded(SAGGED, force)
    if tracked:
        recording = seen(recording, 0.2 * np.clip(SAGGED - 0.004, 0.0, None))
    if not any(level):
        assert check_tared(ProbeRecord(recording, experiment, BODY)) == []
        return
    (found,) = said(recording, experiment)
    assert found.level == "WARN" and found.doubts and found.of_forces
    told = np.array([float(word) for word in found.text.split("(")[1].split(")")[0].split(",")])
    np.testing.assert_allclose(told, level, atol=0.005 * np.linalg.norm(level) + 0.5 * noise)


def law(power: float, precompressed: float) -> Array:
    """Force (n, 3) N of a body that the probe presses by ``precompressed`` m where it is the shallowest."""
    out = np.zeros((len(SAGGED), 3))
    out[:, 2] = -LARGEST * ((SAGGED - SAGGED.min() + precompressed) / np.ptp(SAGGED)) ** power
    return out


@pytest.mark.parametrize("relaxes", [False, True])
@pytest.mark.parametrize("precompressed", [0.0005, 0.02])
@pytest.mark.parametrize("power", [1.0, 1.5, 2.0])  # of a flat face, of a ball and of a cone
def test_a_probe_that_rests_on_the_body_all_the_time_is_not_doubted(
    power: float, precompressed: float, relaxes: bool, experiment: Experiment
) -> None:
    """However lightly: where it goes deeper the force follows. On the way back it may be less, or none."""
    force = law(power, precompressed)
    if relaxes:
        back = (np.diff(SAGGED, append=SAGGED[-1]) < 0.0) & (SAGGED < 0.006)
        force[back] = 0.0
    assert said(recorded(SAGGED, force + 0.01 * _noise(1)), experiment) == []


def test_a_force_that_is_held_is_not_taken_for_the_air(experiment: Experiment) -> None:
    """Led over a body that is uneven, or that gives way, with 5 N: across its axis, or with markers that go along."""
    held = np.zeros((len(SAGGED), 3))
    held[:, 2] = -5.0 + pushed(SAGGED, -0.005)[:, 2]
    recording = recorded(SAGGED, held + 0.01 * _noise(1))
    across = [
        replace(pose, position=pose.position + np.array([5.0 * (d - SAGGED.min()), 0.0, 0.0]))
        for pose, d in zip(recording.poses, SAGGED, strict=True)
    ]
    assert len(said(recording, experiment)) == 1  # without either nothing tells it from the air
    assert said(replace(recording, poses=across), experiment) == []
    for moved in (SAGGED - SAGGED.min(), SAGGED.max() - SAGGED):  # from a rest in the air, or within a press
        assert said(seen(recording, 0.5 * moved), experiment) == []
