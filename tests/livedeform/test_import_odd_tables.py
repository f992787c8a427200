"""Tables of other people: each right one gives the right numbers, each wrong one a line that says what, where and the
remedy, and nothing is written in silence beside it."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from livedeform.cli import run as command_line
from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.importing.c3d import register
from livedeform.importing.marker_ids import assign_ids
from livedeform.importing.points import Understanding, read_take

NAMES = ("tip", "base left", "größe.3")
RATE = 50.0
GONE = 5  # the frame in which the second marker is not seen


@pytest.fixture(scope="module")
def track() -> np.ndarray:
    """(20, 3, 3) m, to 0.1 um."""
    points = np.tile(np.array([[0.0, 0.0, 0.1], [0.05, 0.0, 0.0], [0.0, 0.07, 0.02]]), (20, 1, 1))
    return np.round(points + np.random.default_rng(0).normal(0, 1e-4, points.shape), 7)


def wide(
    points: np.ndarray, sep: str = ",", missing: str = "", time: str = "time", unit: str = " [mm]",
    names: tuple[str, ...] = NAMES,
) -> str:  # fmt: skip
    """A row per moment, in mm; decimal commas beside tabs and semicolons."""
    lines = [sep.join([time, *(f"{n}_{a}{unit}" for n in names for a in "xyz")])]
    for k, row in enumerate(1e3 * points.reshape(len(points), -1)):
        cells = [f"{k / RATE:.4f}", *(f"{v:.4f}" for v in row)]
        if k == GONE:
            cells[4:7] = [missing] * 3
        lines.append(sep.join(c if sep in ", " or c == missing else c.replace(".", ",") for c in cells))
    return "\n".join(lines) + "\n"


def exported(points: np.ndarray, head: list[str]) -> str:
    """What a program exports below ``head``: frame, time, and three columns for each marker, in mm."""
    rows = [f"{k + 1},{k / RATE:.4f}," + ",".join(f"{v:.4f}" for v in 1e3 * p.ravel()) for k, p in enumerate(points)]
    rows[GONE] = ",".join([*rows[GONE].split(",")[:5], "", "", "", *rows[GONE].split(",")[8:]])
    return "\n".join([*head, *rows]) + "\n"


MOTIVE = [
    "Format Version,1.23,Capture Frame Rate,50.000000,Length Units,Millimeters", "", ",Type" + ",Marker" * 9,
    ",Name," + ",".join(n for n in NAMES for _ in range(3)),
    ",ID," + ",".join(str(k) for k in range(3) for _ in range(3)),
    "," + ",Position" * 9, "Frame,Time (Seconds)" + ",X,Y,Z" * 3,
]  # fmt: skip
NEXUS = ["Trajectories", "50", ",," + ",,,".join(NAMES) + ",,", "Frame,Time" + ",X,Y,Z" * 3, "," + ",mm" * 9]

FORCES = "Devices\n1000\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n" + 30 * "1,0,1,2,3\n" + "\n"

RIGHT: dict[str, Callable[[np.ndarray], bytes]] = {
    "comma": lambda p: wide(p).encode(),
    "semicolons and decimal commas": lambda p: wide(p, ";").encode(),
    "tabs and decimal commas": lambda p: wide(p, "\t").encode(),
    "quoted decimal commas": lambda p: re.sub(r"(-?\d+)\.(\d+)", r'"\1,\2"', wide(p)).encode(),
    "byte order mark": lambda p: wide(p).encode("utf-8-sig"),
    "utf-16": lambda p: wide(p).encode("utf-16"),
    "windows' western": lambda p: wide(p).encode("cp1252"),
    "carriage returns": lambda p: wide(p).replace("\n", "\r\n").encode(),
    "comma at the end of lines": lambda p: wide(p).replace("\n", ",\n").replace(",", ",", 1).encode(),
    "nexus with forces before": lambda p: (FORCES + exported(p, NEXUS)).encode(),
    "a table of one line above": lambda p: ("Specimen,Width,Height\n1,50,25\n" + wide(p)).encode(),
    "motive": lambda p: exported(p, MOTIVE).encode(),
    "nexus": lambda p: exported(p, NEXUS).encode(),
} | {
    f"missing is {word}": lambda p, word=word: wide(p, missing=word).encode()  # type: ignore[misc]
    for word in ("NaN", "NA", "N/A", "null", "-", "--", "None", "#N/A", "?", "inf")
}


@pytest.mark.parametrize("kind", RIGHT)
def test_a_right_table_gives_the_right_numbers(kind: str, track: np.ndarray, tmp_path: Path):
    (tmp_path / "take.csv").write_bytes(RIGHT[kind](track))
    take, said = read_take([tmp_path / "take.csv"], Understanding())
    truth = track.copy()
    truth[GONE, 1] = np.nan
    assert take.labels == NAMES and "unit mm" in said
    np.testing.assert_allclose(take.points, truth, atol=1e-9)
    np.testing.assert_allclose(take.seconds, np.arange(20) / RATE, atol=1e-9)


def without(text: str, lines: range) -> str:
    return "\n".join(line for k, line in enumerate(text.splitlines()) if k not in lines) + "\n"


def long(points: np.ndarray, order: np.ndarray) -> str:
    rows = [
        f"{k};{7 + m};good;" + ";".join(f"{v:.7f}".replace(".", ",") for v in p)
        for k, f in enumerate(points)
        for m, p in enumerate(f)
    ]
    return "\n".join(["frame;id;kind;x (m);y (m);z (m)", *(rows[k] for k in order)]) + "\n"


def test_frames_that_are_not_there_leave_their_time(track: np.ndarray, tmp_path: Path):
    """By the numbers of the frames: they do not close up."""
    (tmp_path / "a.csv").write_text(without(long(track, np.arange(60)), range(13, 22)))  # frames 4, 5 and 6
    take, _ = read_take([tmp_path / "a.csv"], Understanding(rate_hz=RATE))
    kept = [k for k in range(20) if k not in (4, 5, 6)]
    np.testing.assert_allclose(take.seconds, np.array(kept) / RATE)
    np.testing.assert_allclose(take.points, track[kept], atol=1e-9)


def test_numbers_that_a_table_gives_its_markers_are_their_ids(track: np.ndarray, tmp_path: Path):
    """Whatever the order of the rows."""
    (tmp_path / "a.csv").write_text(long(track, np.random.default_rng(1).permutation(60)))
    words = ["import", "points", str(tmp_path / "a.csv"), "--rate", "50", "--out", str(tmp_path / "bags")]
    assert command_line(words) == 0
    for frame, truth in zip(load_recording(tmp_path / "bags" / "a.mcap").marker_frames, track, strict=True):
        rows = np.asarray(frame.ids, int) - 7
        assert sorted(rows) == [0, 1, 2]
        np.testing.assert_allclose(frame.points, truth[rows], atol=1e-8)
    assert assign_ids(["b", "a"], {}).tolist() == [1, 2] and assign_ids(["3", "03"], {}).tolist() == [1, 2]


def test_one_marker_needs_no_name(track: np.ndarray, tmp_path: Path):
    rows = "".join(f"{k / RATE},{','.join(map(str, p))}\n" for k, p in enumerate(track[:, 0]))
    (tmp_path / "a.csv").write_text("time,x,y,z\n" + rows)
    take, _ = read_take([tmp_path / "a.csv"], Understanding("m"))
    np.testing.assert_allclose(take.points[:, 0], track[:, 0], atol=1e-9)


def test_a_marker_without_all_coordinates_is_named(track: np.ndarray, tmp_path: Path):
    short = "\n".join(",".join(line.split(",")[:-1]) for line in wide(track).splitlines())
    (tmp_path / "a.csv").write_text(short)
    take, said = read_take([tmp_path / "a.csv"], Understanding())
    assert take.labels == NAMES[:2] and "left out: größe.3 (has x and y only)" in said


OTHERS = {  # columns beside markers, and what is said of them
    "force_x,force_y,force_z": "force", "Probe Force X,Probe Force Y,Probe Force Z": "Probe Force",
    "Force2.x,Force2.y,Force2.z": "Force2", "Torque 1_x,Torque 1_y,Torque 1_z": "Torque 1",
    "moment_x,moment_y,moment_z": "moment", "rotation_x,rotation_y,rotation_z": "rotation",
    "probe_qx,probe_qy,probe_qz,probe_qw": "probe_q", "q_w,q_x,q_y,q_z": "q",
    "tip_vx,tip_vy,tip_vz": "tip_v", "vx,vy,vz": "v", "tip_vel_x,tip_vel_y,tip_vel_z": "tip_vel",
    "velocity.x,velocity.y,velocity.z": "velocity", "acc_x,acc_y,acc_z": "acc",
    "tip_ux,tip_uy,tip_uz": "tip_u", "u_x,u_y,u_z": "u", "tip_disp_x,tip_disp_y,tip_disp_z": "tip_disp",
    "Displacement 1 X,Displacement 1 Y,Displacement 1 Z": "Displacement 1", "tip_std_x,tip_std_y,tip_std_z": "tip_std",
    "tip sigma X,tip sigma Y,tip sigma Z": "tip sigma", "tip_sd_x,tip_sd_y,tip_sd_z": "tip_sd",
    "tip_error_x,tip_error_y,tip_error_z": "tip_error", "strain_x,strain_y,strain_z": "strain",
    "tip_nx,tip_ny,tip_nz": "tip_n", "nx,ny,nz": "n", "tip_normal_x,tip_normal_y,tip_normal_z": "tip_normal",
    "x,y,z": "x, y, z",
}  # fmt: skip


@pytest.mark.parametrize("columns", OTHERS)
def test_forces_turns_and_velocities_are_no_markers(columns: str, track: np.ndarray, tmp_path: Path):
    head, *rows = wide(track).splitlines()
    beside = ",0.1" * (columns.count(",") + 1)
    (tmp_path / "a.csv").write_text("\n".join([f"{head},{columns}", *(row + beside for row in rows)]), encoding="utf-8")
    take, said = read_take([tmp_path / "a.csv"], Understanding())
    what = "of no marker's name" if columns == "x,y,z" else "no position"
    assert take.labels == NAMES and f"left out: {OTHERS[columns]} ({what})" in said
    assert assign_ids(take.labels, {}).tolist() == [1, 2, 3]


def test_what_is_stated_of_every_marker_shifts_no_id(track: np.ndarray, tmp_path: Path):
    """Whatever it is called; a marker beside one marker, or on a side of all, is a marker."""
    head, *rows = wide(track[:, :2], names=("M1", "M3")).splitlines()
    for words, n in (("raw", 2), ("std", 2), ("left", 4), ("2", 4)):
        more = "".join(f",{m}_{words}_{a} [mm]" for m in ("M1", "M3") for a in "xyz")
        (tmp_path / "a.csv").write_text("\n".join([head + more, *(row + 6 * ",0.1" for row in rows)]))
        take, said = read_take([tmp_path / "a.csv"], Understanding())
        assert len(take.labels) == n and ("left out" in said) == (n == 2)
        assert n == 4 or (f"M1_{words} (no position), M3_{words} (no position)" in said and take.labels == ("M1", "M3"))
        assert n == 4 or assign_ids(take.labels, {}).tolist() == [1, 3]
    names = ("base", "base_cap", "tip")
    (tmp_path / "a.csv").write_text(wide(track, names=names))
    assert read_take([tmp_path / "a.csv"], Understanding())[0].labels == names


def test_a_robots_place_beside_markers_hides_none(track: np.ndarray, tmp_path: Path):
    """One beside its own forces and turns is the point; of a row per point, what is no place is named."""
    rows = "".join(f"{k / RATE},{','.join(map(str, p))},1,2,3,0.1,0.2,0.3\n" for k, p in enumerate(track[:, 0]))
    for columns, labels, left_out in (
        ("fx,fy,fz,rx,ry,rz", ("1",), "f, r"), ("ux,uy,uz,vx,vy,vz", ("1",), "u, v"),
        ("tip_x,tip_y,tip_z,vx,vy,vz", ("tip",), "v (no position), x, y, z (of no marker's name)"),
        ("A_x,A_y,A_z,B_x,B_y,B_z", ("A", "B"), "x, y, z (of no marker's name)"),
        ("Ax,Ay,Az,Bx,By,Bz", ("A", "B"), "x, y, z (of no marker's name)"),
    ):  # fmt: skip
        (tmp_path / "a.csv").write_text(f"time,x,y,z,{columns}\n{rows}")
        take, said = read_take([tmp_path / "a.csv"], Understanding("m"))
        assert take.labels == labels and f"left out: {left_out}" in said
    (tmp_path / "a.csv").write_text(
        "time,id,x,y,z,tip_x,tip_y,tip_z\n" + "".join(f"{k},1,2,3,{k},1,2,3\n" for k in range(9))
    )
    take, said = read_take([tmp_path / "a.csv"], Understanding("m", 1.0))
    assert take.labels == ("1",) and "left out: tip" in said


def test_markers_that_are_called_alike_are_markers(track: np.ndarray, tmp_path: Path):
    """Letters among letters, q without a w, and words that only begin like a force's."""
    for names in (("U", "V", "W"), ("q", "b", "c"), ("forceps", "velcro", "rotation stage")):
        (tmp_path / "a.csv").write_text(wide(track, names=names))
        assert read_take([tmp_path / "a.csv"], Understanding())[0].labels == names


