"""What is as large as the noise on the standard experiment of the blind test.

    python -m benchmarks.blind.sizes [--size N] [--only NAME]

By how much each effect at ``VISIBLE`` (`benchmarks.blind.cases`), or ``--size`` times that, changes the
markers at the fitted key moments: rms mm, and rms per coordinate of the tracker's noise of a frame, before and after
the best rigid registration; and the largest change of the force. By the model at its mesh for the search.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.blind import cases
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Run
from livedeform.closed_loop.inputs import Inputs, read_inputs
from livedeform.closed_loop.settings import SamplingSettings, Settings
from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.mesh.generate import mesh_to_file
from livedeform.synthetic.scenario import make

SAME = 1e-3  # m at most, by which an effect moves a marker of the body at rest


def whitened(o: Observation, d: Array) -> Array:
    """Displacements (k, m, 3) m in units of a frame's noise."""
    L = np.linalg.cholesky(o.single_covariances)
    return np.asarray(np.linalg.solve(L, d[..., None])[..., 0])


def left_by_registration(o: Observation, run: Run, d: Array, seen: np.ndarray) -> Array:
    """Whitened displacements (n,) of the ``seen`` (k, m) markers that no rigid motion takes away."""
    columns = []
    centre = np.nanmean(run.points, axis=(0, 1))
    for axis in np.eye(3):
        columns += [np.broadcast_to(axis, run.points.shape), np.cross(axis, run.points - centre)]
    A = np.column_stack([whitened(o, c)[seen].ravel() for c in columns])
    w = whitened(o, d)[seen].ravel()
    return np.asarray(w - A @ np.linalg.lstsq(A, w, rcond=None)[0])


def rms_over_noise(o: Observation, run: Run, d: Array) -> float:
    """Return the rms of displacements (k, m, 3) m where markers are seen, whitened and registered."""
    seen = np.asarray(np.isfinite(o.single + d).all(axis=2))
    return float(np.sqrt(np.mean(left_by_registration(o, run, d, seen) ** 2)))


def size_over_noise(experiment: Path, recording: Path, effects: Sequence[Mapping[str, Any]]) -> float:
    """Return by how many of a frame's noise, rms per coordinate and after registration, true effects move the markers
    at the key moments of a recording.

    By the loop's model on a coarse mesh; NaN for effects that it does not know or cannot solve.
    """
    inputs = _coarse(experiment, recording)
    assert inputs.forward is not None  # read_inputs makes one
    with inputs.forward as forward:
        o, base = inputs.fitted[0], forward.run([], inputs.fitted)[0]
        values = [_values(effect) for effect in effects]
        try:
            d = forward.run(values, inputs.fitted)[0].points - base.points
        except (InputError, ConvergenceError):
            return float("nan")
    return rms_over_noise(o, base, d)


def size_of_truth(made: Path, plain: Path) -> float:
    """Return the same of an experiment with effects that the loop's model does not know, by the truths of recording a:
    of what was ``made`` with them, and of the ``plain`` one without."""
    inputs = _coarse(made / "experiment", made / "bags" / "a")
    assert inputs.forward is not None  # read_inputs makes one
    with inputs.forward as forward:
        o, base = inputs.fitted[0], forward.run([], inputs.fitted)[0]
    d = moved_between(made / "truth" / "a.npz", plain / "truth" / "a.npz", o.stamps_ns)
    return rms_over_noise(o, base, d)


def moved_between(made: Path, plain: Path, stamps_ns: np.ndarray) -> Array:
    """Return by how much further markers are from rest (k, m, 3) m at ``stamps_ns`` (k,) in one truth than in another;
    NaN for one that the other has not: an effect moves the body at rest, and so the points of it that are drawn."""
    (rest, moved), (of, other) = (_displaced(truth, stamps_ns) for truth in (made, plain))
    far, alike = cKDTree(of).query(rest)
    return np.where((far < SAME)[:, None], moved - other[:, alike], np.nan)


def _displaced(truth: Path, stamps_ns: np.ndarray) -> tuple[Array, Array]:
    """Return a truth's markers at rest (m, 3) m, and their displacements (k, m, 3) m."""
    with np.load(truth) as kept:
        at = np.searchsorted(kept["stamps_ns"], stamps_ns).clip(0, len(kept["stamps_ns"]) - 1)
        return kept["rest"], kept["markers"][at] - kept["rest"]


def _coarse(experiment: Path, recording: Path) -> Inputs:
    """Read an experiment for a model on a coarse mesh."""
    settings = Settings(sampling=SamplingSettings(moments_fit=12, mesh_vertices=200))
    return read_inputs(experiment, [recording], [], candidates=["stereo_scale"], settings=settings)


def _values(effect: Mapping[str, Any]) -> EffectValues:
    return EffectValues(str(effect["name"]), {k: np.asarray(v, float) for k, v in effect.items() if k != "name"})


def measure(inputs: Inputs, names: list[str], size: float) -> None:
    """Prints a line for each effect."""
    assert inputs.forward is not None  # read_inputs makes one
    with inputs.forward as forward:
        o, base = inputs.fitted[0], forward.run([], inputs.fitted)[0]
        for name in names:
            run = forward.run([_values(cases.sized(name, size))], inputs.fitted)[0]
            d = run.points - base.points
            seen = np.asarray(np.isfinite(o.single + d).all(axis=2))
            force = 0.0 if run.forces is None or base.forces is None else np.abs(run.forces - base.forces).max()
            registered = left_by_registration(o, base, d, seen)
            rms = [1e3 * d[seen], whitened(o, d)[seen], registered]
            mm, white, left = (float(np.sqrt(np.mean(x**2))) for x in rms)
            print(
                f"{name:20s} {mm:.3f} mm   {white:.2f} of the noise, registered {left:.2f}   {force:.3f} N", flush=True
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=float, default=1.0)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    wanted = [n for n in cases.VISIBLE if options.only in n]
    special = {"refraction": {"markers": {**cases.STANDARD["markers"], "internal": 8}},
               "thermal_expansion": {"temperature": cases.WARMING}}  # fmt: skip
    for changes in ({}, *special.values()):
        names = [n for n in wanted if special.get(n, {}) == changes]
        if not names:
            continue
        with tempfile.TemporaryDirectory() as folder:
            plain = {key: cases.STANDARD.get(key) for key in ("declared", "markers", "temperature")}
            spec = cases.Case("plain", "none", (), 0.0, 0).scenario() | plain | changes
            make(spec, Path(folder) / "plain", 0, mesher=mesh_to_file)
            at = Path(folder) / "plain"
            inputs = read_inputs(at / "experiment", [at / "bags" / "a"], [at / "bags" / "b"])
            measure(inputs, names, options.size)


if __name__ == "__main__":
    main()
