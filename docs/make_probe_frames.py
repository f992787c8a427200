"""Draws the frame ``probe`` for a ball, a cylinder and a box: where its origin is and where its axes point.

python docs/make_probe_frames.py docs/img/probe-frames.png
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from livedeform.common.experiment.probe_mesh import probe_mesh
from livedeform.common.experiment.schema import Probe
from livedeform.new.picture import AXIS_COLOURS, PROBE
from livedeform.studies.study import STYLE

MM = 1e3
SHAPES = {
    "sphere: 0.010": {"sphere": 0.010},
    "cylinder: [0.008, 0.024]": {"cylinder": [0.008, 0.024]},
    "box: [0.030, 0.012, 0.024]": {"box": [0.030, 0.012, 0.024]},
}
SIZES = {  # (from, to) in mm in the probe's frame (axis across, z), and what it is
    "sphere: 0.010": (((0.0, -10.0), (10.0, -10.0), "radius"),),
    "cylinder: [0.008, 0.024]": (((0.0, -24.0), (8.0, -24.0), "radius"), ((8.0, -24.0), (8.0, 0.0), "height")),
    "box: [0.030, 0.012, 0.024]": (((-15.0, -24.0), (15.0, -24.0), "length"), ((15.0, -24.0), (15.0, 0.0), "height")),
}
WIDTH = (((6.0, -24.0), (6.0, 0.0), "height"), ((-6.0, -24.0), (6.0, -24.0), "width"))
LENGTH = 9.0  # mm, of a drawn axis


def outline(shape: dict[str, Any], across: int) -> np.ndarray:
    """The silhouette (n, 2) mm of a probe, seen along the other axis: +z points down on the paper."""
    from scipy.spatial import ConvexHull

    vertices, _ = probe_mesh(
        Probe.model_validate({"shape": shape, "edge_radius": 0.002 if "sphere" not in shape else 0.0})
    )
    flat = MM * vertices[:, [across, 2]]
    return flat[ConvexHull(flat).vertices]


def draw(axes: Any, name: str, across: int) -> None:
    """One probe above the tissue: its outline, sizes, origin and axes."""
    axes.add_patch(Rectangle((-22, 0), 44, 9, color="#f1d9cc", lw=0))
    axes.text(-20.5, 7, "tissue", fontsize=8, color="#7a4a33")
    axes.fill(*outline(SHAPES[name], across).T, facecolor=PROBE, alpha=0.45, edgecolor="#2b6f94", lw=1.2)
    letter = "xyz"[across]
    for label, tip in ((letter, (LENGTH, 0.0)), ("z", (0.0, LENGTH))):
        arrow = {"arrowstyle": "-|>", "color": AXIS_COLOURS[label], "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tip, (0, 0), arrowprops=arrow, zorder=5)
        axes.text(tip[0] + 0.8, tip[1] - 0.3, label, color=AXIS_COLOURS[label], fontsize=10, weight="bold", zorder=5)
    axes.plot(0, 0, "o", color="black", ms=4, zorder=6)
    axes.text(-1.2, -1.2, "origin", ha="right", fontsize=8)
    for start, end, text in WIDTH if across == 1 else SIZES[name]:
        level = start[1] == end[1]
        shift = np.array((0.0, -2.0) if level else (2.0, 0.0))
        a, b = np.array(start) + shift, np.array(end) + shift
        axes.annotate(
            "", a, b, arrowprops={"arrowstyle": "<->", "color": "#444444", "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
        )
        where = (a + b) / 2 + ((0.0, -1.0) if level else (1.0, 0.0))
        axes.text(*where, text, ha="center" if level else "left", va="bottom" if level else "center", fontsize=8)
    axes.set(xlim=(-22, 22), ylim=(9, -30), aspect="equal", xticks=[], yticks=[])
    axes.grid(False)
    axes.spines[:].set_visible(False)


def main(path: Path) -> None:
    """Ball, cylinder, and box from two sides."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11.0, 3.3))
        names = list(SHAPES)
        panels = [(names[0], 0), (names[1], 0), (names[2], 0), (names[2], 1)]
        for axes, (name, across) in zip(figure.subplots(1, 4), panels, strict=True):
            draw(axes, name, across)
            side = ", seen along +x" if across == 1 else ""
            axes.set_title(name + side, fontsize=8.5)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
