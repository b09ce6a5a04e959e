"""Up to which speed contacts hold along a phase, and which goes first."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..mechanics.limits import SPEED
from .road import Road

_SPEEDS = np.geomspace(1e-2, 1e2, 49)
"""Speeds at which a break is looked for, over the scene's speed."""
_HALVINGS = 24
"""Steps of bisection."""


class Least(NamedTuple):
    """What presses least along a phase at one speed.

    Attributes
    ----------
    force : float, [N]
        The least normal force, or for a rolling contact the epsilon that its cone leaves; minus
        infinity where other limits are missed whatever the squeeze.
    place : int
        Row of the road.
    limits : tuple of int
        What keeps it from being more, as indices into the limits of the road.
    """

    force: float
    place: int
    limits: tuple[int, ...]


Look = Callable[[float], Least]
"""What presses least at a speed [m/s]."""


class Break(NamedTuple):
    """The speed up to which contacts press with some force [N].

    Attributes
    ----------
    speed : float, [m/s]
        Zero where they do not at any speed near rest; infinite if they do at any.
    least : Least
        What is there at a speed just above, or at that of zero.
    again : float, [m/s]
        Where it is zero, the speed from which on they press; infinite if there is none.
    """

    speed: float
    least: Least
    again: float


class Pace(NamedTuple):
    """A motion along a phase whose largest speed is one: a = s'' and b = s'^2, shape (n,) each.

    Attributes
    ----------
    a : ndarray, shape (n,), [1/m]
    b : ndarray, shape (n,)
    way : float, [m]
        Duration times the largest speed.
    """

    a: Array
    b: Array
    way: float

    @staticmethod
    def steady(road: Road) -> Pace:
        """At one speed throughout."""
        return Pace(np.zeros_like(road.s), np.ones_like(road.s), road.length)

    @staticmethod
    def between(road: Road, rests: tuple[bool, bool]) -> Pace:
        """From rest or not, to rest or not: a cosine of time from rest to rest.

        With one end at rest s'' is constant, with none the speed is.
        """
        x, length = road.s / road.length, road.length
        if rests == (True, True):
            return Pace(2 * (1 - 2 * x) / length, 4 * x * (1 - x), np.pi / 2 * length)
        if not any(rests):
            return Pace.steady(road)
        sign = 1.0 if rests[0] else -1.0
        return Pace(np.full_like(x, sign / (2 * length)), x if rests[0] else 1 - x, 2 * length)


def look_along(road: Road, pace: Pace) -> Look:
    """What presses least along a road with the best squeeze at each place."""

    def look(speed: float) -> Least:
        grasp = road.squeezing.find_best(speed**2 * pace.a, speed**2 * pace.b)
        least = np.where(road.inertia > 0, grasp.least, -np.inf)
        place = int(least.argmin())
        owners = grasp.owners[place].tolist() if road.inertia[place] > 0 else []
        return Least(float(least[place]), place, tuple(owners))

    return look


def look_under(road: Road, tau: Array) -> Look:
    """What presses least under given torques, shape (n, 2) [N m], at a steady speed."""
    limits = road.squeezing.limits
    of_c, _, of_rates = limits.columns
    owners, soft = limits.owners, limits.of("press", "cone")
    weights = np.concatenate([limit.weight for limit in limits.limits])
    fast = limits.of(SPEED)

    def look(speed: float) -> Least:
        c = road.press_under(tau, speed)
        force = (c @ of_c.T)[:, soft] / weights[soft]
        rates = np.abs(speed * road.z_s[:, 3:] @ of_rates[fast].T)
        over = (rates > limits.high[fast]).any(axis=1)
        force[over] = -np.inf
        place, row = np.unravel_index(int(force.argmin()), force.shape)
        return Least(float(force[place, row]), int(place), (int(owners[soft[row]]),))

    return look


def find_break(look: Look, wanted: float, unit: float, above: float = 0.0) -> Break:
    """The least speed at which less than a `wanted` force [N] is left.

    Parameters
    ----------
    look : callable
    wanted : float, [N]
    unit : float, [m/s]
        The scene's speed.
    above : float, [m/s]
        Speed up to which more than that is known to be left, if it is at rest.
    """
    start, low = look(0.0), above
    holds = start.force >= wanted
    for high in (unit * _SPEEDS[unit * _SPEEDS > above]).tolist():
        least = look(high)
        if (least.force >= wanted) != holds:
            break
        low = high
    else:
        return Break(np.inf, start, 0.0) if holds else Break(0.0, start, np.inf)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        found = look(middle)
        if (found.force >= wanted) == holds:
            low = middle
        else:
            high, least = middle, found
    return Break(high, least, 0.0) if holds else Break(0.0, start, high)
