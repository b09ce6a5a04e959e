"""Free simulation of a hand: from joint torques to motion, contacts and events."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import Array
from ..common.errors import InputError, SimulationError, require_number
from ..common.sharing import exclusive
from ..contacts.elemental import parse_contact
from ..problem.definition import Problem
from ..results.adopt import Torques, adopt_torques
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from .events import (
    EventKind,
    FreeSimulation,
    Outcome,
    OutcomeKind,
    collect,
    list_stretches,
)
from .free_events import play
from .free_run import FreeRun
from .hand import build_system, is_apart, measure_gaps
from .run import Feedback, Law
from .stepper import Modes
from .tolerances import SLOW, is_slower


class PhaseRun(NamedTuple):
    """Phases that are simulated from a planned start at rest, to the next one."""

    first: int  # first, last: indices of the phases
    last: int
    simulation: FreeSimulation


@exclusive
def simulate_free(
    problem: Problem,
    what: Torques | Law,
    *,
    start: ArrayLike | None = None,
    until: float | None = None,
    restitution: float = 0.0,
    tolerance: float = 1e-9,
    halt: Callable[[FreeRun], bool] | None = None,
) -> FreeSimulation:
    """Simulate torques without prescribed contacts, also after one is lost.

    Parameters
    ----------
    problem                its phases count only for the clock of a plan
    start : (5,) or (10,)  z, and z' if it is not at rest; the problem's start if left out. What is
                           closer than what counts as touching is moved onto its contact.
    until : [s]            the end, if not that of the torques; those of their end hold after it. A
                           law needs one.
    restitution            poisson's coefficient, 0 for plastic impacts to 1
    tolerance              as of `simulate`
    halt                   asked at every event, with the run, whether that is enough

    Raises
    ------
    InputError       if a number is out of its range
    SimulationError  if features overlap at the start, or a law gives no two numbers
    """
    state = _require_start(problem, start)
    rate = require_number(restitution, "restitution", nonnegative=True)
    if rate > 1:
        raise InputError("", "restitution", f"{restitution!r} is not between 0 and 1")
    if not 1e-14 <= tolerance <= 1e-2:
        raise InputError("", "tolerance", f"{tolerance!r} is not between 1e-14 and 1e-2")
    end = None if until is None else require_number(until, "until", positive=True)
    if isinstance(what, Law):
        if end is None:
            raise InputError("", "until", "none given; a law of torques needs an end")
        feedback = Feedback(what, end)
        return _simulate(problem, feedback, state, [0.0], None, rate, tolerance, halt)
    problem, profile, plan = adopt_torques(problem, what)
    profile = profile if end is None else profile.cut(0.0, end)
    starts = [0.0] if plan is None else plan.phase_starts[:-1].tolist()
    hint = None if plan is None or start is not None else _recall(problem, plan, 0)
    return _simulate(problem, profile, state, starts, hint, rate, tolerance, halt)


@exclusive
def simulate_phases(
    problem: Problem,
    plan: Trajectory,
    *,
    restitution: float = 0.0,
    tolerance: float = 1e-9,
    progress: Callable[[str], None] | None = None,
) -> tuple[PhaseRun, ...]:
    """Simulate the phases of a plan one by one, each from its planned start.

    Phases that pass into one another in motion, by the plan's velocities, are simulated together.

    Parameters
    ----------
    problem, restitution, tolerance  as of `simulate_free`
    progress  told which phase is simulated
    """
    starts, found = plan.phase_starts, []
    rows = [int(row) for row in np.flatnonzero(np.diff(plan.phase, prepend=-1))]
    rests = [is_slower(problem.scene, plan.z_dot[row], SLOW) for row in rows] + [True]
    first = 0
    for last in range(len(rows)):
        if not rests[last + 1]:
            continue
        if progress is not None:
            progress(f"simulating phase {problem.phases[first].number} of {len(rows)}")
        profile = plan.torque.cut(float(starts[first]), float(starts[last + 1]))
        row = rows[first]
        state = np.concatenate([plan.z[row], plan.z_dot[row]])
        hint = _recall(problem, plan, row)
        clock = starts[first : last + 1].tolist()
        simulation = _simulate(problem, profile, state, clock, hint, restitution, tolerance)
        found.append(PhaseRun(first, last, simulation))
        first = last + 1
    return tuple(found)


def _simulate(
    problem: Problem,
    profile: TorqueProfile | Feedback,
    state: Array,
    starts: list[float],
    hint: Modes | None,
    restitution: float,
    tolerance: float,
    halt: Callable[[FreeRun], bool] | None = None,
) -> FreeSimulation:
    z, v = np.split(state, 2)
    system = build_system(problem.scene)
    if not is_apart(system, z, problem.scene.touching):
        depths = -measure_gaps(problem.scene, z[None])[0]
        worst = int(depths.argmax())
        if depths[worst] > 10 * problem.scene.touching:
            pairs = (
                "palm and object",
                "finger 1 and object",
                "finger 2 and object",
                "both fingers",
            )
            raise SimulationError(f"{pairs[worst]} overlap by {depths[worst]:.3g} m at the start")
    run = FreeRun(system, profile, z, v, restitution, tolerance, hint)
    play(run, problem.scene.touching, halt)
    return _conclude(run, problem, np.asarray(starts))


def _conclude(run: FreeRun, problem: Problem, clock: Array) -> FreeSimulation:
    """The result of a run; `clock` are the starts of the phases [s]."""
    names, records = run.system.names, run.records
    planned = [contact.name for contact in problem.contacts]
    used = dict.fromkeys(names[pair] for row in records for pair in row.kept)
    others = [name for name in used if name not in planned and _is_named(name, problem)]
    given_up = next((e for e in run.events if e.kind is EventKind.GIVEN_UP), None)
    outcome = Outcome(OutcomeKind.ENDED, f"the simulation ends at t = {run.t:.5g} s")
    if given_up is not None:
        outcome = Outcome(OutcomeKind.GIVEN_UP, given_up.text)
    fields = collect(run.system, records, [*planned, *others])
    t = fields["t"]
    owners = np.searchsorted(clock, [event.time for event in run.events], side="right") - 1
    # Of two rows at a boundary the first one ends the phase before.
    twice = np.append(np.diff(t) == 0, False) & np.isin(t, clock[1:])
    fields["phase"] = np.maximum(np.searchsorted(clock, t, side="right") - 1 - twice, 0)
    return FreeSimulation(
        **fields,
        problem=problem,
        torque=run.torque,
        events=tuple(
            event._replace(phase=max(int(owner), 0))
            for event, owner in zip(run.events, owners, strict=True)
        ),
        stretches=list_stretches(records, names),
        outcome=outcome,
        missed_by=math.nan,
        residual=run.residual,
        steps=run.steps,
        rejected=run.rejected,
    )


def _is_named(name: str, problem: Problem) -> bool:
    """Whether a pair is a contact that problem files know."""
    try:
        parse_contact(name, problem.scene)
    except InputError:
        return False
    return True


def _recall(problem: Problem, plan: Trajectory, row: int) -> Modes:
    """Contact modes with which a plan begins, for the choice among several solutions."""
    system = build_system(problem.scene)
    names = [name for name, c in zip(plan.contacts, plan.c_n[row], strict=True) if c == c]
    kept = sorted(system.names.index(name) for name in names)
    z, v, a = plan.z[row], plan.z_dot[row], plan.z_ddot[row]
    rows = system.evaluate(z, v, kept)
    ahead = 1e-3 * system.scales.time
    slides = np.sign(rows.A_t @ v + ahead * (rows.A_t @ a + rows.bend_t))
    phase = problem.phases[int(plan.phase[row])]
    rolls = [system.names[pair] in {c.name for c in phase.formation.rolling} for pair in kept]
    Xi = np.where(rolls, 0.0, slides)
    turns = np.sign(v + ahead * a) * (system.dry > 0)
    stuck = tuple((pair,) for pair, one in zip(kept, rolls, strict=True) if one)
    return Modes(tuple(kept), stuck, (), tuple(Xi.tolist()), tuple(turns.tolist()))


def _require_start(problem: Problem, start: ArrayLike | None) -> Array:
    if start is None:
        return np.concatenate([problem.start, np.zeros(5)])
    try:
        state = np.asarray(start, dtype=float)
    except (TypeError, ValueError):
        raise InputError("", "start", "does not hold numbers") from None
    if state.shape not in ((5,), (10,)) or not np.isfinite(state).all():
        raise InputError(
            "", "start", f"shape {state.shape} given; 5 or 10 finite numbers are needed"
        )
    return np.concatenate([state, np.zeros(10 - len(state))])
