"""Constant torques that close a contact and then hold still with everything that touches.

A motion that is to stop at a contact may end a little short of it. Torques have to

* be in static balance with all that touches at the contact, every c_n at least epsilon and
  |c_t| <= mu (c_n - epsilon), and start no motion that gives up one of these contacts;
* from rest, with the contact still open by a gap, accelerate the formation towards it, beyond what
  friction can hold.

All of this is affine in the torques. Those with the largest least margin, each over its saturation
value, solve a linear programme in three unknowns (vertex enumeration on an active set). Contacts of
the formation may open on the way: torques that keep them closed are so weak that impacts on arrival
last longer than the motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..scene.model import Scene
from .dynamics import Directions, force_rows
from .impact import ViolationKind, compute_impact
from .wedging import SURE, find_static_torques

LEAST = 1e-2  # least margin over saturation of torques that hold or close
AMPLE = 0.1  # saturation of margins of forces, torques, accelerations, over the scene's
DRIVE = 0.02  # least acceleration towards a contact that is still open, over the scene's
SLOW = 0.2  # least margin of slowly closing torques, over that of torques that only hold
_CREEP = 0.02  # saturation of sliding and turning with assumed signs, over the scene's
_STILL = 1e-9  # relative rate of sliding, turning or opening that counts as none
_JAMS = 1e-6  # determinant of K over the frictionless one, at and below which a mode jams
_INDEPENDENT = 1e-12  # least Gram determinant of independent normalized constraints
_SMALL = 1e-9  # what counts as zero in the linear programme
_FAR = 1e3  # largest margin, over saturation


class ArrivalPath(NamedTuple):
    """A start mode of a formation at rest; rows are for (1, tau_1, tau_2)."""

    acceleration: Array  # (5, 3): z''
    c_n: Array  # (n_c, 3) [N]
    # (k, 3): accelerations of sliding contacts and of joints along their assumed signs, over the
    # scene's; none with one freedom, where `heading` determines them
    consistent: Array
    heading: Array | None  # (5,): with one freedom, where to, of length one in the metric M5


class Standstill(NamedTuple):
    """Where a motion stops."""

    z: Array  # (5,)
    formation: Formation  # that it stops in
    gained: Contact | None  # what it stops at
    touching: Formation  # all that touches


class Hold(NamedTuple):
    """Constant torques for a standstill."""

    tau: Array  # (2,) [N m]
    margin: float  # the least of the margins, over what is ample
    # [m/s]: at most, with which the contact is reached from rest, if all others stay closed till
    # then; zero where nothing has to close, or no torques would drive the formation on
    speed: float = 0.0
    # contacts that would have to pull in the impact of that arrival: they part for a moment
    parts: tuple[str, ...] = ()


def find_hold(place: Standstill, epsilon: float, gap: float, time: float) -> Hold | None:
    """Torques with the largest margin for a standstill; None if none hold c_n >= `epsilon` [N].

    A gained contact, open by up to `gap` [m], is closed with the least acceleration `DRIVE` if any
    torques do, or else with that which closes it in `time` [s].
    """
    rest = _list_holding(place, epsilon)
    best = maximise_margin(place.formation.scene, rest)
    if best is None or best[1] < LEAST:
        return None
    opening, firm = find_opening(place), Hold(*best)
    if opening is None:
        return firm
    swift = 2 * gap / time**2
    closing = _find_closing(place, rest, opening, gap)
    slow = _find_closing(place, rest, opening, gap, swift) if closing is None else None
    if slow is not None and slow.margin > SLOW * firm.margin:
        return slow
    return closing or firm


def _list_holding(place: Standstill, epsilon: float) -> Array:
    """Rows that have to be positive at rest, over their saturation values, shape (k, 3)."""
    touching, z = place.touching, place.z
    scene = touching.scene
    static = find_static_torques([touching], z, epsilon)
    balance = np.column_stack([static.bounds, -static.normals]) / (AMPLE * scene.scales.torque)
    A = touching.evaluate(z[None], np.zeros((1, 5))).A[0]
    count = np.linalg.matrix_rank(A / np.sqrt(scene.mass_diagonal), tol=_SMALL)
    away, ample = [], AMPLE * math.sqrt(scene.scales.mass) * scene.scales.acceleration
    for kept in combinations(range(len(A)), 4) if count == 5 else ():
        others = [k for k in range(len(A)) if k not in kept]
        part = Formation(scene, tuple(touching.contacts[k] for k in kept))
        away += [
            -(mode.heading * scene.mass_diagonal) @ mode.acceleration / ample
            for mode in list_modes(part, z)
            if mode.heading is not None and (A[others] @ mode.heading >= -_SMALL).all()
        ]
    return np.vstack([balance, *away])


def find_opening(place: Standstill) -> Array | None:
    """Rate of z per metre of the gained contact's gap, shape (5,); None if nothing opens it."""
    if place.gained is None:
        return None
    scene = place.formation.scene
    at = place.z[None], np.zeros((1, 5))
    normal = Formation(scene, (place.gained,)).evaluate(*at).A[0][0]
    root = np.sqrt(scene.mass_diagonal)
    P, along = place.formation.evaluate(*at).P[0] / root, normal / root
    free = along - P.T @ np.linalg.lstsq(P.T, along, rcond=_SMALL)[0]
    rate = float(free @ along)
    if rate <= _STILL**0.5 * float(along @ along):
        return None
    return np.asarray(free / root / rate)


