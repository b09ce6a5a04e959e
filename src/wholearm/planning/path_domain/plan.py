"""Planning one-freedom phases: first guess, NLP, and limits that hold between nodes too.

The NLP of `nlp` keeps the limits at its nodes. Once it is solved, nodes are redistributed towards
where limits are missed most between them (where the plan switches from one to another). Then
limits are tightened by what they miss and the NLP is solved again from where it was, until nothing
misses more than `MISS`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError, JammingError, SolverError, WholearmError
from ...common.shortfalls import Parameter
from ...geometry.curve import Curve
from ..advice import describe_changes, find_changes, name_phases
from ..options import Objective, PlanOptions
from ..phase_plan import PhasePlan
from .data import PhaseData, StalledError, cut, fit_torque, join, prepare
from .first_guess import guess, guess_slowly
from .misses import MISS, ROUNDS, Misses, PathSolution
from .motion import Grid, PathMotion, Profile, make_grid, redistribute_nodes
from .nlp import (
    PathNLP,
    Tightening,
    Units,
    build_path_nlp,
    first_multipliers,
    make_bounds,
    move_multipliers,
    pack,
    parameters,
    unpack,
)
from .terms import LimitShape

_COARSE = 1.5e-4
"""Miss, over the typical force or torque, above which the grid is drawn together."""
_FAST = 1e-2
"""The same for the square of a speed limit, relatively."""
_LEVER = 30.0
"""Lever at which the typical force makes the typical torque, in radii of gyration."""
_FINER = (1, 2, 4)
"""Intervals to try, over those that are asked for."""


@dataclass(frozen=True)
class _Task:
    """What is planned: see `plan_curves`."""

    curves: Sequence[Curve]
    epsilon: float
    options: PlanOptions
    phases: Sequence[int]
    duration: float | None

    @property
    def name(self) -> str:
        """The phases, for messages."""
        return name_phases(self.phases)

    @property
    def lost(self) -> float:
        """Least normal force below which a margin is none [N]."""
        return self.epsilon - MISS * self.curves[0].formation.scene.scales.force

    def prepare(self, grids: Iterable[Grid]) -> list[PhaseData]:
        """What each phase gives the NLP on its grid."""
        given = zip(self.curves, grids, self.phases, strict=True)
        return [prepare(curve, self.epsilon, grid, phase) for curve, grid, phase in given]


class _Stuck(NamedTuple):
    """What has come instead of a plan.

    Attributes
    ----------
    parts : list of PhaseData
        The phases on their grids.
    reason : str
    between : bool
        Whether limits can be kept at the nodes, but not between them on so coarse a grid.
    """

    parts: list[PhaseData]
    reason: str
    between: bool


_Plans = list[PhasePlan[PathMotion]]


def plan_path(
    curve: Curve,
    epsilon: float,
    options: PlanOptions,
    phase: int,
    duration: float | None = None,
) -> PhasePlan[PathMotion]:
    """Plan one phase along a curve, from rest to rest; see `plan_curves`."""
    return plan_curves((curve,), epsilon, options, (phase,), duration)[0]


def plan_curves(
    curves: Sequence[Curve],
    epsilon: float,
    options: PlanOptions,
    phases: Sequence[int],
    duration: float | None = None,
    explained: bool = True,
) -> list[PhasePlan[PathMotion]]:
    """Plan phases along curves that are run through one after the other, from rest to rest.

    Parameters
    ----------
    curves : sequence of Curve
        With such speed ratios that the speed is the same on both sides of where two of them meet.
    epsilon : float, [N]
        Least normal force.
    options : PlanOptions
    phases : sequence of int
        The phases' numbers, for messages.
    duration : float, optional, [s]
        Longest duration of all, for the objective `margin`.
    explained : bool
        Whether to find out why there is no plan, which takes longer than planning.

    Raises
    ------
    InfeasibleError
        If no motion keeps the limits; names what is short, where and by how much, and each single
        limit with which there would be a plan.
    JammingError
        If friction jams a formation somewhere on its curve.
    SolverError
        If the solver stops without an answer.
    """
    task = _Task(curves, epsilon, options, phases, duration)

    def replan(changed: Sequence[Curve], least: float) -> object:
        return _insist(_plan_finer(replace(task, curves=changed, epsilon=least)))

    try:
        plans = _plan_finer(task)
    except JammingError as jam:
        if not explained or len(curves) > 1:
            raise
        from .explain import explain_jam

        raise explain_jam(curves[0], epsilon, jam, replan) from None
    if isinstance(plans, _Stuck):
        if not explained:
            raise SolverError(plans.reason)
        from .explain import explain

        guessed = guess_slowly(join(plans.parts))
        raise _explain_duration(task) or explain(
            plans.parts, *guessed, phases, plans.reason, replan
        )
    if options.goal is Objective.MARGIN and plans[0].value < task.lost:
        late = _explain_duration(task)
        raise late or SolverError(f"{task.name}: the margin found is below epsilon")
    return plans


def _explain_duration(task: _Task) -> InfeasibleError | None:
    """Say so if the duration is shorter than the least time, and which one would do."""
    duration = task.duration
    if duration is None:
        return None
    fastest = replace(task.options, objective=Objective.TIME, duration=None)
    try:
        plans = _insist(_plan(replace(task, options=fastest, duration=None)))
    except WholearmError:
        return None
    least = sum(plan.value for plan in plans)
    if least <= duration:
        return None

    def can_plan(_: Parameter, value: float) -> bool:
        try:
            return _insist(_plan(replace(task, duration=value)))[0].value >= task.epsilon
        except SolverError:
            return False

    own = Parameter("duration", duration, "s", 1, "duration")
    changes = find_changes([own], lambda _: least, can_plan)
    return InfeasibleError(
        f"{name_phases(task.phases, 'infeasible')}: duration = {duration:g} s is "
        f"{least - duration:.3g} s shorter than the least time; {describe_changes(changes)}",
        changes=changes,
    )


def _insist(found: _Plans | _Stuck) -> _Plans:
    """The plans, or an error."""
    if isinstance(found, _Stuck):
        raise SolverError(found.reason)
    return found


def _plan_finer(task: _Task) -> _Plans | _Stuck:
    """Plan, on a finer grid where limits that hold between the nodes leave nothing, or no time."""
    for finer in _FINER:
        own = replace(task.options, intervals=finer * task.options.intervals)
        found = _plan(replace(task, options=own))
        if isinstance(found, _Stuck):
            if not found.between:
                break
        elif own.goal is not Objective.MARGIN or found[0].value >= task.lost:
            break
    return found


def _plan(task: _Task) -> _Plans | _Stuck:
    """Solve, redistribute nodes once and tighten limits until they hold between nodes too."""
    options = task.options
    parts = task.prepare(make_grid(curve, options.intervals) for curve in task.curves)
    data = join(parts)
    nlp = build_path_nlp(LimitShape.of(data.limits), len(data.grid.steps), options.goal)
    profile, units = guess(data, options.time_weight)
    tightening = Tightening.none(data, task.duration)
    solution = PathSolution(profile, 0.0, first_multipliers(nlp, data, profile, units))
    for solves in range(1, ROUNDS + 1):
        found = _solve(nlp, data, units, tightening, solution, options.time_weight)
        if isinstance(found, str):
            return _Stuck(parts, f"{task.name}: {found}", between=solves > 1)
        solution = found
        pairs = zip(parts, cut(parts, solution.profile), strict=True)
        motions = [PathMotion(part.curve, part.grid, own) for part, own in pairs]
        misses = Misses.of(data, solution, motions, task.duration)
        if misses.find_worst(data) <= MISS:
            try:
                return _summarise(task, parts, motions, solution)
            except StalledError as stall:
                return _Stuck(parts, f"{task.name}: {stall}", between=True)
        coarse = _weigh(data, misses, units)
        if solves == 1 and coarse.max() > 1:
            old = data.grid
            shares = np.split(coarse, np.cumsum([len(part.nonempty) for part in parts])[:-1])
            parts = task.prepare(
                redistribute_nodes(part.grid, part.nonempty, share)
                for part, share in zip(parts, shares, strict=True)
            )
            data = join(parts)
            moved = Profile(*(np.interp(data.grid.s, old.s, part) for part in solution.profile))
            multipliers = move_multipliers(nlp, solution.multipliers, old, data.grid)
            solution = solution._replace(profile=moved, multipliers=multipliers)
        else:
            tightening = misses.tighten(data, tightening, solution)
    return _Stuck(parts, f"{task.name}: {misses.describe(data)}", between=True)


def _summarise(
    task: _Task,
    parts: Sequence[PhaseData],
    motions: Sequence[PathMotion],
    solution: PathSolution,
) -> _Plans:
    """The plan of each phase."""
    plans: _Plans = []
    for part, motion in zip(parts, motions, strict=True):
        torque, squares = fit_torque(part, motion)
        value = {
            Objective.TIME: motion.duration,
            Objective.EFFORT: squares + task.options.time_weight * motion.duration,
            Objective.MARGIN: task.epsilon + solution.margin,
        }[task.options.goal]
        plans.append(PhasePlan(motion, torque, value))
    return plans


def _weigh(data: PhaseData, misses: Misses, units: Units) -> Array:
    """How much each solid interval misses of what draws the grid together, shape (n_solid,)."""
    lever = _LEVER * data.curve.formation.scene.scales.length
    of_torque = np.isin(data.limits.sides[0], np.flatnonzero(data.limits.columns[1].any(axis=1)))
    forces = (misses.short / np.where(of_torque, lever, 1.0)).max(axis=1)
    return np.asarray(np.maximum(forces / (_COARSE * units.force), misses.speeding / _FAST))


def _solve(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    tightening: Tightening,
    start: PathSolution,
    time_weight: float,
) -> PathSolution | str:
    """Solve once; the solution, or in words how the solver ended."""
    bounds = make_bounds(nlp, data, units, tightening)
    if (bounds["lbg"] > bounds["ubg"]).any():
        return "limits that hold between the nodes too leave nothing"
    result = nlp.solver(
        x0=pack(nlp, start.profile, units, start.margin),
        p=parameters(nlp, data, units, time_weight),
        **bounds,
        **start.multipliers,
    )
    stats = nlp.solver.stats()
    if not stats["success"]:
        return f"Ipopt stopped with {stats['return_status']}"
    profile, margin = unpack(nlp, data.grid, result["x"].full()[:, 0], units)
    multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
    return PathSolution(profile, margin, multipliers)
