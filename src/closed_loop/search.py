"""Forward addition of effects: screen all, refine the leading ones through the nonlinear model, keep what earns
itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from closed_loop.catalogue import Candidate, with_start
from closed_loop.evidence import Observation
from closed_loop.fit import Fit, Marginal, Problem, gauss_newton, robust_inflation
from closed_loop.forward import Column, ForwardModel, Run, dictionary_columns, stack
from closed_loop.noise import (
    Covariance,
    Errors,
    Nuisance,
    Rows,
    Steady,
    covariance_of,
    join,
    registration_columns,
    rows_of,
    smooth_error_columns,
    touch_columns,
)
from closed_loop.select import Entry, Screening, combined, screen, training_sets
from livedeform_common.errors import ConvergenceError
from livedeform_common.types import Array, EffectValues

ALPHA = 0.01  # family-wise probability of a false addition per step
MIN_SCORE = 8.0  # an addition must predict unseen blocks better by this much (twice the log density): odds of 55
LEADERS = 4  # candidates that are refined through the nonlinear model
FIRST_RUNS = 2  # of the model for each of them, before those that have fallen behind are left
BEHIND, BEHIND_SHARE = 30.0, 0.2  # that is: by this much of twice the log likelihood, or this share of the best gain
LOOK = 2e-5  # m rms, over which a dot keeps its systematic error: a twentieth of a pixel or so
LEAD_SHARE = 0.5  # ... if their screened gain is at least this share of the best

Tell = Callable[[str, float | None], None]


def silent(text: str, fraction: float | None = None) -> None:
    """No progress shown."""


@dataclass(frozen=True)
class Allowed:
    """A candidate that is allowed for, up to ``sigma`` (p,) per amplitude, whatever else is tried: as a table that is
    not quite level. ``per_press``: anew in each press, also beside the candidate itself."""

    candidate: Candidate
    sigma: Array
    per_press: bool = False


@dataclass(frozen=True)
class Uncertain:
    """What is uncertain in every model: sizes of ``errors``, the registration's sigmas (m, rad), and what is
    ``always`` allowed for."""

    errors: Errors
    shift: float = 5e-4
    turn: float = 0.01
    always: tuple[Allowed, ...] = ()


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
    """A leading candidate after its nonlinear fit: ``score`` against the model without it, ``predicted`` the runs."""

    candidate: Candidate
    fit: Fit
    score: float
    block_scores: Array


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

    ``added`` effects, ``steps`` so far, ``joint`` the last fit of all added effects together.
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
    problems: list[Problem] = field(default_factory=list)

    def find(self) -> None:
        """Adds effects until none earns itself or there are ``max_effects``."""
        self.weights: Array | None = None
        for number in range(self.max_effects + 1):
            self.tell(f"step {number + 1}: screening {len(self.remaining)} candidates", None)
            columns = dictionary_columns(self.remaining)
            run = stack(self.forward.run(self.effects, self.observations, [*columns, *self.always_columns]))
            if self.baseline is None:
                self.baseline = run
            problem, dictionary = self.problem(run, len(columns))
            self.problems.append(problem)
            entries = entries_of(self.remaining)
            screening = screen(problem, dictionary, entries, seed=self.seed)
            if number == self.max_effects:
                self.steps.append(Step(screening, {}, "", "no effect may be added"))
                break
            if screening.family_p > ALPHA or not screening.scores or screening.scores[0].score > -MIN_SCORE:
                self.steps.append(Step(screening, {}, "", "nothing beyond what noise and model error explain"))
                break
            refined = self.refine(problem, screening)
            best = min(refined.values(), key=lambda r: r.score, default=None)
            if best is None or best.score > -MIN_SCORE:
                self.steps.append(Step(screening, refined, "", "no candidate predicts unseen blocks better"))
                break
            self.added.append(Added(best.candidate, best.fit.z))
            self.joint = best.fit if len(self.added) == 1 else self.refit(problem)
            self.steps.append(Step(screening, refined, best.candidate.name, "predicts unseen blocks best"))
            if self.max_effects == number + 1:
                break

    # -- parts -------------------------------------------------------------------------------------------------------

    @property
    def effects(self) -> list[EffectValues]:
        return [a.values for a in self.added]

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

    def always_nuisance(self, rows: Rows, columns: Array, motion: Array) -> Nuisance:
        """Of the columns (rows, p) of `always_columns`; ``motion`` (k, m) m as predicted."""
        blocks, at, parts = blocks_of(self.observations), 0, []
        shallow = shallowness(motion, blocks)[rows.moment]
        blocks = blocks[rows.moment]
        for a in self.allowed:
            n = len(a.sigma)
            own = columns[:, at : at + n] * a.sigma
            at += n
            pieces = [own]
            if a.per_press:  # and otherwise where the probe first touches than where it is deep
                pieces = [own * (w * (blocks == b))[:, None] for b in np.unique(blocks) for w in (1.0, shallow)]
            for k, piece in enumerate(pieces):
                parts.append(Nuisance(piece, tuple(f"{a.candidate.name}[{k},{i}]" for i in range(n))))
        return join(parts)

    def problem(self, run: Run, n_dictionary: int) -> tuple[Problem, Array]:
        """The linear problem at a run, and its dictionary (rows, n_dictionary)."""
        y, f = measured(self.observations), run.points
        bad = np.asarray(~np.isfinite(f).all(axis=(1, 2)))
        if bad.all():
            raise ConvergenceError(
                "the model found no equilibrium at any key moment", remedy="check the experiment with `livedeform run`"
            )
        y = np.where(bad[:, None, None], np.nan, y)
        f = np.where(bad[:, None, None], 0.0, f)
        forces = measured_forces(self.observations)
        if forces is not None and run.forces is not None:
            forces = np.where(bad[:, None], np.nan, forces)
        else:
            forces = None
        rows = rows_of(y, forces, blocks_of(self.observations))
        predicted_forces = np.nan_to_num(run.forces) if run.forces is not None else None
        force_residual = None
        if forces is not None and predicted_forces is not None:
            force_residual = np.nan_to_num(forces) - predicted_forces
        d_points, d_forces = np.nan_to_num(run.d_points), run.d_forces
        d_forces = np.nan_to_num(d_forces) if d_forces is not None else None
        residual = rows.take(np.nan_to_num(y) - f, force_residual)
        columns = rows.take(d_points, d_forces if forces is not None else None)
        covariance, nuisance = self.noise(rows, f, predicted_forces)
        extra = columns[:, n_dictionary:]
        if extra.shape[1]:
            nuisance = join([nuisance, self.always_nuisance(rows, extra, motion_of(f, self.observations))])
        problem = Problem(rows, residual, covariance, nuisance)
        return self.robust(problem), columns[:, :n_dictionary]

    def noise(self, rows: Rows, f: Array, forces: Array | None) -> tuple[Covariance, Nuisance]:
        """C and Z at predicted points ``f`` (k, m, 3)."""
        blocks, recording = blocks_of(self.observations), recordings_of(self.observations)
        motion = motion_of(f, self.observations)
        e = self.uncertain.errors
        sigma_force = float(np.nanmax([o.force_sigma for o in self.observations] + [0.0]))
        covariance = covariance_of(
            rows,
            np.concatenate([o.covariances * o.noise.repeated for o in self.observations]),
            motion,
            blocks,
            e,
            force=forces,
            force_sigma=sigma_force,
            steady=steady_of(self.observations, f),
        )
        places = np.nanmean(f, axis=0)
        parts = [
            registration_columns(rows, f, recording, self.uncertain.shift, self.uncertain.turn),
            smooth_error_columns(rows, places, motion, blocks, e),
        ]
        beside = [float(np.linalg.norm(a.sigma)) for a in self.allowed if a.per_press]
        if beside:
            share = 1.0 - shallowness(motion, blocks)
            parts.append(touch_columns(rows, f, forces, probe_of(self.observations), recording, share, beside[0]))
        return covariance, join(parts)

    def robust(self, problem: Problem) -> Problem:
        """Trusts single marker-moments less that nothing smooth explains."""
        factors = robust_inflation(problem.rows, problem.covariance, problem.residual)
        if (factors == 1.0).all():
            return problem
        s = np.sqrt(factors)
        bounds = problem.rows.bounds
        blocks = tuple(
            b * np.outer(s[bounds[g] : bounds[g + 1]], s[bounds[g] : bounds[g + 1]])
            for g, b in enumerate(problem.covariance.blocks)
        )
        return replace(problem, covariance=Covariance(problem.rows, blocks))

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
        ]
        leading = sorted(leading, key=lambda s: -s.gain)[:LEADERS]
        marginal = problem.marginal()
        self.tell("fitting " + ", ".join(s.name for s in leading), None)
        starts = {s.name: start_of(self.candidates[s.name], s.shape, s.solution.theta) for s in leading}
        found = self._refine_all(problem, marginal, starts, max_runs=FIRST_RUNS)
        limit = max((r.fit.gain for r in found.values()), default=0.0)
        limit -= max(BEHIND, BEHIND_SHARE * limit)
        # who is that far behind after some steps does not win any more
        open_ = {n: r.fit.z for n, r in found.items() if not r.fit.converged and r.fit.gain > limit}
        return found | self._refine_all(problem, marginal, open_)

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
        score, per_set = cross_validated(problem, fit, candidate.array("centre"), candidate.array("sigma"))
        return Refined(candidate, fit, score, per_set)

    def refit(self, problem: Problem) -> Fit | None:
        """All added effects together."""
        fit = self.fit(problem, problem.marginal(), self.added, free=range(len(self.added)))
        if fit is not None:
            at = 0
            for i, a in enumerate(self.added):
                n = len(a.z)
                self.added[i] = Added(a.candidate, fit.z[at : at + n])
                at += n
        return fit

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
            columns = [
                Column(now[i].candidate, tuple(now[i].z), c)
                for i in free
                for c in range(len(now[i].candidate.coordinates))
            ]
            run = stack(self.forward.run([a.values for a in now], self.observations, columns))
            return self.residual_of(problem, run)

        centre, sigma, lower, upper = (
            np.concatenate([a.candidate.array(k) for a in chosen]) for k in ("centre", "sigma", "lower", "upper")
        )
        c0 = float(np.sum(marginal(problem.residual) ** 2))
        try:
            return gauss_newton(
                model, marginal, start, centre, sigma, lower, upper, c0=c0, max_runs=max_runs or 4 + len(start)
            )
        except ConvergenceError:
            return None

    def residual_of(self, problem: Problem, run: Run) -> tuple[Array, Array]:
        """Measured minus predicted (rows,) and the run's columns (rows, p), on the problem's rows."""
        y, forces = measured(self.observations), measured_forces(self.observations)
        has_force = bool((problem.rows.marker < 0).any())
        force_residual = np.nan_to_num(forces) - run.forces if forces is not None and run.forces is not None else None
        residual = problem.rows.take(np.nan_to_num(y) - run.points, force_residual)
        columns = problem.rows.take(run.d_points, run.d_forces if has_force else None)
        lost = ~np.isfinite(residual)
        if lost.mean() > 0.2:
            raise ConvergenceError("the model is lost at many moments", remedy="try a smaller effect")
        residual[lost] = 0.0
        columns[~np.isfinite(columns)] = 0.0
        return residual, columns


# --- small functions
# ------------------------------------------------------------------------------------------------------


def entries_of(candidates: Sequence[Candidate]) -> list[Entry]:
    """The dictionary's entries, in the order of `dictionary_columns`."""
    entries, at = [], 0
    for c in candidates:
        i = c.amplitudes
        sigma, lower, upper = c.array("sigma")[i], c.array("lower")[i], c.array("upper")[i]
        if not len(i):  # switched on as a whole: the column is the effect itself, at strength one
            sigma, lower, upper = np.array([1.0]), np.array([0.0]), np.array([2.0])
        for s in range(len(c.shapes)):
            entries.append(Entry(c.name, s, tuple(range(at, at + len(sigma))), sigma, lower, upper))
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


