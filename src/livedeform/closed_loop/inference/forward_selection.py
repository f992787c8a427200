"""Forward addition of effects: screen all, fit the leading ones through the nonlinear model, keep what earns
itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import compress

import numpy as np

from livedeform.closed_loop.candidates import Candidate, unhindered, with_start
from livedeform.closed_loop.evidence.noise import Nuisance, join
from livedeform.closed_loop.evidence.observation import Observation, are_pressed
from livedeform.closed_loop.forward import Column, ForwardModel, RefinedMesh, Run, dictionary_columns, stack
from livedeform.closed_loop.inference.effect_fit import EffectFitter, RefinedMeshCorrection
from livedeform.closed_loop.inference.fitted_model import Added, FittedModel, Uncertain
from livedeform.closed_loop.inference.forms import as_released, in_form, of_itself, swing_rate
from livedeform.closed_loop.inference.gauss_newton import Fit, GaussNewton, Marginal, Prior, Problem, normal_equations
from livedeform.closed_loop.inference.problem import ProblemFactory, beginning, is_let_go
from livedeform.closed_loop.inference.screening import (
    DictionaryEntry,
    Score,
    Screened,
    Screening,
    Views,
    in_one_block,
)
from livedeform.closed_loop.progress import Tell, TimeBudget, silent
from livedeform.closed_loop.remembered import Remembered
from livedeform.closed_loop.settings import SelectionSettings, Settings
from livedeform.common.types import Array

NOTHING_LEFT = "nothing beyond what noise and model error explain"
OUT_OF_TIME = "the time budget was used up"
AT_LIMIT = "no more effects may be added, and there is one that would predict unseen blocks better"
TOGETHER = "what was let go shows it with the others"

ColumnKey = tuple[str, int, tuple[float, ...] | None]  # candidate, coordinate, and where it was taken


@dataclass(frozen=True)
class Refined:
    """A leading candidate after its nonlinear fit: ``score`` conditional on the effects in the model, in all, by each
    block of time (``block_scores``, see `screening.by_time`) and as its ``views``; ``joint``: the fit of all effects,
    if they were fitted together."""

    candidate: Candidate
    fit: Fit
    block_scores: Array
    views: Views
    score: float
    joint: Fit | None = None


@dataclass(frozen=True)
class SelectionStep:
    """One step of the forward addition: all candidates' scores, the refined leaders, and who was added ('' for
    none) for which ``reason``; ``by_one_press``: those that one press alone speaks for, which are not added."""

    screening: Screened
    refined: Mapping[str, Refined]
    added: str
    reason: str
    by_one_press: tuple[str, ...] = ()


@dataclass(frozen=True)
class Linearised:
    """The model at a step: its ``run`` with Jacobian columns, the ``keys`` of these, the linear ``problem`` there and
    the columns of the ``dictionary`` (rows, p) on its rows."""

    run: Run
    keys: tuple[ColumnKey, ...]
    problem: Problem
    dictionary: Array


@dataclass(frozen=True)
class Selection:
    """The result of the forward selection on ``observations`` among ``candidates``.

    ``model``: the declared model with the effects that were kept, fitted together in ``problem``; ``steps`` on the way;
    ``first`` and ``last``: where the model was linearised in the first and the last step (None: no step got there);
    ``lost``: leading candidates that could not be fitted, since the model has no equilibrium with them.
    """

    observations: Sequence[Observation]
    candidates: Mapping[str, Candidate]
    model: FittedModel
    steps: tuple[SelectionStep, ...]
    first: Linearised | None
    last: Linearised | None
    problem: Problem | None
    lost: tuple[str, ...] = ()

    @property
    def added(self) -> tuple[Added, ...]:
        """The effects that were kept."""
        return self.model.added

    @property
    def as_one(self) -> bool:
        """Tell whether the effects were fitted and compared as one set, which contradict each other one by one."""
        return any(step.reason == TOGETHER for step in self.steps)

    @property
    def cut_off(self) -> str:
        """The candidate that leads where no more effects may be added; empty if none would have been."""
        last = next((step for step in self.steps if step.reason == AT_LIMIT), None)
        return "" if last is None else last.screening.scores[0].name

    def is_alone(self, name: str) -> bool:
        """Tell whether this candidate, and no other, was added."""
        return self.model.names == [name]


@dataclass(frozen=True)
class ForwardSelection:
    """The method: adds effects one after another while they earn themselves."""

    settings: SelectionSettings
    screening: Screening
    fitter: EffectFitter
    mesh: RefinedMeshCorrection
    candidates: Mapping[str, Candidate]
    declared: FittedModel
    max_effects: int = 3
    seed: int = 0
    tell: Tell = field(default=silent)
    budget: TimeBudget = field(default_factory=TimeBudget)
    kept: list[FittedModel] = field(default_factory=list)  # beside which a release's set was no better
    lost: list[str] = field(default_factory=list)  # leaders that the model has no equilibrium with

    @classmethod
    def of(
        cls,
        settings: Settings,
        forward: ForwardModel,
        observations: Sequence[Observation],
        candidates: Mapping[str, Candidate],
        uncertain: Uncertain,
        *,
        refined_mesh: RefinedMesh | None = None,
        max_effects: int = 3,
        seed: int = 0,
        tell: Tell = silent,
        budget: TimeBudget | None = None,
    ) -> ForwardSelection:
        """Build the method for these recordings and this model, whose last runs it remembers."""
        problems = ProblemFactory(observations, settings.allowance)
        fitter = EffectFitter(Remembered(forward), problems, GaussNewton(settings.fit))
        mesh = RefinedMeshCorrection(refined_mesh, uncertain.correction, fitter, tell)
        screening, declared = Screening(settings.screening), FittedModel(uncertain)
        budget = budget or TimeBudget()
        return cls(settings.selection, screening, fitter, mesh, candidates, declared, max_effects, seed, tell, budget)

    @property
    def observations(self) -> Sequence[Observation]:
        """The recordings that are fitted."""
        return self.fitter.problems.observations

    def find(self) -> Selection:
        """Add effects until none earns itself or there are ``max_effects``."""
        model = self.declared
        steps: list[SelectionStep] = []
        first: Linearised | None = None
        last: Linearised | None = None
        fitted: Linearised | None = None  # where the model was: a step that adds nothing is taken about it
        too_small: frozenset[str] = frozenset()
        for number in range(self.max_effects + 1):
            if number and not self.has_time(model, number):
                break
            self.tell(f"step {number + 1}: screening {len(self.remaining(model))} candidates", None)
            # 1. prescreen with the Jacobian columns of the step before: is there anything worth a step?
            early = self.prescreen(model, last)
            if early is not None and self.is_silent(model, early):
                steps.append(SelectionStep(early, {}, "", NOTHING_LEFT))
                break
            # 2. the model as it is now with the columns of all candidates, conditional on what is in it already
            last = self.linearised(model, last, early)
            first = first or last
            problem = conditional_on(last.problem, model)
            # 3. score all candidates at once
            screened = self.screen(model, problem, last.dictionary)
            if len(model.added) == self.max_effects:
                steps += self.at_limit(model, screened)
                break
            if not self.is_significant(screened, self.least(model, self.left_by(problem, screened), problem.rows.n)):
                steps.append(SelectionStep(screened, {}, "", NOTHING_LEFT))
                break
            # 4. fit the leaders through the nonlinear model
            together = last.problem if model.rings else problem  # what rings is fitted anew with each candidate
            early_gains = self.early_gains(together, last.dictionary, model) if model.rings else None
            refined, too_small = self.refine(model, together, screened, too_small, early_gains)
            refined, better, able = self.settled(model, together, refined)
            best = self.simplest(able)
            if best is None:
                steps.append(self.nothing_added(screened, refined, better))
                break
            # 5. add the best one and fit all together; what a release shows takes the place of what was found so far
            model, last, new = self.released_soon(self.extended(last.problem, model, best), last)
            # 6. number each as the data ask for, and correct for the discretisation error with it
            model = self.mesh.corrected(last.problem, self.numbered(last.problem, model), self.settings.passes)
            fitted = last
            steps.append(SelectionStep(screened, refined, best.candidate.name, _why(best, able)))
            steps += [SelectionStep(screened, {}, name, TOGETHER) for name in new]
            if len(model.added) >= self.max_effects:
                steps += self.at_limit(model, self.prescreen(model, last))
                break
        # 7. number otherwise what rings, take out what is needless, take what is allowed for where the effects have led
        return self.finished(model, steps, first, last, fitted)

    # -- parts -------------------------------------------------------------------------------------------------------

    def finished(
        self,
        model: FittedModel,
        steps: list[SelectionStep],
        first: Linearised | None,
        last: Linearised | None,
        where: Linearised | None,
    ) -> Selection:
        """Return what was found, revised and settled: all in the problem ``where`` it was fitted, whose rows and whose
        gain are the fit's."""
        stated = where or last
        fitted_in = None if stated is None else stated.problem
        if fitted_in is not None:
            model, fitted_in, notes = self.revised(fitted_in, model)
            model, fitted_in = self.without_lost(fitted_in, model)
            model = self.freed(fitted_in, model)
            steps = steps + [SelectionStep(steps[-1].screening, {}, name, note) for name, note in notes]
            model, fitted_in = self.settle(fitted_in, model)
        fitted = {*model.names, *(name for step in steps for name in step.refined)}
        lost = tuple(name for name in dict.fromkeys(self.lost) if name not in fitted)
        return Selection(self.observations, self.candidates, model, tuple(steps), first, last, fitted_in, lost)

    def has_time(self, model: FittedModel, number: int) -> bool:
        """Tell whether more than a ``number`` of effects may be looked for: what a release shows together is fitted
        after those that lead to it, and is to have its time."""
        waits = is_let_go(model, self.observations) and not self.is_released(model)
        share = self.settings.one_by_one if waits else 1.0
        return self.budget.allows(f"looking for more than {number} effects", share)

    def remaining(self, model: FittedModel) -> list[Candidate]:
        """Candidates that are not in the model."""
        return [c for name, c in self.candidates.items() if name not in model.names]

    def least(self, model: FittedModel, left: float = np.inf, n: float = np.inf) -> float:
        """Tell by how much the next addition must predict unseen blocks better, if ``left`` chi2 beyond chance remain
        of ``n`` data (infinite: not known).

        What the effects in the model get wrong may look like another one. What rings gains so much that a share of it
        would hide all others; but what an addition leaves nothing of was not another effect's error, which rings too.
        Where more than noise is left, chance takes as many times more of it (McCullagh & Nelder 1989, section 4.5).
        """
        errors = [a.candidate.info.model_error for a in model.added]
        error = max((self.settings.effect_error if e is None else e for e in errors), default=0.0)
        wrong = error**2 * model.gained
        scatter = 1.0 + (left / n if np.isfinite(left) else 0.0)
        return self.settings.min_score * scatter + (min(wrong, left) if model.rings else wrong)

    def better(self, model: FittedModel, problem: Problem, refined: Mapping[str, Refined]) -> list[Refined]:
        """Return those that predict unseen blocks better, though one press alone may speak for them (`is_odd`)."""
        left = {name: self.beyond_chance(problem, r.fit.residual) for name, r in refined.items()}
        return [r for name, r in refined.items() if r.score <= -self.least(model, left[name], problem.rows.n)]

    def settled(
        self, model: FittedModel, problem: Problem, refined: dict[str, Refined]
    ) -> tuple[dict[str, Refined], list[Refined], list[Refined]]:
        """Fit to its end what would be added, until what would be is; return all fits, those that are `better`, and of
        these the ones for which more than one press speaks.

        A fit that was left on its way, as far behind, is scored as if it had made its next step, which may lead to the
        best of all; but what is added is where the fit is.
        """
        ended: set[str] = set()
        while True:
            better = self.better(model, problem, refined)
            able = [r for r in better if not self.is_odd(r.block_scores)]
            best = self.simplest(able)
            if best is None or best.fit.converged or best.candidate.name in ended:
                return refined, better, able
            ended.add(best.candidate.name)
            start = self.trying(model, best.candidate.name, best.fit.z, best.joint)
            refined = refined | self._refine_all(problem, problem.marginal, [start], goes_on=True)

    def nothing_added(
        self, screened: Screened, refined: Mapping[str, Refined], better: Sequence[Refined]
    ) -> SelectionStep:
        """Return a step in which nothing is added, and why: for each that is ``better`` one press alone speaks."""
        odd = tuple(r.candidate.name for r in better)
        why = f"one press alone speaks for {' and '.join(odd)}" if odd else "no candidate predicts unseen blocks better"
        return SelectionStep(screened, refined, "", OUT_OF_TIME if self.budget.left_out else why, odd)

    def at_limit(self, model: FittedModel, screened: Screened | None) -> list[SelectionStep]:
        """Return the step that may add nothing any more, which says whether it would have."""
        if screened is None:
            return []
        more = self.is_significant(screened, self.least(model))
        return [SelectionStep(screened, {}, "", AT_LIMIT if more else NOTHING_LEFT)]

    def is_silent(self, model: FittedModel, early: Screened) -> bool:
        """Tell whether nothing is worth a step, by the Jacobian columns of the step before; of what rings these tell
        little once it swings otherwise."""
        return not model.rings and early.scores[0].score > -self.settings.silent * self.least(model)

    def beyond_chance(self, problem: Problem, residual: Array) -> float:
        """Return how much larger the chi2 of a residual is than chance makes it."""
        n = problem.rows.n
        return max(problem.chi2_of(residual) - n - 2.0 * float(np.sqrt(2.0 * n)), 0.0)

    def left_by(self, problem: Problem, screened: Screened) -> float:
        """Return how much chi2 beyond chance the leading candidate leaves, to first order."""
        best = screened.scores[0].gain if screened.scores else 0.0
        return max(self.beyond_chance(problem, problem.residual) - best, 0.0)

    def is_significant(self, screened: Screened, least: float) -> bool:
        """Tell whether anything is worth a nonlinear fit."""
        if screened.family_p > self.settings.alpha or not screened.scores:
            return False
        return screened.scores[0].score <= -least

    def is_odd(self, block_scores: Array) -> bool:
        """Tell whether one press alone speaks for it. What is let go shows itself in one stretch of time; what is
        pressed, in every press."""
        return are_pressed(self.observations) and in_one_block(block_scores)

    def screen(self, model: FittedModel, problem: Problem, dictionary: Array) -> Screened:
        """Score the candidates that are not in the model."""
        return self.screening(problem, dictionary, entries_of(self.remaining(model)), seed=self.seed)

    def prescreen(self, model: FittedModel, last: Linearised | None) -> Screened | None:
        """Score the remaining candidates at the model as it is now by the Jacobian columns of the step before: an
        effect that is added changes what others do little. None in the first step, or if nothing remains."""
        if last is None or not self.remaining(model):
            return None
        columns = dictionary_columns(self.remaining(model))
        now = stack(self.fitter.forward.run(model.effects, self.observations))
        run = with_columns(now, last, _keys(columns, model.allowed_columns), [])
        problem, dictionary = self.problems_of(model).at(model, run, columns)
        return self.screen(model, conditional_on(problem, model), dictionary)

    def linearised(self, model: FittedModel, last: Linearised | None, early: Screened | None) -> Linearised:
        """Run the model with the Jacobian columns of the remaining candidates and of what is always allowed for. Those
        of candidates that explained hardly anything ``early`` stay as they were in the step before."""
        columns = dictionary_columns(self.remaining(model))
        asked, keys = [*columns, *model.allowed_columns], _keys(columns, model.allowed_columns)
        if early is None or last is None:
            run = stack(self.fitter.forward.run(model.effects, self.observations, asked))
        else:
            least = self.settings.look_again * max(s.gain for s in early.scores)
            wanted = {s.name for s in early.scores if s.gain >= least}
            again = [key[0] in wanted or key[2] is None for key in keys]
            run = stack(self.fitter.forward.run(model.effects, self.observations, list(compress(asked, again))))
            run = with_columns(run, last, keys, list(compress(keys, again)))
        return Linearised(run, tuple(keys), *self.problems_of(model).at(model, run, columns))

    def early_gains(self, problem: Problem, dictionary: Array, model: FittedModel) -> dict[str, float]:
        """Return what each candidate gains in the beginning of the motion, to first order: later, what swings with a
        wrong frequency is out of phase, and its columns tell nothing."""
        early = beginning(self.observations, self.settings.beginning)
        keep = (early if early.sum() > 1 else np.ones_like(early))[problem.rows.moment]
        ridge = normal_equations(problem.marginal_of(keep), problem.residual, dictionary)
        gains: dict[str, float] = {}
        for e in entries_of(self.remaining(model)):
            gain = ridge.part(e.columns).solve(e.sigma, e.lower, e.upper).gain
            gains[e.name] = max(gains.get(e.name, 0.0), gain)
        return gains

    def refine(
        self,
        model: FittedModel,
        problem: Problem,
        screened: Screened,
        too_small: frozenset[str],
        early_gains: Mapping[str, float] | None = None,
    ) -> tuple[dict[str, Refined], frozenset[str]]:
        """Fit the leading candidates through the nonlinear model, but those that are ``too_small`` for its elements;
        also tells which are that by now.

        Of what rings those lead that do in the beginning of the motion (``early_gains``), and those that its own
        damping may have stood in for.
        """
        if early_gains is None:
            leading = self.leaders(screened, too_small)
        else:
            hidden = {name for a in model.added if a.candidate.info.rings for name in a.candidate.info.confused_with}
            least = self.settings.lead_share_no_tangent * max(early_gains.values())
            able = [n for n, gain in early_gains.items() if (gain >= least or n in hidden) and n not in too_small]
            leading = sorted(able, key=lambda n: (n not in hidden, -early_gains[n]))[: self.settings.leaders]
        marginal = problem.marginal
        self.tell("fitting " + ", ".join(leading), None)
        starts = [self.trying(model, n, z) for n in leading for z in self.starts_of(screened[n])]
        found = self._refine_all(problem, marginal, starts, max_runs=self.settings.first_runs)
        too_small |= {n for n, r in found.items() if self._is_too_small(r)}
        limit = max((r.fit.gain for r in found.values()), default=0.0)
        limit -= max(self.settings.behind, self.settings.behind_share * limit)
        # who is that far behind after some steps does not win any more
        open_ = [r for r in found.values() if not r.fit.converged and r.fit.gain > limit]
        there = [self.trying(model, r.candidate.name, r.fit.z, r.joint) for r in open_]
        return found | self._refine_all(problem, marginal, there, goes_on=True), too_small

    def trying(self, model: FittedModel, name: str, z: Array, joint: Fit | None = None) -> FittedModel:
        """Return the model with a candidate at ``z`` (p,) behind its effects, and all of them where a ``joint`` fit has
        them."""
        with_it = replace(model, added=(*model.added, Added(self.candidates[name], z)))
        return with_it if joint is None else with_it.with_fit(joint)

    def starts_of(self, score: Score) -> list[Array]:
        """Return where the nonlinear fits of a candidate begin: at its best shape, and at that of the other sign if it
        explains a good share of that to first order, which cannot tell them apart for sure."""
        tried = [(score.shape, score.fit)]
        if score.opposite is not None and score.opposite[1].gain >= self.settings.lead_share * score.fit.gain:
            tried.append(score.opposite)
        return [start_of(self.candidates[score.name], shape, fit.theta) for shape, fit in tried]

    def leaders(self, screened: Screened, too_small: frozenset[str]) -> list[str]:
        """Name the leading candidates, best first.

        One whose best shape, chosen without the left-out data, predicts them worse is no leader: its shape, once fitted
        to all of them, would seem to. (Not so where columns at zero say little.)
        """
        best = max(s.gain for s in screened.scores)
        tangent = {s.name: self.candidates[s.name].tangent for s in screened.scores}
        share = {n: self.settings.lead_share if t else self.settings.lead_share_no_tangent for n, t in tangent.items()}
        leading = [
            s
            for s in screened.scores
            if s.gain >= share[s.name] * best and (s.score <= 0.0 or not tangent[s.name])
            if s.name not in too_small and not self.is_odd(s.block_scores)
        ]
        leading = sorted(leading, key=lambda s: -s.gain)[: self.settings.leaders]
        largest = max(screened.scores, key=lambda s: s.gain)
        if largest not in leading and largest.score < 0.0 and largest.name not in too_small:
            leading.append(largest)  # odd, unless that is its linearisation
        return [s.name for s in leading]

    def simplest(self, refined: Sequence[Refined]) -> Refined | None:
        """Choose, of those that the data cannot tell from the best, the one with the fewest numbers, and of these the
        best."""
        if not refined:
            return None
        best = min(refined, key=lambda r: r.views.together)
        near = [r for r in refined if r.views.behind(best.views) < self.screening.settings.min_gap]
        return min(near, key=lambda r: (len(r.candidate.coordinates), r.views.together))

    def extended(self, problem: Problem, model: FittedModel, best: Refined) -> FittedModel:
        """Add the ``best`` candidate to the model and fit all effects together."""
        added = (*model.added, Added(best.candidate, best.fit.z))
        model = replace(model, added=added, gained=model.gained + best.fit.gain)
        if best.joint is not None:
            return model.with_fit(best.joint)
        if len(added) == 1:
            return replace(model, joint=best.fit)
        return self.fitter.refit(problem, model) or replace(model, joint=None)

    def numbered(self, problem: Problem, model: FittedModel, *, at_the_end: bool = False) -> FittedModel:
        """Number each effect as the data ask for: as many terms, or such a spectrum, as predict left-out blocks better.

        They are tried if the fit leaves something. Of what rings, those with no more numbers are tried ``at_the_end``
        in any case: what a model may get wrong of a motion is more than what a wrong spectrum leaves of it. What a
        release shows together has its numbers.
        """
        if self.is_released(model):
            return model
        for i in range(len(model.added)):
            for form in of_itself(self.candidates[model.names[i]]):
                now = model.added[i].candidate
                more = len(form.coordinates) > len(now.coordinates)
                if model.joint is None or form.form is now.form:
                    continue
                if not self._is_loud(problem, model.joint) and (more or not at_the_end or not model.rings):
                    continue
                better = self._in_form(problem, model, i, form)
                if better is not None:
                    model = better
                elif more:
                    break  # more numbers do not better it
        return model

    def _in_form(self, problem: Problem, model: FittedModel, number: int, form: Candidate) -> FittedModel | None:
        """Fit the model with an effect in another form, and with what that asks for; None if it is no better, by as
        much for each effect that comes with it as an effect needs."""
        assert model.joint is not None  # the caller's
        rate = swing_rate(self.observations) if model.rings else 0.0
        tried = in_form(model, number, form, self.candidates, rate)
        more = len(tried.added) - len(model.added)
        name = form.form.name if form.form else "one term"
        if len(tried.added) > self.max_effects or not self.budget.allows(f"fitting {form.name} as {name}"):
            return None
        self.tell(f"fitting {form.name} as {name}", None)
        again = self.fitter.refit(problem, tried)
        if again is None or again.joint is None:
            return None
        least = (1 + more) * self.settings.min_score
        if self._score_of(problem, again) > self._score_of(problem, model) - least:
            return None
        return replace(again, gained=model.gained + again.joint.gain - model.joint.gain)

    def revised(self, problem: Problem, model: FittedModel) -> tuple[FittedModel, Problem, list[tuple[str, str]]]:
        """Number what rings otherwise, and take out what others have made needless. Also returns the problem that it
        was fitted in, and tells what was added ('' for nothing) and why."""
        numbered = self.numbered(problem, model, at_the_end=True)
        asked = [(name, "another form asks for it") for name in numbered.names if name not in model.names]
        whole, problem = self.released(problem, numbered)
        asked += [(name, TOGETHER) for name in whole.names if name not in numbered.names]
        pruned, notes = self.prune(problem, whole)
        return pruned, problem, [*asked, *(("", note) for note in notes)]

    def released(self, problem: Problem, model: FittedModel) -> tuple[FittedModel, Problem]:
        """Return all that a body which was let go shows together in place of the effects found one by one, if it
        predicts left-out blocks better, by as much for each effect that is new as an effect needs; and the problem that
        the set which is returned was fitted in.

        One by one, each of them alone makes what the others explain worse. The two finished sets are fitted and
        compared with one error of the model for each recording: steps between blocks of time would take up what creeps.
        When the body passes where it began, hardly an error is allowed: such moments tell which set it is, but not how
        large its values are, as they outweigh all others. So the set is fitted once more with an error that lasts.
        """
        if not is_let_go(model, self.observations) or any(one is model for one in self.kept):
            return model, problem
        tried = as_released(model, self.candidates, swing_rate(self.observations), self.max_effects)
        if tried is None or model.joint is None or len(tried.added) > self.max_effects:
            return model, problem
        if not self.budget.allows("fitting together what is shown by a release"):
            return model, problem
        self.tell("fitting together " + ", ".join(tried.names), None)
        one_load = replace(self.fitter.problems, one_load=True)
        whole = self.restated(model, one_load)
        again, found = self.fitter.refit(whole, tried), self.fitter.refit(whole, model, goes_on=True)
        if found is None or again is None or found.joint is None or again.joint is None:
            return model, problem
        new = sum(name not in model.names for name in again.names)
        if self._score_of(whole, again) > self._score_of(whole, found) - (1 + new) * self.settings.min_score:
            self.kept.append(model)
            return model, problem
        again = replace(again, gained=model.gained + again.joint.gain - found.joint.gain)
        lasting = self.restated(again, self.problems_of(again))
        return self.fitter.refit(lasting, again, goes_on=True) or again, lasting

    def released_soon(self, model: FittedModel, last: Linearised) -> tuple[FittedModel, Linearised, list[str]]:
        """Return what `released` does, with the problem that goes on from there, and the names that are new."""
        now, problem = self.released(last.problem, model)
        return now, replace(last, problem=problem), [name for name in now.names if name not in model.names]

    def is_released(self, model: FittedModel) -> bool:
        """Tell whether the model has what a body shows that was let go."""
        return model.is_whole and is_let_go(model, self.observations)

    def problems_of(self, model: FittedModel) -> ProblemFactory:
        """Return what states the problems of a model: with an error that lasts once it has what a release shows."""
        if not self.is_released(model):
            return self.fitter.problems
        return replace(self.fitter.problems, one_load=True, lasts=True)

    def restated(self, model: FittedModel, problems: ProblemFactory) -> Problem:
        """State the problem at a model as it is, with what is allowed for taken there."""
        run = stack(self.fitter.forward.run(model.effects, self.observations, model.allowed_columns))
        return problems.at(model, run, [])[0]

    def _score_of(self, problem: Problem, model: FittedModel) -> float:
        """Score all effects of a fitted model together on left-out blocks."""
        assert model.joint is not None  # the caller's
        views, _ = self.screening.cross_validated(problem, model.joint, *(a.candidate for a in model.added))
        return views.score(self.screening.settings.mute)

    def _is_loud(self, problem: Problem, fit: Fit) -> bool:
        """Tell whether a fit leaves more than chance does, and by enough to pay for a better one."""
        return self.beyond_chance(problem, fit.residual) > self.settings.min_score

    def prune(self, problem: Problem, model: FittedModel) -> tuple[FittedModel, list[str]]:
        """Take out what effects added later have made needless, an effect that stood for two others, and what was
        discretisation error: nothing of it is left once that is worked out with it. Also tells what was taken out."""
        notes: list[str] = []
        while model.added and model.joint is not None:
            gain = model.joint.gain
            worth = [model.worth(i) for i in range(len(model.added))]
            i = int(np.argmin(worth))
            if worth[i] > self.settings.min_score:
                break
            name = model.names[i]
            without = replace(model, added=model.added[:i] + model.added[i + 1 :])
            if not without.added:
                if gain > self.settings.min_score:
                    break
                model = FittedModel(replace(model.uncertain, correction=self.mesh.declared))
                notes.append(f"{name} is discretisation error: nothing is left of it on a refined mesh")
                break
            self.tell(f"fitting without {name}", None)
            again = self.fitter.refit(problem, without)
            if again is None or again.joint is None or gain - again.joint.gain > self.least(again):
                break
            model = self.mesh.corrected(problem, again, self.settings.passes)
            notes.append(f"{name} is not needed given the others: taken out")
        return model, notes

    def without_lost(self, problem: Problem, model: FittedModel) -> tuple[FittedModel, Problem]:
        """Fit again without the moments that have no equilibrium with the effects. A fit keeps there what was left
        before, so that nothing is gained by it; but errors of place and registration tie that to other moments, and
        draw what is fitted towards nothing. Also returns the problem on the rows of the fit."""
        if model.joint is None:
            return model, problem
        points = stack(self.fitter.forward.run(model.effects, self.observations)).points
        lost = np.asarray(np.isnan(points).any(axis=(1, 2)))
        if not lost[problem.rows.moment].any():
            return model, problem
        self.tell("fitting without the moments that are lost", None)
        anew = self._anew(model)
        if anew is None:
            return model, problem
        again, restated = anew
        return self.mesh.corrected(restated, again, passes=1), restated

    def freed(self, problem: Problem, model: FittedModel) -> FittedModel:
        """Take the last step of the fit, with priors that hold nothing back (`unhindered`); where these change more
        than that, fit again."""
        if model.joint is None:
            return model
        most = self.screening.settings.doubt
        free = replace(model, added=tuple(Added(unhindered(a.candidate, a.z, most), a.z) for a in model.added))
        held = any(
            a.candidate.coordinates != b.candidate.coordinates for a, b in zip(model.added, free.added, strict=True)
        )
        ended = self._ended(problem, free, model)
        if ended is not None or not held:
            return ended or model
        self.tell("fitting with priors that hold nothing back", None)
        again = self.fitter.refit(problem, free, goes_on=True)
        if again is None or again.joint is None:
            return model
        if not again.joint.has_settled(model.joint):
            again = self.mesh.corrected(problem, again, passes=1)
        return self._ended(problem, again, again) or again

    def _ended(self, problem: Problem, model: FittedModel, held: FittedModel) -> FittedModel | None:
        """Return a model with the last step of its fit, which was by the priors of the model ``held``; None where that
        is too long."""
        assert model.joint is not None  # the callers'
        z = model.joint.z
        prior, before = (Prior.of([a.candidate for a in m.added], z) for m in (model, held))
        fit = self.fitter.method.last_step(model.joint, problem.marginal, prior, before)
        return None if fit is None else model.with_fit(fit)

    def settle(self, problem: Problem, model: FittedModel) -> tuple[FittedModel, Problem]:
        """Fit again with the derivatives of what is allowed for in each press anew taken where an added effect of its
        own kind has led: a probe that is deeper touches more. Also returns the problem on the rows of the fit."""
        own = {a.candidate.name for a in model.uncertain.always if a.per_press}
        if model.joint is None or not own & set(model.names):
            return model, problem
        for _ in range(self.settings.passes):
            if not self.budget.allows("fitting all together once more"):
                break
            self.tell("fitting all together", None)
            before, anew = model.joint, self._anew(model)
            if anew is None or before is None:
                break
            model, problem = anew
            if model.joint is None or model.joint.has_settled(before):
                break
            model = self.mesh.corrected(problem, model, passes=1)
        return model, problem

    def _anew(self, model: FittedModel) -> tuple[FittedModel, Problem] | None:
        """Fit again in the problem stated at the model as it is, and return that too; None where it cannot be solved
        there."""
        problem = self.restated(model, self.problems_of(model))
        again = self.fitter.refit(problem, model)
        return None if again is None or again.joint is None else (again, problem)

    def _is_too_small(self, r: Refined) -> bool:
        """Tell whether the least of it that the model can be solved with is far worse than nothing, and no way leads
        down from there: a strip that comes free is an element wide."""
        stuck = bool(np.array_equal(r.fit.z, r.fit.start))
        return stuck and r.fit.gain < -self.settings.behind and bool(r.candidate.kick.any())

    def _refine_all(
        self,
        problem: Problem,
        marginal: Marginal,
        starts: Sequence[FittedModel],
        max_runs: int | None = None,
        *,
        goes_on: bool = False,
    ) -> dict[str, Refined]:
        """Fit the last effect of each of the ``starts``, and keep the best fit of each candidate."""
        with ThreadPoolExecutor(max_workers=self.fitter.forward.processes) as threads:  # the model's workers are shared
            found = threads.map(
                lambda start: self._refine_one(problem, marginal, start, max_runs, goes_on=goes_on), starts
            )
            by_gain = sorted((r for r in found if r is not None), key=lambda r: r.fit.gain)
            return {r.candidate.name: r for r in by_gain}

    def _refine_one(
        self, problem: Problem, marginal: Marginal, start: FittedModel, max_runs: int | None, *, goes_on: bool
    ) -> Refined | None:
        """Fit the last effect of the model, and with it all others if the body swings with them."""
        *others, tried = start.added
        if not self.budget.allows(f"fitting {tried.candidate.name}"):
            return None
        together = replace(start, added=tuple(others)).rings
        free = range(0 if together else len(others), len(start.added))
        whole = self.fitter.fit(problem, marginal, start, free, max_runs, goes_on=goes_on)
        if whole is None:
            self.lost.append(tried.candidate.name)
            return None
        fit = whole.part(slice(len(whole.z) - len(tried.z), None))
        views, block_scores = self.screening.cross_validated(problem, fit, tried.candidate)
        score = views.score(self.screening.settings.mute)
        return Refined(tried.candidate, fit, block_scores, views, score, whole if together else None)


