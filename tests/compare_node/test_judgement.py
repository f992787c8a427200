"""The verdict is of the errors and of how much was compared."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.presses import motion
from livedeform.common.checks.protocol import MarkerTrack
from livedeform.common.types import MarkerFrame
from livedeform.compare_node.coverage import Coverage, cover
from livedeform.compare_node.judgement import judge
from livedeform.compare_node.metrics import RunMetrics, Statistic, run_metrics
from livedeform.compare_node.residual import Residual
from livedeform.compare_node.surface_error import SurfaceError

N = 100
STEP = 50_000_000


def press(depth: float = 0.01, n: int = N, noise: float = 5e-5) -> list[MarkerFrame]:
    """Four markers that go down and up twice by ``depth`` m."""
    rng = np.random.default_rng(1)
    down = depth * np.abs(np.sin(2 * np.pi * np.arange(n) / n)) ** 3
    places = np.array([[0.0, 0, 0], [0.02, 0, 0], [0, 0.02, 0], [0.02, 0.02, 0]])
    C = np.tile(noise**2 * np.eye(3), (4, 1, 1))
    return [
        MarkerFrame(k * STEP, np.arange(4, dtype=np.uint32),
                    places - [0, 0, d] + rng.normal(0, noise, (4, 3)), C, np.zeros(4))
        for k, d in enumerate(down)
    ]  # fmt: skip


def residuals_of(frames: list[MarkerFrame], rows: Iterable[int] | None = None, error: float = 1e-4) -> list[Residual]:
    """The frames in ``rows`` (all of them) as they are compared with a model that is off by ``error`` m along x."""
    kept = frames if rows is None else [frames[k] for k in rows]
    return [Residual(f.stamp_ns, f.ids, f.points, f.points - [error, 0, 0], f.covariances) for f in kept]


def metrics(compared: list[int], error: float = 1e-3, threshold: float = 0.005, n_measured: int = N) -> RunMetrics:
    frames = press()
    residuals = residuals_of(frames, compared, error)
    coverage = cover(frames, residuals, n_measured=n_measured, noise=5e-5)
    return replace(run_metrics(residuals, threshold), coverage=coverage)


EVERY = list(range(N))


@pytest.mark.parametrize(("compared", "level"), [
    (EVERY, "OK"),
    (EVERY[:95], "OK"),
    ([k for k in EVERY if k % 4], "WARN"),
    (EVERY[:40], "STALE"),
    (EVERY[:2], "STALE"),
    ([k for k in EVERY if k % 50 not in (23, 24, 25, 26)], "STALE"),  # 92 of 100, without most of the deepest moments
    ([k for k in EVERY if k not in (25, 75)], "WARN"),  # 98 of 100, without the two deepest of ten
    ([], "STALE"),
])  # fmt: skip
def test_coverage_bounds_the_verdict(compared: list[int], level: str):
    assert judge(metrics(compared)).level == level


@pytest.mark.parametrize("heard", [EVERY, EVERY[::2], EVERY[:30], EVERY[95:], []])
@pytest.mark.parametrize("compared", [EVERY, EVERY[1::2], EVERY[20:]])
def test_what_was_compared_counts_whether_or_not_the_recorder_heard_it(heard: list[int], compared: list[int]):
    """Of 328 frames with an error 83 counted as compared: the recorder's full queue had dropped the others."""
    frames = press()
    residuals = residuals_of(frames, compared)
    coverage = cover([frames[k] for k in heard], residuals, n_measured=N, noise=5e-5)
    known = sorted({*heard, *compared})
    at_once = cover([frames[k] for k in known], residuals, n_measured=N, noise=5e-5)
    assert coverage.frames_compared == run_metrics(residuals, 0.005).n_frames == len(compared)
    assert coverage == at_once


@pytest.mark.parametrize(("hidden", "level"), [(range(0), "OK"), (range(15, 35), "WARN"), (range(15, 85), "STALE")])
def test_frames_that_hardly_show_the_body_do_not_count(hidden: range, level: str):
    """Three of four markers are hidden, as by the probe's holder: one marker says nothing of the others."""
    frames = press()
    for k in hidden:
        f = frames[k]
        frames[k] = MarkerFrame(f.stamp_ns, f.ids[3:], f.points[3:], f.covariances[3:], np.zeros(1))
    residuals = residuals_of(frames, error=1e-3)
    coverage = cover(frames, residuals, n_measured=N, noise=5e-5)
    judged = judge(replace(run_metrics(residuals, 0.005), coverage=coverage))
    assert judged.level == level and coverage.frames_compared == N - len(hidden)
    assert not len(hidden) or f"{len(hidden)}: fewer than half of the markers were seen" in judged.sentence


