"""What was installed is what was tested: pinned, within bounds, declared, and whole without the tests' packages."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
NEEDED = [Requirement(line) for line in (*PROJECT["project"]["dependencies"], *EXTRAS["fast"])]
LOCKS = [(ROOT / name).read_text() for name in ("requirements.lock", "requirements-check.lock")]
BASE, CHECK = (re.findall(r"^([\w.-]+)==(\S+)(.*?)(?=^\S|\Z)", lock, re.M | re.S) for lock in LOCKS)
PINS = [*BASE, *CHECK]
WALK = """
import importlib, pkgutil, livedeform
from livedeform.commands.campaign import NEEDED
from livedeform.shipped import shipped
names = [m.name for m in pkgutil.walk_packages(livedeform.__path__, "livedeform.")]
for name in names:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if not name.startswith("livedeform.campaign.") or error.name not in NEEDED:
            raise
print(len(names), livedeform.__file__, shipped("breast_phantom"))
"""


def test_every_pin_has_its_hashes():
    assert len(PINS) > 100
    assert not [name for name, _, hashes in PINS if "--hash=sha256:" not in hashes]


@pytest.mark.parametrize("place", ["Makefile", "docs/first-steps.md", "docs/ros-wheels.md"])
def test_a_newer_package_on_the_index_does_not_break_the_lock(place: str):
    """With dependencies pip looks up the newest of what is asked for with an extra, and refuses it without a hash."""
    commands = re.findall(r"^.*--require-hashes.*$", (ROOT / place).read_text(), re.M)
    assert commands and all("--no-deps" in command for command in commands)


def test_what_is_declared_is_pinned_within_its_bounds():
    """All versions of a package that is pinned differently for different Pythons among them."""
    base = [*map(str, NEEDED), *EXTRAS["test"], *EXTRAS["benchmark"], *PROJECT["build-system"]["requires"]]
    for pins, lines in ((BASE, base), (PINS, [*EXTRAS["campaign"], *EXTRAS["docs"], *EXTRAS["rerun"]])):
        for line in lines:
            wanted = Requirement(line)
            versions = [version for name, version, _ in pins if name == canonicalize_name(wanted.name)]
            assert versions and all(wanted.specifier.contains(version) for version in versions), line


def test_what_only_checks_need_is_pinned_once():
    """Nobody who runs the demo pays for Dask or a documentation site; no package has two versions on one Python."""
    assert not {(name, rest.partition("--hash")[0]) for name, _, rest in BASE} & {
        (name, rest.partition("--hash")[0]) for name, _, rest in CHECK
    }
    assert not {"dask", "pyarrow", "mkdocs", "rerun-sdk"} & {name for name, _, _ in BASE}


def test_every_bound_has_two_sides():
    for wanted in NEEDED:
        kinds = {clause.operator for clause in wanted.specifier}
        assert kinds == {">=", "<"} or kinds == {"=="}, str(wanted)


def test_the_lock_has_what_builds_the_package():
    assert PROJECT["dependency-groups"]["build"] == PROJECT["build-system"]["requires"]


def test_the_licences_page_is_that_of_the_lock():
    done = subprocess.run([sys.executable, "docs/make_licences.py", "--check"], cwd=ROOT, check=False)
    assert done.returncode == 0, "run: python docs/make_licences.py"
    listed = set(re.findall(r"^\| ([\w.-]+) \| [\w.]+ \| \S", (ROOT / "docs" / "licences.md").read_text(), re.M))
    elsewhere = {name for name, _, rest in PINS if "sys_platform" in rest}
    assert {name for name, _, _ in PINS} - elsewhere <= listed


@pytest.mark.slow
def test_a_wheel_works_without_the_packages_of_the_tests(tmp_path: Path):
    """Build it, install it into an empty environment, import every module, and let the program look after itself."""
    # the ROS wheels set their library path once for a process and its children: the new environment has its own
    own = {
        k: v
        for k, v in os.environ.items()
        if k not in ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE", "PYTHONPATH")
    }
    own |= {"HOME": str(tmp_path)}

    def do(*command: object, code: int = 0) -> str:
        words = [str(word) for word in command]
        done = subprocess.run(words, cwd=tmp_path, env=own, capture_output=True, text=True, check=False)
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout if code == 0 else done.stderr

    do(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path / "dist", ROOT)
    do(sys.executable, "-m", "venv", tmp_path / "venv")
    bin_ = tmp_path / "venv" / "bin"
    pins = tmp_path / "pins.txt"
    pins.write_text(
        "".join(
            f"{line}\n" for line in re.findall(r"^[\w.-]+==[^\\\n]+", (ROOT / "requirements.lock").read_text(), re.M)
        )
    )
    do(bin_ / "python", "-m", "pip", "install", "--quiet", "-c", pins, *(tmp_path / "dist").glob("*.whl"))
    n, *places = do(bin_ / "python", "-c", WALK).split()
    assert int(n) > 200 and all(str(tmp_path) in place for place in places)
    assert "diagnose" in do(bin_ / "livedeform", "--help")
    assert "everything that is needed works" in do(bin_ / "livedeform", "doctor")
    refused = do(bin_ / "livedeform", "campaign", tmp_path, "--out", tmp_path / "out", code=2)
    assert "pip install 'livedeform[campaign]'" in refused and refused.count("\n") == 1


def test_what_the_container_installs_can_be_had_together():
    """ROS 2 Jazzy's messages are built against NumPy 1.26, ours asks for NumPy 2: in the container's list no package is
    asked for twice, none comes as ROS's wheel, and NumPy is ROS's own."""
    done = subprocess.run([sys.executable, ROOT / ".ci" / "beside_ros.py"], capture_output=True, text=True, check=True)
    asked = [Requirement(line) for line in done.stdout.split("\n") if line]
    names = [canonicalize_name(r.name) for r in asked]
    assert len(names) == len(set(names)) > 20 and not any(name.startswith("ros-") for name in names)
    assert "1.26.4" in asked[names.index("numpy")].specifier
    assert "beside_ros.py" in (ROOT / "Dockerfile").read_text()
