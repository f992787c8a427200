"""The body is the one that was given: edges and flats stay, noise goes, repairs are said, meshes repeat."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from triangulations import SHAPES, surface

from livedeform.common.errors import InputError, MeshError
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.supports import check_caught
from livedeform.fem_node.mesh import cache
from livedeform.fem_node.mesh import generate as meshing
from livedeform.fem_node.mesh.generate import block_mesh, in_order, mesh_warnings, meshed
from livedeform.fem_node.mesh.mesher import tetrahedra
from livedeform.fem_node.mesh.quality import enclosed_volume, surface_distances
from livedeform.fem_node.mesh.repair.denoise import denoise
from livedeform.fem_node.mesh.repair.record import Repair
from livedeform.fem_node.mesh.surface import merge_vertices, repair_surface
from livedeform.fem_node.mesh.thickness import thickness_warning, thinnest_part
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Support


@pytest.mark.parametrize("size", [0.004, 0.008, 0.015])
@pytest.mark.parametrize("triangulation", ["coarse", "fine", "subdivided", "remeshed"])
@pytest.mark.parametrize("name", SHAPES)
def test_a_drawn_body_is_left_as_it_is(name: str, triangulation: str, size: float) -> None:
    vertices, triangles = merge_vertices(*surface(name, triangulation))
    found = denoise(vertices, triangles, size)
    assert found.noise == 0.0 and np.array_equal(found.vertices, vertices)


@pytest.mark.parametrize("seed", [0, 7])
@pytest.mark.parametrize("noise", [0.2, 0.5])
@pytest.mark.parametrize("name", ["box", "L", "breast"])
def test_a_scan_gets_its_flats_and_edges_back(name: str, noise: float, seed: int) -> None:
    clean, _ = surface(name, "scan 0.0 mm", seed)
    vertices, triangles = surface(name, f"scan {noise} mm", seed)
    found = denoise(vertices, triangles, 0.008)
    assert found.share > 0.95
    assert found.noise == pytest.approx(1e-3 * noise, rel=0.12)
    _, off = surface_distances((found.vertices, triangles), (clean, triangles))
    assert np.sqrt(np.mean(off**2)) < 0.3e-3 * noise
    assert enclosed_volume(found.vertices, triangles) == pytest.approx(enclosed_volume(clean, triangles), rel=0.003)
    base = clean[:, 2] < 1e-9
    assert found.vertices[base, 2].std() < 0.35e-3 * noise


def test_only_the_noisy_part_is_smoothed() -> None:
    """A scan whose base was capped by a drawing's flat: the cap stays, to the last digit, away from its rim."""
    clean, triangles = surface("breast", "scan 0.0 mm")
    noise = np.random.default_rng(3).normal(scale=3e-4, size=clean.shape)
    vertices = np.where(clean[:, 2:] > 1e-9, clean + noise, clean)
    found = denoise(vertices, triangles, 0.008)
    cap = np.linalg.norm(clean[:, :2], axis=1) < 0.035
    cap &= clean[:, 2] < 1e-9
    assert np.abs(found.vertices[cap] - clean[cap]).max() < 1e-12
    assert 0.4 < found.share < 0.9 and found.noise == pytest.approx(3e-4, rel=0.15)


def test_what_a_repair_moved_is_said_with_its_place() -> None:
    vertices, triangles = surface("box", "scan 0.2 mm")
    surface_ = repair_surface(vertices, triangles, 0.010)
    noise = next(r for r in surface_.record if "noise smoothed" in r.what)
    moved = np.linalg.norm(surface_.vertices - vertices, axis=1)
    assert noise.moved_max == pytest.approx(moved.max())
    assert noise.moved_rms == pytest.approx(np.sqrt(np.mean(moved**2)))
    np.testing.assert_allclose(noise.place, vertices[moved.argmax()])
    assert f"up to {1e3 * moved.max():.3f} mm" in str(noise)


def cuboid() -> tuple[np.ndarray, np.ndarray]:
    """The thesis's, 50 x 50 x 70 mm, with 8 x 8 squares on each face."""
    return merge_vertices(*surface("box", "subdivided"))


def test_a_cuboid_of_squares_is_a_cuboid_and_its_base_is_held(tmp_path: Path) -> None:
    vertices, triangles = cuboid()
    mesh, report = meshed(vertices, triangles, 0.010, tmp_path)
    assert report.repairs == () and mesh_warnings(report, 0.010) == []
    assert abs(report.volume / report.surface_volume - 1.0) < 1e-3
    assert report.surface_distance_max < 0.1 * 0.010
    space = make_space(mesh, "p2p0")
    check_caught(space, [Support(lambda X: X[:, 2] < 0.001, "fixed")], vertices, triangles)