def test_of_motives_rigid_bodies_the_position_is_taken(track: np.ndarray, tmp_path: Path):
    """One body alone, and three of which one has no rotation."""
    for names, turning in ((NAMES[:1], (True,)), (NAMES, (True, True, False))):
        kinds = [k for t in turning for k in (["Rotation"] * 4 if t else []) + ["Position"] * 3]
        own = [n for n, t in zip(names, turning, strict=True) for _ in range(7 if t else 3)]
        axes = [a for t in turning for a in ("XYZWXYZ" if t else "XYZ")]
        head = [MOTIVE[0], ",Type" + ",Rigid Body" * len(own), ",".join(["", "Name", *own]), ",ID" + ",1" * len(own)]
        head += [",".join(["", "", *kinds]), ",".join(["Frame", "Time (Seconds)", *axes])]
        rows = [
            f"{k + 1},{k / RATE:.4f},"
            + ",".join(("0.1,0.2,0.3,0.9," if t else "") + ",".join(f"{1e3 * v:.4f}" for v in p)
                       for t, p in zip(turning, points, strict=False))
            for k, points in enumerate(track)
        ]  # fmt: skip
        (tmp_path / "a.csv").write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")
        take, said = read_take([tmp_path / "a.csv"], Understanding())
        assert take.labels == names and f"{names[0]} rotation (no position)" in said
        np.testing.assert_allclose(take.points, track[:, : len(names)], atol=1e-9)


