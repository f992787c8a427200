"""Closing the loop: from a residual to the effect that the model lacks, fitted and added, with the error before and
after.

`diagnose` is the whole method on one screen; `investigate` is the same without any files, on any `ForwardModel`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from livedeform.closed_loop.assessment.baselines import (
    Baselines,
    by_bic,
    by_signature,
    not_falsified,
    process_discrepancy,
    process_inputs,
)
from livedeform.closed_loop.assessment.called_for import Called
from livedeform.closed_loop.assessment.deciding import Deciding
from livedeform.closed_loop.assessment.detectable import ALL, Visible, in_all, needs_all, visible
from livedeform.closed_loop.assessment.discrepancy import (
    Discrepancy,
    describe,
    discrepancy,
    share_of_size,
    smooth_basis,
)
from livedeform.closed_loop.assessment.drift import HeldDrift, drift_of
from livedeform.closed_loop.assessment.earning import Earned, Earning, Predicted, taken_elsewhere
from livedeform.closed_loop.assessment.held_out import (
    HeldOutErrors,
    errors_of,
    improvement_interval,
    noise_floor,
)
from livedeform.closed_loop.assessment.next_experiment import NextExperiment, Proposal, once_more
from livedeform.closed_loop.assessment.ranking import Ranked, Ranking
from livedeform.closed_loop.assessment.verdict import Conclusion, Findings, Left, explained_share, judge, rivals_of
from livedeform.closed_loop.borne_out import HeldOutRuns, borne_out, doubted
from livedeform.closed_loop.diagnosis import (
    Diagnosis,
    Stated,
    aside_notes,
    chi2_notes,
    cut_off_doubts,
    declared_doubts,
    elements_notes,
    fit_notes,
    floor_notes,
    force_doubts,
    held_out_notes,
    left_doubts,
    lost_doubts,
    lost_with_effects,
    noise_notes,
    noise_reasons,
    odd_marker_doubts,
    one_press_reasons,
    registration_reasons,
    replays,
    slow_noise_reasons,
    steady_notes,
    unsolved_notes,
    untouched_doubts,
)
from livedeform.closed_loop.evidence.enough import check_contact, check_enough
from livedeform.closed_loop.evidence.observation import move_by_themselves
from livedeform.closed_loop.forward import Column, ForwardModel, Run, stack
from livedeform.closed_loop.inference.fitted_model import FittedModel
from livedeform.closed_loop.inference.forward_selection import (
    ForwardSelection,
    Selection,
    entries_of,
)
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.inference.problem import blocks_of, motion_of
from livedeform.closed_loop.inputs import Inputs, read_inputs
from livedeform.closed_loop.progress import Tell, TimeBudget, silent
from livedeform.closed_loop.settings import Settings, VerdictSettings


def diagnose(
    experiment: Path,
    fit: Sequence[Path],
    test: Sequence[Path],
    out: Path,
    *,
    candidates: Sequence[str] | None = None,
    max_effects: int | None = None,
    seed: int = 0,
    processes: int = 2,
    progress: Tell = silent,
    settings: Settings | None = None,
    budget: float | None = None,
) -> Diagnosis:
    """Read the recordings, name the missing effect, and write ``diagnosis.json``, ``experiment.fitted.yaml``, the
    ``settings.json`` that decided and, where two candidates cannot be told apart or one press alone speaks for one,
    ``proposal`` (a bag of poses that would decide) into the folder ``out``. ``budget``: seconds after which nothing
    more is begun (`TimeBudget`)."""
    from livedeform.closed_loop.write import write_diagnosis

    start, time_left = time.perf_counter(), TimeBudget(budget)
    inputs = read_inputs(
        experiment, fit, test, candidates=candidates, processes=processes, tell=progress, settings=settings
    )
    assert inputs.forward is not None  # read_inputs makes one
    with inputs.forward as forward:
        result = investigate(forward, inputs, max_effects=max_effects, seed=seed, tell=progress, budget=time_left)
    result = replace(result, seconds=time.perf_counter() - start)
    write_diagnosis(result, inputs, out)
    return result


def investigate(
    forward: ForwardModel,
    inputs: Inputs,
    *,
    max_effects: int | None = None,
    seed: int = 0,
    tell: Tell = silent,
    budget: TimeBudget | None = None,
) -> Diagnosis:
    """Diagnose: the method, a comment for each of its steps."""
    budget = budget or TimeBudget()
    check_enough(inputs.fitted, inputs.held_out)
    # 1. candidates are screened, fitted through the model, and added one after another while they earn themselves
    selection = ForwardSelection.of(
        inputs.settings,
        forward,
        inputs.fitted,
        inputs.candidates,
        inputs.uncertain,
        refined_mesh=inputs.refined_mesh,
        max_effects=most_effects(inputs) if max_effects is None else max_effects,
        seed=seed,
        tell=tell,
        budget=budget,
    )
    found = selection.find()
    check_touched(inputs, found)
    # 2. what was held out is predicted with the declared and with the fitted model
    tell("predicting what was held out", None)
    ranking = Ranking(inputs.settings, found, inputs.registered)
    tested = HeldOutRuns.of(forward, inputs, selection, found, ranking.columns)
    # 3. each added effect has to be more than nothing, and to earn itself there, or goes out again
    found, tested, outs = borne_out(inputs, selection, found, tested, ranking.columns)
    # 4. what could have been seen, what either model leaves, the verdict and its sentence
    seen = could_be_seen(inputs, selection, found)
    assessed = assess(inputs, found, tested, ranking.columns, seen, seed, budget.notes, outs)
    verdict = assessed.conclusion.verdict
    # 5. which candidates the data cannot tell apart, and the experiment that would
    ranked = ranking(inputs.held_out, tested.before, tested.after)
    proposal = next_experiment(forward, selection, inputs, found, ranked, verdict)
    # 6. what simpler methods make of the same recordings
    given = tested if verdict == "effect" else tested.without_effects(inputs)
    others = baselines(inputs, found, given, ranked)
    result = _diagnosis(inputs, assessed, given, ranked, proposal, others, seed)
    # 7. where the recordings cannot tell, which ones could
    if verdict == "undecided" and seen.hidden and budget.allows("looking for what would decide"):
        tell("looking for what would decide", None)
        deciding = Deciding(inputs.settings, forward, inputs.reach, found, seen.hidden, seen.matters)
        result = replace(result, text=f"{result.text} {deciding.advice()}")
    return replace(result, doubts=(*result.doubts, *budget.notes))


def most_effects(inputs: Inputs) -> int:
    """Return how many effects are added if nobody says so."""
    settings = inputs.settings.selection
    return settings.most_let_go if move_by_themselves(inputs.fitted) else settings.most


def check_touched(inputs: Inputs, found: Selection) -> None:
    """Refuse recordings in which the probe touches nothing, by the model's motion."""
    if found.first is not None:
        motion = motion_of(found.first.run.points, inputs.fitted)
        check_contact(inputs.fitted, motion, inputs.settings)


