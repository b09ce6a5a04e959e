"""The time domain: order of convergence, and cost of its blocks."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np

from ..common.arrays import Array
from ..geometry.tracing import runs_on_curve, trace_phases
from ..planning.options import Objective, PlanOptions
from ..planning.plan import solve
from ..planning.time_domain.collocation import make_scheme
from ..planning.time_domain.motion import TimeMotion, make_motions
from ..planning.time_domain.own_units import to_si
from ..planning.time_domain.search import Search
from ..planning.time_domain.staging import guess_stages
from ..problem.definition import Phase, Problem
from ..simulation.simulate import simulate
from .report import Row

SCHEMES = (("radau", 2), ("radau", 3), ("radau", 4), ("legendre", 2), ("legendre", 3))
"""Schemes whose order is measured."""
ORDER_INTERVALS = (4, 8, 16, 32)
_FALLS = 2.0


def measure_order(problem: Problem) -> list[Row]:
    """Error of collocation at the end of a phase over the number of intervals.

    A phase without reversals is planned for least effort, and its torques are integrated by the
    simulator. The error is the largest difference of any z from the last node.
    """
    curves = trace_phases(problem)
    smooth = [k for k, curve in enumerate(curves) if len(curve.segments) == 1]
    if not smooth:
        return []
    index = smooth[-1]
    z = curves[index - 1].end if index else problem.start
    alone = _isolate(problem, index, z)
    rows = []
    for name, degree in SCHEMES:
        before = math.nan
        for intervals in ORDER_INTERVALS:
            started = time.perf_counter()
            error = find_end_error(alone, name, degree, intervals)
            seconds = time.perf_counter() - started
            order = make_scheme(name, degree).order
            note = "" if math.isfinite(error) else "the replay ends early"
            if math.isfinite(before) and math.isfinite(error):
                note = f"order {math.log2(before / error):.2f} observed, {order} in theory"
            setting = f"{intervals} intervals"
            known = error if math.isfinite(error) else None
            rows.append(
                Row("time domain: order", f"{name} {degree}", setting, seconds, known, note)
            )
            before = error
    return rows


def _isolate(problem: Problem, index: int, z: Array) -> Problem:
    """One phase of a problem as a problem of its own."""
    phase = problem.phases[index]
    alone = Phase(0, phase.formation, phase.until)
    return Problem(problem.name, problem.scene, problem.epsilon, z, (alone,), problem.source)


def find_end_error(problem: Problem, name: str, degree: int, intervals: int) -> float:
    """Largest difference of any z between simulation and collocation at the end, or NaN."""
    scheme = make_scheme(name, degree)
    # With linear torques motions on few intervals are as smooth as those on many.
    search = replace(Search.of(problem, PlanOptions(Objective.EFFORT)), scheme=scheme)
    stages = guess_stages(problem, problem.phases, problem.start, scheme, intervals, _FALLS)
    found = [to_si(stage, problem) for stage in search.solve(stages).stages]
    torque = TimeMotion(make_motions(found, scheme)).torque
    simulation = simulate(problem, torque, tolerance=1e-13, times=torque.breaks[-1:])
    if simulation.t[-1] < torque.breaks[-1] - 1e-3 * torque.duration:
        return math.nan
    return float(np.abs(simulation.z[-1] - found[-1].guess.nodes[-1, 0]).max())


def measure_blocks(problem: Problem) -> list[Row]:
    """Planning of phases that need the time domain, for every objective.

    The error is the largest difference of any z, at the end of any phase, from the simulation.
    """
    rows: list[Row] = []
    if all(runs_on_curve(phase) for phase in problem.phases):
        return rows
    for goal in ("time", "effort", "margin"):
        plan = solve(problem, goal)
        trajectory, timings = plan.trajectory, plan.timings
        ends = trajectory.phase_starts[1:]
        simulation = simulate(problem, trajectory.torque, tolerance=1e-11, times=ends)
        missed = 0.0
        for motion, end in zip(trajectory.motions, ends, strict=True):
            planned = motion.evaluate(np.array([motion.duration])).z[0]
            missed = max(missed, float(np.abs(planned - simulation.at(end)[:5]).max()))
        for phase, motion in zip(plan.phases, trajectory.motions, strict=True):
            cost = phase.statistics
            if isinstance(motion, TimeMotion) and cost.solves:
                note = f"{cost.iterations} iterations in {cost.solves} solves"
                note += f" from phase {phase.number}"
        share = timings.build / timings.plan
        note += f"; building is {share:.0%} of planning"
        rows.append(Row("time domain: whole plans", goal, "default", timings.plan, missed, note))
    return rows
