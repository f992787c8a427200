"""Positions that SOFA's WriteState or Monitor wrote (algorithm 1 of the thesis): ``..._x.txt``.

Monitor writes one line per time step, a column for the time and one per particle, tabs between columns and spaces
between a particle's coordinates, after a header line. WriteState writes blocks ``T= time`` / ``X= x y z x y z ...``.
Both are read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.types import Array


@dataclass(frozen=True)
class SofaPositions:
    """``seconds`` (f,) and ``points`` (f, n, 3) in the scene's unit of length."""

    seconds: Array
    points: Array

    def heights(self, axis: int = 2) -> Array:
        """Highest minus lowest particle (f,) along an axis, as the thesis measures."""
        heights: Array = np.ptp(self.points[:, :, axis], axis=1)
        return heights


def read_sofa_positions(path: Path) -> SofaPositions:
    """Read a SOFA position export; ``InputError`` names the line that cannot be read."""
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror})", where=str(path), remedy="name a SOFA _x.txt file"
        ) from error
    written = [line for line in lines if line.strip()]
    if any(line.lstrip().startswith("X=") for line in written):
        return _write_state(written, path)
    return _monitor(written, path)


def _write_state(lines: list[str], path: Path) -> SofaPositions:
    seconds: list[float] = []
    points: list[Array] = []
    now = 0.0
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if text.startswith("T="):
            now = float(text[2:].split()[0])
        elif text.startswith("X="):
            values = _floats(text[2:].replace("X=", ""), path, number)
            points.append(_triples(values, path, number))
            seconds.append(now)
    return _stacked(seconds, points, path)


def _monitor(lines: list[str], path: Path) -> SofaPositions:
    seconds: list[float] = []
    points: list[Array] = []
    for number, line in enumerate(lines, 1):
        columns = [c for c in line.replace("#", " ").split("\t") if c.strip()]
        try:
            now = float(columns[0].split()[0])
        except (ValueError, IndexError):
            if points:
                raise InputError(
                    f"line {number} has no time in its first column", where=str(path), remedy="export it again"
                ) from None
            continue  # header
        values = _floats(" ".join([" ".join(columns[0].split()[1:]), *columns[1:]]), path, number)
        points.append(_triples(values, path, number))
        seconds.append(now)
    return _stacked(seconds, points, path)


def _floats(text: str, path: Path, number: int) -> Array:
    try:
        return np.array(text.split(), float)
    except ValueError as error:
        raise InputError(f"line {number}: {error}", where=str(path), remedy="it must hold numbers only") from error


def _triples(values: Array, path: Path, number: int) -> Array:
    if len(values) == 0 or len(values) % 3:
        raise InputError(
            f"line {number} holds {len(values)} numbers, not x y z of particles",
            where=str(path),
            remedy="export positions (the file that ends in _x.txt), not velocities of another dimension",
        )
    return values.reshape(-1, 3)


def _stacked(seconds: list[float], points: list[Array], path: Path) -> SofaPositions:
    if not points:
        raise InputError("holds no positions", where=str(path), remedy="name a SOFA _x.txt file")
    counts = {len(p) for p in points}
    if len(counts) > 1:
        raise InputError(f"the number of particles changes ({sorted(counts)})", where=str(path), remedy="export again")
    return SofaPositions(np.array(seconds), np.stack(points))
