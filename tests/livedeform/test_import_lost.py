"""Markers that a tracker lost and wrote down nevertheless: as 0, 0, 0, or where they were last. Neither is a place that
was measured to a micrometre."""

from __future__ import annotations

from pathlib import Path

import ezc3d
import numpy as np
import pytest

from livedeform.common.bags.recording import load_recording
from livedeform.importing.c3d import MotionCapture, held, still_covariance
from livedeform.importing.imports import import_takes
from livedeform.importing.points import Understanding, import_points

NAMES = ("A", "B", "C", "D")
REST = np.array([[0.0, 0.0, 0.05], [0.03, 0.0, 0.052], [0.0, 0.04, 0.051], [0.03, 0.04, 0.06]])
SIGMA = 20e-6
RATE = 100.0
GONE = slice(50, 120)  # of the third marker


@pytest.fixture(scope="module")
def track() -> np.ndarray:
    """(200, 4, 3) m: pressed by 5 mm, seen in all frames, to 0.1 um."""
    points = np.tile(REST, (200, 1, 1)) + np.random.default_rng(0).normal(0, SIGMA, (200, 4, 3))
    points[:, :, 2] -= np.linspace(0, 5e-3, 200)[:, None]
    return np.round(points, 7)


def written(folder: Path, kind: str, points: np.ndarray) -> Path:
    mm, t = 1e3 * points, np.arange(len(points)) / RATE
    rows = [[f"{v:.4f}" for v in p.ravel()] for p in mm]
    path = folder / f"a.{kind}"
    if kind == "npy":
        np.save(path, mm)
    elif kind == "c3d":
        file = ezc3d.c3d()
        for key, value in (("RATE", [RATE]), ("UNITS", ["mm"]), ("LABELS", list(NAMES))):
            file["parameters"]["POINT"][key]["value"] = value
        data = np.ones((4, 4, len(points)))
        data[:3] = mm.transpose(2, 1, 0)
        file["data"]["points"] = data
        file["data"]["meta_points"]["residuals"] = np.ones((1, 4, len(points)))  # the program says that it saw them
        file.write(str(path))
    elif kind == "trc":
        head = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
                f"100\t100\t{len(t)}\t4\tmm", "Frame#\tTime\t" + "\t\t\t".join(NAMES) + "\t\t",
                "\t\t" + "\t".join(f"{a}{k}" for k in range(1, 5) for a in "XYZ")]  # fmt: skip
        path.write_text("\n".join(head + [f"{k + 1}\t{t[k]}\t" + "\t".join(r) for k, r in enumerate(rows)]) + "\n")
    else:
        sep = "\t" if kind == "tsv" else ","
        head = [f"NO_OF_FRAMES\t{len(t)}", "FREQUENCY\t100"] if kind == "tsv" else []
        head.append(sep.join(["Time", *(f"{n} {a}" for n in NAMES for a in "XYZ")]))
        path.write_text("\n".join(head + [sep.join([f"{t[k]}", *r]) for k, r in enumerate(rows)]) + "\n")
    return path


def sigmas(path: Path) -> np.ndarray:
    """Of one coordinate of each marker (4,) m, by the first frame."""
    covariances = load_recording(path).marker_frames[0].covariances
    return np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 3)


@pytest.mark.parametrize("kind", ["csv", "tsv", "trc", "npy", "c3d"])
def test_nothing_is_measured_at_exactly_nought(kind: str, track: np.ndarray, tmp_path: Path):
    points = track.copy()
    points[GONE, 2] = 0.0
    path = written(tmp_path, kind, points)
    if kind == "c3d":
        lines = import_takes([path], tmp_path / "bags")
    else:
        lines = import_points([path], tmp_path / "bags", Understanding("mm", RATE))
        assert "seen 91.2% of the time" in lines[0]
    name = "3" if kind == "npy" else "C"
    assert f"warning: a.{kind}: exactly 0, 0, 0 is taken as not measured ({name} in 70 frames)" in lines
    frames = load_recording(tmp_path / "bags" / "a.mcap").marker_frames
    assert [len(f.ids) for f in frames] == [3 if 50 <= k < 120 else 4 for k in range(200)]
    ratio = sigmas(tmp_path / "bags" / "a.mcap") / SIGMA
    assert ratio.min() > 0.6 and ratio.max() < 1.6  # measured 0.88 .. 0.96; it was 0.05 of the third


@pytest.mark.parametrize("code", [-9999.0, -999.0, 99999.0])
def test_a_code_three_times_is_no_place(code: float, track: np.ndarray, tmp_path: Path):
    """It made a body of 10 m; one coordinate that happens to be the code is one."""
    points = track.copy()
    points[GONE, 2] = 1e-3 * code
    path = written(tmp_path, "csv", points)
    lines = import_points([path], tmp_path / "bags", Understanding("mm"))
    said = ", ".join([f"{code:.0f}"] * 3)
    assert f"warning: a.csv: exactly {said} is taken as not measured (C in 70 frames)" in lines
    frames = load_recording(tmp_path / "bags" / "a.mcap").marker_frames
    assert [len(f.ids) for f in frames] == [3 if 50 <= k < 120 else 4 for k in range(200)]
    points[GONE, 2, 1:] = 0.01
    lines = import_points([written(tmp_path, "csv", points)], tmp_path / "bags", Understanding("mm"), force=True)
    assert not any("is taken as not measured" in line for line in lines)


@pytest.mark.parametrize("where", [slice(0, 70), GONE, slice(130, 200)])
def test_a_place_that_is_written_on_is_no_noise(where: slice, track: np.ndarray, tmp_path: Path):
    points = track.copy()
    points[where, 2] = points[where.start, 2]
    lines = import_points([written(tmp_path, "csv", points)], tmp_path / "bags", Understanding("mm"))
    assert sum(line.startswith("warning: a.csv: places are exactly those") for line in lines) == 1
    assert "(C in 69 frames)" in lines[1]
    ratio = sigmas(tmp_path / "bags" / "a.mcap") / SIGMA
    assert ratio.min() > 0.6 and ratio.max() < 1.6  # measured 0.88 .. 0.98; it was 0.05 of the third


def noise(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The steps that are held (markers,), and sigma (markers,) m."""
    take = MotionCapture(Path("a"), NAMES[: points.shape[1]], points, np.full(points.shape[:2], np.nan), RATE)
    return held(take).sum(axis=0), np.sqrt(np.trace(still_covariance(take), axis1=1, axis2=2) / 3)


def test_what_is_held_is_told_from_what_does_not_change(track: np.ndarray):
    """A tracker too coarse for its noise, a body that nobody touches, one marker alone, and a loss of most markers."""
    still = REST + np.random.default_rng(1).normal(0, SIGMA, (200, 4, 3))
    assert not noise(np.round(still, 4))[0].any()
    assert not noise(np.tile(REST, (200, 1, 1)))[0].any()
    assert not noise(track[:3])[0].any() and not noise(np.round(track[:, :1], 2))[0].any()
    lost = track.copy()
    lost[GONE, :3] = lost[50, :3]
    steps, sigma = noise(lost)
    assert steps.tolist() == [69, 69, 69, 0]
    assert (sigma / SIGMA).min() > 0.6 and (sigma / SIGMA).max() < 1.6  # measured 0.90 .. 1.01
    lost[:, 0] = lost[0, 0]
    assert np.isnan(noise(lost)[1][0])  # never seen to scatter: nobody knows its noise