def cross_validated(problem: Problem, fit: Fit, centre: Array, sigma: Array) -> tuple[float, Array]:
    """-2 log predictive density of each left-out block, of the fit's linearisation relative to the model before; the
    sum first."""

    def evidence(marginal: Marginal) -> float:
        r0, r, J = marginal(problem.residual), marginal(fit.residual), marginal(fit.columns)
        d = (fit.z - centre) / sigma
        A = J.T @ J + np.diag(1.0 / sigma**2)
        b = J.T @ r - d / sigma
        _, logdet = np.linalg.slogdet(A * np.outer(sigma, sigma))
        return float(r0 @ r0 - (r @ r + d @ d - b @ np.linalg.solve(A, b) + logdet))

    full = evidence(problem.marginal())
    per_set = np.array([evidence(problem.marginal(keep)) - full for keep in training_sets(problem)])
    return combined(per_set, len(np.unique(problem.rows.fold))), per_set


def measured(observations: Sequence[Observation]) -> Array:
    return np.concatenate([o.points for o in observations])


def measured_forces(observations: Sequence[Observation]) -> Array | None:
    if any(o.forces is None for o in observations):
        return None
    return np.concatenate([o.forces for o in observations if o.forces is not None])


def blocks_of(observations: Sequence[Observation]) -> np.ndarray:
    """Blocks (k,) numbered through all recordings."""
    out, at = [], 0
    for o in observations:
        out.append(o.blocks + at)
        at += int(o.blocks.max()) + 1
    return np.concatenate(out)