def _find_closing(
    place: Standstill, rest: Array, opening: Array, gap: float, ample: float | None = None
) -> Hold | None:
    """Torques of largest margin that accelerate the formation towards a contact open by `gap`.

    With a saturation value `ample` [m/s^2] that acceleration is one more margin, not a bound.
    """
    assert place.gained is not None
    scene, z = place.formation.scene, place.z + gap * opening
    normal = Formation(scene, (place.gained,)).evaluate(z[None], np.zeros((1, 5))).A[0][0]
    least = np.array([DRIVE * scene.scales.acceleration, 0.0, 0.0])
    best: Hold | None = None
    for mode in list_modes(place.formation, z):
        if mode.heading is not None and normal @ mode.heading >= 0:
            continue
        closing, rows = -normal @ mode.acceleration, np.vstack([rest, mode.consistent])
        if ample is None:
            solution = maximise_margin(scene, rows, closing[None] - least)
        else:
            solution = maximise_margin(scene, np.vstack([rows, closing / ample]))
        if solution is None or solution[1] < max(LEAST, best.margin if best else 0.0):
            continue
        tau, margin = solution
        # Friction must not be able to hold the formation at rest before it is there.
        held = find_static_torques([place.formation], z)
        if held.measure(tau[None])[0] <= SURE * scene.scales.torque:
            continue
        a = float(closing @ [1.0, *tau])
        v = mode.acceleration @ [1.0, *tau] * math.sqrt(2 * gap / a)
        best = Hold(tau, margin, math.sqrt(2 * a * gap), find_parting(place, v))
    return best


def find_parting(place: Standstill, v: Array) -> tuple[str, ...]:
    """Contacts that would have to pull in a plastic impact at velocity `v`, shape (5,)."""
    try:
        impact = compute_impact(place.formation, place.touching, place.z, v)
    except np.linalg.LinAlgError:
        return ()
    return tuple(h.name for h in impact.violations if h.kind is ViolationKind.PULL)


