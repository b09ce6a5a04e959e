from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from refused import INTERVALS, OPTIONS, ask, edited, plan, read_advice
from shipped import IMPACTS, problem_of
from wholearm.common.arrays import Array
from wholearm.common.errors import InfeasibleError, SolverError, WholearmError
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import LAMBDA, ONE, A, B, V
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.impact_sequence import make_sequence, plan_sequence
from wholearm.planning.path_domain.path_data import prepare
from wholearm.planning.path_domain.path_mesh import Mesh
from wholearm.planning.path_domain.path_plan import plan_path

LIMITS = ("torque limit of finger 1", "torque limit of finger 2", "epsilon")


def is_feasible(limits: dict[str, float], phase: int, friction: float = 0.1) -> bool:
    try:
        plan(edited(limits, friction), phase, explained=False)
    except WholearmError:
        return False
    return True


def test_advised_values_are_feasible_and_hardly_larger_than_needed() -> None:
    """Checked by planning anew with the limit in the problem file changed."""
    name = "torque limit of finger 1"
    limits = {"epsilon": 0.6, name: 0.3}
    advised = read_advice(ask(3, **limits))
    assert list(advised) == [name, "epsilon"] and advised[name] > limits[name]
    assert is_feasible(limits | {name: advised[name]}, 3)
    assert not is_feasible(limits | {name: advised[name] / 1.03}, 3)


def test_where_nothing_is_advised_nothing_helps() -> None:
    """Not even a hundred times the torque, or no force at all."""
    limits = {"epsilon": 0.05}
    assert read_advice(ask(1, 0.3, **limits)) == {}
    for name in LIMITS:
        generous = 0.0 if name == "epsilon" else 300.0
        assert not is_feasible(limits | {name: generous}, 1, 0.3)


def relax_by_linear_program(curve: Curve, epsilon: float, name: str) -> float | None:
    """The value at which one limit lets all others be kept at the nodes, without viscous drag.

    Then everything is linear in a, b and the squeeze at the nodes.
    """
    data = prepare(curve, epsilon, Mesh().make_grid(curve, INTERVALS // 4), 1)
    nodes, n_c = len(data.grid.s), 4
    forces, steps = data.nodes.forces, data.grid.steps
    assert not forces.of_tau[..., V].any()
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
        row = write(forces.of_c[:, i, A], forces.of_c[:, i, B], forces.of_c[:, i, LAMBDA])
        rows.append(give * relaxed - row)
        right.append(forces.of_c[:, i, ONE] - (not give) * epsilon)
    for i in range(2):
        give = name == f"torque limit of finger {i + 1}"
        row = write(forces.of_tau[:, i, A], forces.of_tau[:, i, B], forces.of_tau[:, i, LAMBDA])
        high = (not give) * tau_limit[i]
        rows += [row - give * relaxed, -row - give * relaxed]
        right += [high - forces.of_tau[:, i, ONE], high + forces.of_tau[:, i, ONE]]
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
    advised = read_advice(ask(phase, viscous=0.0, **limits))
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


def test_phases_that_impacts_join_are_advised_together() -> None:
    problem = problem_of(IMPACTS)
    chain = make_sequence(problem.phases, trace_phases(problem)).split()[0]
    with pytest.raises(InfeasibleError) as caught:
        plan_sequence(chain, 1.0, OPTIONS)
    found = re.match(
        r"phases 1 to 3 are infeasible: c_n of (\S+) >= epsilon = 1 N is \S+ N short at "
        r"t = \d\.\d{4} s \(x = .*? mm, phi = .*? deg\), phase ([123])",
        str(caught.value),
    )
    assert found is not None, str(caught.value)
    assert found[1] in chain.phases[int(found[2]) - 1].formation.names
    (value,) = read_advice(str(caught.value)).values()
    assert all(plan.motion.duration > 0 for plan in plan_sequence(chain, value, OPTIONS))
    # Where only the fact counts, no time is spent on advice.
    with pytest.raises(SolverError, match=r"^phases 1 to 3: Ipopt stopped with "):
        plan_sequence(chain, 1.03 * value, OPTIONS, explained=False)


def test_too_short_a_duration_is_named(curves: tuple[Curve, ...]) -> None:
    duration = 0.1
    options = PlanOptions("margin", intervals=INTERVALS)
    least = plan_path(curves[0], 0.05, OPTIONS, 1).value
    with pytest.raises(
        InfeasibleError, match=f"^phase 1 is infeasible: duration = {duration:g} s is"
    ) as caught:
        plan_path(curves[0], 0.05, options, 1, duration)
    advised = read_advice(str(caught.value))
    assert list(advised) == ["duration"]
    # Both solves are good to 1e-6.
    assert least * (1 - 1e-6) < advised["duration"] < 1.03 * least
    assert plan_path(curves[0], 0.05, options, 1, advised["duration"]).value > 0.05 * (1 - 1e-6)
