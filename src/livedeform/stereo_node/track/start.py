"""The first pictures: where the cameras are, and where the search for each marker starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from livedeform.common.frames import apply, inverse
from livedeform.common.types import Array
from livedeform.stereo_node.track.identities import IdentityTracker, TrackSettings
from livedeform.stereo_node.track.match import Pairs
from livedeform.stereo_node.track.register import (
    MIN_MARKERS,
    Registration,
    RegistrationError,
    SeenFromInside,
    register,
    register_either_way,
)
from livedeform.stereo_node.track.sides import nearly_flat

Rows = NDArray[np.int64]
INTERNAL_SIGMA = 3e-3  # m: refraction lifts a marker 10 mm below the surface by that
WIDER = 2.5  # times the tolerance at rest with which the registration is tried again


@dataclass(frozen=True)
class MarkersAtRest:
    """The declared places of the markers at rest: ``points`` (m, 3) m in phantom, and ``kinds`` (m,).

    ``tolerance`` m is how far they may lie from there, ``tolerance_most`` m what is tried when that does not do.
    ``outward`` (3,): where they lie in a plane, its normal out of the body, if that is known.
    """

    points: Array
    kinds: NDArray[np.str_]
    tolerance: float
    tolerance_most: float
    outward: Array | None = None

    @property
    def outside(self) -> NDArray[np.int64]:
        """Rows of the markers that the cameras are registered to: internal ones are seen where refraction puts them."""
        rows = np.flatnonzero(self.kinds != "internal")
        return rows if len(rows) >= MIN_MARKERS else np.arange(len(self.kinds))

    def side(self) -> Array | None:
        """Return the normal (3,) of the side that the cameras see, None where the markers do not lie in a plane;
        ``RegistrationError`` where they do and the side is not known."""
        if not nearly_flat(self.points[self.outside]):
            return None
        if self.outward is None:
            raise RegistrationError(
                "the markers lie in a plane, and which side of it is out of the body is not known: mirrored places "
                "would fit as well",
                where="stereo.pose",
                remedy="give the pose, or put the markers on the body's surface",
            )
        return self.outward

    def sigma(self, sigma: float) -> Array:
        """Return how far (m,) m markers may be from where they are declared when they are first seen."""
        return np.where(self.kinds == "internal", np.maximum(sigma, INTERNAL_SIGMA), sigma)


def register_cameras(pairs: Pairs, codes: Sequence[Rows] | None, rest: MarkersAtRest) -> Registration:
    """Find T_phantom_left from the ``pairs`` of the first pictures; ``RegistrationError`` where it is not unique.

    ``codes``: rows (k,) of the markers where the pictures name them, -1 for none, in each way that looks alike.
    """
    if len(pairs) == 0:
        raise RegistrationError(
            "no spot of the left picture meets one of the right picture",
            where="stereo calibration",
            remedy="check that left and right are not exchanged and that the calibration is of these cameras",
        )
    points, outside, side = pairs.points, rest.outside, rest.side()
    if codes is not None:
        named = [np.where(np.isin(names, outside), names, -1) for names in codes]
        return register_either_way(points.points, points.covariances, rest.points, named, rest.tolerance_most, side)
    groups = np.stack([pairs.left, pairs.right], axis=1)
    tolerance = rest.tolerance
    while True:
        try:
            found = register(
                points.points, points.covariances, rest.points[outside], tolerance, groups=groups, outward=side
            )
            return replace(found, marker_rows=outside[found.marker_rows])
        except SeenFromInside:
            raise
        except RegistrationError:
            tolerance *= WIDER
            if tolerance > rest.tolerance_most:
                raise


def named_as_before(codes: Sequence[Rows] | None, pairs: Pairs, identities: IdentityTracker) -> Rows | None:
    """Return the one of ``codes``, ways of naming the ``pairs`` that look alike, by which markers are nearest to where
    they were; None without codes."""
    if codes is None or len(codes) == 1:
        return None if codes is None else codes[0]
    points, before = pairs.points.points, identities.places()[0]
    apart = [np.linalg.norm(points[names >= 0] - before[names[names >= 0]], axis=1) for names in codes]
    return codes[int(np.argmin([np.median(d) if len(d) else np.inf for d in apart]))]


def track_from_pose(T_phantom_left: Array, rest: MarkersAtRest, settings: TrackSettings) -> IdentityTracker:
    """Start the identities where ``T_phantom_left`` was given: no marker is known before it is seen."""
    in_left = apply(inverse(T_phantom_left), rest.points)
    return IdentityTracker(in_left, np.zeros(len(in_left), bool), settings, rest.sigma(rest.tolerance_most / 3))


def track_from_registration(
    found: Registration, pairs: Pairs, rest: MarkersAtRest, settings: TrackSettings
) -> IdentityTracker:
    """Start the identities where the registration found them: its markers lie where they were measured."""
    in_left = apply(inverse(found.T_phantom_left), rest.points)
    seen = np.zeros(len(in_left), bool)
    seen[found.marker_rows] = True
    in_left[found.marker_rows] = pairs.points.points[found.point_rows]
    return IdentityTracker(in_left, seen, settings, rest.sigma(3 * rest.tolerance))
