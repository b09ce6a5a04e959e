"""Violated limits of infeasible problems, and changes of a single parameter that are feasible.

A planner supplies the motion of least violation, a value of each parameter at which it vanishes,
and whether it can plan with a value; the value is rounded outwards and confirmed by a plan.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from ..common.arrays import Array
from ..common.document import plain
from ..common.errors import (
    Change,
    InfeasibleError,
    InputError,
    JammingError,
    LimitPlace,
    Parameter,
    Shortfall,
    SolverError,
)
from ..contacts.formation import Formation
from ..mechanics.limits import LimitSet
from ..results.dwell_record import assemble
from ..results.torque import TorqueProfile
from ..results.trajectory import Motion, Trajectory
from ..scene.model import Scene

SHORT = 1e-4  # least violation that counts, over the scale of a limit
ROWS = 201  # rows of each phase of a motion of least violation
DIGITS = 3  # significant digits of advised values
_BEYOND = (0.0, 0.005, 0.015, 0.05, 0.15, 0.5)
"""Relative distances beyond the least change to try: plans keep limits between nodes too."""
_CLOSE = 0.02  # relative excess over the least change that is good enough
_unadvised: ContextVar[bool] = ContextVar("_unadvised", default=False)


@contextmanager
def unadvised() -> Iterator[None]:
    """Have errors say what is missing without looking for changes that would help."""
    token = _unadvised.set(True)
    try:
        yield
    finally:
        _unadvised.reset(token)


class Advice(NamedTuple):
    """Why there is no plan, in words, and the changes with which there would be one."""

    text: str
    changes: tuple[Change, ...]


def list_shortfalls(
    limits: LimitSet, values: Array, locate: Callable[[int], LimitPlace]
) -> list[Shortfall]:
    """Violations of limits, each where it is worst, from values of their rows, (n, m).

    `locate` gives the k-th of the n places.
    """
    violation, shortfalls = limits.fold(-limits.find_slack(values)), []
    for k, limit in enumerate(limits.limits):
        of_limit = violation[:, limits.owners == k].max(axis=1)
        worst = int(of_limit.argmax())
        amount = float(of_limit[worst])
        if amount > SHORT * limit.scale:
            what = (limit.kind, limit.part, limit.text, amount, limit.unit)
            shortfalls.append(Shortfall(*what, locate(worst), amount / limit.scale))
    return shortfalls


def assemble_least(
    motions: Sequence[Motion], torques: Sequence[TorqueProfile], formations: Sequence[Formation]
) -> Trajectory:
    """The trajectory of a motion of least violation."""
    meta = {
        "status": "misses limits least",
        "rolling": [[contact.name for contact in own.rolling] for own in formations],
        "modes": plain([getattr(own, "modes", ()) for own in motions]),
    }
    return assemble(motions, TorqueProfile.chain(torques), meta, ROWS)


def keep_worst(shortfalls: Iterable[Shortfall]) -> list[Shortfall]:
    """Of several violations of one limit, the largest."""
    worst: dict[str, Shortfall] = {}
    for short in shortfalls:
        worst[short.limit] = max(worst.get(short.limit, short), short, key=lambda s: s.amount)
    return list(worst.values())


def name_phases(phases: Sequence[int], what: str = "") -> str:
    """One phase or several, for messages, and that they are `what`."""
    first, *others = phases
    if not others:
        return f"phase {first} is {what}" if what else f"phase {first}"
    several = f"phases {first} {'and' if len(others) == 1 else 'to'} {others[-1]}"
    return f"{several} are {what}" if what else several


def advise(
    text: str,
    parameters: Iterable[Parameter],
    find_value: Callable[[Parameter], float | None],
    replan: Callable[[Parameter, float], object] | None,
    seconds: float = math.inf,
) -> Advice:
    """Text of an error with the changes of a single parameter that make a plan possible.

    Parameters
    ----------
    text           the violated limits
    find_value     as of `find_changes`; NaN where it cannot tell
    replan         plans with another value of a parameter, or raises; None: no change is looked for
    seconds : [s]  processor time after which no further change is tried
    """
    if replan is None or _unadvised.get():
        return Advice(text, ())
    stop, undecided = time.thread_time() + seconds, list[Parameter]()

    def find(parameter: Parameter) -> float | None:
        least = math.nan if time.thread_time() > stop else find_value(parameter)
        if least is not None and math.isnan(least):
            undecided.append(parameter)
            return None
        return least

    def can_plan(parameter: Parameter, value: float) -> bool:
        if time.thread_time() > stop:
            undecided.append(parameter)
            return False
        return succeeds(partial(replan, parameter, value))

    changes = find_changes(parameters, find, can_plan)
    if undecided and not changes:
        return Advice(f"{text}; no single limit was found that makes it feasible", ())
    return Advice(f"{text}; {describe_changes(changes)}", tuple(changes))


def succeeds(plan: Callable[[], object]) -> bool:
    """Whether there is a plan."""
    try:
        plan()
    except (InfeasibleError, SolverError, JammingError, InputError):
        return False
    return True


def change_scene(scene: Scene, key: str, value: float) -> Scene:
    """The scene with another value of a parameter, such as `fingers.1.torque_limit`."""
    where, *names = key.split(".")
    if where == "friction":
        return replace(scene, friction=replace(scene.friction, **{names[0]: value}))
    change: Any = {names[1]: value}
    right, left = (
        replace(link, **change) if f"{k + 1}" == names[0] else link
        for k, link in enumerate(scene.fingers)
    )
    return replace(scene, fingers=(right, left))


def rank_shortfalls(shortfalls: Iterable[Shortfall]) -> list[Shortfall]:
    """Shortfalls, the worst first."""
    return sorted(shortfalls, key=lambda short: -short.share)


def describe_shortfalls(shortfalls: Iterable[Shortfall]) -> str:
    """All shortfalls in one line."""
    return "; ".join(map(str, shortfalls))


def find_changes(
    parameters: Iterable[Parameter],
    find_value: Callable[[Parameter], float | None],
    can_plan: Callable[[Parameter, float], bool],
) -> list[Change]:
    """Changes of a single parameter with which there is a plan, to values rounded outwards.

    Parameters
    ----------
    find_value  the value of a parameter at which the other limits can just be kept, if there is one
    can_plan    whether there is a plan with a value of a parameter
    """
    changes = []
    for parameter in parameters:
        least = find_value(parameter)
        if least is not None:
            value = _find_enough(least, parameter.sign, partial(can_plan, parameter))
            changes += [] if value is None else [Change(parameter, value)]
    return changes


def bracket(
    own: Parameter, farthest: float, can_plan: Callable[[float], bool], halvings: int = 5
) -> float | None:
    """A feasible value between a parameter's and `farthest`, by bisection; None without one."""
    if farthest == own.value or not can_plan(farthest):
        return None
    enough, short = farthest, own.value
    for _ in range(halvings):
        middle = round_outwards((enough + short) / 2, own.sign)
        if middle in (enough, short):
            break
        enough, short = (middle, short) if can_plan(middle) else (enough, middle)
    return enough


def _find_enough(least: float, sign: int, can_plan: Callable[[float], bool]) -> float | None:
    """A feasible rounded value, as little beyond `least` as plans allow, by bisection."""
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
        value, failed = (middle, failed) if can_plan(middle) else (value, middle)
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
    # Values of so few digits stay, whatever their last bits are.
    scaled = round(value * 10.0**place, 6)
    whole = math.ceil(scaled) if sign > 0 else math.floor(scaled)
    return float(f"{whole}e{-place}")
