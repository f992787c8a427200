"""The benchmark of intervals: its two halves share nothing, its truth is exact where modulus jumps, it counts right."""

from pathlib import Path

import numpy as np
import pytest
from benchmarks.coverage import BODIES, FineTruth, cases, numbers_of, table

from benchmarks import coverage
from livedeform.synthetic.solved_motion import SHAPES, build_world


def test_no_case_is_in_both_halves_and_each_has_presses_of_its_own() -> None:
    tuning, proof = cases("tuning"), cases("proof")
    assert not {c.seed for c in tuning} & {c.seed for c in proof}
    for one, other in zip(tuning[::2], proof[::2], strict=True):
        assert one.effect == other.effect
        assert one.true != other.true
        assert one.scenario()["recordings"] != other.scenario()["recordings"]


def test_twins_share_what_is_solved_and_differ_in_noise_or_elements() -> None:
    one, two = cases("proof")[:2]
    assert one.true == two.true
    assert one.scenario()["recordings"] == two.scenario()["recordings"]
    assert one.settings.sampling.mesh_vertices != two.settings.sampling.mesh_vertices


@pytest.mark.parametrize("name", ["block", pytest.param("cuboid", marks=pytest.mark.slow)])
@pytest.mark.parametrize("thickness", [0.003, *(pytest.param(t, marks=pytest.mark.slow) for t in (0.005, 0.007))])
def test_the_truth_s_layer_is_as_thick_as_it_says(name: str, thickness: float) -> None:
    case = next(c for c in cases("proof") if c.effect == "skin")
    effect = {"name": "skin", "ratio": 2.0, "thickness": thickness}
    spec = {**case.scenario(), "body": BODIES[name], "truth": [effect], "temperature": None}
    world, shape = build_world(spec)
    truth = FineTruth(world, shape)
    body = truth._body
    more = body._moduli(0.0)[0] / body._moduli(0.0)[0].min() - 1.0
    truth.close()
    x, y, z = np.ptp(SHAPES["block"](BODIES[name]).nodes, axis=0)
    layer = x * y * z - (x - 2 * thickness) * (y - 2 * thickness) * (z - thickness)  # none at the base
    assert float((more * body.w0).sum()) == pytest.approx(layer, rel=0.03)


@pytest.mark.parametrize("x", [0.0, 0.005, 0.011])
def test_the_truth_s_elements_keep_what_is_in_them_wherever_it_lies(x: float) -> None:
    ratio, radius = 0.3, 0.007  # of what is softer the modulus goes over in equal steps
    ball = {"name": "inclusion", "ratio": ratio, "radius": radius, "centre": [x, 0.003, 0.024]}
    case = next(c for c in cases("proof") if c.effect == "skin")
    spec = {**case.scenario(), "body": BODIES["block"], "truth": [ball], "temperature": None}
    truth = FineTruth(*build_world(spec))
    share = truth._body._moduli(0.0)[0] / truth._body._moduli(0.0)[0].max()  # nothing is above the rest's
    less = float(((1.0 - share) * truth._body.w0).sum())
    truth.close()
    assert less == pytest.approx((1.0 - ratio) * 4.0 / 3.0 * np.pi * radius**3, rel=0.06)  # measured 2 to 5 %


def test_an_inclusion_s_elements_end_where_it_does() -> None:
    for case in [c for c in cases("proof") if c.effect == "inclusion"][:4]:
        spec = case.scenario()
        assert spec["body"]["shape"] == "block" and spec["body"]["ball"]["radius"] == case.true["radius"]
        world, _ = build_world({**spec, "temperature": None})
        distance = np.linalg.norm(world.mesh.nodes - case.true["centre"], axis=1)
        assert np.isclose(distance, case.true["radius"], rtol=1e-9).sum() > 100


def test_it_counts_intervals_and_not_sigmas() -> None:
    numbers = [["ratio", 1.3, 0.1, 1.5, 1.1, 1.6], ["thickness", 2.0, 0.1, 2.3, 1.8, 2.2]]
    result = {"effect": "skin", "family": "layers", "numbers": numbers}
    assert [n.held for n in numbers_of(result)] == [True, False]
    lines = table([result, result])
    assert lines[0] == "2 experiments"
    assert lines[1].startswith("layers") and "(2 of 4, 95 %: 7-93)" in lines[1]


def test_a_case_without_a_fit_is_listed_and_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Three of six that raised left "3 experiments", of which every interval held."""
    names, again = [c.name for c in cases("proof", 6)], {"effect": "skin", "family": "layers", "made": 1.0}
    fitted = again | {"seconds": 1.0, "numbers": [["ratio", 1.3, 0.1, 1.25, 1.1, 1.6]]}

    def made_and_fitted(case: coverage.Case, out: Path, keep: bool) -> dict:
        if case.name in names[::2]:
            raise ValueError("no start of it can be solved")
        return fitted

    monkeypatch.setattr(coverage, "_made_and_fitted", made_and_fitted)
    command = ["run", "--limit", "6", "--out", str(tmp_path)]
    for said in (command, ["table", *command[1:]], ["again", *command[1:]]):
        assert coverage.main(said) == 0
        text = capsys.readouterr().out
        assert "3 experiments; 3 of 6 could not be made or fitted" in text and "(3 of 3," in text
        assert text.count("without a fit: ") == 3 and "ValueError: no start of it can be solved" in text
    monkeypatch.setattr(coverage, "_made_and_fitted", lambda *given: fitted)
    assert coverage.main(command) == 0 and "6 experiments\n" in capsys.readouterr().out
