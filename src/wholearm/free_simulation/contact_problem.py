"""Which contacts press, stick and slide: no pulling and Coulomb's law as a complementarity problem.

With the forces c_n >= 0 of contacts and f of everything that stands still and may stick (contacts
and joints), rates r = (r_n, r_t) follow linearly,

    r_n = b_n + A M^-1 (G^T c_n + T^T f),      r_t = b_t + T M^-1 (G^T c_n + T^T f),

and have to keep r_n >= 0 and c_n r_n = 0, abs(f) <= bound, and f opposite to r_t and at its bound
wherever r_t is not zero. The bound is mu c_n of a contact and D of a joint. Rates are accelerations
while forces act, and velocities in an impact. A contact that slides already has its friction in
G = A - mu Xi A_t. Splitting f into its parts of either sign gives the linear problem of Stewart and
Trinkle, which is exact in the plane.

References
----------
D. E. Stewart, J. C. Trinkle, "An implicit time-stepping scheme for rigid body dynamics with
inelastic collisions and Coulomb friction", 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from .lemke import solve_lcp

RESIDUAL = 1e-8
"""Largest residual of a solution, relative to the largest rate without contacts."""
EDGE = 1e-9
"""Reserve of friction that counts as none, relative to its bound or the largest force."""
MOST = 4000
"""Most combinations of modes that are looked through for other answers."""
SAME = 1e-6
"""Difference of rates that counts as none, relative to the largest rate without contacts."""
SINGULAR = 1e-9
"""Determinant of a scaled system that counts as zero."""


APART, STICKS, FORTH, BACK = range(4)
"""Modes of a contact; of a joint all but the first. One without friction that presses sticks."""


class ContactProblem(NamedTuple):
    """k contacts, s of whatever stands still and may stick, n coordinates.

    Attributes
    ----------
    lift : ndarray, shape (n,)
        Diagonal of M^-1.
    A, G : ndarray, shape (k, n)
    b_n : ndarray, shape (k,)
        Normal rates without forces.
    T : ndarray, shape (s, n)
    b_t : ndarray, shape (s,)
        Sliding rates without forces.
    owner : ndarray of int, shape (s,)
        The contact whose normal force bounds friction; -1 for a joint.
    mu, bound : ndarray, shape (s,)
        abs(f) <= mu c_n + bound.
    """

    lift: Array
    A: Array
    G: Array
    b_n: Array
    T: Array
    b_t: Array
    owner: NDArray[np.int64]
    mu: Array
    bound: Array


class Answer(NamedTuple):
    """One solution.

    Attributes
    ----------
    c_n : ndarray, shape (k,)
    f : ndarray, shape (s,)
    r_n, r_t : ndarray, shape (k,) and (s,)
    shares : ndarray, shape (s,)
        Friction over the most that it may be.
    way : ndarray, shape (s,)
        +1 or -1 where friction is at its bound and gives way in that direction, 0 where it holds.
    change : ndarray, shape (n,)
        M^-1 (G^T c_n + T^T f).
    residual : float
        Relative; see `RESIDUAL`.
    """

    c_n: Array
    f: Array
    r_n: Array
    r_t: Array
    shares: Array
    way: Array
    change: Array
    residual: float


def solve(problem: ContactProblem) -> Answer | None:
    """Solve by Lemke's method; None where it finds nothing."""
    p, (s_n, s_t, K, q) = problem, _scale(problem)
    k, s = len(s_n), len(s_t)
    N, T = K[:k], K[k:]
    own = np.zeros((s, k))
    held = np.flatnonzero(p.owner >= 0)
    own[held, p.owner[held]] = p.mu[held] * s_n[p.owner[held]] / s_t[held]
    unit, none = np.eye(s), np.zeros((k, s))
    M = np.block([
        [N[:, :k], N[:, k:], -N[:, k:], none],
        [T[:, :k], T[:, k:], -T[:, k:], unit],
        [-T[:, :k], -T[:, k:], T[:, k:], unit],
        [own, -unit, -unit, np.zeros((s, s))],
    ])  # fmt: skip
    found = solve_lcp(M, np.concatenate([q[:k], q[k:], -q[k:], p.bound / s_t]))
    size = float(np.abs(q).max(initial=0.0)) or 1.0
    if not found.residual <= RESIDUAL * max(size, float((p.bound / s_t).max(initial=0.0))):
        return None
    c_n, plus, minus = (part for part in np.split(found.z, [k, k + s, k + 2 * s])[:3])
    return read(p, s_n * c_n, s_t * (plus - minus), found.residual / size)


def read(problem: ContactProblem, c_n: Array, f: Array, residual: float = 0.0) -> Answer:
    """What given forces do."""
    p = problem
    change = p.lift * (p.G.T @ c_n + p.T.T @ f)
    most = _bound(p, c_n)
    # Friction whose bound is zero by c_n has nothing to give, whichever way.
    edge = most - np.abs(f) <= EDGE * np.maximum(most, 1e-3 * np.abs(f).max(initial=0.0))
    r_t = p.b_t + p.T @ change
    way = np.where(edge, np.where(f != 0, -np.sign(f), np.sign(r_t)), 0.0)
    shares = np.abs(f) / np.maximum(most, np.finfo(float).tiny)
    return Answer(c_n, f, p.b_n + p.A @ change, r_t, shares, way, change, residual)


