"""Predict what was held out, and take the effects out again that it does not bear out (`assessment.earning`), or whose
own stated values may be nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from scipy.stats import chi2

from livedeform.closed_loop.assessment.earning import Earned, Earning, Predicted, taken_elsewhere, unconfirmed
from livedeform.closed_loop.assessment.held_out import in_common
from livedeform.closed_loop.diagnosis import stated_covariance
from livedeform.closed_loop.evidence.observation import are_untouched
from livedeform.closed_loop.forward import Column, ForwardModel, Run
from livedeform.closed_loop.inference.fitted_model import FittedModel
from livedeform.closed_loop.inference.forward_selection import ForwardSelection, Selection, SelectionStep
from livedeform.closed_loop.inference.problem import is_let_go
from livedeform.closed_loop.inputs import Inputs

MAY_BE_NOTHING = "may be nothing, by the values that are stated of it"


@dataclass(frozen=True)
class HeldOutRuns:
    """Predictions of what was held out: ``before`` by the declared model, ``after`` by the fitted ``model``, which has
    the Jacobian ``columns`` first and then those of what is always allowed for."""

    model: FittedModel
    before: list[Run]
    after: list[Run]
    columns: Sequence[Column]

    @classmethod
    def of(
        cls, forward: ForwardModel, inputs: Inputs, method: ForwardSelection, found: Selection, tried: Sequence[Column]
    ) -> HeldOutRuns:
        """Run both models, the declared one with the columns of the candidates that are ``tried``."""
        declared, model = FittedModel(inputs.uncertain), found.model
        before = forward.run([], inputs.held_out, [*tried, *declared.allowed_columns])
        if not model.added:
            return cls(model, before, before, tried)
        return cls(model, before, before, tried).by(method, inputs, model)

    @property
    def given(self) -> Predicted:
        """Return the fitted model's part."""
        return Predicted(self.model, self.after, self.columns)

    def rule(self, inputs: Inputs) -> Earning:
        """Return the rule by which this model and parts of it are judged."""
        one_load = is_let_go(self.model, inputs.held_out)
        untouched = are_untouched(inputs.held_out, inputs.fitted)
        return Earning(inputs.settings, inputs.held_out, inputs.registered, one_load, untouched)

    def by(self, method: ForwardSelection, inputs: Inputs, model: FittedModel) -> HeldOutRuns:
        """Run another fitted ``model`` instead."""
        columns, observations = model.columns, inputs.held_out
        after = method.fitter.forward.run(model.effects, observations, [*columns, *model.allowed_columns])
        return HeldOutRuns(method.mesh.extended(model, observations, after), *in_common(self.before, after), columns)

    def without_effects(self, inputs: Inputs) -> HeldOutRuns:
        """Return what is given where the effects are not the cause: the declared model before and after."""
        return replace(self, model=FittedModel(inputs.uncertain), after=self.before)


def borne_out(
    inputs: Inputs,
    method: ForwardSelection,
    found: Selection,
    tested: HeldOutRuns,
    declared_columns: Sequence[Column],
) -> tuple[Selection, HeldOutRuns, tuple[Earned, ...]]:
    """Take the effects out again that may be nothing (`more_than_nothing`) or do not earn themselves (`earning`)."""
    found, tested = more_than_nothing(inputs, method, found, tested)
    return earning(inputs, method, found, tested, declared_columns)


def earning(
    inputs: Inputs,
    method: ForwardSelection,
    found: Selection,
    tested: HeldOutRuns,
    declared_columns: Sequence[Column],
) -> tuple[Selection, HeldOutRuns, tuple[Earned, ...]]:
    """Take the effects out again, the least first, that do not earn themselves on what was held out (`Earning`), as
    long as others are left; tells all that do not. What seems so to first order is confirmed by a fit without the
    effect."""
    rule, settings = tested.rule(inputs), inputs.settings.verdict
    outs: list[Earned] = []
    kept: set[str] = set()
    while len(tested.model.added) > 1 and tested.model.joint is not None:
        judged = kept | rule.over(tested.given).keys()
        each = [e for e in each_alone(rule, method, tested) if e.name not in judged]
        poor = [e for e in each if not e.is_enough(settings, of_a_set=found.as_one)]
        if not poor:
            break
        least = min(poor, key=lambda e: e.called.fall)
        again = refitted_without(method, found, tested.model.names.index(least.name))
        if again is None:
            return found, tested, (*outs, least)
        without = tested.by(method, inputs, again)
        confirmed = rule.of(least.name, without.given, tested.given)
        if confirmed.is_enough(settings, of_a_set=found.as_one):
            kept.add(least.name)
            continue
        outs.append(confirmed)
        step = SelectionStep(found.steps[-1].screening, {}, "", confirmed.sentence(settings))
        found, tested = replace(found, model=again, steps=(*found.steps, step)), without
    over = rule.over(tested.given)
    confirmed_there = taken_elsewhere(found, over, settings)
    outs += [e for e in over.values() if e.name not in confirmed_there]
    if not over.keys() >= set(tested.model.names) and (len(tested.model.added) == 1 or found.as_one):
        declared = Predicted(FittedModel(inputs.uncertain), tested.before, declared_columns)
        whole = rule.of(" and ".join(tested.model.names), declared, tested.given)
        outs += [] if whole.is_enough(settings) else [whole]
    return found, tested, tuple(outs)


