"""The blind test: its cases, how they are sized, and how answers are judged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks.blind import cases as blind_cases
from benchmarks.blind.random_cases import MODULUS, NOISE, conditions, drawn_effect, randomised
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


def test_drawn_cases_are_the_same_each_time_and_can_be_made() -> None:
    cases = randomised(40)
    assert cases == randomised(40) and cases == randomised(60)[:80]
    assert len({c.seed for c in cases}) == 80 and [c.seed % 2 for c in cases[:4]] == [0, 1, 0, 1]
    for half in (0, 1):
        mine = [c for c in cases if c.seed % 2 == half]
        assert sum(c.kind == "none" for c in mine) == 16
        assert {n for c in mine for n in c.truth} == set(blind_cases.VISIBLE)
        assert sum(c.size == 1.0 for c in mine) == 8
    for case in cases:
        spec = case.scenario()
        assert spec == case.scenario()
        assert not any(name in case.name + spec["name"] for name in case.truth)
        scenario.load(spec)
        body = spec["body"]
        reach = np.array(body["semi_axes"][:2] if "semi_axes" in body else [v / 2.0 for v in body["size"][:2]])
        for press in [p for presses in spec["recordings"].values() for p in presses]:
            end = np.abs(np.array(press["at"]) + press.get("stroke", [0.0, 0.0]))
            assert (end < 0.75 * reach).all()


def test_drawn_effects_grow_with_the_noise_and_with_what_hides_them() -> None:
    spec, rng = conditions(0), np.random.default_rng(0)
    spec["measuring"]["noise_px"], spec["declared"]["youngs_modulus"] = 2.0 * NOISE, MODULUS
    assert drawn_effect("time_offset", 1.0, spec, rng) == blind_cases.sized("time_offset", 2.0)
    spec["declared"]["youngs_modulus"] = 1.5 * MODULUS
    assert drawn_effect("gravity_tilt", 1.0, spec, rng) == blind_cases.sized("gravity_tilt", 3.0)
    slip = drawn_effect("base_slip", 1.0, spec, rng)["stiffness"]
    assert slip == pytest.approx(1.5 * blind_cases.sized("base_slip", 2.0)["stiffness"])
    assert drawn_effect("density", 4.0, spec, rng) == blind_cases.sized("density", 6.0)


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
