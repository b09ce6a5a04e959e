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

from ...common.arrays import Array, Expression, Flags
from ...common.errors import AmbiguityError, JammingError, SolverError, name_phases
from ...geometry.curve import Curve, describe_pose, directions_of
from ...mechanics.dynamics import LAMBDA, ONE, A, B, V, reduced_inertia
from ...mechanics.limits import PRESS, TORQUE, LimitSet
from ...mechanics.statics import SURE
from ...mechanics.uniqueness import describe_uniqueness, find_minors
from ..nlp import Columns, SolverStatistics, book, build_solver
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
MISS = 2.5e-7  # largest violation between nodes, over the limits' scales; relative for b and time
_GAP = 1.5  # gap to the optimum over the cost of the tightening
_LOOKS = 65  # places of a segment at which uniqueness is checked; minima are narrow
_START, _SMOOTH, _RATE = 12, 20, 40  # elements of a phase; for effort; under rate limits
WORTH = 0.02  # largest relative cost of a start that friction cannot hold (`SureStart`)
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
            task = replace(task, guides=nominal.guides)
        iterate = _plan_within(task)
    except JammingError as jam:
        if not explained or len(task.curves) > 1:
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
    rounding = MISS * task.curves[0].formation.scene.scales.force
    if options.goal is Objective.MARGIN and iterate.plans[0].value < task.epsilon - rounding:
        if task.duration is not None:
            fastest = replace(options, objective=Objective.TIME, duration=None)
            least = plan_task(replace(task, options=fastest, duration=None)).plans
            where = f"{name_phases(phases, 'infeasible')}: "
            share_duration([plan.value for plan in least], task.duration, where)
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
    The first plan is a rough one, whose few nodes have few of them: many may leave no plan at all.
    Case: three phases of a pentagon within half its usual ranges.
    """
    if not task.guides:
        return plan_task(task)
    iterate = plan_task(replace(task, options=task.options.roughen()))
    for _ in range(3):  # most further ones
        if iterate.error <= task.options.accuracy:
            break
        try:
            other = plan_task(replace(task, guides=iterate.guides))
        except SolverError:
            break
        if other.objective >= iterate.objective:
            break
        iterate = other
    return replace(iterate, task=replace(iterate.task, options=task.options))


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
    formation, forces = data.curve.formation, data.nodes.forces
    holds = list_holds(formation, data.curve.start, ranges)
    here = np.array([profile.a[0], profile.lam[0]])
    T0, T = forces.of_tau[0, :, ONE], forces.of_tau[0][:, [A, LAMBDA]]
    scales, spans = formation.scene.scales, data.limits.side_scales
    if measure_holds(holds, T0 + T @ here) > SURE * scales.torque:
        return None
    presses = np.isin(data.limits.sides[0], data.limits.of(PRESS))
    rows = data.find_limits(data.nodes.pick(slice(0, 1))).rows[0] * spans[:, None]
    slopes, units = rows[:, [A, LAMBDA]], np.array([scales.acceleration, scales.force])
    # Sides of the torques that can be held, and a distance beyond [N m].
    sides = [
        (normal * gains, bound + 10.0 * SURE * scales.torque)
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
                kept = ((offsets + slopes @ place) / spans).min() >= -1e-9 and place[0] > 0
                kept = kept and measure_holds(holds, T0 + T @ place) > SURE * scales.torque
                away = float(np.abs(T @ (place - here)).max())
                if kept and away < best:
                    ends = (place[1], np.inf) if normal[1] > 0 else (-np.inf, place[1])
                    best, start = away, SureStart(float(place[0]), *map(float, ends))
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
    start: SureStart | None = None
    guides: tuple[Reference, ...] = ()  # with ranges a reference for each curve
    pins: Pins = (None, None)
    others: Mapping[int, Curve] = field(default_factory=dict)  # of other phases, for advice

    @cached_property
    def spreads(self) -> list[RobustLimits | None]:
        """Robust force limits of each curve, None without ranges."""
        if not self.guides:
            return [None] * len(self.curves)
        args = self.epsilon, self.options.ranges
        return [robustify(*pair, *args) for pair in zip(self.curves, self.guides, strict=True)]

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
        """Each phase on elements with breaks: as many as wanted, if that is enough for these."""
        breaks, last = breaks or [np.zeros(0)] * len(self.curves), len(self.curves) - 1
        pairs = list(zip(self.curves, breaks, strict=True))
        elements = max(elements or self.elements, *(len(find_ends(*pair)) - 1 for pair in pairs))
        parts = list[PhaseData]()
        for k, (pair, phase) in enumerate(zip(pairs, self.phases, strict=True)):
            grid = make_grid(*pair, elements, (k == 0, k == last), self.is_held)
            parts.append(prepare(pair[0], self.epsilon, grid, phase, self.spreads[k]))
        return parts

    def find_fastest(self) -> Fastest | None:
        """The minimum-time speed profile of a sweep; None without one."""
        return find_fastest(join(self.lay_out()))

    def share_out_switches(self, fastest: Fastest) -> list[Array]:
        """The places of each curve where the minimum-time profile switches [m]."""
        starts = np.cumsum([0.0, *(curve.length for curve in self.curves)])
        owner = np.searchsorted(starts[1:-1], fastest.switches)
        return [
            keep_apart(curve, fastest.switches[owner == k] - starts[k])
            for k, curve in enumerate(self.curves)
        ]


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


class Tightening(NamedTuple):
    """Tightening of limits at the nodes so that they hold between nodes too."""

    limits: Array | float = 0.0  # (N + 1, n_sides) [N, N m]: of each side of the limits
    # (N + 1, n_sides) [N, N m]: the part of `limits` beyond the slack at nodes
    missed: Array | float = 0.0
    # (N + 1, 5): factors on the largest b, both torque rate limits and both largest commands
    shares: Array | float = 1.0
    late: float = 1.0  # factor on the longest duration, if there is one


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
        swept = task.options.goal is Objective.TIME and not task.is_held
        if swept and (fastest := find_fastest(data)):
            # Breaks at the switches, but on a curve where a fixed number of elements is too few.
            for k, places in enumerate(task.share_out_switches(fastest)):
                if not task.options.intervals or len(find_ends(task.curves[k], places)) <= elements:
                    breaks[k] = places
            parts = task.lay_out(elements, breaks)
            profile = guess_below(join(parts), fastest)
        return PathIterate(task, parts, units, profile, task.options.goal)

    @staticmethod
    def elastic(task: Task) -> PathIterate:
        """The problem with soft limits, from a slow motion whatever they are."""
        data = join(parts := task.lay_out())
        profile, units = _guess_at(data, 0.7 * _fall(data) * 2.0**_SLOW)
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
        solver = nlp.solver if self.multipliers else nlp.starter
        bounds |= self.multipliers or self._center()
        result = solver(x0=self.pack(), p=self.find_parameters(), **bounds)
        if not result["success"]:
            raise SolverError(f"Ipopt stopped with {result['status']}")
        # b is integrated again from a: b' = 2 a to rounding, not to Ipopt's tolerance.
        x, table = result["x"].full()[:, 0], np.zeros(nlp.free.shape)
        table[nlp.free] = x
        profile = follow(self.data.grid, *(table[:, [1, 2]] * units.profile[1:]).T)
        margin = float(x[-1]) * units.force if self.goal is Objective.MARGIN else 0.0
        return replace(
            self,
            profile=profile,
            margin=margin,
            multipliers={f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")},
            cost=float(result["f"]),
            duration=float(result["g"][-1]) * units.time if self.task.duration else 0.0,
        )

    def pack(self) -> Array:
        """Unknowns of the NLP, in its units, of the motion to start from.

        Soft limits may be missed by somewhat more than it misses them.
        """
        nlp, data, units, profile = self.nlp, self.data, self.units, self.profile
        table = np.empty(nlp.free.shape)
        table[:, nlp.node["extra"]] = self.margin / units.force
        if self.goal is Objective.ELASTIC:
            short = np.maximum(data.limits.fold(-data.slack(data.nodes, profile)), 0.0)
            short += 0.05 * data.limits.scales
            table[:, nlp.node["extra"]] = short / units.of(data.limits)
        table[:, :3] = np.column_stack([profile.b, profile.a, profile.lam]) / units.profile
        table[:, 0] /= data.grid.sizes
        return np.asarray(table[nlp.free])

    def find_parameters(self) -> Array:
        """Parameters of the NLP, in its units."""
        nlp, data, units = self.nlp, self.data, self.units
        terms, unit = data.find_terms(), units.of(data.limits)
        b_unit, a_unit, force = units.profile
        torque, shape, scene = unit[list(nlp.shape.torques)], nlp.shape, data.curve.formation.scene
        blocks = {
            "steps": data.grid.steps / units.length,
            "weight": np.array([self.task.options.time_weight / units.power]),
            "calm": np.array([force / units.press]),
            "a": terms[..., A] * a_unit / unit,
            "b": terms[..., B] * b_unit / unit,
            "lam": terms[..., LAMBDA] * force / unit,
            "speed": (terms[..., V] * np.sqrt(b_unit) / unit)[:, shape.fast],
            "torque": data.nodes.forces.of_tau[..., ONE] / torque,
            "joints": torque**2 / units.power,
            "quick": (torque / units.time / scene.torque_rate_limit)[list(shape.rates)],
            "lags": scene.actuator_lag[list(shape.commands)] / units.time,
            "maps": data.grid.maps,
            "sizes": data.grid.sizes,
        }
        return np.asarray(nlp.p.join(**{name: block.ravel("F") for name, block in blocks.items()}))

    def make_bounds(self) -> dict[str, Array]:
        """Bounds of the NLP, with every limit tightened."""
        nlp, data, units, tightening = self.nlp, self.data, self.units, self.tightening
        start, pins = self.task.start, self.task.pins
        n, node = len(data.grid.s), nlp.node
        shares = np.broadcast_to(tightening.shares, (n, 5))
        share, quickest, most = np.split(shares, [1, 3], axis=1)
        low, high = np.full((n, node.count), -np.inf), np.full((n, node.count), np.inf)
        b_max = data.largest_b(data.nodes)
        # Next to rest b is 2 s times the least s''.
        s, length = data.grid.s, data.grid.s[-1]
        low[:, 0] = LEAST_B * np.minimum(s, length - s) / length
        high[:, 0] = np.maximum(b_max * share[:, 0] / units.profile[0], 2 * LEAST_B)
        if data.grid.held:
            low[:, 0], high[:, 0] = LEAST_B, high[:, 0] / data.grid.sizes
        # From rest to rest, without reversal.
        if nlp.shape.slow:
            low[[0, -1], node["a"]] = high[[0, -1], node["a"]] = 0.0
        else:
            low[0, node["a"]], high[-1, node["a"]] = LEAST_B, -LEAST_B
        if start is not None:
            _, a_unit, force = units.profile
            low[0, node["a"]] = max(start.least_a / a_unit, LEAST_B)
            low[0, node["lam"]], high[0, node["lam"]] = start.low / force, start.high / force
        for place, pin in zip((0, -1), pins, strict=True):
            if pin is not None:
                low[place, node["lam"]] = high[place, node["lam"]] = pin / units.profile[2]
        low[:, node["extra"]] = -np.inf if self.goal is Objective.MARGIN else 0.0
        rows, signs, bounds = data.limits.sides
        sides = bounds + signs * tightening.limits - data.find_terms()[:, rows, ONE]
        sides /= units.of(data.limits)[rows]
        side = np.arange(len(rows)) if self.goal is Objective.ELASTIC else rows
        width = nlp.g.sizes["limits"] // n
        rows_low, rows_high = np.full((n, width), -np.inf), np.full((n, width), np.inf)
        rows_low[:, side[signs > 0]] = sides[:, signs > 0]
        rows_high[:, side[signs < 0]] = sides[:, signs < 0]
        late = nlp.g.sizes["duration"]
        equal = np.zeros(nlp.g["limits"].start)
        longest = np.full(late, (self.task.duration or np.inf) * tightening.late / units.time)
        rates, commands = list(nlp.shape.rates), list(nlp.shape.commands)
        torque, sizes = units.of(data.limits)[list(nlp.shape.torques)], nlp.g.sizes
        most = most * data.torque_limit / torque
        joins, begins = np.zeros(sizes["joins"]), np.full(sizes["begins"], LEAST_B)
        within = np.concatenate([quickest[:, rates].ravel("F"), most[:, commands].ravel("F")])
        motors_low, motors_high = (-within, joins, begins), (within, joins, np.inf * begins)
        return {
            "lbx": low[nlp.free],
            "ubx": high[nlp.free],
            "lbg": np.concatenate([equal, rows_low.ravel(), np.full(late, -np.inf), *motors_low]),
            "ubg": np.concatenate([equal, rows_high.ravel(), longest, *motors_high]),
        }

    def _center(self) -> dict[str, Array]:
        """Multipliers with which a motion is near the central path: none of the links b' = 2 a.

        Empty where limits are soft.
        """
        nlp, data, units, profile = self.nlp, self.data, self.units, self.profile
        if self.goal is Objective.ELASTIC:
            return {}
        (rows, signs, _), sizes = data.limits.sides, nlp.g.sizes
        slack = data.slack(data.nodes, profile, self.margin) / units.of(data.limits)[rows]
        on_rows = np.zeros((len(slack), nlp.shape.rows))
        for side, row in enumerate(rows.tolist()):
            on_rows[:, row] -= signs[side] * _CENTRAL / np.maximum(slack[:, side], _SLACK)
        on_x = np.zeros(nlp.free.shape)
        on_x[:, 0] = -_CENTRAL / np.maximum(profile.b / units.profile[0], _SLACK)
        # The chain's multiplier at a node is the sum of those of normal forces from there on.
        chain = -1 - np.cumsum(on_rows[:, list(nlp.shape.presses)].sum(axis=1))[:-1]
        multipliers = {"chain": chain[: sizes["chain"]], "limits": on_rows.ravel()}
        on_g = nlp.g.join(**{name: np.zeros(sizes[name]) for name in sizes} | multipliers)
        return {"lam_x0": on_x[nlp.free], "lam_g0": on_g}

    def adapt(self) -> PathIterate | None:
        """The next one to solve: with rows for this motion, on other elements, or tightened."""
        task, accuracy = self.task, self.task.options.accuracy
        # A first plan that misses much by signs of no row is a reference only; case: two releases
        # of a pentagon, whose plan takes 20 % longer.
        if task.guides and self.meshes < 6:  # most references
            slack = self.data.slack(self.data.nodes, self.profile, self.margin)
            if (slack / self.data.limits.side_scales).min() < -0.05:
                other = PathIterate.begin(replace(task, guides=self.guides), task.elements)
                return replace(other, meshes=self.meshes + 1)
        # What tightening by the violations will cost, and what it has.
        costs = self.paid + self._price(*map(self.data.spread_to_nodes, self.misses[:2]))
        shares, costly = self._split(costs), _GAP * float(costs.sum()) > accuracy
        if task.is_held and (self.meshes < 2 or (costly and self.meshes < 4)):
            grow = self.meshes >= 2 and task.options.intervals is None
            count = task.elements * 3 // 2 if grow else task.elements
            each = zip(self.parts, self.motions, shares, strict=True)
            return self._move([equidistribute(*phase, count) for phase in each], count)
        if costly and not task.is_held and self.meshes < SOLVES and task.options.intervals is None:
            edges = [part.grid.edges for part in self.parts]
            count = min(task.elements, 80 - max(map(len, edges)))  # most elements of a phase
            halved = [halve(*pair, count) for pair in zip(edges, shares, strict=True)]
            finer = self._move(halved, task.elements)
            # Where elements have their least length, halving more of them gains nothing.
            if len(finer.parts[0].grid.edges) >= len(edges[0]) + task.elements // 2:
                return finer
        if task.duration and np.isinf(self.violation) and not any(map(np.any, self.misses[:2])):
            # In so long a time a motion may all but stop: shorter ones keep the same margin. Case:
            # the slide of a triangle in 100 s, which takes 0.3 s at least.
            return PathIterate.begin(replace(task, duration=task.duration / 2), task.elements)
        return self.tighten() if self.violation > 1 else None

    def _move(self, breaks: Sequence[Array], elements: int) -> PathIterate:
        """Start on at least so many other elements, with these breaks, from this motion."""
        every, held = zip(self.task.curves, breaks, strict=True), self.task.is_held
        ends = [keep_apart(curve, places, held) for curve, places in every]
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
        data, tight = self.data, self.tightening
        short, over, delay = self.misses
        late = 1.0
        if self.task.duration is not None:
            # The quadrature of the NLP is not that of the motion.
            off = self.duration / sum(motion.duration for motion in self.motions)
            # From a solution Ipopt leaves 2e-6 of a bound: phase 2 of the heptagon's margin in 5 s.
            late = float(np.clip(off, 0.8, 1.2)) * (1 - np.clip(4 * delay, 0.0, 1e-5))
        # Slack at nodes would absorb the rest: the lesser one of the two beside what is short.
        # Case: the largest margin of phase 3 of the heptagon on four contacts.
        slack, k = data.slack(data.nodes, self.profile, self.margin), data.grid.nonempty
        least = np.maximum(np.minimum(slack[k], slack[k + 1]), 0.0)
        reach = np.where(short > 0, least, 0.0)
        added, less = (1.05 * data.spread_to_nodes(violation) for violation in (short, over))
        limits = np.maximum(tight.limits, data.spread_to_nodes(reach)) + added
        tighter = Tightening(limits, tight.missed + added, tight.shares * (1 - less), late)
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
    def guides(self) -> tuple[Reference, ...]:
        """The motion along each curve as a reference."""
        return tuple(Reference(motion.grid.s, *motion.profile) for motion in self.motions)

    @cached_property
    def misses(self) -> tuple[Array, Array, float]:
        """Violations between nodes: of limits, of what `Tightening.shares` has, of the duration."""
        duration, late = self.task.duration, 0.0
        if duration:
            late = sum(motion.duration for motion in self.motions) / duration - 1
        data, profile = self.data, self.profile
        over = np.zeros((len(data.grid.nonempty), 5))
        short, over[:, 0] = data.misses(profile, self.margin)
        if data.grid.held:
            torques, rates = find_torques(data, profile, self.motions)
            scene = data.curve.formation.scene
            rate, lags = np.abs(rates).max(axis=2) / scene.torque_rate_limit, scene.actuator_lag
            command = np.abs(torques + lags[:, None] * rates).max(axis=2) / data.torque_limit
            over[:, 1:] = np.maximum(np.hstack([rate, command * (lags > 0)]) - 1, 0.0)
        return short, over, late

    @property
    def violation(self) -> float:
        """The largest violation between nodes, over the allowed one."""
        if any(motion.stalls for motion in self.motions):
            return np.inf
        short, over, late = self.misses
        most = max((short / self.data.limits.side_scales).max(), over[:, 0].max(), late)
        return float(max(most / MISS, over[:, 1:].max() / 1e-4))

    @property
    def error(self) -> float:
        """Estimated relative error, by the cost of the tightening.

        Over 75 refinements the gap to plans at an accuracy of 1e-7 is 0.8 to 3.9 times that cost
        where limits are tightened once; 1.5 times is within a factor of 3 either way.
        """
        return _GAP * float(self.paid.sum())

    @cached_property
    def paid(self) -> Array:
        """Relative cost at each node of the tightening so far."""
        return self._price(self.tightening.missed, 1 - self.tightening.shares)

    def _price(self, limits: Array | float, shares: Array | float) -> Array:
        """First-order relative cost of tightening at each node, shape (n,).

        The sum of multipliers times the tightening of limits, (n, n_sides), and what is taken from
        `Tightening.shares`, (n, 5).
        """
        nlp, data, units = self.nlp, self.data, self.units
        rows, signs, _ = data.limits.sides
        on_g, count = self.multipliers["lam_g0"], len(data.grid.s)
        on_limits = on_g[nlp.g["limits"]].reshape(count, -1)
        on_sides = np.maximum(-signs * on_limits[:, rows], 0.0) / units.of(data.limits)[rows]
        on_b = np.zeros(nlp.free.shape)
        on_b[nlp.free] = self.multipliers["lam_x0"]
        on_shares = np.zeros((count, 5))
        on_shares[:, 0] = np.maximum(on_b[:, 0], 0.0) * self.profile.b / data.grid.sizes
        on_shares[:, 0] /= units.profile[0]
        for first, name, joints in (
            (1, "rates", nlp.shape.rates),
            (3, "commands", nlp.shape.commands),
        ):
            on_rows = np.abs(on_g[nlp.g[name]]).reshape(len(joints), count).T
            on_shares[:, [first + joint for joint in joints]] = on_rows
        costs = (on_sides * limits).sum(axis=1) + (on_shares * shares).sum(axis=1)
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
    sides: tuple[tuple[int, float], ...]  # row and sign of each, in the order of `LimitSet.sides`
    presses: tuple[int, ...]  # rows of the least normal forces
    torques: tuple[int, ...]  # rows of the torques
    fast: tuple[int, ...]  # rows that depend on s'
    rates: tuple[int, ...]  # joints with a torque rate limit
    commands: tuple[int, ...]  # joints whose torques lag behind a command

    @staticmethod
    def of(data: PhaseData) -> LimitShape:
        """The shape of the limits of phases and of their motors."""
        limits, scene = data.limits, data.curve.formation.scene
        rows, signs, _ = limits.sides
        # What depends on torques or speeds of the joints.
        joints = limits.rows[:, -4:].any(axis=1)
        drags = np.array([limits.limits[k].viscous for k in limits.owners])
        return LimitShape(
            len(limits.low),
            tuple(zip(rows.tolist(), signs.tolist(), strict=True)),
            tuple(limits.of(PRESS).tolist()),
            tuple(limits.of(TORQUE).tolist()),
            tuple(np.flatnonzero(joints | drags).tolist()),
            tuple(np.flatnonzero(np.isfinite(scene.torque_rate_limit)).tolist()),
            tuple(np.flatnonzero(scene.actuator_lag).tolist()),
        )

    @property
    def slow(self) -> tuple[int, ...]:
        """Joints whose torques may not step."""
        return tuple(sorted({*self.rates, *self.commands}))


def _find_lengths(h: Expression) -> Expression:
    """Length of each element, shape (1, E)."""
    return ca.sum1(ca.reshape(ca.vertcat(h, 0), NODES, -1))


def _write_rises(a: Expression, h: Expression, maps: Expression) -> Expression:
    """Rise of b from each node to the next, shape (N,), on elements with `maps`, (3, E)."""
    table, lengths, links = ca.reshape(a, NODES, -1), _find_lengths(h), find_basis().links
    scales = [ca.repmat(maps[k, :] * lengths, DEGREE, 1) for k in range(3)]
    rises = sum(scale * (ca.DM(link) @ table) for scale, link in zip(scales, links, strict=True))
    return ca.vec(ca.vertcat(rises, ca.SX(1, lengths.numel())))[:-1]


def _find_paces(
    a: Expression, speed: Expression, h: Expression, maps: Expression, held: bool
) -> Expression:
    """Rate dy/dt of the local variable at each node, times the element's length, (p + 1, E)."""
    y, lengths = find_basis().y, _find_lengths(h)
    stretches = ca.DM(np.column_stack([y**0, 2 * y, 3 * y**2])) @ maps
    paces = ca.reshape(speed, NODES, -1) / stretches
    # At rest speed and stretch vanish: s'' or its slope makes the speed a power of y there.
    growths, power = (find_first_slopes(a), 3) if held else ((a[0], -a[-1]), 2)
    for at, growth in zip((0, -1), growths, strict=True):
        paces[at, at] = ca.sqrt(power / (power - 1) * lengths[at] * growth) / power
    return paces


