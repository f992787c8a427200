"""All candidates of the first step in order: how each predicts what was held out, and which cannot be told apart.

An effect that was added later has as its rivals those that the data could not tell from it then, beside the effects
that were in the model already: before, both had explained a part of the same larger one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from livedeform.closed_loop.assessment.held_out import errors_of
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Run, dictionary_columns
from livedeform.closed_loop.inference.forward_selection import Refined, Selection, SelectionStep, entries_of
from livedeform.closed_loop.inference.screening import Score, indistinguishable, leader
from livedeform.closed_loop.settings import Settings
from livedeform.common.types import Array


@dataclass(frozen=True)
class Ranked:
    """A candidate of the first step: ``test_rmse`` m on held-out data, ``score`` (minus twice log predictive density
    against the declared model), ``score_gap`` to the best, and those that the data cannot tell from it, if it and they
    gain anything: in that step, or where it was added. ``refined``: through the nonlinear model, not by its
    linearisation only."""

    name: str
    test_rmse: float
    score: float
    score_gap: float
    indistinguishable_from: tuple[str, ...]
    gain: float
    p_value: float
    refined: bool


def tried_in(step: SelectionStep) -> dict[str, Score | Refined]:
    """Return all candidates of a step by name: through the nonlinear model, or by their linearisation."""
    return {**{s.name: s for s in step.screening.scores}, **step.refined}


@dataclass(frozen=True)
class Ranking:
    """The method: ranks the candidates of a ``selection``. Where the cameras were ``registered`` to the declared model,
    errors are taken after a registration to each prediction."""

    settings: Settings
    selection: Selection
    registered: bool

    @property
    def linear(self) -> list[Score]:
        """Candidates that held-out data are predicted for by their Jacobian columns: not one that was added alone,
        which is run itself, nor those that gain nothing and so change nothing."""
        scores = self.selection.steps[0].screening.scores
        least = self.settings.verdict.gains_nothing
        return [s for s in scores if s.gain > least and not self.selection.is_alone(s.name)]

    @property
    def columns(self) -> list[Column]:
        """Jacobian columns of the best shape of each candidate that is predicted by them."""
        out = []
        for s in self.linear:
            candidate = self.selection.candidates[s.name]
            out += dictionary_columns([replace(candidate, shapes=candidate.shapes[s.shape : s.shape + 1])])
        return out

    def __call__(
        self, held_out: Sequence[Observation], before: Sequence[Run], after: Sequence[Run]
    ) -> tuple[Ranked, ...]:
        """Rank all candidates of the first step, best first; the runs ``before`` have the `columns`, those ``after``
        are of the fitted model."""
        step = self.selection.steps[0]
        found = tried_in(step)
        if not found:
            return ()
        views = {name: one.views for name, one in found.items()}
        groups = self._alike(step, self._left(found))
        best = leader(views)
        gaps = {name: views[name].behind(views[best]) for name in views}
        scores = {name: found[best].score + gap for name, gap in gaps.items()}
        predicted, idle = self._predicted(before, after), self._idle(scores, gaps, best)
        out = []
        for name in sorted(gaps, key=lambda n: gaps[n]):
            rmse = errors_of(held_out, predicted.get(name, before), registered=self.registered).metrics().rmse
            score = step.screening[name]
            alike = () if name in idle else tuple(n for n in groups[name] if n not in idle)
            known = name in step.refined
            out.append(Ranked(name, rmse, scores[name], gaps[name], alike, score.gain, score.p_value, known))
        return self.with_later(out)

    def _alike(self, step: SelectionStep, left: Mapping[str, Array] | None = None) -> dict[str, tuple[str, ...]]:
        """List for each candidate of a step those that the data cannot tell from it; see `indistinguishable`."""
        views = {name: one.views for name, one in tried_in(step).items()}
        gain = max(s.gain for s in step.screening.scores)
        return indistinguishable(views, gain, self.settings.screening, left)

    def with_later(self, ranked: Sequence[Ranked]) -> tuple[Ranked, ...]:
        """Return the candidates of the first step with the rivals of what was added later, by the step in which it
        was: of what was not compared there, as a set that was fitted together, none are known."""
        alike = {r.name: r.indistinguishable_from for r in ranked}
        for step in self.selection.steps[1:]:
            if step.added not in self.selection.model.names:
                continue
            rivals = self._rivals_in(step)
            for name, others in alike.items():
                alike[name] = tuple(n for n in others if n != step.added) + (step.added,) * (name in rivals)
            alike[step.added] = rivals
        return tuple(replace(r, indistinguishable_from=alike[r.name]) for r in ranked)

    def _rivals_in(self, step: SelectionStep) -> tuple[str, ...]:
        """Return those that the data cannot tell from the effect that was added in a later ``step``."""
        if step.added not in step.refined:
            return ()
        found, least = tried_in(step), -self.settings.selection.min_score
        return tuple(name for name in self._alike(step)[step.added] if found[name].score <= least)

    def _idle(self, scores: Mapping[str, float], gaps: Mapping[str, float], best: str) -> set[str]:
        """Name those that gain nothing: what cannot be told from the declared model is no rival of what explains more
        than that, and where nothing does, of nothing."""
        least, gap = self.settings.selection.min_score, self.settings.screening.min_gap
        told = [name for name in gaps if gaps[name] >= gap or scores[best] > -least]
        return {name for name in told if scores[name] > -least}

    def _left(self, found: Mapping[str, Score | Refined]) -> dict[str, Array]:
        """Return what each candidate's fit leaves of what was fitted, whitened."""
        first = self.selection.first
        if first is None:
            return {}
        entries = {(e.name, e.shape): list(e.columns) for e in entries_of(list(self.selection.candidates.values()))}
        marginal, out = first.problem.marginal, {}
        for name, one in found.items():
            if isinstance(one, Refined):
                residual = one.fit.residual
            else:
                residual = first.problem.residual - first.dictionary[:, entries[name, one.shape]] @ one.fit.theta
            if residual.shape == first.problem.residual.shape:
                out[name] = marginal(residual)
        return out

    def _predicted(self, before: Sequence[Run], after: Sequence[Run]) -> dict[str, Sequence[Run]]:
        """Predict what was held out with each candidate: by its linearisation, save the one that was added alone."""
        out: dict[str, Sequence[Run]] = {n: after for n in self.selection.model.names if self.selection.is_alone(n)}
        ends = np.cumsum([len(s.fit.theta) for s in self.linear])
        for s, end in zip(self.linear, ends, strict=True):
            theta = s.fit.theta
            pick = list(range(end - len(theta), end))
            # where its own run was lost it does nothing, as in screening: all are told of the same moments
            moved = [r.points + np.nan_to_num(r.d_points[..., pick]) @ theta for r in before]
            out[s.name] = [Run(p, r.forces, r.d_points[..., :0], None) for p, r in zip(moved, before, strict=True)]
        return out
