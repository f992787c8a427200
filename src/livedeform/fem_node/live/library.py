"""The library of a live model: full solutions, linearised, and the file in which they are kept."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.own_folder import is_own, own_folder
from livedeform.common.types import Array
from livedeform.fem_node.live.condensed import Condensed


@dataclass(frozen=True)
class Entry:
    """A full solution at the pose ``T`` (4, 4), linearised: ``body``; ``multiplier``: the contact's, Pa; ``force`` (m,)
    N: the probe's at the body's dofs; ``spread`` m: how far the full model's solution at the pose is from it when
    reached by another way."""

    T: Array
    body: Condensed
    multiplier: Array
    force: Array
    spread: float = 0.0


class Library(NamedTuple):
    """``entries``; the largest ``coefficient`` c (1/m) of an error c d^2 that was measured between them, and the
    ``floor`` m, the largest error beside their path beyond that."""

    entries: list[Entry]
    coefficient: float
    floor: float


def write_library(path: Path, rows: NDArray[np.int64], library: Library) -> bool:
    """Write the ``library`` of a body whose dofs ``rows`` (k,) are asked for, aside first, so that nobody reads half a
    file; False where nothing can be written."""
    arrays: dict[str, Any] = {"n": len(library.entries), "coefficient": library.coefficient, "floor": library.floor}
    for k, entry in enumerate(library.entries):
        arrays |= {f"{k}.{name}": getattr(entry, name) for name in ("T", "multiplier", "force", "spread")}
        arrays.update({f"{k}.{f.name}": getattr(entry.body, f.name) for f in fields(Condensed) if f.name != "rows"})
    draft = path.with_name(f".{path.stem}-{os.getpid()}.npz")
    try:
        if not own_folder(path.parent):
            return False
        np.savez(draft, rows=rows, **arrays)
        os.replace(draft, path)
    except OSError:
        with contextlib.suppress(OSError):  # of a folder that is none
            draft.unlink()
        return False
    return True


def read_library(path: Path, rows: NDArray[np.int64], tell: Callable[[str], None]) -> Library | None:
    """Read what `write_library` wrote, for a body whose dofs ``rows`` (k,) are asked for; None if there is no such
    file, or if it is damaged, which is told."""
    if not is_own(path.parent) or not path.is_file():
        return None
    try:
        with np.load(path) as z:
            entries = [_entry(z, k, rows) for k in range(int(z["n"]))]
            return Library(entries, float(z["coefficient"]), float(z["floor"]))
    except Exception as error:  # whatever a torn or flipped file makes numpy, zipfile and zlib raise
        tell(f"the kept solutions {path} are damaged ({type(error).__name__}) and are made again")
    return None


def _entry(z: Mapping[str, Any], k: int, rows: NDArray[np.int64]) -> Entry:
    parts = {f.name: z[f"{k}.{f.name}"] for f in fields(Condensed) if f.name != "rows"}
    body = Condensed(rows=rows, **parts)
    return Entry(z[f"{k}.T"], body, z[f"{k}.multiplier"], z[f"{k}.force"], float(z[f"{k}.spread"]))
