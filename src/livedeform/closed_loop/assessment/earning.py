"""Judge what each added effect earns by itself on recordings that were not fitted: beyond chance, and by a share
that matters.

Effects are judged together by `verdict.judge`; one that is needless, or that stands for what the elements get wrong,
can hide behind another. So each is left out of the model in turn, the others following as their joint fit lets them
(`left_out`; to first order, and for an effect that is switched on as a whole by a run), and what that does to the
held-out recordings is what the effect earns there (`Earning`). An effect stays if

- it takes more off their chi2 than chance does (``VerdictSettings.against``), and
- it takes a part off the mean square of their error that would matter if it were left (``VerdictSettings.min_excess``
  of the noise of a single frame), even if they called for a standard error less of it (`called_for`); or off that of
  the force, more than what is allowed for there. In each direction the noise is its own: two cameras see depth several
  times worse than what goes sideways, and in millimetres depth would drown it. But in millimetres the error must not
  rise.

Effects that a release shows together (`Selection.as_one`) contradict each other one by one: without the one, the others
follow to where the level is right and the swing is wrong. There each has to beat chance, and all together to take off
the part that matters.

What happens once, as a motion of the cameras, is over where cameras were registered later, and what grows with the
temperature is nowhere in a recording at the reference: such held-out data have no say in it (`Earning.over`). It is
judged by what it takes off the blocks and markers that were left out where it was fitted, if nothing is loud there
beside it.

The error in millimetres is that of the means over windows, in which little of the noise is left; the part is the same
as of single frames.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from livedeform.closed_loop.assessment.called_for import Called, called_for, moved_in_noise, scatter
from livedeform.closed_loop.assessment.held_out import HeldOutErrors, errors_of, in_common, noise_floor
from livedeform.closed_loop.evidence.noise import Nuisance, join
from livedeform.closed_loop.evidence.observation import Observation, are_pressed
from livedeform.closed_loop.forward import Column, Run, stack
from livedeform.closed_loop.inference.fitted_model import FittedModel
from livedeform.closed_loop.inference.forward_selection import Selection
from livedeform.closed_loop.inference.gauss_newton import Problem, bounded_minimum
from livedeform.closed_loop.inference.problem import ProblemFactory
from livedeform.closed_loop.settings import Settings, VerdictSettings
from livedeform.common.types import Array

NOTHING = 1e-9  # m, or N: less is round-off
TINY_VARIANCE = 1e-18  # keeps a covariance with a coordinate on its bound positive definite


@dataclass(frozen=True)
class Fall:
    """Says by how much a mean square falls: ``value``, its standard error ``sigma``, and ``of``, what a fall is
    compared with (each m2, or N2)."""

    value: float
    sigma: float
    of: float

    def matters(self, share: float) -> bool:
        """Tell whether it is more than that ``share``, and remains so if it is a standard error less."""
        return self.value - self.sigma > share * self.of

    def rises(self) -> bool:
        """Tell whether it rises instead, by more than a standard error."""
        return self.value < -self.sigma


@dataclass(frozen=True)
class Earned:
    """Says what the effect ``name`` earns on held-out data: the chi2 that it has ``taken`` off, how much of it the
    markers have ``called`` for, and the fall of their mean square ``in_metres`` and of the ``force``'s (None: not
    measured); ``before`` and ``after`` m: the markers' rms error without and with it. ``over``: it did not happen
    there."""

    name: str
    taken: float
    called: Called
    in_metres: Fall
    force: Fall | None
    before: float
    after: float
    over: bool = False

    def is_enough(self, settings: VerdictSettings, *, of_a_set: bool = False) -> bool:
        """Tell whether it stays in the model; an effect ``of_a_set`` that earns itself together has to beat chance."""
        if of_a_set:
            return self.taken > settings.against
        forceful = self.force is not None and self.force.matters(1.0)
        seen = self.called.matters(settings.min_excess**2) and not self.in_metres.rises()
        return self.taken > settings.against and (seen or forceful)

    def is_mute(self, settings: VerdictSettings) -> bool:
        """Tell whether the data say neither that it is there nor that it is not: it changes nothing that matters."""
        return abs(self.taken) <= settings.against and self.called.moved <= settings.min_excess**2

    def sentence(self, settings: VerdictSettings) -> str:
        """Say why it does not."""
        if self.over:
            return f"{self.name} did not happen in what was held out, and too much is left where it was fitted"
        called = self.called
        if not np.isfinite(called.sigma):
            return (
                f"{self.name} explained something where it was fitted, but held-out data say nothing of it: taken out"
            )
        return (
            f"{self.name} explained something where it was fitted, but on held-out data it takes {self.taken:.1f} off "
            f"chi2: they call for {called.share:.2f} +- {called.sigma:.2f} of it, and all of it moves the markers by "
            f"{np.sqrt(called.moved):.2f} of their noise, where {settings.min_excess:.1f} matters; the error goes from "
            f"{1e3 * self.before:.4f} to {1e3 * self.after:.4f} mm: taken out"
        )


@dataclass(frozen=True)
class Predicted:
    """A ``model`` and its ``runs`` of what was held out, with its own Jacobian ``columns`` first, or those that were
    tried of a model without effects, and then `FittedModel.allowed_columns`."""

    model: FittedModel
    runs: Sequence[Run]
    columns: Sequence[Column]


@dataclass(frozen=True)
class Earning:
    """The rule, on the held-out ``observations``; see the module's text. ``one_load``: a recording is one load from its
    beginning to its end, with one error of the model that lasts (`ProblemFactory`), as what was let go is.
    ``untouched``: nothing is pressed in them (`are_untouched`)."""

    settings: Settings
    observations: Sequence[Observation]
    registered: bool
    one_load: bool = False
    untouched: bool = False

    def of(self, name: str, without: Predicted, having: Predicted) -> Earned:
        """Tell what the effect ``name`` earns, by runs of a model without it and of one with it."""
        one, two = in_common(without.runs, having.runs)
        without, having = replace(without, runs=one), replace(having, runs=two)
        problem, other = self.problem(without), self.problem(having)
        return self._earned(name, without.runs, having, problem, other.residual)

    def of_part(self, number: int, having: Predicted) -> Earned:
        """Tell what the effect ``number`` of a model earns, to first order: its amplitudes go to zero, and the other
        effects to where their joint fit then has its optimum."""
        free, change, covariance = left_out(having.model, number)
        problem, J = self._linear(having)
        return self._by_change(_allowing(problem, J[:, free], covariance), J @ change, change, number, having)

    def over(self, having: Predicted) -> dict[str, Earned]:
        """Return, by name, the effects of a model that are not in what was held out, which has no say in them then.

        They happened once, before cameras were registered for it, and without them, the others as they are, nothing
        changes there; or they move nothing there at all, as warmth where it was never warm. What a press shows is no
        such effect where the held-out body is ``untouched``, nor are the probe's and the support's own ever: these
        last, and held-out data that do not show them do not confirm them.
        """
        model, joint = having.model, having.model.joint
        if joint is None:
            return {}
        infos = [a.candidate.info for a in model.added]
        away = [
            number
            for number, info in enumerate(infos)
            if (info.once and self.registered)
            or (not (self.untouched or info.lasts) and _moves_nothing(having, number, joint.z))
        ]
        if not away:
            return {}
        problem, J = self._linear(having)
        changes = {number: np.where(amplitudes_of(model, number), -joint.z, 0.0) for number in away}
        each = [self._by_change(problem, J @ change, change, number, having) for number, change in changes.items()]
        return {e.name: replace(e, over=True) for e in each if e.is_mute(self.settings.verdict)}

    def amount(self, before: Problem, after: Problem) -> Called:
        """Tell for how much of what a model's effects move together the data call, by what is left ``before`` them and
        ``after`` them; what their fit leaves uncertain is allowed for in the latter."""
        pressed = are_pressed(self.observations)
        return called_for(after, before.residual, after.residual, pressed=pressed)

    def _by_change(self, problem: Problem, moved: Array, change: Array, number: int, having: Predicted) -> Earned:
        """Tell what an effect earns by the ``change`` (p,) of a model's coordinates that leaves it out, which has
        ``moved`` (n,) m the rows of the ``problem``."""
        without = [_changed(run, change) for run in having.runs]
        left = replace(problem, residual=problem.residual - moved)
        return self._earned(having.model.names[number], without, having, left, problem.residual)

    def problem(self, predicted: Predicted) -> Problem:
        """Form the linear problem of a model's runs, with its fit's own uncertainty allowed for."""
        problem, J = self._linear(predicted)
        joint = predicted.model.joint
        return problem if joint is None else _allowing(problem, J, joint.covariance)

    def _linear(self, predicted: Predicted) -> tuple[Problem, Array]:
        factory = ProblemFactory(
            self.observations, self.settings.allowance, one_load=self.one_load, lasts=self.one_load
        )
        return factory.at(predicted.model, stack(predicted.runs), predicted.columns)

    def _earned(self, name: str, without: Sequence[Run], having: Predicted, problem: Problem, after: Array) -> Earned:
        """Tell what an effect earns by the runs of a model ``without`` it and the ``problem`` that is left of these,
        and by the runs of one ``having`` it and what is left (n,) ``after`` it."""
        means = [replace(o, single=o.points) for o in self.observations]
        runs, registered = (without, having.runs), self.registered
        errors = [errors_of(means, r, registered=registered) for r in runs]
        single = [errors_of(self.observations, r, registered=registered) for r in runs]
        pressed, allowed = are_pressed(self.observations), having.model.uncertain.errors.force_relative
        moved = moved_in_noise(*errors) / min(1.0, *(e.chi2() for e in single))
        return Earned(
            name,
            taken=problem.chi2 - replace(problem, residual=after).chi2,
            called=called_for(problem, problem.residual, after, moved, pressed=pressed),
            in_metres=fall(errors[0], errors[1], noise_floor(*single) ** 2, pressed=pressed),
            force=force_fall(self.observations, without, having.runs, allowed),
            before=single[0].metrics().rmse,
            after=single[1].metrics().rmse,
        )


@dataclass(frozen=True)
class Elsewhere:
    """Says what an effect that is over does where it was fitted: what it has ``taken`` off what was left out there when
    it was added (twice the log evidence), and by how much it ``moved`` the markers, m rms."""

    taken: float
    moved: float


def taken_elsewhere(found: Selection, over: Collection[str], settings: VerdictSettings) -> dict[str, Elsewhere]:
    """Return what effects that are ``over`` do where they were fitted, by name; nothing if something loud is left
    there."""
    joint, problem, names = found.model.joint, found.problem, found.model.names
    if joint is None or problem is None or not problem.left(joint) <= settings.usual_chi2[1]:
        return {}
    out, seen = {}, problem.rows.marker >= 0
    for step in found.steps:
        if step.added in over and step.added in step.refined and step.added in names:
            own = amplitudes_of(found.model, names.index(step.added))
            moved = np.sqrt(3.0 * np.mean((joint.columns[seen][:, own] @ joint.z[own]) ** 2))
            out[step.added] = Elsewhere(-step.refined[step.added].score, float(moved))
    return out


def unconfirmed(model: FittedModel, outs: Sequence[Earned], settings: Settings) -> str:
    """Say why held-out data do not confirm a model, of whose effects, or of those that it had, ``outs`` have not earned
    themselves; empty if all that are left in it have."""
    if not {e.name for e in outs} & {*model.names, " and ".join(model.names)}:
        return ""
    return "; ".join(e.sentence(settings.verdict) for e in outs)


def fall(without: HeldOutErrors, having: HeldOutErrors, of: float, *, pressed: bool = True) -> Fall:
    """Find the fall of the markers' mean square (m2), to be compared with ``of``, and weighted with the time that each
    moment stands for; its standard error is counted over blocks of time and over markers: frames of one press are not
    independent, nor are those of a marker. What is let go instead of ``pressed`` shows itself in one stretch of time,
    and is counted over markers alone."""
    before, after = (e.size**2 for e in (without, having))
    seen = np.isfinite(before) & np.isfinite(after)
    weight = np.where(seen, without.weight, 0.0)
    fell = np.where(seen, np.nan_to_num(before) - np.nan_to_num(after), 0.0)
    total = max(float(weight.sum()), 1e-12)
    value = float((weight * fell).sum()) / total
    beyond = weight * (fell - value) / total
    blocks = np.array([beyond[without.blocks == b].sum() for b in np.unique(without.blocks)])
    by_press = scatter(blocks) if pressed else 0.0
    return Fall(value, float(np.hypot(by_press, scatter(beyond.sum(axis=0)))), of)


def force_fall(
    observations: Sequence[Observation], without: Sequence[Run], having: Sequence[Run], allowed: float
) -> Fall | None:
    """Find the fall of the force's mean square, compared with its noise and ``allowed`` of it for the elements, in the
    recordings that have one; None where none has."""
    sums, of = [], []
    for o, a, b in zip(observations, without, having, strict=True):
        if o.forces is None or a.forces is None or b.forces is None:
            continue
        fell = np.sum((o.forces - a.forces) ** 2 - (o.forces - b.forces) ** 2, axis=1)
        noise = 3.0 * o.force_sigma**2 + allowed**2 * np.sum(b.forces**2, axis=1)
        seen = np.isfinite(fell)
        for block in np.unique(o.blocks):
            here = seen & (o.blocks == block)
            sums.append(np.sum(o.weights[here] * fell[here]))
            of.append([np.sum(o.weights[here] * noise[here]), np.sum(o.weights[here])])
    limit, weight = np.sum(of, axis=0) if of else (0.0, 0.0)
    if weight == 0.0:
        return None
    value = float(np.sum(sums) / weight)
    spread = scatter((np.array(sums) - value * np.array(of)[:, 1]) / weight)
    return Fall(value, spread, float(limit / weight))


def amplitudes_of(model: FittedModel, number: int) -> np.ndarray:
    """Return which of a model's coordinates (p,) switch its effect of that ``number`` off at zero."""
    parts = [np.zeros(len(a.z), bool) for a in model.added]
    parts[number][model.added[number].candidate.amplitudes] = True
    return np.concatenate(parts)


