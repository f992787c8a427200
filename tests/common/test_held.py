"""Which rigid motions of the body its supports leave free is said, and what holds it then."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from livedeform.common.checks.contact.held import check_held, free_motions
from livedeform.common.experiment.plausibility import read_body
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.inspection import inspect_experiment

BAGS = Path(__file__).parents[2] / "bags"
FREE_FRICTION = "only the probe may hold it, which has no friction, while it touches and as far as its shape does"


def block(edge: float = 0.01) -> trimesh.Trimesh:
    mesh = trimesh.creation.box((0.06, 0.06, 0.05)).subdivide_to_size(edge)
    mesh.apply_translation((0.0, 0.0, 0.025))
    return mesh


def surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64))


def declared(folder: Path, *supports: dict, **more: object) -> Experiment:
    document = yaml.safe_load((folder / "experiment.yaml").read_text())
    document["phantom"]["support"] = list(supports)
    document.update(more)
    (folder / "experiment.yaml").write_text(yaml.safe_dump(document))
    return load_experiment(folder, geometry=False)


BELOW, SIDE = {"below_z": 0.001}, {"box": [[-0.031, -0.04, -0.01], [-0.0299, 0.04, 0.06]]}
BACK = {"box": [[-0.04, -0.031, -0.01], [0.04, -0.0299, 0.06]]}


def sliding(region: dict) -> dict:
    return {"region": region, "type": "sliding"}


def test_a_fixed_base_holds_everything(folder: Path) -> None:
    experiment = declared(folder, {"region": BELOW})
    assert check_held(experiment, surface(block())) == []


@pytest.mark.parametrize(
    ("supports", "said"),
    [
        ([BELOW], "shifts along x and y and a turn about z"),
        ([SIDE], "shifts along y and z and a turn about x"),
        ([BELOW, SIDE], "a shift along y"),
        ([{"below_z": 0.012}], "shifts along x and y and a turn about z"),  # with the foot of its walls
    ],
)
def test_sliding_supports_leave_motions_free(supports: list[dict], said: str, folder: Path) -> None:
    experiment = declared(folder, *map(sliding, supports))
    (found,) = check_held(experiment, surface(block()))
    assert found.level == "WARN" and not found.doubts and "'fixed'" in found.remedy
    assert found.text == f"the supports leave {said} of the whole body free: {FREE_FRICTION}"


def test_three_sliding_walls_hold_everything(folder: Path) -> None:
    assert check_held(declared(folder, *map(sliding, (BELOW, SIDE, BACK))), surface(block())) == []


def test_what_else_holds_it_is_said(folder: Path) -> None:
    shape = {"shape": {"sphere": 0.01}}
    rubs = declared(folder, sliding(BELOW), probe={**shape, "contact": {"friction": 0.3}})
    (found,) = check_held(rubs, surface(block()))
    assert found.text.endswith("free: only the probe holds it, while it touches")
    alone = declared(folder, sliding(BELOW)).model_copy(update={"probe": None})
    (found,) = check_held(alone, surface(block()))
    assert found.text.endswith("free, and nothing else holds it")
    springs = declared(folder, sliding(BELOW), effects=[{"name": "base_slip", "stiffness": 1e5}])
    assert check_held(springs, surface(block())) == []


def test_a_rough_base_is_flat_and_a_tilted_one_is_named(folder: Path) -> None:
    """A scan's noise of 0.1 mm would lock the base on its roughness."""
    mesh = block(0.004)
    low = mesh.vertices[:, 2] < 1e-6
    mesh.vertices[low, 2] += 1e-4 * np.random.default_rng(0).standard_normal(low.sum())
    shifts, turns = free_motions(declared(folder, sliding(BELOW)), surface(mesh))
    assert len(shifts) == 2 and len(turns) == 1 and abs(turns[0] @ [0.0, 0.0, 1.0]) > 0.999
    tilted = block()
    tilted.apply_transform(trimesh.transformations.rotation_matrix(0.5, [1.0, 0.0, 0.0]))
    normal = [0.0, float(-np.sin(0.5)), float(np.cos(0.5))]
    plane = {"plane": {"point": [0.0, 0.0, 0.0], "normal": normal, "tolerance": 1e-4}}
    (found,) = check_held(declared(folder, sliding(plane)), surface(tilted))
    assert "a turn about (" in found.text and ("0.48" in found.text and "0.88" in found.text)


def test_a_bowl_that_slides_leaves_turns_free(folder: Path) -> None:
    ball = trimesh.creation.icosphere(4, 0.03)
    ball.apply_translation((0.0, 0.0, 0.03))
    shifts, turns = free_motions(declared(folder, sliding({"below_z": 0.02})), surface(ball))
    assert len(shifts) == 0 and len(turns) == 3


@pytest.mark.parametrize("name", ["breast_phantom", "gelatin_cuboid"])
def test_the_shipped_bodies_are_held(name: str) -> None:
    experiment = load_experiment(BAGS / name / "experiment")
    assert check_held(experiment, read_body(experiment)) == []


def test_info_says_so(folder: Path) -> None:
    declared(folder, sliding(BELOW), stereo=None)
    document = yaml.safe_load((folder / "experiment.yaml").read_text())
    document.pop("stereo")
    (folder / "experiment.yaml").write_text(yaml.safe_dump(document))
    found = [f for f in inspect_experiment(folder).findings if "leave shifts along x and y" in f.text]
    assert len(found) == 1
