"""What a phantom of some 20 000 unknowns costs beside its steps: start, memory, and the fit of six parameters.

    python benchmarks/fem_start.py [--cells 6] [--frames 60] [--fit]

Start: from a fresh process with nothing imported to the first prediction (weight, then the probe touching), with the
mesh made as it would be read from the cache. The fit: 60 frames of 40 markers (a press of 10 mm and back at 10 mm/s, 30
Hz, 20 um of noise), Gauss-Newton with the model's own sensitivities (`PhantomModel.simulate`) for modulus, Poisson
ratio, two tilts of gravity and the probe's height and place sideways, from values that are 5 % off. Wall times.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np
from scipy.interpolate import interp1d

import fem_node.contact
from fem_node.solver import SolverSettings

NOISE = 2e-5  # m
SPEED, RATE, DEPTH = 0.01, 30.0, 0.01  # m/s, Hz, m
STEP = 1e-6  # of a parameter's unit, for its sensitivity
SETTINGS = SolverSettings(tolerance=1e-6)
GAP = 2e-6  # m: the contact's usual 10 um would put the fitted tilts off by several sigmas
SOLVED = 13  # depths at which the press is solved
MOST_ITERATIONS = 6
FIRST = """
import time
began = time.process_time()
import sys
sys.path.insert(0, {here!r})
from live import phantom, pose
model = phantom({cells})
rest = model.rest()
top = float(rest.surface[:, 2].max())
model.predict(pose(top - 0.0005))
import resource
print(time.process_time() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, model.space.n_dof)
"""


def start(cells: int) -> None:
    """A fresh process until its first prediction."""
    code = FIRST.format(here=str(__file__).rsplit("/", 1)[0], cells=cells)
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    print(f"{out[2]} unknowns: first prediction after {float(out[0]):.1f} s CPU, peak memory {float(out[1]):.2f} GiB")


def changed(physics, p):
    """The physics at changes ``p`` (6,): E (relative), nu (in units of 0.05), where the probe is sideways (mm), tilts
    (rad), its height (mm). (Density is as good as E to markers: with a rigid probe without friction only density / E
    counts.)"""
    E, nu, sideways, tilt_x, tilt_y, height = p
    material = physics.material
    out = physics.with_material(
        youngs_modulus=material.youngs_modulus * (1.0 + E), poisson_ratio=material.poisson_ratio + 0.05 * nu
    ).with_probe(offset=physics.probe.offset + 1e-3 * np.array([sideways, 0.0, height]))
    gravity = physics.gravity + 9.81 * np.array([tilt_x, tilt_y, 0.0])
    return replace(out, gravity=gravity)


@dataclass
class Run:
    """Of some frames: markers (n, m, 3), and where asked, derivatives (n, m, 3, 6), solutions and how they change."""

    markers: np.ndarray
    tangents: np.ndarray
    states: list
    d_states: list


class Fit:
    """The phantom, its press, and the changed bodies."""

    def __init__(self, cells: int, frames: int, processes: int) -> None:
        from live import phantom, pose

        from fem_node.model import PhantomModel

        fem_node.contact.GAP_TOLERANCE = GAP  # in all processes
        model = phantom(cells)
        self.space, self.physics, self.points = model.space, model.physics, model._markers.points
        self.processes, self.threads = processes, 1 if processes > 1 else None
        top = float(model.rest().surface[:, 2].max())
        times = np.arange(frames) / RATE
        self.depth = np.minimum(SPEED * times, 2.0 * DEPTH - SPEED * (times + 0.5 / RATE)) + 3e-4  # no pose comes twice
        self.stamps = [round(1e9 * t) for t in times]
        self.poses = [replace(pose(top - d), stamp_ns=s) for d, s in zip(self.depth, self.stamps, strict=True)]
        self._model = PhantomModel

    def simulate(self, p: np.ndarray, frames: np.ndarray, starts: list | None, tangents: bool) -> Run:
        """Shared by the processes where there are ``starts``: nothing remembers the frame before."""
        n = self.processes if starts is not None else 1
        parts = np.array_split(np.arange(len(frames)), n)
        jobs = [(p, frames[i], None if starts is None else [starts[k] for k in i], tangents) for i in parts]
        if n == 1:
            return self.part(*jobs[0])
        with ProcessPoolExecutor(n, get_context("fork"), _take, (self,)) as pool:
            done = list(pool.map(_part, jobs))
        return Run(
            np.concatenate([d.markers for d in done]),
            np.concatenate([d.tangents for d in done]),
            [s for d in done for s in d.states],
            [s for d in done for s in d.d_states],
        )

    def between(self, frames: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """What is known of some frames (n, ...), interpolated in the depth to the ``wanted`` ones."""
        line = interp1d(self.depth[frames], values, axis=0, kind="cubic", fill_value="extrapolate")
        return np.asarray(line(self.depth[wanted]))

    def part(self, p: np.ndarray, frames: np.ndarray, starts: list | None, tangents: bool) -> Run:
        """One process's share."""
        from fem_node.followers import Direction

        threads = None if starts is None else self.threads
        model = self._model(
            self.space, changed(self.physics, p), markers=self.points, settings=SETTINGS, threads=threads
        )
        directions = []
        if tangents:
            directions = [Direction(str(k), changed(self.physics, p + STEP * e), STEP) for k, e in enumerate(np.eye(6))]
        poses, stamps = [self.poses[k] for k in frames], [self.stamps[k] for k in frames]
        run = model.simulate(poses, stamps, directions, starts=starts, keep_states=True)
        return Run(np.array([x.markers for x in run.predictions]), run.d_markers, run.states, run.d_states)


