"""A nearly incompressible body by felupe (Dutzler 2022): 27-node hexahedra with a linear pressure in each element.

Shape functions, quadrature, the neo-Hookean law, its three-field variation (displacement, pressure, volume ratio),
assembly and weight are felupe's; the pressure's four shape functions are handed to it here. What belongs to one element
only, pressure and volume ratio, is eliminated exactly: the unknowns are displacements.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.synthetic.truth.hexmesh import HexMesh, IntArray
from livedeform.synthetic.truth.physics import TruthPhysics


class FelupeBody:
    """Give inner forces and stiffness of ``mesh``'s body in felupe's discretisation; raise InputError without felupe.

    ``growth`` J_s: each volume grows to that without stress. ``weight`` (3 n,) N.
    """

    def __init__(self, mesh: HexMesh, physics: TruthPhysics) -> None:
        self.growth = 1.0
        fe = felupe()
        order = lattice(fe.element.TriQuadraticHexahedron())
        cells = fe.Mesh(mesh.nodes, mesh.hexes[:, order], "hexahedron27")
        region = fe.RegionTriQuadraticHexahedron(cells)
        u = fe.Field(region, dim=3)
        pressures = np.arange(4 * len(mesh.hexes)).reshape(-1, 4)
        apart = fe.Mesh(np.zeros((pressures.size, 3)), pressures, "linear pressure")
        dual = fe.Region(apart, _linear(fe), region.quadrature, grad=False)
        self._u = fe.FieldContainer([u])
        self._field = fe.FieldContainer([u, fe.Field(dual), fe.Field(dual, values=1.0)])
        self._dV, self._psi = region.dV, dual.h[:, :, 0]
        self._mass = np.linalg.inv(np.einsum("aq,bq,qc->cab", self._psi, self._psi, self._dV))
        places = fe.Field(region, dim=3, values=mesh.nodes).interpolate()
        factor = _moduli(physics, places)
        E, nu = physics.youngs_modulus, physics.poisson_ratio
        self._mu = factor * E / (2 * (1 + nu))
        self._neo_hooke = fe.NeoHooke(mu=self._mu)
        # what has grown by J_s: J_s (mu / 2 (J^-2/3 I1 - 3) + K / 2 (J / J_s - 1)^2)
        self._law = fe.NearlyIncompressible(
            self._neo_hooke,
            factor * E / (3 * (1 - 2 * nu)),
            dUdJ=lambda J, bulk: bulk * (J / self.growth - 1.0),
            d2UdJdJ=lambda J, bulk: bulk / self.growth,
        )
        for law in (self._neo_hooke, self._law):
            law.chunksize = None  # a part of the cells at a time, it would take the moduli of all
        self._form = fe.IntegralForm
        force = physics.density * np.asarray(physics.gravity, float)
        self.weight = fe.SolidBodyForce(self._u, values=list(force)).assemble.vector().toarray().ravel()

    def inner(self, u: Array) -> Array:
        """Return the inner forces (3 n,) N at displacements ``u`` (n, 3) m; what is not finite where it is folded."""
        self._displace(u)
        stress = self._law.gradient([*self._at_points(), None])[0]
        forces: Array = self._form([stress], self._u, self._dV).assemble().toarray().ravel()
        return forces

    def stiffness(self) -> csr_matrix:
        """Return the derivative (3 n, 3 n) N/m of the last ``inner``."""
        parts = self._law.hessian([*self._at_points(), None])
        K, B, _, _, _, C = self._form(parts, self._field, self._dV, self._field).integrate()
        cells = len(self._mass)
        flat = B.reshape(81, 4, cells).transpose(2, 0, 1) @ self._mass
        condensed = flat @ C.reshape(4, 4, cells).transpose(2, 0, 1) @ flat.transpose(0, 2, 1)
        K += condensed.reshape(cells, 27, 3, 27, 3).transpose(1, 2, 3, 4, 0)
        return self._form(parts[:1], self._u, self._dV, self._u).assemble(values=[K])

    def _displace(self, u: Array) -> None:
        """Set the displacements, and the pressures and volume ratios that belong to them."""
        self._neo_hooke.mu = self.growth * self._mu
        self._u[0].values[:] = u
        F = self._u.extract()[0]
        p, ratio = self._field[1], self._field[2]
        ratio.values[:, 0] = self._projected(np.linalg.det(F.transpose(2, 3, 0, 1)))
        at_points = np.einsum("aq,ca->qc", self._psi, ratio.values.reshape(-1, 4))
        p.values[:, 0] = self._projected(self._law.dUdJ(at_points, self._law.bulk))

    def _projected(self, values: Array) -> Array:
        """Return the linear functions (4 m,) nearest to ``values`` (q, m) at the quadrature points of each element."""
        load = np.einsum("aq,qc,qc->ca", self._psi, values, self._dV)
        found: Array = np.einsum("cab,cb->ca", self._mass, load).ravel()
        return found

    def _at_points(self) -> list[Array]:
        """Return deformation gradient, pressure and volume ratio at the quadrature points."""
        found: list[Array] = self._field.extract()
        return found


def _linear(fe: Any) -> Any:
    """Make the element of the pressure: 1, r, s, t."""

    class LinearPressure(fe.element.Element):  # type: ignore[misc]
        def __init__(self) -> None:
            self.points = np.zeros((4, 3))
            self.cells, self.cell_type = np.arange(4).reshape(1, -1), "linear pressure"

        def function(self, rst: Array) -> Array:
            return np.r_[1.0, rst]

        def gradient(self, rst: Array) -> Array:
            return np.vstack([np.zeros(3), np.eye(3)])

    return LinearPressure()


def _moduli(physics: TruthPhysics, places: Array) -> Array:
    """Return the factor of the moduli (q, m) at the quadrature points, ``places`` (3, q, m) m."""
    factor = np.ones(places.shape[1:])
    for one in physics.modulus:
        factor = factor * one(places.reshape(3, -1).T, 0.0).reshape(factor.shape)
    return factor


def lattice(element: Any) -> IntArray:
    """Return where the nodes of felupe's quadratic ``element`` are in the lattice of 3 per direction."""
    places = np.rint(element.points).astype(int) + 1
    found: IntArray = places @ 3 ** np.arange(places.shape[1])[::-1]
    return found


def felupe() -> Any:
    """Return the library. Raise InputError where it is not installed."""
    try:
        import felupe
    except ImportError as error:
        raise InputError("there is no felupe", where="--truth", remedy="pip install 'livedeform[benchmark]'") from error
    return felupe
