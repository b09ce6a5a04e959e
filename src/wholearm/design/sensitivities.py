"""Derivatives of the value of a plan with respect to every number of its problem.

**By multipliers.** At a solution the derivative of the value is the partial derivative of the
Lagrangian (envelope theorem). The NLP of every block is built again for p + h and for p - h on the
same mesh, and its Lagrangian evaluated at the plan's unknowns and multipliers: no solve, hence no
noise of meshes. Curves are traced anew, as they depend on shapes and bases, and elements move with
the switches of the minimum-time profile: a switch that moves inside an element changes the error of
the NLP's value to first order, though that error is small itself. A block over time with
a free end is solved with the gradient of the later Lagrangians as the price of its end, so that all
blocks together are stationary.

**By differences** of solved problems if a plan is not a solution of NLPs alone: the objective
margin, rate-limited or held torques, ranges, impacts over time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import numpy as np

from ..common.arrays import Array
from ..common.document import Document, Result, Table, fixed
from ..common.errors import InputError, SolverError, WholearmError
from ..common.parallel import run_tasks
from ..common.sharing import exclusive
from ..geometry.curve import Curve
from ..geometry.tracing import trace_phase, trace_phases
from ..mechanics.dynamics import find_freedoms, metric_weights
from ..mechanics.limits import LimitSet
from ..planning.blocks import BlockPlan, ImpactSequence, Planning, plan_blocks
from ..planning.options import Objective, PlanOptions
from ..planning.path_domain import path_data, path_motion, path_plan
from ..planning.path_domain.path_mesh import find_ends
from ..planning.phase_plan import combine
from ..planning.result import UNITS
from ..planning.time_domain import solution, stage, time_nlp
from ..planning.time_domain.guesses import list_stages
from ..problem.definition import End, Problem
from ..problem.read import require_phases
from ..search import solve as solve_any
from ..simulation.modes import require_closed
from .sweep import Parameter, find_parameter, list_parameters, name_limit

Terms = list[tuple[str, str, float]]
"""Terms of a Lagrangian, or of a value: phases, limit, amount."""
Evaluate = Callable[[Problem, Array], tuple[Terms, Array]]
"""Terms of blocks for another problem from a start (5,), and their last configuration (5,)."""
# Name of a method, its relative change of a number, the terms without a change, its function
Method = tuple[str, float, Terms, Evaluate]
ACCURACY = 1e-6  # of the plans: at 1e-4 the derivative by friction_palm of heptagon is 2 % off
STEP, WIDE_STEP = 1e-4, 2.5e-3  # relative changes of a number, for Lagrangians and solved problems
LEAST_SIZE = 1e-2  # least magnitude of a number for its relative change, over the scene's unit
PATH = "length of the path"


@dataclass(frozen=True)
class Sensitivity:
    """Derivative of the value of a plan by one number."""

    derived = ("percent",)

    name: str
    given: float  # the number
    unit: str
    derivative: float  # of the value; NaN if neither side has a plan
    phases: tuple[float, ...]  # that of each part of the plan
    limit: str  # limit with the largest term; empty if unknown
    method: str  # {"multipliers", "differences"}
    note: str = ""  # reason of a one-sided derivative
    error: float = 0.0  # of the derivative, by the estimated errors of plans, for differences

    @property
    def percent(self) -> float:
        """Change of the value by 1 % more of the number, to first order."""
        return 0.01 * self.given * self.derivative


@dataclass(frozen=True, repr=False)
class Sensitivities(Result):
    """Sensitivities of a plan, in descending order of the effect of 1 %."""

    problem: str
    objective: str
    value: float
    unit: str
    parts: tuple[str, ...]  # numbers of the phases of each part
    rows: tuple[Sensitivity, ...]

    @property
    def document(self) -> Document:
        """A ranked table, reasons of one-sided derivatives, and derivatives within errors."""
        least = fixed(max((abs(row.percent) for row in self.rows), default=0.0), 4)
        heads = ["number", "value:.6g", "", f"d({self.objective})/d(number):.4g"]
        heads += [f"1 % more [{self.unit}]:{least}", "acts through", "by"]
        heads += [f"phase {part}:{least}" for part in self.parts]
        rows = [
            [row.name, row.given, row.unit, row.derivative, row.percent, row.limit or "-"]
            + [row.method + " (one-sided)" * bool(row.note)]
            + [0.01 * row.given * slope for slope in row.phases]
            for row in self.rows
        ]
        notes = [f"{row.name}: {row.note}" for row in self.rows if row.note]
        unsure = [row.name for row in self.rows if row.error > abs(row.derivative)]
        if unsure:
            notes.append(f"within the errors of the plans: {', '.join(unsure)}")
        title = f"{self.problem}: {self.objective} = {self.value:.6g} {self.unit}"
        return Document(title, parts=[Table(heads, rows), *notes])


def _charge(multipliers: Array, values: Array, low: Array, high: Array) -> Array:
    """Multipliers times the distances of values from their active bounds."""
    active = np.where(multipliers > 0, high, low)
    return np.where(np.isfinite(active), multipliers * (values - np.nan_to_num(active)), 0.0)


def _name_rows(limits: LimitSet) -> list[str]:
    return [name_limit(limits.limits[k].text) for k in limits.owners]


def _name_phases(numbers: Sequence[int]) -> str:
    return "-".join(dict.fromkeys(map(str, (numbers[0], numbers[-1]))))


def use_curves(planning: Planning, block: BlockPlan) -> Evaluate:
    """The Lagrangians of a block along curves, one for each part from rest to rest.

    SolverError if the block's plan is not the solution of these NLPs.
    """
    assert block.chain is not None
    iterates, marks = list[path_plan.PathIterate](), list[list[Array]]()
    for part in block.chain.split():
        task = part.make_task(planning.problem.epsilon, planning.options)
        iterates.append(path_plan.plan_task(task))
        marks.append(_find_marks(task))
    value = sum(iterate.objective for iterate in iterates)
    if abs(value - sum(plan.value for plan in block.plans)) > 1e-9 * value:
        raise SolverError("the start is one that friction cannot hold")

    def evaluate(problem: Problem, z: Array) -> tuple[Terms, Array]:
        phases = [problem.phases[phase.index] for phase in block.phases]
        curves, terms = list[Curve](), list[tuple[str, str, float]]()
        for phase in phases:
            curves.append(trace_phase(phase, z, problem.phases[phase.index + 1 :]))
            z = curves[-1].end
        parts = ImpactSequence(phases, curves).split()
        for iterate, old, part in zip(iterates, marks, parts, strict=True):
            changed = replace(iterate.task, curves=part.continuous_curves, epsilon=problem.epsilon)
            terms += _evaluate_path(iterate, old, changed)
        return terms, z

    return evaluate


def _find_marks(task: path_plan.Task) -> list[Array]:
    """Ends of each curve, its reversals, and for least time switches of the sweep [m]."""
    breaks = [np.zeros(0)] * len(task.curves)
    if task.options.goal is Objective.TIME and (fastest := task.find_fastest()):
        breaks = task.locate_switches(fastest)
    return list(map(find_ends, task.curves, breaks))


def _evaluate_path(
    iterate: path_plan.PathIterate, marks: Sequence[Array], task: path_plan.Task
) -> Terms:
    """Terms of a solution with `marks` for another task, on elements between the same ones."""
    nlp, units = iterate.nlp, iterate.units
    parts = list[path_data.PhaseData]()
    last = len(task.curves) - 1
    pairs = zip(marks, _find_marks(task), strict=True)
    for k, (part, (old, new)) in enumerate(zip(iterate.parts, pairs, strict=True)):
        curve, phase = task.curves[k], task.phases[k]
        if len(old) != len(new):
            raise SolverError(f"in phase {phase} a reversal or a switch comes or goes")
        edges, grid = np.interp(part.grid.edges, old, new), part.grid
        segment = grid.segment[:: path_motion.NODES]
        new_grid = path_motion.lay_out(edges, segment, (k == 0, k == last), task.is_held)
        parts.append(path_data.prepare(curve, task.epsilon, new_grid, phase))
    changed = replace(iterate, parts=parts)
    data = changed.data
    x, p, bounds = iterate.pack(), changed.find_parameters(), changed.make_bounds()
    f, g = (nlp.solver.function.get_function(f"nlp_{name}")(x, p).full()[:, 0] for name in "fg")
    terms_x = _charge(iterate.multipliers["lam_x0"], x, bounds["lbx"], bounds["ubx"])
    terms_g = _charge(iterate.multipliers["lam_g0"], g, bounds["lbg"], bounds["ubg"])
    unit = units.time * (units.power if task.options.goal is Objective.EFFORT else 1.0)
    limits = terms_g[nlp.g["limits"]].reshape(len(data.grid.s), -1).sum(axis=0).tolist()
    speeds = " and ".join(limit.parameter.name for limit in data.speeds.limits)
    terms = [*zip(_name_rows(data.limits), limits, strict=True), (speeds or PATH, terms_x.sum())]
    terms.append((PATH, f[0] + terms_g.sum() - sum(limits)))
    name = _name_phases(task.phases)
    return [(name, limit, unit * float(value)) for limit, value in terms]


def use_time(planning: Planning, block: BlockPlan, price: Array | None) -> Evaluate:
    """The Lagrangian of a block in the time domain, with the price of its end, (5,) in SI units.

    Terms without a limit, as of equations of motion, are added to the limit with the largest
    multipliers. SolverError if its NLP has no solution with that price.
    """
    options, scales = planning.options, planning.problem.scene.scales
    search = solution.TimeSearch(planning.problem, options)
    if price is not None:
        gradient = price * stage.unit_lengths(scales) / stage.unit_of(options.goal, scales)
        search.price = solution.Price(gradient, block.end / stage.unit_lengths(scales))
    solved = search.solve(list_stages(block.plans))
    if not solved.success:
        raise SolverError(solved.status)
    mul_x, mul_g = (solved.multipliers[key] for key in ("lam_x0", "lam_g0"))
    points = [each.guess for each in solved.stages]
    name = _name_phases([phase.number for phase in block.phases])

    def sum_by_limit(nlp: time_nlp.TimeNLP, of_x: Array, of_g: Array) -> dict[str, float]:
        """Sum of terms over the rows and unknowns of each limit."""
        sums = dict[str, float]()
        for rows in nlp.rows_of:
            names, sides = _name_rows(rows.limits), rows.limits.sides[0]
            for side, on_rows, indices in rows.parts:
                name, value = names[sides[side]], float((of_g if on_rows else of_x)[indices].sum())
                sums[name] = sums.get(name, 0.0) + value
        return sums

    costs = sum_by_limit(solved.nlp, np.abs(mul_x), np.abs(mul_g))
    costliest = max(costs, key=lambda limit: costs[limit])

    def evaluate(problem: Problem, z: Array) -> tuple[Terms, Array]:
        scaled, scales = stage.in_scene_units(problem), problem.scene.scales
        stages = [_adopt(each, scaled) for each in solved.stages]
        nodes = points[0].nodes.copy()
        nodes[0, 0] = z / stage.unit_lengths(scales)
        stages[0] = replace(stages[0], guess=points[0]._replace(nodes=nodes))
        changed = solution.TimeSearch(problem, options)
        nlp = changed.build(stages)
        relaxations = [stage.LimitViolations.none(each) for each in stages]
        bounds, bounds_g = time_nlp.find_bounds(nlp, stages, changed.scheme, relaxations)
        x, parts = time_nlp.pack(points, nlp.layouts, 0.0), nlp.assembled[0]
        # Without a price of the end.
        f, g = ca.Function("fg", [parts[k] for k in "xp"], [parts[k] for k in "fg"])(x, 0)
        of_x, of_g = _charge(mul_x, x, *bounds), _charge(mul_g, g.full()[:, 0], *bounds_g)
        sums, unit = sum_by_limit(nlp, of_x, of_g), stage.unit_of(options.goal, scales)
        sums[costliest] += float(f) + float(of_x.sum() + of_g.sum()) - sum(sums.values())
        terms = [(name, limit, unit * value) for limit, value in sums.items()]
        return terms, points[-1].nodes[-1, 0] * stage.unit_lengths(scales)

    return evaluate


def _adopt(part: stage.Stage, new: Problem) -> stage.Stage:
    """A stage in the scene of a problem, in the scene's units."""
    until, approach = new.phases[part.phase].until, part.approach
    if approach is not None and until.value is not None:
        approach = approach[0], until.value, approach[2]
    part = replace(part.move_to(new.scene), until=part.until and until, approach=approach)
    if (other := part.next_formation) is not None:
        part = replace(part, next_formation=stage.make_formation(new.scene, *other.equations[1:]))
    return part


