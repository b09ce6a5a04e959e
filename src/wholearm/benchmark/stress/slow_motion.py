"""Linear programmes that decide whether a motion along a curve can exist.

Along a curve z(s) the speed squared b = s'^2 and the acceleration a = s'' enter every force
linearly, and so do the contact forces: whether any motion keeps all limits is a linear programme,
discretised in s. Two questions are asked of it, each for the largest share `margin` by which all
limits can be kept at once (negative where they cannot):

* `slow_margin`: at b = a = 0, place by place. Positive everywhere, a slow enough motion exists.
* `fast_margin`: with b >= 0 free along the curve, at rest at its ends. Negative, none exists.
  Viscous friction is not linear in b; what stands in for sqrt(b) may be anything between its chord
  and its tangents, which can only allow more.

Forces are from bodies and points alone (`benchmark.stress.newton`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import coo_array

from ...common.arrays import Array
from ...contacts.closing import Numbers
from ...problem.definition import Phase
from ...scene.model import Scene
from .newton import Touch, locate
from .tracing import slides

Bounds = list[tuple[float | None, float | None]]

FASTEST = 1e3
"""Largest speed that is considered, over the scene's own."""
TANGENTS = np.geomspace(1e-6, 1.0, 13)
"""Places of the tangents that bound sqrt(b), over the largest b."""


class Forces(NamedTuple):
    """Limits of a phase at n places, as rows over x = (a, b, v, c) >= least.

    With forces over the scene's weight, torques over their limits and lengths over the radius of
    gyration. v stands for sqrt(b).

    Attributes
    ----------
    equal, equal_to : ndarray, shape (n, 3, k) and (n, 3)
        Newton's and Euler's laws of the object.
    rows, least : ndarray, shape (n, m, k) and (n, m)
        Limits.
    share : ndarray, shape (m,)
        What a margin of 1 takes from each limit.
    """

    equal: Array
    equal_to: Array
    rows: Array
    least: Array
    share: Array


def slow_margin(
    scene: Scene, phase: Phase, epsilon: float, z: Array, z_s: Array
) -> tuple[float, int]:
    """Least margin of all places, each at its best, for vanishing speed, and which place it is."""
    signs = _signs(scene, phase, z, z_s)
    worst, place = np.inf, 0
    for k in range(len(z)):
        for sign in signs[max(k - 1, 0) : k + 1]:
            at = slice(k, k + 1)
            forces = _limits(scene, phase, epsilon, z[at], z_s[at], np.zeros((1, 5)), sign[None])
            margin = _solve_one(forces)
            if margin < worst:
                worst, place = margin, k
    return worst, place


def fast_margin(
    scene: Scene,
    phase: Phase,
    epsilon: float,
    curve: tuple[Array, Array, Array],
    rests: tuple[bool, bool] = (True, True),
    loose: float = 0.0,
) -> float:
    """Margin of the best motion along a curve.

    Parameters
    ----------
    curve : (s, z, z_s)
        As of `tracing.resample`.
    rests : (bool, bool)
        Whether the motion is at rest at the start and at the end of the curve.
    loose : float
        Rate of sliding over that of the whole motion below which a contact may also roll, or slide
        the other way, on a curve nearby: its friction may then be any in its cone.
    """
    s, z, z_s = curve
    size, speed = scene.scales.length, scene.scales.speed
    signs = _signs(scene, phase, z, z_s)
    z_ss = np.gradient(z_s, s, axis=0, edge_order=1)
    contacts = phase.formation.n_contacts
    slow = np.abs(slides(scene, phase, z, z_s)[:, :contacts]) < loose
    free = slow[1:] | slow[:-1] if loose else None
    count, forces = len(s), []
    for left in (True, False):
        at = slice(0, count - 1) if left else slice(1, count)
        forces.append(_limits(scene, phase, epsilon, z[at], z_s[at], z_ss[at], signs, free))
    width, slots = forces[0].rows.shape[2] - 3, np.arange(count - 1)
    run = np.diff(s) / size
    # Unknowns: b at the nodes, then v at the nodes, then c at both ends of every interval, margin.
    first_c = 2 * count
    total = first_c + 2 * (count - 1) * width + 1
    upper, equal = _Rows(total), _Rows(total)
    for side, part in enumerate(forces):
        columns = first_c + (2 * slots + side)[:, None] * width + np.arange(width)
        _add_limits(equal, part.equal, part.equal_to, slots, slots + side, run, columns)
        first = upper.count
        _add_limits(upper, -part.rows, -part.least, slots, slots + side, run, columns)
        row = np.arange(first, upper.count)
        upper.add(row, np.full(len(row), total - 1), np.repeat(part.share, len(slots)))
    top = _top(scene, z_s) / speed**2
    _add_tangents(upper, top)
    bounds: Bounds = [(0.0, float(limit)) for limit in top]
    bounds += [(0.0, None)] * count
    bounds += [(None, None)] * (total - first_c - 1) + [(None, 1.0)]
    for end, rest in zip((0, count - 1), rests, strict=True):
        if rest:
            bounds[end] = bounds[count + end] = (0.0, 0.0)
    return _maximise(total, upper, equal, bounds)


