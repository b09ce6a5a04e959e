"""Impacts that a problem asks for, and the gain of each over a stop.

Both domains list the impacts of a block (`BlockImpact`) and plan parts of it (`PlanPart`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..common.errors import InfeasibleError, SolverError
from ..mechanics.impact import Impact
from ..problem.definition import Phase
from ..results.plan_record import Transition
from ..results.trajectory import Motion
from ..solvers.ipopt import charge
from .options import Objective, PlanOptions
from .phase_plan import PhasePlan, add_up, combine
from .stops import PlanPart, plan_stops

PER_SPEED = " per m/s"  # unit after impulses and rates, which are for unit speed before an impact


@dataclass(frozen=True, eq=False)
class BlockImpact:
    """An impact between two phases of a block, for unit speed before it."""

    before: int  # index in the block of the phase that it ends
    impact: Impact  # velocities per m/s, hence without unit and in rad/m; impulses in N s per m/s
    ratio: float  # speed after over speed before
    reason: str  # why the motion stops there instead; empty if it passes at speed
    speed: float  # [m/s]: before the impact; zero at a stop

    @property
    def passed(self) -> bool:
        """Whether the motion goes on at speed."""
        return not self.reason


def assess_impacts(
    block: Sequence[Phase],
    impacts: Sequence[BlockImpact],
    plans: Sequence[PhasePlan[Motion]],
    plan_part: PlanPart,
    options: PlanOptions,
    allowed: Sequence[float | None],
    report: Callable[[str], None],
) -> list[Transition]:
    """Transitions of all impacts of a block, with what each saves over a planned stop.

    `allowed` are the longest durations of the problem's phases [s], for the objective `margin`.
    """
    stops = [0, *(impact.before + 1 for impact in impacts if not impact.passed), len(block)]
    transitions = []
    for own in impacts:
        phase, at, saves = block[own.before], own.before + 1, math.nan
        if own.passed:
            report(f"phase {phase.number}: what its impact saves")
            start, stop = max(k for k in stops if k < at), min(k for k in stops if k > at)
            duration = add_up(block[start:stop], allowed)
            with charge(phase.number):
                saves = _find_saving(plans, (start, at, stop), plan_part, options, duration)
        contact, impulse = own.impact.least
        what = phase.number, str(phase.until), own.passed, own.reason, own.ratio
        transitions.append(Transition(*what, impulse, contact, own.speed, saves))
    return transitions


def _find_saving(
    plans: Sequence[PhasePlan[Motion]],
    bounds: tuple[int, int, int],
    plan_part: PlanPart,
    options: PlanOptions,
    duration: float | None,
) -> float:
    """Cost of a stop at the middle one of `bounds` in phases in motion; NaN without a plan."""
    moving = plans[bounds[0] : bounds[-1]]
    z = moving[0].motion.evaluate(np.zeros(1)).z[0]
    try:
        stopped = plan_stops(plan_part, bounds, z, options, duration)
    except (InfeasibleError, SolverError):
        return math.nan
    values = [combine(options.goal, [plan.value for plan in own]) for own in (stopped, moving)]
    gain = values[0] - values[1]
    return -gain if options.goal is Objective.MARGIN else gain
