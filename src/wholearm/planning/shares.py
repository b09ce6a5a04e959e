"""Time for held ends that is shared out among them, as a share of the motion's.

Contacts that are gained first are as far open as the start is off, or farther; those after them are
hardly open any more, if the first ones have closed. An end where no contact is gained has only to
stop. How well that goes, in a whole plan by the clock, hangs on impacts that no rule foretells: a
few ways to share are tried, from starts that are off to either side, free of assumptions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import WholearmError
from ..contacts.closing import close_finger
from ..free_simulation.simulate import simulate_free
from ..mechanics.arrival import find_opening
from ..problem.definition import Problem
from ..results.torque import TorqueProfile
from .settling import End, find_ends, find_places, hold_plans
from .stops import Plans, end_of


class Way(NamedTuple):
    """A way to share time: what ends have that gain a contact, over most others of them.

    Attributes
    ----------
    first : int
        How many of the first have more, or less.
    more : float
        What they have.
    last : float
        What the plan's last end has.
    firm : bool
        Whether torques are the firmest ones, whether or not they drive on what is still open.
    """

    first: int
    more: float
    last: float
    firm: bool = False


WAYS = (
    Way(1, 2.0, 1.0, firm=True),
    Way(1, 0.0, 0.0, firm=True),
    Way(1, 2.0, 1.0),
    Way(2, 3.5, 1.0),
    Way(2, 2.0, 1.0),
    Way(1, 0.0, 0.0),
)
"""Ways to share that are tried, in this order, until a plan ends no farther off than its start."""
STOP = 0.06
"""Time for an end where nothing has to close, over that for a contact."""
BETTER = 0.8
"""How far off another way's end may be to be better, over that of the best one before."""


def share_time(problem: Problem, plans: Plans) -> list[End | None]:
    """How each end is held: the way to share time that ends best is taken.

    The first one whose plan's end is no farther off than `problem.gap`, simulated by the clock from
    the exact start and from starts moved along the palm by that to either side, or the best one.
    """
    best, least = list[End | None](), math.inf
    for way in WAYS:
        ends = find_ends(problem, plans, _share(problem, plans, way), way.firm)
        off = measure_off(problem, plans, ends) if any(ends) else 0.0
        if not best or off < BETTER * least:
            best, least = ends, off
        if least <= problem.gap:
            break
    return best


def _share(problem: Problem, plans: Plans, way: Way) -> list[float]:
    """For how long ends are held if time is shared in a way [s]."""
    times = [problem.settles(phase) for phase in problem.phases]
    weights, gained = np.zeros(len(times)), 0
    for k, place in enumerate(find_places(problem, plans)):
        if place is None or times[k] is not None:
            continue
        closes = find_opening(place) is not None
        weights[k] = (way.more if gained < way.first else 1.0) if closes else STOP
        gained += closes
    if gained > way.first:
        weights[-1] *= way.last
    whole = problem.settle_share * sum(plan.motion.duration for plan in plans)
    shares = whole * weights / max(float(weights.sum()), STOP**2)
    return [own if time is None else time for own, time in zip(shares.tolist(), times, strict=True)]


def measure_off(problem: Problem, plans: Plans, ends: Sequence[End | None]) -> float:
    """How far off plans end at most [m] with ends held, turns counting by the scene's length."""
    torque = TorqueProfile.chain([plan.torque for plan in hold_plans(problem, plans, ends)])
    goal, length = end_of(plans[-1])[0], problem.scene.scales.length
    most = 0.0
    for off in (0.0, problem.gap, -problem.gap):
        try:
            z = simulate_free(problem, torque, start=move_start(problem, off)).z[-1]
        except (WholearmError, ArithmeticError):
            return math.inf
        most = max(most, float(np.linalg.norm((z - goal)[:3] * [1.0, 1.0, length])))
    return most


def move_start(problem: Problem, off: float) -> Array | None:
    """The start moved along the palm by `off` [m], with the fingers closed; None for none."""
    if not off:
        return None
    q = problem.start[:3] + np.array([off, 0.0, 0.0])
    return np.array([*q, *(close_finger(problem.scene, q, finger) for finger in (0, 1))])
