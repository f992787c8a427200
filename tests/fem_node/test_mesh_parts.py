"""Mesh files of several parts: bodies that touch must hang together, and what is solved as less than it is is told."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
import pytest
import trimesh
from bodies import plane, soft

from livedeform.common.errors import MeshError
from livedeform.common.types import Pose
from livedeform.fem_node.contact.probe_shapes import make_shape
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.generate import (
    block_mesh,
    check_mesh,
    load_or_make,
    mesh_warnings,
    meshed,
    prepared,
    read_mesh,
    write_mesh,
)
from livedeform.fem_node.mesh.tet_mesh import TetMesh, join
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import Probe, Support

HALF = block_mesh((0.03, 0.06, 0.04), (3, 6, 4))
TOUCHING = {"side by side": (0.03, 0.0, 0.0), "stacked": (0.0, 0.0, 0.04), "at an edge": (0.03, 0.06, 0.0)}


@dataclass(frozen=True)
class Given:
    """A phantom that is given as a mesh."""

    mesh: Path
    surface: None = None
    unit: str = "m"
    element_size: float = 0.01


def beside(*shift: float) -> TetMesh:
    """Two blocks with nodes of their own."""
    return join(HALF, TetMesh(HALF.nodes + np.array(shift), HALF.tets))


def merged(mesh: TetMesh) -> TetMesh:
    places, number = np.unique(np.round(1e9 * mesh.nodes).astype(np.int64), axis=0, return_inverse=True)
    return TetMesh.oriented(1e-9 * places, number.reshape(-1)[mesh.tets])


@pytest.mark.parametrize("ending", ["vtu", "msh", "inp"])
@pytest.mark.parametrize("how", TOUCHING)
def test_bodies_that_touch_without_common_nodes_are_refused(tmp_path: Path, ending: str, how: str) -> None:
    path = tmp_path / f"two.{ending}"
    write_mesh(path, beside(*TOUCHING[how]))
    for read in (read_mesh, lambda path: load_or_make(Given(path)), lambda path: prepared(Given(path))):
        with pytest.raises(MeshError, match=r"\d+ nodes lie on one of another body, as at \(.* mm") as caught:
            read(path)
        assert caught.value.where == str(path) and "Coherence Mesh;" in caught.value.remedy
    whole = merged(beside(*TOUCHING[how]))
    write_mesh(path, whole)
    mesh, report = load_or_make(Given(path))
    assert report.n_bodies == 1 and len(mesh.nodes) == len(whole.nodes) and mesh_warnings(report, 0.01) == []


@pytest.mark.parametrize(("off", "refused"), [(1e-7, True), (1e-6, True), (1e-3, False)])
def test_the_same_place_is_so_to_what_text_files_keep(tmp_path: Path, off: float, refused: bool) -> None:
    """Edges are 10 mm; two bodies with a gap of a tenth are two."""
    write_mesh(tmp_path / "two.vtu", beside(0.03 + off, 0.0, 0.0))
    if refused:
        with pytest.raises(MeshError, match="70 nodes lie on one of another body"):
            read_mesh(tmp_path / "two.vtu")
    else:
        assert check_mesh(read_mesh(tmp_path / "two.vtu")).n_bodies == 2


def test_merged_halves_move_together_and_apart_they_do_not() -> None:
    """Why they are refused: beside a press of 5 mm the other half stays where it is."""
    moved = []
    for mesh in (beside(*TOUCHING["side by side"]), merged(beside(*TOUCHING["side by side"]))):
        middle = float(HALF.nodes[:, 0].max())
        probe = Probe(make_shape("sphere", 0.008, 0.0))
        physics = soft(0.45, 6000.0, supports=(Support(plane(2, 0.0)),), scan_fraction=1.0, probe=probe)
        model = PhantomModel(make_space(mesh), physics, markers=np.array([[middle + 0.012, 0.0, 0.04]]))
        down = np.array([1.0, 0.0, 0.0, 0.0])
        for k, depth in enumerate(np.linspace(-0.001, 0.005, 7)):
            found = model.predict(Pose(k * 10**8, np.array([middle - 0.015, 0.0, 0.04 - depth]), down))
        assert found.converged
        moved.append(float(np.linalg.norm(found.markers[0] - [middle + 0.012, 0.0, 0.04])))
    assert moved[0] < 1e-7 and moved[1] > 2e-4  # measured 1.3e-13 and 4.16e-4 m


def test_bodies_that_do_not_touch_are_told(tmp_path: Path) -> None:
    write_mesh(tmp_path / "two.vtu", beside(0.05, 0.0, 0.0))
    told: list[str] = []
    _, report = load_or_make(Given(tmp_path / "two.vtu"), progress=told.append)
    assert report.n_bodies == 2
    assert told == prepared(Given(tmp_path / "two.vtu")).warnings
    assert len(told) == 1 and told[0].startswith("WARN: the mesh is 2 bodies that nothing holds together")


def test_two_pieces_of_a_surface_are_told_once(tmp_path: Path) -> None:
    balls = [trimesh.creation.icosphere(2, 0.02), trimesh.creation.icosphere(2, 0.02)]
    balls[1].apply_translation([0.06, 0.0, 0.0])
    both = trimesh.util.concatenate(balls)
    _, report = meshed(np.asarray(both.vertices), np.asarray(both.faces), 0.01, tmp_path)
    assert report.n_bodies == 2 and mesh_warnings(report, 0.01) == []
    assert any("2 separate pieces" in repair for repair in report.repairs)


def _written(path: Path, how: str, tags: np.ndarray) -> Path:
    """Write a merged body with a material of its own in each half."""
    mesh = merged(beside(0.03, 0.0, 0.0))
    if how == "inp":
        write_mesh(path, mesh)
        lines = [f"*Solid Section, elset=E{k}, material = Gel-{k}\n1.,\n" for k in np.unique(tags)]
        path.write_text(path.read_text() + "".join(lines))
        return path
    order = np.argsort(tags, kind="stable")
    name = "gmsh:physical" if how == "msh" else "material"
    data = {name: [tags[order]]} | ({"gmsh:geometrical": [tags[order]]} if how == "msh" else {})
    fields = {"soft": np.array([1, 3]), "hard": np.array([2, 3])} if how == "msh" else {}
    made = meshio.Mesh(mesh.nodes, [("tetra", mesh.tets[order])], cell_data=data, field_data=fields)
    meshio.write(path, made, **({"file_format": "gmsh22", "binary": False} if how == "msh" else {}))
    return path


@pytest.mark.parametrize(("how", "names"), [("msh", "hard, soft"), ("inp", "GEL-1, GEL-2"), ("vtu", "1, 2")])
def test_materials_that_become_one_are_told(tmp_path: Path, how: str, names: str) -> None:
    n = len(merged(beside(0.03, 0.0, 0.0)).tets)
    for several in (True, False):
        tags = 1 + (np.arange(n) >= n // 2).astype(int) if several else np.ones(n, int)
        told: list[str] = []
        load_or_make(Given(_written(tmp_path / f"m.{how}", how, tags)), progress=told.append)
        assert len(told) == several
        assert not several or f"2 material regions ({names}), and all get the one phantom.material" in told[0]


def test_an_abaqus_file_of_several_parts_is_refused(tmp_path: Path) -> None:
    """Of its lists of nodes the last one alone is read, for the elements of all."""
    write_mesh(tmp_path / "one.inp", HALF)
    text = (tmp_path / "one.inp").read_text()
    assert sum(line.upper().startswith("*NODE") for line in text.splitlines()) == 1
    (tmp_path / "two.inp").write_text(text + "*Node Output\n" + text)
    with pytest.raises(MeshError, match="it has 2 lists of nodes") as caught:
        read_mesh(tmp_path / "two.inp")
    assert "merge the parts" in caught.value.remedy
    (tmp_path / "one.inp").write_text(text + "*Node Output\n")
    assert len(read_mesh(tmp_path / "one.inp").tets) == len(HALF.tets)
