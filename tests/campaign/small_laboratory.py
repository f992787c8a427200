"""A laboratory of small phantoms whose recordings are jobs that cost nothing: neither run nor diagnosed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import yaml

from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.types import MarkerFrame
from livedeform.fem_node.mesh.generate import write_mesh
from livedeform.fem_node.mesh.structured import block_mesh

START_NS = 1_700_000_000_000_000_000
ONLY_READ = "version: 1\nrun: null\ndiagnose: null\n"
PROGRAM = "from livedeform.cli import main\nif __name__ == '__main__':\n    main()\n"


def write_phantom(folder: Path, *, youngs_modulus: float = 8000.0) -> Path:
    """A block of 4 cm with three markers: ``folder/experiment.yaml`` and its files."""
    folder.mkdir(parents=True)
    write_mesh(folder / "block.vtu", block_mesh((0.04, 0.04, 0.03), (2, 2, 2)))
    (folder / "markers.csv").write_text("id,x,y,z\n1,0,0,0.03\n2,0.01,0,0.03\n3,0,0.01,0.03\n")
    document = {
        "version": 1,
        "name": folder.name,
        "phantom": {
            "mesh": "block.vtu",
            "configuration": "unloaded",
            "density": 1000.0,
            "material": {"model": "neo_hookean", "youngs_modulus": youngs_modulus, "poisson_ratio": 0.49},
            "support": [{"region": {"below_z": 0.0005}, "type": "fixed"}],
            "markers": "markers.csv",
        },
    }
    (folder / "experiment.yaml").write_text(yaml.safe_dump(document))
    return folder


def write_take(path: Path, number: int) -> Path:
    """A recording of three frames, another one for each ``number``."""
    points = np.array([[0.0, 0.0, 0.03], [0.01, 0.0, 0.03], [0.0, 0.01, 0.03]]) + 1e-5 * number
    covariances = np.tile(1e-10 * np.eye(3), (3, 1, 1))
    with BagWriter(path, {"made_by": "tests"}) as bag:
        writer = RecordingWriter(bag)
        for k in range(3):
            stamp = START_NS + number * 10**9 + k * 50_000_000
            writer.marker_frame(MarkerFrame(stamp, np.arange(1, 4, dtype=np.uint32), points, covariances, np.zeros(3)))
    return path


def write_laboratory(folder: Path, phantoms: int, takes: int) -> Path:
    """``phantoms`` with ``takes`` recordings each, and a campaign.yaml by which they are only read."""
    for i in range(phantoms):
        home = write_phantom(folder / f"phantom-{i:02d}")
        for k in range(takes):
            write_take(home / f"take-{k:02d}.mcap", takes * i + k)
    (folder / "campaign.yaml").write_text(ONLY_READ)
    return folder


def start(source: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    """``livedeform campaign`` in a process group of its own."""
    script = out.parent / "livedeform_program.py"
    script.write_text(PROGRAM)
    words = [sys.executable, str(script), "campaign", str(source), "--out", str(out), *options]
    return subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, env=dict(os.environ)
    )
