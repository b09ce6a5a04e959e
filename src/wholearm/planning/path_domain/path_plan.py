"""Minimum-time, minimum-effort and maximum-margin plans of phases with one degree of freedom.

Direct collocation along the curve (`path_nlp`) with mesh refinement: solve, estimate the error,
adapt the mesh, tighten limits between nodes, check. Elements are made to end where the solution
switches, and doubled where it violates limits between nodes. Then limits are tightened by their
violations until none exceeds `MISS`. The cost of that estimates the error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import (
    AmbiguityError,
    InfeasibleError,
    JammingError,
    Parameter,
    SolverError,
    WholearmError,
)
from ...geometry.curve import Curve, describe_pose, directions_of
from ...mechanics.dynamics import reduced_inertia
from ...mechanics.uniqueness import describe_uniqueness, find_minors
from ..advice import describe_changes, find_changes, name_phases
from ..options import DEFAULT_ACCURACY, Objective, PlanOptions
from ..phase_plan import PhasePlan
from ..robust.robust_rows import Guide, RobustLimits, spread
from .elements import DEGREE, Elements, follow
from .first_guess import guess, guess_slowly
from .path_data import PhaseData, cut, join, prepare
from .path_mesh import MOST, SHIFTED, SLOW_MOST, SOFT, START, Mesh, Switch, adapt, find_ends
from .path_motion import PathMotion, StalledError, fit_torque
from .path_nlp import (
    PathNLP,
    Tightening,
    Units,
    build_path_nlp,
    make_bounds,
    pack,
    parameters,
    unpack,
)
from .rate_terms import UNLIMITED, MotorShape, find_rate_switches, ramp_up
from .speed_profile import Fastest, find_fastest, is_hopeless
from .terms import LimitShape
from .unique_start import WORTH, SureStart, find_sure_start
from .violations import MISS, SOLVES, Misses, PathSolution, anticipate, price
from .warm_start import balance, center, move_multipliers, start_at

Plans = list[PhasePlan[PathMotion]]
Pins = tuple[float | None, float | None]  # prescribed internal force at start and end [N]
_LOOKS = 17  # places of a segment at which uniqueness is checked
EARLY = 1e-5  # accuracy from which few elements will do, and limits are tightened before any solve
_EXTRA = 8  # elements beyond one for each stretch, under rate limits
_STEPS = 5  # their number is a multiple of it: fewer different NLPs to build
_SHARE = 0.5  # share of the accuracy for shifted switches
# Share of the accuracy for missed limits, to first order: efforts have other errors.
_DEAR = {Objective.TIME: 1.0, Objective.MARGIN: 1.0, Objective.EFFORT: 0.2}
_LIKELY = 0.2  # share of that beyond which the elements are doubled, not only moved
_LONGER = 0.2  # most that the NLP's duration may be allowed to be longer, relatively
_SETTLED = 0.1  # share of the accuracy below which switches are not looked for again
_UNLIMITED_TIGHTENING = 1e-2  # of limits in a plan without rate limits, over their scales
_FIRST_TIGHTENINGS = (5e-4, 5e-5)  # the same with rate limits; the second for a high accuracy
_RATE_TIGHTENING = 10.0  # of rates and commands, over that
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
) -> Plans:
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
    return plans if surely else _leave_rest(plans, result)


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
        return explain_rate_limits(task, stuck.parts, stuck.reason)
    late, slow = _explain_duration(task), guess_slowly(join(stuck.parts))
    return late or explain(stuck.parts, *slow, task.phases, stuck.reason, replan)


def plan_within(task: Task) -> tuple[Iterate | Stuck, tuple[Guide, ...]]:
    """Plan within ranges by successive linearization, and the reference of the last one.

    The first reference is a plan without ranges. Each next plan has rows for the speed of the one
    before. Violations by other signs than theirs are tightened; if that costs too much, again.
    """
    options, references = task.options, tuple[Guide, ...]()
    if not options.ranges:
        return _plan_finer(task), references
    result = _plan_finer(replace(task, options=replace(_roughen(options), ranges={})))
    best: Iterate | None = None
    for _ in range(_LINEARIZATIONS):
        if isinstance(result, Stuck):
            break
        references = _make_guides(plan.motion for plan in result.plans)
        result = _plan_finer(replace(task, guides=references))
        if isinstance(result, Iterate):
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
    if not isinstance(other, Iterate):
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


def _insist(result: Iterate | Stuck) -> Plans:
    """The plans, or an error."""
    if isinstance(result, Stuck):
        raise SolverError(result.reason)
    return result.plans


def _plan_finer(task: Task, insist: bool = True) -> Iterate | Stuck:
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


def _plan(task: Task, refinement: int = 1, insist: bool = True) -> Iterate | Stuck:
    """Solve with mesh refinement; unless to `insist`, only where a sweep has found a motion."""
    first = Iterate.begin(task, refinement)
    if not first.is_kept and (not insist or is_hopeless(first.data)):
        return Stuck(first.parts, f"{task.name}: no motion keeps the limits", between=False)
    result: Iterate | Stuck = Stuck(first.parts, "", between=False)
    for solved in first.solve_first():
        if isinstance(solved, str):
            result = Stuck(first.parts, f"{task.name}: {solved}", between=False)
            continue
        result = _refine(_linearize(solved, refinement))
        if isinstance(result, Iterate):
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


def _refine(iterate: Iterate) -> Iterate | Stuck:
    """Adapt the mesh and tighten limits between nodes until the estimated error is small enough."""
    best: Iterate | Stuck | None = None
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


def _enforce_between(iterate: Iterate) -> Iterate | Stuck:
    """Tighten limits until they hold between nodes too."""
    task, data = iterate.task, iterate.data
    excessive = float(iterate.wasted.sum()) > _WASTED * task.options.accuracy
    for _ in range(SOLVES):
        misses = iterate.misses
        if misses.find_worst(data) <= MISS and not excessive:
            try:
                iterate.plans  # noqa: B018
            except StalledError as stall:
                return Stuck(iterate.parts, f"{task.name}: {stall}", between=True)
            return iterate
        solved = iterate.tighten(excessive).solve()
        if isinstance(solved, str):
            return Stuck(iterate.parts, f"{task.name}: {solved}", between=True)
        iterate, excessive = solved, False
    return Stuck(iterate.parts, f"{task.name}: {misses.describe(data)}", between=True)


@dataclass(frozen=True)
class Task:
    """Arguments of `plan_curves`; with ranges also a reference for each curve."""

    curves: Sequence[Curve]
    epsilon: float
    options: PlanOptions
    phases: Sequence[int]
    duration: float | None
    start: SureStart | None = None
    guides: tuple[Guide, ...] = ()
    unlimited: bool = False  # whether torque rates and lags are left out
    pins: Pins = (None, None)

    @cached_property
    def spreads(self) -> list[RobustLimits | None]:
        """Robust force limits of each curve, None without ranges."""
        if not self.guides:
            return [None] * len(self.curves)
        args = self.epsilon, self.options.ranges
        return [spread(*pair, *args) for pair in zip(self.curves, self.guides, strict=True)]

    @property
    def is_held(self) -> bool:
        """Whether motions start and end without acceleration, as torques may not step."""
        return self.curves[0].formation.scene.has_slow_motors and not self.unlimited

    @property
    def name(self) -> str:
        """The phases, for messages."""
        return name_phases(self.phases)

    @property
    def lost(self) -> float:
        """Least acceptable c_n of a plan of largest margin [N]."""
        return self.epsilon - MISS * self.curves[0].formation.scene.scales.force

    @property
    def elements(self) -> int:
        """Initial number of elements of each phase."""
        intervals = self.options.intervals
        if intervals is None:
            few = START if self.options.accuracy >= EARLY else 2 * START
            return max(few, SOFT) if self.is_held or self.options.goal is Objective.EFFORT else few
        return max(-(-intervals // DEGREE), 3)

    def lay_out(
        self, meshes: tuple[Mesh, ...], wanted: int
    ) -> tuple[int, tuple[Mesh, ...], list[PhaseData], PhaseData, PathNLP]:
        """Elements of each phase, meshes, each phase on its mesh, all joined, and their NLP.

        There are as many elements as wanted, if that is enough for the breaks.
        """
        pairs = list(zip(self.curves, meshes, strict=True))
        ends = max(len(find_ends(curve, mesh.breaks)) for curve, mesh in pairs)
        if self.is_held and self.options.intervals is None:
            ends = -(-(ends + _EXTRA) // _STEPS) * _STEPS
        elements, parts, last = max(wanted, ends), list[PhaseData](), len(meshes) - 1
        for k, (curve, mesh) in enumerate(pairs):
            grid = mesh.make_grid(curve, elements, (k == 0, k == last), self.is_held)
            parts.append(prepare(curve, self.epsilon, grid, self.phases[k], self.spreads[k]))
        data = join(parts)
        motors = MotorShape.of(self.curves[0].formation.scene) if self.is_held else UNLIMITED
        shape = LimitShape.of(data.limits, motors)
        nlp = build_path_nlp(shape, len(data.grid.steps), self.options.goal)
        return elements, meshes, parts, data, nlp

    def place_breaks(self, switches: Sequence[Switch]) -> tuple[Mesh, ...]:
        """Meshes with breaks at switches, which are at places along all curves.

        None on a curve where a fixed number of elements is too few for them.
        """
        starts = np.cumsum([0.0, *(curve.length for curve in self.curves)])
        of_curve = np.searchsorted(starts[1:-1], [place for place, _ in switches])
        meshes = list[Mesh]()
        for k, curve in enumerate(self.curves):
            pairs = zip(switches, of_curve, strict=True)
            local = [Switch(place - starts[k], jumps) for (place, jumps), at in pairs if at == k]
            mesh = Mesh.of(curve, local, self.is_held)
            few = self.options.intervals and len(find_ends(curve, mesh.breaks)) > self.elements
            meshes.append(Mesh() if few else mesh)
        return tuple(meshes)


def require_unique(curve: Curve, least: float, phase: int) -> None:
    """Require unique contact forces along a curve.

    Parameters
    ----------
    least  least uniqueness margin (`mechanics.uniqueness`)
    phase  its number, for messages

    Raises
    ------
    AmbiguityError  if one is less; where friction jams the curve, `path_data.prepare` raises
    """
    formation, segments = curve.formation, curve.segments
    if not formation.friction.any():
        return
    s = np.concatenate([np.linspace(part.start, part.stop, _LOOKS) for part in segments])
    point = curve.evaluate(s)
    directions = directions_of(curve, np.repeat(np.arange(len(segments)), _LOOKS))
    Xi = directions.Xi
    still = (formation.sliding_friction > 0) & (Xi == 0).all(axis=0)
    sticking = tuple(np.flatnonzero(still).tolist())
    ratio, names, row = find_minors(formation, point.kinematics, Xi, sticking).find_least()
    if ratio >= least:
        return
    if reduced_inertia(formation, point.kinematics, directions).min() > 0:
        text = describe_uniqueness(ratio, names, describe_pose(point.z[row]), least)
        raise AmbiguityError(f"phase {phase}: {text}")


@dataclass(frozen=True)
class Iterate:
    """A mesh with its NLP, and the solution on it or the point to start from."""

    task: Task
    elements: int  # of each phase
    meshes: tuple[Mesh, ...]
    parts: list[PhaseData]
    data: PhaseData  # all phases as one
    nlp: PathNLP
    units: Units
    solution: PathSolution  # the last one, or the point to start from
    tightening: Tightening  # of the limits for that
    fastest: Fastest | None  # minimum-time speed profile, near which plans are looked for
    shift: float = np.inf  # estimated distance of switches from breaks, over the curve's length
    interior: Iterate | None = None  # under rate limits: strictly feasible, to restart from

    @staticmethod
    def begin(task: Task, refinement: int) -> Iterate:
        """Initial guess on elements that end at reversals alone, or from an unlimited plan."""
        ramped = Iterate._add_ramps(task, refinement) if task.is_held else None
        if ramped is not None:
            return ramped
        layout = task.lay_out(tuple(Mesh() for _ in task.curves), refinement * task.elements)
        data, nlp = layout[3:]
        profile, units = guess(data, task.options.time_weight)
        sweeps = task.options.goal is not Objective.EFFORT and not data.grid.held
        fastest = find_fastest(data, task.duration) if sweeps else None
        start = PathSolution(profile, 0.0, balance(nlp, data, units, profile))
        none = Tightening.none(data, task.duration)
        profiled = fastest if isinstance(fastest, Fastest) else None
        first = Iterate(task, *layout, units, start, none, profiled)
        if fastest is None:
            return first
        # Where it is not the duration that limits a margin, switches are not looked for.
        meshes = task.place_breaks(fastest.switches)
        return first._restart(meshes, refinement * task.elements, np.inf if profiled else 0.0)

    @staticmethod
    def _add_ramps(task: Task, refinement: int) -> Iterate | None:
        """Initial guess under rate limits: a plan without them, with ramps for torque steps."""
        unlimited = Iterate.begin(replace(task, unlimited=True, pins=(None, None)), refinement)
        plan = unlimited.tighten_all(_UNLIMITED_TIGHTENING).solve()
        if isinstance(plan, str):
            return None
        duration = sum(motion.duration for motion in plan.motions)
        ramped = ramp_up(plan.data, plan.solution.profile, duration, task.pins)
        if ramped is None:
            return None
        starts = np.cumsum([0.0, *(curve.length for curve in task.curves)])
        breaks = [mesh.breaks + start for mesh, start in zip(plan.meshes, starts, strict=False)]
        meshes = task.place_breaks(ramped.find_breaks(np.concatenate(breaks)))
        layout = task.lay_out(meshes, refinement * task.elements)
        data, nlp = layout[3:]
        profile = ramped.guess(plan.data.grid, plan.solution.profile, data.grid)
        multipliers = plan.move_multipliers(nlp, data)
        multipliers = center(nlp, data, plan.units, profile, multipliers, task.duration, task.pins)
        start, none = PathSolution(profile, 0.0, multipliers), Tightening.none(data, task.duration)
        return Iterate(task, *layout, plan.units, start, none, None)

    def tighten_all(self, share: float) -> Iterate:
        """The iterate with all limits tightened, so that its solution is strictly feasible."""
        tight, scale = self.tightening, 1 - _RATE_TIGHTENING * share
        limits = tight.limits + share * self.data.spans
        tight = tight._replace(limits=limits, motors=tight.motors * scale)
        return replace(self, tightening=tight)

    def refit(self) -> Iterate:
        """The iterate on a mesh for its solution, with limits as they are."""
        meshes = tuple(
            Mesh.of(part.curve, find_rate_switches(part, motion.profile), True)
            for part, motion in zip(self.parts, self.motions, strict=True)
        )
        return replace(self, interior=self)._restart(meshes, self.elements, 0.0)

    def _restart(self, meshes: tuple[Mesh, ...], elements: int, shift: float) -> Iterate:
        """Start on other meshes, from the minimum-time speed profile or else from this iterate."""
        task, source = self.task, self.interior or self
        layout = task.lay_out(meshes, elements)
        data, nlp = layout[3:]
        tightening = Tightening.none(data, self.allowed)
        if self.fastest is None:
            profile = Elements(source.data.grid, source.solution.profile).move(data.grid)
            multipliers = source.move_multipliers(nlp, data)
            if data.grid.held:
                profile = follow(data.grid, profile.a, profile.lam)
                multipliers = center(
                    nlp, data, self.units, profile, multipliers, task.duration, task.pins
                )
            start = source.solution._replace(profile=profile, multipliers=multipliers)
        else:
            start, vertices = start_at(nlp, data, self.units, self.fastest)
            if task.options.accuracy >= EARLY:
                tightening = anticipate(data, start._replace(profile=vertices), tightening)
        first = Iterate(task, *layout, self.units, start, tightening, self.fastest)
        return replace(first, shift=shift, interior=self.interior)

    def move_multipliers(self, nlp: PathNLP, data: PhaseData) -> dict[str, Array]:
        """Multipliers of the solution on another grid of the same curves."""
        old = self.solution.multipliers
        return move_multipliers(self.nlp, nlp, old, self.data.grid, data.grid)

    @cached_property
    def motions(self) -> list[PathMotion]:
        """The motion of each phase."""
        pairs = zip(self.parts, cut(self.parts, self.solution.profile), strict=True)
        return [PathMotion(part.curve, part.grid, profile) for part, profile in pairs]

    @cached_property
    def misses(self) -> Misses:
        """Violations of limits between nodes."""
        return Misses.of(self.data, self.solution, self.motions, self.task.duration)

    @property
    def value(self) -> float:
        """Scale of the cost's error."""
        if self.task.options.goal is Objective.MARGIN:
            return max(abs(self.task.epsilon + self.solution.margin) / self.units.force, 1e-9)
        return max(abs(self.solution.cost), 1e-9)

    @cached_property
    def due(self) -> Array:
        """Relative cost at each node of tightening limits by their violations."""
        missed = self.misses.short, self.misses.speeding, self.misses.hurry
        return self._price(*map(self.data.spread_to_nodes, missed))

    @cached_property
    def paid(self) -> Array:
        """Relative cost at each node of the tightening so far."""
        tight = self.tightening
        return self._price(tight.missed, 1 - tight.speed_share, 1 - tight.motors)

    @cached_property
    def wasted(self) -> Array:
        """Relative cost at each node of tightening limits more than needed."""
        spare = np.minimum(self.tightening.missed, self.misses.find_spare(self.data))
        return self._price(spare, np.zeros(len(spare)), np.zeros((len(spare), 2, 2)))

    def _price(self, *tightened: Array) -> Array:
        costs = price(self.nlp, self.data, self.units, self.solution, *tightened)
        return np.asarray(costs / self.value)

    @property
    def allowed(self) -> float | None:
        """Bound of the NLP's duration with which the motion's is the allowed one [s]."""
        wanted, duration = self.task.duration, self.solution.duration
        if not wanted or not duration:
            return wanted
        total = sum(motion.duration for motion in self.motions)
        return wanted * (1 + min(max(duration / total - 1, 0.0), _LONGER))

    @property
    def unspent(self) -> float:
        """Relative gain of using the time that is left, to first order."""
        if self.task.duration is None:
            return 0.0
        left = self.task.duration - sum(motion.duration for motion in self.motions)
        each = float(self.solution.multipliers["lam_g0"][self.nlp.columns.g["duration"]].sum())
        return max(each, 0.0) * max(left, 0.0) / self.units.time / self.value

    @property
    def merit(self) -> float:
        """Estimated cost once limits hold between nodes."""
        return self.solution.cost + self.value * float(self.due.sum())

    @property
    def is_kept(self) -> bool:
        """Whether some motion is known to keep limits at nodes, or negative margins would do."""
        if self.fastest is not None or self.task.options.goal is Objective.MARGIN:
            return True
        return bool(self.data.slack(self.data.nodes, self.solution.profile).min() >= 0)

    @property
    def violation_at_nodes(self) -> float:
        """Largest violation at nodes, over the scales: within ranges, by signs of no row."""
        margin = self.solution.margin
        slack = self.data.slack(self.data.nodes, self.solution.profile, margin)
        return -float((slack / self.data.spans).min())

    @property
    def is_split(self) -> bool:
        """Whether elements end where the plan switches."""
        return any(len(mesh.breaks) for mesh in self.meshes)

    def solve(self) -> Iterate | str:
        """Solve on this mesh; why the solver ended if there is no solution."""
        nlp, data, units, start, task = self.nlp, self.data, self.units, self.solution, self.task
        bounds = make_bounds(nlp, data, units, self.tightening, start=task.start, pins=task.pins)
        if (bounds["lbg"] > bounds["ubg"]).any():
            return "limits that hold between the nodes too leave nothing"
        result = nlp.solver(
            x0=pack(nlp, start.profile, units, start.margin, data.grid.sizes),
            p=parameters(nlp, data, units, task.options.time_weight),
            **bounds,
            **start.multipliers,
        )
        stats = nlp.solver.stats()
        if not stats["success"]:
            return f"Ipopt stopped with {stats['return_status']}"
        profile, margin = unpack(nlp, data.grid, result["x"].full()[:, 0], units)
        multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
        duration = float(result["g"][-1]) * units.time if self.tightening.duration else 0.0
        solution = PathSolution(profile, margin, multipliers, float(result["f"]), duration)
        return replace(self, solution=solution)

    def solve_first(self) -> Iterator[Iterate | str]:
        """First solutions; under rate limits also on a mesh for one with tighter limits."""
        if self.data.grid.held:
            accurate, first = self.task.options.accuracy < EARLY, self
            for share in _FIRST_TIGHTENINGS[: 1 + accurate]:
                interior = first.tighten_all(share).solve()
                if isinstance(interior, str):
                    break
                first = interior.refit()
            if first is not self:
                yield first.solve()
        yield self.solve()

    def tighten(self, ease: bool) -> Iterate:
        """The iterate with limits tightened by their violations, eased first where too tight."""
        tight = self.tightening
        tight = tight.ease(self.misses.find_spare(self.data)) if ease else tight
        return replace(self, tightening=self.misses.tighten(self.data, tight, self.solution))

    def adapt(self, dearer: bool = False) -> tuple[Iterate, Iterate | None]:
        """The iterate with its shift, and one on a better mesh; None if this one will do.

        Parameters
        ----------
        dearer  whether tightening limits has cost more than the accuracy
        """
        task, most = self.task, self.task.options.accuracy
        prices = self.due + self.paid - self.wasted
        shares = np.split(prices, np.cumsum([len(part.grid.s) for part in self.parts])[:-1])
        most_elements = SLOW_MOST if self.data.grid.held and most >= EARLY else MOST
        coarse = self.elements < most_elements and task.options.intervals is None
        allowed = _DEAR[task.options.goal] * most
        dear = dearer or bool(prices.sum() > allowed)
        # Converged switches need not be looked for. Where much is violated they are not better
        # known than by a sweep.
        settled = SHIFTED * self.shift < _SETTLED * most
        settled = settled or self.data.grid.held or (self.fastest is not None and dear and coarse)
        goal, margin = None if settled else task.options.goal, self.solution.margin
        phases = zip(self.parts, self.motions, shares, self.meshes, strict=True)
        better = [
            adapt(goal, part, motion.profile, margin, share, mesh)
            for part, motion, share, mesh in phases
        ]
        shift = self.shift if settled else max(each.shift for each in better)
        moved = SHIFTED * shift > _SHARE * most and not self.data.grid.held
        # Violations say little before elements end at switches.
        dear = dear and coarse and (dearer or self.is_split or not np.isinf(shift))
        if not (moved or dear):
            if self.unspent <= _SHARE * most:
                return replace(self, shift=shift), None
            longer = self.tightening._replace(duration=self.allowed)
            return self, replace(self, tightening=longer, shift=shift)
        expected = sum(each.price for each in better)
        double = (dearer and coarse) or (dear and expected > _LIKELY * allowed)
        meshes = tuple(each.mesh for each in better)
        return self, self._restart(meshes, self.elements * (2 if double else 1), shift)

    @cached_property
    def plans(self) -> Plans:
        """The plan of each phase; StalledError if one nearly stops between two nodes."""
        options = self.task.options
        error = float(self.paid.sum() + SHIFTED * min(self.shift, 1.0) + self.unspent)
        plans = []
        for part, motion in zip(self.parts, self.motions, strict=True):
            torque, squares = fit_torque(part, motion)
            value = {
                Objective.TIME: motion.duration,
                Objective.EFFORT: squares + options.time_weight * motion.duration,
                Objective.MARGIN: self.task.epsilon + self.solution.margin,
            }[options.goal]
            plans.append(PhasePlan(motion, torque, value, error=error))
        return plans
