"""Products of columns over all data, and over the training sets of cross-validation: without each block of time, and
without each of some groups of markers.

For whitened columns x and the whitened nuisance Z with priors of variance one (see `gauss_newton`),

    x~^T y~ = x^T y - x^T Z (I + Z^T Z)^-1 Z^T y.

Whole markers are blocks of the covariance, so leaving some of them out takes their share off the products; a block of
time shares a marker's place with the others, and what remains is whitened anew.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.common.types import Array


class Products(NamedTuple):
    """Marginal products (p, p) of p columns over ``whole``, all data, and over the training sets without each block of
    ``time``, then without each of the groups of ``markers``.

    Blocks of time alone do not test what is constant: the markers' places would learn it from the other blocks.
    """

    whole: Array
    time: list[Array]
    markers: list[Array]

    @classmethod
    def of(cls, problem: Problem, columns: Array, n_groups: int) -> Products:
        """Form those of ``columns`` (n, p), with as many interleaved groups of markers."""
        rows, p = problem.rows, columns.shape[1]
        both = np.column_stack([columns, problem.nuisance.columns])
        whitened = problem.covariance.whitener.whiten(both)
        groups = np.zeros((n_groups, both.shape[1], both.shape[1]))
        whole = np.zeros_like(groups[0])
        for a, b in pairwise(rows.bounds):
            own = whitened[a:b].T @ whitened[a:b]
            whole += own
            if rows.marker[a] >= 0:
                groups[rows.marker[a] % n_groups] += own
        time = []
        for fold in np.unique(rows.fold):
            kept = problem.covariance.whitener_of(rows.fold != fold).whiten(both)
            time.append(_marginal(kept.T @ kept, p))
        return cls(_marginal(whole, p), time, [_marginal(whole - group, p) for group in groups])

    @property
    def all(self) -> list[Array]:
        """List those over all data first, then over each training set."""
        return [self.whole, *self.time, *self.markers]


def _marginal(products: Array, p: int) -> Array:
    """Integrate the nuisance out of ``products`` of p columns and, behind these, of those of the nuisance."""
    nuisance, both = products[p:, p:], products[p:, :p]
    if not len(nuisance):
        return products
    factor = cho_factor(nuisance + np.eye(len(nuisance)))
    return np.asarray(products[:p, :p] - both.T @ cho_solve(factor, both))
