"""The protocol of an item: one force that the solver sums (body, support, load, contact), with its energy and its
history.

The unknowns are ``x`` (n_dof,): displacements u of all nodes from the scanned shape, 3 per node (dof 3 a + i), then the
element's further unknowns (pressures of P2-P1) if it has any. An item that holds nothing inside itself besides its
constants, the moment, its iteration state and its committed history can be copied, compared and rolled back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.common.frames import slerp
from livedeform.common.types import Array
from livedeform.fem_node.solve.assembly import Feedback, Pattern, System

SLIGHT = 1e-6  # of a step: round-off of stamps
RETREAT = 0.05  # m along the probe's axis, from where it comes if it was not there before


@dataclass(frozen=True)
class Moment:
    """A moment at which equilibrium is sought, with what acts then.

    ``time`` s of the drifts; ``dt`` s since the committed history (inf: fully relaxed, no inertia); ``gravity`` (3,)
    m/s2; ``load``: 0..1 of the dead loads; ``pose`` T_phantom_probe (4, 4), None without a probe; ``still``: without
    inertia; ``acting``: s for which gravity has acted (inf: always); ``held``: somebody holds the body where it
    rested before, so that nothing is sought.
    """

    time: float
    dt: float
    gravity: Array
    load: float = 1.0
    pose: Array | None = None
    still: bool = False
    acting: float = np.inf
    held: bool = False

    @property
    def rests(self) -> bool:
        """Tell whether the body is relaxed before weight and loads act."""
        return bool(np.isinf(self.dt)) and self.load == 0.0 and not self.held

    def begun(self, delay: float) -> float:
        """Return how much of what acts ``delay`` s after gravity does acts at this moment: 0 or 1, but at the end of
        the step of a motion in which it begins.

        There it is what gives the impulse of its share of the step, and so changes smoothly with the delay: a step
        takes the mean of both ends, the first one after a rest the later end (`fem_node.items.dynamics`).
        """
        late = self.acting - delay
        if self.still or not 0.0 < self.dt < np.inf:
            return float(late >= 0.0)
        part = late / self.dt
        if not SLIGHT < part < 1.0 + SLIGHT:
            return float(part >= SLIGHT)
        return part + (0.5 if self.acting > (1.0 + SLIGHT) * self.dt else 0.0)

    def part_way(self, start: Moment, s: float) -> Moment:
        """Return the moment at the fraction ``s`` of the way from ``start``: gravity, load and pose are
        interpolated."""
        if s >= 1.0:
            return self
        gravity = start.gravity + s * (self.gravity - start.gravity)
        pose = self.pose
        if self.pose is not None and start.pose is None:
            pose = self.pose.copy()
            pose[:3, 3] -= (1.0 - s) * RETREAT * self.pose[:3, 2]
        elif self.pose is not None and start.pose is not None:
            turn = Rotation.from_matrix(np.stack([start.pose[:3, :3], self.pose[:3, :3]]))
            pose = np.eye(4)
            pose[:3, :3] = slerp(turn, s).as_matrix()
            pose[:3, 3] = start.pose[:3, 3] + s * (self.pose[:3, 3] - start.pose[:3, 3])
        return replace(self, gravity=gravity, load=start.load + s * (self.load - start.load), pose=pose)


def same_moment(a: Moment, b: Moment) -> bool:
    """Return whether two moments ask for the same."""
    poses = a.pose is b.pose or (a.pose is not None and b.pose is not None and np.array_equal(a.pose, b.pose))
    plain = (a.time, a.dt, a.load, a.still) == (b.time, b.dt, b.load, b.still)
    return plain and poses and np.array_equal(a.gravity, b.gravity)


class Item(Protocol):
    """One force. The solver calls ``prepare`` once per moment, then ``evaluate`` many times, then ``update`` until all
    items are content, then ``commit``. ``save``/``restore`` roll back what ``commit``, ``update`` and ``prepare``
    change."""

    symmetric: bool  # whether its tangent is

    def couplings(self) -> Sequence[NDArray[np.int64]]:
        """Return arrays (m, k) of dofs whose rows couple; the dofs of a surface facet are already coupled by its
        element."""
        ...

    def attach(self, pattern: Pattern) -> None:
        """Find, once, with the tangent's pattern, the places of the blocks (``pattern.positions``). An item that is
        never attached is only asked for residuals (that is how sensitivities are taken)."""

    def prepare(self, moment: Moment) -> None:
        """Set the moment: fields in time, load factors, the pose."""

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        """Add the residual at ``x`` to ``system.r``, and to ``system.values`` the tangent if asked; return the energy
        (incremental potential, J), or NaN if there is none: the line search then uses the residual."""
        ...

    def tangent_changes(self, x: Array) -> bool:
        """Say before a Newton solution whether the tangent at ``x`` differs much from the committed moment's (new
        contact)."""
        ...

    def expect(self, x: Array, dx: Array | None) -> None:
        """Prepare for Newton's step ``dx`` from ``x``: the next tangent may be taken for what the step promises to
        first order. None: exact tangents again."""

    def update(self, x: Array) -> bool:
        """Do the outer iteration after a Newton solution (multipliers, plastic flow). True: equilibrium must be sought
        again."""
        ...

    def commit(self, x: Array) -> None:
        """Accept ``x`` as the solution of the moment: history moves on."""

    def stiffen(self, x: Array) -> None:
        """Make constraints that multipliers hold at the solution ``x`` respond as constraints (for sensitivities)."""

    def feedback(self, x: Array) -> Feedback | None:
        """Return what the tangent at the solution ``x`` leaves out, for sensitivities: forces that follow the unknowns
        from one outer iteration to the next. None: nothing."""
        ...

    def follow(self, other: Any) -> None:
        """Take over the iteration state (multipliers), not the history, of the same item of a slightly different body
        that has just been solved at this moment."""

    def save(self) -> Any:
        """Return the history and iteration state (to be handed to ``restore``; never changed in place)."""
        ...

    def restore(self, state: Any) -> None:
        """Roll back to a saved state."""

    def ways(self, x: Array, start: Moment, moment: Moment) -> Sequence[Sequence[Moment]]:
        """Moments to pass from the solution ``x`` at ``start`` (left out) to ``moment``: for each way there is, the
        likeliest first. None: no item but one whose moments may be far apart has an opinion."""
        ...

    def furthest(self, x: Array, start: Moment, moment: Moment, done: float) -> float:
        """The part (0..1) of the way from ``start`` to ``moment`` that may be gone to in one step after ``done``."""
        ...

    def stride(self) -> float:
        """The part of the steps that it admits in which a jump is to be walked."""
        ...

    def passed(self, x: Array) -> None:
        """``x`` solves a moment on the way to the one that is sought: history that depends on the way moves on."""

    def hurry(self, *, on_the_way: bool) -> None:
        """Say whether the next solution is one ``on_the_way``, of which only the way matters, or the one sought."""

    def near(self, x: Array, moment: Moment) -> bool:
        """Return whether ``x`` may start the solution of ``moment`` in one step."""
        ...

    def reported(self, x: Array) -> Array:
        """Return what of the item's forces at the solution ``x`` users are told (k,) N: equal where solutions are."""
        ...

    def reported_within(self, x: Array) -> float:
        """Return how exactly (N) the reported forces are known at the solution ``x``."""
        ...

    def flaw(self, x: Array) -> str:
        """Say what is wrong with the solution ``x`` of the prepared moment in the item's own terms; "" if nothing."""
        ...

    def constraints(self) -> tuple[NDArray[np.int64], Array]:
        """Return dofs held at the moment, and the values they are held at (most items: none)."""
        ...


