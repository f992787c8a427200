"""A surface of several closed pieces: bodies look outward, cavities inward, and what may be either is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from livedeform.common.errors import MeshError
from livedeform.fem_node.mesh import generate as meshing
from livedeform.fem_node.mesh.generate import mesh_warnings, meshed, read_surface
from livedeform.fem_node.mesh.mesher import Tetrahedra
from livedeform.fem_node.mesh.quality import enclosed_volume
from livedeform.fem_node.mesh.repair.record import Repair
from livedeform.fem_node.mesh.repair.shells import without_specks
from livedeform.fem_node.mesh.surface import repair_surface

Triangles = tuple[np.ndarray, np.ndarray]


def box(size: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0), *, inward: bool = False) -> Triangles:
    """A cube about ``at``, 32 triangles a face."""
    made = trimesh.creation.box(extents=[size] * 3).subdivide().subdivide()
    triangles = np.asarray(made.faces, np.int64)
    return np.asarray(made.vertices) + at, triangles[:, ::-1] if inward else triangles


def together(*pieces: Triangles) -> Triangles:
    starts = np.cumsum([0, *(len(v) for v, _ in pieces)])
    return np.concatenate([v for v, _ in pieces]), np.concatenate(
        [t + s for (_, t), s in zip(pieces, starts, strict=False)]
    )


def test_each_piece_that_is_inside_out_is_turned() -> None:
    pieces = together(box(0.04), box(0.02, (0.06, 0.0, 0.0), inward=True))
    repaired = repair_surface(*pieces, 0.01)
    assert enclosed_volume(repaired.vertices, repaired.triangles) == pytest.approx(0.04**3 + 0.02**3)
    assert repaired.repairs == ("1 of 2 pieces were inside out", "2 separate pieces of 64, 8 cm3 are meshed together")
    whole = repair_surface(*box(0.04, inward=True), 0.01)
    assert whole.repairs == ("the surface was inside out",)


@pytest.mark.parametrize("inward", [False, True])
def test_a_cavity_stays_empty_and_is_named(inward: bool) -> None:
    hollow = together(box(0.04, inward=inward), box(0.02, (0.002, 0.0, 0.0), inward=not inward))
    repaired = repair_surface(*hollow, 0.01)
    assert repaired.repairs[-1] == "a cavity of 8 cm3 at (2.0, 0.0, 0.0) mm stays empty"
    assert enclosed_volume(repaired.vertices, repaired.triangles) == pytest.approx(0.04**3 - 0.02**3)


def test_a_speck_is_told_by_its_size_not_by_its_triangles() -> None:
    fine = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    body = np.asarray(fine.vertices), np.asarray(fine.faces, np.int64)
    drawn = trimesh.creation.box(extents=[0.02] * 3)
    drawn.apply_translation([0.06, 0.0, 0.0])
    second = np.asarray(drawn.vertices), np.asarray(drawn.faces, np.int64)
    assert len(second[1]) < 0.02 * len(body[1])
    repairs: list[Repair] = []
    kept = without_specks(*together(body, second), repairs)
    assert len(kept) == len(body[1]) + 12 and repairs == []
    kept = without_specks(*together(body, box(0.004, (0.06, 0.0, 0.0))), repairs)
    assert len(kept) == len(body[1])
    assert str(repairs[0]) == "1 loose specks up to 6.9 mm across dropped"


def ball(radius: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0), *, inward: bool = False) -> Triangles:
    """A ball of 1280 triangles about ``at``."""
    made = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    triangles = np.asarray(made.faces, np.int64)
    return np.asarray(made.vertices) + at, triangles[:, ::-1] if inward else triangles


@pytest.mark.parametrize("radius", [0.0031, 0.0095, 0.0147, 0.0163])
@pytest.mark.parametrize("inward", [False, True])
def test_a_cavity_stays_empty_however_small_it_is_beside_the_body(radius: float, inward: bool) -> None:
    """In a ball of 140 mm those up to 20 mm were dropped as specks, since their area is less than 2 % of its own."""
    cyst = ball(radius, (0.02, 0.0, 0.01), inward=not inward)
    hollow = together(ball(0.07, inward=inward), cyst)
    repaired = repair_surface(*hollow, 0.012)
    held = enclosed_volume(*ball(radius))
    assert repaired.repairs[-1] == f"a cavity of {1e6 * held:.3g} cm3 at (20.0, 0.0, 10.0) mm stays empty"
    volume = enclosed_volume(repaired.vertices, repaired.triangles)
    assert volume == pytest.approx(enclosed_volume(*ball(0.07)) - held, rel=1e-12)


def test_a_small_cavity_is_no_part_of_the_mesh(tmp_path: Path) -> None:
    mesh, report = meshed(*together(ball(0.035), ball(0.0048, (0.01, 0.0, 0.0), inward=True)), 0.01, tmp_path)
    apart = np.linalg.norm(mesh.nodes - [0.01, 0.0, 0.0], axis=1)
    assert apart.min() > 0.9 * 0.0048  # measured 4.81e-3 m
    assert mesh_warnings(report, 0.01) == []


def test_what_is_much_less_than_an_element_within_the_body_is_filled_and_said_to_be_a_cavity() -> None:
    body, places = ball(0.07), [(0.02, 0.0, 0.0), (0.0, -0.03, 0.01)]
    one = together(body, ball(0.0029, places[0], inward=True))
    assert repair_surface(*one, 0.012).repairs == ("a cavity 5.8 mm across filled in: under half an element",)
    two = together(body, *(ball(0.0029 / k, at, inward=True) for k, at in zip((1, 2), places, strict=True)))
    repaired = repair_surface(*two, 0.012)
    assert repaired.repairs == ("2 cavities up to 5.8 mm across filled in: under half an element",)
    assert len(repaired.triangles) == len(body[1])
    outward = together(body, ball(0.0029, places[0]))
    assert repair_surface(*outward, 0.012).repairs == ("1 loose specks up to 5.8 mm across dropped",)


def test_specks_are_open_or_outside() -> None:
    """An open patch within the body, a closed one outside, one half in its surface, and one in a large cavity."""
    body, (v, t) = together(ball(0.07), ball(0.03, inward=True)), ball(0.008, (0.05, 0.0, 0.0))
    patch = v, t[v[t][:, :, 2].mean(axis=1) > 0.004]
    for speck in (patch, ball(0.008, (0.06, 0.06, 0.06)), ball(0.008, (0.07, 0.0, 0.0)), ball(0.008)):
        repaired = repair_surface(*together(body, speck), 0.012)
        assert repaired.repairs[0].startswith("1 loose specks up to ") and len(repaired.triangles) == len(body[1])


@pytest.mark.parametrize(("sides", "across"), [((4, 4, 4), "6.9"), ((9, 1, 0.5), "9.1")])
def test_how_far_a_speck_is_across_is_how_far_its_points_are_apart(sides: tuple[float, ...], across: str) -> None:
    made = trimesh.creation.box(extents=1e-3 * np.array(sides)).subdivide()
    turn = trimesh.transformations.rotation_matrix(0.6, [1.0, 2.0, 3.0], [0.0, 0.0, 0.0])
    made.apply_transform(turn)
    made.apply_translation([0.06, 0.0, 0.0])
    repairs: list[Repair] = []
    without_specks(*together(ball(0.03), (np.asarray(made.vertices), made.faces)), repairs)
    assert str(repairs[0]) == f"1 loose specks up to {across} mm across dropped"
    without_specks(*together(ball(0.03), ball(0.002, (0.06, 0.0, 0.0))), repairs)
    assert str(repairs[1]) == "1 loose specks up to 4.0 mm across dropped"


def test_a_small_shell_within_the_body_that_looks_outward_is_refused_too() -> None:
    with pytest.raises(
        MeshError, match=r"shell of 2\.\d+ cm3 at \(20\.0, 0\.0, 0\.0\) mm lies within .* turn it inward"
    ):
        repair_surface(*together(ball(0.07), ball(0.008, (0.02, 0.0, 0.0))), 0.012)


def test_a_body_within_a_cavity_is_a_body() -> None:
    three = together(box(0.06), box(0.04, inward=True), box(0.02))
    repaired = repair_surface(*three, 0.01)
    assert repaired.repairs == (
        "2 separate pieces of 216, 8 cm3 are meshed together",
        "a cavity of 64 cm3 at (0.0, 0.0, 0.0) mm stays empty",
    )


def test_a_shell_within_the_body_that_looks_outward_is_refused() -> None:
    with pytest.raises(
        MeshError, match=r"shell of 8 cm3 at \(0\.0, 0\.0, 5\.0\) mm lies within .* remove it"
    ) as raised:
        repair_surface(*together(box(0.04), box(0.02, (0.0, 0.0, 0.005))), 0.01, "phantom.stl")
    assert raised.value.where == "phantom.stl"


def test_pieces_that_overlap_are_refused_with_the_place() -> None:
    with pytest.raises(MeshError, match=r"overlap, as at \(\d+\.\d, -?\d+\.\d, -?\d+\.\d\) mm; join them"):
        repair_surface(*together(box(0.04), box(0.03, (0.025, 0.003, 0.002))), 0.012)


@pytest.mark.parametrize("wrong", ["inside out", "a third turned", "a small hole"])
def test_what_was_mended_is_no_difference_of_volume(wrong: str, tmp_path: Path) -> None:
    """Against the surface as it is meant: an open one, or one inside out, has no volume to compare."""
    vertices, triangles = box(0.05, (0.1, 0.0, 0.2))
    if wrong == "inside out":
        triangles = triangles[:, ::-1]
    elif wrong == "a third turned":
        triangles = np.where(np.arange(len(triangles))[:, None] % 3 == 0, triangles[:, ::-1], triangles)
    else:
        triangles = triangles[1:]
    mesh, report = meshed(vertices, triangles, 0.02, tmp_path)
    assert len(report.repairs) == 1
    assert mesh_warnings(report, 0.02) == []
    assert report.surface_volume == pytest.approx(0.05**3)
    assert mesh.volume == pytest.approx(0.05**3, rel=0.003)


def test_a_plate_thinner_than_an_element_is_meshed_with_a_warning_or_refused(tmp_path: Path) -> None:
    """2 mm with elements of 10: right in shape, and said to be too coarse."""
    path = tmp_path / "plate.stl"
    trimesh.creation.box(extents=(0.06, 0.05, 0.002)).export(path)
    mesh, report = meshed(*read_surface(path), 0.01, tmp_path)
    assert mesh.volume == pytest.approx(0.06 * 0.05 * 0.002, rel=0.003)
    assert any("0.2 go through its thinnest part (2.0 mm" in line for line in mesh_warnings(report, 0.01))


def test_a_sheet_that_no_envelope_finds_is_named_by_its_thickness(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = Tetrahedra(np.empty((0, 3)), np.empty((0, 4), np.int64), True)
    tried: list[float] = []
    monkeypatch.setattr(meshing, "tetrahedra", lambda v, t, size, envelope: tried.append(envelope) or nothing)
    sheet = trimesh.creation.box(extents=(0.06, 0.05, 0.0003))
    with pytest.raises(MeshError, match=r"no inside: at its thinnest the body is 0\.3 mm, .* use elements of 0\.1 mm"):
        meshing.tetrahedralise(np.asarray(sheet.vertices), np.asarray(sheet.faces), 0.01)
    assert tried == [0.01 * e for e in meshing.ENVELOPES]
