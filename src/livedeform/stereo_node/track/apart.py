"""The assignment in which no blob serves two markers, and what it costs without each of its pairs, compiled.

Least total cost by shortest augmenting paths (Jonker & Volgenant 1987): each row has a column of its own besides, in
which it is left alone, and what no row has is held by one more row at no cost. A pair that is taken away leaves a hole
in an assignment that was of least cost, and one path to it mends that: nothing is solved anew.
"""

from __future__ import annotations

import numpy as np

from livedeform.common.compiled import njit

ROUNDS = 20  # in which pairs that share a blob are taken away, but for the best of each
NOBODY, HOLE = -1, -2  # of a column: no row has it, and what was taken away


@njit(cache=True, error_model="numpy")
def assign_apart_and_without(cost, left, right, limit):
    """Return the column (n,) of each row of ``cost`` (n, m), -1 for none, the total cost, and the totals (n,) where the
    pair of that row is forbidden; ``left`` and ``right`` (m,): the blobs of a column; a row left alone costs
    ``limit``, which pairs stay below."""
    n, m = cost.shape
    first = np.full(m + n, NOBODY)  # the row of each column
    first[m:] = HOLE
    u, v, to = np.zeros(n + 1), np.zeros(m + n), np.full(n, NOBODY)
    for row in range(n):
        _augment(row, cost, limit, u, v, first, to)
    best = to.copy()
    total = _rounds(cost.copy(), left, right, limit, u.copy(), v.copy(), first.copy(), best)
    totals = np.full(n, total)
    for row in range(n):
        if best[row] >= 0:
            without, other, by = cost.copy(), to.copy(), first.copy()
            without[row, best[row]] = np.inf
            other_u, other_v = u.copy(), v.copy()
            if other[row] == best[row]:
                by[best[row]] = HOLE
                _augment(row, without, limit, other_u, other_v, by, other)
            totals[row] = _rounds(without, left, right, limit, other_u, other_v, by, other)
    return best, total, totals


@njit(cache=True, error_model="numpy")
def _rounds(cost, left, right, limit, u, v, by, to):
    """Take pairs away from ``to`` (n,) until no blob serves two rows; returns the total cost. Columns in which rows are
    left alone become -1."""
    n, m = cost.shape
    worse = np.zeros(n, np.bool_)
    for k in range(ROUNDS):
        n_worse = 0
        for i in range(n):
            worse[i] = to[i] < m and _has_better(i, cost, left, right, to)
            n_worse += worse[i]
        if n_worse == 0 or k == ROUNDS - 1:
            break
        for i in range(n):
            if worse[i]:
                cost[i, to[i]] = np.inf
                by[to[i]] = HOLE
        for i in range(n):
            if worse[i]:
                _augment(i, cost, limit, u, v, by, to)
    total = 0.0
    for i in range(n):
        total += cost[i, to[i]] if to[i] < m else limit
        if to[i] >= m:
            to[i] = NOBODY
    return total


@njit(cache=True, error_model="numpy")
def _has_better(i, cost, left, right, to):
    """Tell whether a pair that costs less shares a blob with that of row ``i``."""
    n, m = cost.shape
    for k in range(n):
        if k != i and to[k] < m and (left[to[k]] == left[to[i]] or right[to[k]] == right[to[i]]):
            less = cost[k, to[k]] - cost[i, to[i]]
            if less < 0.0 or (less == 0.0 and k < i):
                return True
    return False


@njit(cache=True, error_model="numpy")
def _augment(row, cost, limit, u, v, by, to):
    """Give ``row`` a column, by the shortest path to a hole (Dijkstra); ``u`` (n + 1,), ``v`` (m + n,): the duals,
    those of what holds the free columns last; ``by`` (m + n,): the row of each column; ``to`` (n,) the inverse."""
    n, m = cost.shape
    apart, came, done = np.full(m + n, np.inf), np.full(m + n, n), np.zeros(m + n, np.bool_)
    reached, at, length = np.full(n + 1, np.inf), row, 0.0
    while True:
        column, scan = -1, reached[at] > length
        reached[at] = min(reached[at], length)
        for j in range(m + n):
            if done[j]:
                continue
            if scan and (j < m or at == n or j == m + at):
                price = 0.0 if at == n else (cost[at, j] if j < m else limit)
                through = length + max(price - u[at] - v[j], 0.0)
                if through < apart[j]:
                    apart[j], came[j] = through, at
            if column < 0 or apart[j] < apart[column]:
                column = j
        done[column], length = True, apart[column]
        if by[column] == HOLE:
            break
        at = by[column] if by[column] != NOBODY else n
    for i in range(n + 1):
        u[i] += length - reached[i] if reached[i] < np.inf else 0.0
    for j in range(m + n):
        v[j] -= length - apart[j] if done[j] else 0.0
    entry = -1
    for j in range(m + n):  # by which what holds the free columns was reached
        if done[j] and by[j] == NOBODY and (entry < 0 or apart[j] < apart[entry]) and came[j] < n:
            entry = j
    at = n + 1
    while at != row:
        at = came[column]
        if at == n:
            by[column] = NOBODY
            column = entry
            continue
        before, by[column] = to[at], at
        to[at] = column
        column = before