@pytest.mark.parametrize(("bound", "level"), [(np.nan, "OK"), (0.0, "OK"), (0.002, "OK"), (0.003, "WARN")])
def test_a_verdict_that_interpolation_may_have_made_is_doubted(bound: float, level: str):
    """The threshold is 5 mm: predictions so far apart that frames between them may be off by more than half of that."""
    judged = judge(replace(metrics(EVERY), interpolation_bound=bound))
    assert judged.level == level
    assert ("interpolation between predictions may be wrong by up to 3.00 mm" in judged.sentence) == (level == "WARN")


@pytest.mark.parametrize(("judged", "level"), [(0.002, "OK"), (0.003, "WARN")])
def test_a_few_frames_between_predictions_far_apart_doubt_no_run(judged: float, level: str):
    """One frame may be 9 mm off: what is judged is the rmse and the 95th percentile of all."""
    judgement = judge(replace(metrics(EVERY), interpolation_bound=0.009, interpolation_judged=judged))
    assert judgement.level == level
    assert ("may be wrong by up to 9.00 mm" in judgement.sentence) == (level == "WARN")


@pytest.mark.parametrize("skipped", [0, 250])
def test_poses_that_the_model_was_too_slow_for_are_not_to_be_recorded_more_often(skipped: int):
    m = metrics(EVERY)
    assert m.coverage is not None
    sentence = judge(replace(m, interpolation_bound=0.003, coverage=replace(m.coverage, skipped=skipped))).sentence
    assert ("250 poses were overtaken" in sentence and "`--rate max`" in sentence) == bool(skipped)
    assert (" mm: record the poses more often" in sentence) != bool(skipped)


def test_both_presses_are_counted():
    coverage = metrics([k for k in EVERY if k < 50]).coverage
    assert coverage is not None
    assert (coverage.presses, coverage.presses_compared) == (2, 1)
    assert coverage.motion_largest == pytest.approx(0.01, rel=0.02)
    assert coverage.deepest == 10


@pytest.mark.parametrize("noise", [5e-5, 1e-3, 2e-3])
@pytest.mark.parametrize("stated", [True, False])
def test_noise_makes_and_hides_no_presses(noise: float, stated: bool):
    frames = press(noise=noise)
    floor = np.sqrt(3.0) * noise if stated else float("nan")
    assert cover(frames, residuals_of(frames), n_measured=N, noise=floor).presses == 2


def test_noise_alone_is_no_press():
    frames = press(depth=0.0, n=1000, noise=1e-3)
    coverage = cover(frames, residuals_of(frames), n_measured=len(frames), noise=np.sqrt(3.0) * 1e-3)
    assert (coverage.presses, coverage.deepest) == (0, 0)


def test_frames_that_never_came_of_pictures_count():
    assert judge(metrics(EVERY, n_measured=150)).level == "WARN"
    assert judge(metrics(EVERY, n_measured=250)).level == "STALE"


def test_errors_over_the_threshold_stay_errors():
    assert judge(metrics(EVERY, error=0.006)).level == "ERROR"
    assert judge(metrics(EVERY[:70], error=0.006)).level == "ERROR"
    assert judge(metrics(EVERY[:30], error=0.006)).level == "STALE"


def test_the_error_is_given_relative_to_the_motion():
    m = metrics(EVERY, error=0.003)
    assert m.coverage is not None
    assert m.relative == pytest.approx(m.rmse.value / m.coverage.motion_rms)
    assert f"{100 * m.relative:.0f} % of the motion" in judge(m).sentence


@pytest.mark.parametrize(("threshold", "said"), [(0.02, True), (0.005, False)])
def test_a_threshold_over_the_motion_is_said(threshold: float, said: bool):
    assert ("not even a model that does not move" in judge(metrics(EVERY, threshold=threshold)).sentence) is said


def test_doubts_and_wrong_inputs_are_in_the_sentence():
    good = metrics(EVERY)
    doubtful = judge(replace(good, doubts=("the probe never touches the body",)))
    assert doubtful.level == "WARN" and "the probe never touches the body" in doubtful.sentence
    wrong = judge(replace(good, wrong=("the clocks differ",)))
    assert wrong.level == "STALE" and "the clocks differ" in wrong.sentence
    stopped = judge(replace(good, coverage=replace(good.coverage or Coverage(), interrupted=True)))
    assert stopped.level == "WARN" and "interrupted" in stopped.sentence


def test_a_body_at_rest_has_no_presses():
    frames = press(depth=0.0)
    coverage = cover(frames, residuals_of(frames), n_measured=N, noise=5e-5 * 3**0.5)
    assert coverage.presses == coverage.deepest == 0


