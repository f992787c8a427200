"""One bad stamp costs one message: looking back on a recording, and live."""

from __future__ import annotations

import numpy as np
import pytest

from livedeform.common.stamps import (
    StampClock,
    StampGate,
    StampKind,
    StampOrder,
    bad_stamps,
    in_stretches,
    long_pauses,
    times_set_back,
)

S = 1_000_000_000
YEAR = 365 * 86_400 * S
GOOD = [100 * YEAR // 2 + k * S // 20 for k in range(60)]
WRONG = {
    "another year": -3 * YEAR, "the future": 5 * YEAR, "two hours ago": -7200 * S, "a minute ago": -61 * S,
    "in ten minutes": 600 * S,
}  # fmt: skip


@pytest.mark.parametrize("at", [0, 1, 30, 59])
@pytest.mark.parametrize("wrong", [YEAR, -3 * YEAR, 7200 * S])
def test_a_recording_loses_only_the_message_with_the_bad_stamp(at: int, wrong: int):
    stamps = list(GOOD)
    stamps[at] += wrong
    assert np.flatnonzero(bad_stamps(stamps, GOOD)).tolist() == [at]
    order = np.argsort(stamps)  # written by a tool that takes stamps for receive times
    sorted_stamps = [stamps[i] for i in order]
    assert [sorted_stamps[i] for i in np.flatnonzero(bad_stamps(sorted_stamps, sorted_stamps))] == [stamps[at]]


@pytest.mark.parametrize("wrong", [3 * S, -3 * S, 60 * S])
def test_a_short_jump_shows_in_the_receive_times(wrong: int):
    stamps = list(GOOD)
    stamps[30] += wrong
    assert np.flatnonzero(bad_stamps(stamps, GOOD)).tolist() == [30]


def test_pauses_drifts_and_slow_playing_are_no_bad_stamps():
    paused = [stamp + (600 * S if k > 20 else 0) for k, stamp in enumerate(GOOD)]
    drifting = [stamp + k * S // 10 for k, stamp in enumerate(GOOD)]
    assert not bad_stamps(paused, paused).any()
    assert not bad_stamps(GOOD, drifting).any()
    assert not bad_stamps(GOOD, [GOOD[0] + k * 2 * S + (k % 3) * S for k in range(60)]).any()
    assert not bad_stamps(paused, GOOD).any()  # the clock was set once


HOUR, DAY = 3600 * S, 86_400 * S


def after_pauses(sizes: list[int], pause: int) -> list[int]:
    """Stamps in parts of so many, each a ``pause`` after the one before."""
    return [GOOD[0] + part * pause + k * S // 20 for part, n in enumerate(sizes) for k in range(n)]


@pytest.mark.parametrize("sizes", [[100, 5], [5, 100], [100, 2], [4, 100, 4], [5] * 20], ids=str)
@pytest.mark.parametrize("pause", [2 * HOUR, DAY])
@pytest.mark.parametrize("late", [0, S // 100, 5 * HOUR])
def test_a_pause_of_hours_that_both_clocks_tell_loses_nothing(sizes: list[int], pause: int, late: int):
    """The shorter part was left out, and of twenty parts nineteen. However late all messages come."""
    stamps = after_pauses(sizes, pause)
    assert not bad_stamps(stamps, [stamp + late for stamp in stamps]).any()
    assert long_pauses(stamps) == len(sizes) - 1 and long_pauses(stamps[: sizes[0]]) == 0


@pytest.mark.parametrize("wrong", [2 * HOUR, -2 * HOUR, DAY, -3 * YEAR])
def test_a_jump_of_one_clock_alone_is_no_pause(wrong: int):
    """Five messages of which receive times tell nothing: a whole stretch goes, and is counted as one."""
    stamps = [stamp + wrong * (10 <= k < 15) for k, stamp in enumerate(GOOD)]
    bad = bad_stamps(stamps, GOOD)
    assert np.flatnonzero(bad).tolist() == list(range(10, 15))
    assert in_stretches(bad).sum() == 5


def test_a_clock_that_was_never_set_is_no_pause():
    """Receive times that were written offline go with the stamps, in 1970 as well."""
    stamps = [k * S for k in range(5)] + GOOD
    bad = bad_stamps(stamps, stamps)
    assert np.flatnonzero(bad).tolist() == list(range(5))


def test_single_faults_are_no_stretch():
    bad = np.zeros(20, bool)
    bad[[0, 3, 4, 9, 10, 11, 19]] = True
    assert np.flatnonzero(in_stretches(bad)).tolist() == [9, 10, 11]
    assert not in_stretches(np.zeros(0, bool)).any() and in_stretches(np.ones(3, bool)).all()


@pytest.mark.parametrize("at", [1, 30, 58])
@pytest.mark.parametrize("name", WRONG)
def test_a_live_stream_loses_only_the_message_with_the_bad_stamp(at: int, name: str):
    gate = StampGate[int]()
    passed: list[int] = []
    for k, stamp in enumerate(GOOD):
        passed += gate.admit(stamp + (WRONG[name] if k == at else 0), k)
    assert passed == [k for k in range(60) if k != at] and gate.refused == 1


@pytest.mark.parametrize("later", [YEAR, -YEAR, 3600 * S])
def test_a_clock_that_is_set_loses_nothing(later: int):
    gate = StampGate[int]()
    passed = [x for k, stamp in enumerate(GOOD) for x in gate.admit(stamp + (later if k > 20 else 0), k)]
    assert passed == list(range(60)) and gate.refused == 0


def test_a_slow_stream_passes():
    gate = StampGate[int]()
    passed = [x for k in range(9) for x in gate.admit(k * 300 * S, k)]
    assert passed == list(range(9))


@pytest.mark.parametrize("seconds", [[120 + 10 * k for k in range(9)], [100 * 1.5**k for k in range(9)], [3600] * 9])
def test_a_stream_that_becomes_slower_passes(seconds: list[float]):
    gate = StampGate[int]()
    stamps = np.cumsum(np.array(seconds) * S).astype(int).tolist()
    passed = [x for k, stamp in enumerate(stamps) for x in gate.admit(stamp, k)]
    assert passed == list(range(9)) and gate.refused == 0


def _steps(stamps: list[int]) -> list[StampKind]:
    clock = StampClock()
    return [clock.take(stamp) for stamp in stamps]


@pytest.mark.parametrize("wrong", [S, 15 * S, 59 * S, 3600 * S])
def test_a_clock_takes_back_one_stamp_that_jumped_ahead(wrong: int):
    stamps = [stamp + wrong * (k == 20) for k, stamp in enumerate(GOOD)]
    steps = _steps(stamps)
    assert steps[21] is StampKind.UNMASKS and set(steps[:21] + steps[22:]) == {StampKind.NEXT}
    late = _steps([stamp - min(wrong, 59 * S) * (k == 20) for k, stamp in enumerate(GOOD)])
    assert late[20] is StampKind.LATE and set(late[:20] + late[21:]) == {StampKind.NEXT}


@pytest.mark.parametrize(("by", "lost"), [(S, 1), (15 * S, 1), (59 * S, 1), (61 * S, 0), (3600 * S, 0)])
def test_a_clock_that_was_set_back_holds_from_the_second_stamp(by: int, lost: int):
    """From the first where a gate has asked already."""
    steps = _steps([stamp - by * (k >= 20) for k, stamp in enumerate(GOOD)])
    assert steps[20 : 20 + lost] == [StampKind.LATE] * lost and steps[20 + lost] is StampKind.SET
    assert set(steps[:20] + steps[21 + lost :]) == {StampKind.NEXT}


def test_messages_out_of_order_set_no_clock():
    steps = _steps([GOOD[k] for k in (0, 1, 5, 3, 4, 2, 6, 7)])
    assert [k for k, step in enumerate(steps) if step is not StampKind.NEXT] == [3, 4, 5]
    assert steps[3:6] == [StampKind.LATE] * 3
    another = [GOOD[k] - 5 * S * (k % 2) for k in range(60)]  # two publishers in turn
    assert StampKind.SET not in _steps(another)


def test_what_a_gate_holds_back_is_not_lost_in_the_end():
    """A stop two minutes after the others: no later message says that its stamp is right, and none that it is wrong."""
    gate = StampGate[int]()
    passed = [x for k, stamp in enumerate([0, S, 120 * S]) for x in gate.admit(stamp, k)]
    assert passed + gate.end() == [0, 1, 2] and gate.end() == [] and gate.refused == 0


AHEAD = {
    "one ahead": (lambda k: 20 * S * (k == 20), {20}), "five seconds ahead": (lambda k: 5 * S * (k == 20), {20}),
    "one back": (lambda k: -20 * S * (k == 20), {20}), "set ahead": (lambda k: 20 * S * (k >= 20), set()),
    "set back": (lambda k: -20 * S * (k >= 20), {20}), "the last one ahead": (lambda k: 20 * S * (k == 39), set()),
}  # fmt: skip


@pytest.mark.parametrize("apart", [S // 30, 2 * S])
@pytest.mark.parametrize("name", AHEAD)
def test_a_live_stream_goes_neither_back_nor_ahead_of_its_time(name: str, apart: int):
    jump, lost = AHEAD[name]
    order, passed = StampOrder[int](), []
    for k in range(40):
        passed += order.admit(GOOD[0] + k * apart + jump(k), k, received_ns=7 * S + k * apart)
    passed += order.end()
    assert passed == [k for k in range(40) if k not in lost] and order.refused == len(lost)


def test_a_pause_holds_nothing_back_and_a_recording_need_not_say_when_messages_came():
    order = StampOrder[int]()
    stamps = [0, S, 40 * S, 40 * S + 1, 50 * S]
    assert [order.admit(stamp, k, stamp + 3 * S) for k, stamp in enumerate(stamps)] == [[0], [1], [2], [3], [4]]
    order = StampOrder[int]()
    assert [order.admit(stamp, k) for k, stamp in enumerate(stamps)] == [[0], [1], [2], [3], [4]]


def test_a_bag_that_is_played_faster_loses_nothing():
    """Ten times as fast, poses a second apart: but for one at the start none waits for the next."""
    order = StampOrder[int]()
    came = [order.admit(k * S, k, received_ns=k * S // 10) for k in range(9)]
    assert came == [[0], [], [1, 2], [3], [4], [5], [6], [7], [8]] and order.refused == 0


def test_a_bad_stamp_that_is_sent_twice_is_no_proof_of_itself():
    order = StampOrder[int]()
    stamps = [0, S // 10, 30 * S, 30 * S, 2 * S // 10]
    came = [order.admit(stamp, k, received_ns=k * S // 10) for k, stamp in enumerate(stamps)]
    assert came == [[0], [1], [], [], [4]] and order.refused == 2


def test_how_often_a_clock_was_set_back():
    assert times_set_back(GOOD[:30] + [stamp - S + 7 for stamp in GOOD[30:]]) == 1
    assert times_set_back(GOOD + GOOD) == 0  # a bag that was played twice
    assert times_set_back([GOOD[k] for k in (0, 2, 1, 5, 4, 3, 6)]) == 0
    for wrong in (0, GOOD[20] - 2 * S, GOOD[20] - 100 * S, GOOD[20] + 100 * S):  # one that is not set, or wrong
        assert times_set_back([*GOOD[:20], wrong, *GOOD[20:]]) == 0