def squared(n: int) -> tuple[np.ndarray, np.ndarray]:
    """The cuboid with n x n squares on each face, each of two triangles."""
    u, v = (k.ravel() for k in np.meshgrid(np.arange(n + 1) / n, np.arange(n + 1) / n, indexing="ij"))
    a = np.array([i * (n + 1) + j for i in range(n) for j in range(n)])
    square = np.concatenate([np.column_stack([a, a + n + 1, a + n + 2]), np.column_stack([a, a + n + 2, a + 1])])
    points, triangles = [], []
    for axis in range(3):
        for side in (0, 1):
            flat = np.zeros((len(u), 3))
            flat[:, axis], flat[:, (axis + 1) % 3], flat[:, (axis + 2) % 3] = side, u, v
            triangles.append((square if side else square[:, ::-1]) + len(u) * len(points))
            points.append(flat * [0.05, 0.05, 0.07] - [0.025, 0.025, 0.0])
    return merge_vertices(np.concatenate(points), np.concatenate(triangles))


def test_the_thesis_cuboid_sinks_as_it_should_however_many_squares_its_file_has(tmp_path: Path) -> None:
    """50 x 50 x 70 mm, 2896 Pa, nu 0.49, bonded: 6.845 +- 0.010 mm of the top's centre under its own weight
    (independent codes, Richardson's limit). The rest is the rim of the bond, where the stress is singular."""
    answers = []
    for n in (1, 3, 8):
        vertices, triangles = squared(n)
        mesh, report = meshed(vertices, triangles, 0.010, tmp_path)
        assert report.repairs == () and report.volume == pytest.approx(0.05 * 0.05 * 0.07, rel=1e-4)
        space = make_space(mesh, "p2p0")
        physics = Physics(
            material=MaterialSpec("neo_hookean", 2896.0, 0.49),
            density=1000.0,
            gravity=np.array([0.0, 0.0, -9.81]),
            supports=(Support(lambda X: X[:, 2] < 1e-4, "fixed"),),
        )
        check_caught(space, physics.supports, vertices, triangles)
        top = np.array([[0.0, 0.0, 0.07]])
        moment = PhantomModel(space, physics, markers=top).predict(None, 0)
        assert moment.converged
        answers.append(float(1e3 * (top - moment.markers)[0, 2]))
    assert answers == pytest.approx([6.845] * 3, rel=0.005)  # measured: 6.863, 6.860, 6.843
    assert max(answers) - min(answers) < 0.005 * 6.845


@pytest.mark.parametrize(
    ("name", "triangulation", "thickness"),
    [
        ("slab", "coarse", 20.0),
        ("slab", "scan 0.2 mm", 20.0),
        ("L", "subdivided", 25.0),
        ("cylinder", "coarse", 50.0),
        ("dome", "coarse", 30.0),
    ],
)
def test_the_thinnest_part_is_measured_and_a_rim_is_none(name: str, triangulation: str, thickness: float) -> None:
    vertices, triangles = merge_vertices(*surface(name, triangulation))
    body = repair_surface(vertices, triangles, 0.008)
    found = thinnest_part(body.vertices, body.triangles)
    assert 1e3 * found.thinnest == pytest.approx(thickness, rel=0.02)
    assert thickness_warning(found, 0.49e-3 * thickness) == []
    (line,) = thickness_warning(found, 0.6e-3 * thickness)
    assert "1.6 go through its thinnest part" in line or "1.7 go" in line


def test_a_limb_counts_though_it_is_a_small_part_of_the_body() -> None:
    whole = block_mesh((0.12, 0.06, 0.06), (8, 4, 4), origin=(0.0, 0.0, 0.0))
    x, y, z = whole.nodes[whole.tets].mean(axis=1).T
    body = type(whole)(whole.nodes, whole.tets[(x < 0.075) | ((y < 0.015) & (z < 0.015))])
    found = thinnest_part(*merge_vertices(body.nodes, body.boundary_triangles))
    assert found.thinnest == pytest.approx(0.015, rel=1e-6) and found.place[0] > 0.075


