"""A run over time in three dimensions: predicted surface, probe and its path, where they touch, errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.read import BagReader, read_bag
from livedeform.common.bags.recording import header_stamp_ns
from livedeform.common.bags.types import decode
from livedeform.common.experiment.probe_mesh import probe_mesh
from livedeform.common.experiment.schema import Probe
from livedeform.common.frames import apply, inverse, pose_matrix
from livedeform.common.types import Array, Pose
from livedeform.compare_node.residual import Residual
from livedeform.fem_node.contact.probe_shapes import Shape
from livedeform.fem_node.declared import probe_shape
from livedeform.report.plots import BLUE, GREEN, MM, SCALE, SKY, VERMILLION, drawn

MOST_MOMENTS = 60
MOST_BYTES = 600_000  # of the surfaces on a page, in single precision
BYTES_PER_POINT = 16  # three float32, in base64
TOUCHES = 3e-4  # m between surface and probe: the patch that touches
SURFACE_GREY = "#b9c0c6"
MS_PER_MOMENT = 120


@dataclass(frozen=True)
class ViewedMoment:
    """One position of the slider: ``surface`` (m, 3) m, the markers that were compared then, the probe's place
    T_phantom_probe (None: there is none), and which nodes of the surface touch it."""

    seconds: float
    surface: Array
    residual: Residual
    T_probe: Array | None
    touching: NDArray[np.int64]


@dataclass(frozen=True)
class Playback:
    """A run over time: the surface's ``triangles`` (k, 3), the probe's own vertices (n, 3) m and triangles, and its
    whole path (p, 3) m; empty where there is no probe."""

    moments: Sequence[ViewedMoment]
    triangles: NDArray[np.int64]
    probe_vertices: Array
    probe_triangles: NDArray[np.int64]
    path: Array


def read_playback(
    bag_path: Path,
    residuals: Sequence[Residual],
    poses: Sequence[Pose],
    probe: Probe | None,
    start_ns: int,
    most: int = MOST_MOMENTS,
    most_bytes: int = MOST_BYTES,
) -> Playback:
    """Read at most ``most`` moments, evenly over the run; fewer where their surfaces take more than ``most_bytes``, so
    that a page stays small."""
    with read_bag(bag_path) as bag:
        triangles = surface_triangles(bag)
        n_nodes = int(triangles.max()) + 1 if len(triangles) else 0
        room = int(np.clip(most_bytes / max(n_nodes * BYTES_PER_POINT, 1), 8, most))
        rows = np.unique(np.linspace(0, len(residuals) - 1, min(room, len(residuals))).round().astype(int))
        chosen = [residuals[row] for row in rows]
        surfaces = _surfaces_near(bag, [r.stamp_ns for r in chosen])
    shape = probe_shape(probe) if probe is not None and poses else None
    stamps = np.array([p.stamp_ns for p in poses], np.int64)
    moments = []
    for r, surface in zip(chosen, surfaces, strict=True):
        T = pose_matrix(poses[int(np.abs(stamps - r.stamp_ns).argmin())]) if shape is not None else None
        touching = _touching(surface, T, shape)
        moments.append(ViewedMoment((r.stamp_ns - start_ns) * 1e-9, surface, r, T, touching))
    none = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    vertices, corners = probe_mesh(probe) if probe is not None and shape is not None else none
    path = np.array([p.position for p in poses]) if shape is not None else np.zeros((0, 3))
    return Playback(moments, triangles, vertices, corners, path)


def _touching(surface: Array, T: Array | None, shape: Shape | None) -> NDArray[np.int64]:
    """The nodes of the surface that are within ``TOUCHES`` of the probe."""
    if T is None or shape is None or not len(surface):
        return np.zeros(0, np.int64)
    local = apply(inverse(T), surface)
    near = np.flatnonzero(((local >= shape.bounds[0] - TOUCHES) & (local <= shape.bounds[1] + TOUCHES)).all(axis=1))
    return near[shape.distance(local[near]).d < TOUCHES] if len(near) else near


def _surfaces_near(bag: BagReader, wanted: Sequence[int]) -> list[Array]:
    """The converged surface whose stamp is nearest to each wanted one; empty arrays where there is none at all."""
    stamps = sorted({s for raw in bag.messages([t.FEM_SURFACE]) if (s := header_stamp_ns(raw)) is not None})
    if not stamps:
        return [np.zeros((0, 3))] * len(wanted)
    known = np.array(stamps, np.int64)
    nearest = [int(known[np.abs(known - stamp).argmin()]) for stamp in wanted]
    found: dict[int, Array] = {}
    for raw in bag.messages([t.FEM_SURFACE]):
        stamp = header_stamp_ns(raw)
        if stamp in nearest:
            points = layouts.points(layouts.unpack(decode(raw)))
            if np.isfinite(points).all():
                found[int(stamp)] = points
    return [found.get(stamp, np.zeros((0, 3))) for stamp in nearest]


def surfaces_of(bag: BagReader) -> dict[int, Array]:
    """Predicted surface nodes (m, 3) m by stamp; moments without convergence are left out."""
    found = {}
    for raw in bag.messages([t.FEM_SURFACE]):
        stamp = header_stamp_ns(raw)
        points = layouts.points(layouts.unpack(decode(raw)))
        if stamp is not None and len(points) and np.isfinite(points).all():
            found[stamp] = points
    return found


def surface_triangles(bag: BagReader) -> NDArray[np.int64]:
    """Rows of a surface (k, 3): the corners of ``/fem/mesh`` found among the surface's nodes of the same stamp."""
    meshes = {}
    for raw in bag.messages([t.FEM_MESH]):
        message = decode(raw)
        if len(message.points):
            meshes[message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec] = message.points
            if len(meshes) > 5:  # the first is of the rest, which has no surface of its stamp
                break
    for raw in bag.messages([t.FEM_SURFACE]):
        stamp = header_stamp_ns(raw)
        if stamp in meshes:
            nodes = layouts.points(layouts.unpack(decode(raw)))
            corners = np.array([(p.x, p.y, p.z) for p in meshes[stamp]])
            if np.isfinite(nodes).all():
                return np.asarray(cKDTree(nodes).query(corners)[1].reshape(-1, 3), np.int64)
    return np.zeros((0, 3), np.int64)


