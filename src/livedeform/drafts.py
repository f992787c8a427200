"""Hidden folders beside an output, in which results are written until they are whole; those of commands that were
killed are removed, or named, by the next one."""

from __future__ import annotations

import glob
import os
import shutil
import tempfile
import warnings
from pathlib import Path
from typing import Any

fcntl: Any
try:
    import fcntl
except ImportError:  # no Unix
    fcntl = None

DRAFT, RECORDED = "draft", "recording"  # of what can be made again, and of what cannot


def real(path: Path) -> Path:
    """Return the absolute path without links, whether or not it is there."""
    return path.expanduser().resolve()


def new_draft(out: Path, kind: str) -> Path:
    """Make a new folder beside ``out``; inside, where nothing can be made beside it (a mounted folder)."""
    place = real(out)
    try:
        draft = tempfile.mkdtemp(prefix=f".{place.name}-{kind}-", dir=place.parent)
    except OSError:
        draft = tempfile.mkdtemp(prefix=f".{kind}-", dir=place)
    mask = os.umask(0)
    os.umask(mask)
    Path(draft).chmod(0o777 & ~mask)
    return Path(draft)


def tidy(out: Path) -> None:
    """Remove the drafts that killed commands left beside ``out`` or in it; name, in a warning, what cannot be made
    again: a live recording, and results that were being replaced."""
    place = real(out)
    beside = f".{glob.escape(place.name)}"
    for path in [*place.parent.glob(f"{beside}-{DRAFT}-*"), *place.glob(f".{DRAFT}-*")]:
        if _abandoned(path):
            shutil.rmtree(path, ignore_errors=True)
    for path in [*place.parent.glob(f"{beside}-{RECORDED}-*"), *place.glob(f".{RECORDED}-*")]:
        if _abandoned(path):
            warnings.warn(f"a session was killed; what it had recorded is in {path}", stacklevel=2)
    for path in place.glob(".replaced-*"):
        warnings.warn(f"a command was killed while it replaced results; the earlier ones are in {path}", stacklevel=2)


def hold(folder: Path) -> int | None:
    """Lock a folder for as long as this process lives, or the file descriptor is open; None where that cannot be."""
    if fcntl is None:
        return None
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # another process has it, or the file system has no locks
        os.close(descriptor)
        return None
    return descriptor


def _abandoned(folder: Path) -> bool:
    """Return whether nobody holds a draft any more."""
    descriptor = hold(folder)
    if descriptor is not None:
        os.close(descriptor)
    return descriptor is not None
