"""Bring a probe to a pose that is far from where it was: which ways it may take, and how far it may go at a time.

A point of the surface that is found inside the probe is pushed out of the probe's nearest side. That is the side where
it came in only if the probe has not gone too far at once: a point near an edge leaves by the wall beside it, one that
is deeper than the middle leaves by the back, and Newton's method then finds a state that is in balance, free of
penetration, and wrong. So a step is admissible as long as no point of the surface, kept still, is deep inside the
probe, none is pushed elsewhere than before the step, and the probe does not disappear in the body. A probe that was
nowhere before, or whose straight way fails, comes along its axis from outside; not one that rubs or sticks where it
touches, since what it has dragged along would be undone.

On elements much larger than the probe's edges an elastic body has equilibria that belong to the way: a surface that a
probe drags along sideways hangs on its edges. Of a body without memory the one from outside along the axis is meant,
which mostly has the lower energy. So such a body is approached anew where the straight way is a jump, and where the
probe has slid: not if it is round enough for the elements, every now and then if it is sharper, always if far sharper.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from livedeform.common import frames
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.contact.probe_shapes import Shape
from livedeform.fem_node.items.protocol import Moment

DEEP = 0.25  # of the facets' size, and of the probe's smallest half width: how deep a step may put the surface
FAR = 0.15  # of the same: how far a probe that touches already may go at a time, also along the surface
TURNED = 0.5  # cosine between the directions in which a point is pushed before a step and
BEYOND = 1.5  # times the step after it: Newton's iterations swing
SHORTEST = 0.025  # of the facets' size: a step that is as short is always admissible
CLEAR = 1e-3  # m between a probe that comes from outside and the body
MOST_LOOKS = 400  # at poses on one way
BISECTIONS = 3  # of the last stretch between two of them
ROUND, SHARP = 0.5, 0.25  # of the facets' size: a radius above which slides are free, and below which none is
SHORTER = 0.5  # part of an admissible step in which a jump under sharp edges is walked
HARDLY = 0.02  # of the facets' size: a shorter slide is none
QUICK = 1e-4  # m; a surface that is no deeper in the probe is pushed out the way it came, whatever the step


class Touchable(Protocol):
    """The questions that an approach asks of a contact (`fem_node.contact.contact.ProbeContact`)."""

    shape: Shape

    @property
    def facet_size(self) -> float:
        """Typical length of a facet, m."""

    def seen(self, x: Array, T: Array) -> Array:
        """The contact points (n, 3) m near the probe at ``T`` (4, 4), in its frame, at the displacements ``x``."""

    def swallowed(self, x: Array, T: Array) -> bool:
        """Return whether the middle of the probe at ``T`` lies inside the body."""

    def depth_in_held(self, x: Array, T: Array) -> float:
        """Return how deep (m) surface that cannot move is inside the probe at ``T`` (4, 4)."""

    def depth_behind(self, x: Array, T: Array) -> float:
        """Return how far (m) the body reaches behind the face of a probe at ``T``, along the probe's axis."""


def hangs(contact: Touchable) -> bool:
    """Return whether the surface may hang on the probe's edges: they are sharper than elements of this size bend, or
    how sharp they are is not known (NaN)."""
    return not contact.shape.roundness >= ROUND * contact.facet_size