_TAKEN: list[Fit] = []  # in a worker: forked, not sent


def _take(problem: Fit) -> None:
    _TAKEN[:] = [problem]


def _part(job: tuple) -> Run:
    return _TAKEN[0].part(*job)


def fit(cells: int, frames: int, processes: int) -> None:
    """Gauss-Newton on all frames until its steps are small.

    The press is solved at some depths on the way down, tangents at a third of those and once only; predictions and
    tangents of the frames are interpolated between them in the depth. After the first time solutions start from where
    the tangents say that they are. At the end all frames are solved: that is what was fitted but for the interpolation.
    """
    problem = Fit(cells, frames, processes)
    truth, every = np.array([0.05, -0.1, 0.1, 0.03, -0.02, 0.1]), np.arange(frames)
    solved = np.unique(np.linspace(0, frames // 2, SOLVED).round().astype(int))
    keys = solved[::3]
    measured = problem.simulate(truth, every, None, False).markers
    measured += NOISE * np.random.default_rng(0).standard_normal(measured.shape)
    p, began = np.zeros(6), time.perf_counter()
    run = problem.simulate(p, solved, None, False)
    at_keys = problem.simulate(p, keys, run.states[::3], True)
    slopes = problem.between(keys, np.array(at_keys.d_states), solved)
    tangents = problem.between(keys, at_keys.tangents, every)
    for iteration in range(MOST_ITERATIONS):
        residual = measured - problem.between(solved, run.markers, every)
        step, sigma = gauss_newton(residual, tangents)
        p = p + step
        tell(f"iteration {iteration + 1}", residual, step, (p - truth) / sigma, sigma, began)
        if np.all(np.abs(step) < 0.5 * sigma):
            break
        starts = [state._replace(x=state.x + d @ step) for state, d in zip(run.states, slopes, strict=True)]
        run = problem.simulate(p, solved, starts, False)
    full = problem.simulate(p, every, None, False).markers
    between = problem.between(solved, run.markers, every)
    apart = 1e6 * (between + np.einsum("nmip,p->nmi", tangents, step) - full)
    rms, differ = 1e6 * np.sqrt(np.nanmean((measured - full) ** 2)), np.sqrt(np.mean(apart**2))
    print(f"at the fit, with all frames solved (not in the time): rms {rms:.2f} um; interpolated: {differ:.2f} um off")


def gauss_newton(residual: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The step (6,) and its uncertainty (6,)."""
    r, J = residual.ravel(), columns.reshape(-1, 6)
    known = np.isfinite(r) & np.isfinite(J).all(axis=1)
    step = np.linalg.lstsq(J[known], r[known], rcond=None)[0]
    return step, NOISE * np.sqrt(np.diag(np.linalg.inv(J[known].T @ J[known])))


def tell(name: str, r: np.ndarray, step: np.ndarray, off: np.ndarray, sigma: np.ndarray, began: float) -> None:
    """One line per iteration."""
    print(f"{name}: rms {1e6 * np.sqrt(np.nanmean(r**2)):.1f} um ({np.isfinite(r).mean():.3f} of the data), ", end="")
    print(f"{time.perf_counter() - began:.1f} s wall; step / sigma {np.round(step / sigma, 1)},", end=" ")
    print(f"errors / sigma {np.round(off, 1)}, sigma {np.round(sigma, 5)}", flush=True)


def main() -> None:
    """Prints both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=6)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--processes", type=int, default=2, help="of the fit")
    arguments = parser.parse_args()
    start(arguments.cells)
    if arguments.fit:
        fit(arguments.cells, arguments.frames, arguments.processes)
        print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


if __name__ == "__main__":
    main()
