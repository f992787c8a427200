"""What the closed loop asks of a model: predictions at key moments, and how they change with any candidate's
coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from closed_loop.catalogue import Candidate
from closed_loop.evidence import Observation
from livedeform_common.types import Array, EffectValues


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
    NaN."""

    points: Array
    forces: Array | None
    d_points: Array
    d_forces: Array | None
    seconds: float = 0.0


@dataclass(frozen=True)
class Correction:
    """What a better mesh tells differently of a model, by (recording's name, stamp): ``points`` (m, 3) m
    and ``forces`` (3,) N. Where it is not known it is nothing."""

    points: Mapping[tuple[str, int], Array] = field(default_factory=dict)
    forces: Mapping[tuple[str, int], Array] = field(default_factory=dict)

    def of_points(self, observations: Sequence[Observation]) -> Array:
        """(k, m, 3) m of all moments, one recording after another."""
        nothing = np.zeros(observations[0].points.shape[1:])
        return np.array([self.points.get((o.name, int(s)), nothing) for o in observations for s in o.stamps_ns])

    def updated(self, newer: Correction) -> Correction:
        """This one, with all that the ``newer`` one knows."""
        return Correction({**self.points, **newer.points}, {**self.forces, **newer.forces})

    def less(self, other: Correction) -> Correction:
        """This one without what the ``other`` one takes off as well."""
        points = {key: value - other.points.get(key, 0.0) for key, value in self.points.items()}
        forces = {key: value - other.forces.get(key, 0.0) for key, value in self.forces.items()}
        return Correction(points, forces)

    def corrected(self, observations: Sequence[Observation], runs: Sequence[Run]) -> list[Run]:
        """The runs' points as the better mesh would have them."""
        return [replace(r, points=r.points + self.of_points([o])) for o, r in zip(observations, runs, strict=True)]

    def of_forces(self, observations: Sequence[Observation]) -> Array:
        """(k, 3) N."""
        nothing = np.zeros(3)
        return np.array([self.forces.get((o.name, int(s)), nothing) for o in observations for s in o.stamps_ns])


class ForwardModel(Protocol):
    """A model with any list of effects. ``effects`` come on top of the declared ones, or replace one of the same name;
    ``processes`` runs may be asked for at the same time, from threads."""

    processes: int

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        """One run per recording, each from the model's state at rest."""
        ...


def stack(runs: Sequence[Run]) -> Run:
    """The runs of several recordings one after another."""
    with_forces = all(r.forces is not None for r in runs)
    return Run(
        np.concatenate([r.points for r in runs]),
        np.concatenate([r.forces for r in runs if r.forces is not None]) if with_forces else None,
        np.concatenate([r.d_points for r in runs]),
        np.concatenate([r.d_forces for r in runs if r.d_forces is not None]) if with_forces else None,
        sum(r.seconds for r in runs),
    )


def difference(observations: Sequence[Observation], one: Sequence[Run], two: Sequence[Run]) -> Correction:
    """What the runs ``two`` tell differently from ``one``."""
    points, forces = {}, {}
    for o, a, b in zip(observations, one, two, strict=True):
        for k, stamp in enumerate(o.stamps_ns):
            if np.isfinite(a.points[k]).all() and np.isfinite(b.points[k]).all():
                points[o.name, int(stamp)] = b.points[k] - a.points[k]
                if a.forces is not None and b.forces is not None:
                    forces[o.name, int(stamp)] = b.forces[k] - a.forces[k]
    return Correction(points, forces)


def dictionary_columns(candidates: Sequence[Candidate]) -> list[Column]:
    """All columns of the first step: for every shape of every candidate its amplitudes, at zero."""
    columns = []
    for candidate in candidates:
        for shape in candidate.shapes:
            z = tuple(float(v) for v in shape)
            amplitudes = candidate.amplitudes if len(candidate.amplitudes) else [0]
            columns += [Column(candidate, z, int(i)) for i in amplitudes]
    return columns
