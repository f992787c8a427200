"""A transparent body with markers on it and inside, rendered by tracing rays, and measured."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scene import DOME, Look, balls_inside, dome_markers, looking_down, make_test_rig, render

from livedeform.common.frames import apply, inverse
from livedeform.common.types import EffectValues, Image
from livedeform.stereo_node.effects import View, correct_all
from livedeform.stereo_node.pipeline import StereoTracker


def measure_through_a_body(seed=0, keep=lambda picture, pixels: None):
    """A dome of glass-like gel (index 1.41) with painted discs on it and six dark balls 6 to 14 mm inside: the
    tracker's status, which measured markers are internal, and their errors (n,) m as seen and corrected for refraction.
    """
    index, T = 1.41, looking_down()
    rig = make_test_rig(dist=(-0.2, 0.1, 0.001, -0.0005, 0.0))
    markers, normals = dome_markers(46, seed=3, spacing=0.011)
    places, kinds = markers.points.copy(), markers.kinds.copy().astype("<U8")
    inside = np.argsort(-places[:, 2])[:12:2]
    places[inside] -= np.linspace(0.006, 0.014, 6)[:, None] * normals[inside]
    kinds[inside] = "internal"
    pictures, rng = _through_the_body(rig, T, places, normals, kinds, index), np.random.default_rng(seed)
    tracker = StereoTracker(rig, replace(markers, points=places, kinds=kinds))
    for k in range(3):
        noisy = [np.clip(np.round(p + rng.normal(0, 2, p.shape)), 0, 255).astype(np.uint8) for p in pictures]
        frame, status = tracker.process(Image(k + 1, noisy[0]), Image(k + 1, noisy[1]))
    surface = ellipsoid_surface(120)
    view = View(tracker.T_phantom_left, rig, places, markers.ids, kinds, 0, lambda stamp_ns: surface)
    values = [EffectValues("refraction", {"index": np.array(index)})]
    straight = correct_all(frame.points, 0, values, view.for_ids(frame.ids))
    rows = frame.ids - markers.ids[0]
    keep(noisy[0], rig.project(apply(inverse(tracker.T_phantom_left), frame.points))[0])
    seen, left = (np.linalg.norm(p - places[rows], axis=1) for p in (frame.points, straight))
    return status, kinds[rows] == "internal", seen, left


def ellipsoid_surface(n=60):
    """A half ellipsoid as triangles, outward."""
    theta, phi = np.linspace(0, np.pi / 2, n), np.linspace(0, 2 * np.pi, 4 * n + 1)
    P = np.stack(
        [np.outer(np.sin(theta), np.cos(phi)) * 0.06, np.outer(np.sin(theta), np.sin(phi)) * 0.06,
         np.outer(np.cos(theta), np.ones_like(phi)) * 0.045], axis=-1,
    )  # fmt: skip
    index = np.arange(P.shape[0] * P.shape[1]).reshape(P.shape[:2])
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return P.reshape(-1, 3), triangles


def _through_the_body(rig, T, places, normals, kinds, index):
    """Clean pictures, left and right, of painted discs on the dome and of dark balls inside it."""
    outside, out = kinds != "internal", []
    for side in ("left", "right"):
        rng = np.random.default_rng(0)
        discs = render(rig, T, places[outside], normals[outside], Look(painted_on=DOME), rng, side, rounded=False)
        balls = cv2.GaussianBlur(balls_inside(rig, T, places[~outside], 0.0015, index, side), (0, 0), 0.6)
        out.append(discs * (1 - balls) + 60.0 * balls)
    return out
