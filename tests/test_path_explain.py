from __future__ import annotations

import copy
import re
import tomllib
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from shipped import HEPTAGON
from wholearm.common.arrays import Array
from wholearm.common.errors import InfeasibleError, SolverError, WholearmError
from wholearm.geometry.curve import Curve
from wholearm.geometry.path_guess import load
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.data import prepare
from wholearm.planning.path_domain.explain import change_curve
from wholearm.planning.path_domain.impact_sequence import make_sequence
from wholearm.planning.path_domain.mesh import Mesh
from wholearm.planning.path_domain.plan import plan_curves, plan_path
from wholearm.planning.path_domain.sequence_plan import plan_sequence
from wholearm.planning.plan import solve
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem

INTERVALS = 15
OPTIONS = PlanOptions(intervals=INTERVALS)
FINE = PlanOptions(intervals=30)
NOTHING = "no single limit makes it feasible"
LIMITS = ("torque limit of finger 1", "torque limit of finger 2", "epsilon")
SPEEDS = ("speed limit of finger 1", "speed limit of finger 2")


def edited(limits: dict[str, float], friction: float = 0.1, viscous: float = 0.01) -> Problem:
    """The heptagon with other limits, under the names that messages have."""
    table: dict[str, Any] = copy.deepcopy(tomllib.loads(HEPTAGON.read_text(encoding="utf-8")))
    table["epsilon"] = limits.get("epsilon", 0.05)
    for key in ("palm", "finger1", "finger2"):
        table["friction"][key] = friction
    for key, finger in table["fingers"].items():
        finger["viscous"] = viscous
        for limit in ("torque", "speed"):
            name = f"{limit} limit of finger {key}"
            if name in limits:
                finger[f"{limit}_limit"] = limits[name]
    return build_problem(table)


def plan(
    problem: Problem, phase: int, explained: bool = True, options: PlanOptions = OPTIONS
) -> None:
    curve = trace_phases(problem)[phase - 1]
    plan_curves((curve,), problem.epsilon, options, (phase,), explained=explained)


def ask(problem: Problem, phase: int, options: PlanOptions = OPTIONS) -> str:
    with pytest.raises(InfeasibleError) as caught:
        plan(problem, phase, options=options)
    message = str(caught.value)
    assert message.startswith(f"phase {phase} is infeasible: ") and "\n" not in message
    return message


def read_advice(message: str) -> dict[str, float]:
    """Advised values by limit, without friction."""
    _, _, advice = message.rpartition("; ")
    if advice == NOTHING:
        return {}
    assert advice.startswith("feasible with ")
    parts = advice.removeprefix("feasible with ").split(", or ")
    found = {}
    for part in parts:
        if part.startswith("friction of "):
            continue
        match = re.fullmatch(r"(.+) = (\S+) (?:N m|N|rad/s|s) instead of (\S+)", part)
        assert match is not None, part
        found[match[1]] = float(match[2])
    return found


def is_feasible(
    limits: dict[str, float], phase: int, options: PlanOptions = OPTIONS, **others: float
) -> bool:
    try:
        plan(edited(limits, **others), phase, explained=False, options=options)
    except WholearmError:
        return False
    return True


@pytest.mark.parametrize(
    "phase, limits, wanted",
    [
        (1, {"epsilon": 1.0}, ["epsilon"]),
        (
            3,
            {"epsilon": 0.6, "speed limit of finger 1": 0.3},
            ["speed limit of finger 1", "epsilon"],
        ),
    ],
)
def test_advised_values_are_feasible_and_hardly_larger_than_needed(
    phase: int, limits: dict[str, float], wanted: list[str]
) -> None:
    """Checked by planning anew with the limit in the problem file changed."""
    advised = read_advice(ask(edited(limits), phase, FINE))
    assert list(advised) == wanted
    for name, value in advised.items():
        back = 1.03 if name == "epsilon" else 1 / 1.03
        assert (value < limits[name]) == (name == "epsilon")
        assert is_feasible(limits | {name: value}, phase, FINE)
        assert not is_feasible(limits | {name: back * value}, phase, FINE)


