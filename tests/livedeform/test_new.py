"""livedeform new: what the files tell is found, what they cannot tell is asked, and what is written is sound."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from livedeform.cli import app, run
from livedeform.commands.new import _asks
from livedeform.common.errors import InputError
from livedeform.common.experiment.probe_mesh import probe_mesh
from livedeform.common.experiment.schema import Probe
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.inspection import inspect
from livedeform.new.body import read_new_body
from livedeform.new.make import Sources, make_experiment, read_places_of
from livedeform.new.markers import read_places
from livedeform.new.questions import read_probe
from livedeform.progress import Progress
from livedeform.recording import Writer

TABLE = "id,x,y,z\n1,0,0,50\n2,30,0,20\n5,0,30,20\n7,0,0,20\n9,40,0,0\n"  # mm; 7 inside, 9 beside the base
KNOWN = {"configuration": "loaded", "modulus": "4000", "probe": "ball:0.01"}


@pytest.fixture
def block(tmp_path: Path) -> Path:
    """A block of 60 x 60 x 50 mm on z = 0, in millimetres, with a table of markers."""
    body = trimesh.creation.box((60.0, 60.0, 50.0))
    body.apply_translation((0.0, 0.0, 25.0))
    body.export(tmp_path / "block.stl")
    (tmp_path / "table.csv").write_text(TABLE)
    return tmp_path


def sources(folder: Path, markers: str = "table.csv", **more: object) -> Sources:
    return Sources(folder / "block.stl", folder / markers, **more)  # type: ignore[arg-type]


def test_an_experiment_from_a_surface_and_a_table(block: Path) -> None:
    lines = make_experiment(block / "new", sources(block), KNOWN | {"modulus_sigma": "300"})
    assert inspect(block / "new").sound
    experiment = load_experiment(block / "new")
    assert experiment.phantom.unit == "mm"
    np.testing.assert_allclose(experiment.markers.points[0], [0.0, 0.0, 0.05])  # the table was in mm, too
    assert experiment.markers.kinds.tolist() == ["surface", "surface", "surface", "internal", "support"]
    assert experiment.sigma("phantom.material.youngs_modulus") == 300.0
    assert experiment.probe is not None and experiment.probe.shape.sphere == 0.01
    n = 0.06 * 0.06 * 0.05 * 6 * np.sqrt(2) / experiment.phantom.element_size**3
    assert 3500 < n < 4500  # tetrahedra of a first mesh; to two digits of the edge
    assert (block / "new" / "experiment.png").stat().st_size > 10_000
    assert any(line.startswith("assumed: ") and "poisson 0.49" in line for line in lines)
    keys = [line for line in (block / "new" / "experiment.yaml").read_text().splitlines() if line.startswith("  ")]
    assert sum("#" in line for line in keys) > len(keys) / 2  # commented


def test_it_asks_for_what_it_cannot_know(block: Path) -> None:
    asked: list[str] = []
    answers = {"configuration": "neither", "modulus": "soft"}  # first answers, which cannot be read

    def ask(question: str, default: str | None) -> str:
        asked.append(question)
        if "Young" in question:
            return answers.pop("modulus", "4000")
        if "scanned" in question:
            return answers.pop("configuration", "unloaded")
        return default if default is not None else "cylinder:0.01,0.03"

    make_experiment(block / "new", sources(block), {"density": "1010"}, ask=ask)
    experiment = load_experiment(block / "new")
    assert experiment.phantom.density == 1010.0 and not any("Density" in question for question in asked)
    assert experiment.phantom.configuration == "unloaded"
    assert any(question.startswith("'neither' is not known") for question in asked)
    assert experiment.probe is not None and experiment.probe.shape.cylinder == (0.01, 0.03)


def test_without_a_terminal_every_missing_option_is_named_at_once(block: Path) -> None:
    with pytest.raises(InputError, match=r"not given: --configuration, --modulus, --probe"):
        make_experiment(block / "new", sources(block), {})
    assert not (block / "new").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"probe": "ball"}, "--probe: 'ball' is no answer"),
        ({"probe": "cone:0.1"}, "no probe"),
        ({"probe": "box:0.1,0.1"}, "has 3 sizes"),
        ({"modulus": "-4"}, "not positive"),
        ({"gravity": "9.81"}, "three numbers"),
        ({"cameras": "left.yaml"}, "does not exist"),
        ({"support_below": "0.5"}, "--support-below: the region holds the whole body"),
        ({"modulus": "4"}, "--modulus: .* pascals"),
        ({"density": "1"}, "--density: 1 is not plausible"),
        ({"poisson": "0.5"}, "--poisson: .* below 0.5"),
        ({"gravity": "0,0,-981"}, "--gravity: "),
        ({"element_size": "1e-5"}, "--element-size: .* tetrahedra"),
        ({"friction": "20"}, "--friction: 20 is not plausible"),
        ({"probe": "cylinder:0.01,0.1", "edge_radius": "0.2"}, "--edge-radius: "),
        ({"probe": "ball:2"}, "--probe: sphere is 2 m; write ball:0.002 if millimetres are meant"),
        ({"probe": "box:20,15,40"}, "--probe: box is 40 m; write box:0.02,0.015,0.04 if"),
        ({"probe": "ball"}, r"--probe: .*ball:0\.01"),
        ({"threshold": "2"}, "--threshold: error is 2 m"),
    ],
)
def test_a_wrong_answer_is_one_line(block: Path, change: dict[str, str], said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        make_experiment(block / "new", sources(block), KNOWN | change)
    assert "\n" not in str(caught.value) and caught.value.remedy and "draft" not in str(caught.value)
    assert not (block / "new").exists()


@pytest.mark.parametrize(
    ("head", "separator", "said"),
    [
        ("id,x,y,z", ";", "separated by ';': put commas between them, and points into decimals"),
        ("id,x,y,z", "\t", "separated by tabs: put commas"),
        ("id,x [mm],y [mm],z [mm]", ",", "call the columns id,x,y,z, .* with --markers-unit mm"),
        ("id,X(mm),Y(mm),Z(mm)", ",", "with --markers-unit mm"),
        ("id,x_mm,y_mm,z_mm", ",", "with --markers-unit mm"),
        ("id,x [m],y [m],z [m]", ",", "without their unit: lengths are in metres$"),
        ("name,a,b,c", ",", "begin the file with the line id,x,y,z"),
    ],
)
def test_a_table_with_another_head_says_what_to_change(block: Path, head: str, separator: str, said: str) -> None:
    rows = [head, "1,0,0,50", "2,30,0,25", "3,0,30,25", "4,-30,0,25"]
    (block / "other.csv").write_text("\n".join(row.replace(",", separator) for row in rows))
    with pytest.raises(InputError, match=said) as caught:
        make_experiment(block / "new", sources(block, "other.csv"), KNOWN)
    assert "other.csv: column " in str(caught.value) and not (block / "new").exists()


def test_what_is_made_is_as_sound_as_info_says(block: Path) -> None:
    """Calibrations that are none were copied, and the folder called sound."""
    for side in ("l.yaml", "r.yaml"):
        (block / side).write_text("abc")
    cameras = {"cameras": f"{block / 'l.yaml'},{block / 'r.yaml'}"}
    with pytest.raises(InputError, match=rf"{block / 'l.yaml'}: holds no keys"):
        make_experiment(block / "new", sources(block), KNOWN | cameras)
    assert not (block / "new").exists()
    lines = make_experiment(block / "new", sources(block), KNOWN | {"modulus": "25"})
    told = [f"warning: {f.text}" for f in inspect(block / "new").findings if f.level == "WARN"]
    assert len(told) == 1 and "collapses" in told[0]
    assert [line.partition(";")[0] for line in lines if line.startswith("warning: ")] == told


def test_a_unit_that_cannot_be_told_is_asked_for(tmp_path: Path) -> None:
    trimesh.creation.box((0.9, 0.9, 0.9)).export(tmp_path / "cube.stl")  # 0.9 m or 0.9 mm: only one is a body
    assert read_new_body(tmp_path / "cube.stl", None).unit == "m"
    trimesh.creation.box((3.0, 3.0, 3.0)).export(tmp_path / "cube.stl")
    with pytest.raises(InputError, match="--unit m or --unit mm"):
        read_new_body(tmp_path / "cube.stl", None)
    assert read_new_body(tmp_path / "cube.stl", "mm").size.tolist() == pytest.approx([0.003] * 3)


def test_a_ball_has_no_base(tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=3, radius=0.03).export(tmp_path / "ball.stl")
    assert read_new_body(tmp_path / "ball.stl", None).base is None


@pytest.mark.parametrize("unit", [1.0, 1e-3])
@pytest.mark.parametrize("off", [-5.0, 0.0, 2.0, 8.0])
def test_a_table_s_unit_is_told_wherever_markers_are_on_the_body(block: Path, off: float, unit: float) -> None:
    """Balls whose middles stand 2 mm off the skin, in metres, were read as millimetres: all of them 0.05 mm from the
    origin lie in the body's box."""
    places = np.array([[0.0, 0.0, 50 + off], [30 + off, 0.0, 20], [0.0, 30 + off, 20], [-30 - off, 5.0, 20]])
    rows = [f"{k},{','.join(f'{unit * x:.6f}' for x in place)}" for k, place in enumerate(places)]
    (block / "table.csv").write_text("\n".join(["id,x,y,z", *rows]))
    body = read_new_body(block / "block.stl", "mm")
    found, _ = read_places(block / "table.csv", body.surface, unit=None, rest=(0.0, 1.0), places={})
    np.testing.assert_allclose(found.points, 1e-3 * places, atol=1e-8)


