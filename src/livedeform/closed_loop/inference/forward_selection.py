"""Forward addition of effects: screen all, refine the leading ones through the nonlinear model, keep what earns
itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import compress

import numpy as np

from livedeform.closed_loop.candidates import Candidate, doubt, with_start
from livedeform.closed_loop.evidence.noise import Nuisance, join
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import (
    Column,
    Correction,
    ForwardModel,
    Name,
    Run,
    dictionary_columns,
    first_key,
    stack,
)
from livedeform.closed_loop.inference.gauss_newton import Fit, Marginal, Problem, gauss_newton
from livedeform.closed_loop.inference.problem import Allowed, Uncertain, linear_problem, residual_at
from livedeform.closed_loop.inference.screening import (
    MIN_GAP,
    Entry,
    Screening,
    Views,
    by_time,
    in_one_block,
    screen,
    training_sets,
)
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array, EffectValues

ALPHA = 0.02  # family-wise probability of a false addition per step
MIN_SCORE = 16.0  # an addition must predict unseen blocks better by this much (twice the log density): odds of 3000
EFFECT_ERROR = 0.08  # of what an added effect does, that the model gets wrong of it: it looks like another effect
SILENT = 0.5  # of what an addition needs, below which a next step is not gone into, if it was seen at the step before
LEADERS = 4  # candidates that are refined through the nonlinear model
LOOK_AGAIN = 0.1  # of the best gain, that a candidate must seem to have for its columns to be taken again
FIRST_RUNS = 2  # of the model for each of them, before those that have fallen behind are left
PASSES = 3  # over the second mesh for an added effect, as long as that moves it by more than its sigma
BEHIND, BEHIND_SHARE = 30.0, 0.2  # that is: by this much of twice the log likelihood, or this share of the best gain
LEAD_SHARE = 0.5  # ... if their screened gain is at least this share of the best

ColumnKey = tuple[str, int, tuple[float, ...] | None]  # candidate, coordinate, and where it was taken
Tell = Callable[[str, float | None], None]


def silent(text: str, fraction: float | None = None) -> None:
    """No progress shown."""


@dataclass(frozen=True)
class Added:
    """An effect in the model, at coordinates ``z``."""

    candidate: Candidate
    z: Array

    @property
    def values(self) -> EffectValues:
        return self.candidate.values(self.z)


@dataclass(frozen=True)
class Refined:
    """A leading candidate after its nonlinear fit: ``score`` against the model without it, in all, by each block of
    time (``block_scores``, see `by_time`) and as its ``views``."""

    candidate: Candidate
    fit: Fit
    block_scores: Array
    views: Views

    @property
    def score(self) -> float:
        return self.views.score


@dataclass(frozen=True)
class Step:
    """One step of the forward addition: all candidates' screening, the refined leaders, and who was added ('' for
    none)."""

    screening: Screening
    refined: Mapping[str, Refined]
    added: str
    reason: str


@dataclass
class Search:
    """The state of the forward addition on the ``observations`` that are fitted.

    ``added`` effects, what they ``gained``, ``steps`` so far, ``joint`` the last fit of all added effects together.
    """

    forward: ForwardModel
    observations: Sequence[Observation]
    candidates: Mapping[str, Candidate]
    uncertain: Uncertain
    max_effects: int = 3
    seed: int = 0
    tell: Tell = silent
    added: list[Added] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    joint: Fit | None = None
    baseline: Run | None = None
    dictionary: Array | None = None  # of the first step
    last: tuple[Run, list[ColumnKey]] | None = None  # run that was screened, and which column is which
    problems: list[Problem] = field(default_factory=list)
    gained: float = 0.0
    smaller: set[str] = field(default_factory=set)  # than the least that the model can be solved with
    latest: tuple[tuple[object, ...], list[Run]] | None = None  # what was asked last of the model, and its answer

    def __post_init__(self) -> None:
        self.declared = self.uncertain.correction  # of the elements' error, without any effect

    def find(self) -> None:
        """Adds effects until none earns itself or there are ``max_effects``."""
        for number in range(self.max_effects + 1):
            self.tell(f"step {number + 1}: screening {len(self.remaining)} candidates", None)
            early = self.at_first_sight()
            if early is not None and early.scores[0].score > -SILENT * self.least:
                self.steps.append(Step(early, {}, "", "nothing beyond what noise and model error explain"))
                break
            columns = dictionary_columns(self.remaining)
            keys = _keys(columns, self.always_columns)
            run = self.columns_run(columns, early)
            self.last = run, keys
            if self.baseline is None:
                self.baseline = run
            problem, dictionary = self.problem(run, columns)
            self.problems.append(problem)
            if self.dictionary is None:
                self.dictionary = dictionary
            entries = entries_of(self.remaining)
            beside = self.beside(problem)
            screening = screen(beside, dictionary, entries, seed=self.seed)
            if number == self.max_effects:
                self.steps.append(Step(screening, {}, "", "no effect may be added"))
                break
            if screening.family_p > ALPHA or not screening.scores or screening.scores[0].score > -self.least:
                self.steps.append(Step(screening, {}, "", "nothing beyond what noise and model error explain"))
                break
            refined = self.refine(beside, screening)
            able = [r for r in refined.values() if r.score <= -self.least and not self.is_odd(r.block_scores)]
            best = simplest(able)
            if best is None:
                self.steps.append(Step(screening, refined, "", "no candidate predicts unseen blocks better"))
                break
            self.added.append(Added(best.candidate, best.fit.z))
            self.gained += best.fit.gain
            self.joint = best.fit if len(self.added) == 1 else self.refit(problem)
            self.correct(problem)
            self.steps.append(Step(screening, refined, best.candidate.name, _why(best, able)))
            if self.max_effects == number + 1:
                break
        self.prune()
        self.settle()

    # -- parts -------------------------------------------------------------------------------------------------------

    @property
    def effects(self) -> list[EffectValues]:
        return [a.values for a in self.added]

    @property
    def least(self) -> float:
        """What the next addition must predict unseen blocks better by."""
        errors = [a.candidate.info.model_error for a in self.added]
        error = max((EFFECT_ERROR if e is None else e for e in errors), default=0.0)
        return MIN_SCORE + error**2 * self.gained

    @property
    def remaining(self) -> list[Candidate]:
        taken = {a.candidate.name for a in self.added}
        return [c for name, c in self.candidates.items() if name not in taken]

    @property
    def allowed(self) -> list[Allowed]:
        """Of what is always allowed for, that which the added effects do not stand for."""
        taken = {a.candidate.name for a in self.added}
        return [a for a in self.uncertain.always if a.per_press or a.candidate.name not in taken]

    @property
    def always_columns(self) -> list[Column]:
        """Columns of what is allowed for in every model, to be asked for after all others."""
        at = {a.candidate.name: tuple(float(v) for v in a.z) for a in self.added}
        columns = dictionary_columns([a.candidate for a in self.allowed])
        return [replace(c, z=at.get(c.candidate.name, c.z)) for c in columns]

    def at_first_sight(self) -> Screening | None:
        """The remaining candidates at the model as it is now, by the columns of the step before: an effect that is
        added changes what others do little. None in the first step, or if nothing remains."""
        if self.last is None or not self.remaining:
            return None
        columns = dictionary_columns(self.remaining)
        now = stack(self.forward.run(self.effects, self.observations))
        run = self.with_last_columns(now, _keys(columns, self.always_columns), [])
        problem, dictionary = self.problem(run, columns)
        return screen(self.beside(problem), dictionary, entries_of(self.remaining), seed=self.seed)

    def columns_run(self, dictionary: Sequence[Column], early: Screening | None) -> Run:
        """The model as it is now with the columns of the ``dictionary`` and of what is always allowed for. Those of
        candidates that explained hardly anything ``early`` stay as they were."""
        columns, keys = [*dictionary, *self.always_columns], _keys(dictionary, self.always_columns)
        if early is None:
            return stack(self.forward.run(self.effects, self.observations, columns))
        least = LOOK_AGAIN * max(s.gain for s in early.scores)
        wanted = {s.name for s in early.scores if s.gain >= least}
        again = [key[0] in wanted or key[2] is None for key in keys]
        run = stack(self.forward.run(self.effects, self.observations, list(compress(columns, again))))
        return self.with_last_columns(run, keys, list(compress(keys, again)))

    def with_last_columns(self, run: Run, wanted: Sequence[ColumnKey], fresh: Sequence[ColumnKey]) -> Run:
        """The ``run``, which has the ``fresh`` columns, with the ``wanted`` ones: the others as they were at the last
        step."""
        assert self.last is not None  # the caller's
        before, known = self.last
        place = {key: i for i, key in enumerate([*known, *fresh])}  # the newest of each
        pick = [place[key] for key in wanted]
        d_forces = None
        if before.d_forces is not None and run.d_forces is not None:
            d_forces = np.concatenate([before.d_forces, run.d_forces], axis=-1)[..., pick]
        return replace(
            run, d_points=np.concatenate([before.d_points, run.d_points], axis=-1)[..., pick], d_forces=d_forces
        )

    def problem(self, run: Run, dictionary: Sequence[Column]) -> tuple[Problem, Array]:
        """See `linear_problem`."""
        return linear_problem(self.observations, self.uncertain, self.allowed, run, dictionary, self.always_columns)

    def beside(self, problem: Problem) -> Problem:
        """The problem of finding one more effect: those that are in the model may change with it. What looks like them
        they have taken upon themselves."""
        if self.joint is None or len(self.joint.columns) != problem.rows.n:
            return problem
        names = [(a.candidate.name, c) for a in self.added for c in a.candidate.coordinates]
        sigma = np.array([c.sigma for _, c in names])
        own = Nuisance(self.joint.columns * sigma, tuple(f"{name}.{c.parameter}" for name, c in names))
        return replace(problem, nuisance=join([problem.nuisance, own]))

    def refine(self, problem: Problem, screening: Screening) -> dict[str, Refined]:
        """The leading candidates through the nonlinear model.

        One whose best shape, chosen without the left-out data, predicts them worse is no leader: its shape, once fitted
        to all of them, would seem to. (Not so where columns at zero say little.)
        """
        best = max(s.gain for s in screening.scores)
        share = {s.name: LEAD_SHARE if self.candidates[s.name].tangent else 0.4 * LEAD_SHARE for s in screening.scores}
        leading = [
            s
            for s in screening.scores
            if s.gain >= share[s.name] * best and (s.score <= 0.0 or not self.candidates[s.name].tangent)
            if s.name not in self.smaller and not self.is_odd(s.block_scores)
        ]
        leading = sorted(leading, key=lambda s: -s.gain)[:LEADERS]
        largest = max(screening.scores, key=lambda s: s.gain)
        if largest not in leading and largest.score < 0.0 and largest.name not in self.smaller:
            leading.append(largest)  # odd, unless that is its linearisation
        marginal = problem.marginal()
        self.tell("fitting " + ", ".join(s.name for s in leading), None)
        starts = {s.name: start_of(self.candidates[s.name], s.shape, s.solution.theta) for s in leading}
        found = self._refine_all(problem, marginal, starts, max_runs=FIRST_RUNS)
        self.smaller |= {n for n, r in found.items() if self._is_smaller(r)}
        limit = max((r.fit.gain for r in found.values()), default=0.0)
        limit -= max(BEHIND, BEHIND_SHARE * limit)
        # who is that far behind after some steps does not win any more
        open_ = {n: r.fit.z for n, r in found.items() if not r.fit.converged and r.fit.gain > limit}
        return found | self._refine_all(problem, marginal, open_)

    def is_odd(self, block_scores: Array) -> bool:
        """What is let go shows itself in one stretch of time; what is pressed, in every press."""
        return any(len(o.path) for o in self.observations) and in_one_block(block_scores)

    def _is_smaller(self, r: Refined) -> bool:
        """Whether the least of it that the model can be solved with is far worse than nothing, and no way leads down
        from there: a strip that comes free is an element wide."""
        stuck = bool(np.array_equal(r.fit.z, r.fit.start))
        return stuck and r.fit.gain < -BEHIND and bool(r.candidate.kick.any())

    def _refine_all(
        self, problem: Problem, marginal: Marginal, starts: Mapping[str, Array], max_runs: int | None = None
    ) -> dict[str, Refined]:
        with ThreadPoolExecutor(max_workers=self.forward.processes) as threads:  # the model's workers are shared
            found = threads.map(lambda name: self._refine_one(problem, marginal, name, starts[name], max_runs), starts)
            return {r.candidate.name: r for r in found if r is not None}

    def _refine_one(
        self, problem: Problem, marginal: Marginal, name: str, start: Array, max_runs: int | None
    ) -> Refined | None:
        candidate = self.candidates[name]
        fit = self.fit(problem, marginal, [*self.added, Added(candidate, start)], [len(self.added)], max_runs)
        if fit is None:
            return None
        per_set = cross_validated(problem, fit, candidate.array("centre"), candidate.array("sigma"))
        n_time = len(np.unique(problem.rows.fold))
        views = Views.of(per_set, n_time, doubt(fit.z, candidate.stated))
        return Refined(candidate, fit, by_time(per_set, n_time), views)

    def refit(self, problem: Problem) -> Fit | None:
        """All added effects together."""
        fit = self.fit(problem, problem.marginal(), self.added, free=range(len(self.added)))
        if fit is not None:
            at = 0
            for i, a in enumerate(self.added):
                n = len(a.z)
                self.added[i] = Added(a.candidate, fit.z[at : at + n])
                at += n
            correction = self.uncertain.correction.moved(coordinates_of(self.added))
            self.uncertain = replace(self.uncertain, correction=correction)
        return fit

    def correct(self, problem: Problem, passes: int = PASSES) -> None:
        """What the elements get wrong is another thing with the added effects: takes that off instead, or what the
        declared model gets wrong where that is not worked out, and fits them again; once more where they have moved."""
        if self.uncertain.anew is None:
            return
        for _ in range(passes):
            if self.joint is None:
                return
            self.tell("solving it on the second mesh", None)
            correction = self.worked_out(self.observations)
            kept, before = self.uncertain, self.joint
            if correction is None and kept.correction is self.declared:
                return
            of_all = self.declared if correction is None else self.declared.updated(correction)
            self.uncertain = replace(kept, correction=of_all)
            again = self.refit(problem)
            if again is None:
                self.uncertain = kept
                return
            self.joint = again
            self.gained += again.gain - before.gain
            if correction is None or has_settled(before, again):
                return

    def worked_out(self, observations: Sequence[Observation], own: Sequence[Run] = ()) -> Correction | None:
        """What the elements get wrong of the model as it is, where a second mesh tells; ``own``: its runs, with the
        columns of all coordinates first, if they are there already."""
        if self.uncertain.anew is None:
            return None
        columns = columns_of(self.added)
        return self.uncertain.anew(
            self.effects, observations, lambda: own or self.predicted(self.added, observations, columns), columns
        )

    def foresee(self, held_out: Sequence[Observation], own: Sequence[Run]) -> None:
        """Works out what the elements get wrong of recordings that are only predicted, by the model's ``own`` runs."""
        correction = None if self.uncertain.correction is self.declared else self.worked_out(held_out, own)
        if correction is not None:
            self.uncertain = replace(self.uncertain, correction=self.uncertain.correction.updated(correction))

    def predicted(
        self, members: Sequence[Added], observations: Sequence[Observation], columns: Sequence[Column]
    ) -> list[Run]:
        """The model's runs with the ``members`` in it; those that were asked for last are remembered."""
        key = (
            tuple((a.candidate.name, tuple(a.z)) for a in members),
            tuple(map(first_key, observations)),
            tuple((c.candidate.name, c.z, c.coordinate) for c in columns),
        )
        latest = self.latest
        if latest is None or latest[0] != key:
            latest = key, self.forward.run([a.values for a in members], observations, columns)
            self.latest = latest
        return latest[1]

    def prune(self) -> None:
        """Takes out what those added after it have made needless, an effect that stood for two others, and what was
        the elements' error: nothing of it is left once that is worked out with it."""
        while self.added and self.joint is not None:
            worth = [self._worth(i) for i in range(len(self.added))]
            i = int(np.argmin(worth))
            if worth[i] > MIN_SCORE:
                return
            kept, joint, uncertain = list(self.added), self.joint, self.uncertain
            out = self.added.pop(i)
            name = out.candidate.name
            if not self.added:
                if joint.gain > MIN_SCORE:
                    self.added = kept
                    return
                self.joint, self.gained = None, 0.0
                self.uncertain = replace(self.uncertain, correction=self.declared)
                self._note(f"{name} is the elements' error: nothing is left of it on a second mesh")
                return
            self.tell(f"fitting without {name}", None)
            again = self.refit(self.problems[-1])
            if again is None or joint.gain - again.gain > self.least:
                self.added, self.joint, self.uncertain = kept, joint, uncertain
                return
            self.joint = again
            self.correct(self.problems[-1])
            self._note(f"{name} is not needed beside the others: taken out")

    def _note(self, reason: str) -> None:
        self.steps.append(Step(self.steps[-1].screening, {}, "", reason))

    def settle(self) -> None:
        """What is allowed for in each press anew acts otherwise beside an added effect of its own kind: a probe that is
        deeper touches more. Takes its derivatives there, and fits again."""
        own = {a.candidate.name for a in self.uncertain.always if a.per_press}
        if self.joint is None or not own & {a.candidate.name for a in self.added}:
            return
        for _ in range(PASSES):
            self.tell("fitting all together", None)
            run = stack(self.forward.run(self.effects, self.observations, self.always_columns))
            problem, _ = self.problem(run, [])
            before, again = self.joint, self.refit(problem)
            if again is None:
                return
            self.joint = again
            if has_settled(before, again):
                return
            self.correct(problem, passes=1)

    def _worth(self, number: int) -> float:
        """Squared size of the added effect ``number`` in its own sigmas: twice the log likelihood that it is worth
        beside the others (Wald 1943)."""
        assert self.joint is not None
        at = sum(len(a.z) for a in self.added[:number])
        i = at + self.added[number].candidate.amplitudes
        if not len(i):  # switched on as a whole
            return np.inf
        z, covariance = self.joint.z[i], self.joint.covariance[np.ix_(i, i)]
        return float(z @ np.linalg.solve(covariance, z))

    def fit(
        self,
        problem: Problem,
        marginal: Marginal,
        members: Sequence[Added],
        free: Sequence[int],
        max_runs: int | None = None,
    ) -> Fit | None:
        """MAP of the coordinates of the members number ``free``; None if the model cannot be solved there."""
        chosen = [members[i] for i in free]
        start = np.concatenate([a.z for a in chosen])
        bounds = np.cumsum([0] + [len(a.z) for a in chosen])

        def model(z: Array) -> tuple[Array, Array]:
            now = list(members)
            for j, i in enumerate(free):
                now[i] = Added(members[i].candidate, z[bounds[j] : bounds[j + 1]])
            columns = columns_of([now[i] for i in free])
            run = stack(self.predicted(now, self.observations, columns))
            uncertain = replace(self.uncertain, correction=self.uncertain.correction.moved(coordinates_of(now)))
            return residual_at(self.observations, uncertain, problem, run, columns)

        centre, sigma, lower, upper = (
            np.concatenate([a.candidate.array(k) for a in chosen]) for k in ("centre", "sigma", "lower", "upper")
        )
        between = np.array([bool(c.edges) for a in chosen for c in a.candidate.coordinates])
        centre = np.where(between, start, centre)  # stays where it is best, since nothing slopes there
        c0 = float(np.sum(marginal(problem.residual) ** 2))
        try:
            return gauss_newton(
                model, marginal, start, centre, sigma, lower, upper, c0=c0, max_runs=max_runs or 4 + len(start)
            )
        except ConvergenceError:
            return None


