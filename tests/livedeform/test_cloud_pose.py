"""Points without identity are laid on a body as well as is said, or it is said what the body leaves open."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from livedeform.cli import run as command_line
from livedeform.common.bags import layouts
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.types import decode
from livedeform.common.errors import InputError
from livedeform.common.frames import apply, inverse, transform
from livedeform.importing.cloud_pose import CloudPose, lay_on

NOISE = 1e-4  # m
UP = np.array([0.0, 0.0, 1.0])


def lump() -> trimesh.Trimesh:
    """A body of 100 x 80 x 60 mm that looks alike from nowhere."""
    body = trimesh.creation.icosphere(3)
    v = body.vertices * [0.05, 0.04, 0.03]
    v = v + np.array([0.1 * v[:, 2] + 2.0 * v[:, 1] ** 2, 3.0 * v[:, 2] ** 2, 2.0 * v[:, 0] * v[:, 1]]).T
    return trimesh.Trimesh(v, body.faces, process=False)


def measured(body: trimesh.Trimesh, n: int, seed: int, noise: float = NOISE, seen_from: np.ndarray | None = None):
    """Points on the body (of the side that is seen) with noise."""
    points, face = trimesh.sample.sample_surface(body, 6 * n, seed=seed)
    shown = body.face_normals[face] @ seen_from > 0.1 if seen_from is not None else np.ones(len(face), bool)
    points = np.asarray(points)[shown][:n]
    return points + np.random.default_rng(seed).normal(0.0, noise, points.shape)


def turned(seed: int, angle: float | None = None) -> np.ndarray:
    """A camera's pose: any, or one within some rad and millimetres of the phantom's frame."""
    rng = np.random.default_rng(seed)
    if angle is None:
        return transform(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 0.2, 3))
    return transform(Rotation.from_rotvec(angle * rng.normal(size=3) / 2).as_matrix(), rng.normal(0, 0.003, 3))


def laid(body: trimesh.Trimesh, points: np.ndarray, T: np.ndarray, **how: bool) -> CloudPose:
    return lay_on(apply(inverse(T), points), np.asarray(body.vertices), np.asarray(body.faces, np.int64), **how)


def off(pose: CloudPose, T: np.ndarray) -> np.ndarray:
    """By how much (6,) a pose is turned (rad) about the points' middle and shifted (m) from the true one."""
    E = pose.T_phantom_cloud @ inverse(T)
    shift = E[:3, :3] @ pose.middle + E[:3, 3] - pose.middle
    return np.concatenate([Rotation.from_matrix(E[:3, :3]).as_rotvec(), shift])


@pytest.mark.parametrize("seen_from", [None, UP], ids=["all around", "from above"])
def test_a_body_is_found_from_anywhere(seen_from: np.ndarray | None):
    """2000 points of 0.1 mm: the pose is off by hundredths of a millimetre."""
    body, T = lump(), turned(1)
    points = measured(body, 2000, 1, seen_from=seen_from)
    pose = laid(body, points, T)
    moved = pose.moved(apply(inverse(T), points)) - points
    assert np.sqrt((moved**2).sum(axis=1).mean()) < 1e-4  # measured 0.02 and 0.04 mm
    assert pose.rms == pytest.approx(NOISE, rel=0.1) and pose.share > 0.99
    assert 1e-5 < pose.sigma_at(points) < 1e-4  # says 0.02 and 0.07 mm


def test_points_of_other_things_do_not_move_it():
    """A fifth of the points are anywhere in the room."""
    body, T = lump(), turned(3, 0.1)
    points = np.vstack([measured(body, 2000, 3), np.random.default_rng(0).uniform(-0.1, 0.1, (400, 3))])
    pose = laid(body, points, T, near=True)
    assert np.abs(off(pose, T)[3:]).max() < 5e-5 and 0.8 < pose.share < 0.9


@pytest.mark.parametrize("wave_number", [0.0, pytest.param(120.0, marks=pytest.mark.slow), 250.0])
def test_the_uncertainty_is_as_large_as_the_errors(wave_number: float):
    """Chi-square of six numbers in 20 takes, of noise alone, and of shape errors with waves of some centimetres, which
    make few of many points."""
    body, chi2 = lump(), []
    for seed in range(20):
        T, points, rng = turned(seed, 0.05), measured(body, 800, seed), np.random.default_rng(seed + 100)
        wave = np.sin(points @ rng.normal(0.0, wave_number, 3) + rng.uniform(0.0, 2.0 * np.pi)) * bool(wave_number)
        points = points + 1e-4 * wave[:, None] * points / np.linalg.norm(points, axis=1)[:, None]
        pose = laid(body, points, T, near=True)
        e = off(pose, T)
        chi2.append(e @ np.linalg.solve(pose.covariance, e))
    # measured 1.07, 0.50 and 1.03
    assert (0.6 if not wave_number else 0.25) < np.mean(chi2) / 6.0 < 1.6, np.mean(chi2)