WRONG: dict[str, tuple[Callable[[np.ndarray], str], str]] = {
    "word in a cell": (lambda p: wide(p, missing="lost"), "a.csv:7: holds 'lost' in the column 'base left_x'"),
    "two units": (lambda p: wide(p).replace("tip_y [mm]", "tip_y [m]"), "columns of points in m and mm"),
    "minutes": (lambda p: wide(p, time="time [min]"), "states times in 'min'; give seconds"),
    "one name for two": (lambda p: wide(p, names=("tip", "tip", "c")), "has the column 'tip_x' twice"),
    "torn": (lambda p: wide(p)[:-30], "a.csv:21: has 7 cells beside lines of 10"),
    "a time twice": (lambda p: wide(p) + wide(p).splitlines()[-1], "do not rise: 0.38 s follows 0.38 s"),
    "unsorted": (lambda p: wide(p) + wide(p).splitlines()[3], "do not rise: 0.04 s follows 0.38 s (1 such"),
    "no time": (lambda p: wide(p).replace("\n0.0400,", "\n,"), "1 rows have no time"),
    "no header": (lambda p: without(wide(p), range(1)), "no line with the columns' names"),
    "header alone": (lambda p: wide(p).splitlines()[0] + "\n\n", "holds no table"),
    "nothing": (lambda p: "", "holds no table"),
    "a point twice": (lambda p: long(p, np.array([0, 1, 2, 1])), "a.csv:5: states the point '8' twice at the same"),
    "many of no name": (lambda p: "time,x,y,z\n0,1,2,3\n0,4,5,6\n", "no column that says which point"),
    "started again": (lambda p: wide(p) + wide(p[:8]), "a.csv:22: has a second header, 'time', below lines of numbers"),
    "started again and stopped": (
        lambda p: wide(p) + wide(p[:1]).split("\n")[0], "a.csv:22: has a second header, 'time', below"
    ),
    "started again with other markers": (
        lambda p: wide(p) + wide(p[:, :2], names=NAMES[:2]), "a.csv:22: has a second header"
    ),
    "started again in points": (
        lambda p: long(p, np.arange(60)) + long(p, np.arange(60)), "a.csv:62: has a second header, 'frame', below"
    ),
    "a remark": (
        lambda p: "\n".join([*wide(p).splitlines()[:9], "press begins" + 9 * ",", *wide(p).splitlines()[9:]]),
        "a.csv:10: has a second header, 'press begins', below lines of numbers; make one file of each recording, or",
    ),
    "commas of thousands": (
        lambda p: re.sub(r"\n0.0400,[^,]*,", '\n0.0400,"12,345",', wide(p)),
        "a.csv:4: holds '12,345', which is 12345 or 12.345; write numbers without commas",
    ),
    "motive without names": (
        lambda p: exported(p, [MOTIVE[0], "," + ",Position" * 9, MOTIVE[-1]]), "no line above that gives each its own"
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_table_gives_one_line_and_nothing_is_written(kind: str, track: np.ndarray, tmp_path: Path, capsys):
    text, said = WRONG[kind]
    (tmp_path / "a.csv").write_text(text(track), encoding="utf-8")
    out = tmp_path / "bags"
    assert command_line(["import", "points", str(tmp_path / "a.csv"), "--rate", "50", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and "; " in error and not out.exists()


def trc(points: np.ndarray, names: tuple[str, ...] = NAMES, n_frames: int = 20) -> str:
    """As OpenSim writes it: a blank line below the header."""
    head = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
            f"50\t50\t{n_frames}\t3\tmm", "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
            "\t\t" + "\t".join(f"{a}{k}" for k in (1, 2, 3) for a in "XYZ"), ""]  # fmt: skip
    rows = [f"{k + 1}\t{k / RATE:.3f}\t" + "\t".join(f"{1e3 * v:.4f}" for v in p.ravel()) for k, p in enumerate(points)]
    return "\r\n".join([*head, *rows]) + "\r\n"


def test_a_trc_file_as_opensim_writes_it(track: np.ndarray, tmp_path: Path):
    (tmp_path / "a.trc").write_text(trc(track), encoding="utf-8", newline="")
    take, _ = read_take([tmp_path / "a.trc"], Understanding())
    np.testing.assert_allclose(take.points, track, atol=1e-9)
    assert take.labels == NAMES


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda p: trc(p, ("a", "a", "b")), "has two markers called 'a'"),
        (lambda p: trc(p, ("a", "b")), "states NumMarkers 3 and holds 2"),
        (lambda p: trc(p, n_frames=21), "states NumFrames 21 and holds 20"),
        (lambda p: trc(p)[:-20], "a.trc:26: ends within a line"),
        (lambda p: trc(p).replace("\t0.100\t", "\tabc\t"), "a.trc:12: holds a cell that is no number"),
        (lambda p: "", "no five lines of header"),
    ],
)
def test_a_wrong_trc_file_gives_one_line(change, said: str, track: np.ndarray, tmp_path: Path, capsys):
    (tmp_path / "a.trc").write_text(change(track), encoding="utf-8", newline="")
    assert command_line(["import", "points", str(tmp_path / "a.trc"), "--out", str(tmp_path / "bags")]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and not (tmp_path / "bags").exists()


@pytest.mark.parametrize(
    "array, said",
    [
        (np.zeros((4, 9)), "holds 4 x 9 values"),
        (np.zeros((4, 3)), r"points\[:, None, :\]"),
        (np.zeros((4, 2, 3), complex), "holds complex128 values"),
        (np.zeros((4, 2, 3), bool), "holds bool values"),
        (np.zeros((0, 2, 3)), "holds no points"),
    ],
)
def test_a_wrong_array_is_refused(array: np.ndarray, said: str, tmp_path: Path):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InputError, match=said):
        read_take([tmp_path / "a.npy"], Understanding("mm", 10.0))


