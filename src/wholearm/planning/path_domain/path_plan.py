"""Planning one-freedom phases: first guess, NLP, and limits that hold between nodes too.

The NLP of `nlp` keeps the limits at its nodes. It is solved on few elements first. What it switches
there says where elements should end, and what its limits miss between nodes, whether more of them
are needed (`mesh`). Then limits are tightened by what they miss and the NLP is solved again from
where it was, until nothing misses more than `MISS`. What that costs is an estimate of the error:
the untightened solution is too good about as much as the tightened one is too bad.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...common.errors import InfeasibleError, JammingError, SolverError, WholearmError
from ...common.shortfalls import Parameter
from ...geometry.curve import Curve
from ..advice import describe_changes, find_changes, name_phases
from ..options import DEFAULT_ACCURACY, Objective, PlanOptions
from ..phase_plan import PhasePlan
from ..robust.robust_rows import Guide
from .first_guess import guess_slowly
from .interpolation import StalledError
from .path_data import PhaseData, join
from .path_motion import PathMotion
from .refine import Plans, Round
from .speed_profile import is_hopeless
from .task import Pins, Task
from .unique_start import WORTH, find_sure_start
from .violations import MISS, ROUNDS

_MESHES = 6
"""Most times that the mesh is changed before limits are tightened."""
_SLOW_MESHES = 3
"""The same with slow motors, whose switches matter less the more there are."""
_AGAIN = 3
"""Most times that limits are tightened, each on a mesh that is finer than the one before."""
_FINER = (1, 2, 4)
"""Elements to try, over those that are asked for."""
_SPREADS = 3
"""Most plans within ranges, each with rows for the speed of the one before."""
_WASTED = 0.02
"""Share of the accuracy that limits may cost by being tightened more than they need."""
_ROUGH = 1e-2
"""Accuracy of plans that are made to see whether there are any."""


class Stuck(NamedTuple):
    """What has come instead of a plan."""

    parts: list[PhaseData]  # the phases on their grids
    reason: str
    # whether limits can be kept at the nodes, but not between them on so coarse a grid
    between: bool


class _Solved(NamedTuple):
    """Plans of all phases, and the mesh and solution that they come from."""

    plans: Plans
    round_: Round

    @property
    def guides(self) -> tuple[Guide, ...]:
        """The motion along each curve."""
        motions = [plan.motion for plan in self.plans]
        return tuple(Guide(own.grid.s, *own.profile) for own in motions)


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
    curves          with such speed ratios that the speed is the same on both sides of where two of
                    them meet
    epsilon : [N]   least normal force
    phases          the phases' numbers, for messages
    duration : [s]  longest duration of all, for the objective `margin`
    explained       whether to find out why there is no plan, which takes longer than planning
    pins : [N]      the squeeze at both ends, where it is given

    Raises
    ------
    InfeasibleError  if no motion keeps the limits; names what is short, where, and what would have
                     to change
    JammingError     if friction jams a formation somewhere on its curve; an AmbiguityError if it
                     lets other contact forces be possible
    SolverError      if the solver stops without an answer
    """
    task = Task(curves, epsilon, options, phases, duration, pins=pins)
    guides = tuple[Guide, ...]()

    def replan(changed: Sequence[Curve], least: float) -> object:
        changes = replace(task, curves=changed, epsilon=least, options=_roughen(options))
        changes = replace(changes, guides=guides)
        return _insist(_plan_finer(changes, insist=False))

    try:
        found, guides = plan_within(task)
    except JammingError as jam:
        if not explained or len(curves) > 1:
            raise
        from .path_explain import explain_jam

        raise explain_jam(curves[0], epsilon, jam, replan) from None
    if isinstance(found, Stuck):
        if not explained:
            raise SolverError(found.reason)
        error = explain_stuck(task, found, replan)
        if guides and isinstance(error, SolverError):
            # What guides is a plan without ranges; case: the block of two landings of a pentagon.
            raise SolverError(
                f"{found.reason} within the ranges of numbers; without them there is a plan: try "
                f"--robust {options.robust / 2:g}, or narrower [uncertainty], where 0 leaves a "
                "number as it is"
            )
        raise error
    if options.goal is Objective.MARGIN and found.plans[0].value < task.lost:
        least = SolverError(f"{task.name}: the margin found is below epsilon")
        raise _explain_duration(task) or least
    found = _bound_error(task, found)
    # Slow motors begin a motion as they leave what holds the object.
    surely = task.is_held or (options.goal is Objective.TIME and not options.ranges)
    return found.plans if surely else _leave_rest(found)


