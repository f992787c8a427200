"""A body that deforms before the probe comes to it is doubted; knocked cameras, drifts, noise and lateness are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from livedeform.common.bags.recording import Recording, load_recording
from livedeform.common.checks.contact.first_motion import check_first_motion
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.probe_path import ProbeRecord
from livedeform.common.checks.recorded import check_recording
from livedeform.common.experiment.plausibility import read_body
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Array, MarkerFrame, Pose

BLOCK = trimesh.creation.box((0.06, 0.06, 0.05))  # as the experiment of `conftest.folder`
BLOCK.apply_translation((0.0, 0.0, 0.025))
BODY = Surface(np.asarray(BLOCK.vertices, float), np.asarray(BLOCK.faces, np.int64))
BAGS = Path(__file__).parents[2] / "bags"
PLACES = np.array([[x, y, z] for x in (-0.03, 0.03) for y in (-0.02, 0.0, 0.02) for z in (0.01, 0.03, 0.045)])
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
TOP, PERIOD = 0.05, 0.1


@pytest.fixture
def experiment(folder: Path) -> Experiment:
    """The block, scanned as it is held, and a plate that presses it."""
    loaded = load_experiment(folder, geometry=False)
    phantom = loaded.phantom.model_copy(update={"configuration": "loaded", "scan_gravity": loaded.phantom.gravity})
    return loaded.model_copy(update={"phantom": phantom, "loads": ()})


def course(t: Array, speed: float = 0.006, hang: float = 0.005, deepest: float = 0.004, at: float = 3.0) -> Array:
    """Depth (n,) m of one press that begins at ``at`` s and is held for 2 s."""
    takes = (hang + deepest) / speed
    return np.interp(t, [at, at + takes, at + takes + 2.0, at + 2.0 * takes + 2.0], [-hang, deepest, deepest, -hang])


def squeezed(depth: float) -> Array:
    s = 1.0 - max(depth, 0.0) / TOP
    return np.asarray(PLACES * [s**-0.5, s**-0.5, s])


def recorded(
    motion=lambda t, p: p, *, off: float = 0.0, late: float = 0.0, noise: float = 1e-4, n: int = len(PLACES), **press
) -> Recording:
    """Markers that ``motion`` (t s, points) changes, poses ``off`` m too high, and markers ``late`` s."""
    rng, takes = np.random.default_rng(2), 12.0 + 2.0 * press.get("at", 3.0)
    frames, nothing = [], (np.full((n, 3, 3), np.nan), np.full(n, np.nan))
    for t in np.arange(0.0, takes, PERIOD):
        points = motion(t, squeezed(float(course(np.array(t - late), **press)))) + noise * rng.standard_normal(
            PLACES.shape
        )
        frames.append(MarkerFrame(round(1e9 * t), np.arange(n, dtype=np.uint32), points[:n], *nothing))
    seconds = np.arange(0.0, takes, 0.02)
    depths = course(seconds, **press)
    poses = [
        Pose(round(1e9 * t), np.array([0.0, 0.0, TOP - d + off]), DOWN) for t, d in zip(seconds, depths, strict=True)
    ]
    return Recording(Path(), 0, frames[-1].stamp_ns, frames, poses, [], {}, {})


def said(recording: Recording, experiment: Experiment) -> list[Finding]:
    return check_first_motion(ProbeRecord(recording, experiment, BODY))


@pytest.mark.parametrize("off", [0.005, 0.0055, 0.0059])
@pytest.mark.parametrize("noise", [0.0, 1e-4, 2e-4])
def test_poses_that_are_too_high_are_doubted(off: float, noise: float, experiment: Experiment) -> None:
    """The press was told as a first contact at 0.0 mm, by a note."""
    (found,) = said(recorded(off=off, noise=noise), experiment)
    assert found.level == "WARN" and found.doubts and not found.of_forces and "height of the poses" in found.remedy
    above = float(found.text.split("the probe is ")[1].split(" mm")[0])
    assert off - 0.003 < 1e-3 * above < off  # of a press of 4 mm, as a quarter of it shows
    assert [f.text for f in check_recording(recorded(off=off), experiment)].count(
        said(recorded(off=off), experiment)[0].text
    ) == 1


@pytest.mark.parametrize("off", [0.0, 0.002, -0.003])
@pytest.mark.parametrize("noise", [2e-4, 1e-3])
@pytest.mark.parametrize("speed", [0.001, 0.006, 0.1])
def test_a_press_as_it_is_is_not_doubted(off: float, noise: float, speed: float, experiment: Experiment) -> None:
    """Nor by what a scan or a tool's length is off, nor by 50 ms of a clock, of a slow press or a fast poke."""
    for late in (0.0, -0.05, 0.05):
        found = said(recorded(off=off, noise=noise, late=late, speed=speed), experiment)
        assert not [f for f in found if f.level != "NOTE"] and (off or not found)