def test_markers_that_do_not_lie_as_declared_are_not_registered(track: np.ndarray):
    """Exchanged names, another unit, and a line about which a turn is not known."""
    places = np.vstack([track[0], [[0.03, 0.03, 0.06]]])
    T, misfit = register(places, places + 1.0)
    assert np.abs(misfit).max() < 1e-12 and T[:3, 3] == pytest.approx(-1.0)
    with pytest.raises(InputError, match=r"do not lie as the experiment's do.*check which is which"):
        register(places, places[[1, 0, 3, 2]])
    with pytest.raises(InputError, match=r"misfit 5.* mm rms"):
        register(places, 1e-3 * places)
    line = np.outer(np.arange(4.0), [0.02, 0.01, 0.0])
    with pytest.raises(InputError, match="lie on a line"):
        register(line, line)


def dice(rest: np.ndarray, moved: np.ndarray, lost: set[int]) -> str:
    """A stereo solution of DICe: a subset that it did not find has sigma -1 and no displacement."""
    head = "SUBSET_ID,COORDINATE_X,COORDINATE_Y,SIGMA,STATUS_FLAG,"
    head += ",".join(f"MODEL_{what}_{a}" for what in ("COORDINATES", "DISPLACEMENT") for a in "XYZ")
    rows = [
        f"{i},{100 + i}.0,200.0,{-1.0 if i in lost else 0.01},{-1 if i in lost else 4},"
        + ",".join(f"{v:.6E}" for v in (*p, *(0.0 * d if i in lost else d)))
        for i, (p, d) in enumerate(zip(rest, moved, strict=True))
    ]
    return "\n".join(["***", "*** Digital Image Correlation Engine (DICe)", "***", head, *rows]) + "\n"


