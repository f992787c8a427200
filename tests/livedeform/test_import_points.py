"""``livedeform import points``: every format gives the same take; what is not said is asked for; what is left out is
named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from livedeform.cli import run as command_line
from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError, RecordingError
from livedeform.importing.points import Understanding, import_points, read_take, release_frame

LABELS = ("Tip - 1", "base", "side")
RATE = 50.0


@pytest.fixture
def track() -> np.ndarray:
    """(100, 3, 3) m: still for 1 s, then two points fall; one is hidden for five frames."""
    rng = np.random.default_rng(2)
    points = np.tile(np.array([[0.0, 0.0, 0.1], [0.05, 0.0, 0.0], [0.0, 0.07, 0.02]]), (100, 1, 1))
    fall = 0.5 * 9.8 * np.clip(np.arange(100) / RATE - 1.0, 0, None) ** 2
    points[:, 0, 2] -= fall * 0.02
    points[:, 2, 2] -= fall * 0.01
    points += rng.normal(0, 1e-5, points.shape)
    points[20:25, 1] = np.nan
    return points


def written(folder: Path, points: np.ndarray) -> dict[str, Path]:
    """The same take (mm) as wide and long CSV, TRC and npy."""
    t = np.arange(len(points)) / RATE
    mm = 1e3 * points
    wide = ["time," + ",".join(f"{n}_{a} [mm]" for n in LABELS for a in "XYZ")]
    long = ["Frame;time_ms;marker;x (mm);y (mm);z (mm)"]
    trc = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
           f"{RATE}\t{RATE}\t{len(t)}\t3\tmm", "Frame#\tTime\t" + "\t\t\t".join(LABELS) + "\t\t",
           "\t\t" + "\t".join(f"{a}{k}" for k in (1, 2, 3) for a in "XYZ")]  # fmt: skip
    for k, second in enumerate(t):
        cells = ["" if np.isnan(v) else f"{v:.6f}" for v in mm[k].ravel()]
        wide.append(f"{second:.4f}," + ",".join(cells))
        trc.append(f"{k + 1}\t{second:.4f}\t" + "\t".join(cells))
        for name, p in zip(LABELS, mm[k], strict=True):
            if np.isfinite(p).all():
                long.append(f"{k};{1e3 * second:.1f};{name};{p[0]:.6f};{p[1]:.6f};{p[2]:.6f}")
    out = {"wide": folder / "wide.csv", "long": folder / "long.csv", "trc": folder / "a.trc", "npy": folder / "a.npy"}
    for name, lines in (("wide", wide), ("long", long), ("trc", trc)):
        out[name].write_text("\n".join(lines) + "\n")
    np.save(out["npy"], mm)
    return out


@pytest.mark.parametrize("kind", ["wide", "long", "trc", "npy"])
def test_every_format_is_the_same_take(kind: str, track: np.ndarray, tmp_path: Path):
    path = written(tmp_path, track)[kind]
    how = Understanding(unit="mm", rate_hz=RATE) if kind == "npy" else Understanding()
    take, said = read_take([path], how)
    assert np.allclose(take.points, track, atol=1e-8, equal_nan=True)
    assert take.rate_hz == pytest.approx(RATE) and np.allclose(take.seconds, np.arange(100) / RATE)
    assert take.labels == (LABELS if kind != "npy" else ("1", "2", "3"))
    assert "100 frames" in said and "unit mm" in said


def test_what_is_not_said_is_asked_for(track: np.ndarray, tmp_path: Path):
    files = written(tmp_path, track)
    with pytest.raises(InputError, match=r"does not say its unit; say it: .*--units mm \(0.127 m from end"):
        read_take([files["npy"]], Understanding())
    with pytest.raises(InputError, match="does not say when its frames were measured; say --rate HZ"):
        read_take([files["npy"]], Understanding(unit="mm"))


def test_a_preview_writes_nothing_and_a_take_left_out_is_named(track: np.ndarray, tmp_path: Path, capsys):
    files = written(tmp_path, track)
    (tmp_path / "torn.csv").write_text("\n".join(files["wide"].read_text().splitlines()[:30]) + ",3\n")
    (tmp_path / "words.csv").write_text("a,b,c\n1,2,3\n4,5,6\n")
    given = [str(files["wide"]), str(tmp_path / "torn.csv"), str(tmp_path / "words.csv"), str(files["trc"])]
    out = tmp_path / "bags"
    assert command_line(["import", "points", *given, "--out", str(out), "--preview"]) == 0
    said = capsys.readouterr().out
    assert not out.exists() and said.count("left out: ") == 2 and "torn.csv" in said and "words.csv" in said
    assert command_line(["import", "points", *given, "--out", str(out), "--release", "auto", "--crop", "0.2:2"]) == 0
    said = capsys.readouterr().out
    assert {p.name for p in out.glob("*.mcap")} == {"wide.mcap", "a.mcap"} and "timeline: {release: 0." in said
    frames = load_recording(out / "wide.mcap").marker_frames
    assert len(frames) == 90 and list(frames[0].ids) == [1, 2, 3] and len(frames[12].ids) == 2
    assert command_line(["import", "points", str(tmp_path / "words.csv"), "--out", str(out)]) == 2
    assert "no marker has x, y and z" in capsys.readouterr().err


def test_the_release_is_where_points_begin_to_move(track: np.ndarray, tmp_path: Path):
    take, _ = read_take([written(tmp_path, track)["wide"]], Understanding())
    assert 1.0 <= take.seconds[release_frame(take)] < 1.12  # 60 um are fallen 0.03 s later, 6 sigma in z
    lost = take.points.copy()
    lost[int(np.searchsorted(take.seconds, 1.6))] = np.nan  # trackers lose points while they swing: that is no rest
    assert release_frame(replace(take, points=lost)) == release_frame(take)
    still, _ = read_take([written(tmp_path, track)["wide"]], Understanding(crop=(0.0, 0.9)))
    with pytest.raises(InputError, match="nothing tells rest from movement"):
        release_frame(still)


def test_points_of_a_dic_tool_are_the_same_row_by_row(tmp_path: Path):
    """DICe's stereo output: places at rest, and displacements; 2000 points, some lost."""
    rng = np.random.default_rng(1)
    rest = rng.uniform(0, 60, (2000, 3))
    for k in range(5):
        moved = rng.normal(0, 0.01, rest.shape) - np.array([0.0, 0.0, 0.1 * k])
        head = "SUBSET_ID,MODEL_COORDINATES_X,MODEL_COORDINATES_Y,MODEL_COORDINATES_Z,"
        head += "MODEL_DISPLACEMENT_X,MODEL_DISPLACEMENT_Y,MODEL_DISPLACEMENT_Z,SIGMA"
        rows = [
            f"{i},{','.join(f'{v:.5f}' for v in (*p, *d))},0.01"
            for i, (p, d) in enumerate(zip(rest, moved, strict=True))
        ]
        (tmp_path / f"DICe_solution_{k:02d}.txt").write_text("\n".join([head, *(rows[1:] if k == 3 else rows)]) + "\n")
    files = sorted(tmp_path.glob("*.txt"), reverse=True)
    take, said = read_take(files, Understanding(unit="mm", rate_hz=2.0, dic=True))
    assert take.points.shape == (5, 2000, 3) and "2000 points" in said
    assert np.nanmean(take.points[4, :, 2] - take.points[0, :, 2]) == pytest.approx(-0.4e-3, abs=1e-6)
    assert np.isnan(take.points[3, 0]).all() and np.isfinite(take.points[3, 1:]).all()
    lines = import_points(files, tmp_path / "bags", Understanding("mm", 2.0, thin=10, dic=True))
    assert "200 markers" in lines[-1]
    for k in range(2):  # without names, a row less is not the same points
        (tmp_path / f"duo_{k}.csv").write_text("X,Y,Z\n" + "".join(f"{i},0,1\n" for i in range(9 - k)))
    with pytest.raises(RecordingError, match="row k is not the same point in both"):
        read_take(sorted(tmp_path.glob("duo_*.csv")), Understanding("mm", 2.0, dic=True))