def _add_limits(
    rows: _Rows,
    matrix: Array,
    right: Array,
    slots: Numbers,
    node: Numbers,
    run: Array,
    columns: Numbers,
) -> None:
    """Rows over (a, b, v, c) at one end of every interval, a being the slope of b along it."""
    count = len(slots) + 1
    for m in range(matrix.shape[1]):
        row = rows.begin(len(slots), right[:, m])
        slope = matrix[:, m, 0] / (2 * run)
        rows.add(row, slots + 1, slope)
        rows.add(row, slots, -slope)
        rows.add(row, node, matrix[:, m, 1])
        rows.add(row, count + node, matrix[:, m, 2])
        for j in range(columns.shape[1]):
            rows.add(row, columns[:, j], matrix[:, m, 3 + j])


def _add_tangents(upper: _Rows, top: Array) -> None:
    """Rows that keep v below the tangents of sqrt(b), and above its chord up to `top`."""
    count, nodes = len(top), np.arange(len(top))
    for share in TANGENTS:
        at = share * top
        row = upper.begin(count, np.sqrt(at) / 2)
        upper.add(row, count + nodes, np.ones(count))
        upper.add(row, nodes, -0.5 / np.sqrt(at))
    row = upper.begin(count, np.zeros(count))
    upper.add(row, nodes, 1 / np.sqrt(top))
    upper.add(row, count + nodes, -np.ones(count))


def inertia_ratio(scene: Scene, phase: Phase, z: Array, z_s: Array) -> Array:
    """Reduced inertia over that without friction, least of both sides, shape (n,): jams below 0."""
    names, rolling = phase.formation.names, phase.formation.rolling_rows
    touches = [locate(scene, name, z) for name in names]
    rows = np.stack([touch.normal for touch in touches], axis=1)
    slid = np.stack([touch.tangent for touch in touches], axis=1)
    mu = np.array([0.0 if k in rolling else t.friction for k, t in enumerate(touches)])
    own = np.stack([touches[k].tangent for k in rolling], axis=1) if rolling else rows[:, :0]
    signs = _signs(scene, phase, z, z_s)[:, : len(names)]
    constraints = np.concatenate([rows, own], axis=1)
    light = constraints / scene.mass_diagonal
    without = np.linalg.det(light @ constraints.transpose(0, 2, 1))
    ratios = []
    for sign in (np.vstack([signs[:1], signs]), np.vstack([signs, signs[-1:]])):
        push = np.concatenate([rows - (mu * sign)[:, :, None] * slid, own], axis=1)
        ratios.append(np.linalg.det(light @ push.transpose(0, 2, 1)) / without)
    return np.asarray(np.minimum(*ratios))


def _top(scene: Scene, z_s: Array) -> Array:
    """Largest s'^2 that the joints' speed limits and `FASTEST` allow, shape (n,)."""
    with np.errstate(divide="ignore"):
        joints = (scene.speed_limit / np.abs(z_s[:, 3:])) ** 2
    return np.asarray(np.minimum((FASTEST * scene.scales.speed) ** 2, joints.min(axis=1)))


def _signs(scene: Scene, phase: Phase, z: Array, z_s: Array) -> Array:
    """Signs of sliding of contacts and joints on each interval, shape (n - 1, n_c + 2)."""
    rates = slides(scene, phase, z, z_s)
    return np.asarray(np.sign(rates[1:] + rates[:-1]))


