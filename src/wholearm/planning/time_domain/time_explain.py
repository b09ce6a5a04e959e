"""Reasons of infeasibility in the time domain by the elastic problem, and changes of one limit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ...common.errors import InfeasibleError, LimitPlace, Parameter, Shortfall, SolverError
from ...geometry.curve import describe_pose
from ...geometry.path_guess import count_freedoms
from ...mechanics.limits import EPSILON, PRESS, make_limits
from ...mechanics.statics import Statics, pushes_one_way
from ...problem.definition import Phase, Problem
from ...scene.model import Scales
from .. import advice
from ..options import Objective, PlanOptions
from ..stops import runs_along_curves
from .collocation import Scheme, blend
from .guesses import PathMargin
from .search import TimeSearch
from .stage import Stage, StagePoints, to_si
from .time_motion import make_phase_motions

MISSED = 0.02  # least margin by which limits are missed along an infeasible path
MET = 0.98  # share of a limit above which it is active
ADVICE = 0.6  # processor time [s] after which no further change of a limit is tried
Replan = Callable[[Problem], object]  # plans the same phases of another problem, or raises


def solve_elastic(search: TimeSearch, stages: Sequence[Stage]) -> list[Stage] | None:
    """The motion of least violation with soft limits, or None."""
    solution = search.aiming(Objective.ELASTIC).solve(list(stages))
    return solution.stages if solution.success else None


def refuse(
    search: TimeSearch,
    problem: Problem,
    phases: Sequence[Phase],
    stages: Sequence[Stage],
    replan: Replan | None,
) -> None:
    """Raise an InfeasibleError if no motion can begin from rest, or come to rest at the end.

    The end counts if it is one point, of a single phase with one degree of freedom. `replan` is as
    for `explain`.
    """
    epsilon, last = search.problem.epsilon, stages[-1]
    stage, node, phase = stages[0], 0, phases[0]
    blocked = Statics(stage.formation, stage.guess.nodes[0, 0]).find_block(epsilon)
    say = "from rest at its start, {}, no motion begins in any contact mode"
    alone = len(phases) == 1 and not phase.until.is_release
    if blocked is None and alone and count_freedoms(last.formation, last.guess.nodes[-1, 0]) == 1:
        stage, node = last, -1
        blocked = Statics(last.formation, last.guess.nodes[-1, 0]).find_block(epsilon, ends=True)
        say = "at its end, {}, no motion comes to rest in any contact mode"
    if blocked is None:
        _refuse_pushed(problem, phases[0], stages if alone else ())
        if problem.scene.has_slow_motors:
            _refuse_unheld(problem, phases[0], stages[0], 0)
            if alone and (last.formation.n_constraints == 4 or phase.until.pins):
                _refuse_unheld(problem, phases[0], last, -1)
        return
    where = describe_pose(to_si(stage, problem).guess.nodes[node, 0])
    text = f"phase {phase.number} is infeasible: {say.format(where)}"
    shortfalls = list[Shortfall]()
    if blocked.contact:
        amount = blocked.short * problem.scene.scales.force
        limit = f"c_n of {blocked.contact} >= epsilon = {problem.epsilon:g} N"
        text += f": {limit} is {amount:.3g} N short at best"
        place = LimitPlace(phase.number, math.nan, where)
        shortfalls.append(
            Shortfall(PRESS, blocked.contact, limit, amount, "N", place, blocked.short)
        )
    else:
        text += " within the torque limits"
    ends, statics = node == -1, Statics(stage.formation, stage.guess.nodes[node, 0])

    def find_value(parameter: Parameter) -> float | None:
        if parameter.is_speed:
            return None
        if parameter.key == EPSILON:
            value = statics.find_epsilon(ends)
        else:
            finger = int(parameter.key.split(".")[1]) - 1
            value = statics.find_torque_limit(epsilon, finger, ends)
        return _unit_of(parameter, problem.scene.scales) * value if value else None

    raise _advise(problem, phase, text, find_value, replan, shortfalls)


def _refuse_pushed(problem: Problem, phase: Phase, stages: Sequence[Stage]) -> None:
    """Raise an error if contacts can push the object only one way, along all of the guess."""
    if not stages or stages[0].formation.n_constraints > 2:
        return
    z = np.concatenate([stage.guess.z.reshape(-1, 5) for stage in stages])
    if pushes_one_way(stages[0].formation, z):
        names = " ".join(stages[0].formation.names)
        where = describe_pose(to_si(stages[-1], problem).guess.nodes[-1, 0])
        raise InfeasibleError(
            f"phase {phase.number} is infeasible: {names} can only push the object one way, with "
            f"whatever friction, so that it does not come to rest at its end, {where}"
        )


def _refuse_unheld(problem: Problem, phase: Phase, stage: Stage, node: int) -> None:
    """Raise an error if rate-limited torques cannot hold the object at rest at an end."""
    z, limit = to_si(stage, problem).guess.nodes[node, 0], problem.scene.torque_limit
    held = Statics(phase.formation, z).torque_polygon()
    if not held.is_empty(limit):
        return
    most = "however large" if held.is_empty(np.full(2, np.inf)) else "within their limits"
    raise InfeasibleError(
        f"phase {phase.number} is infeasible: torques may not step (torque_rate_limit, "
        f"actuator_lag), so that they have to hold the object at rest at its "
        f"{'end' if node else 'start'}, {describe_pose(z)}; {' '.join(phase.formation.names)} with "
        f"their friction can be held there by no torques, {most}; end the phase where they can "
        "(wholearm predict shows where), or leave out torque_rate_limit and actuator_lag"
    )


def explain(
    search: TimeSearch,
    problem: Problem,
    phases: Sequence[Phase],
    short: Sequence[list[Stage]],
    status: str,
    replan: Replan | None,
) -> InfeasibleError | SolverError:
    """Error that says why phases have no plan and what would change that.

    Parameters
    ----------
    problem  in SI units
    short    elastic solutions that violate limits, from different guesses
    status   how the solver ended, in words
    replan   None: no change is looked for
    """
    numbers = [phase.number for phase in phases]
    if not short:
        names = " and ".join(" ".join(phase.formation.names) for phase in phases)
        where = advice.name_phases(numbers)
        text = f"no plan for {where} ({names}, until {phases[-1].until}): {status}"
        usual = search.options.transcription == "time" and not problem.scene.control_period
        if usual and runs_along_curves(phases, PlanOptions()):
            return SolverError(f"{text}; leave out --transcription time, which plans along curves")
        return SolverError(f"{text}; try another number of intervals per phase (--time-intervals)")

    lists = [list_shortfalls(problem, stages, search.scheme) for stages in short]
    sums = [sum(shortfall.amount for shortfall in shortfalls) for shortfalls in lists]
    best = sums.index(min(sums))
    elastic, ranked = short[best], advice.rank_shortfalls(lists[best])
    stages = [to_si(stage, problem) for stage in elastic]

    def find_value(parameter: Parameter) -> float | None:
        if not is_met(parameter, [stage.guess for stage in stages], ranked):
            return np.nan
        solution = search.aiming(Objective.RELAX, parameter).solve(elastic)
        # A limit that may be tighter is not in conflict with the others.
        if not solution.success or solution.cost < 0.0:
            return np.nan
        unit = _unit_of(parameter, problem.scene.scales)
        return parameter.value + parameter.sign * unit * solution.cost

    text = f"{advice.name_phases(numbers, 'infeasible')}: {advice.describe_shortfalls(ranked)}"
    error = _advise(problem, phases[0], text, find_value, replan, ranked)
    motions = make_phase_motions(stages, search.scheme, phases)
    torques = [motion.torque for motion in motions]
    error.motion = advice.assemble_least(motions, torques, [phase.formation for phase in phases])
    return error


def is_met(
    parameter: Parameter, motion: Sequence[StagePoints], shortfalls: Sequence[Shortfall]
) -> bool:
    """Whether the limit of a parameter is active in the elastic motion.

    That of epsilon is if no normal force is short of more than epsilon.
    """
    if parameter.key == EPSILON:
        return all(each.amount < parameter.value for each in shortfalls if each.kind == PRESS)
    finger = int(parameter.key.split(".")[1]) - 1
    tables = [part.v[..., 3:] if parameter.is_speed else part.tau for part in motion]
    most = max(float(np.abs(table[..., finger]).max()) for table in tables)
    return most > MET * parameter.value


def refuse_paths(problem: Problem, phase: Phase, margins: Sequence[PathMargin]) -> None:
    """Raise an InfeasibleError with the critical limit if along every path one is missed."""
    if not margins or (best := max(margins, key=lambda own: own.value)).value > -MISSED:
        return
    limits = make_limits(phase.formation, problem.epsilon).limits
    limit = next(own for own in limits if (own.kind, own.part) == best[1:3])
    place, missed = LimitPlace(phase.number, math.nan, "the best of them"), -best.value
    amount = missed * limit.scale
    shortfall = Shortfall(*best[1:3], limit.text, amount, limit.unit, place, missed)
    raise InfeasibleError(
        f"phase {phase.number} is infeasible along all straight paths to its ends, at any speed: "
        f"{shortfall}",
        [shortfall],
    )


def _unit_of(parameter: Parameter, scales: Scales) -> float:
    """The scene's unit of a parameter in SI units."""
    return {"N": scales.force, "N m": scales.torque, "rad/s": 1 / scales.time}[parameter.unit]


