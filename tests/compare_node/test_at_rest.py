"""The error at rest: how large, how much of it is one rigid motion, and whether it is beyond noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from livedeform.common.experiment.schema import Markers
from livedeform.common.types import Wrench
from livedeform.compare_node.at_rest import at_rest
from livedeform.compare_node.residual import Residual

PLACES = 0.03 * np.random.default_rng(0).standard_normal((8, 3))
SIGMA = 2e-5
STEP_NS = 33_333_333


def _markers(place: float = np.nan) -> Markers:
    kinds = np.array(["surface"] * 7 + ["support"])
    return Markers(np.arange(8, dtype=np.uint32), PLACES, np.full(8, place), kinds)


def _recording(offset: np.ndarray, n: int = 40, moving: int = 20) -> list[Residual]:
    """A body that rests, moves by 5 mm, and rests: everywhere measured ``offset`` (8, 3) m beside the model."""
    rng, out = np.random.default_rng(1), []
    for k in range(n + moving + n):
        predicted = PLACES + np.array([0.0, 0.0, -5e-3]) * np.clip((k - n) / moving, 0.0, 1.0)
        measured = predicted + offset + SIGMA * rng.standard_normal((8, 3))
        out.append(
            Residual(
                k * STEP_NS,
                np.arange(8, dtype=np.uint32),
                measured,
                predicted,
                np.tile(SIGMA**2 * np.eye(3), (8, 1, 1)),
            )
        )
    return out


def test_noise_alone_contradicts_nothing():
    found = at_rest(_recording(np.zeros((8, 3))), _markers())
    assert [f.end for f in found] == ["start", "end"] and [f.frames for f in found] == [41, 40]
    assert not any(f.contradicts for f in found)
    assert found[0].noise == pytest.approx(np.sqrt(3.0 * (4e-5**2 + SIGMA**2)))


def test_a_rigid_and_a_smooth_part_are_told_apart():
    turned = Rotation.from_rotvec([0.0, 0.01, 0.0]).apply(PLACES) - PLACES + [3e-4, 0.0, 5e-4]
    bent = np.column_stack([np.zeros(8), np.zeros(8), 0.3 * PLACES[:, 0] ** 2 / 0.03])
    rigid = at_rest(_recording(turned), _markers())[1]
    both = at_rest(_recording(turned + bent), _markers())[1]
    assert rigid.contradicts and "diagnose tests reference_pose" in rigid.text and rigid.n == 7
    assert rigid.error == pytest.approx(np.sqrt(np.mean(np.sum(turned[:7] ** 2, axis=1))), rel=0.02)
    assert rigid.left < 2.0 * SIGMA and rigid.rigid == pytest.approx(rigid.error, rel=0.02)
    assert both.left > 3.0 * rigid.left
    assert not at_rest(_recording(turned), _markers(place=1e-3))[1].contradicts  # places that are stated to be that bad


def test_what_never_rests_is_not_judged():
    assert at_rest(_recording(np.zeros((8, 3)), n=0, moving=60), _markers()) == ()
    assert at_rest([], _markers()) == ()


def test_a_rigid_motion_is_told_below_the_noise_of_a_marker():
    """Half a millimetre and 5 mrad, seen by a tracker with 0.18 mm of noise that loses others in every frame."""
    rng, rest = np.random.default_rng(5), 0.03 * np.random.default_rng(6).standard_normal((30, 3))
    markers = Markers(np.arange(30, dtype=np.uint32), rest, np.full(30, np.nan), np.full(30, "surface"))
    T = np.array([3e-4, 0.0, 4e-4]), Rotation.from_rotvec([0.003, -0.004, 0.0])
    alarms = []
    for k in range(100):
        where = T[1].apply(rest) + T[0] if k == 0 else rest
        frames = []
        for stamp in range(12):
            seen = np.sort(rng.permutation(30)[:28])
            measured = where[seen] + 1e-4 * rng.standard_normal((28, 3))
            C = np.tile(1e-8 * np.eye(3), (28, 1, 1))
            frames.append(Residual(stamp * STEP_NS, seen.astype(np.uint32), measured, rest[seen], C))
        found = at_rest(frames, markers)[0]
        assert found.n == 30 and found.frames == 12
        if k == 0:
            assert found.error < 3.0 * found.noise and found.contradicts
            middle = T[1].apply(rest).mean(axis=0) - rest.mean(axis=0) + T[0]
            assert found.shift == pytest.approx(middle, abs=5e-5)
            assert found.turn == pytest.approx([0.003, -0.004, 0.0], abs=1e-3)
            assert not at_rest(frames, markers, elements=3e-4)[0].contradicts
        else:
            alarms.append(found.contradicts)
    assert not any(alarms)


def _press(fps: float, speed: float, late: float, n: int, hold: bool = False) -> tuple[list[Residual], list[Wrench]]:
    """Thirty markers on a body that a probe presses from the first frame on (or holds), seen ``late`` s early."""
    rng, out, wrenches = np.random.default_rng(1), [], []
    rest = rng.uniform(-0.04, 0.04, (30, 3))
    shape = -np.exp(-np.linalg.norm(rest - [0.0, 0.0, 0.04], axis=1) / 0.03)[:, None] * [0.0, 0.0, 1.0]
    for k in range(n):
        stamp, depth = round(k * 1e9 / fps), 0.01 if hold else speed * k / fps
        measured = rest + shape * (depth + speed * late) + SIGMA * rng.standard_normal((30, 3))
        C = np.tile(SIGMA**2 * np.eye(3), (30, 1, 1))
        out.append(Residual(stamp, np.arange(30, dtype=np.uint32), measured, rest + shape * depth, C))
        wrenches.append(Wrench(stamp, np.array([0.0, 0.0, -100.0 * depth]), np.zeros(3)))
    return out, wrenches


@pytest.mark.parametrize(
    ("fps", "speed", "n"), [(1000, 0.02, 500), (500, 0.01, 500), (2000, 0.02, 900), (100, 2e-4, 90)]
)
def test_a_body_that_is_pressed_or_moves_does_not_rest(fps: float, speed: float, n: int):
    markers = Markers(np.arange(30, dtype=np.uint32), np.zeros((30, 3)), np.full(30, np.nan), np.full(30, "surface"))
    moving, forces = _press(fps, speed, 0.03, n)
    assert at_rest(moving, markers, wrenches=forces) == ()
    if speed > 1e-3:
        assert at_rest(moving, markers) == ()  # whatever the force is
    held, forces = _press(fps, speed, 0.03, n, hold=True)
    assert at_rest(held, markers, wrenches=forces) == ()
    released = [Wrench(w.stamp_ns, np.zeros(3), w.torque) for w in forces]
    assert [f.end for f in at_rest(held, markers, wrenches=released)] == ["start", "end"]


def test_a_rest_beside_a_press_is_judged_as_far_as_it_goes():
    frames = _recording(np.tile([0.0, 0.0, 5e-4], (8, 1)))
    pressed = [Wrench(f.stamp_ns, np.array([0.0, 0.0, -0.2 * (k >= 20)]), np.zeros(3)) for k, f in enumerate(frames)]
    found = at_rest(frames, _markers(), wrenches=pressed)
    assert [(f.end, f.frames, f.contradicts) for f in found] == [("start", 20, True)]
    nowhere = [Wrench(w.stamp_ns, np.full(3, np.nan), w.torque) for w in pressed]  # no prediction that converged
    assert [f.end for f in at_rest(frames, _markers(), wrenches=nowhere)] == ["start", "end"]


@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.3, -0.5, 0.8]])
@pytest.mark.parametrize("beside", [0.0, 2e-5])
def test_markers_on_a_line_show_no_turn_about_it(direction: list[float], beside: float):
    rng, axis = np.random.default_rng(2), np.array(direction) / np.linalg.norm(direction)
    rest = np.linspace(-0.03, 0.03, 5)[:, None] * axis + beside * rng.standard_normal((5, 3))
    across = np.cross(axis, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    markers = Markers(np.arange(5, dtype=np.uint32), rest, np.full(5, np.nan), np.full(5, "surface"))
    turned = Rotation.from_rotvec(0.02 * across) * Rotation.from_rotvec(0.5 * axis)
    where = turned.apply(rest) + np.array([4e-4, 0.0, 0.0])
    frames = []
    for k in range(20):
        measured = where + SIGMA * rng.standard_normal((5, 3))
        C = np.tile(SIGMA**2 * np.eye(3), (5, 1, 1))
        frames.append(Residual(k * STEP_NS, np.arange(5, dtype=np.uint32), measured, rest, C))
    found = at_rest(frames, markers)[0]
    assert found.contradicts
    assert found.shift == pytest.approx([4e-4, 0.0, 0.0], abs=2e-5)  # measured 0.8e-5
    assert abs(np.dot(found.turn, axis)) < 0.01  # measured 0.0029
    assert np.dot(found.turn, across) == pytest.approx(0.02, abs=5e-4)  # measured 1.8e-4


@pytest.mark.parametrize("bend", [0.0, 0.01])
def test_a_stated_rest_is_told_from_a_trackers_frame_by_markers_that_make_one(bend: float):
    """Three markers on the support that lie on a line leave a turn about it open, and the tracker's frame with it."""
    line = np.array([[-0.03, bend, 0.0], [0.0, -bend, 0.0], [0.03, bend, 0.0]])
    places = np.concatenate([PLACES[:5], line])
    kinds = np.array(["surface"] * 5 + ["support"] * 3)
    markers = Markers(np.arange(8, dtype=np.uint32), places, np.full(8, np.nan), kinds)
    found = at_rest(_recording(np.full((8, 3), 5e-4)), markers)[0]
    assert found.contradicts and found.held == (3 if bend else 0)
    assert ("does not come from these markers" in found.text) == (not bend)


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("sigma", [2e-4, 1e-3])
def test_noise_that_no_tracker_states_is_how_errors_scatter(stated: bool, sigma: float):
    """It was none, and a tracker of 1 mm contradicted a perfect model in ten still frames."""
    rng, rest = np.random.default_rng(1), 0.03 * np.random.default_rng(6).standard_normal((20, 3))
    ids = np.arange(20, dtype=np.uint32)
    markers = Markers(ids, rest, np.full(20, np.nan), np.full(20, "surface"))
    C = np.tile(sigma**2 * np.eye(3) if stated else np.full((3, 3), np.nan), (20, 1, 1))
    frames = [Residual(k * 100_000_000, ids, rest + sigma * rng.standard_normal((20, 3)), rest, C) for k in range(10)]
    found = at_rest(frames, markers)[0]
    assert not found.contradicts
    assert found.noise == pytest.approx(np.sqrt(3.0 * (4e-5**2 + sigma**2)), rel=0.1)  # measured 6 % less