def _bound_error(task: Task, found: _Solved) -> _Solved:
    """The plans with the gap to a lower bound of their time as their error, where that says more.

    Limits are tightened and switches moved by estimates alone. They are checked where they are
    above the accuracy, or where that is below that of the default.
    """
    options, error = task.options, found.plans[0].error
    if options.goal is not Objective.TIME or options.ranges or task.is_held or task.quick:
        return found
    if error <= options.accuracy and options.accuracy >= DEFAULT_ACCURACY:
        return found
    from ..lower_bound.lower_bound import bound_least_time

    bound = bound_least_time(task.curves, task.epsilon)
    if bound is None or bound.value <= 0:
        return found
    # Limits may be missed a little, by which a plan can be below the bound.
    gap = max(sum(plan.value for plan in found.plans) / bound.value - 1, 0.0)
    return found._replace(plans=[plan._replace(error=gap) for plan in found.plans])


def explain_stuck(
    task: Task, found: Stuck, replan: Callable[[Sequence[Curve], float], object]
) -> WholearmError:
    """Why there is no plan: slow motors, the duration, or what is short."""
    from .path_explain import explain, explain_motors

    if task.is_held:
        return explain_motors(task, found.parts, found.reason, plan_curves)
    late, slow = _explain_duration(task), guess_slowly(join(found.parts))
    return late or explain(found.parts, *slow, task.phases, found.reason, replan)


def plan_within(task: Task) -> tuple[_Solved | Stuck, tuple[Guide, ...]]:
    """Plan within the ranges that there are, from the plan without them on; also near what.

    Rows are those for the speed of the plan before. What other signs than theirs would miss is
    tightened, and where that costs more than it may, the next plan has better ones.
    """
    options = task.options
    if not options.ranges:
        return _plan_finer(task), ()
    bare = replace(_roughen(options), ranges={})
    found, guides = _plan_finer(replace(task, options=bare)), tuple[Guide, ...]()
    best: _Solved | None = None
    for _ in range(_SPREADS):
        if isinstance(found, Stuck):
            break
        guides = found.guides
        found = _plan_finer(replace(task, guides=guides))
        if isinstance(found, _Solved):
            best = found
            if found.plans[0].error <= options.accuracy:
                break
    return best or found, guides


def _leave_rest(found: _Solved) -> Plans:
    """The plans, or others with a start that friction cannot hold, if it can hold theirs.

    Those of least time push off as hard as limits allow, but not as if friction were larger.
    """
    plans, task = found.plans, found.round_.task
    data, margin = found.round_.parts[0], 0.0
    if task.options.goal is Objective.MARGIN:
        margin = plans[0].value - task.epsilon
    ranges = task.options.ranges
    start = find_sure_start(data, plans[0].motion.profile, margin, ranges)
    if start is None:
        return plans
    bounded = replace(found.round_, task=replace(task, start=start)).solve()
    other = bounded if isinstance(bounded, str) else _enforce_between(bounded)
    if not isinstance(other, _Solved):
        return plans
    loss = sum(own.value for own in plans) - sum(own.value for own in other.plans)
    if task.options.goal is Objective.EFFORT:
        loss = -loss
    most = np.inf if ranges else WORTH * sum(own.value for own in plans)
    return other.plans if loss <= most else plans


def _explain_duration(task: Task) -> InfeasibleError | None:
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

    rough = replace(task, options=_roughen(task.options))

    def can_plan(_: Parameter, value: float) -> bool:
        try:
            return _insist(_plan(replace(rough, duration=value)))[0].value >= task.epsilon
        except SolverError:
            return False

    own = Parameter("duration", duration, "s", 1, "duration")
    changes = find_changes([own], lambda _: least, can_plan)
    return InfeasibleError(
        f"{name_phases(task.phases, 'infeasible')}: duration = {duration:g} s is "
        f"{least - duration:.3g} s shorter than the least time; {describe_changes(changes)}",
        changes=changes,
    )


