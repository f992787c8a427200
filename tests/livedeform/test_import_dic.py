"""Tables of one moment each: places at rest with their displacements are moved once, places of the moment never twice,
and times are those that the files' names tell."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from livedeform.cli import run as command_line
from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.types import decode
from livedeform.common.errors import RecordingError
from livedeform.importing.points import Understanding, read_take
from livedeform.importing.tables import in_order, moments_of

DOWN = -3.0  # mm from each file to the next
DISPLACEMENTS = (
    ("U", "V", "W"), ("u", "v", "w"), ("Ux", "Uy", "Uz"), ("u_x", "u_y", "u_z"), ("dX", "dY", "dZ"),
    ("d_x", "d_y", "d_z"), ("disp_x", "disp_y", "disp_z"), ("disp.x", "disp.y", "disp.z"),
    ("Displacement X", "Displacement Y", "Displacement Z"),
)  # fmt: skip


def rest(n: int = 30) -> np.ndarray:
    """(n, 3) mm."""
    return np.random.default_rng(0).uniform(-40, 40, (n, 3)) * [1, 1, 0.1] + [0, 0, 300]


def written(
    folder: Path, columns: tuple[str, ...], now: bool = False, kept: Callable[[int], slice] = lambda k: slice(None)
) -> list[Path]:
    """Four files; ``now``: places are those of the moment, beside displacements; of file k the rows ``kept(k)``."""
    for k in range(4):
        move = np.array([0.1 * k, 0.0, DOWN * k])
        rows = [",".join(f"{v:.4f}" for v in (*(p + now * move), *move)) for p in rest()[kept(k)]]
        (folder / f"a_{k}.csv").write_text("\n".join([",".join(["X", "Y", "Z", *columns]), *rows]) + "\n")
    return sorted(folder.glob("a_*.csv"))


def clouds(files: list[Path], out: Path) -> list[np.ndarray]:
    """What `livedeform import surface` writes of them, mm."""
    words = ["import", "surface", *map(str, files), "--rate", "5", "--units", "mm", "--out", str(out)]
    assert command_line(words) == 0
    with read_bag(next(out.glob("*.mcap"))) as bag:
        return [1e3 * layouts.points(layouts.unpack(decode(raw))) for raw in bag.messages([t.STEREO_SURFACE])]


@pytest.mark.parametrize("columns", DISPLACEMENTS, ids=lambda c: c[0])
def test_points_move_as_their_displacements_say(columns: tuple[str, ...], tmp_path: Path, capsys):
    files = written(tmp_path, columns)
    take, said = read_take(files, Understanding("mm", 5.0, dic=True))
    moved = 1e3 * (take.points[3] - take.points[0])
    np.testing.assert_allclose(moved, np.tile([0.3, 0.0, 3 * DOWN], (30, 1)), atol=1e-9)  # it was 0.0 by seven of nine
    assert f"displacements {', '.join(columns)} added" in said
    found = clouds(files, tmp_path / "bags")
    np.testing.assert_allclose(found[3] - found[0], moved, atol=1e-4)  # float32 m
    assert f"{columns[2]} added" in capsys.readouterr().out


def test_that_nothing_was_added_is_said(tmp_path: Path, capsys):
    for k in range(2):
        (tmp_path / f"a_{k}.csv").write_text("x,y,z,strain_x\n" + "".join(f"{x},{y},{z},0\n" for x, y, z in rest()))
    files = sorted(tmp_path.glob("a_*.csv"))
    assert "no displacements added" in read_take(files, Understanding("mm", 5.0, dic=True))[1]
    clouds(files, tmp_path / "bags")
    assert "no displacements added" in capsys.readouterr().out


@pytest.mark.parametrize("kept", [slice(None), slice(2, None)], ids=["all rows", "rows that come and go"])
def test_places_of_the_moment_are_not_moved_twice(kept: slice, tmp_path: Path, capsys):
    """As some tools write them; those at rest of which some rows were lost are as they were."""
    files = written(tmp_path, ("dx", "dy", "dz"), now=True, kept=lambda k: kept if k else slice(None))
    said = (
        "a_3.csv: its places change from file to file as dx, dy, dz say, and would be moved twice; delete the columns"
    )
    if kept == slice(None):
        with pytest.raises(RecordingError, match=said):
            read_take(files, Understanding("mm", 5.0, dic=True))
    out = tmp_path / "bags"
    words = ["import", "surface", *map(str, files), "--rate", "5", "--units", "mm", "--out", str(out)]
    assert command_line(words) == 2 and said in capsys.readouterr().err and not out.exists()
    files = written(tmp_path, ("dx", "dy", "dz"), kept=lambda k: kept if k else slice(None))
    found = clouds(files, out)
    np.testing.assert_allclose(found[3] - found[0][kept], np.tile([0.3, 0.0, -9.0], (len(found[3]), 1)), atol=1e-4)


@pytest.mark.parametrize(
    "head", ["u,v,X,Y,Z,U,V,W", "x,y,X,Y,Z,U,V,W", '"u [pixel]","x","X [mm]","Y [mm]","Z [mm]",U [mm],V [mm],W [mm]']
)
def test_what_is_in_the_picture_is_left_out(head: str, tmp_path: Path):
    """VIC-3D's whole export: pixels beside millimetres, that differ in their letters' case alone."""
    for k in range(2):
        (tmp_path / f"a_{k}.csv").write_text(f"{head}\n9,9,1,2,3,0,0,{k}\n9,9,4,5,6,0,0,{k}\n")
    take, _ = read_take(sorted(tmp_path.glob("a_*.csv")), Understanding("mm", 5.0, dic=True))
    np.testing.assert_allclose(take.points[:, 0], [[1e-3, 2e-3, 3e-3], [1e-3, 2e-3, 4e-3]])


def test_displacements_in_space_and_in_the_picture_are_not_confused(tmp_path: Path):
    for k in range(2):
        (tmp_path / f"a_{k}.csv").write_text("u,v,x,y,z,U,V,W\n" + "9,9,1,2,3,0,0,1\n9,9,4,5,6,0,0,1\n")
    with pytest.raises(RecordingError, match="has the column 'u' twice; keep places and displacements in space"):
        read_take(sorted(tmp_path.glob("a_*.csv")), Understanding("mm", 5.0, dic=True))


BY_ORDER = " (times by the files' order)"
CLOCKS = {  # names in order: moments
    "10-00-57 10-00-58 10-00-59 10-01-07 10-01-08": [0, 1, 2, 10, 11],
    "2026-01-01_10-00-00 2026-01-01_10-00-01 2026-01-01_10-01-02": [0, 1, 62],
    "a_20260101_100058 a_20260101_100059 a_20260101_100100 a_20260101_100102": [0, 1, 2, 4],
    "09.59.58_b 09.59.59_b 10.00.00_b 10.00.02_b": [0, 1, 2, 4],
    "s_0.0 s_0.5 s_1.0 s_3.0 s_3.5": [0, 1, 2, 6, 7],
    "s_0.0 s_0.25 s_0.5 s_0.75 s_1.0 s_1.5": [0, 1, 2, 3, 4, 6],
}
ORDERS = ("touch lift", "a1_1 a1_2 a2_1", "c1.1 c1.2 c2.1 c2.2", "c1.8 c1.9 c1.10 c2.1", "a_000 b_000 a_001 b_001",
          "59_8 59_9 60_0 60_3", "10-00-57.12 10-00-58.31 10-01-02.11")  # fmt: skip


@pytest.mark.parametrize("names", CLOCKS)
def test_times_of_day_and_decimals_in_names_leave_gaps(names: str):
    """Steps are of --rate, as those of a number."""
    files = [Path(f"{name}.csv") for name in names.split()]
    ordered = in_order(files[::-1])
    assert [f.stem for f in ordered] == names.split()
    moments, said = moments_of(ordered)
    assert moments.tolist() == CLOCKS[names]
    assert said == f" ({CLOCKS[names][-1] + 1 - len(files)} missing by the files' numbers)"


@pytest.mark.parametrize("names", ORDERS)
def test_that_times_are_by_the_files_order_is_said(names: str, tmp_path: Path):
    """Where two numbers count, or none does."""
    files = [tmp_path / f"{name}.csv" for name in names.split()]
    moments, said = moments_of(in_order(files))
    assert moments.tolist() == list(range(len(files))) and said == BY_ORDER
    for path in files:
        path.write_text("x,y,z\n1,2,3\n4,5,60\n")
    assert BY_ORDER in read_take(files, Understanding("mm", 5.0, dic=True))[1]
