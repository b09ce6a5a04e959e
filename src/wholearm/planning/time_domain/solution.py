"""Solution of the time-domain NLP by Ipopt, and its refinement: adaptive mesh and tightened limits.

The limits of each iterate are checked once, at `checks` places of every interval, on the motion
integrated from its torques. The README says where intervals are halved and limits are tightened.
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
    LimitViolations,
    Scheme,
    Stage,
    bisect_intervals,
    in_scene_units,
    make_scheme,
    monitor,
    unit_lengths,
    unit_of,
    with_controls,
)
from .time_motion import MotionResponse, StageMotion, make_motions
from .time_nlp import (
    MIN_RATE,
    Target,
    TimeNLP,
    build_time_nlp,
    find_bounds,
    find_zero_bounds,
    least_rates,
    pack,
    unpack,
)

Multipliers = dict[str, Array]  # of the unknowns' bounds, `lam_x0`, and of the rows, `lam_g0`


@dataclass
class ModeStatistics:
    """Statistics of a mode search."""

    sequences: int = 1  # number of mode sequences solved
    complete: bool = True  # whether all neighbours of the best one were solved


class Price(NamedTuple):
    """Linear cost of the end of stages: `gradient` @ (z - `origin`), both of shape (5,)."""

    gradient: Array
    origin: Array


class TimeSolution(NamedTuple):
    """Solution of an NLP: stages with the solution as their guess."""

    stages: list[Stage]
    cost: float  # objective
    margin: float  # least c_n over epsilon, if that is an unknown
    status: str  # how the solver ended, in words
    success: bool
    nlp: TimeNLP
    multipliers: Multipliers
    error: float = math.nan  # estimated gain of better torques, over the cost; NaN if unknown
    attempt: str = ""  # name of the initial guess

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
    """Arguments common to all solves for a plan, and their statistics."""

    source: Problem
    options: PlanOptions
    phases: Sequence[Phase] = ()  # of the NLP; all of the problem by default
    duration: float | None = None  # [s]: longest duration, for the objective `margin`
    cost_to_go: CostToGo | None = None
    saturation: float = math.inf  # [N]: normal force at which the objective `margin` saturates
    coarse: bool = False  # whether plans may miss limits between points
    controls: int = 0  # control points of torques in an interval; 0: as many as points
    soft_objective: Objective | None = None  # `elastic` or `relax`, overrides the options
    relaxation: Parameter | None = None  # the relaxed limit, for the objective `relax`
    price: Price | None = None  # in the scene's own units
    modes_searched: bool = False  # whether the modes of the first guess come from a mode search
    statistics: ModeStatistics = field(default_factory=ModeStatistics)  # common to all copies

    def __post_init__(self) -> None:
        self.phases = self.phases or self.source.phases

    @cached_property
    def problem(self) -> Problem:
        """The problem in its scene's own units."""
        return in_scene_units(self.source)

    @property
    def goal(self) -> Objective:
        """The objective."""
        return self.soft_objective or self.options.goal

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
        assert self.cost_to_go is not None
        scales = self.source.scene.scales
        lengths, unit = unit_lengths(scales), unit_of(self.goal, scales)
        value, gradient = self.cost_to_go.expand(z * lengths)
        return value / unit, Price(gradient * lengths / unit, z)

    def soften(self, relaxation: Parameter | None = None) -> TimeSearch:
        """Copy that minimizes the violation of all limits, or the relaxation of a single one.

        Torques are linear in each interval: polynomials might keep the limits at the points alone.
        """
        soft_objective = Objective.RELAX if relaxation else Objective.ELASTIC
        search = replace(self, soft_objective=soft_objective, relaxation=relaxation, controls=2)
        return replace(search, duration=None, cost_to_go=None, price=None)

    def is_saturated(self, solution: TimeSolution) -> bool:
        """Whether the objective `margin` is saturated."""
        return self.goal is Objective.MARGIN and solution.margin > self.saturated_margin

    def measure(self, cost: float) -> float:
        """Scale of a cost, for relative changes."""
        return abs(cost) + self.problem.epsilon * (self.goal is Objective.MARGIN)

    @property
    def saturated_margin(self) -> float:
        """Margin at which the objective saturates."""
        return self.saturation / self.source.scene.scales.force - self.problem.epsilon

    def solve(
        self,
        stages: list[Stage],
        previous: TimeSolution | None = None,
        max_iter: int = 150,
        tightening: Sequence[LimitViolations] | None = None,
    ) -> TimeSolution:
        """Solve from the stages' guesses in at most `max_iter` iterations.

        Without `tightening` of the limits, formation limits violated at the points are added, and
        the NLP is solved again. The NLP of a `previous` solution is reused for its own stages.
        """
        controls = self.scheme.controls
        if stages[0].guess.tau.shape[1] != controls:
            stages = [replace(s, guess=with_controls(s.guess, controls)) for s in stages]
        margin = previous.margin if previous else 0.0
        tolerance = 1e-6 * self.problem.scene.polygon.gyration_radius  # least violation that counts
        nlp, multipliers = None, None
        if previous and all(map(operator.is_, stages, previous.stages)):
            # With another price of the end the previous solution is not optimal.
            nlp = previous.nlp if tightening else replace(previous.nlp, max_iter=max_iter)
            multipliers = previous.multipliers if tightening else None
        while True:
            amounts = tightening or [LimitViolations.none(stage) for stage in stages]
            nlp = nlp or self.build(stages, max_iter)
            solution = self.run(nlp, stages, amounts, multipliers, margin)
            if tightening or not solution.success:
                return solution
            pairs = ((stage.formation, stage.guess.z.reshape(-1, 5)) for stage in solution.stages)
            least = [formation.evaluate_limits(z).min(axis=0) for formation, z in pairs]
            stages, nlp = monitor(solution.stages, least, tolerance), None
            if stages is solution.stages:
                return solution

    def build(self, stages: Sequence[Stage], max_iter: int = 150) -> TimeNLP:
        """Build the NLP."""
        weight = self.options.time_weight / self.source.scene.scales.torque**2
        # Coarse plans without: with it four of 60 goals have routes that are 0.1 to 8 % slower.
        target = Target(self.goal, self.problem.epsilon, weight, self.relaxation, not self.coarse)
        max_iter = {Objective.ELASTIC: 90, Objective.RELAX: 50}.get(self.goal, max_iter)
        return build_time_nlp(stages, self.scheme, target, max_iter)

    def run(
        self,
        nlp: TimeNLP,
        stages: Sequence[Stage],
        tightening: Sequence[LimitViolations],
        multipliers: Multipliers | None,
        margin: float,
    ) -> TimeSolution:
        """Run the solver once."""
        (low, high), (low_g, high_g) = find_bounds(nlp, stages, self.scheme, tightening)
        if self.duration is not None and nlp.duration_row >= 0:
            high_g[nlp.duration_row] = self.duration / self.source.scene.scales.time
        if self.goal is Objective.MARGIN:
            # Solving for more than the saturated margin takes long.
            high[nlp.layouts[-1].margin[-1]] = 1.1 * self.saturated_margin
        status = "limits tightened between points exclude all motions" if (low > high).any() else ""
        if (low_g == high_g).sum() > len(low):
            # Ipopt refuses it, and CasADi prints that. Case: scene 5 of stress, seed 3, effort.
            status = "the modes leave no freedom: there are more equations than unknowns"
        if status:
            return TimeSolution(list(stages), np.inf, 0.0, status, False, nlp, {})
        warm_start = nlp.max_iter > ITERATIONS
        options = ({} if warm_start else GUESS_OPTIONS) | (COARSE_OPTIONS if self.coarse else {})
        solver = nlp.solver if multipliers else nlp.make_solver(1e-2, **options)
        if not multipliers:
            size = 1e-2  # of all inequalities
            signs = np.isfinite(high).astype(float) - np.isfinite(low)
            lam_g = np.where(high_g > low_g, -size, 0.0)
            multipliers = {"lam_x0": size * signs, "lam_g0": lam_g}
        price = self.price or Price(np.zeros(5), np.zeros(5))
        x0 = pack([stage.guess for stage in stages], nlp.layouts, margin)
        bounds = {"lbx": low, "ubx": high, "lbg": low_g, "ubg": high_g}
        result = solver(x0=x0, p=price.gradient, **bounds, **multipliers)
        if warm_start and not result["success"]:
            solver = nlp.make_solver(1e-2, **MONOTONE_OPTIONS)
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
    """Tolerances in the scene's units, and bounds of the number of intervals and solves."""

    violation: float = 2.5e-7  # of force limits between points, over the weight
    overlap: float = 3e-7  # of bodies between points, over the radius of gyration
    rate: float = 0.1  # violation of half a least rate, over that rate: a replay might stick
    defect: float = 2e-8  # largest collocation error of z and z' in an interval
    relative_cost: float = 1e-5  # largest relative cost of tightened limits in an interval
    error: float = 0.5  # target of a halving for the estimated error, over the accuracy
    # factors on violations by which limits of forces, gaps and rates are tightened
    tightening: tuple[float, float, float] = (1.5, 3.0, 3.0)
    checks: int = 25  # places per interval at which limits are checked
    halvings: int = 2  # most times that an interval is halved at once
    # most of a phase at the default accuracy, prop. to 1 / sqrt(accuracy); phase 2 of box_rolling
    # takes 155; with fewer its limits are tightened by much
    intervals: int = 160
    parametric_iterates: int = 5  # first iterates, tightened by the parametric bounds alone
    iterates: int = 24
    refinements: int = 8  # most iterates with finer intervals
    max_iter: int = 80  # most solver iterations of one iterate
    # largest relative increase of the cost; case: goal 8 of the corpus, whose coarse motion breaks
    # limits between points by so much that every finer one costs half as much again
    cost_increase: float = 0.2


