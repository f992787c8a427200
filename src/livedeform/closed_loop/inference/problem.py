"""The linear problem at a run of the model: measured minus predicted, and all that is uncertain whatever is tried."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from livedeform.closed_loop.candidates import Candidate
from livedeform.closed_loop.evidence.noise import (
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
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Correction, Run
from livedeform.closed_loop.inference.gauss_newton import Problem, robust_inflation
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array, EffectValues

LOOK = 2e-5  # m rms, over which a dot keeps its systematic error: a twentieth of a pixel or so


@dataclass(frozen=True)
class Allowed:
    """A candidate that is allowed for, up to ``sigma`` (p,) per amplitude, whatever else is tried: as a table that is
    not quite level. ``per_press``: anew in each press, also beside the candidate itself."""

    candidate: Candidate
    sigma: Array
    per_press: bool = False


# for these effects, on these recordings, beside the model's own runs with these columns
WorkOut = Callable[
    [Sequence[EffectValues], Sequence[Observation], Callable[[], Sequence[Run]], Sequence[Column]], Correction | None
]


@dataclass(frozen=True)
class Uncertain:
    """What is uncertain in every model: sizes of ``errors``, the registration's sigmas (m, rad), and what is
    ``always`` allowed for; ``correction``: what is known of the elements' error already, and ``anew``: how it is worked
    out for a model with effects in it."""

    errors: Errors
    shift: float = 5e-4
    turn: float = 0.01
    always: tuple[Allowed, ...] = ()
    correction: Correction = field(default_factory=Correction)
    anew: WorkOut | None = None


def linear_problem(
    observations: Sequence[Observation],
    uncertain: Uncertain,
    allowed: Sequence[Allowed],
    run: Run,
    dictionary: Sequence[Column],
    always: Sequence[Column],
) -> tuple[Problem, Array]:
    """The linear problem at a run, and its columns of the ``dictionary`` (rows, p); the run has ``always`` after them,
    the columns of what is ``allowed`` in every model."""
    run = _with_better_columns(observations, uncertain.correction, run, [*dictionary, *always])
    y, f = measured(observations, uncertain.correction), run.points
    bad = np.asarray(~np.isfinite(f).all(axis=(1, 2)))
    if bad.all():
        raise ConvergenceError(
            "the model found no equilibrium at any key moment", remedy="check the experiment with `livedeform run`"
        )
    y = np.where(bad[:, None, None], np.nan, y)
    f = np.where(bad[:, None, None], 0.0, f)
    forces = measured_forces(observations, uncertain.correction)
    if forces is not None and run.forces is not None:
        forces = np.where(bad[:, None], np.nan, forces)
    else:
        forces = None
    rows = rows_of(y, forces, blocks_of(observations))
    predicted_forces = np.nan_to_num(run.forces) if run.forces is not None else None
    force_residual = None
    if forces is not None and predicted_forces is not None:
        force_residual = np.nan_to_num(forces) - predicted_forces
    d_points, d_forces = np.nan_to_num(run.d_points), run.d_forces
    d_forces = np.nan_to_num(d_forces) if d_forces is not None else None
    residual = rows.take(np.nan_to_num(y) - f, force_residual)
    columns = rows.take(d_points, d_forces if forces is not None else None)
    covariance, nuisance = _noise(observations, uncertain, allowed, rows, f, predicted_forces)
    extra = columns[:, len(dictionary) :]
    if always:
        nuisance = join([nuisance, _always(observations, allowed, rows, extra, motion_of(f, observations))])
    problem = Problem(rows, residual, covariance, nuisance)
    return _robust(problem), columns[:, : len(dictionary)]


def residual_at(
    observations: Sequence[Observation], uncertain: Uncertain, problem: Problem, run: Run, columns: Sequence[Column]
) -> tuple[Array, Array]:
    """Measured minus predicted (rows,) and the run's ``columns`` (rows, p), on the problem's rows. A moment without an
    equilibrium gains nothing: it keeps the problem's residual."""
    y, forces = measured(observations, uncertain.correction), measured_forces(observations, uncertain.correction)
    has_force = bool((problem.rows.marker < 0).any())
    force_residual = np.nan_to_num(forces) - run.forces if forces is not None and run.forces is not None else None
    residual = problem.rows.take(np.nan_to_num(y) - run.points, force_residual)
    run = _with_better_columns(observations, uncertain.correction, run, columns)
    J = problem.rows.take(run.d_points, run.d_forces if has_force else None)
    lost = ~np.isfinite(residual)
    if lost.mean() > 0.2:
        raise ConvergenceError("the model is lost at many moments", remedy="try a smaller effect")
    residual[lost] = problem.residual[lost]
    J[~np.isfinite(J)] = 0.0
    return residual, J


