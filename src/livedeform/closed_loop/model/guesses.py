"""What is solved already: where the next solutions start from."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Collection, MutableMapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Key, Name
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.effects import EFFECTS as MECHANICAL

MOST_KINDS = 6  # of effects that solved moments are kept for, beside the declared model's

Coordinates = dict[Name, float]  # of the effects in force
Kind = frozenset[str]  # the effects that act on the body
Solved = dict[tuple[Kind, Key], "Guess"]


@dataclass
class Guess:
    """A solved moment: displacements, the contact's state, the pose, and what the displacements do when coordinates
    change from ``z`` by one: ``slopes``."""

    x: Array
    contact: Any
    pose: Array | None
    z: Coordinates
    slopes: dict[Name, Array]

    def at(self, z: Coordinates) -> Array:
        """The displacements to be expected at other coordinates."""
        x = self.x
        for name, slope in self.slopes.items():
            if name in z:
                x = x + (z[name] - self.z[name]) * slope
        return x

    def put_right(self, before: Guess, found: Guess) -> Guess:
        """This guess at another moment, if it is as far off as ``before`` was from what was ``found``."""
        state, *more = self.contact
        multiplier = state.multiplier + found.contact[0].multiplier - before.contact[0].multiplier
        state = replace(state, multiplier=np.maximum(multiplier, 0.0), touches=multiplier > 0.0)
        return replace(self, x=self.x + found.x - before.x, contact=(state, *more))


class Guesses:
    """The solved moments of one body: the last ones with each kind of effects, for some kinds."""

    def __init__(self) -> None:
        self._by_kind: dict[Kind, dict[Key, Guess]] = {frozenset(): {}}  # the latest last

    def of(self, effects: Sequence[EffectValues]) -> MutableMapping[Key, Guess]:
        """Those with these effects, to read and to write. What is not solved with all of them is read as it was with
        the most of them."""
        kind = kind_of(effects)
        if kind:
            self._by_kind[kind] = self._by_kind.pop(kind, {})
        for old in list(self._by_kind)[1:-MOST_KINDS]:
            del self._by_kind[old]
        fewer = sorted((k for k in self._by_kind if k < kind), key=len, reverse=True)
        return ChainMap(self._by_kind[kind], *(self._by_kind[k] for k in fewer))

    @property
    def known(self) -> set[tuple[Kind, Key]]:
        """What is solved."""
        return {(kind, key) for kind, known in self._by_kind.items() for key in known}

    def news(self, known: Collection[tuple[Kind, Key]]) -> Solved:
        """What is solved besides the ``known``, for another body; slopes stay here."""
        return {(n, k): replace(self._by_kind[n][k], slopes={}) for n, k in self.known if (n, k) not in known}

    def hear(self, news: Solved) -> None:
        """Takes over what another body solved."""
        for (kind, key), guess in news.items():
            self._by_kind.setdefault(kind, {}).setdefault(key, guess)

    def solved(self, effects: Sequence[EffectValues], o: Observation) -> Solved:
        """What there is of a recording with these effects, slopes and all."""
        kind = kind_of(effects)
        wanted = {(o.name, int(s)) for s in o.stamps_ns}
        return {(kind, k): g for k, g in self._by_kind[kind].items() if k in wanted or not k[0]}

    def follow(self, solved: Solved) -> None:
        """Takes over what the same body has `solved` in another process, instead of what it knew."""
        for (kind, key), guess in solved.items():
            self._by_kind.setdefault(kind, {})[key] = guess


def kind_of(effects: Sequence[EffectValues]) -> Kind:
    """The names of those that act on the body."""
    return frozenset(e.name for e in effects if e.name in MECHANICAL)
