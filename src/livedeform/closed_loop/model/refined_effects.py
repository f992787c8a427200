"""Estimate the discretisation error of a model with effects in it: they change the error of the elements with the body,
an inclusion more than any.

`Anew` works out again what the refined mesh tells differently (`refined_mesh`), on elements that are smaller where a
modulus jumps as well. Each moment takes a solution there, with several factors of a large matrix. So the deepest moment
of each press comes first. Where an effect changes less of the correction than is uncertain of it anyway
(``remains``), the others change in proportion to how far their markers are moved (`spread`); else all are solved.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Correction, Key, Run, difference, first_key, keys_of
from livedeform.closed_loop.model.fem_model import Body
from livedeform.closed_loop.model.refined_friction import ElementDrag, FrictionOnRefinedMesh
from livedeform.closed_loop.model.workers import simulate_each
from livedeform.closed_loop.settings import DiscretisationSettings
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.effects import EFFECTS as MECHANICAL
from livedeform.fem_node.effects import makes_rub
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.physics.memory import memory_of, pulls
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.refinement import jumps, refined
from livedeform.fem_node.simulator import Kind


@dataclass(frozen=True)
class Known:
    """A ``second`` body for a recording, of elements that are smaller where the probe presses, by which the
    ``declared`` model gave this run."""

    second: Body
    declared: Run


@dataclass(frozen=True)
class Halved:
    """A ``body`` whose ``uneven`` elements (n,) of a second one are halved, which are ``split`` (n,) with some beside
    them for faces to fit, and what that ``alone`` improves."""

    uneven: NDArray[np.bool_]
    split: NDArray[np.bool_]
    body: Body
    alone: Correction


@dataclass(frozen=True)
class Anew:
    """The discretisation error of a model with effects in it, by a ``body`` that remembers nothing but how the probe
    rubs, of the recordings that are ``known`` (by their first moment); the ``declared`` model's is known at all their
    moments. ``slips``: whether the body's probe does, where the declared one sticks.

    Where a modulus jumps elements are halved once more. What that alone improves is not for the effect to claim: any
    small inclusion under the probe would buy a better mesh with it.
    """

    body: Body
    known: Mapping[Key, Known]
    declared: Correction
    settings: DiscretisationSettings
    slips: bool = False
    processes: int = 2
    halved: dict[Key, list[Halved]] = field(default_factory=dict)
    drags: dict[tuple[Key, Kind], ElementDrag] = field(default_factory=dict)

    def __call__(
        self,
        effects: Sequence[EffectValues],
        observations: Sequence[Observation],
        own: Callable[[], Sequence[Run]],
        columns: Sequence[Column] = (),
    ) -> Correction | None:
        """Return the correction of the model's ``own`` runs, with derivatives for their ``columns``. None where the
        effects leave the body alone, and for a body that remembers: its whole path would be gone on the refined mesh,
        which takes minutes. That is worth it for friction that is an effect (`FrictionOnRefinedMesh`), and where the
        declared probe rubs for what is uneven: what is even changes little of the declared model's."""
        rubs = bool(memory_of(self.body.physics([])).rubs)
        begins = not rubs and any(makes_rub(e.name) for e in effects)
        if not (self.slips or begins):
            return self._of_others(effects, observations, own, columns)
        others = [e for e in effects if not makes_rub(e.name)]
        their = [c for c in columns if not c.candidate.info.rubs]
        slips = [self.body] * len(observations)
        found = self._of_others(
            others, observations, lambda: simulate_each(slips, others, observations, their, self.processes), their
        )
        friction = {(c.candidate.name, c.coordinate): c.z[c.coordinate] for c in columns if c.candidate.info.rubs}
        if self.slips or len(friction) != 1 or remembers(self.body.physics(effects)):
            return found
        if any(u.any() for u in self._uneven(self.body.physics(others), observations)):
            return found  # by other meshes than the declared model's
        base = self.declared if found is None else self.declared.updated(found)
        second = [self._known(o).second for o in observations]
        dragged = FrictionOnRefinedMesh(self.settings, self.processes, self.drags)
        return dragged(effects, observations, own, second, base, friction) or found

    def _of_others(
        self,
        effects: Sequence[EffectValues],
        observations: Sequence[Observation],
        own: Callable[[], Sequence[Run]],
        columns: Sequence[Column],
    ) -> Correction | None:
        """Return the correction of effects by which no probe begins to rub."""
        physics = self.body.physics(effects)
        if remembers(physics) or not any(e.name in MECHANICAL for e in effects):
            return None
        uneven = self._uneven(physics, observations)
        halve = any(there.any() for there in uneven)
        if memory_of(self.body.physics([])).rubs and not halve:
            return None
        runs = own()
        if halve:
            return self._on_smaller(effects, observations, runs, columns, uneven)
        return self._pressed_first(effects, observations, runs, columns)

    def _uneven(self, physics: Physics, observations: Sequence[Observation]) -> list[NDArray[np.bool_]]:
        """Return which elements (n,) of each refined mesh are to be halved: uneven ones, unless that is nearly all."""
        each = [jumps(self._known(o).second.setting.mesh, physics) for o in observations]
        return [there & (there.mean() < self.settings.most_uneven) for there in each]

    def _known(self, o: Observation) -> Known:
        return self.known[first_key(o)]

    def _on_smaller(
        self,
        effects: Sequence[EffectValues],
        observations: Sequence[Observation],
        runs: Sequence[Run],
        columns: Sequence[Column],
        uneven: Sequence[NDArray[np.bool_]],
    ) -> Correction:
        """Return the correction by meshes with their ``uneven`` elements (n,) halved."""
        bodies, alone = [], Correction()
        for o, there in zip(observations, uneven, strict=True):
            halved = self._halved(o, there) if there.any() else None
            bodies.append(self._known(o).second if halved is None else halved.body)
            alone = alone if halved is None else alone.updated(halved.alone)
        told = simulate_each(bodies, effects, observations, columns, self.processes)
        return difference(observations, runs, told, columns).less(alone)

    def _halved(self, o: Observation, uneven: NDArray[np.bool_]) -> Halved:
        """Return the body with its ``uneven`` elements (n,) halved, or one that has more of them halved: it is as
        exact, and starts from what it solved of the effects as they were a step of the fit before."""
        before = self.halved.setdefault(first_key(o), [])
        fit = [halved for halved in before if halved.split[uneven].all()]
        if fit:
            return min(fit, key=lambda halved: int(halved.split.sum()))
        both = uneven | before[-1].uneven if before else uneven
        before.append(self._made(o, both if both.mean() < self.settings.most_uneven else uneven))
        return before[-1]

    def _made(self, o: Observation, uneven: NDArray[np.bool_]) -> Halved:
        """Make the body with its ``uneven`` elements (n,) halved, and find what that alone improves."""
        known = self._known(o)
        mesh = refined(known.second.setting.mesh, np.flatnonzero(uneven))
        body = Body(replace(known.second.setting, mesh=mesh))
        body.start_from(known.second)
        told = simulate_each([body], [], [o], (), self.processes)
        return Halved(uneven, split(known.second.setting.mesh, mesh), body, difference([o], [known.declared], told))

    def _pressed_first(
        self,
        effects: Sequence[EffectValues],
        observations: Sequence[Observation],
        runs: Sequence[Run],
        columns: Sequence[Column],
    ) -> Correction:
        """Return the correction by the deepest moments, or by all if they change much of it."""
        deep = [np.isin(np.arange(o.n_moments), o.deepest(self.settings.most_presses)) for o in observations]
        found = self._solved(effects, observations, runs, columns, deep)
        if is_small(found, self.declared, observations, self.settings.remains):
            return spread(found, self.declared, observations, runs)
        return found.updated(self._solved(effects, observations, runs, columns, [~d for d in deep]))

    def _solved(
        self,
        effects: Sequence[EffectValues],
        observations: Sequence[Observation],
        runs: Sequence[Run],
        columns: Sequence[Column],
        keep: Sequence[np.ndarray],
    ) -> Correction:
        """Return the correction of the moments that are kept (k,)."""
        asked = [n for n, moments in enumerate(keep) if moments.any()]
        some = [observations[n].take(keep[n]) for n in asked]
        bodies = [self._known(observations[n]).second for n in asked]
        told = simulate_each(bodies, effects, some, columns, self.processes) if some else []
        return difference(some, [runs[n].take(keep[n]) for n in asked], told, columns)


