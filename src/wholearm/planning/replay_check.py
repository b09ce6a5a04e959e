"""Verification of a plan by simulation of its torques, and replanning where it fails.

The residual of the equations of motion is independent of the planner (`verification.newton_euler`).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import InfeasibleError, JammingError, ReplayError, SimulationError, SolverError
from ..common.files import write_text
from ..problem.definition import Problem
from ..results.dwell_record import HeldMotion, assemble
from ..results.report import RecordedDeviation, ReplayedPhase, ReplayFigures, Report
from ..results.torque import ERROR, TorqueProfile, format_rows, place_rows, sample_rows
from ..results.trajectory import Samples, Trajectory, sample_phases
from ..scene.model import Scales
from ..verification.newton_euler import balance
from ..verification.verify import Allowance, describe_motors, find_commands, judge, replay_torques
from .blocks import BlockPlan, Planning, plan_each
from .phase_plan import combine

INCREASE = 2.0  # increase of epsilon over a small shortfall of c_n
_ARRIVAL_ERROR = 1e-2  # largest error of an arrival over the duration of its phase
RESIDUAL = 1e-8  # largest relative residual of the equations of motion; rounding leaves 1e-13
_DIVISOR = 8.0  # of the error of the rows of a table if its replay does not hold
_ATTEMPTS = 3  # most tables


class Residual(NamedTuple):
    """Largest residual of the equations of motion."""

    size: float  # relative to the scene's force or torque, length or speed
    phase: int  # number of the phase
    text: str  # where, and of what


class ReplayCheck(NamedTuple):
    """A plan's own replay and its residual."""

    report: Report | JammingError | SimulationError  # an error ends the replay
    residual: Residual

    @property
    def failure(self) -> tuple[int, str] | None:
        """Number of the phase that fails, and the reason; None if the plan holds."""
        if self.residual.size > RESIDUAL:
            return self.residual.phase, self.residual.text
        if not isinstance(self.report, Report):
            return self.report.phase or 1, str(self.report)
        if self.report.ok:
            return None
        assert self.report.failed_phase is not None
        return self.report.failed_phase, self.report.reason

    def find_culprit(self, scales: Scales, allowance: Allowance, trajectory: Trajectory) -> int:
        """Number of the phase to replan: the first that departs from the plan, or that fails.

        A departure is a deviation in position, a speed at a stop, also times the duration of the
        next phase, or an error of the arrival time. Case of the last: phase 2 of a triangle's flip
        for the largest margin, a slow motion that arrives too early by a tenth.
        """
        assert self.failure is not None
        starts = trajectory.phase_starts
        durations = np.diff(starts)
        following = dict(enumerate(durations[1:].tolist(), start=1))
        # A dwell comes after the arrival.
        times = [m.end if isinstance(m, HeldMotion) else m.duration for m in trajectory.motions]
        ends = starts[:-1] + times
        for phase in self.report.phases if isinstance(self.report, Report) else ():
            k = phase.number - 1
            arrival = ends[k] if phase.arrival is None else phase.arrival
            deviation = phase.deviation.measure(scales.length) if phase.deviation else 0.0
            departs = deviation > allowance.departure
            speed = phase.end_speed or 0.0
            displacement = speed * following.get(phase.number, 0.0)
            moving = speed > allowance.rest_speed * scales.speed
            late = abs(arrival - ends[k]) > _ARRIVAL_ERROR * durations[k]
            if departs or moving or late or displacement > allowance.departure * scales.length:
                return min(phase.number, self.failure[0])
        return self.failure[0]


def replay_plan(
    planning: Planning, report: Callable[[str], None]
) -> tuple[Planning, ReplayFigures]:
    """Replay a plan, replanning blocks until the replay holds; ReplayError if none does."""
    problem, allowance, simulations = planning.problem, Allowance(), 0
    while True:
        simulations += 1
        report("replaying the plan")
        check = check_plan(problem, planning.trajectory, allowance)
        if check.failure is None:
            break
        number = check.find_culprit(problem.scene.scales, allowance, planning.trajectory)
        # Under rate limits the final speed of phase 8 of query 72 does not cause phase 12 to fail.
        suspects = dict.fromkeys((number, check.failure[0]))
        plans = (_replan(planning, phase, check, report) for phase in suspects)
        replanned = next((plan for plan in plans if plan is not None), None)
        if replanned is None:
            failed, reason = check.failure
            first = "" if number == failed else f", which departs in phase {number} first"
            ends = f"planned to end at t = {planning.trajectory.phase_starts[failed]:.5g} s"
            raise ReplayError(
                f"the plan of phase {failed} does not hold in its replay{first}: {reason}; it is "
                f"{ends}; other intervals, another objective or time weight may do, and "
                "--no-replay (replay=False) leaves the check out"
            )
        planning = replanned
    assert isinstance(check.report, Report)
    phases = list[ReplayedPhase]()
    for phase in check.report.phases:
        deviations = phase.end_deviation, phase.deviation
        end, peak = (each and RecordedDeviation(*each) for each in deviations)
        phases.append(ReplayedPhase(phase.arrival, phase.end_speed, end, peak, phase.least_force))
    least, residual, steps = check.report.least_force, check.residual.size, check.report.steps
    assert least is not None
    return planning, ReplayFigures(least, tuple(phases), residual, steps, simulations)


