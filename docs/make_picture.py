"""Draws the README's picture from what ``livedeform demo`` left behind.

livedeform demo --out out/demo
python docs/make_picture.py out/demo docs/img/overview.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.frames import apply, inverse
from livedeform.compare_node.metrics import rmse
from livedeform.report.run.evidence import RunEvidence
from livedeform.report.run.moments import DEEPEST, NotableMoment, interesting_moments
from livedeform.report.run.read import load_evidence
from livedeform.studies.study import COLOURS, figure

MM = 1e3


def evidence_of(run: Path) -> RunEvidence:
    """What a run left."""
    return load_evidence(run, load_experiment(run / "experiment.yaml"))


def draw_picture(ax: Axes, evidence: RunEvidence, moment: NotableMoment) -> None:
    """The left picture with the predicted surface and both kinds of markers on it."""
    image, _ = evidence.pictures(moment.residual.stamp_ns)
    rig, place, shape = evidence.rig, evidence.T_phantom_left, moment.shape
    assert image is not None and rig is not None and place is not None and shape is not None  # the demo has them
    T = inverse(place)
    px = rig.project(apply(T, shape.vertices))[0]
    measured, predicted = (rig.project(apply(T, p))[0] for p in (moment.residual.measured, moment.residual.predicted))
    ax.imshow(image.pixels, cmap="gray", vmin=0, vmax=255)
    seen = apply(T, shape.vertices)[shape.triangles]
    front = np.einsum("ij,ij->i", np.cross(seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0]), seen[:, 0]) < 0
    ax.triplot(px[:, 0], px[:, 1], shape.triangles[front], color=COLOURS[5], lw=0.25, alpha=0.7)
    ax.plot(*measured.T, "o", mfc="none", mec=COLOURS[1], ms=5, label="measured")
    ax.plot(*predicted.T, "+", color="white", ms=4, mew=0.8, label="predicted")
    low, high = px.min(axis=0), px.max(axis=0)
    room = 0.12 * (high - low).max()
    ax.set(xlim=(low[0] - room, high[0] + room), ylim=(high[1] + room, low[1] - room), xticks=[], yticks=[])
    ax.grid(False)
    ax.legend(loc="lower left", labelcolor="white", fontsize=7)


def main(demo: Path, path: Path) -> None:
    """Picture, error over time, error per marker: before and after."""
    before = evidence_of(demo / "before")
    runs = [("declared", before, COLOURS[1], -0.2)]
    if (demo / "after" / "metrics.json").exists():  # nothing was added where the declared model explains the data
        runs.append(("fitted", evidence_of(demo / "after"), COLOURS[0], 0.2))
    moments = interesting_moments(before.residuals, before)
    deepest = next(m for m in moments if DEEPEST in m.name)
    fig, axes = figure(9.6, 2.9, 3, gridspec_kw={"width_ratios": [1.0, 1.25, 1.0]})
    draw_picture(axes[0], before, deepest)
    axes[0].set_title("measured and predicted")
    for name, evidence, colour, _ in runs:
        kept = [r for r in evidence.residuals if len(r.ids)]
        seconds = [(r.stamp_ns - evidence.start_ns) * 1e-9 for r in kept]
        axes[1].plot(seconds, [rmse(r.distances) * MM for r in kept], color=colour, lw=1.2, label=name)
    axes[1].set(xlabel="time (s)", ylabel="rmse (mm)", ylim=(0, None), title="error over time")
    axes[1].legend()
    ids = np.unique(np.concatenate([r.ids for r in before.residuals]))
    for name, evidence, colour, shift in runs:
        pooled: dict[int, list[float]] = {int(i): [] for i in ids}
        for r in evidence.residuals:
            for i, d in zip(r.ids, r.distances, strict=True):
                pooled.setdefault(int(i), []).append(d)
        values = [rmse(np.array(pooled[int(i)])) * MM for i in ids]
        axes[2].bar(np.arange(len(ids)) + shift, values, 0.4, color=colour, label=name)
    axes[2].set(xlabel="marker", ylabel="rms error (mm)", title="error per marker", xticks=[])
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=200)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
