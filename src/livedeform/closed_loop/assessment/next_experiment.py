"""The experiment that would tell two explanations apart: of a list of feasible probe trajectories, the one with the
largest expected separation (Hunter & Reiner 1965; Box & Hill 1967: D2 between the predictions of the rivals).

Each trajectory is predicted with the fitted effect and with its nearest rival (`apart_in`); what the rival can mimic by
changing its own amplitudes, what the registration, the markers' places and the model error can hide, is projected out
first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, ForwardModel, Run
from livedeform.closed_loop.inference.fitted_model import Added, FittedModel, columns_of
from livedeform.closed_loop.inference.forward_selection import Refined, Selection
from livedeform.closed_loop.inference.problem import ProblemFactory, blocks_of, recordings_of
from livedeform.closed_loop.settings import ProposalSettings, Settings
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array, EffectValues, Pose

TINY = 1e-12  # least sigma of a coordinate


@dataclass(frozen=True)
class ProbeReach:
    """The region in which the probe may press: ``lower`` and ``upper`` (3,) m are the body's corners, ``top`` the pose
    at which it touches (None: there is no probe), ``depth`` m how deep it goes from there."""

    lower: Array
    upper: Array
    top: Pose | None = None
    depth: float = 0.0


@dataclass(frozen=True)
class ProbeTrajectory:
    """A feasible motion of the probe at 50 Hz, with a sentence that says what it does."""

    name: str
    text: str
    poses: tuple[Pose, ...]


@dataclass(frozen=True)
class Proposal:
    """The best trajectory for telling ``names`` apart, or for telling one name from chance; ``separation`` D in sigmas
    of each trajectory, ``advice`` in words, including what no trajectory can do."""

    names: tuple[str, ...]
    best: ProbeTrajectory | None
    separation: dict[str, float]
    advice: str


@dataclass(frozen=True)
class NextExperiment:
    """The method: predicts feasible trajectories with an added effect and with its nearest rival, beside the others."""

    settings: Settings
    forward: ForwardModel
    reach: ProbeReach

    def propose(self, selection: Selection, rivals: Mapping[str, Sequence[str]]) -> Proposal | None:
        """Find the trajectory that tells the first added effect that has ``rivals``, by its name, from the nearest of
        them best; None if none has any."""
        for step in selection.steps:
            rival = next((r for r in rivals.get(step.added, ()) if r in step.refined), None)
            if rival is not None and step.added in step.refined:
                return self._telling_apart(selection, step.refined, (step.added, rival))
        return None

    def _telling_apart(
        self, selection: Selection, refined: Mapping[str, Refined], names: tuple[str, str]
    ) -> Proposal | None:
        cards = refined[names[0]].candidate.info, refined[names[1]].candidate.info
        extra = cards[0].told_apart_by.get(names[1], "") or cards[1].told_apart_by.get(names[0], "")
        if self.reach.top is None:
            return Proposal(names, None, {}, extra or "record the body under a second load or in a second orientation")
        trajectories = feasible(self.reach, self.reach.top, self.settings.proposal)
        separation = self._separations(selection, trajectories, refined, names)
        if not separation:
            return Proposal(names, None, {}, extra)
        best = max(separation, key=lambda n: separation[n])
        chosen = next(t for t in trajectories if t.name == best)
        advice = f"{chosen.text}: expected separation of {names[0]} from {names[1]} {separation[best]:.1f} sigma"
        tells = separation[best] >= np.sqrt(self.settings.screening.min_gap)
        if not tells:
            advice = f"no feasible trajectory separates {names[0]} from {names[1]} (best {separation[best]:.1f} sigma)"
        return Proposal(names, chosen if tells else None, separation, f"{advice}; {extra}" if extra else advice)

    def _separations(
        self,
        selection: Selection,
        trajectories: Sequence[ProbeTrajectory],
        refined: Mapping[str, Refined],
        names: tuple[str, str],
    ) -> dict[str, float]:
        """D of each trajectory that both effects can be predicted for to its end, beside the others in the model."""
        first, second = (Added(refined[name].candidate, refined[name].fit.z) for name in names)
        others = [a for a in selection.added if a.candidate.name not in names]
        rough = (selection.first is not None and selection.first.run.rough) or not all(grows(a) for a in others)
        known = refined[names[1]].fit.sigma  # what the recordings already say of the rival
        plans = [planned(t, selection.observations, self.settings.proposal) for t in trajectories]
        out: dict[str, float] = {}
        each = apart_in(self.forward, [a.values for a in others], (first, second), plans, rough=rough)
        for plan, apart in zip(plans, each, strict=True):
            if apart is None:
                continue
            try:
                out[plan.name] = self._separation(selection.model, plan, apart, columns_of([second]), known)
            except ConvergenceError:
                continue
        return out

    def _separation(
        self, model: FittedModel, observation: Observation, apart: ModelsApart, columns: Sequence[Column], known: Array
    ) -> float:
        """D between the predictions of two members on one observation, in sigmas, after the second, whose ``columns``
        its run has, has adapted itself within the sigmas (p,) ``known`` of it."""
        plan = FittedModel(replace(model.uncertain, always=()))
        problem, J = ProblemFactory([observation], self.settings.allowance).at(plan, apart.rival, columns)
        d = problem.rows.take(apart.points, apart.forces)
        marginal = problem.marginal
        dw, Jw = marginal(np.nan_to_num(d)), marginal(J)
        A = Jw.T @ Jw + np.diag(1.0 / np.maximum(known, TINY) ** 2)
        g = Jw.T @ dw
        return float(np.sqrt(max(float(dw @ dw - g @ np.linalg.solve(A, g)), 0.0)))


class ModelsApart(NamedTuple):
    """Hold by how much one model's ``points`` (k, m, 3) m and ``forces`` (k, 3) N, if it tells any, are off its
    rival's, and a run of the ``rival``, or near it, with its columns."""

    points: Array
    forces: Array | None
    rival: Run


