"""The body with its markers, its support and the probe above it: as a picture, and to turn round in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common.experiment.plausibility import read_body
from livedeform.common.experiment.probe_mesh import probe_mesh
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Array

MM = 1e3
BODY, HELD, PROBE = "#b9c6d0", "#D55E00", "#56B4E9"
KIND_COLOURS = {"surface": "#0072B2", "internal": "#CC79A7", "support": "#000000"}
AXIS_COLOURS = {"x": "#d62728", "y": "#2ca02c", "z": "#1f1fd0"}
GAP = 0.15  # of the body's height, between its top and the drawn probe


def placed_probe(experiment: Experiment, body: Surface) -> tuple[Array, Any, Array] | None:
    """The probe above the body's highest point, upside down as it presses from above.

    Vertices (n, 3) m, triangles (k, 3), origin (3,) m of its frame; None without a probe.
    """
    if experiment.probe is None:
        return None
    vertices, triangles = probe_mesh(experiment.probe)
    height = float(body.upper[2] - body.lower[2])
    top = body.vertices[body.vertices[:, 2].argmax()]
    middle = (body.lower + body.upper) / 2.0
    origin = np.array([*(top[:2] if _pointed(body) else middle[:2]), top[2] + GAP * height])
    return origin + vertices * (1.0, -1.0, -1.0), triangles, origin


def _pointed(body: Surface) -> bool:
    """Tell whether the highest place is one point rather than a flat top."""
    top = body.vertices[body.vertices[:, 2] > body.upper[2] - 1e-6]
    return bool(np.ptp(top, axis=0).max() < 0.1 * (body.upper - body.lower).max())


def held(experiment: Experiment, body: Surface) -> Any:
    """Return which triangles (k,) a support holds: those with all corners in a support's region."""
    inside = np.zeros(len(body.vertices), bool)
    for support in experiment.phantom.support:
        inside |= support.region.contains(body.vertices)
    return inside[body.triangles].all(axis=1)


def draw(experiment: Experiment, path: Path) -> None:
    """Write the picture (PNG): from the front, from the side and from above, all to one scale."""
    import matplotlib
    from matplotlib.figure import Figure

    from livedeform.studies.study import STYLE

    body = read_body(experiment)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11.0, 4.6))
        for axes, view in zip(figure.subplots(1, 3), VIEWS, strict=True):
            _draw_view(axes, experiment, body, view)
        figure.legend(*_legend(experiment), loc="outside lower center", ncols=6)
        size = " x ".join(f"{MM * s:.0f}" for s in body.upper - body.lower)
        figure.suptitle(f"{experiment.name}: {size} mm, {len(experiment.markers.ids)} markers", parse_math=False)
        figure.savefig(path, dpi=130)


@dataclass(frozen=True)
class Projection:
    """A parallel projection: ``across`` and ``up`` the numbers of the axes on the paper, ``to_eye`` (3,) towards the
    reader."""

    title: str
    across: int
    up: int
    to_eye: tuple[float, float, float]

    def flat(self, points: Array) -> Array:
        """Places (..., 2) mm on the paper."""
        return MM * points[..., [self.across, self.up]]


VIEWS = (
    Projection("from the front", 0, 2, (0.0, -1.0, 0.0)),
    Projection("from the side", 1, 2, (1.0, 0.0, 0.0)),
    Projection("from above", 0, 1, (0.0, 0.0, 1.0)),
)


def _draw_view(axes: Any, experiment: Experiment, body: Surface, view: Projection) -> None:
    """Body, probe and markers; markers on the far side are hollow."""
    eye = np.array(view.to_eye)
    fixed = held(experiment, body)
    _paint(axes, body.corners, np.where(fixed[:, None], _rgb(HELD), _rgb(BODY)), view)
    if view.up == 2:  # what is held below is seen from its edge only
        for corners in view.flat(body.corners[fixed]):
            axes.plot(*corners[[0, 1, 2, 0]].T, color=HELD, lw=2.5, zorder=4, solid_joinstyle="round")
    probe = placed_probe(experiment, body)
    if probe is not None:
        vertices, triangles, origin = probe
        _paint(axes, vertices[triangles], np.tile(_rgb(PROBE), (len(triangles), 1)), view, alpha=0.35)
        _draw_frame(axes, origin, 0.25 * float(body.upper[2] - body.lower[2]), view)
    markers = experiment.markers
    hidden = _faces(body, markers.points) @ eye < -0.1
    for kind, colour in KIND_COLOURS.items():
        for rows, fill in ((hidden, "none"), (~hidden, colour)):
            points = view.flat(markers.points[(markers.kinds == kind) & rows])
            axes.plot(*points.T, "o", color=colour, mfc=fill, ms=4, zorder=5)
    for marker_id, point in zip(markers.ids[~hidden], view.flat(markers.points[~hidden]), strict=True):
        axes.annotate(str(marker_id), point, xytext=(3, 2), textcoords="offset points", fontsize=6, zorder=6)
    axes.set(xlabel=f"{'xyz'[view.across]} (mm)", ylabel=f"{'xyz'[view.up]} (mm)", title=view.title, aspect="equal")


