"""Solution of the time-domain NLP of stages by Ipopt, and its refinement.

Each iterate is checked once: limits at `checks` places of every interval, by the motion that its
torques lead to. The README says where intervals are halved, or limits raised by what is missed.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, Numbers, find_minima
from ...common.errors import Parameter, SolverError
from ...geometry.tracing import CostToGo
from ...mechanics.dynamics import Directions
from ...mechanics.limits import CONE, PRESS, make_limits
from ...mechanics.sensitivity import find_slopes_at
from ...problem.definition import PARAMETERS, Phase, Problem
from ...results.trajectory import Samples
from ..options import DEFAULT_ACCURACY, Objective, PlanOptions
from ..refinement import refine
from ..robust.robust_rows import find_variations
from .stage import (
    LimitMisses,
    Scheme,
    Stage,
    bisect_intervals,
    in_own_units,
    make_scheme,
    monitor,
    unit_lengths,
    unit_of,
    with_controls,
)
from .time_motion import MotionResponse, StageMotion, make_motions
from .time_nlp import (
    SLIDING,
    Target,
    TimeNLP,
    build_time_nlp,
    find_bounds,
    find_relieved,
    least_senses,
    pack,
    unpack,
)

Multipliers = dict[str, Array]  # of the unknowns' bounds, `lam_x0`, and of the rows, `lam_g0`


@dataclass
class Tried:
    """Statistics of a mode search."""

    sequences: int = 1  # of modes that were tried
    complete: bool = True  # whether none was left


class Price(NamedTuple):
    """Linear cost of the end of stages: `gradient` @ (z - `origin`), both of shape (5,)."""

    gradient: Array
    origin: Array


class TimeSolution(NamedTuple):
    """Stages with the solution as their guess."""

    stages: list[Stage]
    cost: float  # objective
    margin: float  # least c_n over epsilon, if that is an unknown
    status: str  # how the solver ended, in words
    success: bool
    nlp: TimeNLP
    multipliers: Multipliers
    error: float = math.nan  # estimated gain of better torques, over the cost; not always known
    attempt: str = ""  # name of the guess that it is from

    @property
    def end(self) -> Array:
        """Where the stages end, shape (5,)."""
        return np.asarray(self.stages[-1].guess.nodes[-1, 0])

    def price_friction(self, k: int) -> Array:
        """First-order saving by full friction the other way at the points of a stage, (K, d, n_c).

        For a contact held at its least rate this bounds what rolling saves.
        """
        stage = self.stages[k]
        formation, part = stage.formation, stage.guess
        A_t = formation.evaluate(part.z.reshape(-1, 5), part.v.reshape(-1, 5)).A_t
        lam = self.multipliers["lam_g0"][self.nlp.rows_of[k].balance].reshape(-1, 5)
        c_n = part.forces[..., : formation.n_contacts]
        price = np.einsum("nij,nj->ni", A_t, lam).reshape(c_n.shape)
        return np.asarray(2 * price * stage.directions.Xi * formation.friction * c_n)


@dataclass
class TimeSearch:
    """Data common to all solves for a plan, and their statistics."""

    source: Problem
    options: PlanOptions
    phases: Sequence[Phase] = ()  # those of the NLP; all of the problem if left out
    duration: float | None = None  # [s]: longest duration, for the objective `margin`
    to_go: CostToGo | None = None
    ample: float = math.inf  # [N]: normal force at which the objective `margin` saturates
    only_begins: bool = False  # whether plans may miss limits between points
    controls: int = 0  # control points of torques in an interval; 0: as many as points
    soft: Objective | None = None  # `elastic` or `relax`, in place of the options' objective
    relaxation: Parameter | None = None  # the relaxed limit, for the objective `relax`
    price: Price | None = None  # in the scene's own units
    searched: bool = False  # whether the modes of the first guess are those of a mode search
    tried: Tried = field(default_factory=Tried)  # shared by all searches for one plan

    def __post_init__(self) -> None:
        self.phases = self.phases or self.source.phases

    @cached_property
    def problem(self) -> Problem:
        """The problem in its scene's own units."""
        return in_own_units(self.source)

    @property
    def goal(self) -> Objective:
        """The objective."""
        return self.soft or self.options.goal

    @property
    def scheme(self) -> Scheme:
        """The collocation scheme."""
        degree = self.options.degree
        return make_scheme(self.options.scheme, degree, self.controls or degree)

    @property
    def numbers(self) -> list[int]:
        """Numbers of the phases."""
        return [phase.number for phase in self.phases]

    def expand(self, z: Array) -> tuple[float, Price]:
        """The cost-to-go of an end `z`, (5,), to first order; a `WholearmError` without a plan."""
        assert self.to_go is not None
        scales = self.source.scene.scales
        lengths, unit = unit_lengths(scales), unit_of(self.goal, scales)
        value, gradient = self.to_go.expand(z * lengths)
        return value / unit, Price(gradient * lengths / unit, z)

    def soften(self, relaxation: Parameter | None = None) -> TimeSearch:
        """The same search with soft limits, or one that is relaxed, for the least of that.

        These go with linear torques: others might keep them at the points alone.
        """
        soft = Objective.RELAX if relaxation else Objective.ELASTIC
        other = replace(self, soft=soft, relaxation=relaxation, controls=2)
        return replace(other, duration=None, to_go=None, price=None)

    def has_ample(self, solution: TimeSolution) -> bool:
        """Whether the objective `margin` is saturated."""
        return self.goal is Objective.MARGIN and solution.margin > self.most_margin

    def measure(self, cost: float) -> float:
        """Size of a value of the objective."""
        return abs(cost) + self.problem.epsilon * (self.goal is Objective.MARGIN)

    @property
    def most_margin(self) -> float:
        """Margin at which the objective saturates."""
        return self.ample / self.source.scene.scales.force - self.problem.epsilon

    def solve(
        self,
        stages: list[Stage],
        before: TimeSolution | None = None,
        most: int = 150,
        raised: Sequence[LimitMisses] | None = None,
    ) -> TimeSolution:
        """Solve from the stages' guesses in at most `most` iterations, with `raised` limits.

        Without these, formation limits violated at the points are added, and the NLP is solved
        again. The NLP of the solution `before` is used again for its own stages.
        """
        controls = self.scheme.controls
        if stages[0].guess.tau.shape[1] != controls:
            stages = [replace(s, guess=with_controls(s.guess, controls)) for s in stages]
        margin = before.margin if before else 0.0
        depth = 1e-6 * self.problem.scene.polygon.gyration_radius  # least violation that counts
        nlp, multipliers = None, None
        if before and all(map(operator.is_, stages, before.stages)):
            # With another price the start is no solution.
            nlp = before.nlp if raised else replace(before.nlp, max_iter=most)
            multipliers = before.multipliers if raised else None
        while True:
            limits = raised or [LimitMisses.none(stage) for stage in stages]
            nlp = nlp or self.build(stages, most)
            solution = self.run(nlp, stages, limits, multipliers, margin)
            if raised or not solution.success:
                return solution
            pairs = ((stage.formation, stage.guess.z.reshape(-1, 5)) for stage in solution.stages)
            least = [formation.evaluate_limits(z).min(axis=0) for formation, z in pairs]
            stages, nlp = monitor(solution.stages, least, depth), None
            if stages is solution.stages:
                return solution

    def build(self, stages: Sequence[Stage], most: int = 150) -> TimeNLP:
        """Build the NLP."""
        weight = self.options.time_weight / self.source.scene.scales.torque**2
        target = Target(self.goal, self.problem.epsilon, weight, self.relaxation)
        most = {Objective.ELASTIC: 90, Objective.RELAX: 50}.get(self.goal, most)
        return build_time_nlp(stages, self.scheme, target, most)

    def run(
        self,
        nlp: TimeNLP,
        stages: Sequence[Stage],
        limits: Sequence[LimitMisses],
        multipliers: Multipliers | None,
        margin: float,
    ) -> TimeSolution:
        """Run the solver once."""
        (low, high), (low_g, high_g) = find_bounds(nlp, stages, self.scheme, limits)
        if self.duration is not None and nlp.duration_row >= 0:
            high_g[nlp.duration_row] = self.duration / self.source.scene.scales.time
        if self.goal is Objective.MARGIN:
            # Solving for more than the saturated margin takes long.
            high[nlp.layouts[-1].margin[-1]] = 1.1 * self.most_margin
        status = "limits that hold between points too leave nothing" if (low > high).any() else ""
        if (low_g == high_g).sum() > len(low):
            # Ipopt refuses it, and CasADi prints that. Case: scene 5 of stress, seed 3, effort.
            status = "the modes leave no freedom: there are more equations than unknowns"
        if status:
            return TimeSolution(list(stages), np.inf, 0.0, status, False, nlp, {})
        near = nlp.max_iter > ITERATIONS
        options = ({} if near else GUESSED) | (ACCEPTED if self.only_begins else {})
        solver = nlp.solver if multipliers else nlp.make_solver(1e-2, **options)
        if not multipliers:
            size = 1e-2  # of all inequalities
            bounded = np.isfinite(high).astype(float) - np.isfinite(low)
            on_rows = np.where(high_g > low_g, -size, 0.0)
            multipliers = {"lam_x0": size * bounded, "lam_g0": on_rows}
        price = self.price or Price(np.zeros(5), np.zeros(5))
        x0 = pack([stage.guess for stage in stages], nlp.layouts, margin)
        bounds = {"lbx": low, "ubx": high, "lbg": low_g, "ubg": high_g}
        result = solver(x0=x0, p=price.gradient, **bounds, **multipliers)
        if near and not result["success"]:
            solver = nlp.make_solver(1e-2, **MONOTONE)
            result = solver(x0=x0, p=price.gradient, **bounds, **multipliers)
        x, cost = result["x"].full()[:, 0], float(result["f"])
        cost -= float(price.gradient @ price.origin)
        pairs = zip(stages, unpack(x, nlp.layouts), strict=True)
        solved = [replace(stage, guess=part) for stage, part in pairs]
        multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
        status = f"Ipopt stopped with {result['status']}"
        margin = -cost if self.goal is Objective.MARGIN else 0.0
        return TimeSolution(solved, cost, margin, status, result["success"], nlp, multipliers)