def _advise(
    problem: Problem,
    phase: Phase,
    text: str,
    find_value: Callable[[Parameter], float | None],
    replan: Replan | None,
    shortfalls: Sequence[Shortfall],
) -> InfeasibleError:
    """Error with `text` and the changes of a single limit that make a plan possible.

    `shortfalls` are the data of the text; for the others see `planning.advice.advise`.
    """

    def change(parameter: Parameter, value: float) -> object:
        assert replan is not None
        return replan(change_limit(problem, parameter.key, value))

    parameters = make_limits(phase.formation, problem.epsilon).parameters
    found = advice.advise(text, parameters, find_value, change if replan else None, ADVICE)
    return InfeasibleError(found.text, shortfalls, found.changes)


def list_shortfalls(problem: Problem, stages: Sequence[Stage], scheme: Scheme) -> list[Shortfall]:
    """Violations of limits by the motion of stages in the scene's units, each where it is worst.

    They are looked at in SI units, at the collocation points, torques also at ends of intervals.
    """
    shortfalls, passed = list[Shortfall](), 0.0
    pick = np.array([0, *range(scheme.degree), scheme.degree - 1])
    at = np.concatenate([[0.0], scheme.points, [1.0]])
    for stage in (to_si(stage, problem) for stage in stages):
        limits, part = make_limits(stage.formation, problem.epsilon), stage.guess
        tau = blend(at, part.tau.shape[1]) @ part.tau
        y = np.concatenate([part.forces[:, pick], tau, part.v[:, pick, 3:]], axis=2)
        middles = passed + part.duration * (part.breaks[:-1] + part.fractions / 2)
        places = [
            LimitPlace(stage.phase + 1, t, f"t = {t:.4f} s, phase {stage.phase + 1}")
            for t in np.repeat(middles, len(pick)).tolist()
        ]
        values = (y @ limits.rows.T).reshape(-1, len(limits.low))
        shortfalls += advice.list_shortfalls(limits, values, places.__getitem__)
        passed += part.duration
    return advice.keep_worst(shortfalls)


def change_limit(problem: Problem, key: str, value: float) -> Problem:
    """The problem with another value of a parameter of its limits."""
    if key == EPSILON:
        return replace(problem, epsilon=value)
    return replace(problem, scene=advice.change_scene(problem.scene, key, value))
