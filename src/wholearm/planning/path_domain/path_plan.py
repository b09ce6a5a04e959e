"""Minimum-time, minimum-effort and maximum-margin plans of phases with one degree of freedom.

Direct collocation along the curve, refined in the loop of `refinement`; elements, equations, first
points and the estimate of the error are in the README. The unknowns a = s'', b = s'^2 and lambda
are polynomials in the local variable y of an element (`path_motion`).

Rate-limited torques are continuous: d tau / dt = (d tau / dy) (dy / dt), the torques at the nodes
of an element being a polynomial in y. The least margin has a copy at every node with m_k+1 = m_k: a
dense column would make building the Jacobian quadratic in their number. Built once for some
contacts, intervals and an objective, the NLP serves every phase: grid, coefficients and limits are
its parameters and bounds.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ...common.arrays import Array, Expression
from ...common.errors import AmbiguityError, JammingError, SolverError, name_phases
from ...geometry.curve import Curve, describe_pose, directions_of
from ...mechanics.dynamics import LAMBDA, ONE, A, B, V, apply, reduced_inertia
from ...mechanics.limits import PRESS, TORQUE, LimitSet
from ...mechanics.statics import SURE
from ...mechanics.uniqueness import describe_uniqueness, find_minors
from ..nlp import Columns, SolverStatistics, add_cost, build_solver
from ..options import Objective, PlanOptions
from ..phase_plan import PhasePlan, share_duration, value_of
from ..refinement import SOLVES, refine
from ..robust.robust_rows import Reference, RobustLimits, list_holds, measure_holds, robustify
from .path_data import PhaseData, find_torques, fit_torque, join, prepare
from .path_mesh import (
    Fastest,
    equidistribute,
    find_ends,
    find_fastest,
    halve,
    keep_apart,
    make_grid,
)
from .path_motion import DEGREE, NODES, Elements, PathMotion, Profile, find_basis, follow, list_maps

Plans = list[PhasePlan[PathMotion]]
Pins = tuple[float | None, float | None]  # prescribed internal force at start and end [N]
ALLOWED = 2.5e-7  # violation between nodes, over the limits' scales; relative for b and time
_GAP = 1.5  # gap to the optimum over the cost of the tightening
_PLACES = 65  # places of a segment at which uniqueness is checked; minima are narrow
_START, _SMOOTH, _RATE = 12, 20, 40  # elements of a phase; for effort; under rate limits
MAX_START_LOSS = 0.02  # largest relative cost of a start that friction cannot hold (`MovingStart`)
LEAST_B = 1e-8  # least |s''| at rest and b elsewhere, over typical ones: sqrt(b) is differentiable


def plan_curves(task: Task, explained: bool = True) -> Plans:
    """Plan phases along curves that are run through one after the other, from rest to rest.

    Without a plan it is `explained` why there is none, which takes longer than planning.

    Raises
    ------
    InfeasibleError  if no motion keeps the limits; names the violated ones and what would have to
                     change
    JammingError     if friction jams a formation somewhere on its curve; an AmbiguityError if
                     contact forces are not unique
    SolverError      if the solver does not converge
    """
    options, phases = task.options, task.phases
    try:
        if options.ranges:
            # Rows are for the motion of a reference: first of a plan without ranges.
            nominal = plan_task(replace(task, options=replace(options.roughen(), ranges={})))
            task = replace(task, references=nominal.references)
        iterate = _plan_linearized(task)
    except JammingError as jam:
        if not explained or len(task.curves) > 1:
            raise
        from ..explain import explain_jam

        raise explain_jam(task, jam) from None
    except SolverError as stuck:
        from ..explain import explain_curves

        reason = f"{name_phases(phases)}: {stuck}"
        error = explain_curves(task, reason) if explained else SolverError(reason)
        if task.references and isinstance(error, SolverError):
            # The reference is a plan without ranges; case: the block of two landings of a pentagon.
            raise SolverError(
                f"{reason} within the ranges of numbers; without them there is a plan: try "
                f"--robust {options.robust / 2:g}, or narrower [uncertainty], where 0 leaves a "
                "number as it is"
            ) from None
        raise error from None
    rounding = ALLOWED * task.curves[0].formation.scene.scales.force
    if options.goal is Objective.MARGIN and iterate.plans[0].value < task.epsilon - rounding:
        if task.duration is not None:
            fastest = options.for_least_time()
            least = plan_task(replace(task, options=fastest, duration=None)).plans
            where = f"{name_phases(phases, 'infeasible')}: "
            share_duration([plan.value for plan in least], task.duration, where)
        raise SolverError(f"{name_phases(phases)}: the margin found is below epsilon")
    # Rate-limited torques start at the limit of what friction can hold.
    is_final = task.is_held or (options.goal is Objective.TIME and not options.ranges)
    return iterate.plans if is_final else _leave_rest(iterate)


def plan_task(task: Task) -> PathIterate:
    """Solve and refine."""
    for curve, phase in zip(task.curves, task.phases, strict=True):
        require_unique(curve, task.options.uniqueness_margin, phase)
    first = PathIterate.begin(task, min(task.elements, _START) if task.is_held else task.elements)
    return refine(first, task.options.accuracy)


def _plan_linearized(task: Task) -> PathIterate:
    """Plan; with a reference by successive linearization, each about the motion of the one before.

    Violations by other signs than those of the rows are tightened; if that costs too much, again.
    The first plan is a rough one, whose few nodes have few of them: many may leave no plan at all.
    Case: three phases of a pentagon within half its usual ranges.
    """
    if not task.references:
        return plan_task(task)
    iterate = plan_task(replace(task, options=task.options.roughen()))
    for _ in range(3):  # most further ones
        if iterate.error <= task.options.accuracy:
            break
        try:
            candidate = plan_task(replace(task, references=iterate.references))
        except SolverError:
            break
        if candidate.objective >= iterate.objective:
            break
        iterate = candidate
    return replace(iterate, task=replace(iterate.task, options=task.options))


def _leave_rest(iterate: PathIterate) -> Plans:
    """The plans, or if friction can hold their start, others with one that it cannot hold.

    Those of least time start with the largest s'', but not as if friction were larger.
    """
    task, plans, margin = iterate.task, iterate.plans, 0.0
    goal, ranges = task.options.goal, task.options.ranges
    if goal is Objective.MARGIN:
        margin = plans[0].value - task.epsilon
    start = find_moving_start(iterate.parts[0], plans[0].motion.profile, margin, ranges)
    if start is None:
        return plans
    try:
        moving = refine(replace(iterate, task=replace(task, start=start)), task.options.accuracy)
    except SolverError:
        return plans
    loss = moving.objective - iterate.objective
    return moving.plans if ranges or loss <= MAX_START_LOSS * abs(iterate.objective) else plans


def find_moving_start(
    data: PhaseData, profile: Profile, margin: float, ranges: Mapping[str, float]
) -> MovingStart | None:
    """Bounds with which a motion leaves rest; None if it does anyway, or if nothing helps.

    At rest the torques are affine in s'' and internal force, tau = T0 + Ta s'' + Tl lambda. Those
    that friction can hold are a polygon (`mechanics.statics`). The first node is put beyond one of
    its sides: at the nearest place that keeps every limit, or beyond.

    Parameters
    ----------
    margin : [N]  of normal forces over epsilon
    ranges        of parameters, within all of which it has to leave rest
    """
    formation, of_tau = data.curve.formation, data.of_tau[0]
    holds = list_holds(formation, data.curve.start, ranges)
    first = np.array([profile.a[0], profile.lam[0]])
    T0, T = of_tau[:, ONE], of_tau[:, [A, LAMBDA]]
    scales, spans = formation.scene.scales, data.limits.side_scales
    if measure_holds(holds, T0 + T @ first) > SURE * scales.torque:
        return None
    is_press = np.isin(data.limits.sides[0], data.limits.of(PRESS))
    rows = data.find_limits(data.nodes.pick(slice(0, 1))).rows[0] * spans[:, None]
    slopes, units = rows[:, [A, LAMBDA]], np.array([scales.acceleration, scales.force])
    # Sides of the torques that can be held, and a distance beyond [N m].
    sides = [
        (normal * gains, bound + 10.0 * SURE * scales.torque)
        for static, gains in holds
        for normal, bound in zip(static.normals, static.bounds, strict=True)
    ]
    # Fractions of a margin to give up.
    for fraction in (0.0, 0.002, 0.005, 0.01, MAX_START_LOSS) if margin > 0 else (0.0,):
        offsets = rows[:, ONE] - (1 - fraction) * margin * is_press
        least, start = np.inf, None
        for gradient, bound in sides:
            normal = gradient @ T
            if normal[0] <= 0:
                continue
            # The nearest place on the line normal @ x = offset, and where limits cross it.
            offset, along = float(bound - gradient @ T0), np.array([-normal[1], normal[0]])
            foot = first + units**2 * normal * (offset - normal @ first) / (units**2 @ normal**2)
            rates, slack = slopes @ along, offsets + slopes @ foot
            crossings = -slack[rates != 0] / rates[rates != 0]
            for point in (foot, *(foot + fraction * along for fraction in crossings)):
                feasible = ((offsets + slopes @ point) / spans).min() >= -1e-9 and point[0] > 0
                feasible = feasible and measure_holds(holds, T0 + T @ point) > SURE * scales.torque
                distance = float(np.abs(T @ (point - first)).max())
                if feasible and distance < least:
                    lam = (point[1], np.inf) if normal[1] > 0 else (-np.inf, point[1])
                    least, start = distance, MovingStart(float(point[0]), *map(float, lam))
        if start is not None:
            return start
    return None


@dataclass(frozen=True)
class Task:
    """Phases along curves that are planned as one."""

    curves: Sequence[Curve]  # with speed ratios that make the speed continuous where two meet
    epsilon: float  # [N]: least normal force
    options: PlanOptions
    phases: Sequence[int]  # the phases' numbers, for messages
    duration: float | None = None  # [s]: longest one of all, for the objective `margin`
    start: MovingStart | None = None
    references: tuple[Reference, ...] = ()  # with ranges a reference for each curve
    pins: Pins = (None, None)
    others: Mapping[int, Curve] = field(default_factory=dict)  # of other phases, for advice

    @cached_property
    def robust_limits(self) -> list[RobustLimits | None]:
        """Robust force limits of each curve, None without ranges."""
        if not self.references:
            return [None] * len(self.curves)
        args = self.epsilon, self.options.ranges
        return [robustify(*pair, *args) for pair in zip(self.curves, self.references, strict=True)]

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

    def lay_out(self, elements: int = 0, breaks: Sequence[Array] = ()) -> list[PhaseData]:
        """Each phase on elements with breaks: `elements` if that is enough for these, or more."""
        breaks, last = breaks or [np.zeros(0)] * len(self.curves), len(self.curves) - 1
        pairs = list(zip(self.curves, breaks, strict=True))
        elements = max(elements or self.elements, *(len(find_ends(*pair)) - 1 for pair in pairs))
        parts = list[PhaseData]()
        for k, (pair, phase) in enumerate(zip(pairs, self.phases, strict=True)):
            grid = make_grid(*pair, elements, (k == 0, k == last), self.is_held)
            parts.append(prepare(pair[0], self.epsilon, grid, phase, self.robust_limits[k]))
        return parts

    def find_fastest(self) -> Fastest | None:
        """The minimum-time speed profile of a sweep; None without one."""
        return find_fastest(join(self.lay_out()))

    def locate_switches(self, fastest: Fastest) -> list[Array]:
        """Places on each curve at which the minimum-time profile switches [m]."""
        starts = np.cumsum([0.0, *(curve.length for curve in self.curves)])
        owner = np.searchsorted(starts[1:-1], fastest.switches)
        return [
            keep_apart(curve, fastest.switches[owner == k] - starts[k])
            for k, curve in enumerate(self.curves)
        ]


def require_unique(curve: Curve, required: float, phase: int) -> None:
    """Raise an AmbiguityError if a uniqueness margin along a curve is below `required`.

    Where friction jams the curve, `path_data.prepare` raises.
    """
    formation, segments = curve.formation, curve.segments
    if not formation.friction.any():
        return
    s = np.concatenate([np.linspace(part.start, part.stop, _PLACES) for part in segments])
    point = curve.evaluate(s)
    directions = directions_of(curve, np.repeat(np.arange(len(segments)), _PLACES))
    Xi = directions.Xi
    sticks = (formation.sliding_friction > 0) & (Xi == 0).all(axis=0)
    sticking = tuple(np.flatnonzero(sticks).tolist())
    ratio, names, row = find_minors(formation, point.kinematics, Xi, sticking).find_least()
    if ratio >= required:
        return
    if reduced_inertia(formation, point.kinematics, directions).min() > 0:
        text = describe_uniqueness(ratio, names, describe_pose(point.z[row]), required)
        raise AmbiguityError(f"phase {phase}: {text}")


class Tightening(NamedTuple):
    """Tightening of limits at the nodes so that they hold between nodes too."""

    limits: Array | float = 0.0  # (N + 1, n_sides) [N, N m]: of each side of the limits
    # (N + 1, n_sides) [N, N m]: the part of `limits` beyond the slack at nodes
    excess: Array | float = 0.0
    # (N + 1, 5): factors on the largest b, both torque rate limits and both largest commands
    factors: Array | float = 1.0
    duration: float = 1.0  # factor on the longest duration, if there is one


@dataclass(frozen=True)
class PathIterate:
    """A mesh with its NLP, and the solution on it or the point to start from."""

    task: Task
    parts: list[PhaseData]  # each phase on its grid
    units: Units
    profile: Profile
    goal: Objective
    margin: float = 0.0  # [N]: over epsilon
    tightening: Tightening = field(default_factory=Tightening)  # of the limits for that
    multipliers: dict[str, Array] = field(default_factory=dict)  # empty at a point to start from
    cost: float = np.inf  # in the units of the NLP
    duration: float = 0.0  # [s]: by the quadrature of the NLP, where it is bounded
    meshes: int = 0  # before this one
    before: PathIterate | None = None  # the solution on the mesh before

    @staticmethod
    def begin(task: Task, elements: int) -> PathIterate:
        """Start from the minimum-time speed profile, or a parabola of the squared speed."""
        data, breaks = join(parts := task.lay_out(elements)), [np.zeros(0)] * len(task.curves)
        profile, units = guess(data, task.options.time_weight)
        from_sweep = task.options.goal is Objective.TIME and not task.is_held
        if from_sweep and (fastest := find_fastest(data)):
            # Breaks at the switches, but on a curve where a fixed number of elements is too few.
            for k, places in enumerate(task.locate_switches(fastest)):
                if not task.options.intervals or len(find_ends(task.curves[k], places)) <= elements:
                    breaks[k] = places
            parts = task.lay_out(elements, breaks)
            profile = guess_below(join(parts), fastest)
        return PathIterate(task, parts, units, profile, task.options.goal)

    @staticmethod
    def elastic(task: Task) -> PathIterate:
        """The problem with soft limits, from a slow motion whatever they are."""
        data = join(parts := task.lay_out())
        profile, units = _guess_at(data, 0.7 * _find_fall_b(data) * 2.0**_SLOW)
        # A shortfall of torque is as bad as one of force.
        torque = np.full(2, 15.0 * data.curve.formation.scene.scales.torque)
        units = units._replace(torque=torque)
        return PathIterate(task, parts, units, profile, Objective.ELASTIC)

    @cached_property
    def data(self) -> PhaseData:
        """All phases as one."""
        return join(self.parts)

    @cached_property
    def nlp(self) -> PathNLP:
        """The NLP on their elements."""
        steps = len(self.data.grid.steps)
        return build_path_nlp(LimitShape.of(self.data), steps, self.goal)

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
        nlp, units, bounds = self.nlp, self.units, self.make_bounds()
        if (bounds["lbg"] > bounds["ubg"]).any():
            raise SolverError("limits that hold between the nodes too leave nothing")
        solver = nlp.solver if self.multipliers else nlp.start_solver
        bounds |= self.multipliers or self._find_central_multipliers()
        result = solver(x0=self.pack(), p=self.find_parameters(), **bounds)
        if not result["success"]:
            raise SolverError(f"Ipopt stopped with {result['status']}")
        # b is integrated again from a: b' = 2 a to rounding, not to Ipopt's tolerance.
        x = result["x"].full()[:, 0]
        profile = follow(self.data.grid, x[nlp.x["a"]] * units.a, x[nlp.x["lam"]] * units.force)
        margin = float(x[-1]) * units.force if self.goal is Objective.MARGIN else 0.0
        return replace(
            self,
            profile=profile,
            margin=margin,
            multipliers={f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")},
            cost=float(result["f"]),
            duration=float(ca.sum1(result["g"][nlp.g["duration"]])) * units.time,
        )

    def find_usage(self) -> Array:
        """Torque rates and commands at the nodes over their limits, (N + 1, 5) as of `factors`.

        The largest b counts as used.
        """
        nlp, data = self.nlp, self.data
        g = nlp.solver.function.get_function("nlp_g")(self.pack(), self.find_parameters())
        g, usage = g.full()[:, 0], np.ones((len(data.grid.s), 5))
        torque = data.torque_limit / self.units.of(data.limits)[list(nlp.shape.torques)]
        for first, name, limits in ((1, "rates", np.ones(2)), (3, "commands", torque)):
            joints = list(getattr(nlp.shape, name))
            values = np.abs(g[nlp.g[name]]).reshape(len(joints), len(usage))
            usage[:, [first + joint for joint in joints]] = (values / limits[joints, None]).T
        return usage

    def pack(self) -> Array:
        """Unknowns of the NLP, in its units, of the motion to start from.

        Soft limits start with somewhat larger shortfalls than those of the motion.
        """
        nlp, data, units, profile = self.nlp, self.data, self.units, self.profile
        extra = np.full(nlp.x.sizes["extra"], self.margin / units.force)
        if self.goal is Objective.ELASTIC:
            shortfalls = np.maximum(data.limits.fold(-data.slack(data.nodes, profile)), 0.0)
            shortfalls += 0.05 * data.limits.scales
            extra = (shortfalls / units.of(data.limits)).ravel("F")
        # On another mesh b of a motion that stalls may be negative. Case: largest margin of phase 2
        # of the rolling box in 1.3 s, 0.378 N in place of 0.443 N.
        y, power = data.grid.s / data.grid.s[-1], 4 / 3 if data.grid.held else 1.0
        least = 0.01 * profile.b.max() * (4 * y * (1 - y)) ** power
        b = (np.maximum(profile.b, least) / units.b / data.grid.sizes)[1:-1]
        x = nlp.x.join(a=profile.a / units.a, b=b, lam=profile.lam / units.force, extra=extra)
        return np.asarray(x)

    def find_parameters(self) -> Array:
        """Parameters of the NLP, in its units."""
        nlp, data, units = self.nlp, self.data, self.units
        unit, shape, scene = units.of(data.limits), nlp.shape, data.curve.formation.scene
        torque = unit[list(shape.torques)]
        blocks = {
            "steps": data.grid.steps / units.length,
            "weight": np.array([self.task.options.time_weight / units.power]),
            "calm": np.array([units.force / units.press]),
            "terms": data.nodes.values * units.motion / unit[:, None],
            "joints": torque**2 / units.power,
            "quick": torque / units.time / scene.torque_rate_limit,
            "lags": scene.actuator_lag / units.time,
            "maps": data.grid.maps,
            "sizes": data.grid.sizes,
        }
        return np.asarray(nlp.p.join(**{name: block.ravel("F") for name, block in blocks.items()}))

    def make_bounds(self) -> dict[str, Array]:
        """Bounds of the NLP, with every limit tightened."""
        nlp, data, units, tightening = self.nlp, self.data, self.units, self.tightening
        start, n = self.task.start, len(data.grid.s)
        factors = np.broadcast_to(tightening.factors, (n, 5))
        # Next to rest b is 2 s times the least s''.
        s, length = data.grid.s, data.grid.s[-1]
        low_b = LEAST_B * np.minimum(s, length - s) / length
        high_b = np.maximum(data.largest_b(data.nodes) * factors[:, 0] / units.b, 2 * LEAST_B)
        if data.grid.held:
            low_b, high_b = np.full(n, LEAST_B), high_b / data.grid.sizes
        low, high = np.full((2, nlp.x.count), [[-np.inf], [np.inf]])
        low[nlp.x["b"]], high[nlp.x["b"]] = low_b[1:-1], high_b[1:-1]
        low[nlp.x["extra"]] = -np.inf if self.goal is Objective.MARGIN else 0.0
        (low_a, high_a), (low_lam, high_lam) = (
            (low[nlp.x[name]], high[nlp.x[name]]) for name in ("a", "lam")
        )
        # From rest to rest, without reversal.
        if nlp.shape.slow:
            low_a[[0, -1]] = high_a[[0, -1]] = 0.0
        else:
            low_a[0], high_a[-1] = LEAST_B, -LEAST_B
        if start is not None:
            low_a[0] = max(start.least_a / units.a, LEAST_B)
            low_lam[0], high_lam[0] = start.low / units.force, start.high / units.force
        for place, pin in zip((0, -1), self.task.pins, strict=True):
            if pin is not None:
                low_lam[place] = high_lam[place] = pin / units.force
        low_g, high_g = np.zeros((2, nlp.g.count))
        (rows, signs, bounds), unit = data.limits.sides, units.of(data.limits)
        sides = (bounds + signs * tightening.limits - data.nodes.values[:, rows, ONE]) / unit[rows]
        low_g[nlp.g["limits"]], high_g[nlp.g["limits"]] = -np.inf, np.inf
        highs = rows[signs < 0] + (nlp.shape.rows if self.goal is Objective.ELASTIC else 0)
        low_g[nlp.g["limits"]].reshape(n, -1)[:, rows[signs > 0]] = sides[:, signs > 0]
        high_g[nlp.g["limits"]].reshape(n, -1)[:, highs] = sides[:, signs < 0]
        duration = (self.task.duration or np.inf) * tightening.duration / units.time
        low_g[nlp.g["duration"]], high_g[nlp.g["duration"]] = -np.inf, duration
        torque = data.torque_limit / unit[list(nlp.shape.torques)]
        for name, columns in (("rates", factors[:, 1:3]), ("commands", factors[:, 3:] * torque)):
            bound = columns[:, list(getattr(nlp.shape, name))].ravel("F")
            low_g[nlp.g[name]], high_g[nlp.g[name]] = -bound, bound
        low_g[nlp.g["begins"]], high_g[nlp.g["begins"]] = LEAST_B, np.inf
        return {"lbx": low, "ubx": high, "lbg": low_g, "ubg": high_g}

    def _find_central_multipliers(self) -> dict[str, Array]:
        """Multipliers with which a motion is near the central path: none of the links b' = 2 a.

        Empty where limits are soft.
        """
        nlp, data, units, profile = self.nlp, self.data, self.units, self.profile
        if self.goal is Objective.ELASTIC:
            return {}
        rows, signs, _ = data.limits.sides
        slack = data.slack(data.nodes, profile, self.margin) / units.of(data.limits)[rows]
        lam_rows = np.zeros((len(slack), nlp.shape.rows))
        for side, row in enumerate(rows.tolist()):
            lam_rows[:, row] -= signs[side] * _CENTRAL / np.maximum(slack[:, side], _SLACK)
        lam_x, lam_g = np.zeros(nlp.x.count), np.zeros(nlp.g.count)
        lam_x[nlp.x["b"]] = -_CENTRAL / np.maximum(profile.b[1:-1] / units.b, _SLACK)
        lam_g[nlp.g["limits"]] = lam_rows.ravel()
        # The chain's multiplier at a node is the sum of those of normal forces from there on.
        lam_chain = -1 - np.cumsum(lam_rows[:, list(nlp.shape.presses)].sum(axis=1))[:-1]
        lam_g[nlp.g["chain"]] = lam_chain[: nlp.g.sizes["chain"]]
        return {"lam_x0": lam_x, "lam_g0": lam_g}

    def adapt(self) -> PathIterate | None:
        """The next iterate: with rows for this motion, other elements, or tighter limits."""
        task, accuracy = self.task, self.task.options.accuracy
        # A first plan with large violations by signs of no row is only a reference. Case: two
        # releases of a pentagon, whose plan takes 20 % longer.
        if task.references and self.meshes < 6:  # most references
            slack = self.data.slack(self.data.nodes, self.profile, self.margin)
            if (slack / self.data.limits.side_scales).min() < -0.05:
                new = PathIterate.begin(replace(task, references=self.references), task.elements)
                return replace(new, meshes=self.meshes + 1)
        only_stalls = not any(map(np.any, self.violations[:2]))
        if task.duration and np.isinf(self.violation) and (task.is_held or only_stalls):
            # In so long a time a motion may all but stop: shorter ones keep the same margin. Cases:
            # the slide of a triangle in 100 s, which takes 0.3 s at least; under rate limits phase
            # 5 of the heptagon on four contacts in 2.5 s, where torques jump at such a stop.
            return PathIterate.begin(replace(task, duration=task.duration / 2), task.elements)
        # Cost of tightening by the violations, and of the tightening so far.
        total = self.costs + self._find_costs(*map(self.data.move_to_nodes, self.violations[:2]))
        phase_costs, costly = self._split(total), _GAP * float(total.sum()) > accuracy
        if task.is_held and (self.meshes < 2 or (costly and self.meshes < 4)):
            grow = self.meshes >= 2 and task.options.intervals is None
            count = task.elements * 3 // 2 if grow else task.elements
            phases = zip(self.parts, self.motions, phase_costs, strict=True)
            return self._remesh([equidistribute(*phase, count) for phase in phases], count)
        if costly and not task.is_held and self.meshes < SOLVES and task.options.intervals is None:
            edges = [part.grid.edges for part in self.parts]
            count = min(task.elements, 80 - max(map(len, edges)))  # most elements of a phase
            breaks = [halve(*pair, count) for pair in zip(edges, phase_costs, strict=True)]
            refined = self._remesh(breaks, task.elements)
            # Where elements have their least length, halving more of them gains nothing.
            if len(refined.parts[0].grid.edges) >= len(edges[0]) + task.elements // 2:
                return refined
        return self.tighten() if self.violation > 1 else None

    def _remesh(self, breaks: Sequence[Array], elements: int) -> PathIterate:
        """Start on at least so many other elements, with these breaks, from this motion."""
        pairs, held = zip(self.task.curves, breaks, strict=True), self.task.is_held
        ends = [keep_apart(curve, places, held) for curve, places in pairs]
        parts = self.task.lay_out(elements, ends)
        grid = join(parts).grid
        profile = Elements(self.data.grid, self.profile).move(grid)
        if grid.held:
            profile = follow(grid, profile.a, profile.lam)
        return replace(
            self,
            parts=parts,
            profile=profile,
            tightening=Tightening(),
            multipliers={},
            meshes=self.meshes + 1,
            before=replace(self, before=None),
        )

    def tighten(self) -> PathIterate:
        """The same with limits tightened by somewhat more than their violations."""
        data, current = self.data, self.tightening
        excess, over, delay = self.violations
        factor = 1.0
        if self.task.duration is not None:
            # The quadrature of the NLP is not that of the motion.
            ratio = self.duration / sum(motion.duration for motion in self.motions)
            # From a solution Ipopt leaves 2e-6 of a bound: phase 2 of the heptagon's margin in 5 s.
            factor = float(np.clip(ratio, 0.8, 1.2)) * (1 - np.clip(4 * delay, 0.0, 1e-5))
        # Slack at nodes would absorb the rest: the lesser one of the two beside a violation.
        # Case: the largest margin of phase 3 of the heptagon on four contacts.
        slack, k = data.slack(data.nodes, self.profile, self.margin), data.grid.nonempty
        spare = np.maximum(np.minimum(slack[k], slack[k + 1]), 0.0)
        absorbed = np.where(excess > 0, spare, 0.0)
        added, less = (1.05 * data.move_to_nodes(violation) for violation in (excess, over))
        limits = np.maximum(current.limits, data.move_to_nodes(absorbed)) + added
        factors = current.factors
        if data.grid.held:
            # So it is with factors. Case: least effort of phase 4 of the heptagon with 50 N m/s.
            usage = self.find_usage()
            spared = data.move_to_nodes(np.where(over > 0, np.maximum(usage[k], usage[k + 1]), 0.0))
            factors = np.where(spared > 0, np.minimum(factors, spared), factors)
        tighter = Tightening(limits, current.excess + added, factors * (1 - less), factor)
        return replace(self, tightening=tighter)

    @cached_property
    def motions(self) -> list[PathMotion]:
        """The motion of each phase."""
        profiles = map(Profile, *map(self._split, self.profile))
        pairs = zip(self.parts, profiles, strict=True)
        return [PathMotion(part.curve, part.grid, profile) for part, profile in pairs]

    def _split(self, values: Array) -> list[Array]:
        """Values at the nodes of each phase."""
        return np.split(values, np.cumsum([len(part.grid.s) for part in self.parts])[:-1])

    @property
    def references(self) -> tuple[Reference, ...]:
        """The motion along each curve as a reference."""
        return tuple(Reference(motion.grid.s, *motion.profile) for motion in self.motions)

    @cached_property
    def violations(self) -> tuple[Array, Array, float]:
        """Violations between nodes: of limits, of those that `factors` scale, of the duration."""
        duration, delay = self.task.duration, 0.0
        if duration:
            delay = sum(motion.duration for motion in self.motions) / duration - 1
        data, profile = self.data, self.profile
        factors = np.zeros((len(data.grid.nonempty), 5))
        excess, factors[:, 0] = data.find_violations(profile, self.margin)
        if data.grid.held:
            torques, rates = find_torques(data, profile, self.motions)
            scene = data.curve.formation.scene
            rate, lags = np.abs(rates).max(axis=2) / scene.torque_rate_limit, scene.actuator_lag
            command = np.abs(torques + lags[:, None] * rates).max(axis=2) / data.torque_limit
            factors[:, 1:] = np.maximum(np.hstack([rate, command * (lags > 0)]) - 1, 0.0)
        return excess, factors, delay

    @property
    def violation(self) -> float:
        """The largest violation between nodes, over the allowed one."""
        if any(motion.stalls for motion in self.motions):
            return np.inf
        excess, factors, delay = self.violations
        largest = max((excess / self.data.limits.side_scales).max(), factors[:, 0].max(), delay)
        return float(max(largest / ALLOWED, factors[:, 1:].max() / 1e-4))

    @property
    def error(self) -> float:
        """Estimated relative error, by the cost of the tightening.

        Over 75 refinements the gap to plans at an accuracy of 1e-7 is 0.8 to 3.9 times that cost
        where limits are tightened once; 1.5 times is within a factor of 3 either way.
        """
        return _GAP * float(self.costs.sum())

    @cached_property
    def costs(self) -> Array:
        """Relative cost at each node of the tightening so far."""
        return self._find_costs(self.tightening.excess, 1 - self.tightening.factors)

    def _find_costs(self, limits: Array | float, reductions: Array | float) -> Array:
        """First-order relative cost of tightening at each node, shape (n,).

        The sum of multipliers times the tightening of limits, (n, n_sides), and what is taken from
        `Tightening.factors`, (n, 5).
        """
        nlp, data, units = self.nlp, self.data, self.units
        rows, signs, _ = data.limits.sides
        lam_g, count = self.multipliers["lam_g0"], len(data.grid.s)
        lam_limits = lam_g[nlp.g["limits"]].reshape(count, -1)
        lam_sides = np.maximum(-signs * lam_limits[:, rows], 0.0) / units.of(data.limits)[rows]
        lam_b = np.maximum(self.multipliers["lam_x0"][nlp.x["b"]], 0.0)
        lam_factors = np.zeros((count, 5))
        lam_factors[1:-1, 0] = lam_b * (self.profile.b / data.grid.sizes / units.b)[1:-1]
        for first, name in ((1, "rates"), (3, "commands")):
            columns = [first + joint for joint in getattr(nlp.shape, name)]
            lam_factors[:, columns] = np.abs(lam_g[nlp.g[name]]).reshape(len(columns), count).T
        costs = (lam_sides * limits).sum(axis=1) + (lam_factors * reductions).sum(axis=1)
        scale = abs(self.cost)
        if self.task.options.goal is Objective.MARGIN:
            scale = abs(self.task.epsilon + self.margin) / units.force
        return np.asarray(costs / max(scale, 1e-9))

    @cached_property
    def plans(self) -> Plans:
        """The plan of each phase; SolverError if one nearly stops between two nodes."""
        plans, least = [], self.task.epsilon + self.margin
        for part, motion in zip(self.parts, self.motions, strict=True):
            torque = fit_torque(part, motion)
            value = value_of(self.task.options, motion.duration, torque, least)
            plans.append(PhasePlan(motion, torque, value, error=self.error))
        return plans

    @property
    def objective(self) -> float:
        """Value of the plans' objective, the margin's with the opposite sign."""
        values = [plan.value for plan in self.plans]
        return -values[0] if self.task.options.goal is Objective.MARGIN else sum(values)


class LimitShape(NamedTuple):
    """Structure of the limits that an NLP is built for."""

    rows: int  # number m of rows
    presses: tuple[int, ...]  # rows of the least normal forces
    torques: tuple[int, ...]  # rows of the torques
    viscous: tuple[int, ...]  # rows that depend on s'
    rates: tuple[int, ...]  # joints with a torque rate limit
    commands: tuple[int, ...]  # joints whose torques lag behind a command

    @staticmethod
    def of(data: PhaseData) -> LimitShape:
        """The shape of the limits of phases and of their motors."""
        limits, scene = data.limits, data.curve.formation.scene
        # What depends on torques or speeds of the joints does so with viscous friction.
        viscous = limits.rows[:, -4:].any(axis=1) | data.nodes.values[..., V].any(axis=0)
        masks = viscous, np.isfinite(scene.torque_rate_limit), scene.actuator_lag
        numbers = limits.of(PRESS), limits.of(TORQUE), *map(np.flatnonzero, masks)
        return LimitShape(len(limits.low), *(tuple(each.tolist()) for each in numbers))

    @property
    def slow(self) -> tuple[int, ...]:
        """Joints whose torques may not step."""
        return tuple(sorted({*self.rates, *self.commands}))


def _integrate_nodes(a: Expression, lengths: Expression, maps: Expression) -> Expression:
    """Rise of b from each node to the next, shape (N,), on elements with `maps`, (3, E)."""
    table, links = ca.reshape(a, NODES, -1), find_basis().links
    scales = [ca.repmat(maps[k, :] * lengths, DEGREE, 1) for k in range(3)]
    rises = sum(scale * (ca.DM(link) @ table) for scale, link in zip(scales, links, strict=True))
    return ca.vec(ca.vertcat(rises, ca.SX(1, lengths.numel())))[:-1]


def _find_y_rates(
    a: Expression, speed: Expression, lengths: Expression, maps: Expression, held: bool
) -> Expression:
    """Rate dy/dt of the local variable at each node, times the element's length, (p + 1, E)."""
    y = find_basis().y
    stretches = ca.DM(np.column_stack([y**0, 2 * y, 3 * y**2])) @ maps
    rates = ca.reshape(speed, NODES, -1) / stretches
    # At rest speed and stretch vanish: s'' or its slope makes the speed a power of y there.
    slopes, power = (find_first_slopes(a), 3) if held else ((a[0], -a[-1]), 2)
    for end, slope in zip((0, -1), slopes, strict=True):
        rates[end, end] = ca.sqrt(power / (power - 1) * lengths[end] * slope) / power
    return rates


