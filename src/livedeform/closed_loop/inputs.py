"""Read an experiment and its recordings into what the search needs: observations, candidates, uncertainties and a
model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path

import numpy as np

from livedeform.closed_loop.assessment.next_experiment import ProbeReach
from livedeform.closed_loop.candidates import Candidate, catalogue, check_known, narrowed, that_stay
from livedeform.closed_loop.evidence.contacts import contacts_of
from livedeform.closed_loop.evidence.noise import ModelErrors
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.evidence.recordings import Evidence, jolt, names_of, read_evidence
from livedeform.closed_loop.forward import Correction, RefinedMesh
from livedeform.closed_loop.inference.fitted_model import Allowed, Uncertain
from livedeform.closed_loop.model.equilibria import doubtful
from livedeform.closed_loop.model.fem_model import Body, Setting
from livedeform.closed_loop.model.refined_mesh import Accuracy, accuracy
from livedeform.closed_loop.model.workers import FemModel
from livedeform.closed_loop.progress import Tell, silent
from livedeform.closed_loop.settings import AllowanceSettings, Settings
from livedeform.common.bags.recording import Recording
from livedeform.common.checks.recorded import drifts_clock_ns, load_checked
from livedeform.common.effect import Surroundings
from livedeform.common.errors import InputError, MeshError
from livedeform.common.experiment.yaml_file import Experiment, load_experiment
from livedeform.common.frames import make_a_frame, pose_matrix
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.declared import declared_physics
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.mesh.generate import load_or_make_mesh, remeshed
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.stereo_node.camera.setup import declared_camera_pose, rig_of
from livedeform.stereo_node.effects import View


@dataclass(frozen=True)
class Inputs:
    """All that is known before anything is fitted.

    ``places`` (m, 3) m of the markers at rest; ``reach``: where a next experiment may press; ``notes`` for the user;
    ``refined_mesh`` tells the discretisation error of a model with effects; ``settings`` of the method; ``doubts``
    about the model's solutions, a line each.
    """

    fitted: tuple[Observation, ...]
    held_out: tuple[Observation, ...]
    candidates: Mapping[str, Candidate]
    uncertain: Uncertain
    places: Array
    reach: ProbeReach
    notes: tuple[str, ...] = ()
    experiment: Experiment | None = None
    forward: FemModel | None = None
    refined_mesh: RefinedMesh | None = None
    recordings: Mapping[str, Recording] = field(default_factory=dict)
    declared: tuple[EffectValues, ...] = ()
    settings: Settings = field(default_factory=Settings)
    doubts: tuple[str, ...] = ()

    @property
    def element_size(self) -> float:
        """Mean edge of the model's elements, m; 0 for a model without any."""
        return 0.0 if self.forward is None else self.forward.body.element_size

    @property
    def registered(self) -> bool:
        """Return whether the cameras' pose came from the markers at rest."""
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
    settings: Settings | None = None,
) -> Inputs:
    """Read everything from files. Raises ``InputError`` without a recording to fit."""
    settings = settings or Settings()
    # 1. the experiment and the recordings
    experiment, recordings = _load(experiment_path, fit, test, tell)
    names = _candidate_names(candidates, experiment)
    # 2. the model on a mesh that the search can afford, and how the cameras see it
    body, rest = _body(experiment, recordings, len(fit), settings, tell)
    # 3. the evidence: what was measured, at key moments
    evidence = read_evidence(experiment, recordings, len(fit), body.setting.views, settings, tell)
    tell("looking whether each moment has one answer", None)
    doubts = doubtful(body, [*evidence.fitted, *evidence.held_out])
    # 4. the candidates that can act here
    around = _surroundings(experiment, recordings, evidence, body, settings)
    found = _with_priors(catalogue(around, names, experiment.effects), experiment, settings.allowance)
    notes = [*evidence.notes, *_acting_notes(experiment, recordings), *_that_cannot_act(candidates or (), found)]
    # 5. the discretisation error, told by a refined mesh
    known = list(catalogue(around, declared=experiment.effects).values())
    error = _discretisation_error(body, evidence, known, processes, settings, tell)
    # 6. what is uncertain whatever is tried
    uncertain = _uncertain(experiment, body.setting.mesh, rest, known, error, settings.allowance)
    uncertain = replace(uncertain, release=_release_sigma(experiment, recordings))
    return Inputs(
        fitted=evidence.fitted,
        held_out=evidence.held_out,
        candidates=found,
        uncertain=uncertain,
        places=rest,
        reach=_reach(evidence, around, settings),
        notes=(*notes, _accuracy_note(error, settings.allowance)),
        experiment=experiment,
        forward=FemModel(body.setting, processes, body, settings.screening.own_run, settings.allowance.lost),
        refined_mesh=None if error is None else error.anew,
        recordings=recordings,
        declared=tuple(experiment.effects),
        settings=settings,
        doubts=(*_recorded_doubts(recordings), *doubts),
    )


