"""The linear problem at a run of the model: measured minus predicted, and all that is uncertain whatever is tried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from livedeform.closed_loop.evidence.noise import (
    Covariance,
    Nuisance,
    Rows,
    covariance_of,
    join,
    registration_columns,
    release_columns,
    rows_of,
    smooth_error_columns,
    touch_columns,
)
from livedeform.closed_loop.evidence.observation import Observation, are_pressed
from livedeform.closed_loop.forward import Column, Correction, Run
from livedeform.closed_loop.inference.fitted_model import FittedModel, Uncertain
from livedeform.closed_loop.inference.forms import swing_rate
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.inference.steady import steady_of
from livedeform.closed_loop.settings import AllowanceSettings
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array


@dataclass(frozen=True)
class ProblemFactory:
    """Linear problems of the recordings ``observations``, at any run of any model.

    What a model gets wrong by a share of the motion is another share in each press: in each of the blocks of time, or
    in each recording that is ``one_load`` from its beginning to its end. It ``lasts`` while a body swings, or not
    (`lasting`).
    """

    observations: Sequence[Observation]
    settings: AllowanceSettings
    one_load: bool = False
    lasts: bool = False

    @property
    def presses(self) -> np.ndarray:
        """Return the number of the press (k,) that each moment belongs to."""
        return recordings_of(self.observations) if self.one_load else blocks_of(self.observations)

    def at(self, model: FittedModel, run: Run, dictionary: Sequence[Column]) -> tuple[Problem, Array]:
        """Form the linear problem at a run, and its Jacobian columns of the ``dictionary`` (rows, p).

        The run has the columns of the dictionary, and after them the model's `FittedModel.allowed_columns`. Raises
        ``ConvergenceError`` where it has no equilibrium at any moment.
        """
        uncertain, observations = model.uncertain, self.observations
        run = corrected_columns(observations, uncertain.correction, run, [*dictionary, *model.allowed_columns])
        y, f, forces, predicted_forces = self._compared(uncertain, run)
        rows = rows_of(y, forces, blocks_of(observations))
        force_residual = None
        if forces is not None and predicted_forces is not None:
            force_residual = np.nan_to_num(forces) - predicted_forces
        d_forces = np.nan_to_num(run.d_forces) if run.d_forces is not None else None
        residual = rows.take(np.nan_to_num(y) - f, force_residual)
        columns = rows.take(np.nan_to_num(run.d_points), d_forces if forces is not None else None)
        covariance, nuisance = self._noise(model, rows, y, f, predicted_forces)
        if model.allowed:
            extra = columns[:, len(dictionary) :]
            nuisance = join([nuisance, self._allowed(model, rows, extra, motion_of(f, observations))])
        problem = Problem(rows, residual, covariance, nuisance)
        return self._robust(problem), columns[:, : len(dictionary)]

    def residual_at(
        self, uncertain: Uncertain, problem: Problem, run: Run, columns: Sequence[Column]
    ) -> tuple[Array, Array]:
        """Measured minus predicted (rows,) and the run's Jacobian ``columns`` (rows, p), on the problem's rows.

        A moment without an equilibrium gains nothing: it keeps the problem's residual. Raises ``ConvergenceError``
        where there are many of these.
        """
        y, forces = (
            measured(self.observations, uncertain.correction),
            measured_forces(self.observations, uncertain.correction),
        )
        has_force = bool((problem.rows.marker < 0).any())
        force_residual = np.nan_to_num(forces) - run.forces if forces is not None and run.forces is not None else None
        residual = problem.rows.take(np.nan_to_num(y) - run.points, force_residual)
        run = corrected_columns(self.observations, uncertain.correction, run, columns)
        J = problem.rows.take(run.d_points, run.d_forces if has_force else None)
        lost = ~np.isfinite(residual)
        if lost.mean() > self.settings.lost:
            raise ConvergenceError("the model is lost at many moments", remedy="try a smaller effect")
        residual[lost] = problem.residual[lost]
        J[~np.isfinite(J)] = 0.0
        return residual, J

    def _compared(self, uncertain: Uncertain, run: Run) -> tuple[Array, Array, Array | None, Array | None]:
        """Measured and predicted points (k, m, 3) m and forces (k, 3) N; nothing is measured where nothing is
        predicted."""
        y, f = measured(self.observations, uncertain.correction), run.points
        bad = np.asarray(~np.isfinite(f).all(axis=(1, 2)))
        if bad.all():
            raise ConvergenceError(
                "the model found no equilibrium at any key moment", remedy="check the experiment with `livedeform run`"
            )
        y = np.where(bad[:, None, None], np.nan, y)
        f = np.where(bad[:, None, None], f[~bad].mean(axis=0), f)  # within the motion, where nothing is compared
        forces = measured_forces(self.observations, uncertain.correction)
        if forces is not None and run.forces is not None:
            forces = np.where(bad[:, None], np.nan, forces)
        else:
            forces = None
        return y, f, forces, np.nan_to_num(run.forces) if run.forces is not None else None

    def _noise(
        self, model: FittedModel, rows: Rows, y: Array, f: Array, forces: Array | None
    ) -> tuple[Covariance, Nuisance]:
        """Form C and Z at measured points ``y`` and predicted points ``f`` (k, m, 3)."""
        observations, uncertain, settings = self.observations, model.uncertain, self.settings
        blocks, recording = self.presses, recordings_of(observations)
        motion = motion_of(f, observations)
        if self.lasts:
            motion = lasting(motion, observations)
        e = uncertain.errors
        sigma_force = float(np.nanmax([o.force_sigma for o in observations] + [0.0]))
        covariance = covariance_of(
            rows,
            np.concatenate([o.covariances * o.noise.repeated for o in observations]),
            yielding(motion, settings.still),
            blocks,
            e,
            force=forces,
            force_sigma=sigma_force,
            steady=steady_of(observations, f, y - f, e, motion, blocks_of(observations), settings.look),
            settings=settings,
        )
        places = np.nanmean(f, axis=0)
        parts = [
            registration_columns(rows, f, recording, uncertain.shift, uncertain.turn),
            smooth_error_columns(rows, places, motion, blocks, e, settings),
        ]
        if uncertain.release > 0.0:
            rates = np.concatenate([o.rates for o in observations])
            parts.append(release_columns(rows, rates, recording, uncertain.release))
        sideways = [float(np.linalg.norm(a.sigma)) for a in model.allowed if a.per_press]
        if sideways:
            share = 1.0 - shallowness(motion, blocks)
            probe = probe_of(observations)
            parts.append(touch_columns(rows, f, forces, probe, recording, share, sideways[0], settings))
        return covariance, join(parts)

    def _allowed(self, model: FittedModel, rows: Rows, columns: Array, motion: Array) -> Nuisance:
        """Scale the Jacobian ``columns`` (rows, p) of what is allowed for; ``motion`` (k, m) m as predicted."""
        blocks, at, parts = self.presses, 0, []
        shallow = shallowness(motion, blocks)[rows.moment]
        blocks = blocks[rows.moment]
        for a in model.allowed:
            n = len(a.sigma)
            own = columns[:, at : at + n] * a.sigma
            at += n
            pieces = [own]
            if a.per_press:  # and otherwise where the probe first touches than where it is deep
                pieces = [own * (w * (blocks == b))[:, None] for b in np.unique(blocks) for w in (1.0, shallow)]
            for k, piece in enumerate(pieces):
                parts.append(Nuisance(piece, tuple(f"{a.candidate.name}[{k},{i}]" for i in range(n))))
        return join(parts)

    def _robust(self, problem: Problem) -> Problem:
        """Trust single marker-moments less that nothing smooth explains."""
        factors = robust_inflation(problem.rows, problem.covariance, problem.residual, self.settings)
        if (factors == 1.0).all():
            return problem
        s = np.sqrt(factors)
        bounds = problem.rows.bounds
        blocks = tuple(
            b * np.outer(s[bounds[g] : bounds[g + 1]], s[bounds[g] : bounds[g + 1]])
            for g, b in enumerate(problem.covariance.blocks)
        )
        return replace(problem, covariance=Covariance(problem.rows, blocks))


def corrected_columns(
    observations: Sequence[Observation], correction: Correction, run: Run, columns: Sequence[Column]
) -> Run:
    """Give the run its ``columns`` as the refined mesh would have them."""
    points, forces = correction.of_columns(observations, [(c.candidate.name, c.coordinate) for c in columns])
    d_forces = None if run.d_forces is None else run.d_forces + forces
    return replace(run, d_points=run.d_points + points, d_forces=d_forces)


def measured(observations: Sequence[Observation], correction: Correction) -> Array:
    """Gather the points (k, m, 3) m, as far as they are for these elements to explain."""
    return np.concatenate([o.points for o in observations]) - correction.of_points(observations)


def measured_forces(observations: Sequence[Observation], correction: Correction) -> Array | None:
    """Gather the forces (k, 3) N likewise, NaN of a recording without any; None where no recording has any."""
    if all(o.forces is None for o in observations):
        return None
    return np.concatenate([o.known_forces for o in observations]) - correction.of_forces(observations)


def is_let_go(model: FittedModel, observations: Sequence[Observation]) -> bool:
    """Tell whether the body swings after it was let go, and no probe presses it: each recording is one load from its
    beginning to its end."""
    return model.rings and not are_pressed(observations)


def blocks_of(observations: Sequence[Observation]) -> np.ndarray:
    """Number the blocks (k,) through all recordings."""
    out, at = [], 0
    for o in observations:
        out.append(o.blocks + at)
        at += int(o.blocks.max()) + 1
    return np.concatenate(out)


def recordings_of(observations: Sequence[Observation]) -> np.ndarray:
    """Number of the recording (k,) that each moment belongs to."""
    return np.concatenate([np.full(o.n_moments, i) for i, o in enumerate(observations)])


def shallowness(motion: Array, blocks: np.ndarray) -> Array:
    """One minus each moment's share (k,) of the deepest press of its block, by the predicted ``motion`` (k, m)."""
    size = np.sqrt(np.mean(motion**2, axis=1))
    deepest = np.array([size[blocks == b].max() for b in blocks])
    return np.asarray(1.0 - np.divide(size, deepest, out=np.ones_like(size), where=deepest > 0.0))


