"""The blind test: its cases, how they are sized, and how answers are judged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks.blind import cases as blind_cases
from benchmarks.blind.table import score, table

from livedeform.synthetic import scenario


def test_blind_cases_are_many_different_and_say_nothing_in_the_experiment() -> None:
    cases = blind_cases.large()
    assert len({c.name for c in cases}) == len(cases)
    kinds = [c.kind for c in cases]
    assert kinds.count("none") >= 60 and kinds.count("outside") == 24 and kinds.count("pair") == 48
    assert kinds.count("single") == 8 * 3 * len(blind_cases.VISIBLE)
    for case in cases[60:90]:
        spec = case.scenario()
        assert not any(name in spec["name"] for name in case.truth)
        scenario.load(spec)


def test_sizes_scale_the_distance_from_no_effect() -> None:
    assert blind_cases.sized("stiffness", 2.0)["ratio"] == pytest.approx(1.17)
    assert blind_cases.sized("poisson_ratio", 2.0)["value"] == pytest.approx(0.446)
    assert blind_cases.sized("base_slip", 2.0)["stiffness"] == pytest.approx(4.25e5)
    assert blind_cases.sized("probe_offset", 0.5)["translation"] == pytest.approx([5.5e-5, 0.0, 2.05e-4])


def test_the_table_judges_as_the_issue_asks(tmp_path: Path) -> None:
    cases = [
        blind_cases.Case("n0", "none", (), 0.0, 0),
        blind_cases.Case("s0", "single", (blind_cases.sized("stiffness", 2.0),), 2.0, 1),
        blind_cases.Case("d0", "single", (blind_cases.sized("density", 2.0),), 2.0, 2),
        blind_cases.Case("w0", "single", (blind_cases.sized("base_slip", 2.0),), 2.0, 3),
        blind_cases.Case("o0", "outside", (blind_cases.sized("tether", 2.0),), 2.0, 4),
    ]

    def answer(verdict: str, name: str = "", others: tuple[str, ...] = (), value: float = 1.1785) -> dict:
        effects = [{"name": name, "parameters": {"ratio": {"value": value, "sigma": 0.02}}}] if name else []
        rows = [{"name": name, "indistinguishable_from": list(others)}] if name else []
        before, after = {"rmse": 5e-4}, {"rmse": 2.1e-4}
        return {
            "verdict": verdict, "effects": effects, "candidates": rows, "error_before": before, "error_after": after,
            "noise_floor": 2e-4,
        }  # fmt: skip

    answers = [
        answer("none"),
        answer("effect", "stiffness", ("density",)),
        answer("effect", "stiffness", ("density",)),
        answer("effect", "skin"),
        answer("unexplained"),
    ]
    for case, found in zip(cases, answers, strict=True):
        (tmp_path / case.name).mkdir()
        result = {"diagnosis": found, "code": 0, "said": [], "seconds": 10.0}
        (tmp_path / case.name / "result.json").write_text(json.dumps(result))
    scores = [score(c, tmp_path) for c in cases]
    assert [s is not None and s.right for s in scores] == [True, True, False, False, True]
    assert [s is not None and s.in_set for s in scores[1:4]] == [True, True, False]
    assert [s is not None and s.confidently_wrong for s in scores] == [False, False, False, True, False]
    assert scores[1] is not None
    assert scores[1].errors == pytest.approx((0.05,)) and scores[1].covered == (True,)
    assert scores[1].removed == pytest.approx((0.25 - 0.0441) / (0.25 - 0.04))
    text = "\n".join(table(s for s in scores if s is not None))
    assert "named right at 2 x noise                              33.3 %  (1/3" in text
