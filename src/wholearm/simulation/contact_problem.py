"""Contact modes from a linear complementarity problem (Stewart and Trinkle), exact in the plane.

With the forces c_n >= 0 of contacts and f of everything that stands still and may stick (contacts
and joints), rates r = (r_n, r_t) follow linearly,

    r_n = b_n + A M^-1 (G^T c_n + T^T f),      r_t = b_t + T M^-1 (G^T c_n + T^T f),

and have to keep r_n >= 0 and c_n r_n = 0, abs(f) <= bound, and f opposite to r_t and at its bound
wherever r_t is not zero. The bound is mu c_n of a contact and D of a joint. Rates are accelerations
while forces act, and velocities in an impact. A contact that slides already has its friction in
G = A - mu Xi A_t. Splitting f into its parts of either sign makes the problem linear (Stewart and
Trinkle, "An implicit time-stepping scheme for rigid body dynamics with inelastic collisions and
Coulomb friction", 1996).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array

RESIDUAL = 1e-8  # largest residual of a solution, relative to the largest rate without contacts
EDGE = 1e-9  # reserve of friction that counts as none, relative to its bound or the largest force
SAME = 1e-6  # difference of rates that is none, over the largest rate without contacts
SINGULAR = 1e-9  # determinant of a scaled system that counts as zero
APART, STICKS, FORTH, BACK = range(4)
"""Modes of a contact; of a joint all but the first. One without friction that presses sticks."""
MODES = {0.0: STICKS, 1.0: FORTH, -1.0: BACK}  # by sliding sign


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """k contacts, s of whatever stands still and may stick, n coordinates."""

    lift: Array  # (n,): diagonal of M^-1
    A: Array  # A, G (k, n):
    G: Array
    b_n: Array  # (k,): normal rates without forces
    T: Array  # (s, n)
    b_t: Array  # (s,): sliding rates without forces
    owner: NDArray[np.int64]  # (s,): the contact whose normal force bounds friction; -1 for a joint
    mu: Array  # mu, bound (s,): abs(f) <= mu c_n + bound
    bound: Array

    @cached_property
    def scaled(self) -> tuple[Array, Array, Array, Array]:
        """Units of forces that make the diagonal one, the matrix in them, and the rates without."""
        rows, pushes, b, s = self.A, self.G, self.b_n, len(self.b_t)
        if s:
            rows, pushes = np.vstack([rows, self.T]), np.vstack([pushes, self.T])
            b = np.concatenate([b, self.b_t])
        lifted = rows * self.lift
        units = 1 / np.sqrt((lifted * rows).sum(axis=1))
        K = (lifted @ pushes.T) * (units[:, None] * units)
        return units[: len(b) - s], units[len(b) - s :], K, units * b

    @cached_property
    def is_unique(self) -> bool:
        """Whether there is surely one solution: nothing may stick, K + K^T is positive definite."""
        if len(self.b_t):
            return False
        K = self.scaled[2]
        if len(K) < 2:
            return not len(K) or float(2 * K[0, 0]) > SINGULAR
        return bool(np.linalg.eigvalsh(K + K.T)[0] > SINGULAR)


class ContactAnswer(NamedTuple):
    """One solution."""

    c_n: Array  # (k,)
    f: Array  # (s,)
    r_n: Array  # r_n, r_t (k,) and (s,):
    r_t: Array
    shares: Array  # (s,): friction over the most that it may be
    sign: Array  # (s,): sliding sign where friction is at its bound, 0 where it holds
    change: Array  # (n,): M^-1 (G^T c_n + T^T f)
    residual: float  # relative; see `RESIDUAL`


def solve(p: ContactProblem) -> ContactAnswer | None:
    """One solution by Lemke's method, or none."""
    s_n, s_t, K, q = p.scaled
    k, s = len(s_n), len(s_t)
    held = (p.owner >= 0).nonzero()[0]
    # Unknowns are c_n, both parts of f, and how fast each of them gives way.
    M, plus, minus = np.zeros((k + 3 * s, k + 3 * s)), k + s, k + 2 * s
    M[:plus, :plus] = K
    M[:plus, plus:minus] = -K[:, k:]
    M[plus:minus, :minus] = -M[k:plus, :minus]
    i = np.arange(s)
    M[k + i, minus + i] = M[plus + i, minus + i] = 1.0
    M[minus + i, k + i] = M[minus + i, plus + i] = -1.0
    M[minus + held, p.owner[held]] = p.mu[held] * s_n[p.owner[held]] / s_t[held]
    found = solve_lcp(M, np.concatenate([q, -q[k:], p.bound / s_t]))
    size = float(np.abs(q).max(initial=0.0)) or 1.0
    if not found.residual <= RESIDUAL * max(size, float((p.bound / s_t).max(initial=0.0))):
        return None
    z = found.z
    return read(p, s_n * z[:k], s_t * (z[k:plus] - z[plus:minus]), found.residual / size)


