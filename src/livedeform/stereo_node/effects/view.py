"""The view that a measuring effect has of the experiment, besides its own values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from livedeform.common.effect import EffectInfo
from livedeform.common.errors import InputError
from livedeform.common.frames import apply, fit_rigid, inverse
from livedeform.common.types import Array, Ids
from livedeform.stereo_node.camera.rig import StereoRig

Surface = tuple[Array, NDArray[np.int64]]
"""Points (m, 3) m in phantom and outward triangles (k, 3)."""


@dataclass(frozen=True)
class View:
    """The part of the experiment that an effect is told: row i of its points is the marker ``ids[i]``.

    ``T_phantom_left`` (4, 4); ``rest`` (n, 3) m in phantom: the markers at rest, on which the cameras were registered;
    ``kinds`` (n,) surface, internal or support; ``start_ns`` the first stamp of the earliest recording;
    ``surface(stamp_ns)`` the predicted surface; ``registered`` False where the cameras' pose was given and not found
    from the markers.
    """

    T_phantom_left: Array
    rig: StereoRig | None
    rest: Array
    ids: Ids
    kinds: NDArray[np.str_]
    start_ns: int
    surface: Callable[[int], Surface | None] | None = None
    registered: bool = True
    anchors: Array | None = (
        None  # (a, 3) m in phantom, the markers that were registered on; None: all that are not internal
    )

    def take(self, rows: NDArray[Any]) -> View:
        """Return the view of some of the markers; the registration still rests on all of them."""
        anchors = self.anchors if self.anchors is not None else self._outside()
        return replace(self, rest=self.rest[rows], ids=self.ids[rows], kinds=self.kinds[rows], anchors=anchors)

    def _outside(self) -> Array:
        outside = self.kinds != "internal"
        return self.rest[outside] if outside.sum() >= 3 else self.rest

    def for_ids(self, ids: Ids) -> View:
        """Return the view of the markers ``ids``, in this order; all must be known."""
        order = {int(name): row for row, name in enumerate(self.ids)}
        return self.take(np.array([order[int(name)] for name in ids], np.int64))

    def cameras(self, effect: str) -> StereoRig:
        """Return the rig; ``InputError`` where the recording has none."""
        if self.rig is None:
            raise InputError(
                f"the effect '{effect}' needs the cameras' calibration",
                where="stereo",
                remedy="name stereo.left and stereo.right",
            )
        return self.rig


class MeasuringEffect(Protocol):
    """The interface of each module of this package: its identity card and two functions."""

    INFO: EffectInfo

    def distort(self, points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
        """Return what an uncorrected rig reports for true ``points`` (n, 3) m in phantom."""

    def correct(self, points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
        """Correct reported points to true ones: the inverse."""


def reregistration(view: View, bend: Callable[[Array], Array]) -> Array:
    """Return T (4, 4) that a registration at rest puts after ``bend`` (left frame -> left frame), in the left frame.

    The cameras' pose is found from what they report of the markers at rest, so that a rigid part of the error is not
    seen.
    """
    rest = view.anchors if view.anchors is not None else view._outside()
    if not view.registered or len(rest) < 3:
        return np.eye(4)
    in_left = apply(inverse(view.T_phantom_left), rest)
    return fit_rigid(bend(in_left), in_left)


def through_left(points: Array, view: View, change: Callable[[Array], Array]) -> Array:
    """Apply ``change`` in the left camera's frame to ``points`` in phantom."""
    return apply(view.T_phantom_left, change(apply(inverse(view.T_phantom_left), points)))


def invert(target: Array, change: Callable[[Array], Array], n_iterations: int = 60) -> Array:
    """Find the points that ``change`` takes to ``target`` (n, 3) by fixed-point steps; it must be near the identity."""
    points = target.copy()
    for _ in range(n_iterations):
        step = target - change(points)
        points = points + step
        if not np.abs(step).max(initial=0.0) > 1e-11:
            break
    return points