# --- small functions
# ------------------------------------------------------------------------------------------------------


def columns_of(added: Sequence[Added]) -> list[Column]:
    """Those of all coordinates, where they are."""
    return [
        Column(a.candidate, tuple(float(v) for v in a.z), i) for a in added for i in range(len(a.candidate.coordinates))
    ]


def coordinates_of(added: Sequence[Added]) -> dict[Name, float]:
    """Where all coordinates are, by name."""
    return {(a.candidate.name, i): float(v) for a in added for i, v in enumerate(a.z)}


def has_settled(before: Fit, after: Fit) -> bool:
    """Whether nothing has moved by more than its sigma."""
    return bool(np.all(np.abs(after.z - before.z) < after.sigma))


def simplest(refined: Sequence[Refined]) -> Refined | None:
    """Of those that the data cannot tell from the best the one with the fewest numbers, and of these the best."""
    if not refined:
        return None
    best = min(refined, key=lambda r: r.views.together)
    near = [r for r in refined if r.views.behind(best.views) < MIN_GAP]
    return min(near, key=lambda r: (len(r.candidate.coordinates), r.views.together))


def _why(chosen: Refined, able: Sequence[Refined]) -> str:
    if all(chosen.views.together <= r.views.together for r in able):
        return "predicts unseen blocks best"
    return "the simplest of those that predict unseen blocks best"