def _recorded_doubts(recordings: Mapping[str, Recording]) -> list[str]:
    """Say why what was recorded may be wrong; what is said of all recordings, once."""
    said: dict[str, list[str]] = {}
    for name, recording in recordings.items():
        for text in dict.fromkeys(recording.doubts):
            said.setdefault(text, []).append(name)
    return [f"{', '.join(names)}: {text}" for text, names in said.items()]


def _load(
    experiment_path: Path, fit: Sequence[Path], test: Sequence[Path], tell: Tell
) -> tuple[Experiment, dict[str, Recording]]:
    """Load the experiment, and its recordings by name, those to fit first."""
    if not fit:
        raise InputError("no recording to fit", where="--fit", remedy="name at least one bag")
    tell("reading the experiment and the recordings", None)
    experiment = load_experiment(experiment_path)
    return experiment, dict(zip(names_of([*fit, *test]), load_checked(fit, test, experiment), strict=True))


def _body(
    experiment: Experiment, recordings: Mapping[str, Recording], n_fit: int, settings: Settings, tell: Tell
) -> tuple[Body, Array]:
    """Mesh the declared model coarsely enough for the search; also its markers' places (m, 3) m at rest."""
    mesh = load_or_make_mesh(experiment.phantom)  # type: ignore[arg-type]  # the schema has a size
    setting = Setting(
        mesh=coarse_enough(mesh, settings.sampling.mesh_vertices, tell),
        element="p2p0",
        physics=declared_physics(experiment),
        declared=tuple(experiment.effects),
        markers=experiment.markers.points,
        still=np.asarray(experiment.markers.kinds) == "support",
        views={},
        clock_start_ns=drifts_clock_ns(experiment, list(recordings.values())[:n_fit]),
    )
    others = {name: experiment.of_recording(recording.own_name) for name, recording in recordings.items()}
    acting = {name: declared_physics(other) for name, other in others.items() if other is not experiment}
    body = Body(replace(setting, acting=acting))
    rest = body.rest()
    places = {name: body.rest(name) if name in acting else rest for name in recordings}
    views = {name: _view(experiment, r, places[name], setting) for name, r in recordings.items()}
    return Body(replace(body.setting, views=views)), rest


def _reach(evidence: Evidence, around: Surroundings, settings: Settings) -> ProbeReach:
    """Find where a next experiment may press."""
    top, depth, _ = contacts_of(evidence.fitted, settings.sampling.depth)
    return ProbeReach(around.lower, around.upper, top, depth)


def _surroundings(
    experiment: Experiment,
    recordings: Mapping[str, Recording],
    evidence: Evidence,
    body: Body,
    settings: Settings,
) -> Surroundings:
    """Gather what decides which effects can act."""
    setting, bare = body.setting, declared_physics(experiment)
    fitted = [r for n, r in recordings.items() if n in {o.name for o in evidence.fitted}]
    views, kinds = setting.views.values(), np.asarray(experiment.markers.kinds)
    return Surroundings(
        physics=apply_effects(bare, experiment.effects),
        bare=bare,
        lower=setting.mesh.nodes.min(axis=0),
        upper=setting.mesh.nodes.max(axis=0),
        markers=experiment.markers.points,
        internal=bool((kinds == "internal").any()),
        support_makes_a_frame=make_a_frame(experiment.markers.points[kinds == "support"]),
        duration=max(float(o.seconds[-1]) for o in evidence.fitted),
        has_probe=experiment.probe is not None and bool(len(fitted[0].poses)),
        contacts=contacts_of(evidence.fitted, settings.sampling.depth)[2],
        has_cameras=all(v.rig is not None and not np.array_equal(v.T_phantom_left, np.eye(4)) for v in views),
        has_release=any(setting.declared_in(name).release > 0.0 for name in recordings),
        has_loads=any(setting.declared_in(name).loads for name in recordings),
        jolt=max(jolt(r.poses, settings.sampling.jolt_window) for r in fitted),
        filmed=experiment.stereo is not None or any(_filmed(r) for r in recordings.values()),
        moments=tuple(float(t) for o in evidence.fitted for t in (o.stamps_ns - setting.clock_start_ns) * 1e-9),
    )


