"""Tell what elements drag more than the body does, where friction under the probe is an effect.

Coarse elements stick and slide as a whole, so that the same friction moves the surface by another amount: at 10 mm
under a ball of 22 mm by 10 % more in one recording and by 4 % less in another. Where the surface goes depends on its
path, so that the refined mesh is led along all of it, which takes a minute. That is done at one friction, and goes on
in proportion from there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Correction, Key, Name, Run, difference, first_key
from livedeform.closed_loop.model.fem_model import Body, kind_of
from livedeform.closed_loop.model.workers import simulate_each
from livedeform.closed_loop.settings import DiscretisationSettings
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.simulator import Kind


@dataclass(frozen=True)
class ElementDrag:
    """Holds what the refined mesh of a recording tells differently per unit of friction, ``points`` (m, 3) m and
    ``forces`` (3,) N by moment, as it was found at a friction ``at``."""

    at: float
    points: Mapping[Key, Array]
    forces: Mapping[Key, Array]

    @classmethod
    def of(cls, at: float, found: Correction) -> ElementDrag:
        """Make it of the correction that was ``found`` beyond that without friction."""
        points, forces = ({key: value / at for key, value in of.items()} for of in (found.points, found.forces))
        return cls(at, points, forces)


@dataclass(frozen=True)
class FrictionOnRefinedMesh:
    """Tells what elements drag more; it is ``known`` of recordings (by their first moment) with effects of one kind."""

    settings: DiscretisationSettings
    processes: int = 2
    known: dict[tuple[Key, Kind], ElementDrag] = field(default_factory=dict)

    def __call__(
        self,
        effects: Sequence[EffectValues],
        observations: Sequence[Observation],
        own: Callable[[], Sequence[Run]],
        second: Sequence[Body],
        base: Correction,
        friction: Mapping[Name, float],
    ) -> Correction | None:
        """Return the correction of the ``own`` runs with all ``effects``, of which ``friction`` is one: the ``base``
        without it on the same bodies, and what elements drag more than the ``second`` bodies' do. None where that
        cannot be told: their paths would take too long, or most moments have no answer."""
        ((name, z),) = friction.items()
        if z <= 0.0 or any(body.unknowns > self.settings.most_rubbing for body in second):
            return None
        keys = [(first_key(o), kind_of(effects)) for o in observations]
        far = [n for n, key in enumerate(keys) if not self._is_near(key, z)]
        if far:
            asked, runs = [observations[n] for n in far], own()
            told = simulate_each([second[n] for n in far], effects, asked, (), self.processes)
            for n, o, run in zip(far, asked, told, strict=True):
                self.known[keys[n]] = ElementDrag.of(z, difference([o], [runs[n]], [run]).less(base))
        drags = [self.known[key] for key in keys]
        if any(2 * len(drag.points) < o.n_moments for drag, o in zip(drags, observations, strict=True)):
            return None
        return with_drags(base, drags, name, z)

    def _is_near(self, key: tuple[Key, Kind], z: float) -> bool:
        known, most = self.known.get(key), self.settings.follows
        return known is not None and 1.0 / most <= z / known.at <= most


def with_drags(base: Correction, drags: Sequence[ElementDrag], name: Name, z: float) -> Correction:
    """Return the correction ``base`` of a body without friction with ``drags`` at a friction ``z``, the coordinate of
    that ``name``, and its derivative."""
    points = {key: value for drag in drags for key, value in drag.points.items()}
    forces = {key: value for drag in drags for key, value in drag.forces.items()}
    (markers, *_) = points.values()

    def sums(known: Mapping[Key, Array], per_unit: Mapping[Key, Array]) -> dict[Key, Array]:
        return {**known, **{key: known.get(key, 0.0) + z * value for key, value in per_unit.items()}}

    def slopes(known: Mapping[Key, Array], per_unit: Mapping[Key, Array], shape: tuple[int, ...]) -> dict[Key, Array]:
        nothing, none = np.zeros((*shape, len(base.z))), np.zeros(shape)
        keys = known.keys() | per_unit.keys()
        return {
            key: np.concatenate([known.get(key, nothing), per_unit.get(key, none)[..., None]], axis=-1) for key in keys
        }

    d_points, d_forces = slopes(base.d_points, points, markers.shape), slopes(base.d_forces, forces, (3,))
    return Correction(sums(base.points, points), sums(base.forces, forces), {**base.z, name: z}, d_points, d_forces)
