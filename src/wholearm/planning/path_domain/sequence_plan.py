"""Planning sequences of one-freedom phases that impacts join."""

from __future__ import annotations

from collections.abc import Sequence

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import Curve
from ...mechanics.metric import measure_speed
from ...problem.definition import End
from ...results.trajectory import Motion
from ...solvers.statistics import charge
from ..impacts import BlockImpact
from ..options import PlanOptions
from ..phase_plan import PhasePlan
from ..stops import PlanPart, Plans, end_of
from .impact_sequence import ImpactSequence
from .junction import Joint, add_pause, choose_joint
from .path_motion import PathMotion
from .path_plan import plan_curves
from .task import Pins


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
    epsilon : [N]
    duration : [s]  longest duration of all, for the objective `margin`; the phases share it as is
                    best
    explained       whether to find out why there is no plan
    pins : [N]      the squeeze at both ends, where it is given
    """
    phases = [phase.number for phase in sequence.phases]
    curves = sequence.continuous_curves
    return plan_curves(curves, epsilon, options, phases, duration, explained, pins)


def plan_slowly(
    parts: Sequence[ImpactSequence],
    beside: tuple[Curve | Array | None, Curve | Formation | None],
    epsilon: float,
    options: PlanOptions,
    durations: Sequence[float | None],
) -> Plans:
    """Plan sequences one after the other whose torques may not step, with pauses between them.

    Parameters
    ----------
    beside           the curves before and after all of them, or where these are planned over time,
                     the torques that the former end with, and the formation of the latter; None
                     where there is nothing
    epsilon : [N]
    durations : [s]  the longest duration of each, for the objective `margin`
    """
    plans: Plans = []
    firsts: list[Curve | Formation | None] = [*(part.curves[0] for part in parts[1:]), beside[1]]
    joint: Joint | None = None
    before: Curve | Array | None = beside[0]
    for part, after, duration in zip(parts, firsts, durations, strict=True):
        number = part.phases[0].number
        if before is not None and joint is None:
            first = part.curves[0]
            joint = choose_joint(before, first, first.start, epsilon, number)
        last, following, coming = part.curves[-1], part.phases[-1].number + 1, None
        if after is not None:
            coming = choose_joint(last, after, last.end, epsilon, following)
        pins = joint.begins if joint else None, coming.ends if coming else None
        if duration is not None and joint is not None:
            duration -= joint.pause
        with charge(number):
            own: Plans = [*plan_sequence(part, epsilon, options, duration, pins=pins)]
        if joint is not None:
            first = part.curves[0]
            own[0] = add_pause(own[0], joint, first.formation, first.start, options)
        plans += own
        joint, before = coming, last
    return plans


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
