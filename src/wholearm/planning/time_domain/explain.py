"""Why phases have no plan in the time domain, and which single limit would have to give way."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError, InputError, SolverError
from ...geometry.curve import describe_pose
from ...geometry.path_guess import count_freedoms
from ...problem.definition import Phase, Problem
from ..advice import Limit, Shortfall, describe_changes, find_changes, rank_shortfalls
from ..options import Objective
from .limits import LimitRelaxation
from .own_units import to_si
from .search import Search
from .stage import Stage

LONGEST = 1.0
"""Most processor time [s] of one run of the solver that looks for the least shortfalls."""
ADVICE = 1.0
"""Processor time [s] after which no further change of a limit is tried."""
SHORT = 1e-4
"""Least shortfall that counts, of forces over the weight, of torques over that times the radius
of gyration of the object."""

Replan = Callable[[Problem], object]
"""Plans the same phases of another problem; raises if there is no plan."""


def solve_elastic(search: Search, stages: Sequence[Stage]) -> list[Stage] | None:
    """The motion with the least shortfalls when every limit is soft, or None."""
    solution = search.aiming(Objective.ELASTIC).solve(list(stages), seconds=LONGEST)
    return solution.stages if solution.success else None


def refuse(
    search: Search,
    problem: Problem,
    phases: Sequence[Phase],
    stages: Sequence[Stage],
    replan: Replan | None,
) -> None:
    """Raise an error if no motion can begin from rest at the start, or come to rest at the end.

    The end counts where it is one point: where a single phase with one freedom leads. `replan` is
    as for `explain`.

    Raises
    ------
    InfeasibleError
        With the contact that would have to pull, and what single change would do.
    """
    from .resting import EPSILON, find_block, find_change

    epsilon, last = search.problem.epsilon, stages[-1]
    stage, node, phase = stages[0], 0, phases[0]
    blocked = find_block(stage.formation, stage.guess.nodes[0, 0], epsilon)
    say = "from rest at its start, {}, no motion begins in any contact mode"
    alone = len(phases) == 1 and not phase.until.is_release
    if blocked is None and alone and count_freedoms(last.formation, last.guess.nodes[-1, 0]) == 1:
        stage, node = last, -1
        blocked = find_block(last.formation, last.guess.nodes[-1, 0], epsilon, ends=True)
        say = "at its end, {}, no motion comes to rest in any contact mode"
    if blocked is None:
        return
    where = describe_pose(to_si(stage, problem).guess.nodes[node, 0])
    text = f"phase {phase.number} is infeasible: {say.format(where)}"
    if blocked.contact:
        amount = blocked.short * problem.scene.scales.force
        least = f"epsilon = {problem.epsilon:g} N"
        text += f": c_n of {blocked.contact} >= {least} is {amount:.3g} N short at best"
    else:
        text += " within the torque limits"
    ends, z = node == -1, stage.guess.nodes[node, 0]

    def find_least(index: int) -> float | None:
        value = find_change(stage.formation, z, epsilon, index, ends)
        unit = scales.force if index == EPSILON else scales.torque
        return unit * value if value else None

    scales = problem.scene.scales
    raise _advise(problem, text, find_least, replan)


def explain(
    search: Search,
    problem: Problem,
    phases: Sequence[Phase],
    short: Sequence[list[Stage]],
    status: str,
    replan: Replan | None,
) -> InfeasibleError | SolverError:
    """Say why phases have no plan and what would change that.

    Parameters
    ----------
    search : Search
    problem : Problem
        In SI units.
    phases : sequence of Phase
    short : sequence of list of Stage
        What `solve_elastic` found from different guesses, where that is short of something.
    status : str
        How the solver ended, in words.
    replan : callable, optional
        When left out, no change is looked for.
    """
    numbers = " and ".join(str(phase.number) for phase in phases)
    what = f"phase{'s' if len(phases) > 1 else ''} {numbers}"
    if not short:
        names = " and ".join(" ".join(phase.formation.names) for phase in phases)
        text = f"no plan for {what} ({names}, until {phases[-1].until}): {status}"
        return SolverError(f"{text}; try other time_intervals")
    scales = problem.scene.scales

    def sum_up(stages: list[Stage]) -> float:
        return sum(shortfall.amount for shortfall in list_shortfalls(problem, stages))

    elastic = min(short, key=sum_up)
    shortfalls = list_shortfalls(problem, elastic)
    are = "are" if len(phases) > 1 else "is"
    text = f"{what} {are} infeasible: {rank_shortfalls(shortfalls)}"
    relaxations = [
        LimitRelaxation(0.0, (1.0, 0.0)),
        LimitRelaxation(0.0, (0.0, 1.0)),
        LimitRelaxation(1.0),
    ]
    units = [scales.torque, scales.torque, scales.force]
    limits, undecided = _list_limits(problem), list[int]()

    def find_least(index: int) -> float | None:
        solution = search.aiming(Objective.RELAX, relaxations[index]).solve(
            elastic, seconds=LONGEST
        )
        # A limit that may be tighter is not what keeps the others from being kept.
        if not solution.success or solution.cost < 0.0:
            undecided.append(index)
            return None
        return limits[index].value + limits[index].sign * units[index] * solution.cost

    return _advise(problem, text, find_least, replan, undecided)


def _list_limits(problem: Problem) -> list[Limit]:
    """The limits that may give way: both torque limits, and epsilon."""
    torque = problem.scene.torque_limit
    limits = [
        Limit(f"torque limit of finger {k + 1}", float(torque[k]), "N m", 1) for k in range(2)
    ]
    return [*limits, Limit("epsilon", problem.epsilon, "N", -1)]


def _advise(
    problem: Problem,
    text: str,
    find_least: Callable[[int], float | None],
    replan: Replan | None,
    undecided: list[int] | None = None,
) -> InfeasibleError:
    """The error with `text` and what single change of a limit would make a plan possible.

    Parameters
    ----------
    problem : Problem
    text : str
    find_least : callable
        As for `planning.advice.find_changes`.
    replan : callable or None
        Without it no change is looked for.
    undecided : list of int, optional
        Limits of which `find_least` could not tell.
    """
    if replan is None:
        return InfeasibleError(text)
    stop, open_ones = time.thread_time() + ADVICE, [] if undecided is None else undecided

    def look(index: int) -> float | None:
        if time.thread_time() > stop:
            open_ones.append(index)
            return None
        return find_least(index)

    def can_plan(index: int, value: float) -> bool:
        if time.thread_time() > stop:
            open_ones.append(index)
            return False
        try:
            replan(change_limit(problem, index, value))
        except (InfeasibleError, SolverError, InputError):
            return False
        return True

    changes = find_changes(_list_limits(problem), look, can_plan)
    if open_ones and not changes:
        return InfeasibleError(f"{text}; no single limit was found that makes it feasible")
    return InfeasibleError(f"{text}; {describe_changes(changes)}")


def list_shortfalls(problem: Problem, stages: Sequence[Stage]) -> list[Shortfall]:
    """What the motion of stages is short of, each limit where it is worst.

    Parameters
    ----------
    problem : Problem
        In SI units, as the answers are; the stages are in the scene's own.
    stages : sequence of Stage
    """
    stages = [to_si(stage, problem) for stage in stages]
    worst: dict[str, Shortfall] = {}
    passed = 0.0
    for stage in stages:
        for found in _list_of_stage(problem, stage, passed):
            if found.limit not in worst or found.amount > worst[found.limit].amount:
                worst[found.limit] = found
        passed += stage.guess.duration
    return list(worst.values())


def _list_of_stage(problem: Problem, stage: Stage, passed: float) -> list[Shortfall]:
    formation, part = stage.formation, stage.guess
    n_c, count = formation.n_contacts, len(part.fractions)
    c_n, c_t = part.forces[..., :n_c], part.forces[..., n_c:]
    rolling = list(formation.rolling_rows)
    grip = formation.friction[rolling] * (c_n[..., rolling] - problem.epsilon)
    over = np.abs(part.tau) - problem.scene.torque_limit
    names = [f"c_n of {name} >= epsilon = {problem.epsilon:g} N" for name in formation.names]
    names += [
        f"friction cone of {formation.names[k]}, "
        f"|c_t| <= {formation.friction[k]:g} (c_n - {problem.epsilon:g} N),"
        for k in rolling
    ]
    names += [
        f"torque limit of finger {k + 1} = {problem.scene.torque_limit[k]:g} N m" for k in range(2)
    ]

    def flat(table: Array) -> Array:
        return np.asarray(table.max(axis=1))

    short = np.hstack([flat(problem.epsilon - c_n), flat(np.abs(c_t) - grip), flat(over)])
    middles = passed + part.duration * (part.breaks[:-1] + part.fractions / 2)
    spans = np.full(len(names), problem.scene.scales.force)
    spans[-2:] = problem.scene.torque_limit
    found = []
    for column, name in enumerate(names):
        row = int(short[:count, column].argmax())
        joint = column >= len(names) - 2
        scales = problem.scene.scales
        if short[row, column] > SHORT * (scales.torque if joint else scales.force):
            unit = "N m" if joint else "N"
            where = f"t = {middles[row]:.4f} s, phase {stage.phase + 1}"
            amount = float(short[row, column])
            found.append(Shortfall(name, amount, unit, where, amount / spans[column]))
    return found


def change_limit(problem: Problem, index: int, value: float) -> Problem:
    """The problem with another torque limit of finger 1 or 2 (index 0 or 1), or epsilon (2)."""
    if index == 2:
        return replace(problem, epsilon=value)
    right, left = (
        replace(link, torque_limit=value) if k == index else link
        for k, link in enumerate(problem.scene.fingers)
    )
    return replace(problem, scene=replace(problem.scene, fingers=(right, left)))
