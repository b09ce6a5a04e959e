"""Plans of sequences of phases along curves that impacts join, at speed or with pauses."""

from __future__ import annotations

from collections.abc import Sequence

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import Curve
from ...mechanics.dynamics import measure_speed
from ...problem.definition import End
from ...results.trajectory import Motion
from ...solvers.ipopt import charge
from ..impacts import BlockImpact
from ..options import PlanOptions
from ..phase_plan import PhasePlan
from ..stops import PlanPart, Plans, end_of
from .impact_sequence import ImpactSequence
from .junction import Joint, add_pause, choose_joint
from .path_motion import PathMotion
from .path_plan import Pins, plan_curves


def plan_sequence(
    sequence: ImpactSequence,
    epsilon: float,
    options: PlanOptions,
    duration: float | None = None,
    explained: bool = True,
    pins: Pins = (None, None),
) -> list[PhasePlan[PathMotion]]:
    """Plan phases that possible impacts join, from rest to rest.

    Parameters
    ----------
    epsilon, duration, explained, pins  see `plan_curves`
    """
    phases = [phase.number for phase in sequence.phases]
    curves = sequence.continuous_curves
    return plan_curves(curves, epsilon, options, phases, duration, explained, pins)


def plan_slowly(
    parts: Sequence[ImpactSequence],
    neighbours: tuple[Curve | Array | None, Curve | Formation | None],
    epsilon: float,
    options: PlanOptions,
    durations: Sequence[float | None],
) -> Plans:
    """Plan sequences one after the other under rate limits, with pauses between them.

    Parameters
    ----------
    neighbours       the curves before and after all of them, if any; in the time domain the final
                     torques of the former, and the formation of the latter
    durations : [s]  the longest duration of each, for the objective `margin`
    """
    plans: Plans = []
    firsts: list[Curve | Formation | None] = [
        *(part.curves[0] for part in parts[1:]),
        neighbours[1],
    ]
    joint: Joint | None = None
    before: Curve | Array | None = neighbours[0]
    for part, after, duration in zip(parts, firsts, durations, strict=True):
        number, first, last = part.phases[0].number, part.curves[0], part.curves[-1]
        if before is not None and joint is None:
            joint = choose_joint(before, first, first.start, epsilon, number)
        following = None
        if after is not None:
            following = choose_joint(last, after, last.end, epsilon, part.phases[-1].number + 1)
        pins = joint.begins if joint else None, following.ends if following else None
        if duration is not None and joint is not None:
            duration -= joint.pause
        with charge(number):
            plan: Plans = [*plan_sequence(part, epsilon, options, duration, pins=pins)]
        if joint is not None:
            plan[0] = add_pause(plan[0], joint, first.formation, first.start, options)
        plans += plan
        joint, before = following, last
    return plans


def plan_parts_of(sequence: ImpactSequence, epsilon: float) -> PlanPart:
    """The planner of parts of a sequence."""

    def plan_part(
        start: int, stop: int, z: Array, options: PlanOptions, duration: float | None
    ) -> Plans:
        return [*plan_sequence(sequence.part(start, stop), epsilon, options, duration, False)]

    return plan_part


def list_impacts(sequence: ImpactSequence, plans: Sequence[PhasePlan[Motion]]) -> list[BlockImpact]:
    """The impacts of a sequence, with the speeds that its plans pass them at."""
    impacts = []
    for k, join in enumerate(sequence.impacts):
        if join.phase.end is End.IMPACT:
            scene = join.phase.formation.scene
            speed = measure_speed(scene, end_of(plans[k])[1]) if join.possible else 0.0
            impacts.append(BlockImpact(k, join.impact, join.ratio, join.reason, speed))
    return impacts
