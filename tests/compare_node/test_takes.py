"""What takes of one press say of the next: intervals that hold as often as they promise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t as student

from livedeform.compare_node.takes import expected, expected_of_markers


@pytest.mark.parametrize("n", [2, 3, 6])
def test_the_next_take_is_in_the_interval_as_often_as_it_promises(n):
    rng = np.random.default_rng(n)
    takes = np.exp(rng.normal(-7.0, 0.2, (1500, n + 1)))
    held = [e.next[0] <= row[-1] <= e.next[1] for row in takes for e in expected([row[:n]])]
    assert abs(np.mean(held) - 0.95) < 3.0 * np.sqrt(0.05 * 0.95 / len(takes))


def test_groups_share_their_scatter():
    rng = np.random.default_rng(0)
    means = np.array([-8.0, -6.0, -5.0])
    held, alone = [], []
    for _ in range(800):
        takes = np.exp(means[:, None] + rng.normal(0.0, 0.1, (3, 3)))
        found = expected([g[:2] for g in takes])
        held += [e.next[0] <= g[2] <= e.next[1] for e, g in zip(found, takes, strict=True)]
        alone.append(np.log(found[0].next[1] / found[0].next[0]) / np.log(np.divide(*expected([takes[0, :2]])[0].next)))
    assert found[0].freedom == 3
    assert np.mean(held) == pytest.approx(0.95, abs=0.015)
    assert np.median(np.abs(alone)) < 0.5  # three differences instead of one


def test_one_take_and_takes_alike_say_so():
    (one,) = expected([[1e-3]])
    assert one.value == pytest.approx(1e-3) and np.isnan(one.next).all() and one.freedom == 0
    (same,) = expected([[1e-3, 1e-3]])
    assert same.next == pytest.approx((1e-3, 1e-3))
    assert np.isnan(expected([[0.0, 1e-3]])[0].next).all()  # an error of nothing has no logarithm


@pytest.mark.parametrize(("common", "own", "most"), [(0.0, 0.2, 2.0), (0.2, 0.0, 1.01), (0.1, 0.2, 2.0)])
def test_markers_share_what_each_does_and_not_what_all_do_alike(common, own, most):
    """With two takes and six markers, whether takes differ alike at all markers, at each, or in both ways."""
    rng, n, m = np.random.default_rng(1), 2, 6
    held, width, freedom = [], [], []
    for _ in range(500):
        logs = rng.normal(0, common, (n + 1, 1)) + rng.normal(0, own, (n + 1, m)) + np.linspace(-8, -6, m)
        found = expected_of_markers(np.exp(logs[:n]))
        held.append(np.mean([e.next[0] <= np.exp(v) <= e.next[1] for e, v in zip(found, logs[-1], strict=True)]))
        width.append(np.log(found[0].next[1] / found[0].next[0]) / 2.0)
        freedom.append(found[0].freedom)
    assert np.mean(held) > 0.93, np.mean(held)
    assert np.median(freedom) >= 1.0 and min(freedom) >= 1.0
    alone = student.ppf(0.975, 1) * np.hypot(common, own) * np.sqrt(1.5)
    assert np.median(width) < alone * most if common else np.median(width) < 0.4 * alone
