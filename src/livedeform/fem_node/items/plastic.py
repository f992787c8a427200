"""Plastic set: isochoric plastic Hencky strain h_p = fraction (1 - threshold/|h|) h at the largest Hencky strain h so
far.

h = dev(1/2 ln F^T F) of the deformation from the unloaded shape, |h| its Frobenius norm; Fp = exp(h_p), F_e = F Fp^-1.

Where a strain outgrows an earlier one of another direction, the set turns at once, and the strain may fall below the
earlier one again: no equilibrium has either set. What has outgrown it stays, as it would on a path in small steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import PlasticSet


@dataclass(frozen=True)
class SetState:
    """Hencky strains (n, 3, 3): the ``largest`` that is committed, and what the present moment has ``reached`` so far;
    ``inverse`` (n, 3, 3): Fp^-1 in force."""

    largest: Array
    reached: Array
    inverse: Array


def unstrained(n: int) -> SetState:
    """Return a state in which nothing has been strained yet."""
    return SetState(np.zeros((n, 3, 3)), np.zeros((n, 3, 3)), np.broadcast_to(np.eye(3), (n, 3, 3)).copy())


def hencky(F: Array) -> Array:
    """Return dev(1/2 ln F^T F) (n, 3, 3); `ConvergenceError` where a search has led to no deformation at all."""
    if not np.all(np.isfinite(F)):
        raise ConvergenceError(
            "a strain is not finite", where="solver", remedy="move the body in smaller steps, or refine the mesh"
        )
    values, vectors = np.linalg.eigh(F.transpose(0, 2, 1) @ F)
    logs = 0.5 * np.log(np.maximum(values, 1e-12))
    logs = logs - logs.mean(axis=1, keepdims=True)
    return np.asarray((vectors * logs[:, None, :]) @ vectors.transpose(0, 2, 1))


def strained(state: SetState, h: Array) -> Array:
    """Return what is reached (n, 3, 3) as an iteration comes by the strains ``h`` (n, 3, 3)."""
    grows = np.einsum("nij,nij->n", h, h) > np.einsum("nij,nij->n", state.largest, state.largest)
    return np.where(grows[:, None, None], h, state.reached)


def inverse_set(law: PlasticSet, largest: Array) -> Array:
    """Return Fp^-1 = exp(-h_p) (n, 3, 3)."""
    size = np.sqrt(np.einsum("nij,nij->n", largest, largest))
    share = law.fraction * np.maximum(1.0 - law.threshold / np.maximum(size, 1e-300), 0.0)
    values, vectors = np.linalg.eigh(-share[:, None, None] * largest)
    return np.asarray((vectors * np.exp(values)[:, None, :]) @ vectors.transpose(0, 2, 1))
