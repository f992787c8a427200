"""Find the size of each effect that these recordings could have shown, and whether a size that matters is hidden.

An amplitude z of a candidate whose Jacobian columns, with everything that is always uncertain integrated out, carry the
information I has the gain (sqrt(I) z + e)^2 with e ~ N(0, 1), and in the left-out sets s the score
-z^2 K + 2 z K / sqrt(I) e + cost with K = sum (I - I_s), the information that is new in each. It is added if the gain
is beyond chance, at the family-wise level of all candidates, and the score beyond what an addition needs. The smallest
z for which both happen with 95 % is what could have been seen. Where the tangent at zero is not to be trusted the
columns are secants to the candidate's kick (`forward.Column`), and so is z: what grows by another power than that
(``grows`` on its card) is as large as what does as much.

It matters if it would move the markers, beside a rigid motion of all of them, by a stated share of how the body moved
or by the experiment's threshold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtri, chndtr, ndtri

from livedeform.closed_loop.candidates import Candidate
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import dictionary_columns, stack
from livedeform.closed_loop.inference.forward_selection import ForwardSelection, Selection, entries_of
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.inference.problem import ProblemFactory, motion_of
from livedeform.closed_loop.inference.screening import DictionaryEntry, Screening
from livedeform.closed_loop.settings import Settings, VerdictSettings
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array

NOTHING = 1e-300
ALL = "looking at all recordings together"  # a part of a diagnosis, as it is told


@dataclass(frozen=True)
class Detectable:
    """The visible part of candidate ``name``: the smallest ``size`` of its ``parameter``, as a difference from what is
    declared of it or from no effect (infinite: none that it can have), which moves the markers by ``moves`` m rms;
    ``most``: how far it can move them at all, m rms."""

    name: str
    parameter: str
    size: float
    moves: float
    most: float

    def is_hidden(self, matters: float) -> bool:
        """Tell whether it could move the markers by ``matters`` m rms without being seen."""
        return self.most > matters and self.moves > matters


@dataclass(frozen=True)
class Visible:
    """The visible size of each candidate, as ``found``, and the size that ``matters``, m rms; ``together``: candidates
    that all recordings together speak for, and those that were fitted do not."""

    found: Mapping[str, Detectable]
    matters: float
    together: tuple[str, ...] = ()

    @property
    def hidden(self) -> tuple[str, ...]:
        """Candidates that could move the markers by a size that matters without being seen, the worst first."""
        names = [n for n, d in self.found.items() if d.is_hidden(self.matters)]
        return tuple(sorted(names, key=lambda n: -self.found[n].moves))

    def reasons(self, settings: VerdictSettings) -> tuple[str, ...]:
        """Say what is hidden, and which size of it could have been seen; nothing where nothing is."""
        if self.together:
            return (f"all recordings together speak for {' and '.join(self.together)}, those that were fitted do not",)
        if not self.hidden:
            return ()
        sizes = [
            f"{n} ({d.parameter} by {d.size:.2g}, {1e3 * d.moves:.2g} mm)" if np.isfinite(d.size) else f"{n} (none)"
            for n, d in ((n, self.found[n]) for n in self.hidden)
        ]
        return (
            f"effects that move the markers by {1e3 * self.matters:.2g} mm rms, {100.0 * settings.matters:.0f} % of "
            f"how they moved or the threshold, could have stayed unseen; seen with {100.0 * settings.power:.0f} % "
            f"would be {', '.join(sizes)}",
        )


@dataclass(frozen=True)
class Power:
    """The method: which sizes of which candidate could have been seen in a linear problem."""

    settings: Settings

    def __call__(
        self, problem: Problem, dictionary: Array, candidates: Sequence[Candidate], family: int | None = None
    ) -> dict[str, Detectable]:
        """Find it for all ``candidates``, whose columns are those of the ``dictionary`` (n, P); ``family``: how many
        would be looked for (None: these)."""
        products = Screening(self.settings.screening).products(problem, dictionary)
        moved = _apart_from_registration(problem, dictionary)
        entries, out = entries_of(candidates), {}
        full, views, tried = products.whole, (products.time, products.markers), family or len(candidates)
        for candidate in candidates:
            found = [
                max(
                    (self._one(candidate, e, *of, full, views, moved, tried) for of in _of_parameters(candidate, e)),
                    key=lambda d: d.moves,
                )
                for e in entries
                if e.name == candidate.name
            ]
            out[candidate.name] = min(found, key=lambda d: (d.size, -d.most))
        return out

    def _one(
        self,
        candidate: Candidate,
        entry: DictionaryEntry,
        i: np.ndarray,
        parameter: str,
        full: Array,
        views: tuple[Sequence[Array], Sequence[Array]],
        moved: Array,
        family: int,
    ) -> Detectable:
        """Find it for one ``parameter``, which has the columns ``i`` of the entry, of one shape of one candidate."""
        columns = np.array(entry.columns)[i]
        G = full[np.ix_(columns, columns)]
        e = np.linalg.eigh(G)[1][:, 0]  # of a vector, the direction that shows least
        e = e * np.sign(e[np.argmax(np.abs(e))])

        def information(of: Array) -> float:
            g = float(e @ of[np.ix_(columns, columns)] @ e)
            return g**2 / (g + float(1.0 / entry.sigma[i][0] ** 2))

        whole = information(full)
        new = [(sum(whole - information(s) for s in view), _cost(full, view, entry)) for view in views]
        z = min(self._needed(whole, k, cost, len(entry.columns), family) for k, cost in new)
        limit = float(max(entry.upper[i][0], -entry.lower[i][0]))
        rms = float(np.sqrt(np.sum((moved[:, columns] @ e) ** 2) * 3.0 / max(len(moved), 1)))
        size = _size(candidate, entry, i, e, z) if z <= limit else float("inf")
        return Detectable(candidate.name, parameter, size, rms * min(z, limit), rms * limit)

    def _needed(self, whole: float, new: float, cost: float, p: int, family: int) -> float:
        """Find the amplitude whose gain and whose score are enough with the power that is asked for."""
        if whole <= NOTHING or new <= NOTHING:
            return float("inf")
        level = 1.0 - (1.0 - self.settings.selection.alpha) ** (1.0 / family)
        power = self.settings.verdict.power
        by_gain = _distance(float(chdtri(p, level)), p, power) / np.sqrt(whole)
        # z^2 K - 2 z K / sqrt(I) u - (score + cost) = 0
        u, least = float(ndtri(power)), self.settings.selection.min_score + cost
        b = new * u / np.sqrt(whole)
        by_score = (b + np.sqrt(b**2 + new * least)) / new
        return float(max(by_gain, by_score))


def _distance(limit: float, p: int, power: float) -> float:
    """Find how far (in sigmas) from zero a normal vector (p,) is if its squared length exceeds the limit with
    the ``power``."""
    return float(brentq(lambda d: 1.0 - chndtr(limit, p, d**2) - power, 1e-3, np.sqrt(limit) + 10.0))


def _cost(full: Array, view: Sequence[Array], entry: DictionaryEntry) -> float:
    """Return what the entry's parameters cost in the left-out sets of one view, without any effect."""
    i = np.array(entry.columns)
    prior = np.diag(1.0 / entry.sigma**2)

    def logdet(G: Array) -> float:
        return float(np.linalg.slogdet(G[np.ix_(i, i)] + prior)[1])

    return sum(logdet(full) - logdet(part) for part in view)


