"""A force of the wrong sign or along another axis is doubted; rubbing, sticking, slopes, lateness and noise are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from livedeform.common.bags.recording import Recording, load_recording
from livedeform.common.checks.contact.pushing import check_pushing, pushed
from livedeform.common.checks.probe_path import ProbeRecord
from livedeform.common.checks.recorded import check_recording
from livedeform.common.experiment.plausibility import read_body
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Array, Pose, Wrench

BLOCK = trimesh.creation.box((0.06, 0.06, 0.05))  # as the experiment of `conftest.folder`
BLOCK.apply_translation((0.0, 0.0, 0.025))
BODY = Surface(np.asarray(BLOCK.vertices, float), np.asarray(BLOCK.faces, np.int64))
BAGS = Path(__file__).parents[2] / "bags"
PERIOD, STIFFNESS = 0.02, 400.0  # s and N/m
SECONDS = np.arange(0.0, 12.0, PERIOD)
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
START_NS = 1_700_000_000_000_000_000


def way(deepest: float = 0.006, sideways: float = 0.0, hang: float = 0.005) -> Array:
    """Places (n, 3) m of two presses, from 2 and from 7 s on, and of a way aside while it is deepest."""
    course = sum(np.clip(np.minimum(SECONDS - a, a + 3.0 - SECONDS), 0.0, 1.0) for a in (2.0, 7.0))
    aside = sum(np.clip(SECONDS - a, 0.0, 1.0) for a in (3.0, 8.0))
    return np.column_stack([sideways * aside, 0.0 * course, 0.05 + hang - (hang + deepest) * course])


def pressing(places: Array) -> Array:
    """Return the force (n, 3) N of a spring that is pressed down."""
    return np.outer(STIFFNESS * np.clip(0.05 - places[:, 2], 0.0, None), [0.0, 0.0, -1.0])


def recorded(places: Array, force: Array, quaternion: Array = DOWN) -> Recording:
    stamps = [START_NS + round(1e9 * s) for s in SECONDS]
    poses = [Pose(stamp, place, quaternion) for stamp, place in zip(stamps, places, strict=True)]
    wrenches = [Wrench(stamp, f, np.zeros(3)) for stamp, f in zip(stamps, force, strict=True)]
    return Recording(Path(), stamps[0], stamps[-1], [], poses, wrenches, {}, {})


def said(recording: Recording, experiment: Experiment) -> list[str]:
    found = check_pushing(ProbeRecord(recording, experiment, BODY))
    assert all(f.level == "WARN" and f.doubts and f.of_forces and "on the phantom" in f.remedy for f in found)
    return [f.text for f in found]


@pytest.mark.parametrize("level", [(0.0, 0.0, 0.0), (0.0, 0.0, -1.5), (0.5, -0.5, 3.0)])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_the_force_on_the_probe_is_doubted_and_that_on_the_body_is_not(
    level: tuple[float, float, float], noise: float, experiment: Experiment
) -> None:
    """A sensor that was not tared is said by another check, and does not hide the sign."""
    scatter = noise * np.random.default_rng(3).standard_normal((len(SECONDS), 3)) + np.array(level)
    assert said(recorded(way(), pressing(way()) + scatter), experiment) == []
    (text,) = said(recorded(way(), -pressing(way()) + scatter), experiment)
    assert "is against the way (0, 0, -1) in which the probe presses" in text
    found = check_recording(recorded(way(), -pressing(way()) + scatter), experiment)
    assert len([f for f in found if "in which the probe presses" in f.text]) == 1
    assert len([f for f in found if "not tared" in f.text]) == int(level != (0.0, 0.0, 0.0))


@pytest.mark.parametrize("axes", [[2, 1, 0], [0, 2, 1]])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_force_along_another_axis_is_doubted(axes: list[int], sign: float, experiment: Experiment) -> None:
    (text,) = said(recorded(way(), sign * pressing(way())[:, axes]), experiment)
    assert "is across the way (0, 0, -1) in which the probe presses" in text


def test_a_force_in_the_frame_of_a_turned_sensor_is_doubted(experiment: Experiment) -> None:
    """A probe that presses sideways, read along the z of its sensor."""
    turn = Rotation.from_euler("y", 90.0, degrees=True).as_quat()
    places = np.column_stack([-0.03 - (way()[:, 2] - 0.05), 0.0 * SECONDS, 0.025 + 0.0 * SECONDS])
    right = pressing(way())[:, [2, 1, 0]] * -1.0
    assert said(recorded(places, right, turn), experiment) == []
    (text,) = said(recorded(places, pressing(way()), turn), experiment)
    assert "is across the way (1, 0, 0)" in text


@pytest.mark.parametrize("friction", [0.0, 0.5, 1.0])
def test_rubbing_and_sideways_drags_are_not_doubted(friction: float, experiment: Experiment) -> None:
    places = way(0.004, 0.012)
    force = pressing(places)
    moves = np.gradient(places[:, 0]) > 0.0
    force[:, 0] = np.where(moves, -friction * force[:, 2], 0.0)
    assert said(recorded(places, force), experiment) == []


@pytest.mark.parametrize("slope", [30.0, 60.0, 78.0])
def test_a_slope_without_friction_is_not_doubted(slope: float, experiment: Experiment) -> None:
    """The force is across the surface, not along the probe."""
    size = np.linalg.norm(pressing(way()), axis=1)
    angle = np.radians(slope)
    assert said(recorded(way(), np.outer(size, [np.sin(angle), 0.0, -np.cos(angle)])), experiment) == []


@pytest.mark.parametrize("pull", [0.5, 2.0, 5.0])
def test_a_probe_that_sticks_and_pulls_is_not_doubted(pull: float, experiment: Experiment) -> None:
    """It pulls ``pull`` times as strongly as it presses, until 4 mm above the body, and comes in again meanwhile."""
    z = np.interp(
        SECONDS, [0, 2, 3, 4, 6, 6.5, 8, 9, 10], [0.055, 0.055, 0.046, 0.046, 0.053, 0.05, 0.052, 0.055, 0.055]
    )
    places = np.column_stack([0.0 * z, 0.0 * z, z])
    sticks = (SECONDS > 3.0) & (SECONDS < 8.0)
    force = pressing(places)
    force[:, 2] += np.where(sticks, pull * STIFFNESS * np.clip(z - 0.05, 0.0, None), 0.0)
    assert said(recorded(places, force), experiment) == []


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_touch_within_noise_tells_nothing(sign: float, experiment: Experiment) -> None:
    noise = 0.5 * np.random.default_rng(4).standard_normal((len(SECONDS), 3))
    places = way(0.003)
    assert said(recorded(places, 0.2 * sign * pressing(places) + noise), experiment) == []
    shallow = way(0.0008)
    assert said(recorded(shallow, sign * pressing(shallow)), experiment) == []


@pytest.mark.parametrize("late", [-0.7, -0.1, 0.1, 0.7])
def test_a_force_that_is_late_is_not_doubted_for_its_sign(late: float, experiment: Experiment) -> None:
    force = np.column_stack([np.interp(SECONDS - late, SECONDS, each) for each in pressing(way()).T])
    assert said(recorded(way(), force), experiment) == []


@pytest.mark.parametrize("name", ["breast_phantom", "gelatin_cuboid"])
@pytest.mark.parametrize("which", ["a", "b"])
def test_the_shipped_recordings_push_along_the_probe(name: str, which: str) -> None:
    """The cosine is 0.995 to 0.997, and the work since the air never below -0.026 of that of a press."""
    experiment = load_experiment(BAGS / name / "experiment")
    recording = load_recording(BAGS / name / "bags" / which, experiment)
    probe = ProbeRecord(recording, experiment, read_body(experiment))
    push = pushed(probe)
    assert push is not None and push.along > 0.99 and push.least > -0.03 and check_pushing(probe) == []
    turned = [Wrench(wrench.stamp_ns, -wrench.force, wrench.torque) for wrench in recording.wrenches]
    other = Recording(Path(), recording.start_ns, recording.end_ns, [], recording.poses, turned, {}, {})
    (found,) = check_pushing(ProbeRecord(other, experiment, read_body(experiment)))
    assert "against the way" in found.text
