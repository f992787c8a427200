"""The page of a run: verdict, error over time, on the surface, on the pictures, per marker, worst moments, counts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from livedeform.common.experiment.schema import Experiment
from livedeform.common.types import Array, Image, PredictedMarkers, Wrench
from livedeform.compare_node.judgement import judge
from livedeform.compare_node.metrics import Level, RunMetrics, Statistic, frame_metrics, rmse, run_metrics
from livedeform.compare_node.residual import Residual
from livedeform.report import plots
from livedeform.report.overlay import Overlay, overlays
from livedeform.report.page import Chart, Table, Tile, Verdict, write_page
from livedeform.stereo_node.camera.camera import StereoRig

N_WORST = 5
DEEPEST = "largest deformation"
MM = 1e3


@dataclass(frozen=True)
class Shape:
    """A surface: ``vertices`` (n, 3) m and ``triangles`` (k, 3)."""

    vertices: Array
    triangles: NDArray[np.int64]


@dataclass(frozen=True)
class RunEvidence:
    """What a run's page is made of.

    ``residuals``, ``predictions`` and ``wrenches`` (predicted) in the order of their stamps; ``surfaces`` gives the
    predicted surface nearest to a stamp, ``pictures`` the (left, right) images; ``counts`` are (what, how many, what it
    means) rows, ``facts`` (what, value) rows; ``configuration`` is the effective experiment as YAML.
    """

    start_ns: int
    residuals: Sequence[Residual]
    predictions: Sequence[PredictedMarkers]
    wrenches: Sequence[Wrench] = ()
    surfaces: Callable[[int], Shape | None] = lambda stamp_ns: None
    rig: StereoRig | None = None
    T_phantom_left: Array | None = None
    pictures: Callable[[int], tuple[Image | None, Image | None]] = lambda stamp_ns: (None, None)
    counts: Sequence[tuple[str, str, str]] = ()
    facts: Sequence[tuple[str, str]] = ()
    configuration: str = ""
    metrics: RunMetrics | None = None  # as the run wrote them; None: from the residuals


@dataclass(frozen=True)
class Moment:
    """A moment of the run that is worth looking at; ``shape`` is the predicted surface, where it was recorded."""

    name: str
    residual: Residual
    shape: Shape | None


@dataclass(frozen=True)
class _Run:
    """A run with everything that several parts of the page need."""

    evidence: RunEvidence
    experiment: Experiment
    metrics: RunMetrics
    seconds: Array = field(repr=False)  # (f,) of the residuals, since the start
    per_frame: Array = field(repr=False)  # (f,) rmse, m

    @property
    def threshold(self) -> float:
        return self.experiment.thresholds.error


def write_run_page(path: Path, evidence: RunEvidence, experiment: Experiment) -> Path:
    """Write the page of a run to ``path``."""
    residuals = [r for r in evidence.residuals if len(r.ids)]
    run = _Run(
        evidence,
        experiment,
        evidence.metrics or run_metrics(residuals, experiment.thresholds.error),
        np.array([(r.stamp_ns - evidence.start_ns) * 1e-9 for r in residuals]),
        np.array([rmse(r.distances) for r in residuals]),
    )
    moments = interesting_moments(residuals, evidence)
    over_time = _over_time(run, residuals, moments)
    on_surface = _on_surface(run, moments)
    per_marker = _per_marker(run)
    pictures = _pictures(run, moments)
    return write_page(
        path,
        "run.html.j2",
        title=experiment.name,
        kind="run report",
        charts=[c for c in (over_time, on_surface, per_marker) if c],
        subtitle=_subtitle(run),
        verdict=_verdict(run),
        tiles=_tiles(run),
        over_time=over_time,
        on_surface=on_surface,
        states=list(dict.fromkeys(t.meta for t in on_surface.figure.data)) if on_surface else [],
        per_marker=per_marker,
        marker_table=_marker_table(run),
        pictures=pictures,
        moments=[name for name, _ in pictures],
        pictures_caption=_pictures_caption(pictures),
        worst=_worst_table(run, residuals),
        counts=Table(("what", "count", "what it means"), tuple(evidence.counts), numbers=(1,)),
        run_table=Table(("what", "value"), tuple(evidence.facts)),
        configuration=evidence.configuration,
    )


def interesting_moments(residuals: Sequence[Residual], evidence: RunEvidence) -> list[Moment]:
    """At rest (the first), the deepest press or largest sag, and the largest error; one moment can be several."""
    if not residuals:
        return []
    moved = [_moved(r, residuals[0]) for r in residuals]
    errors = [rmse(r.distances) for r in residuals]
    chosen = {"at rest": 0, DEEPEST: int(np.argmax(moved)), "largest error": int(np.argmax(errors))}
    moments: list[Moment] = []
    for k in dict.fromkeys(chosen.values()):
        name = ", ".join(label for label, at in chosen.items() if at == k)
        moments.append(Moment(name, residuals[k], evidence.surfaces(residuals[k].stamp_ns)))
    return moments


def _moved(now: Residual, first: Residual) -> float:
    """Rms displacement (m) of the predicted markers that both moments have."""
    _, rows, columns = np.intersect1d(now.ids, first.ids, return_indices=True)
    return rmse(np.linalg.norm(now.predicted[rows] - first.predicted[columns], axis=1)) if len(rows) else 0.0


def mm(value: float, digits: int = 2) -> str:
    """A length in m as text in millimetres; a dash where there is none."""
    return f"{value * MM:.{digits}f}" if np.isfinite(value) else "–"


def interval(statistic: Statistic) -> str:
    """The 95 % interval of a length in millimetres."""
    if not np.isfinite(statistic.low):
        return "too few frames for an interval"
    return f"95 %: {mm(statistic.low)} to {mm(statistic.high)}"


TONES = {Level.OK: "good", Level.WARN: "warn", Level.ERROR: "bad", Level.STALE: "neutral"}


def _verdict(run: _Run) -> Verdict:
    judgement = judge(run.metrics)
    return Verdict(TONES[judgement.level], judgement.said, judgement.because)


def _tiles(run: _Run) -> list[Tile]:
    m = run.metrics
    floor = f"noise alone: {mm(m.noise_floor)}" if np.isfinite(m.noise_floor) else "no covariances recorded"
    return [
        Tile("rmse", mm(m.rmse.value), "mm", interval(m.rmse)),
        Tile("mean error", mm(m.mean.value), "mm", interval(m.mean)),
        Tile("95th percentile", mm(m.p95.value), "mm", interval(m.p95)),
        Tile("largest error", mm(m.max), "mm", floor),
        Tile("errors", f"{m.n}", "", f"{m.n_frames} frames, worth {m.n_effective:.0f} independent ones"),
        *_coverage_tiles(m),
    ]


def _coverage_tiles(m: RunMetrics) -> list[Tile]:
    c = m.coverage
    if c is None:
        return []
    share = f"{100 * m.relative:.0f}" if np.isfinite(m.relative) else "–"
    pressed = f"{c.presses_compared} of {c.presses} presses, {c.deepest_compared} of {c.deepest} deepest moments"
    return [
        Tile("compared", f"{c.frames_compared} of {c.frames_measured}", "frames", pressed),
        Tile("error over motion", share, "%", f"the markers moved {mm(c.motion_rms)} mm rms"),
    ]


def _subtitle(run: _Run) -> str:
    length = f"{run.seconds[-1] - run.seconds[0]:.1f} s" if len(run.seconds) else "no frames"
    effects = ", ".join(e.name for e in run.experiment.effects) or "none"
    return f"{length} compared, {len(run.metrics.markers)} markers; effects in the model: {effects}"


def _over_time(run: _Run, residuals: Sequence[Residual], moments: Sequence[Moment]) -> Chart | None:
    if not residuals:
        return None
    frames = [frame_metrics(r, run.threshold) for r in residuals]

    def line(name: str, key: str, colour: str, dash: str = "solid") -> plots.Line:
        return plots.Line(name, run.seconds, np.array([getattr(f, key) for f in frames]) * MM, colour, dash)

    lines = [
        line("max", "max", plots.SKY),
        line("95th percentile", "p95", plots.ORANGE),
        line("rmse", "rmse", plots.BLUE),
    ]
    floor = np.array([f.noise_floor for f in frames])
    if np.isfinite(floor).any():
        lines.append(line("measuring noise alone", "noise_floor", plots.GREY, "dot"))
    marks = {m.name: (m.residual.stamp_ns - run.evidence.start_ns) * 1e-9 for m in moments}
    figure = plots.error_over_time(lines, run.threshold, marks, _what_happens(run, residuals))
    caption = (
        f"Error of the {len(run.metrics.markers)} markers in each of {len(residuals)} frames; threshold "
        f"{run.threshold * MM:g} mm. Below: what the model was doing at that time."
    )
    return Chart("over-time", figure, caption)


def _what_happens(run: _Run, residuals: Sequence[Residual]) -> plots.Line:
    """The predicted force of the probe, or without one how far the predicted markers have moved."""
    wrenches = run.evidence.wrenches
    force = np.array([np.linalg.norm(w.force) for w in wrenches])
    if np.nanmax(force, initial=0.0) > 0.0:
        seconds = np.array([(w.stamp_ns - run.evidence.start_ns) * 1e-9 for w in wrenches])
        return plots.Line("probe force (N)", seconds, force, plots.GREEN)
    moved = np.array([_moved(r, residuals[0]) for r in residuals])
    return plots.Line("markers moved (mm)", run.seconds, moved * MM, plots.GREEN)


def _on_surface(run: _Run, moments: Sequence[Moment]) -> Chart | None:
    with_surface = [(m, m.shape) for m in moments if m.shape is not None]
    if not with_surface:
        return None
    overall = {m.id: m.rmse for m in run.metrics.markers}
    largest, shape = max(with_surface, key=lambda pair: DEEPEST in pair[0].name)
    whole = np.array([overall.get(int(i), np.nan) for i in largest.residual.ids])
    states = [_state("whole run (rms)", largest.residual, shape, whole)]
    states += [_state(m.name, m.residual, s, m.residual.distances) for m, s in with_surface]
    highest = max(float(np.nanmax(s.error)) for s in states)
    size = float(np.ptp(shape.vertices, axis=0).max())
    arrows = max(1.0, float(np.floor(0.15 * size / highest))) if highest > 0 else 1.0
    arrows = float(min(arrows, 20.0))
    caption = (
        "Colour: error, spread between the markers; grey where no marker is near. Lines run from the predicted to the "
        f"measured marker, drawn {arrows:g} times longer. One colour scale for all tabs, up to {mm(highest)} mm."
    )
    return Chart("on-surface", plots.surface_map(states, highest, arrows), caption, tall=True)


def _state(name: str, r: Residual, shape: Shape, error: Array) -> plots.SurfaceState:
    return plots.SurfaceState(name, shape.vertices, shape.triangles, r.ids, r.predicted, r.measured, error)


def _per_marker(run: _Run) -> Chart | None:
    markers = run.metrics.markers
    if not markers:
        return None
    ids = np.array([m.id for m in markers], dtype=np.uint32)
    half = np.array([_half_width(run, int(i)) for i in ids])
    figure = plots.error_per_marker({"rms error": (ids, np.array([m.rmse for m in markers]), half)})
    caption = (
        "Root mean square error of each marker over the run. Whiskers: 95 % interval, from its changes over "
        f"{run.metrics.n_effective:.0f} effective frames."
    )
    return Chart("per-marker", figure, caption)


def _half_width(run: _Run, marker: int) -> float:
    """Half the 95 % interval (m) of a marker's rms error, frames counted by their effective number.

    First order from the mean square: sigma(rms) = sigma(d^2) / (2 rms sqrt(n_effective)).
    """
    squares = np.array([float(q) for r in run.evidence.residuals for q in r.distances[r.ids == marker] ** 2])
    if len(squares) < 2 or not squares.any():
        return float("nan")
    n_effective = max(1.0, run.metrics.n_effective * len(squares) / max(run.metrics.n_frames, 1))
    return 1.96 * float(squares.std() / (2.0 * np.sqrt(squares.mean() * n_effective)))


def _marker_table(run: _Run) -> Table:
    rows = tuple(
        (str(m.id), str(m.n), mm(m.rmse, 3), mm(m.max, 3), *(mm(b, 3) for b in m.bias), mm(m.scatter, 3))
        for m in sorted(run.metrics.markers, key=lambda m: -m.rmse)
    )
    header = ("marker", "frames", "rms (mm)", "max (mm)", "bias x (mm)", "bias y (mm)", "bias z (mm)", "scatter (mm)")
    return Table(header, rows, numbers=tuple(range(1, 8)))


def _worst_table(run: _Run, residuals: Sequence[Residual]) -> Table | None:
    """The frames with the largest rmse, at least a twentieth of the recording apart."""
    if not residuals:
        return None
    apart = 0.05 * (run.seconds[-1] - run.seconds[0])
    chosen: list[int] = []
    for k in np.argsort(run.per_frame)[::-1]:
        if all(abs(run.seconds[k] - run.seconds[j]) >= apart for j in chosen):
            chosen.append(int(k))
        if len(chosen) == N_WORST:
            break
    rows = []
    for k in chosen:
        r = residuals[k]
        worst = int(np.argmax(r.distances))
        e = r.errors[worst]
        rows.append(
            (f"{run.seconds[k]:.2f}", mm(run.per_frame[k]), mm(r.distances[worst]), str(r.ids[worst]),
             f"({mm(e[0])}, {mm(e[1])}, {mm(e[2])})", str(len(r.ids)))
        )  # fmt: skip
    header = ("time (s)", "rmse (mm)", "largest (mm)", "at marker", "its error x, y, z (mm)", "markers")
    return Table(header, tuple(rows), numbers=(0, 1, 2, 3, 5))


def _pictures(run: _Run, moments: Sequence[Moment]) -> list[tuple[str, list[Overlay]]]:
    evidence = run.evidence
    if evidence.rig is None or evidence.T_phantom_left is None:
        return []
    shown = []
    for moment in moments:
        left, right = evidence.pictures(moment.residual.stamp_ns)
        r, shape = moment.residual, moment.shape or Shape(np.empty((0, 3)), np.empty((0, 3), np.int64))
        laid = overlays(
            moment.name, left, right, evidence.rig, evidence.T_phantom_left,
            shape.vertices, shape.triangles, r.measured, r.predicted,
        )  # fmt: skip
        if laid:
            shown.append((moment.name, laid))
    return shown


def _pictures_caption(pictures: Sequence[tuple[str, Sequence[Overlay]]]) -> str:
    if not pictures:
        return ""
    size = pictures[0][1][0].mm_per_px
    return (
        "The recorded pictures as they came, cut to the body; the prediction is projected with the calibration. "
        f"One recorded pixel is about {size:.2f} mm at the markers."
    )


def describe_counts(counts: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Rows for the page of ``metrics.json``'s counts."""
    rows = []
    for key, value in counts.items():
        if isinstance(value, Mapping) and not value:
            rows.append((_words(key), "0", MEANING.get(key, "")))
        elif isinstance(value, Mapping):
            rows += [(f"{key}: {name}", text, why) for name, text, why in describe_counts(value)]
        elif isinstance(value, list):
            rows.append((_words(key), str(len(value)), ", ".join(map(str, value[:20])) or MEANING.get(key, "")))
        elif isinstance(value, int | float | str):
            rows.append((_words(key), f"{value:g}" if isinstance(value, float) else str(value), MEANING.get(key, "")))
    return rows