def _sum_modes(values: Expression, degree: int) -> Expression:
    """Sum of the squared Legendre coefficients of each element from a degree on, shape (1, E)."""
    return ca.sum1((ca.DM(find_basis().modes[degree:]) @ ca.reshape(values, NODES, -1)) ** 2)


def find_first_slopes(a: Expression) -> tuple[Expression, Expression]:
    """Slopes of s'' over y at the start and at the end."""
    slopes = ca.DM(find_basis().slopes)
    return slopes[0, :] @ a[:NODES], slopes[-1, :] @ a[-NODES:]


class Units(NamedTuple):
    """Units of the NLP, in which its numbers are near 1 whatever the scene's size and mass are."""

    length: float  # [m]
    time: float  # [s]
    force: float  # [N]
    torque: Array  # (2,) [N m]: of each joint
    power: float  # [(N m)^2]: of the effort's integrand
    press: float  # [N]: typical internal force, in the regularization

    @property
    def a(self) -> float:
        """Unit of s'' [m/s^2]."""
        return self.length / self.time**2

    @property
    def b(self) -> float:
        """Unit of s'^2 [m^2/s^2]."""
        return (self.length / self.time) ** 2

    @property
    def motion(self) -> Array:
        """Units of (1, a, b, s', internal force), shape (5,)."""
        return np.array([1.0, self.a, self.b, self.length / self.time, self.force])

    def of(self, limits: LimitSet) -> Array:
        """Units of each row of limits, shape (m,)."""
        of_torque = np.abs(limits.rows[:, -4:-2])
        return np.where(of_torque.any(axis=1), of_torque @ self.torque, self.force)


