"""Points in TRC files (Motion Analysis, OpenSim) and in numpy arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array
from livedeform.importing.tables import RATE_AGREES, PointTable


def read_npy(path: Path) -> PointTable:
    """Read an array (frames, markers, 3)."""
    try:
        points = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise RecordingError(f"cannot be read ({error})", where=str(path), remedy="save it with numpy.save") from error
    if not isinstance(points, np.ndarray) or points.dtype.kind not in "fiu":
        what = f"{points.dtype} values" if isinstance(points, np.ndarray) else "several arrays"
        raise RecordingError(f"holds {what}", where=str(path), remedy="save one array of real numbers")
    if points.ndim != 3 or points.shape[2] != 3:
        shape = " x ".join(map(str, points.shape))
        one = "; one marker's frames x 3 are points[:, None, :]" if points.ndim == 2 and points.shape[1] == 3 else ""
        raise RecordingError(f"holds {shape} values", where=str(path), remedy=f"save frames x markers x 3 numbers{one}")
    labels = tuple(str(k + 1) for k in range(points.shape[1]))
    return PointTable(labels, points.astype(float), None, "", "numpy array of frames x markers x 3")


def read_trc(path: Path) -> PointTable:
    """Read a TRC file: five lines of header with rate, units and names, then frame, time, x, y, z, .."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise RecordingError(f"cannot be read ({error.strerror})", where=str(path), remedy="name a TRC file") from error
    lines = text.splitlines()
    if len(lines) < 6 or "\t" not in lines[3]:
        raise RecordingError(
            "cannot be read as TRC: it has no five lines of header in columns between tabs, and frames below them",
            where=str(path), remedy="export it again",
        )  # fmt: skip
    stated = dict(zip(lines[1].split("\t"), (cell.strip() for cell in lines[2].split("\t")), strict=False))
    labels = tuple(name.strip() for name in lines[3].split("\t")[2:] if name.strip())
    rows = [(n, line.rstrip("\r\n")) for n, line in enumerate(lines[5:], 6) if line.strip()]
    if not rows:
        raise RecordingError("holds no frames", where=str(path), remedy="export it again")
    _check(path, stated, labels, len(rows))
    wide = 2 + 3 * len(labels)
    if not text.endswith(("\n", "\r")) and len(rows[-1][1].split("\t")) < wide:
        raise RecordingError("ends within a line", where=f"{path}:{rows[-1][0]}", remedy="export it again")
    table = np.array([_numbers(path, n, line, wide) for n, line in rows])
    points = table[:, 2:].reshape(len(table), len(labels), 3)
    unit = stated.get("Units", "").lower()
    return PointTable(labels, points, table[:, 1], unit, "TRC", table[:, 0], _agrees(stated, table[:, 1]))


def _agrees(stated: dict[str, str], times: Array) -> bool:
    """Return whether the rate in the header is that of the times, which are in seconds then."""
    try:
        rate = float(stated.get("DataRate", ""))
    except ValueError:
        return False
    return len(times) > 1 and bool(abs(rate * np.median(np.diff(times)) - 1.0) < RATE_AGREES)


def _check(path: Path, stated: dict[str, str], labels: tuple[str, ...], n_frames: int) -> None:
    """Raise ``RecordingError`` where names or frames are not as many as the header says, or two markers have one
    name."""
    twice = next((name for name in labels if labels.count(name) > 1), None)
    if not labels or twice is not None:
        what = f"has two markers called '{twice}'" if labels else "names no markers"
        raise RecordingError(what, where=f"{path}:4", remedy="give every marker its own name")
    for key, found, what in (("NumMarkers", len(labels), "marker names"), ("NumFrames", n_frames, "frames")):
        if stated.get(key, "").isdigit() and int(stated[key]) != found:
            raise RecordingError(
                f"states {key} {stated[key]} and holds {found} {what}", where=str(path),
                remedy="it may be torn; export it again",
            )  # fmt: skip


def _numbers(path: Path, number: int, line: str, wide: int) -> Array:
    """Return a line's numbers (wide,), NaN where a cell is empty; what is beyond is not read."""
    cells = [cell.strip() for cell in line.split("\t")][:wide]
    if len(cells) < wide and (len(cells) - 2) % 3:
        raise RecordingError(
            f"has {len(cells)} cells of {wide}", where=f"{path}:{number}", remedy="it may be torn; export it again"
        )
    try:
        found = [float(cell or "nan") for cell in cells]
    except ValueError as error:
        raise RecordingError(
            f"holds a cell that is no number ({error})", where=f"{path}:{number}", remedy="export it again"
        ) from error
    return np.array(found + [np.nan] * (wide - len(cells)))
