"""The truth's body in pieces: elements, faces, what its base holds, and the pattern of its matrix."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.synthetic.truth import kernels
from livedeform.synthetic.truth.hexmesh import HexMesh, IntArray, face_gradient, face_shape, gauss, hex_shape
from livedeform.synthetic.truth.linear import Factors
from livedeform.synthetic.truth.physics import TruthPhysics

CONTACT_POINTS = 4  # along each side of a face: twice as many take twice the iterations, for 0.1-0.8 % of a force
# of equal weight, on each side of a face that sticks: what one point bears comes off at once, and the last ones decide
# how much a probe pulls. A ball of 20 mm on elements of 10 mm pulls by 0.8 to 0.95 of what Johnson, Kendall & Roberts
# (1971) say, with 4 points of Gauss by 1.2 to 2.2
STICKING_POINTS = 6


class Discretisation:
    """Hold what the mesh and its support decide: gradients, volumes, areas, free unknowns and the sparse pattern.

    ``G0`` (m, q, 3, 27) gradients and ``w0`` (m, q) m3 volumes of the unloaded body; ``places`` (m, q, 3) m;
    ``free`` (k,) unknowns; ``factors`` solves with the matrix of the free ones.
    """

    def __init__(self, mesh: HexMesh, physics: TruthPhysics) -> None:
        self.mesh = mesh
        self._elements()
        self._faces(sticks=physics.adhesion > 0.0)
        self._hold(physics.base_stiffness, physics.base_free)
        self._graph()

    def _elements(self) -> None:
        points, weights = gauss(3, 3)
        shape, local = hex_shape(points)
        self.G0, det = kernels.gradients(self.mesh.nodes, self.mesh.hexes, local)
        self.w0 = np.ascontiguousarray(det * weights)
        self.psi = np.column_stack([np.ones(len(points)), points])
        self.places = np.einsum("qa,mad->mqd", shape, self.mesh.nodes[self.mesh.hexes])
        lumped = np.einsum("mq,qa->ma", self.w0, shape)
        self.volume = np.bincount(self.mesh.hexes.reshape(-1), lumped.reshape(-1), len(self.mesh.nodes))

    def _faces(self, *, sticks: bool) -> None:
        points, weights = gauss(2, 2, STICKING_POINTS // 2) if sticks else gauss(CONTACT_POINTS, 2)
        self.face_N = face_shape(points)
        dN = face_gradient(points)
        corners = self.mesh.nodes[self.mesh.faces]
        tangents = np.einsum("qla,fad->fqld", dN, corners)
        area = np.linalg.norm(np.cross(tangents[:, :, 0], tangents[:, :, 1]), axis=2) * weights
        self.is_base = (np.abs(corners[:, :, 2]) < 1e-9).all(1)
        self.free_faces = self.mesh.faces[~self.is_base]
        self.base_faces = self.mesh.faces[self.is_base]
        self.face_area = area[~self.is_base]
        self.base_area = area[self.is_base]

    def _hold(self, base_stiffness: float | None, base_free: Callable[[Array], NDArray[np.bool_]] | None) -> None:
        nodes = self.mesh.nodes
        on_base = np.zeros(len(nodes), bool)
        on_base[self.base_faces] = True
        if base_free is not None:
            on_base &= ~base_free(nodes)
        self.held_nodes = on_base
        held = np.zeros((len(nodes), 3), bool)
        held[on_base, 2] = True
        if base_stiffness is None:
            held[on_base] = True
        self.free = np.flatnonzero(~held.reshape(-1))
        self.spring_block = np.zeros(0)
        if base_stiffness is not None:
            M = np.einsum("fq,qa,qb->fab", self.base_area, self.face_N, self.face_N) * base_stiffness
            self.spring_block = np.einsum("fab,ij->faibj", M, np.diag([1.0, 1.0, 0.0]))

    def _graph(self) -> None:
        """Number the matrix's pattern, and where each element's and face's entries go."""
        n = len(self.mesh.nodes)
        hexes = self.mesh.hexes
        rows = np.repeat(hexes, 27, axis=1).reshape(-1)
        cols = np.tile(hexes, (1, 27)).reshape(-1)
        keys, inverse = np.unique(rows * n + cols, return_inverse=True)
        row, col = keys // n, keys % n
        start = np.searchsorted(row, np.arange(n + 1))
        # row 3a + i holds the triples of all neighbours of a
        width = np.diff(start)
        row_start = 9 * start[:-1]
        pair_at = row_start[row] + 3 * (np.arange(len(keys)) - start[row])
        stride = 3 * width[row]
        at = pair_at[:, None] + stride[:, None] * np.arange(3)
        self._keys, self._at, self._n = keys, at, n
        self.position = np.ascontiguousarray(at[inverse].reshape(len(hexes), 27, 27, 3).astype(np.int64))
        self.free_position = self._face_position(self.free_faces)
        self.base_position = self._face_position(self.base_faces)
        self.n_data = 9 * len(keys)
        self._free_part(at, width, col)

    def _free_part(self, at: Array, width: IntArray, col: IntArray) -> None:
        """Keep of the pattern what is free: ``at`` (k, 3), where the pairs' rows start, ``width`` (n,) of the rows."""
        n = self._n
        dof_row = np.repeat(np.arange(3 * n), np.repeat(3 * width, 3))
        dof_col = np.empty(self.n_data, np.int64)
        for i in range(3):
            for j in range(3):
                dof_col[at[:, i] + j] = 3 * col + j
        number = np.full(3 * n, -1)
        number[self.free] = np.arange(len(self.free))
        keep = (number[dof_row] >= 0) & (number[dof_col] >= 0)
        self.factors = Factors(number[dof_row[keep]], number[dof_col[keep]], np.flatnonzero(keep), len(self.free))

    def _face_position(self, faces: IntArray) -> Array:
        rows = np.repeat(faces, 9, axis=1).reshape(-1).astype(np.int64)
        cols = np.tile(faces, (1, 9)).reshape(-1).astype(np.int64)
        found = np.searchsorted(self._keys, rows * self._n + cols)
        return np.ascontiguousarray(self._at[found].reshape(len(faces), 9, 9, 3))

    def block_of_node(self, a: int) -> IntArray:
        """Return where the three rows (3,) of the node's own diagonal block start in the matrix's values."""
        rows: IntArray = self._at[np.searchsorted(self._keys, a * self._n + a)]
        return rows

    def _face_places(self, x: Array) -> Array:
        """Return the quadrature points (p, 3) m of all free faces of the body at ``x`` (n, 3) m."""
        places: Array = np.einsum("qa,fad->fqd", self.face_N, x[self.free_faces]).reshape(-1, 3)
        return places
