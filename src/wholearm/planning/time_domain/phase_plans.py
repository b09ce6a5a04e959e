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
    unit, margin = unit_of(search.goal, problem.scene.scales), solution.margin
    weight = search.options.time_weight * problem.scene.scales.torque**2
    solved = [to_si(stage, problem) for stage in solution.stages]
    motions = make_motions(solved, search.scheme)
    for phase in phases:
        stages = zip(motions, solved, strict=True)
        motion = TimeMotion([own for own, stage in stages if stage.phase == phase.index])
        torque = motion.torque
        value = {
            Objective.TIME: motion.duration,
            Objective.EFFORT: weight * motion.duration + torque.integrate_squares(),
            Objective.MARGIN: problem.epsilon + unit * margin,
        }[search.goal]
        own = [stage for stage in solution.stages if stage.phase == phase.index]
        plan = PhasePlan(motion, torque, value, attempt=attempt, stages=own)
        plans.append(plan._replace(error=solution.error))
    plans[0] = plans[0]._replace(sequences=tried.sequences, complete=tried.complete)
    if search.only_begins:
        plans[0] = plans[0]._replace(solution=solution)
    return plans
