"""Lemke's method for linear complementarity problems, with lexicographic pivots.

Find z >= 0 with w = M z + q >= 0 and z^T w = 0. Ties are broken lexicographically, so that the
method cannot cycle; it ends with a solution, or on a ray, which says that there is none where M is
copositive, and nothing else.

References
----------
R. W. Cottle, J.-S. Pang, R. E. Stone, "The Linear Complementarity Problem", sections 4.4 and 4.9.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array

PIVOTS = (1e-8, 1e-11)
"""Least pivot, for rows of M of the size of one: rounding of redundant rows is below the first, and
what is not solved with it is tried with the other."""
GOOD = 1e-10
"""Residual with which an attempt is the last one, relative to the largest entry of q."""
TIE = 1e-12
"""Difference of ratios that counts as none, relative to the largest entry of q."""
TURNS = 60
"""Most pivots for each unknown."""


class Solution(NamedTuple):
    """What the method found.

    Attributes
    ----------
    z, w : ndarray, shape (n,)
    residual : float
        Largest violation of z >= 0, w >= 0, z w = 0 and w = M z + q; infinite on a ray.
    """

    z: Array
    w: Array
    residual: float


def solve_lcp(M: Array, q: Array) -> Solution:
    """Solve one problem.

    Parameters
    ----------
    M : ndarray, shape (n, n)
        Scaled so that its entries are of the size of one.
    q : ndarray, shape (n,)
    """
    n = len(q)
    size = float(np.abs(q).max(initial=0.0))
    if n == 0 or (q >= 0).all():
        return Solution(np.zeros(n), q.copy(), 0.0)
    found = []
    for least in PIVOTS:
        found.append(_pivot(M, q, size, least))
        if found[-1].residual <= GOOD * size:
            break
    return min(found, key=lambda one: one.residual)


def _pivot(M: Array, q: Array, size: float, least: float) -> Solution:
    """Go from basis to basis until the artificial unknown is out."""
    n = len(q)
    # Columns: the right-hand side, w, z and the artificial z_0.
    table = np.empty((n, 2 * n + 2))
    table[:, 0], table[:, 1 : n + 1], table[:, n + 1 : -1] = q / size, np.eye(n), -M
    table[:, -1] = -1.0
    basis = np.arange(1, n + 1)
    row, entering = _choose(table, np.arange(n), -np.ones(n)), 2 * n + 1
    for _ in range(TURNS * n):
        leaving = int(basis[row])
        table[row] /= table[row, entering]
        factors = table[:, entering].copy()
        factors[row] = 0.0
        table -= factors[:, None] * table[row]
        basis[row] = entering
        if leaving == 2 * n + 1:
            return _read(M, q, basis)
        entering = leaving + n if leaving <= n else leaving - n
        column = table[:, entering]
        rising = (column > least).nonzero()[0]
        if not len(rising):
            break
        # The artificial unknown goes as soon as it may: its level is what is missing.
        ratios = table[rising, 0] / column[rising]
        low = rising[ratios <= ratios.min() + TIE]
        last = low[basis[low] == 2 * n + 1]
        row = int(last[0]) if len(last) else _choose(table, rising, column[rising])
    return Solution(np.full(n, np.nan), np.full(n, np.nan), np.inf)


def _choose(table: Array, rows: NDArray[np.int64], pivots: Array) -> int:
    """The row with the lexicographically least ratio to its pivot.

    For the first pivot the column is negative, so that the ratios are those of what falls most.
    """
    sizes = np.abs(pivots)
    ratios = table[rows, 0] / sizes
    least = (ratios == ratios.min()).nonzero()[0]
    if len(least) > 1:
        chosen = rows[least]
        ties = table[chosen, 1 : len(table) + 1] / sizes[least, None]
        return int(chosen[np.lexsort(ties.T[::-1])[0]])
    return int(rows[least[0]])


def _read(M: Array, q: Array, basis: NDArray[np.int64]) -> Solution:
    """The solution of a complementary basis, solved anew from the problem itself."""
    n = len(q)
    chosen = basis[basis > n] - n - 1
    z = np.zeros(n)
    if len(chosen):
        try:
            z[chosen] = np.linalg.solve(M[np.ix_(chosen, chosen)], -q[chosen])
        except np.linalg.LinAlgError:
            z[chosen] = np.linalg.lstsq(M[np.ix_(chosen, chosen)], -q[chosen])[0]
    w = M @ z + q
    wrong = [np.abs(w[chosen]), -z, -w, np.zeros(1)]
    residual = float(max(part.max(initial=0.0) for part in wrong))
    w[chosen] = 0.0
    return Solution(np.maximum(z, 0.0), np.maximum(w, 0.0), residual)
