"""Existence of motions along a curve, or from rest, by linear programmes.

Along a curve z(s) the speed squared b = s'^2 and the acceleration a = s'' enter every force
linearly, and so do the contact forces: whether any motion keeps all limits is a linear programme,
discretised in s. Two questions are asked of it, each for the largest share `margin` by which all
limits can be kept at once (negative where they cannot):

* `slow_margin`: at b = a = 0, place by place. Positive everywhere, a slow enough motion exists.
* `fast_margin`: with b >= 0 free along the curve, at rest at its ends. Negative, none exists.
  Viscous friction is not linear in b; what stands in for sqrt(b) may be anything between its chord
  and its tangents, which can only allow more.

`rest_margin` asks whether a motion can begin from rest, or come to rest, at a place. There every
force is linear in the accelerations, once it is known which contacts and joints these set in motion
and which way. With one or two freedoms the ways are few: rays along which something stands still,
and the sectors between them. Accelerations may vanish, and what stands still may be held by any
friction in its cone, so that only more is allowed than any motion needs: where even the best margin
is negative, nothing moves.

Forces are from bodies and points alone (`benchmark.stress.newton`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import coo_array, csr_array

from ...common.arrays import Array
from ...contacts.closing import Numbers
from ...problem.definition import Phase
from ...scene.model import Scene
from .event_tracing import slides
from .newton import Touch, locate

Bounds = list[tuple[float | None, float | None]]

FASTEST = 1e3  # largest speed that is considered, over the scene's own
TANGENTS = np.geomspace(1e-6, 1.0, 13)
"""Places of the tangents that bound sqrt(b), over the largest b."""


class Forces(NamedTuple):
    """Limits of a phase at n places, as rows over x = (a, b, v, c) >= least.

    With forces over the scene's weight, torques over their limits and lengths over the radius of
    gyration. v stands for sqrt(b).
    """

    equal: Array  # equal, equal_to (n, 3, k) and (n, 3): Newton's and Euler's laws of the object
    equal_to: Array
    rows: Array  # rows, least (n, m, k) and (n, m): limits
    least: Array
    share: Array  # (m,): what a margin of 1 takes from each limit


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
            rows, equal = forces.rows[0, :, 3:], forces.equal[0, :, 3:]
            upper = np.column_stack([-rows, forces.share]), -forces.least[0]
            object_laws = np.column_stack([equal, np.zeros(3)]), forces.equal_to[0]
            bounds: Bounds = [(None, None)] * rows.shape[1] + [(None, 1.0)]
            margin = np.nan_to_num(_maximise(*upper, *object_laws, bounds), nan=-np.inf)
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
    curve  as of `event_tracing.resample`
    rests  whether the motion is at rest at the start and at the end of the curve
    loose  rate of sliding over that of the whole motion below which a contact may also roll, or
           slide the other way, on a curve nearby: its friction may then be any in its cone
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
    return _maximise(*upper.build(), *equal.build(), bounds)


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

    def build(self) -> tuple[csr_array, Array]:
        """The matrix and the right sides."""
        row, column, value = (np.concatenate(part) for part in zip(*self._entries, strict=True))
        shape = self.count, self.width
        return coo_array((value, (row, column)), shape).tocsr(), np.concatenate(self._right)


def _maximise(A_ub: Any, b_ub: Any, A_eq: Any, b_eq: Any, bounds: Bounds) -> float:
    """Largest value of the last unknown; -inf where infeasible, NaN where nothing is known."""
    cost = -np.eye(1, len(bounds), len(bounds) - 1)[0]
    options = {"time_limit": 20.0}
    answer = linprog(cost, A_ub, b_ub, A_eq, b_eq, bounds, method="highs", options=options)
    return float(-answer.fun) if answer.status == 0 else -np.inf if answer.status == 2 else np.nan


TOUCHES = 1e-6
"""Gap over the radius of gyration below which a contact touches that the phase does without."""
STILL = 1e-9  # rate over the largest one below which something stands still


def rest_margin(scene: Scene, phase: Phase, epsilon: float, z: Array, ends: bool = False) -> float:
    """Best margin of any motion that leaves rest at `z`, shape (5,), or comes to rest there.

    Parameters
    ----------
    ends  whether the motion ends there: then things moved against their accelerations

    Returns
    -------
    float  of normal forces over the weight and of torques over their limits, at most 1; NaN with
           other than one or two freedoms
    """
    touches = [locate(scene, name, z[None]) for name in phase.formation.names]
    rolling = phase.formation.rolling_rows
    closed = np.array([t.normal[0] for t in touches] + [touches[k].tangent[0] for k in rolling])
    size = np.array([1.0, 1.0, *[1 / scene.scales.length] * 3])
    N = size[:, None] * _null_space(closed * size)
    if N.shape[1] not in (1, 2):
        return np.nan
    slip = np.array([t.tangent[0] for t in touches] + list(np.eye(5)[3:])) @ N
    slip[list(rolling)] = 0.0
    apart = np.array([t.normal[0] @ N for t in list_others(scene, phase, z)]).reshape(
        -1, N.shape[1]
    )
    largest = np.abs(slip).max()
    margins = [-np.inf]
    for way in _ways(np.vstack([slip, apart])):
        rate = slip @ way
        signs = np.where(np.abs(rate) > STILL * largest, np.sign(rate), 0.0)
        if (apart @ way >= -STILL * largest).all():
            margins.append(_solve(scene, epsilon, touches, N, (slip, signs, apart), ends))
    return max(margins)


def list_others(scene: Scene, phase: Phase, z: Array) -> list[Touch]:
    """Contacts that touch at `z` but are none of the phase's: they may only open."""
    names = set(phase.formation.names)
    others = []
    for name in sorted(_every_name(scene) - names):
        touch = locate(scene, name, z[None])
        near = TOUCHES * scene.scales.length
        if abs(touch.gap[0]) < near and min(touch.low[0], touch.high[0]) > near:
            others.append(touch)
    return others


