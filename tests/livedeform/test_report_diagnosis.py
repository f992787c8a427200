"""The diagnosis page says diagnosis.json, before and after on one scale."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import page_data
import pytest

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


@pytest.mark.parametrize(
    ("value", "sigma", "interval", "said", "ends"),
    [
        (1.00234, 4e-5, (1.00226, 1.00242), "1.00234 ± 4e-05", "1.00226 … 1.00242"),
        (1234.56, 0.01, (1234.54, 1234.58), "1234.56 ± 0.01", "1234.54 … 1234.58"),
        (1.31, 0.02, (1.27, 1.35), "1.31 ± 0.02", "1.27 … 1.35"),
        (-1e-5, 0.3, (-0.6, 0.6), "-1e-05 ± 0.3", "-0.6 … 0.6"),
        (2.0, 0.0, (2.0, 2.0), "2</code>", "2 … 2"),
    ],
)
def test_a_value_has_the_digits_that_its_sigma_tells(
    tmp_path: Path, value: float, sigma: float, interval: tuple[float, float], said: str, ends: str
) -> None:
    """A scale of 1.00234 +- 0.00004 was "1.002 ± 4e-05", within "1.002 … 1.002"."""
    effects = [{"name": "stiffness", "parameters": {"ratio": {"value": value, "sigma": sigma}}}]
    rows = [FitRow("stiffness.ratio", "-", value, sigma, 1.0, 0.2, 5.0, False, interval)]
    evidence = dataclasses.replace(page_evidence(), fit=rows)
    text = write_diagnosis_report(tmp_path, diagnosis(effects=effects), evidence).read_text()
    assert f"ratio = {said}" in text and ends in text and "± 0<" not in text


@pytest.mark.parametrize(
    ("after", "interval", "said"),
    [
        (0.0002, [0.79, 0.83], "(82 % less; 95 % interval over presses like these: 79 to 83 % less)"),
        (0.00132, [-0.3, -0.1], "(20 % more; 95 % interval over presses like these: 30 to 10 % more)"),
        (0.0002, [None, None], "(82 % less; one press does not tell between which ends)"),
    ],
)
def test_the_change_of_the_error_has_one_sign_and_no_nan(
    tmp_path: Path, after: float, interval: list[float | None], said: str
) -> None:
    """An error that rose was "−-20 %", and an interval that there is not "nan to nan %"."""
    found = diagnosis(improvement_interval=interval)
    found["error_after"] = found["error_after"] | {"rmse": after}
    assert said in write_diagnosis_report(tmp_path, found, page_evidence()).read_text()
