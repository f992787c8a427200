"""How much of the model's error the closed loop's refined mesh takes away, by the truth of synthetic experiments.

    livedeform synth scenario.yaml --out DIR      # without a `truth:` of effects
    python benchmarks/refined_mesh.py DIR [DIR ...]

At the deepest moments of recording ``a``: rms over coordinates of the markers' motion that the model misses, um, after
the best rigid motion; with its own mesh and with elements halved once and twice (`closed_loop.model.refined_mesh`).
``left`` is what remains, as a share of what was taken away (`closed_loop.model.settings`, ``remains``).
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from livedeform.closed_loop.inputs import read_inputs
from livedeform.closed_loop.model.fem_model import Body
from livedeform.closed_loop.model.refined_mesh import pressed_more_finely
from livedeform.common.types import Array


def missed(true: Array, predicted: Array) -> Array:
    """Return what of the motion since the first moment is missed (k, m, 3) m, without its best rigid part."""
    d = (true - true[0]) - (predicted - predicted[0])
    axes = [np.broadcast_to(axis, true.shape) for axis in np.eye(3)]
    columns = np.stack([c.ravel() for a in axes for c in (a, np.cross(a, true))], axis=1)
    best = np.linalg.lstsq(columns, d.ravel(), rcond=None)[0]
    return np.asarray(d - (columns @ best).reshape(d.shape))


def rms(d: Array) -> float:
    return float(1e6 * np.sqrt(np.mean(d[1:] ** 2)))


def main(folders: list[str]) -> int:
    for folder in map(Path, folders):
        inputs = read_inputs(folder / "experiment", [folder / "bags" / "a"], [folder / "bags" / "b"])
        if inputs.forward is None:
            raise SystemExit(f"{folder}: no model")
        settings = inputs.settings.discretisation
        (o,), body = inputs.fitted, inputs.forward.body
        few = o.take(np.isin(np.arange(o.n_moments), o.deepest(settings.most_presses)))
        kept = np.load(folder / "truth" / "a.npz")
        at = [int(np.argmin(np.abs(kept["stamps_ns"] - s))) for s in few.stamps_ns]
        true, force, own = kept["markers"][at], kept["force"][at], np.zeros(0)
        for times in range(settings.halved + 1):
            mesh = pressed_more_finely(body, o, replace(settings, halved=times))
            run = Body(replace(body.setting, mesh=mesh)).simulate([], few, ())
            own = run.points if times == 0 else own
            left, taken = rms(missed(true, run.points)), rms(missed(run.points, own))
            share = f", left {left / taken:.2f} of {taken:.1f}" if times else ""
            if run.forces is not None:
                share += f"; force {100.0 * (1.0 - run.forces[1:, 2] / force[1:, 2]).mean():.1f} % short"
            size = len(mesh.nodes)
            print(f"{folder.name:24s} halved {times} x: {size:5d} vertices, misses {left:5.1f} um{share}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