def _moves_nothing(having: Predicted, number: int, z: Array) -> bool:
    """Tell whether the effect of that ``number`` of a model at the coordinates ``z`` (p,) has amplitudes, and moves and
    presses nothing in its runs."""
    own = np.flatnonzero(amplitudes_of(having.model, number))
    columns = [d[..., own] for run in having.runs for d in (run.d_points, run.d_forces) if d is not None]
    return bool(len(own)) and not any((np.abs(np.nan_to_num(d) @ z[own]) > NOTHING).any() for d in columns)


def left_out(model: FittedModel, number: int) -> tuple[np.ndarray, Array, Array]:
    """Leave out the effect of that ``number``: find which other coordinates (q,) are at no bound then, the change (p,)
    of all coordinates that leaves it out, to first order and within the bounds of the others, and the covariance (q, q)
    of those that are free; of an effect without an amplitude none is known.

    Without the bounds what data hardly tell is moved out of all sense: a power law's strength below zero, and the time
    that a beam was held to ages. (One that the joint fit has at a bound already is taken for a minimum there.)
    """
    assert model.joint is not None  # the caller's
    mine = np.concatenate([np.full(len(a.z), i == number) for i, a in enumerate(model.added)])
    i = np.flatnonzero(amplitudes_of(model, number))
    others, z = np.flatnonzero(~mine), model.joint.z
    A = np.asarray(np.linalg.inv(model.joint.covariance), float)
    low, high = (np.concatenate([a.candidate.array(side) for a in model.added]) - z for side in ("lower", "upper"))
    change = np.zeros(len(mine))
    change[i] = -z[i]
    pull = -A[np.ix_(others, i)] @ change[i]
    change[others] = bounded_minimum(A[np.ix_(others, others)], pull, low[others], high[others])
    free = others[(change > low)[others] & (change < high)[others]]
    return free, change, np.linalg.inv(A[np.ix_(free, free)])


def _allowing(problem: Problem, J: Array, covariance: Array) -> Problem:
    """Allow for what a fit leaves uncertain: the ``covariance`` (p, p) of coordinates with Jacobian columns ``J`` (n,
    p)."""
    spread = np.linalg.cholesky(covariance + TINY_VARIANCE * np.eye(len(covariance)))
    own = Nuisance(J @ spread, tuple(f"fit[{i}]" for i in range(len(covariance))))
    return replace(problem, nuisance=join([problem.nuisance, own]))


def _changed(run: Run, change: Array) -> Run:
    """Move a run along its first columns by a ``change`` (p,) of their coordinates."""
    p = len(change)
    forces = run.forces
    if forces is not None and run.d_forces is not None:
        forces = forces + np.nan_to_num(run.d_forces[..., :p]) @ change
    return replace(run, points=run.points + np.nan_to_num(run.d_points[..., :p]) @ change, forces=forces)
