"""Collect what the report of a diagnosis shows, from the closed loop's result."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from livedeform.closed_loop.assessment.held_out import RecordingErrors
from livedeform.closed_loop.assessment.verdict import EVIDENCE, chance, share_of_evidence
from livedeform.closed_loop.candidates import Coordinate, all_effects
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.evidence.measuring_noise import median
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.inference.fitted_model import Added
from livedeform.closed_loop.inference.forward_selection import SelectionStep
from livedeform.common.effect import Parameter
from livedeform.common.experiment.yaml_file import Experiment
from livedeform.common.types import Array
from livedeform.compare_node.residual import Residual
from livedeform.fem_node.model import PhantomModel
from livedeform.outputs import final
from livedeform.report.diagnosis.evidence import Compared, DiagnosisEvidence, FitRow, NoiseRow, RestingBody
from livedeform.report.run.evidence import SurfaceMesh
from livedeform.report.text import words


def evidence_of(result: Diagnosis, experiment: Experiment, out: Path) -> DiagnosisEvidence:
    """Residuals before and after on what was held out, the fit, and how it was found."""
    recordings = [
        Compared(before.name, True, before.start_ns, residuals(before), residuals(after), before.weights)
        for before, after in zip(result.errors_before.recordings, result.errors_after.recordings, strict=True)
    ]
    fitted = out / "experiment.fitted.yaml"
    return DiagnosisEvidence(
        name=experiment.name,
        recordings=recordings,
        infos=all_effects(),
        fit=fit_rows(result),
        correlations=correlations(result),
        body=body_at_rest(experiment),
        facts=[*facts(result), *(("run it", command) for command in commands(result, out))],
        noise=noise_rows(result),
        experiments=[result.proposal.advice] if result.proposal is not None else [],
        configuration=fitted.read_text() if fitted.exists() else "",
    )


def commands(result: Diagnosis, out: Path) -> list[str]:
    """Return how the graph runs the fitted model on what was held out, a command line each, by the names that what is
    in a draft ``out`` will have."""
    lines, out = [], final(out)
    for replay in result.replays:
        after = ["--after", *map(str, replay.after)] if replay.after else []
        words = [str(out / "experiment.fitted.yaml"), "--bag", str(replay.bag), *after, "--out", str(out / "run")]
        lines.append(f"livedeform run {shlex.join(words)}")
    return lines


def residuals(errors: RecordingErrors) -> list[Residual]:
    """The errors of a recording, moment by moment; markers that were not seen or not predicted are left out."""
    out = []
    known = np.isfinite(errors.size)
    for k, stamp in enumerate(errors.stamps_ns):
        seen = known[k]
        ids = errors.ids[seen].astype(np.uint32)
        measured, predicted = errors.measured[k][seen], errors.predicted[k][seen]
        out.append(Residual(int(stamp), ids, measured, predicted, errors.covariances[k][seen]))
    return out


def noise_rows(result: Diagnosis) -> list[NoiseRow]:
    """List the parts of each recording's noise."""
    rows = []
    errors = result.selection.model.uncertain.errors
    for held_out, observations in ((False, result.selection.observations), (True, result.held_out)):
        for o in observations:
            used = float(np.sqrt(np.nanmean(np.trace(o.noise.covariance, axis1=1, axis2=2))))
            relative = np.array([errors.of(i) for i in range(len(o.ids))])
            mesh = float(np.sqrt(np.nanmean((relative * _motion(o)) ** 2)))
            rows.append(NoiseRow(o.name, held_out, o.noise, used, mesh))
    return rows


def _motion(o: Observation) -> Array:
    """Measure how far each marker was from its place at the recording's rest (k, m) m."""
    rest = np.flatnonzero(o.phases == "rest")
    return np.asarray(np.linalg.norm(o.points - median(o.points[rest if len(rest) else [0]]), axis=2))


def body_at_rest(experiment: Experiment) -> RestingBody | None:
    """The declared model at rest; None where it finds no equilibrium."""
    rest = PhantomModel.from_experiment(experiment).rest()
    return RestingBody(SurfaceMesh(rest.surface, rest.triangles), rest.ids, rest.markers) if rest.converged else None


