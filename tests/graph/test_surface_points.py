"""Points without ids in a recording: the run compares surfaces, and does not claim more than they show."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small
import trimesh
import yaml

from livedeform.cli import run as command_line
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Prediction
from livedeform.compare_node.judgement import judge
from livedeform.compare_node.metrics import run_metrics
from livedeform.compare_node.surface_error import surface_error
from livedeform.fem_node.model import PhantomModel
from livedeform.run.running import RunOptions, run
from livedeform.run.surfaces import Cloud, distances

OFF = 6e-4  # m, outwards


def _write(path: Path, direct: list[Prediction], *, off: float, probe: bool = True, **about: str) -> Path:
    """Points on the predicted triangles, moved along these: random ones, other ones in every frame."""
    rng = np.random.default_rng(0)
    with BagWriter(path, {"made_by": "tests", **about}) as bag:
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


def _without_markers(experiment: Path, folder: Path) -> Path:
    """The same experiment, of a body of which only points without ids are measured."""
    shutil.copytree(experiment, folder)
    description = yaml.safe_load((folder / "experiment.yaml").read_text())
    (folder / description["phantom"].pop("markers")).unlink()
    description.pop("stereo", None)
    (folder / "experiment.yaml").write_text(yaml.safe_dump(description))
    return folder


def test_points_without_ids_need_no_markers_and_their_registration_is_told(experiment, direct, tmp_path, capsys):
    bare = _without_markers(experiment, tmp_path / "bare")
    assert command_line(["info", str(bare)]) == 0 and "none, for points without ids" in capsys.readouterr().out
    bag = _write(tmp_path / "c.mcap", direct, off=OFF, registration="laid on", registration_sigma_m="2e-4")
    assert command_line(["run", str(bare), "--bag", str(bag), "--out", str(tmp_path / "out")]) == 0
    document = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert document["surface_error"]["registration"] == 2e-4 and document["registration"]["text"] == "laid on"
    assert document["surface_error"]["bias"]["value"] == pytest.approx(OFF, rel=0.1)
    assert "all moments may be off by 0.200 mm" in capsys.readouterr().out
    assert command_line(["report", str(tmp_path / "out")]) == 0


def test_an_experiment_without_markers_refuses_what_needs_them(experiment, direct, tmp_path, capsys):
    bare, bag = _without_markers(experiment, tmp_path / "bare"), tmp_path / "m.mcap"
    with BagWriter(bag, {}) as file:
        for p in direct:
            RecordingWriter(file).marker_frame(small.frame(p.stamp_ns, p.ids, p.markers))
    for words in (["run", str(bare), "--bag", str(bag)], ["diagnose", str(bare), "--fit", str(bag)]):
        capsys.readouterr()
        assert command_line([*words, "--out", str(tmp_path / words[0])]) == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert "marker" in error and "; " in error and not (tmp_path / words[0]).exists()


@pytest.mark.parametrize(("registration", "level"), [(2e-3, "WARN"), (1e-5, "ERROR"), (float("nan"), "ERROR")])
def test_an_error_that_the_registration_may_be_is_no_error_of_the_model(registration, level):
    box = trimesh.creation.box([0.06, 0.05, 0.04])
    frame = distances(Cloud(0, np.array([[0.0, 0.0, 0.0255]]), np.full((1, 3, 3), np.nan)), box.vertices, box.faces)
    found = replace(surface_error([frame], 1, {}), registration=registration)
    assert judge(replace(run_metrics([], 0.005), surface=found)).level == level  # 5.5 mm where 5 are allowed


@pytest.mark.parametrize(("every", "level"), [(10, "WARN"), (2, "")])
def test_moments_between_poses_that_are_far_apart_are_told_before_a_run(
    experiment, direct, tmp_path, every, level, capsys
):
    """A probe whose poses were written down by hand once a second; frames come at 10 Hz."""
    bag = tmp_path / "by_hand.mcap"
    with BagWriter(bag, {}) as file:
        writer, pose = RecordingWriter(file), small.press()[0]
        for k in range(31):
            stamp = small.START_NS + k * 100_000_000
            writer.marker_frame(small.frame(stamp, direct[0].ids, direct[0].markers))
            if k % every == 0:
                writer.pose(replace(pose, stamp_ns=stamp))
    assert command_line(["info", str(bag), "--experiment", str(experiment)]) == 0
    said = capsys.readouterr().out
    told = "for 100 % of the time the probe's poses are more than 0.5 s apart (up to 1 s)"
    assert (told in said) == bool(level)
