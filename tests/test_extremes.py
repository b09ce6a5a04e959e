"""Scenes at the ends of their ranges are planned, or refused with a reason; nothing warns."""

from __future__ import annotations

import copy
import re
from typing import Any

import pytest

from shipped import HEPTAGON
from wholearm.common.errors import InfeasibleError, JammingError
from wholearm.geometry.path_guess import load
from wholearm.planning.plan import solve
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem
from wholearm.verification.verify import verify

TABLE = dict(load(str(HEPTAGON)).table)


def edited(friction: dict[str, float] | None = None, **joints: float) -> Problem:
    """The first phase of the heptagon with other numbers, those of joints or at the top."""
    table: dict[str, Any] = copy.deepcopy(TABLE)
    table["phases"] = table["phases"][:1]
    table["friction"] |= friction or {}
    for key, value in joints.items():
        for part in (table,) if key in table else table["fingers"].values():
            part[key] = value
    return build_problem(table)


@pytest.mark.parametrize(
    "joints",
    [
        {"viscous": 16.0},
        {"speed_limit": 0.1},
        {"inertia": 1e-9, "viscous": 0.0},
        {"torque_limit": 350.0},
        {"gravity": 100.0, "torque_limit": 20.0},
    ],
    ids=str,
)
def test_extreme_scenes_are_planned(joints: dict[str, Any]) -> None:
    problem = edited(**joints)
    # Links a thousand times as heavy let other contact forces be possible than the planned ones.
    plan = solve(problem, intervals=20, replay=False, uniqueness_margin=-5.0)
    report = verify(problem, plan, uniqueness_margin=-5.0)
    assert report.ok, report.failures


def test_strong_drag_bounds_the_speed() -> None:
    """Ten times the drag takes ten times as long: inertia does not matter any more."""
    slow, slower = (solve(edited(viscous=drag), replay=False).value for drag in (2.3, 23.0))
    assert slower / slow == pytest.approx(10.0, rel=1e-2)


@pytest.mark.usefixtures("unadvised")
def test_dry_friction_above_the_torque_limit_is_named() -> None:
    with pytest.raises(InfeasibleError, match=r"torque limit of finger \d = 2 N m is .* short"):
        solve(edited(dry=3.0), intervals=10)


def test_friction_is_advised_where_it_is_the_cause(request: pytest.FixtureRequest) -> None:
    """Each advised value does, and one halfway back to what is given does not."""
    rough = {"palm": 0.35, "finger1": 0.35, "finger2": 0.35}
    with pytest.raises(InfeasibleError, match="feasible with friction of palm = ") as caught:
        solve(edited(rough), intervals=10)
    advised = re.findall(r"friction of (\w+)( \d)? = ([\d.]+) instead of 0.35", str(caught.value))
    assert advised
    request.getfixturevalue("unadvised")
    for part, number, value in advised:
        key = part + number.strip()
        solve(edited(rough | {key: float(value)}), intervals=10, replay=False)
        with pytest.raises(InfeasibleError):
            solve(edited(rough | {key: (float(value) + 0.35) / 2}), intervals=10)


def test_jamming_says_which_friction_to_lower() -> None:
    rough = {"palm": 3.0, "finger1": 0.3, "finger2": 0.3}
    with pytest.raises(JammingError, match=r"jams at .*; feasible with friction of palm = ") as jam:
        solve(edited(rough), intervals=10)
    found = re.search(r"friction of palm = ([\d.]+) instead of 3", str(jam.value))
    assert found is not None
    (change,) = jam.value.changes
    assert change.parameter.key == "friction.palm" and str(change) in str(jam.value)
    solve(edited(rough | {"palm": float(found[1])}), intervals=10, replay=False)