@pytest.mark.parametrize(
    "phase, limits",
    [
        (1, {"epsilon": 0.05}),
        (4, {"torque limit of finger 1": 0.3, "torque limit of finger 2": 0.05}),
    ],
)
def test_where_nothing_is_advised_nothing_helps(phase: int, limits: dict[str, float]) -> None:
    """Not even a hundred times the torque, or no force at all."""
    friction = 0.3 if phase == 1 else 0.1
    assert read_advice(ask(edited(limits, friction), phase)) == {}
    for name in LIMITS:
        generous = 0.0 if name == "epsilon" else 300.0
        assert not is_feasible(limits | {name: generous}, phase, friction=friction)


def relax_by_linear_program(curve: Curve, epsilon: float, name: str) -> float | None:
    """The value at which one limit lets all others be kept at the nodes, without viscous drag.

    Then everything is linear in a, b and the squeeze at the nodes.
    """
    data = prepare(curve, epsilon, Mesh().make_grid(curve, INTERVALS // 4), 1)
    nodes, n_c = len(data.grid.s), 4
    forces, steps = data.nodes.forces, data.grid.steps
    assert not forces.Tv.any()
    last = 3 * nodes
    rows: list[Array] = []
    right: list[Array] = []
    tau_limit = data.torque_limit
    relaxed = np.zeros((nodes, last + 1))
    relaxed[:, last] = 1.0

    def write(of_a: Array, of_b: Array, of_squeeze: Array) -> Array:
        """Rows of one force or torque, one for each node."""
        parts = [np.diag(part) for part in (of_a, of_b, of_squeeze)]
        return np.hstack([*parts, np.zeros((nodes, 1))])

    for i in range(n_c):
        # c_n >= epsilon, or what epsilon is relaxed to.
        give = name == "epsilon"
        row = write(forces.Ca[:, i], forces.Cb[:, i], forces.Cl[:, i])
        rows.append(give * relaxed - row)
        right.append(forces.C0[:, i] - (not give) * epsilon)
    for i in range(2):
        give = name == f"torque limit of finger {i + 1}"
        row = write(forces.Ta[:, i], forces.Tb[:, i], forces.Tl[:, i])
        high = (not give) * tau_limit[i]
        rows += [row - give * relaxed, -row - give * relaxed]
        right += [high - forces.T0[:, i], high + forces.T0[:, i]]
    equal = np.zeros((nodes + 1, last + 1))
    for k, step in enumerate(steps):
        equal[k, [k, k + 1]] = -step
        equal[k, [nodes + k, nodes + k + 1]] = -1.0, 1.0
    equal[nodes - 1, [0, 1]] = -1.0, 1.0
    equal[nodes, [nodes - 2, nodes - 1]] = -1.0, 1.0
    free_range: Any = (None, None)
    rest: Any = (0.0, 0.0)
    b_range = [rest, *[(0.0, None)] * (nodes - 2), rest]
    sign = -1.0 if name == "epsilon" else 1.0
    result = linprog(
        sign * np.eye(last + 1)[last],
        A_ub=np.vstack(rows),
        b_ub=np.concatenate(right),
        A_eq=equal,
        b_eq=np.zeros(nodes + 1),
        bounds=[free_range] * nodes + b_range + [free_range] * nodes + [(0.0, None)],
    )
    return float(result.x[last]) if result.success else None


@pytest.mark.parametrize(
    "phase, limits",
    [
        (1, {"epsilon": 1.0}),
        (4, {"torque limit of finger 1": 0.3}),
        (4, {"torque limit of finger 1": 0.7, "epsilon": 0.4}),
        (4, {"torque limit of finger 1": 0.3, "torque limit of finger 2": 0.05}),
    ],
)
def test_advice_is_that_of_a_linear_program(phase: int, limits: dict[str, float]) -> None:
    problem = edited(limits, viscous=0.0)
    advised = read_advice(ask(problem, phase))
    curve = trace_phases(problem)[phase - 1]
    exact = {name: relax_by_linear_program(curve, problem.epsilon, name) for name in LIMITS}
    assert set(advised) == {name for name, value in exact.items() if value is not None}
    for name, value in advised.items():
        least = exact[name]
        assert least is not None
        # Rounded outwards, with some room for what is between nodes.
        if name == "epsilon":
            assert 0.97 * least <= value <= least
        else:
            assert least <= value <= 1.03 * least


def test_whole_problems_are_advised() -> None:
    with pytest.raises(
        InfeasibleError, match=r"^phase 4 is infeasible: .*; feasible with "
    ) as caught:
        solve(edited({"torque limit of finger 2": 0.05}), intervals=20)
    (name, value), *others = read_advice(str(caught.value)).items()
    assert name == "torque limit of finger 2" and not others
    assert solve(edited({name: value}), intervals=20).meta["status"] == "solved"


def test_phases_that_impacts_join_are_advised_together() -> None:
    problem = load(str(HEPTAGON.with_name("heptagon_impact.toml")))
    chain = make_sequence(problem.phases, trace_phases(problem)).split()[0]
    with pytest.raises(InfeasibleError, match=r"^phases 1 to 3 are infeasible: ") as caught:
        plan_sequence(chain, 1.0, OPTIONS)
    (value,) = read_advice(str(caught.value)).values()
    assert all(plan.motion.duration > 0 for plan in plan_sequence(chain, value, OPTIONS))
    with pytest.raises(InfeasibleError):
        plan_sequence(chain, 1.03 * value, OPTIONS)
    # Where only the fact counts, no time is spent on advice.
    with pytest.raises(SolverError, match=r"^phases 1 to 3: Ipopt stopped with "):
        plan_sequence(chain, 1.0, OPTIONS, explained=False)


@pytest.mark.parametrize("duration", [0.05, 0.1])
def test_too_short_a_duration_is_named(curves: tuple[Curve, ...], duration: float) -> None:
    options = PlanOptions("margin", intervals=INTERVALS)
    least = plan_path(curves[0], 0.05, OPTIONS, 1).value
    with pytest.raises(
        InfeasibleError, match=f"^phase 1 is infeasible: duration = {duration:g} s is"
    ) as caught:
        plan_path(curves[0], 0.05, options, 1, duration)
    advised = read_advice(str(caught.value))
    assert list(advised) == ["duration"] and least <= advised["duration"] < 1.03 * least
    assert plan_path(curves[0], 0.05, options, 1, advised["duration"]).value >= 0.05


def test_a_duration_for_all_phases_is_advised() -> None:
    problem = edited({})
    with pytest.raises(InfeasibleError, match=r"^duration = 0\.3 s is not longer") as caught:
        solve(problem, objective="margin", duration=0.3, intervals=20)
    value = read_advice(str(caught.value))["duration"]
    longer = solve(problem, objective="margin", duration=value, intervals=20)
    assert longer.duration <= value * (1 + 1e-6)


def test_changing_one_limit_leaves_everything_else(curves: tuple[Curve, ...]) -> None:
    curve = curves[0]
    other = change_curve(curve, "fingers.2.torque_limit", 3.5)
    scene, changed = curve.formation.scene, other.formation.scene
    np.testing.assert_array_equal(changed.torque_limit, [2.0, 3.5])
    np.testing.assert_array_equal(scene.torque_limit, [2.0, 2.0])
    np.testing.assert_array_equal(
        change_curve(curve, "fingers.1.speed_limit", 3.0).formation.scene.speed_limit, [3.0, np.inf]
    )
    assert changed.fingers[0] is scene.fingers[0] and changed.polygon is scene.polygon
    assert other.formation.names == curve.formation.names and other.panels is curve.panels
