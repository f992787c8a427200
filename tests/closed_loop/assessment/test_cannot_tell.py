"""Where recordings cannot tell, that is the answer: which sizes could have been seen, and what would decide."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import toy
from toy_loop import toy_inputs

from livedeform.closed_loop.assessment.detectable import Detectable, Power, needs_all, size_that_matters, visible
from livedeform.closed_loop.assessment.verdict import Findings, Left, judge
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.evidence.enough import check_contact, check_enough
from livedeform.closed_loop.evidence.observation import Observation, observe
from livedeform.closed_loop.evidence.recordings import split
from livedeform.closed_loop.evidence.track import Track
from livedeform.closed_loop.forward import Column, Run, dictionary_columns
from livedeform.closed_loop.inference.fitted_model import FittedModel
from livedeform.closed_loop.inference.forward_selection import entries_of
from livedeform.closed_loop.inference.problem import ProblemFactory
from livedeform.closed_loop.inference.screening import Screening, noise_draws
from livedeform.closed_loop.loop import investigate
from livedeform.closed_loop.write import as_json
from livedeform.common.errors import RecordingError
from livedeform.common.types import EffectValues

PLACES = toy.markers()
NAMES = ["stiffness", "viscoelasticity", "probe_offset", "gravity_tilt"]
LOWER, UPPER = np.array([-0.05, -0.05, 0.0]), np.array([0.05, 0.05, 0.05])


def diagnosed(sigma: float) -> Diagnosis:
    """A body without any undeclared effect, measured with this noise."""
    fit, test = (toy.record([], seed=s, name=n, n=24, sigma=sigma) for s, n in ((3, "fit"), (4, "test")))
    inputs = toy_inputs(fit, test, NAMES)
    return investigate(toy.ToyModel(toy.ToyBody(PLACES)), inputs)


def test_noise_that_hides_effects_leaves_it_undecided():
    result = diagnosed(2e-3)
    assert result.verdict == "undecided" and not result.effects
    assert "cannot tell" in result.text and "What would decide" in result.text
    assert any(d.is_hidden(result.matters) for d in result.detectable.values())
    said = json.loads(json.dumps(as_json(result)))
    assert said["verdict"] == "undecided"
    assert said["error_before"]["n"] == said["error_after"]["n"]
    assert said["coverage"]["frames_compared"] == said["coverage"]["frames_measured"] == 24
    assert said["coverage"]["presses"] >= 2


def in_both(seed: int, ratio: float) -> Diagnosis:
    """A body whose modulus is that times as large, with a noise that hides from one recording what two show."""
    truth = [] if ratio == 1.0 else [toy.effect("stiffness", ratio=ratio)]
    fit, test = (toy.record(truth, seed=s, name=n, n=24, sigma=6e-4) for s, n in ((seed, "fit"), (seed + 1, "test")))
    return investigate(toy.ToyModel(toy.ToyBody(PLACES)), toy_inputs(fit, test, NAMES))


@pytest.mark.parametrize("seed", [5, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (9, 15))])
def test_where_nothing_was_added_all_recordings_show_what_those_that_were_fitted_hide(seed):
    result = in_both(seed, 1.0)
    hidden = visible(result.selection, np.inf, toy.SETTINGS).hidden
    assert hidden and result.verdict == "none"
    for name in hidden:  # what is said to be seen is by all of them
        assert result.detectable[name].moves < result.matters


@pytest.mark.parametrize("seed", [17, pytest.param(18, marks=pytest.mark.slow)])
def test_what_all_recordings_speak_for_and_those_that_were_fitted_do_not_is_told(seed):
    """It would move the markers by a size that matters: `none` would be wrong, and there is nothing to hold out."""
    result = in_both(seed, 1.4)
    assert result.verdict == "undecided" and not result.effects
    assert "all recordings together speak for stiffness, those that were fitted do not" in result.text


def test_nothing_is_looked_at_again_where_it_would_not_do():
    result = diagnosed(2e-3)
    seen = visible(result.selection, np.inf, toy.SETTINGS)
    assert seen.hidden and not needs_all(seen, result.selection.observations, result.held_out)
    assert needs_all(seen, result.selection.observations, 200 * result.held_out)


class Lost(toy.ToyModel):
    """A model that finds no equilibrium late in a motion that was only planned."""

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        runs = super().run(effects, observations, columns)
        for o, run in zip(observations, runs, strict=True):
            if np.isfinite(o.patience):
                run.points[6:] = np.nan
        return runs


def test_only_motions_that_were_predicted_to_their_end_are_spoken_of():
    fit, test = (toy.record([], seed=s, name=n, n=24, sigma=4e-3) for s, n in ((3, "fit"), (4, "test")))
    inputs, body = toy_inputs(fit, test, NAMES), toy.ToyBody(PLACES)
    still = replace(inputs, reach=replace(inputs.reach, top=None))
    assert "What would decide: another motion of the probe" in investigate(toy.ToyModel(body), inputs).text
    for text in (investigate(Lost(body), inputs).text, investigate(toy.ToyModel(body), still).text):
        assert "Neither 16 repeats nor elements 0.25 times as large would do." in text


def test_good_recordings_decide_and_say_how_small():
    result = diagnosed(1e-4)
    assert result.verdict == "none"
    sizes = {c["name"]: c["detectable"] for c in as_json(result)["candidates"]}
    assert set(sizes) == set(NAMES)
    assert sizes["stiffness"] < 0.15 and sizes["viscoelasticity"] < 0.06 and sizes["probe_offset"] < 8e-4
    assert all(not d.is_hidden(result.matters) for d in result.detectable.values())
    assert result.floor <= min(result.before.rmse, result.after.rmse)
    noise = result.noise
    assert [n.name for n in noise] == ["fit", "test"] and [n.held_out for n in noise] == [False, True]
    assert all(n.interval[0] <= n.value <= n.interval[1] and n.source == "unshared motion" for n in noise)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("name", "draws"),
    [("stiffness", 40), ("viscoelasticity", 200)],
)
def test_the_detectable_size_is_seen_in_95_of_100(name, draws):
    """Measured over 40 draws: 0.95 to 1.00 of five effects, with a family of 16."""
    o, model = toy.record([], seed=0, n=24), toy.ToyModel(toy.ToyBody(PLACES))
    candidates = list(toy.candidates(PLACES, NAMES).values())
    columns = dictionary_columns(candidates)
    problems = ProblemFactory([o], toy.SETTINGS.allowance)
    problem, J = problems.at(FittedModel(toy.uncertain(PLACES)), model.run([], [o], columns)[0], columns)
    found = Power(toy.SETTINGS)(problem, J, candidates)[name]
    candidate = next(c for c in candidates if c.name == name)
    entries = [e for e in entries_of(candidates) if e.name == name]
    method = Screening(replace(toy.SETTINGS.screening, draws=100))

    def seen(size: float) -> float:
        c = candidate.coordinates[candidate.amplitudes[0]]
        z = abs(c.z(c.neutral + size))
        # the shape that the size is of is the one that shows most
        gains = [np.linalg.norm(problem.marginal(J[:, e.columns[0]])) for e in entries]
        effect = z * J[:, entries[int(np.argmax(gains))].columns[0]]
        noise = noise_draws(problem, np.random.default_rng(7), draws)
        hits = 0
        for e in noise.T:
            s = method(replace(problem, residual=e + effect), J, entries_of(candidates))
            hits += s.family_p <= toy.SETTINGS.selection.alpha and s.scores[0].score <= -16.0
        return hits / draws

    assert seen(found.size) >= 0.9
    assert seen(0.5 * found.size) < 0.7


def test_a_detectable_size_below_the_kick_is_by_the_power_that_the_card_says() -> None:
    """Along the secant, a strip of a thousandth of the base seemed to be seen."""
    o, model = toy.record([], seed=0, n=24), toy.ToyModel(toy.ToyBody(PLACES))
    debonding = toy.candidates(PLACES, ["base_debonding"])["base_debonding"]
    columns = dictionary_columns([debonding])
    problem, _ = ProblemFactory([o], toy.SETTINGS.allowance).at(
        FittedModel(toy.uncertain(PLACES)), model.run([], [o], ())[0], ()
    )
    J = 1e-2 * np.random.default_rng(0).normal(size=(len(problem.residual), len(columns)))
    fraction = debonding.info.parameters[-1]
    straight = replace(debonding, info=replace(debonding.info, parameters=(replace(fraction, grows=1.0),)))
    bent = replace(debonding, info=replace(debonding.info, parameters=(fraction,)))
    (along,), (by_power,) = (Power(toy.SETTINGS)(problem, J, [c]).values() for c in (straight, bent))
    kick = float(debonding.kick[1])
    assert 0.0 < along.size < kick and by_power.moves == along.moves
    assert by_power.size == pytest.approx(kick * (along.size / kick) ** (2.0 / 3.0))


def test_a_candidate_is_judged_by_its_own_columns() -> None:
    """The others count only in how many are looked for."""
    o, model = toy.record([], seed=0, n=24), toy.ToyModel(toy.ToyBody(PLACES))
    candidates = list(toy.candidates(PLACES, NAMES).values())
    columns = dictionary_columns(candidates)
    problems = ProblemFactory([o], toy.SETTINGS.allowance)
    problem, J = problems.at(FittedModel(toy.uncertain(PLACES)), model.run([], [o], columns)[0], columns)
    every, some = Power(toy.SETTINGS)(problem, J, candidates), candidates[1::2]
    mine = J[:, [c.candidate in some for c in columns]]
    for name, d in Power(toy.SETTINGS)(problem, mine, some, len(candidates)).items():
        assert (d.parameter, d.size, d.moves) == pytest.approx(
            (every[name].parameter, every[name].size, every[name].moves)
        )


def test_what_is_hidden():
    seen = Detectable("a", "x", 0.1, moves=1e-5, most=1e-3)
    assert not seen.is_hidden(1e-4) and seen.is_hidden(5e-6)
    assert not replace(seen, moves=1e-4, most=1e-4).is_hidden(2e-4)  # it can never move that much
    motion = np.full((4, 5), 2e-3)
    assert size_that_matters(motion, np.inf, 1e-5, 0.1) == pytest.approx(2e-4)
    assert size_that_matters(motion, 1e-4, 1e-5, 0.1) == 1e-4
    assert size_that_matters(0.0 * motion, 5e-3, 1e-5, 0.1) == 5e-3


def test_only_what_would_be_none_becomes_undecided():
    nothing, something = Left(0.5, 0.0, 1.0), Left(1e-9, 1e-3, 1.0)
    quiet = Findings((), 0.0, nothing, nothing, 1e-4, 0.0, float("nan"), ("noise hides them",))
    rule = toy.SETTINGS.verdict
    said = judge(quiet, rule)
    assert said.verdict == "undecided" and "noise hides them" in said.sentence
    assert judge(replace(quiet, hidden=()), rule).verdict == "none"
    assert judge(replace(quiet, declared=something, left=something), rule).verdict == "unexplained"
    assert judge(replace(quiet, names=("skin",), taken=90.0, explained=0.9), rule).verdict == "effect"


def part(o: Observation, markers: int) -> Observation:
    """The observation with all but the first markers unseen."""
    points = o.points.copy()
    points[:, markers:] = np.nan
    return replace(o, points=points)


@pytest.mark.parametrize(("markers", "said"), [(0, "no marker is ever seen"), (3, "only 3 of the")])
def test_too_few_markers(markers, said):
    o = toy.record([], seed=0, n=12)
    with pytest.raises(RecordingError, match=said):
        check_enough([o], [part(o, markers)])
    check_enough([o], [part(o, 4)])


def test_too_few_moments_and_no_contact():
    o = toy.record([], seed=0, n=12)
    one = o.take(np.arange(12) < 1)
    with pytest.raises(RecordingError, match="no moment is left"):
        check_enough([one], [split(one)[1]])
    with pytest.raises(RecordingError, match="only 1 moment"):
        check_enough([one], [o])
    with pytest.raises(RecordingError, match="nothing is held out"):
        check_enough([o], [])
    away = replace(o, points=np.repeat(o.points[:1], o.n_moments, axis=0))
    nothing, something = np.zeros((12, 40)), np.full((12, 40), 1e-3)
    with pytest.raises(RecordingError, match="no contact"):
        check_contact([away], nothing, toy.SETTINGS)
    check_contact([away], something, toy.SETTINGS)
    check_contact([o], nothing, toy.SETTINGS)
    check_contact([replace(away, path=())], nothing, toy.SETTINGS)  # a body under its own weight


def test_markers_that_are_never_seen_are_observed_and_then_refused():
    nothing = np.full((50, 9, 3, 3), np.nan)
    data = Track((np.arange(50) * 4e7).astype(np.int64), np.arange(9), nothing[..., 0], nothing)
    o = observe("empty", data, settings=toy.SETTINGS, n_moments=10)
    with pytest.raises(RecordingError, match="no marker is ever seen"):
        check_enough([o], [o])
