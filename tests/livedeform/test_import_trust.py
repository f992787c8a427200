"""What an imported take is trusted for: its frame's handedness, its seconds, and no more digits than it has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from livedeform.cli import run as command_line
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.importing.c3d import MotionCapture, last_digit, register, still_covariance
from livedeform.importing.points import Understanding, read_take

RATE = 50.0


def pad(height: float, n: int = 25) -> np.ndarray:
    """(n, 3) m: markers on a pad of 100 mm whose middle is ``height`` above its corners."""
    xy = np.random.default_rng(1).uniform(-0.05, 0.05, (n, 2))
    return np.column_stack([xy, height * (1 - ((xy / 0.05) ** 2).sum(axis=1) / 2)])


@pytest.mark.parametrize("height", [0.003, 0.006, 0.015])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_left_handed_frame_is_refused(height: float, axis: int):
    """On a pad of 6 mm it fitted within 1.8 mm, and a press was read as a pull."""
    places, rng = pad(height), np.random.default_rng(0)
    mirrored = places.copy()
    mirrored[:, axis] *= -1
    said = r"the take is mirrored: its frame is left-handed .*; negate one axis of all its points"
    with pytest.raises(InputError, match=said):
        register(places, mirrored + 1.0 + rng.normal(0, 1e-4, places.shape))
    T, _ = register(places, places + 1.0 + rng.normal(0, 1e-4, places.shape))
    np.testing.assert_allclose(T[:3, :3], np.eye(3), atol=2e-3)


def test_a_right_frame_is_not_taken_for_a_mirrored_one():
    """Places that are stated a millimetre off, of all shapes from flat on: a mirror image hardly ever fits twice as
    well."""
    refused = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        places = pad([0.0, 1e-3, 3e-3, 1e-2][seed % 4], [4, 5, 8, 25][seed // 4 % 4])
        try:
            register(places, places + rng.normal(0, 1e-3, places.shape))
        except InputError:
            refused += 1
    assert refused == 0


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    folder = tmp_path / "pad"
    folder.mkdir()
    box = trimesh.creation.box((0.12, 0.12, 0.03))
    box.export(folder / "pad.stl")
    rows = "".join(f"{k + 1},{x},{y},{z}\n" for k, (x, y, z) in enumerate(pad(0.01)))
    (folder / "markers.csv").write_text("id,x,y,z\n" + rows)
    phantom = {
        "surface": "pad.stl", "unit": "m", "configuration": "loaded", "element_size": 0.01, "density": 1000.0,
        "material": {"model": "neo_hookean", "youngs_modulus": 4000.0, "poisson_ratio": 0.49},
        "support": [{"region": {"below_z": -0.0149}, "type": "fixed"}], "markers": "markers.csv",
    }  # fmt: skip
    (folder / "experiment.yaml").write_text(yaml.safe_dump({"version": 1, "name": "pad", "phantom": phantom}))
    return folder


def pushed(folder: Path) -> Path:
    """A table of 8 s at 50 Hz: at rest, 5 mm to the side from 2 to 4 s, at rest again, and let go at 6 s."""
    t = np.arange(400) / RATE
    points = np.tile(pad(0.01), (400, 1, 1)) + np.random.default_rng(0).normal(0, 2e-5, (400, 25, 3))
    points[(t >= 2) & (t < 4), :, 0] += 5e-3
    points[:, :, 2] -= 0.02 * np.clip(t - 6, 0, None)[:, None] ** 2
    head = "time [s]" + "".join(f",M{k + 1}_{a} [mm]" for k in range(25) for a in "xyz")
    rows = [f"{s:.3f}," + ",".join(f"{v:.4f}" for v in 1e3 * p.ravel()) for s, p in zip(t, points, strict=True)]
    (folder / "a.csv").write_text("\n".join([head, *rows]) + "\n")
    return folder / "a.csv"


def test_seconds_are_from_the_files_start(experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Of the rest and the release beside a crop; the experiment's release is from the bag's start."""
    path, out = pushed(tmp_path), tmp_path / "bags"
    base = ["import", "points", str(path), "--experiment", str(experiment), "--crop", "3:8", "--out", str(out)]
    assert command_line([*base, "--rest", "4.5:5.5", "--release", "6"]) == 0  # it was from 7.5 s on: let go
    said = capsys.readouterr().out
    assert "released at 3.000 s (6.000 s after the file's start): write timeline: {release: 3.000}" in said
    frames = load_recording(out / "a.mcap").marker_frames
    assert len(frames) == 250
    error = np.array([f.points for f in frames]) - pad(0.01)
    assert np.abs(error[60:140].mean(axis=(0, 1))).max() < 2e-5  # m, at rest from 4 to 6 s; measured 5.4e-6
    np.testing.assert_allclose(error[:45, :, 0].mean(), 5e-3, atol=2e-5)
    with read_bag(out / "a.mcap") as bag:
        assert bag.metadata["release_s"] == "3.0000"
    assert command_line([*base, "--rest", "0:0.5", "--force"]) == 2
    assert (
        "no frame lies in the time of rest (kept is what begins 3 s after the file's start)" in capsys.readouterr().err
    )
    assert command_line([*base, "--release", "2", "--force"]) == 2
    assert (
        "2 s is not within the 3.000 to 7.980 s that are kept; count from the file's start" in capsys.readouterr().err
    )
    later = ["--crop", "4.2:8", "--force", "--release", "auto"]  # rest is then the first half second that is kept
    assert command_line([*base, *later]) == 0 and "registered to 25 markers, rms 0.0" in capsys.readouterr().out
    take, _ = read_take([path], Understanding(crop=(3.0, 8.0)))
    assert take.since == pytest.approx(3.0) and take.frames_between(4.0, 4.1).tolist() == [50, 51, 52, 53, 54]