def read(problem: ContactProblem, c_n: Array, f: Array, residual: float = 0.0) -> ContactAnswer:
    """Rates, signs and friction shares that forces give."""
    p = problem
    if not len(f):
        change = p.lift * (c_n @ p.G)
        return ContactAnswer(c_n, f, p.b_n + p.A @ change, f, f, f, change, residual)
    change, size = p.lift * (c_n @ p.G + f @ p.T), np.abs(f)
    most = p.bound + p.mu * np.append(c_n, 0.0)[p.owner]
    # Friction whose bound is zero by c_n has no margin in either direction.
    edge = most - size <= EDGE * np.maximum(most, 1e-3 * size.max())
    r_t = p.b_t + p.T @ change
    sign = np.where(edge, np.where(f != 0, -np.sign(f), np.sign(r_t)), 0.0)
    shares = size / np.maximum(most, 1e-300)
    return ContactAnswer(c_n, f, p.b_n + p.A @ change, r_t, shares, sign, change, residual)


def is_clear(problem: ContactProblem, answer: ContactAnswer, least: float) -> bool:
    """Whether each contact presses or parts by more than a share of the largest rate."""
    s_n, _, _, q = problem.scaled
    most = least * float(np.abs(q).max(initial=0.0))
    return bool((np.maximum(answer.c_n / s_n, answer.r_n * s_n) > most).all())


def list_answers(problem: ContactProblem) -> list[ContactAnswer] | None:
    """All solutions with distinct rates, by enumeration of modes; None if these are too many."""
    combinations = _combine(len(problem.b_n), len(problem.lift), tuple(problem.owner.tolist()))
    return None if combinations is None else _try(problem, *combinations)


def try_modes(problem: ContactProblem, choice: Sequence[int]) -> ContactAnswer | None:
    """Solution with the modes `choice` of contacts, then joints, if they are consistent."""
    sizes = len(problem.b_n), len(problem.lift), tuple(problem.owner.tolist())
    combinations = _combine(*sizes, tuple(choice))
    answers = [] if combinations is None else _try(problem, *combinations)
    return answers[0] if answers else None


@lru_cache(maxsize=256)
def _combine(
    k: int, n: int, owner: tuple[int, ...], choice: tuple[int, ...] | None = None
) -> tuple[Array, NDArray[np.bool_]] | None:
    """One choice of modes of k contacts and n coordinates, or all, with up to n conditions.

    Returns which way what may stick gives way, 0 where it does not, (m, s), and which forces are
    for a condition, (m, k + s).
    """
    own = np.array(owner, dtype=int)
    options: list[tuple[int, ...]]
    options = [(APART, STICKS, FORTH, BACK) if i in owner else (APART, STICKS) for i in range(k)]
    options += [(STICKS, FORTH, BACK) for _ in range(owner.count(-1))]
    if choice is None and math.prod(len(option) for option in options) > 4000:
        return None
    every = list(product(*options)) if choice is None else [choice]
    choices = np.array(every, dtype=int).reshape(len(every), len(options))
    modes = np.empty((len(choices), len(own)), dtype=int)
    modes[:, own >= 0], modes[:, own < 0] = choices[:, own[own >= 0]], choices[:, k:]
    active = np.hstack([choices[:, :k] != APART, modes == STICKS])
    sound = active.sum(axis=1) <= n
    ways = np.where(modes == FORTH, 1.0, np.where(modes == BACK, -1.0, 0.0))
    return ways[sound], active[sound]