def is_unique(problem: ContactProblem) -> bool:
    """Whether there is one solution for sure, as nothing stands that might stick and K is positive.

    A matrix whose symmetric part is positive definite has positive principal minors only.
    """
    _, s_t, K, _ = _scale(problem)
    return not len(s_t) and bool(np.linalg.eigvalsh(K + K.T).min(initial=1.0) > SINGULAR)


def list_answers(problem: ContactProblem) -> list[Answer] | None:
    """Every solution with other rates than the others; None where that is too much to look through.

    Each contact is apart, or presses and sticks or slides either way; each joint is held or turns.
    """
    k, s = len(problem.b_n), len(problem.b_t)
    held = [i in problem.owner for i in range(k)]
    options: list[tuple[int, ...]]
    options = [(APART, STICKS, FORTH, BACK) if one else (APART, STICKS) for one in held]
    options += [(STICKS, FORTH, BACK) for _ in range(s - sum(held))]
    if np.prod([float(len(option)) for option in options]) > MOST:
        return None
    every = list(product(*options))
    return _try(problem, np.array(every, dtype=int).reshape(len(every), len(options)))


def try_modes(problem: ContactProblem, choice: Sequence[int]) -> Answer | None:
    """The solution with given modes of contacts, then joints, if they are consistent."""
    found = _try(problem, np.array([choice], dtype=int))
    return found[0] if found else None


def _try(p: ContactProblem, choices: NDArray[np.int64]) -> list[Answer]:
    """Solve with each row's modes, and return what is consistent, each motion once."""
    scaled = s_n, s_t, K, q = _scale(p)
    k, s = len(s_n), len(s_t)
    matrices = np.broadcast_to(K, (len(choices), k + s, k + s)).copy()
    right = np.broadcast_to(-q, (len(choices), k + s)).copy()
    unit = np.eye(k + s)
    for i in range(k):
        apart = choices[:, i] == APART
        matrices[apart, i], right[apart, i] = unit[i], 0.0
    column = k
    for j, own in enumerate(p.owner):
        row, unit_row = k + j, unit[k + j]
        mode = choices[:, own] if own >= 0 else choices[:, column]
        column += own < 0
        matrices[mode == APART, row], right[mode == APART, row] = unit_row, 0.0
        for which, way in ((FORTH, 1.0), (BACK, -1.0)):
            slides = unit_row.copy()
            if own >= 0:
                slides[own] = way * p.mu[j] * s_n[own] / s_t[j]
            matrices[mode == which, row] = slides
            right[mode == which, row] = -way * p.bound[j] / s_t[j]
    sound = np.abs(np.linalg.det(matrices)) > SINGULAR
    if not sound.any():
        return []
    forces = np.linalg.solve(matrices[sound], right[sound][:, :, None])[:, :, 0]
    return _pick(p, forces, scaled, float(np.abs(q).max(initial=0.0)) or 1.0)


def _pick(
    p: ContactProblem, forces: Array, scaled: tuple[Array, Array, Array, Array], size: float
) -> list[Answer]:
    """Those of the forces that solve the problem, each motion once."""
    s_n, s_t, K, q = scaled
    k = len(s_n)
    rates = q + forces @ K.T
    c_n, f = forces[:, :k] * s_n, forces[:, k:] * s_t
    own = np.where(p.owner >= 0, c_n[:, np.maximum(p.owner, 0)] if k else 0.0, 0.0)
    spare = (p.mu * own + p.bound - np.abs(f)) / s_t
    slack = EDGE * size
    turning = np.where(spare <= slack, -np.sign(f) * rates[:, k:], -np.abs(rates[:, k:]))
    turning[np.abs(rates[:, k:]) <= slack] = 0.0
    # What slides without a force has nothing that could be wrong.
    turning[(np.abs(f / s_t) <= slack) & (spare <= slack)] = 0.0
    worst = np.hstack([forces[:, :k], rates[:, :k], spare, turning]).min(axis=1, initial=0.0)
    both = np.abs(forces[:, :k] * rates[:, :k]).max(axis=1, initial=0.0)
    found: list[Array] = []
    answers = []
    for row in np.flatnonzero((worst >= -slack) & (both <= slack * size)):
        if all(np.abs(rates[row] - other).max() > SAME * size for other in found):
            found.append(rates[row])
            answers.append(read(p, np.maximum(c_n[row], 0.0), f[row]))
    return answers


def _bound(p: ContactProblem, c_n: Array) -> Array:
    own = p.owner >= 0
    most = p.bound.copy()
    most[own] += p.mu[own] * c_n[p.owner[own]]
    return most


def _scale(p: ContactProblem) -> tuple[Array, Array, Array, Array]:
    """Units of forces that make the diagonal one, the matrix in them, and the rates without."""
    s_n = 1 / np.sqrt((p.A**2) @ p.lift)
    s_t = 1 / np.sqrt((p.T**2) @ p.lift)
    s = np.concatenate([s_n, s_t])
    rows, pushes = np.vstack([p.A, p.T]), np.vstack([p.G, p.T])
    K = (s[:, None] * rows * p.lift) @ (s[:, None] * pushes).T
    return s_n, s_t, K, s * np.concatenate([p.b_n, p.b_t])
