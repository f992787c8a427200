"""A swing that a model predicts, and what it is allowed to get wrong across it."""

import numpy as np
import pytest

from livedeform.closed_loop.evidence.noise import rows_of
from livedeform.closed_loop.evidence.swing_error import begins_at, swing_error_columns, swing_of
from livedeform.closed_loop.settings import AllowanceSettings

START, RATE, DECAY = 0.2, 27.0, 1.4  # s, rad/s, 1/s
ALLOWANCE = AllowanceSettings()
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
    swing = swing_of(t, _body(t), RATE / off, ALLOWANCE)
    assert swing.rate == pytest.approx(RATE, rel=2e-3)  # measured 2e-4
    assert swing.decay == pytest.approx(DECAY, rel=0.03)  # measured 6e-3
    np.testing.assert_allclose(swing.size, SIZE, rtol=0.02, atol=1e-6)
    np.testing.assert_allclose(swing.across @ ALONG, 0.0, atol=1e-6)


def test_where_nothing_swings_none_is_found():
    t = _times()
    assert swing_of(t, _body(t, swings=0.0, creeps=0.0), RATE, ALLOWANCE) is None
    assert swing_of(t, _body(t, swings=0.0, creeps=5e-3), RATE, ALLOWANCE) is None
    assert swing_of(t, _body(t), 0.0, ALLOWANCE) is None
    assert swing_of(t[:10], _body(t[:10]), RATE, ALLOWANCE) is None
    assert swing_of(t[:0], _body(t[:0]), RATE, ALLOWANCE) is None


def test_a_body_is_on_its_way_from_when_it_moves():
    t = _times()
    motion = np.linalg.norm(_body(t) - _body(t)[0], axis=2)
    assert t[4] <= begins_at(t, motion, 0.01) <= t[9]


def _left(allowed, x, sigma=1e-5):
    """What is left of a motion (rows,) after what is ``allowed``, beside a noise of ``sigma`` m, and how far that went,
    in its sigmas."""
    A = allowed / sigma
    theta = np.linalg.solve(A.T @ A + np.eye(A.shape[1]), A.T @ x / sigma)
    return np.sqrt(np.mean((x - allowed @ theta) ** 2) / np.mean(x**2)), np.abs(theta).max()


@pytest.mark.parametrize("rate, decay", [(RATE, DECAY), (1.1 * RATE, DECAY), (0.93 * RATE, 2.0 * DECAY)])
def test_a_sway_of_another_rate_and_decay_is_taken_up_and_the_swing_itself_is_not(rate, decay):
    t = _times()
    points, share = _body(t), 0.03
    rows = rows_of(points, None, np.zeros(len(t), int))
    allowed = swing_error_columns(rows, t, points, np.zeros(len(t), int), [RATE], share, 0.0, ALLOWANCE).columns
    across = np.cross(ALONG, [0.0, 1.0, 0.0])
    sway = rows.take(
        share * (_body(t, creeps=0.0, along=across, rate=rate, decay=decay) - _body(t, swings=0.0, creeps=0.0))
    )
    swing = rows.take(_body(t, creeps=0.0) - _body(t, swings=0.0, creeps=0.0))
    mean = rows.take(share * np.multiply.outer(np.outer(t > START, SIZE), across))
    part, size = _left(allowed, sway - mean)
    assert part < 0.2 and size < 3.0
    assert _left(allowed, swing)[0] > 0.999


def test_each_recording_sways_by_itself_and_not_before_it_is_let_go():
    t = _times()
    points = np.concatenate([_body(t), _body(t, rate=2.0 * RATE)])
    seconds, recording = np.concatenate([t, t]), np.repeat([0, 1], len(t))
    rows = rows_of(points, None, recording)
    sway = swing_error_columns(rows, seconds, points, recording, [RATE, 2.0 * RATE], 0.02, 0.0, ALLOWANCE)
    first = np.array([name.endswith("[0]") for name in sway.names])
    assert first.any() and (~first).any()
    here = recording[rows.moment]
    assert not sway.columns[here == 1][:, first].any() and not sway.columns[here == 0][:, ~first].any()
    assert not sway.columns[seconds[rows.moment] < START].any()
    assert np.abs(sway.columns).max() <= 0.02 * SIZE.max() * 1.05
    lost = points.copy()
    lost[20] = 0.0  # no equilibrium was found, and nothing is compared
    seen = np.where((np.arange(len(points)) == 20)[:, None, None], np.nan, points)
    some = swing_error_columns(
        rows_of(seen, None, recording), seconds, lost, recording, [RATE, 2.0 * RATE], 0.02, 0.0, ALLOWANCE
    )
    both = [c @ c.T for c in (some.columns, sway.columns[rows.moment != 20])]  # the two directions may be turned
    np.testing.assert_allclose(*both, atol=0.01 * (0.02 * SIZE.max()) ** 2)
    still = swing_error_columns(rows, seconds, points, recording, [0.0, 0.0], 0.02, 0.01, ALLOWANCE)
    assert still.columns.shape == (rows.n, 0)


def _rubbed(t, rubs):
    """The same body with dry friction, a step of a tenth of a millisecond after the other: q'' + 2 d q' + w2 (q - 1 +
    rubs sign q') = 0."""
    dt, w2 = 1e-4, RATE**2 + DECAY**2
    q, v, course = 0.0, 0.0, []
    for _ in range(int((t.max() - START) / dt) + 2):
        course.append(q)
        v += dt * (w2 * (1.0 - q - rubs * np.tanh(v / 0.02)) - 2.0 * DECAY * v)
        q += dt * v
    course = np.interp(t - START, dt * np.arange(len(course)), course, left=0.0)
    return np.arange(12.0).reshape(4, 3) * 0.01 + np.multiply.outer(np.outer(course, SIZE), ALONG)


@pytest.mark.parametrize("rubs", [0.003, 0.01])
def test_what_rubs_is_one_number(rubs):
    """Dry friction takes as much off each swing: four times its force over the stiffness in a period."""
    t = _times()
    points = _rubbed(t, 0.0)
    rows = rows_of(points, None, np.zeros(len(t), int))
    sizes = 0.02, 1e-9  # nothing else along the swing
    errors = swing_error_columns(rows, t, points, np.zeros(len(t), int), [RATE], *sizes, ALLOWANCE)
    rubbing = errors.columns[:, [name.startswith("swing_rubs") for name in errors.names]]
    part, size = _left(rubbing, rows.take(_rubbed(t, rubs) - points))
    assert part < 0.35 and size == pytest.approx(4.0 * rubs / 0.02, rel=0.35)


def test_along_its_swing_a_body_may_swing_otherwise_only_where_that_is_allowed():
    t = _times()
    points = _body(t)
    rows, recording = rows_of(points, None, np.zeros(len(t), int)), np.zeros(len(t), int)
    other = rows.take(_body(t, decay=1.05 * DECAY) - points)
    without, having = (
        swing_error_columns(rows, t, points, recording, [RATE], 0.02, along, ALLOWANCE).columns
        for along in (0.0, 0.006)
    )
    assert _left(without, other)[0] > 0.999
    part, size = _left(having, other)
    assert part < 0.2 and size < 3.0