def find_lagrangian(planning: Planning) -> Evaluate:
    """The Lagrangian of all blocks of a plan; SolverError if multipliers are not sufficient."""
    problem, options, scene = planning.problem, planning.options, planning.problem.scene
    rate_limited = scene.has_slow_motors or scene.control_period
    if options.goal is Objective.MARGIN or options.ranges or rate_limited:
        raise SolverError("plans of this kind are no solution of NLPs by themselves")
    evaluators = list[tuple[int, Evaluate]]()  # first phase of each block, from the last one on

    def evaluate(problem: Problem, z: Array) -> tuple[Terms, Array]:
        terms: Terms = []
        for index, evaluate_block in reversed(evaluators):
            z = require_closed(problem.phases[index].formation, z)
            block_terms, z = evaluate_block(problem, z)
            terms += block_terms
        return terms, z

    for block in reversed(planning.blocks):
        if block.chain is not None:
            evaluators.append((block.phases[0].index, use_curves(planning, block)))
            continue
        if any(phase.end is End.IMPACT for phase in block.phases):
            raise SolverError("impacts over time may be stops")
        price = None
        if evaluators:
            formation, h = problem.phases[evaluators[-1][0]].formation, STEP * scene.scales.length
            price, metric = np.zeros(5), metric_weights(scene)
            P = formation.evaluate(block.end[None], np.zeros((1, 5))).P[0]
            for d in find_freedoms(P, metric, 1e-9).T:
                ends = [block.end + sign * h * d for sign in (1, -1)]
                high, low = (sum(term[2] for term in evaluate(problem, end)[0]) for end in ends)
                price += (high - low) / (2 * h) * metric * d
        evaluators.append((block.phases[0].index, use_time(planning, block, price)))
    return evaluate


