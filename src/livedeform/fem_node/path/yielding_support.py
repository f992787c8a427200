"""A bond that begins to give way, to first order: a support that holds exactly has no parameter to differentiate by."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from livedeform.common.types import Array
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.items.supports import Behind, supported_face, supported_nodes
from livedeform.fem_node.physics.record import PartialRegion, Physics, Support

DEGREE = 4  # of the quadrature of the facets' mass matrix
STRIP = 2.8  # times the bond's width over the modulus: the compliance of a strip that lets go


class YieldingSupport:
    """Held nodes that move by their traction times a compliance.

    The traction is M^-1 R with the reactions R of the ``nodes`` (n,) and the mass matrix of the boundary ``facets``;
    ``compliance()`` m/Pa per unit of the coordinate, along ``axes`` (3,) bool.
    """

    def __init__(
        self,
        space: Space,
        facets: NDArray[np.int64],
        nodes: NDArray[np.int64],
        compliance: Callable[[], float],
        axes: Array,
    ) -> None:
        values, weights, _ = space.facet_rule(DEGREE, space.facets[facets])
        blocks = np.einsum("kq,qa,qb->kab", weights, values, values)
        used, place = np.unique(space.facets[facets], return_inverse=True)
        place = place.reshape(len(facets), -1)
        n = place.shape[1]
        rows, columns = np.repeat(place, n, axis=1).ravel(), np.tile(place, (1, n)).ravel()
        self._mass = splu(csc_array((blocks.ravel(), (rows, columns)), shape=(len(used), len(used))))
        self._used, self._gives = used, np.isin(used, nodes)
        self.compliance, self.axes = compliance, axes

    def imposed(self, residual: Array, held: NDArray[np.int64]) -> Array:
        """Return displacements (n_dof,) of the ``held`` dofs per unit of the coordinate: the support pushes the body
        with ``residual`` there, and the body it back."""
        out, compliance = np.zeros_like(residual), self.compliance()
        for a in np.flatnonzero(self.axes):
            dofs = 3 * self._used + a
            traction = self._mass.solve(residual[dofs])
            out[dofs] = np.where(self._gives, -compliance * traction, 0.0)
        keep = np.zeros(len(out), bool)
        keep[held] = True
        return np.where(keep, out, 0.0)


def _bonds(before: Support, after: Support) -> bool:
    """Return whether there is a bond to give way: also that along the normal, of whole springs that lose a strip."""
    loses = before.type == "spring" and isinstance(after.region, PartialRegion)
    return before.type == "fixed" or (loses and not isinstance(before.region, PartialRegion))


def yielding_support(space: Space, reference: Physics, changed: Physics, behind: Behind) -> YieldingSupport | None:
    """Return what a change of the supports does to a bond: springs instead of it, or a strip that is free. None if the
    change leaves all bonds as they are. ``behind``: the modulus behind boundary facets, of the changed body."""
    for before, after in zip(reference.supports, changed.supports, strict=True):
        if before is after or not _bonds(before, after):
            continue
        face, nodes = supported_face(space, before), supported_nodes(space, before)
        if before.type != after.type:
            axes = np.array([a != face.axis for a in range(3)])
            return YieldingSupport(space, face.facets, face.nodes, lambda: 1.0, axes)
        free = np.setdiff1d(nodes, supported_nodes(space, after))
        width = STRIP * float(np.ptp(space.nodes[nodes], axis=0).max())
        if len(free):
            area = space.facet_rule(1, space.facets[face.facets])[1].sum(axis=1)

            def compliance(width: float = width, facets: NDArray[np.int64] = face.facets, area: Array = area) -> float:
                return width / float(np.exp(np.average(np.log(behind(facets)), weights=area)))

            return YieldingSupport(space, face.facets, free, compliance, np.ones(3, bool))
    return None