@pytest.mark.parametrize("noise", [5e-5, 2e-5, 1e-5, 5e-6])
@pytest.mark.parametrize("last", [1e-4, 2.54e-4, 1e-3])
@pytest.mark.parametrize("kind", ["text", "float32"])
def test_no_more_digits_than_an_export_has(noise: float, last: float, kind: str):
    """Markers that stayed within the last digit, 1 to 29 of the 30 in 10 cases of 12, had sigmas of 1 um."""
    rng = np.random.default_rng(1)
    places = rng.uniform([0.95, -0.55, 0.25], [1.05, -0.45, 0.35], (30, 3))
    points = np.round((places + rng.normal(0, noise, (500, 30, 3))) / last) * last
    if kind == "float32":
        points = 1e-3 * (1e3 * points).astype(np.float32).astype(float)
    take = MotionCapture(Path("a"), tuple(map(str, range(30))), points, np.full((500, 30), np.nan), RATE)
    np.testing.assert_allclose(last_digit(points), last, rtol=1e-6)
    variance = np.trace(still_covariance(take), axis1=1, axis2=2) / 3
    assert variance.min() > last**2 / 13
    ratio = np.sqrt(variance.mean() / ((points - places) ** 2).mean())
    assert 0.9 < ratio < 1.3  # measured 1.03 .. 1.21; it was 0.12 .. 0.93


def test_what_is_no_last_digit_adds_nothing():
    """Noise in all digits, moments that move by steps, few places that never change, and a flat picture."""
    rng = np.random.default_rng(2)
    places = rng.uniform(-0.04, 0.04, (30, 3))
    steps = places + np.arange(8)[:, None, None] * [0, 0, -3e-3]
    for points in (
        places + rng.normal(0, 2e-5, (500, 30, 3)), steps, np.round(steps, 7), steps.astype(np.float32).astype(float),
        np.tile([[0.0, 0.0, 0.05], [0.05, 0.0, 0.1]], (50, 1, 1)), np.full((9, 3, 3), np.nan),
    ):  # fmt: skip
        np.testing.assert_array_equal(last_digit(np.asarray(points, float)), 0.0)
    np.testing.assert_allclose(last_digit(np.round(steps * [1, 1, 0], 4)), [1e-4, 1e-4, 0.0])
    gone = np.round(places + rng.normal(0, 2e-5, (500, 30, 3)), 4)
    gone[:250, 0] += np.linspace(0, 1e-4, 250)[:, None]  # a gap that was filled
    np.testing.assert_allclose(last_digit(gone), 1e-4)