SETTINGS = RefinementSettings()
ITERATIONS = 50  # most of the solver from a guess; successes take up to 25
# Ipopt options from a guess: of 152 successes one entered the restoration phase, of 41 failures 24,
# for longer. Case: leg 6 of the corpus takes one iteration of it.
GUESS_OPTIONS = {"max_resto_iter": 5}
# Ipopt options of coarse plans: accept where the objective no longer changes and constraints are
# satisfied. Cases: of 17 releases of queries 37, 10, 24, 33, 16, 0, 5 and 11 three have no plan
# without these, others by rounding.
COARSE_OPTIONS = {
    "acceptable_iter": 3,
    "acceptable_obj_change_tol": 1e-6,
    "acceptable_constr_viol_tol": 1e-4,
    "acceptable_compl_inf_tol": 1e-4,
    "acceptable_tol": 1e10,
}
# Ipopt options of a second solve from near a solution, where the adaptive barrier parameter falls
# too soon. Cases: new polygon 9 over time, phase 3 on 22 intervals; query 10 takes twice the time.
MONOTONE_OPTIONS = {"mu_strategy": "monotone", "mu_init": 1e-2}
COSTLY = "limits between points cost too much"  # status
_STEP = 1e-6  # step of z for slopes of gaps, over accelerations of a torque of 1


