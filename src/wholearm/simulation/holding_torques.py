"""Constant torques that close a contact and then hold still with everything that touches.

A motion that is to stop at a contact may end a little short of it. Torques have to

* be in static balance with all that touches at the contact, every c_n at least epsilon and
  |c_t| <= mu (c_n - epsilon), and start no motion that gives up one of these contacts;
* from rest, with the contact still open by a gap, accelerate the formation towards it, beyond what
  friction can hold.

All of this is affine in the torques (`rest`). Those with the largest least margin, each over its
saturation value, solve a linear programme in three unknowns. Contacts of the formation may open on
the way: torques that keep them closed are so weak that impacts on arrival last longer than the
motion.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import SimulationError
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..mechanics.impact import ViolationKind, compute_impact
from ..mechanics.statics import SURE, Statics
from .rest import StartMode, find_rest

LEAST = 1e-2  # least margin over saturation of torques that hold or close
AMPLE = 0.1  # saturation of margins of forces, torques, accelerations, over the scene's
DRIVE = 0.02  # least acceleration towards an open contact, ample sliding, over the scene's
_SMALL = 1e-9  # relative rate at which a contact does not part


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
    best = maximise_margin(place.formation.scene.torque_limit, rest)
    if best is None or best[1] < LEAST:
        return None
    opening, firm = find_opening(place), Hold(*best)
    if opening is None:
        return firm
    swift = 2 * gap / time**2
    closing = _find_closing(place, rest, opening, gap)
    slow = _find_closing(place, rest, opening, gap, swift) if closing is None else None
    # Torques that close slowly hold less well than those that only hold, but by not too much.
    if slow is not None and slow.margin > 0.2 * firm.margin:
        return slow
    return closing or firm


def _list_holding(place: Standstill, epsilon: float) -> Array:
    """Rows that have to be positive at rest, over their saturation values, shape (k, 3)."""
    touching, z = place.touching, place.z
    scene = touching.scene
    static = Statics(touching, z).torque_polygon(epsilon)
    rows = [np.column_stack([static.bounds, -static.normals]) / (AMPLE * scene.scales.torque)]
    A = touching.evaluate(z[None], np.zeros((1, 5))).A[0]
    count = np.linalg.matrix_rank(A / np.sqrt(scene.mass_diagonal), tol=_SMALL)
    ample = AMPLE * math.sqrt(scene.scales.mass) * scene.scales.acceleration
    for kept in combinations(touching.contacts, 4) if count == 5 else ():
        others = [k for k, contact in enumerate(touching.contacts) if contact not in kept]
        # Motions that give up the other contacts.
        rows += [
            -mode.slips / ample
            for mode in _list_sliding(Formation(scene, kept), z)
            if mode.heading is not None and (A[others] @ mode.heading >= -_SMALL).all()
        ]
    return np.vstack(rows)


def _list_sliding(formation: Formation, z: Array) -> tuple[StartMode, ...]:
    """Start modes without sticking that do not jam; none if contacts depend on each other."""
    try:
        return tuple(mode for mode in find_rest(formation, z).sliding if mode.response.ratio > 0)
    except SimulationError:
        return ()


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
    if rate <= 3e-5 * float(along @ along):
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
    scales, limits = scene.scales, scene.torque_limit
    normal = Formation(scene, (place.gained,)).evaluate(z[None], np.zeros((1, 5))).A[0][0]
    held = Statics(place.formation, z).torque_polygon()
    creep = DRIVE * np.repeat(
        [scales.acceleration, 1 / scales.time**2], [place.formation.n_contacts, 2]
    )
    best: Hold | None = None
    for mode in _list_sliding(place.formation, z):
        rows, closing = rest, -normal @ mode.response.acceleration
        if mode.heading is None:
            rows = np.vstack([rest, (mode.slips / creep[:, None])[mode.response.signs != 0]])
        elif normal @ mode.heading >= 0:
            continue
        if ample is None:
            bound = closing - [DRIVE * scales.acceleration, 0.0, 0.0]
            solution = maximise_margin(limits, rows, bound[None])
        else:
            solution = maximise_margin(limits, np.vstack([rows, closing / ample]))
        if solution is None or solution[1] < max(LEAST, best.margin if best else 0.0):
            continue
        tau, margin = solution
        # Friction must not be able to hold the formation at rest before it is there.
        if held.measure(tau[None])[0] <= SURE * scales.torque:
            continue
        a = float(closing @ [1.0, *tau])
        v = mode.response.acceleration @ [1.0, *tau] * math.sqrt(2 * gap / a)
        best = Hold(tau, margin, math.sqrt(2 * a * gap), _find_parting(place, v))
    return best


def _find_parting(place: Standstill, v: Array) -> tuple[str, ...]:
    """Contacts that would have to pull in a plastic impact at velocity `v`, shape (5,)."""
    try:
        impact = compute_impact(place.formation, place.touching, place.z, v)
    except np.linalg.LinAlgError:
        return ()
    return tuple(h.name for h in impact.violations if h.kind is ViolationKind.PULL)


def maximise_margin(
    limits: Array, rows: Array, bounds: Array | None = None
) -> tuple[Array, float] | None:
    """Torques up to `limits`, (2,), with the largest margin m <= 1000, and m; None without any.

    They keep rows @ (1, tau) >= m and bounds @ (1, tau) >= 0, of shapes (k, 3) and (l, 3).
    """
    from scipy.optimize import linprog

    sides = np.vstack([rows, np.zeros((0, 3)) if bounds is None else bounds])
    sides = np.column_stack([sides, np.arange(len(sides)) < len(rows)])
    sides /= np.abs(sides).max(axis=1)[:, None]
    answer: Any = linprog(
        [0.0, 0.0, -1.0],
        A_ub=sides[:, 1:] * [-1.0, -1.0, 1.0],
        b_ub=sides[:, 0],
        bounds=[*((-most, most) for most in limits.tolist()), (None, 1e3)],
    )
    return (answer.x[:2], float(answer.x[2])) if answer.status == 0 else None