def one_press(n: int, pressed: int, depth: float, at: float = 0.5) -> tuple[list[MarkerFrame], list[int]]:
    """``n`` frames of forty markers, pressed in ``pressed`` of them; and which frames these are not."""
    rng, sigma = np.random.default_rng(3), 1e-4
    rest = rng.uniform(-0.05, 0.05, (40, 3))
    shape = np.exp(-np.arange(40) / 20)[:, None] * [0.0, 0.0, -1.0]
    begin = round(at * n)
    down = np.zeros(n)
    down[begin : begin + pressed] = depth * np.sin(np.pi * (np.arange(pressed) + 0.5) / pressed)
    C = np.tile(sigma**2 * np.eye(3), (40, 1, 1))
    ids = np.arange(40, dtype=np.uint32)
    frames = [
        MarkerFrame(k * STEP, ids, rest + d * shape + rng.normal(0, sigma, (40, 3)), C, np.zeros(40))
        for k, d in enumerate(down)
    ]
    return frames, [k for k in range(n) if not begin <= k < begin + pressed]


@pytest.mark.parametrize(("n", "pressed"), [(200, 20), (2000, 15), (2000, 19), (2000, 30), (4000, 5), (4000, 8)])
@pytest.mark.parametrize(("depth", "at"), [(0.01, 0.5), (0.03, 0.9)])
@pytest.mark.parametrize("stated", [True, False])
def test_the_only_press_counts_however_short_it_is(n: int, pressed: int, depth: float, at: float, stated: bool):
    """None of it was compared, and all else: nothing is known of the press."""
    frames, others = one_press(n, pressed, depth, at)
    floor = np.sqrt(3.0) * 1e-4 if stated else float("nan")
    missed, whole = (
        cover(frames, residuals_of(frames, compared), n_measured=n, noise=floor) for compared in (others, range(n))
    )
    assert (missed.presses, missed.presses_compared, whole.presses_compared) == (1, 0, 1)
    assert 1 <= missed.deepest <= max(pressed, 0.1 * n) and missed.deepest_compared == 0
    residuals = residuals_of(frames)
    judged = judge(replace(run_metrics([residuals[k] for k in others], 0.005), coverage=missed))
    assert judged.level == "STALE" and f"0 of the {missed.deepest} deepest moments" in judged.sentence
    assert judge(replace(run_metrics(residuals, 0.005), coverage=whole)).level == "OK"


@pytest.mark.parametrize("wild", [(70,), (399,), (130, 131), (20, 210, 390)])
@pytest.mark.parametrize("depth", [0.0, 0.01])
def test_a_wild_frame_makes_and_hides_no_press(wild: tuple[int, ...], depth: float):
    frames, others = one_press(400, 40, depth)
    told = [cover(frames, residuals_of(frames, others), n_measured=400, noise=np.sqrt(3.0) * 1e-4)]
    for k in wild:
        frames[k] = replace(frames[k], points=frames[k].points + np.array([0.0, 0.3, 0.1]))
    told.append(cover(frames, residuals_of(frames, others), n_measured=400, noise=np.sqrt(3.0) * 1e-4))
    counts = [(c.presses, c.presses_compared, c.deepest, c.deepest_compared) for c in told]
    assert counts[0] == counts[1] and counts[0][0] == (depth > 0.0)


def test_where_frames_are_far_apart_each_may_be_a_press():
    frames, _ = one_press(12, 1, 0.01)
    frames[9] = replace(frames[6], stamp_ns=frames[9].stamp_ns)
    rest = [k for k in range(12) if k not in (6, 9)]
    coverage = cover(frames, residuals_of(frames, rest), n_measured=12, noise=np.sqrt(3.0) * 1e-4)
    assert (coverage.presses, coverage.deepest, coverage.deepest_compared) == (1, 1, 0)


def pressed_by(depths: tuple[float, ...], left: float = 0.0, noise: float = 2e-5) -> list[MarkerFrame]:
    """Presses of 20 frames by ``depths`` (m) with 40 between them, in which a share ``left`` of the first one stays."""
    rng, places = np.random.default_rng(1), np.random.default_rng(2).uniform(-0.03, 0.03, (11, 3))
    rest = np.concatenate([np.zeros(60), np.full(60 * len(depths), left * depths[0])])
    for k, depth in enumerate(depths):
        at = 60 + 60 * k
        rest[at : at + 20] = np.maximum(rest[at - 1], depth * np.sin(np.pi * np.arange(20) / 19))
    ids, C = np.arange(11, dtype=np.uint32), np.tile(noise**2 * np.eye(3), (11, 1, 1))
    return [
        MarkerFrame(k * STEP, ids, places - [0, 0, d] + rng.normal(0, noise, (11, 3)), C, np.zeros(11))
        for k, d in enumerate(rest)
    ]


