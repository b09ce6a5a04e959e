"""Second opinions on refusals, by arguments that share nothing with the planner."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import InputError, WholearmError
from ...planning.plan import solve
from ...problem.definition import End, Phase, Problem
from .cell_curves import best_end, find_best, list_ends
from .event_tracing import Trace, follow, resample
from .slow_motion import fast_margin, inertia_ratio, rest_margin, slow_margin

PLACES = 60  # places along a curve at which limits are looked at
CLEAR = 1e-3  # margin over the scene's weight, or a torque limit, from which a motion surely exists


class Verdict(NamedTuple):
    """What a second look says about a refusal."""

    # {"confirmed", "refuted", "close", "open"}: no motion exists; one does; it depends on rounding
    # or on the discretisation; or there is no second argument
    kind: str
    reason: str


def judge(
    problem: Problem,
    error: WholearmError,
    stops: list[tuple[float, float]],
    objective: str = "time",
) -> Verdict:
    """Judge a refusal to plan a problem whose phases stop at the poses `stops` (x, phi).

    Phases after one with two freedoms begin where the plan of the phases before ends, for the
    `objective` that was asked for.
    """
    match = re.search(r"phases? (\d+)|phases\[(\d+)\]", str(error))
    number = int(match[1] or match[2]) if match else None
    z = problem.start
    open_end = Verdict("open", "")
    planned = False
    for phase in problem.phases:
        concerned = number in (None, phase.number)
        if planned and not concerned:
            continue
        if phase.formation.n_constraints == 4 and not phase.until.is_release:
            # The shortest curve that reaches the phase's end, or the longer one if none does.
            trace = max(
                follow(problem.scene, phase, z),
                key=lambda own: (own.reached, -own.length if own.reached else own.length),
            )
            if trace.length < 0.001 * problem.scene.scales.length:
                return Verdict("close", f"phase {phase.number} has nothing to do")
            if not trace.reached:
                return Verdict("confirmed", f"phase {phase.number}: {trace.ending}")
            if concerned:
                verdict = _judge_curve(problem, phase, trace)
                if verdict.kind != "refuted" or number is not None:
                    return verdict
                open_end = verdict
            z = trace.end
            continue
        if concerned and phase.index < len(stops):
            return _judge_cell(problem, phase, z, stops[phase.index])
        before = None if concerned or number is None else _find_start(problem, number, objective)
        if before is None:
            return Verdict("open", f"phase {phase.number} ends where the planner chooses")
        z, planned = before, True
    if isinstance(error, InputError) and not open_end.reason:
        return Verdict("refuted", "every phase reaches its until")
    return open_end


def _find_start(problem: Problem, number: int, objective: str) -> Array | None:
    """Where the plan of the phases before one ends at rest; None if there is none.

    For the largest margin, phases go on from where plans of least time end.
    """
    before = problem.phases[: number - 1]
    if not before or before[-1].end is not End.REST:
        return None
    try:
        goal = "time" if objective == "margin" else objective
        plan = solve(replace(problem, phases=before), goal, replay=False)
    except WholearmError:
        return None
    motion = plan.trajectory.motions[-1]
    return np.asarray(motion.evaluate(np.array([motion.duration])).z[0])


def _judge_curve(problem: Problem, phase: Phase, trace: Trace) -> Verdict:
    scene, epsilon = problem.scene, problem.epsilon
    s, z, z_s = resample(scene, phase, trace, PLACES)
    slow = slow_margin(scene, phase, epsilon, z, z_s)
    free = float(inertia_ratio(scene, phase, z, z_s).min())
    at = f"phase {phase.number}"
    # Of the reduced inertia without friction.
    if free < 0.02:
        return Verdict("confirmed" if free < 0.0 else "close", f"{at}: inertia ratio {free:.3g}")
    if slow > CLEAR:
        return Verdict("refuted", f"{at}: a slow motion keeps all limits by {slow:.3g}")
    rests = (_stops_before(problem, phase), phase.end is End.REST)
    fast = fast_margin(scene, phase, epsilon, (s, z, z_s), rests)
    if fast < -1e-7:
        return Verdict("confirmed", f"{at}: no motion keeps all limits, {fast:.3g} short")
    if np.isnan(fast):
        return Verdict("open", f"{at}: the linear programme has no answer")
    if fast > CLEAR and not scene.viscous.any():
        return Verdict("refuted", f"{at}: a motion keeps all limits by {fast:.3g}")
    return Verdict("close", f"{at}: slow {slow:.3g}, fast {fast:.3g}")


def _stops_before(problem: Problem, phase: Phase) -> bool:
    return phase.index == 0 or problem.phases[phase.index - 1].end is End.REST


def _judge_cell(problem: Problem, phase: Phase, z: Array, stop: tuple[float, float]) -> Verdict:
    scene, epsilon, at = problem.scene, problem.epsilon, f"phase {phase.number}"
    if not _stops_before(problem, phase) or phase.end is not End.REST or phase.until.is_release:
        return Verdict("open", f"{at} does not go from rest to rest")
    begins = rest_margin(scene, phase, epsilon, z)
    if begins < -CLEAR:
        return Verdict("confirmed", f"{at}: no motion from rest at the start, {begins:.3g}")
    ends = list_ends(scene, phase, z, stop)
    if not len(ends):
        return Verdict("open", f"{at}: no place of its end was found")
    stopped = best_end(scene, phase, epsilon, ends)
    if stopped < -CLEAR:
        reason = f"{at}: no motion comes to rest at any of {len(ends)} places, {stopped:.3g}"
        return Verdict("confirmed", reason)
    best = find_best(scene, phase, epsilon, z, ends)
    text = f"{at}: of {best.curves} curves to {best.ends} places the best has {best.margin:.3g}"
    if best.margin > CLEAR:
        return Verdict("refuted", text)
    text += f", {best.loose:.3g} if slow contacts may stick"
    least = max(best.margin, best.loose)
    # Where the best of many curves misses limits by so much, surely none keeps them.
    return Verdict("confirmed" if best.curves and least < -0.02 else "close", text)
