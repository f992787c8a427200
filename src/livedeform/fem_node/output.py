"""Solutions as files for ParaView: one step as VTU, several as an XDMF series (meshio).

Point fields: ``displacement`` m (from the scanned shape), ``contact_force`` N, and, averaged from the quadrature
points to the nodes, ``strain`` (Green-Lagrange, from the unloaded shape) and ``stress`` (Cauchy, Pa) as xx yy zz xy
yz xz, ``von_mises``, ``pressure`` Pa.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.element.element import TET_EDGES, Space
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.solve.assembly import System

_VOIGT = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


def write_step(path: Path | str, mechanics: Mechanics) -> None:
    """Writes where the body is now, in the scanned configuration with displacements (.vtu or any format of meshio)."""
    meshio.Mesh(mechanics.space.nodes, _cells(mechanics.space), point_data=fields(mechanics)).write(path)


def write_series(path: Path | str, steps: Iterable[tuple[float, Mechanics]]) -> None:
    """Writes (time s, body) pairs as an XDMF series; the body may be the same object, moved on between two steps.

    The numbers stand in the file itself, as text, so that neither HDF5 nor a second file is needed; a step of 20 000
    unknowns takes 3.7 MB. For long series write one VTU (compressed, 1.3 MB) per step with `write_step`.
    """
    iterator = iter(steps)
    time, mechanics = next(iterator)
    with meshio.xdmf.TimeSeriesWriter(str(path), data_format="XML") as writer:
        writer.write_points_cells(mechanics.space.nodes, _cells(mechanics.space))
        writer.write_data(time, point_data=fields(mechanics))
        for time, mechanics in iterator:
            writer.write_data(time, point_data=fields(mechanics))


def fields(mechanics: Mechanics) -> dict[str, Array]:
    """The nodal fields (n, ...) of the committed state."""
    F, sigma = mechanics.continuum.stress(mechanics.x)
    E = 0.5 * (F.swapaxes(2, 3) @ F - np.eye(3))
    deviator = sigma - np.trace(sigma, axis1=2, axis2=3)[..., None, None] / 3.0 * np.eye(3)
    von_mises = np.sqrt(1.5 * np.einsum("eqij,eqij->eq", deviator, deviator))
    average = _Averager(mechanics.space)
    return {
        "displacement": mechanics.u.copy(),
        "contact_force": contact_forces(mechanics),
        "strain": np.column_stack([average(E[..., i, j]) for i, j in _VOIGT]),
        "stress": np.column_stack([average(sigma[..., i, j]) for i, j in _VOIGT]),
        "von_mises": average(von_mises),
        "pressure": average(-np.trace(sigma, axis1=2, axis2=3) / 3.0),
    }


def contact_forces(mechanics: Mechanics) -> Array:
    """The probe's force on every node (n, 3) N."""
    out = np.zeros(3 * mechanics.space.n_nodes)
    if mechanics.contact is not None:
        system = System(mechanics.solver.pattern)
        mechanics.contact.evaluate(mechanics.x, system, tangent=False)
        out = -system.r[: len(out)]
    return out.reshape(-1, 3)


def _cells(space: Space) -> list[tuple[str, NDArray[np.int64]]]:
    return [("tetra10" if space.quadratic else "tetra", space.cells)]


class _Averager:
    """Bring values from quadrature points to nodes: fitted linearly in each element, then averaged by volume."""

    def __init__(self, space: Space) -> None:
        corners = np.eye(4) if not space.quadratic else np.concatenate([np.eye(4), _middles()])
        self._extrapolate = corners @ np.linalg.pinv(space.barycentric)  # (a, q)
        self._cells, self._n = space.cells, space.n_nodes
        self._volumes = np.repeat(space.mesh.volumes[:, None], space.cells.shape[1], axis=1)
        self._total = np.bincount(self._cells.ravel(), self._volumes.ravel(), minlength=self._n)

    def __call__(self, values: Array) -> Array:
        at_nodes = values @ self._extrapolate.T * self._volumes
        return np.bincount(self._cells.ravel(), at_nodes.ravel(), minlength=self._n) / self._total


def _middles() -> Array:
    middles = np.zeros((6, 4))
    middles[np.arange(6)[:, None], TET_EDGES] = 0.5
    return middles
