"""Evidence from which the report of a run is made."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array, Image, PredictedMarkers, Wrench
from livedeform.compare_node.metrics import RunMetrics
from livedeform.compare_node.residual import Residual
from livedeform.report.playback import Playback
from livedeform.stereo_node.camera.rig import StereoRig


@dataclass(frozen=True)
class SurfaceMesh:
    """A surface: ``vertices`` (n, 3) m and ``triangles`` (k, 3)."""

    vertices: Array
    triangles: NDArray[np.int64]


@dataclass(frozen=True)
class RunEvidence:
    """Hold what a run's page is made of.

    ``residuals``, ``predictions`` and ``wrenches`` (predicted) in the order of their stamps; ``surfaces`` gives the
    predicted surface nearest to a stamp, ``pictures`` the (left, right) images, ``playback`` the run over time;
    ``counts`` are (what, how many, what it means) rows, ``facts`` (what, value) rows; ``configuration`` is the
    effective experiment as YAML; ``distances``: columns of ``surface.csv``, empty without points that have no ids.
    """

    start_ns: int
    residuals: Sequence[Residual]
    predictions: Sequence[PredictedMarkers]
    wrenches: Sequence[Wrench] = ()
    surfaces: Callable[[int], SurfaceMesh | None] = lambda stamp_ns: None
    rig: StereoRig | None = None
    T_phantom_left: Array | None = None
    pictures: Callable[[int], tuple[Image | None, Image | None]] = lambda stamp_ns: (None, None)
    counts: Sequence[tuple[str, str, str]] = ()
    facts: Sequence[tuple[str, str]] = ()
    configuration: str = ""
    distances: Mapping[str, Array] = field(default_factory=dict)
    playback: Callable[[], Playback | None] = lambda: None
    metrics: RunMetrics | None = None  # as the run wrote them; None: from the residuals