def _filmed(recording: Recording) -> bool:
    """Return whether cameras made the recording."""
    return bool(recording.camera_infos) or recording.camera_pose is not None


def coarse_enough(mesh: TetMesh, vertices: int, tell: Tell = silent) -> TetMesh:
    """Keep the mesh, or take one of about so many ``vertices`` of the same body, kept by content as every mesh is.

    The loop solves thousands of equilibria; what the coarser mesh gets wrong is allowed for as model error.
    """
    if len(mesh.nodes) <= 2.0 * vertices:
        return mesh
    edges = mesh.nodes[mesh.tets[:, 0]] - mesh.nodes[mesh.tets[:, 1]]
    size = float(np.median(np.linalg.norm(edges, axis=1))) * (len(mesh.nodes) / vertices) ** (1.0 / 3.0)
    parameters = {"closed_loop": vertices, "repair": False}
    try:
        coarse = remeshed(mesh, size, parameters, lambda text: tell(f"for the search: {text}", None))
    except MeshError:
        return mesh
    # a curved surface keeps its triangles small, however large a size is asked
    return min(coarse, mesh, key=lambda m: len(m.nodes))


def _candidate_names(candidates: Sequence[str] | None, experiment: Experiment) -> list[str] | None:
    """Name the candidates; None: all. Raises ``InputError`` for those that are declared in a way that no other values
    can be tried of."""
    stay = [name for name in that_stay(experiment.effects) if name in (candidates or ())]
    if stay:
        raise InputError(
            f"other values of '{stay[0]}', as the experiment declares it, cannot be tried",
            where="--candidates",
            remedy="leave it out, or undeclare it",
        )
    return None if candidates is None else check_known(candidates)


def _that_cannot_act(asked: Sequence[str], found: Mapping[str, Candidate]) -> list[str]:
    """Note which effects that were ``asked`` for cannot act in this experiment. Raises ``InputError`` if none can."""
    idle = [name for name in asked if name not in found]
    if idle and not found:
        raise InputError(
            f"none of these can act in this experiment: {', '.join(idle)}",
            where="--candidates",
            remedy="leave the option out, and every effect that can act here is tried",
        )
    return [f"not tried, since it cannot act in this experiment: {', '.join(idle)}"] if idle else []


def _view(experiment: Experiment, recording: Recording, rest: Array, setting: Setting) -> View:
    """Find how the cameras look at the body, as far as experiment and recording say."""
    declared = declared_camera_pose(experiment)
    known = declared or recording.camera_pose
    T = np.eye(4) if known is None else pose_matrix(known)
    rig, markers = rig_of(experiment, recording.camera_infos), experiment.markers
    kinds, clock = np.asarray(markers.kinds), setting.clock_start_ns
    return View(T, rig, rest, markers.ids, kinds, clock, registered=declared is None)


def _discretisation_error(
    body: Body, evidence: Evidence, known: Sequence[Candidate], processes: int, settings: Settings, tell: Tell
) -> Accuracy | None:
    """Compare with a refined mesh; None where none can be made or solved."""
    tell("solving the presses on a refined mesh", None)
    asked = evidence.fitted, evidence.held_out, _like_mesh(known), processes
    return accuracy(body, *asked, settings=settings.discretisation)


def _like_mesh(known: Sequence[Candidate]) -> Candidate | None:
    """Find the candidate that the elements' error under a probe looks like."""
    return next((c for c in known if c.info.like_mesh), None)


def _uncertain(
    experiment: Experiment,
    mesh: TetMesh,
    rest: Array,
    known: Sequence[Candidate],
    model: Accuracy | None,
    settings: AllowanceSettings,
) -> Uncertain:
    """Size everything that is uncertain anyway, by the experiment's sigmas where it has them."""
    stereo, shift, turn = experiment.stereo, settings.shift, settings.turn
    if stereo is not None and not isinstance(stereo.pose, str):
        shift, turn = settings.stated_shift, settings.stated_turn
    sideways = _offset_of(mesh, settings) if model is None else model.offset
    always = _always(known, _like_mesh(known), sideways)
    errors = _model_errors(experiment, rest, model, settings)
    return Uncertain(errors, shift, turn, always, Correction() if model is None else model.correction)


