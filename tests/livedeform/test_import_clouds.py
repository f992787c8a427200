"""``livedeform import surface``: tables of other lengths and scans become clouds without ids."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from livedeform.cli import run as command_line
from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.types import decode


def clouds(bag_path: Path) -> list[np.ndarray]:
    with read_bag(bag_path) as bag:
        return [layouts.points(layouts.unpack(decode(raw))) for raw in bag.messages([t.STEREO_SURFACE])]


def test_tables_of_other_lengths_become_clouds(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    rng = np.random.default_rng(0)
    places = [rng.uniform(0, 60, (2000 + 10 * k, 3)) for k in range(4)]
    for k, points in enumerate(places):
        rows = "".join(f"{x:.4f},{y:.4f},{z:.4f}\n" for x, y, z in points)
        (tmp_path / f"duo_{k + 8}.csv").write_text("X,Y,Z\n" + rows)  # 8, 9, 10, 11: by number, not by letter
    files = [str(f) for f in tmp_path.glob("duo_*.csv")]
    base = ["import", "surface", *files, "--out", str(tmp_path / "bags")]
    assert command_line([*base, "--units", "mm"]) == 2 and "--rate" in capsys.readouterr().err
    assert command_line([*base, "--rate", "2"]) == 2 and "--units mm" in capsys.readouterr().err
    assert command_line([*base, "--rate", "2", "--units", "mm"]) == 0
    assert "2000 to 2030 points without ids" in capsys.readouterr().out
    found = clouds(tmp_path / "bags" / "duo_8.mcap")
    for points, cloud in zip(places, found, strict=True):
        np.testing.assert_allclose(cloud, 1e-3 * points, atol=1e-7)


def test_scans_become_clouds(tmp_path: Path):
    for k in range(3):
        ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05 + 1e-3 * k)
        ball.export(tmp_path / f"scan{k}.ply")
    files = [str(f) for f in sorted(tmp_path.glob("*.ply"))]
    words = ["import", "surface", *files, "--rate", "5", "--units", "m", "--out", str(tmp_path / "bags")]
    assert command_line(words) == 0
    radii = [np.linalg.norm(c, axis=1).mean() for c in clouds(tmp_path / "bags" / "scan0.mcap")]
    assert radii == pytest.approx([0.05, 0.051, 0.052], abs=1e-6)
    (tmp_path / "scan3.ply").write_bytes(b"ply\nformat ascii 1.0\nnonsense")
    assert command_line([*words, str(tmp_path / "scan3.ply"), "--force"]) == 2


def test_nothing_is_seen_at_exactly_nought(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """As depth cameras write pixels without depth, in tables and in scans."""
    places = np.random.default_rng(0).uniform(10, 60, (400, 3))
    places[100:150] = 0.0
    for k in range(2):
        (tmp_path / f"a_{k}.csv").write_text("x,y,z\n" + "".join(f"{x:.4f},{y:.4f},{z:.4f}\n" for x, y, z in places))
        trimesh.PointCloud(places).export(tmp_path / f"b_{k}.ply")
    for name in ("a_*.csv", "b_*.ply"):
        files = [str(f) for f in tmp_path.glob(name)]
        words = ["import", "surface", *files, "--rate", "5", "--units", "mm", "--out", str(tmp_path / "bags")]
        assert command_line(words) == 0
        assert "left out, as not measured: 100 points at exactly 0, 0, 0" in capsys.readouterr().out
        for cloud in clouds(tmp_path / "bags" / f"{name[0]}_0.mcap"):
            np.testing.assert_allclose(cloud, 1e-3 * places[places.any(axis=1)], atol=1e-7)
