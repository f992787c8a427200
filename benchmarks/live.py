"""Live prediction of a breast phantom: time per pose, error against the full model, start with a cached library.

    python benchmarks/live.py [--cells 6] [--compare 8] [--seed 1] [--cache FOLDER]

A hemi-ellipsoid 100 mm across (quadratic tetrahedra with constant pressure), pressed 10 mm by a box of 40 x 28 mm with
round edges (12 mm). The library is trained along the press; the frames that are timed lie between its poses (10 mm/s at
30 Hz), displaced sideways and tilted by as much as a robot that repeats a path may be. Some frames are solved by the
full model as well.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common import frames
from livedeform.common.types import Pose, Prediction
from livedeform.fem_node.contact.probe_shapes import Box
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.live.live_model import LivePredictor, LiveSettings
from livedeform.fem_node.mesh.generate import hemi_ellipsoid_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Support

DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()


def phantom(n: int) -> PhantomModel:
    """The body, with ``n`` cells across its core."""
    space = make_space(hemi_ellipsoid_mesh([0.05, 0.05, 0.05], n), "p2p0")
    physics = Physics(
        MaterialSpec("neo_hookean", 4000.0, 0.49),
        supports=(Support(lambda points: points[:, 2] < 1e-6),),
        probe=Probe(Box(0.04, 0.028, 0.04, 0.012)),
    )
    rng = np.random.default_rng(0)
    around, down = rng.uniform(0.0, 2.0 * np.pi, 40), rng.uniform(0.1, 1.4, 40)
    markers = 0.05 * np.column_stack([np.cos(around) * np.sin(down), np.sin(around) * np.sin(down), np.cos(down)])
    return PhantomModel(space, physics, markers=markers)


def pose(z: float, sideways=(0.0, 0.0), tilt_deg=(0.0, 0.0)) -> Pose:
    turn = Rotation.from_euler("xy", tilt_deg, degrees=True).as_matrix() @ DOWN
    return frames.matrix_pose(frames.transform(turn, np.array([*sideways, z])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=6, help="across the core: 6 are 22 000 unknowns")
    parser.add_argument("--depth", type=float, default=0.010, help="m")
    parser.add_argument("--spacing", type=float, default=1e-3, help="of the library along the path, m")
    parser.add_argument(
        "--tolerance", type=float, default=1e-4, help="error estimate above which the full model answers"
    )
    parser.add_argument("--compare", type=int, default=8, help="frames that the full model solves too")
    parser.add_argument("--jitter", type=float, default=1e-4, help="m sideways, and 2 rad/m of it in tilt")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "livedeform-live")
    parser.add_argument("--seed", type=int, default=1, help="of the poses beside the path")
    options = parser.parse_args()

    began = time.perf_counter()
    model = phantom(options.cells)
    top = round(float(model.rest().surface[:, 2].max()), 6)
    live = LivePredictor(
        model, settings=LiveSettings(options.tolerance, options.spacing), progress=lambda text: print(text, flush=True)
    )
    live.train([pose(top - d) for d in np.arange(-0.001, options.depth + 1e-9, 1e-4)], options.cache)
    first = live.predict(pose(top + 0.001))
    print(f"{model.space.n_dof} unknowns, {len(live.library)} solutions, c = {live.coefficient:.0f} 1/m")
    print(f"start to first prediction: {time.perf_counter() - began:.1f} s wall ({first.error_bound:.1e} m)")

    rng = np.random.default_rng(options.seed)
    depths = np.concatenate([np.arange(-0.001, options.depth, 1 / 3000), np.arange(options.depth, -0.001, -1 / 3000)])
    path = [
        pose(top - d, options.jitter * rng.normal(size=2), 2e3 * options.jitter * rng.normal(size=2)) for d in depths
    ]
    cpu, wall, answers = [], [], []
    before = live.counts.live
    for p in path:
        c, w = time.process_time(), time.perf_counter()
        answers.append(live.predict(p))
        cpu.append(time.process_time() - c)
        wall.append(time.perf_counter() - w)
    for name, times in (("CPU", cpu), ("wall", wall)):
        ms = 1e3 * np.array(times)
        print(f"{name} ms per pose: median {np.median(ms):.1f}, p99 {np.percentile(ms, 99):.1f}, worst {ms.max():.1f}")
    print(f"{live.counts.live - before} of {len(path)} live, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    compare(model, path, answers, options.compare)
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


def compare(model: PhantomModel, path: list[Pose], answers: list[Prediction], n: int) -> None:
    """Errors of some live frames against the full model, pressed in the order of the path to five times its usual
    exactness, and how many are above their estimate."""
    model.mechanics.contact.gap_tolerance *= 0.2
    model.reset()
    pressed = [k for k, a in enumerate(answers) if a.error_bound > 0.0 and np.linalg.norm(a.force) > 0.0]
    errors, bounds, forces = [], np.zeros(0), []
    for k in pressed[:: max(1, len(pressed) // n)]:
        full = model.predict(path[k])
        if not full.converged:
            print(f"frame {k}: the full model did not converge: {full.message}")
            continue
        error = np.linalg.norm(full.surface - answers[k].surface, axis=1)
        errors.append(error)
        bounds = np.append(bounds, answers[k].error_bound)
        forces.append(np.linalg.norm(full.force - answers[k].force) / np.linalg.norm(full.force))
        print(
            f"frame {k}: p99 {1e3 * np.percentile(error, 99):.3f}, max {1e3 * error.max():.3f} mm, estimate "
            f"{1e3 * bounds[-1]:.3f} mm; markers max {1e3 * np.abs(full.markers - answers[k].markers).max():.3f} mm; "
            f"force {100 * forces[-1]:.1f} %",
            flush=True,
        )
    if errors:
        all_ = 1e3 * np.concatenate(errors)
        print(f"error of {all_.size} nodes: p99 {np.percentile(all_, 99):.3f} mm, max {all_.max():.3f} mm")
        reached = np.array([np.percentile(error, 99) for error in errors])
        above, far = int(np.sum(reached > bounds)), int(np.sum(reached > 1e-4))
        print(f"{above} of {len(reached)} frames above their estimate, {far} above 0.1 mm")
        print(f"estimates: median {1e3 * np.median(bounds):.3f} mm, largest {1e3 * bounds.max():.3f} mm")


if __name__ == "__main__":
    main()
