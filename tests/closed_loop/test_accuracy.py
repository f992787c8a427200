"""Which moments tell the model's own error, and how sure a few of them make."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import toy
import trimesh

from closed_loop.accuracy import deepest, flatness, upper
from closed_loop.forward import Run, difference


def test_few_presses_leave_more_doubt():
    assert upper(4) == pytest.approx(1.514, abs=1e-3)  # sqrt(8 / 3.490), chi-square's 10 % point at 8 degrees
    assert upper(1) > upper(2) > upper(8) > 1.0


def test_each_press_is_looked_at_where_it_is_deepest():
    o = toy.record([], seed=0)
    depth = np.zeros(o.n_moments)
    half = o.n_moments // 2
    depth[2], depth[half + 1], depth[half + 2] = 3e-3, 1e-3, 2e-3
    points = np.zeros_like(o.points)
    points[..., 2] = -depth[:, None]
    o = replace(o, points=points, blocks=(np.arange(o.n_moments) >= half).astype(int))
    assert deepest(o).tolist() == [0, 2, half + 2]


def test_flat_triangles_of_a_ball_are_h2_over_8_r_inside_it():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.06)
    mesh = SimpleNamespace(nodes=np.asarray(ball.vertices), boundary_triangles=np.asarray(ball.faces))
    points, _ = trimesh.sample.sample_surface(ball, 20000, seed=0)
    gap = np.mean(0.06 - np.linalg.norm(points, axis=1))
    found = flatness(mesh, np.ones(len(ball.faces), bool))
    assert found == pytest.approx(gap, rel=0.1)  # 0.169 mm; 0.173 by sampling
    block = trimesh.creation.box((0.08, 0.06, 0.04))
    mesh = SimpleNamespace(nodes=np.asarray(block.vertices), boundary_triangles=np.asarray(block.faces))
    assert flatness(mesh, np.ones(len(block.faces), bool)) == 0.0


def test_a_correction_is_known_by_recording_and_stamp():
    o = SimpleNamespace(name="a", stamps_ns=np.array([5, 7]), points=np.zeros((2, 3, 3)))
    one = Run(np.zeros((2, 3, 3)), None, np.zeros((2, 3, 3, 0)), None)
    two = Run(np.full((2, 3, 3), 1e-4), None, np.zeros((2, 3, 3, 0)), None)
    two.points[1] = np.nan
    correction = difference([o], [one], [two])
    assert correction.of_points([o]) == pytest.approx(np.stack([np.full((3, 3), 1e-4), np.zeros((3, 3))]))
    other = SimpleNamespace(name="b", stamps_ns=o.stamps_ns, points=o.points)
    assert not correction.of_points([other]).any()