def probe_of(observations: Sequence[Observation]) -> Array:
    """Return where the probe is reported to be (k, 3) m; NaN without one."""
    poses = [p for o in observations for p in o.poses]
    return np.array([np.full(3, np.nan) if p is None else p.position for p in poses])


def motion_of(points: Array, observations: Sequence[Observation]) -> Array:
    """Return how far each predicted marker is from its place at the recording's moments of rest (k, m) m; 0 at a moment
    without an equilibrium, of which nothing is known."""
    out, at = np.zeros(points.shape[:2]), 0
    for o in observations:
        part = points[at : at + o.n_moments]
        solved = np.isfinite(part).all(axis=(1, 2))
        rest = solved & (o.phases == "rest")
        if solved.any():
            origin = part[rest].mean(axis=0) if rest.any() else part[solved][0]
            out[at : at + o.n_moments][solved] = np.linalg.norm(part[solved] - origin, axis=2)
        at += o.n_moments
    return out


def lasting(motion: Array, observations: Sequence[Observation]) -> Array:
    """Return the ``motion`` (k, m) m of a body that swings, at least as large as in the period before: what a model
    gets wrong of a swing is not undone where the body passes the place from which it was let go."""
    out, at = motion.copy(), 0
    for o in observations:
        rate, t = swing_rate([o]), o.seconds
        for k in range(o.n_moments if rate > 0.0 else 0):
            past = (t <= t[k]) & (t >= t[k] - 2.0 * np.pi / rate)
            out[at + k] = motion[at : at + o.n_moments][past].max(axis=0)
        at += o.n_moments
    return out