@dataclass(frozen=True)
class RefinementSettings:
    """Tolerances in the scene's own units, and bounds of the number of intervals and solves."""

    miss: float = 2.5e-7  # largest miss of a force limit between points, over the weight
    graze: float = 3e-7  # deepest overlap between points, over the radius of gyration
    falter: float = 0.1  # largest miss of half a least rate, over it: a replay might stick
    defect: float = 2e-8  # largest collocation error of z and z' in an interval
    dear: float = 1e-5  # largest relative cost of raised limits in an interval
    spare: float = 0.5  # error after a halving, over the accuracy
    # factors on misses by which limits of forces, gaps and rates are raised
    over: tuple[float, float, float] = (1.5, 3.0, 3.0)
    checks: int = 25  # places per interval at which limits are checked
    at_once: int = 2  # most times that an interval is halved at once
    # most of a phase at the default accuracy, prop. to 1 / sqrt(accuracy); phase 2 of box_rolling
    # takes 155, and with fewer its limits are raised by much
    intervals: int = 160
    parametric: int = 5  # first iterates in which limits are raised by what ranges change alone
    iterates: int = 24
    refinements: int = 8  # most iterates with finer intervals
    patience: int = 80  # most solver iterations of one iterate
    # largest relative increase of the cost; case: goal 8 of the corpus, whose coarse motion breaks
    # limits between points by so much that every finer one costs half as much again
    increase: float = 0.2