@pytest.mark.parametrize("comment", ["", "# measured 12 May\n", "# one kind of marker: beads\n\n"])
@pytest.mark.parametrize("stated", [True, False])
def test_kinds_are_those_of_the_table_whatever_comments_it_has(block: Path, comment: str, stated: bool) -> None:
    """A comment above the header hid the column of kinds, and one about kinds was taken for it."""
    rows = ["id,x,y,z,kind", "1,0,0,20,surface", "2,0,0,48,internal", "3,40,0,0,surface", "4,30,0,20,surface"]
    table = rows if stated else [row.rpartition(",")[0] for row in rows]
    (block / "table.csv").write_text(comment + "\n".join(table))
    body = read_new_body(block / "block.stl", "mm")
    found, _ = read_places(block / "table.csv", body.surface, unit="mm", rest=(0.0, 1.0), places={})
    told, guessed = ["surface", "internal", "surface", "surface"], ["internal", "surface", "support", "surface"]
    assert found.kinds.tolist() == (told if stated else guessed)


def test_markers_of_a_recording_at_rest(block: Path) -> None:
    """In the tracker's frame, 0.5 m away: three stated places take them to the surface's."""
    table = np.array([[0.0, 0.0, 0.05], [0.03, 0.0, 0.02], [0.0, 0.03, 0.02], [-0.03, 0.0, 0.02]])
    away = table[:, [1, 2, 0]] + 0.5  # axes exchanged: a rotation
    with Writer(block / "a.mcap", begins="2026-03-01") as recording:
        for frame in range(10):
            moved = away + (0.02 if frame > 6 else 0.0)
            recording.points(0.1 * frame, [4, 3, 2, 1], moved)
    with pytest.raises(InputError, match="--place"):
        make_experiment(block / "new", sources(block, "a.mcap"), KNOWN)
    places = read_places_of(["4=0,0,0.05", "3=0.03,0,0.02", "2=0,0.03,0.02"])
    make_experiment(block / "new", sources(block, "a.mcap", places=places), KNOWN)
    markers = load_experiment(block / "new").markers
    assert markers.ids.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(markers.points, table[::-1], atol=1e-7)  # float32 of the recording