def fit_rows(result: Diagnosis) -> list[FitRow]:
    """Every number of every added effect."""
    rows = []
    bound = at_bound(result)
    for added, effect in zip(result.added, result.effects, strict=False):
        for p in (added.candidate.info.parameter(name) for name in effect.values):
            values = np.atleast_1d(effect.values[p.name])
            sigmas = np.atleast_1d(effect.sigmas.get(p.name, np.full(values.shape, np.nan)))
            starts = np.broadcast_to(np.atleast_1d(np.asarray(p.start, float)), values.shape)
            ends = effect.intervals.get(p.name, np.full((len(values), 2), np.nan)).reshape(-1, 2)
            for i, (value, sigma, start) in enumerate(zip(values, sigmas, starts, strict=True)):
                name = f"{effect.name}.{p.name}" + (f"[{i}]" if p.size is not None else "")
                limits = (*ends_of(added, p, i), name in bound)
                unit = "" if p.unit == "1" else p.unit
                rows.append(
                    FitRow(
                        name,
                        unit,
                        float(value),
                        float(sigma),
                        float(start),
                        *limits,
                        (float(ends[i, 0]), float(ends[i, 1])),
                    )
                )
    return rows


def ends_of(added: Added, parameter: Parameter, index: int) -> tuple[float, float]:
    """Return between which values one number of an effect's parameter is fitted; those of the card where a form makes
    it."""
    for c in added.candidate.coordinates:
        if c.parameter == parameter.name and (c.index or 0) == index:
            low, high = sorted((c.value(c.lower), c.value(c.upper)))
            return low, high
    return parameter.lower, parameter.upper


def at_bound(result: Diagnosis) -> set[str]:
    """Names of fitted coordinates that sit on a bound."""
    return {coordinate_name(added, c) for added, c in result.selection.model.at_bound}


def correlations(result: Diagnosis) -> dict[tuple[str, str], float]:
    """Return the correlations of the fitted coordinates, as far as the last joint fit covers them."""
    fit = result.selection.model.whole_joint
    if fit is None or not result.effects:
        return {}
    names = [coordinate_name(added, c) for added in result.added for c in added.candidate.coordinates]
    return {(names[i], names[j]): float(fit.correlation[i, j]) for i in range(len(names)) for j in range(i)}


def coordinate_name(added: Added, c: Coordinate) -> str:
    """Return a coordinate's name as the table of the fit has it."""
    return f"{added.candidate.name}.{c.parameter}" + (f"[{c.index}]" if c.index is not None else "")


def facts(result: Diagnosis) -> list[tuple[str, str]]:
    """Return what was fitted, held out and counted, step by step, and how long it took."""
    rows = [("fitted", _described(result.selection.observations)), ("held out", _described(result.held_out))]
    rows += [(f"step {number}", said) for number, said in enumerate(_steps(result.selection.steps), 1)]
    if np.isfinite(result.explained):
        rows.append(("explained", f"{share_of_evidence(result.explained)} % of {EVIDENCE}"))
    rows.append(
        (
            "model discrepancy",
            f"{chance(result.discrepancy.p_value)}, {1e3 * result.discrepancy.excess:.3f} mm rms beyond noise",
        )
    )
    rows += [("note", note) for note in result.notes]
    if result.seconds:
        rows.append(("time", f"{result.seconds:.0f} s"))
    return rows


def _steps(steps: Sequence[SelectionStep]) -> list[str]:
    """Return what each step did, and why; by chance alone, where it has a screening of its own."""
    said, last = [], None
    for step in steps:
        text = f"added {words(step.added)}: {step.reason}" if step.added else step.reason
        if step.screening is not last:
            last = step.screening
            text = text if step.added else f"nothing added: {text}"
            text += f"; chance alone: {chance(last.family_p)} over {len(last.scores)} candidates"
        said.append(text)
    return said


def _described(observations: Sequence[Observation]) -> str:
    parts = []
    for o in observations:
        n, effective = int(o.n_frames.sum()), float(o.n_effective.sum())
        parts.append(f"{o.name} ({o.n_moments} key moments of {n} frames, worth {effective:.0f})")
    return "; ".join(parts)
