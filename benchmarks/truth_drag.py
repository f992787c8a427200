"""How much a probe drags the surface of the truth sideways, by the size of the truth's elements, and of the model's.

    python -m benchmarks.truth_drag dome --elements 8,2 12,3        # the second takes up to 40 min
    python -m benchmarks.truth_drag block --elements 8,5,5 12,8,6

Presses a body in steps of 0.5 mm, with a friction and without, and prints the force along x at each depth: without
friction, and what friction adds to it. On a flat block the first should be little. ``--model`` adds `fem_node` on the
mesh of the experiment, with tetrahedra of 12 mm.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Array, EffectValues, Pose
from livedeform.fem_node.mesh.generate import mesh_to_file
from livedeform.fem_node.model import PhantomModel
from livedeform.synthetic import scenario
from livedeform.synthetic.solved_motion import build_truth

STEP, DOWN = 5e-4, np.diag([1.0, -1.0, -1.0])
DECLARED = {"youngs_modulus": 4000.0, "poisson_ratio": 0.49, "configuration": "unloaded", "element_size": 0.012}
BODIES: dict[str, dict[str, Any]] = {
    "dome": {"shape": "hemi_ellipsoid", "semi_axes": [0.04, 0.04, 0.035], "elements": [8, 2], "focus": 1.5},
    "block": {"shape": "block", "size": [0.072, 0.052, 0.05], "elements": [8, 5, 5], "focus": 1.4},
}
PLACES = {"dome": (0.008, 0.0, 0.028), "block": (-0.008, 0.012, 0.0455)}  # m, where the probe gets to
ABOVE = 0.008  # m above that, where it begins


def spec(body: str, elements: list[int], friction: float) -> dict[str, Any]:
    """Return the scenario with so many elements."""
    truth = [{"name": "probe_friction", "mu": friction}] if friction > 0.0 else []
    x, y, _ = PLACES[body]
    return {
        "version": 1,
        "name": "drag",
        "body": {**BODIES[body], "elements": elements},
        "declared": DECLARED,
        "probe": {"shape": {"sphere": 0.025}, "edge_radius": 0.0, "friction": 0.0},
        "markers": {"surface": 12, "internal": 0, "support": 4},
        "measuring": {"kind": "markers", "rate": 5.0, "noise_px": 0.08},
        "truth": truth,
        "recordings": {"a": [{"at": [x, y], "depth": 1e-3}]},
    }


def poses(body: str) -> Array:
    """Return the probe's places (k, 3) m, going down."""
    end = np.array(PLACES[body])
    return end + np.outer(np.arange(ABOVE, -STEP / 2, -STEP), [0.0, 0.0, 1.0])


def of_truth(body: str, elements: list[int], friction: float) -> Array:
    """Return the probe's forces (k, 3) N on the truth."""
    _, solved, _ = build_truth(scenario.load(spec(body, elements, friction)))
    solved.rest()
    T, forces = np.eye(4), []
    T[:3, :3] = DOWN
    for k, place in enumerate(poses(body)):
        T[:3, 3] = place
        forces.append(solved.step(T.copy(), 0.1 * k).force)
    solved.factors.close()
    return np.array(forces)


def of_model(body: str, friction: float) -> Array:
    """Return the probe's forces (k, 3) N on the model."""
    with tempfile.TemporaryDirectory() as out:
        scenario.make(spec(body, BODIES[body]["elements"], 0.0), Path(out), mesher=mesh_to_file)
        rubs = [EffectValues("probe_friction", {"mu": np.array(friction)})] if friction > 0.0 else []
        model = PhantomModel.from_experiment(load_experiment(Path(out) / "experiment"), effects=rubs)
    turn = Rotation.from_matrix(DOWN).as_quat()
    return np.array([model.predict(Pose(k * 10**8, p, turn)).force for k, p in enumerate(poses(body))])


def report(name: str, places: Array, slides: Array, rubs: Array) -> None:
    """Print the force along x at the ``places`` (k, 3) m of the probe: without friction, and what friction adds, mN."""
    print(f"{name}: the probe's height, mm | along z, along x without friction, what friction adds, mN")
    for k in np.flatnonzero(slides[:, 2] != 0.0):
        (x, _, z), added = 1e3 * slides[k], 1e3 * (rubs[k] - slides[k])[0]
        print(f"  {1e3 * places[k, 2]:4.1f} | {z:8.1f} {x:8.2f} {added:8.2f}", flush=True)


def main() -> None:
    """Print a table for each number of elements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("body", choices=list(BODIES))
    parser.add_argument("--elements", nargs="*", default=[], help="numbers of the truth's elements, as 8,2")
    parser.add_argument("--friction", type=float, default=0.1)
    parser.add_argument("--model", action="store_true")
    options = parser.parse_args()
    places = poses(options.body)
    for text in options.elements:
        n = [int(v) for v in text.split(",")]
        report(f"truth {text}", places, of_truth(options.body, n, 0.0), of_truth(options.body, n, options.friction))
    if options.model:
        report("model", places, of_model(options.body, 0.0), of_model(options.body, options.friction))


if __name__ == "__main__":
    main()