SETTINGS = RefinementSettings()
ITERATIONS = 50  # most of the solver from a guess; successes take up to 25
# Options from there: of 152 successes one entered the restoration phase, of 41 failures 24, for
# longer. Case: leg 6 of the corpus takes one iteration of it.
GUESSED = {"max_resto_iter": 5}
# Options of coarse plans: they are accepted where the objective no longer changes, with constraints
# kept. Cases: of 17 releases of queries 37, 10, 24, 33, 16, 0, 5 and 11 three have no plan
# without these, others by rounding.
ACCEPTED = {
    "acceptable_iter": 3,
    "acceptable_obj_change_tol": 1e-6,
    "acceptable_constr_viol_tol": 1e-4,
    "acceptable_compl_inf_tol": 1e-4,
    "acceptable_tol": 1e10,
}
# Options of another solve from what is near a solution, where the adaptive barrier parameter falls
# too soon. Cases: new polygon 9 over time, phase 3 on 22 intervals; query 10 takes twice the time.
MONOTONE = {"mu_strategy": "monotone", "mu_init": 1e-2}
COSTLY = "limits between points cost too much"  # status
_STEP = 1e-6  # step of z for slopes of gaps, over accelerations of a torque of 1


class CheckPlaces(NamedTuple):
    """A stage at the places of the checks in each of its K intervals, one after the other."""

    places: Array  # (K checks,): shares of the duration
    samples: Samples  # motion and forces there
    limits: Array  # (K checks, n_limits) [m]: values of every limit of the formation


