"""Rigid transforms and poses in between."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from livedeform.common.frames import (
    PosePath,
    apply,
    fit_misplaced,
    fit_rigid,
    fit_rigid_by_noise,
    inverse,
    make_a_frame,
    pose_matrix,
    slerp,
    transform,
)
from livedeform.common.types import Pose

START_NS = 1_700_000_000_000_000_000


def turning(n: int, step_ns: int = 10_000_000, speed: float = 2.0) -> list[Pose]:
    """A pose that turns about z at ``speed`` rad/s and moves along x at 1 m/s."""
    times = np.arange(n) * step_ns * 1e-9
    turns = Rotation.from_rotvec(np.outer(speed * times, [0.0, 0.0, 1.0])).as_quat()
    return [Pose(START_NS + k * step_ns, np.array([times[k], 0.0, 0.0]), turns[k]) for k in range(n)]


def test_between_poses_a_constant_motion_is_met_exactly():
    stamps = START_NS + np.array([0, 3_000_000, 14_500_000, 40_000_000])
    positions, turns = PosePath(turning(5)).at(stamps)
    t = (stamps - START_NS) * 1e-9
    np.testing.assert_allclose(positions[:, 0], t, atol=1e-15)
    np.testing.assert_allclose(turns.as_rotvec()[:, 2], 2.0 * t, atol=1e-12)


@pytest.mark.parametrize("stamp", [START_NS - 10**9, START_NS + 10**9])
def test_outside_the_recording_it_stands_still(stamp: int):
    poses = turning(3)
    end = poses[0] if stamp < START_NS else poses[-1]
    positions, turns = PosePath(poses).at([stamp])
    np.testing.assert_allclose(transform(turns.as_matrix()[0], positions[0]), pose_matrix(end), atol=1e-14)


def test_an_offset_is_a_later_moment():
    path = PosePath(turning(5))
    np.testing.assert_allclose(path.at([START_NS], 0.015)[0], path.at([START_NS + 15_000_000])[0], atol=1e-12)


def test_order_and_repeated_stamps_do_not_matter():
    poses = turning(4)
    again = Pose(poses[1].stamp_ns, np.full(3, 9.0), poses[3].orientation_xyzw)
    stamps = START_NS + np.arange(0, 30_000_000, 1_000_000)
    one, other = PosePath(poses).at(stamps), PosePath([poses[3], poses[1], again, poses[0], poses[2]]).at(stamps)
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1].as_quat(), other[1].as_quat())


def test_one_pose_is_there_at_all_times():
    positions, turns = PosePath(turning(1)).at(START_NS + np.array([-5, 0, 7]))
    assert positions.shape == (3, 3) and len(turns) == 3


def test_slerp_turns_at_constant_speed():
    both = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.3, -0.6, 0.2]])
    np.testing.assert_allclose(slerp(both, 0.25).as_rotvec(), [0.075, -0.15, 0.05], atol=1e-14)


def test_a_rigid_fit_undoes_a_transform():
    rng = np.random.default_rng(0)
    T = transform(Rotation.from_rotvec([0.2, -0.4, 1.1]).as_matrix(), np.array([0.1, -0.2, 0.3]))
    points = rng.normal(size=(7, 3))
    np.testing.assert_allclose(fit_rigid(points, apply(T, points)), T, atol=1e-13)
    np.testing.assert_allclose(apply(inverse(T), apply(T, points)), points, atol=1e-14)


def test_a_rigid_fit_by_noise_is_the_plain_one_where_noise_is_the_same_in_all_directions():
    rng = np.random.default_rng(1)
    points, target = rng.normal(scale=0.03, size=(2, 9, 3))
    even = np.broadcast_to(1e-8 * np.eye(3), (9, 3, 3))
    start = fit_rigid(points, target + 1e-3)
    np.testing.assert_allclose(fit_rigid_by_noise(points, even, points, start, 1e-7), np.eye(4), atol=1e-9)
    target = apply(start, points) + rng.normal(scale=1e-4, size=(9, 3))
    found = fit_rigid_by_noise(points, even, target, start, 1e-4)
    np.testing.assert_allclose(found, fit_rigid(points, target), atol=1e-8)


def test_a_rigid_fit_by_noise_trusts_what_is_seen_sideways():
    """Two cameras that look down at an angle see depth eight times worse: by millimetres alone that turns the rest."""
    rng = np.random.default_rng(2)
    view = Rotation.from_euler("xyz", [0.7, -0.5, 0.3]).as_matrix()
    spread = view @ np.diag([5e-5, 5e-5, 4e-4]) @ view.T
    target = rng.uniform(-0.03, 0.03, (20, 3)) * [1.0, 1.0, 0.2]
    off: dict[str, list[float]] = {"plain": [], "by noise": [], "misplaced": []}
    for _ in range(40):
        seen = target + rng.normal(size=(20, 3)) @ spread
        covariances = np.broadcast_to(spread @ spread.T, (20, 3, 3))
        plain = fit_rigid(seen, target)
        fits = (
            plain,
            fit_rigid_by_noise(seen, covariances, target, plain, 1e-7),
            fit_misplaced(seen, covariances, target, plain),
        )
        for name, T in zip(off, fits, strict=True):
            sideways = (apply(T, target) - target) @ view[:, :2]
            off[name].append(float(np.sqrt(np.mean(sideways**2))))
    plain_off, by_noise, misplaced = (float(np.mean(v)) for v in off.values())
    assert by_noise < 0.5 * plain_off  # measured: 16 and 42 um
    assert misplaced < 0.5 * plain_off


def test_places_that_are_said_to_be_known_exactly_are_fitted_like_others():
    rng = np.random.default_rng(3)
    points = rng.normal(scale=0.03, size=(9, 3))
    target = points + rng.normal(scale=1e-4, size=(9, 3))
    plain = fit_rigid(points, target)
    np.testing.assert_allclose(fit_misplaced(points, np.zeros((9, 3, 3)), target, plain), plain, atol=1e-8)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 12])
def test_points_on_a_line_or_at_one_place_leave_a_turn_open(n: int) -> None:
    line = np.array([0.1, 0.2, 0.3]) + np.outer(np.linspace(-0.05, 0.05, n), [1.0, 2.0, -1.0])
    assert not make_a_frame(line)
    assert not make_a_frame(np.tile([0.1, 0.2, 0.3], (n, 1)))
    assert make_a_frame(np.concatenate([line, [[0.1, 0.2, 0.32]]])) == (n > 1)