def apart_in(
    forward: ForwardModel,
    others: Sequence[EffectValues],
    members: tuple[Added, Added],
    plans: Sequence[Observation],
    *,
    rough: bool = False,
) -> list[ModelsApart | None]:
    """Predict each of the ``plans`` with one member and with the other, its rival, beside the ``others``; None where
    that does not lead to its end.

    Where both have a size they are taken from one run, halfway between them: half of both sizes, of which one grows as
    the other goes (central differences, right to the second order; the rival's columns to the first). Where one rubs or
    is switched on, or columns are ``rough``, as of a probe that rubs, from a run of each.
    """
    first, second = members
    columns = columns_of([second])
    if rough or not all(grows(a) for a in members):
        runs = [forward.run([*others, a.values], plans, c) for a, c in ((first, ()), (second, columns))]
        return [_between(a, b) if a.whole and b.whole else None for a, b in zip(*runs, strict=True)]
    (half, up), (rival, down) = halfway(first), halfway(second)
    between = forward.run([*others, half.values, rival.values], plans, columns_of([half, rival]))
    step = 2.0 * np.concatenate([up, -down])
    of_shape = np.where(down != 0.0, 1.0, 2.0)  # what it shows of its shape grows with its size
    return [_by_one_run(run, step, of_shape) if run.whole else None for run in between]


def _between(a: Run, b: Run) -> ModelsApart:
    """Return by how much the run ``a`` is off that of the rival ``b``."""
    forces = None if a.forces is None or b.forces is None else a.forces - b.forces
    return ModelsApart(a.points - b.points, forces, b)


def _by_one_run(run: Run, step: Array, of_shape: Array) -> ModelsApart:
    """Return by how much models are apart along a ``step`` (n + p,) of the run's columns, of which the last p are the
    rival's, to be scaled as ``of_shape`` (p,) says."""
    own = len(step) - len(of_shape)
    forces = None if run.d_forces is None else run.d_forces @ step
    d_forces = None if run.d_forces is None else run.d_forces[..., own:] * of_shape
    rival = replace(run, d_points=run.d_points[..., own:] * of_shape, d_forces=d_forces)
    return ModelsApart(run.d_points @ step, forces, rival)


def grows(added: Added) -> bool:
    """Tell whether an effect grows evenly with its size: it has one, neither rubs nor is switched on."""
    info = added.candidate.info
    return bool(len(added.candidate.amplitudes)) and not (info.rubs or info.switched)


def halfway(added: Added) -> tuple[Added, Array]:
    """Return the effect at half of its size, and what is missing to the whole (p,)."""
    amplitudes = np.isin(np.arange(len(added.z)), added.candidate.amplitudes)
    missing = np.where(amplitudes, 0.5 * added.z, 0.0)
    return replace(added, z=added.z - missing), missing


def once_more(selection: Selection) -> Proposal | None:
    """Propose to make the recording again in which one press alone speaks for a candidate that would predict
    left-out data better: what comes again was no chance. None if there is no such candidate."""
    asked = [step for step in selection.steps if step.by_one_press]
    if not asked:
        return None
    refined = asked[-1].refined
    name = min(asked[-1].by_one_press, key=lambda n: refined[n].score)
    blocks, recordings = blocks_of(selection.observations), recordings_of(selection.observations)
    numbers = blocks if selection.last is None else selection.last.problem.rows.fold  # none where nothing was kept
    press = int(np.unique(numbers)[np.argmin(refined[name].block_scores)])
    number = int(recordings[blocks == press][0])
    o = selection.observations[number]
    t = o.seconds[blocks[recordings == number] == press]
    text = f"record {o.name} once more, with the same motion"
    advice = f"{text}: what speaks for {name} between {t[0]:.1f} and {t[-1]:.1f} s comes again or was chance"
    poses = tuple(replace(p, stamp_ns=p.stamp_ns - o.path[0].stamp_ns) for p in o.path)
    return Proposal((name,), ProbeTrajectory("once more", text, poses) if poses else None, {}, advice)