def beginning(observations: Sequence[Observation], most: float) -> np.ndarray:
    """Return the moments (k,) bool of the first part of the motion: until the markers' path is ``most`` times their
    largest displacement."""
    paths = []
    for o in observations:
        seen = np.isfinite(o.points).all(axis=(0, 2))
        moved = o.points[:, seen] - o.points[0, seen] if seen.any() else np.zeros((o.n_moments, 1, 3))
        size = np.sqrt(np.mean(np.sum(moved**2, axis=2), axis=1))
        steps = np.sqrt(np.mean(np.sum(np.diff(moved, axis=0) ** 2, axis=2), axis=1))
        paths.append(np.concatenate([[0.0], np.cumsum(steps)]) / max(float(size.max()), 1e-12))
    return np.concatenate(paths) <= most


def yielding(motion: Array, still: float) -> Array:
    """Return the ``motion`` (k, m) m with markers that the model never moves by as much as ``still`` m moved like the
    others in the mean: what holds a body yields a little with it, and the model is as wrong there as elsewhere."""
    held = motion.max(axis=0) < still
    if held.all() or not held.any():
        return motion
    others = np.sqrt(np.mean(motion[:, ~held] ** 2, axis=1))
    return np.where(held, others[:, None], motion)


def robust_inflation(rows: Rows, covariance: Covariance, residual: Array, settings: AllowanceSettings) -> Array:
    """Find factors (n,) >= 1 by which single marker-moments that nothing smooth explains are to be trusted less.

    The squared standardised residual of one marker at one moment, relative to the median of this marker and of this
    moment: a missing effect raises those too, a swapped or slipped marker raises itself only (Huber 1964, with the
    scale from the neighbours).
    """
    scaled = residual / np.sqrt(np.concatenate([np.diag(b) for b in covariance.blocks]))
    factors = np.ones(rows.n)
    is_point = rows.marker >= 0
    if not is_point.any():
        return factors
    k, m = rows.moment.max() + 1, rows.marker.max() + 1
    size = np.full((k, m), np.nan)
    total = np.zeros((k, m))
    np.add.at(total, (rows.moment[is_point], rows.marker[is_point]), scaled[is_point] ** 2)
    seen = np.zeros((k, m), bool)
    seen[rows.moment[is_point], rows.marker[is_point]] = True
    size[seen] = np.sqrt(total[seen] / 3.0)
    ever = np.ix_(seen.any(axis=1), seen.any(axis=0))
    usual = np.ones((k, m))
    by_marker = np.nanquantile(size[ever], settings.usual, axis=0)[None]
    usual[ever] = np.maximum(np.nanmedian(size[ever], axis=1)[:, None], by_marker)
    ratio = size / np.maximum(usual, 1.0)
    excess = np.where(np.nan_to_num(ratio) > settings.outlier, np.nan_to_num(ratio) / settings.outlier, 1.0)
    factors[is_point] = excess[rows.moment[is_point], rows.marker[is_point]] ** 2
    return factors
