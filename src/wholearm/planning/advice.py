"""Why there is no plan, and which single change would make one possible: ranking and wording.

Nothing here depends on how plans are made. A planner says what its limits miss, which limits could
give way, how far each would have to, and whether it can plan with that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple

DIGITS = 3
"""Significant digits of what is advised."""
_BEYOND = (0.0, 0.005, 0.015, 0.05, 0.15, 0.5)
"""How far beyond the least change to try, relatively: plans keep limits between nodes too."""
_CLOSE = 0.02
"""How much more than needed is good enough, relatively."""


class Shortfall(NamedTuple):
    """A limit that cannot be kept.

    Attributes
    ----------
    limit : str
        The limit in words, with its value.
    amount : float
        By how much it is missed at worst.
    unit : str
    where : str
        Time, and place or phase, of that.
    share : float
        The amount over what is much for such a limit, which shortfalls are ranked by.
    """

    limit: str
    amount: float
    unit: str
    where: str
    share: float

    def __str__(self) -> str:
        return f"{self.limit} is {self.amount:.3g} {self.unit} short at {self.where}"


class Limit(NamedTuple):
    """A limit that could give way.

    Attributes
    ----------
    name : str
    value : float
        As it is.
    unit : str
    sign : int
        1 if it gives way by growing, -1 if by falling (not below zero).
    """

    name: str
    value: float
    unit: str
    sign: int


class Change(NamedTuple):
    """A limit and a value of it that a plan was found with."""

    limit: Limit
    value: float

    def __str__(self) -> str:
        limit = self.limit
        value = f"{self.value:g} {limit.unit}".rstrip()
        return f"{limit.name} = {value} instead of {limit.value:g}"


def rank_shortfalls(shortfalls: Iterable[Shortfall]) -> str:
    """All shortfalls in one line, the worst first."""
    return "; ".join(map(str, sorted(shortfalls, key=lambda short: -short.share)))


def find_changes(
    limits: Sequence[Limit],
    find_least: Callable[[int], float | None],
    can_plan: Callable[[int, float], bool],
) -> list[Change]:
    """Find the changes of a single limit with which there is a plan.

    Parameters
    ----------
    limits : sequence of Limit
    find_least : callable
        The value at which the i-th limit just lets the others be kept, or None if none does.
    can_plan : callable
        Whether there is a plan with this value of the i-th limit.

    Returns
    -------
    list of Change
        Each with a value, rounded outwards, that `can_plan` has confirmed.
    """
    changes = []
    for index, limit in enumerate(limits):
        least = find_least(index)
        if least is None:
            continue
        value = _find_enough(least, limit.sign, partial(can_plan, index))
        if value is not None:
            changes.append(Change(limit, value))
    return changes


def bracket(
    limit: Limit, farthest: float, can_plan: Callable[[float], bool], halvings: int = 5
) -> float | None:
    """A value that can be planned with, between a limit and `farthest`, as near to it as found.

    For limits that a planner cannot relax within one solve; None if `farthest` does not do.
    """
    if farthest == limit.value or not can_plan(farthest):
        return None
    enough, short = farthest, limit.value
    for _ in range(halvings):
        middle = round_outwards((enough + short) / 2, limit.sign)
        if middle in (enough, short):
            break
        if can_plan(middle):
            enough = middle
        else:
            short = middle
    return enough


def _find_enough(least: float, sign: int, can_plan: Callable[[float], bool]) -> float | None:
    """A rounded value that can be planned with, as little beyond `least` as plans allow."""
    failed: float | None = None
    tried = (round_outwards(least * (1 + sign * beyond), sign) for beyond in _BEYOND)
    for value in dict.fromkeys(tried):
        if value < 0:
            return None
        if can_plan(value):
            break
        failed = value
    else:
        return None
    while failed is not None and abs(value - failed) > _CLOSE * abs(value):
        middle = round_outwards((value + failed) / 2, sign)
        if can_plan(middle):
            value = middle
        else:
            failed = middle
    return value


def describe_changes(changes: Sequence[Change]) -> str:
    """All changes in one line."""
    if not changes:
        return "no single limit makes it feasible"
    return f"feasible with {', or '.join(map(str, changes))}"


def round_outwards(value: float, sign: int, digits: int = DIGITS) -> float:
    """Round to significant digits, up for the sign 1 and down for -1."""
    if value == 0 or not math.isfinite(value):
        return value
    place = digits - 1 - math.floor(math.log10(abs(value)))
    # What already has so few digits stays, whatever its last bits are.
    scaled = round(value * 10.0**place, 6)
    whole = math.ceil(scaled) if sign > 0 else math.floor(scaled)
    return float(f"{whole}e{-place}")