class Stop(NamedTuple):
    """A pose to go to at ``speed`` m/s and to ``stay`` at for some s."""

    position: Array
    quaternion: Array
    speed: float
    stay: float


def feasible(reach: ProbeReach, top: Pose, settings: ProposalSettings) -> list[ProbeTrajectory]:
    """Plan trajectories around the pose ``top``: two depths, off-centre, tilted, sideways, fast."""
    z = Rotation.from_quat(top.orientation_xyzw).as_matrix()[:, 2]
    x = Rotation.from_quat(top.orientation_xyzw).as_matrix()[:, 0]
    side = settings.side * float(min(reach.upper[0] - reach.lower[0], reach.upper[1] - reach.lower[1]))
    at, depth, slow, above = top.position, reach.depth, settings.speed, settings.approach * z

    def press(offset: Array, deep: float, hold: float, *, back: float = slow, tilt: float = 0.0) -> list[Stop]:
        q = (Rotation.from_rotvec(tilt * x) * Rotation.from_quat(top.orientation_xyzw)).as_quat()
        return [
            Stop(at + offset - above, q, slow, 0.0),
            Stop(at + offset + deep * z, q, slow, hold),
            Stop(at + offset - above, q, back, settings.wait),
        ]

    none = np.zeros(3)
    far, low = settings.drag
    away = at + low * depth * z + far * side * x
    plans = {
        "two depths": ("press to half and to the full depth", press(none, 0.5 * depth, 1.0) + press(none, depth, 1.0)),
        "hold and wait": (
            f"press, hold for {settings.hold:.0f} s, retreat fast and wait",
            press(none, depth, settings.hold, back=settings.fast),
        ),
        "off centre": ("press off the centre on two sides", press(side * x, depth, 1.0) + press(-side * x, depth, 1.0)),
        "tilted": (
            f"press with the probe tilted by {settings.tilt:.0f} degrees",
            press(none, depth, 1.0, tilt=float(np.deg2rad(settings.tilt))),
        ),
        "sideways": (
            "press and slide sideways",
            [
                *press(none, low * depth, 0.5)[:2],
                Stop(away, np.asarray(top.orientation_xyzw), slow, 1.0),
                *press(none, low * depth, 0.0)[2:],
            ],
        ),
        "two speeds": (
            "press slowly and fast",
            press(none, depth, 0.5) + press(none, depth, 0.5, back=settings.fast),
        ),
    }
    return [ProbeTrajectory(name, text, _poses(stops, settings.period)) for name, (text, stops) in plans.items()]


def _poses(stops: Sequence[Stop], period: float) -> tuple[Pose, ...]:
    """Poses through ``stops``, one every ``period`` s."""
    poses = [Pose(0, stops[0][0], np.asarray(stops[0][1]))]
    t = 1.0
    poses.append(Pose(round(1e9 * t), stops[0][0], np.asarray(stops[0][1])))
    for position, quaternion, speed, stay in stops[1:]:
        last = poses[-1]
        seconds = max(float(np.linalg.norm(position - last.position)) / speed, period)
        n = max(round(seconds / period), 1)
        for k in range(1, n + 1):
            p = last.position + k / n * (position - last.position)
            poses.append(Pose(round(1e9 * (t + seconds * k / n)), p, np.asarray(quaternion)))
        t += seconds
        for k in range(1, round(stay / period) + 1):
            poses.append(Pose(round(1e9 * (t + period * k)), position, np.asarray(quaternion)))
        t += stay
    return tuple(poses)


def planned(trajectory: ProbeTrajectory, recorded: Sequence[Observation], settings: ProposalSettings) -> Observation:
    """An observation of a motion that has not been made, with the noise of the middle one of those that have, and
    with forces if one of them has."""
    like = sorted(recorded, key=lambda o: float(np.trace(np.nanmedian(o.noise.covariance, axis=0))))[len(recorded) // 2]
    force_sigmas = [o.force_sigma for o in recorded if o.forces is not None and np.isfinite(o.force_sigma)]
    stamps = np.array([p.stamp_ns for p in trajectory.poses], np.int64)
    pick = np.unique(np.linspace(0, len(stamps) - 1, settings.moments).round().astype(int))
    m = len(like.ids)
    noise = like.noise
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
        rates=np.zeros((n, m, 3)),
        covariances=covariances,
        single=np.zeros((n, m, 3)),
        single_covariances=covariances,
        weights=np.ones(n),
        poses=tuple(Pose(p.stamp_ns + shift, p.position, p.orientation_xyzw) for p in poses),
        velocities=np.zeros((n, 3)),
        forces=np.zeros((n, 3)) if force_sigmas else None,
        force_sigma=float(np.median(force_sigmas)) if force_sigmas else float("nan"),
        blocks=np.zeros(n, int),
        phases=np.where(np.arange(n) < 2, "rest", "press"),
        presses=np.where(np.arange(n) < 2, 0, 1),
        n_frames=np.full(n, 1),
        n_effective=np.full(n, typical),
        noise=noise,
        start_ns=shift,
        path=path,
        patience=settings.patience,
    )
