"""The diagnosis page says diagnosis.json, before and after on one scale."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import page_data

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.report.diagnosis.evidence import Compared, DiagnosisEvidence, FitRow, RestingBody
from livedeform.report.diagnosis.page import diagnosis_verdict, write_diagnosis_report

from test_report import evidence as run_evidence  # isort: skip

INFO = EffectInfo(
    "stiffness", "body", "The Young's modulus is another.", "E = ratio E_declared", "definition",
    (Parameter("ratio", "-", 1.0, 0.2, 5.0, 0.5, 1.0),),
)  # fmt: skip


def diagnosis(**changes: Any) -> dict[str, Any]:
    error = {"rmse": 0.0011, "mean": 0.0009, "p95": 0.0021, "max": 0.0034, "n": 6200}
    return {
        "version": 1,
        "verdict": "effect",
        "effects": [{"name": "stiffness", "parameters": {"ratio": {"value": 1.31, "sigma": 0.02}}}],
        "candidates": [
            {"name": "stiffness", "test_rmse": 2.1e-4, "score": -81.0, "score_gap": 0.0, "indistinguishable_from": []},
            {"name": "skin", "test_rmse": 6.1e-4, "score": 120.5, "score_gap": 201.5, "indistinguishable_from": []},
        ],
        "error_before": error,
        "error_after": error | {"rmse": 0.0002},
        "noise_floor": 0.00019,
        "improvement_interval": [0.79, 0.83],
        "unexplained": "Nothing beyond the noise.",
    } | changes


def page_evidence() -> DiagnosisEvidence:
    e = run_evidence(20)
    after = [dataclasses.replace(r, predicted=r.predicted + 0.8 * r.errors) for r in e.residuals]
    compared = Compared("second press", True, e.start_ns, e.residuals, after, np.ones(len(after)))
    rows = [FitRow("stiffness.ratio", "-", 1.31, 0.02, 1.0, 0.2, 5.0, False)]
    stamp = e.residuals[10].stamp_ns
    shape = e.surfaces(stamp)
    assert shape is not None
    body = RestingBody(shape, e.residuals[10].ids, e.residuals[10].predicted)
    return DiagnosisEvidence(
        "block", [compared], {"stiffness": INFO}, rows, {("a", "b"): -0.4}, body, [("took", "9 s")]
    )


def test_the_page_says_the_diagnosis(tmp_path: Path) -> None:
    text = write_diagnosis_report(tmp_path, diagnosis(), page_evidence()).read_text()
    assert "Traced to stiffness" in text
    assert "1.10 mm before, 0.20 mm after" in text
    assert "ratio = 1.31 ± 0.02" in text
    assert "-0.40" in text
    assert list(page_data.figures(text)) == ["over-time-0", "per-marker", "on-surface", "ranking"]


def test_before_and_after_share_one_colour_scale(tmp_path: Path) -> None:
    text = write_diagnosis_report(tmp_path, diagnosis(), page_evidence()).read_text()
    traces = page_data.charts(text)["on-surface"]
    scales = {t["marker"]["cmax"] for t in traces if t["type"] == "scatter3d" and "cmax" in t.get("marker", {})}
    assert len(scales) == 1


def test_verdicts() -> None:
    assert diagnosis_verdict(diagnosis()).tone == "good"
    assert "nothing was added" in diagnosis_verdict(diagnosis(verdict="none", effects=[])).said
    assert "no known effect" in diagnosis_verdict(diagnosis(verdict="unexplained", effects=[])).said
    tied = diagnosis()
    tied["candidates"][0]["indistinguishable_from"] = ["density"]
    assert diagnosis_verdict(tied).said == "Traced to stiffness, or to density"
