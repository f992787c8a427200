"""Fits of effects through the nonlinear model, and what the refined mesh tells of the model with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Correction, ForwardModel, RefinedMesh, Run, stack
from livedeform.closed_loop.inference.fitted_model import Added, FittedModel, columns_of
from livedeform.closed_loop.inference.gauss_newton import Fit, GaussNewton, Marginal, Prior, Problem
from livedeform.closed_loop.inference.problem import ProblemFactory
from livedeform.closed_loop.progress import Tell, silent
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array

SEEN = 1e-5  # m, rms by which a step moves points that says more of columns than the path of a probe that rubs is exact


class Secants:
    """Columns that are only about right, corrected by what the runs of one fit tell: with these in J, and a step s of
    the coordinates (in units of ``sigma`` (p,)) that changed the prediction by d,

        J <- J + (d - J s) s^T / (s^T s)    (Broyden 1965).
    """

    def __init__(self, sigma: Array) -> None:
        self._sigma = sigma
        self._last: tuple[Array, Array] | None = None
        self._lacking: Array | float = 0.0

    def corrected(self, z: Array, residual: Array, columns: Array, points: NDArray[np.bool_]) -> Array:
        """Return the ``columns`` (n, p) at ``z`` (p,), where the model leaves ``residual`` (n,), as the runs before
        have them; ``points`` (n,): the rows that are coordinates of points, in m."""
        J = columns * self._sigma + self._lacking
        if self._last is not None:
            s = (z - self._last[0]) / self._sigma
            d = self._last[1] - residual
            if np.any(points) and np.sqrt(np.mean(d[points] ** 2)) > SEEN:
                wrong = np.outer(d - J @ s, s) / float(s @ s)
                self._lacking, J = self._lacking + wrong, J + wrong
        self._last = z.copy(), residual
        return np.asarray(J / self._sigma)


@dataclass(frozen=True)
class EffectFitter:
    """Fits effects to the recordings of the ``problems`` by ``method``."""

    forward: ForwardModel
    problems: ProblemFactory
    method: GaussNewton

    def fit(
        self,
        problem: Problem,
        marginal: Marginal,
        model: FittedModel,
        free: Sequence[int],
        max_runs: int | None = None,
        *,
        goes_on: bool = False,
    ) -> Fit | None:
        """Find the MAP of the coordinates of the model's effects number ``free``; None if it cannot be solved there,
        nor where the effects are smaller: a start is a guess to first order, and may lie beyond what the body bears.

        A body that rings is fitted roughly first: a frequency that is off by a few per cent is out of phase after some
        swings, and as exactly as a camera sees it, hardly a step betters all swings at once; the fit would end at a
        body that is damped too much. A fit that ``goes_on`` was there already, and so were those of a model that is
        `in_step`.
        """
        chosen = [model.added[i] for i in free]
        start = np.concatenate([a.z for a in chosen])
        runs = max_runs or self.method.settings.runs + len(start)
        rough_first = model.rings and not (goes_on or model.in_step)
        for at in self._starts(chosen, start):
            try:
                return self._from(at, Tried.of(self, problem, model, free), marginal, runs, rough_first)
            except ConvergenceError:
                continue
        return None

    def _starts(self, chosen: Sequence[Added], start: Array) -> list[Array]:
        """Return ``start`` (p,), and it with the sizes of all that was ``chosen`` shortened as steps are."""
        sizes = np.concatenate([np.isin(np.arange(len(a.z)), a.candidate.amplitudes) for a in chosen])
        shares = self.method.settings.lengths[1:] if sizes.any() else ()
        return [start, *(np.where(sizes, share * start, start) for share in shares)]

    def _from(self, start: Array, tried: Tried, marginal: Marginal, runs: int, rough_first: bool) -> Fit:
        """Fit from ``start`` (p,). Raises ``ConvergenceError`` where the model is lost there."""
        candidates, problem = [tried.model.added[i].candidate for i in tried.free], tried.problem
        if rough_first:
            start = self._roughly(tried, problem, Prior.of(candidates, start), start)
        c0 = float(np.sum(marginal(problem.residual) ** 2))
        glance = tried.glance if tried.model.rings else None
        return self.method(tried, marginal, start, Prior.of(candidates, start), c0=c0, max_runs=runs, glance=glance)

    def _roughly(self, tried: Tried, problem: Problem, prior: Prior, start: Array) -> Array:
        """Fit from ``start`` (p,) as if what is left there were white noise, again as long as it falls."""
        settings, points = self.method.settings, problem.rows.marker >= 0
        size, residual = np.inf, tried(start)[0]
        while (left := float(np.sqrt(np.mean(residual[points] ** 2)))) < settings.falls * size:
            rough = replace(problem, covariance=problem.covariance.roughened(left)).marginal
            fit = self.method(tried, rough, start, prior, c0=np.inf, max_runs=settings.roughly, glance=tried.glance)
            size, start, residual = left, fit.z, fit.residual
        return start

    def refit(self, problem: Problem, model: FittedModel, *, goes_on: bool = False) -> FittedModel | None:
        """Fit all added effects together; None if the model cannot be solved there."""
        fit = self.fit(problem, problem.marginal, model, free=range(len(model.added)), goes_on=goes_on)
        return None if fit is None else model.with_fit(fit)


@dataclass(frozen=True)
class Tried:
    """Residuals of the ``model`` at other coordinates of its effects number ``free``, in the rows of a ``problem``:
    `Residuals` when called, and a `Glance`."""

    fitter: EffectFitter
    problem: Problem
    model: FittedModel
    free: Sequence[int]
    secants: Secants

    @classmethod
    def of(cls, fitter: EffectFitter, problem: Problem, model: FittedModel, free: Sequence[int]) -> Tried:
        """Make it for one fit, whose runs correct their columns."""
        sigma = np.concatenate([model.added[i].candidate.array("sigma") for i in free])
        return cls(fitter, problem, model, free, Secants(sigma))

    def __call__(self, z: Array) -> tuple[Array, Array]:
        """Return measured minus predicted (n,) at ``z`` (p,), and the columns (n, p) there."""
        now = self._at(z)
        residual, J, rough = self._left(now, columns_of([now[i] for i in self.free]))
        return residual, self.secants.corrected(z, residual, J, self.problem.rows.marker >= 0) if rough else J

    def glance(self, z: Array) -> Array:
        """Return measured minus predicted (n,) at ``z`` (p,)."""
        return self._left(self._at(z), [])[0]

    def _at(self, z: Array) -> list[Added]:
        now, at = list(self.model.added), 0
        for i in self.free:
            n = len(now[i].z)
            now[i] = Added(now[i].candidate, z[at : at + n])
            at += n
        return now

    def _left(self, now: Sequence[Added], columns: Sequence[Column]) -> tuple[Array, Array, bool]:
        """Return what is left (n,), the ``columns`` (n, p), and whether they are only about right."""
        problems = self.fitter.problems
        run = stack(self.fitter.forward.run([a.values for a in now], problems.observations, columns))
        residual, J = problems.residual_at(self.model.uncertain.moved(now), self.problem, run, columns)
        return residual, J, run.rough


@dataclass(frozen=True)
class RefinedMeshCorrection:
    """The discretisation error of the model with effects in it, as a refined ``mesh`` tells it (None: there is none);
    ``declared``: that of the declared model."""

    mesh: RefinedMesh | None
    declared: Correction
    fitter: EffectFitter
    tell: Tell = field(default=silent)

    def of(self, model: FittedModel, observations: Sequence[Observation], own: Sequence[Run] = ()) -> Correction | None:
        """Work the correction out where the refined mesh tells one; ``own``: the model's runs, with the columns of all
        coordinates first, if they are there already."""
        if self.mesh is None:
            return None
        columns = model.columns
        return self.mesh(
            model.effects,
            observations,
            lambda: own or self.fitter.forward.run(model.effects, observations, columns),
            columns,
        )

    def corrected(self, problem: Problem, model: FittedModel, passes: int) -> FittedModel:
        """Take off the discretisation error with the added effects, or that of the declared model where that is not
        worked out, and fit again; once more where the effects have moved, up to ``passes`` times."""
        if self.mesh is None:
            return model
        for _ in range(passes):
            if model.joint is None:
                return model
            self.tell("solving it on the refined mesh", None)
            correction = self.of(model, self.fitter.problems.observations)
            if correction is None and model.uncertain.correction is self.declared:
                return model
            of_all = self.declared if correction is None else self.declared.updated(correction)
            before = model.joint
            again = self.fitter.refit(problem, replace(model, uncertain=replace(model.uncertain, correction=of_all)))
            if again is None or again.joint is None:
                return model
            model = replace(again, gained=model.gained + (again.joint.gain - before.gain))
            if correction is None or again.joint.has_settled(before):
                return model
        return model

    def extended(self, model: FittedModel, held_out: Sequence[Observation], own: Sequence[Run]) -> FittedModel:
        """Work out the discretisation error of recordings that are only predicted, by the model's ``own`` runs."""
        if model.uncertain.correction is self.declared:
            return model
        correction = self.of(model, held_out, own)
        if correction is None:
            return model
        of_all = model.uncertain.correction.updated(correction)
        return replace(model, uncertain=replace(model.uncertain, correction=of_all))
