"""A run in three dimensions with a time slider: one HTML file that opens offline."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.read import BagReader, read_bag
from livedeform.common.bags.recording import header_stamp_ns, load_recording
from livedeform.common.bags.types import decode
from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.compare_node.residual import Residual
from livedeform.outputs import write_text
from livedeform.report.page import POLICY
from livedeform.report.plots import BLUE, MM, SCALE
from livedeform.report.run.read import residuals_of

MAX_MOMENTS = 60
GREY = "#b9c0c6"


@dataclass(frozen=True)
class ViewedMoment:
    """One position of the slider: ``surface`` (m, 3) m and the markers that were compared then."""

    seconds: float
    surface: Array
    residual: Residual


def write_view(run: Path, out: Path, tell: Callable[..., None]) -> Path:
    """Writes the viewer of a run's folder, or of its recording, to ``out``."""
    bag_path = run / "run.mcap" if run.is_dir() and (run / "run.mcap").is_file() else run
    recording = load_recording(bag_path)
    residuals = [r for r in residuals_of(recording) if len(r.ids)]
    if not residuals:
        raise InputError("holds no errors of a model", where=str(run), remedy="make it with livedeform run")
    tell("reading the predicted surfaces")
    with read_bag(bag_path) as bag:
        surfaces = _surfaces(bag)
        triangles = _triangles(bag, surfaces)
    moments = _moments(residuals, surfaces, recording.start_ns)
    tell(f"drawing {len(moments)} moments")
    title = f"{run.resolve().name}: predicted surface, measured and predicted markers"
    page = figure(moments, triangles, title).to_html(include_plotlyjs=True, auto_play=False)
    write_text(out, page.replace("<head>", f"<head>{POLICY}", 1))
    return out


def _surfaces(bag: BagReader) -> dict[int, Array]:
    """Predicted surface nodes (m, 3) m by stamp; moments without convergence are left out."""
    found = {}
    for raw in bag.messages([t.FEM_SURFACE]):
        stamp = header_stamp_ns(raw)
        points = layouts.points(layouts.unpack(decode(raw)))
        if stamp is not None and len(points) and np.isfinite(points).all():
            found[stamp] = points
    return found


def _triangles(bag: BagReader, surfaces: dict[int, Array]) -> NDArray[np.int64]:
    """Rows of a surface (k, 3): the corners of ``/fem/mesh`` found among the surface's nodes of the same stamp."""
    for raw in bag.messages([t.FEM_MESH]):
        message = decode(raw)
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        if stamp in surfaces and len(message.points):
            corners = np.array([(p.x, p.y, p.z) for p in message.points])
            nearest: NDArray[np.int64] = cKDTree(surfaces[stamp]).query(corners)[1].reshape(-1, 3).astype(np.int64)
            return nearest
    return np.zeros((0, 3), np.int64)


def _moments(residuals: Sequence[Residual], surfaces: dict[int, Array], start_ns: int) -> list[ViewedMoment]:
    """Choose at most ``MAX_MOMENTS``, evenly over the run; the surface is the nearest predicted one."""
    stamps = np.array(sorted(surfaces), dtype=np.int64)
    rows = np.unique(np.linspace(0, len(residuals) - 1, min(MAX_MOMENTS, len(residuals))).round().astype(int))
    moments = []
    for row in rows:
        r = residuals[row]
        nearest = stamps[np.abs(stamps - r.stamp_ns).argmin()] if len(stamps) else None
        surface = surfaces[int(nearest)] if nearest is not None else np.zeros((0, 3))
        moments.append(ViewedMoment((r.stamp_ns - start_ns) * 1e-9, surface, r))
    return moments


def figure(moments: Sequence[ViewedMoment], triangles: NDArray[np.int64], title: str) -> go.Figure:
    """The scene, in mm, with a slider over the moments; colour is the error of a marker."""
    highest = max(float(m.residual.distances.max()) for m in moments) * MM
    frames = [go.Frame(data=_traces(m, triangles, highest), name=f"{m.seconds:.2f}") for m in moments]
    steps = [
        {"method": "animate", "label": f.name, "args": [[f.name], {"mode": "immediate", "frame": {"duration": 0}}]}
        for f in frames
    ]
    play = {"label": "play", "method": "animate", "args": [None, {"frame": {"duration": 120}, "fromcurrent": True}]}
    stop = {"label": "stop", "method": "animate", "args": [[None], {"mode": "immediate", "frame": {"duration": 0}}]}
    shown = go.Figure(data=frames[0].data, frames=frames)
    shown.update_layout(
        title=title,
        scene={"aspectmode": "data", **{f"{axis}axis": {"title": f"{axis} (mm)"} for axis in "xyz"}},
        sliders=[{"steps": steps, "currentvalue": {"prefix": "time ", "suffix": " s"}, "len": 0.9}],
        updatemenus=[{"type": "buttons", "buttons": [play, stop], "direction": "left", "x": 0.0, "y": 1.06}],
        legend={"x": 0.0, "y": 0.95},
        template="plotly_white",
    )
    return shown


def _traces(moment: ViewedMoment, triangles: NDArray[np.int64], highest: float) -> list[go.Mesh3d | go.Scatter3d]:
    r = moment.residual
    surface, measured, predicted = (np.round(a * MM, 3) for a in (moment.surface, r.measured, r.predicted))
    traces: list[go.Mesh3d | go.Scatter3d] = []
    if len(triangles) and len(surface):
        x, y, z = surface.T
        i, j, k = triangles.T
        traces.append(go.Mesh3d(x=x, y=y, z=z, i=i, j=j, k=k, color=GREY, opacity=0.55, name="predicted surface"))
    size = r.distances * MM
    text = [f"marker {marker}: {d:.2f} mm" for marker, d in zip(r.ids, size, strict=True)]
    bar = {"title": "error (mm)", "len": 0.6}
    dots = {"size": 5, "color": size, "colorscale": SCALE, "cmin": 0, "cmax": highest, "colorbar": bar}
    rings = {"size": 4, "color": BLUE, "symbol": "circle-open"}
    lines = np.stack([predicted, measured, np.full_like(measured, np.nan)], axis=1).reshape(-1, 3)
    for points, mode, name, options in (
        (predicted, "markers", "predicted markers", {"marker": rings}),
        (measured, "markers", "measured markers", {"marker": dots, "text": text, "hoverinfo": "text"}),
        (lines, "lines", "error", {"line": {"color": BLUE, "width": 3}}),
    ):
        traces.append(go.Scatter3d(x=points[:, 0], y=points[:, 1], z=points[:, 2], mode=mode, name=name, **options))
    return traces