# --- small functions
# ------------------------------------------------------------------------------------------------------


def conditional_on(problem: Problem, model: FittedModel) -> Problem:
    """State the problem of finding one more effect, conditional on those in the model: they may change with it. What
    looks like them they have taken upon themselves."""
    if model.joint is None or len(model.joint.columns) != problem.rows.n:
        return problem
    names = [(a.candidate.name, c) for a in model.added for c in a.candidate.coordinates]
    sigma = np.array([c.sigma for _, c in names])
    own = Nuisance(model.joint.columns * sigma, tuple(f"{name}.{c.parameter}" for name, c in names))
    return replace(problem, nuisance=join([problem.nuisance, own]))


def with_columns(run: Run, last: Linearised, wanted: Sequence[ColumnKey], fresh: Sequence[ColumnKey]) -> Run:
    """Give the ``run``, which has the ``fresh`` columns, the ``wanted`` ones: the others as they were ``last``."""
    before = last.run
    place = {key: i for i, key in enumerate([*last.keys, *fresh])}  # the newest of each
    pick = [place[key] for key in wanted]
    d_forces = None
    if before.d_forces is not None and run.d_forces is not None:
        d_forces = np.concatenate([before.d_forces, run.d_forces], axis=-1)[..., pick]
    d_points = np.concatenate([before.d_points, run.d_points], axis=-1)[..., pick]
    return replace(run, d_points=d_points, d_forces=d_forces)


