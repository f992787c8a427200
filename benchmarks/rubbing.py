"""What a probe that rubs costs: contact solved whole in each of Newton's steps, against the ordinary way.

    python -m benchmarks.rubbing [--poses 12]

Poses of the shipped recordings, far apart, go through the full model with a friction of 0.5: under the gelatin cuboid's
box and the breast phantom's ball. CPU seconds and their ratio, and how far the markers are from an answer that is ten
times as exact (both stop within 10 um of contact and some per cent of the largest friction limit).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.solve.solver import SolverSettings
from livedeform.shipped import BREAST, CUBOID, shipped

RUBS = EffectValues("probe_friction", {"mu": np.array(0.5)})
WHOLE = SolverSettings()
WAYS = {"exact": replace(WHOLE, gap_tolerance=1e-6), "whole": WHOLE, "ordinary": replace(WHOLE, condensed=False)}


def predicted(name: str, n: int, settings: SolverSettings) -> tuple[Array, float]:
    """Return the markers (k, m, 3) m at about ``n`` poses of a shipped recording, and the CPU seconds that it took."""
    folder = shipped(name)
    experiment = load_experiment(folder / "experiment")
    poses = load_recording(folder / "bags" / "a", experiment).poses
    model = PhantomModel.from_experiment(experiment, effects=[RUBS], settings=settings)
    start = time.process_time()
    markers = [model.predict(pose).markers for pose in poses[:: max(1, len(poses) // n)]]
    return np.array(markers), time.process_time() - start


def main() -> None:
    """Print a line for each body."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=12)
    n = parser.parse_args().poses
    for name in (CUBOID, BREAST):
        found = {way: predicted(name, n, settings) for way, settings in WAYS.items()}
        off = {way: 1e6 * np.sqrt(np.nanmean((found[way][0] - found["exact"][0]) ** 2)) for way in WAYS}
        whole, ordinary = found["whole"][1], found["ordinary"][1]
        print(
            f"{name}, {len(found['whole'][0])} poses: whole {whole:.1f} s, ordinary {ordinary:.1f} s, ratio "
            f"{ordinary / whole:.1f}; {off['whole']:.2f} and {off['ordinary']:.2f} um rms from the exact one",
            flush=True,
        )


if __name__ == "__main__":
    main()
