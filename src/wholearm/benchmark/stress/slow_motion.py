"""Existence of motions along a curve, or from rest, by linear programmes.

Along a curve z(s) the speed squared b = s'^2 and the acceleration a = s'' enter every force
linearly, and so do the contact forces: whether any motion keeps all limits is a linear programme,
discretised in s. Two questions are asked of it, each for the largest share `margin` by which all
limits can be kept at once (negative where they cannot):

* `slow_margin`: at b = a = 0. Positive, a slow enough motion exists.
* `fast_margin`: with b >= 0 free along the curve, at rest at its ends. Negative, none exists.
  Viscous friction is not linear in b; what stands in for sqrt(b) may be anything between its chord
  and its tangents, which can only allow more.

`rest_margin` asks whether a motion can begin from rest, or come to rest, at a place. There every
force is linear in the accelerations, once it is known which contacts and joints these set in motion
and which way. With one or two freedoms the ways are few: rays along which something stands still,
and the sectors between them. Accelerations may vanish, and what stands still may be held by any
friction in its cone, so that only more is allowed than any motion needs: where even the best margin
is negative, nothing moves.

Forces are from bodies and points alone (`verification.newton_euler`).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.optimize import linprog
from scipy.sparse import block_array, block_diag, coo_array, diags_array, eye_array, kron

from ...common.arrays import Array
from ...problem.definition import Phase
from ...scene.model import Scene
from ...verification.newton_euler import Touch, locate
from .event_tracing import slides

Bounds = list[tuple[float | None, float | None]]


def slow_margin(scene: Scene, phase: Phase, epsilon: float, z: Array, z_s: Array) -> float:
    """Least margin of all places, each at its best, for vanishing speed."""
    curve = np.arange(1.0 * len(z)), z, z_s, np.zeros_like(z)
    margin = _solve_along(scene, phase, epsilon, curve, np.zeros(len(z)), 0.0)
    return float(np.nan_to_num(margin, nan=-np.inf))


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
    with np.errstate(divide="ignore"):
        joints = ((scene.speed_limit / np.abs(z_s[:, 3:])) ** 2).min(axis=1)
    top = np.minimum(1e6, joints / scene.scales.speed**2)
    top[[0, -1]] *= ~np.array(rests)
    z_ss = np.gradient(z_s, s, axis=0, edge_order=1)
    return _solve_along(scene, phase, epsilon, (s, z, z_s, z_ss), top, loose)


def _solve_along(
    scene: Scene,
    phase: Phase,
    epsilon: float,
    curve: tuple[Array, Array, Array, Array],
    top: Array,
    loose: float,
) -> float:
    """Largest margin along a curve (s, z, z_s, z_ss), b being at most `top` at its n places.

    Unknowns: b and v, which stands for sqrt(b), at the places, contact forces at both ends of every
    interval, and the margin.
    """
    s, z, z_s, z_ss = curve
    n, n_c = len(s), phase.formation.n_contacts
    slow = np.abs(slides(scene, phase, z, z_s)[:, :n_c]) < loose
    signs, free = _signs(scene, phase, z, z_s), slow[1:] | slow[:-1] if loose else None
    slope = diags_array(scene.scales.length / (2 * np.diff(s))) @ (
        eye_array(n - 1, n, k=1) - eye_array(n - 1, n)
    )
    upper, most, equal, equal_to = list[Any](), list[Array](), list[Any](), list[Array]()
    for side in (0, 1):
        at, place = slice(side, n - 1 + side), eye_array(n - 1, n, k=side)
        points = z[at], z_s[at], z_ss[at]
        laws, laws_to, rows, least, share = _limits(scene, phase, epsilon, *points, signs, free)
        for blocks, matrix in ((equal, laws), (upper, -rows)):
            every = kron(eye_array(n - 1), np.ones((matrix.shape[1], 1)))
            a, b, v = (diags_array(matrix[:, :, k].ravel()) @ every for k in range(3))
            c: list[Any] = [None, None]
            c[side] = block_diag([coo_array(block) for block in matrix[:, :, 3:]])
            blocks.append([a @ slope + b @ place, v @ place, *c])
        upper[-1].append(np.tile(share, n - 1)[:, None])
        most.append(-least.ravel())
        equal_to.append(laws_to.ravel())
    moving = np.flatnonzero(top)
    bounds: Bounds = [*zip(np.zeros(n), top, strict=True)]
    bounds += [(0.0, None if limit else 0.0) for limit in top]
    if len(moving):
        # v is below the tangents of sqrt(b), and above its chord.
        some, root = eye_array(n, format="csr")[moving], np.sqrt(top[moving])
        for share in np.geomspace(1e-3, 1.0, 13):
            upper.append([-diags_array(0.5 / (share * root)) @ some, some, None, None, None])
            most.append(share * root / 2)
        upper.append([diags_array(1 / root) @ some, -some, None, None, None])
        most.append(np.zeros(len(moving)))
    A_ub, A_eq = block_array(upper, format="csr"), block_array(equal, format="csr")
    bounds += [(None, None)] * (A_ub.shape[1] - 2 * n - 1) + [(None, 1.0)]
    A_eq.resize(A_eq.shape[0], A_ub.shape[1])
    return _maximise(A_ub, np.concatenate(most), A_eq, np.concatenate(equal_to), bounds)


def inertia_ratio(scene: Scene, phase: Phase, z: Array, z_s: Array) -> Array:
    """Reduced inertia over that without friction, least of both sides, shape (n,): jams below 0."""
    names, rolling = phase.formation.names, phase.formation.rolling_rows
    touches = [locate(scene, name, z) for name in names]
    signs = _signs(scene, phase, z, z_s)
    rows = np.concatenate(
        [
            np.stack([touch.normal for touch in touches], axis=1),
            *(touches[k].tangent[:, None] for k in rolling),
        ],
        axis=1,
    )
    light = rows / scene.mass_diagonal
    without = np.linalg.det(light @ rows.transpose(0, 2, 1))
    ratios = []
    for sign in (np.vstack([signs[:1], signs]), np.vstack([signs, signs[-1:]])):
        ratios.append(np.linalg.det(light @ _push(touches, rolling, sign)) / without)
    return np.asarray(np.minimum(*ratios))


def _signs(scene: Scene, phase: Phase, z: Array, z_s: Array) -> Array:
    """Signs of sliding of contacts and joints on each interval, shape (n - 1, n_c + 2)."""
    rates = slides(scene, phase, z, z_s)
    return np.asarray(np.sign(rates[1:] + rates[:-1]))


def _push(touches: list[Touch], rolling: tuple[int, ...], signs: Array) -> Array:
    """What the forces c_n and c_t(rolling) push with, shape (n, 5, n_c + R)."""
    pushes = [
        touch.normal - (0.0 if k in rolling else touch.friction) * signs[:, [k]] * touch.tangent
        for k, touch in enumerate(touches)
    ]
    return np.stack([*pushes, *(touches[k].tangent for k in rolling)], axis=2)


def _limits(
    scene: Scene,
    phase: Phase,
    epsilon: float,
    z: Array,
    z_s: Array,
    z_ss: Array,
    signs: Array,
    free: NDArray[np.bool_] | None,
) -> tuple[Array, Array, Array, Array, Array]:
    """Limits at n places, as rows over x = (a, b, v, c) >= least.

    With forces over the scene's weight, torques over their limits and lengths over the radius of
    gyration. v stands for sqrt(b), c for c_n, c_t(rolling), and all c_t where friction is free:
    where `free`, shape (n, n_c), that of a contact is in its cone.

    Returns
    -------
    equal, equal_to : (n, 3, k) and (n, 3)  Newton's and Euler's laws of the object
    rows, least : (n, m, k) and (n, m)      limits
    share : (m,)                            what a margin of 1 takes from each limit
    """
    length, force, speed = scene.scales.length, scene.scales.force, scene.scales.speed
    n, n_c, rolling = len(z), phase.formation.n_contacts, phase.formation.rolling_rows
    touches = [locate(scene, name, z) for name in phase.formation.names]
    mu, held = np.array([touch.friction for touch in touches]), list(rolling)
    push = [_push(touches, rolling, signs)]
    if free is not None:
        push.append(np.stack([touch.tangent for touch in touches], axis=2))
    mass = scene.mass_diagonal * speed**2
    inertia = [mass * z_s / length, mass * z_ss, scene.viscous * z_s * speed]
    drive = np.concatenate([np.stack(inertia, axis=2), *(-force * part for part in push)], axis=2)
    scale, limit = force * np.array([1.0, 1.0, length]), scene.torque_limit
    unit = np.eye(drive.shape[2])
    press, grip = unit[3 : 3 + n_c], unit[3 + n_c : 3 + n_c + len(held)]
    cone = mu[held, None] * press[held]
    fixed = np.concatenate([press, cone + grip, cone - grip])
    torque = drive[:, 3:] / limit[:, None]
    dry = scene.dry[3:] * signs[:, n_c:] / limit
    rows = [np.broadcast_to(fixed, (n, *fixed.shape)), -torque, torque]
    least = [np.tile(epsilon / force * np.concatenate([np.ones(n_c), *[mu[held]] * 2]), (n, 1))]
    least += [dry - 1.0, -dry - 1.0]
    share = [np.ones(len(fixed) + 4)]
    if free is not None:
        # What is left of friction against the sliding, between nothing and twice its amount.
        left = signs[:, :n_c, None] * unit[-n_c:]
        rows += [left, 2 * (mu * free)[:, :, None] * press - left]
        least.append(np.zeros((n, 2 * n_c)))
        share.append(np.zeros(2 * n_c))
    equal_to = np.broadcast_to(scene.applied_force[:3] / scale, (n, 3))
    matrices = np.concatenate(rows, axis=1), np.concatenate(least, axis=1)
    return drive[:, :3] / scale[:, None], equal_to, *matrices, np.concatenate(share)


def _maximise(A_ub: Any, b_ub: Any, A_eq: Any, b_eq: Any, bounds: Bounds) -> float:
    """Largest value of the last unknown; -inf where infeasible, NaN where nothing is known."""
    cost = -np.eye(1, len(bounds), len(bounds) - 1)[0]
    options = {"time_limit": 20.0}
    answer = linprog(cost, A_ub, b_ub, A_eq, b_eq, bounds, method="highs", options=options)
    return float(-answer.fun) if answer.status == 0 else -np.inf if answer.status == 2 else np.nan


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
    N = size[:, None] * null_space(closed * size, rcond=STILL)
    if N.shape[1] not in (1, 2):
        return np.nan
    slip = np.array([t.tangent[0] for t in touches] + list(np.eye(5)[3:])) @ N
    slip[list(rolling)] = 0.0
    apart = np.array([t.normal[0] for t in list_others(scene, phase, z)]).reshape(-1, 5) @ N
    largest = np.abs(slip).max()
    margins = [-np.inf]
    for way in _ways(np.vstack([slip, apart])):
        rate = slip @ way
        signs = np.where(np.abs(rate) > STILL * largest, np.sign(rate), 0.0)
        if (apart @ way >= -STILL * largest).all():
            margins.append(_solve_at_rest(scene, epsilon, touches, N, (slip, signs, apart), ends))
    return max(margins)


def list_others(scene: Scene, phase: Phase, z: Array) -> list[Touch]:
    """Contacts that touch at `z` but are none of the phase's: they may only open."""
    near, count = 1e-6 * scene.scales.length, len(scene.polygon.vertices)
    names = [f"v{k}-{part}" for k, part in product(range(count), ("palm", "finger1", "finger2"))]
    names += [f"e{k}-tip{finger}" for k, finger in product(range(count), (1, 2))]
    touches = [locate(scene, n, z[None]) for n in sorted({*names} - {*phase.formation.names})]
    return [t for t in touches if abs(t.gap[0]) < near and min(t.low[0], t.high[0]) > near]


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


