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

PIVOT = 1e-11
"""Least pivot, for rows of M of the size of one."""
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
    # Columns: w, z, the artificial z_0, and the right-hand side.
    table = np.hstack([np.eye(n), -M, -np.ones((n, 1)), q[:, None] / size])
    basis = list(range(n))
    row = _choose(table, np.arange(n), -np.ones(n))
    entering = 2 * n
    for _ in range(TURNS * n):
        leaving = basis[row]
        table[row] /= table[row, entering]
        factors = table[:, entering].copy()
        factors[row] = 0.0
        table -= factors[:, None] * table[row]
        basis[row] = entering
        if leaving == 2 * n:
            return _read(M, q, basis)
        entering = leaving + n if leaving < n else leaving - n
        rising = np.flatnonzero(table[:, entering] > PIVOT)
        if not len(rising):
            break
        row = _choose(table, rising, table[:, entering])
        # The artificial unknown goes as soon as it may: its level is what is missing.
        ratios = table[rising, -1] / table[rising, entering]
        last = np.flatnonzero(np.array(basis)[rising] == 2 * n)
        if len(last) and ratios[last[0]] <= ratios.min() + TIE:
            row = int(rising[last[0]])
    return Solution(np.full(n, np.nan), np.full(n, np.nan), np.inf)


def _choose(table: Array, rows: NDArray[np.int64], column: Array) -> int:
    """The row with the lexicographically least ratio to its pivot.

    For the first pivot the column is negative, so that the ratios are those of what falls most.
    """
    n = len(table)
    ratios = np.column_stack([table[rows, -1], table[rows, :n]]) / np.abs(column[rows])[:, None]
    return int(rows[np.lexsort(ratios.T[::-1])[0]])


def _read(M: Array, q: Array, basis: list[int]) -> Solution:
    """The solution of a complementary basis, solved anew from the problem itself."""
    n = len(q)
    chosen = np.array([k - n for k in basis if k >= n], dtype=int)
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
