"""Boards of circles: the middle of a tilted circle's outline is not the picture of its middle (Heikkila 2000)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import BoardView, Pair
from livedeform.stereo_node.calibrate.bundle import Bundle, Lens, board_poses, projected
from livedeform.stereo_node.discs.outlines import area_centre

N_RIM = 24


def with_middles(points: Array, pairs: Sequence[Pair], bundle: Bundle) -> list[Pair]:
    """Return ``pairs`` with the pictures of the circles' middles instead of their outlines' middles, by the board's
    poses in ``bundle``; the circles' radius comes from their outlines. Pairs of other boards come back as they are."""
    if any(view.shapes is None for pair in pairs for view in (pair.left, pair.right)):
        return list(pairs)
    views = [
        (view, lens, pose)
        for pair, poses in zip(pairs, board_poses(bundle), strict=True)
        for view, lens, pose in zip((pair.left, pair.right), (bundle.left, bundle.right), poses, strict=True)
    ]
    radius = float(np.median(np.concatenate([_radii(points, *view) for view in views])))
    moved = [
        replace(view, pixels=view.pixels - _bias(points[view.rows], lens, pose, radius)) for view, lens, pose in views
    ]
    return [replace(pair, left=moved[2 * k], right=moved[2 * k + 1]) for k, pair in enumerate(pairs)]


def _radii(points: Array, view: BoardView, lens: Lens, pose: Array) -> Array:
    """Return (n,) m: radius of a circle on the board whose outline has the area of the one seen."""
    X, step = points[view.rows], 1e-4
    middle = projected(X, pose, lens)[0]
    across, along = (projected(X + step * axis, pose, lens)[0] - middle for axis in np.eye(3)[:2])
    scale2 = np.abs(across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0]) / step**2  # px2 per m2
    assert view.shapes is not None
    return np.asarray(np.sqrt(1 / np.abs(np.linalg.det(view.shapes)) / scale2), float)


def _bias(X: Array, lens: Lens, pose: Array, radius: float) -> Array:
    """Return (n, 2) px: outline's middle minus the middle's picture."""
    angle = 2 * np.pi * np.arange(N_RIM) / N_RIM
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(N_RIM)], axis=1) * radius
    outline = projected((X[:, None] + rim).reshape(-1, 3), pose, lens)[0].reshape(len(X), N_RIM, 2)
    return area_centre(outline - projected(X, pose, lens)[0][:, None])
