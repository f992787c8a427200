"""An experiment that has effects already, as every fitted one has: what differs from them is found as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy
from toy_loop import PLACES, toy_inputs

from livedeform.closed_loop.candidates import catalogue, that_may_differ
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.linearised import write_linearised
from livedeform.closed_loop.loop import investigate
from livedeform.closed_loop.write import as_json
from livedeform.common.effect import EFFECT_PARAMETERS
from livedeform.common.published_effects import with_others
from livedeform.common.types import EffectValues
from livedeform.report.diagnosis.page import diagnosis_verdict

AROUND = replace(toy.surroundings(PLACES), internal=True, has_cameras=True, has_release=True, has_loads=True)
BODY = toy.ToyBody(PLACES)
NAMES = tuple(name for name in toy.NAMES if name != "density")  # which no displacement tells from the stiffness
# what is declared, and what there is
OTHERWISE = [
    (toy.effect("stiffness", ratio=1.4), toy.effect("stiffness", ratio=1.0)),
    (toy.effect("stiffness", ratio=0.8), toy.effect("stiffness", ratio=1.1)),
    (toy.effect("base_slip", stiffness=2e4), toy.effect("base_slip", stiffness=8e3)),
    (toy.effect("probe_offset", translation=[0.004, 0.0, 0.001]), toy.effect("probe_offset", translation=[0.0] * 3)),
    (toy.effect("viscoelasticity", g=[0.15], tau=[2.0]), toy.effect("viscoelasticity", g=[0.45], tau=[2.0])),
    (toy.effect("viscoelasticity", g=[0.4], tau=[5.0]), toy.effect("viscoelasticity", g=[0.4], tau=[2.0])),
    (
        toy.effect("viscoelasticity", g=[0.4, 0.2], tau=[2.0, 10.0]),
        toy.effect("viscoelasticity", g=[0.1, 0.2], tau=[2.0, 10.0]),
    ),
    (toy.effect("plastic_set", fraction=0.5, threshold=0.05), toy.effect("plastic_set", fraction=0.1, threshold=0.05)),
    (toy.effect("time_offset", seconds=0.3), toy.effect("time_offset", seconds=0.2)),
]


def but_slow(cases: Sequence[tuple[object, ...]], quick: set[int]) -> list[Any]:
    """Mark all cases as slow ones but those of these numbers."""
    return [pytest.param(*case, marks=() if i in quick else pytest.mark.slow) for i, case in enumerate(cases)]


def found_in(declared: list[EffectValues], there: list[EffectValues], seed: int = 1, sigma: float = 1e-4) -> Diagnosis:
    """Diagnose a toy recording of what is ``there`` with a model that has what is ``declared``."""
    fit, test = (
        toy.record(there, seed=s, body=BODY, n=n, name=name, sigma=sigma)
        for s, n, name in ((seed, 36, "fit"), (seed + 1000, 24, "test"))
    )
    inputs = replace(toy_inputs(fit, test), declared=tuple(declared))
    inputs = replace(inputs, candidates=toy.candidates(PLACES, NAMES, declared))
    return investigate(toy.ToyModel(BODY, declared=declared), inputs, seed=seed)


@pytest.mark.parametrize(("declared", "there"), but_slow(OTHERWISE, {0, 2, 5, 7}))
def test_another_value_than_declared_is_found(declared: EffectValues, there: EffectValues) -> None:
    """It was no candidate: of half a relaxation that was declared the other half was traced to other effects."""
    found = found_in([declared], [there])
    assert [e.name for e in found.effects] == [there.name] and found.verdict == "effect"
    for name, true in there.values.items():
        sigma = np.atleast_1d(found.effects[0].sigmas[name])
        value = np.atleast_1d(found.effects[0].values[name])
        assert np.all(np.abs(value - true) < 3.0 * sigma)
    assert not found.doubts and f"{there.name} takes the place of the declared one" in found.text


@pytest.mark.parametrize("there", but_slow([(there,) for _, there in OTHERWISE[1:]], {0, 3, 7}))
def test_what_is_declared_as_it_is_stays(there: EffectValues) -> None:
    found = found_in([there], [there])
    assert not found.effects and found.verdict in ("none", "undecided")


@pytest.mark.parametrize("declared", [OTHERWISE[2][0], OTHERWISE[4][0]])
def test_another_effect_beside_what_is_declared_is_found(declared: EffectValues) -> None:
    late = toy.effect("time_offset", seconds=0.06)
    found = found_in([declared], [declared, late])
    assert [e.name for e in found.effects] == ["time_offset"] and not found.doubts
    assert [e.name for e in with_others([declared], found.effects)] == [declared.name, "time_offset"]


def test_a_fitted_experiment_has_each_effect_once() -> None:
    declared, there = OTHERWISE[1]
    found = found_in([declared], [there])
    (effect,) = with_others([declared], found.effects)
    assert effect.values["ratio"] == found.effects[0].values["ratio"]


@pytest.mark.parametrize("name", sorted(EFFECT_PARAMETERS))
def test_every_number_counts_from_its_declared_value(name: str) -> None:
    """At zero the effect is as it is declared, and every number but an onset can change by itself, to both sides."""
    usual = (catalogue(AROUND, [name]) or catalogue(replace(AROUND, has_cameras=False), [name]))[name]
    declared = usual.values(usual.beginning + 0.3 * usual.array("step"))
    candidate = catalogue(AROUND, [name], [declared])[name]
    (shape,) = candidate.shapes
    for parameter, values in candidate.values(shape).values.items():
        assert values == pytest.approx(declared.values[parameter], rel=1e-9), parameter
    own = [i for i, c in enumerate(candidate.coordinates) if not c.edges]
    assert candidate.amplitudes.tolist() == own and candidate.tangent and not candidate.kick.any()
    assert np.all(candidate.array("lower")[own] <= 0.0) and np.all(candidate.array("upper")[own] >= 0.0)
    assert not candidate.forms and not candidate.info.switched
    moved = shape + 0.2 * candidate.array("step")
    assert candidate.coordinates_of(candidate.values(moved).values) == pytest.approx(moved, rel=1e-9, abs=1e-12)


def test_what_has_no_number_of_its_own_stays_as_it_is_declared() -> None:
    """Several balls, the terms of a power law, and how long a load had hung before it was let go."""
    ball = toy.effect("inclusion", centre=[0.0, 0.0, 0.02], radius=0.01, ratio=4.0)
    terms = toy.effect("viscoelasticity", g=[0.1] * 9, tau=np.geomspace(1e-3, 1e2, 9).tolist())
    held = toy.effect("viscoelasticity", g=[0.2], tau=[1.0], held=100.0)
    assert set(that_may_differ([ball])) == {"inclusion"}
    for declared in ([ball, ball], [terms], [held], [toy.effect("plastic_set", fraction=0.1, threshold=0.0)]):
        assert not that_may_differ(declared)
        assert declared[0].name not in catalogue(AROUND, declared=declared)


def test_what_cannot_be_tried_is_a_doubt() -> None:
    terms = toy.effect("viscoelasticity", g=[0.05] * 4, tau=[0.5, 1.0, 5.0, 10.0])
    found = found_in([terms], [terms, toy.effect("time_offset", seconds=0.06)])
    assert any("values of viscoelasticity, as the experiment declares it, cannot" in doubt for doubt in found.doubts)


def test_intervals_do_not_depend_on_what_is_declared() -> None:
    """Elements err by a share of the whole effect: declared as 9000, a base slip of 8000 had 38 for 320 Pa/m."""
    (_, there), sigmas = OTHERWISE[2], []
    for declared in ([], [toy.effect("base_slip", stiffness=2e4)], [toy.effect("base_slip", stiffness=5e3)]):
        (effect,) = found_in(declared, [there]).effects
        sigmas.append(float(effect.sigmas["stiffness"]))
    assert sigmas == pytest.approx([sigmas[0]] * 3, rel=0.01)


@pytest.mark.parametrize("ratio", [2.0, None])
def test_what_a_poor_tracker_hides_of_a_declared_skin_is_said(ratio: float | None) -> None:
    """It was judged by its thickness alone, and `none` where its ratio was wrong by more than matters."""
    declared = [] if ratio is None else [toy.effect("skin", thickness=0.003, ratio=ratio)]
    found = found_in(declared, [toy.effect("skin", thickness=0.003, ratio=3.5)] if declared else [], sigma=1e-3)
    assert found.verdict == "undecided" and found.detectable["skin"].parameter == "ratio"


def test_what_differs_from_a_declared_effect_is_told_as_that() -> None:
    """Declared, and not there: it is traced to another one than declared, which may be nothing."""
    row = pytest.importorskip("livedeform.campaign.row")  # needs pyarrow
    found = found_in([toy.effect("softening", rate=0.01)], [])
    assert found.headline == "Traced to another softening than declared"
    assert found.text.endswith("softening takes the place of the declared one (rate 0.01 1/s), and may be nothing.")
    document = as_json(found)
    assert document["effects"][0]["parameters"]["rate"]["declared"] == 0.01
    assert [c["name"] for c in document["candidates"] if c["declared"]] == ["softening"]
    assert diagnosis_verdict(document).said == found.headline
    assert "(declared 0.01)" in row.effect_words(document["effects"][0])


def test_the_last_value_that_is_possible_is_no_doubt() -> None:
    """A friction of 0.5 that is not there came out as 0, beyond which the true value was said to lie."""
    found = found_in([toy.effect("probe_friction", mu=0.5)], [])
    assert [e.name for e in found.effects] == ["probe_friction"] and found.effects[0].values["mu"] < 0.03
    assert not any("end of what is tried" in doubt for doubt in found.doubts)


@pytest.mark.parametrize("place", [0, pytest.param(3, marks=pytest.mark.slow)])
def test_a_campaign_pools_takes_that_declare_an_effect_with_others(place: int, tmp_path: Path) -> None:
    """One whose experiment declares a relaxation took it from all others, if it was the first of them."""
    pytest.importorskip("pyarrow")
    from livedeform.campaign.evidence import in_common_units, read_evidence
    from livedeform.campaign.pooling import scopes_of
    from livedeform.campaign.shared_causes import pool

    relaxes, kept = toy.effect("viscoelasticity", g=[0.4], tau=[2.0]), []
    for number in range(4):
        found = found_in([relaxes] if number == place else [], [relaxes], seed=10 + number)
        write_linearised(found.selection, tmp_path / f"{number}.npz")
        kept.append(read_evidence(tmp_path / f"{number}.npz", f"take{number}", "phantom", "rig"))
    evidence = in_common_units(kept)
    assert all("viscoelasticity" in e.columns for e in evidence)
    (shared,) = pool(evidence, scopes_of(evidence)).named
    assert shared.effect == "viscoelasticity" and len(shared.members) == 4
