"""What colcon needs in setup.py, and the files beside the packages; everything else is in pyproject.toml."""

from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

from setuptools import setup

SHARED = ("bags", "config", "launch")


def shared_files():
    """Files of the folders that are installed under share/livedeform, one row per folder."""
    rows = []
    for folder in SHARED:
        for path in sorted(Path(folder).rglob("*")):
            files = sorted(str(f) for f in path.iterdir() if f.is_file()) if path.is_dir() else []
            if files:
                rows.append((f"share/livedeform/{path.as_posix()}", files))
        files = sorted(str(f) for f in Path(folder).glob("*") if f.is_file())
        if files:
            rows.append((f"share/livedeform/{folder}", files))
    return rows


def version():
    """Take package.xml's version where setuptools-scm, which knows the tag, is missing: colcon installs nothing."""
    return {} if find_spec("setuptools_scm") else {"version": ElementTree.parse("package.xml").findtext("version")}


setup(
    **version(),
    python_requires=">=3.11,<3.15",
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/livedeform"]),
        ("share/livedeform", ["package.xml"]),
        *shared_files(),
    ],
)
