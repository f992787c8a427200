"""Which moments tell the model's own error, and how sure a few of them make."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy

from closed_loop.accuracy import deepest, upper


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