@dataclass(frozen=True)
class Approach:
    """The steps of a probe with ``contact`` through a body that is at displacements ``x`` (n_dof,)."""

    contact: Touchable

    def ways(
        self, x: Array, start: Moment, moment: Moment, came: Array | None, *, anew: bool, stays: bool
    ) -> list[list[Moment]]:
        """Moments to pass from ``start`` (left out) to ``moment``, for each way there is; the likeliest first.

        ``anew``: a body without memory, which is approached from outside where the straight way is a jump or a slide
        since the pose ``came``; ``stays``: a probe that rubs or sticks where it touches, which a way that leaves the
        body would undo. `ConvergenceError` where there is no way, since surface that is held cannot make way.
        """
        if moment.pose is None:
            return [[moment]]
        depth = self.contact.depth_in_held(x, moment.pose)
        if depth > QUICK:
            raise _no_way(f"the probe stands {1e3 * depth:.1f} mm deep in what holds the body")
        before = moment.pose.copy()
        before[:3, 3] -= self.deepest * moment.pose[:3, 2]
        known = start.pose is not None and not self._held_between(x, start.pose, moment.pose)
        straight = [[moment]] if known or self.admissible(x, before, moment.pose) else []
        if stays:
            if not straight:
                raise _no_way("the probe rubs or sticks, and its way leads through what holds the body")
            return straight
        outside = self.outside(x, moment.pose)
        around = [replace(moment, pose=None), replace(moment, pose=outside), moment]
        if not self._held_between(x, outside, moment.pose):
            if anew and self.slid(came, moment.pose):
                return [around]
            jumps = anew and not self.is_step(x, start, moment)
            return [around, *straight] if jumps else [*straight, around]
        if not straight:
            raise _no_way("the probe is first seen inside the body, and its way there leads through what holds that")
        return straight

    def slid(self, came: Array | None, T: Array | None) -> bool:
        """Return whether the probe at ``T`` (4, 4) is too far beside the axis by which it ``came`` (None: from nowhere)
        to be trusted without being approached anew."""
        if came is None or T is None or not hangs(self.contact):
            return False
        moved = self._corners(T) - self._corners(came)
        along = float(moved.mean(axis=0) @ T[:3, 2])
        free = HARDLY * self.contact.facet_size if self.sharp else self.deepest
        return float(np.linalg.norm(moved - along * T[:3, 2], axis=1).max()) > free

    @property
    def sharp(self) -> bool:
        """Return whether the probe's edges are far sharper than elements of this size can follow."""
        return self.contact.shape.roundness < SHARP * self.contact.facet_size

    def alike(self, one: Array | None, other: Array | None) -> bool:
        """Return whether two poses (4, 4) are no further apart than one step may be."""
        return one is not None and other is not None and self._length(one, other) <= self.deepest

    def is_step(self, x: Array, start: Moment, moment: Moment) -> bool:
        """Return whether the straight way from ``start`` may be gone at once."""
        return start.pose is not None and moment.pose is not None and self.admissible(x, start.pose, moment.pose)

    def furthest(self, x: Array, start: Moment, moment: Moment, done: float) -> float:
        """Return the part (0..1) of the way from ``start`` to ``moment`` that may be gone to in one step after
        ``done``."""
        if start.pose is None or moment.pose is None:
            return 1.0

        def at(s: float) -> Array:
            return np.asarray(moment.part_way(start, s).pose)

        if self.admissible(x, at(done), moment.pose):
            return 1.0
        length = self._length(start.pose, moment.pose)
        shortest = min(SHORTEST * self.contact.facet_size / length, 1.0 - done) if length > 0.0 else 1.0 - done
        n_looks = int(np.clip(np.ceil((1.0 - done) * length / (0.5 * self.deepest)), 1, MOST_LOOKS))
        good = done
        for s in np.linspace(done, 1.0, n_looks + 1)[1:]:
            if not self.admissible(x, at(done), at(float(s))):
                return max(self._between(x, at, done, good, float(s)), done + shortest)
            good = float(s)
        return max(good, done + shortest)

    def admissible(self, x: Array, before: Array, after: Array) -> bool:
        """Return whether the probe may go from the pose ``before`` to ``after`` at once."""
        contact = self.contact
        y = contact.seen(x, after)
        if len(y):
            d = contact.shape.distance(y).d
            if float(d.min()) < -self.deepest:
                return False
            far = self._length(before, after) > FAR / DEEP * self.deepest
            if far and float(d.min()) < QUICK and self._touches(x, before):
                return False
            inside = d < -QUICK
            if inside.any():
                came = frames.apply(frames.inverse(before) @ after, y[inside])
                goes = contact.shape.distance(came + BEYOND * (y[inside] - came)).gradient
                if float(np.einsum("ni,ni->n", contact.shape.distance(came).gradient, goes).min()) < TURNED:
                    return False
        return not contact.swallowed(x, after)

    def _touches(self, x: Array, T: Array) -> bool:
        """Return whether the probe touches the body at ``T``."""
        y = self.contact.seen(x, T)
        return len(y) > 0 and float(self.contact.shape.distance(y).d.min()) < QUICK

    @property
    def deepest(self) -> float:
        """Return how deep (m) the surface may be inside the probe after one step."""
        low, high = self.contact.shape.bounds
        return DEEP * min(self.contact.facet_size, 0.5 * float((high - low).min()))

    def _between(self, x: Array, at: Callable[[float], Array], done: float, good: float, bad: float) -> float:
        for _ in range(BISECTIONS):
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if self.admissible(x, at(done), at(middle)) else (good, middle)
        return good

    def _length(self, start: Array, end: Array) -> float:
        """Return how far the corners of the probe's box go, m."""
        return float(np.linalg.norm(self._corners(start) - self._corners(end), axis=1).max())

    def _corners(self, T: Array) -> Array:
        """The corners (8, 3) m of the probe's box at ``T`` (4, 4)."""
        low, high = self.contact.shape.bounds
        corners = np.array([[a, b, c] for a in (low[0], high[0]) for b in (low[1], high[1]) for c in (low[2], high[2])])
        return frames.apply(T, corners)

    def _held_between(self, x: Array, start: Array, end: Array) -> bool:
        """Return whether surface that is held is in the probe's way between two poses (4, 4)."""
        n_looks = int(np.clip(np.ceil(self._length(start, end) / self.deepest), 1, MOST_LOOKS))
        pose = end.copy()
        for s in np.linspace(0.0, 1.0, n_looks, endpoint=False)[1:]:
            pose[:3, 3] = start[:3, 3] + s * (end[:3, 3] - start[:3, 3])
            if self.contact.depth_in_held(x, pose) > QUICK:
                return True
        return False

    def outside(self, x: Array, T: Array) -> Array:
        """Return the pose on the probe's axis behind ``T`` from which all of the body lies before its face."""
        behind = self.contact.depth_behind(x, T)
        out = T.copy()
        out[:3, 3] -= (behind + CLEAR) * T[:3, 2]
        return out


def _no_way(why: str) -> ConvergenceError:
    return ConvergenceError(
        why, where="probe contact", remedy="check its pose: its z axis points out of its face, into the body"
    )