def test_how_markers_came_is_told_and_places_that_contradict_them_are_refused(block: Path) -> None:
    table = np.array([[0.0, 0.0, 0.05], [0.03, 0.0, 0.02], [0.0, 0.03, 0.02], [-0.03, 0.0, 0.02]])
    with Writer(block / "a.mcap", begins="2026-03-01") as recording:
        for frame in range(10):
            recording.points(0.1 * frame, [1, 2, 3, 4], table + 0.5)
    stated = ["1=0,0,0.05", "2=0.03,0,0.02", "3=0,0.03,0.021"]  # one is 1 mm off
    lines = make_experiment(block / "new", sources(block, "a.mcap", places=read_places_of(stated)), KNOWN)
    assert "4 markers of a.mcap at rest, moved to 3 stated places (misfit 0.30 mm rms)" in "\n".join(lines)  # measured
    assert any(
        "5 markers of table.csv, in mm" in line for line in make_experiment(block / "other", sources(block), KNOWN)
    )
    stated[0] = "1=0,0.012,0.045"
    with pytest.raises(InputError, match=r"--place: the stated places are .* mm"):
        make_experiment(block / "third", sources(block, "a.mcap", places=read_places_of(stated)), KNOWN)
    assert not (block / "third").exists()


@pytest.mark.parametrize("n", [1, 3, 4])
def test_markers_in_another_frame_are_not_taken_for_millimetres(block: Path, n: int) -> None:
    """Metres some 0.4 m beside the body were all put at its origin, as millimetres."""
    rows = [f"{k},{0.28 + 0.02 * k},{0.3 + 0.01 * (k % 2)},0.35" for k in range(n)]
    (block / "table.csv").write_text("\n".join(["id,x,y,z", *rows]))
    with pytest.raises(InputError, match="mm from the body; the frames differ"):
        make_experiment(block / "new", sources(block), KNOWN)


