"""The interactive charts of a diagnosis: errors before and after, and the ranking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from livedeform.common.types import Array, Ids
from livedeform.compare_node.metrics import rmse
from livedeform.compare_node.residual import tabulate
from livedeform.report import plots
from livedeform.report.diagnosis.evidence import Compared, RestingBody
from livedeform.report.diagnosis.tables import indistinguishable
from livedeform.report.page import Chart
from livedeform.report.text import MM, words


def over_time_chart(recordings: Sequence[Compared]) -> list[Chart]:
    charts = []
    highest = max((rmse(r.distances) for c in recordings for r in (*c.before, *c.after) if len(r.ids)), default=0.0)
    for number, recording in enumerate(recordings):
        lines = []
        for name, residuals, colour in (
            ("before", recording.before, plots.ORANGE),
            ("after", recording.after, plots.BLUE),
        ):
            kept = [r for r in residuals if len(r.ids)]
            seconds = np.array([(r.stamp_ns - recording.start_ns) * 1e-9 for r in kept])
            lines.append(plots.Line(name, seconds, np.array([rmse(r.distances) for r in kept]) * MM, colour))
        figure = plots.error_over_time(lines, None, {})
        figure.update_yaxes(range=[0.0, 1.05 * highest * MM])
        role = "held out: nothing was fitted to it" if recording.held_out else "used for fitting"
        charts.append(Chart(f"over-time-{number}", figure, f"{recording.name} ({role}): rmse of each moment."))
    return charts


def _marker_rms(recordings: Sequence[Compared], after: bool) -> tuple[Ids, Array, Array]:
    """Ids, rms error and half of its 95 % interval, over all moments of the recordings."""
    table = tabulate([r for c in recordings for r in (c.after if after else c.before)])
    ids = np.unique(table.ids)
    squares = [table.distances[table.ids == i] ** 2 for i in ids]
    rms = np.array([np.sqrt(q.mean()) for q in squares])
    half = np.array([1.96 * q.std() / (2 * np.sqrt(q.mean() * len(q))) if q.any() else 0.0 for q in squares])
    return ids, rms, half


def per_marker_chart(recordings: Sequence[Compared]) -> Chart | None:
    if not any(len(r.ids) for c in recordings for r in c.before):
        return None
    groups = {"before": _marker_rms(recordings, False), "after": _marker_rms(recordings, True)}
    figure = plots.error_per_marker(groups, (plots.ORANGE, plots.BLUE))
    return Chart(
        "per-marker", figure, "Root mean square error of each marker on the held-out recordings, with 95 % intervals."
    )


def on_surface_chart(recordings: Sequence[Compared], body: RestingBody | None) -> Chart | None:
    """Rms errors as colours and mean errors as lines, before and after, drawn on the body at rest."""
    if body is None or not any(len(r.ids) for c in recordings for r in c.before):
        return None
    states = []
    for name, after in (("before", False), ("after", True)):
        table = tabulate([r for c in recordings for r in (c.after if after else c.before)])
        known = np.isin(body.ids, table.ids) & np.isfinite(body.places).all(axis=1)
        ids, places = body.ids[known], body.places[known]
        rms = np.array([rmse(table.distances[table.ids == i]) for i in ids])
        mean = np.stack([table.errors[table.ids == i].mean(axis=0) for i in ids])
        states.append(
            plots.SurfaceState(name, body.shape.vertices, body.shape.triangles, ids, places, places + mean, rms)
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
    best = set(indistinguishable(diagnosis)) | {e["name"] for e in diagnosis["effects"]}
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
    caption = "Every candidate alone, best score first. Blue: what was added, or what the data cannot tell from it."
    return Chart("ranking", figure, caption)
