"""The finite-element model on several processes: which part of a run is solved where.

A run asks for a recording's moments and for columns. Where nothing remembers what was before, each worker takes a part
of the moments, always the same one; many columns (as of a screening) are shared out instead. Workers tell what they
have solved: nobody else starts it from nothing. Where the probe rubs, columns are carried along its path
(`fem_node.path.rubbing`), and fits correct them by their own runs (`inference.effect_fit`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from threading import Lock
from types import TracebackType
from typing import Self

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Key, Run, stack
from livedeform.closed_loop.model.fem_model import Body, Setting, kind_of
from livedeform.common.processes import worker_pool
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.physics.memory import memory_of, pulls
from livedeform.fem_node.simulator import NOT_ENOUGH, Kind, Solved

MANY = 8  # columns of a moment that cost more than its solution
SWINGS = 4  # likewise of a body in motion, each of whose columns costs six tenths of a run
ENOUGH = 8  # moments that are worth a worker
AMPLITUDE_STEPS = 5.0  # of a coordinate, for a secant: friction is solved to a micrometre
# about what these cost in columns, medians of eight experiments: a run of its own (74 to 143), one with a probe that
# pulls (105 to 360), twice that where it rubs as well (490 in one experiment), and a column with friction, for which
# the surface under the probe is solved (19 to 57)
OWN_RUN, PULLING, PULLING_AND_RUBBING, BEGINS_TO_RUB = 130.0, 220.0, 440.0, 45.0
SECANT_STEP = 0.2  # of the value of a coordinate that has a kick, or of that


@dataclass(frozen=True)
class _Job:
    """``moments`` (k,) of recording number ``recording`` and the columns number ``columns``; a ``secant`` job gives its
    one column by the difference to the base. ``path_steps`` of the probe as in `Body.simulate`: a secant to a base
    without any needs none. ``worker``: whose it is; None if anybody's. It is given up after ``patience`` iterations
    for each moment."""

    recording: int
    moments: np.ndarray
    columns: tuple[int, ...]
    effects: tuple[EffectValues, ...]
    secant: bool = False
    path_steps: bool = True
    worker: int | None = None
    patience: float = np.inf

    @property
    def most_iterations(self) -> float:
        """Number of iterations after which it is given up."""
        return self.patience * len(self.moments)


class FemModel:
    """Runs a `Body` on ``processes`` workers; use it as a context manager. One process runs it here. ``body``: one that
    has solved some of the moments already; the workers start from what it knows. ``own_run``: iterations for a moment,
    after which the run that gives a candidate its column is given up; ``most_lost``: share of the moments beyond which
    such a run is of no use."""

    def __init__(
        self,
        setting: Setting,
        processes: int = 2,
        body: Body | None = None,
        own_run: float = np.inf,
        most_lost: float = 1.0,
    ) -> None:
        self.setting, self.processes, self.own_run, self.most_lost = setting, processes, own_run, most_lost
        self._body = body
        self._workers: list[ProcessPoolExecutor] = []
        self._open = ExitStack()
        self._turn = itertools.count()
        # recordings that are solved as a whole: who knows the slopes
        self._whose: dict[tuple[Kind, str, bool], int] = {}
        self._known: Solved = {}  # what any worker has solved
        self._told: list[set[tuple[Kind, Key]]] = []  # which of it each worker has been told, or found
        self._passed: set[str] = set()  # recordings of which all moments were solved
        self._lock = Lock()

    def __enter__(self) -> Self:
        if self.processes > 1:
            self._workers = [self._open.enter_context(worker(self.body)) for _ in range(self.processes)]
            self._known = self.body.solved.news(())
            self._told = [set(self._known) for _ in self._workers]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.__exit__(kind, value, trace)

    @property
    def body(self) -> Body:
        """The body that runs here."""
        if self._body is None:
            self._body = Body(self.setting)
        return self._body

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        """See `ForwardModel`."""
        if self._workers and len(self._tangents(effects, columns)) >= MANY and not self._remembers(effects):
            new = [o for o in observations if o.name not in self._passed]
            self._passed.update(o.name for o in new)
            self._solve([j for i, o in enumerate(new) for j in self._plan(effects, i, o, ())], new, ())
        alone = len(observations) == 1
        jobs = [j for i, o in enumerate(observations) for j in self._plan(effects, i, o, columns, alone=alone)]
        found = self._solve(jobs, observations, columns)
        out = []
        for i, o in enumerate(observations):
            own = [(j, r) for j, r in zip(jobs, found, strict=True) if j.recording == i]
            out.append(replace(_joined(o, own, columns, self.most_lost), rough=bool(columns) and self._rubs(effects)))
        return out

    def _plan(
        self,
        effects: Sequence[EffectValues],
        number: int,
        o: Observation,
        columns: Sequence[Column],
        *,
        alone: bool = False,
    ) -> Iterator[_Job]:
        """Yield the jobs of one recording, which may be ``alone``: then a body in motion, whose columns are each nearly
        a run of its own, has them shared out sooner."""
        tangents, whole = self._tangents(effects, columns), np.arange(o.n_moments)
        at_once: list[tuple[int | None, np.ndarray]] = [(None, whole)]
        divided = o.n_moments >= ENOUGH * self.processes > ENOUGH
        parts = [*enumerate(np.array_split(whole, self.processes))] if divided else at_once
        secants = sorted(set(range(len(columns))) - set(tangents))
        enough = SWINGS if alone and memory_of(self.body.physics(effects)).rings else MANY
        many = len(tangents) >= enough and self.processes > 1
        if many:
            whose, loads = self._dealt(effects, {i: columns[i] for i in secants})
            weights = [self._weight(effects, columns[i]) for i in tangents]
            for k, share in enumerate(shares(weights, loads)):
                if share:
                    own = tuple(tangents[i] for i in share)
                    yield _Job(number, whole, own, tuple(effects), worker=k, patience=o.patience)
        else:
            remembers = any(self._remembers(e) for e in _all_effects(effects, columns, tangents))
            for worker, moments in at_once if remembers else parts:
                yield _Job(number, moments, tuple(tangents), tuple(effects), worker=worker, patience=o.patience)
        path_steps = self._remembers(effects)
        for i in secants:
            kicked = _kicked(effects, columns[i])
            split = [(whose[i], whole)] if many else at_once if self._remembers(kicked) else parts
            for worker, moments in split:
                yield _Job(
                    number, moments, (i,), tuple(kicked), secant=True, path_steps=path_steps, worker=worker,
                    patience=min(self.own_run, o.patience),
                )  # fmt: skip

    def _weight(self, effects: Sequence[EffectValues], column: Column) -> float:
        """Return what a tangent costs, in others."""
        return BEGINS_TO_RUB if column.candidate.info.rubs and not self._rubs(effects) else 1.0

    def _dealt(self, effects: Sequence[EffectValues], secants: dict[int, Column]) -> tuple[dict[int, int], list[float]]:
        """Deal the ``secants``' runs out, by their numbers; return whose each is and what each worker has to do for
        them, in columns."""
        costs = [self._own_run(effects, column) for column in secants.values()]
        dealt, numbers = shares(costs, [0.0] * self.processes), list(secants)
        whose = {numbers[n]: worker for worker, own in enumerate(dealt) for n in own}
        return whose, [sum(costs[n] for n in own) for own in dealt]

    def _own_run(self, effects: Sequence[EffectValues], column: Column) -> float:
        """Return what the run that gives a secant's column costs, in columns."""
        if not pulls(self.body.physics(_kicked(effects, column)).probe):
            return OWN_RUN
        return PULLING_AND_RUBBING if self._rubs(effects) else PULLING

    def _tangents(self, effects: Sequence[EffectValues], columns: Sequence[Column]) -> list[int]:
        """Return the columns that are derivatives at the model's solution."""
        return [i for i, c in enumerate(columns) if not _is_secant(c, effects)]

    def _rubs(self, effects: Sequence[EffectValues]) -> bool:
        """Return whether the probe does, of a body at rest: points that stick or slide make kinks in its answers."""
        memory = memory_of(self.body.physics(effects))
        return bool(memory.rubs and not memory.rings)

    def _remembers(self, effects: Sequence[EffectValues]) -> bool:
        return bool(memory_of(self.body.physics(effects)).path_dependent)

    def _solve(self, jobs: Sequence[_Job], observations: Sequence[Observation], columns: Sequence[Column]) -> list[Run]:
        asked = []
        for job in jobs:
            o = observations[job.recording]
            keep = np.zeros(o.n_moments, bool)
            keep[job.moments] = True
            tangents = () if job.secant else tuple(columns[i] for i in job.columns)
            asked.append((job.effects, o if keep.all() else o.take(keep), tangents))
        if not self._workers:
            return [
                self.body.simulate(*a, path_steps=j.path_steps, most_iterations=j.most_iterations)
                for j, a in zip(jobs, asked, strict=True)
            ]
        futures = []
        for n, job, a in zip(self._shared_out(jobs, observations), jobs, asked, strict=True):
            news, how = self._news_for(n, a[1].name), (job.path_steps, job.most_iterations)
            futures.append((n, self._workers[n].submit(simulate_and_tell, *a, news, *how)))
        return [self._heard(n, *f.result()) for n, f in futures]

    def _shared_out(self, jobs: Sequence[_Job], observations: Sequence[Observation]) -> list[int]:
        """Return whose each job is. Whole runs that give a column stay with whoever knows their slopes; of the others,
        the longest first, each is taken by who has the least to do of them."""
        whose = [-1] * len(jobs)
        moments = [0] * self.processes  # of runs that give a column
        for i in sorted(range(len(jobs)), key=lambda i: -len(jobs[i].moments)):
            job = jobs[i]
            if job.worker is None:
                whose[i] = self._turn_of(job, observations[job.recording].name)
            else:
                cut = len(job.moments) < observations[job.recording].n_moments
                whose[i] = int(np.argmin(moments)) if job.secant and cut else job.worker
            if job.secant:
                moments[whose[i]] += len(job.moments)
        return whose

    def _turn_of(self, job: _Job, recording: str) -> int:
        """Return the worker for a whole recording: the one that had it before with such effects, or the next."""
        with self._lock:
            kind = kind_of(job.effects), recording, job.secant
            if kind not in self._whose:
                self._whose[kind] = next(self._turn) % self.processes
            return self._whose[kind]

    def _news_for(self, worker: int, recording: str) -> Solved:
        with self._lock:
            told = self._told[worker]
            news = {k: g for k, g in self._known.items() if k not in told and k[1][0] in ("", recording)}
            told.update(news)
            return news

    def _heard(self, worker: int, run: Run, news: Solved) -> Run:
        with self._lock:
            self._known.update(news)
            self._told[worker].update(news)
        return run


