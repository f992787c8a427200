"""The thesis's column under its own weight (eq. 2.1 to 2.4), and what it leaves out.

    m(h) = rho A (L - h),  strain(h) = g m(h) / (A E),  dL = int_0^L strain dh = g rho L^2 / (2 E)            (2.3)

Uniaxial, small strain, a base that slides freely. The same column at finite strain (incompressible neo-Hookean, still
uniaxial and homogeneous over each slice) carries the nominal stress P = rho g (L - h), and

    P = (E/3) (1/lambda^2 - lambda)  for the stretch 0 < lambda < 1 in compression                       (Treloar 1975).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from livedeform.common.types import Array

GRAVITY = 9.81  # m/s2, as in the thesis
DENSITY = 1000.0  # kg/m3


@dataclass(frozen=True)
class HeavyColumn:
    """An upright prism: unloaded ``height`` m, ``youngs_modulus`` Pa, ``overload`` Pa on its top (what is stacked)."""

    height: float
    youngs_modulus: float
    density: float = DENSITY
    gravity: float = GRAVITY
    overload: float = 0.0

    def stress(self, h: Array) -> Array:
        """Compressive nominal stress (n,) Pa at the reference heights ``h`` (n,) m."""
        return self.density * self.gravity * (self.height - h) + self.overload

    def shortening_linear(self) -> float:
        """dL (m) of eq. 2.3, with the overload's share: int stress / E dh."""
        weight = 0.5 * self.density * self.gravity * self.height**2
        return (weight + self.overload * self.height) / self.youngs_modulus

    def shortening_finite(self, n: int = 200) -> float:
        """dL (m) of the incompressible neo-Hookean column, by Gauss-Legendre quadrature over the height."""
        nodes, weights = np.polynomial.legendre.leggauss(min(n, 64))
        h = 0.5 * self.height * (nodes + 1.0)
        stretch = stretch_under(self.stress(h), self.youngs_modulus)
        return float(0.5 * self.height * weights @ (1.0 - stretch))

    def outline(self, n: int = 201) -> tuple[Array, Array, Array]:
        """Heights after deformation (n,) m by eq. 2.3 and by finite strain, and the lateral stretch (n,) of the latter.

        Layer by layer from the base, as in figure 2.6 of the thesis.
        """
        h = np.linspace(0.0, self.height, n)
        linear = 1.0 - self.stress(h) / self.youngs_modulus
        finite = stretch_under(self.stress(h), self.youngs_modulus)

        def heights(stretch: Array) -> Array:
            return np.concatenate([[0.0], np.cumsum(0.5 * (stretch[1:] + stretch[:-1]) * np.diff(h))])

        return heights(linear), heights(finite), 1.0 / np.sqrt(finite)


def stretch_under(stress: Array, youngs_modulus: float) -> Array:
    """Stretch (n,) of an incompressible neo-Hookean bar under the compressive nominal ``stress`` (n,) Pa, uniaxial."""
    a = 3.0 * np.atleast_1d(stress) / youngs_modulus
    # 1/l^2 - l = a has one root in (0, 1]: the left side falls from infinity to 0
    return np.array([brentq(lambda l, a=ai: 1.0 / l**2 - l - a, 1e-3, 1.0) if ai > 0 else 1.0 for ai in a])


def modulus_linear(height: float, shortening: float, density: float = DENSITY, gravity: float = GRAVITY) -> float:
    """E (Pa) that eq. 2.3 gives for a measured shortening."""
    return 0.5 * density * gravity * height**2 / shortening


def minimum_modulus(height: float, density: float = DENSITY, gravity: float = GRAVITY) -> float:
    """E (Pa) at which eq. 2.3 shortens the column to nothing: dL = L. The thesis's 343 Pa at 7 cm."""
    return 0.5 * density * gravity * height
