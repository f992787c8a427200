"""Sensitivities: bodies with slightly (or clearly) changed physics that follow a solved one.

Every follower has the same mesh, its own physics and its own history (relaxation, slip, plastic set, multipliers).
When the leading body has found its equilibrium x with the tangent K, a follower's is x + delta with

    delta <- delta - K^-1 [r_f(x + delta) - r(x)],

repeated until it stands: Newton's method with the leader's factor, all followers as one block of right-hand sides.
For a small change the first correction is the tangent sensitivity -K^-1 dr/dp, and history is carried exactly, as the
follower's own. An unchanged follower (the shadow) runs along, so that what the leader's tolerances leave over
cancels. A follower whose held dofs differ, or that does not settle with the leader's factor, is solved for itself.
Where only tangents are wanted, as along a motion of hundreds of steps, that first correction is all (``linear``).
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.embedded_points import EmbeddedPoints
from livedeform.fem_node.items.friction import FrictionSupport
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.path.direction import Direction, MomentOf
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.start import Start
from livedeform.fem_node.solve.assembly import System

ACCURACY = 1e-6  # of a follower's largest difference: smaller corrections end the iteration
ROUND_OFF = 1e-15  # m
MAX_CORRECTIONS = 8
WITH_FRICTION = 60  # its limits follow the pressure from one correction to the next


class Follower:
    """One changed body; ``delta`` (n_dof,) m is how far it is from the leader, ``force`` the probe's, ``found`` whether
    it was solved."""

    def __init__(self, leader: Mechanics, direction: Direction, unloaded: Array | None) -> None:
        self.direction = direction
        self.mechanics = Mechanics(
            leader.space, direction.physics, unloaded, settings=leader.settings, threads=leader.threads
        )
        self.delta = np.zeros(leader.space.n_dof)
        self.force = np.zeros(3)  # N, of the probe
        self.found = True

    def follow(self, leader: Mechanics) -> None:
        """Take multipliers and the like from the leader's items."""
        leading = {type(item): item for item in leader.items}
        for item in self.mechanics.items:
            if type(item) in leading:
                item.follow(leading[type(item)])

    def update(self, x: Array) -> None:
        """Let multipliers, limits and plastic flow follow where it is next to the leader's solution ``x``."""
        for item in self.mechanics.items:
            item.update(x + self.delta)

    def let_slip(self, x: Array) -> None:
        """Let the limits of friction with the support follow, which its slip goes by."""
        for item in self.mechanics.items:
            if isinstance(item, FrictionSupport):
                item.update(x + self.delta)


