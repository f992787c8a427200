"""Identities through time and occlusion.

Every marker is predicted: where it was, carried on by its velocity while it is seen, and carried along by its
neighbours' displacement while it is not (the body is continuous, so the displacement field is smooth). Markers that
were just seen take their points first, by one global assignment; what they leave may belong to markers that come
back. A returning marker is taken only when no other marker explains the point nearly as well, and it is published
from its second sighting on. A doubt costs a marker for some frames; it never swaps two. Between two pictures a whole
patch may have moved to its neighbours' places: where that explains more of the markers, nothing is published until the
body is again as it was before, or at rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.stereo_node.track.apart import assign_apart_and_without
from livedeform.stereo_node.track.field import MIN_NEIGHBOURS, Among, SmoothField
from livedeform.stereo_node.track.match import Pairs, assign
from livedeform.stereo_node.track.near import distances, mahalanobis2
from livedeform.stereo_node.track.shifts import filled, shifted

Rows = NDArray[np.int64]
MAY_BE_NEIGHBOURS = "may be its neighbour"  # why none of these is published


@dataclass(frozen=True)
class TrackSettings:
    """The gates of tracking: how far markers may be from their prediction. Lengths in m, speeds in m/s."""

    jitter: float = 3e-4  # of the prediction of a marker seen in the last frame
    speed_change: float = 0.04  # that one frame may bring
    lost_sigma: float = 1e-3  # of a marker that is not seen while nothing moves
    smooth_length: float = 3.0  # correlation length of the displacement, in distances between neighbours
    gate: float = 4.0  # sigmas
    spacing_share: float = 0.45  # of the distance to the next marker: no gate is wider
    distinct: float = 9.0  # chi-square by which another identity must be worse
    torn: float = (
        8e-4  # m, how far a marker may move otherwise than its neighbours, besides what their own scatter allows
    )
    confirm: int = 2  # sightings before a returning marker is published
    forgive: int = 2  # frames in a row that a marker may be missed without having to be confirmed again
    forget_seconds: float = 0.3  # after which a velocity says nothing any more


@dataclass(frozen=True)
class Tracked:
    """Rows of markers and of pairs (n,) that belong together, which of them are confirmed, and counts of the rest;
    ``n_by_model``: markers not seen before that were looked for where the model's prediction puts them."""

    markers: Rows
    pairs: Rows
    confirmed: NDArray[np.bool_]
    rejected: dict[str, int] = field(default_factory=dict)
    n_by_model: int = 0


