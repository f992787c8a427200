"""The interactive figures of the reports: error over time, per marker, and on the surface. Millimetres on every axis.

Colours are Okabe and Ito's (told apart by colour-blind readers), the error scale is viridis (even in lightness).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib import colormaps
from numpy.typing import NDArray

from livedeform.common.types import Array, Ids

BLUE, ORANGE, GREEN, VERMILLION, SKY, GREY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#8A939B",
)  # fmt: skip
SCALE, viridis = "Viridis", colormaps["viridis"]
MM = 1e3
FEW_POINTS = 20  # of one line; up to these, each has a mark: a single one has no line
MAX_POINTS = 3000  # of one line; more are thinned out for the page, never for the numbers


@dataclass(frozen=True)
class Line:
    """A curve over time: ``seconds`` (n,) and ``values`` (n,) in the figure's unit; ``weights`` (n,) s is what each
    value counts in a mean over the curve."""

    name: str
    seconds: Array
    values: Array
    colour: str
    dash: str = "solid"
    weights: Array | None = None


@dataclass(frozen=True)
class SurfaceState:
    """A predicted surface with measured and predicted markers on it.

    ``surface`` (n, 3) m, ``triangles`` (k, 3), ``predicted`` and ``measured`` (m, 3) m,
    ``error`` (m,) m the length that colours the map (of that moment or over a run), ``ids`` (m,).
    """

    name: str
    surface: Array
    triangles: NDArray[np.int64]
    ids: Ids
    predicted: Array
    measured: Array
    error: Array


def error_over_time(
    lines: Sequence[Line], threshold: float | None, marks: Mapping[str, float], second: Line | None = None
) -> go.Figure:
    """Errors (mm) over the recording's time, the threshold (m), vertical marks; ``second`` is drawn below."""
    figure = go.Figure()
    for line in lines:
        shown = _shown(line.values)
        seconds, values = line.seconds[shown], line.values[shown]
        figure.add_scatter(
            x=seconds,
            y=values,
            customdata=None if line.weights is None else line.weights[shown],
            name=line.name,
            mode=_mode(seconds),
            line={"color": line.colour, "width": 2, "dash": line.dash},
            hovertemplate="%{y:.3f} mm",
        )
    if threshold is not None:
        _add_threshold(figure, lines, threshold)
    _add_marks(figure, marks, max((line.seconds[-1] for line in lines if len(line.seconds)), default=1.0))
    layout = base_layout(height=340)
    layout["hovermode"] = "x unified"
    layout["xaxis"] = {"title": "time since the recording's start (s)"}
    layout["yaxis"] = {"title": "error (mm)", "rangemode": "tozero"}
    if second is not None:
        shown = _shown(second.values)
        seconds, values = second.seconds[shown], second.values[shown]
        below = {"line": {"color": second.colour, "width": 1.6}, "yaxis": "y2", "hovertemplate": "%{y:.3f}"}
        figure.add_scatter(x=seconds, y=values, name=second.name, mode=_mode(seconds), **below)
        layout |= {
            "height": 460,
            "yaxis": layout["yaxis"] | {"domain": [0.36, 1.0]},
            "yaxis2": {"title": second.name, "domain": [0.0, 0.26]},
        }
        layout["xaxis"] |= {"anchor": "y2"}
    figure.update_layout(**layout)
    return figure


def _mode(seconds: Array) -> str:
    return "lines+markers" if len(seconds) <= FEW_POINTS else "lines"


def _add_threshold(figure: go.Figure, lines: Sequence[Line], threshold: float) -> None:
    """Draw the threshold (m), unless it is so far away that it would flatten the curves; the caption names it."""
    highest = max((np.nanmax(line.values, initial=0.0) for line in lines), default=0.0)
    if highest > 0.5 * threshold * MM:
        figure.add_hline(
            y=threshold * MM, line={"color": VERMILLION, "dash": "dash", "width": 1.5},
            annotation_text=f"threshold {threshold * MM:g} mm", annotation_font_size=11,
        )  # fmt: skip


