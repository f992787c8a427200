"""What a phantom of some 20 000 unknowns costs beside its steps: start, memory, and the fit of six parameters.

    python benchmarks/fem_start.py [--cells 6] [--frames 60] [--fit]

Start: from a fresh process with nothing imported to the first prediction (weight, then the probe touching), with the
mesh made as it would be read from the cache. The fit: 60 frames of 40 markers (a press of 10 mm and back at 10 mm/s, 30
Hz, 20 um of noise), Gauss-Newton with the model's own sensitivities (`PhantomModel.simulate`) for modulus, Poisson
ratio, density, two tilts of gravity and the probe's height, from values that are 5 % off. CPU times.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np

NOISE = 2e-5  # m
SPEED, RATE, DEPTH = 0.01, 30.0, 0.01  # m/s, Hz, m
STEP = 1e-4  # of a parameter's unit, for its sensitivity
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
    """The physics at relative changes ``p`` (6,): E, nu (in units of 0.05), density, tilts (rad), height (mm)."""
    E, nu, density, tilt_x, tilt_y, height = p
    material = physics.material
    out = physics.with_material(
        youngs_modulus=material.youngs_modulus * (1.0 + E), poisson_ratio=material.poisson_ratio + 0.05 * nu
    ).with_probe(offset=physics.probe.offset + np.array([0.0, 0.0, 1e-3 * height]))
    gravity = physics.gravity + 9.81 * np.array([tilt_x, tilt_y, 0.0])
    return replace(out, density=physics.density * (1.0 + density), gravity=gravity)


def fit(cells: int, frames: int) -> None:
    """Gauss-Newton to convergence (or six iterations)."""
    from live import phantom, pose

    from fem_node.followers import Direction
    from fem_node.model import PhantomModel

    model = phantom(cells)
    top = float(model.rest().surface[:, 2].max())
    times = np.arange(frames) / RATE
    depth = np.minimum(SPEED * times, 2.0 * DEPTH - SPEED * times) + 3e-4
    stamps = [round(1e9 * t) for t in times]
    poses = [replace(pose(top - d), stamp_ns=s) for d, s in zip(depth, stamps, strict=True)]
    base, points = model.physics, model._markers.points
    truth = np.array([0.05, -0.1, -0.05, 0.03, -0.02, 0.1])

    def at(p):
        return PhantomModel(model.space, changed(base, p), markers=points)

    began = time.process_time()
    measured = np.array([r.markers for r in at(truth).simulate(poses, stamps).predictions])
    print(f"truth: {frames} frames in {time.process_time() - began:.1f} s CPU", flush=True)
    measured += NOISE * np.random.default_rng(0).standard_normal(measured.shape)
    p, began = np.zeros(6), time.process_time()
    for iteration in range(6):
        directions = [Direction(str(k), changed(base, p + STEP * e), STEP) for k, e in enumerate(np.eye(6))]
        run = at(p).simulate(poses, stamps, directions)
        r = (measured - np.array([x.markers for x in run.predictions])).ravel()
        J = run.d_markers.reshape(-1, 6)
        known = np.isfinite(r) & np.isfinite(J).all(axis=1)
        step = np.linalg.lstsq(J[known], r[known], rcond=None)[0]
        sigma = NOISE * np.sqrt(np.diag(np.linalg.inv(J[known].T @ J[known])))
        p = p + step
        print(
            f"iteration {iteration + 1}: rms {1e6 * np.sqrt(np.mean(r[known] ** 2)):.1f} um, {known.mean():.3f} of the "
            f"data, errors / sigma {np.round((p - truth) / sigma, 1)}, {time.process_time() - began:.1f} s CPU",
            flush=True,
        )
        if np.all(np.abs(step) < 0.1 * sigma):
            break


def main() -> None:
    """Prints both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=6)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--fit", action="store_true", help="minutes")
    arguments = parser.parse_args()
    start(arguments.cells)
    if arguments.fit:
        fit(arguments.cells, arguments.frames)
        print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


if __name__ == "__main__":
    main()
