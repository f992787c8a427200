"""Closing the loop: from a residual to the effect that the model lacks, fitted and added, with the error before and
after.

`diagnose` is the whole method on one screen; `investigate` is the same without any files, on any `ForwardModel`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from livedeform.closed_loop.diagnosis import (
    Diagnosis,
    Ranked,
    describe_left,
    elements_share,
    fitted_values,
    replays,
    said_of_convergence,
    said_of_held_out,
    said_of_unsolved,
)
from livedeform.closed_loop.evidence.noise import Nuisance, join
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, ForwardModel, Run, dictionary_columns, stack
from livedeform.closed_loop.inference.baselines import (
    Simpler,
    by_bic,
    by_signature,
    process_discrepancy,
    process_inputs,
)
from livedeform.closed_loop.inference.discrepancy import Remainder, remainder, smooth_basis
from livedeform.closed_loop.inference.forward_selection import (
    ALPHA,
    Refined,
    Search,
    Tell,
    columns_of,
    entries_of,
    silent,
)
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.inference.next_experiment import propose
from livedeform.closed_loop.inference.problem import blocks_of, motion_of
from livedeform.closed_loop.inference.screening import Score, indistinguishable, leader
from livedeform.closed_loop.inference.verdict import (
    AGAINST,
    MIN_EXCESS,
    MIN_EXPLAINED,
    MUCH,
    OMNIBUS_P,
    Verdict,
    errors_of,
    explained_share,
    improvement_interval,
    noise_floor,
)
from livedeform.closed_loop.inputs import Inputs, read_inputs

GAINS_NOTHING = 1.0  # twice the log likelihood: noise alone gains as much with every third parameter


def diagnose(
    experiment: Path,
    fit: Sequence[Path],
    test: Sequence[Path],
    out: Path,
    *,
    candidates: Sequence[str] | None = None,
    max_effects: int = 3,
    seed: int = 0,
    processes: int = 2,
    progress: Tell = silent,
) -> Diagnosis:
    """Reads the recordings, names the missing effect, and writes ``diagnosis.json``, ``experiment.fitted.yaml`` and,
    where two candidates cannot be told apart, ``proposal`` (a bag of poses that would) into the folder ``out``."""
    from livedeform.closed_loop.write import write_diagnosis

    start = time.perf_counter()
    inputs = read_inputs(experiment, fit, test, candidates=candidates, processes=processes, tell=progress)
    assert inputs.forward is not None  # read_inputs makes one
    with inputs.forward as forward:
        result = investigate(forward, inputs, max_effects=max_effects, seed=seed, tell=progress)
    result = replace(result, seconds=time.perf_counter() - start)
    write_diagnosis(result, inputs, out)
    return result


def investigate(
    forward: ForwardModel, inputs: Inputs, *, max_effects: int = 3, seed: int = 0, tell: Tell = silent
) -> Diagnosis:
    """The method. See the comments for its steps."""
    # 1. the evidence: recordings at key moments, with noise that was checked on themselves
    fitted, held_out = inputs.fitted, inputs.held_out
    # 2.-4. candidates are screened, fitted through the model, and added one after another while they earn themselves
    search = Search(forward, fitted, inputs.candidates, inputs.uncertain, max_effects=max_effects, seed=seed, tell=tell)
    search.find()
    # 5. what was held out: errors before and after, on the same scale
    tell("predicting what was held out", None)
    declared = Search(forward, fitted, {}, inputs.uncertain)
    tried = columns = best_columns(search, inputs)
    test_before = test_after = forward.run([], held_out, [*tried, *declared.always_columns])
    if search.added:
        columns = columns_of(search.added)
        test_after = forward.run(search.effects, held_out, [*columns, *search.always_columns])
        search.foresee(held_out, test_after)
    before, after = (errors_of(held_out, t, registered=inputs.registered) for t in (test_before, test_after))
    # 6. is the best model good enough, or is something left that nothing here explains?
    left_before, problem_before = left_over(inputs, declared, held_out, test_before, tried, seed=seed)
    left, problem_after = left_over(inputs, search, held_out, test_after, columns, seed=seed)
    taken = problem_before.chi2 - problem_after.chi2
    explained = explained_share(left_before.gain, left.gain, taken) if search.added else float("nan")
    floor = noise_floor(held_out)
    verdict = judge(search, left, explained, floor, taken)
    # 7. which candidates the data cannot tell from the answer, and the experiment that would
    ranking = rank(search, inputs, held_out, test_before, test_after)
    rivals = next(
        (r.indistinguishable_from for r in ranking if search.added and r.name == search.added[0].candidate.name), ()
    )
    proposal = propose(forward, inputs, search, rivals) if verdict == "effect" else None
    if verdict != "effect":
        after, test_after = before, test_before
    fitted_effects = fitted_values(search, inputs.element_size) if verdict == "effect" else []
    text = describe_left(verdict, search, left, explained if taken >= -AGAINST else np.nan, held_out, inputs.places)
    others = simpler(search, inputs, held_out, test_before, test_after, ranking)
    return Diagnosis(
        verdict=verdict,
        effects=tuple(fitted_effects),
        added=tuple(search.added),
        ranking=ranking,
        before=before.metrics(),
        after=after.metrics(),
        floor=floor,
        improvement=improvement_interval(before, after, seed=seed),
        explained=explained,
        remainder=left,
        text=text,
        search=search,
        held_out=tuple(held_out),
        test_before=tuple(test_before),
        test_after=tuple(test_after),
        proposal=proposal,
        simpler=others,
        notes=(
            *inputs.notes,
            *said_of_unsolved("fitted", [] if search.baseline is None else [search.baseline]),
            *said_of_unsolved("held-out", test_after),
            *said_of_convergence(search.joint if verdict == "effect" else None),
            *elements_share(inputs, others, after.metrics().rmse),
            *said_of_held_out(search, taken),
        ),
        replays=replays(inputs, held_out, fitted_effects) if verdict == "effect" else (),
    )


def judge(search: Search, left: Remainder, explained: float, floor: float, taken: float) -> Verdict:
    """None, effect or unexplained: see the constants of `closed_loop.inference.verdict`; ``taken``: chi2 on held-out
    data that the
    effects take away. Where that is contradicted (`AGAINST`), they are no cause, and there was something if they had
    gained much; one that was over before the held-out recording changes nothing there."""
    loud = left.p_value < OMNIBUS_P and left.excess > MIN_EXCESS * floor
    if not search.added:
        return "unexplained" if loud else "none"
    if taken < -AGAINST:
        return "unexplained" if loud or search.gained > MUCH else "none"
    if loud and not explained >= MIN_EXPLAINED:
        return "unexplained"
    return "effect"


# --- parts
# -----------------------------------------------------------------------------------------------------------------


def by_columns(search: Search) -> list[Score]:
    """Candidates that held-out data are predicted for by their columns: not one that was added alone, which is run
    itself, nor those that gain nothing (`GAINS_NOTHING`) and so change nothing."""
    scores = search.steps[0].screening.scores
    return [s for s in scores if s.gain > GAINS_NOTHING and not is_alone(search, s.name)]


def best_columns(search: Search, inputs: Inputs) -> list[Column]:
    """The dictionary's columns of the best shape of each candidate that is predicted `by_columns`."""
    out = []
    for s in by_columns(search):
        candidate = inputs.candidates[s.name]
        out += dictionary_columns([replace(candidate, shapes=candidate.shapes[s.shape : s.shape + 1])])
    return out


