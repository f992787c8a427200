"""Experiments that declare an effect, as one does that a diagnosis has mended: rightly, or by another value.

Conditions are drawn as in `benchmarks.blind.random_cases`, by seeds of their own. Of five cases of a half two declare
what is true, in which nothing is the matter; three declare the effect half as far from nothing as it is, so that what
is missing is about twice the tracker's noise, of every third of these once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.blind.cases import VISIBLE, Case, scaled
from benchmarks.blind.random_cases import N_NONE, N_OF, RandomCase, conditions, drawn_effect

FIRST_SEED = 1000


@dataclass(frozen=True)
class RedeclaredCase(RandomCase):
    """One drawn experiment that lists its effects, as they are (``kind`` none) or half of them."""

    def scenario(self) -> dict[str, Any]:
        """Return the scenario of the case."""
        spec = super().scenario()
        listed = self.effects if self.kind == "none" else [scaled(effect, 0.5) for effect in self.effects]
        spec["declared"]["effects"] = [dict(effect) for effect in listed]
        return spec


def redeclared(n: int = 60) -> list[Case]:
    """Return ``n`` cases of each half, the halves in turn: even seeds to look at, odd ones to prove."""
    return [case for pair in zip(_half(0, n), _half(1, n), strict=True) for case in pair]


def _half(parity: int, n: int) -> Iterator[RedeclaredCase]:
    """Return the cases of one half in their order."""
    names = np.random.default_rng([10, parity]).permutation(list(VISIBLE))
    wrong = 0
    for k in range(n):
        seed, name = FIRST_SEED + parity + 2 * k, str(names[k % len(names)])
        right = k * N_NONE % N_OF < N_NONE
        size = 0.0 if right else 1.0 if wrong % 3 == 2 else 2.0
        wrong += not right
        drawn = drawn_effect(name, 2.0 * (size or 2.0), conditions(seed, [name]), np.random.default_rng([8, seed]))
        yield RedeclaredCase(f"redeclared-{seed}", "none" if right else "single", (drawn,), size, seed)