def _find_bends(values: Expression, degree: int) -> Expression:
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
    def profile(self) -> Array:
        """Units of (b, a, internal force), shape (3,)."""
        speed = self.length / self.time
        return np.array([speed**2, speed / self.time, self.force])

    def of(self, limits: LimitSet) -> Array:
        """Units of each row of limits, shape (m,)."""
        of_torque = np.abs(limits.rows[:, -4:-2])
        return np.where(of_torque.any(axis=1), of_torque @ self.torque, self.force)


class SureStart(NamedTuple):
    """Bounds of the first node: s'' from `least_a` up, internal force from `low` to `high`."""

    least_a: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class PathNLP:
    """A built NLP."""

    # both take x0, p, bounds and multipliers; see `build_path_nlp` for their order
    solver: Expression
    starter: Expression  # for points that are no solution, with slacks near the central path
    shape: LimitShape
    intervals: int
    # unknowns of each node: b over its size (none at the two ends), a, internal force, and `extra`:
    # shortfalls for `elastic`, or the least margin
    node: Columns
    # `steps`, `weight` of time, unit of internal force in the regularization; constant torques and
    # weights of joints for `effort`; coefficients of the limits at the nodes, column by column (the
    # constant ones are part of the bounds); for rate limits 1 / these, lags, maps of elements and
    # `sizes` of b
    p: Columns
    # b' = 2 a; the `chain` of the margin; node by node the `limits`, side by side where they are
    # soft; the `duration` for `margin`; rate limits
    g: Columns

    @cached_property
    def free(self) -> Flags:
        """Which entries of the (N + 1, columns) array of unknowns are not b at an end."""
        mask = np.ones((self.intervals + 1, self.node.count), dtype=bool)
        mask[[0, -1], self.node["b"]] = False
        return mask