def split(before: TetMesh, after: TetMesh) -> NDArray[np.bool_]:
    """Return which elements (n,) of the mesh ``before`` are no elements of the one ``after`` it was refined."""
    whole = {tuple(corners) for corners in np.sort(after.tets, axis=1).tolist()}
    return np.array([tuple(corners) not in whole for corners in np.sort(before.tets, axis=1).tolist()])


def remembers(physics: Physics) -> bool:
    """Tell whether a body remembers more than how the probe rubs."""
    return bool(replace(memory_of(physics), rubs=()).path_dependent) or pulls(physics.probe)


def is_small(found: Correction, declared: Correction, observations: Sequence[Observation], most: float) -> bool:
    """Tell whether the correction that was ``found`` at some moments differs from the ``declared`` model's, in what it
    takes off the motion, by at most that part of it. A moment that has not converged tells nothing."""
    change2 = motion2 = 0.0
    for o in observations:
        keys = [key for key in keys_of(o) if key in found.points]
        if not keys or keys[0] != first_key(o) or not all(key in declared.points for key in keys_of(o)):
            return False
        rest = found.points[keys[0]] - declared.points[keys[0]]
        for key in keys[1:]:
            change2 += float(((found.points[key] - declared.points[key] - rest) ** 2).sum())
            motion2 += float(((declared.points[key] - declared.points[keys[0]]) ** 2).sum())
    return change2 <= most**2 * motion2


