"""Whether any motion begins or ends at rest at a place: what `mechanics.statics` says, told anew.

`rest_margin` asks whether a motion can begin from rest, or come to rest, at a place. There every
force is linear in the accelerations, once it is known which contacts and joints these set in motion
and which way. With one or two freedoms the ways are few: rays along which something stands still,
and the sectors between them. Accelerations may vanish, and what stands still may be held by any
friction in its cone, so that only more is allowed than any motion needs: where even the best margin
is negative, nothing moves.

Nothing is shared with the planner: contacts and forces are those of `verification.newton_euler`.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from scipy.linalg import null_space

from wholearm import Scene
from wholearm.benchmark.refusals import Bounds, constrain, maximise
from wholearm.common.arrays import Array
from wholearm.problem.definition import Phase
from wholearm.verification.newton_euler import ContactGeometry, locate

STILL = 1e-9  # rate over the largest one below which something stands still


def rest_margin(scene: Scene, phase: Phase, epsilon: float, z: Array, ends: bool = False) -> float:
    """Best margin of any motion that leaves rest at `z`, shape (5,), or comes to rest there.

    Where a motion `ends`, things moved against their accelerations. The margin is that of normal
    forces over the weight and of torques over their limits, at most 1; NaN with other than one or
    two freedoms.
    """
    touches = [locate(scene, name, z[None]) for name in phase.formation.names]
    rolling = phase.formation.rolling_rows
    closed = constrain(phase.formation, z[None])[1][0]
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


def list_others(scene: Scene, phase: Phase, z: Array) -> list[ContactGeometry]:
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
    touches: list[ContactGeometry],
    N: Array,
    rates: tuple[Array, Array, Array],
    ends: bool,
) -> float:
    """Margin in one way.

    Unknowns: the acceleration over the scene's, c_n and c_t over the weight, dry friction of the
    joints over its bound, and the margin. Columns of N, (5, f), are accelerations that keep the
    contacts; `rates` are those of contacts and joints, (n_c + 2, f), their signs, and those of
    other gaps.
    """
    slip, signs, apart = rates
    scales, f, n_c = scene.scales, N.shape[1], len(touches)
    unit = np.eye(f + 2 * n_c + 3)
    move, press, grip = unit[:f], unit[f : f + n_c], unit[f + n_c : f + 2 * n_c]
    drive = scene.mass_diagonal[:, None] * N @ move * scales.acceleration * scales.length
    for k, t in enumerate(touches):
        drive -= scales.force * (np.outer(t.normal, press[k]) + np.outer(t.tangent, grip[k]))
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
    return maximise(upper, most, np.concatenate(equal), equal_to, [*bounds, (None, 1.0)])
