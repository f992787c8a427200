"""Markers with wrong ids, in another frame, unit or handedness are doubted; soft, pressed and noisy bodies are not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from livedeform.common.bags.recording import Recording, load_recording
from livedeform.common.checks.arrangement import check_arrangement, may_sag
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
RING = np.array([
    [0.03 * np.cos(a), 0.03 * np.sin(a), z] for z in (0.01, 0.02, 0.03) for a in np.arange(0.0, 2.0 * np.pi, np.pi / 4)
])  # fmt: skip
LATTICE = np.stack(np.meshgrid(np.linspace(-0.024, 0.024, 5), np.linspace(-0.02, 0.02, 4), [0.05]), axis=-1).reshape(
    -1, 3
)
COMPACT = np.array([[0.03, 0.0, 0.02], [0.0, 0.03, 0.03], [-0.02, -0.01, 0.05]])
LINE = np.array([0.0, 0.0, 0.03]) + np.outer(np.linspace(-0.02, 0.03, 6), [0.9, 0.3, 0.3])
SOME = np.random.default_rng(5).uniform([-0.03, -0.03, 0.005], [0.03, 0.03, 0.05], (15, 3))
PATTERNS = {"rings": RING, "lattice": LATTICE, "three": COMPACT, "line": LINE, "scattered": SOME}
Motion = Callable[[Array], Array]


def turned(axis: str, degrees: float, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Motion:
    R = Rotation.from_euler(axis, degrees, degrees=True)
    return lambda p: np.asarray(R.apply(p) + shift)


def experiment_of(folder: Path, places: Array, **phantom: object) -> Experiment:
    """The block of 4 kPa with markers 10, 11, ... at ``places`` (n, 3) m."""
    lines = ["id,x,y,z", *(f"{10 + k},{x:.9f},{y:.9f},{z:.9f}" for k, (x, y, z) in enumerate(places))]
    (folder / "markers.csv").write_text("\n".join(lines) + "\n")
    loaded = load_experiment(folder, geometry=False)
    by = {"phantom": loaded.phantom.model_copy(update=phantom), "loads": ()}
    return loaded.model_copy(update=by)


def recorded(points: Array, ids: list[int] | None = None, noise: float = 1e-4, poses: list[Pose] | None = None):
    """Five seconds in which the markers stay where they are."""
    rng = np.random.default_rng(1)
    numbers = np.array(ids if ids is not None else range(10, 10 + len(points)), np.uint32)
    nothing = np.full((len(points), 3, 3), np.nan), np.full(len(points), np.nan)
    frames = [
        MarkerFrame(round(1e8 * k), numbers, points + noise * rng.standard_normal(points.shape), *nothing)
        for k in range(50)
    ]
    return Recording(Path(), 0, frames[-1].stamp_ns, frames, poses or [], [], {}, {})


def said(recording: Recording, experiment: Experiment, body: Surface = BODY) -> list[Finding]:
    found = check_arrangement(ProbeRecord(recording, experiment, body))
    assert all(f.level == "WARN" and f.doubts and not f.of_forces and f.remedy for f in found)
    return found


STIFF = {"configuration": "loaded", "scan_gravity": (0.0, 0.0, -9.81)}
"""Of the block, held while it was scanned as it is recorded."""


@pytest.mark.parametrize("pattern", ["rings", "lattice", "scattered"])
@pytest.mark.parametrize(("i", "j"), [(0, 1), (3, 12), (5, 6)])
def test_two_exchanged_ids_are_named(pattern: str, i: int, j: int, folder: Path) -> None:
    places = PATTERNS[pattern]
    ids = list(range(10, 10 + len(places)))
    ids[i], ids[j] = ids[j], ids[i]
    (found,) = said(recorded(places, ids), experiment_of(folder, places))
    assert f"one another's places: {10 + i} and {10 + j}" in found.text and "exchanged" in found.remedy


def test_two_of_three_markers_are_exchanged(folder: Path) -> None:
    (found,) = said(recorded(COMPACT, [10, 12, 11]), experiment_of(folder, COMPACT, **STIFF))
    assert "11 and 12" in found.text


@pytest.mark.parametrize("pattern", ["rings", "lattice", "scattered"])
@pytest.mark.parametrize("shift", [-1, 1, 4])
def test_ids_shifted_by_some_are_named(pattern: str, shift: int, folder: Path) -> None:
    """On rings most of the markers go together with a turn by 45 degrees, and none with a frame."""
    places = PATTERNS[pattern]
    ids = [i for i in range(10 + shift, 10 + shift + len(places)) if 10 <= i < 10 + len(places)]
    kept = places[max(-shift, 0) : len(places) - max(shift, 0)]
    (found,) = said(recorded(kept, ids), experiment_of(folder, places))
    assert f"ids are shifted by {shift:+d}: {ids[0]} on that of {ids[0] - shift}" in found.text


def test_ids_in_another_order_are_listed(folder: Path) -> None:
    """Numbered row by row instead of column by column."""
    ids = 10 + np.arange(20).reshape(4, 5).T.ravel()
    (found,) = said(recorded(LATTICE, ids.tolist()), experiment_of(folder, LATTICE))
    assert "markers lie on the places of others: " in found.text and "14 more" in found.text


@pytest.mark.parametrize("pattern", ["rings", "lattice", "three", "scattered"])
@pytest.mark.parametrize(
    "by",
    [turned("z", 90.0), turned("x", 90.0), turned("y", 180.0), turned("z", 25.0), turned("z", 0.0, (0.02, 0.0, 0.0))],
)
def test_another_frame_is_said_with_its_turn_and_shift(pattern: str, by: Motion, folder: Path) -> None:
    places = PATTERNS[pattern]
    moved = by(places)
    (found,) = said(recorded(moved), experiment_of(folder, places, **STIFF, material=_stiff(folder)))
    assert "in another frame than markers.csv" in found.text and "T_phantom_tracker" in found.remedy
    R = by(np.eye(3)) - by(np.zeros((1, 3)))
    angle = np.degrees(np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0)))
    if angle > 1.0:
        assert float(found.text.split("turned by ")[1].split()[0]) == pytest.approx(angle, abs=2.0)
    else:
        np.testing.assert_allclose(_numbers(found.text), [20.0, 0.0, 0.0], atol=0.2)


def _stiff(folder: Path):
    return load_experiment(folder, geometry=False).phantom.material.model_copy(update={"youngs_modulus": 4e5})


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split("(")[1].split(")")[0].split(",")]


@pytest.mark.parametrize("pattern", ["rings", "scattered"])
def test_a_mirror_image_is_called_so(pattern: str, folder: Path) -> None:
    """Of rings it is a permutation too, and of a plane a turned frame: there is nothing to tell."""
    places = PATTERNS[pattern]
    (found,) = said(recorded(places * [1.0, -1.0, 1.0]), experiment_of(folder, places))
    assert "mirror image" in found.text and "left-handed" in found.remedy


@pytest.mark.parametrize("pattern", ["rings", "lattice", "scattered", "line"])
@pytest.mark.parametrize("factor", [0.1, 1.0 / 2.54, 1.5, 2.54, 10.0])
def test_another_unit_is_said_with_its_factor(pattern: str, factor: float, folder: Path) -> None:
    places = PATTERNS[pattern]
    found = said(recorded(factor * places, noise=1e-5), experiment_of(folder, places, **STIFF, material=_stiff(folder)))
    assert len(found) == 1 and f"are {factor:.3g} times those" in found[0].text


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-3, 4e-3])
def test_what_a_diagnosis_finds_by_itself_is_not_doubted(pattern: str, noise: float, folder: Path) -> None:
    """Cameras off by millimetres and 5 degrees, a scale and a swelling of 6 per cent, a tracker's noise."""
    places = PATTERNS[pattern]
    experiment = experiment_of(folder, places, **STIFF, material=_stiff(folder))
    rigid: list[Motion] = [turned("y", 5.0, (0.003, -0.002, 0.003)), turned("z", -5.0), turned("x", 10.0)]
    for by in [lambda p: p, *rigid, lambda p: 1.06 * p, lambda p: 0.94 * p]:
        assert said(recorded(by(places), noise=noise), experiment) == []


