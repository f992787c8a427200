"""All benchmarks, one after another: python -m benchmarks [NAME...]."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
SHIPPED = HERE.parent / "bags" / "breast_phantom"
DATA = Path(os.environ.get("LIVEDEFORM_DATA", HERE.parents[1] / "shared" / "data"))
ARGUMENTS = {
    "bag_writer": [],
    "recorder": [],
    "stereo_speed": [],
    "stereo_accuracy": ["--data", str(DATA)],
    "stereo_calibration": ["--data", str(DATA)],
    "fem_speed": [],
    "fem_reference": [],
    "fem_start": [],
    "live": [],
    "latency": [str(SHIPPED / "experiment"), "--bag", str(SHIPPED / "bags" / "a"), "--duration", "10"],
    "beam_static": ["--data", str(DATA)],
}


def main(names: list[str]) -> int:
    """Runs the named benchmarks, or all; returns how many failed."""
    failed = 0
    for name in names or ARGUMENTS:
        print(f"\n== {name}", flush=True)
        command = [sys.executable, "-m", f"benchmarks.{name}", *ARGUMENTS.get(name, [])]
        failed += subprocess.run(command, cwd=HERE.parent).returncode != 0
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
