"""Find what would decide where recordings cannot tell: repeats, smaller elements, or another motion of the probe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from livedeform.closed_loop.assessment.detectable import Power
from livedeform.closed_loop.assessment.next_experiment import ProbeReach, feasible, planned
from livedeform.closed_loop.candidates import Candidate
from livedeform.closed_loop.forward import ForwardModel, dictionary_columns
from livedeform.closed_loop.inference.fitted_model import FittedModel, Uncertain
from livedeform.closed_loop.inference.forward_selection import Selection
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.inference.problem import ProblemFactory
from livedeform.closed_loop.settings import Settings
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array


@dataclass(frozen=True)
class Deciding:
    """The method: predicts what could be seen of the ``hidden`` candidates, whose sizes of ``matters`` m rms count, of
    the recordings of a ``selection``, if these were other ones."""

    settings: Settings
    forward: ForwardModel
    reach: ProbeReach
    selection: Selection
    hidden: Sequence[str]
    matters: float

    def advice(self) -> str:
        """Say the least that would decide, in one sentence; another motion of the probe, all of which have to be
        solved, only where more or finer of the same would not."""
        out = [text for text in (self._repeats(), self._elements()) if text]
        left = {} if out else self._hidden_after()
        best = min(left, key=lambda t: left[t], default="")
        if best and left[best] < len(self.hidden):
            shows = "all of them" if not left[best] else f"{len(self.hidden) - left[best]} of {len(self.hidden)}"
            out = [f"another motion of the probe ({best}: shows {shows})"]
        if out:
            return "What would decide: " + ", or ".join(out) + "."
        tried = self.settings.proposal
        repeats, elements = f"{tried.repeats[-1]} repeats", f"elements {tried.finer[-1]:g} times as large"
        if not left:
            return f"Neither {repeats} nor {elements} would do."
        return f"Neither {repeats}, {elements} nor another motion of the probe would do."

    @property
    def candidates(self) -> list[Candidate]:
        """The hidden candidates, each of which is judged by itself: another one's columns would be for nothing."""
        return [c for name, c in self.selection.candidates.items() if name in self.hidden]

    def _hidden_with(self, repeats: int, finer: float) -> int:
        """Count what would still be hidden with so many repeats, and with elements so much smaller."""
        model, first = FittedModel(self.selection.model.uncertain), self.selection.first
        assert first is not None  # the caller's: there are hidden candidates
        observations = [replace(o, covariances=o.covariances / repeats) for o in self.selection.observations]
        model = replace(model, uncertain=with_finer_elements(model.uncertain, finer))
        every = dictionary_columns(list(self.selection.candidates.values()))  # as the run has them
        problem, J = ProblemFactory(observations, self.settings.allowance).at(model, first.run, every)
        J = J[:, [c.candidate.name in self.hidden for c in every]]
        return self._count(problem, J)

    def _count(self, problem: Problem, columns: Array) -> int:
        """Count what is hidden in a linear problem with the hidden candidates' ``columns`` (n, P), where all candidates
        would be looked for."""
        found = Power(self.settings)(problem, columns, self.candidates, len(self.selection.candidates))
        return sum(found[name].is_hidden(self.matters) for name in self.hidden)

    def _repeats(self) -> str:
        enough = next((n for n in self.settings.proposal.repeats if not self._hidden_with(n, 1.0)), None)
        return f"{enough} times as many recordings of this kind" if enough else ""

    def _elements(self) -> str:
        enough = next((x for x in self.settings.proposal.finer if not self._hidden_with(1, x)), None)
        return f"elements {enough:g} times as large (element_size)" if enough else ""

    def _hidden_after(self) -> dict[str, int]:
        """Count what would still be hidden after each other motion of the probe that can be predicted to its end, by
        the motion's text."""
        if self.reach.top is None:
            return {}
        left: dict[str, int] = {}
        trajectories = feasible(self.reach, self.reach.top, self.settings.proposal)
        plans = [planned(t, self.selection.observations, self.settings.proposal) for t in trajectories]
        model, columns = FittedModel(self.selection.model.uncertain), dictionary_columns(self.candidates)
        runs = self.forward.run([], plans, [*columns, *model.allowed_columns])
        for trajectory, plan, run in zip(trajectories, plans, runs, strict=True):
            if not run.whole:
                continue
            try:
                problem, J = ProblemFactory([plan], self.settings.allowance).at(model, run, columns)
            except ConvergenceError:
                continue
            left[trajectory.text] = self._count(problem, J)
        return left


def with_finer_elements(uncertain: Uncertain, finer: float) -> Uncertain:
    """Return what stays uncertain with elements ``finer`` times as large: their errors go with their size."""
    e = uncertain.errors
    errors = replace(
        e,
        relative=finer * e.relative,
        absolute=finer * e.absolute,
        force_relative=finer * e.force_relative,
        local=None if e.local is None else finer * np.asarray(e.local),
    )
    always = tuple(replace(a, sigma=finer * a.sigma) if a.per_press else a for a in uncertain.always)
    return replace(uncertain, errors=errors, always=always)