def _paint(axes: Any, corners: Array, colours: Array, view: Projection, alpha: float = 1.0) -> None:
    """Triangles (k, 3, 3) m that face the reader, the nearest last, darker the more they turn away."""
    from matplotlib.collections import PolyCollection

    eye = np.array(view.to_eye)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = (normals @ eye) / np.maximum(np.linalg.norm(normals, axis=1), 1e-30)
    order = np.argsort(corners.mean(axis=1) @ eye)
    order = order[facing[order] > 1e-3]
    shade = (0.6 + 0.4 * facing[order])[:, None] * colours[order]
    paint = np.column_stack([shade, np.full(len(shade), alpha)])
    axes.add_collection(PolyCollection(list(view.flat(corners[order])), facecolors=paint, edgecolors="none"))
    axes.autoscale_view()


def _faces(body: Surface, points: Array) -> Array:
    """Outward unit normal (n, 3) of the triangle that is nearest to each point, by its middle."""
    corners = body.corners
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    from trimesh.triangles import closest_point

    out = np.empty((len(points), 3))
    for i, point in enumerate(points):
        near = np.linalg.norm(closest_point(corners, np.broadcast_to(point, (len(corners), 3))) - point, axis=1)
        out[i] = normals[near.argmin()]
    return out


def _rgb(colour: str) -> Array:
    return np.array([int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])


def _draw_frame(axes: Any, origin: Array, length: float, view: Projection) -> None:
    """The axes of the frame probe as it is placed: +z down into the body."""
    for (name, colour), direction in zip(AXIS_COLOURS.items(), np.diag([1.0, -1.0, -1.0]), strict=True):
        start, tip = view.flat(origin), view.flat(origin + length * direction)
        if np.allclose(start, tip):
            continue
        axes.annotate("", tip, start, arrowprops={"arrowstyle": "->", "color": colour}, zorder=7)
        axes.annotate(name, tip, color=colour, fontsize=8, zorder=7)


def _legend(experiment: Experiment) -> tuple[list[Any], list[str]]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: dict[str, Any] = {"body": Patch(color=BODY), "held": Patch(color=HELD)}
    if experiment.probe is not None:
        entries["probe"] = Patch(color=PROBE, alpha=0.5)
    for kind in np.unique(experiment.markers.kinds):
        entries[f"{kind} marker"] = Line2D([], [], marker="o", ls="", color=KIND_COLOURS[str(kind)])
    return list(entries.values()), list(entries)


def write_scene(path: Path, out: Path) -> None:
    """Write the page that shows the experiment in ``path`` (a folder or a YAML file); it opens offline."""
    scene(load_experiment(path)).write_html(out, include_plotlyjs=True)


def scene(experiment: Experiment) -> Any:
    """The same as a plotly figure that can be turned round, in mm."""
    import plotly.graph_objects as go

    body = read_body(experiment)
    fixed = held(experiment, body)
    traces = [
        _solid(body.vertices, body.triangles[~fixed], BODY, "body", 0.6),
        _solid(body.vertices, body.triangles[fixed], HELD, "held", 0.9),
    ]
    probe = placed_probe(experiment, body)
    if probe is not None:
        traces.append(_solid(*probe[:2], PROBE, "probe", 0.6))
    markers = experiment.markers
    for kind in np.unique(markers.kinds):
        rows = markers.kinds == kind
        x, y, z = MM * markers.points[rows].T
        text = [f"marker {i}" for i in markers.ids[rows]]
        dots = {"size": 4, "color": KIND_COLOURS[str(kind)]}
        traces.append(go.Scatter3d(x=x, y=y, z=z, mode="markers", name=f"{kind} markers", text=text, marker=dots))
    figure = go.Figure(traces)
    axes = {f"{axis}axis": {"title": f"{axis} (mm)"} for axis in "xyz"}
    figure.update_layout(
        title=f"{experiment.name}: body, markers, support and probe", scene={"aspectmode": "data", **axes},
        template="plotly_white", legend={"orientation": "h", "y": 0.0}, margin={"l": 0, "r": 0, "t": 40, "b": 0},
    )  # fmt: skip
    return figure


def _solid(vertices: Array, triangles: Any, colour: str, name: str, opacity: float) -> Any:
    import plotly.graph_objects as go

    x, y, z = np.round(MM * vertices, 3).T
    i, j, k = triangles.T
    return go.Mesh3d(
        x=x, y=y, z=z, i=i, j=j, k=k, color=colour, opacity=opacity, name=name, showlegend=True, flatshading=True
    )