def _with_better_columns(
    observations: Sequence[Observation], correction: Correction, run: Run, columns: Sequence[Column]
) -> Run:
    """The run, its ``columns`` as the better mesh would have them."""
    points, forces = correction.of_columns(observations, [(c.candidate.name, c.coordinate) for c in columns])
    d_forces = None if run.d_forces is None else run.d_forces + forces
    return replace(run, d_points=run.d_points + points, d_forces=d_forces)


def _noise(
    observations: Sequence[Observation],
    uncertain: Uncertain,
    allowed: Sequence[Allowed],
    rows: Rows,
    f: Array,
    forces: Array | None,
) -> tuple[Covariance, Nuisance]:
    """C and Z at predicted points ``f`` (k, m, 3)."""
    blocks, recording = blocks_of(observations), recordings_of(observations)
    motion = motion_of(f, observations)
    e = uncertain.errors
    sigma_force = float(np.nanmax([o.force_sigma for o in observations] + [0.0]))
    covariance = covariance_of(
        rows,
        np.concatenate([o.covariances * o.noise.repeated for o in observations]),
        motion,
        blocks,
        e,
        force=forces,
        force_sigma=sigma_force,
        steady=steady_of(observations, f),
    )
    places = np.nanmean(f, axis=0)
    parts = [
        registration_columns(rows, f, recording, uncertain.shift, uncertain.turn),
        smooth_error_columns(rows, places, motion, blocks, e),
    ]
    beside = [float(np.linalg.norm(a.sigma)) for a in allowed if a.per_press]
    if beside:
        share = 1.0 - shallowness(motion, blocks)
        parts.append(touch_columns(rows, f, forces, probe_of(observations), recording, share, beside[0]))
    return covariance, join(parts)


def _always(
    observations: Sequence[Observation], allowed: Sequence[Allowed], rows: Rows, columns: Array, motion: Array
) -> Nuisance:
    """Of the ``columns`` (rows, p) of what is always ``allowed``; ``motion`` (k, m) m as predicted."""
    blocks, at, parts = blocks_of(observations), 0, []
    shallow = shallowness(motion, blocks)[rows.moment]
    blocks = blocks[rows.moment]
    for a in allowed:
        n = len(a.sigma)
        own = columns[:, at : at + n] * a.sigma
        at += n
        pieces = [own]
        if a.per_press:  # and otherwise where the probe first touches than where it is deep
            pieces = [own * (w * (blocks == b))[:, None] for b in np.unique(blocks) for w in (1.0, shallow)]
        for k, piece in enumerate(pieces):
            parts.append(Nuisance(piece, tuple(f"{a.candidate.name}[{k},{i}]" for i in range(n))))
    return join(parts)


def _robust(problem: Problem) -> Problem:
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


def measured(observations: Sequence[Observation], correction: Correction) -> Array:
    """The points (k, m, 3) m, as far as they are for these elements to explain."""
    return np.concatenate([o.points for o in observations]) - correction.of_points(observations)


def measured_forces(observations: Sequence[Observation], correction: Correction) -> Array | None:
    """The forces (k, 3) N likewise; None where a recording has none."""
    if any(o.forces is None for o in observations):
        return None
    return np.concatenate([o.forces for o in observations if o.forces is not None]) - correction.of_forces(observations)


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
