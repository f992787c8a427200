"""What a small step in a candidate's coordinate changes in the equilibrium's equations: dr/dp of
`closed_loop.model.fem_model`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import Local, ProbeContact
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.items.continuum import Continuum
from livedeform.fem_node.items.loads import Weight
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.items.supports import Springs, make_supports, supported_face, supported_nodes
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.solve.assembly import System


class Variant:
    """The physics a small step ``h`` away in one coordinate: only the items that differ are evaluated.

    ``passing``: its column differs between moments of equal pose. ``imposed`` (n_dof,): displacements of held nodes.
    """

    def __init__(
        self,
        space: Space,
        base: Mechanics,
        reference: Physics,
        changed: Physics,
        h: float,
        unloaded: Array | None,
        o: Observation,
    ) -> None:
        self.h, self.physics, self.o = h, changed, o
        self.poses: list[Array | None] = []
        self.imposed: Array | float = 0.0
        self._system: System | None = None
        self._direct: Array = np.zeros(0)
        self._n_nodes = space.n_nodes
        probe, other = changed.probe, reference.probe
        self.moves_probe = self.moves_in_time = False
        if probe is not None and other is not None:
            self.moves_in_time = probe.time_offset != other.time_offset
            self.moves_probe = self.moves_in_time or not np.array_equal(probe.offset, other.offset)
        inner, outer = _bulk(changed), _bulk(reference)
        reshaped = unloaded is not base.unloaded
        self.continuum: Continuum | None = None
        if reshaped or not same(inner, outer):
            self.continuum = Continuum(space, changed, unloaded)
        self.weight: Weight | None = None
        heavier = changed.density != reference.density or not np.array_equal(changed.gravity, reference.gravity)
        if heavier or reshaped:
            self.weight = Weight(space, changed.density, (self.continuum or base.continuum).mass_weights)
        self.gives = _gives(space, reference, changed)
        self.springs: list[Springs] = []
        if self.gives is None and changed.supports != reference.supports:
            supports = make_supports(space, changed, unloaded)
            self.springs = [item for item in supports if isinstance(item, Springs)]
        memories = memory_of(reference), memory_of(changed)
        self.passing = self.moves_in_time or any(m.drifts or m.relaxes or m.sets for m in memories)

    def start(self, moment: Moment, base: Mechanics) -> None:
        """The state at rest is the history's beginning."""
        if self.continuum is not None:
            self.continuum.prepare(moment)
            self.continuum.update(base.x)
            self.continuum.commit(base.x)

    def residual_change(
        self, base: Mechanics, i: int, held: NDArray[np.int64], part: Local | None, forces: dict[int, Array]
    ) -> Array:
        """dr / dz (n_dof,) at the base's solution, where the contact is ``part``; ``forces`` of the base's items there,
        by their `id`, as far as another variant has asked for them."""
        if self._system is None:
            self._system = System(base.solver.pattern)
        x, moment = base.x, base.moment
        r = np.zeros_like(self._system.r)
        if self.continuum is not None:
            self.continuum.prepare(moment)
            if base.physics.plastic_set is not None and self.physics.plastic_set is not None:
                self.continuum.set_like(base.continuum)
            else:
                self.continuum.update(x)
            r += self._of(x, self.continuum) - self._once(forces, x, base.continuum)
        if self.weight is not None:
            active = float(np.linalg.norm(moment.gravity)) > 0.0
            self.weight.prepare(replace(moment, gravity=self.physics.gravity) if active else moment)
            r += self._of(x, self.weight) - self._once(forces, x, base.weight)
        if self.springs:
            before = [item for item in base.items if isinstance(item, Springs)]
            r += self._of(x, *self.springs) - self._of(x, *before)
        self._direct = np.zeros_like(r)  # of the contact
        pose = self.poses[i]
        if self.moves_probe and base.contact is not None and part is not None and pose is not None:
            self._direct += base.contact.moved(part, pose, x)
        r += self._direct
        if self.gives is not None:
            self.imposed = self.gives(self._of(x, *base.items), held)
            e = 1e-6 / max(float(np.abs(self.imposed).max()), 1e-12)
            return (self._of(x + e * self.imposed, *base.items) - self._of(x, *base.items)) / e
        return r / self.h

    def _once(self, forces: dict[int, Array], x: Array, item: Any) -> Array:
        if id(item) not in forces:
            forces[id(item)] = self._of(x, item)
        return forces[id(item)]

    def _of(self, x: Array, *items: Any) -> Array:
        assert self._system is not None  # made by residual_change
        self._system.clear(tangent=False)
        for item in items:
            item.evaluate(x, self._system, tangent=False)
        return self._system.r.copy()

    def force_change(self, contact: ProbeContact, part: Local, dx: Array) -> Array:
        """d force / dz (3,): what the contact's springs do as the body moves by ``dx``, and what the variant does to
        them at once."""
        pulled = part.times(dx[contact.dofs[part.facets]]).reshape(-1, 3).sum(axis=0)
        n = 3 * self._n_nodes
        at_once = self._direct[:n].reshape(-1, 3).sum(axis=0) / self.h
        return np.asarray(-pulled - at_once)

    def commit(self, x: Array, moment: Moment) -> None:
        """The variant's own path goes into its memory."""
        if self.continuum is not None:
            self.continuum.commit(x)