def test_points_that_a_dic_tool_lost_are_not_at_rest(tmp_path: Path, capsys):
    rng = np.random.default_rng(2)
    rest = rng.uniform(0, 60, (40, 3))
    for k in range(4):
        (tmp_path / f"DICe_{k}.txt").write_text(dice(rest, np.full((40, 3), -1.0 * k), {3, 7} if k == 2 else set()))
    files = sorted(tmp_path.glob("*.txt"))
    take, _ = read_take(files, Understanding("mm", 2.0, dic=True))
    truth = 1e-3 * (rest - np.arange(4.0)[:, None, None])
    truth[2, [3, 7]] = np.nan
    np.testing.assert_allclose(take.points, truth, atol=1e-7)
    words = ["import", "points", *map(str, files), "--units", "mm", "--rate", "2", "--out", str(tmp_path / "bags")]
    assert command_line(words) == 2 and "give all moments of the take with --dic" in capsys.readouterr().err
    for k in range(2):  # numbers alone
        (tmp_path / f"bare_{k}.csv").write_text("".join(f"{x},{y},{z}\n" for x, y, z in rest))
    take, _ = read_take(sorted(tmp_path.glob("bare_*")), Understanding("mm", 2.0, dic=True))
    np.testing.assert_allclose(take.points[1], 1e-3 * rest, atol=1e-9)