def _keys(dictionary: Sequence[Column], always: Sequence[Column]) -> list[ColumnKey]:
    """Which column is which, of two runs; those of what is always allowed for are at other coordinates in each."""
    tried: list[ColumnKey] = [(c.candidate.name, c.coordinate, c.z) for c in dictionary]
    return tried + [(c.candidate.name, c.coordinate, None) for c in always]


def entries_of(candidates: Sequence[Candidate]) -> list[Entry]:
    """The dictionary's entries, in the order of `dictionary_columns`."""
    entries, at = [], 0
    for c in candidates:
        i = c.amplitudes
        sigma, lower, upper, stated = c.array("sigma")[i], c.array("lower")[i], c.array("upper")[i], c.stated[i]
        if not len(i):  # switched on as a whole: the column is the effect itself, at strength one
            sigma, lower, upper, stated = np.array([1.0]), np.array([0.0]), np.array([2.0]), np.array([np.inf])
        for s in range(len(c.shapes)):
            entries.append(Entry(c.name, s, tuple(range(at, at + len(sigma))), sigma, lower, upper, stated))
            at += len(sigma)
    return entries


def start_of(candidate: Candidate, shape: int, theta: Array) -> Array:
    """Where the nonlinear fit starts: the linear amplitudes, off the bounds at which an effect vanishes."""
    if not len(candidate.amplitudes):
        return candidate.shapes[shape].copy()
    z = with_start(candidate, shape, theta)
    kick = candidate.kick
    low, high = np.minimum(0.5 * kick, 2.0 * kick), np.maximum(0.5 * kick, 2.0 * kick)
    return np.where(kick != 0.0, np.clip(z, low, high), z)


def cross_validated(problem: Problem, fit: Fit, centre: Array, sigma: Array) -> Array:
    """-2 log predictive density of each left-out set, of the fit's linearisation relative to the model before."""

    def evidence(marginal: Marginal) -> float:
        r0, r, J = marginal(problem.residual), marginal(fit.residual), marginal(fit.columns)
        d = (fit.z - centre) / sigma
        A = J.T @ J + np.diag(1.0 / sigma**2)
        b = J.T @ r - d / sigma
        _, logdet = np.linalg.slogdet(A * np.outer(sigma, sigma))
        return float(r0 @ r0 - (r @ r + d @ d - b @ np.linalg.solve(A, b) + logdet))

    full = evidence(problem.marginal())
    return np.array([evidence(problem.marginal(keep)) - full for keep in training_sets(problem)])
