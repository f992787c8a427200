"""From an experiment and its recordings to what the search needs: observations, candidates, uncertainties and a
model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from operator import attrgetter
from pathlib import Path

import numpy as np

from livedeform.closed_loop.candidates import Candidate, catalogue, narrowed
from livedeform.closed_loop.evidence.noise import Errors
from livedeform.closed_loop.evidence.observation import Observation, observe, track
from livedeform.closed_loop.inference.forward_selection import Tell, silent
from livedeform.closed_loop.inference.problem import Allowed, Uncertain
from livedeform.closed_loop.model.fem_model import Body, Setting
from livedeform.closed_loop.model.refined_mesh import Accuracy, accuracy
from livedeform.closed_loop.model.workers import FemModel
from livedeform.common.bags.recording import Recording
from livedeform.common.checks.recorded import load_checked
from livedeform.common.effect import Surroundings
from livedeform.common.errors import InputError, MeshError, RecordingError
from livedeform.common.experiment.yaml_file import Experiment, load_experiment
from livedeform.common.frames import pose_matrix
from livedeform.common.types import Array, EffectValues, MarkerFrame, Pose
from livedeform.fem_node.declared import declared_physics
from livedeform.fem_node.effects import EFFECTS as MECHANICAL
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.mesh.generate import load_or_make_mesh, remeshed
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.stereo_node.camera.setup import declared_camera_pose, rig_of
from livedeform.stereo_node.effects import View
from livedeform.stereo_node.pairing import recorded_pairs
from livedeform.stereo_node.pipeline import StereoTracker

MOMENTS_FIT, MOMENTS_TEST = 30, 20
MESH_VERTICES = 420
PLACE_SIGMA = 4e-5  # m, of markers whose file gives none
# model errors where they cannot be measured (see `accuracy`), and their floors where they can
RELATIVE_ERROR, LEAST_RELATIVE = 0.03, 0.02  # of a marker's motion
FORCE_ERROR, LEAST_FORCE = 0.06, 0.02  # of the force: a sensor is hardly better
REST_ERROR = 0.008  # of a marker's sag
OFFSET_ERROR = 0.04  # of an element's size, sideways, by which the probe seems to press beside where it is
PAIRS_PER_SECOND = 10.0  # of pictures that are measured here, where a recording has no markers yet


@dataclass(frozen=True)
class Inputs:
    """What is known before anything is fitted. ``places`` (m, 3) of the markers at rest; ``contact_top`` the pose of
    first touch and ``depth`` m how deep it went; ``lower``, ``upper`` (3,) m the body's corners; ``notes`` for the
    user."""

    fitted: tuple[Observation, ...]
    held_out: tuple[Observation, ...]
    candidates: Mapping[str, Candidate]
    uncertain: Uncertain
    places: Array
    lower: Array
    upper: Array
    contact_top: Pose | None = None
    depth: float = 0.008
    notes: tuple[str, ...] = ()
    experiment: Experiment | None = None
    forward: FemModel | None = None
    recordings: Mapping[str, Recording] = field(default_factory=dict)
    declared: tuple[EffectValues, ...] = ()

    @property
    def element_size(self) -> float:
        """Mean edge of the model's elements, m; 0 for a model without any."""
        return 0.0 if self.forward is None else self.forward.body.element_size

    @property
    def registered(self) -> bool:
        """Whether the cameras' pose came from the markers at rest."""
        stereo = None if self.experiment is None else self.experiment.stereo
        return stereo is not None and isinstance(stereo.pose, str)