@pytest.mark.parametrize("depths", [(3e-3, 1.2e-3, 1.2e-3, 1.2e-3), (1e-3, 1e-2), (1e-2, 1e-3, 5e-3)])
@pytest.mark.parametrize(("stated", "left"), [(True, 0.0), (False, 0.0), (True, 0.1)])
def test_a_press_counts_however_little_it_is_beside_another(depths: tuple[float, ...], stated: bool, left: float):
    """Of 3, 1.2, 1.2 and 1.2 mm `run` counted one press, `info` four: a press that was missed whole was OK."""
    left *= depths[0] < 4 * min(depths)  # what stays is less than half of the smallest
    frames, floor = pressed_by(depths, left), np.sqrt(3.0) * 2e-5 if stated else float("nan")
    n, least = len(frames), int(np.argmin(depths))
    others = [k for k in range(n) if not 60 + 60 * least <= k < 80 + 60 * least]
    whole, missed = (cover(frames, residuals_of(frames, c), n_measured=n, noise=floor) for c in (range(n), others))
    assert (whole.presses, whole.presses_compared) == (len(depths), len(depths))
    assert (missed.presses, missed.presses_compared) == (len(depths), len(depths) - 1)
    residuals = residuals_of(frames)
    judged = judge(replace(run_metrics([residuals[k] for k in others], 0.005), coverage=missed))
    assert judged.level == "WARN" and f"only {len(depths) - 1} of {len(depths)} presses" in judged.sentence
    recording = Recording(Path("x"), 0, n * STEP, frames, [], [], {}, {})
    assert len(MarkerTrack(recording).presses) == len(depths)  # one rule for both


@pytest.mark.parametrize("wild", [(0,), (2,), (0, 4), (250,)])
def test_a_mislabelled_frame_does_not_decide_where_markers_rest(wild: tuple[int, ...]):
    """One marker 30 mm beside its place in the first frame made 9 mm of 0.8 mm of motion."""
    clean, frames = pressed_by((3e-3,) * 4), pressed_by((3e-3,) * 4)
    for k in wild:
        frames[k].points[3] += [0.0, 0.03, 0.0]
    others = np.setdiff1d(np.arange(len(frames)), wild)
    np.testing.assert_allclose(motion(frames)[others], motion(clean)[others], atol=1e-6)  # m; measured 1.4e-7
    told = cover(frames, residuals_of(frames), n_measured=len(frames), noise=np.sqrt(3.0) * 2e-5)
    assert told.presses == 4
    track, sound = (MarkerTrack(Recording(Path("x"), 0, 1, f, [], [], {}, {})) for f in (frames, clean))
    assert np.abs(track.rest - sound.rest).max() < 1e-5  # m; measured 1.2e-6
    assert len(track.presses) == 4


@pytest.mark.parametrize("registration", [float("nan"), 1e-3])
@pytest.mark.parametrize("rmse", [0.004, 0.0055, 0.02])
def test_one_surface_in_twenty_is_too_little_whatever_it_shows(registration: float, rmse: float):
    """A registration that leaves it open made WARN of one moment of twenty."""
    s = [Statistic(v, v, v) for v in (rmse, 0.9 * rmse, 1.8 * rmse, 0.0)]
    surface = SurfaceError(1000, 1, 20, *s, 3 * rmse, 1e-4, "stated", 0.5, {"gap": 19}, registration)
    judged = judge(replace(run_metrics([], 0.005), surface=surface))
    assert judged.level == "STALE" and "only 1 of 20 measured moments" in judged.sentence
    enough = judge(replace(run_metrics([], 0.005), surface=replace(surface, n_frames=20)))
    assert enough.level != "STALE"


@pytest.mark.parametrize(("noise", "drift"), [(2e-5, 0.0), (4e-5, 0.0), (1e-4, 0.0), (2e-4, 0.0), (2e-5, 3e-4)])
@pytest.mark.parametrize("depths", [(3e-3,), (3e-3, 1.2e-3, 1.2e-3, 1.2e-3)])
def test_noise_that_is_larger_than_stated_and_drift_make_no_presses(
    noise: float, drift: float, depths: tuple[float, ...]
):
    """Where it hovers about the limit each time that it goes over would be a press: as many as 28 instead of one."""
    for frames in (pressed_by(depths, noise=noise), pressed_by(depths, noise=noise)[::-1]):
        for k, frame in enumerate(frames):
            frame.points[:, 1] += drift * k / len(frames)
        told = cover(frames, residuals_of(frames), n_measured=len(frames), noise=np.sqrt(3.0) * 2e-5)
        assert told.presses == len(depths)