def _roughen(options: PlanOptions) -> PlanOptions:
    """Options for plans of which only matters that there are any."""
    return replace(options, accuracy=max(options.accuracy, _ROUGH))


def _insist(found: _Solved | Stuck) -> Plans:
    """The plans, or an error."""
    if isinstance(found, Stuck):
        raise SolverError(found.reason)
    return found.plans


def _plan_finer(task: Task, insist: bool = True) -> _Solved | Stuck:
    """Plan, on a finer grid where limits that hold between the nodes leave nothing, or no time.

    What so few elements cannot keep at their nodes, twice as many may: they are tried if that is
    insisted on. What is said of why there is no plan is said of the fewer.
    """
    task.require_unique()
    stuck: Stuck | None = None
    for finer in _FINER:
        found = _plan(task, finer, insist)
        if isinstance(found, Stuck):
            if not found.between and (stuck or not insist):
                return stuck or found
            stuck = found
        elif task.options.goal is not Objective.MARGIN or found.plans[0].value >= task.lost:
            break
    return found


def _plan(task: Task, finer: int = 1, insist: bool = True) -> _Solved | Stuck:
    """Solve on meshes that suit the plan more and more, and make limits hold between nodes too.

    If that is not insisted on, only where a sweep has found a motion.
    """
    round_ = Round.begin(task, finer)
    if not round_.is_kept and (not insist or is_hopeless(round_.data)):
        return Stuck(round_.parts, f"{task.name}: no motion keeps the limits", between=False)
    kept = Stuck(round_.parts, "", between=False)
    for found in round_.solve_first():
        if isinstance(found, str):
            kept = Stuck(round_.parts, f"{task.name}: {found}", between=False)
            continue
        refined = _refine(found)
        if isinstance(refined, _Solved):
            return refined
        kept = refined
    return kept


def _refine(found: Round) -> _Solved | Stuck:
    """Suit the mesh to a solution until limits hold between nodes, at no more than it may cost."""
    best: _Solved | Stuck | None = None
    for _ in range(_AGAIN):
        found = _suit(found)
        kept = _enforce_between(found)
        if best is not None and isinstance(kept, Stuck):
            return best
        best = kept
        if isinstance(kept, Stuck) or kept.plans[0].error <= found.task.options.accuracy:
            break
        better = found.adapt(dearer=True)[1]
        if better is not None and better.elements == found.elements and found.data.grid.held:
            break
        refined = better.solve() if better else ""
        if isinstance(refined, str):
            break
        found = refined
    assert best is not None
    return best


def _suit(found: Round) -> Round:
    """Change the mesh until switches stay where they are and little is missed between nodes."""
    for _ in range(_SLOW_MESHES if found.data.grid.held else _MESHES):
        found, better = found.adapt()
        if better is None:
            break
        refined = better.solve()
        if isinstance(refined, str):
            return replace(found, shift=better.shift)
        if found.is_split and refined.merit > found.merit:
            return found.keep_before(refined)
        found = refined
    return found


def _enforce_between(round_: Round) -> _Solved | Stuck:
    """Tighten limits until they hold between nodes too."""
    task, data = round_.task, round_.data
    wasteful = float(round_.wasted.sum()) > _WASTED * task.options.accuracy
    for _ in range(ROUNDS):
        misses = round_.misses
        if misses.find_worst(data) <= MISS and not wasteful:
            try:
                return _Solved(round_.summarise(), round_)
            except StalledError as stall:
                return Stuck(round_.parts, f"{task.name}: {stall}", between=True)
        found = round_.tighten(wasteful).solve()
        if isinstance(found, str):
            return Stuck(round_.parts, f"{task.name}: {found}", between=True)
        round_, wasteful = found, False
    return Stuck(round_.parts, f"{task.name}: {misses.describe(data)}", between=True)
