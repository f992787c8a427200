"""The experiment that would tell two explanations apart: of a list of feasible probe trajectories, the one with the
largest expected separation (Hunter & Reiner 1965; Box & Hill 1967: D2 between the predictions of the rivals).

Each trajectory is predicted with the fitted answer and with its nearest rival; what the rival can mimic by changing its
own amplitudes, what the registration, the markers' places and the model error can hide, is projected out first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.closed_loop.evidence.observation import NoiseReport, Observation
from livedeform.closed_loop.forward import ForwardModel, stack
from livedeform.closed_loop.inference.forward_selection import Added, Search, columns_of
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array, Pose

if TYPE_CHECKING:
    from livedeform.closed_loop.inputs import Inputs

SPEED = 0.010  # m/s of a careful robot
APPROACH = 0.005  # m above the surface
MOMENTS = 14


@dataclass(frozen=True)
class Trajectory:
    """A feasible motion of the probe at 50 Hz, with a sentence that says what it does."""

    name: str
    text: str
    poses: tuple[Pose, ...]


@dataclass(frozen=True)
class Proposal:
    """The best trajectory for telling ``names`` apart; ``separation`` D in sigmas of each trajectory, ``advice`` in
    words, including what no trajectory can do."""

    names: tuple[str, str]
    best: Trajectory | None
    separation: dict[str, float]
    advice: str


def propose(forward: ForwardModel, inputs: Inputs, search: Search, rivals: Sequence[str]) -> Proposal | None:
    """For the first added effect and its nearest rival; None if it has none or there is no probe."""
    if not search.steps or not search.added or not rivals:
        return None
    refined = search.steps[0].refined
    first = search.added[0].candidate.name
    rival = next((r for r in rivals if r in refined and r != first), None)
    if rival is None or first not in refined:
        return None
    names = (first, rival)
    cards = refined[first].candidate.info, refined[rival].candidate.info
    extra = cards[0].told_apart_by.get(rival, "") or cards[1].told_apart_by.get(first, "")
    if inputs.contact_top is None:
        return Proposal(names, None, {}, extra or "record the body under a second load or in a second orientation")
    separation: dict[str, float] = {}
    trajectories = feasible(inputs.contact_top, inputs.depth, inputs.lower, inputs.upper)
    members = [Added(refined[n].candidate, refined[n].fit.z) for n in names]
    for trajectory in trajectories:
        observation = planned(trajectory, search.observations[0])
        try:
            separation[trajectory.name] = _separation(forward, search, observation, members)
        except ConvergenceError:
            continue
    if not separation:
        return Proposal(names, None, {}, extra)
    best = max(separation, key=lambda n: separation[n])
    chosen = next(t for t in trajectories if t.name == best)
    advice = f"{chosen.text}: expected separation of {names[0]} from {names[1]} {separation[best]:.1f} sigma"
    if separation[best] < 3.0:
        advice = f"no feasible trajectory separates {names[0]} from {names[1]} (best {separation[best]:.1f} sigma)"
    return Proposal(names, chosen, separation, f"{advice}; {extra}" if extra else advice)


def feasible(top: Pose, depth: float, lower: Array, upper: Array) -> list[Trajectory]:
    """Trajectories around the pose ``top`` at which the probe first touched: two depths, off-centre, tilted,
    sideways, fast."""
    z = Rotation.from_quat(top.orientation_xyzw).as_matrix()[:, 2]
    x = Rotation.from_quat(top.orientation_xyzw).as_matrix()[:, 0]
    side = 0.2 * float(min(upper[0] - lower[0], upper[1] - lower[1]))
    at = top.position

    def press(offset: Array, deep: float, hold: float, *, back: float = SPEED, tilt: float = 0.0) -> list[tuple]:
        q = (Rotation.from_rotvec(tilt * x) * Rotation.from_quat(top.orientation_xyzw)).as_quat()
        return [
            (at + offset - APPROACH * z, q, SPEED, 0.0),
            (at + offset + deep * z, q, SPEED, hold),
            (at + offset - APPROACH * z, q, back, 2.0),
        ]

    none = np.zeros(3)
    plans = {
        "two depths": ("press to half and to the full depth", press(none, 0.5 * depth, 1.0) + press(none, depth, 1.0)),
        "hold and wait": ("press, hold for 6 s, retreat fast and wait", press(none, depth, 6.0, back=0.1)),
        "off centre": ("press off the centre on two sides", press(side * x, depth, 1.0) + press(-side * x, depth, 1.0)),
        "tilted": ("press with the probe tilted by 10 degrees", press(none, depth, 1.0, tilt=np.deg2rad(10.0))),
        "sideways": (
            "press and stroke sideways",
            [
                *press(none, 0.7 * depth, 0.5)[:2],
                (at + 0.7 * depth * z + 0.3 * side * x, top.orientation_xyzw, SPEED, 1.0),
                *press(none, 0.7 * depth, 0.0)[2:],
            ],
        ),
        "two speeds": ("press slowly and fast", press(none, depth, 0.5) + press(none, depth, 0.5, back=0.1)),
    }
    return [Trajectory(name, text, _poses(stops)) for name, (text, stops) in plans.items()]


def _poses(stops: Sequence[tuple]) -> tuple[Pose, ...]:
    """50 Hz poses through ``stops`` (position, quaternion, speed to get there, seconds to stay)."""
    poses = [Pose(0, stops[0][0], np.asarray(stops[0][1]))]
    t = 1.0
    poses.append(Pose(round(1e9 * t), stops[0][0], np.asarray(stops[0][1])))
    for position, quaternion, speed, stay in stops[1:]:
        last = poses[-1]
        seconds = max(float(np.linalg.norm(position - last.position)) / speed, 0.02)
        n = max(round(seconds / 0.02), 1)
        for k in range(1, n + 1):
            p = last.position + k / n * (position - last.position)
            poses.append(Pose(round(1e9 * (t + seconds * k / n)), p, np.asarray(quaternion)))
        t += seconds
        for k in range(1, round(stay / 0.02) + 1):
            poses.append(Pose(round(1e9 * (t + 0.02 * k)), position, np.asarray(quaternion)))
        t += stay
    return tuple(poses)


def planned(trajectory: Trajectory, like: Observation) -> Observation:
    """An observation of a motion that has not been made, with the noise of a recording that has."""
    stamps = np.array([p.stamp_ns for p in trajectory.poses], np.int64)
    pick = np.unique(np.linspace(0, len(stamps) - 1, MOMENTS).round().astype(int))
    m = len(like.ids)
    noise: NoiseReport = like.noise
    n = len(pick)
    typical = float(np.median(like.n_effective[like.n_effective > 0])) if (like.n_effective > 0).any() else 1.0
    covariances = np.broadcast_to(noise.covariance / typical, (n, m, 3, 3)).copy()
    poses = tuple(trajectory.poses[i] for i in pick)
    shift = like.start_ns
    path = tuple(Pose(p.stamp_ns + shift, p.position, p.orientation_xyzw) for p in trajectory.poses)
    return Observation(
        name=trajectory.name,
        stamps_ns=stamps[pick] + shift,
        ids=like.ids,
        points=np.zeros((n, m, 3)),
        covariances=covariances,
        single=np.zeros((n, m, 3)),
        single_covariances=covariances,
        weights=np.ones(n),
        poses=tuple(Pose(p.stamp_ns + shift, p.position, p.orientation_xyzw) for p in poses),
        velocities=np.zeros((n, 3)),
        forces=None,
        force_sigma=float("nan"),
        blocks=np.zeros(n, int),
        phases=np.where(np.arange(n) < 2, "rest", "press"),
        n_frames=np.full(n, 1),
        n_effective=np.full(n, typical),
        noise=noise,
        start_ns=shift,
        path=path,
    )


def _separation(forward: ForwardModel, search: Search, observation: Observation, members: Sequence[Added]) -> float:
    """D between the predictions of two members on one observation, in sigmas, after the second has adapted itself."""
    first, second = members
    columns = columns_of([second])
    a = stack(forward.run([first.values], [observation]))
    b = stack(forward.run([second.values], [observation], columns))
    plan = Search(forward, [observation], {}, replace(search.uncertain, always=()))
    problem, J = plan.problem(b, columns)
    d = problem.rows.take(a.points - b.points)
    marginal = problem.marginal()
    dw, Jw = marginal(np.nan_to_num(d)), marginal(J)
    sigma = search.steps[0].refined[second.candidate.name].fit.sigma  # what the recordings already say of it
    A = Jw.T @ Jw + np.diag(1.0 / np.maximum(sigma, 1e-12) ** 2)
    g = Jw.T @ dw
    return float(np.sqrt(max(float(dw @ dw - g @ np.linalg.solve(A, g)), 0.0)))