@dataclass(frozen=True)
class Assessed:
    """The effects ``found`` and the models ``tested``, with the verdict: the ``findings`` that the ``conclusion`` is
    made of, what the given model has ``left`` of what was held out, how much of the effects that ``called`` for, and
    what could have been ``seen``."""

    found: Selection
    tested: HeldOutRuns
    left: Discrepancy
    called: Called
    seen: Visible
    findings: Findings
    conclusion: Conclusion


def assess(
    inputs: Inputs,
    found: Selection,
    tested: HeldOutRuns,
    declared_columns: Sequence[Column],
    seen: Visible,
    seed: int,
    unfinished: Sequence[str] = (),
    outs: Sequence[Earned] = (),
) -> Assessed:
    """Judge what was found by what both models leave of what was held out; the declared one's runs have
    ``declared_columns``. ``unfinished``: why not everything was tried; ``outs``: what has not earned itself there."""
    declared, rule = Predicted(FittedModel(inputs.uncertain), tested.before, declared_columns), tested.rule(inputs)
    (before, of_before), (after, of_after) = (left_over(inputs, rule, p, seed=seed) for p in (declared, tested.given))
    over = taken_elsewhere(found, rule.over(tested.given), inputs.settings.verdict)
    taken = of_before.chi2 - of_after.chi2
    swings = tested.model.rings or move_by_themselves(inputs.held_out)
    rough_before, rough = (swings and left.chi2 > inputs.settings.verdict.usual_chi2[1] for left in (before, after))
    missed, gain = still_there(inputs, tested, after, of_after, rough=rough)
    explained = explained_share(before.gain, gain, taken + sum(e.taken for e in over.values()))
    errors = [errors_of(inputs.held_out, r, registered=inputs.registered) for r in (tested.before, tested.after)]
    findings = Findings(
        names=tuple(tested.model.names),
        gained=tested.model.gained,
        declared=Left(before.p_value, before.excess, before.chi2, rough_before),
        left=Left(after.p_value, after.excess, after.chi2, rough),
        floor=noise_floor(*errors),
        taken=taken,
        explained=explained if found.added else float("nan"),
        hidden=hiding(inputs, found, seen, errors[1]),
        slow=slow_noise_reasons(before, inputs.held_out),
        of_size=share_of_size((before, after), errors, [e.moved for e in over.values()], swings=rough_before),
        unfinished=tuple(unfinished),
        missed=missed.sentence(seen.matters) if missed is not None else "",
        unconfirmed=doubted(inputs, found, tested.model, outs),
        over=tuple(over),
    )
    conclusion = judge(findings, inputs.settings.verdict)
    left = after if conclusion.verdict == "effect" else before
    return Assessed(found, tested, left, rule.amount(of_before, of_after), seen, findings, conclusion)