def spread(
    found: Correction, declared: Correction, observations: Sequence[Observation], runs: Sequence[Run]
) -> Correction:
    """Return the correction that was ``found`` at some moments at all of them: what differs from the ``declared``
    model's is that of the first moment and, in proportion to their motion in the model's ``runs``, that of the moment
    whose motion is most alike."""
    points, forces = dict(found.points), dict(found.forces)
    d_points, d_forces = dict(found.d_points), dict(found.d_forces)
    for o, run in zip(observations, runs, strict=True):
        keys, rest = keys_of(o), first_key(o)
        moved = (run.points - run.points[0]).reshape(o.n_moments, -1)
        solved = [k for k in range(1, o.n_moments) if keys[k] in found.points]
        for k, key in enumerate(keys):
            if key in found.points or not np.isfinite(moved[k]).all():
                continue
            like, share = most_alike(moved[k], moved[solved])
            there = rest if like is None else keys[solved[like]]
            for values, given in ((points, declared.points), (forces, declared.forces)):
                if all(each in values and each in given for each in (rest, there)) and key in given:
                    first, last = values[rest] - given[rest], values[there] - given[there]
                    values[key] = given[key] + first + share * (last - first)
            for values in (d_points, d_forces):
                if rest in values and there in values:
                    values[key] = values[rest] + share * (values[there] - values[rest])
    return Correction(points, forces, found.z, d_points, d_forces)


def most_alike(moved: Array, others: Array) -> tuple[int | None, float]:
    """Return which of the motions ``others`` (n, p) is most like one (p,) in direction, and how far that goes along it,
    0 to 1; none where nothing moves."""
    along, size = others @ moved, np.linalg.norm(others, axis=1)
    if not len(others) or not moved.any() or not size.all():
        return None, 0.0
    best = int(np.argmax(along / size))
    return best, float(np.clip(along[best] / size[best] ** 2, 0.0, 1.0))