def is_alone(search: Search, name: str) -> bool:
    """Whether this candidate, and no other, was added."""
    return [a.candidate.name for a in search.added] == [name]


def left_over(
    inputs: Inputs,
    search: Search,
    observations: Sequence[Observation],
    runs: Sequence[Run],
    columns: Sequence[Column],
    *,
    seed: int,
) -> tuple[Remainder, Problem]:
    """What is left on ``observations`` at the ``runs`` of the best model, with the fit's own uncertainty allowed for.

    The runs have ``columns``, those of the added effects if there are any, and then those of what is always allowed
    for.
    """
    run = stack(runs)
    probe = Search(search.forward, observations, {}, search.uncertain, added=search.added)
    problem, J = probe.problem(run, columns)
    if search.added and search.joint is not None:
        spread = np.linalg.cholesky(search.joint.covariance + 1e-18 * np.eye(len(columns)))
        own = Nuisance(J @ spread, tuple(f"fit[{i}]" for i in range(len(columns))))
        problem = replace(problem, nuisance=join([problem.nuisance, own]))
    motion = motion_of(np.nan_to_num(run.points), observations)
    seconds = np.concatenate([o.seconds for o in observations])
    basis = smooth_basis(problem.rows, inputs.places, motion, blocks_of(observations), seconds)
    return remainder(problem, basis, motion.shape, seed=seed + 1), problem