def _of_parameters(candidate: Candidate, entry: DictionaryEntry) -> list[tuple[np.ndarray, str]]:
    """Return which of the entry's columns are of the first parameter that can switch the effect off, and its name; of a
    declared effect, of which any number may be otherwise, those of each parameter."""
    if not len(candidate.amplitudes):
        return [(np.array([0]), candidate.info.parameters[0].name)]
    names = [candidate.coordinates[a].parameter for a in candidate.amplitudes]
    asked = names[:1] if candidate.undeclared is None else dict.fromkeys(names)
    return [(np.flatnonzero([n == name for n in names]), name) for name in asked]


def _size(candidate: Candidate, entry: DictionaryEntry, i: np.ndarray, e: Array, z: float) -> float:
    """Return how far the parameter is from no effect, in its unit; of one whose no effect is infinite, its value."""
    if not len(candidate.amplitudes):
        return z
    amounts = []
    for j, share in zip(i, e, strict=True):
        c = candidate.coordinates[candidate.amplitudes[j]]
        far = _by_its_power(candidate, candidate.amplitudes[j], z * share)
        side = far if c.lower <= far <= c.upper else -far
        value, none = c.value(side), c.value(0.0)
        amounts.append(abs(value - none) if np.isfinite(none) else abs(value))
    return float(np.linalg.norm(amounts))


