"""The user's own numbers for a study, ``NAME=VALUE,...``: every mistake is one line that names the key."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from livedeform.common.errors import InputError

MEASURED, SIGMA = "--measured", "--sigma"


@dataclass(frozen=True)
class Key:
    """A number that the user gives: what it is, its unit, where it may lie, and its default (None: must be given)."""

    meaning: str
    low: float
    high: float
    default: float | None = None


def named_values(text: str, keys: Mapping[str, Key]) -> dict[str, float]:
    """Numbers of "height=70,loss=6.8" for all of ``keys`` in the units of the keys; defaults where none is given."""
    known = ", ".join(f"{name} ({key.meaning})" for name, key in keys.items())
    found: dict[str, float] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, _, value = (word.strip() for word in part.partition("="))
        if name not in keys:
            remedy = f"write NAME=VALUE,...; known are {known}"
            raise InputError(f"'{part}' names nothing that this study takes", where=MEASURED, remedy=remedy)
        if name in found:
            raise InputError("is given twice", where=f"{MEASURED} {name}", remedy="leave one of them away")
        found[name] = _number(name, value, keys[name])
    for name, key in keys.items():
        if name not in found and key.default is None:
            remedy = f"add {name}=..., the {key.meaning}"
            raise InputError("is missing", where=f"{MEASURED} {name}", remedy=remedy)
        found.setdefault(name, key.default if key.default is not None else float("nan"))
    return found


def _number(name: str, text: str, key: Key) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not key.low <= value <= key.high:
        raise InputError(
            f"'{text}' is not a number from {key.low:g} to {key.high:g}",
            where=f"{MEASURED} {name}",
            remedy=f"give the {key.meaning}",
        )
    return value


def sigmas(text: str, meanings: tuple[str, ...]) -> list[float]:
    """One sigma (mm) for each of ``meanings`` of "0.5,1.1", or a single one for all of them."""
    of = " and of ".join(meanings)
    remedy = f"give one sigma in mm of {of}, as {','.join(('0.5', '1.1')[: len(meanings)])}"
    if not text:
        raise InputError("is missing", where=SIGMA, remedy=remedy)
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError as error:
        raise InputError(f"'{text}' is not a list of numbers", where=SIGMA, remedy=remedy) from error
    if len(values) not in {1, len(meanings)} or not all(np.isfinite(v) and v > 0.0 for v in values):
        raise InputError(f"'{text}' is not {len(meanings)} positive numbers, or one", where=SIGMA, remedy=remedy)
    return values * len(meanings) if len(values) == 1 else values
