"""A swing that a model predicts, and what it is allowed to get wrong across it."""

import numpy as np
import pytest

from livedeform.closed_loop.evidence.noise import rows_of
from livedeform.closed_loop.evidence.swing_error import begins_at, swing_error_columns, swing_of

START, RATE, DECAY = 0.2, 27.0, 1.4  # s, rad/s, 1/s
STILL = 1e-5  # m
SIZE = np.array([10.0, 9.0, 6.0, 0.0]) * 1e-3  # m
ALONG = np.array([0.6, 0.0, 0.8])


def _times(n=80):
    """Moments that crowd where it moves, as key moments do."""
    return np.concatenate([np.linspace(0.0, START, 5), START + 5.0 * np.linspace(0.0, 1.0, n) ** 2.0])


def _body(t, *, swings=1.0, creeps=1e-3, along=ALONG, rate=RATE, decay=DECAY):
    """Points (k, 4, 3) m of a body that is let go at `START`, swings along one direction and creeps with a power of
    time."""
    after = np.maximum(t - START, 0.0)
    course = SIZE.max() * (1.0 - np.exp(-decay * after) * np.cos(rate * after)) * swings + creeps * after**0.2
    course = np.where(t > START, course, 0.0)
    return np.arange(12.0).reshape(4, 3) * 0.01 + np.multiply.outer(np.outer(course, SIZE / SIZE.max()), along)


@pytest.mark.parametrize("off", [0.5, 0.7, 0.93, 1.3, 2.0])
def test_the_swing_is_found_beside_what_creeps_where_the_model_swings_otherwise_than_the_body(off):
    t = _times()
    swing = swing_of(t, _body(t), RATE / off, STILL)
    assert swing.rate == pytest.approx(RATE, rel=2e-3)  # measured 2e-4
    assert swing.decay == pytest.approx(DECAY, rel=0.03)  # measured 6e-3
    np.testing.assert_allclose(swing.size, SIZE, rtol=0.02, atol=1e-6)
    np.testing.assert_allclose(swing.across @ ALONG, 0.0, atol=1e-6)


def test_where_nothing_swings_none_is_found():
    t = _times()
    assert swing_of(t, _body(t, swings=0.0, creeps=0.0), RATE, STILL) is None
    assert swing_of(t, _body(t, swings=0.0, creeps=5e-3), RATE, STILL) is None
    assert swing_of(t, _body(t), 0.0, STILL) is None
    assert swing_of(t[:10], _body(t[:10]), RATE, STILL) is None
    assert swing_of(t[:0], _body(t[:0]), RATE, STILL) is None


def test_a_body_is_on_its_way_from_when_it_moves():
    t = _times()
    motion = np.linalg.norm(_body(t) - _body(t)[0], axis=2)
    assert t[4] <= begins_at(t, motion) <= t[9]


@pytest.mark.parametrize("rate, decay", [(RATE, DECAY), (1.1 * RATE, DECAY), (0.93 * RATE, 2.0 * DECAY)])
def test_a_sway_of_another_rate_and_decay_is_taken_up_and_the_swing_itself_is_not(rate, decay):
    t = _times()
    points, share = _body(t), 0.03
    rows = rows_of(points, None, np.zeros(len(t), int))
    allowed = swing_error_columns(rows, t, points, np.zeros(len(t), int), [RATE], share).columns
    sigma = 1e-5

    def left(x):
        """What is left of a motion (rows,), and how far the allowed for went, in their sigmas."""
        A = allowed / sigma
        theta = np.linalg.solve(A.T @ A + np.eye(A.shape[1]), A.T @ x / sigma)
        return np.sqrt(np.mean((x - allowed @ theta) ** 2) / np.mean(x**2)), np.abs(theta).max()

    across = np.cross(ALONG, [0.0, 1.0, 0.0])
    sway = rows.take(
        share * (_body(t, creeps=0.0, along=across, rate=rate, decay=decay) - _body(t, swings=0.0, creeps=0.0))
    )
    swing = rows.take(_body(t, creeps=0.0) - _body(t, swings=0.0, creeps=0.0))
    mean = rows.take(share * np.multiply.outer(np.outer(t > START, SIZE), across))
    part, size = left(sway - mean)
    assert part < 0.2 and size < 3.0
    assert left(swing)[0] > 0.999


def test_each_recording_sways_by_itself_and_not_before_it_is_let_go():
    t = _times()
    points = np.concatenate([_body(t), _body(t, rate=2.0 * RATE)])
    seconds, recording = np.concatenate([t, t]), np.repeat([0, 1], len(t))
    rows = rows_of(points, None, recording)
    sway = swing_error_columns(rows, seconds, points, recording, [RATE, 2.0 * RATE], 0.02)
    first = np.array([name.startswith("sway[0,") for name in sway.names])
    assert first.any() and (~first).any()
    here = recording[rows.moment]
    assert not sway.columns[here == 1][:, first].any() and not sway.columns[here == 0][:, ~first].any()
    assert not sway.columns[seconds[rows.moment] < START].any()
    assert np.abs(sway.columns).max() <= 0.02 * SIZE.max() * 1.05
    lost = points.copy()
    lost[20] = 0.0  # no equilibrium was found, and nothing is compared
    seen = np.where((np.arange(len(points)) == 20)[:, None, None], np.nan, points)
    some = swing_error_columns(rows_of(seen, None, recording), seconds, lost, recording, [RATE, 2.0 * RATE], 0.02)
    both = [c @ c.T for c in (some.columns, sway.columns[rows.moment != 20])]  # the two directions may be turned
    np.testing.assert_allclose(*both, atol=0.01 * (0.02 * SIZE.max()) ** 2)
    still = swing_error_columns(rows, seconds, points, recording, [0.0, 0.0], 0.02)
    assert still.columns.shape == (rows.n, 0)