def knocked(t: float, p: Array) -> Array:
    """A camera that is knocked by 3 mm and 2 degrees while the probe is in the air."""
    return Rotation.from_euler("y", 2.0, degrees=True).apply(p) + np.array([0.003, 0.0, 0.001]) if t > 6.0 else p


def creeping(t: float, p: Array) -> Array:
    """A sag that grows by 3 mm at the top, most of it at first."""
    return p * [1.0, 1.0, 1.0 - 0.06 * (1.0 - np.exp(-t / 8.0))]


def swelling(t: float, p: Array) -> Array:
    return p * (1.0 + 2e-3 * t)


@pytest.mark.parametrize("motion", [knocked, creeping, swelling])
@pytest.mark.parametrize("at", [3.0, 10.0])
@pytest.mark.parametrize("speed", [0.003, 0.02])
def test_what_else_moves_markers_is_not_doubted(motion, at: float, speed: float, experiment: Experiment) -> None:
    assert [f.level for f in said(recorded(motion, at=at, speed=speed), experiment) if f.level != "NOTE"] == []


def test_exchanged_ids_and_few_markers_tell_nothing(experiment: Experiment) -> None:
    def exchanged(t: float, p: Array) -> Array:
        return p[[1, 0, *range(2, len(p))]] if t > 2.0 else p

    assert said(recorded(exchanged), experiment) == []
    assert said(recorded(off=0.005, n=3), experiment) == []


@pytest.mark.parametrize("late", [0.7, 1.5])
def test_clocks_that_are_apart_are_noted(late: float, experiment: Experiment) -> None:
    """A diagnosis finds a time offset: no doubt."""
    (found,) = said(recorded(late=late), experiment)
    assert found.level == "NOTE" and not found.doubts
    said_so = f"the body is pressed {late:.1f} s after the probe comes: clocks may differ, or the poses are off"
    assert found.text == said_so + " along the probe"


def test_of_a_body_that_sags_nothing_is_said(folder: Path) -> None:
    """Its top may be as much lower than the surface as given."""
    soft = load_experiment(folder, geometry=False)
    assert ProbeRecord(recorded(), soft, BODY).sag > 0.003
    assert said(recorded(off=0.004), soft) == []


@pytest.mark.parametrize("name", ["breast_phantom", "gelatin_cuboid"])
@pytest.mark.parametrize("which", ["a", "b"])
def test_the_shipped_recordings_are_not_doubted(name: str, which: str) -> None:
    """The breast's markers are those of the truth."""
    folder = BAGS / name
    experiment = load_experiment(folder / "experiment")
    recording = load_recording(folder / "bags" / which, experiment)
    frames = recording.measured_frames
    if not frames:
        truth, ids = np.load(folder / "truth" / f"{which}.npz"), experiment.markers.ids
        none = np.full((len(ids), 3, 3), np.nan), np.full(len(ids), np.nan)
        frames = [MarkerFrame(int(s), ids, p, *none) for s, p in zip(truth["stamps_ns"], truth["markers"], strict=True)]
    part = Recording(Path(), recording.start_ns, recording.end_ns, frames, recording.poses, [], {}, {})
    assert check_first_motion(ProbeRecord(part, experiment, read_body(experiment))) == []