@lru_cache(maxsize=16)
def build_path_nlp(shape: LimitShape, intervals: int, objective: Objective) -> PathNLP:
    """Build the NLP for every phase with limits of a shape."""
    started = time.perf_counter()
    n, m, slow = intervals + 1, shape.rows, shape.slow
    effort, late = objective is Objective.EFFORT, objective is Objective.MARGIN
    soft = objective is Objective.ELASTIC
    sizes = {"steps": intervals, "weight": 1, "calm": 1, "torque": n * 2, "joints": 2}
    sizes |= {"a": n * m, "b": n * m, "lam": n * m, "speed": n * len(shape.fast)}
    sizes |= {"quick": len(shape.rates), "lags": len(shape.commands)}
    p = Columns(**sizes, maps=3 * n // NODES, sizes=n)
    symbols = p.make_symbols()
    b_inner, a, lam = ca.SX.sym("b", n - 2), ca.SX.sym("a", n), ca.SX.sym("lam", n)
    extra = ca.SX.sym("extra", n, m if soft else int(late))
    h, fast = symbols.steps, list(shape.fast)
    # Under rate limits b is scaled: next to rest it is many orders of magnitude smaller.
    maps, scales = ca.DM(list_maps(np.zeros(n // NODES)).T), ca.DM.ones(n)
    if slow:
        maps, scales = ca.reshape(symbols.maps, -1, 3).T, symbols.sizes
    b = ca.vertcat(0, b_inner * scales[1:-1], 0)
    speed = ca.vertcat(0, ca.sqrt(b[1:-1]), 0)
    largest = ca.fmax(scales[1:], scales[:-1])
    lengths, paces = _find_lengths(h), _find_paces(a, speed, h, maps, bool(slow))
    times = ca.vec(ca.DM(find_basis().weights) @ lengths / paces)

    def scale(name: str, column: Expression) -> Expression:
        table = ca.reshape(getattr(symbols, name), n, -1)
        return table * ca.repmat(column, 1, table.shape[1])

    # Limits but for their constant part, which is in the bounds.
    values = scale("a", a) + scale("b", b) + scale("lam", lam)
    values[:, fast] += scale("speed", speed)
    torques = values[:, list(shape.torques)] + ca.reshape(symbols.torque, n, 2)
    scaled_lam, node_weights = symbols.calm * lam, ca.vertcat(0, h) + ca.vertcat(h, 0)
    node_costs = 1e-6 * node_weights * scaled_lam**2  # among equal plans
    rough = _find_bends(a, DEGREE) + _find_bends(scaled_lam, DEGREE)
    if soft:
        # Soft limits would otherwise be avoided by motions that reverse between nodes.
        first, second = _find_bends(a, 1), _find_bends(a, 2)
        rough += 1e3 * ca.horzcat(first[0], second[1:-1], first[-1])
        node_costs[:-1] += 1e-4 * (a[1:] - a[:-1]) ** 2
    node_costs[0] += 0.1 * ca.sum2(lengths * rough)  # no oscillation within elements
    if objective is Objective.TIME:
        node_costs += times
    elif effort:
        node_costs += times * (torques**2 @ symbols.joints + symbols.weight)
    elif late:
        node_costs[0] -= extra[0]
    else:
        # Not weighted by lengths, or shortfalls at short intervals would be cheap.
        node_costs += ca.sum2(extra) / n + 1e-4 * times

    # Limits at the nodes, side by side where they are soft.
    limits = values
    if late:
        limits = values - extra @ ca.DM(np.isin(np.arange(m), shape.presses).astype(float)).T
    elif soft:
        sides = [values[:, row] + sign * extra[:, row] for row, sign in shape.sides]
        limits = ca.horzcat(*sides)
    none = ca.SX(0, 1)
    rows = {
        "links": (b[1:] - b[:-1] - _write_rises(a, h, maps)) / largest,
        "chain": extra[1:] - extra[:-1] if late else none,
        "limits": ca.vec(limits.T),
        "duration": ca.sum1(times) if late else none,
    }
    rates, slopes = dict[int, Expression](), ca.DM(find_basis().slopes)
    for joint in slow:
        # The derivative of the polynomials of y through the torques at the nodes.
        table = slopes @ ca.reshape(torques[:, joint], NODES, -1)
        rates[joint] = ca.vec(table * paces / ca.repmat(lengths, NODES, 1))
    quick = [symbols.quick[k] * rates[joint] for k, joint in enumerate(shape.rates)]
    lagged = [torques[:, j] + symbols.lags[k] * rates[j] for k, j in enumerate(shape.commands)]
    joins = [torques[NODES::NODES, j] - torques[DEGREE:-1:NODES, j] for j in slow]
    motor_rows = {"rates": quick, "commands": lagged, "joins": joins}
    rows |= {name: ca.vertcat(none, *expressions) for name, expressions in motor_rows.items()}
    rows["begins"] = ca.vertcat(*find_first_slopes(a)) if slow else none
    g = Columns(**{name: int(block.numel()) for name, block in rows.items()})
    nodes = ca.horzcat(ca.vertcat(0, b_inner, 0), a, lam, extra).T
    nlp = {
        "x": ca.vertcat(nodes[1:, 0], ca.vec(nodes[:, 1:-1]), nodes[1:, -1]),
        "p": symbols.every,
        "f": ca.sum1(node_costs),
        "g": g.write(**rows),
    }
    book(SolverStatistics(build_time=time.perf_counter() - started))
    # Soft NLPs start far from their optimum, and need the more robust strategy.
    strategy: dict[str, Any]
    strategy = {"mu_strategy": "monotone"} if soft else {"mu_oracle": "probing"}
    if slow:
        # Large gradients of the time next to rest would scale the objective down. Probing lowers
        # the barrier at once, and steps along the bounds of rates are short then.
        strategy = {"nlp_scaling_method": "none", "mu_oracle": "quality-function"}
    solver = build_solver("path_nlp", nlp, 1e-9, max_iter=300, **strategy)
    starter = solver
    if slow:
        derived = {"jac_g": "nlp_jac_g", "hess_lag": "nlp_hess_l", "grad_f": "nlp_grad_f"}
        same = {key: solver.function.get_function(name) for key, name in derived.items()}
        starter = build_solver("path_nlp", nlp, _SLACK, same, max_iter=300, **strategy)
    node = Columns(b=1, a=1, lam=1, extra=extra.shape[1])
    return PathNLP(solver, starter, shape, intervals, node, p, g)


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
    limits, fall = data.find_limits(data.nodes), _fall(data)

    def is_blocked(share: float) -> bool:
        a, b = _parabola(data, fall * share)
        low, high = limits.find_internal_force_range(a, b)
        return not ((low <= high) & (low < np.inf) & (b <= limits.cap)).all()

    shares = 2 ** np.linspace(_LEAST, 8.0, 256, endpoint=False)
    kept = bisect_left(shares, True, key=is_blocked)
    return _guess_at(data, 0.7 * fall * (shares[kept - 1] if kept else 1.0), time_weight)


def _fall(data: PhaseData) -> float:
    """The b of a fall over the length of the curve [m^2/s^2]."""
    return float(2 * data.curve.formation.scene.scales.acceleration * data.grid.s[-1])


def _parabola(data: PhaseData, height: float) -> tuple[Array, Array]:
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
    near = np.minimum(high, low + 40.0 * np.maximum(force, np.abs(low)))
    finite = np.isfinite(low + high) & (low <= high)
    part, whole = (np.where(finite, (low + end) / 2, 0.0) for end in (near, high))
    return Profile(a, b, part), whole


def _guess_at(data: PhaseData, height: float, time_weight: float = 0.0) -> tuple[Profile, Units]:
    profile, whole = _complete(data, *_parabola(data, height))
    length, weight = float(data.grid.s[-1]), data.curve.formation.scene.scales.force
    duration, torque = np.pi / 2 * length / np.sqrt(height), data.torque_limit
    force = max(0.5 * weight, data.epsilon, float(np.abs(profile.lam).mean()))  # the least unit
    squares = np.minimum(np.abs(data.nodes.forces.tau(*profile)), torque) ** 2
    power = time_weight + float(squares.sum(axis=1).mean())
    most = max(force, float(np.abs(whole).mean()))
    return profile, Units(length, 0.6 * duration, force, torque, power, most)