def read_inputs(
    experiment_path: Path,
    fit: Sequence[Path],
    test: Sequence[Path],
    *,
    candidates: Sequence[str] | None = None,
    processes: int = 2,
    tell: Tell = silent,
) -> Inputs:
    """Everything from files."""
    if not fit:
        raise InputError("no recording to fit", where="--fit", remedy="name at least one bag")
    tell("reading the experiment and the recordings", None)
    experiment = load_experiment(experiment_path)
    names = _names([*fit, *test])
    recordings = dict(zip(names, load_checked(fit, test, experiment), strict=True))
    physics = apply_effects(declared_physics(experiment), experiment.effects)
    mesh = coarse_enough(load_or_make_mesh(experiment.phantom), tell)  # type: ignore[arg-type]  # the schema has a size
    markers = experiment.markers
    declared_clock = experiment.timeline.clock_start_ns
    clock = min(recordings[n].start_ns for n in names[: len(fit)]) if declared_clock is None else declared_clock
    setting = Setting(
        mesh=mesh,
        element="p2p0",
        physics=declared_physics(experiment),
        declared=tuple(experiment.effects),
        markers=markers.points,
        still=np.asarray(markers.kinds) == "support",
        views={},
        clock_start_ns=clock,
    )
    rest = Body(setting).rest()
    views = {n: _view(experiment, r, rest, clock) for n, r in recordings.items()}
    setting = replace(setting, views=views)
    body = Body(setting)
    observations, notes = [], []
    for number, name in enumerate(names):
        recording = recordings[name]
        frames, note = _marker_frames(experiment, recording, rest, tell)
        notes += [f"{name}: {text}" for text in (*recording.warnings, *note)]
        observations.append(
            observe(
                name,
                track(frames, markers.ids),
                recording.poses if experiment.probe is not None else (),
                recording.wrenches,
                n_moments=MOMENTS_FIT if number < len(fit) else MOMENTS_TEST,
                start_ns=recording.start_ns,
                release=physics.release,
            )
        )
    observations = in_sequence(observations)
    fitted, held_out = observations[: len(fit)], observations[len(fit) :]
    if not held_out:
        notes.append("no --test recording: the last third of the blocks of time is held out")
        parts = [split(o) for o in fitted]
        fitted, held_out = [p[0] for p in parts], [replace(p[1], before=p[0]) for p in parts]
    lower, upper = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    top, depth, contacts = _contacts(fitted)
    around = Surroundings(
        physics=physics,
        lower=lower,
        upper=upper,
        markers=markers.points,
        internal=bool((np.asarray(markers.kinds) == "internal").any()),
        duration=max(float(o.seconds[-1]) for o in fitted),
        has_probe=experiment.probe is not None and bool(len(recordings[names[0]].poses)),
        contacts=contacts,
        has_cameras=all(v.rig is not None and not np.array_equal(v.T_phantom_left, np.eye(4)) for v in views.values()),
        has_release=physics.release > 0.0,
        jolt=max(_jolt(recordings[n].poses) for n in names[: len(fit)]),
        moments=tuple(float(t) for o in fitted for t in (o.stamps_ns - clock) * 1e-9),
    )
    found = _with_priors(catalogue(around, _candidate_names(candidates, experiment)), experiment)
    tell("solving the presses on a second mesh", None)
    known = catalogue(around)
    offset = next((c for c in known.values() if c.info.like_mesh), None)
    error = accuracy(body, fitted, held_out, offset, processes)
    notes.append(_said_of(error))
    return Inputs(
        fitted=tuple(fitted),
        held_out=tuple(held_out),
        candidates=found,
        uncertain=replace(
            _uncertain(experiment, rest, error),
            always=_always(known.values(), offset, _beside(mesh) if error is None else error.offset),
        ),
        places=rest,
        lower=lower,
        upper=upper,
        contact_top=top,
        depth=depth,
        notes=tuple(notes),
        experiment=experiment,
        forward=FemModel(setting, processes, body),
        recordings=recordings,
        declared=tuple(experiment.effects),
    )


def in_sequence(observations: Sequence[Observation]) -> list[Observation]:
    """Each recording with the one `before` it, if the body goes on from there: if at its start the markers are where
    they were at the other's end rather than at the other's start. Else the body is new, or has recovered."""
    out = list(observations)
    order = sorted(range(len(out)), key=lambda i: out[i].start_ns)
    for i, j in pairwise(order):
        earlier, later = out[i], out[j]
        if _apart(later, 0, earlier, -1) <= _apart(later, 0, earlier, 0):
            out[j] = replace(later, before=earlier)
    return out


def _apart(one: Observation, i: int, two: Observation, j: int) -> float:
    """How far apart the markers are at moment i of one and moment j of the other, in their noise."""
    d = one.points[i] - two.points[j]
    seen = np.isfinite(d).all(axis=1)
    if not seen.any():
        return 0.0
    noise = one.covariances[i][seen] + two.covariances[j][seen]
    return float(np.einsum("mi,mij,mj->", d[seen], np.linalg.inv(noise), d[seen]) / seen.sum())


