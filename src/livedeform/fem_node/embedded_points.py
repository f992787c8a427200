"""Points that the body carries: markers and lesions, inside, on the surface, or on a stalk outside."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.element.element import Space, shape_derivatives, shape_values
from livedeform.fem_node.materials.volume import polar_rotation
from livedeform.fem_node.mesh.tet_mesh import locate


class EmbeddedPoints:
    """``points`` (n, 3) m in the scanned configuration; those where ``still`` (n,) do not move.

    A point of the body moves with its element's shape functions. One outside hangs on its nearest surface point: its
    offset turns with the surface, by the rotation of the surface's own deformation (tangents by F, normal by F^-T).
    """

    def __init__(self, space: Space, points: Array, still: NDArray[np.bool_] | None = None) -> None:
        self.points = np.asarray(points, float).reshape(-1, 3)
        where = locate(space.mesh, self.points) if len(self.points) else None
        moving = np.ones(len(self.points), bool) if still is None else ~still
        self._moving = np.flatnonzero(moving)
        if where is None:
            return
        self._nodes = space.cells[where.tet[moving]]
        self._values = shape_values(where.barycentric[moving], quadratic=space.quadratic)
        offset = where.offset[moving]
        self._outside = np.flatnonzero(np.linalg.norm(offset, axis=1) > 1e-9)
        self._offset = offset[self._outside]
        tets = where.tet[moving][self._outside]
        corners = space.mesh.nodes[space.mesh.tets[tets]]
        inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
        grad_L = np.concatenate([-inverse.sum(axis=2)[:, None], inverse.transpose(0, 2, 1)], axis=1)
        dN = shape_derivatives(where.barycentric[moving][self._outside], quadratic=space.quadratic)
        self._gradients = np.einsum("mak,mkj->maj", dN, grad_L)

    @property
    def nodes(self) -> NDArray[np.int64]:
        """The nodes that carry them."""
        return np.unique(self._nodes) if len(self._moving) else np.zeros(0, np.int64)

    @property
    def still(self) -> NDArray[np.bool_]:
        """Return which of the points (n,) do not move."""
        return ~np.isin(np.arange(len(self.points)), self._moving)

    def positions(self, u: Array) -> Array:
        """Return where they are (n, 3) m at the nodal displacements ``u`` (nodes, 3) m."""
        out = self.points.copy()
        if len(self._moving) == 0:
            return out
        out[self._moving] += np.einsum("ma,mai->mi", self._values, u[self._nodes])
        if len(self._outside) and np.all(np.isfinite(u)):
            F = np.eye(3) + np.einsum("mai,maj->mij", u[self._nodes[self._outside]], self._gradients)
            out[self._moving[self._outside]] += (
                np.einsum("mij,mj->mi", _turn(F, self._offset), self._offset) - self._offset
            )
        return out


def _turn(F: Array, offset: Array) -> Array:
    """Rotation (m, 3, 3) of a surface with normals along ``offset`` (m, 3)."""
    N = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    n = np.linalg.solve(F.transpose(0, 2, 1), N[:, :, None])[:, :, 0]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    NN = N[:, :, None] * N[:, None, :]
    return polar_rotation(F @ (np.eye(3) - NN) + n[:, :, None] * N[:, None, :])
