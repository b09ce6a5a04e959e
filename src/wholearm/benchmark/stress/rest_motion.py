"""Linear programmes that decide whether a motion can begin from rest, or come to rest, at a place.

At rest every force is linear in the accelerations, once it is known which contacts and joints these
set in motion and which way. With one or two freedoms the ways are few: rays along which something
stands still, and the sectors between them. For each of them the largest share `margin` is sought by
which all limits can be kept at once. Accelerations may vanish, and what stands still may be held by
any friction in its cone, so that only more is allowed than any motion needs: where even the best
margin is negative, nothing moves.

Forces are from bodies and points alone (`benchmark.stress.newton`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import linprog

from ...common.arrays import Array
from ...problem.definition import Phase
from ...scene.model import Scene
from .newton import Touch, locate

TOUCHES = 1e-6
"""Gap over the radius of gyration below which a contact touches that the phase does without."""
STILL = 1e-9
"""Rate over the largest one below which something stands still."""


def rest_margin(scene: Scene, phase: Phase, epsilon: float, z: Array, ends: bool = False) -> float:
    """Best margin of any motion that leaves rest at `z`, shape (5,), or comes to rest there.

    Parameters
    ----------
    ends : bool
        Whether the motion ends there: then things moved against their accelerations.

    Returns
    -------
    float
        Of normal forces over the weight and of torques over their limits, at most 1; NaN with other
        than one or two freedoms.
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
    found = []
    for name in sorted(_every_name(scene) - names):
        touch = locate(scene, name, z[None])
        near = TOUCHES * scene.scales.length
        if abs(touch.gap[0]) < near and min(touch.low[0], touch.high[0]) > near:
            found.append(touch)
    return found


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
    N : ndarray, shape (5, f)
        Accelerations that keep the contacts.
    rates : (slip, signs, apart)
        Rates of contacts and joints, shape (n_c + 2, f), their signs, and rates of other gaps.
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

    bounds: list[tuple[float | None, float | None]] = [(None, None)] * (f + 2 * n_c)
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
    answer = linprog(
        -np.eye(total)[-1], np.array(rows), most, np.array(equal), equal_to, bounds, method="highs"
    )
    return float(-answer.fun) if answer.status == 0 else -np.inf if answer.status == 2 else np.nan
