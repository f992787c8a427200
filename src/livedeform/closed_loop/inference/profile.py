"""How far numbers may be off where the model bends: profile likelihood.

A covariance makes even intervals, as of a parabola. Of a ball whose radius and ratio stand in for each other, of a layer
and its contrast, of a number at its bound the cost is none. There an end of the interval is where the cost, with that
number held and all others fitted anew, has risen as it would at the even interval's end (Venzon & Moolgavkar 1988):

    cost(end) - cost(fit) = (reach / sigma)^2,

``reach`` that of the stated covariance, ``sigma`` the fit's own: what makes intervals wider than noise does so here.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from livedeform.closed_loop.inference.effect_fit import EffectFitter, Tried, prior_of
from livedeform.closed_loop.inference.fitted_model import FittedModel
from livedeform.closed_loop.inference.gauss_newton import Fit, Prior, Problem
from livedeform.closed_loop.inference.interval import drawn_along
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array

STILL = 1e-6  # sigma of a number that is held
FURTHEST = 2.0  # times as far as what was looked at is looked at next


@dataclass(frozen=True)
class Place:
    """A place that was looked at: coordinates ``z`` (p,), and the ``root`` of how much the cost rises to there."""

    z: Array
    root: float


@dataclass(frozen=True)
class Profile:
    """The profiles of a fitted ``model`` in the linear ``problem`` on the rows of its joint ``fit``; ``places`` that
    were looked at."""

    fitter: EffectFitter
    problem: Problem
    model: FittedModel
    fit: Fit
    places: list[Place] = field(default_factory=list)

    def reach(self, even: Array) -> Array:
        """Return by how much each coordinate may be off (p, 2), down and up; ``even`` (p,): by the covariance."""
        out = np.column_stack([even, even])
        told: list[int] = []
        for i in self.bent(even):
            along = any(abs(self.fit.correlation[i, j]) > self.fitter.method.settings.alike for j in told)
            with ThreadPoolExecutor(max_workers=self.fitter.forward.processes) as threads:
                known = tuple(self.places) if along else ()
                out[i] = list(threads.map(lambda side, i=i, known=known: self._end(i, side * even[i], known), (-1, 1)))
            told.append(i)
        return out

    def bent(self, even: Array) -> list[int]:
        """Return the coordinates whose interval is not even: logarithms that are not known to a small share."""
        coordinates = [c for a in self.model.added for c in a.candidate.coordinates]
        least = self.fitter.method.settings.bends
        return [i for i, c in enumerate(coordinates) if c.transform == "log" and not c.edges and even[i] > least]

    def _end(self, number: int, step: float, known: Sequence[Place]) -> float:
        """Return how far an end is in the direction of the even ``step``; ``known``: places on the way of another
        number that this one follows."""
        settings, z, prior = self.fitter.method.settings, self.fit.z, self._prior
        way, wanted = float(np.sign(step)), float(abs(step) / self.fit.sigma[number])
        limit = float(prior.upper[number] - z[number] if way > 0 else z[number] - prior.lower[number])
        seen = [Place(z, 0.0), *(p for p in known if way * (p.z[number] - z[number]) > 0.0)]
        reach = min(abs(step), limit) if len(seen) == 1 else self._where(seen, number, wanted)
        if max(p.root for p in seen) >= wanted:
            return min(reach, limit)
        for _ in range(settings.places):
            try:
                seen.append(self._at(number, z[number] + way * min(reach, limit), seen))
            except ConvergenceError:
                return max(float(abs(p.z[number] - z[number])) for p in seen)
            if reach >= limit and seen[-1].root < wanted:
                return limit
            before, reach = reach, self._where(seen, number, wanted)
            if abs(reach - before) < settings.near * before:
                break
        return min(reach, limit)

    def _where(self, seen: Sequence[Place], number: int, wanted: float) -> float:
        """Return how far from the fit the cost has risen to the square of ``wanted``, by the places ``seen``: the root
        is a straight line of a parabola, and nearly one between two places."""
        far = np.array([abs(p.z[number] - self.fit.z[number]) for p in seen])
        order = np.argsort(far)
        far, roots = far[order], np.maximum.accumulate(np.array([p.root for p in seen])[order])
        if wanted <= roots[-1]:
            return float(np.interp(wanted, roots, far))
        slope = (roots[-1] - roots[-2]) / (far[-1] - far[-2])
        beyond = (wanted - roots[-1]) / slope if slope > 0.0 else np.inf
        return float(min(far[-1] + beyond, FURTHEST * far[-1]))

    def _at(self, number: int, value: float, seen: Sequence[Place]) -> Place:
        """Fit all other coordinates with one held at a ``value``, from the nearest place that was ``seen``."""
        prior, nearest = self._prior, min(seen, key=lambda p: abs(p.z[number] - value))
        start = nearest.z + drawn_along(self.fit, number, value - nearest.z[number])
        start[number] = value
        centre, sigma = prior.centre.copy(), prior.sigma.copy()
        centre[number], sigma[number] = value, STILL
        held = replace(prior, centre=centre, sigma=sigma)
        tried = Tried.of(self.fitter, self.problem, self.model, range(len(self.model.added)))
        method, marginal = self.fitter.method, self.problem.marginal()
        fit = method(tried, marginal, start, held, c0=0.0, max_runs=method.settings.profile_runs)
        own = float(np.sum(marginal(self.fit.residual) ** 2)) + prior.cost(self.fit.z)
        cost = -fit.gain + ((value - prior.centre[number]) / prior.sigma[number]) ** 2
        place = Place(fit.z, float(np.sqrt(max(cost - own, 0.0))))
        self.places.append(place)
        return place

    @property
    def _prior(self) -> Prior:
        return prior_of(self.model.added, self.fit.z)
