"""Coded markers: identities from the picture, centres where the tag's middle is."""

import cv2
import numpy as np
import pytest
from scene import looking_down, make_test_rig, tag_picture

from livedeform.common.experiment.yaml_file import Markers
from livedeform.common.frames import apply, inverse
from livedeform.common.types import Image
from livedeform.stereo_node.detect.fiducials import DEFAULT_DICTIONARY, detect_markers
from livedeform.stereo_node.detect.settings import DetectorSettings
from livedeform.stereo_node.pipeline import StereoTracker, TrackerSettings

SIDE = 0.02


def draw(rig, T, centres, kind, side, stamp_ns):
    """Tags in the plane z = 0 of the phantom, drawn by warping their pictures (OpenCV), four times oversampled."""
    camera = rig.left if side == "left" else rig.right
    to_camera = inverse(T) if side == "left" else rig.T_right_left @ inverse(T)
    scale = 4
    picture = np.full((camera.height * scale, camera.width * scale), 200, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DEFAULT_DICTIONARY[kind]))
    for code, centre in centres.items():
        tag = cv2.copyMakeBorder(
            dictionary.generateImageMarker(code, 240), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255
        )
        half = SIDE / 2 * 320 / 240
        corners = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]]) + centre
        seen = apply(to_camera, corners)
        px = seen[:, :2] / seen[:, 2:] @ camera.camera_matrix[:2, :2].T + camera.camera_matrix[:2, 2]
        # the middle of a fine pixel k lies at (k + 0.5) / scale - 0.5
        target = ((px + 0.5) * scale - 0.5).astype(np.float32)
        H = cv2.getPerspectiveTransform(
            np.array([[-0.5, -0.5], [319.5, -0.5], [319.5, 319.5], [-0.5, 319.5]], np.float32), target
        )
        warped = cv2.warpPerspective(tag, H, picture.shape[::-1], flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.full_like(tag, 255), H, picture.shape[::-1], flags=cv2.INTER_NEAREST) > 0
        picture[inside] = warped[inside]
    small = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(float)
    small = cv2.GaussianBlur(small, (0, 0), 0.6) + np.random.default_rng(stamp_ns).normal(0, 2, small.shape)
    return Image(stamp_ns, np.clip(np.round(small), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("kind", ["aruco", "apriltag"])
def test_middles_of_tags_by_their_sides(kind):
    errors, chi2 = [], []
    for seed in range(10, 14):
        picture, truth = tag_picture(seed, DEFAULT_DICTIONARY[kind])
        found = detect_markers(picture, DetectorSettings(type=kind))
        assert len(found) == 12
        for centre, covariance, code in zip(found.centres, found.covariances, found.codes, strict=True):
            e = centre - truth[int(code)]
            errors.append(e)
            chi2.append(e @ np.linalg.inv(covariance) @ e / 2)
    assert np.sqrt(np.mean(np.square(errors))) < 0.025  # px; measured 0.015, 0.013; by OpenCV's corners 0.2
    assert 0.5 < np.mean(chi2) < 2.0  # measured 1.03, 1.16


def test_a_tag_without_its_white_surround_is_not_measured():
    picture, _ = tag_picture(10)
    black = np.where(picture > 150, 40, picture).astype(np.uint8)  # nothing stands out any more
    assert len(detect_markers(black, DetectorSettings(type="apriltag"))) == 0


@pytest.mark.parametrize("kind", ["aruco", "apriltag"])
def test_tags_are_named_and_measured(kind):
    rig, T = make_test_rig(), looking_down(tilt=0.4)
    codes = [3, 17, 40, 41, 5]
    places = {
        c: np.array([0.03 * np.cos(k * 1.3), 0.03 * np.sin(k * 1.3) * (1 + 0.2 * k), 0.0]) for k, c in enumerate(codes)
    }
    markers = Markers(
        np.array(codes[:4], np.uint32),
        np.array([places[c] for c in codes[:4]]),
        np.full(4, np.nan),
        np.array(["surface"] * 4),
    )
    settings = TrackerSettings(detector=DetectorSettings(type=kind))
    tracker = StereoTracker(rig, markers, settings, T_phantom_left=T)
    frame, status = tracker.process(draw(rig, T, places, kind, "left", 1), draw(rig, T, places, kind, "right", 1))
    assert list(frame.ids) == [3, 17, 40, 41]
    assert status.rejected.get("code of no marker") == 1  # tag 5 is no marker of ours
    error = frame.points - markers.points
    assert np.abs(error @ T[:3, :3]).max(axis=0)[:2].max() < 1e-5  # m sideways; measured 2.8e-6
    assert np.abs(error @ T[:3, :3])[:, 2].max() < 5e-5  # m in depth; measured 1.5e-5
    registered = StereoTracker(rig, markers, settings, outward=np.array([0.0, 0.0, 1.0]))
    frame, _ = registered.process(draw(rig, T, places, kind, "left", 1), draw(rig, T, places, kind, "right", 1))
    assert np.linalg.norm(frame.points - markers.points, axis=1).max() < 5e-5  # m; measured 1.2e-5
