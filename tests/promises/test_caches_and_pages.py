"""A damaged cache costs time and nothing else; nobody gets in by a folder or a page; what runs is what is declared."""

from __future__ import annotations

import ast
import re
import runpy
import sys
import tomllib
import warnings
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path

import numpy as np
import pytest
import trimesh

sys.path.insert(0, str(Path(__file__).parents[1] / "trust"))  # a small experiment and its recording

from situations import sound

from livedeform.cli import run as command_line
from livedeform.common.experiment.surface import read_surface
from livedeform.common.own_folder import is_own, own_folder
from livedeform.common.ros.session import PROFILE_VARIABLE, use_large_segment
from livedeform.fem_node.mesh import cache
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.path.load_history import bags_of, joined
from livedeform.report.run.read import without_folders

ROOT = Path(__file__).parents[2]


def try_damages(folder: Path, n: int) -> None:
    """A bit flipped, and the file cut, at ``n`` places: the whole mesh comes back, or one line says that it is made
    again."""
    mesh = block_mesh((0.04, 0.04, 0.03), (3, 3, 3))
    assert cache.save(folder, "key", mesh)
    file = folder / "key.npz"
    whole = file.read_bytes()
    n_damaged = 0
    for k, place in enumerate(np.random.default_rng(5).integers(0, len(whole), n).tolist()):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << (k % 8)
        file.write_bytes(damaged if k % 2 else whole[:place])
        said: list[str] = []
        kept = cache.load(folder, "key", said.append)
        if kept is None:
            n_damaged += 1
            assert len(said) == 1 and "is made again" in said[0] and "\n" not in said[0]
        else:  # a byte that nothing reads, as a date in the archive's directory
            np.testing.assert_array_equal(kept.mesh.nodes, mesh.nodes)
            np.testing.assert_array_equal(kept.mesh.tets, mesh.tets)
    assert n_damaged > n // 2
    assert cache.save(folder, "key", mesh) and cache.load(folder, "key") is not None


def test_a_kept_mesh_that_is_damaged_is_made_again(tmp_path: Path):
    try_damages(tmp_path / "meshes", 50)


KERNELS = """
from livedeform.common.compiled import njit

@njit(cache=True)
def twice(x):
    return 2.0 * x

@njit(cache=True)
def more(x):
    return twice(x) + 1.0
"""


def try_damaged_kernels(folder: Path, n: int) -> None:
    """A bit flipped, and the file cut, at ``n`` places of what numba keeps: the kernels give what they gave, and one
    line says that they were compiled again."""
    source = folder / "kernels.py"
    source.write_text(KERNELS)

    def answer() -> set[str]:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            assert runpy.run_path(str(source))["more"](3.0) == 7.0
        return {str(w.message) for w in said}

    rng = np.random.default_rng(6)
    n_said = len(answer())
    assert n_said == 0
    for k in range(n):
        files = sorted((folder / "__pycache__").glob("*.nb[ci]"))
        assert len(files) >= 4
        file = files[k % len(files)]
        whole = file.read_bytes()
        damaged, place = bytearray(whole), int(rng.integers(0, len(whole)))
        damaged[place] ^= 1 << (k % 8)
        file.write_bytes(damaged if k % 3 else whole[:place])
        said = answer()
        assert len(said) <= 1 and all("compiled again" in text for text in said)
        n_said += len(said)
    assert n_said > n // 3  # half of the files are of a kernel that nothing asks for while the other is whole
    assert answer() == set()


def test_a_kept_kernel_that_is_damaged_is_compiled_again(tmp_path: Path):
    try_damaged_kernels(tmp_path, 20)


@pytest.mark.slow
def test_kept_kernels_damaged_at_500_places(tmp_path: Path):
    try_damaged_kernels(tmp_path, 500)


def test_every_kernel_that_is_kept_is_checked():
    """Kernels are decorated by `livedeform.common.compiled.njit`, not by numba's own."""
    own = re.compile(r"from numba import .*\bn?jit\b|numba\.(n?jit|vectorize|guvectorize)\(.*cache=True")
    found = [p for p in (ROOT / "src").rglob("*.py") if p.name != "compiled.py" and own.search(p.read_text())]
    assert not found


