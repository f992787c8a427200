"""Directions along which a body may differ a little, and what its sensitivities to them must be able to do."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.embedded_points import EmbeddedPoints
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.physics.record import Physics

MomentOf = Callable[[Physics], Moment]  # the moment that is passed, for any physics


@dataclass(frozen=True)
class Direction:
    """Changed ``physics``, where one parameter differs from the ``reference`` by ``width`` (any size, sign or unit).

    The derivative is one-sided: its error is the width times the response's curvature, some 1e-5 relative for a width
    of 1e-5 of the parameter, 1e-6 for 1e-6, down to what the contact's tolerance lets through. With friction it holds
    as long as no point begins to stick or to slide between the two bodies: there the response has a kink.

    ``reference``: the leader's physics (None), or an equal one that says more, as with an effect of no amplitude.
    ``at``: where the leader is along the parameter, for the starts of other runs.
    """

    name: Hashable
    physics: Physics
    width: float
    reference: Physics | None = None
    at: float = 0.0


class Sensitivities(Protocol):
    """Derivatives of a body's solutions along directions. ``passing``: the numbers of those whose change differs
    between moments at which the body itself is the same."""

    passing: Sequence[int]

    def step(self, x: Array, moment_of: MomentOf, *, there: bool, wanted: Collection[int]) -> None:
        """Pass a moment between the leader's solution ``x`` (n_dof,) and its commit. If it is ``there``, the
        derivatives number ``wanted`` are asked for next; else it is only on the way. `ConvergenceError` if there are
        none."""

    def pass_held(self, moment_of: MomentOf) -> None:
        """Pass a moment at which each body is held where it rested."""
        ...

    def derivatives(self, points: EmbeddedPoints, wanted: Collection[int]) -> tuple[Array, Array]:
        """Return the derivatives of ``points`` (n, 3, p) and of the probe's force (3, p) N along the directions number
        ``wanted`` at the moment that was passed last, which the leader has committed; NaN where there is none."""
        ...

    def slopes(self, wanted: Collection[int]) -> dict[Hashable, Array]:
        """Return the derivatives of the unknowns (n_dof,) by direction, as far as they help another run's start."""
        ...


def same_physics(a: Any, b: Any) -> bool:
    """Return whether two physics are equal, arrays included."""
    for name in a.__dataclass_fields__:
        x, y = getattr(a, name), getattr(b, name)
        if isinstance(x, np.ndarray) or isinstance(y, np.ndarray):
            if not np.array_equal(x, y):
                return False
        elif x is not y and x != y:
            return False
    return True