def _joined(
    o: Observation, parts: Sequence[tuple[_Job, Run]], columns: Sequence[Column], most_lost: float = 1.0
) -> Run:
    """Join one run of the recording from its jobs."""
    base = [(j, r) for j, r in parts if not j.secant]
    shape = base[0][1].points.shape[1:]
    points = np.full((o.n_moments, *shape), np.nan)
    d_points = np.full((*points.shape, len(columns)), np.nan)
    with_forces = all(r.forces is not None for _, r in parts)
    forces, d_forces = np.full((o.n_moments, 3), np.nan), np.full((o.n_moments, 3, len(columns)), np.nan)
    for job, run in base:
        points[job.moments] = run.points
        _place(d_points, job, run.d_points)
        if run.forces is not None:
            forces[job.moments] = run.forces
        if run.d_forces is not None:
            _place(d_forces, job, run.d_forces)
    for job, run in parts:
        if job.secant:
            c = columns[job.columns[0]]
            strength = float(_secant_step(c)[c.coordinate]) or 1.0
            _place(d_points, job, ((run.points - points[job.moments]) / strength)[..., None])
            if run.forces is not None:
                _place(d_forces, job, ((run.forces - forces[job.moments]) / strength)[..., None])
    aside = _set_aside(np.asarray(np.isfinite(points).all(axis=(1, 2))), parts, columns, most_lost)
    for i, column in enumerate(columns):
        if column.candidate.name in aside:
            d_points[..., i] = d_forces[..., i] = 0.0
    seconds = sum(r.seconds for _, r in parts)
    reasons = tuple(dict.fromkeys(reason for _, r in base for reason in r.reasons))
    if not with_forces:
        return Run(points, None, d_points, None, seconds, reasons, aside)
    return Run(points, forces, d_points, d_forces, seconds, reasons, aside)


