"""Flat triangles that stand for a smooth surface."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from livedeform.common.experiment.smooth_surface import bulge, corner_normals

GRID = np.array([[i, j, 6 - i - j] for i in range(7) for j in range(7 - i)]) / 6.0


def test_a_ball_bulges_out_of_its_triangles():
    """Radius 60 mm, edges of 9 mm: the triangles lie 0.143 mm inside on average, their patches within 0.0006 mm."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.06)
    points, triangles = np.asarray(ball.vertices), np.asarray(ball.faces)
    flat = np.einsum("qi,kid->kqd", GRID, points[triangles])
    curved = flat + bulge(points[triangles], corner_normals(points, triangles), GRID)
    inside = 0.06 - np.linalg.norm(flat, axis=2)
    assert inside.mean() == pytest.approx(1.43e-4, rel=0.02)
    assert np.abs(0.06 - np.linalg.norm(curved, axis=2)).max() < 1e-6


def test_a_block_stays_a_block():
    block = trimesh.creation.box((0.08, 0.06, 0.04)).subdivide()
    points, triangles = np.asarray(block.vertices), np.asarray(block.faces)
    assert np.abs(bulge(points[triangles], corner_normals(points, triangles), GRID)).max() < 1e-12


def test_corners_stay_where_they_are():
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    points, triangles = np.asarray(ball.vertices), np.asarray(ball.faces)
    assert not bulge(points[triangles], corner_normals(points, triangles), np.eye(3)).any()