def test_meshing_says_that_the_elements_are_too_large(tmp_path: Path) -> None:
    said: list[str] = []
    meshed(*merge_vertices(*surface("slab", "coarse")), 0.014, tmp_path, said.append)
    assert [line for line in said if line.startswith("WARN") and "1.4 go through its thinnest part (20.0 mm" in line]
    phantom = SimpleNamespace(surface=tmp_path / "slab.stl", mesh=None, unit="m", element_size=0.014)
    trimesh.Trimesh(*surface("slab", "coarse")).export(phantom.surface)
    (line,) = meshing.prepared(phantom).warnings
    assert "1.4 go through its thinnest part (20.0 mm" in line


def test_the_same_surface_gives_the_same_tetrahedra_however_its_file_lists_them(tmp_path: Path) -> None:
    vertices, triangles = cuboid()
    shuffled = np.random.default_rng(0).permutation(np.roll(triangles, 1, axis=1))
    digests = {
        meshed(vertices, t, 0.014, tmp_path / str(k))[1].digest for k, t in enumerate((triangles, triangles, shuffled))
    }
    assert len(digests) == 1
    np.testing.assert_array_equal(in_order(vertices, shuffled)[1], in_order(vertices, triangles)[1])
    assert tetrahedra(vertices, triangles, 0.014, 0.0004).seeded


def test_a_damaged_cache_is_made_again_with_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = block_mesh((0.05, 0.05, 0.07), 3)
    record = (Repair("noise smoothed", 1e-3, 1e-4, (0.0, 0.1, 0.2)), Repair("the surface was inside out"))
    assert cache.save(tmp_path, "k", mesh, record)
    whole = (tmp_path / "k.npz").read_bytes()
    kept = cache.load(tmp_path, "k")
    assert kept is not None and kept.record == record and kept.mesh.digest == mesh.digest
    rng, unnoticed = np.random.default_rng(0), 0
    for n in range(200):
        torn = bytearray(whole[: rng.integers(0, len(whole))] if n % 2 else whole)
        if n % 2 == 0:
            torn[rng.integers(0, len(torn))] ^= 1 << int(rng.integers(0, 8))
        (tmp_path / "k.npz").write_bytes(torn)
        said: list[str] = []
        again = cache.load(tmp_path, "k", said.append)
        assert (again is None) == (len(said) == 1)
        if again is not None:  # a bit that nobody reads
            unnoticed += 1
            assert again.mesh.digest == mesh.digest and again.record == record
    assert unnoticed < 60
    assert [p.name for p in tmp_path.iterdir()] == ["k.npz"]  # nothing is left beside it


def test_a_mesh_that_is_off_its_surface_is_refused_with_the_place(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, triangles = cuboid()
    made = tetrahedra(vertices, triangles, 0.014, 0.0004)
    top = made.nodes[:, 2] > 0.0699
    stretched = made._replace(nodes=made.nodes + [0.0, 0.0, 0.002] * top[:, None])
    monkeypatch.setattr(meshing, "tetrahedra", lambda *a: stretched)
    with pytest.raises(MeshError, match=r"2\.00 mm off the surface, most at \[.*, 0\.07"):
        meshing.tetrahedralise(vertices, triangles, 0.014)


def test_a_support_that_holds_less_than_the_surface_has_there_is_refused() -> None:
    """Half of the base's nodes lie a little above the region's end, as the base of a body that bulges."""
    vertices, triangles = cuboid()
    mesh = block_mesh((0.05, 0.05, 0.07), 6)
    mesh = type(mesh)(mesh.nodes - [0.025, 0.025, 0.0], mesh.tets)
    support = Support(lambda X: X[:, 2] < 1e-4, "fixed")
    check_caught(make_space(mesh, "p2p0"), [support], vertices, triangles)
    inner = np.linalg.norm(mesh.nodes[:, :2], axis=1) < 0.02
    bulging = mesh.nodes + np.outer((mesh.nodes[:, 2] < 1e-9) & inner, [0.0, 0.0, 1e-3])
    with pytest.raises(
        InputError, match=r"support 0 \(fixed\): it holds \d+ nodes, \d+ mm2 of the 2500 mm2 .*; enlarge"
    ):
        check_caught(make_space(type(mesh)(bulging, mesh.tets), "p2p0"), [support], vertices, triangles)


def test_meshing_writes_no_input(tmp_path: Path) -> None:
    path = tmp_path / "box.stl"
    trimesh.Trimesh(*cuboid()).export(path)
    before = hashlib.sha256(path.read_bytes()).digest()
    meshed(*meshing.read_surface(path), 0.014, tmp_path / "cache")
    assert hashlib.sha256(path.read_bytes()).digest() == before
