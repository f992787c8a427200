"""What a phantom of some 20 000 unknowns costs beside its steps: start, memory, and the fit of six parameters.

    python benchmarks/fem_start.py [--cells 6] [--frames 60] [--fit] [--draws 1]

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
from dataclasses import dataclass, field, replace
from multiprocessing import get_context

import numpy as np
from scipy.interpolate import CubicSpline

from livedeform.fem_node.solve.solver import SolverSettings

NOISE = 2e-5  # m
SPEED, RATE, DEPTH = 0.01, 30.0, 0.01  # m/s, Hz, m
STEP = 1e-6  # of a parameter's unit, for its sensitivity
FINE = SolverSettings(tolerance=1e-6, gap_tolerance=2e-6)  # the usual 10 um would put tilts off by several sigmas
COARSE = SolverSettings(tolerance=1e-5)  # where the parameters are still far off
NAME = "press"  # of the recording
KEYS = 7  # frames with tangents
ON_KEYS = 2  # iterations on these
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
    """Some frames: markers (n, m, 3), where asked derivatives (n, m, 3, 6), and the solved moments by frame."""

    markers: np.ndarray
    tangents: np.ndarray
    solved: dict


class Fit:
    """The phantom, its press, and the changed bodies. A body that forgets may be solved at its frames in any order: in
    that of their depth each is near the one before it, and halves of them are solved side by side."""

    def __init__(self, cells: int, frames: int, processes: int) -> None:
        from live import phantom, pose

        from livedeform.fem_node.model import PhantomModel

        model = phantom(cells)
        self.space, self.physics, self.points = model.space, model.physics, model._markers.points
        top = float(model.rest().surface[:, 2].max())
        times = np.arange(frames) / RATE
        depth = np.minimum(SPEED * times, 2.0 * DEPTH - SPEED * (times + 0.5 / RATE)) + 3e-4  # no pose comes twice
        self.depth = np.sort(depth)
        self.poses = [pose(top - d) for d in self.depth]
        self._model = PhantomModel
        self._processes = processes
        self._pool = ProcessPoolExecutor(processes, get_context("fork"), _take, (self,))

    def simulate(self, p: np.ndarray, jobs: list[Job]) -> Run:
        """The jobs side by side."""
        if self._processes == 1:
            done = [self.part(p, job) for job in jobs]
        else:
            done = list(self._pool.map(_part, [p] * len(jobs), jobs))
        return Run(
            np.concatenate([d.markers for d in done]),
            np.concatenate([d.tangents for d in done]),
            {k: moment for d in done for k, moment in d.solved.items()},
        )

    def part(self, p: np.ndarray, job: Job) -> Run:
        """One process's share."""
        from livedeform.fem_node.path.direction import Direction
        from livedeform.fem_node.path.start import WarmStart

        physics = changed(self.physics, p)
        model = self._model(self.space, physics, markers=self.points, settings=job.settings, threads=1)
        directions = [
            Direction(k, changed(self.physics, p + STEP * e), STEP, at=float(p[k])) for k, e in enumerate(np.eye(6))
        ]
        stamps = [round(1e9 * i / RATE) for i in range(len(job.frames))]
        solved = {(NAME, stamp): job.solved[k] for k, stamp in zip(job.frames, stamps, strict=True) if k in job.solved}
        run = model.simulate(
            [replace(self.poses[k], stamp_ns=stamp) for k, stamp in zip(job.frames, stamps, strict=True)],
            stamps,
            directions if job.tangents else [],
            warm=WarmStart(solved, NAME, dense=True),
        )
        markers = np.array([x.markers for x in run.predictions])
        known = {k: solved[NAME, stamp] for k, stamp in zip(job.frames, stamps, strict=True) if (NAME, stamp) in solved}
        return Run(markers[job.passed :], run.d_markers[job.passed :], known)


@dataclass(frozen=True)
class Job:
    """``frames`` in the order of their depth, of which the first ``passed`` are only on the way; ``solved``: some of
    them by an earlier run."""

    frames: np.ndarray
    settings: SolverSettings
    tangents: bool
    passed: int = 0
    solved: dict = field(default_factory=dict)


