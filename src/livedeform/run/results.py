"""``metrics.json`` and ``markers.csv`` of a run, from what was recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags.recording import Recording, Repeats, load_recording
from livedeform.common.checks.finding import Finding
from livedeform.common.experiment.yaml_file import Experiment
from livedeform.common.types import Array
from livedeform.compare_node.at_rest import at_rest
from livedeform.compare_node.coverage import Coverage, cover
from livedeform.compare_node.interpolation import Interpolated
from livedeform.compare_node.judgement import judge
from livedeform.compare_node.metrics import RunMetrics, Statistic, run_metrics
from livedeform.compare_node.places import with_places
from livedeform.compare_node.residual import Residual
from livedeform.compare_node.surface_error import SURFACE_CSV
from livedeform.comparing.takes import Take, with_repeats
from livedeform.outputs import write_json
from livedeform.report.run.read import residuals_of
from livedeform.report.text import OF_THIS_RECORDING, WITH_PLACES
from livedeform.run.said import Said, stereo_said
from livedeform.run.surfaces import compare_surfaces, write_surface_csv

COLUMNS = (
    "stamp_ns", "seconds", "id", "measured_x", "measured_y", "measured_z", "predicted_x", "predicted_y", "predicted_z",
    "error_x", "error_y", "error_z", "error", "sigma",
)  # fmt: skip
LINE_END = "\r\n"  # RFC 4180
ROW = ",".join(["%d", "%s", "%d", *10 * ["%.9g"], "%s"]) + LINE_END


def write_results(
    out: Path,
    experiment: Experiment,
    counts: Mapping[str, Any],
    start_ns: int,
    interpolated: Interpolated,
    about: Mapping[str, Any],
    findings: Sequence[Finding] = (),
    recording: Recording | None = None,
    repeats: Sequence[Take] = (),
) -> RunMetrics:
    """Both files, from ``out/run.mcap``; ``about`` goes into the JSON's head. They are the same for the same run.

    ``findings`` about the inputs and what the stereo node says keep the verdict from being OK where they doubt it, and
    make it STALE where they are errors. ``recording`` is ``out/run.mcap`` if that is loaded; ``repeats``: other takes.
    """
    recording = recording or load_recording(out / "run.mcap", experiment)
    residuals = residuals_of(recording)
    metrics = with_places(run_metrics(residuals, experiment.thresholds.error), residuals, experiment.markers)
    surfaces = compare_surfaces(out / "run.mcap")
    said = stereo_said(out / "run.mcap")
    counts, findings = with_reasons(counts, said), [*findings, *said.findings]
    metrics = replace(
        metrics,
        interpolation_bound=interpolated.largest,
        interpolation_judged=interpolated.judged,
        coverage=_coverage(recording, residuals, metrics.noise_floor, counts, bool(about.get("interrupted"))),
        doubts=doubts_of(findings),
        wrong=tuple(dict.fromkeys(f.text for f in findings if f.level == "ERROR")),
        rest=at_rest(residuals, experiment.markers, _elements_error(about), recording.predicted_wrenches),
        surface=replace(surfaces[0], registration=_registration(about)) if surfaces is not None else None,
        mesh=tuple((about.get("mesh") or {}).get("report", ())),
    )
    takes = with_repeats(metrics, Path(str(about.get("bag", ""))).stem, repeats)
    metrics = replace(metrics, level=judge(metrics).level, takes=takes)
    write_json(out / "metrics.json", dict(about) | metrics_document(metrics) | {"counts": counts})
    write_markers(out / "markers.csv", residuals, start_ns)
    if surfaces is not None:
        write_surface_csv(out / SURFACE_CSV, surfaces[1])
    return metrics


def with_reasons(counts: Mapping[str, Any], said: Said) -> dict[str, Any]:
    """Return the nodes' counts with what the stereo node ``said`` against its own measurement."""
    if not said.times:
        return dict(counts)
    return dict(counts) | {"stereo": {**(counts.get("stereo") or {}), "reasons": said.reasons}}


def _registration(about: Mapping[str, Any]) -> float:
    """Return by how much (m, one sigma) the pose of points without ids may move them; NaN where nobody says it."""
    return float((about.get("registration") or {}).get("sigma_m", "nan"))


def _elements_error(about: Mapping[str, Any]) -> float:
    """Return by how much (m, rms) the model's elements get the markers wrong; 0 where that is not told."""
    error = ((about.get("mesh") or {}).get("discretisation") or {}).get("rms", 0.0)
    return float(error) if np.isfinite(error) else 0.0


