"""The interactive charts of a diagnosis: errors before and after, and the ranking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from livedeform.common.types import Array, Ids
from livedeform.compare_node.metrics import rmse
from livedeform.compare_node.residual import Residual, tabulate
from livedeform.report import plots
from livedeform.report.diagnosis.evidence import Compared, RestingBody
from livedeform.report.diagnosis.tables import rivals_in
from livedeform.report.page import Chart
from livedeform.report.text import MM, words


def over_time_chart(recordings: Sequence[Compared]) -> list[Chart]:
    charts = []
    highest = max((rmse(r.distances) for c in recordings for r in (*c.before, *c.after) if len(r.ids)), default=0.0)
    for number, recording in enumerate(recordings):
        lines = [
            _line("before", recording, recording.before, plots.ORANGE),
            _line("after", recording, recording.after, plots.BLUE),
        ]
        figure = plots.error_over_time(lines, None, {})
        figure.update_yaxes(range=[0.0, 1.05 * highest * MM])
        role = "held out: nothing was fitted to it" if recording.held_out else "used for fitting"
        charts.append(Chart(f"over-time-{number}", figure, f"{recording.name} ({role}): rmse of each moment."))
    return charts


def _line(name: str, recording: Compared, residuals: Sequence[Residual], colour: str) -> plots.Line:
    """The rmse of each moment (mm), which counts by its time and markers."""
    kept = [(r, w) for r, w in zip(residuals, recording.weights, strict=True) if len(r.ids)]
    seconds = np.array([(r.stamp_ns - recording.start_ns) * 1e-9 for r, _ in kept])
    values = np.array([rmse(r.distances) for r, _ in kept]) * MM
    return plots.Line(name, seconds, values, colour, weights=np.array([w * len(r.ids) for r, w in kept]))


@dataclass(frozen=True)
class _MarkerErrors:
    """The errors of each marker over all moments, each weighted with its time: ``ids`` (m,), ``rms`` (m,) m, ``mean``
    (m, 3) m and ``seconds`` (m,) that they stand for."""

    ids: Ids
    rms: Array
    mean: Array
    seconds: Array


def _marker_errors(recordings: Sequence[Compared], after: bool) -> _MarkerErrors:
    table = tabulate([r for c in recordings for r in (c.after if after else c.before)])
    weights = np.concatenate([c.weights for c in recordings])[table.frame]
    ids, row = np.unique(table.ids, return_inverse=True)

    def per_marker(values: Array) -> Array:
        return np.asarray(np.bincount(row, values), float)

    seconds = per_marker(weights)
    share = weights / seconds[row]
    square = per_marker(share * table.distances**2)
    mean = np.stack([per_marker(share * e) for e in table.errors.T], axis=1)
    return _MarkerErrors(ids, np.sqrt(square), mean, seconds)


def per_marker_chart(recordings: Sequence[Compared]) -> Chart | None:
    if not any(len(r.ids) for c in recordings for r in c.before):
        return None
    groups = {}
    for name, after in (("before", False), ("after", True)):
        e = _marker_errors(recordings, after)
        groups[name] = plots.Bars(e.ids, e.rms, np.full(len(e.ids), np.nan), e.seconds)
    figure = plots.error_per_marker(groups, (plots.ORANGE, plots.BLUE))
    return Chart("per-marker", figure, "Root mean square error of each marker on the held-out recordings.")


def on_surface_chart(recordings: Sequence[Compared], body: RestingBody | None) -> Chart | None:
    """Rms errors as colours and mean errors as lines, before and after, drawn on the body at rest."""
    if body is None or not any(len(r.ids) for c in recordings for r in c.before):
        return None
    states = []
    for name, after in (("before", False), ("after", True)):
        e = _marker_errors(recordings, after)
        _, at, row = np.intersect1d(body.ids[np.isfinite(body.places).all(axis=1)], e.ids, return_indices=True)
        places = body.places[np.isfinite(body.places).all(axis=1)][at]
        shape = body.shape
        states.append(
            plots.SurfaceState(
                name, shape.vertices, shape.triangles, e.ids[row], places, places + e.mean[row], e.rms[row]
            )
        )
    highest = max(float(np.nanmax(s.error)) for s in states)
    size = float(np.ptp(body.shape.vertices, axis=0).max())
    arrows = float(np.clip(np.floor(0.15 * size / highest), 1, 40)) if highest > 0 else 1.0
    caption = (
        "Drawn on the body at rest. Colour: rms error on the held-out recordings, one scale for both tabs. Lines: the "
        f"markers' mean error, {arrows:g} times longer."
    )
    return Chart("on-surface", plots.surface_map(states, highest, arrows), caption, tall=True)


def ranking_chart(diagnosis: Mapping[str, Any]) -> Chart | None:
    candidates = [c for c in diagnosis["candidates"] if np.isfinite(c["score"])]
    if not candidates:
        return None
    import plotly.graph_objects as go

    names = [words(c["name"]) for c in candidates]
    best = {n for name, others in rivals_in(diagnosis).items() for n in (name, *others)}
    colours = [plots.BLUE if c["name"] in best else plots.GREY for c in candidates]
    figure = go.Figure(
        go.Bar(
            x=[-c["score"] for c in candidates],
            y=names,
            orientation="h",
            marker_color=colours,
            customdata=[[c["test_rmse"] * MM, c["score_gap"]] for c in candidates],
            hovertemplate="%{y}: %{x:.1f}, %{customdata[1]:.1f} behind the best<br>"
            "rmse %{customdata[0]:.3f} mm<extra></extra>",
        )
    )
    layout = plots.base_layout(height=80 + 22 * len(names))
    layout["margin"] |= {"l": 140}
    layout["xaxis"] = {"title": "gain in predicting unseen blocks (twice the log predictive density)"}
    layout["yaxis"] = {"autorange": "reversed", "ticklabelstandoff": 6}
    figure.update_layout(**layout)
    caption = (
        "Every candidate alone, best score first. Blue: what was added, or what the data cannot tell from it. The rmse "
        "is of what was held out, to first order in the effect: of a large one that was not added it can be far off."
    )
    return Chart("ranking", figure, caption)