def still_there(
    inputs: Inputs, tested: HeldOutRuns, after: Discrepancy, problem: Problem, *, rough: bool
) -> tuple[HeldDrift | None, float]:
    """Find the drift that the fitted model misses (None: none), and what there would be to gain for a black box that
    could follow it, and what swings if that is left (``rough``)."""
    gain = max(after.gain, problem.chi2 - problem.rows.n) if rough else after.gain
    drift = drift_of(inputs.held_out, tested.after) if tested.model.added else None
    if drift is None or not drift.is_missed(inputs.settings):
        return None, gain
    return drift, max(gain, drift.missed - drift.n)


def hiding(inputs: Inputs, found: Selection, seen: Visible, after: HeldOutErrors) -> tuple[str, ...]:
    """Say why effects that matter could not have been seen, or not be told from one odd press, a reason each."""
    noise, odd = noise_reasons((*inputs.fitted, *inputs.held_out)), one_press_reasons(found.steps)
    return (*odd, *seen.reasons(inputs.settings.verdict), *noise, *registration_reasons(after, inputs))


def could_be_seen(inputs: Inputs, method: ForwardSelection, found: Selection) -> Visible:
    """Find what could have been seen of each candidate: where nothing was added, in all recordings."""
    threshold = np.inf if inputs.experiment is None else inputs.experiment.thresholds.error
    seen = visible(found, threshold, inputs.settings)
    if found.added or not needs_all(seen, inputs.fitted, inputs.held_out):
        return seen
    return in_all(seen, method, inputs.held_out, inputs.settings) if method.budget.allows(ALL) else seen


# --- parts
# -----------------------------------------------------------------------------------------------------------------


def left_over(inputs: Inputs, rule: Earning, predicted: Predicted, *, seed: int) -> tuple[Discrepancy, Problem]:
    """Find what is left of what was held out as a model has ``predicted`` it, with the fit's own uncertainty allowed
    for."""
    run, observations, settings = stack(predicted.runs), inputs.held_out, inputs.settings
    problem = rule.problem(predicted)
    motion = motion_of(run.points, observations)
    seconds, rates = (np.concatenate([getattr(o, name) for o in observations]) for name in ("seconds", "rates"))
    blocks = blocks_of(observations)
    basis = smooth_basis(problem.rows, inputs.places, motion, rates, blocks, seconds, settings.discrepancy)
    k, m = motion.shape
    return discrepancy(problem, basis, (k, m), settings, seed=seed + 1), problem


def next_experiment(
    forward: ForwardModel,
    method: ForwardSelection,
    inputs: Inputs,
    found: Selection,
    ranked: Sequence[Ranked],
    verdict: str,
) -> Proposal | None:
    """Propose the experiment that would tell the first effect that is given and has rivals from them, or what one press
    alone speaks for from chance."""
    if verdict != "effect":
        return once_more(found)
    if not method.budget.allows("proposing the next experiment"):
        return None
    method.tell("proposing the next experiment", None)
    rivals = rivals_of(found.model.names, {r.name: r.indistinguishable_from for r in ranked})
    return NextExperiment(inputs.settings, forward, inputs.reach).propose(found, rivals)


