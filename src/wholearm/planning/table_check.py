"""Torque tables and sampled torques of a plan, verified by simulation."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import JammingError, ReplayError, SimulationError
from ..common.files import write_text
from ..problem.definition import Problem
from ..results.report import Report
from ..results.torque import ERROR, format_rows, place_rows, read_rows, sample_rows
from ..results.trajectory import Trajectory
from ..verification.verdict import Allowance, find_least_force
from ..verification.verify import describe_motors, find_commands, judge, observe

FINER = 8.0  # divisor of the error of the rows of a table when its replay does not hold
ATTEMPTS = 3  # most tables that are tried


class TorqueTable(NamedTuple):
    """Rows of torques, and what their replay does."""

    rows: Array  # (n, 3) [s, N m, N m]: t, tau_1 and tau_2; a time given twice is a step
    # plain values: rows, rate, interpolation, and of the replay whether it holds, why, and arrival
    # and least normal force of each phase and of the plan's
    figures: dict[str, Any]
    commands: Array | None = None  # (n, 2) [N m]: what motors that lag are told at these times

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the rows as CSV."""
        write_text(path, format_rows(self.rows, self.commands))


def _list_commands(problem: Problem, trajectory: Trajectory, rows: Array) -> Array | None:
    """What motors are told at the times of rows, if they lag."""
    lag = problem.scene.actuator_lag
    return find_commands(trajectory.torque, lag).at(rows[:, 0]) if lag.any() else None


def make_table(problem: Problem, trajectory: Trajectory, replay: bool = True) -> TorqueTable:
    """Rows as dense as a simulation of them needs to hold.

    Raises
    ------
    ReplayError                    if the replay loses a contact or misses the goal with any rows
    JammingError, SimulationError  if the simulation cannot go on
    """
    slow = problem.scene.has_slow_motors
    rate_limit = problem.scene.torque_rate_limit if slow else None
    least, error = ERROR / FINER ** (ATTEMPTS - 1), ERROR
    rows = place_rows(trajectory.torque, error, rate_limit)
    # Commands step where the slopes of lines do, so that motors' limits need no replay.
    while error > least and describe_motors(problem, read_rows(rows)):
        error /= 2
        rows = place_rows(trajectory.torque, error, rate_limit)
    if not replay:
        commands = _list_commands(problem, trajectory, rows)
        return TorqueTable(rows, {"rows": len(rows), "replay": None}, commands)
    for _ in range(ATTEMPTS):
        # The table has to keep the limits of the plan, and to stay near it.
        seen = observe(problem, read_rows(rows), trajectory)
        report = judge(seen, Allowance())
        if report.ok or error <= least:
            break
        error = max(error / FINER, least)
        rows = place_rows(trajectory.torque, error, rate_limit)
    if not report.ok:
        report = judge(seen._replace(plan=None), Allowance())
    if not report.ok:
        raise ReplayError(
            f"the torques as a table of {len(rows)} rows do not hold in their replay: "
            f"{report.reason}; --no-replay (replay=False) leaves the check out"
        )
    figures = {"rows": len(rows), "replay": _compare(trajectory, report)}
    return TorqueTable(rows, figures, _list_commands(problem, trajectory, rows))


def sample_table(
    problem: Problem, trajectory: Trajectory, rate: float, interpolation: str, replay: bool = True
) -> TorqueTable:
    """Samples of a plan's torques at a rate [Hz], and their replay, whose failure is no error."""
    rows = sample_rows(trajectory.torque, rate, interpolation)
    commands = _list_commands(problem, trajectory, rows)
    figures: dict[str, Any] = {
        "rows": len(rows),
        "sample_rate": rate,
        "interpolation": interpolation,
        "replay": None,
    }
    if replay:
        try:
            seen = observe(problem, read_rows(rows), trajectory)
            report = judge(seen._replace(plan=None), Allowance())
            figures["replay"] = _compare(trajectory, report)
        except (JammingError, SimulationError) as error:
            figures["replay"] = {"ok": False, "reason": str(error), "phases": []}
    return TorqueTable(rows, figures, commands)


def _compare(trajectory: Trajectory, report: Report) -> dict[str, Any]:
    """Arrival and least normal force of each phase of a replay, beside those of the plan."""
    phases = []
    for index in range(len(trajectory.motions)):
        phase = report.phases[index] if index < len(report.phases) else None
        least = find_least_force(phase) if phase else None
        planned = trajectory.c_n[trajectory.phase == index]
        phases.append(
            {
                "phase": index + 1,
                "planned_arrival": float(trajectory.phase_starts[index + 1]),
                "arrival": phase.arrival if phase else None,
                "planned_least_c_n": float(np.nanmin(planned)),
                "least_c_n": least.least if least else None,
                "contact": least.contact if least else None,
            }
        )
    return {"ok": report.ok, "reason": report.reason, "phases": phases}
