"""The forward model, as the closed loop asks for it: predictions at key moments, and how they change with any
candidate's coordinates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Protocol

import numpy as np

from livedeform.closed_loop.candidates import Candidate
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.common.types import Array, EffectValues


@dataclass(frozen=True)
class Column:
    """The derivative of the prediction with respect to coordinate number ``coordinate`` of the ``candidate`` at ``z``
    (p,); where the candidate has no tangent at zero, the secant between zero and its kick. The candidate is added to
    the model if it is not in it (at ``z`` with its amplitudes at zero, which changes nothing)."""

    candidate: Candidate
    z: tuple[float, ...]
    coordinate: int


@dataclass(frozen=True)
class Run:
    """Predictions of one recording: ``points`` (k, m, 3) m, ``forces`` (k, 3) N or None, and their derivatives
    ``d_points`` (k, m, 3, p), ``d_forces`` (k, 3, p) for the columns asked for. Moments that did not converge are
    NaN; ``reasons`` says why, once each. ``rough``: whether derivatives are only about right, as where the probe rubs:
    points begin to stick or to slide between two runs. ``aside``: why the run of its own of each candidate was of no
    use whose columns are therefore nothing."""

    points: Array
    forces: Array | None
    d_points: Array
    d_forces: Array | None
    seconds: float = 0.0
    reasons: tuple[str, ...] = ()
    aside: Mapping[str, str] = field(default_factory=dict)
    rough: bool = False

    @property
    def whole(self) -> bool:
        """Return whether all moments were found."""
        return bool(np.isfinite(self.points).all())

    def take(self, keep: np.ndarray) -> Run:
        """Some of the moments (k,) bool, with their derivatives."""
        forces = None if self.forces is None else self.forces[keep]
        d_forces = None if self.d_forces is None else self.d_forces[keep]
        return Run(self.points[keep], forces, self.d_points[keep], d_forces, rough=self.rough)

    def at(self, moments: np.ndarray) -> Run:
        """Return it as the run of more moments (k,) bool, of which it has those that are True; the others are NaN."""

        def among(values: Array) -> Array:
            out = np.full((len(moments), *values.shape[1:]), np.nan)
            out[moments] = values
            return out

        forces = None if self.forces is None else among(self.forces)
        d_forces = None if self.d_forces is None else among(self.d_forces)
        return replace(self, points=among(self.points), forces=forces, d_points=among(self.d_points), d_forces=d_forces)


Key = tuple[str, int]  # of a moment: the recording's name and the stamp
Name = tuple[str, int]  # of a coordinate: the candidate's name and the number
Carry = Callable[[Array, Array], tuple[Array, Array]]  # see `Candidate.carried`


def keys_of(o: Observation) -> list[Key]:
    """Return the keys of a recording's moments."""
    return [(o.name, int(stamp)) for stamp in o.stamps_ns]


def first_key(o: Observation) -> Key:
    """Return the key of its first moment."""
    return keys_of(o)[0]


@dataclass(frozen=True)
class Correction:
    """The difference that a finer mesh makes to a model: ``points`` (m, 3) m and ``forces`` (3,) N by moment. Where it
    is not known it is nothing. The model's effects were at the coordinates ``z``; with each of these it changes by
    ``d_points`` (m, 3, p) and ``d_forces`` (3, p)."""

    points: Mapping[Key, Array] = field(default_factory=dict)
    forces: Mapping[Key, Array] = field(default_factory=dict)
    z: Mapping[Name, float] = field(default_factory=dict)
    d_points: Mapping[Key, Array] = field(default_factory=dict)
    d_forces: Mapping[Key, Array] = field(default_factory=dict)

    def updated(self, newer: Correction) -> Correction:
        """Return this one, with all that the ``newer`` one knows; its own derivatives only if they are taken there as
        well."""
        points, forces = {**self.points, **newer.points}, {**self.forces, **newer.forces}
        if self.z != newer.z:
            return replace(newer, points=points, forces=forces)
        d_points, d_forces = {**self.d_points, **newer.d_points}, {**self.d_forces, **newer.d_forces}
        return Correction(points, forces, self.z, d_points, d_forces)

    def less(self, other: Correction) -> Correction:
        """Return this one without what the ``other`` one, of a model without effects, takes off as well."""
        points = {key: value - other.points.get(key, 0.0) for key, value in self.points.items()}
        forces = {key: value - other.forces.get(key, 0.0) for key, value in self.forces.items()}
        return replace(self, points=points, forces=forces)

    def moved(self, z: Mapping[Name, float], carry: Mapping[str, Carry] = MappingProxyType({})) -> Correction:
        """Return it to first order with effects at the coordinates ``z``; those that ``carry`` names follow their own
        lines."""
        if not self.z:
            return self
        before, after = np.array(list(self.z.values())), np.array([z.get(name, at) for name, at in self.z.items()])
        step, turn = after - before, np.eye(len(before))
        for effect, carried in carry.items():
            own = [i for i, (name, _) in enumerate(self.z) if name == effect]
            if own:
                step[own], turn[np.ix_(own, own)] = carried(before[own], after[own])
        points = {k: p + self.d_points[k] @ step if k in self.d_points else p for k, p in self.points.items()}
        forces = {k: f + self.d_forces[k] @ step if k in self.d_forces else f for k, f in self.forces.items()}
        turned = ({k: d @ turn for k, d in of.items()} if carry else of for of in (self.d_points, self.d_forces))
        return Correction(points, forces, dict(zip(self.z, after.tolist(), strict=True)), *turned)

    def corrected(self, observations: Sequence[Observation], runs: Sequence[Run]) -> list[Run]:
        """Return the runs with points as the finer mesh would have them."""
        return [replace(r, points=r.points + self.of_points([o])) for o, r in zip(observations, runs, strict=True)]

    def of_points(self, observations: Sequence[Observation]) -> Array:
        """Return (k, m, 3) m of all moments, one recording after another."""
        return _gathered(self.points, observations, observations[0].points.shape[1:])

    def of_forces(self, observations: Sequence[Observation]) -> Array:
        """Return (k, 3) N of all moments."""
        return _gathered(self.forces, observations, (3,))

    def of_columns(self, observations: Sequence[Observation], names: Sequence[Name]) -> tuple[Array, Array]:
        """Return its derivatives (k, m, 3, p) and (k, 3, p) with respect to the coordinates ``names``; zero where it
        has none."""
        known = list(self.z)
        pick = [known.index(n) if n in self.z else len(known) for n in names]
        shape = observations[0].points.shape[1:]
        d_points = _gathered(self.d_points, observations, (*shape, len(known)))
        d_forces = _gathered(self.d_forces, observations, (3, len(known)))
        more = [(0, 0)] * (d_points.ndim - 1)
        return np.pad(d_points, [*more, (0, 1)])[..., pick], np.pad(d_forces, [*more[:2], (0, 1)])[..., pick]