def _limits(
    scene: Scene,
    phase: Phase,
    epsilon: float,
    z: Array,
    z_s: Array,
    z_ss: Array,
    signs: Array,
    free: NDArray[np.bool_] | None = None,
) -> Forces:
    """Limits at n places; where `free`, shape (n, n_c), friction of a contact is in its cone."""
    length, force = scene.scales.length, scene.scales.force
    limit, square = scene.torque_limit, scene.scales.speed**2
    names, rolling = phase.formation.names, phase.formation.rolling_rows
    holds, least, share = [], [], []
    touches = [locate(scene, name, z) for name in names]
    push = force * _push(touches, rolling, signs, free is not None)
    width = 3 + push.shape[2]
    mass = scene.mass_diagonal
    drive = np.stack(
        [mass * z_s * square / length, mass * z_ss * square, scene.viscous * z_s * np.sqrt(square)],
        axis=2,
    )
    scale = force * np.array([1.0, 1.0, length])
    equal = np.concatenate([drive[:, :3], -push[:, :3]], axis=2) / scale[:, None]
    equal_to = np.broadcast_to(scene.applied_force[:3] / scale, (len(z), 3))
    n = len(z)

    def limit_row(row: Array, bound: Array, own: float) -> None:
        holds.append(row)
        least.append(bound)
        share.append(own)

    for k in range(len(names)):
        row = np.zeros((n, width))
        row[:, 3 + k] = 1.0
        limit_row(row, np.full(n, epsilon / force), 1.0)
    for k, own in enumerate(rolling):
        for sign in (-1.0, 1.0):
            row = np.zeros((n, width))
            row[:, 3 + own] = touches[own].friction
            row[:, 3 + len(names) + k] = sign
            limit_row(row, np.full(n, touches[own].friction * epsilon / force), 1.0)
    if free is not None:
        for k in range(len(names)):
            # What is left of friction against the sliding, between nothing and twice its amount.
            for sign, most in ((1.0, 0.0), (-1.0, 2.0)):
                row = np.zeros((n, width))
                row[:, 3 + k] = most * touches[k].friction * free[:, k]
                row[:, width - len(names) + k] = sign * signs[:, k]
                limit_row(row, np.zeros(n), 0.0)
    for joint in range(2):
        row = np.concatenate([drive[:, 3 + joint], -push[:, 3 + joint]], axis=1) / limit[joint]
        dry = scene.dry[3 + joint] * signs[:, len(names) + joint] / limit[joint]
        limit_row(-row, dry - 1.0, 1.0)
        limit_row(row, -dry - 1.0, 1.0)
    return Forces(
        equal, equal_to, np.stack(holds, axis=1), np.stack(least, axis=1), np.array(share)
    )


def _push(touches: Sequence[Touch], rolling: Sequence[int], signs: Array, loose: bool) -> Array:
    """What the contact forces push with, shape (n, 5, k): c_n, c_t(rolling), all c_t if `loose`."""
    pushes = []
    for k, touch in enumerate(touches):
        slip = 0.0 if k in rolling else touch.friction
        pushes.append(touch.normal - slip * signs[:, [k]] * touch.tangent)
    pushes += [touches[k].tangent for k in rolling]
    pushes += [touch.tangent for touch in touches] if loose else []
    return np.stack(pushes, axis=2)


def _solve_one(forces: Forces) -> float:
    """Margin of one place at rest."""
    rows, equal = forces.rows[0, :, 3:], forces.equal[0, :, 3:]
    cost = np.append(np.zeros(rows.shape[1]), -1.0)
    answer = linprog(
        cost,
        A_ub=np.column_stack([-rows, forces.share]),
        b_ub=-forces.least[0],
        A_eq=np.column_stack([equal, np.zeros(3)]),
        b_eq=forces.equal_to[0],
        bounds=[(None, None)] * rows.shape[1] + [(None, 1.0)],
        method="highs",
    )
    return float(-answer.fun) if answer.status == 0 else -np.inf


class _Rows:
    """Rows of a sparse matrix with their right sides, collected piece by piece."""

    def __init__(self, width: int) -> None:
        self.width, self.count = width, 0
        self._entries: list[tuple[Numbers, Numbers, Array]] = []
        self._right: list[Array] = []

    def begin(self, count: int, right: Array) -> Numbers:
        """Numbers of `count` new rows with the given right sides."""
        self._right.append(np.broadcast_to(right, (count,)))
        self.count += count
        return np.arange(self.count - count, self.count)

    def add(self, row: Numbers, column: Numbers, value: Array) -> None:
        """Add one entry to each of some rows."""
        self._entries.append((row, column, np.broadcast_to(value, row.shape)))

    def build(self) -> tuple[coo_array, Array]:
        """The matrix and the right sides."""
        row, column, value = (np.concatenate(part) for part in zip(*self._entries, strict=True))
        return coo_array((value, (row, column)), (self.count, self.width)), np.concatenate(
            self._right
        )


def _maximise(total: int, upper: _Rows, equal: _Rows, bounds: Bounds) -> float:
    cost = np.zeros(total)
    cost[-1] = -1.0
    A_ub, b_ub = upper.build()
    A_eq, b_eq = equal.build()
    answer = linprog(
        cost, A_ub.tocsr(), b_ub, A_eq.tocsr(), b_eq, bounds=bounds, method="highs",
        options={"time_limit": 20.0},
    )  # fmt: skip
    if answer.status == 0:
        return float(-answer.fun)
    return -np.inf if answer.status == 2 else np.nan


__all__ = ["fast_margin", "inertia_ratio", "slow_margin"]