def recordings_of(observations: Sequence[Observation]) -> np.ndarray:
    return np.concatenate([np.full(o.n_moments, i) for i, o in enumerate(observations)])


def steady_of(observations: Sequence[Observation], points: Array) -> Steady:
    """What the tracker states and repeats do not show: it lasts while the markers, predicted at ``points`` (k, m, 3),
    are looked at in the same way, and is another one where they have moved by `LOOK`."""
    blocks = blocks_of(observations)
    looks = np.full(len(blocks), -1)
    for k in range(len(blocks)):
        if looks[k] < 0:
            moved = np.sqrt(np.mean((points - points[k]) ** 2, axis=(1, 2)))
            looks[(blocks == blocks[k]) & (moved < LOOK) & (looks < 0)] = k
    missing = [
        np.broadcast_to((1.0 - o.noise.repeated) * o.noise.covariance, (o.n_moments, *o.noise.covariance.shape))
        for o in observations
    ]
    return Steady(looks, np.concatenate(missing))


def shallowness(motion: Array, blocks: np.ndarray) -> Array:
    """One minus each moment's share (k,) of the deepest press of its block, by the predicted ``motion`` (k, m)."""
    size = np.sqrt(np.mean(motion**2, axis=1))
    deepest = np.array([size[blocks == b].max() for b in blocks])
    return 1.0 - np.divide(size, deepest, out=np.ones_like(size), where=deepest > 0.0)


def probe_of(observations: Sequence[Observation]) -> Array:
    """Where the probe is reported to be (k, 3) m; NaN without one."""
    poses = [p for o in observations for p in o.poses]
    return np.array([np.full(3, np.nan) if p is None else p.position for p in poses])


def motion_of(points: Array, observations: Sequence[Observation]) -> Array:
    """How far each predicted marker is from its place at the recording's moment of rest (k, m) m."""
    out, at = np.zeros(points.shape[:2]), 0
    for o in observations:
        part = points[at : at + o.n_moments]
        rest = np.flatnonzero(o.phases == "rest")
        origin = part[rest].mean(axis=0) if len(rest) else part[0]
        out[at : at + o.n_moments] = np.linalg.norm(part - origin, axis=2)
        at += o.n_moments
    return out