def _set_aside(
    solved: np.ndarray, parts: Sequence[tuple[_Job, Run]], columns: Sequence[Column], most_lost: float
) -> dict[str, str]:
    """Return the candidates whose own run was given up, or is lost at more than the share ``most_lost`` of what the
    model without them has ``solved`` (k,) bool, and which of both: they would answer for nothing there."""
    own: dict[str, list[tuple[_Job, Run]]] = {}
    for job, run in parts:
        if job.secant:
            own.setdefault(columns[job.columns[0]].candidate.name, []).append((job, run))
    out = {}
    for name, runs in own.items():
        moments = np.concatenate([job.moments[~np.isfinite(run.points).all(axis=(1, 2))] for job, run in runs])
        lost = len(np.unique(moments[solved[moments]]))
        if any(NOT_ENOUGH in reason for _, run in runs for reason in run.reasons):
            out[name] = f"its run did not converge in {sum(run.seconds for _, run in runs):.0f} s"
        elif lost > most_lost * solved.sum():
            out[name] = f"its run finds no equilibrium at {lost} of {int(solved.sum())} moments"
    return out


def _place(out: Array, job: _Job, values: Array) -> None:
    for i, column in enumerate(job.columns):
        out[job.moments, ..., column] = values[..., i]


def _all_effects(
    effects: Sequence[EffectValues], columns: Sequence[Column], tangents: Sequence[int]
) -> list[list[EffectValues]]:
    """Return the lists of effects that a job with these columns solves or changes to."""
    out = [list(effects)]
    for i in tangents:
        c, k = columns[i].candidate, columns[i].coordinate
        z = np.array(columns[i].z)
        z[k] += c.coordinates[k].beside(z[k], c.coordinates[k].step)
        out.append(_with(effects, c.values(z)))
    return out


