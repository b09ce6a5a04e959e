"""Planning sequences of one-freedom phases that impacts join."""

from __future__ import annotations

from collections.abc import Sequence

from ...common.arrays import Array
from ...mechanics.metric import measure_speed
from ...problem.definition import End
from ...results.trajectory import Motion
from ..impacts import BlockImpact
from ..options import PlanOptions
from ..phase_plan import PhasePlan
from ..stops import PlanPart, Plans, end_of
from .impact_sequence import ImpactSequence
from .motion import PathMotion
from .plan import plan_curves


def plan_sequence(
    sequence: ImpactSequence,
    epsilon: float,
    options: PlanOptions,
    duration: float | None = None,
    explained: bool = True,
) -> list[PhasePlan[PathMotion]]:
    """Plan phases that possible impacts join, from rest to rest.

    Parameters
    ----------
    sequence : ImpactSequence
    epsilon : float, [N]
    options : PlanOptions
    duration : float, optional, [s]
        Longest duration of all, for the objective `margin`; the phases share it as is best.
    explained : bool
        Whether to find out why there is no plan.
    """
    phases = [phase.number for phase in sequence.phases]
    return plan_curves(sequence.continuous_curves, epsilon, options, phases, duration, explained)


def plan_parts_of(sequence: ImpactSequence, epsilon: float) -> PlanPart:
    """How parts of a sequence are planned."""

    def plan_part(
        start: int, stop: int, z: Array, options: PlanOptions, duration: float | None
    ) -> Plans:
        return [*plan_sequence(sequence.part(start, stop), epsilon, options, duration, False)]

    return plan_part


def list_impacts(sequence: ImpactSequence, plans: Sequence[PhasePlan[Motion]]) -> list[BlockImpact]:
    """The impacts of a sequence, with the speeds that its plans pass them at."""
    found = []
    for k, own in enumerate(sequence.impacts):
        if own.phase.end is not End.IMPACT:
            continue
        scene = own.phase.formation.scene
        speed = measure_speed(scene, end_of(plans[k])[1]) if own.possible else 0.0
        found.append(BlockImpact(k, own.impact, own.ratio, own.reason, speed))
    return found
