"""A body walks along a recording: it is solved at one stamp after another, with its sensitivities.

What is passed on the way to a stamp (the state at rest, the release, steps of the probe's path or of time) is said by
the `Timeline`, where each solution starts from by `Mechanics` or a `WarmStart`, and how solutions change along
directions by `Tangents` or, where a tangent at the moment does not know enough of what was before, `Followers`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import EXACT
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.path.direction import Direction, Sensitivities
from livedeform.fem_node.path.followers import Followers
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.rubbing import RubbingTangents
from livedeform.fem_node.path.start import ContactSave, Start, WarmStart, pose_distance
from livedeform.fem_node.path.tangents import CORRECTIONS, Tangents, answers_linearly
from livedeform.fem_node.path.timeline import LONGEST_PATH_STEP, Instant, PoseAt, Timeline
from livedeform.fem_node.solve.solver import Solution

SAME_POSE = 1e-7  # m between poses that are one


@dataclass(frozen=True)
class WalkSettings:
    """Settings of a walk. ``path_step`` m: the longest that a probe that rubs moves at a time (None: from stamp to
    stamp at once). ``between``: how much less exactly its contact is solved on the way than at the stamps.
    ``corrections`` of sensitivities: one for the tangent alone, which is cheap and leaves out what only whole paths
    tell."""

    path_step: float | None = LONGEST_PATH_STEP
    between: float = 1.0
    corrections: int = CORRECTIONS


WALK = WalkSettings()


def sensitivities_of(
    leader: Mechanics, directions: Sequence[Direction], unloaded: Sequence[Array | None], corrections: int = CORRECTIONS
) -> Sensitivities | None:
    """Return what works out the sensitivities of a body, where ``unloaded`` are its unloaded shapes along each
    direction. None without directions."""
    if not directions:
        return None
    rough = corrections == 1
    if leader.memory.rings:
        return Followers(leader, directions, unloaded, linear=rough)
    if rough and leader.memory.rubs:
        return RubbingTangents(leader, directions, unloaded)
    if rough or answers_linearly(leader.physics, [d.physics for d in directions]):
        return Tangents(leader, directions, unloaded, corrections)
    return Followers(leader, directions, unloaded)


@dataclass(frozen=True)
class _Passed:
    """A stamp that was passed: the probe's ``pose`` (4, 4), whether weight and loads acted, and the unknowns ``x``
    (n_dof,) and the ``contact`` as it was saved if the probe touched nothing there."""

    pose: Array | None
    active: bool
    x: Array | None
    contact: ContactSave | None


@dataclass
class Walk:
    """One walk of the ``body`` along the track ``pose_at``; ``now_ns``: the last stamp that was reached."""

    body: Mechanics
    line: Timeline
    pose_at: PoseAt | None = None
    now_ns: int | None = None
    sensitivities: Sensitivities | None = None
    warm: WarmStart | None = None
    walk_settings: WalkSettings = WALK
    _passed: dict[int, _Passed] = field(default_factory=dict)  # by stamp
    _begun: bool = False
    _active: bool = False  # whether weight and loads acted at the instant that was passed last

    def to(self, stamp_ns: int, wanted: Sequence[int] = ()) -> int:
        """Go to ``stamp_ns``, with the sensitivities number ``wanted`` there; return the iterations that it took.

        Without an equilibrium somewhere on the way everything is as before, and `ConvergenceError` is raised.
        """
        n = self.through(self.line.instants(self.now_ns, stamp_ns, self.body), stamp_ns, wanted)
        self.now_ns = stamp_ns
        self._passed[stamp_ns] = self._here(stamp_ns)
        return n

    def through(self, instants: Iterable[Instant], stamp_ns: int, wanted: Sequence[int] = ()) -> int:
        """Pass some ``instants`` on the way to ``stamp_ns``, as `to`."""
        body, n = self.body, 0
        saved = body.save()
        steps = self.line.in_path_steps(instants, body.physics, self.pose_at, self.walk_settings.path_step)
        try:
            for instant in steps:
                n += self._pass(instant, stamp_ns, wanted)
        except ConvergenceError:
            body.restore(saved)
            raise
        return n

    def twin(self, stamp_ns: int) -> int | None:
        """Return a stamp that was passed with the same answer: of the same pose, or the probe touches nothing at
        either. None if there is none, or if more than pose and loads decides."""
        if self.body.memory.reasons:
            return None
        active = self.line.acts(stamp_ns)
        pose, contact = self._pose(stamp_ns), self.body.contact
        for stamp, passed in self._passed.items():
            if passed.active != active:
                continue
            untouched = passed.x is not None and (contact is None or contact.misses(passed.x, pose))
            if untouched or pose_distance(pose, passed.pose) < SAME_POSE:
                return stamp
        return None

    def _pass(self, instant: Instant, stamp_ns: int, wanted: Sequence[int]) -> int:
        """Solve and commit one instant; return its iterations."""
        body = self.body
        moment = self.line.moment(body.physics, instant, self.pose_at)
        # at rest at the release, and loaded a moment later at the same stamp
        passing = not (instant.active or self.line.dynamic) and self.line.acts(instant.stamp_ns)
        there = instant.stamp_ns == stamp_ns and instant.with_probe and not passing
        if moment.held:
            if self.sensitivities is not None:
                self.sensitivities.pass_held(partial(self.line.moment, instant=instant, pose_at=self.pose_at))
            body.pass_held(moment)
            self._begun, self._active = True, instant.active
            return 0
        if body.contact is not None and body.memory.rubs:
            # each step goes on from where the last one ended, so that what was left open adds up to another path
            body.contact.exactness = EXACT * (1.0 if instant.stamp_ns == stamp_ns else self.walk_settings.between)
        warm = None if body.memory.rings else self.warm
        key = None if warm is None or passing else warm.key(instant.stamp_ns, moment, first=not self._begun)
        known = None if warm is None or key is None else warm.solved(body, key, moment)
        known = self._untouched(stamp_ns, moment) if known is None and there else known
        starts = () if known is not None else self._starts(stamp_ns, key, moment)
        try:
            solution = Solution(known) if known is not None else body.solve(moment, starts)
        except ConvergenceError as error:
            if not self.line.is_hanging(instant):
                raise
            raise ConvergenceError(
                f"as it hung before it was held: {error.what}", where=error.where, remedy="leave 'held' out"
            ) from error
        if self.sensitivities is not None:
            moment_of = partial(self.line.moment, instant=instant, pose_at=self.pose_at)
            self.sensitivities.step(solution.x, moment_of, there=there, wanted=wanted)
        body.commit(solution.x, moment)
        self._begun, self._active = True, instant.active
        if warm is not None and key is not None:
            warm.note(body, stamp_ns, key, moment)
            if there and self.sensitivities is not None:
                warm.keep_slopes(stamp_ns, self.sensitivities.slopes(wanted))
        return solution.n_iterations

    def _untouched(self, stamp_ns: int, moment: Moment) -> Array | None:
        """Return the unknowns (n_dof,) at a stamp at which the probe touches nothing, as at its `twin`, and put the
        contact there; None where that has to be solved."""
        body, twin = self.body, self.twin(stamp_ns)
        passed = None if twin is None else self._passed[twin]
        if passed is None or passed.x is None or body.physics.interfaces:
            return None
        if body.contact is not None and passed.contact is not None:
            body.contact.restore(passed.contact)
        body.prepare(moment)
        return passed.x

    def _starts(self, stamp_ns: int, key: tuple[str, int] | None, moment: Moment) -> Iterable[Start] | None:
        """Return where the solution may start from: ahead in the motion, or what is known of other runs."""
        if self.body.memory.rings:
            return self.body.ahead(moment) or None
        if self.warm is None or key is None:
            return None
        return self.warm.starts(self.body, stamp_ns, key, moment)

    def _pose(self, stamp_ns: int) -> Array | None:
        return self.line.moment(self.body.physics, Instant(stamp_ns, 0.0, active=True), self.pose_at).pose

    def _here(self, stamp_ns: int) -> _Passed:
        """Return what is to be known of the stamp that was just reached."""
        contact = self.body.contact
        touches = contact is not None and bool(contact.state.touches.any())
        saved = None if contact is None or touches else contact.save()
        return _Passed(self._pose(stamp_ns), self._active, None if touches else self.body.x, saved)
