"""How well a released beam is predicted with effects that are named: fitted together to take a, judged on take b.

python benchmarks/beam_release.py --data DATA [--case gravity] [--runs 8]
python benchmarks/beam_release.py --data DATA --case both
python benchmarks/beam_release.py --data DATA --case load52 --given 4.7e-4,0.245,0.22,60,0.903,0.174,0.045,0.0067,1e-4

With ``both`` takes a of both load cases are fitted together, each with its own loads (`recordings:`). With values that
are given (in the order of `START`, as far as they can act) nothing is fitted: so those of one load predict another. A
fit goes on from values with ``--start``, without the rough fits before it. The loop
has to find these effects; here they are given, so what is left is the model's. Beside the stated release the error is
given with the take's own one (within three of its sigmas).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from livedeform.closed_loop.forward import stack
from livedeform.closed_loop.inference.fitted_model import Added, FittedModel
from livedeform.closed_loop.inference.forward_selection import ForwardSelection
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.inputs import Inputs, read_inputs
from livedeform.common.types import Array
from livedeform.importing.silicone_beam import BOTH, RELEASE_SIGMA, TIP, import_beam
from livedeform.studies.public.beam import CELLS, mesh, predicted_and_measured
from livedeform.studies.public.swings import release_of, rms_error, swings_of

FADES = (1.0, 1.5, 2.0, 2.5)  # s after the release
# where the fit starts: a power law, a beam that is held a little below level, a weight that is held a little longer
START: Mapping[str, Mapping[str, float]] = {
    "inertia": {"rayleigh_beta": 3e-4},
    "viscoelasticity": {"strength": 0.3, "exponent": 0.3, "held": 10.0},
    "stiffness": {"ratio": 0.95},
    "scan_gravity": {"fraction": 0.1},
    "late_load": {"delay": 0.03},
    "load_friction": {"ratio": 0.001, "give": 2e-5},
    "density": {"ratio": 1.03},
}


def started(inputs: Inputs, given: str = "") -> FittedModel:
    """Return the model with the named effects at their start, or at the ``given`` values."""
    wanted = sum(len(start) for name, start in START.items() if name in inputs.candidates)
    values = [float(v) for v in given.split(",")] if given else []
    if len(values) not in (0, wanted):
        raise SystemExit(f"{len(values)} values are given; {wanted} are needed, in the order of START")
    added, numbers = [], iter(values)
    for name, start in START.items():
        if name not in inputs.candidates:
            continue
        own = {key: next(numbers, value) for key, value in start.items()}
        c = inputs.candidates[name]
        c = next((f for f in c.forms if f.form and f.form.released), c)
        added.append(Added(c, np.array([x.z(own[x.parameter]) for x in c.coordinates])))
    return FittedModel(inputs.uncertain, tuple(added))


def method_of(inputs: Inputs) -> ForwardSelection:
    """Return the loop's method for these takes."""
    assert inputs.forward is not None
    return ForwardSelection.of(inputs.settings, inputs.forward, inputs.fitted, inputs.candidates, inputs.uncertain)


def stated(method: ForwardSelection, model: FittedModel) -> Problem:
    """State the problem at a model, as the loop fits a finished set."""
    run = stack(method.fitter.forward.run(model.effects, method.observations, model.allowed_columns))
    return replace(method.fitter.problems, one_load=True, lasts=True).at(model, run, [])[0]


def fitted(inputs: Inputs, runs: int, start: str = "") -> FittedModel:
    """Fit all of them together in so many ``runs`` of the whole, roughly first unless a ``start`` is given."""
    model, method = started(inputs, start), method_of(inputs)
    problem = stated(method, model)
    marginal = problem.marginal
    fit = method.fitter.fit(problem, marginal, model, range(len(model.added)), runs, goes_on=bool(start))
    if fit is None:
        raise SystemExit("the model cannot be solved there")
    left = float(np.sum(marginal(fit.residual) ** 2))
    print(f"{problem.rows.n} data, chi2 {problem.chi2:.0f} at the start, {left:.0f} in the end")
    return model.with_fit(fit)


