"""Minimum-time, minimum-effort and maximum-margin plans of phases with one degree of freedom.

Direct collocation along the curve (`path_nlp`) with mesh refinement. Elements are made to end where
the solution switches, and doubled where it violates limits between nodes (`refine`). Then limits
are tightened by their violations until none exceeds `MISS`. The cost of that estimates the error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...common.errors import InfeasibleError, JammingError, Parameter, SolverError, WholearmError
from ...geometry.curve import Curve
from ..advice import describe_changes, find_changes, name_phases
from ..options import DEFAULT_ACCURACY, Objective, PlanOptions
from ..phase_plan import PhasePlan
from ..robust.robust_rows import Guide
from .first_guess import guess_slowly
from .interpolation import StalledError
from .path_data import PhaseData, join
from .path_mesh import SHIFTED
from .path_motion import PathMotion
from .refine import Iterate, Plans
from .speed_profile import is_hopeless
from .task import Pins, Task, require_unique
from .unique_start import WORTH, find_sure_start
from .violations import MISS, SOLVES

_MESHES = 6  # most mesh changes before limits are tightened
_RATE_LIMITED_MESHES = 3  # the same under rate limits
_AGAIN = 3  # most times that limits are tightened, each on a finer mesh
_REFINEMENTS = (1, 2, 4)  # factors on the wanted number of elements
_LINEARIZATIONS = 3  # most robust plans, each with rows for the speed of the one before
# Violation at nodes by other signs than those of the rows, over the limits' scales, above which a
# first plan is a reference only; case: two releases of a pentagon, whose plan takes 20 % longer.
_OTHER_SIGNS = 0.05
_WASTED = 0.02  # share of the accuracy that excessive tightening may cost
ROUGH = 1e-2  # accuracy of plans that only have to exist


class Stuck(NamedTuple):
    """Failure of a plan."""

    parts: list[PhaseData]  # the phases on their grids
    reason: str
    between: bool  # whether limits can be kept at the nodes of this grid, but not between them


class _Solved(NamedTuple):
    """Plans of all phases, and the mesh and solution that they come from."""

    plans: Plans
    iterate: Iterate


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
    pins: Pins = (None, None),
) -> list[PhasePlan[PathMotion]]:
    """Plan phases along curves that are run through one after the other, from rest to rest.

    Parameters
    ----------
    curves          with speed ratios that make the speed continuous where two of them meet
    epsilon : [N]   least normal force
    phases          the phases' numbers, for messages
    duration : [s]  longest duration of all, for the objective `margin`
    explained       whether to find out why there is no plan, which takes longer than planning
    pins : [N]      prescribed internal force at both ends, if any

    Raises
    ------
    InfeasibleError  if no motion keeps the limits; names the violated ones and what would have to
                     change
    JammingError     if friction jams a formation somewhere on its curve; an AmbiguityError if
                     contact forces are not unique
    SolverError      if the solver does not converge
    """
    task = Task(curves, epsilon, options, phases, duration, pins=pins)
    references = tuple[Guide, ...]()

    def replan(changed: Sequence[Curve], least: float) -> object:
        options = _roughen(task.options)
        changes = replace(task, curves=changed, epsilon=least, options=options, guides=references)
        return _insist(_plan_finer(changes, insist=False))

    try:
        result, references = plan_within(task)
    except JammingError as jam:
        if not explained or len(curves) > 1:
            raise
        from .path_explain import explain_jam

        raise explain_jam(curves[0], epsilon, jam, replan) from None
    if isinstance(result, Stuck):
        if not explained:
            raise SolverError(result.reason)
        error = explain_stuck(task, result, replan)
        if references and isinstance(error, SolverError):
            # The reference is a plan without ranges; case: the block of two landings of a pentagon.
            raise SolverError(
                f"{result.reason} within the ranges of numbers; without them there is a plan: try "
                f"--robust {options.robust / 2:g}, or narrower [uncertainty], where 0 leaves a "
                "number as it is"
            )
        raise error
    if options.goal is Objective.MARGIN and result.plans[0].value < task.lost:
        least = SolverError(f"{task.name}: the margin found is below epsilon")
        raise _explain_duration(task) or least
    plans = _bound_error(task, result.plans)
    # Rate-limited torques start at the limit of what friction can hold.
    surely = task.is_held or (options.goal is Objective.TIME and not options.ranges)
    return plans if surely else _leave_rest(plans, result.iterate)


def _bound_error(task: Task, plans: Plans) -> Plans:
    """The plans, with the gap to a lower bound of the least time as error where that says more.

    Estimated errors are checked above the accuracy, or where that is below the default.
    """
    options, error = task.options, plans[0].error
    if options.goal is not Objective.TIME or options.ranges or task.is_held or task.unlimited:
        return plans
    if error <= options.accuracy and options.accuracy >= DEFAULT_ACCURACY:
        return plans
    from ..lower_bound.lower_bound import bound_least_time

    bound = bound_least_time(task.curves, task.epsilon)
    if bound is None or bound.value <= 0:
        return plans
    # A plan may be below the bound by the violations that it is allowed.
    gap = max(sum(plan.value for plan in plans) / bound.value - 1, 0.0)
    return [plan._replace(error=gap) for plan in plans]


def explain_stuck(
    task: Task, stuck: Stuck, replan: Callable[[Sequence[Curve], float], object]
) -> WholearmError:
    """Why there is no plan: torque rate limits, the duration, or other limits."""
    from .path_explain import explain, explain_rate_limits

    if task.is_held:
        return explain_rate_limits(task, stuck.parts, stuck.reason, plan_curves)
    late, slow = _explain_duration(task), guess_slowly(join(stuck.parts))
    return late or explain(stuck.parts, *slow, task.phases, stuck.reason, replan)


def plan_within(task: Task) -> tuple[_Solved | Stuck, tuple[Guide, ...]]:
    """Plan within ranges by successive linearization, and the reference of the last one.

    The first reference is a plan without ranges. Each next plan has rows for the speed of the one
    before. Violations by other signs than theirs are tightened; if that costs too much, again.
    """
    options, references = task.options, tuple[Guide, ...]()
    if not options.ranges:
        return _plan_finer(task), references
    result = _plan_finer(replace(task, options=replace(_roughen(options), ranges={})))
    best: _Solved | None = None
    for _ in range(_LINEARIZATIONS):
        if isinstance(result, Stuck):
            break
        references = _make_guides(plan.motion for plan in result.plans)
        result = _plan_finer(replace(task, guides=references))
        if isinstance(result, _Solved):
            best = result
            if result.plans[0].error <= options.accuracy:
                break
    return best or result, references


def _leave_rest(plans: Plans, iterate: Iterate) -> Plans:
    """The plans, or if friction can hold their start, others with one that it cannot hold.

    Those of least time start with the largest s'', but not as if friction were larger.
    """
    task, margin = iterate.task, 0.0
    goal, ranges = task.options.goal, task.options.ranges
    if goal is Objective.MARGIN:
        margin = plans[0].value - task.epsilon
    start = find_sure_start(iterate.parts[0], plans[0].motion.profile, margin, ranges)
    if start is None:
        return plans
    bounded = replace(iterate, task=replace(task, start=start)).solve()
    other = bounded if isinstance(bounded, str) else _enforce_between(bounded)
    if not isinstance(other, _Solved):
        return plans
    value = sum(plan.value for plan in plans)
    loss = value - sum(plan.value for plan in other.plans)
    if goal is Objective.EFFORT:
        loss = -loss
    return other.plans if loss <= (np.inf if ranges else WORTH * value) else plans


def _explain_duration(task: Task) -> InfeasibleError | None:
    """The error if the duration is shorter than the least time, with one that would do."""
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
    rough = replace(task, options=_roughen(task.options))

    def can_plan(_: Parameter, value: float) -> bool:
        try:
            return _insist(_plan(replace(rough, duration=value)))[0].value >= task.epsilon
        except SolverError:
            return False

    changes = find_changes(
        [Parameter("duration", duration, "s", 1, "duration")], lambda _: least, can_plan
    )
    return InfeasibleError(
        f"{name_phases(task.phases, 'infeasible')}: duration = {duration:g} s is "
        f"{least - duration:.3g} s shorter than the least time; {describe_changes(changes)}",
        changes=changes,
    )


def _roughen(options: PlanOptions) -> PlanOptions:
    """Options for plans that only have to exist."""
    return replace(options, accuracy=max(options.accuracy, ROUGH))


def _insist(result: _Solved | Stuck) -> Plans:
    """The plans, or an error."""
    if isinstance(result, Stuck):
        raise SolverError(result.reason)
    return result.plans


def _plan_finer(task: Task, insist: bool = True) -> _Solved | Stuck:
    """Plan, with two and four times the elements if tightened limits leave no motion, or no time.

    If limits cannot be kept at the nodes, twice as many are tried only to `insist`. The failure
    reported is that of the fewer elements.
    """
    for curve, phase in zip(task.curves, task.phases, strict=True):
        require_unique(curve, task.options.uniqueness_margin, phase)
    stuck: Stuck | None = None
    for refinement in _REFINEMENTS:
        result = _plan(task, refinement, insist)
        if isinstance(result, Stuck):
            if not result.between and (stuck or not insist):
                return stuck or result
            stuck = result
        elif task.options.goal is not Objective.MARGIN or result.plans[0].value >= task.lost:
            break
    return result


def _plan(task: Task, refinement: int = 1, insist: bool = True) -> _Solved | Stuck:
    """Solve with mesh refinement; unless to `insist`, only where a sweep has found a motion."""
    first = Iterate.begin(task, refinement)
    if not first.is_kept and (not insist or is_hopeless(first.data)):
        return Stuck(first.parts, f"{task.name}: no motion keeps the limits", between=False)
    result: _Solved | Stuck = Stuck(first.parts, "", between=False)
    for solved in first.solve_first():
        if isinstance(solved, str):
            result = Stuck(first.parts, f"{task.name}: {solved}", between=False)
            continue
        result = _refine(_linearize(solved, refinement))
        if isinstance(result, _Solved):
            break
    return result


def _linearize(iterate: Iterate, refinement: int) -> Iterate:
    """Within ranges, the plan with rows for about its speed: no mesh mends rows for another one."""
    for _ in range(_LINEARIZATIONS):
        if not iterate.task.guides or iterate.violation_at_nodes <= _OTHER_SIGNS:
            break
        task = replace(iterate.task, guides=_make_guides(iterate.motions))
        other = Iterate.begin(task, refinement).solve()
        if isinstance(other, str):
            break
        iterate = other
    return iterate


def _make_guides(motions: Iterable[PathMotion]) -> tuple[Guide, ...]:
    return tuple(Guide(motion.grid.s, *motion.profile) for motion in motions)


def _refine(iterate: Iterate) -> _Solved | Stuck:
    """Adapt the mesh and tighten limits between nodes until the estimated error is small enough."""
    best: _Solved | Stuck | None = None
    for _ in range(_AGAIN):
        iterate = _adapt_mesh(iterate)
        result = _enforce_between(iterate)
        if best is not None and isinstance(result, Stuck):
            return best
        best = result
        if isinstance(result, Stuck) or result.plans[0].error <= iterate.task.options.accuracy:
            break
        better = iterate.adapt(dearer=True)[1]
        if better is not None and better.elements == iterate.elements and iterate.data.grid.held:
            break
        refined = better.solve() if better else ""
        if isinstance(refined, str):
            break
        iterate = refined
    assert best is not None
    return best


def _adapt_mesh(iterate: Iterate) -> Iterate:
    """Adapt the mesh until switches converge and violations between nodes cost little."""
    for _ in range(_RATE_LIMITED_MESHES if iterate.data.grid.held else _MESHES):
        iterate, better = iterate.adapt()
        if better is None:
            break
        refined = better.solve()
        if isinstance(refined, str):
            return replace(iterate, shift=better.shift)
        if iterate.is_split and refined.merit > iterate.merit:
            # Its breaks, off the switches, lose no more than the two differ by.
            loss = (refined.merit - iterate.merit) / iterate.value
            return replace(iterate, shift=min(refined.shift, loss / SHIFTED))
        iterate = refined
    return iterate


def _enforce_between(iterate: Iterate) -> _Solved | Stuck:
    """Tighten limits until they hold between nodes too."""
    task, data = iterate.task, iterate.data
    excessive = float(iterate.wasted.sum()) > _WASTED * task.options.accuracy
    for _ in range(SOLVES):
        misses = iterate.misses
        if misses.find_worst(data) <= MISS and not excessive:
            try:
                return _Solved(iterate.summarise(), iterate)
            except StalledError as stall:
                return Stuck(iterate.parts, f"{task.name}: {stall}", between=True)
        solved = iterate.tighten(excessive).solve()
        if isinstance(solved, str):
            return Stuck(iterate.parts, f"{task.name}: {solved}", between=True)
        iterate, excessive = solved, False
    return Stuck(iterate.parts, f"{task.name}: {misses.describe(data)}", between=True)
