"""The solution of a block of phases as plans of these, in SI units."""

from __future__ import annotations

from collections.abc import Sequence

from ...problem.definition import Phase, Problem
from ..options import Objective
from ..phase_plan import PhasePlan
from .motion import TimeMotion, make_motions
from .own_units import to_si, unit_of
from .search import Search, Solution


def list_plans(
    problem: Problem, search: Search, phases: Sequence[Phase], solution: Solution, attempt: str
) -> list[PhasePlan[TimeMotion]]:
    """The plan of each phase; the sequences of modes that were tried count for the first.

    Where there are ranges, one that keeps its limits within them: see `widening`.
    """
    if search.options.ranges and not search.only_begins:
        from .widening import keep_within

        solution = keep_within(search, solution, phases)
    plans, tried = [], search.tried
    motions = _list_motions(problem, search, phases, solution)
    free = solution.free and _list_motions(problem, search, phases, solution.free)
    for k, (phase, motion) in enumerate(zip(phases, motions, strict=True)):
        value = _measure(problem, search, solution, motion)
        own = [stage for stage in solution.stages if stage.phase == phase.index]
        plan = PhasePlan(motion, motion.torque, value, attempt=attempt, stages=own)
        if free and solution.free:
            plan = plan._replace(unheld=_measure(problem, search, solution.free, free[k]))
        plans.append(plan._replace(error=solution.error))
    plans[0] = plans[0]._replace(sequences=tried.sequences, complete=tried.complete)
    if search.only_begins:
        plans[0] = plans[0]._replace(solution=solution)
    return plans


def _list_motions(
    problem: Problem, search: Search, phases: Sequence[Phase], solution: Solution
) -> list[TimeMotion]:
    """The motion of each phase, in SI units."""
    solved = [to_si(stage, problem) for stage in solution.stages]
    made = list(zip(make_motions(solved, search.scheme), solved, strict=True))
    return [
        TimeMotion([own for own, stage in made if stage.phase == phase.index]) for phase in phases
    ]


def _measure(problem: Problem, search: Search, solution: Solution, motion: TimeMotion) -> float:
    """A phase's share of the objective."""
    scales = problem.scene.scales
    if search.goal is Objective.MARGIN:
        return problem.epsilon + unit_of(search.goal, scales) * solution.margin
    if search.goal is Objective.TIME:
        return motion.duration
    weight = search.options.time_weight * scales.torque**2
    return weight * motion.duration + motion.torque.integrate_squares()