def _why(chosen: Refined, able: Sequence[Refined]) -> str:
    if all(chosen.views.together <= r.views.together for r in able):
        return "predicts unseen blocks best"
    return "the simplest of those that predict unseen blocks best"


def _keys(dictionary: Sequence[Column], allowed: Sequence[Column]) -> list[ColumnKey]:
    """Tell which column is which, of two runs; those of what is always allowed for are at other coordinates in each."""
    tried: list[ColumnKey] = [(c.candidate.name, c.coordinate, c.z) for c in dictionary]
    return tried + [(c.candidate.name, c.coordinate, None) for c in allowed]


def entries_of(candidates: Sequence[Candidate]) -> list[DictionaryEntry]:
    """List the dictionary's entries, in the order of `dictionary_columns`."""
    entries, at = [], 0
    for c in candidates:
        i = c.amplitudes
        sigma, lower, upper, stated = c.array("sigma")[i], c.array("lower")[i], c.array("upper")[i], c.stated[i]
        if not len(i):  # switched on as a whole: the column is the effect itself, at strength one
            sigma, lower, upper, stated = np.array([1.0]), np.array([0.0]), np.array([2.0]), np.array([np.inf])
        for s in range(len(c.shapes)):
            entries.append(DictionaryEntry(c.name, s, tuple(range(at, at + len(sigma))), sigma, lower, upper, stated))
            at += len(sigma)
    return entries


def start_of(candidate: Candidate, shape: int, theta: Array) -> Array:
    """Find where the nonlinear fit starts: the linear amplitudes, off the bounds at which an effect vanishes."""
    if not len(candidate.amplitudes):
        return np.array(candidate.shapes[shape])
    z = with_start(candidate, shape, theta)
    kick = candidate.kick
    low, high = np.minimum(0.5 * kick, 2.0 * kick), np.maximum(0.5 * kick, 2.0 * kick)
    return np.asarray(np.where(kick != 0.0, np.clip(z, low, high), z))