def _release_sigma(experiment: Experiment, recordings: Mapping[str, Recording]) -> float:
    """Return the sigma (s) of when a body was let go, the largest that is stated of any recording; 0 where none is."""
    each = (experiment.of_recording(r.own_name).sigma("timeline.release") for r in recordings.values())
    return max((sigma for sigma in each if sigma is not None), default=0.0)


def _model_errors(
    experiment: Experiment, rest: Array, model: Accuracy | None, settings: AllowanceSettings
) -> ModelErrors:
    """Size the errors of the markers' places and of the model; ``rest`` (m, 3) m are the markers at rest."""
    markers = experiment.markers
    place = np.where(np.isfinite(markers.sigmas), markers.sigmas, settings.place_sigma)
    if model is None or model.correction.points:  # where elements are small under the probe only, the sag's remains
        place = np.hypot(place, settings.rest * np.linalg.norm(rest - markers.points, axis=1))
    if model is None:
        return ModelErrors(place_sigma=place, relative=settings.relative, force_relative=settings.force)
    return ModelErrors(
        place_sigma=place,
        relative=max(model.relative, settings.least),
        local=model.local,
        absolute=model.absolute,
        force_relative=max(settings.force_factor * model.force_relative, settings.least),
    )


def _acting_notes(experiment: Experiment, recordings: Mapping[str, Recording]) -> list[str]:
    """Say of which recordings something else acts than is declared for all."""
    others = {name: experiment.of_recording(recording.own_name) for name, recording in recordings.items()}
    return [f"{name}: {other.acting.text}" for name, other in others.items() if other is not experiment]


def _accuracy_note(model: Accuracy | None, settings: AllowanceSettings) -> str:
    """Say what is allowed for as the model's own error."""
    if model is None:
        return (
            f"no refined mesh could be made or solved: {100.0 * settings.relative:.0f} % is taken for the model's error"
        )
    x, y, z = 1e3 * model.offset
    alike = ""
    if model.unsolved:
        alike = (
            f"; at {model.unsolved} moments that mesh has no answer, and what it tells is taken from those alike: use "
            "elements as small as the radius of the probe's edges"
        )
    return (
        f"model error, by a refined mesh of {model.vertices} vertices at {model.n} presses: "
        f"{100.0 * model.relative:.1f} % of the motion, "
        f"{1e3 * model.absolute:.3f} mm at rest, {100.0 * model.force_relative:.1f} % of the force, "
        f"the probe {x:.2f} {y:.2f} {z:.2f} mm off its place{alike}"
    )


def _offset_of(mesh: TetMesh, settings: AllowanceSettings) -> Array:
    """Size how far (3,) m from itself the probe seems to press where no refined mesh tells."""
    edges: Array = mesh.nodes[mesh.edges[:, 0]] - mesh.nodes[mesh.edges[:, 1]]
    size = float(np.median(np.linalg.norm(edges, axis=1)))
    return size * np.array(settings.offset)


def _always(known: Iterable[Candidate], offset: Candidate | None, sideways: Array) -> tuple[Allowed, ...]:
    """Allow for what no experiment knows better, as its card says, and for the elements under the probe, which carry it
    a little off where it is, in each press anew."""
    sigmas = [(c, np.array([c.info.parameter(x.parameter).known_to for x in c.coordinates])) for c in known]
    allowed = [Allowed(candidate, sigma) for candidate, sigma in sigmas if sigma.any()]
    if offset is not None and sideways.any():
        allowed.append(Allowed(offset, sideways, per_press=True))
    return tuple(allowed)


def _with_priors(
    candidates: Mapping[str, Candidate], experiment: Experiment, settings: AllowanceSettings
) -> dict[str, Candidate]:
    """Let candidates know which sigma the experiment gives their parameter's declared value."""
    out = dict(candidates)
    for name, candidate in candidates.items():
        if name in {e.name for e in experiment.effects}:
            continue  # what an effect says otherwise is not what the sigma is of
        sigmas: dict[str, float] = {}
        for parameter in candidate.info.parameters:
            sigma = experiment.sigma(parameter.stated_by) if parameter.stated_by else None
            if sigma:
                scale = attrgetter(parameter.stated_by)(experiment) if parameter.neutral == 1.0 else 1.0
                sigmas[parameter.name] = sigma / scale
        if sigmas:
            out[name] = narrowed(candidate, sigmas, settings.stated)
    return out
