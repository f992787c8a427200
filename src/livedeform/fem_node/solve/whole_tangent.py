"""The tangent with what the solver leaves out of it, since it is not symmetric: for sensitivities only.

Newton's iterations take the symmetric part, where the limits of a support's friction keep still, and limits follow
between them. Beside a solution both move at once: K d + U d = -r_p, with U of each item's `feedback`, needs one LU
factor for all directions, which takes about twice as long as the symmetric one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.solve.assembly import Feedback, Pattern, System
from livedeform.fem_node.solve.linear_solver import make_linear_solver


class WholeTangent:
    """A factor of the tangent with both triangles, of systems with the symmetric ``pattern``, whose tangent has
    ``n_negative`` negative eigenvalues."""

    def __init__(self, pattern: Pattern, *, n_negative: int = 0, threads: int | None = None) -> None:
        self._pattern, self._where = pattern.whole()
        self._system = System(self._pattern)
        self._linear = make_linear_solver(self._pattern, threads=threads, nearly_symmetric=not n_negative)

    def factorise(self, system: System, more: Sequence[Feedback], held: NDArray[np.int64]) -> None:
        """Factorise the values of a ``system``, the ``held`` dofs out, with what there is ``more``;
        `FactorisationError` if that cannot be."""
        own, pattern = self._system, self._pattern
        own.values[:] = system.values[self._where]
        for dofs, blocks in more:
            own.add_blocks(pattern.positions(dofs), blocks)
        scale = float(np.abs(own.values[pattern.diagonal]).mean())
        own.values[pattern.touching(held)] = 0.0
        own.values[pattern.diagonal[held]] = scale
        self._linear.factorise(own)

    def solve(self, right_hand_side: Array) -> Array:
        """Return (K + U)^-1 b for b (n,) or (n, k)."""
        return self._linear.solve(right_hand_side)

    def solve_exactly(self, right_hand_side: Array) -> Array:
        """Return the same."""
        return self._linear.solve_exactly(right_hand_side)
