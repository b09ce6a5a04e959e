"""Feasibility of links through cells: each planned alone, on few intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..common.errors import WholearmError
from ..contacts.formation import Formation
from ..geometry.explore import STILL
from ..geometry.path_guess import find_end
from ..geometry.tracing import trace_phase
from ..mechanics.dynamics import metric_weights
from ..mechanics.speed_sweep import NoMotionError
from ..planning.lower_bound import look_along
from ..planning.options import Objective, PlanOptions
from ..planning.phase_plan import PhasePlan
from ..planning.time_domain.time_motion import TimeMotion
from ..problem.definition import End, Phase, Problem, Until
from .border_limits import INTERVALS
from .edges import EdgeStep, Link
from .places import close_place

ROUGH = 1e-2  # accuracy of plans that only estimate durations
SINGULAR = "its contacts depend on each other"
"""Reason where the equations of motion have no single solution."""


class Measured(NamedTuple):
    """The plan of one link through a cell."""

    duration: float  # [s]
    steps: tuple[EdgeStep, ...]  # its phases as planned
    # initial guesses: plans in the cell and of a border that is left in motion, on few intervals
    begun: list[PhasePlan[TimeMotion]]


def make_phases(problem: Problem, steps: Sequence[EdgeStep]) -> list[Phase]:
    """Steps as phases."""
    return [
        Phase(k, Formation(problem.scene, step.contacts), step.until, step.end)
        for k, step in enumerate(steps)
    ]


def measure_link(
    problem: Problem,
    link: Link,
    steps: tuple[EdgeStep, ...],
    options: PlanOptions,
    further: bool = False,
    straight: bool = True,
    first_only: bool = False,
) -> Measured | str:
    """Plan a link through a cell alone, on few intervals; the plan, or why there is none.

    Parameters
    ----------
    steps       the link's, or others between the same places
    further     whether other guesses are tried if the first ones fail
    straight    first guess: straight through the cell; otherwise to the nearest end of the phase
    first_only  whether only the first guess is tried
    """
    from ..planning.time_domain.time_plan import try_phases

    rough = replace(options, objective=Objective.TIME, duration=None, accuracy=ROUGH)
    phases, z, spent = make_phases(problem, steps), link.start.z, 0.0
    try:
        single = replace(problem, goals=(), phases=tuple(phases))
        if len(phases) > 1 and phases[0].end is End.REST:
            curve = trace_phase(phases[0], z)
            spent = look_along((curve,), problem.epsilon, INTERVALS)
            z, phases = curve.end, phases[1:]
        goal = close_place(link.stop) if len(phases) == 1 else None
        if goal is None:
            goal = replace(link.stop, z=find_end(phases[0], z, phases[1:]))
        moved = metric_weights(problem.scene) @ (goal.z - z) ** 2
        if moved < (STILL * problem.scene.scales.length) ** 2:
            return f"{phases[0].until} holds already where it starts"
        alone = len(phases) == 1
        towards = goal.z if straight and alone else None
        plans = try_phases(single, phases, z, rough, towards, further and alone, first_only)
    except NoMotionError:
        return "no motion keeps its limits along the border"
    except WholearmError as error:
        return str(error)
    except np.linalg.LinAlgError:
        return SINGULAR
    if plans is None:
        return "no guess leads to a plan"
    return Measured(spent + sum(plan.motion.duration for plan in plans), steps, plans)


def leave_in_motion(steps: tuple[EdgeStep, ...]) -> tuple[EdgeStep, ...]:
    """Phases that leave a border in motion, where the planner chooses."""
    first, *rest = steps
    return (EdgeStep(first.contacts, Until(), End.SMOOTH), *rest)