def split(o: Observation) -> tuple[Observation, Observation]:
    """Fitted and held-out moments of one recording: its last third of blocks is held out."""
    n = int(o.blocks.max()) + 1
    first_held = max(n - max(n // 3, 1), 1)
    return o.take(o.blocks < first_held), o.take(o.blocks >= first_held)


def coarse_enough(mesh: TetMesh, tell: Tell = silent) -> TetMesh:
    """The mesh, or one of about ``MESH_VERTICES`` of the same body, kept by content as every mesh that is made.

    The loop solves thousands of equilibria; what the coarser mesh gets wrong is allowed for as model error.
    """
    if len(mesh.nodes) <= 2.0 * MESH_VERTICES:
        return mesh
    edges = mesh.nodes[mesh.tets[:, 0]] - mesh.nodes[mesh.tets[:, 1]]
    size = float(np.median(np.linalg.norm(edges, axis=1))) * (len(mesh.nodes) / MESH_VERTICES) ** (1.0 / 3.0)
    parameters = {"closed_loop": MESH_VERTICES, "repair": False}
    try:
        coarse = remeshed(mesh, size, parameters, lambda text: tell(f"for the search: {text}", None))
    except MeshError:
        return mesh
    return min(coarse, mesh, key=_vertices)  # a curved surface keeps its triangles small, however large a size is asked


def _vertices(mesh: TetMesh) -> int:
    return len(mesh.nodes)


def _jolt(poses: Sequence[Pose]) -> float:
    """The probe's highest acceleration, m/s2, over 50 ms: shorter blows pass a soft body by."""
    if len(poses) < 3:
        return 0.0
    t = np.array([p.stamp_ns - poses[0].stamp_ns for p in poses]) * 1e-9
    x = np.array([p.position for p in poses])
    grid = np.arange(t[0], t[-1], 0.05)
    at = np.column_stack([np.interp(grid, t, x[:, i]) for i in range(3)])
    return float(np.linalg.norm(np.diff(at, 2, axis=0), axis=1).max(initial=0.0) / 0.05**2)


def _names(paths: Sequence[Path]) -> list[str]:
    """Names of the recordings, made different where they are not."""
    out: list[str] = []
    for path in paths:
        base = path.stem if path.suffix == ".mcap" else path.name
        name, number = base, 2
        while name in out:
            name, number = f"{base}-{number}", number + 1
        out.append(name)
    return out


def _candidate_names(candidates: Sequence[str] | None, experiment: Experiment) -> list[str] | None:
    """Effects that the experiment has already are no candidates."""
    from livedeform.closed_loop.candidates import all_effects

    has = {e.name for e in experiment.effects}
    if candidates is None:
        return [n for n in all_effects() if n not in has]
    doubled = has & set(candidates)
    if doubled:
        raise InputError(
            f"the experiment has '{sorted(doubled)[0]}' already",
            where="--candidates",
            remedy="leave it out, or undeclare it",
        )
    return list(candidates)


def _view(experiment: Experiment, recording: Recording, rest: Array, clock: int) -> View:
    """How the cameras look at the body, as far as experiment and recording say."""
    declared = declared_camera_pose(experiment)
    known = declared or recording.camera_pose
    T = np.eye(4) if known is None else pose_matrix(known)
    rig = rig_of(experiment, recording.camera_infos)
    kinds = np.asarray(experiment.markers.kinds)
    return View(T, rig, rest, experiment.markers.ids, kinds, clock, registered=declared is None)


def _marker_frames(
    experiment: Experiment, recording: Recording, rest: Array, tell: Tell
) -> tuple[list[MarkerFrame], list[str]]:
    """The markers as an uncorrected rig reports them; measured here from the pictures if nobody has yet."""
    if recording.uncorrected_marker_frames:
        return recording.uncorrected_marker_frames, []
    if recording.marker_frames:
        return recording.marker_frames, []
    cameras = None
    if {"left", "right"} <= set(recording.camera_infos):
        cameras = recording.camera_infos["left"], recording.camera_infos["right"]
    tracker = StereoTracker.from_experiment(experiment, cameras, rest)
    frames: list[MarkerFrame] = []
    last = -np.inf
    for left, right in recorded_pairs(recording.left, recording.right):
        if left.stamp_ns - last < 0.9e9 / PAIRS_PER_SECOND:
            continue
        last = left.stamp_ns
        frame, _ = tracker.process(left, right)
        frames.append(frame)
        if len(frames) % 25 == 0:
            tell(f"measuring markers in pictures: {len(frames)} pairs", None)
    if not any(len(f.ids) for f in frames):
        raise RecordingError(
            "the recording holds neither markers nor pictures in which markers are found",
            where=str(recording.path),
            remedy="check it with `livedeform info`",
        )
    return frames, [f"markers measured here from {len(frames)} pairs of pictures"]


def _contacts(fitted: Sequence[Observation]) -> tuple[Pose | None, float, Array]:
    """The pose of the first press, how deep presses go beyond where they begin, and where the probe was at the
    deepest moments."""
    places, depth, top = [], 0.0, None
    for o in fitted:
        pressed = np.flatnonzero(o.phases != "rest")
        for b in np.unique(o.blocks[pressed]) if len(pressed) else []:
            here = pressed[o.blocks[pressed] == b]
            poses = [o.poses[i] for i in here if o.poses[i] is not None]
            if not poses:
                continue
            size = [np.nan_to_num(np.nanmean(np.linalg.norm(o.points[i] - o.points[0], axis=1))) for i in here]
            deepest = poses[int(np.argmax(size[: len(poses)]))]
            places.append(deepest.position)
            first = poses[0]
            travel = float(np.linalg.norm(deepest.position - first.position))
            if top is None or travel > depth:
                top, depth = first, travel
    contacts = np.array(places).reshape(-1, 3)
    return top, float(np.clip(depth, 0.003, 0.015)), contacts


def _uncertain(experiment: Experiment, rest: Array, model: Accuracy | None) -> Uncertain:
    """Sizes of everything that is uncertain anyway, from the experiment's sigmas where it has them."""
    markers = experiment.markers
    place = np.where(np.isfinite(markers.sigmas), markers.sigmas, PLACE_SIGMA)
    stereo = experiment.stereo
    shift, turn = 5e-4, 0.01
    if stereo is not None and not isinstance(stereo.pose, str):
        shift, turn = 2e-4, 0.002
    if model is None or model.correction.points:  # where elements are small under the probe only, the sag's remains
        place = np.hypot(place, REST_ERROR * np.linalg.norm(rest - markers.points, axis=1))
    if model is None:
        errors = Errors(place_sigma=place, relative=RELATIVE_ERROR, force_relative=FORCE_ERROR)
    else:
        errors = Errors(
            place_sigma=place,
            relative=max(model.relative, LEAST_RELATIVE),
            local=model.local,
            absolute=model.absolute,
            force_relative=max(2.0 * model.force_relative, LEAST_FORCE),
        )
    if model is None:
        return Uncertain(errors, shift, turn)
    return Uncertain(errors, shift, turn, correction=model.correction, anew=model.anew)


def _said_of(model: Accuracy | None) -> str:
    """What is allowed for as the model's own error."""
    if model is None:
        return f"no second mesh could be made or solved: {100.0 * RELATIVE_ERROR:.0f} % is taken for the model's error"
    x, y, z = 1e3 * model.offset
    return (
        f"model error, by a second mesh of {model.vertices} vertices at {model.n} presses: "
        f"{100.0 * model.relative:.1f} % of the motion, "
        f"{1e3 * model.absolute:.3f} mm at rest, {100.0 * model.force_relative:.1f} % of the force, "
        f"the probe {x:.2f} {y:.2f} {z:.2f} mm beside itself"
    )


def _beside(mesh: TetMesh) -> Array:
    """How far (3,) m beside itself the probe seems to press where no second mesh tells."""
    edges: Array = mesh.nodes[mesh.edges[:, 0]] - mesh.nodes[mesh.edges[:, 1]]
    return OFFSET_ERROR * float(np.median(np.linalg.norm(edges, axis=1))) * np.array([1.0, 1.0, 0.5])


def _always(known: Iterable[Candidate], offset: Candidate | None, beside: Array) -> tuple[Allowed, ...]:
    """Allow for what no experiment knows better, as its card says, and for the elements under the probe, which carry it
    a little beside where it is, in each press anew."""
    sigmas = [(c, np.array([c.info.parameter(x.parameter).known_to for x in c.coordinates])) for c in known]
    allowed = [Allowed(candidate, sigma) for candidate, sigma in sigmas if sigma.any()]
    if offset is not None and beside.any():
        allowed.append(Allowed(offset, beside, per_press=True))
    return tuple(allowed)


def _with_priors(candidates: Mapping[str, Candidate], experiment: Experiment) -> dict[str, Candidate]:
    """Candidates that know which sigma the experiment gives their parameter's declared value."""
    out = dict(candidates)
    for name, candidate in candidates.items():
        for parameter in candidate.info.parameters:
            sigma = experiment.sigma(parameter.stated_by) if parameter.stated_by else None
            if sigma:
                scale = attrgetter(parameter.stated_by)(experiment) if parameter.neutral == 1.0 else 1.0
                out[name] = narrowed(out[name], {parameter.name: sigma / scale})
    return out


__all__ = ["MECHANICAL", "Inputs", "read_inputs", "split"]