def more_than_nothing(
    inputs: Inputs, method: ForwardSelection, found: Selection, tested: HeldOutRuns
) -> tuple[Selection, HeldOutRuns]:
    """Take out the effects, the least first, whose stated values may be nothing, as long as others are left.

    What another effect gets wrong may look like one more, and so much the more the data tell: the fit's own covariance
    does not know of it, but presses disagree on the values.
    """
    while len(tested.model.added) > 1 and (names := may_be_nothing(inputs, found, tested.model)):
        again = refitted_without(method, found, tested.model.names.index(names[0]))
        if again is None:
            break
        step = SelectionStep(found.steps[-1].screening, {}, "", f"{names[0]} {MAY_BE_NOTHING}: taken out")
        found = replace(found, model=again, steps=(*found.steps, step))
        tested = tested.by(method, inputs, again)
    return found, tested


def may_be_nothing(inputs: Inputs, found: Selection, model: FittedModel) -> list[str]:
    """Name the effects of a model, the least first, whose values may all be those of no effect: by what is stated of
    them these are no less likely than chance may make a step of the selection. What a release shows together is judged
    together."""
    covariance = stated_covariance(model, found.problem, inputs.fitted, inputs.settings, inputs.element_size)
    if covariance is None or found.as_one:
        return []
    worth = {}
    for number, a in enumerate(model.added):
        limit = float(chi2.isf(inputs.settings.selection.alpha, max(len(a.candidate.amplitudes), 1)))
        worth[a.candidate.name] = model.worth(number, covariance) / limit
    return sorted((name for name, w in worth.items() if w < 1.0), key=lambda name: worth[name])


def doubted(inputs: Inputs, found: Selection, model: FittedModel, outs: Sequence[Earned]) -> str:
    """Say why held-out data, of which ``outs`` have not earned themselves, or the stated values do not confirm a model,
    and what went out before; empty if they do."""
    nothing = [f"{name} {MAY_BE_NOTHING}" for name in may_be_nothing(inputs, found, model)]
    said = [*filter(None, [unconfirmed(model, outs, inputs.settings)]), *nothing]
    gone = [step.reason for step in found.steps if MAY_BE_NOTHING in step.reason]
    return "; ".join([*gone, *said]) if said else ""


def each_alone(rule: Earning, method: ForwardSelection, tested: HeldOutRuns) -> list[Earned]:
    """Tell what each effect of a model earns, the others following it to first order; of one that is switched on as a
    whole, by a run without it, the others as they are."""
    out, model = [], tested.model
    for number, a in enumerate(model.added):
        if len(a.candidate.amplitudes):
            out.append(rule.of_part(number, tested.given))
            continue
        others = replace(model, added=model.added[:number] + model.added[number + 1 :], joint=None)
        runs = method.fitter.forward.run(others.effects, rule.observations, others.allowed_columns)
        out.append(rule.of(a.candidate.name, Predicted(others, runs, []), tested.given))
    return out


def refitted_without(method: ForwardSelection, found: Selection, number: int) -> FittedModel | None:
    """Fit the effects without the one of that ``number``; None if there is no time, or it cannot be solved."""
    model, name = found.model, found.model.names[number]
    if found.problem is None or not method.budget.allows(f"fitting without {name}"):
        return None
    method.tell(f"fitting without {name}", None)
    left = replace(model, added=model.added[:number] + model.added[number + 1 :])
    again = method.fitter.refit(found.problem, left)
    if again is None or again.joint is None:
        return None
    worse = 0.0 if model.joint is None else max(model.joint.gain - again.joint.gain, 0.0)
    again = replace(again, gained=max(model.gained - worse, 0.0))
    return method.mesh.corrected(found.problem, again, passes=1)