class IdentityTracker:
    """Keeps which point is which marker. Positions are in the left camera's frame, metres."""

    def __init__(
        self, rest: Array, seen: NDArray[np.bool_], settings: TrackSettings, start_sigma: float | Array
    ) -> None:
        """Start from all markers at ``rest`` (m, 3) m; ``seen`` (m,): measured there; ``start_sigma`` m, of all or
        (m,), of those not measured. A marker that is first seen later lies where it is seen: its rest is corrected by
        that."""
        self.settings = settings
        self.rest = rest.copy()
        self.position = rest.copy()
        self.velocity = np.zeros_like(rest)
        self.sightings = np.where(seen, settings.confirm, 0)
        self._missed = np.where(seen, 0, settings.forgive + 1)
        self.start_sigma = np.broadcast_to(np.asarray(start_sigma, float), len(rest))
        self.ever_seen = seen.copy()
        self.stamp_ns: int | None = None
        self._n_by_model = 0
        self._in_doubt = False
        distance = distances(rest, rest)
        np.fill_diagonal(distance, np.inf)
        self.spacing = distance.min(axis=1) if len(rest) > 1 else np.full(len(rest), np.inf)
        length = settings.smooth_length * float(np.median(self.spacing)) if len(rest) > 1 else 1.0
        self._field = SmoothField(np.where(np.isfinite(distance), distance, 0.0), length)

    def predict(self, stamp_ns: int, model: Array | None = None) -> tuple[Array, Array]:
        """Predict positions (m, 3) at ``stamp_ns`` and their sigmas (m,); ``model`` (m, 3): the model's prediction, NaN
        where unknown. It says where markers are that are not seen, where it does better than the rest's shape."""
        s = self.settings
        dt = 0.0 if self.stamp_ns is None else max((stamp_ns - self.stamp_ns) * 1e-9, 0.0)
        fresh = self.fresh
        fade = np.exp(-dt / s.forget_seconds)
        position = self.position + self.velocity * dt * fade
        sigma = np.full(len(self.rest), s.jitter) + s.speed_change * dt
        lost = ~fresh
        if lost.any():
            carried, spread = self._carried_along(lost, position, fresh, model)
            position[lost] = carried
            base = np.where(self.ever_seen[lost], s.lost_sigma, np.maximum(s.lost_sigma, self.start_sigma[lost]))
            # a neighbour's velocity is known, so that only a part of what one frame may bring is left
            sigma[lost] = np.sqrt(base**2 + spread**2 + (0.25 * s.speed_change * dt) ** 2)
        return position, sigma

    def places(self) -> tuple[Array, Array]:
        """Return where all markers are (m, 3) as far as is known at the last stamp, and the sigmas (m,) of that."""
        if self.stamp_ns is None:
            return self.rest.copy(), self.start_sigma.copy()
        return self.predict(self.stamp_ns)

    @property
    def fresh(self) -> NDArray[np.bool_]:
        """Return which markers (m,) were seen in the last frame."""
        return np.asarray((self._missed == 0) & (self.sightings > 0))

    def _carried_along(
        self, lost: NDArray[np.bool_], position: Array, fresh: NDArray[np.bool_], model: Array | None
    ) -> tuple[Array, Array]:
        """Return where ``lost`` markers are and the standard deviation of that: carried along from the rest, or from
        the model's prediction where that leaves less of what the markers that are seen do."""
        self._n_by_model = 0
        if not fresh.any():
            last = self.position if model is None else np.where(np.isfinite(model), model, self.position)
            return last[lost], np.where(self.ever_seen[lost], 5e-3, 0.0)
        carried, spread, size = self._kriged(self.rest, lost, position, fresh)
        if model is None:
            return carried, spread
        told = np.asarray(np.isfinite(model).all(axis=1))
        if (told & fresh).sum() < MIN_NEIGHBOURS or not (told & lost).any():
            return carried, spread
        by_model, model_spread, model_size = self._kriged(model, lost & told, position, fresh & told)
        if model_size < size:
            carried[told[lost]], spread[told[lost]] = by_model, model_spread
            self._n_by_model = len(by_model)
        return carried, spread

    def _kriged(
        self, base: Array, lost: NDArray[np.bool_], position: Array, fresh: NDArray[np.bool_]
    ) -> tuple[Array, Array, float]:
        """Return ``base`` of the lost markers plus what the ``fresh`` ones are beside theirs, carried over by the
        smooth field, the standard deviation of that, and the size of that field, m."""
        moved, spread, size = self._field.carried(np.flatnonzero(fresh), (position - base)[fresh], np.flatnonzero(lost))
        return base[lost] + moved, spread, size

    def update(
        self, stamp_ns: int, pairs: Pairs, model: Array | None = None, names: NDArray[np.int64] | None = None
    ) -> Tracked:
        """Give identities to ``pairs`` (points in the left frame) and move the state on to ``stamp_ns``.

        ``names`` (k,): rows of markers where the pictures name them, -1 for none: then nothing is inferred.
        """
        if names is not None:
            return self._update_named(stamp_ns, pairs, names)
        first = self.stamp_ns is None
        for position, sigma in self._expected(stamp_ns, model):
            markers, rows, doubtful = self._assign(pairs, position, sigma)
            smooth = self._smooth(pairs, markers, rows, position)
            # a doubt lasts until most are found again; where all are hidden, no picture came
            few = 2 * smooth.sum() < self.fresh.sum() if self._in_doubt else not smooth.any() and self.fresh.any()
            self._in_doubt = bool(few) or self._may_be_neighbours(stamp_ns, pairs, markers, rows, position)
            if not self._in_doubt:
                break
        else:
            nobody = np.zeros(0, np.int64)
            rejected = {MAY_BE_NEIGHBOURS: len(markers), "no marker there": len(np.unique(pairs.left)) - len(markers)}
            return Tracked(nobody, nobody, np.zeros(0, bool), {k: v for k, v in rejected.items() if v > 0})
        n_by_model, untouched = self._n_by_model, _untouched(pairs, rows[smooth])
        self._learn_rest(markers, pairs.points.points[rows] - position[markers])
        markers, rows = markers[smooth], rows[smooth]
        self._advance(stamp_ns, markers, pairs.points.points[rows])
        # at first nothing went before that could be mistaken
        confirmed = (self.sightings[markers] >= self.settings.confirm) | first
        rejected = {
            "no marker there": len(np.unique(pairs.left[untouched])),
            "identity in doubt": doubtful,
            "does not move with its neighbours": int((~smooth).sum()),
            "waits for a second sighting": int((~confirmed).sum()),
        }
        return Tracked(markers, rows, confirmed, {k: v for k, v in rejected.items() if v}, n_by_model)

    def _expected(self, stamp_ns: int, model: Array | None) -> Iterator[tuple[Array, Array]]:
        """Yield where markers (m, 3) may be, and the sigmas (m,) of that: as predicted, or else at rest again."""
        position, sigma = self.predict(stamp_ns, model)
        yield position, sigma
        yield self.rest, sigma

    def _may_be_neighbours(self, stamp_ns: int, pairs: Pairs, markers: Rows, rows: Rows, position: Array) -> bool:
        """Tell whether the ``rows`` (n,) of ``pairs`` may be those of the neighbours of ``markers`` (n,): as such, more
        markers are seen that move with their neighbours, and the body is not bent distinctly more by that.
        ``position`` (m, 3) m: where all are expected."""
        if self.stamp_ns is None:
            return False
        s, dt = self.settings, max((stamp_ns - self.stamp_ns) * 1e-9, 0.0)
        row_of = np.full(len(position), -1)
        row_of[markers] = rows
        # what is in doubt as a marker that comes back is in its place all the same
        row_of = filled(row_of, position, self.spacing, np.flatnonzero(_untouched(pairs, rows)), pairs)
        free = np.flatnonzero(_untouched(pairs, row_of[row_of >= 0]))
        reach = s.gate * (s.jitter + s.speed_change * dt) + 0.5 * float(np.median(self.spacing))
        together, size = -1, 0.0
        for other in shifted(position, self.spacing, row_of, free, pairs, reach):
            if together < 0:
                named, surprise, field = self._named(pairs, row_of, position)
                together, size = int(self._together(pairs, row_of[named], field, surprise).sum()), field.size(surprise)
            # what costs least is asked first
            if ((other >= 0) & self.ever_seen).sum() <= together:
                continue
            named, surprise, field = self._named(pairs, other, position)
            if (
                field.size(surprise) ** 2 < s.distinct * (size**2 + s.jitter**2)
                and self._together(pairs, other[named], field, surprise, together + 1).sum() > together
            ):
                return True
        return False

    def _named(self, pairs: Pairs, row_of: Rows, position: Array) -> tuple[Rows, Array, Among]:
        """Return the markers (n,) seen before that have one of the rows ``row_of`` (m,) of ``pairs``, -1 for none, how
        far (n, 3) m they are from ``position`` (m, 3) m, and what solves for their field."""
        named = np.flatnonzero((row_of >= 0) & self.ever_seen)
        return named, pairs.points.points[row_of[named]] - position[named], self._field.among(named)

    def _together(self, pairs: Pairs, rows: Rows, field: Among, surprise: Array, least: int = 0) -> NDArray[np.bool_]:
        """Tell which markers (n,) of a ``field``, with the ``rows`` (n,) of ``pairs``, move with their neighbours; any,
        where there are less than ``least``. A false spot beside a marker that was missed does not."""
        noise = np.sqrt(np.trace(pairs.points.covariances[rows], axis1=1, axis2=2))
        return field.move_together(surprise, self.settings.torn + 4 * noise, least)

    def _update_named(self, stamp_ns: int, pairs: Pairs, names: Rows) -> Tracked:
        rows = np.flatnonzero(names >= 0)
        self._advance(stamp_ns, names[rows], pairs.points.points[rows])
        unknown = len(names) - len(rows)
        return Tracked(names[rows], rows, np.ones(len(rows), bool), {"code of no marker": unknown} if unknown else {})

    def _assign(self, pairs: Pairs, position: Array, sigma: Array) -> tuple[Rows, Rows, int]:
        """Assign pairs to the markers seen in the last frame, and what they leave to those that come back.

        Returns rows of markers and of pairs (n,), and how many that come back were in doubt.
        """
        s, fresh = self.settings, self.fresh
        reach = np.where(fresh, s.spacing_share * self.spacing, np.inf)
        cost = mahalanobis2(position, sigma, reach, pairs.points.points, pairs.points.covariances, s.gate)
        cost += ((pairs.epipolar_px / pairs.epipolar_sigma_px) ** 2)[None]
        markers, rows = _assign_apart(cost[fresh], pairs, s.gate**2 + 16.0)
        markers = np.flatnonzero(fresh)[markers]
        back_markers, back_rows, doubtful = self._returning(cost, ~fresh, _untouched(pairs, rows), pairs)
        return np.concatenate([markers, back_markers]), np.concatenate([rows, back_rows]), doubtful

    def _smooth(self, pairs: Pairs, markers: Rows, rows: Rows, position: Array) -> NDArray[np.bool_]:
        """Tell which (n,) move with their neighbours, or were never seen before."""
        surprise = pairs.points.points[rows] - position[markers]
        known = self.ever_seen[markers]
        smooth = np.ones(len(markers), bool)
        smooth[known] = self._together(pairs, rows[known], self._field.among(markers[known]), surprise[known])
        return smooth

    def _learn_rest(self, markers: Rows, surprise: Array) -> None:
        """Put the rest of ``markers`` (n,) never seen before where they are, ``surprise`` (n, 3) m from it."""
        new = ~self.ever_seen[markers]
        self.rest[markers[new]] += surprise[new]

    def _returning(
        self, cost: Array, lost: NDArray[np.bool_], free: NDArray[np.bool_], pairs: Pairs
    ) -> tuple[Rows, Rows, int]:
        """Find lost markers that are surely seen again: rows of markers, of pairs, and how many were in doubt."""
        lost_rows, free_rows = np.flatnonzero(lost), np.flatnonzero(free)
        table = cost[np.ix_(lost_rows, free_rows)]
        free_pairs, limit = pairs.take(free_rows), self.settings.gate**2 + 16.0
        table[table >= limit] = np.inf
        column, best, without = assign_apart_and_without(table, free_pairs.left, free_pairs.right, limit)
        i = np.flatnonzero(column >= 0)
        j = column[i]
        clear = without[i] - best > self.settings.distinct  # how much worse is the world in which this is not so?
        return lost_rows[i[clear]], free_rows[j[clear]], int((~clear).sum())

    def _advance(self, stamp_ns: int, markers: Rows, points: Array) -> None:
        dt = 0.0 if self.stamp_ns is None else (stamp_ns - self.stamp_ns) * 1e-9
        was_fresh = self.fresh
        if dt > 0:
            moved = was_fresh[markers]
            speed = (points - self.position[markers]) / dt
            self.velocity[markers] = np.where(moved[:, None], 0.5 * self.velocity[markers] + 0.5 * speed, 0.0)
        seen = np.zeros(len(self.rest), bool)
        seen[markers] = True
        self.velocity[~seen] = 0.0
        self.position[markers] = points
        self._missed = np.where(seen, 0, self._missed + 1)
        self.sightings = np.where(
            seen, self.sightings + 1, np.where(self._missed > self.settings.forgive, 0, self.sightings)
        )
        self.ever_seen |= seen
        self.stamp_ns = stamp_ns


def _assign_apart(cost: Array, pairs: Pairs, limit: float) -> tuple[Rows, Rows]:
    """Assign such that no blob of either picture serves two markers."""
    cost = cost.copy()
    for _ in range(20):
        rows, cols = assign(cost, limit)
        order = np.argsort(cost[rows, cols])
        worse = np.zeros(len(rows), bool)
        for blobs in (pairs.left[cols], pairs.right[cols]):
            worse[order] |= _is_again(blobs[order])
        if not worse.any():
            break
        cost[rows[worse], cols[worse]] = np.inf
    return rows, cols


def _is_again(values: Rows) -> NDArray[np.bool_]:
    """Tell which values (n,) were among those before them."""
    again = np.ones(len(values), bool)
    again[np.unique(values, return_index=True)[1]] = False
    return again


def _untouched(pairs: Pairs, rows: Rows) -> NDArray[np.bool_]:
    """Return which pairs share no blob with the pairs ``rows``."""
    return ~(np.isin(pairs.left, pairs.left[rows]) | np.isin(pairs.right, pairs.right[rows]))
