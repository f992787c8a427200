"""The ids of markers that files know by name: one numbering over all takes of a command."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.types import Ids

SHOWN = 12  # names in a line
Name = tuple[str, int]  # what a file calls a marker, and the how many-th of those that it calls so


def assign_ids(labels: Iterable[str], given: Mapping[str, int]) -> Ids:
    """Return the ids (n,) of one take's markers, as `ids_of` does for several."""
    return ids_of([list(labels)], given)[0]


def ids_of(takes: Sequence[Sequence[str]], given: Mapping[str, int]) -> list[Ids]:
    """Return the ids of each take's markers, from their names: a name has one id in all takes.

    They are those ``given`` by name. If none is: the names, where all of a take are whole numbers; else the numbers at
    the names' end where all have one and they differ; else 1, 2, 3 .. in the order in which the takes name them.
    Raises ``InputError`` where names and ids given do not go together.
    """
    named = [_names(labels) for labels in takes]
    if given:
        _check(named, given)
        return [np.array([given[label] for label, _ in names], np.uint32) for names in named]
    own = [_numbers(names, r"(\d{1,9})") for names in named]
    words = {name for names, numbers in zip(named, own, strict=True) if numbers is None for name in names}
    # rows of an array have numbers, and no names; numbers that a take with words has as well are names
    joint = [numbers is None or not words.isdisjoint(names) for names, numbers in zip(named, own, strict=True)]
    union = list(dict.fromkeys(name for names, j in zip(named, joint, strict=True) if j for name in names))
    one = _numbers(union, r".*?(\d{1,9})") or {name: k for k, name in enumerate(union, 1)}
    known = [one if j or numbers is None else numbers for numbers, j in zip(own, joint, strict=True)]
    return [np.array([k[n] for n in names], np.uint32) for k, names in zip(known, named, strict=True)]


def differences(files: Sequence[str], takes: Sequence[Sequence[str]], ids: Sequence[Ids]) -> list[str]:
    """Return a warning for each take that lacks markers which another has."""
    pairs = [pair for labels, numbers in zip(takes, ids, strict=True) for pair in zip(labels, numbers, strict=True)]
    all_of_them = dict.fromkeys(pairs)
    said = _some([f"{number} {label}" for label, number in all_of_them])
    lines = []
    for file, labels in zip(files, takes, strict=True):
        own = set(labels)
        lacking = [label for label in dict.fromkeys(label for label, _ in all_of_them) if label not in own]
        if lacking:
            what = f"has no marker {_some(lacking)}, which another take has"
            lines.append(f"warning: {file}: {what}; a name has one id in all takes: {said}")
    return lines


def _some(words: Sequence[str]) -> str:
    return ", ".join(words[:SHOWN]) + (f" and {len(words) - SHOWN} more" if len(words) > SHOWN else "")


def _names(labels: Sequence[str]) -> list[Name]:
    so_far: Counter[str] = Counter()
    names = []
    for label in labels:
        names.append((label, so_far[label]))
        so_far[label] += 1
    return names


def _numbers(names: Sequence[Name], pattern: str) -> dict[Name, int] | None:
    """Return the number in every name; None where one has none, or two have the same."""
    found = [re.fullmatch(pattern, label) for label, _ in names]
    numbers = {name: int(f[1]) for name, f in zip(names, found, strict=True) if f is not None}
    return numbers if len(set(numbers.values())) == len(names) else None


def _check(takes: Sequence[Sequence[Name]], given: Mapping[str, int]) -> None:
    """Raise ``InputError`` where a marker has no id or no name of its own, or an id no marker."""
    names = list(dict.fromkeys(name for take in takes for name in take))
    labels = [label for label, _ in names]
    unknown = [label for label in given if label not in labels]
    if unknown:
        who = "the take has no" if len(takes) == 1 else "none of the takes has a"
        raise InputError(f"{who} marker '{unknown[0]}'", remedy=f"the markers are {', '.join(dict.fromkeys(labels))}")
    missing = [label for label in labels if label not in given]
    if missing:
        raise InputError(f"marker '{missing[0]}' has no id", remedy=f"add --ids '{missing[0]}=7', or name none at all")
    twice = [label for label, k in names if k]
    if twice:
        raise InputError(f"a take has two markers called '{twice[0]}'", remedy="give every marker its own name")
    if len(set(given.values())) < len(given):
        raise InputError("two markers got the same id", where="--ids", remedy="give every label its own number")
