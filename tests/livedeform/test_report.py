"""The run's page: complete, self-contained, and its numbers are compare_node's."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import page_data
import pytest
from plotly.offline import get_plotlyjs

from livedeform.common.errors import InputError
from livedeform.common.frames import transform
from livedeform.common.types import Array, CameraCalibration, Image, PredictedMarkers, Wrench
from livedeform.compare_node.judgement import judge
from livedeform.compare_node.metrics import run_metrics
from livedeform.compare_node.residual import Residual
from livedeform.fem_node.mesh.structured import hemi_ellipsoid_mesh
from livedeform.report import plots
from livedeform.report.playback import Playback, ViewedMoment, figure
from livedeform.report.run import read
from livedeform.report.run.charts import per_marker_chart
from livedeform.report.run.counts import describe_counts
from livedeform.report.run.evidence import RunEvidence, SurfaceMesh
from livedeform.report.run.moments import DEEPEST, interesting_moments
from livedeform.report.run.page import write_run_page
from livedeform.report.run.summary import RunSummary
from livedeform.stereo_node.camera.rig import StereoRig

RNG = np.random.default_rng(7)
T_PHANTOM_LEFT = transform(np.diag([1.0, -1.0, -1.0]), np.array([-0.04, 0.0, 0.40]))  # 0.4 m above, looking down


def experiment() -> Any:
    """What the page reads of an experiment."""
    return SimpleNamespace(name="a dimple <in> a hemi-ellipsoid", thresholds=SimpleNamespace(error=0.005), effects=())


def camera(name: str, tx: float = 0.0) -> CameraCalibration:
    K = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]])
    projection = np.column_stack([K, [tx * 1000.0, 0.0, 0.0]])
    return CameraCalibration(name, 1280, 720, K, np.array([-0.05, 0.01, 0.0, 0.0, 0.0]), np.eye(3), projection)


def evidence(n_frames: int = 40) -> RunEvidence:
    """A dimple that comes and goes, measured with noise and a 0.5 mm larger dimple."""
    mesh = hemi_ellipsoid_mesh((0.05, 0.045, 0.055), 8)
    triangles = np.searchsorted(mesh.boundary_nodes, mesh.boundary_triangles)
    surface = mesh.nodes[mesh.boundary_nodes]
    rows = np.flatnonzero(surface[:, 2] > 0.01)[::7]
    ids = np.arange(1, len(rows) + 1, dtype=np.uint32)

    def pressed(points: Array, depth: float) -> Array:
        out = points.copy()
        out[:, 2] -= depth * np.exp(-(points[:, :2] ** 2).sum(1) / 0.02**2) * points[:, 2] / 0.055
        return out

    residuals, predictions, wrenches, shapes = [], [], [], {}
    for k in range(n_frames):
        depth = 0.010 * np.sin(np.pi * k / (n_frames - 1)) ** 2
        predicted = pressed(surface, depth)
        measured = pressed(surface, 1.05 * depth)[rows] + RNG.normal(0.0, 1e-4, (len(rows), 3))
        stamp = 1_000_000_000 + k * 100_000_000
        predictions.append(PredictedMarkers(stamp, ids, predicted[rows]))
        wrenches.append(Wrench(stamp, np.array([0.0, 0.0, -200.0 * depth]), np.zeros(3)))
        shapes[stamp] = SurfaceMesh(predicted, triangles)
        residuals.append(Residual(stamp, ids, measured, predicted[rows], np.tile(np.eye(3) * 1e-8, (len(ids), 1, 1))))
    rig = StereoRig(camera("left"), camera("right", -0.1))
    grey = np.linspace(40, 200, 1280, dtype=np.uint8)[None].repeat(720, 0)
    return RunEvidence(
        start_ns=1_000_000_000,
        residuals=residuals,
        predictions=predictions,
        wrenches=wrenches,
        surfaces=shapes.get,
        rig=rig,
        T_phantom_left=T_PHANTOM_LEFT,
        pictures=lambda stamp: (Image(stamp, grey), Image(stamp, grey)),
        counts=describe_counts({"matched_frames": n_frames, "predicted_not_converged": 0}),
        facts=[("seed", "7")],
        configuration="version: 1\n",
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = write_run_page(tmp_path_factory.mktemp("run") / "report.html", evidence(), experiment())
    return path.read_text()


def test_the_page_needs_no_network(page: str) -> None:
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", page)
    assert "@import" not in page
    assert len(page) < 2_600_000  # 2.2 MB measured, of which plotly is 2.0


def test_plotly_and_large_figures_are_packed_in_the_page(page: str) -> None:
    """4.8 MB of plotly as it was installed, in 2.0; the script that unpacks them is the browser's test's."""
    packed = re.search(r'<script type="application/gzip" id="plotly">(.*?)</script>', page, re.S)
    assert packed is not None
    assert page_data.unpacked(packed[1]) == get_plotlyjs()
    assert len(packed[1]) < 2_100_000
    assert '<script type="application/gzip" id="on-surface-data">' in page


def test_the_page_says_the_metrics(page: str) -> None:
    e = evidence()
    metrics = run_metrics(e.residuals, 0.005)
    assert f"{metrics.rmse.value * 1e3:.2f}" in page
    assert "The model is within 5 mm" in page
    for heading in ("Error over time", "Error on the surface", "Error per marker", "Worst moments", "What was counted"):
        assert heading in page


def test_names_are_escaped(page: str) -> None:
    assert "a dimple &lt;in&gt; a hemi-ellipsoid" in page
    assert "<in>" not in page


def test_charts_hold_finite_json(page: str) -> None:
    figures = page_data.figures(page)
    assert list(figures) == ["over-time", "on-surface", "per-marker"]
    assert all(figure["data"] for figure in figures.values())


def test_pictures_carry_outline_and_markers(page: str) -> None:
    assert page.count('<figure class="picture">') == 6  # three moments, two cameras
    assert len(re.findall(r'<path class="outline" d="M\d', page)) == 6


def test_moments_are_rest_press_and_worst() -> None:
    e = evidence()
    moments = interesting_moments(e.residuals, e)
    assert moments[0].name == "at rest"
    deepest = next(m for m in moments if DEEPEST in m.name)
    assert deepest.residual.stamp_ns in {e.predictions[19].stamp_ns, e.predictions[20].stamp_ns}


def test_nothing_to_judge_is_said(tmp_path: Path) -> None:
    text = write_run_page(tmp_path / "r.html", RunEvidence(0, [], []), experiment()).read_text()
    assert "There is nothing to judge" in text


def test_a_single_frame_is_seen_in_the_chart(tmp_path: Path) -> None:
    """It was a line of one point, which is nothing."""
    for n, mode in ((1, "lines+markers"), (40, "lines")):
        e = evidence()
        one = replace(e, residuals=e.residuals[:n], predictions=e.predictions[:n], wrenches=e.wrenches[:n])
        text = write_run_page(tmp_path / "report.html", one, experiment()).read_text()
        assert {trace["mode"] for trace in page_data.charts(text)["over-time"]} == {mode}


@pytest.mark.parametrize("scale", [1e-3, 1e-2, 1.0])
def test_small_errors_are_not_shown_as_none(tmp_path: Path, scale: float) -> None:
    """Of a run within 1 um page and verdict said "0.00 mm, 0.00 to 0.00"."""
    e = evidence()
    near = [replace(r, measured=r.predicted + scale * r.errors) for r in e.residuals]
    text = write_run_page(tmp_path / "report.html", replace(e, residuals=near), experiment()).read_text()
    metrics = run_metrics(near, 0.005)
    tiles = page_data.tiles(text)
    for name, value in (
        ("rmse", metrics.rmse.value),
        ("mean error", metrics.mean.value),
        ("largest error", metrics.max),
    ):
        assert float(tiles[name].split()[0]) == pytest.approx(1e3 * value, rel=0.06)
    said = re.search(r"rmse ([0-9.]+) mm", judge(metrics).because)
    assert said is not None and float(said[1]) == pytest.approx(1e3 * metrics.rmse.value, rel=0.06)


def test_whiskers_are_of_each_markers_own_errors() -> None:
    """As they were marker by marker, frame by frame, which took 18 s for 200 markers in 6000 frames."""
    e = evidence()
    seen = [np.flatnonzero((r.ids + k) % 5 > 0) for k, r in enumerate(e.residuals)]
    some = [
        Residual(r.stamp_ns, r.ids[at], r.measured[at], r.predicted[at], r.covariances[at])
        for r, at in zip(e.residuals, seen, strict=True)
    ]
    metrics = run_metrics(some, 0.005)
    run = RunSummary(replace(e, residuals=some), experiment(), metrics, np.zeros(40), np.zeros(40))
    ids = np.array([m.id for m in metrics.markers], np.uint32)
    found = per_marker_chart(run)
    assert found is not None
    whiskers = dict(zip(found.figure.data[0].x, found.figure.data[0].error_y.array, strict=True))
    for marker in ids[:5]:
        squares = np.concatenate([r.distances[r.ids == marker] ** 2 for r in some])
        n_effective = max(1.0, metrics.n_effective * len(squares) / metrics.n_frames)
        half = 1.96 * squares.std() / (2.0 * np.sqrt(squares.mean() * n_effective))
        assert whiskers[str(marker)] == pytest.approx(1e3 * half)


@pytest.mark.parametrize("at", [2500, 2501, 6998, 7000])
def test_a_peak_of_a_single_frame_is_in_the_chart(at: int) -> None:
    """Of more than 3000 frames every second or third was shown, and the largest error often was not."""
    values = np.full(7001, 0.1)
    values[at], values[at - 5] = 3.0, np.nan
    line = plots.Line("rmse", 0.01 * np.arange(7001), values, plots.BLUE, weights=np.arange(7001.0))
    shown = plots.error_over_time([line], None, {}).data[0]
    assert len(shown.x) <= plots.MAX_POINTS and max(shown.y) == 3.0
    assert np.all(np.diff(shown.x) > 0.0) and shown.customdata[np.nanargmax(shown.y)] == at


def test_moments_that_are_near_have_names_of_their_own() -> None:
    """The slider finds them by these: 4 ms apart, it showed two of three moments as another."""
    e = evidence(10)
    body = e.surfaces(e.residuals[0].stamp_ns)
    assert body is not None
    none, no_rows = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    for step, first in ((0.004, "0.000"), (0.1, "0.00")):
        moments = [
            ViewedMoment(k * step, body.vertices, r, None, np.zeros(0, np.int64)) for k, r in enumerate(e.residuals)
        ]
        names = [frame.name for frame in figure(Playback(moments, body.triangles, none, no_rows, none)).frames]
        assert len(set(names)) == 10 and names[0] == first


@pytest.mark.parametrize("text", ["{", "", "[1]", "null"])
def test_torn_metrics_are_one_line(tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "metrics.json").write_text(text)
    monkeypatch.setattr(read, "load_recording", lambda *_: None)  # it is whole
    with pytest.raises(InputError, match="is not what livedeform run wrote"):
        read.load_evidence(tmp_path, experiment())
