"""Quadrature on the reference triangle and tetrahedron, in barycentric coordinates; weights sum to 1.

Sources: Strang & Fix (1973), Dunavant (1985), Keast (1986).
"""

from __future__ import annotations

import numpy as np

from livedeform.common.types import Array

Rule = tuple[Array, Array]  # barycentric coordinates (q, d + 1), weights (q,)


def _orbits(*parts: tuple[Array, float]) -> Rule:
    points = np.concatenate([p for p, _ in parts])
    return points, np.concatenate([np.full(len(p), w) for p, w in parts])


def _one_apart(a: float, n: int) -> Array:
    """The n points with one coordinate 1 - (n - 1) a and the others a."""
    return np.full((n, n), a) + np.eye(n) * (1.0 - n * a)


def _two_and_two(a: float) -> Array:
    """The 6 points of the tetrahedron with two coordinates a and two 1/2 - a."""
    pairs = [(i, j) for i in range(4) for j in range(i + 1, 4)]
    points = np.full((6, 4), 0.5 - a)
    for row, (i, j) in enumerate(pairs):
        points[row, [i, j]] = a
    return points


def tetrahedron(degree: int) -> Rule:
    """A rule on the tetrahedron that is exact for polynomials up to ``degree`` (1 to 5)."""
    if degree <= 1:
        return np.full((1, 4), 0.25), np.ones(1)
    if degree == 2:
        return _orbits((_one_apart((5.0 - np.sqrt(5.0)) / 20.0, 4), 0.25))
    if degree > 5:
        raise ValueError(f"no tetrahedron rule of degree {degree}")
    s = np.sqrt(15.0)  # Keast #6: 15 points, all inside, all weights positive
    return _orbits(
        (np.full((1, 4), 0.25), 16.0 / 135.0),
        (_one_apart((7.0 - s) / 34.0, 4), (2665.0 + 14.0 * s) / 37800.0),
        (_one_apart((7.0 + s) / 34.0, 4), (2665.0 - 14.0 * s) / 37800.0),
        (_two_and_two((5.0 - s) / 20.0), 10.0 / 189.0),
    )


def triangle(degree: int) -> Rule:
    """A rule on the triangle that is exact for polynomials up to ``degree`` (1 to 5)."""
    if degree <= 1:
        return np.full((1, 3), 1.0 / 3.0), np.ones(1)
    if degree == 2:
        return _orbits((_one_apart(1.0 / 6.0, 3), 1.0 / 3.0))
    if degree <= 4:
        return _orbits(
            (_one_apart(0.445948490915965, 3), 0.223381589678011), (_one_apart(0.091576213509771, 3), 0.109951743655322)
        )
    if degree > 5:
        raise ValueError(f"no triangle rule of degree {degree}")
    s = np.sqrt(15.0)
    return _orbits(
        (np.full((1, 3), 1.0 / 3.0), 9.0 / 40.0),
        (_one_apart((6.0 - s) / 21.0, 3), (155.0 - s) / 1200.0),
        (_one_apart((6.0 + s) / 21.0, 3), (155.0 + s) / 1200.0),
    )
