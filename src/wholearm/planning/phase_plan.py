"""Plans of phases in either domain; blocks of phases, and plans with stops inside a block."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from ..common.arrays import Array
from ..common.document import to_plain
from ..common.errors import Change, InfeasibleError, Parameter, describe_changes, round_outwards
from ..contacts.formation import Formation
from ..geometry.tracing import runs_on_curves
from ..mechanics.impact import Impact
from ..problem.definition import Phase
from ..results.dwell_record import Settling, assemble
from ..results.report import Transition
from ..results.torque import TorqueProfile
from ..results.trajectory import Motion, Trajectory
from .options import Objective, PlanOptions

M_co = TypeVar("M_co", bound=Motion, covariant=True)
PER_SPEED = " per m/s"  # unit after impulses and rates, which are for unit speed before an impact


class PhasePlan(NamedTuple, Generic[M_co]):
    """The plan of one phase."""

    motion: M_co
    torque: TorqueProfile  # from the start of the phase
    value: float  # the phase's part of the objective: s, (N m)^2 s or N
    sequences: int = 0  # of contact modes solved, in the first phase of an NLP; 0 on curves
    complete: bool = True  # whether the mode search has solved all neighbours
    attempt: str = ""  # name of its initial guess; empty along curves
    stages: Sequence[object] = ()  # of the NLP, in the scene's units; none along curves
    error: float = math.nan  # estimated relative error of the value of all phases in one NLP
    unheld: float = math.nan  # value with free torques, where they are held over control periods
    settling: Settling | None = None  # the dwell at its end

    @property
    def end_torques(self) -> Array:
        """The first and the last torques, shape (2, 2) [N m]."""
        return self.torque.at(self.torque.breaks[[0, -1]])


Plans = list[PhasePlan[Motion]]
PlanPart = Callable[[int, int, Array, PlanOptions, float | None], Plans]
"""Plans phases `start` to `stop` of a block, without the latter, from a configuration and within a
duration: from rest to rest, without stops between."""


def combine(goal: Objective, values: Sequence[float]) -> float:
    """Objective value of some phases, given that of each."""
    return min(values) if goal is Objective.MARGIN else sum(values)


def value_of(options: PlanOptions, duration: float, torque: TorqueProfile, least: float) -> float:
    """The objective of a motion: its duration [s], its effort, or its least normal force [N]."""
    if options.goal is Objective.EFFORT:
        return torque.integrate_squares() + options.time_weight * duration
    return least if options.goal is Objective.MARGIN else duration


Piece = tuple[Motion, TorqueProfile, Formation]
"""A phase: its motion, its torque from its start, and its formation."""


def assemble_motions(pieces: Iterable[Piece], rows: int, **meta: Any) -> Trajectory:
    """The trajectory of phases; rolling contacts and modes are added to its `meta`."""
    motions, torques, formations = zip(*pieces, strict=True)
    entries: dict[str, Any] = {
        "rolling": [[contact.name for contact in formation.rolling] for formation in formations],
        "modes": to_plain([getattr(motion, "modes", ()) for motion in motions]),
    }
    return assemble(motions, TorqueProfile.chain(torques), entries | meta, rows)


def plan_stops(
    plan_part: PlanPart,
    bounds: Sequence[int],
    z: Array,
    options: PlanOptions,
    duration: float | None = None,
) -> Plans:
    """Plans of phases of a block with a stop before some of them; raises without a plan.

    Parameters
    ----------
    bounds          indices in the block of the phases that start at rest, and the end of the last
    z : (5,)        start
    duration : [s]  longest in all, for `margin`: divided in proportion to the parts' least times
    """
    parts = list(pairwise(bounds))

    def plan_parts(options: PlanOptions, durations: Sequence[float | None]) -> Plans:
        plans, begin = list[PhasePlan[Motion]](), z
        for (start, stop), longest in zip(parts, durations, strict=True):
            plans += plan_part(start, stop, begin, options, longest)
            begin = end_of(plans[-1])[0]
        return plans

    if duration is None or len(parts) == 1:
        return plan_parts(options, [duration] * len(parts))
    time_options = options.for_least_time()
    time_optimal = plan_parts(time_options, [None] * len(parts))
    times = [
        sum(plan.motion.duration for plan in time_optimal[start - bounds[0] : stop - bounds[0]])
        for start, stop in parts
    ]
    stops = "a stop" if len(parts) == 2 else "stops"
    return plan_parts(options, share_duration(times, duration, stops=f" with {stops}"))


def share_duration(
    times: Sequence[float], duration: float, where: str = "", stops: str = ""
) -> list[float]:
    """Durations of parts in proportion to their least times [s].

    InfeasibleError if the duration is too short; it names `stops` that are not in the problem.
    """
    least_time = sum(times)
    if duration <= least_time:
        # The least time is feasible; a little more leaves a margin to optimize.
        parameter = Parameter("duration", duration, "s", 1, "duration")
        changes = [Change(parameter, round_outwards(1.005 * least_time, 1))] * (not stops)
        text = f"{where}duration = {duration:g} s is not longer than the least time{stops}, "
        text += f"{least_time:.6g} s" + (f"; {describe_changes(changes)}" if changes else "")
        raise InfeasibleError(text, changes=changes)
    return [duration / least_time * time for time in times]


def end_of(plan: PhasePlan[Motion]) -> tuple[Array, Array]:
    """Configuration z and velocity z' at the end of a phase, shape (5,) each."""
    samples = plan.motion.evaluate(np.array([plan.motion.duration]))
    return samples.z[0], samples.z_dot[0]


def runs_along_curves(block: Sequence[Phase], options: PlanOptions) -> bool:
    """Whether phases are planned along their curves."""
    return options.transcription == "auto" and runs_on_curves(block)


def make_transition(
    phase: Phase, impact: Impact, ratio: float, reason: str, speed: float
) -> Transition:
    """The transition at the end of a phase, with unknown savings."""
    contact, impulse = impact.least_impulse
    until, nan = str(phase.until), math.nan
    return Transition(phase.number, until, not reason, reason, ratio, impulse, contact, speed, nan)
