"""The packages that the program is tested with.

    python .ci/packages.py lock     writes requirements.lock: the newest within pyproject's bounds, with hashes; and
                                    requirements-check.lock, what checks and the site need beyond it
    python .ci/packages.py check    says where what is installed here is not what the two locks pin
    python .ci/packages.py oldest   makes an environment of the oldest packages within the bounds, runs fast tests in it

The first and the last need uv (``pip install uv``).
"""

from __future__ import annotations

import importlib.metadata
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LOCK, CHECK_LOCK = ROOT / "requirements.lock", ROOT / "requirements-check.lock"
EXTRAS = ("fast", "test", "benchmark")
CHECK_EXTRAS = ("campaign", "docs", "rerun")  # installed by "make check" and "make docs" only: 900 MB
HEAD = "# Written by .ci/packages.py lock; installed by make. Every file is known by its hash.\n"
CHECK_HEAD = "# Written by .ci/packages.py lock: what make check and make docs install beyond requirements.lock.\n"
FAST_TESTS = (
    "tests/common",
    "tests/compare_node",
    "tests/stereo_node",
    "tests/graph",
    "tests/campaign",
    "tests/test_architecture.py",
)
EVERY_MODULE = """
import pkgutil, sys, livedeform
failed = []
for module in pkgutil.walk_packages(livedeform.__path__, "livedeform."):
    try:
        __import__(module.name)
    except Exception as error:
        failed.append(f"{module.name}: {type(error).__name__}: {error}")
sys.exit("\\n".join(failed) or 0)
"""


def compiled(*options: str, extras: Sequence[str] = EXTRAS) -> str:
    """Return what uv makes of pyproject.toml; ``options`` may ask for more extras."""
    command = ["uv", "pip", "compile", "pyproject.toml", "--python-version", "3.11", "--no-header", "--no-annotate"]
    command += [word for extra in extras for word in ("--extra", extra)]
    done = subprocess.run([*command, *options], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stderr)
    return done.stdout


def pinned() -> list[Requirement]:
    """Return the lock's requirements that apply to this interpreter and machine."""
    lines = [line for file in (LOCK, CHECK_LOCK) for line in file.read_text().splitlines()]
    requirements = [Requirement(line.rstrip(" \\")) for line in lines if line and line[0] not in " #"]
    return [r for r in requirements if r.marker is None or r.marker.evaluate()]


def differences() -> list[str]:
    """Return one line for each package that is not installed as the lock pins it."""
    lines = []
    for requirement in pinned():
        try:
            found = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            found = "not installed"
        if not requirement.specifier.contains(found, prereleases=True):
            lines.append(f"{canonicalize_name(requirement.name)}: {found}, the lock has {requirement.specifier}")
    return lines


def lock() -> int:
    """Write both locks, the second without what the first has."""
    options = ("--group", "build", "--universal", "--generate-hashes")
    LOCK.write_text(HEAD + compiled(*options, "--upgrade"))
    whole = compiled(*options, "--constraint", str(LOCK), extras=(*EXTRAS, *CHECK_EXTRAS))
    known = {requirement(block) for block in blocks(LOCK.read_text())}
    CHECK_LOCK.write_text(CHECK_HEAD + "".join(b for b in blocks(whole) if requirement(b) not in known))
    return 0


def blocks(text: str) -> list[str]:
    """Return a lock's requirements, each with the lines of its hashes."""
    return re.findall(r"^\w.*\n(?: .*\n)*", text, re.M)


def requirement(block: str) -> str:
    """Return the first line of a lock's block, without what continues it."""
    return block.partition("\n")[0].rstrip(" \\")


def check() -> int:
    """Compare what is installed with the lock."""
    lines = differences()
    print("\n".join(lines) or f"all {len(pinned())} packages are those of the locks")
    return len(lines) > 0


def oldest() -> int:
    """Run the fast tests with the oldest packages; gives pytest's exit code."""
    with tempfile.TemporaryDirectory(prefix="livedeform-oldest-") as folder:
        wanted, python = Path(folder) / "requirements.txt", Path(folder) / "venv" / "bin" / "python"
        wanted.write_text(compiled("--extra", "campaign", "--resolution", "lowest-direct"))
        subprocess.run(["uv", "venv", "--quiet", "--python", sys.executable, python.parents[1]], check=True)
        subprocess.run(["uv", "pip", "install", "--quiet", "--python", python, "-r", wanted], check=True)
        subprocess.run(["uv", "pip", "install", "--quiet", "--python", python, "--no-deps", "-e", ROOT], check=True)
        # the ROS wheels set their library path once for a process and its children: this environment has its own
        own = {k: v for k, v in os.environ.items() if k not in ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")}
        own |= {"PYTHONPATH": str(ROOT / "src"), "NUMBA_CACHE_DIR": str(Path(folder) / "kernels")}
        subprocess.run([python, "-c", EVERY_MODULE], env=own, check=True)
        words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow and not statistical", *FAST_TESTS]
        return subprocess.run([python, *words], cwd=ROOT, env=own, check=False).returncode


if __name__ == "__main__":
    commands = {"lock": lock, "check": check, "oldest": oldest}
    if len(sys.argv) != 2 or sys.argv[1] not in commands:
        sys.exit(__doc__)
    sys.exit(commands[sys.argv[1]]())
