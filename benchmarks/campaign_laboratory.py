"""A small laboratory for campaigns that are really run: phantoms of gel, some takes of each, made by the other solver.

    python -m benchmarks.campaign_laboratory FOLDER [--phantoms 2] [--takes 3] [--faults]

All recordings are seen through one camera pair, whose scale is off by 2 %; every second phantom is stiffer than
declared, too. With ``--faults`` the last phantom's last bag is torn, and one more phantom has a mistake in its
experiment.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

import yaml

from livedeform.fem_node.mesh.generate import mesh_to_file
from livedeform.synthetic.scenario import make

SCALE, STIFFER = 1.02, 1.3
CANDIDATES = ("stiffness", "density", "stereo_scale")
TORN, MISTAKE = 4000, "densitty"  # bytes that are left of a bag; of "density"


def scenario(number: int, takes: int) -> dict[str, Any]:
    """A phantom that is pressed once per take, each time at another place and as deep as no other time."""
    truth: list[dict[str, Any]] = [{"name": "stereo_scale", "scale": SCALE}]
    if number % 2:
        truth.append({"name": "stiffness", "ratio": STIFFER})
    presses = {
        f"take-{k:02d}": [{"at": [2e-3 * (k % 5), 1e-3 * number], "depth": 0.002 + 1e-4 * k, "hold": 1.0, "pause": 1.0}]
        for k in range(takes)
    }
    return {
        "version": 1,
        "name": f"gel-{number}",
        "body": {"shape": "block", "size": [0.04, 0.04, 0.03], "elements": [4, 4, 3], "focus": 1.3},
        "declared": {"youngs_modulus": 4000.0, "poisson_ratio": 0.49, "configuration": "unloaded"}
        | {"element_size": 0.012, "sigmas": {"youngs_modulus": 1200.0, "density": 5.0}},
        "probe": {"shape": {"sphere": 0.015}, "edge_radius": 0.0, "friction": 0.0},
        "markers": {"surface": 20, "internal": 0, "support": 4},
        "measuring": {"kind": "markers", "rate": 4.0, "noise_px": 0.08},
        "path_step": 0.004,
        "truth": truth,
        "recordings": presses,
    }


def write(folder: Path, phantoms: int = 2, takes: int = 3, *, faults: bool = False) -> Path:
    """Make the laboratory and its campaign.yaml; return ``folder``."""
    for number in range(phantoms):
        make(scenario(number, takes), folder / f"gel-{number}", seed=number, mesher=mesh_to_file)
        shutil.rmtree(folder / f"gel-{number}" / "truth")
    if faults:
        last = folder / f"gel-{phantoms - 1}" / "bags" / f"take-{takes - 1:02d}"
        torn = next(last.glob("*.mcap"))
        torn.write_bytes(torn.read_bytes()[:TORN])
        shutil.copytree(folder / "gel-0", folder / "mistaken")
        shutil.rmtree(folder / "mistaken" / "bags" / "take-00")
        experiment = folder / "mistaken" / "experiment" / "experiment.yaml"
        experiment.write_text(experiment.read_text().replace("density:", f"{MISTAKE}:", 1))
    steps = {"run": {"at_frames": True}, "diagnose": {"candidates": list(CANDIDATES), "max_effects": 2}}
    (folder / "campaign.yaml").write_text(yaml.safe_dump({"version": 1, **steps}))
    return folder


def main() -> None:
    """Make a laboratory where it is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--phantoms", type=int, default=2)
    parser.add_argument("--takes", type=int, default=3)
    parser.add_argument("--faults", action="store_true", help="A torn bag, and a mistake in an experiment.")
    asked = parser.parse_args()
    write(asked.folder, asked.phantoms, asked.takes, faults=asked.faults)


if __name__ == "__main__":
    main()
