"""What tracking solves by what it solved before, against the same solved anew."""

import numpy as np
import pytest

from livedeform.stereo_node.track.apart import assign_apart_and_without
from livedeform.stereo_node.track.field import MIN_NEIGHBOURS, SmoothField
from livedeform.stereo_node.track.match import assign

LENGTH = 0.02  # m, over which the field is alike
LIMIT = 32.0


def places(n=60, seed=0):
    """Return n places (n, 3) m about 7 mm apart, their distances and their kernel with its noise (n, n)."""
    points = np.random.default_rng(seed).uniform(0.0, 0.05, (n, 3)) * [1.0, 1.0, 0.1]
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    a = np.sqrt(3) * distance / LENGTH
    return distance, (1 + a) * np.exp(-a) + 1e-3 * np.eye(n)


@pytest.mark.parametrize("sizes", [(60, 55, 31, 12, 58), (10, 25, 3, 60, 40), (1, 0, 2, 60)])
def test_the_field_of_some_markers_is_as_solved_for_these_alone(sizes):
    """Measured: 3e-13 of the inverse's largest number, 9e-15 m, 1e-13 m of the sigma, and 7e-15 of the size."""
    rng, (distance, K) = np.random.default_rng(1), places()
    field = SmoothField(distance, LENGTH)
    for n in sizes:  # what is kept is of other markers
        markers = rng.permutation(60)[:n]
        values, moved = rng.normal(size=(n, 4)), rng.normal(0.0, 1e-3, (n, 3))
        alone = np.linalg.inv(K[np.ix_(markers, markers)])
        among = field.among(markers)
        assert np.allclose(among.solve(values), alone @ values, rtol=0, atol=1e-10 * np.abs(alone).max(initial=1.0))
        if n:
            rest, lost = moved - moved.mean(axis=0), np.setdiff1d(np.arange(60), markers)
            k = (K - 1e-3 * np.eye(60))[np.ix_(lost, markers)]
            size = np.sqrt(np.einsum("ni,nk,ki->", rest, alone, rest) / (3 * n))
            left_over = np.sqrt(np.maximum(1 - np.einsum("ln,nk,lk->l", k, alone, k), 0.0))
            carried, spread, found = field.carried(markers, moved, lost)
            assert np.allclose(carried, moved.mean(axis=0) + k @ alone @ rest, rtol=0, atol=1e-12)
            assert np.allclose(spread, size * left_over, rtol=0, atol=1e-11) and np.isclose(found, size, rtol=1e-11)


def one_by_one(K, surprise, allowed):
    """Tell which move with the others, each time with the inverse of those that are left."""
    keep = np.ones(len(K), bool)
    while keep.sum() >= MIN_NEIGHBOURS:
        rows = np.flatnonzero(keep)
        inverse = np.linalg.inv(K[np.ix_(rows, rows)])
        spread = 1 / np.sqrt(np.diag(inverse))
        off = np.linalg.norm(inverse @ (surprise[rows] - np.median(surprise[rows], axis=0)), axis=1) * spread**2
        excess = off - (allowed[rows] + 6 * np.median(off / spread) * spread)
        if excess.max() <= 0:
            break
        keep[rows[excess.argmax()]] = False
    return keep


@pytest.mark.parametrize("n_off", [0, 1, 9, 12])
def test_those_that_do_not_move_with_the_others_are_as_solved_anew_for_each(n_off):
    rng, (distance, K) = np.random.default_rng(n_off), places(seed=2)
    markers = rng.permutation(60)[:50]
    surprise = rng.normal(0.0, 1e-4, (50, 3))
    surprise[:n_off] += rng.normal(0.0, 0.01, (n_off, 3))
    field = SmoothField(distance, LENGTH)
    field.among(np.arange(60))
    keep = field.among(markers).move_together(surprise, np.full(50, 8e-4))
    assert np.array_equal(keep, one_by_one(K[np.ix_(markers, markers)], surprise, np.full(50, 8e-4)))
    assert keep.sum() == {0: 50, 1: 49, 9: 41, 12: 49}[n_off]  # the more are off, the more the field may
    # whoever asks whether more move together is told at once that they do not
    told = field.among(markers).move_together(surprise, np.full(50, 8e-4), least=int(keep.sum()) + 1)
    assert told.sum() <= keep.sum()


def apart(cost, left, right):
    """Assign anew after each round in which the dearer of two pairs that share a blob is forbidden."""
    cost = cost.copy()
    for _ in range(20):
        rows, cols = assign(cost, LIMIT)
        price = cost[rows, cols]
        same = (left[cols][:, None] == left[cols]) | (right[cols][:, None] == right[cols])
        worse = (same & (price[:, None] > price)).any(axis=1)
        if not worse.any():
            break
        cost[rows[worse], cols[worse]] = np.inf
    return rows, cols, price.sum() + LIMIT * (len(cost) - len(rows))


def test_assignments_without_a_pair_are_as_solved_anew():
    rng = np.random.default_rng(0)
    for _ in range(40):
        n, m = rng.integers(1, 25), rng.integers(1, 35)
        cost = rng.uniform(0.0, rng.choice([30.0, 100.0]), (n, m))
        cost[(rng.random((n, m)) < rng.random()) | (cost >= LIMIT)] = np.inf
        left, right = rng.integers(0, max(m // 2, 1), (2, m))
        column, total, without = assign_apart_and_without(cost, left, right, LIMIT)
        rows, cols, best = apart(cost, left, right)
        assert np.array_equal(np.flatnonzero(column >= 0), rows) and np.array_equal(column[rows], cols)
        assert np.isclose(total, best)
        for row, col in zip(rows, cols, strict=True):
            forbidden = cost.copy()
            forbidden[row, col] = np.inf
            assert np.isclose(without[row], apart(forbidden, left, right)[2])
