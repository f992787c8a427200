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
from livedeform.stereo_node.track.match import Pairs, assign
from livedeform.stereo_node.track.shifts import filled, shifted

Rows = NDArray[np.int64]
MIN_NEIGHBOURS = 8
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
        distance = np.linalg.norm(rest[:, None] - rest[None], axis=2)
        np.fill_diagonal(distance, np.inf)
        self.spacing = distance.min(axis=1) if len(rest) > 1 else np.full(len(rest), np.inf)
        length = settings.smooth_length * float(np.median(self.spacing)) if len(rest) > 1 else 1.0
        a = np.sqrt(3) * np.where(np.isfinite(distance), distance, 0.0) / length
        self._kernel = (1 + a) * np.exp(-a)  # Matern 3/2: a field with continuous slopes

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
        """Return ``base`` of the lost markers plus what the ``fresh`` ones are beside theirs, carried over by a
        Gaussian process (kriging; Rasmussen & Williams 2.2), the standard deviation of that, and the size of that
        field, m."""
        displacement = (position - base)[fresh]
        mean = displacement.mean(axis=0)
        K = self._kernel[np.ix_(fresh, fresh)] + 1e-3 * np.eye(int(fresh.sum()))
        k = self._kernel[np.ix_(lost, fresh)]
        weights = np.linalg.solve(K, k.T).T
        left_over = np.maximum(1 - (weights * k).sum(axis=1), 0.0)
        size = self._size(np.flatnonzero(fresh), displacement)
        return base[lost] + mean + weights @ (displacement - mean), size * np.sqrt(left_over), size

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
        together, size = self._moving_together(pairs, row_of, position)
        free = np.flatnonzero(_untouched(pairs, row_of[row_of >= 0]))
        reach = s.gate * (s.jitter + s.speed_change * dt) + 0.5 * float(np.median(self.spacing))
        for other in shifted(position, self.spacing, row_of, free, pairs, reach):
            as_well, other_size = self._moving_together(pairs, other, position)
            if as_well.sum() > together.sum() and other_size**2 < s.distinct * (size**2 + s.jitter**2):
                return True
        return False

    def _moving_together(self, pairs: Pairs, row_of: Rows, position: Array) -> tuple[NDArray[np.bool_], float]:
        """Tell which markers (m,) move with their neighbours if the rows ``row_of`` (m,) of ``pairs`` are theirs, -1
        for none, and the size (m) of the field by which all of them moved from ``position`` (m, 3) m."""
        named = np.flatnonzero((row_of >= 0) & self.ever_seen)
        surprise = pairs.points.points[row_of[named]] - position[named]
        together = np.zeros(len(row_of), bool)
        together[named] = self._moves_with_neighbours(named, surprise, pairs.points.covariances[row_of[named]])
        return together, self._size(named, surprise)

    def _size(self, markers: Rows, moved: Array) -> float:
        """Return the size (m) of the smooth field that ``moved`` the markers (n,) by (n, 3) m, beside their mean."""
        if len(markers) == 0:
            return 0.0
        K = self._kernel[np.ix_(markers, markers)] + 1e-3 * np.eye(len(markers))
        rest = moved - moved.mean(axis=0)
        # from the data themselves (their quadratic form), per axis
        return float(np.sqrt((rest * np.linalg.solve(K, rest)).sum() / (3 * len(rest))))

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
        cost = self._cost(position, sigma, pairs.points.points, pairs.points.covariances, reach)
        cost = cost + ((pairs.epipolar_px / pairs.epipolar_sigma_px) ** 2)[None]
        markers, rows = _assign_apart(cost[fresh], pairs, s.gate**2 + 16.0)
        markers = np.flatnonzero(fresh)[markers]
        back_markers, back_rows, doubtful = self._returning(cost, ~fresh, _untouched(pairs, rows), pairs)
        return np.concatenate([markers, back_markers]), np.concatenate([rows, back_rows]), doubtful

    def _smooth(self, pairs: Pairs, markers: Rows, rows: Rows, position: Array) -> NDArray[np.bool_]:
        """Tell which (n,) move with their neighbours, or were never seen before."""
        surprise = pairs.points.points[rows] - position[markers]
        known = self.ever_seen[markers]
        smooth = np.ones(len(markers), bool)
        covariances = pairs.points.covariances[rows[known]]
        smooth[known] = self._moves_with_neighbours(markers[known], surprise[known], covariances)
        return smooth

    def _learn_rest(self, markers: Rows, surprise: Array) -> None:
        """Put the rest of ``markers`` (n,) never seen before where they are, ``surprise`` (n, 3) m from it."""
        new = ~self.ever_seen[markers]
        self.rest[markers[new]] += surprise[new]

    def _moves_with_neighbours(self, markers: Rows, surprise: Array, covariances: Array) -> NDArray[np.bool_]:
        """Return which markers are about as far from their prediction, ``surprise`` (n, 3), as their neighbours
        foretell (leave-one-out kriging; Rasmussen & Williams 5.4.2). A false spot beside a marker that was missed is
        not. Worst first, one by one."""
        keep = np.ones(len(markers), bool)
        noise = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
        while keep.sum() >= MIN_NEIGHBOURS:
            rows = np.flatnonzero(keep)
            precision = np.linalg.inv(self._kernel[np.ix_(markers[rows], markers[rows])] + 1e-3 * np.eye(len(rows)))
            spread = 1 / np.sqrt(np.diag(precision))
            off = np.linalg.norm(precision @ (surprise[rows] - np.median(surprise[rows], axis=0)), axis=1) * spread**2
            size = np.median(off / spread)
            excess = off - (self.settings.torn + 4 * noise[rows] + 6 * size * spread)
            worst = int(np.argmax(excess))
            if excess[worst] <= 0:
                break
            keep[rows[worst]] = False
        return keep

    def _cost(self, position: Array, sigma: Array, points: Array, covariances: Array, reach: Array) -> Array:
        """Compute the squared Mahalanobis distance (m, k) of every point from every marker's prediction, inf outside
        its gate."""
        difference = points[None] - position[:, None]
        distance = np.linalg.norm(difference, axis=2)
        out = np.full(distance.shape, np.inf)
        # far pairs are sorted out by distance first: most of the table is far
        near = (distance < reach[:, None]) & (
            distance < self.settings.gate * (sigma[:, None] + np.sqrt(covariances.trace(axis1=1, axis2=2))[None])
        )
        i, j = np.nonzero(near)
        S = covariances[j] + (sigma[i] ** 2)[:, None, None] * np.eye(3)
        d = difference[i, j]
        d2 = np.einsum("ni,ni->n", d, np.linalg.solve(S, d[:, :, None])[:, :, 0])
        inside = d2 < self.settings.gate**2
        out[i[inside], j[inside]] = d2[inside]
        return out

    def _returning(
        self, cost: Array, lost: NDArray[np.bool_], free: NDArray[np.bool_], pairs: Pairs
    ) -> tuple[Rows, Rows, int]:
        """Find lost markers that are surely seen again: rows of markers, of pairs, and how many were in doubt."""
        lost_rows, free_rows = np.flatnonzero(lost), np.flatnonzero(free)
        if not len(lost_rows) or not len(free_rows):
            return np.zeros(0, np.int64), np.zeros(0, np.int64), 0
        table = cost[np.ix_(lost_rows, free_rows)]
        free_pairs, limit = pairs.take(free_rows), self.settings.gate**2 + 16.0
        i, j = _assign_apart(table, free_pairs, limit)
        best = _total(table, i, j, limit)
        clear = np.ones(len(i), bool)
        for k, (a, b) in enumerate(zip(i, j, strict=True)):  # how much worse is the world in which this is not so?
            without = table.copy()
            without[a, b] = np.inf
            clear[k] = (
                _total(without, *_assign_apart(without, free_pairs, limit), limit) - best > self.settings.distinct
            )
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
        worst: list[tuple[int, int]] = []
        for blobs in (pairs.left[cols], pairs.right[cols]):
            order = np.argsort(cost[rows, cols])
            first: set[int] = set()
            for k in order:
                if int(blobs[k]) in first:
                    worst.append((int(rows[k]), int(cols[k])))
                first.add(int(blobs[k]))
        if not worst:
            break
        for row, col in worst:
            cost[row, col] = np.inf
    return rows, cols


def _total(cost: Array, rows: Rows, cols: Rows, limit: float) -> float:
    """Return cost of an assignment, with ``limit`` for every row that is left alone."""
    return float(cost[rows, cols].sum() + limit * (len(cost) - len(rows)))


def _untouched(pairs: Pairs, rows: Rows) -> NDArray[np.bool_]:
    """Return which pairs share no blob with the pairs ``rows``."""
    return ~(np.isin(pairs.left, pairs.left[rows]) | np.isin(pairs.right, pairs.right[rows]))
