"""A run's page, its files and its terminal show the same errors and the same body."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "livedeform"))

import page_data

from livedeform.cli import run as command_line
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.fem_node.mesh.generate import load_or_make


@dataclass(frozen=True)
class Shown:
    """A run as its files, page and terminal show it."""

    metrics: dict[str, Any]
    distances: np.ndarray
    html: str
    terminal: str


@pytest.fixture(scope="module")
def shown(experiment: Path, bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Shown:
    out = tmp_path_factory.mktemp("page") / "run"
    with pytest.MonkeyPatch.context() as patch:
        lines: list[str] = []
        patch.setattr("typer.echo", lambda text="", **_: lines.append(str(text)))
        assert command_line(["run", str(experiment), "--bag", str(bag), "--out", str(out)]) == 0
    with (out / "markers.csv").open() as file:
        distances = np.array([float(row["error"]) for row in csv.DictReader(file)])
    metrics = json.loads((out / "metrics.json").read_text())
    return Shown(metrics, distances, (out / "report.html").read_text(), "\n".join(lines))


def test_curve_bars_and_table_have_the_rms_of_the_file(shown: Shown):
    rmse = 1e3 * shown.metrics["error"]["rmse"]
    charts = page_data.charts(shown.html)
    (curve,) = [t for t in charts["over-time"] if t["name"] == "rmse"]
    n = page_data.numbers(curve["customdata"])
    assert page_data.pooled(page_data.numbers(curve["y"]), n) == pytest.approx(rmse, rel=1e-9)
    (bars,) = charts["per-marker"]
    per_marker = page_data.numbers(bars["customdata"])
    assert page_data.pooled(page_data.numbers(bars["y"]), per_marker) == pytest.approx(rmse, rel=1e-9)
    (dots,) = [t for t in charts["on-surface"] if t["meta"] == "whole run (rms)" and "customdata" in t]
    ids, sizes = page_data.numbers(dots["customdata"]).T
    assert [str(int(i)) for i in ids] == bars["x"]
    assert page_data.pooled(sizes, per_marker) == pytest.approx(rmse, rel=1e-9)
    assert 1e3 * np.sqrt(np.mean(shown.distances**2)) == pytest.approx(rmse, rel=1e-6)
    assert n.sum() == per_marker.sum() == len(shown.distances) == shown.metrics["error"]["n"]


def test_tiles_and_terminal_say_the_numbers_of_the_file(shown: Shown):
    tiles, error, coverage = page_data.tiles(shown.html), shown.metrics["error"], shown.metrics["coverage"]
    names = {"rmse": "rmse", "mean error": "mean", "95th percentile": "p95", "largest error": "max"}
    assert {name: tiles[name] for name in names} == {name: f"{1e3 * error[key]:.2f}" for name, key in names.items()}
    assert int(tiles["errors"]) == error["n"]
    assert tiles["compared"] == f"{coverage['frames_compared']} of {coverage['frames_measured']}"
    for key in ("rmse", "mean", "p95", "max"):
        assert f"{key + '_mm':10}{1e3 * error[key]:8.3f}" in shown.terminal
    assert f"verdict: {shown.metrics['verdict']}" in shown.terminal
    assert f"{error['n']} errors" in shown.terminal


def test_one_sentence(shown: Shown):
    _, headline, because = page_data.said(shown.html)
    assert shown.metrics["reason"] == f"{headline}: {because}"
    assert shown.metrics["reason"] in shown.terminal


def test_the_body_is_named_everywhere(shown: Shown, experiment: Path):
    """By its digest and with the repairs of its surface: it is the body that the model was made of."""
    _, report = load_or_make(load_experiment(experiment).phantom)  # type: ignore[arg-type]
    mesh = shown.metrics["mesh"]
    assert mesh["digest"] == report.digest
    assert mesh["repairs"] == list(report.repairs)
    assert mesh["report"][:-1] == report.lines()
    for line in report.lines():
        assert line in shown.html and f"mesh: {line}" in shown.terminal


def test_what_its_elements_get_wrong_is_said_everywhere(shown: Shown):
    """One number: the file's, in the words of terminal and page."""
    error, line = shown.metrics["mesh"]["discretisation"], shown.metrics["mesh"]["report"][-1]
    assert 0.0 < error["rms"] <= error["largest"]
    assert error["unknowns"][1] > error["unknowns"][0]
    assert f"wrong by about {1e3 * error['rms']:.3f} mm rms ({100 * error['share_of_motion']:.1f} %" in line
    assert line in shown.html and f"mesh: {line}" in shown.terminal