def _by_its_power(candidate: Candidate, k: int, z: float) -> float:
    """Return which coordinate number ``k`` of a candidate does what ``z`` does along the secant to its kick, where what
    it does grows by another power."""
    kick, grows = float(candidate.kick[k]), candidate.info.parameter(candidate.coordinates[k].parameter).grows
    if candidate.undeclared is not None or not kick or grows == 1.0:
        return z
    return kick * float(np.sign(z / kick) * abs(z / kick) ** (1.0 / grows))


def _apart_from_registration(problem: Problem, columns: Array) -> Array:
    """Rows of points of the ``columns`` (n, P), without what a rigid motion of each recording takes away: no error of
    the model is seen in that."""
    points = problem.rows.marker >= 0
    rigid = [n.startswith(("shift_", "turn_")) for n in problem.nuisance.names]
    Q, _ = np.linalg.qr(problem.nuisance.columns[points][:, rigid])
    x = columns[points]
    return np.asarray(x - Q @ (Q.T @ x))


def size_that_matters(motion: Array, threshold: float, floor: float, share: float) -> float:
    """Find how far (m rms) an effect must move markers to matter: a ``share`` of how they ``motion`` (k, m) m, or the
    ``threshold`` m (infinite: none) if that is less or if nothing has moved beyond the noise's ``floor`` m."""
    moved = float(np.sqrt(np.mean(motion**2))) if motion.size else 0.0
    return min(share * moved, threshold) if moved > floor else threshold


def visible(found: Selection, threshold: float, settings: Settings) -> Visible:
    """Find what could have been seen of each candidate in the recordings that were fitted, where the declared model was
    linearised, and from which size on it matters: ``threshold`` m at most."""
    if found.first is None:
        return Visible({}, threshold)
    points = found.first.run.points
    motion = motion_of(points, found.observations)[np.isfinite(points).all(axis=(1, 2))]
    floor = float(np.mean([np.nan_to_num(o.noise.value) for o in found.observations]))
    matters = size_that_matters(motion, threshold, floor / np.sqrt(motion.size), settings.verdict.matters)
    if not found.candidates:
        return Visible({}, matters)
    candidates = list(found.candidates.values())
    return Visible(Power(settings)(found.first.problem, found.first.dictionary, candidates), matters)


def needs_all(seen: Visible, fitted: Sequence[Observation], held_out: Sequence[Observation]) -> bool:
    """Tell whether candidates are hidden, and all of them would be visible if the recordings that were ``held_out``
    showed as much in each moment as those that were ``fitted``."""
    n, more = (sum(o.n_moments for o in observations) for observations in (fitted, held_out))
    hidden = [seen.found[name] for name in seen.hidden]
    return bool(hidden) and all(np.sqrt(n / (n + more)) * d.moves <= seen.matters for d in hidden)


def in_all(seen: Visible, method: ForwardSelection, held_out: Sequence[Observation], settings: Settings) -> Visible:
    """Find what could have been seen of the hidden candidates in all recordings together, and look for them there.

    For where nothing was added: nothing was fitted then, and what was held out shows as much as the rest.
    """
    method.tell(ALL, None)
    model, candidates = method.declared, [method.candidates[name] for name in seen.hidden]
    columns = dictionary_columns(candidates)
    asked, observations = [*columns, *model.allowed_columns], [*method.observations, *held_out]
    runs = [run for of in (method.observations, held_out) for run in method.fitter.forward.run([], of, asked)]
    try:
        problem, dictionary = ProblemFactory(observations, settings.allowance).at(model, stack(runs), columns)
    except ConvergenceError:
        return seen
    found = Power(settings)(problem, dictionary, candidates, len(method.candidates))
    screened = method.screening(problem, dictionary, entries_of(candidates), seed=method.seed)
    together = (screened.scores[0].name,) if method.is_significant(screened, method.least(model)) else ()
    return replace(seen, found={**seen.found, **found}, together=together)
