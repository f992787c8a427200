"""Association by id and stamp: exact values, and every refusal counted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from livedeform.common.types import MarkerFrame, PredictedMarkers
from livedeform.compare_node.associate import Associator, interpolate, remainder
from livedeform.compare_node.interpolation import InterpolationBound

MS = 1_000_000


def frame(stamp_ms: float, ids: list[int], points: np.ndarray) -> MarkerFrame:
    n = len(ids)
    covariances = np.tile(np.eye(3) * 1e-10, (n, 1, 1))
    return MarkerFrame(round(stamp_ms * MS), np.array(ids, np.uint32), points, covariances, np.full(n, np.nan))


def predicted(stamp_ms: float, ids: list[int], points: np.ndarray) -> PredictedMarkers:
    return PredictedMarkers(round(stamp_ms * MS), np.array(ids, np.uint32), points)


def line(t_ms: float, n: int = 3) -> np.ndarray:
    """Markers that move on straight lines at constant speed."""
    return np.arange(n)[:, None] * 0.01 + np.array([1.0, -2.0, 0.5]) * t_ms * 1e-6


def test_motion_on_a_line_is_interpolated_exactly_at_any_stamp():
    associator = Associator()
    residuals = []
    for t in range(0, 100, 10):
        residuals += associator.add_measured(frame(t + 3.7, [0, 1, 2], line(t + 3.7) + np.array([0, 0, 1e-3])))
        residuals += associator.add_predicted(predicted(t, [0, 1, 2], line(t)))
    assert [r.stamp_ns for r in residuals] == [round((t + 3.7) * MS) for t in range(0, 90, 10)]
    for r in residuals:
        np.testing.assert_allclose(r.errors, np.tile([0, 0, 1e-3], (3, 1)), atol=1e-15)
    assert all(r.interpolation_bound < 1e-15 for r in residuals[1:])
    assert np.isnan(residuals[0].interpolation_bound)  # one bracket alone cannot tell a curvature
    associator.flush()
    assert associator.counts.refused_extrapolation == 1
    assert associator.counts.matched_frames == 9


def test_error_is_measured_minus_predicted():
    associator = Associator()
    associator.add_predicted(predicted(5, [7], np.array([[0.1, 0.2, 0.3]])))
    (residual,) = associator.add_measured(frame(5, [7], np.array([[0.2, 0.2, 0.3]])))
    np.testing.assert_allclose(residual.errors, [[0.1, 0, 0]])


def test_remainder_is_exact_for_a_parabola():
    def at(t: float) -> PredictedMarkers:
        return predicted(t, [0], np.array([[0.5 * 8.0 * (t * 1e-3) ** 2, 0, 0]]))  # x'' = 8 m/s2

    stamp = 24 * MS
    straight = interpolate(at(20), at(30), stamp)
    true = 4.0 * 0.024**2
    assert straight.points[0, 0] - true == pytest.approx(remainder(at(10), at(20), at(30), stamp), rel=1e-9)


def test_order_of_arrival_does_not_change_the_residuals():
    frames = [frame(t + 4, [2, 0, 1], line(t + 4)[[2, 0, 1]]) for t in range(0, 200, 10)]
    predictions = [predicted(t, [1, 2, 0], line(t)[[1, 2, 0]]) for t in range(0, 210, 15)]
    orders = {
        "measured first": [*frames, *predictions],
        "predicted first": [*predictions, *frames],
        "by stamp": sorted([*frames, *predictions], key=lambda m: m.stamp_ns),
    }
    results = {}
    for name, messages in orders.items():
        associator = Associator()
        out = []
        for m in messages:
            out += associator.add_measured(m) if isinstance(m, MarkerFrame) else associator.add_predicted(m)
        associator.flush()
        results[name] = [(r.stamp_ns, r.predicted.tobytes(), r.interpolation_bound) for r in out]
        assert associator.counts.matched_frames + associator.counts.refused_extrapolation == len(frames)
    assert repr(results["measured first"]) == repr(results["predicted first"]) == repr(results["by stamp"])


STAMPED = 1e-11  # m: at 10 mm/s, stamps that are whole nanoseconds
PRESSES = {
    "a smooth press": lambda t: 0.01 * np.sin(np.pi * np.clip(t, 0.0, 4.0) / 4.0) ** 2,
    "a probe that touches": lambda t: np.maximum(0.0, 0.013 * np.sin(np.pi * np.clip(t, 0.0, 4.0) / 4.0) - 0.003),
    "a probe that stops and turns": lambda t: 0.01 * np.clip(np.minimum(t, 4.0 - t) / 1.5, 0.0, 1.0),
}


@pytest.mark.parametrize("order", ["predicted first", "by stamp"])
@pytest.mark.parametrize("rate", [2.1, 5.0, 20.0])
@pytest.mark.parametrize("press", PRESSES)
def test_no_frame_is_further_off_than_interpolation_is_said_to_be(press: str, rate: float, order: str):
    """Predictions at ``rate`` Hz and frames at 30 Hz; the mean bend before a frame alone said 0.4 mm of 1.2."""
    at, largest = PRESSES[press], []
    for phase in np.linspace(0.0, 1.0 / rate, 7, endpoint=False):
        predictions = [predicted(1e3 * s, [0], np.array([[0.0, 0.0, -at(s)]])) for s in np.arange(phase, 5.0, 1 / rate)]
        frames = [frame(1e3 * s, [0], np.array([[0.0, 0.0, -at(s)]])) for s in np.arange(0.0, 5.0, 1 / 30)]
        messages = [*predictions, *frames]
        if order == "by stamp":
            messages.sort(key=lambda m: m.stamp_ns)
        associator, out = Associator(), []
        for m in messages:
            out += associator.add_measured(m) if isinstance(m, MarkerFrame) else associator.add_predicted(m)
        out += associator.flush()
        wrong, bound = max(r.distances.max() for r in out), associator.interpolation_bound.value
        assert (
            wrong < 1.6 * bound + STAMPED
        )  # measured up to 1.48, of a probe that touches and slows down at once; it was 4.67
        largest.append((wrong, bound))
    wrong, bound = np.max(largest, axis=0)
    assert bound < 5.0 * wrong  # measured 1.0 to 3.9 times: what is much too large would doubt everything


def played(at: Callable[[float], float], stamps: np.ndarray, frames: np.ndarray, noise: np.ndarray | None = None):
    """Return the residuals and the associator of one marker that moves as ``at`` (m) says, predicted at ``stamps`` s
    with ``noise`` (n, 3) m and measured at ``frames`` s, in the order of both."""
    off = np.zeros((len(stamps), 3)) if noise is None else noise
    point = np.array([0.0, 0.0, -1.0])
    messages = [predicted(1e3 * s, [0], (at(s) * point + e)[None]) for s, e in zip(stamps, off, strict=True)]
    messages += [frame(1e3 * s, [0], (at(s) * point)[None]) for s in frames]
    associator, out = Associator(), []
    for m in sorted(messages, key=stamp_of):
        out += associator.add_measured(m) if isinstance(m, MarkerFrame) else associator.add_predicted(m)
    return [*out, *associator.flush()], associator


@pytest.mark.parametrize("rate", [2.1, 5.0])
@pytest.mark.parametrize("seconds", [0.1, 0.4])
def test_a_marker_that_moves_in_steps_is_no_further_off_than_is_said(seconds: float, rate: float):
    """It stands still, moves for so long and stands still again, within a bracket or two."""
    for phase in np.linspace(0.0, 1.0 / rate, 5, endpoint=False):
        residuals, associator = played(
            lambda t: 0.002 * (np.floor(t) + np.clip((t % 1.0) / seconds, 0.0, 1.0)),
            np.arange(phase, 5.0, 1.0 / rate),
            np.arange(0.0, 5.0, 1.0 / 30.0),
        )
        wrong = max(r.distances.max() for r in residuals)
        assert wrong < 1.1 * associator.interpolation_bound.value + STAMPED  # measured up to 1.00; it was up to 6.3


def in_pairs(every: float, apart: float) -> np.ndarray:
    """Stamps (s) of which two come ``apart`` s from each other, ``every`` so many."""
    return np.sort(np.concatenate([np.arange(0.0, 10.0, every), np.arange(0.0, 10.0, every) + apart]))


STAMPS = {
    "even": np.arange(0.0, 10.0, 0.05),
    "with a pause": np.concatenate([np.arange(0.0, 4.0, 0.02), np.arange(4.45, 10.0, 0.02)]),
    "in pairs 2 ms apart": in_pairs(0.1, 0.002),
    "in pairs 0.1 ms apart": in_pairs(0.05, 1e-4),
}


@pytest.mark.parametrize("stamps", STAMPS)
def test_noise_between_predictions_close_together_is_no_bend(stamps: str):
    """At constant speed interpolation is wrong by the noise alone: 0.02 mm of each coordinate."""
    noise = 2e-5 * np.random.default_rng(0).standard_normal((len(STAMPS[stamps]), 3))
    _, associator = played(lambda t: 0.005 * t, STAMPS[stamps], np.arange(0.2, 9.8, 1.0 / 30.0), noise)
    found = associator.interpolation_bound.found
    assert found.judged < 1.2e-4  # measured 0.076 to 0.085 mm
    assert found.largest < 2.0e-4  # measured 0.11 to 0.15 mm; it was 0.70 with a pause, 1.3 and 12 in pairs


@pytest.mark.parametrize("noise", [1e-8, 5e-6])
@pytest.mark.parametrize("rate", [2.1, 5.0, 20.0])
def test_what_is_judged_is_near_what_interpolation_adds(rate: float, noise: float):
    """A press with a constant speed: noise of 10 nm made 0.67 mm of nothing, and the worst marker of each frame counted
    for all."""
    rng, apart = np.random.default_rng(0), []
    for phase in np.linspace(0.0, 1.0 / rate, 4, endpoint=False):
        stamps = np.arange(phase, 20.0, 1.0 / rate)
        residuals, associator = played(
            lambda t: 0.005 * np.clip((np.minimum(t % 5.0, 4.0 - t % 5.0) - 1.0) / 0.4, 0.0, 1.0),
            stamps,
            np.arange(1.0, 19.0, 1.0 / 30.0),
            noise * rng.standard_normal((len(stamps), 3)),
        )
        added = np.concatenate([r.distances for r in residuals])
        judged = max(np.sqrt(np.mean(added**2)), np.percentile(added, 95))
        apart.append([judged, associator.interpolation_bound.found.judged])
    added, said = np.sqrt(np.mean(np.square(apart), axis=0))
    assert 0.9 * added < said < 3.0 * added  # measured 1.00 to 2.7 times, at 10 nm and 5 Hz 1.7


def test_what_is_judged_is_of_all_frames():
    """Of 100 frames that have predictions of their own and two between others, the two are not what is judged."""
    found = InterpolationBound()
    for _ in range(98):
        found.add_exact(1)
    assert np.isnan(found.found.largest) and np.isnan(found.found.judged)  # none was interpolated
    x = [predicted(100.0 * k, [0], np.array([[0.0, 0.0, 0.001 * k**2]])) for k in range(4)]
    for stamp in (140, 150):
        found.add((x[0], x[1], x[2]), x[3:], stamp * MS)
    assert found.found.largest == found.value == pytest.approx(0.001)  # on the lines of both neighbours
    assert found.found.judged == pytest.approx(np.sqrt((0.001**2 + 0.0008**2) / 100))


def test_the_bound_does_not_depend_on_what_arrives_first():
    at = PRESSES["a probe that touches"]
    predictions = [predicted(1e3 * s, [0], np.array([[0.0, 0.0, at(s)]])) for s in np.arange(0.1, 5.0, 0.4)]
    frames = [frame(1e3 * s, [0], np.array([[0.0, 0.0, at(s)]])) for s in np.arange(0.0, 5.0, 1 / 30)]
    bounds = set()
    for messages in ([*predictions, *frames], [*frames, *predictions], sorted([*frames, *predictions], key=stamp_of)):
        associator = Associator()
        for m in messages:
            associator.add_measured(m) if isinstance(m, MarkerFrame) else associator.add_predicted(m)
        associator.flush()
        bounds.add(associator.interpolation_bound.value)
    assert len(bounds) == 1 and bounds.pop() > 0.0


def stamp_of(message: MarkerFrame | PredictedMarkers) -> int:
    return message.stamp_ns


@pytest.mark.parametrize("ids", [[7, 7, 8], [7, 8, 7], [8, 7, 7, 7]])
def test_markers_that_share_an_id_are_not_compared(ids: list[int]):
    """Neither is known to be the one; the first row was taken, and which that is is chance."""
    associator = Associator()
    associator.add_predicted(predicted(0, [7, 8], np.zeros((2, 3))))
    points = np.array([[0.0, 0.0, 0.001 * (1 + k if name == 7 else 0.5)] for k, name in enumerate(ids)])
    (r,) = associator.add_measured(frame(0, ids, points))
    assert r.ids.tolist() == [8]
    np.testing.assert_allclose(r.errors, [[0.0, 0.0, 5e-4]])
    assert associator.counts.measured_twice == ids.count(7)
    assert associator.add_measured(frame(0, [7, 7], np.zeros((2, 3)))) == []
    assert associator.counts.frames_without_common_marker == 1


def test_ids_are_matched_and_strangers_counted():
    associator = Associator()
    associator.add_predicted(predicted(0, [3, 1, 9], np.arange(9.0).reshape(3, 3)))
    (r,) = associator.add_measured(frame(0, [9, 5, 1], np.zeros((3, 3))))
    assert r.ids.tolist() == [1, 9]
    np.testing.assert_array_equal(r.predicted, [[3, 4, 5], [6, 7, 8]])
    assert (associator.counts.measured_without_prediction, associator.counts.predicted_without_measurement) == (1, 1)
    associator.flush()
    assert associator.counts.as_dict()["unknown_ids"] == [5]
    assert associator.counts.as_dict()["never_measured_ids"] == [3]


def test_nothing_is_extrapolated_or_bridged_over_a_gap():
    associator = Associator(max_gap_ns=50 * MS)
    for t in (10, 20, 100, 110):
        associator.add_predicted(predicted(t, [0, 1, 2], line(t)))
    out = [r for t in (5, 15, 60, 105, 111) for r in associator.add_measured(frame(t, [0, 1, 2], line(t)))]
    associator.flush()
    assert [r.stamp_ns // MS for r in out] == [15, 105]
    assert (associator.counts.refused_extrapolation, associator.counts.refused_gap) == (2, 1)


def test_predictions_that_did_not_converge_match_nothing():
    associator = Associator()
    nan = np.full((3, 3), np.nan)
    for t, points in ((0, line(0)), (10, nan), (20, line(20)), (30, line(30))):
        associator.add_predicted(predicted(t, [0, 1, 2], points))
    out = [r for t in (0, 5, 10, 15, 25) for r in associator.add_measured(frame(t, [0, 1, 2], line(t)))]
    assert [r.stamp_ns // MS for r in out] == [0, 25]
    assert (associator.counts.refused_not_converged, associator.counts.predicted_not_converged) == (3, 1)
    assert np.isnan(out[1].interpolation_bound)  # the prediction before the bracket is none


def test_lost_and_repeated_stamps_are_refused_and_counted():
    associator = Associator()
    associator.add_predicted(predicted(10, [0], np.zeros((1, 3))))
    associator.add_predicted(predicted(10, [0], np.ones((1, 3))))
    associator.add_predicted(predicted(5, [0], np.ones((1, 3))))
    (r,) = associator.add_measured(frame(10, [0], np.zeros((1, 3))))
    assert associator.counts.refused_out_of_order == 2
    assert r.distances[0] == 0
    assert associator.add_measured(frame(10, [42], np.zeros((1, 3)))) == []
    assert associator.counts.frames_without_common_marker == 1


def test_waiting_is_bounded():
    associator = Associator(capacity=5)
    for t in range(20):
        associator.add_measured(frame(t, [0], np.zeros((1, 3))))
    assert associator.counts.dropped_waiting == 15
    idle = Associator(capacity=5)
    for t in range(20):
        idle.add_predicted(predicted(t, [0], np.zeros((1, 3))))
    assert len(idle._predictions) == 5


S = 1000  # ms


@pytest.mark.parametrize("lag", [0, 1, 5])
@pytest.mark.parametrize(
    ("by", "stays"),
    [
        (15 * S, False),
        (100 * S, False),
        (-15 * S, False),
        (-S, True),
        (-2 * S, True),
        (-30 * S, True),
        (-3600 * S, True),
    ],
)
def test_a_stamp_that_jumps_costs_itself_and_a_clock_that_is_set_what_is_under_way(by: int, stays: bool, lag: int):
    """Predictions come ``lag`` frames after what is measured; no frame is compared with another moment's."""
    associator, residuals = Associator(), []
    stamps = [10_000_000 + 33 * k + (by if k == 100 or (stays and k > 100) else 0) for k in range(300)]
    number = {stamp * MS: k for k, stamp in enumerate(stamps)}
    for k in range(300 + lag):
        if k < 300:
            residuals += associator.add_measured(frame(stamps[k], [0, 1, 2], line(33 * k)))
        if k >= lag:
            residuals += associator.add_predicted(predicted(stamps[k - lag], [0, 1, 2], line(33 * (k - lag))))
    residuals += associator.flush()
    found = [number[r.stamp_ns] for r in residuals]
    missing = set(range(300)) - set(found)
    assert found == sorted(found) and missing <= set(range(100 - lag, 102 + lag))
    assert len(missing) <= (
        2 * lag + 1 if stays else 1
    )  # measured 0 to 1, 3 and 11 of a clock that is set, else 0 to 1
    for r in residuals:
        np.testing.assert_allclose(r.errors, 0.0, atol=1e-12)
    assert associator.counts.measured_frames == associator.counts.predicted_frames == 300