@pytest.mark.slow
def test_a_kept_mesh_that_is_damaged_at_500_places_is_made_again(tmp_path: Path):
    try_damages(tmp_path / "meshes", 500)


def test_a_folder_in_which_everybody_may_write_is_no_cache(tmp_path: Path):
    mesh = block_mesh((0.04, 0.04, 0.03), (1, 1, 1))
    assert cache.save(tmp_path / "meshes", "key", mesh) and is_own(tmp_path / "meshes")
    (tmp_path / "meshes").chmod(0o777)
    said: list[str] = []
    assert cache.load(tmp_path / "meshes", "key", said.append) is None and len(said) == 1
    assert not cache.save(tmp_path / "meshes", "other", mesh)
    (tmp_path / "link").symlink_to(tmp_path)
    assert not own_folder(tmp_path / "link")


def test_a_profile_in_anothers_folder_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import os

    monkeypatch.delenv(PROFILE_VARIABLE, raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    planted = tmp_path / f"livedeform-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    path = use_large_segment()
    monkeypatch.delenv(PROFILE_VARIABLE)
    assert path is not None and path.parent != planted and is_own(path.parent)


def test_a_report_can_be_made_again_fetches_nothing_and_tells_no_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    bag, out = sound(tmp_path).write(), tmp_path / "out"
    assert command_line(["run", str(tmp_path), "--bag", str(bag), "--out", str(out)]) in (0, 1)
    (out / "report.html").unlink()
    before = (out / "metrics.json").read_bytes()
    assert command_line(["report", str(out)]) == 0 and (out / "metrics.json").read_bytes() == before
    assert command_line(["report", str(tmp_path)]) == 2
    assert "holds no run.mcap" in capsys.readouterr().err
    page = (out / "report.html").read_text()
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
    assert policy is not None and "default-src 'none'" in policy[1] and "http" not in policy[1]
    assert "unsafe-eval" not in policy[1]
    assert str(tmp_path) not in page and str(Path.home()) + "/" not in page
    assert "/stereo/markers" in page


def test_only_places_are_cut_from_texts():
    text = "bag: /home/me/a b/x.mcap\ntopic: /stereo/markers\nurl: https://a.org/b/c\nratio: 3/4\n- '/data/y.yaml'"
    cut = without_folders(text)
    assert "/home/me" not in cut and "/data" not in cut
    assert "/stereo/markers" in cut and "https://a.org/b/c" in cut and "3/4" in cut


def test_a_path_with_a_colon_is_one_recording():
    paths = [Path("/data/12:30/a.mcap"), Path("b.mcap")]
    assert bags_of(joined(paths)) == paths and bags_of("a.mcap:b.mcap") == [Path("a.mcap"), Path("b.mcap")]
    assert joined(()) == "" and bags_of("") == []


def test_a_surface_that_points_inwards_is_turned_with_what_is_declared(tmp_path: Path):
    ball = trimesh.creation.icosphere(1)
    faces = np.array(ball.faces)
    faces[::2] = faces[::2, ::-1]
    trimesh.Trimesh(ball.vertices, faces, process=False).export(tmp_path / "ball.stl")
    assert read_surface(tmp_path / "ball.stl").volume == pytest.approx(ball.volume, rel=1e-6)


NOT_USED = {"test", "benchmark", "browser"}  # extras of which the installed program imports nothing


def _name(requirement: str) -> str:
    return re.split(r"[\[<>=!~;( ]", requirement)[0].lower().replace("_", "-")


def test_every_package_that_is_imported_is_declared():
    """Or comes with one that is, in every case; ROS's messages come with common-interfaces."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    listed = [*project["dependencies"], *(line for name in extras.keys() - NOT_USED for line in extras[name])]
    for name in list(listed):
        with suppress(PackageNotFoundError):
            listed += [needed for needed in requires(_name(name)) or () if "extra ==" not in needed]
    declared = {_name(name) for name in listed}
    known = packages_distributions()
    missing = set()
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module and not node.level else []
            for name in {n.partition(".")[0] for n in names} - {"livedeform"} - sys.stdlib_module_names:
                given = {d.lower().replace("_", "-") for d in known.get(name, [])}
                if given and not given & declared and not any(d.startswith("ros-") for d in given):
                    missing.add(f"{path.name}: {name}")
    assert not missing
