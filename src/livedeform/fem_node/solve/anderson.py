"""Anderson acceleration of a fixed-point iteration that converges slowly or alternates (Anderson 1965; Walker & Ni
2011)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from livedeform.common.types import Array

MEMORY = 6  # steps that are looked back at


def accelerated(guesses: Sequence[Array], steps: Sequence[Array]) -> Array:
    """Return the next guess, from guesses and the steps that the iteration wanted to take from them (arrays of one
    shape): the combination of the guesses whose steps nearly cancel, and its step."""
    if len(steps) == 1:
        return guesses[0] + steps[0]
    d_steps = np.stack([(b - a).ravel() for a, b in pairwise(steps)], axis=1)
    d_guesses = np.stack([(b - a).ravel() for a, b in pairwise(guesses)], axis=1)
    gamma = np.linalg.lstsq(d_steps, steps[-1].ravel(), rcond=1e-10)[0]
    change = (d_guesses + d_steps) @ gamma
    return guesses[-1] + steps[-1] - change.reshape(steps[-1].shape)