class CheckPlaces(NamedTuple):
    """A stage sampled at the checks of all its K intervals, in order of time."""

    places: Array  # (K checks,): fractions of the duration
    samples: Samples  # motion and forces there
    limits: Array  # (K checks, n_limits) [m]: values of every limit of the formation


@dataclass(frozen=True)
class TimeIterate:
    """Stages with their solution, or the previous solution to start from; see `refinement`."""

    search: TimeSearch
    solution: TimeSolution
    stages: list[Stage]
    tightening: list[LimitViolations]  # limits of the stages, by these amounts
    cost_limit: float  # above which refinement ends
    cost_change: float = 0.01  # relative, by the last halving; at first a guess
    base_cost: float = math.nan  # cost of the first solution on these intervals
    refinements: int = 0  # iterates with halved intervals so far

    def solve(self) -> TimeIterate:
        """The solution on these stages."""
        if self.stages is self.solution.stages:
            return self
        max_iter = SETTINGS.max_iter * (2 if self.search.problem.scene.has_slow_motors else 1)
        solution = self.search.solve(self.stages, self.solution, max_iter, self.tightening)
        if not solution.success:
            raise SolverError(solution.status)
        if solution.cost > self.cost_limit:
            raise SolverError(COSTLY)
        cost_change, base_cost, previous = self.cost_change, self.base_cost, self.solution
        if [s.intervals for s in previous.stages] != [s.intervals for s in self.stages]:
            # The later cost of tightened limits is no reason for more intervals: phases 2 and 3 of
            # query 12 would have twice as many.
            cost_change = abs(solution.cost - previous.cost) / self.search.measure(solution.cost)
            base_cost = solution.cost
        solved = replace(self, solution=solution, stages=solution.stages)
        return replace(solved, cost_change=cost_change, base_cost=base_cost)

    def adapt(self) -> TimeIterate | None:
        """The next iterate: halved intervals, tightened limits, more monitored limits."""
        if self.violation <= 1 and not self.is_coarse:
            return None
        stages = bisect_intervals(self.monitored_stages, self.search.scheme, self.halvings)
        triples = zip(self.tightening, self.violations, self.halvings, strict=True)
        tightening = [a.add(v, SETTINGS.tightening).halve(times) for a, v, times in triples]
        refinements = self.refinements + self.is_coarse
        return replace(self, stages=stages, tightening=tightening, refinements=refinements)

    def restart(self) -> None:
        """Without a solution there is no other iterate."""

    @cached_property
    def motions(self) -> list[StageMotion]:
        """The motion of each stage, integrated from its torques."""
        return make_motions(self.stages, self.search.scheme)

    @cached_property
    def checks(self) -> list[CheckPlaces]:
        """Samples of each stage between its points."""
        return [run_checks(*pair) for pair in zip(self.stages, self.motions, strict=True)]

    @cached_property
    def violations(self) -> list[LimitViolations]:
        """Limit violations of each stage."""
        epsilon, margin = self.search.problem.epsilon, self.solution.margin
        pairs = zip(self.stages, self.checks, strict=True)
        return [find_violations(stage, check, epsilon, margin) for stage, check in pairs]

    @cached_property
    def monitored_stages(self) -> list[Stage]:
        """The stages, with formation limits that are violated between points also monitored."""
        lowest = [find_minima(_by_interval(check.limits)).min(axis=0) for check in self.checks]
        tolerance = SETTINGS.overlap * self.search.problem.scene.scales.length
        return monitor(self.stages, lowest, tolerance)

    @cached_property
    def gains(self) -> list[Array]:
        """Estimated relative gain of torques of any shape, for each interval, (K,) for each stage.

        By the minimum principle with the costates; zero for held torques. For rate-limited ones the
        last relative cost change, in proportion to second differences of the control points.
        """
        search, solution = self.search, self.solution
        stages, epsilon = solution.stages, search.problem.epsilon
        if stages[0].periods:
            return [np.zeros(stage.intervals) for stage in stages]
        size = search.measure(solution.cost)
        if search.problem.scene.has_slow_motors:
            limit, changes = search.problem.scene.torque_limit, list[Array]()
            for part in (stage.guess for stage in stages):
                second = np.abs(np.diff(part.tau, 2, axis=1) / limit).max(axis=(1, 2), initial=0.0)
                changes.append(part.h * second)
            return [change * (self.cost_change / max(_sum(changes), 1e-300)) for change in changes]
        square, gains = float(search.goal is Objective.EFFORT), list[Array]()
        x, weights = np.polynomial.legendre.leggauss(7)
        x = (x + 1) / 2
        for rows, stage, motion in zip(solution.nlp.rows_of, stages, self.motions, strict=True):
            # Costates of z and z' at the start of each interval.
            lam = solution.multipliers["lam_g0"][rows.states].sum(axis=2)
            costate = np.einsum("kdf,ksf->ksd", rows.bases, lam)
            # Minimum of the Hamiltonian at the Gauss points of the intervals.
            lengths = np.diff(motion.breaks)
            t = motion.breaks[:-1, None] + lengths[:, None] * x
            response, n = motion.respond(np.append(t, motion.breaks[:-1])), t.size
            samples = MotionResponse(*(part[:n] for part in response))
            switching = np.einsum("kd,kdj->kj", costate[:, 1], response.a_by_torque[n:])
            switching = _interpolate(motion.breaks, switching, int(stage.opens), x)
            slope = 2 * square * samples.y[:, -4:-2] - switching
            limits = make_limits(stage.formation, epsilon)
            values = samples.y @ limits.rows.T
            values[:, limits.of(PRESS)] -= solution.margin
            side_rows, signs, _ = limits.sides
            scales = limits.scales[side_rows]
            slack = np.maximum(limits.find_slack(values) / scales, 0.0)
            by_torque = np.einsum("mi,nij->nmj", limits.rows, samples.y_by_torque)
            sides = by_torque[:, side_rows] * (signs / scales)[:, None]
            active = _find_active_rows(stage, samples, stage.guess.places(x))
            sides = np.concatenate([sides, active, -active], axis=1)
            slack = np.hstack([slack, np.zeros((n, 2 * active.shape[1]))])
            least = minimize_quadratic(slope, square, sides, slack).reshape(t.shape)
            defects = np.abs(np.einsum("ksd,ksd->k", costate, motion.defects))
            gains.append((defects - least @ weights / 2 * lengths) / size)
        return gains

    @cached_property
    def halvings(self) -> list[Numbers]:
        """Number of halvings of each interval of each stage.

        Gains of better torques do not count if the number of intervals is prescribed.
        """
        search, solution = self.search, self.solution
        zero = [np.zeros(stage.intervals, dtype=np.int64) for stage in self.stages]
        options, phases = search.options, len({stage.phase for stage in solution.stages})
        scale = max(1.0, math.sqrt(DEFAULT_ACCURACY / options.accuracy))
        limit = math.ceil(SETTINGS.intervals * scale) * phases
        intervals = sum(stage.intervals for stage in solution.stages)
        if self.refinements >= SETTINGS.refinements or intervals >= limit:
            return zero
        lam_x, lam_g = (np.abs(solution.multipliers[key]) for key in ("lam_x0", "lam_g0"))
        nlp, costs, halvings = solution.nlp, list[Array](), list[Numbers]()
        for rows, violation, motion in zip(nlp.rows_of, self.violations, self.motions, strict=True):
            # Relative cost of tightening limits by their violations, from the multipliers.
            multipliers = np.zeros_like(violation.sides)
            for side, on_rows, indices in rows.parts:
                multipliers[:, side] += (lam_g if on_rows else lam_x)[indices].sum(axis=1)
            cost = (multipliers * violation.sides * rows.limits.side_scales).sum(axis=1)
            costs.append(np.asarray(cost / max(abs(solution.cost), 1e-300)))
            # Errors of collocation decrease with the scheme's order, costs with the third one.
            ratio = np.maximum(costs[-1] / SETTINGS.relative_cost, 1.0)
            defect = np.maximum(np.abs(motion.defects).max(axis=(1, 2)) / SETTINGS.defect, 1.0)
            needed = np.ceil(np.maximum(np.log2(ratio) / 3, np.log2(defect) / search.scheme.order))
            halvings.append(np.clip(needed, 0, SETTINGS.halvings).astype(np.int64))
        errors = [gain + cost for gain, cost in zip(self.gains, costs, strict=True)]
        if options.time_intervals is None and _sum(errors) > options.accuracy:
            target = SETTINGS.error * options.accuracy
            if search.problem.scene.has_slow_motors:
                # Their gains belong to the last iterate, not to the next one.
                target = max(target, 0.5 * _sum(errors))
            extra = distribute_halvings(errors, target)
            halvings = [np.maximum(*pair) for pair in zip(halvings, extra, strict=True)]
        count = sum(int((2**counts).sum()) for counts in halvings)
        return halvings if count <= limit else [np.minimum(counts, 1) for counts in halvings]

    @property
    def is_coarse(self) -> bool:
        """Whether any interval is to be halved."""
        return any(counts.any() for counts in self.halvings)

    @property
    def violation(self) -> float:
        """Largest violation over its tolerance; infinite where the NLP lacks a limit."""
        if self.monitored_stages is not self.stages:
            return math.inf
        return float(max(measure_violations(violation).max() for violation in self.violations))

    @property
    def error(self) -> float:
        """Estimated relative gain of better torques; infinite if an interval is to be halved.

        With rate-limited torques it includes the cost of tightened limits on these intervals.
        """
        if self.is_coarse:
            return math.inf
        base, cost, scene = self.base_cost, self.solution.cost, self.search.problem.scene
        rise = abs(cost - base) if scene.has_slow_motors and math.isfinite(base) else 0.0
        return _sum(self.gains) + rise / self.search.measure(cost)