def left_by_axis(problem: Problem) -> Array:
    """Return the chi2 (3,) that is left along x, y and z when all that is uncertain in common is where it leaves
    least."""
    whitener = problem.covariance.whitener
    Z, r = whitener.whiten(problem.nuisance.columns), whitener.whiten(problem.residual)
    left = r - Z @ np.linalg.solve(np.eye(Z.shape[1]) + Z.T @ Z, Z.T @ r)
    return np.bincount(problem.rows.axis[np.concatenate(whitener.picks)], weights=left**2, minlength=3)


def fading(seconds: Array, height: Array) -> Array:
    """Return the sd (k,) m of a ``height`` (n,) in half seconds from each of `FADES` on, about a straight line."""
    out = []
    for start in FADES:
        here = (seconds >= start) & (seconds < start + 0.5)
        line = np.polyfit(seconds[here], height[here], 1)
        out.append(np.std(height[here] - np.polyval(line, seconds[here])))
    return np.array(out)


def main() -> None:
    """Fit, and print what each take's tip does."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--case", default="gravity", choices=["gravity", "load52", BOTH])
    parser.add_argument("--given", default="")
    parser.add_argument("--start", default="")
    parser.add_argument("--runs", type=int, default=8)
    args = parser.parse_args()
    folder = args.data / "silicone_beam"
    with tempfile.TemporaryDirectory() as out:
        files = sorted(folder.glob("*.c3d" if args.case == BOTH else f"*{args.case}*.c3d"))
        experiment = import_beam(files, folder / "beam.stl", Path(out), mesh(CELLS))[-1]
        fit, test = (sorted((experiment / "bags").glob(f"*_{take}.mcap")) for take in "ab")
        began = time.process_time()
        # what a beam weighs is told from how stiff it is where loads differ
        names = [name for name in START if name != "density" or args.case == BOTH]
        inputs = read_inputs(experiment, fit, test, candidates=names, processes=1)
        model = started(inputs, args.given) if args.given else fitted(inputs, args.runs, args.start)
        for a in model.added:
            values = [
                f"{x.parameter} {x.value(float(z)):.4g}" for x, z in zip(a.candidate.coordinates, a.z, strict=True)
            ]
            print(a.candidate.name, ", ".join(values))
        print(f"{time.process_time() - began:.0f} s of one core")
        problem = stated(method_of(inputs), model)
        axes = ", ".join(f"{v:.0f}" for v in left_by_axis(problem))
        print(f"stated at these values, chi2 {problem.chi2:.0f}; of it along x, y, z: {axes}")
        for o in (*inputs.fitted, *inputs.held_out):
            seconds, measured, (before, after) = predicted_and_measured(experiment, o, [[], model.effects])
            seen = np.isfinite(measured).any(axis=(0, 2))  # each load case has markers of its own
            tips = [p[:, seen][:, TIP] for p in (measured, before, after)]
            shift = release_of(seconds, tips[0], tips[2], 3.0 * RELEASE_SIGMA)
            errors = [
                1e3 * rms_error(seconds, tips[0], p, s) for p, s in ((tips[1], 0.0), (tips[2], 0.0), (tips[2], shift))
            ]
            print(o.name, "tip rmse mm: declared {:.3f}, fitted {:.3f}, with its own release {:.3f}".format(*errors))
            print(f"  released {1e3 * shift:+.1f} ms from the stated one; error by axis, end:", end=" ")
            end = seconds > seconds[-1] - 0.5
            print(np.round(1e3 * np.nanmean((tips[0] - tips[2])[end], axis=(0, 1)), 3), "mm")
            for name, p in zip(("measured", "predicted"), (tips[0], tips[2]), strict=True):
                s = swings_of(seconds, np.nanmean(p[:, :, 2], axis=1))
                print(f"  {name}: {s.hertz:.3f} Hz, damping {s.damping:.4f}, creep {1e3 * s.creep:+.4f} mm", end="; ")
                left = 1e3 * fading(seconds, np.nanmean(p[:, :, 2], axis=1))
                print(f"swing by half seconds from {FADES[0]:g} s on, mm:", *(f"{v:.3f}" for v in left))


if __name__ == "__main__":
    main()