def _solve_at_rest(
    scene: Scene,
    epsilon: float,
    touches: list[Touch],
    N: Array,
    rates: tuple[Array, Array, Array],
    ends: bool,
) -> float:
    """Margin in one way.

    Unknowns: the acceleration over the scene's, c_n and c_t over the weight, dry friction of the
    joints over its bound, and the margin.

    Parameters
    ----------
    N : (5, f)  accelerations that keep the contacts
    rates       rates of contacts and joints, shape (n_c + 2, f), their signs, and rates of other
                gaps
    """
    slip, signs, apart = rates
    scales, f, n_c = scene.scales, N.shape[1], len(touches)
    unit = np.eye(f + 2 * n_c + 3)
    move, press, grip = unit[:f], unit[f : f + n_c], unit[f + n_c : f + 2 * n_c]
    drive = scene.mass_diagonal[:, None] * N @ move * scales.acceleration * scales.length
    for k, touch in enumerate(touches):
        drive -= scales.force * (
            np.outer(touch.normal, press[k]) + np.outer(touch.tangent, grip[k])
        )
    drive[3:] += scene.dry[3:, None] * unit[f + 2 * n_c : -1]
    scale = scales.force * np.array([1.0, 1.0, scales.length])
    torque = drive[3:] / scene.torque_limit[:, None]
    way = -signs if ends else signs
    gone, still = way[:n_c] != 0, (signs == 0) & (np.abs(slip).max(axis=1) > 0)
    mu = np.array([touch.friction for touch in touches])[:, None]
    cone = mu * press
    equal = [drive[:3] / scale[:, None], slip[still] @ move]
    equal.append((grip + way[:n_c, None] * cone)[gone])
    equal_to = np.append(scene.applied_force[:3] / scale, np.zeros(still.sum() + gone.sum()))
    # Limits: rows, what they are at least, and what a margin of 1 takes from them.
    limits = [
        ((signs[:, None] * slip) @ move, 0.0, 0.0),
        (press, epsilon / scales.force, 1.0),
        ((cone - grip)[~gone], 0.0, 0.0),
        ((cone + grip)[~gone], 0.0, 0.0),
        (torque, -1.0, 1.0),
        (-torque, -1.0, 1.0),
        (apart @ move, 0.0, 0.0),
    ]
    upper = np.concatenate([share * unit[-1] - rows for rows, _, share in limits])
    most = np.concatenate([np.full(len(rows), -least) for rows, least, _ in limits])
    bounds: Bounds = [(None, None)] * (f + 2 * n_c)
    bounds += [(sign, sign) if sign else (-1.0, 1.0) for sign in way[n_c:]]
    return _maximise(upper, most, np.concatenate(equal), equal_to, [*bounds, (None, 1.0)])
