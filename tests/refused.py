"""Why problems with other limits have no plan, each of them asked for once."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from once import once
from scenes import shove
from shipped import HEPTAGON, problem_of
from wholearm import PlanOptions, Problem
from wholearm.common.errors import InfeasibleError, Parameter
from wholearm.geometry.tracing import trace_phases
from wholearm.planning import explain
from wholearm.planning.explain import FRICTION, change_limit
from wholearm.planning.path_domain.path_plan import Task, plan_curves
from wholearm.planning.time_domain.time_plan import plan_phases

INTERVALS = 15
OPTIONS = PlanOptions(intervals=INTERVALS)


def edited(limits: dict[str, float], friction: float = 0.1, viscous: float = 0.01) -> Problem:
    """The heptagon with other limits, under the names that messages have."""

    def key(name: str) -> str:
        what, _, finger = name.partition(" limit of finger ")
        return f"fingers.{finger}.{what}_limit" if finger else name

    changes = {key(name): value for name, value in limits.items()}
    return problem_of(HEPTAGON).with_(changes, friction=friction, viscous=viscous)


def plan(problem: Problem, phase: int, explained: bool = True) -> None:
    curve = trace_phases(problem)[phase - 1]
    plan_curves(Task((curve,), problem.epsilon, OPTIONS, (phase,)), explained)


@contextmanager
def advising(wanted: Callable[[Parameter], bool]) -> Iterator[None]:
    """Changes of such parameters are looked for, and of no others, which takes long."""
    find = explain.find_changes
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            explain, "find_changes", lambda every, *rest: find(filter(wanted, every), *rest)
        )
        yield


@once
def ask(phase: int, friction: float = 0.1, viscous: float = 0.01, **limits: float) -> str:
    """Why a phase has no plan with such `limits`, and what is advised but for frictions."""
    frictionless = advising(lambda own: not own.key.startswith(FRICTION))
    with frictionless, pytest.raises(InfeasibleError) as caught:
        plan(edited(limits, friction, viscous), phase)
    message = str(caught.value)
    assert message.startswith(f"phase {phase} is infeasible: ") and "\n" not in message
    return message


@once
def ask_shoved(key: str, value: float) -> InfeasibleError:
    """Why the square is not shoved with another value of a limit, however long advice takes."""
    problem = change_limit(shove()[0], key, value)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(InfeasibleError) as caught:
        patch.setattr(explain, "ADVICE", math.inf)
        plan_phases(problem, problem.phases, problem.start, PlanOptions(time_intervals=4))
    return caught.value


def read_advice(message: str) -> dict[str, float]:
    """Advised values by limit."""
    _, _, advice = message.rpartition("; ")
    if advice == "no single limit makes it feasible":
        return {}
    assert advice.startswith("feasible with ")
    parts = advice.removeprefix("feasible with ").split(", or ")
    found = {}
    for part in parts:
        match = re.fullmatch(r"(.+) = (\S+) (?:N m|N|rad/s|s) instead of (\S+)", part)
        assert match is not None, part
        found[match[1]] = float(match[2])
    return found
