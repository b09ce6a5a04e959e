"""Ipopt and fatrop on the same NLPs: time, iterations and the optimum, phase by phase."""

from __future__ import annotations

import statistics
import time
from typing import Any, NamedTuple

from ..curve import Curve
from ..errors import SolverError
from ..options import Objective, PlanOptions
from ..path import trace_phases
from ..pathdomain.pathdata import prepare
from ..pathdomain.pathmotion import make_grid
from ..pathdomain.pathnlp import (
    Tightening,
    build_path_nlp,
    first_multipliers,
    make_bounds,
    pack,
    parameters,
)
from ..pathdomain.pathplan import guess, plan_path
from ..problem import Problem
from .benchreport import Row

REPEATS = 3
_STUDY = "solvers"


class _Result(NamedTuple):
    seconds: float
    note: str
    solved: bool


def measure_solvers(problem: Problem) -> list[Row]:
    """Plan every phase for least time and least effort with both solvers.

    The time is that of planning with the NLP built. The error is the relative difference of the
    optimum of the NLP, as it is solved first, from Ipopt's.
    """
    rows = []
    for objective in ("time", "effort"):
        for phase, curve in zip(problem.phases, trace_phases(problem), strict=True):
            setting = f"phase {phase.number}, {objective}"
            ipopt, fatrop = (
                _measure(problem, curve, phase.number, PlanOptions(objective, solver=solver))
                for solver in ("ipopt", "fatrop")
            )
            exact, same = (
                _find_optimum(problem, curve, objective, solver) for solver in ("ipopt", "fatrop")
            )
            quicker = fatrop.solved and fatrop.seconds < ipopt.seconds
            error = same / exact - 1 if fatrop.solved else None
            for name, result, is_faster in (
                ("Ipopt", ipopt, not quicker),
                ("fatrop", fatrop, quicker),
            ):
                note = f"{result.note}{', faster' if is_faster and fatrop.solved else ''}"
                difference = error if name == "fatrop" else None
                rows.append(Row(_STUDY, name, setting, result.seconds, difference, note))
    return rows


def _measure(problem: Problem, curve: Curve, phase: int, options: PlanOptions) -> _Result:
    formation = curve.formation
    sizes = (formation.n_contacts, options.intervals, options.goal, formation.n_rolling)
    build_path_nlp(*sizes, options.solver)
    seconds, note, solved = [], "", True
    for _ in range(REPEATS):
        started = time.perf_counter()
        try:
            plan = plan_path(curve, problem.epsilon, options, phase)
            note, solved = f"{plan.iterations} iterations in {plan.solves} solves", True
            if plan.solver != options.solver:
                note, solved = f"does not converge: {plan.solver} plans instead", False
        except SolverError as error:
            note, solved = f"does not converge: {error}", False
        seconds.append(time.perf_counter() - started)
    return _Result(statistics.median(seconds), note, solved)


def _find_optimum(problem: Problem, curve: Curve, objective: str, solver: str) -> float:
    """Optimum of the NLP with limits as they are, in its units."""
    options = PlanOptions(objective)
    goal, formation = Objective(objective), curve.formation
    nlp = build_path_nlp(formation.n_contacts, options.intervals, goal, formation.n_rolling, solver)
    data = prepare(curve, problem.epsilon, make_grid(curve, options.intervals), 1)
    profile, scales = guess(data)
    result: dict[str, Any] = nlp.solver(
        x0=pack(nlp, profile, scales, 0.0),
        p=parameters(nlp, data, scales, options.time_weight),
        **make_bounds(nlp, data, scales, Tightening.none(data, None)),
        **first_multipliers(nlp, data, profile, scales),
    )
    return float(result["f"])