class _Give:
    """A support that gives way a little: held nodes move by their traction times a compliance (first order).

    The traction is M^-1 R with the reactions R of the ``nodes`` (n,) and the mass matrix of the base's ``facets``;
    ``compliance`` m/Pa per unit of the coordinate, along ``axes`` (3,) bool.
    """

    def __init__(
        self, space: Space, facets: NDArray[np.int64], nodes: NDArray[np.int64], compliance: float, axes: Array
    ) -> None:
        values, weights, _ = space.facet_rule(4, space.facets[facets])
        blocks = np.einsum("kq,qa,qb->kab", weights, values, values)
        used, place = np.unique(space.facets[facets], return_inverse=True)
        place = place.reshape(len(facets), -1)
        n = place.shape[1]
        rows, columns = np.repeat(place, n, axis=1).ravel(), np.tile(place, (1, n)).ravel()
        self._mass = splu(csc_array((blocks.ravel(), (rows, columns)), shape=(len(used), len(used))))
        self._used, self._gives = used, np.isin(used, nodes)
        self.compliance, self.axes = compliance, axes

    def __call__(self, residual: Array, held: NDArray[np.int64]) -> Array:
        """Imposed displacements (n_dof,): the support pushes the body with ``residual`` there, and the body it back."""
        out = np.zeros_like(residual)
        for a in np.flatnonzero(self.axes):
            dofs = 3 * self._used + a
            traction = self._mass.solve(residual[dofs])
            out[dofs] = np.where(self._gives, -self.compliance * traction, 0.0)
        keep = np.zeros(len(out), bool)
        keep[held] = True
        return np.where(keep, out, 0.0)


def _gives(space: Space, reference: Physics, changed: Physics) -> _Give | None:
    """What a change of the supports does to first order: springs instead of a bond, or a strip that is free."""
    for before, after in zip(reference.supports, changed.supports, strict=True):
        if before.type != "fixed" or before is after:
            continue
        face, nodes = supported_face(space, before), supported_nodes(space, before)
        if after.type == "spring":
            axes = np.array([a != face.axis for a in range(3)])
            return _Give(space, face.facets, face.nodes, 1.0, axes)
        free = np.setdiff1d(nodes, supported_nodes(space, after))
        width = 2.8 * float(np.ptp(space.nodes[nodes], axis=0).max())
        if len(free):
            return _Give(space, face.facets, free, width / changed.material.youngs_modulus, np.ones(3, bool))
    return None


def _bulk(physics: Physics) -> Physics:
    """What the continuum alone depends on."""
    return replace(physics, probe=None, gravity=np.zeros(3), supports=(), loads=(), density=0.0, scan_fraction=0.0)


def same(a: Any, b: Any) -> bool:
    """Equal physics, arrays included."""
    for name in a.__dataclass_fields__:
        x, y = getattr(a, name), getattr(b, name)
        if isinstance(x, np.ndarray) or isinstance(y, np.ndarray):
            if not np.array_equal(x, y):
                return False
        elif x is not y and x != y:
            return False
    return True
