"""The experiments that come with the program: in the source tree, or under share/livedeform where it is installed."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator
from pathlib import Path

from livedeform.common.errors import InputError

BREAST, CUBOID = "breast_phantom", "gelatin_cuboid"


def shipped(name: str) -> Path:
    """The folder of a shipped experiment: ``experiment/`` and ``bags/`` are in it."""
    for bags in _places():
        if (bags / name / "experiment" / "experiment.yaml").is_file():
            return bags / name
    raise InputError(
        f"the shipped experiment '{name}' is not installed",
        remedy="install from a clone of the repository: pip install .",
    )


def shipped_file(name: str) -> Path:
    """A file that is shipped beside ``bags``, as ``config/foxglove.json``."""
    for bags in _places():
        if (bags.parent / name).is_file():
            return bags.parent / name
    raise InputError(
        f"the file {name} is not installed", remedy="install from a clone of the repository: pip install ."
    )


def _places() -> Iterator[Path]:
    package = Path(__file__).resolve().parent
    yield package.parents[1] / "bags"  # a source tree
    try:
        for file in importlib.metadata.files("livedeform") or []:
            if file.name == "package.xml":  # pip puts shared files beside it, wherever that is
                yield Path(str(file.locate())).resolve().parent / "bags"
    except importlib.metadata.PackageNotFoundError:
        pass
    yield package.parents[3] / "share" / "livedeform" / "bags"  # colcon: lib/python3.x/site-packages/livedeform