class Followers:
    """The followers of a leader: ``members[0]`` is the shadow, the others are in the order of the directions."""

    def __init__(
        self,
        leader: Mechanics,
        directions: Sequence[Direction],
        unloaded: Sequence[Array | None],
        *,
        linear: bool = False,
    ) -> None:
        self.leader, self.linear = leader, linear
        pairs = [(Direction("", leader.physics, 1.0), leader.unloaded), *zip(directions, unloaded, strict=True)]
        self.members = [Follower(leader, direction, shape) for direction, shape in pairs]
        self.passing: Sequence[int] = range(len(directions))
        self._system = System(leader.solver.pattern)

    def step(self, x: Array, moment_of: MomentOf, *, there: bool, wanted: Collection[int]) -> None:
        """See `Sensitivities`: all followers are solved and committed, on the way as well as there."""
        with self.leader.factorised_at(x, keep=self.leader.contact is None):  # else it is of a stiffened contact
            self._pass(x, moment_of)

    def _pass(self, x: Array, moment_of: MomentOf) -> None:
        """Solve and commit all followers beside the leader's solution ``x``, with its factor where that will do."""
        held = self.leader.held()
        together: list[Follower] = []
        alone: list[Follower] = []
        for member in self.members:
            member.mechanics.prepare(moment_of(member.direction.physics))
            same = np.array_equal(member.mechanics.held(), held)
            (together if same else alone).append(member)
        alone += self._correct(together, x, held)
        for member in self.members:
            moment = moment_of(member.direction.physics)
            if member in alone:
                self._solve_alone(member, x, moment)
            else:
                member.found = True
                member.force = member.mechanics.borne(x + member.delta, self._system)
                member.mechanics.commit(x + member.delta, moment)

    def pass_held(self, moment_of: MomentOf) -> None:
        """See `Sensitivities`."""
        for member in self.members:
            member.mechanics.pass_held(moment_of(member.direction.physics))
            member.delta, member.force = member.mechanics.at_rest - self.leader.at_rest, np.zeros(3)
            member.found = True

    def slopes(self, wanted: Collection[int]) -> dict[Hashable, Array]:
        """See `Sensitivities`: none, since a body with a memory starts from its own past."""
        return {}

    def derivatives(self, points: EmbeddedPoints, wanted: Collection[int]) -> tuple[Array, Array]:
        """See `Sensitivities`; NaN for a follower that was not solved."""
        shadow, *members = self.members
        base = points.positions(shadow.mechanics.u)
        d_points, d_forces = np.full((*base.shape, len(wanted)), np.nan), np.full((3, len(wanted)), np.nan)
        for k, member in enumerate(members[j] for j in wanted):
            if member.found:
                d_points[..., k] = (points.positions(member.mechanics.u) - base) / member.direction.width
                d_forces[:, k] = (member.force - shadow.force) / member.direction.width
        return d_points, d_forces

    def _correct(self, members: list[Follower], x: Array, held: NDArray[np.int64]) -> list[Follower]:
        """Correct all of them side by side; return those that do not settle, as they were before."""
        before = [(member.delta, member.mechanics.save()) for member in members]
        residual = self.leader.residual(x, self._system).copy()
        for member in members:
            member.follow(self.leader)
            member.let_slip(x)
            if self.linear:  # plastic flow and the like, before the only correction
                member.update(x)
        unsettled = members[1:]
        contact = self.leader.contact
        most = MAX_CORRECTIONS if contact is None or contact.law.sticks == 0.0 else WITH_FRICTION
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a change may be too large for the factor
            for i in range(most):
                correction = self._corrected(members, x, residual, held)
                if self.linear:
                    for member in members:
                        member.let_slip(x)
                    return []
                for member in members:
                    member.update(x)
                unsettled = [
                    m for k, m in enumerate(members) if k and not self._stands(m, correction[:, k] - correction[:, 0])
                ]
                if (i and not unsettled) or not np.all(np.isfinite(correction)):  # the first knows no update
                    break
        for member, (delta, state) in zip(members, before, strict=True):
            if member in unsettled:
                member.delta = delta
                member.mechanics.restore(state)
        return unsettled

    def _corrected(self, members: list[Follower], x: Array, residual: Array, held: NDArray[np.int64]) -> Array:
        """Take one correction (n_dof, members) with the leader's factor, whose own ``residual`` (n_dof,) is left."""
        block = np.empty((len(x), len(members)), order="F")
        for k, member in enumerate(members):
            block[:, k] = residual - member.mechanics.residual(x + member.delta, self._system)
        block[held] = 0.0
        correction: Array = self.leader.solver.answering.solve_exactly(block)
        for k, member in enumerate(members):
            member.delta = member.delta + correction[:, k]
        return correction

    def _stands(self, member: Follower, change: Array) -> bool:
        size = np.abs(member.delta - self.members[0].delta).max()
        return bool(np.abs(change).max() <= ACCURACY * size + ROUND_OFF)

    def _solve_alone(self, member: Follower, x: Array, moment: Moment) -> None:
        """Solve it for itself from the leader's solution; without convergence it stays where it was."""
        mechanics = member.mechanics
        try:
            mechanics.advance(moment, [Start(x + member.delta, in_one_step=False)])
            member.found = True
        except ConvergenceError:
            member.found = False
            return
        member.delta, member.force = mechanics.x - x, mechanics.wrench()[0]