@dataclass(frozen=True)
class TimeIterate:
    """Stages with the solution on them, or the one before to start from; see `refinement`."""

    search: TimeSearch
    solution: TimeSolution
    stages: list[Stage]
    raised: list[LimitMisses]  # limits of the stages, by these amounts
    highest: float  # cost above which refinement ends
    change: float = 0.01  # of the cost by the last finer intervals, relative; at first a guess
    least: float = math.nan  # cost of the first solution on these intervals
    refined: int = 0  # iterates with finer intervals so far

    def solve(self) -> TimeIterate:
        """The solution on these stages."""
        if self.stages is self.solution.stages:
            return self
        most = SETTINGS.patience * (2 if self.search.problem.scene.has_slow_motors else 1)
        solution = self.search.solve(self.stages, self.solution, most, self.raised)
        if not solution.success:
            raise SolverError(solution.status)
        if solution.cost > self.highest:
            raise SolverError(COSTLY)
        change, least, old = self.change, self.least, self.solution
        if [s.intervals for s in old.stages] != [s.intervals for s in self.stages]:
            # What raised limits cost later is no reason for more intervals: phases 2 and 3 of query
            # 12 would have twice as many.
            change = abs(solution.cost - old.cost) / self.search.measure(solution.cost)
            least = solution.cost
        solved = replace(self, solution=solution, stages=solution.stages, change=change)
        return replace(solved, least=least)

    def adapt(self) -> TimeIterate | None:
        """With finer intervals, raised limits and those of the formation that are violated."""
        if self.violation <= 1 and not self.is_coarse:
            return None
        stages = bisect_intervals(self.monitored, self.search.scheme, self.halvings)
        triples = zip(self.raised, self.misses, self.halvings, strict=True)
        raised = [limits.add(miss, SETTINGS.over).halve(mine) for limits, miss, mine in triples]
        refined = self.refined + self.is_coarse
        return replace(self, stages=stages, raised=raised, refined=refined)

    def restart(self) -> None:
        """Without a solution there is no other iterate."""

    @cached_property
    def motions(self) -> list[StageMotion]:
        """The motion of each stage that its torques lead to."""
        return make_motions(self.stages, self.search.scheme)

    @cached_property
    def checks(self) -> list[CheckPlaces]:
        """Each stage between its points."""
        return [check_between(*pair) for pair in zip(self.stages, self.motions, strict=True)]

    @cached_property
    def misses(self) -> list[LimitMisses]:
        """Misses of limits of each stage."""
        epsilon, margin = self.search.problem.epsilon, self.solution.margin
        pairs = zip(self.stages, self.checks, strict=True)
        return [find_misses(stage, check, epsilon, margin) for stage, check in pairs]

    @cached_property
    def monitored(self) -> list[Stage]:
        """The stages with limits of their formations that are violated between points."""
        lowest = [find_minima(_by_interval(check.limits)).min(axis=0) for check in self.checks]
        depth = SETTINGS.graze * self.search.problem.scene.scales.length
        return monitor(self.stages, lowest, depth)

    @cached_property
    def gains(self) -> list[Array]:
        """Relative gain of torques of any shape in each interval of each stage, shape (K,) each.

        Zero for held torques. For rate-limited ones it is the relative change of the cost by the
        last finer intervals, distributed by the second differences of the control points.
        """
        search, solution = self.search, self.solution
        stages, epsilon = solution.stages, search.problem.epsilon
        if stages[0].periods:
            return [np.zeros(stage.intervals) for stage in stages]
        size = search.measure(solution.cost)
        if search.problem.scene.has_slow_motors:
            limit, shares = search.problem.scene.torque_limit, list[Array]()
            for part in (stage.guess for stage in stages):
                bends = np.abs(np.diff(part.tau, 2, axis=1) / limit).max(axis=(1, 2), initial=0.0)
                shares.append(part.h * bends)
            return [share * (self.change / max(_sum(shares), 1e-300)) for share in shares]
        square, gains = float(search.goal is Objective.EFFORT), list[Array]()
        x, weights = np.polynomial.legendre.leggauss(7)
        x = (x + 1) / 2
        for rows, stage, motion in zip(solution.nlp.rows_of, stages, self.motions, strict=True):
            # Costates of z and z' at the start of each interval.
            lam = solution.multipliers["lam_g0"][rows.states].sum(axis=2)
            costate = np.einsum("kdf,ksf->ksd", rows.bases, lam)
            # The Hamiltonian at the Gauss points of the intervals is minimised over the torques.
            lengths = np.diff(motion.breaks)
            t = motion.breaks[:-1, None] + lengths[:, None] * x
            response, n = motion.respond(np.append(t, motion.breaks[:-1])), t.size
            here = MotionResponse(*(part[:n] for part in response))
            switching = np.einsum("kd,kdj->kj", costate[:, 1], response.a_by_torque[n:])
            switching = _interpolate(motion.breaks, switching, int(stage.opens), x)
            slope = 2 * square * here.y[:, -4:-2] - switching
            limits = make_limits(stage.formation, epsilon)
            values = here.y @ limits.rows.T
            values[:, limits.of(PRESS)] -= solution.margin
            side_rows, signs, _ = limits.sides
            scales = limits.scales[side_rows]
            slack = np.maximum(limits.find_slack(values) / scales, 0.0)
            by_torque = np.einsum("mi,nij->nmj", limits.rows, here.y_by_torque)
            sides = by_torque[:, side_rows] * (signs / scales)[:, None]
            held = _find_held(stage, here, stage.guess.places(x))
            sides = np.concatenate([sides, held, -held], axis=1)
            slack = np.hstack([slack, np.zeros((n, 2 * held.shape[1]))])
            least = find_least(slope, square, sides, slack).reshape(t.shape)
            defects = np.abs(np.einsum("ksd,ksd->k", costate, motion.defects))
            gains.append((defects - least @ weights / 2 * lengths) / size)
        return gains

    @cached_property
    def halvings(self) -> list[Numbers]:
        """How often to halve each interval of each stage.

        Gains do not count with a given number of intervals.
        """
        search, solution = self.search, self.solution
        none = [np.zeros(stage.intervals, dtype=np.int64) for stage in self.stages]
        options, phases = search.options, len({stage.phase for stage in solution.stages})
        share = max(1.0, math.sqrt(DEFAULT_ACCURACY / options.accuracy))
        most = math.ceil(SETTINGS.intervals * share) * phases
        intervals = sum(stage.intervals for stage in solution.stages)
        if self.refined >= SETTINGS.refinements or intervals >= most:
            return none
        on_x, on_g = (np.abs(solution.multipliers[key]) for key in ("lam_x0", "lam_g0"))
        nlp, prices, times = solution.nlp, list[Array](), list[Numbers]()
        for rows, miss, motion in zip(nlp.rows_of, self.misses, self.motions, strict=True):
            # Relative cost of raising limits by their misses, by multipliers.
            price = np.zeros_like(miss.held)
            for side, on_rows, indices in rows.parts:
                price[:, side] += (on_g if on_rows else on_x)[indices].sum(axis=1)
            cost = (price * miss.held * rows.limits.side_scales).sum(axis=1)
            prices.append(np.asarray(cost / max(abs(solution.cost), 1e-300)))
            # Errors of collocation decrease with the scheme's order, costs with the third one.
            dear = np.maximum(prices[-1] / SETTINGS.dear, 1.0)
            error = np.maximum(np.abs(motion.defects).max(axis=(1, 2)) / SETTINGS.defect, 1.0)
            wanted = np.ceil(np.maximum(np.log2(dear) / 3, np.log2(error) / search.scheme.order))
            times.append(np.clip(wanted, 0, SETTINGS.at_once).astype(np.int64))
        shares = [gain + price for gain, price in zip(self.gains, prices, strict=True)]
        if options.time_intervals is None and _sum(shares) > options.accuracy:
            left = SETTINGS.spare * options.accuracy
            if search.problem.scene.has_slow_motors:
                # Their gains are those of the last iterate, and not of the next one.
                left = max(left, 0.5 * _sum(shares))
            more = spread_halvings(shares, left)
            times = [np.maximum(*pair) for pair in zip(times, more, strict=True)]
        count = sum(int((2**mine).sum()) for mine in times)
        return times if count <= most else [np.minimum(mine, 1) for mine in times]

    @property
    def is_coarse(self) -> bool:
        """Whether any interval is to be halved."""
        return any(times.any() for times in self.halvings)

    @property
    def violation(self) -> float:
        """The largest miss, over its tolerance; infinite where the NLP lacks a limit."""
        if self.monitored is not self.stages:
            return math.inf
        return float(max(measure_misses(miss).max() for miss in self.misses))

    @property
    def error(self) -> float:
        """Estimated relative gain of better torques; infinite on intervals that are too long.

        That of rate-limited ones includes what limits between points have cost on these intervals.
        """
        if self.is_coarse:
            return math.inf
        slow, solution = self.search.problem.scene.has_slow_motors, self.solution
        raised = abs(solution.cost - self.least) if slow and math.isfinite(self.least) else 0.0
        return _sum(self.gains) + raised / self.search.measure(solution.cost)


