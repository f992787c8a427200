"""Points without ids in a recording: the run compares surfaces, and does not claim more than they show."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import small

from livedeform.cli import run as command_line
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Prediction
from livedeform.fem_node.model import PhantomModel
from livedeform.run.running import RunOptions, run

OFF = 6e-4  # m, outwards


def _write(path: Path, direct: list[Prediction], *, off: float, probe: bool = True) -> Path:
    """Points on the predicted triangles, moved along these: random ones, other ones in every frame."""
    rng = np.random.default_rng(0)
    with BagWriter(path, {"made_by": "tests"}) as bag:
        writer = RecordingWriter(bag)
        for k, (pose, p) in enumerate(zip(small.press(), direct, strict=True)):
            if probe:
                writer.pose(pose)
            corners = p.surface[p.triangles]
            top = np.flatnonzero((corners[:, :, 2] > 0.02).all(axis=1))
            at = rng.choice(top, 300 + k)
            normal = np.cross(corners[at, 1] - corners[at, 0], corners[at, 2] - corners[at, 0])
            normal /= np.linalg.norm(normal, axis=1)[:, None]
            points = np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), len(at)), corners[at]) + off * normal
            writer.surface_points(pose.stamp_ns, points, np.tile(np.eye(3) * 4e-10, (len(at), 1, 1)))
    return path


@pytest.mark.parametrize(("off", "verdict"), [(OFF, "WARN"), (6e-3, "ERROR")])
def test_points_without_ids_are_compared_with_the_surface(experiment, direct, tmp_path, off, verdict, capsys):
    bag = _write(tmp_path / "cloud.mcap", direct, off=off)
    assert command_line(["run", str(experiment), "--bag", str(bag), "--out", str(tmp_path / "out")]) == 0
    document = json.loads((tmp_path / "out" / "metrics.json").read_text())
    found = document["surface_error"]
    assert document["verdict"] == verdict and document["error"]["n"] == 0
    assert found["n"] == sum(300 + k for k in range(12)) and found["n_frames"] == found["n_measured"] == 12
    assert found["bias"]["value"] == pytest.approx(off, rel=0.1)  # at edges and hollows another place is nearest
    assert found["noise_from"] == "stated" and found["noise"] == pytest.approx(2e-5, rel=1e-3)
    rows = list(csv.DictReader((tmp_path / "out" / "surface.csv").open()))
    assert [int(r["n"]) for r in rows] == [300 + k for k in range(12)]
    said = capsys.readouterr().out
    assert "blind to sliding" in said
    assert command_line(["diagnose", str(experiment), "--fit", str(bag), "--out", str(tmp_path / "why")]) == 2
    assert "points without ids" in capsys.readouterr().err
    page = (tmp_path / "out" / "report.html").read_text()
    assert "blind to sliding" in page and "Distance from the predicted surface" in page


def test_without_a_probe_the_model_predicts_where_points_were_measured(tmp_path):
    folder = small.write_experiment(tmp_path / "still", probe=False)
    rest = PhantomModel.from_experiment(load_experiment(folder)).rest()
    bag = _write(tmp_path / "cloud.mcap", [rest] * 12, off=0.0, probe=False)
    metrics = run(RunOptions(folder, bag, tmp_path / "out"), lambda *_: None)
    assert metrics.surface is not None and metrics.surface.n_frames == 12
    assert metrics.surface.max < 1e-7  # single precision on the wire


def test_beside_markers_the_verdict_is_the_markers(experiment, direct, tmp_path):
    bag = tmp_path / "both.mcap"
    with BagWriter(bag, {"made_by": "tests"}) as file:
        writer = RecordingWriter(file)
        for pose, p in zip(small.press(), direct, strict=True):
            writer.marker_frame(small.frame(p.stamp_ns, p.ids, p.markers))
            writer.surface_points(pose.stamp_ns, p.surface)
            writer.pose(pose)
    metrics = run(RunOptions(experiment, bag, tmp_path / "out"), lambda *_: None)
    assert metrics.level == "OK" and metrics.n == 12 * 11
    assert metrics.surface is not None and metrics.surface.n_frames == 12 and metrics.surface.max < 1e-7
