"""History of the truth's body, carried from step to step: its pose in time, viscous stress and plastic strain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.common.types import Array
from livedeform.synthetic.truth.probe import TruthContact

Prony = tuple[tuple[float, float], ...]  # (g, tau s) of each term


@dataclass
class TruthHistory:
    """Hold the state of the last step: ``x`` (n, 3) m, contact, ``time`` s, the probe's pose ``T`` (None: away).

    ``stress`` (m, q, 3, 3) Pa is the isochoric elastic second Piola stress of the last step, ``viscous``
    (terms, m, q, 3, 3) Pa the terms' own, ``plastic`` (m, q, 3, 3) the logarithm of F_p, ``worst`` (m, q) the largest
    isochoric Hencky strain so far.
    """

    x: Array
    contact: TruthContact
    stress: Array
    viscous: Array
    plastic: Array
    worst: Array
    time: float = 0.0
    T: Array | None = None

    @classmethod
    def none(cls, x: Array, n_contact: int, shape: tuple[int, int], n_terms: int) -> TruthHistory:
        """Return that of a body at ``x`` to which nothing has happened; ``shape`` (m, q) of its quadrature points."""
        tensors = np.zeros((*shape, 3, 3))
        viscous = np.zeros((n_terms, *shape, 3, 3))
        return cls(x.copy(), TruthContact.none(n_contact), tensors, viscous, tensors.copy(), np.zeros(shape))

    def viscous_part(self, prony: Prony, dt: float) -> tuple[float, Array]:
        """Return 1 + sum gamma exp(-dt/2 tau), and the past's part (m, q, 3, 3) Pa of the stress.

        Q <- exp(-dt/tau) Q + gamma exp(-dt/2 tau) (S_new - S_old) with gamma = g / (1 - sum g) of the relaxed stress
        (Holzapfel 2000, section 6.10).
        """
        past = np.zeros_like(self.stress)
        branch = 1.0
        for k, (gamma, left) in enumerate(_factors(prony, dt)):
            branch += gamma
            past += left * self.viscous[k] - gamma * self.stress
        return branch, past

    def relax(self, prony: Prony, dt: float, stress: Array) -> None:
        """Update the viscous terms over ``dt`` s to the new elastic ``stress`` (m, q, 3, 3) Pa."""
        for k, (gamma, left) in enumerate(_factors(prony, dt)):
            self.viscous[k] = left * self.viscous[k] + gamma * (stress - self.stress)

    def flow(self, F: Array, fraction: float, threshold: float) -> float:
        """Set the plastic strain after the largest isochoric Hencky strain so far; return the largest change.

        ``F`` (m, q, 3, 3) is the deformation gradient from the unloaded body.
        """
        values, vectors = np.linalg.eigh(np.einsum("mqij,mqik->mqjk", F, F))
        h = 0.5 * np.log(values)
        h -= h.mean(-1, keepdims=True)
        size = np.sqrt((h * h).sum(-1))
        grown = size > np.maximum(self.worst, threshold)
        strain = np.einsum("mqij,mqj,mqkj->mqik", vectors, h, vectors)
        share = fraction * (1.0 - threshold / np.maximum(size, 1e-12))
        new = np.where(grown[:, :, None, None], share[:, :, None, None] * strain, self.plastic)
        change = float(np.abs(new - self.plastic).max())
        self.plastic = new
        self.worst = np.where(grown, size, self.worst)
        return change


def _factors(prony: Prony, dt: float) -> list[tuple[float, float]]:
    """Return of each term gamma exp(-dt/2 tau) and exp(-dt/tau)."""
    relaxed = 1.0 - sum(g for g, _ in prony)
    return [(g / relaxed * float(np.exp(-dt / (2 * tau))), float(np.exp(-dt / tau))) for g, tau in prony]
