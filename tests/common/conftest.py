import os

os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")  # rclpy serialises wrong types to garbage unless asked to look

from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from livedeform.common.experiment.schema import Experiment, ProbeShape
from livedeform.common.experiment.yaml_file import load_experiment

DOCUMENT = """
version: 1
name: block
phantom:
  surface: block.stl
  unit: m
  configuration: unloaded
  element_size: 0.01
  density: 1000.0
  material: {model: neo_hookean, youngs_modulus: 4000.0, poisson_ratio: 0.49}
  gravity: [0.0, 0.0, -9.81]
  support:
    - {region: {below_z: 0.001}, type: fixed}
  markers: markers.csv
  lesions:
    - {name: t1, centre: [0.0, 0.01, 0.03], diameter: 0.01}
probe:
  shape: {box: [0.060, 0.015, 0.040]}
  edge_radius: 0.002
stereo:
  left: left.yaml
  right: right.yaml
loads:
  - {name: weight, region: {above_z: 0.049}, force: [0.0, 0.0, -0.5]}
timeline: {release: 0.0}
effects: []
"""
MARKERS = (
    "id,x,y,z,kind\n1,0.03,0.0,0.02,surface\n2,0.0,0.03,0.02,surface\n5,0.0,0.0,0.05,surface\n7,0.0,0.0,0.02,internal\n"
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An experiment folder with a block of 60 x 60 x 50 mm standing on z = 0."""
    block = trimesh.creation.box((0.06, 0.06, 0.05))
    block.apply_translation((0.0, 0.0, 0.025))
    path = tmp_path / "block"
    path.mkdir()
    block.export(path / "block.stl")
    (path / "markers.csv").write_text(MARKERS)
    (path / "left.yaml").write_text("")
    (path / "right.yaml").write_text("")
    (path / "experiment.yaml").write_text(DOCUMENT)
    return path


@pytest.fixture
def experiment(folder: Path) -> Experiment:
    """The block, scanned as it is held, and a ball that presses it."""
    loaded = load_experiment(folder, geometry=False)
    assert loaded.probe is not None
    phantom = loaded.phantom.model_copy(update={"configuration": "loaded", "scan_gravity": loaded.phantom.gravity})
    probe = loaded.probe.model_copy(update={"shape": ProbeShape(sphere=0.01)})
    return loaded.model_copy(update={"phantom": phantom, "probe": probe})


@pytest.fixture
def change(folder: Path):
    """``change(document -> None)`` edits the YAML of ``folder``; a value of ... deletes the key."""

    def edit(key_path: str, value: object) -> Path:
        document = yaml.safe_load((folder / "experiment.yaml").read_text())
        *parents, key = [int(part) if part.isdigit() else part for part in key_path.split(".")]
        section = document
        for part in parents:
            section = section[part]
        if value is ...:
            del section[key]
        else:
            section[key] = value
        (folder / "experiment.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
        return folder

    return edit


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240)


@pytest.fixture
def public_data() -> Path:
    path = Path(os.environ.get("LIVEDEFORM_DATA", Path(__file__).parents[2] / "../shared/data")).resolve()
    if not path.is_dir():
        pytest.skip(f"public data is not at {path}; set LIVEDEFORM_DATA")
    return path
