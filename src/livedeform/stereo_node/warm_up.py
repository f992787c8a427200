"""Measure one drawn pair of pictures before the first real one comes, which then does not wait for kernels."""

from __future__ import annotations

import cv2
import numpy as np

from livedeform.common.experiment.schema import Markers
from livedeform.common.frames import transform
from livedeform.common.types import Array, Image
from livedeform.stereo_node.camera.rig import StereoRig, make_rig
from livedeform.stereo_node.detect.settings import DetectorSettings
from livedeform.stereo_node.pipeline import StereoTracker, TrackerSettings

WIDTH, HEIGHT, FOCAL = 640, 480, 600.0  # px
BASELINE, DISTANCE = 0.05, 0.3  # m
SIDE, SPACING = 6, 0.02  # markers along each side of a square, m between them
GREY, CONTRAST = 128, 80
STEPS = 16  # of a drawn circle, per pixel


def warm_up(detector: DetectorSettings) -> None:
    """Find and measure drawn dots as the ``detector`` looks for them: what is compiled or loaded at its first use is
    there afterwards. What is found does not matter."""
    rig, points = _rig(), _points()
    radius = float(np.clip(4.0, detector.min_radius + 1.0, detector.max_radius))
    places = rig.project(points + np.array([0.0, 0.0, DISTANCE]))
    grey = GREY + (CONTRAST if detector.polarity == "light" else -CONTRAST)
    left, right = (Image(1, _drawn(pixels, radius, grey)) for pixels in places[:2])
    n = len(points)
    markers = Markers(np.arange(n, dtype=np.uint32), points, np.full(n, np.nan), np.full(n, "surface"))
    T_phantom_left = transform(np.eye(3), np.array([0.0, 0.0, -DISTANCE]))
    StereoTracker(rig, markers, TrackerSettings(detector=detector), T_phantom_left).process(left, right)


def _rig() -> StereoRig:
    K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    left, right = ((name, WIDTH, HEIGHT, K, np.zeros(5), "plumb_bob") for name in ("left", "right"))
    return make_rig(left, right, transform(np.eye(3), np.array([-BASELINE, 0.0, 0.0])))


def _points() -> Array:
    """Return places (n, 3) m on a bent sheet, none as far from its neighbours as another."""
    i, j = np.divmod(np.arange(SIDE * SIDE), SIDE)
    places = SPACING * (np.column_stack([i, j]) - (SIDE - 1) / 2)
    places += 0.2 * SPACING * np.random.default_rng(0).uniform(-1.0, 1.0, places.shape)
    return np.column_stack([places, 4.0 * (places**2).sum(axis=1)])


def _drawn(pixels: Array, radius: float, grey: int) -> np.ndarray:
    picture = np.full((HEIGHT, WIDTH), GREY, np.uint8)
    for u, v in np.round(pixels * STEPS).astype(int):
        cv2.circle(picture, (int(u), int(v)), round(radius * STEPS), grey, -1, cv2.LINE_AA, int(np.log2(STEPS)))
    noise = np.random.default_rng(0).normal(0.0, 1.0, picture.shape)
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 0.7) + noise, 0, 255).astype(np.uint8)
