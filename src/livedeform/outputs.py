"""Output folders: nothing is overwritten by accident, and what a command ran with lies beside its results."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import math
import os
import platform
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import livedeform
from livedeform.common.errors import InputError

CONFIGURATION = "configuration.json"
PACKAGES = (
    "numpy", "scipy", "numba", "pypardiso", "opencv-python-headless", "rosbags", "mcap", "pytetwild", "ros-jazzy-rclpy",
)  # fmt: skip


def prepare(out: Path, names: Iterable[str], *, force: bool) -> None:
    """Makes the folder ``out``; ``names`` are what will be written there, and are removed first if ``force``."""
    if out.exists() and not out.is_dir():
        raise InputError("is a file", where=str(out), remedy="name a folder with --out")
    present = [out / name for name in (*names, CONFIGURATION) if (out / name).exists()]
    if present and not force:
        raise InputError("there are results already", where=str(out), remedy="choose another --out, or add --force")
    for path in present:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", where=str(out), remedy="name another --out") from error


@contextmanager
def prepared(out: Path, names: Iterable[str], *, force: bool) -> Iterator[None]:
    """``prepare``, for as long as results are worked out: if that fails, no empty folder is left behind."""
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    prepare(out, names, force=force)
    try:
        yield
    except BaseException:
        with suppress(OSError):  # of the first that something was written to
            for folder in made:
                folder.rmdir()
        raise


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    found = {"livedeform": livedeform.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def configuration(command: str, options: Mapping[str, Any], *, seed: int | None = None) -> dict[str, Any]:
    """What a command runs with: options, seed, versions, machine, time."""
    return {
        "command": command,
        "options": {key: _plain(value) for key, value in options.items()},
        "seed": seed,
        "versions": versions(),
        "machine": {"system": platform.platform(), "cores": os.cpu_count()},
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "arguments": sys.argv[1:],
    }


def write_configuration(out: Path, what: Mapping[str, Any]) -> None:
    """``configuration.json``."""
    write_json(out / CONFIGURATION, what)


def write_json(path: Path, document: Any) -> None:
    """JSON without NaN (null instead), floats with all their digits."""
    path.write_text(json.dumps(_plain(document), indent=2, allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value