def shares(weights: Sequence[float], loads: Sequence[float]) -> list[list[int]]:
    """Share things of some ``weights`` out to workers who have ``loads`` already: the heaviest first, each to who has
    the least to do; return the numbers of each worker's, rising."""
    out: list[list[int]] = [[] for _ in loads]
    total = list(loads)
    for i in sorted(range(len(weights)), key=lambda i: -weights[i]):
        least = int(np.argmin(total))
        total[least] += weights[i]
        out[least].append(i)
    return [sorted(own) for own in out]


def _kicked(effects: Sequence[EffectValues], column: Column) -> list[EffectValues]:
    """Return the effects of the run that gives a secant's column."""
    return _with(effects, column.candidate.values(np.array(column.z) + _secant_step(column)))


def _with(effects: Sequence[EffectValues], more: EffectValues) -> list[EffectValues]:
    return [*(e for e in effects if e.name != more.name), more]


def _is_secant(column: Column, effects: Sequence[EffectValues]) -> bool:
    """Return whether a column is a run of its own: what is switched on as a whole, and is not on yet."""
    c = column.candidate
    if not len(c.amplitudes):
        return not c.tangent and all(e.name != c.name for e in effects)
    return c.info.switched and column.z[column.coordinate] == 0.0


def _secant_step(column: Column) -> Array:
    """Return what a secant's run adds to the column's coordinates (p,): the kick at zero."""
    c, k = column.candidate, column.coordinate
    at, kick = float(column.z[k]), abs(float(c.kick[k]))
    if not len(c.amplitudes) or (at == 0.0 and kick):
        return np.asarray(c.kick)
    size = SECANT_STEP * max(abs(at), kick) if kick else c.coordinates[k].step
    if k in c.amplitudes and not kick:
        size *= AMPLITUDE_STEPS
    step = np.zeros(len(column.z))
    step[k] = c.coordinates[k].beside(at, size)
    return step


# --- in a worker
# --------------------------------------------------------------------------------------------------------


_BODIES: list[Body] = []


@contextmanager
def worker(body: Body) -> Iterator[ProcessPoolExecutor]:
    """Start a process of its own for the ``body`` and what it knows already; ask it to `simulate_and_tell`."""
    with worker_pool(1, _BODIES.extend, [body]) as executor:
        executor.submit(_ready).result()  # forked before another one has its threads at work
        try:
            yield executor
        finally:
            executor.shutdown(cancel_futures=True)


def simulate_and_tell(
    effects: Sequence[EffectValues],
    o: Observation,
    columns: Sequence[Column],
    heard: Solved,
    path_steps: bool = True,
    most_iterations: float = np.inf,
) -> tuple[Run, Solved]:
    """Call `Body.simulate` of the worker's body, which hears what others solved, and tells what it solved itself."""
    body = _BODIES[-1]
    body.solved.hear(heard)
    known = body.solved.known
    run = body.simulate(effects, o, columns, path_steps=path_steps, most_iterations=most_iterations)
    return run, body.solved.news(known)


def _ready() -> None:
    """Do nothing."""


# --- several bodies
# --------------------------------------------------------------------------------------------------------


def simulate_each(
    bodies: Sequence[Body],
    effects: Sequence[EffectValues],
    observations: Sequence[Observation],
    columns: Sequence[Column],
    processes: int,
) -> list[Run]:
    """Let each of the ``bodies`` simulate its recording, which is cut into parts where nothing remembers; the next time
    it starts from what was found. Unloaded shapes are found here, once for all parts: workers would forget them."""
    for body, o in zip(bodies, observations, strict=True):
        body.unload(effects, o.name, columns)
    parts = 1 if memory_of(bodies[0].physics(effects)).path_dependent else processes
    with worker_pool(processes, _BODIES.extend, list(bodies)) as pool:
        asked = [
            [pool.submit(_simulate_one, i, effects, o.take(part), columns) for part in _cut(o.n_moments, parts)]
            for i, o in enumerate(observations)
        ]
        found = [[future.result() for future in futures] for futures in asked]
    for body, results in zip(bodies, found, strict=True):
        for _, solved in results:
            body.solved.follow(solved)
    return [stack([run for run, _ in results]) for results in found]


def _cut(n: int, parts: int) -> list[np.ndarray]:
    """Return masks (n,) of consecutive moments."""
    place = np.arange(n) * parts // max(n, 1)
    return [place == part for part in np.unique(place)]


def _simulate_one(
    number: int, effects: Sequence[EffectValues], o: Observation, columns: Sequence[Column]
) -> tuple[Run, Solved]:
    body = _BODIES[number]
    run = body.simulate(effects, o, columns)
    return run, body.solved.solved(kind_of(effects), o.name, [int(s) for s in o.stamps_ns])