def _replan(
    planning: Planning, number: int, check: ReplayCheck, report: Callable[[str], None]
) -> Planning | None:
    """Another plan of the block with phase `number`; None without one.

    For the largest margin first in less time, as slow motions are less stable in open loop: query
    37 of `bench queries`. Then with a larger epsilon, as a replay may stick for an instant at a
    reversal, with another force: least effort of leg 22 of seed 7.
    """
    candidates, pairs = list[Planning](), enumerate(planning.blocks)
    index, block = next(pair for pair in pairs if number <= pair[1].phases[-1].number)
    # Continuous torques between blocks depend on both.
    reach = 1 if planning.problem.scene.has_slow_motors else 0
    span = range(index - reach, index + reach + 1)
    coarse = tuple(replace(b, coarse=b.coarse or k in span) for k, b in enumerate(planning.blocks))
    marked = replace(planning, blocks=coarse)
    if planning.durations:
        times = {p.index: planning.fastest[p.index].motion.duration for p in block.phases}
        durations = [
            (duration + times[k]) / 2 if k in times else duration
            for k, duration in enumerate(planning.durations)
        ]
        if sum(durations[k] for k in times) > 1.1 * sum(times.values()):
            candidates.append(replace(marked, durations=durations))
    extra = planning.extra_epsilon
    shortfall = _find_shortfall(planning, block, check) if index not in extra else 0.0
    if shortfall:
        candidates.append(replace(marked, extra_epsilon=extra | {index: INCREASE * shortfall}))
    for candidate in candidates:
        try:
            planned = plan_each(candidate, report)
        except (InfeasibleError, SolverError):
            continue
        return planned if candidate.extra_epsilon is extra else _add_cost(planning, planned, index)
    return None


def _add_cost(planning: Planning, replanned: Planning, index: int) -> Planning:
    """The plans with a larger epsilon of a block, whose error includes the cost of that."""
    before, after = (
        combine(each.options.goal, [plan.value for plan in each.blocks[index].plans])
        for each in (planning, replanned)
    )
    blocks, cost = list(replanned.blocks), abs(after - before) / max(abs(after), 1e-300)
    plans = [plan._replace(error=plan.error + cost) for plan in blocks[index].plans]
    blocks[index] = replace(blocks[index], plans=plans)
    return replace(replanned, blocks=tuple(blocks))


def _find_shortfall(planning: Planning, block: BlockPlan, check: ReplayCheck) -> float:
    """Shortfall of c_n below epsilon in the replay of a block [N]; 0 if it is not small."""
    numbers = [phase.number for phase in block.phases]
    phases = check.report.phases if isinstance(check.report, Report) else ()
    contacts = [
        contact for phase in phases if phase.number in numbers for contact in phase.contacts
    ]
    shortfall = -min((contact.margin for contact in contacts), default=0.0)
    # Phase 11 of query 72, over time: 2.1e-3, for microseconds where a contact changes its name.
    return shortfall if 0.0 < shortfall < 4e-3 * planning.problem.scene.scales.force else 0.0


def check_plan(problem: Problem, trajectory: Trajectory, allowance: Allowance) -> ReplayCheck:
    """Replay of a plan, and residual of the equations of motion."""
    residual = find_residual(problem, trajectory)
    try:
        replay = replay_torques(problem, trajectory.torque, trajectory)
    except (JammingError, SimulationError) as error:
        return ReplayCheck(error, residual)
    return ReplayCheck(judge(replay, trajectory, allowance), residual)