class PlainItem:
    """The parts of the protocol that an item without history, outer iteration and constraints needs not write."""

    symmetric = True

    def couplings(self) -> Sequence[NDArray[np.int64]]:
        """Return none beyond the elements'."""
        return ()

    def attach(self, pattern: Pattern) -> None:
        """Do nothing: there is no tangent."""

    def prepare(self, moment: Moment) -> None:
        """Do nothing: nothing depends on the moment."""

    def tangent_changes(self, x: Array) -> bool:
        """Return False: no more than the solver sees for itself."""
        return False

    def expect(self, x: Array, dx: Array | None) -> None:
        """Do nothing: tangents are always exact."""

    def update(self, x: Array) -> bool:
        """Return False: always content."""
        return False

    def commit(self, x: Array) -> None:
        """Do nothing: there is no history."""

    def stiffen(self, x: Array) -> None:
        """Do nothing: there are no multipliers."""

    def feedback(self, x: Array) -> Feedback | None:
        """Return None: the tangent is whole."""
        return None

    def follow(self, other: Any) -> None:
        """Do nothing: there is no iteration state."""

    def save(self) -> Any:
        """Return nothing: there is no state."""
        return None

    def restore(self, state: Any) -> None:
        """Do nothing: there is no state."""

    def ways(self, x: Array, start: Moment, moment: Moment) -> Sequence[Sequence[Moment]]:
        """No opinion."""
        return ()

    def furthest(self, x: Array, start: Moment, moment: Moment, done: float) -> float:
        """All of it."""
        return 1.0

    def stride(self) -> float:
        """All of them."""
        return 1.0

    def passed(self, x: Array) -> None:
        """The way does not matter."""

    def hurry(self, *, on_the_way: bool) -> None:
        """Do nothing: all solutions are alike."""

    def near(self, x: Array, moment: Moment) -> bool:
        """Return True: any start may do."""
        return True

    def reported(self, x: Array) -> Array:
        """Return nothing."""
        return np.zeros(0)

    def reported_within(self, x: Array) -> float:
        """Return 0: it is as exact as equilibrium is solved."""
        return 0.0

    def flaw(self, x: Array) -> str:
        """Nothing can be wrong beyond its equations."""
        return ""

    def constraints(self) -> tuple[NDArray[np.int64], Array]:
        """Return none."""
        return np.zeros(0, np.int64), np.zeros(0)
