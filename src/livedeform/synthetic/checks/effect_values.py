"""Check a scenario's ``truth``: names and values of its effects, and whether they act on its body at all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import did_you_mean
from livedeform.common.published_effects import (
    ANY,
    KEEP_ONE,
    NOT_NEGATIVE,
    POSITIVE,
    PUBLISHED,
    Limits,
    Published,
    Value,
    impossible,
)
from livedeform.common.types import Array
from livedeform.synthetic.truth.hexmesh import HexMesh

OUTSIDE: Mapping[str, Published] = {  # what no catalogue has; a body may have several cavities
    "anisotropy": Published({"direction": Value(size=3), "stiffness": Value(NOT_NEGATIVE)}),
    "tether": Published(
        {"place": Value(size=3), "radius": Value(POSITIVE), "end": Value(size=3), "stiffness": Value(NOT_NEGATIVE)},
        optional={"slack": Value(NOT_NEGATIVE)},
    ),
    "cavity": Published(
        {
            "centre": Value(size=3),
            "radius": Value(POSITIVE),
            "amplitude": Value(Limits(-1.0)),
            "period": Value(POSITIVE),
        },
        several=True,
    ),
}
NOTHING_IF_ABSENT = {"swelling": ("rate", "offset")}  # parameters that are 0 where a scenario leaves them out
WORDS = {"inclusion": {"edge": "sharp"}}  # keys that are no numbers, and what they can be


def check_effects(effects: Sequence[Mapping[str, Any]], height: float = 0.0) -> None:
    """Raise ``InputError`` for effects that the truth of a body ``height`` m high (0: not known) cannot have: an
    unknown key, a missing value, one that is physically impossible, or one effect twice."""
    for effect in effects:
        _check_effect(effect, height)
    for name, n in Counter(str(effect["name"]) for effect in effects).items():
        if n > 1 and not _published(name).several:
            raise InputError(f"effect '{name}' is listed {n} times", where="truth", remedy=KEEP_ONE)


def check_places(effects: Sequence[Mapping[str, Any]], mesh: HexMesh) -> None:
    """Raise ``InputError`` for an effect that would be in the truth, and nowhere in the body of this ``mesh``."""
    lower, upper = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    for effect in effects:
        name = effect["name"]
        if "centre" in effect:
            centre = np.asarray(effect["centre"], float)
            away = float(np.linalg.norm(centre - np.clip(centre, lower, upper)))
            if away >= float(effect["radius"]):
                raise _misplaced(name, f"its ball is {away:.3g} m from the body", lower, upper)
        if "place" in effect:
            free = mesh.faces[(mesh.nodes[mesh.faces][:, :, 2] > 1e-9).any(axis=1)]
            surface = mesh.nodes[np.unique(free)]
            away = float(np.linalg.norm(surface - np.asarray(effect["place"], float), axis=1).min())
            if away >= float(effect["radius"]):
                raise _misplaced(name, f"the nearest node of the surface is {away:.3g} m from its place", lower, upper)
        for key in ("radius", "thickness"):
            if float(effect.get(key, 0.0)) > float((upper - lower).max()):
                raise _misplaced(name, f"its {key} of {float(effect[key]):g} m is larger than the body", lower, upper)


def _check_effect(effect: Mapping[str, Any], height: float) -> None:
    name = effect["name"]
    published, where = _published(name), f"truth: {name}"
    known = {**published.parameters, **published.optional}
    words = WORDS.get(name, {})
    for key in effect:
        if key != "name" and key not in known and key not in words:
            raise InputError(f"unknown key '{key}'", where=where, remedy=did_you_mean(str(key), [*known, *words]))
    for key, word in words.items():
        if effect.get(key, word) != word:
            raise InputError(f"no {name} has the {key} '{effect[key]}'", where=where, remedy=f"use {word}, or none")
    absent = NOTHING_IF_ABSENT.get(name, ())
    for key in published.parameters:
        if key not in effect and (key not in absent or not set(absent) & set(effect)):
            raise InputError(f"effect '{name}' needs the value '{key}'", where=where, remedy="add it to the scenario")
    values = {key: _numbers(effect[key], value, f"{where}: {key}") for key, value in known.items() if key in effect}
    whole = {**{key: np.zeros(()) for key in absent}, **values}
    wrong = impossible(name, whole, height=height) or _impossible_outside(name, whole)
    if wrong:
        raise InputError(wrong, where=where, remedy="correct the value, in SI units")


def _published(name: str) -> Published:
    return PUBLISHED[name] if name in PUBLISHED else OUTSIDE[name]


def _numbers(given: Any, value: Value, where: str) -> Array:
    """Return the finite number, or numbers, of a parameter; InputError if there are not as many as it takes."""
    try:
        numbers = np.asarray(given, float)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    shapes = {None: numbers.ndim == 0, -1: numbers.ndim == 1 and numbers.size > 0}
    right = shapes.get(value.size, numbers.shape == (value.size,))
    truths = any(isinstance(one, bool) for one in np.ravel(np.asarray(given, object)))
    if truths or not right or not ANY.allow(np.atleast_1d(numbers)):
        many = {None: "a number", -1: "a list of numbers"}.get(value.size, f"a list of {value.size} numbers")
        raise InputError(f"is {given!r}", where=where, remedy=f"write {many}")
    return numbers


def _impossible_outside(name: str, values: Mapping[str, Array]) -> str:
    if name not in OUTSIDE:
        return ""
    known = {**OUTSIDE[name].parameters, **OUTSIDE[name].optional}
    for key, value in values.items():
        if not known[key].limits.allow(np.atleast_1d(value)):
            return f"'{key}' of effect '{name}' is {value.tolist()}, and can only be {known[key].limits}"
    if name == "anisotropy" and not values["direction"].any():
        return "the direction of effect 'anisotropy' is zero"
    return ""


def _misplaced(name: str, what: str, lower: Array, upper: Array) -> InputError:
    body = " to ".join("(" + ", ".join(f"{x:.3g}" for x in p) + ")" for p in (lower, upper))
    return InputError(what, where=f"truth: {name}", remedy=f"lengths are in metres, and the body goes from {body}")
