"""Types that travel between the packages: frozen, SI, float64, in the frame ``phantom`` unless a name says
otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Array",
    "CameraCalibration",
    "EffectValues",
    "Ids",
    "Image",
    "MarkerFrame",
    "Pose",
    "PredictedMarkers",
    "Prediction",
    "Wrench",
]

Array = NDArray[np.float64]
Ids = NDArray[np.uint32]


@dataclass(frozen=True)
class Pose:
    """A stamped rigid pose T_target_source: position (3,) m, orientation (4,) unit quaternion x, y, z, w."""

    stamp_ns: int
    position: Array
    orientation_xyzw: Array


@dataclass(frozen=True)
class Wrench:
    """Force of the probe on the phantom (3,) N and its torque about the phantom frame's origin (3,) N m."""

    stamp_ns: int
    force: Array
    torque: Array


@dataclass(frozen=True)
class Image:
    """One picture: ``pixels`` (h, w) or (h, w, 3) uint8; ``encoding`` mono8, bgr8 or rgb8."""

    stamp_ns: int
    pixels: NDArray[np.uint8]
    encoding: str = "mono8"
    frame_id: str = ""


@dataclass(frozen=True)
class CameraCalibration:
    """One camera of a rectifiable stereo pair, as in ROS ``camera_calibration``.

    ``camera_matrix`` (3, 3) px, ``dist_coeffs`` (k,), ``rectification`` (3, 3), ``projection`` (3, 4) px and px m;
    ``distortion_model`` plumb_bob, rational_polynomial or equidistant.
    """

    name: str
    width: int
    height: int
    camera_matrix: Array
    dist_coeffs: Array
    rectification: Array
    projection: Array
    distortion_model: str = "plumb_bob"


@dataclass(frozen=True)
class MarkerFrame:
    """Measured markers of one moment.

    ``points`` (n, 3) m; ``covariances`` (n, 3, 3) m2, NaN where the tracker gives none; ``reprojection_error_px`` (n,),
    NaN where there is none.
    """

    stamp_ns: int
    ids: Ids
    points: Array
    covariances: Array
    reprojection_error_px: Array


@dataclass(frozen=True)
class PredictedMarkers:
    """Predicted markers of one moment: ``points`` (n, 3) m for ``ids`` (n,); NaN where the model did not converge."""

    stamp_ns: int
    ids: Ids
    points: Array

    @property
    def converged(self) -> bool:
        """Return whether the model found a solution at this stamp."""
        return bool(len(self.points) == 0 or np.isfinite(self.points).any())


@dataclass(frozen=True)
class Prediction:
    """The model's prediction of one moment.

    ``markers`` (n, 3) m for ``ids`` (n,); ``surface`` (m, 3) m for ``surface_nodes`` (m,) with ``triangles`` (k, 3)
    indexing rows of ``surface``; ``lesions`` (l, 3) m centres. ``force`` (3,) N and ``torque`` (3,) N m are the probe's
    on the phantom, the torque about the phantom frame's origin. Where ``converged`` is False, positions are NaN and
    ``message`` says why.
    """

    stamp_ns: int
    ids: Ids
    markers: Array
    surface: Array
    surface_nodes: Ids
    triangles: NDArray[np.int64]
    lesions: Array
    force: Array
    torque: Array
    converged: bool
    message: str = ""
    n_iterations: int = 0
    solve_seconds: float = 0.0
    error_bound: float = float("nan")  # m, against the converged full model, where an approximation was used


@dataclass(frozen=True)
class EffectValues:
    """An effect with values: what ``experiment.effects`` and ``diagnosis.json`` hold. Scalars have the shape ().

    ``intervals``: the two ends, in a last axis more, of 95 %; ``declared``: the values in whose place these are.
    """

    name: str
    values: Mapping[str, Array]
    sigmas: Mapping[str, Array] = field(default_factory=dict)
    intervals: Mapping[str, Array] = field(default_factory=dict)
    declared: Mapping[str, Array] = field(default_factory=dict)
