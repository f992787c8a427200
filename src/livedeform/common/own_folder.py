"""Folders of one's own, for what is read again without a question: caches and profiles."""

from __future__ import annotations

import os
import stat
from pathlib import Path

WRITABLE_BY_ALL = 0o002


def own_folder(folder: Path) -> bool:
    """Make the ``folder`` if it is not there; tell whether it is this user's own, no link, and nobody else may write.

    ``OSError`` where it cannot be made.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    return is_own(folder)


def is_own(folder: Path) -> bool:
    """Tell whether a folder is there, is this user's own, is no link, and is not writable by everybody."""
    try:
        state = folder.lstat()
    except OSError:
        return False
    mine = stat.S_ISDIR(state.st_mode) and state.st_uid == os.geteuid()
    return mine and not state.st_mode & WRITABLE_BY_ALL