def _every_name(scene: Scene) -> set[str]:
    count = len(scene.polygon.vertices)
    parts = ("palm", "finger1", "finger2")
    names = {f"v{k}-{part}" for k in range(count) for part in parts}
    return names | {f"e{k}-tip{finger}" for k in range(count) for finger in (1, 2)}


def _null_space(rows: Array) -> Array:
    """Columns that span what the rows leave free."""
    _, size, V = np.linalg.svd(rows)
    return np.asarray(V[int((size > 1e-9 * size[0]).sum()) :].T)


def _ways(slip: Array) -> Iterator[Array]:
    """Unit vectors, shape (f,): one for each ray on which something stands still, and between."""
    if slip.shape[1] == 1:
        yield from (np.ones(1), -np.ones(1))
        return
    moving = slip[np.abs(slip).max(axis=1) > STILL * np.abs(slip).max()]
    angles = np.arctan2(-moving[:, 0], moving[:, 1])
    rays = np.sort(np.concatenate([angles, angles + np.pi]) % (2 * np.pi))
    between = (rays + np.append(rays[1:], rays[0] + 2 * np.pi)) / 2
    for angle in (*rays, *between):
        yield np.array([np.cos(angle), np.sin(angle)])


def _drive(scene: Scene, touches: list[Touch], N: Array) -> Array:
    """The equations of motion, shape (5, f + 2 n_c + 3), over the unknowns of `_solve`."""
    force, scales = scene.scales.force, scene.scales
    f, n_c = N.shape[1], len(touches)
    drive = np.zeros((5, f + 2 * n_c + 3))
    drive[:, :f] = scene.mass_diagonal[:, None] * N * scales.acceleration * scales.length
    for k, touch in enumerate(touches):
        drive[:, f + k] = -touch.normal[0] * force
        drive[:, f + n_c + k] = -touch.tangent[0] * force
    drive[3:, f + 2 * n_c : -1] = np.diag(scene.dry[3:])
    return drive


def _solve(
    scene: Scene,
    epsilon: float,
    touches: list[Touch],
    N: Array,
    rates: tuple[Array, Array, Array],
    ends: bool,
) -> float:
    """Margin in one way.

    Parameters
    ----------
    N : (5, f)  accelerations that keep the contacts
    rates       rates of contacts and joints, shape (n_c + 2, f), their signs, and rates of other
                gaps
    """
    slip, signs, apart = rates
    force, f, n_c = scene.scales.force, N.shape[1], len(touches)
    # Unknowns: the acceleration over the scene's, c_n and c_t over the weight, dry friction of the
    # joints over its bound, and the margin.
    total = f + 2 * n_c + 3
    drive, load = _drive(scene, touches, N), scene.applied_force
    scale = force * np.array([1.0, 1.0, scene.scales.length])
    equal, equal_to = [*(drive[:3] / scale[:, None])], [*(load[:3] / scale)]
    rows, most = list[Array](), list[float]()

    def at_least(row: Array, least: float, share: float) -> None:
        rows.append(-row + share * np.eye(total)[-1])
        most.append(-least)

    bounds: Bounds = [(None, None)] * (f + 2 * n_c)
    for k, sign in enumerate(signs):
        if sign:
            at_least(np.append(sign * slip[k], np.zeros(total - f)), 0.0, 0.0)
        elif np.abs(slip[k]).max() > 0:
            equal.append(np.append(slip[k], np.zeros(total - f)))
            equal_to.append(0.0)
    way = -signs if ends else signs
    for k, touch in enumerate(touches):
        press, grip = np.eye(total)[f + k], np.eye(total)[f + n_c + k]
        at_least(press, epsilon / force, 1.0)
        if way[k]:
            equal.append(grip + way[k] * touch.friction * press)
            equal_to.append(0.0)
        else:
            for side in (-grip, grip):
                at_least(touch.friction * press + side, 0.0, 0.0)
    for joint in range(2):
        for side in (-1.0, 1.0):
            at_least(side * drive[3 + joint] / scene.torque_limit[joint], -1.0, 1.0)
        sign = way[n_c + joint]
        bounds.append((sign, sign) if sign else (-1.0, 1.0))
    for row in apart:
        at_least(np.append(row, np.zeros(total - f)), 0.0, 0.0)
    bounds.append((None, 1.0))
    return _maximise(np.array(rows), most, np.array(equal), equal_to, bounds)