class MovingStart(NamedTuple):
    """Bounds of the first node: s'' from `least_a` up, internal force from `low` to `high`."""

    least_a: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class PathNLP:
    """A built NLP."""

    # both take x0, p, bounds and multipliers; see `build_path_nlp` for their order
    solver: Expression
    start_solver: Expression  # for points that are no solution, with slacks near the central path
    shape: LimitShape
    # at the nodes: a, b over its size (not at the two ends), internal force `lam`, and `extra`:
    # shortfalls for `elastic`, column by column, or the least margin
    x: Columns
    # `steps` between nodes, `weight` of time, unit of internal force in the regularization;
    # coefficients of the limited values at the nodes, column by column (constant ones are part of
    # the bounds, too); weights of joints for `effort`; for rate limits 1 / these, lags, maps of
    # elements and `sizes` of b
    p: Columns
    # b' = 2 a; the `chain` of the margin; node by node the `limits`, where they are soft the lower
    # ones, then the upper ones; the `duration` for `margin`; rate limits
    g: Columns


@lru_cache(maxsize=16)
def build_path_nlp(shape: LimitShape, intervals: int, objective: Objective) -> PathNLP:
    """Build the NLP for every phase with limits of a shape."""
    started = time.perf_counter()
    n, m, slow = intervals + 1, shape.rows, shape.slow
    is_effort, is_margin = objective is Objective.EFFORT, objective is Objective.MARGIN
    is_soft = objective is Objective.ELASTIC
    sizes = {"steps": intervals, "weight": 1, "calm": 1, "terms": 5 * n * m, "joints": 2}
    p = Columns(**sizes, quick=2, lags=2, maps=3 * n // NODES, sizes=n)
    x = Columns(a=n, b=n - 2, lam=n, extra=n * (m if is_soft else is_margin))
    symbols, unknowns = p.make_symbols(), x.make_symbols()
    a, lam, extra = unknowns.a, unknowns.lam, ca.reshape(unknowns.extra, n, -1)
    # Under rate limits b is scaled: next to rest it is many orders of magnitude smaller.
    maps, scales = ca.DM(list_maps(np.zeros(n // NODES)).T), ca.DM.ones(n)
    if slow:
        maps, scales = ca.reshape(symbols.maps, -1, 3).T, symbols.sizes
    b = ca.vertcat(0, unknowns.b * scales[1:-1], 0)
    speed = ca.vertcat(0, ca.sqrt(b[1:-1]), 0)
    largest = ca.fmax(scales[1:], scales[:-1])
    h = symbols.steps
    lengths = ca.sum1(ca.reshape(ca.vertcat(h, 0), NODES, -1))
    y_rates = _find_y_rates(a, speed, lengths, maps, bool(slow))
    times = ca.vec(ca.DM(find_basis().weights) @ lengths / y_rates)
    # Limits but for their constant part, which is in the bounds.
    terms, viscous = ca.horzsplit(ca.reshape(symbols.terms, n, -1), m), list(shape.viscous)
    values = sum(terms[k] * ca.repmat(x_k, 1, m) for k, x_k in ((A, a), (B, b), (LAMBDA, lam)))
    values[:, viscous] += terms[V][:, viscous] * ca.repmat(speed, 1, len(viscous))
    torques, scaled_lam = (values + terms[ONE])[:, list(shape.torques)], symbols.calm * lam
    node_weights = ca.vertcat(0, h) + ca.vertcat(h, 0)
    node_costs = 1e-6 * node_weights * scaled_lam**2  # among equal plans
    roughness = _sum_modes(a, DEGREE) + _sum_modes(scaled_lam, DEGREE)
    if is_soft:
        # Soft limits would otherwise be avoided by motions that reverse between nodes.
        first, second = _sum_modes(a, 1), _sum_modes(a, 2)
        roughness += 1e3 * ca.horzcat(first[0], second[1:-1], first[-1])
        node_costs[:-1] += 1e-4 * (a[1:] - a[:-1]) ** 2
    node_costs[0] += 0.1 * ca.sum2(lengths * roughness)  # no oscillation within elements
    if objective is Objective.TIME:
        node_costs += times
    elif is_effort:
        node_costs += times * (torques**2 @ symbols.joints + symbols.weight)
    elif is_margin:
        node_costs[0] -= extra[0]
    else:
        # Not weighted by lengths, or shortfalls at short intervals would be cheap.
        node_costs += ca.sum2(extra) / n + 1e-4 * times

    limits = values
    if is_margin:
        limits = values - extra @ ca.DM(np.isin(np.arange(m), shape.presses).astype(float)).T
    elif is_soft:
        limits = ca.horzcat(values + extra, values - extra)
    empty = ca.SX(0, 1)
    rows = {
        "links": (b[1:] - b[:-1] - _integrate_nodes(a, lengths, maps)) / largest,
        "chain": extra[1:] - extra[:-1] if is_margin else empty,
        "limits": ca.vec(limits.T),
        "duration": ca.sum1(times) if is_margin else empty,
    }
    rows |= dict.fromkeys(("rates", "commands", "joins", "begins"), empty)
    if slow:
        # The derivatives of the polynomials of y through the torques at the nodes.
        slopes = ca.DM(find_basis().slopes) @ ca.reshape(torques, NODES, -1)
        scale = ca.repmat(y_rates / ca.repmat(lengths, NODES, 1), 1, 2)
        rates = ca.reshape(slopes * scale, n, 2)
        commands = torques + rates * ca.repmat(symbols.lags.T, n, 1)
        joins = torques[NODES::NODES, :] - torques[DEGREE:-1:NODES, :]
        rates *= ca.repmat(symbols.quick.T, n, 1)
        rows["rates"] = ca.vec(rates[:, list(shape.rates)])
        rows["commands"] = ca.vec(commands[:, list(shape.commands)])
        rows["joins"] = ca.vec(joins[:, list(slow)])
        rows["begins"] = ca.vertcat(*find_first_slopes(a))
    g = Columns(**{name: int(block.numel()) for name, block in rows.items()})
    nlp = {"x": unknowns.stack, "p": symbols.stack, "f": ca.sum1(node_costs), "g": g.write(**rows)}
    add_cost(SolverStatistics(build_time=time.perf_counter() - started))
    # Soft NLPs start far from their optimum, and need the more robust strategy.
    strategy: dict[str, Any]
    strategy = {"mu_strategy": "monotone"} if is_soft else {"mu_oracle": "probing"}
    if slow:
        # Large gradients of the time next to rest would scale the objective down. Probing lowers
        # the barrier at once, and steps along the bounds of rates are short then.
        strategy = {"nlp_scaling_method": "none", "mu_oracle": "quality-function"}
    solver = build_solver("path_nlp", nlp, 1e-9, max_iter=300, **strategy)
    start_solver = solver
    if slow:
        derived = {"jac_g": "nlp_jac_g", "hess_lag": "nlp_hess_l", "grad_f": "nlp_grad_f"}
        functions = {key: solver.function.get_function(name) for key, name in derived.items()}
        start_solver = build_solver("path_nlp", nlp, _SLACK, functions, max_iter=300, **strategy)
    return PathNLP(solver, start_solver, shape, x, p, g)


# Heights of guesses over that of a fall, as powers of two: whatever the limits, and the least one
# that is tried; case: joints with strong drag.
_SLOW, _LEAST = -12, -32
_BELOW = 0.9  # squared speed of a guess over that of the minimum-time profile: strictly feasible
# Complementarity of multipliers near the central path, and least slack, in units of the NLP.
_CENTRAL, _SLACK = 1e-4, 1e-3


def guess(data: PhaseData, time_weight: float = 0.0) -> tuple[Profile, Units]:
    """A guess with b as high as limits allow, by bisection.

    Where limits forbid even the slowest one, it is as quick as a fall: in units of a slow one the
    regularization would weigh too much.
    """
    limits, fall_b = data.find_limits(data.nodes), _find_fall_b(data)

    def is_blocked(ratio: float) -> bool:
        a, b = _make_parabola(data, fall_b * ratio)
        low, high = limits.find_internal_force_range(a, b)
        return not ((low <= high) & (low < np.inf) & (b <= limits.cap)).all()

    ratios = 2 ** np.linspace(_LEAST, 8.0, 256, endpoint=False)
    count = bisect_left(ratios, True, key=is_blocked)
    return _guess_at(data, 0.7 * fall_b * (ratios[count - 1] if count else 1.0), time_weight)


def _find_fall_b(data: PhaseData) -> float:
    """The b of a fall over the length of the curve [m^2/s^2]."""
    return float(2 * data.curve.formation.scene.scales.acceleration * data.grid.s[-1])


def _make_parabola(data: PhaseData, height: float) -> tuple[Array, Array]:
    """The a and b of a parabola in s of this height; its power 4/3 where a starts at zero."""
    length = data.grid.s[-1]
    x = data.grid.s / length
    if data.grid.held:
        arch = np.maximum(4 * x * (1 - x), 0.0)
        slope = 8 / 3 * (1 - 2 * x) / length
        return height * slope * np.cbrt(arch), height * arch * np.cbrt(arch)
    return height * 2 * (1 - 2 * x) / length, height * 4 * x * (1 - x)


def guess_below(data: PhaseData, fastest: Fastest) -> Profile:
    """A guess somewhat slower than the minimum-time profile."""
    s, b, _ = fastest
    a = np.interp(data.grid.s, (s[1:] + s[:-1]) / 2, np.diff(b) / (2 * np.diff(s)))
    return _complete(data, _BELOW * a, _BELOW * np.interp(data.grid.s, s, b))[0]


def _complete(data: PhaseData, a: Array, b: Array) -> tuple[Profile, Array]:
    """A motion with the internal force amid a part of its range, and the one amid all of it.

    Both are zero without a range.
    """
    low, high = data.find_limits(data.nodes).find_internal_force_range(a, b)
    force = data.curve.formation.scene.scales.force
    near_high = np.minimum(high, low + 40.0 * np.maximum(force, np.abs(low)))
    finite = np.isfinite(low + high) & (low <= high)
    lam, middle = (np.where(finite, (low + end) / 2, 0.0) for end in (near_high, high))
    return Profile(a, b, lam), middle


def _guess_at(data: PhaseData, height: float, time_weight: float = 0.0) -> tuple[Profile, Units]:
    profile, middle = _complete(data, *_make_parabola(data, height))
    length, weight = float(data.grid.s[-1]), data.curve.formation.scene.scales.force
    duration, torque = np.pi / 2 * length / np.sqrt(height), data.torque_limit
    force = max(0.5 * weight, data.epsilon, float(np.abs(profile.lam).mean()))  # the least unit
    squares = np.minimum(np.abs(apply(data.of_tau, *profile)), torque) ** 2
    power = time_weight + float(squares.sum(axis=1).mean())
    press = max(force, float(np.abs(middle).mean()))
    return profile, Units(length, 0.6 * duration, force, torque, power, press)