def baselines(inputs: Inputs, found: Selection, given: HeldOutRuns, ranked: Sequence[Ranked]) -> Baselines | None:
    """Diagnose the same recordings by simpler methods; None where nothing was tried."""
    if found.first is None:
        return None
    settings, places, held_out = inputs.settings.baselines, inputs.places, inputs.held_out
    problem, dictionary = found.first.problem, found.first.dictionary
    entries = entries_of(list(inputs.candidates.values()))
    signature, cosine = by_signature(problem, dictionary, entries, settings)
    points = found.first.run.points
    known = process_inputs(points, places)
    left = (np.concatenate([o.points for o in inputs.fitted]) - points).reshape(-1, 3)
    runs = []
    for run in given.before:
        more = process_discrepancy(known, left, process_inputs(np.nan_to_num(run.points), places), settings)
        runs.append(replace(run, points=run.points + more.reshape(run.points.shape)))

    def rmse(runs: Sequence[Run]) -> float:
        return errors_of(held_out, runs, registered=inputs.registered).metrics().rmse

    return Baselines(
        by_bic=by_bic(problem, dictionary, entries),
        by_signature=signature,
        not_falsified=not_falsified(problem, dictionary, entries),
        cosine=cosine,
        modulus_rmse=next((r.test_rmse for r in ranked if r.name == "stiffness"), float("nan")),
        process_rmse=rmse(runs),
        finer_before=rmse(inputs.uncertain.correction.corrected(held_out, given.before)),
        finer_after=rmse(given.model.uncertain.correction.corrected(held_out, given.after)),
    )


def _diagnosis(
    inputs: Inputs,
    assessed: Assessed,
    given: HeldOutRuns,
    ranked: tuple[Ranked, ...],
    proposal: Proposal | None,
    others: Baselines | None,
    seed: int,
) -> Diagnosis:
    """Put together what is written and reported; effects that are not the cause are not ``given``."""
    tried, left, conclusion = assessed.tested.model, assessed.left, assessed.conclusion
    before, after = (errors_of(inputs.held_out, r, registered=inputs.registered) for r in (given.before, given.after))
    stated = Stated.of(given.model, assessed.found.problem, inputs)
    where = describe(left, inputs.held_out, inputs.places, inputs.settings.discrepancy) if conclusion.loud else ""
    return Diagnosis(
        verdict=conclusion.verdict,
        effects=stated.effects,
        added=tried.added,
        ranking=ranked,
        errors_before=before,
        errors_after=after,
        improvement=improvement_interval(before, after),
        explained=conclusion.explained,
        discrepancy=left,
        text=" ".join(filter(None, [conclusion.sentence, where, stated.in_place])),
        selection=replace(assessed.found, model=tried),
        held_out=inputs.held_out,
        proposal=proposal,
        baselines=others,
        detectable=assessed.seen.found,
        matters=assessed.seen.matters,
        notes=(*_notes(inputs, assessed, others, before, after), *stated.notes),
        doubts=(
            *_doubts_of_data(inputs, before, after),
            *declared_doubts(conclusion, inputs),
            *stated.doubts,
            *_doubts(assessed, given, inputs.settings.verdict),
        ),
        replays=replays(inputs, inputs.held_out, stated.effects) if conclusion.verdict == "effect" else (),
    )


def _notes(
    inputs: Inputs, assessed: Assessed, others: Baselines | None, before: HeldOutErrors, after: HeldOutErrors
) -> tuple[str, ...]:
    """Gather what a reader should know of the numbers."""
    settings = inputs.settings.verdict
    return (
        *inputs.notes,
        *elements_notes(inputs, others, after.metrics().rmse),
        *held_out_notes(assessed.tested.model, assessed.findings.taken, assessed.called),
        *noise_notes((*inputs.fitted, *inputs.held_out), settings),
        *floor_notes(before, after, settings),
        *steady_notes(after, inputs.uncertain.errors.place_sigma, settings),
        *chi2_notes(assessed.left.chi2, settings),
    )


def _doubts_of_data(inputs: Inputs, before: HeldOutErrors, after: HeldOutErrors) -> tuple[str, ...]:
    """Gather what is in doubt of the recordings and of what the experiment says of its markers."""
    odd = odd_marker_doubts(after, inputs, noise_floor(before, after))
    return (*inputs.doubts, *untouched_doubts(inputs), *odd)


def _doubts(assessed: Assessed, given: HeldOutRuns, settings: VerdictSettings) -> tuple[str, ...]:
    """Gather why the diagnosis might not hold."""
    first = assessed.found.first
    return (
        *unsolved_notes("fitted", [] if first is None else [first.run]),
        *lost_with_effects(assessed.found),
        *unsolved_notes("held-out", given.after),
        *aside_notes(None if first is None else first.run),
        *fit_notes(assessed.tested.model.joint, assessed.found.problem, settings),
        *cut_off_doubts(assessed.found),
        *lost_doubts(assessed.found, assessed.tested.model),
        *left_doubts(assessed.conclusion, assessed.left, settings),
        *force_doubts(assessed.left, settings),
    )