def rank(
    search: Search, inputs: Inputs, held_out: Sequence[Observation], before: Sequence[Run], after: Sequence[Run]
) -> tuple[Ranked, ...]:
    """All candidates of the first step, best first, with their error on held-out data (by their linearisation, save the
    effect that was added alone)."""
    step = search.steps[0]
    found: dict[str, Score | Refined] = {s.name: s for s in step.screening.scores}
    found.update(step.refined)
    views = {name: one.views for name, one in found.items()}
    gain = max((s.gain for s in step.screening.scores), default=0.0)
    groups = indistinguishable(views, gain)
    best = leader(views) if views else ""
    gaps = {name: views[name].behind(views[best]) for name in views}
    others = by_columns(search)
    at = np.cumsum([0] + [len(s.solution.theta) for s in others])
    columns = {s.name: range(at[i], at[i + 1]) for i, s in enumerate(others)}  # see `best_columns`
    out = []
    for name in sorted(gaps, key=lambda n: gaps[n]):
        s = step.screening[name]
        if is_alone(search, name):
            runs = list(after)
        elif name not in columns:
            runs = list(before)
        else:
            theta, pick = s.solution.theta, list(columns[name])
            runs = [Run(r.points + r.d_points[..., pick] @ theta, r.forces, r.d_points[..., :0], None) for r in before]
        rmse = errors_of(held_out, runs, registered=inputs.registered).metrics().rmse
        significant = step.screening.family_p <= ALPHA
        out.append(
            Ranked(
                name,
                rmse,
                found[best].score + gaps[name],
                gaps[name],
                groups[name] if significant else tuple(n for n in found if n != name),
                s.gain,
                s.p_value,
                name in step.refined,
            )
        )
    return tuple(out)


def simpler(
    search: Search,
    inputs: Inputs,
    held_out: Sequence[Observation],
    before: Sequence[Run],
    after: Sequence[Run],
    ranking: Sequence[Ranked],
) -> Simpler | None:
    """What simpler methods make of the same recordings; None where nothing was tried."""
    if search.dictionary is None or search.baseline is None:
        return None
    problem, dictionary, entries = search.problems[0], search.dictionary, entries_of(list(inputs.candidates.values()))
    signature, cosine = by_signature(problem, dictionary, entries)
    known = process_inputs(search.baseline.points, inputs.places)
    left = (np.concatenate([o.points for o in inputs.fitted]) - search.baseline.points).reshape(-1, 3)
    runs = []
    for run in before:
        more = process_discrepancy(known, left, process_inputs(np.nan_to_num(run.points), inputs.places))
        runs.append(replace(run, points=run.points + more.reshape(run.points.shape)))
    modulus = next((r.test_rmse for r in ranking if r.name == "stiffness"), float("nan"))

    def rmse(runs: Sequence[Run]) -> float:
        return errors_of(held_out, runs, registered=inputs.registered).metrics().rmse

    return Simpler(
        by_bic(problem, dictionary, entries),
        signature,
        cosine,
        modulus,
        rmse(runs),
        rmse(inputs.uncertain.correction.corrected(held_out, before)),
        rmse(search.uncertain.correction.corrected(held_out, after)),
    )