def _add_marks(figure: go.Figure, marks: Mapping[str, float], span: float) -> None:
    """Draw a vertical line with its label at each mark (s)."""
    for label, at in _merged(marks, 0.15 * span):
        text = {"text": label, "font": {"size": 11}, "xanchor": "left" if at < 0.85 * span else "right"}
        figure.add_vline(x=at, line={"color": GREY, "dash": "dot", "width": 1.2}, annotation=text)


def _merged(marks: Mapping[str, float], apart: float) -> list[tuple[str, float]]:
    """Labels of marks that are closer than ``apart`` share one line of text, so that they stay readable."""
    out: list[tuple[str, float]] = []
    last = -np.inf
    for name, at in sorted(marks.items(), key=lambda item: item[1]):
        if at - last < apart:
            label, before = out[-1]
            out[-1] = ("", before)
            out.append((f"{label}, {name}", at))
        else:
            out.append((name, at))
        last = at
    return out


@dataclass(frozen=True)
class Bars:
    """One bar per marker: ``ids`` (m,), ``rms`` error (m,) m, ``half`` (m,) m the half width of its 95 % interval,
    NaN where it is not known, and ``weights`` (m,), what each counts in a mean over the markers."""

    ids: Ids
    rms: Array
    half: Array
    weights: Array


def whiskers(high: Array, low: Array | None = None) -> dict[str, Any] | None:
    """Draw intervals from ``low`` below to ``high`` above (n,), as far as they are known: one of no length would look
    the surest of all. None where none is known."""
    if not np.isfinite(high).any():
        return None
    said = {"type": "data", "array": _known(high), "thickness": 1.2, "width": 2, "color": GREY}
    return said if low is None else said | {"symmetric": False, "arrayminus": _known(low)}


def _known(values: Array) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def error_per_marker(groups: Mapping[str, Bars], colours: Sequence[str] = (BLUE, ORANGE)) -> go.Figure:
    """Bars (mm) with intervals for each of the named groups."""
    figure = go.Figure()
    for (name, bars), colour in zip(groups.items(), colours, strict=False):
        figure.add_bar(
            x=[str(i) for i in bars.ids], y=bars.rms * MM, name=name, marker_color=colour, customdata=bars.weights,
            error_y=whiskers(bars.half * MM), hovertemplate="marker %{x}: %{y:.3f} mm",
        )  # fmt: skip
    layout = base_layout(height=340)
    layout["xaxis"] = {"title": "marker id", "type": "category"}
    layout["yaxis"] = {"title": "rms error (mm)", "rangemode": "tozero"}
    layout["showlegend"] = len(groups) > 1
    layout["bargap"] = 0.25
    figure.update_layout(**layout)
    return figure


def surface_map(states: Sequence[SurfaceState], highest: float, arrows: float) -> go.Figure:
    """The error on the surface in 3-D, one group of traces per state (the first is shown, tabs switch).

    ``highest`` (m) is the top of the colour scale, the same for all states; ``arrows`` is the factor by which the lines
    from predicted to measured markers are drawn longer than they are.
    """
    figure = go.Figure()
    for number, state in enumerate(states):
        _add_state(figure, state, highest, arrows, visible=number == 0)
    axes = {name: {"title": f"{name[0]} (mm)", "nticks": 5} for name in ("xaxis", "yaxis", "zaxis")}
    layout = base_layout(height=580)
    layout["scene"] = axes | {"aspectmode": "data", "camera": {"eye": {"x": 1.15, "y": -1.35, "z": 0.75}}}
    layout["legend"] |= {"y": 0.0, "x": 0.0, "orientation": "v"}
    layout["margin"] = {"l": 0, "r": 0, "t": 0, "b": 0}
    figure.update_layout(**layout)
    return figure


def drawn(points: Array) -> tuple[Array, Array, Array]:
    """Return the columns of points (n, 3) m in mm as a page draws them: in single precision and steps of 1/64 mm, whose
    last bits are zero and pack well."""
    x, y, z = (np.round(points.T * MM * 64.0) / 64.0).astype(np.float32)
    return x, y, z


