"""The interactive charts of a run, and the pictures with the prediction over them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livedeform.common.types import Array, Ids
from livedeform.compare_node.metrics import frame_metrics
from livedeform.compare_node.residual import Residual, tabulate
from livedeform.report import plots
from livedeform.report.overlay import Overlay, overlays
from livedeform.report.page import Chart
from livedeform.report.playback import figure as playback_figure
from livedeform.report.run.evidence import SurfaceMesh
from livedeform.report.run.moments import DEEPEST, NotableMoment, distance_moved
from livedeform.report.run.summary import RunSummary
from livedeform.report.text import MM, mm


def over_time_chart(run: RunSummary, residuals: Sequence[Residual], moments: Sequence[NotableMoment]) -> Chart | None:
    if not residuals:
        return None
    frames = [frame_metrics(r, run.threshold) for r in residuals]

    def line(name: str, key: str, colour: str, dash: str = "solid") -> plots.Line:
        values = np.array([getattr(f, key) for f in frames]) * MM
        return plots.Line(name, run.seconds, values, colour, dash, np.array([f.n for f in frames]))

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


def distance_chart(run: RunSummary) -> Chart | None:
    """Draw how far points without ids lay from the predicted surface, over time."""
    found = run.evidence.distances
    if not found or run.metrics.surface is None:
        return None
    seconds = (found["stamp_ns"] - run.evidence.start_ns) * 1e-9
    kinds = (("95th percentile", "p95", plots.ORANGE), ("rms", "rmse", plots.BLUE),
             ("signed mean, outside is positive", "bias", plots.GREEN))  # fmt: skip
    lines = [plots.Line(name, seconds, found[key] * MM, colour) for name, key, colour in kinds]
    said = run.metrics.surface.text
    return Chart("distance", plots.error_over_time(lines, run.threshold, {}), f"{said[:1].upper()}{said[1:]}.")


def _what_happens(run: RunSummary, residuals: Sequence[Residual]) -> plots.Line:
    """The predicted force of the probe, or without one how far the predicted markers have moved."""
    wrenches = run.evidence.wrenches
    force = np.array([np.linalg.norm(w.force) for w in wrenches])
    if np.nanmax(force, initial=0.0) > 0.0:
        seconds = np.array([(w.stamp_ns - run.evidence.start_ns) * 1e-9 for w in wrenches])
        return plots.Line("probe force (N)", seconds, force, plots.GREEN)
    moved = np.array([distance_moved(r, residuals[0]) for r in residuals])
    return plots.Line("markers moved (mm)", run.seconds, moved * MM, plots.GREEN)


def on_surface_chart(run: RunSummary, moments: Sequence[NotableMoment]) -> Chart | None:
    with_surface = [(m, m.shape) for m in moments if m.shape is not None]
    if not with_surface:
        return None
    overall = {m.id: m.rmse for m in run.metrics.markers}
    largest, shape = max(with_surface, key=lambda pair: DEEPEST in pair[0].name)
    whole = np.array([overall.get(int(i), np.nan) for i in largest.residual.ids])
    states = [_state("whole run (rms)", largest.residual, shape, whole)]
    states += [_state(m.name, m.residual, s, m.residual.distances) for m, s in with_surface]
    highest = max(float(np.nanmax(s.error)) for s in states)
    arrows = _longer(shape.vertices, highest)
    caption = (
        "Colour: error, spread between the markers; grey where no marker is near. Lines run from the predicted to the "
        f"measured marker, drawn {arrows:g} times longer. One colour scale for all tabs, up to {mm(highest)} mm."
    )
    return Chart("on-surface", plots.surface_map(states, highest, arrows), caption, tall=True)


def _longer(surface: Array, highest: float) -> float:
    """Return how many times longer errors are drawn, so that the largest (m) shows beside the surface (n, 3) m; 20 at
    most."""
    size = float(np.ptp(surface, axis=0).max()) if len(surface) else 0.0
    return float(np.clip(np.floor(0.15 * size / highest), 1.0, 20.0)) if highest > 0 else 1.0


def playback_chart(run: RunSummary) -> Chart | None:
    """The run over time; None where no surface was recorded."""
    playback = run.evidence.playback()
    if playback is None or not len(playback.triangles):
        return None
    highest = max(float(m.residual.distances.max()) for m in playback.moments)
    arrows = _longer(playback.moments[0].surface, highest)
    caption = (
        f"{len(playback.moments)} moments of the run. Green: where the predicted surface touches the probe. Lines run "
        f"from the predicted to the measured marker, drawn {arrows:g} times longer."
    )
    return Chart("playback", playback_figure(playback, arrows), caption, tall=True)


def _state(name: str, r: Residual, shape: SurfaceMesh, error: Array) -> plots.SurfaceState:
    return plots.SurfaceState(name, shape.vertices, shape.triangles, r.ids, r.predicted, r.measured, error)


def per_marker_chart(run: RunSummary) -> Chart | None:
    markers = run.metrics.markers
    if not markers:
        return None
    ids = np.array([m.id for m in markers], dtype=np.uint32)
    half = _half_widths(run, ids)
    rms, n = np.array([m.rmse for m in markers]), np.array([m.n for m in markers])
    figure = plots.error_per_marker({"rms error": plots.Bars(ids, rms, half, n)})
    caption = (
        "Root mean square error of each marker over the run. Whiskers: 95 % interval, from its changes over "
        f"{run.metrics.n_effective:.0f} effective frames."
    )
    return Chart("per-marker", figure, caption)


def _half_widths(run: RunSummary, markers: Ids) -> Array:
    """Return half the 95 % interval (m,) m of each marker's rms error, frames counted by their effective number; NaN of
    fewer than two, and of none that errs.

    First order from the mean square: sigma(rms) = sigma(d^2) / (2 rms sqrt(n_effective)).
    """
    table = tabulate([r for r in run.evidence.residuals if len(r.ids)])
    squares, ids = table.distances**2, np.unique(table.ids)
    row = np.searchsorted(ids, table.ids)
    n = np.bincount(row, minlength=len(ids))
    mean = np.bincount(row, squares, len(ids)) / n
    spread = np.sqrt(np.bincount(row, (squares - mean[row]) ** 2, len(ids)) / n)
    n_effective = np.maximum(1.0, run.metrics.n_effective * n / max(run.metrics.n_frames, 1))
    known = (n > 1) & (mean > 0.0)
    half = np.full(len(ids), np.nan)
    half[known] = 1.96 * spread[known] / (2.0 * np.sqrt(mean[known] * n_effective[known]))
    at = dict(zip(ids.tolist(), half.tolist(), strict=True))
    return np.array([at.get(int(marker), np.nan) for marker in markers])


def overlaid_pictures(run: RunSummary, moments: Sequence[NotableMoment]) -> list[tuple[str, list[Overlay]]]:
    evidence = run.evidence
    if evidence.rig is None or evidence.T_phantom_left is None:
        return []
    shown = []
    for moment in moments:
        left, right = evidence.pictures(moment.residual.stamp_ns)
        r, shape = moment.residual, moment.shape or SurfaceMesh(np.empty((0, 3)), np.empty((0, 3), np.int64))
        laid = overlays(
            moment.name, left, right, evidence.rig, evidence.T_phantom_left,
            shape.vertices, shape.triangles, r.measured, r.predicted,
        )  # fmt: skip
        if laid:
            shown.append((moment.name, laid))
    return shown


def pictures_caption(pictures: Sequence[tuple[str, Sequence[Overlay]]]) -> str:
    if not pictures:
        return ""
    size = pictures[0][1][0].mm_per_px
    return (
        "The recorded pictures as they came, cut to the body; the prediction is projected with the calibration. "
        f"One recorded pixel is about {size:.2f} mm at the markers."
    )