MEANING = {
    "measured_frames": "frames with measured markers",
    "predicted_frames": "frames of the model",
    "predicted_not_converged": "frames for which the model found no equilibrium; they match nothing",
    "matched_frames": "measured frames that were compared",
    "refused_extrapolation": "measured before the first or after the last prediction",
    "refused_gap": "between predictions too far apart to interpolate",
    "refused_not_converged": "beside a prediction that did not converge",
    "refused_out_of_order": "measured and predicted frames whose stamps ran backwards or jumped",
    "predicted_out_of_order": "predicted ones among them",
    "dropped_waiting": "waited too long for a prediction",
    "matched_markers": "single errors",
    "lost_messages": "published, but not received (from gaps in the publishers' numbers)",
    "measured_without_prediction": "measured markers that the model did not predict",
    "predicted_without_measurement": "predicted markers that were not seen (occluded, or not found)",
    "frames_without_common_marker": "measured frames none of whose markers the model knows",
    "predicted": "frames that the model was asked for",
    "not_converged": "no equilibrium was found; published as such",
    "skipped": "poses overtaken by a newer one while the model was solving",
    "unfinished": "poses that the model was still solving when the run ended",
    "pairs": "pairs of pictures",
    "unpaired": "pictures without a partner of the other camera",
    "unknown_ids": "ids that the experiment does not know",
    "never_measured_ids": "markers of the experiment that were never seen",
}


def _words(key: str) -> str:
    return key.replace("_", " ")
