"""Fits of effects through the nonlinear model, and what the refined mesh tells of the model with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Correction, ForwardModel, RefinedMesh, Run, first_key, stack
from livedeform.closed_loop.inference.fitted_model import Added, FittedModel, columns_of
from livedeform.closed_loop.inference.gauss_newton import Fit, GaussNewton, Marginal, Prior, Problem, Residuals
from livedeform.closed_loop.inference.problem import ProblemFactory
from livedeform.closed_loop.progress import Tell, silent
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array


class LastRuns:
    """A model that remembers its answer to the question asked last: a fit's end is what a correction begins with."""

    def __init__(self, forward: ForwardModel) -> None:
        self.forward = forward
        self._latest: tuple[tuple[object, ...], list[Run]] | None = None

    def __call__(
        self, members: Sequence[Added], observations: Sequence[Observation], columns: Sequence[Column]
    ) -> list[Run]:
        """Run the model with the ``members`` in it."""
        key = (
            tuple((a.candidate.name, tuple(a.z)) for a in members),
            tuple((*first_key(o), o.n_moments) for o in observations),
            tuple((c.candidate.name, c.z, c.coordinate) for c in columns),
        )
        latest = self._latest
        if latest is None or latest[0] != key:
            latest = key, self.forward.run([a.values for a in members], observations, columns)
            self._latest = latest
        return latest[1]


@dataclass(frozen=True)
class EffectFitter:
    """Fits effects to the recordings of the ``problems`` by ``method``."""

    forward: ForwardModel
    problems: ProblemFactory
    method: GaussNewton
    predicted: LastRuns

    @classmethod
    def of(cls, forward: ForwardModel, problems: ProblemFactory, method: GaussNewton) -> EffectFitter:
        """One that remembers the last runs of this model."""
        return cls(forward, problems, method, LastRuns(forward))

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
        """Find the MAP of the coordinates of the model's effects number ``free``; None if it cannot be solved there.

        A body that rings is fitted to the beginning of its motion first, and then to more and more of it: a frequency
        that is off by a few per cent is out of phase after some swings, where the sum of squares has many minima and
        the lowest one within reach is that of a body damped too much. These fits are rough ones, to white noise as
        large as what is left: as exact as a camera is, a step that betters all but some swings looks worse than none. A
        fit that ``goes_on`` was there already.
        """
        chosen = [model.added[i] for i in free]
        start = np.concatenate([a.z for a in chosen])
        ringing = any(a.candidate.info.rings for a in model.added)
        settings = self.method.settings
        runs = max_runs or settings.runs + len(start)
        try:
            if ringing and not goes_on:
                parts = beginnings(self.problems.observations, settings.swings)
                for until in (*parts, np.ones(problem.rows.moment.max() + 1, bool)):
                    start = self._roughly(problem, model, free, until, start, min(runs, settings.roughly))
            c0 = float(np.sum(marginal(problem.residual) ** 2))
            tried = self._residuals(problem, model, free)
            return self.method(tried, marginal, start, prior_of(chosen, start), c0=c0, max_runs=runs)
        except ConvergenceError:
            return None

    def _roughly(
        self, problem: Problem, model: FittedModel, free: Sequence[int], until: np.ndarray, start: Array, runs: int
    ) -> Array:
        """Fit from ``start`` (p,) to the moments ``until`` (k,), as if what is left at first were white noise."""
        tried = self._residuals(problem, model, free, None if until.all() else until)
        keep = until[problem.rows.moment]
        left = tried(start)[0][keep & (problem.rows.marker >= 0)]
        rough = replace(problem, covariance=problem.covariance.roughened(float(np.sqrt(np.mean(left**2)))))
        prior = prior_of([model.added[i] for i in free], start)
        return self.method(tried, rough.marginal(keep), start, prior, c0=np.inf, max_runs=runs).z

    def _residuals(
        self, problem: Problem, model: FittedModel, free: Sequence[int], until: np.ndarray | None = None
    ) -> Residuals:
        """Return the residuals of the coordinates of the effects number ``free``; with ``until`` (k,) those moments
        only are predicted, and the rows of others are not to be used."""
        members, observations = model.added, self.problems.observations
        bounds = np.cumsum([0] + [len(members[i].z) for i in free])

        def residuals(z: Array) -> tuple[Array, Array]:
            now = list(members)
            for j, i in enumerate(free):
                now[i] = Added(members[i].candidate, z[bounds[j] : bounds[j + 1]])
            columns = columns_of([now[i] for i in free])
            if until is None:
                run = stack(self.predicted(now, observations, columns))
            else:
                run = padded(stack(self.predicted(now, _first_parts(observations, until), columns)), until)
            return self.problems.residual_at(model.uncertain.moved(now), problem, run, columns)

        return residuals

    def refit(self, problem: Problem, model: FittedModel) -> FittedModel | None:
        """Fit all added effects together; None if the model cannot be solved there."""
        fit = self.fit(problem, problem.marginal(), model, free=range(len(model.added)))
        return None if fit is None else model.with_fit(fit)


def beginnings(observations: Sequence[Observation], swings: Sequence[float]) -> list[np.ndarray]:
    """Return the moments (k,) bool of the first parts of the motion, each longer than the one before: until the
    markers' path is so many ``swings`` times their largest displacement."""
    paths = []
    for o in observations:
        seen = np.isfinite(o.points).all(axis=(0, 2))
        moved = o.points[:, seen] - o.points[0, seen] if seen.any() else np.zeros((o.n_moments, 1, 3))
        size = np.sqrt(np.mean(np.sum(moved**2, axis=2), axis=1))
        steps = np.sqrt(np.mean(np.sum(np.diff(moved, axis=0) ** 2, axis=2), axis=1))
        paths.append(np.concatenate([[0.0], np.cumsum(steps)]) / max(float(size.max()), 1e-12))
    path = np.concatenate(paths)
    parts = [path <= most for most in swings]
    return [p for p in parts if p.sum() > 1 and not p.all()]


def _first_parts(observations: Sequence[Observation], until: np.ndarray) -> list[Observation]:
    """Return the moments ``until`` (k,) of all recordings, each of its own."""
    ends = np.cumsum([o.n_moments for o in observations])
    parts = [until[end - o.n_moments : end] for o, end in zip(observations, ends, strict=True)]
    return [o.take(p) for o, p in zip(observations, parts, strict=True)]


def padded(run: Run, until: np.ndarray) -> Run:
    """Return the run with nothing at the moments that are not in ``until`` (k,)."""

    def of_all(values: Array | None) -> Array | None:
        if values is None:
            return None
        out = np.zeros((len(until), *values.shape[1:]))
        out[until] = values
        return out

    points, d_points = of_all(run.points), of_all(run.d_points)
    assert points is not None and d_points is not None  # a run has them
    return replace(run, points=points, d_points=d_points, forces=of_all(run.forces), d_forces=of_all(run.d_forces))


def prior_of(added: Sequence[Added], start: Array) -> Prior:
    """Prior of all coordinates; one that nothing slopes towards stays at its ``start`` (p,)."""
    centre, sigma, lower, upper = (
        np.concatenate([a.candidate.array(k) for a in added]) for k in ("centre", "sigma", "lower", "upper")
    )
    between = np.array([bool(c.edges) for a in added for c in a.candidate.coordinates])
    return Prior(np.where(between, start, centre), sigma, lower, upper)


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
            lambda: own or self.fitter.predicted(model.added, observations, columns),
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
