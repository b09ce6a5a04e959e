"""Phases along curves that impacts or smooth ends join: sequences run through without a stop.

At the end of a curve the velocity is z_s s'. The impact makes it a multiple of the next curve's
tangent at any speed: v+ = ratio s' z_s. So whether an impact is possible is known before planning,
and with a parameter that runs `ratio` times as fast on the next curve the speed is continuous: the
curves are planned as one. Otherwise the motion has to stop, and the sequence is split. A smooth end
is passed at speed where the tangents are the same. Under torque rate limits parts are planned one
after the other, with pauses between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import Curve
from ...mechanics.dynamics import measure_speed, metric_weights
from ...mechanics.impact import Impact, compute_impact
from ...problem.definition import End, Phase
from ...results.plan_record import Transition
from ...results.trajectory import Motion
from ..nlp import charge
from ..options import PlanOptions
from ..phase_plan import PhasePlan, PlanPart, Plans, end_of
from .path_plan import plan_curves

if TYPE_CHECKING:
    from .junction import Joint

PER_SPEED = " per m/s"  # unit after impulses and rates, which are for unit speed before an impact
BEND = 1e-6  # largest 1 - cosine between tangents that count as the same


@dataclass(frozen=True, eq=False)
class CurveImpact:
    """Impact between two curves for unit speed along the first; none if they join smoothly."""

    phase: Phase  # the one that it ends
    impact: Impact  # velocities per m/s, hence without unit and in rad/m; impulses in N s per m/s
    ratio: float  # speed along the second curve; negative if the motion would turn back

    @property
    def possible(self) -> bool:
        """Whether the motion can go on at speed."""
        return self.impact.possible and self.ratio > 0

    @property
    def reason(self) -> str:
        """Why it cannot, empty if it can."""
        if self.impact.violations:
            return self.impact.violations[0].describe(PER_SPEED)
        return "" if self.possible else f"phase {self.phase.number + 1} would be run backwards"


def compute_curve_impact(phase: Phase, before: Curve, after: Curve) -> CurveImpact:
    """The impact at the end of a phase, from its curve to the next one's."""
    v = before.evaluate(np.array([before.length])).z_s[0] / before.speed_ratio
    heading = after.evaluate(np.zeros(1)).z_s[0] / after.speed_ratio
    metric = metric_weights(after.formation.scene)
    if phase.end is End.SMOOTH:
        none = np.zeros(after.formation.n_contacts)
        impact = Impact(after.formation, v, none, none, ())
        return CurveImpact(phase, impact, float(v * metric @ heading > 1 - BEND))
    impact = compute_impact(before.formation, after.formation, after.start, v)
    return CurveImpact(phase, impact, float(impact.v * metric @ heading))


@dataclass(frozen=True, eq=False)
class ImpactSequence:
    """One-freedom phases, each but the last ended by an impact or smoothly."""

    phases: tuple[Phase, ...]
    curves: tuple[Curve, ...]  # parametrised by arc length
    impacts: tuple[CurveImpact, ...]  # between one curve and the next

    def part(self, start: int, stop: int) -> ImpactSequence:
        """Phases `start` to `stop`, without the latter."""
        impacts = self.impacts[start : stop - 1]
        return ImpactSequence(self.phases[start:stop], self.curves[start:stop], impacts)

    def split(self) -> list[ImpactSequence]:
        """Split where an impact is not possible."""
        ends = [k + 1 for k, join in enumerate(self.impacts) if not join.possible]
        bounds = zip([0, *ends], [*ends, len(self.phases)], strict=True)
        return [self.part(start, stop) for start, stop in bounds]

    @property
    def continuous_curves(self) -> tuple[Curve, ...]:
        """The curves with such speed ratios that the speed is the same on both sides of a join."""
        ratios = np.cumprod([1.0, *(join.ratio for join in self.impacts)])
        return tuple(
            curve.with_speed_ratio(float(ratio)) if ratio != 1 else curve
            for curve, ratio in zip(self.curves, ratios, strict=True)
        )


def make_sequence(phases: Sequence[Phase], curves: Sequence[Curve]) -> ImpactSequence:
    """Chain phases along their curves."""
    impacts = map(compute_curve_impact, phases[:-1], curves[:-1], curves[1:])
    return ImpactSequence(tuple(phases), tuple(curves), tuple(impacts))


def plan_sequence(
    sequence: ImpactSequence,
    epsilon: float,
    options: PlanOptions,
    duration: float | None = None,
    **others: Any,
) -> Plans:
    """Plan phases that possible impacts join, from rest to rest; see `plan_curves`."""
    phases = [phase.number for phase in sequence.phases]
    plans = plan_curves(sequence.continuous_curves, epsilon, options, phases, duration, **others)
    return [*plans]


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
    from .junction import add_pause, choose_joint

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
            plan = plan_sequence(part, epsilon, options, duration, pins=pins)
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
        part = sequence.part(start, stop)
        return plan_sequence(part, epsilon, options, duration, explained=False)

    return plan_part


def list_impacts(
    phases: Sequence[Phase], sequence: ImpactSequence, plans: Sequence[PhasePlan[Motion]]
) -> list[Transition]:
    """The impacts of a sequence, with the speeds that its plans pass them at."""
    impacts = []
    for phase, plan, join in zip(phases, plans, sequence.impacts, strict=False):
        if join.phase.end is End.IMPACT:
            speed = measure_speed(phase.formation.scene, end_of(plan)[1]) if join.possible else 0.0
            impacts.append(make_transition(phase, join.impact, join.ratio, join.reason, speed))
    return impacts


def make_transition(
    phase: Phase, impact: Impact, ratio: float, reason: str, speed: float
) -> Transition:
    """The transition at the end of a phase; what it saves is not known yet."""
    contact, impulse = impact.least
    what = phase.number, str(phase.until), not reason, reason, ratio
    return Transition(*what, impulse, contact, speed, math.nan)