def list_modes(formation: Formation, z: Array) -> Iterator[ArrivalPath]:
    """Every start mode of a formation at rest at `z`, shape (5,)."""
    scene, n_c = formation.scene, formation.n_contacts
    kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
    P, inverse_mass = kinematics.P[0], 1 / scene.mass_diagonal
    scales = scene.scales
    rates = np.vstack([kinematics.A_t[0] / scales.acceleration, scales.time**2 * np.eye(5)[3:]])
    drive = np.column_stack([scene.applied_force, np.eye(5)[:, 3:]])
    lines = P * np.sqrt(inverse_mass)
    lines /= np.linalg.norm(lines, axis=1)[:, None]
    if np.linalg.det(lines @ lines.T) < _INDEPENDENT:
        return
    plain = np.linalg.det((P * inverse_mass) @ P.T)
    rolls = list(formation.rolling_rows)
    for signs, heading in _list_signs(scene, P, rates, rolls):
        directions = Directions(signs[None, :n_c], signs[None, n_c:])
        G = force_rows(formation, kinematics, directions)[0]
        K = (P * inverse_mass) @ G.T
        if not np.linalg.det(K) > _JAMS * plain:
            continue
        applied = drive.copy()
        applied[3:, 0] -= scene.dry[3:] * signs[n_c:]
        c = -np.linalg.solve(K, (P * inverse_mass) @ applied)
        acceleration = inverse_mass[:, None] * (applied + G.T @ c)
        assumed = signs[:, None] * (rates @ acceleration) / _CREEP
        consistent = assumed[signs != 0] if heading is None else np.zeros((0, 3))
        yield ArrivalPath(acceleration, c[:n_c], consistent, heading)


def _list_signs(
    scene: Scene, P: Array, rates: Array, rolls: list[int]
) -> Iterator[tuple[Array, Array | None]]:
    """Directions of contacts and joints, shape (n_c + 2,), zero for what stays, and the heading."""
    if len(P) == 4:
        root = np.sqrt(scene.mass_diagonal)
        heading = np.linalg.svd(P / root)[2][4] / root
        speeds = rates @ heading
        speeds[rolls] = 0.0
        signs = np.where(np.abs(speeds) > _STILL * np.abs(speeds).max(), np.sign(speeds), 0.0)
        yield from ((signs, heading), (-signs, -heading))
        return
    free = [k for k in range(len(rates)) if k not in rolls]
    for choice in product((1.0, -1.0), repeat=len(free)):
        signs = np.zeros(len(rates))
        signs[free] = choice
        yield signs, None


def maximise_margin(
    scene: Scene, rows: Array, bounds: Array | None = None
) -> tuple[Array, float] | None:
    """Torques within their limits that maximise the least of rows @ (1, tau), (k, 3), and that.

    Values of `bounds`, (l, 3), only have to be positive. None if there are no such torques.
    """
    limits, unit = scene.torque_limit, scene.scales.torque
    box = [[limit, *(-side * axis)] for limit, axis in zip(limits, np.eye(2), strict=True)
           for side in (1.0, -1.0)]  # fmt: skip
    plain = np.vstack([box, np.zeros((0, 3)) if bounds is None else bounds])
    sides = np.vstack([plain, rows, [[_FAR, 0.0, 0.0]]]) * [1.0, unit, unit]
    counts = np.repeat([0.0, 1.0], [len(plain), len(rows) + 1])
    matrix = np.column_stack([-sides[:, 1:], counts])
    sizes = np.abs(np.column_stack([sides, counts])).max(axis=1)
    matrix, right = matrix / sizes[:, None], sides[:, 0] / sizes
    chosen = [0, 1, 2, 3, len(sides) - 1]
    while True:
        x = _find_vertex(matrix[chosen], right[chosen])
        if x is None:
            return None
        missed = matrix @ x - right
        worst = int(missed.argmax())
        if missed[worst] <= _SMALL * max(1.0, float(np.abs(x).max())) or worst in chosen:
            return unit * x[:2], float(x[2])
        chosen.append(worst)


def _find_vertex(matrix: Array, right: Array) -> Array | None:
    """The vertex of matrix @ x <= right with the largest last entry, shape (3,); None if none."""
    three = np.array(list(combinations(range(len(matrix)), 3)))
    corners = matrix[three]
    three = three[np.abs(np.linalg.det(corners)) > _SMALL]
    x = np.linalg.solve(matrix[three], right[three][..., None])[..., 0]
    slack = right - x @ matrix.T
    kept = x[(slack >= -_SMALL * np.maximum(1.0, np.abs(x).max(axis=1))[:, None]).all(axis=1)]
    return kept[kept[:, 2].argmax()] if len(kept) else None
