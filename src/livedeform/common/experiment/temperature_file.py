"""``temperature.csv``: how warm the body was, time,temperature in seconds and degrees (Celsius or kelvin)."""

from __future__ import annotations

import csv
import math
from pathlib import Path

from pydantic_core import PydanticCustomError

from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import Temperature, check_curve

COLUMNS = ("time", "temperature")


def read_temperatures(section: Temperature) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return times (k,) s and temperatures (k,) of the section's lists, or of its file.

    Raises ``InputError`` naming the line for anything that is no number, for times that do not rise, and for units that
    differ.
    """
    if section.file is None:
        return section.time or (), section.value or ()
    rows = _rows(section.file)
    time, value = tuple(row[0] for row in rows), tuple(row[1] for row in rows)
    try:
        check_curve(time, value, section.reference)
    except PydanticCustomError as error:
        context = error.context or {}
        raise InputError(context["what"], where=str(section.file), remedy=context["remedy"]) from error
    return time, value


def _rows(path: Path) -> list[tuple[float, float]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read ({error})", where=str(path), remedy="save it as UTF-8 text") from error
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    names = [name.strip() for name in lines[0][1].split(",")] if lines else []
    if not set(COLUMNS) <= set(names):
        raise InputError(
            f"its columns are {', '.join(names) or 'none'}",
            where=str(path),
            remedy="begin the file with the line time,temperature",
        )
    places = [names.index(column) for column in COLUMNS]
    return [_row(next(csv.reader([line])), places, f"{path}:{i}") for i, line in lines[1:]]


def _row(cells: list[str], places: list[int], where: str) -> tuple[float, float]:
    try:
        time, value = (float(cells[place]) for place in places)
        if not (math.isfinite(time) and math.isfinite(value)):
            raise ValueError
    except (ValueError, IndexError) as error:
        raise InputError(
            f"'{','.join(cells)}' is not a time and a temperature", where=where, remedy="correct the line or delete it"
        ) from error
    return time, value