@exclusive
def find_sensitivities(
    problem: Problem,
    options: PlanOptions | None = None,
    names: Sequence[str] = (),
    jobs: int | None = None,
    progress: Callable[[str], None] = lambda text: None,
    multipliers: bool = True,
) -> Sensitivities:
    """Derivatives of the value of a problem's plan with respect to its numbers.

    With a goal the phases are those of the best route.

    Parameters
    ----------
    options      of the plan, whose accuracy is `ACCURACY` or better
    names        of numbers; all but the corners of the object, if left out
    jobs         processes; as many as cores if left out
    multipliers  whether to use multipliers if possible, or differences alone

    InputError if the problem has no single number of a name; InfeasibleError, SolverError if the
    problem itself has no plan.
    """
    options = options or PlanOptions()
    options = replace(options, accuracy=min(options.accuracy, ACCURACY))
    options = options.scale_ranges(problem.ranges)
    if problem.scene.control_period:
        options = replace(options, transcription="time")
    if problem.goals:
        progress("finding a route")
        problem = solve_any(problem, options.goal.value).problem
    require_phases(problem)
    parameters = [find_parameter(problem, name, "--of") for name in names]
    for parameter in parameters:
        if math.isnan(parameter.value):
            text = "is no single number here: left out, a share, or different for each finger"
            raise InputError(problem.source, f"--of {parameter.name}", text)
    if not names:
        parameters = [p for p in list_parameters(problem) if "vertices" not in p.name]
    progress("planning")
    planning, goal = plan_blocks(problem, trace_phases(problem), options, progress), options.goal

    names_of = {phase.number: str(phase.number) for phase in problem.phases}

    def list_values(planning: Planning) -> Terms:
        return [(names_of[k], "", plan.value) for k, plan in enumerate(planning.plans, 1)]

    def solve(changed: Problem, _: Array) -> tuple[Terms, Array]:
        planning = plan_blocks(changed, trace_phases(changed), options, lambda text: None)
        return list_values(planning), problem.start

    methods, nominal = list[Method](), list_values(planning)
    with suppress(SolverError):
        if multipliers:
            evaluate = find_lagrangian(planning)
            nominal = evaluate(problem, problem.start)[0]
            methods.append(("multipliers", STEP, nominal, evaluate))
    parts = tuple(dict.fromkeys(part for part, *_ in nominal))
    for part in parts:
        first, last = (int(part.split("-")[end]) for end in (0, -1))
        names_of |= dict.fromkeys(range(first, last + 1), part)
    methods.append(("differences", WIDE_STEP, list_values(planning), solve))
    progress(f"{len(parameters)} numbers")
    error = max(plan.error for plan in planning.plans)
    tasks = [partial(_find_one, problem, goal, parts, methods, error, p) for p in parameters]
    rows = run_tasks(tasks, jobs)
    rows.sort(key=lambda row: -abs(row.percent) if math.isfinite(row.percent) else 0.0)
    value = combine(goal, [plan.value for plan in planning.plans])
    return Sensitivities(problem.name, goal.value, value, UNITS[goal], parts, tuple(rows))


