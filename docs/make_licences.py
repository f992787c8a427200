"""Writes docs/licences.md: the licence of every package in the two locks, from what is installed here.

python docs/make_licences.py [--check]
"""

from __future__ import annotations

import importlib.metadata
import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError
from pathlib import Path
from xml.etree import ElementTree

HERE = Path(__file__).parent
PAGE = HERE / "licences.md"
LOCKS = (HERE.parent / "requirements.lock", HERE.parent / "requirements-check.lock")
HEAD = """# Licences

livedeform is Apache-2.0. These are the packages that `make` and `make check` install beside it, as their authors
declare their licences (for the ROS wheels, in their `package.xml`) on Linux with Python 3.11;
`python docs/make_licences.py` writes this page.
A report (`report.html`) holds plotly.js, which is MIT. Of what the program imports, MKL (`fast`) is not open source,
and nothing is GPL.

| package | version | licence |
|---|---|---|
"""
ELSEWHERE = {  # declared in the source repository only
    "ezc3d": "MIT",
    "ros-fastcdr": "Apache-2.0",
    "ros-fastrtps": "Apache-2.0",
}


def pins() -> list[tuple[str, str]]:
    """Return name and version of everything in the locks, once per version."""
    text = "".join(lock.read_text() for lock in LOCKS)
    return re.findall(r"^([\w.-]+)==([\w.]+)(?! ; sys_platform == .win32)\b", text, re.M)


def licence(found: Distribution) -> str:
    """Return what a package declares: an SPDX expression, else its classifiers, else its licence's first line."""
    metadata = found.metadata
    if expression := metadata.get("License-Expression"):
        return str(expression)
    classes = [c.rpartition(" :: ")[2] for c in metadata.get_all("Classifier") or [] if c.startswith("License ::")]
    classes = [c for c in classes if c != "OSI Approved"]
    if classes:
        return ", ".join(classes)
    text = str(metadata.get("License") or "").strip().splitlines()
    return text[0] if text else declared_to_ros(found)


def declared_to_ros(found: Distribution) -> str:
    """Return the licences of a ROS package's ``package.xml``, or of the package that a meta-package stands for."""
    for file in found.files or []:
        if file.name == "package.xml":
            tree = ElementTree.parse(str(file.locate()))
            return ", ".join(node.text or "" for node in tree.findall("license"))
    needed = [r for r in found.requires or [] if r.startswith("ros-") and "extra" not in r]
    name = re.split(r"[<>=~! ]", needed[0])[0] if len(needed) == 1 else ""
    return licence(importlib.metadata.distribution(name)) if name else ""


def rows() -> dict[str, str]:
    """Return the page's row of each package that is installed as it is pinned."""
    out = {}
    for name, version in pins():
        try:
            found = importlib.metadata.distribution(name)
        except PackageNotFoundError:
            continue
        if found.version == version:
            out[name] = f"| {name} | {version} | {licence(found) or ELSEWHERE.get(name, 'not declared')} |"
    return out


def page() -> str:
    """Return the whole page."""
    here = rows()
    return HEAD + "\n".join(here[name] for name in sorted(here)) + "\n"


if __name__ == "__main__":
    if "--check" in sys.argv:
        text = PAGE.read_text()
        sys.exit(0 if all(row in text for row in rows().values()) else 1)
    PAGE.write_text(page())