def refine_stages(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Refine a solution until it is accurate and keeps limits between points."""
    raised = [LimitMisses.none(stage) for stage in solution.stages]
    highest = solution.cost + SETTINGS.increase * search.measure(solution.cost)
    first = TimeIterate(search, solution, solution.stages, raised, highest)
    try:
        best = refine(first, solves=SETTINGS.iterates)
    except SolverError as error:
        return solution._replace(status=str(error), success=False)
    return best.solution._replace(error=best.error)


def keep_within(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Tighten limits of a refined solution until they hold, to first order, within the ranges.

    Limits are raised by what ranges change alone as long as that changes with the motion, and then
    by what is missed.
    """
    raised = [LimitMisses.none(stage) for stage in solution.stages]
    error, epsilon = solution.error, search.problem.epsilon
    for iterate in range(SETTINGS.iterates):
        deviations, misses = list[Array](), list[LimitMisses]()
        motions = make_motions(solution.stages, search.scheme)
        for stage, motion in zip(solution.stages, motions, strict=True):
            check = check_between(stage, motion)
            deviation = find_deviations(search, stage, check)
            misses.append(find_misses(stage, check, epsilon, solution.margin, deviation))
            table = _by_interval(deviation).max(axis=1)
            deviations.append(np.where(table > SETTINGS.miss, table, 0.0))
        if iterate and max(measure_misses(miss).max() for miss in misses) <= 1:
            return solution._replace(error=error)
        raised = [
            amounts._replace(held=table, gap=amounts.gap + miss.gap)
            if iterate < SETTINGS.parametric
            else amounts.add(miss, SETTINGS.over)
            for amounts, table, miss in zip(raised, deviations, misses, strict=True)
        ]
        solution = search.solve(solution.stages, solution, raised=raised)
        if not solution.success:
            break
    status = f"limits cannot be kept within the ranges: {solution.status}"
    return solution._replace(success=False, status=status)


def _by_interval(table: Array) -> Array:
    """Values at the places of the checks, shape (K, checks, n)."""
    return table.reshape(-1, SETTINGS.checks, table.shape[1])


def _sum(tables: Iterable[NDArray[Any]]) -> float:
    return float(sum(table.sum() for table in tables))


def measure_misses(miss: LimitMisses) -> Array:
    """The largest miss of each interval, over its tolerance, shape (K,)."""
    allowed = (SETTINGS.miss, SETTINGS.graze, SETTINGS.falter * SLIDING)
    parts = (table.max(axis=1, initial=0.0) / a for table, a in zip(miss, allowed, strict=True))
    return np.asarray(np.max(list(parts), axis=0))


def check_between(stage: Stage, motion: StageMotion) -> CheckPlaces:
    """Motion, forces and limits of a stage at the checks between its points."""
    places = stage.guess.places(np.linspace(1e-9, 1 - 1e-9, SETTINGS.checks)).ravel()
    samples = motion.evaluate(places * motion.duration)
    return CheckPlaces(places, samples, stage.formation.evaluate_limits(samples.z))


def find_misses(
    stage: Stage,
    check: CheckPlaces,
    epsilon: float,
    margin: float = 0.0,
    deviations: Array | float = 0.0,
) -> LimitMisses:
    """Largest misses of limits in each interval.

    c_n, but not friction cones, have to exceed epsilon by `margin`, and each side its bound by
    `deviations` times its scale, shape (K checks, n_sides). Sides of torques alone are bounds of
    their control points, and never missed.
    """
    formation, samples = stage.formation, check.samples
    limits = make_limits(formation, epsilon)
    c = [samples.c_n, samples.c_t[:, list(formation.rolling_rows)]]
    values = np.hstack([*c, samples.tau, samples.z_dot[:, 3:]]) @ limits.rows.T
    rows, signs, _ = limits.sides
    relieved = np.repeat(find_relieved(stage, limits), SETTINGS.checks, axis=0)
    bare = signs * values[:, rows]
    values[:, limits.of(PRESS)] -= margin
    slack = np.where(relieved, bare, limits.find_slack(values)) / limits.side_scales
    bent = np.flatnonzero(np.delete(limits.rows, [-4, -3], axis=1).any(axis=1))
    slack[:, ~np.isin(rows, bent)] = 0.0
    # Misses at the start of a stage do not depend on it.
    gaps, watched = np.ones_like(check.limits), list(stage.monitored)
    gaps[:, watched] = check.limits[:, watched] - np.minimum(check.limits[:1, watched], 0.0)
    gaps[:, watched] -= stage.list_clearances(check.places, after=1 / 2) / 2
    # Only contacts with friction have a sliding direction.
    senses = stage.measure_senses(samples.z, samples.z_dot)
    senses -= 0.5 * least_senses(stage, check.places)
    senses[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = 1.0
    tables = (slack - deviations, gaps, senses)
    return LimitMisses(*(np.maximum(-find_minima(_by_interval(table)), 0.0) for table in tables))


def find_deviations(search: TimeSearch, stage: Stage, check: CheckPlaces) -> Array:
    """Change of each side of the limits by all ranges, relative to its scale, (n, n_sides)."""
    formation, count, epsilon = stage.formation, len(check.places), search.problem.epsilon
    units = {"m": search.source.scene.scales.length}
    radii = {
        parameter.name: radius / units.get(parameter.unit, 1.0)
        for parameter in PARAMETERS
        if (radius := search.options.ranges.get(parameter.name, 0.0)) and parameter.unit != "s"
    }
    limits = make_limits(formation, epsilon)
    total, names = np.zeros((count, len(limits.low))), [*radii]
    if names:
        forces, samples = limits.of(PRESS, CONE), check.samples
        rows = limits.rows[forces][:, : formation.n_constraints]
        signs = (np.broadcast_to(part, (count, *part.shape)) for part in stage.directions)
        slopes = find_slopes_at(formation, samples, Directions(*signs), names)[..., None]
        c = np.hstack([samples.c_n, samples.c_t[:, list(formation.rolling_rows)]])[..., None]
        changes = find_variations(formation, rows, names, slopes, c, epsilon)[..., 0]
        total[:, forces] = np.abs(changes) @ [*radii.values()]
    return np.asarray(total[:, limits.sides[0]] / limits.side_scales)


def _find_held(stage: Stage, here: MotionResponse, places: Array) -> Array:
    """Accelerations by torque of rates and gaps at their bounds, (n, m, 2); zero elsewhere."""
    formation, z, v, by_torque = stage.formation, here.z, here.v, here.a_by_torque
    least = least_senses(stage, places).reshape(len(z), -1)
    least[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = -np.inf
    senses = np.concatenate([formation.evaluate(z, v).A_t @ by_torque, by_torque[:, 3:]], axis=1)
    slow = (stage.measure_senses(z, v) < 3.0 * least) & (least > 0)  # active
    monitored, size = list(stage.monitored), formation.scene.scales.length
    gaps = formation.evaluate_limits(z)[:, monitored]
    moved = [formation.evaluate_limits(z + _STEP * by_torque[..., j]) for j in range(2)]
    slopes = np.stack([(after[:, monitored] - gaps) / _STEP for after in moved], axis=-1)
    close = gaps < 1e-6 * size  # gap over the radius of gyration below which its limit is active
    first = np.repeat(np.arange(len(places)) == 0, places.shape[1])
    opens = stage.opens and stage.opening is not None
    close |= first[:, None] & (np.isin(monitored, stage.released) & opens)
    active = np.concatenate([slow, close], axis=1)
    held = active[..., None] * np.concatenate([senses, slopes], axis=1)
    return np.asarray(held[:, np.flatnonzero(held.any(axis=(0, 2)))])


def _interpolate(breaks: Array, values: Array, first: int, x: Array) -> Array:
    """Cubic Hermite interpolation of values at starts of K intervals, at `x` of each, (K n, 2).

    The ends, before value number `first` and after the last, are extrapolated by parabolas.
    """
    indices = np.arange(min(first, len(values) - 1), len(values))
    for end, near in ((0, indices[:3]), (len(values), indices[-3:])):
        powers = np.arange(len(near))
        at = (breaks[near] - breaks[end])[:, None] ** powers
        value = np.linalg.solve(at, values[near])[:1]
        values = np.vstack([value, values[1:]]) if end == 0 else np.vstack([values, value])
    slopes = np.gradient(values, breaks, axis=0, edge_order=2)
    x, lengths = x[:, None], np.diff(breaks)[:, None, None]
    y = 1 - x
    ends = y**2 * (1 + 2 * x) * values[:-1, None] + x**2 * (1 + 2 * y) * values[1:, None]
    bends = y**2 * x * slopes[:-1, None] - x**2 * y * slopes[1:, None]
    return np.asarray(ends + lengths * bends).reshape(-1, values.shape[1])


def find_least(slope: Array, square: float, rows: Array, slack: Array) -> Array:
    """Minimum of slope^T u + square u^T u subject to rows u + slack >= 0, for n problems in 2D.

    By enumeration of vertices, edges, interior and the feasible u = 0; shapes (n, 2), (n, m, 2) and
    (n, m) of slope, rows and slack.
    """
    first, second = np.array(list(combinations(range(rows.shape[1]), 2))).T
    one, other = rows[:, first], rows[:, second]
    across = one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        numerators = slack[:, first, None] * other - slack[:, second, None] * one
        u = np.stack([-numerators[..., 1], numerators[..., 0]], axis=-1) / across[..., None]
        if square:
            free = (-slope / (2 * square))[:, None]
            beyond = (np.einsum("nmj,noj->nm", rows, free) + slack)[..., None]
            edges = free - rows * beyond / (rows**2).sum(axis=2, keepdims=True)
            u = np.concatenate([u, edges, free], axis=1)
        over = np.einsum("nmj,nuj->num", rows, u) + slack[:, None]
        value = np.einsum("nj,nuj->nu", slope, u) + square * (u**2).sum(axis=2)
    allowed = (over >= -1e-9).all(axis=2) & np.isfinite(value)  # rounding
    return np.asarray(np.where(allowed, value, 0.0).min(axis=1, initial=0.0))


def spread_halvings(shares: Sequence[Array], most: float) -> list[Numbers]:
    """How often to halve intervals, (K,) each, the largest first, until errors sum up to `most`.

    Gains of better torques decrease with the square of the length.
    """
    left, times = np.concatenate(shares), np.zeros(sum(map(len, shares)), dtype=np.int64)
    even = most / len(left)
    while left.sum() > most:
        worst = int(np.where(times < SETTINGS.at_once, left, 0.0).argmax())
        if times[worst] == SETTINGS.at_once or left[worst] <= even:
            break
        left[worst] /= 4.0
        times[worst] += 1
    return np.split(times, np.cumsum([len(part) for part in shares])[:-1])