def _add_state(figure: go.Figure, state: SurfaceState, highest: float, arrows: float, *, visible: bool) -> None:
    """Draw one state: the coloured surface, the lines to the measured markers, and these."""
    x, y, z = drawn(state.surface)
    figure.add_mesh3d(
        x=x, y=y, z=z,
        i=state.triangles[:, 0], j=state.triangles[:, 1], k=state.triangles[:, 2],
        vertexcolor=_vertex_colours(state, highest), hoverinfo="skip", meta=state.name, visible=visible,
        lighting={"ambient": 0.78, "diffuse": 0.5, "specular": 0.08, "roughness": 0.9},
    )  # fmt: skip
    tips = state.predicted + arrows * (state.measured - state.predicted)
    path = np.full((3 * len(tips), 3), np.nan)
    path[0::3], path[1::3] = state.predicted, tips
    figure.add_scatter3d(
        x=path[:, 0] * MM, y=path[:, 1] * MM, z=path[:, 2] * MM, mode="lines", meta=state.name, visible=visible,
        line={"color": VERMILLION, "width": 5}, hoverinfo="skip", name=f"error, {arrows:g} times longer",
    )  # fmt: skip
    figure.add_scatter3d(
        x=state.measured[:, 0] * MM, y=state.measured[:, 1] * MM, z=state.measured[:, 2] * MM, mode="markers",
        meta=state.name, visible=visible, name="measured marker",
        customdata=np.column_stack([state.ids, state.error * MM]),
        hovertemplate="marker %{customdata[0]}: %{customdata[1]:.3f} mm<extra></extra>",
        marker={
            "size": 7, "color": state.error * MM, "colorscale": SCALE, "cmin": 0.0, "cmax": highest * MM,
            "line": {"width": 1, "color": "#ffffff"},
            "colorbar": {
                "title": {"text": "error (mm)", "side": "right"}, "thickness": 14, "len": 0.75, "outlinewidth": 0,
            },
        },
    )  # fmt: skip


def _vertex_colours(state: SurfaceState, highest: float) -> list[str]:
    """Colours of the error, spread over the surface by a Gaussian of the distance; grey where no marker is near.

    e(x) = sum w_i e_i / sum w_i, w_i = exp(-|x - x_i|^2 / 2 s^2), s = 0.6 times the markers' typical distance
    (Nadaraya 1964).
    """
    grey = np.array([176.0, 184.0, 192.0])
    known = np.isfinite(state.error) & np.isfinite(state.predicted).all(axis=1)
    if not known.any():
        return [_rgb(grey)] * len(state.surface)
    points, error = state.predicted[known], state.error[known]
    squared = ((state.surface[:, None] - points[None]) ** 2).sum(2)
    between = ((points[:, None] - points[None]) ** 2).sum(2)
    np.fill_diagonal(between, np.inf)
    spacing = float(np.sqrt(np.median(between.min(1)))) if len(points) > 1 else float(np.ptp(state.surface) / 5)
    width = 0.6 * spacing
    weights = np.exp(-(squared - squared.min(1, keepdims=True)) / (2.0 * width**2))
    value = (weights @ error) / weights.sum(1)
    near = np.exp(-(np.maximum(np.sqrt(squared.min(1)) - spacing, 0.0) ** 2) / (2.0 * spacing**2))
    colours = 255.0 * viridis(value / highest if highest > 0 else np.zeros_like(value))[:, :3]
    return [_rgb(c) for c in near[:, None] * colours + (1.0 - near[:, None]) * grey]


def _rgb(colour: Array) -> str:
    return "rgb({:.0f},{:.0f},{:.0f})".format(*colour)


def _shown(values: Array) -> NDArray[np.int64]:
    """Return the rows of a line that the page has: all of few; else of each stretch the lowest and the highest, so that
    no peak is left out."""
    n = len(values)
    if n <= MAX_POINTS:
        return np.arange(n)
    stretches = np.array_split(np.arange(n), MAX_POINTS // 2)
    low, high = np.nan_to_num(values, nan=np.inf), np.nan_to_num(values, nan=-np.inf)
    ends = [(rows[np.argmin(low[rows])], rows[np.argmax(high[rows])]) for rows in stretches]
    return np.unique(ends)


def base_layout(height: int) -> dict[str, Any]:
    return {
        "height": height,
        "margin": {"l": 60, "r": 20, "t": 24, "b": 48},
        "font": {"size": 12.5},
        "legend": {"orientation": "h", "y": 1.08, "x": 0.0},
        "template": "none",
    }
