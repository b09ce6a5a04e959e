"""What became of the impacts that a problem asks for, and what they save over stopping.

A block is a run of phases that are planned together; both domains say of each impact in it whether
the motion passes it at speed (`BlockImpact`) and how a part of the block is planned (`PlanPart`).
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
from ..solvers.statistics import charge
from .options import Objective, PlanOptions
from .phase_plan import PhasePlan, add_up, combine
from .stops import PlanPart, plan_stops

PER_SPEED = " per m/s"
"""Unit after impulses and rates of an impact: they are for one unit of speed before it."""


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
    """Assess every impact of a block: what it saves is found by planning a stop instead.

    Parameters
    ----------
    impacts        all that the block asks for
    plans          of the block
    plan_part      see `PlanPart`
    allowed : [s]  longest duration of each phase of the problem, for the objective `margin`
    report         told in a few words what is being done
    """
    stops = [0, *(own.before + 1 for own in impacts if not own.passed), len(block)]
    found = []
    for own in impacts:
        phase, at, saves = block[own.before], own.before + 1, math.nan
        if own.passed:
            report(f"phase {phase.number}: what its impact saves")
            start, stop = max(k for k in stops if k < at), min(k for k in stops if k > at)
            duration = add_up(block[start:stop], allowed)
            with charge(phase.number):
                saves = _find_saving(plans, (start, at, stop), plan_part, options, duration)
        contact, impulse = own.impact.least
        until = str(phase.until)
        found.append(
            Transition(
                phase.number, until, own.passed, own.reason, own.ratio, impulse, contact,
                own.speed, saves,
            )
        )  # fmt: skip
    return found


def _find_saving(
    plans: Sequence[PhasePlan[Motion]],
    bounds: tuple[int, int, int],
    plan_part: PlanPart,
    options: PlanOptions,
    duration: float | None,
) -> float:
    """What a stop at the middle one of `bounds` costs in phases in motion; NaN without a plan."""
    start, _, stop = bounds
    own = plans[start:stop]
    z = own[0].motion.evaluate(np.zeros(1)).z[0]
    try:
        stopped = plan_stops(plan_part, bounds, z, options, duration)
    except (InfeasibleError, SolverError):
        return math.nan
    gain = combine(options.goal, [plan.value for plan in stopped]) - combine(
        options.goal, [plan.value for plan in own]
    )
    return -gain if options.goal is Objective.MARGIN else gain