@pytest.mark.parametrize(
    ("body", "seen_from", "open_"),
    [
        (trimesh.creation.icosphere(3, 0.04), None, "every turn about"),
        (trimesh.creation.icosphere(2, 0.04), UP, "every turn about"),
        (trimesh.creation.cylinder(0.03, 0.08, sections=64), None, "a turn about (0.00, 0.00, 1.00) through"),
        (trimesh.creation.cone(0.03, 0.06, sections=48), None, "a turn about (0.00, 0.00, 1.00) through"),
        (trimesh.creation.box([0.06, 0.04, 0.03]), UP, "a shift along"),
    ],
    ids=["ball", "cap of a coarse ball", "cylinder", "cone", "plane"],
)
def test_what_a_body_leaves_open_is_named(body: trimesh.Trimesh, seen_from: np.ndarray | None, open_: str):
    """And kept as it came where that is asked for."""
    points = measured(body, 2000, 5, seen_from=seen_from)
    with pytest.raises(InputError, match="does not tell the points' pose: it leaves open") as refused:
        laid(body, points, turned(5, 0.05), near=True)
    assert open_ in str(refused.value)
    if seen_from is not None and open_ == "a shift along":
        assert str(refused.value).count("a shift along") == 2 and "a turn about (0.00, 0.00, 1.00)" in str(
            refused.value
        )
    shift = transform(np.eye(3), [1e-3, 0.0, 2e-3])
    pose = laid(body, points, shift, keep=True)
    assert pose.held and "kept as it came" in pose.text
    assert abs(off(pose, shift)[5]) < 1e-4  # what it tells is found
    assert np.abs(off(pose, shift)[:3]).max() < 5e-3  # and it is not turned


def test_a_body_that_looks_alike_from_two_sides_asks_for_a_start():
    body = trimesh.creation.box([0.06, 0.04, 0.03])
    points, T = measured(body, 2000, 7), turned(7, 0.1)
    with pytest.raises(InputError, match=r"fit the surface in two ways .* 180 degrees apart"):
        laid(body, points, T)
    assert np.abs(off(laid(body, points, T, near=True), T)[3:]).max() < 5e-5


def test_points_of_another_body_are_not_laid_on():
    with pytest.raises(InputError, match="no pose lays the points on the surface"):
        laid(lump(), 3.0 * measured(lump(), 500, 0), np.eye(4))
    with pytest.raises(InputError, match="30 points are too few"):
        laid(lump(), measured(lump(), 30, 0), np.eye(4))


def test_scans_in_a_cameras_frame_are_imported_into_the_phantoms(tmp_path: Path, capsys):
    """One pose, that of the moments at rest, moves all of them."""
    body, T = lump(), turned(11)
    body.export(tmp_path / "body.stl")
    description = {
        "version": 1, "name": "lump",
        "phantom": {
            "surface": "body.stl", "unit": "m", "configuration": "loaded", "element_size": 0.012, "density": 1000.0,
            "material": {"model": "neo_hookean", "youngs_modulus": 4000.0, "poisson_ratio": 0.45},
            "support": [{"region": {"below_z": -0.02}, "type": "fixed"}], "markers": "markers.csv",
        },
    }  # fmt: skip
    (tmp_path / "experiment.yaml").write_text(yaml.safe_dump(description))
    places = body.vertices[[0, 10, 20]]
    (tmp_path / "markers.csv").write_text(
        "id,x,y,z\n" + "".join(f"{k},{x},{y},{z}\n" for k, (x, y, z) in enumerate(places))
    )
    truth = [measured(body, 900 + k, k) + 0.002 * (k > 2) * UP for k in range(5)]
    for k, points in enumerate(truth):
        table = "x [mm],y [mm],z [mm]\n" + "".join(f"{x},{y},{z}\n" for x, y, z in 1e3 * apply(inverse(T), points))
        (tmp_path / f"scan_{k}.csv").write_text(table)
    files = [str(f) for f in sorted(tmp_path.glob("scan_*.csv"))]
    words = ["import", "surface", *files, "--rate", "5", "--experiment", str(tmp_path), "--out", str(tmp_path / "bags")]
    assert command_line([*words, "--preview"]) == 0 and not (tmp_path / "bags").exists()
    assert command_line(words) == 0
    said = capsys.readouterr().out
    assert "registered to the surface at rest: distance 0.1" in said and "the surface is the experiment's file" in said
    with read_bag(tmp_path / "bags" / "scan_0.mcap") as bag:
        found = [layouts.points(layouts.unpack(decode(raw))) for raw in bag.messages(["/stereo/surface"])]
        assert 0.0 < float(bag.metadata["registration_sigma_m"]) < 2e-4
    for points, cloud in zip(truth, found, strict=True):
        assert np.sqrt(((points - cloud) ** 2).sum(axis=1).mean()) < 1.5e-4
    assert command_line([*words[:-4], "--near", "--out", str(tmp_path / "b2")]) == 2
    assert "--experiment: is missing" in capsys.readouterr().err
    assert command_line([*words, "--rest", "7:8", "--force"]) == 2
    assert "no moment lies in the time of rest" in capsys.readouterr().err
