"""The report of a real answer of the closed loop, on its toy body: nothing is retold, everything is there."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "closed_loop"))

import toy
import toy_loop as loop

from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.write import as_json
from livedeform.fem_node.mesh.structured import hemi_ellipsoid_mesh
from livedeform.report.diagnosis import collect
from livedeform.report.diagnosis import page as diagnosis_page
from livedeform.report.diagnosis.evidence import RestingBody
from livedeform.report.run.evidence import SurfaceMesh


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