def _try(p: ContactProblem, ways: Array, active: NDArray[np.bool_]) -> list[ContactAnswer]:
    """Solve for each combination of modes; the consistent solutions with distinct rates."""
    s_n, s_t, K, q = p.scaled
    k, own = len(s_n), K
    if len(s_t):
        # A contact that slides brings its friction with it, what turns has a given one.
        held = (p.owner >= 0).nonzero()[0]
        owner, bound = p.owner[held], ways * (p.bound / s_t)
        rubs, partner = np.zeros((len(ways), len(q))), np.arange(len(q))
        rubs[:, owner], partner[owner] = (
            p.mu[held] * s_n[owner] / s_t[held] * ways[:, held],
            k + held,
        )
        own = K - rubs[:, None, :] * K[:, partner]
        right = bound @ K[:, k:].T - q
    else:
        right = np.broadcast_to(-q, active.shape)
    # Forces without a condition are zero, by rows of the unit matrix.
    own = np.where(active[:, :, None] & active[:, None, :], own, np.eye(len(q)))
    sound = np.abs(np.linalg.det(own)) > SINGULAR
    forces = np.linalg.solve(own[sound], np.where(active, right, 0.0)[sound][:, :, None])[:, :, 0]
    if len(s_t):
        forces[:, k:] -= bound[sound]
        forces[:, k + held] -= rubs[sound][:, owner] * forces[:, owner]
    rates = q + forces @ K.T
    size = float(np.abs(q).max(initial=0.0)) or 1.0
    slack = EDGE * size
    pair = forces[:, :k], rates[:, :k]
    obeys = (np.minimum(*pair) >= -slack) & (np.abs(pair[0] * pair[1]) <= slack * size)
    fine = np.logical_and.reduce(obeys, axis=1)
    if len(s_t) and fine.any():
        forces, rates = forces[fine], rates[fine]
        most = np.maximum(forces[:, :k] * s_n, 0.0)
        most = np.hstack([most, np.zeros((len(most), 1))])[:, p.owner] * p.mu + p.bound
        f, r = forces[:, k:], rates[:, k:]
        spare = most / s_t - np.abs(f)
        # Friction holds, or it is at its bound and opposes; none that slides without a force errs.
        opposes = (spare <= slack) & ((f * r <= 0) | (np.abs(f) <= slack))
        fine = np.logical_and.reduce((spare >= -slack) & (opposes | (np.abs(r) <= slack)), axis=1)
    distinct: list[int] = []
    for row in fine.nonzero()[0].tolist():
        if all(np.abs(rates[row] - rates[other]).max() > SAME * size for other in distinct):
            distinct.append(row)
    return [read(p, np.maximum(s_n * forces[i, :k], 0.0), s_t * forces[i, k:]) for i in distinct]


class ContactSolution(NamedTuple):
    """Solution of a linear complementarity problem."""

    z: Array  # z, w (n,):
    w: Array
    # largest violation of z >= 0, w >= 0, z w = 0 and w = M z + q; infinite on a ray
    residual: float


def solve_lcp(M: Array, q: Array) -> ContactSolution:
    """Solve w = M z + q, z >= 0, w >= 0, z w = 0 by Lemke's method; M (n, n) is near one."""
    n = len(q)
    size = float(np.abs(q).max(initial=0.0))
    if n == 0 or (q >= 0).all():
        return ContactSolution(np.zeros(n), q.copy(), 0.0)
    solutions = []
    # Least pivots above and below the rounding of redundant rows.
    for least in (1e-8, 1e-11):
        solutions.append(_pivot(M, q, size, least))
        if solutions[-1].residual <= 1e-10 * size:
            break
    return min(solutions, key=lambda solution: solution.residual)


def _pivot(M: Array, q: Array, size: float, least: float) -> ContactSolution:
    """Complementary pivoting until the artificial unknown leaves the basis."""
    n = len(q)
    # Columns: the right-hand side, w, z and the artificial z_0.
    table = np.empty((n, 2 * n + 2))
    table[:, 0], table[:, 1 : n + 1], table[:, n + 1 : -1] = q / size, np.eye(n), -M
    table[:, -1] = -1.0
    basis = np.arange(1, n + 1)
    row, entering = _choose(table, np.arange(n), -np.ones(n)), 2 * n + 1
    for _ in range(60 * n):
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
        low = rising[ratios <= ratios.min() + 1e-12]
        last = low[basis[low] == 2 * n + 1]
        row = int(last[0]) if len(last) else _choose(table, rising, column[rising])
    return ContactSolution(np.full(n, np.nan), np.full(n, np.nan), np.inf)


def _choose(table: Array, rows: NDArray[np.int64], pivots: Array) -> int:
    """Row of the lexicographically least ratio to its pivot; first, of what falls most."""
    sizes = np.abs(pivots)
    ratios = table[rows, 0] / sizes
    least = (ratios == ratios.min()).nonzero()[0]
    if len(least) > 1:
        chosen = rows[least]
        ties = table[chosen, 1 : len(table) + 1] / sizes[least, None]
        return int(chosen[np.lexsort(ties.T[::-1])[0]])
    return int(rows[least[0]])


def _read(M: Array, q: Array, basis: NDArray[np.int64]) -> ContactSolution:
    """Solution of a complementary basis, from the original matrix."""
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
    return ContactSolution(np.maximum(z, 0.0), np.maximum(w, 0.0), residual)