def test_nothing_is_overwritten_without_force(block: Path) -> None:
    make_experiment(block / "new", sources(block), KNOWN)
    with pytest.raises(InputError, match="--force"):
        make_experiment(block / "new", sources(block), KNOWN)
    with pytest.raises(InputError, match="input"):  # nor an input with it
        make_experiment(block, sources(block), KNOWN, force=True)


def test_the_command_and_the_view(block: Path) -> None:
    words = ["new", str(block / "new"), "--surface", str(block / "block.stl"), "--markers", str(block / "table.csv")]
    assert CliRunner().invoke(app, [*words, "--probe", "none"]).exit_code != 0  # options are missing
    assert run([*words, "--probe", "none", "--modulus", "4000", "--configuration", "loaded"]) == 0
    assert run(["view", str(block / "new"), "--no-open"]) == 0
    page = (block / "new" / "view.html").read_text()
    assert ("surface markers" in page and "Mesh3d" in page) or "mesh3d" in page


@pytest.mark.parametrize("option", ["--unit", "--markers-unit"])
def test_a_unit_that_nobody_knows_is_a_wrong_option(block: Path, option: str, capsys: pytest.CaptureFixture) -> None:
    words = ["new", str(block / "new"), "--surface", str(block / "block.stl"), "--markers", str(block / "table.csv")]
    assert run([*words, option, "cm"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"'{option}'" in said and "internal" not in said
    known = ["--probe", "none", "--modulus", "4000", "--configuration", "loaded"]
    assert run([*words, option, "mm", *known]) == 0


@pytest.mark.parametrize(
    "name", ["my # phantom", "phantom 😀", "a: b {c} 'd' \"e\"", "- \\ %", "tab\there\x7f", "007", "$\\frac$"]
)
def test_any_name_comes_back(block: Path, name: str) -> None:
    (block / "table.csv").write_text(TABLE)
    (block / "block.stl").rename(block / "my # block {1}.stl")
    surface = Sources(block / "my # block {1}.stl", block / "table.csv")
    trimesh.creation.box((0.02, 0.02, 0.02)).export(block / "a, # probe.stl")
    probe = {"probe": f"mesh:{block / 'a, # probe.stl'}"}
    make_experiment(block / "new", surface, KNOWN | probe | {"name": name})
    experiment = load_experiment(block / "new")
    assert experiment.name == name
    assert experiment.phantom.surface == (block / "new" / "my # block {1}.stl").resolve()
    assert experiment.probe is not None and experiment.probe.shape.mesh is not None
    assert experiment.probe.shape.mesh.name == "a, # probe.stl"


def test_nothing_is_asked_where_nothing_may_be_written(block: Path) -> None:
    make_experiment(block / "new", sources(block), KNOWN)
    with pytest.raises(InputError, match="there are results already"):
        make_experiment(block / "new", sources(block), {}, ask=lambda question, default: pytest.fail("it asked"))


def test_the_progress_bar_is_away_while_a_question_stands(block: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was drawn over the questions ten times a second."""
    bars: list[bool] = []

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    with Progress(Terminal()) as progress:
        live = progress._bar.live
        monkeypatch.setattr("typer.prompt", lambda question, default: bars.append(live.is_started) or "answer")
        monkeypatch.setattr("sys.stdin", Terminal())
        assert _asks(progress, True) is None
        ask = _asks(progress, False)
        assert ask is not None and live.is_started
        assert ask("What?", None) == "answer"
        assert live.is_started and bars == [False]


@pytest.mark.parametrize("text", ["ball:0.01", "cylinder:0.01,0.03", "box:0.02,0.015,0.04"])
@pytest.mark.parametrize("edge_radius", [0.0, 0.003])
def test_the_drawn_probe_is_the_probe(text: str, edge_radius: float) -> None:
    """Every vertex lies on the probe's signed distance field's zero, to the coarseness of the drawing."""
    from livedeform.fem_node.contact.probe_shapes import make_shape

    probe = Probe.model_validate({"shape": read_probe(text), "edge_radius": edge_radius})
    vertices, triangles = probe_mesh(probe)
    size = getattr(probe.shape, probe.shape.kind)
    distance = make_shape(probe.shape.kind, size, edge_radius).distance(vertices).d
    assert np.abs(distance).max() < 1e-5  # measured 3e-18 to 1e-17 m
    assert vertices[:, 2].max() == pytest.approx(0.0, abs=1e-9)
    assert trimesh.Trimesh(vertices, triangles).volume > 0
