"""The report of a real answer of the closed loop, on its toy body: nothing is retold, everything is there."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "closed_loop"))

import toy
import toy_loop as loop

from livedeform import outputs
from livedeform.closed_loop.diagnosis import Diagnosis, Replay
from livedeform.closed_loop.write import as_json
from livedeform.fem_node.mesh.structured import hemi_ellipsoid_mesh
from livedeform.report.diagnosis import collect
from livedeform.report.diagnosis import page as diagnosis_page
from livedeform.report.diagnosis.evidence import RestingBody
from livedeform.report.run.evidence import SurfaceMesh
from livedeform.report.text import less_between


@pytest.fixture(scope="module")
def result() -> Diagnosis:
    return loop.closed([toy.effect("viscoelasticity", g=[0.3], tau=[2.0])])


def body(_: object) -> RestingBody:
    mesh = hemi_ellipsoid_mesh((0.05, 0.05, 0.05), 4)
    triangles = np.searchsorted(mesh.boundary_nodes, mesh.boundary_triangles)
    ids = np.arange(len(loop.PLACES), dtype=np.uint32)
    return RestingBody(SurfaceMesh(mesh.nodes[mesh.boundary_nodes], triangles), ids, loop.PLACES)


def test_the_page_of_an_answer(result: Diagnosis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collect, "body_at_rest", body)
    page = diagnosis_page.write_report(tmp_path, result, SimpleNamespace(name="toy"))  # type: ignore[arg-type]
    text = page.read_text()
    assert "Traced to viscoelasticity" in text
    assert "viscoelasticity.tau[0]" in text and "viscoelasticity.g[0]" in text
    before, after = as_json(result)["error_before"]["rmse"], as_json(result)["error_after"]["rmse"]
    assert f"{1e3 * before:.2f} mm before, {1e3 * after:.2f} mm after" in text
    for part in ("over-time-0", "per-marker", "on-surface", "ranking"):
        assert f'id="{part}-data"' in text
    assert "key moments of" in text and "added viscoelasticity" in text


def test_the_page_names_files_as_they_will_be_called(
    result: Diagnosis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collect, "body_at_rest", body)
    replayed = replace(result, replays=(Replay(Path("b.mcap")),))
    with outputs.prepared(tmp_path / "why", ["report.html"], force=False) as draft:
        diagnosis_page.write_report(draft, replayed, SimpleNamespace(name="toy"))  # type: ignore[arg-type]
    page = (tmp_path / "why" / "report.html").read_text()
    assert f"livedeform run {tmp_path}/why/experiment.fitted.yaml --bag b.mcap --out {tmp_path}/why/run" in page
    assert draft.name not in page


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (0.79, 0.831, "79 to 83 % less"),
        (-0.0048, 0.0323, "0.5 % more to 3.2 % less"),
        (-0.31, -0.0801, "31 to 8.0 % more"),
        (0.0, 0.0, "0.0 to 0.0 % less"),
        (-np.inf, 0.2, "– to 20 % less"),
    ],
)
def test_a_change_of_an_error_says_which_way_it_goes(low: float, high: float, said: str) -> None:
    assert less_between(low, high) == said


def test_residuals_are_the_held_out_single_frames(result: Diagnosis) -> None:
    evidence_before = collect.residuals(result.errors_before.recordings[0])
    errors = np.concatenate([r.distances for r in evidence_before])
    assert errors.max() == pytest.approx(result.before.max)
    assert len(errors) == result.before.n


def test_fit_rows_carry_value_and_sigma_of_the_answer(result: Diagnosis) -> None:
    rows = {r.name: r for r in collect.fit_rows(result)}
    effect = result.effects[0]
    for key, value in effect.values.items():
        row = rows[f"viscoelasticity.{key}[0]"]
        assert (row.value, row.sigma) == pytest.approx((value[0], effect.sigmas[key][0]))


def test_a_step_without_a_screening_of_its_own_tells_no_chance(result: Diagnosis) -> None:
    last = result.selection.steps[-1]
    taken = replace(last, added="", reason="skin explains nothing: taken out")
    steps = (*result.selection.steps, taken)
    said = dict(collect.facts(replace(result, selection=replace(result.selection, steps=steps))))
    assert said[f"step {len(steps)}"] == "skin explains nothing: taken out"
    assert "; chance alone: p = " in said[f"step {len(steps) - 1}"]
