"""Markers that cover hardly any of the picture are measured; pictures of one grey are refused nevertheless."""

import re

import cv2
import numpy as np
import pytest
from scene import make_test_rig

from livedeform.common.errors import InputError
from livedeform.common.experiment.yaml_file import Markers
from livedeform.common.types import Image
from livedeform.stereo_node.detect.settings import DetectorSettings
from livedeform.stereo_node.picture_checks import BadPictures, PictureChecks
from livedeform.stereo_node.pipeline import StereoTracker, TrackerSettings

RIG = make_test_rig()


def even(grey: float, seed: int, stuck: int = 0) -> np.ndarray:
    """(720, 1280): one grey, a noise of 1, and pixels that are ``stuck`` at the other end."""
    rng = np.random.default_rng(seed)
    picture = np.clip(np.round(grey + rng.normal(0, 1.0, (720, 1280))), 0, 255).astype(np.uint8)
    picture[rng.integers(0, 720, stuck), rng.integers(0, 1280, stuck)] = 255 if grey < 128 else 0
    return picture


def with_balls(picture: np.ndarray, px: np.ndarray, radius: float, grey: float) -> np.ndarray:
    """Discs of one grey, four times oversampled and blurred by 0.6 px."""
    cover = np.zeros((720 * 4, 1280 * 4), np.uint8)
    for x, y in (px + 0.5) * 4 - 0.5:
        cv2.circle(cover, (round(16 * x), round(16 * y)), round(64 * radius), 255, -1, cv2.LINE_8, 4)
    share = cv2.resize(cover, (1280, 720), interpolation=cv2.INTER_AREA).astype(float) / 255
    share = cv2.GaussianBlur(share, (0, 0), 0.6)
    return np.round(picture * (1 - share) + grey * share).astype(np.uint8)


@pytest.mark.parametrize("radius", [2.5, 4.0, 6.0])
@pytest.mark.parametrize(("ground", "ball"), [(8.0, 200.0), (230.0, 30.0)])
def test_small_balls_before_an_even_ground_are_measured(radius: float, ground: float, ball: float):
    """Retroreflective ones in the dark, which cover 0.05 to 0.3 % of the picture: it was refused as black."""
    rng, points = np.random.default_rng(3), np.zeros((0, 3))
    while len(points) < 24:
        p = rng.uniform([-0.05, -0.07, 0.38], [0.15, 0.07, 0.42])
        if not len(points) or np.linalg.norm(points - p, axis=1).min() > 0.02:
            points = np.vstack([points, p])
    left, right = (px for px in RIG.project(points)[:2])
    n = len(points)
    markers = Markers(np.arange(n, dtype=np.uint32), points, np.full(n, np.nan), np.array(["surface"] * n))
    detector = DetectorSettings(marker="ball")
    tracker = StereoTracker(RIG, markers, TrackerSettings(detector=detector), T_phantom_left=np.eye(4))
    pictures = (with_balls(even(ground, k), px, radius, ball) for k, px in enumerate((left, right)))
    frame, status = tracker.process(*(Image(10**9, p) for p in pictures))
    assert status.level == "ok" and len(frame.ids) == n, status.message
    error = frame.points - points[frame.ids]
    assert np.abs(error).max() < 2e-4  # m; measured 8.6e-5 at most


@pytest.mark.parametrize(("ground", "said"), [(3.0, "black"), (120.0, "of one grey"), (250.0, "white")])
@pytest.mark.parametrize("stuck", [0, 500])
def test_a_picture_of_one_grey_is_refused(ground: float, said: str, stuck: int):
    """With pixels that are stuck, too."""
    checks = PictureChecks(RIG, DetectorSettings().min_contrast / 2, True)
    pictures = (Image(10**9, even(ground, k, stuck)) for k in range(2))
    with pytest.raises(BadPictures, match=f"the left picture is {said}") as refused:
        checks.grey_pair(*pictures)
    assert isinstance(refused.value, InputError)


@pytest.mark.parametrize(("far", "baseline"), [(4.0, 1.0), (0.04, 0.01)])
def test_markers_that_are_too_near_or_far_are_told_so(far: float, baseline: float):
    """It was said that left and right may be exchanged."""
    rig, rng = make_test_rig(baseline=baseline, converge=0.25), np.random.default_rng(3)
    points = far * rng.uniform([-0.2, -0.2, 0.97], [0.4, 0.2, 1.03], (20, 3))
    markers = Markers(np.arange(20, dtype=np.uint32), points, np.full(20, np.nan), np.array(["surface"] * 20))
    tracker = StereoTracker(rig, markers, TrackerSettings(detector=DetectorSettings(marker="ball")))
    pictures = (with_balls(even(200.0, k), px, 5.0, 30.0) for k, px in enumerate(rig.project(points)[:2]))
    frame, status = tracker.process(*(Image(10**9, p) for p in pictures))
    assert status.level == "error" and not len(frame.ids)
    said = re.search(r"spots meet (\S+) m from the cameras; markers are looked for from 0.05 to 3 m", status.message)
    assert said is not None and float(said[1]) == pytest.approx(far, rel=0.05), status.message
