"""Minimum-time, minimum-effort and maximum-margin plans of phases with one degree of freedom.

Direct collocation along the curve (`path_nlp`), refined in the loop of `refinement`. Elements end
where the plan switches from one active limit to another: first where the minimum-time sweep does,
then where the solution does. They are halved while violations between nodes cost more than the
accuracy. Limits are tightened by their violations until none exceeds `MISS`; what that costs is the
estimate of the error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import AmbiguityError, JammingError, SolverError, name_phases
from ...geometry.curve import Curve, describe_pose, directions_of
from ...mechanics.dynamics import LAMBDA, ONE, A, reduced_inertia
from ...mechanics.limits import PRESS
from ...mechanics.statics import SURE
from ...mechanics.uniqueness import describe_uniqueness, find_minors
from ..options import Objective, PlanOptions
from ..phase_plan import PhasePlan, share_duration
from ..refinement import SOLVES, refine
from .path_data import PhaseData, cut, find_torques, fit_torque, join, prepare
from .path_mesh import (
    Fastest,
    equidistribute,
    find_ends,
    find_fastest,
    find_switches,
    halve,
    keep_apart,
    make_grid,
    match,
)
from .path_motion import DEGREE, Elements, PathMotion, Profile, follow
from .path_nlp import (
    LimitShape,
    PathNLP,
    SureStart,
    Tightening,
    Units,
    build_path_nlp,
    center,
    guess,
    guess_below,
    make_bounds,
    pack,
    parameters,
    unpack,
)

if TYPE_CHECKING:
    from ..robust.robust_rows import Guide, RobustLimits

Plans = list[PhasePlan[PathMotion]]
Pins = tuple[float | None, float | None]  # prescribed internal force at start and end [N]
MISS = 2.5e-7  # largest violation between nodes, over the limits' scales; relative for b and time
_GAP = 1.5  # gap to the optimum over the cost of the tightening
_LOOKS = 17  # places of a segment at which uniqueness is checked
_START, _SMOOTH, _RATE = 12, 20, 40  # elements of a phase; for effort; under rate limits
WORTH = 0.02  # largest relative cost of such a start


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
    try:
        if options.ranges:
            # Rows are for the motion of a reference: first of a plan without ranges.
            nominal = plan_task(replace(task, options=replace(options.roughen(), ranges={})))
            task = replace(task, guides=nominal.guides)
        iterate = _plan_within(task)
    except JammingError as jam:
        if not explained or len(curves) > 1:
            raise
        from ..explain import explain_jam

        raise explain_jam(task, jam) from None
    except SolverError as stuck:
        from ..explain import explain_curves

        reason = f"{name_phases(phases)}: {stuck}"
        error = explain_curves(task, reason) if explained else SolverError(reason)
        if task.guides and isinstance(error, SolverError):
            # The reference is a plan without ranges; case: the block of two landings of a pentagon.
            raise SolverError(
                f"{reason} within the ranges of numbers; without them there is a plan: try "
                f"--robust {options.robust / 2:g}, or narrower [uncertainty], where 0 leaves a "
                "number as it is"
            ) from None
        raise error from None
    rounding = MISS * curves[0].formation.scene.scales.force
    if options.goal is Objective.MARGIN and iterate.plans[0].value < epsilon - rounding:
        if duration is not None:
            fastest = replace(options, objective=Objective.TIME, duration=None)
            least = plan_task(replace(task, options=fastest, duration=None)).plans
            where = f"{name_phases(phases, 'infeasible')}: "
            share_duration([plan.value for plan in least], duration, where)
        raise SolverError(f"{name_phases(phases)}: the margin found is below epsilon")
    # Rate-limited torques start at the limit of what friction can hold.
    surely = task.is_held or (options.goal is Objective.TIME and not options.ranges)
    return iterate.plans if surely else _leave_rest(iterate)


def plan_task(task: Task) -> PathIterate:
    """Solve and refine."""
    for curve, phase in zip(task.curves, task.phases, strict=True):
        require_unique(curve, task.options.uniqueness_margin, phase)
    first = PathIterate.begin(task, min(task.elements, _START) if task.is_held else task.elements)
    return refine(first, task.options.accuracy)


def _plan_within(task: Task) -> PathIterate:
    """Plan; with a reference by successive linearization, each about the motion of the one before.

    Violations by other signs than those of the rows are tightened; if that costs too much, again.
    """
    iterate = plan_task(task)
    for _ in range(2 if task.guides else 0):  # most further ones
        if iterate.error <= task.options.accuracy:
            break
        try:
            other = plan_task(replace(task, guides=iterate.guides))
        except SolverError:
            break
        if other.objective >= iterate.objective:
            break
        iterate = other
    return iterate


def _leave_rest(iterate: PathIterate) -> Plans:
    """The plans, or if friction can hold their start, others with one that it cannot hold.

    Those of least time start with the largest s'', but not as if friction were larger.
    """
    task, plans, margin = iterate.task, iterate.plans, 0.0
    goal, ranges = task.options.goal, task.options.ranges
    if goal is Objective.MARGIN:
        margin = plans[0].value - task.epsilon
    start = find_sure_start(iterate.parts[0], plans[0].motion.profile, margin, ranges)
    if start is None:
        return plans
    try:
        other = refine(replace(iterate, task=replace(task, start=start)), task.options.accuracy)
    except SolverError:
        return plans
    loss = other.objective - iterate.objective
    return other.plans if ranges or loss <= WORTH * abs(iterate.objective) else plans


def find_sure_start(
    data: PhaseData, profile: Profile, margin: float, ranges: Mapping[str, float]
) -> SureStart | None:
    """Bounds with which a motion leaves rest; None if it does anyway, or if nothing helps.

    At rest the torques are affine in s'' and internal force, tau = T0 + Ta s'' + Tl lambda. Those
    that friction can hold are a polygon (`mechanics.statics`). The first node is put beyond one of
    its sides: at the nearest place that keeps every limit, or beyond.

    Parameters
    ----------
    margin : [N]  of normal forces over epsilon
    ranges        of parameters, within all of which it has to leave rest
    """
    from ..robust.robust_rows import list_holds, measure_holds

    formation, forces = data.curve.formation, data.nodes.forces
    holds = list_holds(formation, data.curve.start, ranges)
    here = np.array([profile.a[0], profile.lam[0]])
    T0, T = forces.of_tau[0, :, ONE], forces.of_tau[0][:, [A, LAMBDA]]
    unit = formation.scene.scales.torque
    if measure_holds(holds, T0 + T @ here) > SURE * unit:
        return None
    presses = np.isin(data.limits.sides[0], data.limits.of(PRESS))
    rows = data.find_limits(data.nodes.pick(slice(0, 1))).rows[0] * data.spans[:, None]
    slopes = rows[:, [A, LAMBDA]]
    scales = formation.scene.scales
    units = np.array([scales.acceleration, scales.force])
    # Sides of the torques that can be held, and a distance beyond [N m].
    sides = [
        (normal * gains, bound + 10.0 * SURE * unit)
        for static, gains in holds
        for normal, bound in zip(static.normals, static.bounds, strict=True)
    ]
    # Shares of a margin to give up.
    for share in (0.0, 0.002, 0.005, 0.01, WORTH) if margin > 0 else (0.0,):
        offsets = rows[:, ONE] - (1 - share) * margin * presses
        best, start = np.inf, None
        for side, bound in sides:
            normal = side @ T
            if normal[0] <= 0:
                continue
            # The nearest place on the line normal @ x = level, and where limits cross it.
            level, along = float(bound - side @ T0), np.array([-normal[1], normal[0]])
            foot = here + units**2 * normal * (level - normal @ here) / (units**2 @ normal**2)
            rates, rest = slopes @ along, offsets + slopes @ foot
            crossings = -rest[rates != 0] / rates[rates != 0]
            for place in (foot, *(foot + share * along for share in crossings)):
                kept = ((offsets + slopes @ place) / data.spans).min() >= -1e-9 and place[0] > 0
                kept = kept and measure_holds(holds, T0 + T @ place) > SURE * unit
                away = float(np.abs(T @ (place - here)).max())
                if kept and away < best:
                    ends = (place[1], np.inf) if normal[1] > 0 else (-np.inf, place[1])
                    best, start = away, SureStart(float(place[0]), *map(float, ends))
        if start is not None:
            return start
    return None


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
    pins: Pins = (None, None)

    @cached_property
    def spreads(self) -> list[RobustLimits | None]:
        """Robust force limits of each curve, None without ranges."""
        if not self.guides:
            return [None] * len(self.curves)
        from ..robust.robust_rows import spread

        args = self.epsilon, self.options.ranges
        return [spread(*pair, *args) for pair in zip(self.curves, self.guides, strict=True)]

    @property
    def is_held(self) -> bool:
        """Whether motions start and end without acceleration, as torques may not step."""
        return self.curves[0].formation.scene.has_slow_motors

    @property
    def elements(self) -> int:
        """Number of elements of each phase, before some are halved; fewer in a first solve."""
        if self.options.intervals is None:
            few = _SMOOTH if self.options.goal is Objective.EFFORT else _START
            return _RATE if self.is_held else few
        return max(-(-self.options.intervals // DEGREE), 3)

    def lay_out(self, breaks: Sequence[Array], elements: int) -> list[PhaseData]:
        """Each phase on elements with breaks: as many as wanted, if that is enough for these."""
        pairs, last = list(zip(self.curves, breaks, strict=True)), len(breaks) - 1
        elements = max(elements, *(len(find_ends(*pair)) - 1 for pair in pairs))
        grids = [
            make_grid(*pair, elements, (k == 0, k == last), self.is_held)
            for k, pair in enumerate(pairs)
        ]
        columns = zip(self.curves, grids, self.phases, self.spreads, strict=True)
        return [
            prepare(curve, self.epsilon, grid, phase, limits)
            for curve, grid, phase, limits in columns
        ]

    def find_fastest(self) -> Fastest | None:
        """The minimum-time speed profile of a sweep; None without one."""
        return find_fastest(join(self.lay_out([np.zeros(0)] * len(self.curves), self.elements)))


def require_unique(curve: Curve, least: float, phase: int) -> None:
    """Raise an AmbiguityError if a uniqueness margin along the curve of a phase is below `least`.

    Where friction jams the curve, `path_data.prepare` raises.
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