def sagged(places: Array, by: float) -> Array:
    """The block squeezed by ``by`` m at its top, and bulging."""
    s = 1.0 - by * places[:, 2:] / 0.05**2 * (1.0 - places[:, 2:] / 0.1)
    return np.hstack([places[:, :2] / np.sqrt(s), places[:, 2:] * s])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("softer", [1.0, 2.0, 3.0])
def test_a_body_that_sags_is_not_doubted(pattern: str, softer: float, folder: Path) -> None:
    """Sagging by rho g H^2 / 2E, 12 mm of 50 mm, and by three times that."""
    places = PATTERNS[pattern]
    material = load_experiment(folder, geometry=False).phantom.material.model_copy(update={"youngs_modulus": 1000.0})
    experiment = experiment_of(folder, places, material=material)
    assert may_sag(experiment, BODY) == pytest.approx(1000.0 * 9.81 * 0.05**2 / 2e3)
    for noise in (1e-4, 1e-3):
        assert said(recorded(sagged(places, 0.008 * softer), noise=noise), experiment) == []


def test_a_bar_that_bends_under_its_weight_is_not_doubted(folder: Path) -> None:
    """A bar of 200 x 20 x 20 mm, held at one end, hangs by 50 degrees there, which a rigid motion fits well."""
    bar = trimesh.creation.box((0.2, 0.02, 0.02))
    bar.apply_translation((0.1, 0.0, 0.0))
    body = Surface(np.asarray(bar.subdivide().subdivide().vertices), np.asarray(bar.subdivide().subdivide().faces))
    places = np.array([[x, y, z] for x in np.linspace(0.1, 0.19, 5) for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    support = load_experiment(folder, geometry=False).phantom.support[0]
    box = ((-1.0, -1.0, -1.0), (0.001, 1.0, 1.0))
    held = support.model_copy(update={"region": support.region.model_copy(update={"below_z": None, "box": box})})
    experiment = experiment_of(folder, places, support=(held,))
    s, angle = places[:, 0], np.radians(50.0) * places[:, 0] / 0.2
    radius = 0.2 / np.radians(50.0)
    bent = np.column_stack([radius * np.sin(angle), places[:, 1], -radius * (1.0 - np.cos(angle))])
    bent += places[:, 2:] * np.column_stack([np.sin(angle), 0.0 * s, np.cos(angle)])
    assert said(recorded(bent), experiment, body) == []
    assert len(said(recorded(bent, [11, 10, *range(12, 30)]), experiment, body)) == 1  # neighbours 20 mm apart


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_recording_that_begins_pressed_is_not_doubted(pattern: str, folder: Path) -> None:
    """A plate squeezes the block by 12 of 50 mm when the markers are first seen."""
    places = PATTERNS[pattern]
    down = np.array([1.0, 0.0, 0.0, 0.0])
    poses = [Pose(round(1e8 * k), np.array([0.0, 0.0, 0.038]), down) for k in range(50)]
    experiment = experiment_of(folder, places, **STIFF, material=_stiff(folder))
    assert said(recorded(sagged(places, 0.024), poses=poses), experiment) == []


@pytest.mark.parametrize("name", ["breast_phantom", "gelatin_cuboid"])
@pytest.mark.parametrize("which", ["a", "b"])
def test_the_shipped_recordings_are_not_doubted_and_wrong_ids_in_them_are(name: str, which: str) -> None:
    """The gelatin sags by 4 mm (its markers as recorded), the breast's markers are those of the truth."""
    folder = BAGS / name
    experiment = load_experiment(folder / "experiment")
    body, recording = read_body(experiment), load_recording(folder / "bags" / which, experiment)
    frames = recording.measured_frames
    if not frames:
        truth, ids = np.load(folder / "truth" / f"{which}.npz"), experiment.markers.ids
        none = np.full((len(ids), 3, 3), np.nan), np.full(len(ids), np.nan)
        frames = [MarkerFrame(int(s), ids, p, *none) for s, p in zip(truth["stamps_ns"], truth["markers"], strict=True)]

    def found(change: Callable[[MarkerFrame], MarkerFrame], first: int = 0) -> list[Finding]:
        kept = [change(frame) for frame in frames[first : first + 8]]
        part = Recording(Path(), recording.start_ns, recording.end_ns, kept, recording.poses, [], {}, {})
        return check_arrangement(ProbeRecord(part, experiment, body))

    def relabelled(frame: MarkerFrame) -> MarkerFrame:
        return MarkerFrame(frame.stamp_ns, frame.ids % np.uint32(len(experiment.markers.ids)) + np.uint32(1),
                           frame.points, frame.covariances, frame.reprojection_error_px)  # fmt: skip

    assert [found(lambda frame: frame, first) for first in range(0, len(frames) - 5, 9)].count([]) == len(
        range(0, len(frames) - 5, 9)
    )
    assert "shifted by +1" in found(relabelled)[0].text


def test_far_away_it_is_an_error_that_says_why(folder: Path) -> None:
    experiment = experiment_of(folder, RING)
    found = check_recording(recorded(RING * [-1.0, -1.0, 1.0]), experiment)
    (error,) = [f for f in found if f.level == "ERROR" and "places" in f.text]
    assert "0.06 m from their places (median): another frame or unit, or other ids: the markers are in another" in (
        error.text
    )
    assert error.text.endswith("turned by 180 degrees") and "T_phantom_tracker" in error.remedy
    assert not [f for f in found if f.level == "WARN" and "markers.csv" in f.text]


@pytest.mark.parametrize("pattern", ["rings", "scattered"])
def test_a_recording_of_other_markers_is_an_error(pattern: str, folder: Path) -> None:
    """The ids are those of the experiment, and the markers within its body; nothing else fits."""
    places = PATTERNS[pattern]
    lower, upper = np.array([-0.03, -0.03, 0.0]), np.array([0.03, 0.03, 0.05])
    other = np.random.default_rng(11).uniform(lower, upper, places.shape)
    (found,) = check_arrangement(ProbeRecord(recorded(other), experiment_of(folder, places, **STIFF), BODY))
    assert found.level == "ERROR" and "a recording of another body or with other ids" in found.text
    assert found.remedy