def _find_one(
    problem: Problem,
    goal: Objective,
    parts: Sequence[str],
    methods: Sequence[Method],
    plan_error: float,
    p: Parameter,
) -> Sensitivity:
    """The sensitivity to one number, by the first method that can evaluate one of its sides.

    `plan_error` is the largest estimated relative error of the value.
    """
    size, failure = max(abs(p.value), LEAST_SIZE * p.scale), ""
    values_of = p.name, p.value, p.unit
    for method, step, nominal, evaluate in methods:
        sides, note = list[tuple[float, Terms]](), ""
        for change, text in ((step, "with less only: "), (-step, "with more only: ")):
            try:
                changed = problem.with_({p.name: p.value + change * size})
                sides.append((change * size, evaluate(changed, changed.start)[0]))
            except (WholearmError, ValueError) as error:
                note, failure = f"{text}{error}", str(error)
        if not sides:
            continue
        sides.append((0.0, nominal))
        values = [
            [sum(v for part, _, v in terms if part == name) for name in parts] for _, terms in sides
        ]
        totals = [combine(goal, part_values) for part_values in values]
        if not note:
            rise, fall = totals[0] - totals[2], totals[2] - totals[1]
            # A kink or a turning point, larger than the errors of plans.
            if abs(rise - fall) > max(abs(rise) / 2, abs(fall) / 2, 10 * ACCURACY * abs(totals[2])):
                note = f"with more only: with less the derivative is {fall / (step * size):.4g}"
        k = -1 if note else 1
        (high, terms_high), (low, terms_low) = sides[0], sides[k]
        slope = (totals[0] - totals[k]) / (high - low)
        slopes = ((np.array(values[0]) - values[k]) / (high - low)).tolist()
        effects = dict[str, float]()
        for sign, terms in ((1, terms_high), (-1, terms_low)):
            for _, limit, value in terms:
                effects[limit] = effects.get(limit, 0.0) + sign * value
        limit = max(effects, key=lambda name: abs(effects[name])) if any(slopes) else ""
        uncertainty = plan_error * abs(totals[2] / (high - low)) if method == "differences" else 0.0
        return Sensitivity(*values_of, slope, tuple(slopes), limit, method, note, uncertainty)
    note = f"neither with more nor with less: {failure}"
    return Sensitivity(*values_of, math.nan, (math.nan,) * len(parts), "", methods[-1][0], note)