def find_residual(problem: Problem, trajectory: Trajectory) -> Residual:
    """Largest residual of the equations of motion at the samples of a trajectory."""
    if len(trajectory.t) < 100 * len(trajectory.motions):
        trajectory = assemble(trajectory.motions, trajectory.torque, {}, 201)  # rows per phase
    largest = Residual(0.0, 1, "")
    # Forces in a dwell are indeterminate.
    moving = ~trajectory.held
    t, phases, *samples = (
        getattr(trajectory, name)[moving] for name in ("t", "phase", *Samples._fields)
    )
    names, torque = trajectory.contacts, trajectory.torque
    motions = sample_phases(t, phases, Samples(*samples), names, torque)
    for phase, motion in zip(problem.phases, motions, strict=True):
        formation = phase.formation
        contacts = {contact.name: contact for contact in formation.contacts}
        motion_contacts = [contacts[name] for name in motion.contacts]
        residual = balance(problem.scene, motion_contacts, formation.rolling, motion.samples)
        size, row, text = residual.find_worst()
        if not size <= largest.size:
            place = f"at t = {motion.t[row]:.5g} s, phase {phase.number}"
            largest = Residual(size, phase.number, f"{text} {place}")
    return largest


class TorqueTable(NamedTuple):
    """Rows of torques, and the results of their replay."""

    rows: Array  # (n, 3) [s, N m, N m]: t, tau_1 and tau_2; a time given twice is a step
    # plain values: rows, rate, interpolation, and of the replay whether it holds, why, and arrival
    # and least normal force of each phase and of the plan's
    figures: dict[str, Any]
    commands: Array | None = None  # (n, 2) [N m]: commands of lagging motors at these times

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the rows as CSV."""
        write_text(path, format_rows(self.rows, self.commands))


def make_table(
    problem: Problem,
    trajectory: Trajectory,
    replay: bool = True,
    rate: float | None = None,
    interpolation: str = "linear",
) -> TorqueTable:
    """A plan's torques in rows as dense as their replay needs, and the results of that.

    Samples at a `rate` [Hz] are replayed as they are; their failure is no error.

    Raises
    ------
    ReplayError                    if the replay loses a contact or misses the goal with any rows
    JammingError, SimulationError  if the simulation cannot go on
    """
    sampling: dict[str, Any] = {}
    if rate is None:
        rows, comparison = _find_rows(problem, trajectory, replay)
    else:
        sampling = {"sample_rate": rate, "interpolation": interpolation}
        rows, comparison = sample_rows(trajectory.torque, rate, interpolation), None
        if replay:
            try:
                simulation = replay_torques(problem, TorqueProfile.join_rows(rows), trajectory)
                comparison = _compare(trajectory, judge(simulation, None, Allowance()))
            except (JammingError, SimulationError) as error:
                comparison = {"ok": False, "reason": str(error), "phases": []}
    lag = problem.scene.actuator_lag
    commands = find_commands(trajectory.torque, lag).at(rows[:, 0]) if lag.any() else None
    return TorqueTable(rows, {"rows": len(rows), **sampling, "replay": comparison}, commands)


def _find_rows(
    problem: Problem, trajectory: Trajectory, replay: bool
) -> tuple[Array, dict[str, Any] | None]:
    """Rows whose replay holds, and its figures, which are None without a `replay`."""
    rate_limit = problem.scene.torque_rate_limit if problem.scene.has_slow_motors else None
    least_error, error = ERROR / _DIVISOR ** (_ATTEMPTS - 1), ERROR
    rows = place_rows(trajectory.torque, error, rate_limit)
    # Limits of motors need no replay: commands step where the slopes of lines do.
    while error > least_error and describe_motors(problem, TorqueProfile.join_rows(rows)):
        error /= 2
        rows = place_rows(trajectory.torque, error, rate_limit)
    if not replay:
        return rows, None
    for _ in range(_ATTEMPTS):
        # The table has to keep the limits of the plan, and to stay near it.
        simulation = replay_torques(problem, TorqueProfile.join_rows(rows), trajectory)
        report = judge(simulation, trajectory, Allowance())
        if report.ok or error <= least_error:
            break
        error = max(error / _DIVISOR, least_error)
        rows = place_rows(trajectory.torque, error, rate_limit)
    if not report.ok:
        report = judge(simulation, None, Allowance())
    if not report.ok:
        raise ReplayError(
            f"the torques as a table of {len(rows)} rows do not hold in their replay: "
            f"{report.reason}; --no-replay (replay=False) leaves the check out"
        )
    return rows, _compare(trajectory, report)


def _compare(trajectory: Trajectory, report: Report) -> dict[str, Any]:
    """Arrival and least normal force of each phase of a replay, with those of the plan."""
    phases = []
    for index in range(len(trajectory.motions)):
        phase = report.phases[index] if index < len(report.phases) else None
        least = phase.least_force if phase else None
        phases.append(
            {
                "phase": index + 1,
                "planned_arrival": float(trajectory.phase_starts[index + 1]),
                "arrival": phase.arrival if phase else None,
                "planned_least_c_n": trajectory.least_forces[index][0],
                "least_c_n": least.value if least else None,
                "contact": least.contact if least else None,
            }
        )
    return {"ok": report.ok, "reason": report.reason, "phases": phases}