def _coverage(
    recording: Recording, residuals: Sequence[Residual], noise: float, counts: Mapping[str, Any], interrupted: bool
) -> Coverage:
    """Count what became of every measured frame, from the recording and the nodes' counts."""
    inputs, association, model = (counts.get(key) or {} for key in ("inputs", "association", "model"))
    pictures = max(inputs.get(topic, 0) for topic in (*t.IMAGES, *t.COMPRESSED_IMAGES))
    markers = max(inputs.get(topic, 0) for topic in (t.STEREO_MARKERS, t.STEREO_MARKERS_RAW))
    heard = association.get("measured_frames", len(recording.marker_frames))
    repeats = recording.repeats.get(t.STEREO_MARKERS, Repeats())  # a moment counts once, however often it was sent
    n_measured = max(pictures or markers - repeats.n, heard - repeats.n)
    refused = {
        "extrapolation": association.get("refused_extrapolation", 0),
        "gap": association.get("refused_gap", 0),
        "not_converged": association.get("refused_not_converged", 0),
        "out_of_order": association.get("refused_out_of_order", 0) - association.get("predicted_out_of_order", 0),
        "no_common_marker": association.get("frames_without_common_marker", 0),
        "waiting": association.get("dropped_waiting", 0),
        "unpaired": n_measured - heard + repeats.n if pictures else 0,
    }
    return cover(
        recording.marker_frames,
        residuals,
        n_measured=n_measured,
        repeated=repeats.left_out,
        noise=noise,
        skipped=model.get("skipped", 0),
        refused=refused,
        traffic=counts.get("traffic", {}).values(),
        interrupted=interrupted,
        reasons=model.get("reasons"),
    )


def doubts_of(findings: Sequence[Finding]) -> tuple[str, ...]:
    """Return what keeps a run's verdict from being OK: not that of measured forces, which it does not read."""
    return tuple(dict.fromkeys(f.text for f in findings if f.doubts and not f.of_forces and f.level != "ERROR"))


def metrics_document(metrics: RunMetrics) -> dict[str, Any]:
    """``metrics.json``: lengths in m, ``interval_95`` the 95 % intervals of the values in ``error``, and what they are
    of."""
    statistics: dict[str, Statistic] = {"rmse": metrics.rmse, "mean": metrics.mean, "p95": metrics.p95}
    error = {name: s.value for name, s in statistics.items()} | {"max": metrics.max, "n": metrics.n}
    judgement = judge(metrics)
    return {
        "version": 1,
        "unit": "m",
        "verdict": str(judgement.level),
        "reason": judgement.sentence,
        "coverage": asdict(metrics.coverage) if metrics.coverage is not None else None,
        "error_over_motion": metrics.relative,
        "doubts": list(metrics.doubts),
        "wrong": list(metrics.wrong),
        "threshold": metrics.threshold,
        "error": error,
        "interval_of": OF_THIS_RECORDING + (WITH_PLACES if metrics.places else ""),
        "interval_95": {name: [s.low, s.high] for name, s in statistics.items()},
        "next_take": metrics.takes.as_dict() if metrics.takes is not None else None,
        "surface_error": metrics.surface.as_dict() if metrics.surface is not None else None,
        "n_frames": metrics.n_frames,
        "n_effective": metrics.n_effective,
        "noise_floor": metrics.noise_floor,
        "places": metrics.places,
        "rest": [asdict(r) | {"contradicts": r.contradicts, "text": r.text} for r in metrics.rest],
        "interpolation_bound": metrics.interpolation_bound,
        "interpolation_judged": metrics.interpolation_judged,
        "worst_stamp_ns": metrics.worst_stamp_ns,
        "markers": [asdict(marker) for marker in metrics.markers],
    }


def write_markers(path: Path, residuals: Sequence[Residual], start_ns: int) -> None:
    """``markers.csv``: one row per marker and frame, SI; ``sigma`` (m) is sqrt(tr C / 3) of the measurement."""
    with path.open("w", newline="") as file:
        file.write(",".join(COLUMNS) + LINE_END)
        for r in residuals:
            seconds = f"{(r.stamp_ns - start_ns) * 1e-9:.9g}"
            numbers = np.column_stack([r.measured, r.predicted, r.errors, r.distances]).tolist()
            for marker, row, variance in zip(r.ids.tolist(), numbers, _variances(r).tolist(), strict=True):
                sigma = f"{variance**0.5:.4g}" if variance >= 0 else ""
                file.write(ROW % (r.stamp_ns, seconds, marker, *row, sigma))


def _variances(residual: Residual) -> Array:
    """The mean variance (n,) m2 of a coordinate; NaN where it is not known."""
    return np.asarray(residual.covariances.trace(axis1=1, axis2=2) / 3)