class PathSolution(NamedTuple):
    """A solution of the NLP, or the point to start from."""

    profile: Profile
    margin: float  # [N]: over epsilon
    multipliers: dict[str, Array]
    cost: float = np.inf  # in the units of the NLP
    duration: float = 0.0  # [s]: by the quadrature of the NLP, where it is bounded


@dataclass(frozen=True)
class PathIterate:
    """A mesh with its NLP, and the solution on it or the point to start from."""

    task: Task
    breaks: tuple[Array, ...]  # [m]: of each curve, where elements end at switches
    cuts: tuple[Array, ...]  # [m]: other ends of elements of each curve, if some were halved
    parts: list[PhaseData]  # each phase on its grid
    data: PhaseData  # all phases as one
    nlp: PathNLP
    units: Units
    solution: PathSolution
    tightening: Tightening  # of the limits for that
    meshes: int = 0  # before this one
    before: PathIterate | None = None  # the solution on the mesh before

    @staticmethod
    def begin(task: Task, elements: int) -> PathIterate:
        """Start from the minimum-time speed profile, or a parabola of the squared speed."""
        none = [np.zeros(0)] * len(task.curves)
        parts, breaks = task.lay_out(none, elements), [*none]
        data = join(parts)
        profile, units = guess(data, task.options.time_weight)
        swept = task.options.goal is Objective.TIME and not task.is_held
        if swept and (fastest := find_fastest(data)):
            # Breaks at the switches, but on a curve where a fixed number of elements is too few.
            starts = np.cumsum([0.0, *(curve.length for curve in task.curves)])
            places = np.array([switch.place for switch in fastest.switches])
            owner = np.searchsorted(starts[1:-1], places)
            for k, curve in enumerate(task.curves):
                on_curve = keep_apart(curve, places[owner == k] - starts[k])
                if not task.options.intervals or len(find_ends(curve, on_curve)) <= elements:
                    breaks[k] = on_curve
            parts = task.lay_out(breaks, elements)
            profile = guess_below(join(parts), fastest)
        return PathIterate.on(task, (breaks, none), parts, units, profile, 0.0)

    @staticmethod
    def on(
        task: Task,
        edges: tuple[Sequence[Array], Sequence[Array]],
        parts: list[PhaseData],
        units: Units,
        profile: Profile,
        margin: float,
    ) -> PathIterate:
        """The NLP on elements with these breaks and cuts, near a motion and its margin [N].

        Multipliers are those near the central path.
        """
        data, (breaks, cuts) = join(parts), map(tuple, edges)
        nlp = build_path_nlp(LimitShape.of(data), len(data.grid.steps), task.options.goal)
        first = PathSolution(profile, margin, center(nlp, data, units, profile, margin))
        none = Tightening.none(data, task.duration)
        return PathIterate(task, breaks, cuts, parts, data, nlp, units, first, none)

    def restart(self) -> PathIterate | None:
        """The solution on the mesh before with tightened limits, or more elements, once."""
        if self.before is not None:
            return replace(self.before.tighten(), meshes=SOLVES)
        elements = (1 if self.task.is_held else 2) * self.task.elements
        if len(self.parts[0].grid.edges) >= elements:
            return None
        return PathIterate.begin(self.task, elements)

    def solve(self) -> PathIterate:
        """The solution on this mesh."""
        nlp, data, units, start, task = self.nlp, self.data, self.units, self.solution, self.task
        bounds = make_bounds(nlp, data, units, self.tightening, start=task.start, pins=task.pins)
        if (bounds["lbg"] > bounds["ubg"]).any():
            raise SolverError("limits that hold between the nodes too leave nothing")
        solver = nlp.starter if np.isinf(start.cost) else nlp.solver
        result = solver(
            x0=pack(nlp, start.profile, units, start.margin, data.grid.sizes),
            p=parameters(nlp, data, units, task.options.time_weight),
            **bounds,
            **start.multipliers,
        )
        stats = solver.stats()
        if not stats["success"]:
            raise SolverError(f"Ipopt stopped with {stats['return_status']}")
        profile, margin = unpack(nlp, data.grid, result["x"].full()[:, 0], units)
        multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
        duration = float(result["g"][-1]) * units.time if self.tightening.duration else 0.0
        solution = PathSolution(profile, margin, multipliers, float(result["f"]), duration)
        return replace(self, solution=solution)

    def adapt(self) -> PathIterate | None:
        """The next one to solve: with rows or breaks for this motion, halved, or tightened."""
        task, accuracy, margin = self.task, self.task.options.accuracy, self.solution.margin
        again = self.meshes < 6  # most meshes whose breaks move
        # A first plan that misses much by signs of no row is a reference only; case: two releases
        # of a pentagon, whose plan takes 20 % longer.
        slack = self.data.slack(self.data.nodes, self.solution.profile, margin)
        if task.guides and again and (slack / self.data.spans).min() < -0.05:
            other = PathIterate.begin(replace(task, guides=self.guides), task.elements)
            return replace(other, meshes=self.meshes + 1)
        # What tightening by the violations will cost, and what it has.
        (short, speeding), hurry, _ = self.misses
        due = self._price(*map(self.data.spread_to_nodes, (short, speeding, hurry)))
        costs = due + self.paid
        shares = np.split(costs, np.cumsum([len(part.grid.s) for part in self.parts])[:-1])
        costly = _GAP * float(costs.sum()) > accuracy
        if task.is_held and (self.meshes < 2 or (costly and self.meshes < 4)):
            grow = self.meshes >= 2 and task.options.intervals is None
            count = task.elements * 3 // 2 if grow else task.elements
            each = zip(self.parts, self.motions, shares, strict=True)
            return self._move([equidistribute(*phase, count) for phase in each], self.cuts, count)
        if not task.is_held and (self.meshes == 0 or costly) and self.meshes < SOLVES:
            # Neither least effort nor tightened limits show where the switches are.
            breaks, shift = self.breaks, 0.0
            if not (task.options.goal is Objective.EFFORT or bool(self.tightening.missed.any())):
                every = zip(self.parts, self.motions, self.breaks, strict=True)
                matches = [
                    match(before, find_switches(part, motion.profile, margin), part.curve)
                    for part, motion, before in every
                ]
                breaks = tuple(places for places, _ in matches)
                shift = max(distance for _, distance in matches)  # over the curve's length
            if shift > 25.0 * accuracy and again:  # over length and accuracy
                return self._move(breaks, self.cuts, task.elements)
            edges = [part.grid.edges for part in self.parts]
            count = min(task.elements, 80 - max(map(len, edges)))  # most elements of a phase
            if costly and task.options.intervals is None and 2 * count >= task.elements:
                halved = [halve(*pair, count) for pair in zip(edges, shares, strict=True)]
                return self._move(breaks, halved, task.elements)
        return self.tighten() if self.violation > 1 else None

    def _move(self, breaks: Sequence[Array], cuts: Sequence[Array], elements: int) -> PathIterate:
        """Start on at least so many other elements from this motion."""
        every = zip(self.task.curves, breaks, cuts, strict=True)
        held = self.task.is_held
        ends = [keep_apart(curve, np.append(places, more), held) for curve, places, more in every]
        parts, old = self.task.lay_out(ends, elements), self.solution
        grid = join(parts).grid
        profile = Elements(self.data.grid, old.profile).move(grid)
        if grid.held:
            profile = follow(grid, profile.a, profile.lam)
        made = PathIterate.on(self.task, (breaks, cuts), parts, self.units, profile, old.margin)
        return replace(made, meshes=self.meshes + 1, before=replace(self, before=None))

    def tighten(self) -> PathIterate:
        """The same with limits tightened by somewhat more than their violations."""
        data, tight = self.data, self.tightening
        (short, speeding), hurry, _ = self.misses
        solution, duration = self.solution, self.task.duration
        if duration is not None:
            # The quadrature of the NLP is not that of the motion.
            off = solution.duration / sum(motion.duration for motion in self.motions)
            duration *= float(np.clip(off, 0.8, 1.2))
        # Slack at nodes would absorb the rest: the lesser one of the two beside what is short.
        # Case: the largest margin of phase 3 of the heptagon on four contacts.
        slack, k = data.slack(data.nodes, solution.profile, solution.margin), data.grid.nonempty
        least = np.maximum(np.minimum(slack[k], slack[k + 1]), 0.0)
        reach = np.where(short > 0, least, 0.0)
        over = 1.05  # tightening over the violation
        added = over * data.spread_to_nodes(short)
        tighter = Tightening(
            np.maximum(tight.limits, data.spread_to_nodes(reach)) + added,
            tight.speed_share * (1 - over * data.spread_to_nodes(speeding)),
            duration,
            tight.missed + added,
            tight.motors * (1 - over * data.spread_to_nodes(hurry)),
        )
        return replace(self, tightening=tighter)

    @cached_property
    def motions(self) -> list[PathMotion]:
        """The motion of each phase."""
        pairs = zip(self.parts, cut(self.parts, self.solution.profile), strict=True)
        return [PathMotion(part.curve, part.grid, profile) for part, profile in pairs]

    @property
    def guides(self) -> tuple[Guide, ...]:
        """The motion along each curve as a reference."""
        from ..robust.robust_rows import Guide

        return tuple(Guide(motion.grid.s, *motion.profile) for motion in self.motions)

    @cached_property
    def misses(self) -> tuple[tuple[Array, Array], Array, float]:
        """Violations between nodes: of limits and b, of torque rates, of the duration."""
        duration, late = self.task.duration, 0.0
        if duration:
            late = sum(motion.duration for motion in self.motions) / duration - 1
        data, profile = self.data, self.solution.profile
        hurry = np.zeros((len(data.grid.nonempty), 2, 2))
        if data.grid.held:
            # Relative violations of rates and commands of each joint in each interval.
            torques, rates = find_torques(data, profile, self.motions)
            rate = np.abs(rates).max(axis=1) / data.rate_limit
            lags = data.curve.formation.scene.actuator_lag
            command = np.abs(torques + lags * rates).max(axis=1) / data.torque_limit
            hurry = np.maximum(np.stack([rate, command * (lags > 0)], axis=1) - 1, 0.0)
        return data.misses(profile, self.solution.margin), hurry, late

    @property
    def violation(self) -> float:
        """The largest violation between nodes, over the allowed one."""
        if any(motion.stalls for motion in self.motions):
            return np.inf
        (short, speeding), hurry, late = self.misses
        over = (short / self.data.spans).max(), speeding.max(), late
        return float(max(max(over) / MISS, hurry.max() / 1e-4))  # rates relatively

    @property
    def error(self) -> float:
        """Estimated relative error, by the cost of the tightening.

        Over 100 refinements the gap to plans at an accuracy of 1e-7 is 0.8 to 3.9 times that cost
        where limits are tightened once; 1.5 times is within a factor of 3 either way.
        """
        return _GAP * float(self.paid.sum())

    @cached_property
    def paid(self) -> Array:
        """Relative cost at each node of the tightening so far."""
        tight = self.tightening
        return self._price(tight.missed, 1 - tight.speed_share, 1 - tight.motors)

    def _price(self, limits: Array, speed_share: Array, motors: Array) -> Array:
        """First-order relative cost of tightening at each node, shape (n,).

        The sum of multipliers times the tightening of limits, (n, n_sides), b, (n,), and torque
        rates and commands, (n, 2, 2).
        """
        nlp, data, units, solution = self.nlp, self.data, self.units, self.solution
        rows, signs, _ = data.limits.sides
        on_g, count = solution.multipliers["lam_g0"], len(data.grid.s)
        on_limits = on_g[nlp.g["limits"]].reshape(count, -1)
        on_sides = np.maximum(-signs * on_limits[:, rows], 0.0) / units.of(data.limits)[rows]
        on_b = np.zeros(nlp.free.shape)
        on_b[nlp.free] = solution.multipliers["lam_x0"]
        on_b = np.maximum(on_b[:, 0], 0.0) * solution.profile.b / data.grid.sizes
        costs = (on_sides * limits).sum(axis=1) + on_b / units.profile[0] * speed_share
        motor_rows = (("rates", nlp.shape.rates), ("commands", nlp.shape.commands))
        for kind, (name, joints) in enumerate(motor_rows):
            on_rows = np.abs(on_g[nlp.g[name]]).reshape(len(joints), count).T
            costs += (on_rows * motors[:, kind, list(joints)]).sum(axis=1)
        scale = abs(solution.cost)
        if self.task.options.goal is Objective.MARGIN:
            scale = abs(self.task.epsilon + solution.margin) / units.force
        return np.asarray(costs / max(scale, 1e-9))

    @cached_property
    def plans(self) -> Plans:
        """The plan of each phase; SolverError if one nearly stops between two nodes."""
        options, plans = self.task.options, []
        for part, motion in zip(self.parts, self.motions, strict=True):
            torque, squares = fit_torque(part, motion)
            value = {
                Objective.TIME: motion.duration,
                Objective.EFFORT: squares + options.time_weight * motion.duration,
                Objective.MARGIN: self.task.epsilon + self.solution.margin,
            }[options.goal]
            plans.append(PhasePlan(motion, torque, value, error=self.error))
        return plans

    @property
    def objective(self) -> float:
        """Value of the plans' objective, the margin's with the opposite sign."""
        values = [plan.value for plan in self.plans]
        return -values[0] if self.task.options.goal is Objective.MARGIN else sum(values)