def figure(playback: Playback, arrows: float = 1.0) -> go.Figure:
    """The scene in mm with a slider over the moments; lines from predicted to measured are ``arrows`` times longer."""
    moments = playback.moments
    highest = max(float(m.residual.distances.max()) for m in moments) * MM
    first = [*_surface(playback, moments[0]), *_probe(playback, moments[0]), *_markers(moments[0], highest, arrows)]
    moving = list(range(len(first)))
    if len(playback.path):
        x, y, z = drawn(playback.path[:: max(1, len(playback.path) // 400)])
        line = {"color": SKY, "width": 2}
        first.append(go.Scatter3d(x=x, y=y, z=z, mode="lines", name="path of the probe", line=line, hoverinfo="skip"))
    names = _names([m.seconds for m in moments])
    frames = [
        go.Frame(
            data=[_places(trace) for trace in (
                *_surface(playback, m), *_probe(playback, m), *_markers(m, highest, arrows))],
            traces=moving, name=name,
        )
        for name, m in zip(names, moments, strict=True)
    ]  # fmt: skip
    shown = go.Figure(data=first, frames=frames)
    shown.update_layout(**_layout(frames))
    return shown


def _names(seconds: Sequence[float]) -> list[str]:
    """Return the names of moments, by which the slider finds them: with as many decimals as tell them apart."""
    for decimals in range(2, 10):
        names = [f"{s:.{decimals}f}" for s in seconds]
        if len(set(names)) == len(names):
            break
    return names


def _places(trace: go.Mesh3d | go.Scatter3d) -> go.Mesh3d | go.Scatter3d:
    """Return what of a trace changes over time; the rest stays as it was."""
    if isinstance(trace, go.Mesh3d):
        return go.Mesh3d(x=trace.x, y=trace.y, z=trace.z)
    changed = {"x": trace.x, "y": trace.y, "z": trace.z, "text": trace.text}
    if trace.marker.color is not None and not isinstance(trace.marker.color, str):
        changed["marker"] = {"color": trace.marker.color}
    return go.Scatter3d(**changed)


def _surface(playback: Playback, moment: ViewedMoment) -> list[go.Mesh3d | go.Scatter3d]:
    if not len(playback.triangles):
        return []
    x, y, z = drawn(moment.surface)
    i, j, k = playback.triangles.T
    body = go.Mesh3d(
        x=x, y=y, z=z, i=i, j=j, k=k, color=SURFACE_GREY, name="predicted surface", showlegend=True,
        hoverinfo="skip", lighting={"ambient": 0.78, "diffuse": 0.5, "specular": 0.08, "roughness": 0.9},
    )  # fmt: skip
    px, py, pz = drawn(moment.surface[moment.touching])
    dots = {"size": 3, "color": GREEN}
    patch = go.Scatter3d(x=px, y=py, z=pz, mode="markers", name="touches the probe", marker=dots, hoverinfo="skip")
    return [body, patch]


def _probe(playback: Playback, moment: ViewedMoment) -> list[go.Mesh3d | go.Scatter3d]:
    if moment.T_probe is None:
        return []
    x, y, z = drawn(apply(moment.T_probe, playback.probe_vertices))
    i, j, k = playback.probe_triangles.T
    return [
        go.Mesh3d(
            x=x, y=y, z=z, i=i, j=j, k=k, color=SKY, opacity=0.35, name="probe", showlegend=True, hoverinfo="skip"
        )
    ]


def _markers(moment: ViewedMoment, highest: float, arrows: float) -> list[go.Mesh3d | go.Scatter3d]:
    r = moment.residual
    size = np.round(r.distances * MM, 4).astype(np.float32)
    text = [f"marker {marker}: {d:.3f} mm" for marker, d in zip(r.ids, size, strict=True)]
    bar = {"title": {"text": "error (mm)", "side": "right"}, "len": 0.6, "thickness": 12, "x": 1.0}
    dots = {"size": 5, "color": size, "colorscale": SCALE, "cmin": 0, "cmax": highest, "colorbar": bar}
    rings = {"size": 4, "color": BLUE, "symbol": "circle-open"}
    tips = r.predicted + arrows * (r.measured - r.predicted)
    lines = np.stack([r.predicted, tips, np.full_like(tips, np.nan)], axis=1).reshape(-1, 3)
    name = "error" if arrows == 1 else f"error, {arrows:g} times longer"
    made = []
    for points, mode, label, options in (
        (r.predicted, "markers", "predicted markers", {"marker": rings, "hoverinfo": "skip"}),
        (r.measured, "markers", "measured markers", {"marker": dots, "text": text, "hoverinfo": "text"}),
        (lines, "lines", name, {"line": {"color": VERMILLION, "width": 4}, "hoverinfo": "skip"}),
    ):
        x, y, z = drawn(points)
        made.append(go.Scatter3d(x=x, y=y, z=z, mode=mode, name=label, **options))
    return made


def _layout(frames: Sequence[go.Frame]) -> dict[str, object]:
    """Axes, a slider, and two buttons."""
    at_once = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}}
    steps = [{"method": "animate", "label": f.name, "args": [[f.name], at_once]} for f in frames]
    going = {"frame": {"duration": MS_PER_MOMENT, "redraw": True}, "transition": {"duration": 0}, "fromcurrent": True}
    play = {"label": "play", "method": "animate", "args": [None, going]}
    stop = {"label": "stop", "method": "animate", "args": [[None], at_once]}
    return {
        "scene": {"aspectmode": "data", **{f"{axis}axis": {"title": f"{axis} (mm)", "nticks": 5} for axis in "xyz"}},
        "sliders": [
            {"steps": steps, "currentvalue": {"prefix": "time ", "suffix": " s"}, "len": 0.82, "x": 0.18, "y": 0.0,
             "pad": {"t": 10}}
        ],
        "updatemenus": [
            {"type": "buttons", "buttons": [play, stop], "direction": "left", "x": 0.0, "y": 0.0, "xanchor": "left",
             "yanchor": "top", "pad": {"t": 34}, "showactive": False}
        ],
        "legend": {"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom"},
        "height": 620,
        "margin": {"l": 0, "r": 0, "t": 60, "b": 96},
        "font": {"size": 12.5},
        "template": "none",
    }  # fmt: skip