_TAKEN: list[Fit] = []  # in a worker: forked, not sent


def _take(problem: Fit) -> None:
    _TAKEN[:] = [problem]


def _part(p: np.ndarray, job: Job) -> Run:
    return _TAKEN[0].part(p, job)


def fit(cells: int, frames: int, processes: int, draws: int) -> None:
    """The fit, for some draws of the noise; the truth is solved frame by frame as it was measured."""
    problem = Fit(cells, frames, processes)
    truth = np.array([0.05, -0.1, 0.1, 0.03, -0.02, 0.1])
    exact = problem.simulate(truth, [Job(np.arange(frames), FINE, tangents=False)]).markers
    for seed in range(draws):
        measured = exact + NOISE * np.random.default_rng(seed).standard_normal(exact.shape)
        began = time.perf_counter()
        p, sigma = fitted(problem, measured)
        off = np.round((p - truth) / sigma, 1)
        print(f"noise {seed}: {time.perf_counter() - began:.1f} s wall; errors / sigma {off}", flush=True)


def fitted(problem: Fit, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (6,) and their sigmas: Gauss-Newton on a few frames, and one step more with all of them.

    The first iteration walks down the press; those after it start from where the tangents say that the solutions are.
    The last one's residual is that of all frames, its tangents are interpolated in the depth: their error is a part
    of the last step, which is a few sigmas long.
    """
    n, p, began = len(problem.depth), np.zeros(6), time.perf_counter()
    keys = np.linspace(0, n - 1, KEYS).round().astype(int)
    middle = KEYS // 2 + 1
    jobs = [Job(keys[:middle], COARSE, True), Job(keys, COARSE, True, passed=middle)]
    for _ in range(ON_KEYS):
        run = problem.simulate(p, jobs)
        step, sigma = gauss_newton(measured[keys] - run.markers, run.tangents)
        tell("few frames", measured[keys] - run.markers, step, sigma, began)
        p = p + step
        jobs = [Job(part, FINE, True, solved=run.solved) for part in (keys[:middle], keys[middle:])]
    half = keys[middle - 1]  # from there both ways
    parts, near = (np.arange(half, -1, -1), np.arange(half, n)), {half: run.solved[half]}
    jobs = [Job(parts[0], FINE, False, solved=near), Job(parts[1], FINE, False, passed=1, solved=near)]
    markers = problem.simulate(p, jobs).markers
    markers = np.concatenate([markers[half::-1], markers[half + 1 :]])
    tangents = CubicSpline(problem.depth[keys], run.tangents)(problem.depth)
    step, sigma = gauss_newton(measured - markers, tangents)
    tell("all frames", measured - markers, step, sigma, began)
    return p + step, sigma


def gauss_newton(residual: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The step (6,) and its uncertainty (6,)."""
    r, J = residual.ravel(), columns.reshape(-1, 6)
    known = np.isfinite(r) & np.isfinite(J).all(axis=1)
    step = np.linalg.lstsq(J[known], r[known], rcond=None)[0]
    return step, NOISE * np.sqrt(np.diag(np.linalg.inv(J[known].T @ J[known])))


def tell(name: str, r: np.ndarray, step: np.ndarray, sigma: np.ndarray, began: float) -> None:
    """One line per iteration."""
    print(f"{name}: rms {1e6 * np.sqrt(np.nanmean(r**2)):.2f} um ({np.isfinite(r).mean():.3f} of the data), ", end="")
    print(f"{time.perf_counter() - began:.1f} s wall; step / sigma {np.round(step / sigma, 1)}, ", end="")
    print(f"sigma {np.round(sigma, 5)}", flush=True)


def main() -> None:
    """Prints both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=6)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--processes", type=int, default=2, help="of the fit")
    parser.add_argument("--draws", type=int, default=1, help="of the noise")
    arguments = parser.parse_args()
    start(arguments.cells)
    if arguments.fit:
        fit(arguments.cells, arguments.frames, arguments.processes, arguments.draws)
        print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


if __name__ == "__main__":
    main()