def _gathered(known: Mapping[Key, Array], observations: Sequence[Observation], shape: tuple[int, ...]) -> Array:
    nothing = np.zeros(shape)
    return np.array([known.get(key, nothing) for o in observations for key in keys_of(o)])


class ForwardModel(Protocol):
    """A model with any list of effects. ``effects`` come on top of the declared ones, or replace one of the same name;
    ``processes`` runs may be asked for at the same time, from threads."""

    processes: int

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        """Return one run per recording, each from the model's state at rest."""
        ...


class RefinedMesh(Protocol):
    """A refined mesh's estimate of the discretisation error of a model with effects in it."""

    def __call__(
        self,
        effects: Sequence[EffectValues],
        observations: Sequence[Observation],
        own: Callable[[], Sequence[Run]],
        columns: Sequence[Column] = (),
    ) -> Correction | None:
        """Compare with the model's ``own`` runs, which have derivatives for the ``columns``; None where the refined
        mesh tells nothing of these effects."""
        ...


def stack(runs: Sequence[Run]) -> Run:
    """Join the runs of several recordings one after another; forces of those without any are NaN, if others have."""
    with_forces = any(r.forces is not None for r in runs)
    return Run(
        np.concatenate([r.points for r in runs]),
        np.concatenate([_or_unknown(r.forces, r, ()) for r in runs]) if with_forces else None,
        np.concatenate([r.d_points for r in runs]),
        np.concatenate([_or_unknown(r.d_forces, r, r.d_points.shape[3:]) for r in runs]) if with_forces else None,
        sum(r.seconds for r in runs),
        tuple(dict.fromkeys(reason for r in runs for reason in r.reasons)),
        {name: why for r in runs for name, why in r.aside.items()},
        any(r.rough for r in runs),
    )


def _or_unknown(forces: Array | None, run: Run, columns: tuple[int, ...]) -> Array:
    """Return a run's forces, or their ``columns``: NaN (k, 3, ...) where there are none."""
    return np.full((len(run.points), 3, *columns), np.nan) if forces is None else forces


def difference(
    observations: Sequence[Observation], one: Sequence[Run], two: Sequence[Run], columns: Sequence[Column] = ()
) -> Correction:
    """Return the difference of the runs ``two`` from ``one``; ``columns``: the first that both have."""
    p = len(columns)
    z = {(c.candidate.name, c.coordinate): c.z[c.coordinate] for c in columns}
    points, forces, d_points, d_forces = {}, {}, {}, {}
    for o, a, b in zip(observations, one, two, strict=True):
        for k, key in enumerate(keys_of(o)):
            if not np.isfinite(a.points[k] + b.points[k]).all():
                continue
            points[key] = b.points[k] - a.points[k]
            d_points[key] = np.nan_to_num(b.d_points[k][..., :p] - a.d_points[k][..., :p])
            if a.forces is not None and b.forces is not None:
                forces[key] = b.forces[k] - a.forces[k]
            if a.d_forces is not None and b.d_forces is not None:
                d_forces[key] = np.nan_to_num(b.d_forces[k][..., :p] - a.d_forces[k][..., :p])
    return Correction(points, forces, z, d_points, d_forces)


def dictionary_columns(candidates: Sequence[Candidate]) -> list[Column]:
    """Return all columns of the first step: for every shape of every candidate its amplitudes, at zero."""
    columns = []
    for candidate in candidates:
        for shape in candidate.shapes:
            z = tuple(float(v) for v in shape)
            amplitudes = candidate.amplitudes if len(candidate.amplitudes) else [0]
            columns += [Column(candidate, z, int(i)) for i in amplitudes]
    return columns