def refine_stages(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Refine a solution until it is accurate and satisfies limits between points."""
    tightening = [LimitViolations.none(stage) for stage in solution.stages]
    cost_limit = solution.cost + SETTINGS.cost_increase * search.measure(solution.cost)
    first = TimeIterate(search, solution, solution.stages, tightening, cost_limit)
    try:
        refined = refine(first, solves=SETTINGS.iterates)
    except SolverError as error:
        return solution._replace(status=str(error), success=False)
    return refined.solution._replace(error=refined.error)


def tighten_to_ranges(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Tighten limits of a refined solution until they hold, to first order, within the ranges.

    The first iterates are tightened by the parametric bounds, which change with the motion; later
    ones by their violations.
    """
    tightening = [LimitViolations.none(stage) for stage in solution.stages]
    error, epsilon = solution.error, search.problem.epsilon
    for iterate in range(SETTINGS.iterates):
        deviations, violations = list[Array](), list[LimitViolations]()
        motions = make_motions(solution.stages, search.scheme)
        for stage, motion in zip(solution.stages, motions, strict=True):
            check = run_checks(stage, motion)
            deviation = find_deviations(search, stage, check)
            violations.append(find_violations(stage, check, epsilon, solution.margin, deviation))
            table = _by_interval(deviation).max(axis=1)
            deviations.append(np.where(table > SETTINGS.violation, table, 0.0))
        if iterate and max(measure_violations(violation).max() for violation in violations) <= 1:
            return solution._replace(error=error)
        tightening = [
            previous._replace(sides=table, gaps=previous.gaps + violation.gaps)
            if iterate < SETTINGS.parametric_iterates
            else previous.add(violation, SETTINGS.tightening)
            for previous, table, violation in zip(tightening, deviations, violations, strict=True)
        ]
        solution = search.solve(solution.stages, solution, tightening=tightening)
        if not solution.success:
            break
    status = f"limits cannot be kept within the ranges: {solution.status}"
    return solution._replace(success=False, status=status)


def _by_interval(table: Array) -> Array:
    """Values at the places of the checks, shape (K, checks, n)."""
    return table.reshape(-1, SETTINGS.checks, table.shape[1])


def _sum(tables: Iterable[NDArray[Any]]) -> float:
    return float(sum(table.sum() for table in tables))


def measure_violations(violations: LimitViolations) -> Array:
    """Largest violation in each interval over its tolerance, shape (K,)."""
    tolerances = (SETTINGS.violation, SETTINGS.overlap, SETTINGS.rate * MIN_RATE)
    parts = (t.max(axis=1, initial=0.0) / a for t, a in zip(violations, tolerances, strict=True))
    return np.asarray(np.max(list(parts), axis=0))


def run_checks(stage: Stage, motion: StageMotion) -> CheckPlaces:
    """Motion, forces and limits of a stage at the checks of its intervals."""
    places = stage.guess.places(np.linspace(1e-9, 1 - 1e-9, SETTINGS.checks)).ravel()
    samples = motion.evaluate(places * motion.duration)
    return CheckPlaces(places, samples, stage.formation.evaluate_limits(samples.z))


def find_violations(
    stage: Stage,
    check: CheckPlaces,
    epsilon: float,
    margin: float = 0.0,
    deviations: Array | float = 0.0,
) -> LimitViolations:
    """Largest violation of each limit in each interval.

    c_n, but not friction cones, have to exceed epsilon by `margin`. Each side of a limit has to
    exceed its bound by `deviations` times its scale, shape (K checks, n_sides). Limits of torques
    alone are bounds of the control points, and never violated.
    """
    formation, samples = stage.formation, check.samples
    limits = make_limits(formation, epsilon)
    c = [samples.c_n, samples.c_t[:, list(formation.rolling_rows)]]
    values = np.hstack([*c, samples.tau, samples.z_dot[:, 3:]]) @ limits.rows.T
    rows, signs, _ = limits.sides
    zero_bounds = np.repeat(find_zero_bounds(stage, limits), SETTINGS.checks, axis=0)
    distance = signs * values[:, rows]
    values[:, limits.of(PRESS)] -= margin
    slack = np.where(zero_bounds, distance, limits.find_slack(values)) / limits.side_scales
    checked = np.flatnonzero(np.delete(limits.rows, [-4, -3], axis=1).any(axis=1))
    slack[:, ~np.isin(rows, checked)] = 0.0
    # A violation at the start of a stage does not depend on the stage.
    gaps, monitored = np.ones_like(check.limits), list(stage.monitored)
    gaps[:, monitored] = check.limits[:, monitored] - np.minimum(check.limits[:1, monitored], 0.0)
    gaps[:, monitored] -= stage.list_clearances(check.places, after=1 / 2) / 2
    # Only contacts with friction have a sliding direction.
    rates = stage.measure_rates(samples.z, samples.z_dot)
    rates -= 0.5 * least_rates(stage, check.places)
    rates[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = 1.0
    slacks = (slack - deviations, gaps, rates)
    return LimitViolations(*(np.maximum(-find_minima(_by_interval(t)), 0.0) for t in slacks))


def find_deviations(search: TimeSearch, stage: Stage, check: CheckPlaces) -> Array:
    """Parametric bound of each side of the limits over its scale, (n, n_sides)."""
    formation, count, epsilon = stage.formation, len(check.places), search.problem.epsilon
    units = {"m": search.source.scene.scales.length}
    radii = {
        parameter.name: radius / units.get(parameter.unit, 1.0)
        for parameter in PARAMETERS
        if (radius := search.options.ranges.get(parameter.name, 0.0)) and parameter.unit != "s"
    }
    limits = make_limits(formation, epsilon)
    deviations, names = np.zeros((count, len(limits.low))), [*radii]
    if names:
        forces, samples = limits.of(PRESS, CONE), check.samples
        rows = limits.rows[forces][:, : formation.n_constraints]
        directions = (np.broadcast_to(signs, (count, *signs.shape)) for signs in stage.directions)
        slopes = find_slopes_at(formation, samples, Directions(*directions), names)[..., None]
        c = np.hstack([samples.c_n, samples.c_t[:, list(formation.rolling_rows)]])[..., None]
        changes = find_variations(formation, rows, names, slopes, c, epsilon)[..., 0]
        deviations[:, forces] = np.abs(changes) @ [*radii.values()]
    return np.asarray(deviations[:, limits.sides[0]] / limits.side_scales)


def _find_active_rows(stage: Stage, motion: MotionResponse, places: Array) -> Array:
    """Accelerations per torque of rates and gaps at their bounds, (n, m, 2); zero elsewhere."""
    formation, z, v, by_torque = stage.formation, motion.z, motion.v, motion.a_by_torque
    least = least_rates(stage, places).reshape(len(z), -1)
    least[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = -np.inf
    rates = np.concatenate([formation.evaluate(z, v).A_t @ by_torque, by_torque[:, 3:]], axis=1)
    slow = (stage.measure_rates(z, v) < 3.0 * least) & (least > 0)  # active
    monitored, size = list(stage.monitored), formation.scene.scales.length
    gaps = formation.evaluate_limits(z)[:, monitored]
    moved_gaps = [formation.evaluate_limits(z + _STEP * by_torque[..., j]) for j in range(2)]
    slopes = np.stack([(after[:, monitored] - gaps) / _STEP for after in moved_gaps], axis=-1)
    closed = gaps < 1e-6 * size  # gap over the radius of gyration below which its limit is active
    first = np.repeat(np.arange(len(places)) == 0, places.shape[1])
    opens = stage.opens and stage.opening is not None
    closed |= first[:, None] & (np.isin(monitored, stage.released) & opens)
    active = np.concatenate([slow, closed], axis=1)
    rows = active[..., None] * np.concatenate([rates, slopes], axis=1)
    return np.asarray(rows[:, np.flatnonzero(rows.any(axis=(0, 2)))])


def _interpolate(breaks: Array, values: Array, first: int, x: Array) -> Array:
    """Cubic Hermite interpolation of values at the starts of K intervals, at `x` in each, (K n, 2).

    Values before number `first` and at the end are extrapolated by parabolas.
    """
    indices = np.arange(min(first, len(values) - 1), len(values))
    for end, nearest in ((0, indices[:3]), (len(values), indices[-3:])):
        exponents = np.arange(len(nearest))
        powers = (breaks[nearest] - breaks[end])[:, None] ** exponents
        value = np.linalg.solve(powers, values[nearest])[:1]
        values = np.vstack([value, values[1:]]) if end == 0 else np.vstack([values, value])
    slopes = np.gradient(values, breaks, axis=0, edge_order=2)
    x, lengths = x[:, None], np.diff(breaks)[:, None, None]
    y = 1 - x
    ends = y**2 * (1 + 2 * x) * values[:-1, None] + x**2 * (1 + 2 * y) * values[1:, None]
    tangents = y**2 * x * slopes[:-1, None] - x**2 * y * slopes[1:, None]
    return np.asarray(ends + lengths * tangents).reshape(-1, values.shape[1])


def minimize_quadratic(slope: Array, square: float, rows: Array, slack: Array) -> Array:
    """Minimum of slope^T u + square u^T u subject to rows u + slack >= 0, for n problems in 2D.

    By enumeration of vertices, edges, interior and the feasible u = 0. Shapes of slope, rows and
    slack: (n, 2), (n, m, 2) and (n, m).
    """
    first, second = np.array(list(combinations(range(rows.shape[1]), 2))).T
    row, other = rows[:, first], rows[:, second]
    determinant = row[..., 0] * other[..., 1] - row[..., 1] * other[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        numerators = slack[:, first, None] * other - slack[:, second, None] * row
        u = np.stack([-numerators[..., 1], numerators[..., 0]], axis=-1) / determinant[..., None]
        if square:
            interior = (-slope / (2 * square))[:, None]
            excess = (np.einsum("nmj,noj->nm", rows, interior) + slack)[..., None]
            edges = interior - rows * excess / (rows**2).sum(axis=2, keepdims=True)
            u = np.concatenate([u, edges, interior], axis=1)
        distances = np.einsum("nmj,nuj->num", rows, u) + slack[:, None]
        value = np.einsum("nj,nuj->nu", slope, u) + square * (u**2).sum(axis=2)
    feasible = (distances >= -1e-9).all(axis=2) & np.isfinite(value)  # rounding
    return np.asarray(np.where(feasible, value, 0.0).min(axis=1, initial=0.0))


def distribute_halvings(errors: Sequence[Array], target: float) -> list[Numbers]:
    """Numbers of halvings, (K,) each, the largest error first, until errors sum up to `target`.

    Gains of better torques decrease with the square of the length.
    """
    remaining, halvings = np.concatenate(errors), np.zeros(sum(map(len, errors)), dtype=np.int64)
    mean = target / len(remaining)
    while remaining.sum() > target:
        worst = int(np.where(halvings < SETTINGS.halvings, remaining, 0.0).argmax())
        if halvings[worst] == SETTINGS.halvings or remaining[worst] <= mean:
            break
        remaining[worst] /= 4.0
        halvings[worst] += 1
    return np.split(halvings, np.cumsum([len(part) for part in errors])[:-1])
