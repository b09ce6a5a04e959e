"""Plans of phases in the time domain by direct collocation, from a list of initial guesses.

Phases joined in motion are one NLP. It is solved on few intervals from each guess in turn; mode
search and refinement follow. The README says which guesses are compared. Without a plan the elastic
problem (least violation of limits) gives another guess, or the reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain, groupby, islice, pairwise, takewhile
from operator import attrgetter
from typing import Any

import numpy as np

from ...common.arrays import Array
from ...common.errors import (
    InfeasibleError,
    Parameter,
    Shortfall,
    SolverError,
    WholearmError,
    name_phases,
)
from ...geometry.tracing import CostToGo
from ...mechanics.dynamics import measure_speed
from ...mechanics.impact import Impact, compute_impact
from ...problem.definition import End, Phase, Problem
from ...results.report import Transition
from ...results.trajectory import Motion
from ..explain import (
    Replan,
    change_limit,
    explain_stages,
    list_shortfalls,
    refuse,
    refuse_motors,
    refuse_paths,
    require_hold_at_ends,
)
from ..options import Objective, PlanOptions
from ..phase_plan import PER_SPEED, PhasePlan, Plans, end_of, make_transition, plan_stops, value_of
from .guesses import NEAREST_END, PROBLEM_MODES, REST_SPEED, Guess, Guesses, find_modes, list_stages
from .mode_search import (
    MIN_GAIN,
    MIN_INTERVALS,
    adapt_ends,
    change_ends,
    drop_stops,
    drop_vanished,
    improve,
    link,
    list_equivalent,
    list_neighbours,
    sign_sequence,
)
from .solution import COSTLY, ITERATIONS, TimeSearch, TimeSolution, refine_stages, tighten_to_ranges
from .stage import Scheme, Stage, resample, to_si
from .time_motion import TimeMotion, make_phase_motions

# Duration of a solution over that of its guess above which it may be another local optimum. Case: a
# pentagon, 0.369 s from the modes of a plan of 0.094 s (test of prescribed modes)
MAX_DURATION_RATIO = 1.2
OTHER_ENDS = 2  # most other modes at an end that are tried
_TINY = 1e-3  # duration over a period that counts as zero


def plan_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None = None,
    *,
    cost_to_go: CostToGo | None = None,
    saturation: float = math.inf,
    fastest: Sequence[PhasePlan[Motion]] = (),
    initial_plans: Sequence[PhasePlan[Motion]] = (),
    free_plans: Sequence[PhasePlan[Motion]] = (),
    coarse: bool = False,
    thorough: bool = True,
) -> list[PhasePlan[TimeMotion]]:
    """Plans of phases that are one NLP, from rest at `z` to rest.

    Parameters
    ----------
    phases, z : (5,)  all but the last phase end in motion
    duration : [s]    longest duration of all these phases, for `margin`
    cost_to_go        of the next phases, at a free end
    saturation : [N]  of the objective `margin`: the least normal force of other phases limits it
    fastest           time-optimal plans from `z`, as guess for `margin`; if phases follow, the plan
                      ends where these do
    initial_plans     coarse plans from nearly the same `z`, as guess
    free_plans        plans of the phases along curves or with free torques, as guess
    coarse            whether to plan on few intervals, without limits between points
    thorough          whether to try other guesses after the first one, and without a plan to look
                      for a change of the problem that makes one possible

    Raises
    ------
    InputError, InfeasibleError, SolverError  if a phase's contacts do not touch, its end cannot be
        reached, or there is no plan
    """
    search = TimeSearch(problem, options, phases, duration, cost_to_go, saturation, coarse)
    guesses = Guesses(search, z)
    solution: TimeSolution | None = None
    if initial_plans:
        first = initial_plans[0]
        guess = guesses.resume(first.attempt, list_stages(initial_plans))
        if first.complete or first.sequences > 1:  # its modes come from a mode search
            search.statistics.sequences = first.sequences
            search.statistics.complete = first.complete
            solution = solve_guesses(replace(search, modes_searched=True), [guess])
        else:
            solution = solve_guesses(search, [guess, guesses.nearest.by_homotopy()])
    stages, pinned = list_stages(fastest), phases[-1].index + 1 < len(problem.phases)

    def replan(parameter: Parameter, value: float) -> object:
        changed = change_limit(problem, parameter.key, value)
        block = [changed.phases[phase.index] for phase in phases]
        return plan_phases(changed, block, z, options.roughen(), thorough=False)

    replanner = replan if thorough else None
    if solution is None and free_plans:
        guess = guesses.from_plans(free_plans)
        if problem.scene.has_slow_motors or problem.scene.control_period:
            solution = limit_torques(search, guess.from_rest(), stages if pinned else [])
        else:
            solution = solve_guesses(search, [guess.from_rest()])
            # A plan that costs 0.1 % more is another local optimum. Case: a kite (0, 0), (80, 0),
            # (95, 40), (40, 85), (-10, 45) mm, 0.3 kg, of `wholearm new` that turns to edge 1. It
            # brakes before its impact, and takes 0.1600 for 0.1508 s.
            comparable = guess.is_rest_to_rest and search.goal is not Objective.MARGIN
            plans = list_plans(search, solution) if solution and comparable else []
            if solution and sum(p.value for p in plans) > 1.001 * sum(p.value for p in free_plans):
                other = solve_guesses(search, [guesses.nearest])
                solution = other if other and other.cost < solution.cost else solution
    if solution is None:
        candidates = iter([guesses.nearest])
        if thorough:
            others = guesses.on_more_intervals()
            candidates = chain(guesses.list_all(), _free_ends(search, guesses), others)
        if search.goal is Objective.MARGIN:
            candidates = _list_margin_guesses(search, candidates, stages, pinned, guesses.nearest)
        candidates = chain(guesses.list_problem_guesses(), candidates)
        refusal = partial(refuse, search, guesses.nearest.stages, replanner)
        solution = solve_guesses(search, candidates, refusal)
    if solution is None and _fits_duration(search, stages):
        raise SolverError(
            f"no plan for {name_phases(search.numbers)}: the solver did not converge for the "
            "largest margin, although the motion of least time keeps all limits; try another "
            "duration (--duration) or number of intervals per phase (--time-intervals)"
        )
    if solution is None:
        solution = _solve_elastic(search, guesses, replanner)
    plans = list_plans(search, solution)
    if problem.scene.control_period:
        names = "error", "sequences", "complete"
        return [
            plan._replace(unheld=other.value, **{name: getattr(other, name) for name in names})
            for plan, other in zip(plans, free_plans, strict=True)
        ]
    return plans


def limit_torques(search: TimeSearch, guess: Guess, fastest: Sequence[Stage]) -> TimeSolution:
    """Solution under motor limits and control periods, from a guess with free torques.

    It keeps the modes of the guess; for `margin` it ends where the stages `fastest` do, if any.
    """
    if fastest and search.goal is Objective.MARGIN:
        guess = guess.end_at(fastest[-1].guess.nodes[-1, 0], search.problem)
    if search.cost_to_go is not None:
        with suppress(WholearmError):
            search = replace(search, price=search.expand(guess.stages[-1].guess.nodes[-1, 0])[1])
    stages = drop_stops(guess.stages)
    if search.source.scene.has_slow_motors:
        solution = meet_motor_limits(search, stages)
        stages = solution.stages
    if search.source.scene.control_period:
        solution = hold_torques(search, stages)
    return solution._replace(attempt=guess.name)


def meet_motor_limits(search: TimeSearch, free_stages: Sequence[Stage]) -> TimeSolution:
    """Solution under rate limits and lag from one with free torques, by continuation in these.

    Case: phases 6 and 7 of query 0 have a plan only from that with motors 4 times as fast.

    Raises
    ------
    InfeasibleError  if the continuation does not reach the limits; it names those of the last plan
    """
    require_hold_at_ends(search, free_stages)
    plans, factors = list[tuple[float, TimeSearch, TimeSolution]](), list[float]()
    stages = adapted = adapt_ends(free_stages, search)

    def solve_relaxed(factor: float) -> bool:
        """Whether there is a solution with motors `factor` times as fast, from the last one."""
        nonlocal stages
        factors.append(factor)
        scene = search.source.scene.quicken(factor)
        relaxed = replace(search, source=replace(search.source, scene=scene))
        moved = link([stage.move_to(relaxed.problem.scene) for stage in stages])
        solution = relaxed.solve(moved, max_iter=80)
        if solution.success:
            plans.append((factor, relaxed, solution))
            stages = solution.stages
        return solution.success

    def refine_last() -> TimeSolution:
        return plans[-1][2] if search.coarse else refine_stages(search, plans[-1][2])

    # Cases of other modes at an end: phase 8 of query 24, where a contact rolls that slides slowly
    # with free torques, and phases 2 and 3 of query 0, where a contact slides back.
    for candidate in chain([adapted], islice(change_ends(adapted, search), OTHER_ENDS)):
        stages = [stage.stretch(1.3) for stage in candidate]
        if solve_relaxed(1.0) and (solution := refine_last()).success:
            return solution
    stages, step = [stage.stretch(1.3) for stage in adapted], 4.0
    if plans:
        solve_relaxed(step)
        # Case: the pentagon (0, 0), (90, 0), (100, 50), (60, 90), (0, 70) mm, 0.28 kg, of
        # `wholearm new` with 900 N m/s, phase 6 to edge 1.
        solve_relaxed(step**2)
    elif solve_relaxed(step) or solve_relaxed(step**2):
        while step > 1.1 and plans[-1][0] > 1:
            if not solve_relaxed(max(1.0, plans[-1][0] / step)):
                step = math.sqrt(step)
        if plans[-1][0] == 1 and (solution := refine_last()).success:
            return solution
    for factor, relaxed, solution in sorted(plans, key=lambda plan: plan[0]):
        coarse = replace(relaxed, options=relaxed.options.roughen())
        if factor > 1 and refine_stages(coarse, solution).success:
            break
    else:
        factor = math.inf
    scene = search.source.scene
    relaxed_scene = scene.quicken(factor) if math.isfinite(factor) else None
    attempt = f"motors {max(factors):g} times as quick"
    raise refuse_motors(scene, relaxed_scene, search.numbers, attempt=attempt)


def try_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    goal: Array | None = None,
    all_guesses: bool = False,
    single_guess: bool = False,
    stop_plans: Sequence[PhasePlan[TimeMotion]] = (),
) -> list[PhasePlan[TimeMotion]] | None:
    """Coarse plans of phases without a mode search; None without a plan.

    Parameters
    ----------
    goal : (5,)   end of the first, straight guess of a single phase; otherwise its nearest end
    all_guesses   whether the friction homotopy and the guesses after it are tried
    single_guess  whether to solve from one guess alone
    stop_plans    plans of the phases, each from rest to rest, as the only guess
    """
    coarse_options = replace(options, mode_search=False)
    search = TimeSearch(problem, coarse_options, phases, coarse=True)
    guesses = Guesses(search, z)
    candidates: Iterable[Guess] = guesses.list_all(goal)
    if stop_plans:
        candidates = [guesses.without_stops(stop_plans)]
    elif single_guess:
        # No substitute for a straight path that limits exclude.
        guess = guesses.nearest if goal is None else guesses.guess_straight(goal)
        candidates = [guess] if guess else []
    else:
        if not all_guesses:
            candidates = takewhile(lambda guess: not guess.homotopy, candidates)
        candidates = chain(candidates, _free_ends(search, guesses))
    # Many edges have no plan. From a plan with a stop query 10 takes 23 to 53 iterations.
    solution = solve_guesses(search, candidates, max_iter=60 if stop_plans else 35)
    if solution is None:
        return None
    # Of six stages of phase 3 of goal 19 of the corpus three vanish; from all six no plan is found.
    remaining = drop_vanished(search, solution)._replace(attempt=solution.attempt)
    first, *others = list_plans(search, remaining)
    return [first._replace(complete=not options.mode_search), *others]


def solve_guesses(
    search: TimeSearch,
    guesses: Iterable[Guess],
    refuse: Callable[[], None] | None = None,
    max_iter: int = ITERATIONS,
) -> TimeSolution | None:
    """The best refined solution from guesses that are tried in their order; None without one.

    If the guess to the nearest end fails, `refuse` may raise an error that says why. `max_iter` is
    the most solver iterations from a guess in its modes.
    """
    solutions, failures, has_homotopy = list[TimeSolution](), list[TimeSolution](), False
    for guess in guesses:
        if solutions and not guess.homotopy:
            continue
        has_homotopy |= guess.homotopy
        solution = solve_coarse(search, guess, max_iter)
        if solution.success and any(is_same(solution, other) for other in failures):
            continue
        if solution.success:
            solutions.append(solution)
        elif refuse and not solutions and guess.name == NEAREST_END:
            refuse()
        if solutions and (has_homotopy or not may_gain(search, guess, solution)):
            if best := _refine_best(search, solutions):
                return best
            failures, solutions = failures + solutions, []
    return _refine_best(search, solutions)


def solve_coarse(search: TimeSearch, guess: Guess, max_iter: int) -> TimeSolution:
    """Solve from a guess in its modes, in at most `max_iter` iterations, or in the homotopy's."""
    stages = guess.stages
    if guess.homotopy:
        solution = find_modes(search, stages)
        if not solution.success:
            return solution
        stages, max_iter = solution.stages, 80  # most iterations in modes of the homotopy
    solution = search.solve(stages, guess.previous, max_iter)
    if solution.success and solution.margin < -5e-7:  # rounding
        # Such a motion may be far from one whose normal forces reach epsilon.
        return solution._replace(success=False, status="the largest c_n is below epsilon")
    return solution._replace(attempt=guess.name)


def is_same(first: TimeSolution, second: TimeSolution) -> bool:
    """Whether two solutions have the same modes and, but for rounding, the same cost."""
    close = math.isclose(first.cost, second.cost, rel_tol=1e-6)
    return close and sign_sequence(first.stages) == sign_sequence(second.stages)


def may_gain(search: TimeSearch, guess: Guess, solution: TimeSolution) -> bool:
    """Whether other modes may be better, or a solution takes far longer than its guess."""
    if guess.name == PROBLEM_MODES:
        duration = sum(stage.guess.duration for stage in guess.stages)
        return search.goal is Objective.TIME and solution.cost > MAX_DURATION_RATIO * duration
    if not search.options.mode_search or search.modes_searched or search.is_saturated(solution):
        return False
    sequence = sign_sequence(solution.stages)
    return any(sign_sequence(other) != sequence for other in list_neighbours(search, solution))


def _refine_best(search: TimeSearch, solutions: Sequence[TimeSolution]) -> TimeSolution | None:
    """The best solution after refinement, in order of the coarse costs; None without one."""
    best: TimeSolution | None = None
    for solution in sorted(solutions, key=attrgetter("cost")):
        if best and best.cost < solution.cost:
            break
        refined = finish(search, solution)._replace(attempt=solution.attempt)
        if refined.success and (best is None or refined.cost < best.cost):
            best = refined
    return best


def finish(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Solution after mode search, choice of a free end, refinement and tightening to ranges."""
    improved = solution
    if search.options.mode_search and not (search.modes_searched or search.is_saturated(solution)):
        improved = improve(search, solution)
    search, coarse = choose_end(search, improved)
    if search.coarse:
        return coarse
    refined = refine_stages(search, coarse)
    if not refined.success and search.options.mode_search and refined.status != COSTLY:
        # Phase 2 of the route of query 10 has no solution in which a contact reverses without
        # sticking; phase 1 of that of query 91, and phase 5 of that of goal 45, have none in the
        # modes of the mode search.
        neighbours = list_equivalent(search, coarse, list_neighbours(search, coarse))
        candidates = chain(neighbours, [solution] * (improved is not solution))
        solutions = (refine_stages(search, candidate) for candidate in candidates)
        refined = next((solution for solution in solutions if solution.success), refined)
    if not refined.success:
        return refined
    reduced = drop_vanished(search, refined)
    if reduced is not refined:
        # Otherwise phase 3 of query 57 fails in its replay.
        reduced = refine_stages(search, reduced)
        if reduced.success and reduced.cost - refined.cost < MIN_GAIN * abs(refined.cost):
            refined = reduced
    return tighten_to_ranges(search, refined) if search.options.ranges else refined


def hold_torques(search: TimeSearch, free_stages: list[Stage]) -> TimeSolution:
    """Solution with torques held over control periods, from one with free torques.

    First all periods have the same unknown duration; this NLP is solved again until the number of
    prescribed periods that its motion takes stays. Then the periods get their duration, and the NLP
    shortens the last period of each phase.

    Raises
    ------
    InfeasibleError  if none is found; it names a shorter period with which there is a plan
    """
    scene = search.problem.scene
    search = replace(search, controls=2 if scene.control_hold == "linear" else 1)

    def solve(stages: list[Stage], period: float, stretch: float, equal: bool) -> TimeSolution:
        # Phases 2 to 4 of a pentagon take 70 at 2 ms. More than `ITERATIONS`, so that a failure is
        # solved again: queries 38 and 45 at 2 ms.
        stages = cut_periods(stages, search.scheme, period, stretch, equal)
        return search.solve(stages, max_iter=150 if equal else 80)

    def hold(period: float, attempts: int) -> TimeSolution | None:
        stages = free_stages
        if attempts > 1 and sum(count_periods(free_stages, period)) > 100:
            # A plan with doubled periods is feasible, too: phases 2 to 4 of a pentagon at 1 ms.
            doubled = hold(2 * period, attempts)
            stages = doubled.stages if doubled else free_stages
        for _ in range(4):  # most times that numbers of periods change
            solution = solve(stages, period, 1.0, equal=True)
            if not solution.success:
                break
            previous, stages = stages, solution.stages
            if count_periods(previous, period) == count_periods(stages, period):
                break
        stretch = 1.0
        for _ in range(attempts):  # durations
            solution = solve(stages, period, stretch, equal=False)
            while solution.success and (remaining := drop_periods(solution.stages)):
                reduced = search.solve(remaining, max_iter=ITERATIONS)
                if not reduced.success or reduced.cost > solution.cost:
                    break
                solution = reduced
            solution = refine_stages(search, solution) if solution.success else solution
            if solution.success:
                return solution
            stretch += max(0.02, period / sum(stage.guess.duration for stage in stages))
        return None

    if solution := hold(scene.control_period, 6):  # phase 3 of query 0 takes 5 at 5 ms
        return solution
    # A single attempt each: six take two minutes more for phase 5 of query 1, and fail, too.
    fraction = next((x for x in (0.5, 0.2) if hold(x * scene.control_period, 1)), None)
    scene = search.source.scene
    relaxed = replace(scene, control_period=fraction * scene.control_period) if fraction else None
    raise refuse_motors(scene, relaxed, search.numbers, attempt="a fifth of the period")


def drop_periods(stages: Sequence[Stage]) -> list[Stage]:
    """Stages without vanished last periods of phases; an empty list if there are none.

    Case: `triangle.toml` at 10 ms takes 1.5 % longer without it.
    """
    remaining, changed = list(stages), False
    for k, (stage, next_stage) in enumerate(zip(stages, [*stages[1:], None], strict=True)):
        is_last = next_stage is None or next_stage.phase != stage.phase
        part, count = stage.guess, stage.periods.index(stage.periods[-1])
        if is_last and count and part.h[count:].sum() < _TINY * stage.period:
            # The last remaining interval takes the end state of the stage.
            names = ("h", "z", "v", "a", "forces", "tau")
            tables = {name: getattr(part, name)[:count] for name in names}
            guess = part._replace(**tables, nodes=np.vstack([part.nodes[:count], part.nodes[-1:]]))
            remaining[k], changed = replace(stage, guess=guess, periods=stage.periods[:count]), True
    return remaining if changed else []


def count_periods(stages: Sequence[Stage], period: float) -> list[int]:
    """Number of periods of each phase; the last one may be shorter."""
    phases = groupby(stages, key=lambda stage: stage.phase)
    times = [sum(stage.guess.duration for stage in group) for _, group in phases]
    return [max(1, math.ceil(time / period - _TINY)) for time in times]


def cut_periods(
    stages: Sequence[Stage], scheme: Scheme, period: float, stretch: float, equal: bool
) -> list[Stage]:
    """Stages whose intervals are control periods or parts of them, stretched in time.

    The duration of periods is prescribed, or unknown but `equal`.
    """
    pieces, tol = list[Stage](), _TINY * period
    for stages_of_phase in (list(group) for _, group in groupby(stages, key=attrgetter("phase"))):
        start = 0.0
        for stage in stages_of_phase:
            stop = start + stretch * stage.guess.duration
            inside = stage is not stages_of_phase[-1]
            if inside and stage.ending_constraints and stop - start > period / 2:
                # Forces step there, as torques do between periods: phase 9 of query 28 has no plan
                # in which a rolling contact begins to slide within a period.
                stop = period * max(math.floor(start / period + 1 - _TINY), round(stop / period))
            ticks = period * np.arange(math.floor(start / period), math.ceil(stop / period) + 1)
            edges = np.array([start, *ticks[(ticks > start + tol) & (ticks < stop - tol)], stop])
            numbers = tuple(math.floor((a + b) / 2 / period) for a, b in pairwise(edges.tolist()))
            part = resample(stage.guess, scheme, (edges - start) / (stop - start))
            stretched = replace(stage, guess=part).stretch((stop - start) / stage.guess.duration)
            pieces.append(replace(stretched, periods=numbers, period=0.0 if equal else period))
            start = stop
    return pieces


def choose_end(search: TimeSearch, solution: TimeSolution) -> tuple[TimeSearch, TimeSolution]:
    """Solution with the cost-to-go of its end, expanded to first order while that gains.

    Also returns the search with the price of the last expansion.
    """
    best, least_cost = (search, solution), None
    if search.cost_to_go is None:
        return best
    for _ in range(4):  # most expansions of the cost-to-go
        try:
            value, price = search.expand(solution.end)
        except WholearmError:
            break
        total = solution.cost + value
        if search.price is not None:
            total -= float(search.price.gradient @ (solution.end - search.price.origin))
        if least_cost is not None and total > least_cost - 1e-4 * abs(least_cost):
            break
        least_cost, best = total, (search, solution)
        search = replace(search, price=price)
        solution = search.solve(solution.stages, solution)
        if not solution.success:
            break
    return best


def _list_margin_guesses(
    search: TimeSearch, guesses: Iterator[Guess], fastest: list[Stage], pinned: bool, first: Guess
) -> Iterator[Guess]:
    """Guesses for the largest margin, with time-optimal stages; `pinned` to the end of these.

    Phase 5 of `heptagon.toml` keeps 0.57 N instead of 0.68 N without the former.
    """
    if _fits_duration(search, fastest):
        # As many intervals as the first guess has.
        coarse = list[Stage]()
        count = sum(stage.intervals for stage in first.stages) / len({s.phase for s in fastest})
        for stage in fastest:
            phase = sum(other.guess.duration for other in fastest if other.phase == stage.phase)
            intervals = max(MIN_INTERVALS, round(count * stage.guess.duration / phase))
            breaks = np.linspace(0.0, 1.0, intervals + 1)
            coarse.append(replace(stage, guess=resample(stage.guess, search.scheme, breaks)))
        guesses = chain(islice(guesses, 1), [Guess("a motion of least time", coarse)], guesses)
    if not (pinned and fastest):
        return guesses
    end = fastest[-1].guess.nodes[-1, 0]
    return (guess.end_at(end, search.problem) for guess in guesses)


def _fits_duration(search: TimeSearch, stages: Sequence[Stage]) -> bool:
    """Whether there are stages and they take at most the longest duration."""
    duration = sum(stage.guess.duration for stage in stages) * search.source.scene.scales.time
    return bool(stages) and search.duration is not None and duration <= search.duration


def _free_ends(search: TimeSearch, guesses: Guesses) -> Iterator[Guess]:
    """Guess from a coarse plan with free ends, moved to the pinned ends.

    Goal 12 of the corpus takes 1.16 s instead of 0.68 s without it.
    """
    pinned = [phase.until.pins for phase in search.phases if phase.formation.n_constraints < 4]
    if not any(pinned):
        return
    free = tuple(replace(p, until=replace(p.until, pins=())) for p in search.source.phases)
    problem, phases = replace(search.source, phases=free), [free[p.index] for p in search.phases]
    free_search = replace(search, source=problem, phases=phases, cost_to_go=None, coarse=True)
    coarse = solve_guesses(free_search, Guesses(free_search, guesses.z).list_all())
    if coarse is None:
        return
    targets = search.problem.phases
    stages = [replace(s, goal=s.goal and targets[s.phase].until) for s in coarse.stages]
    solution = search.solve(link(stages), coarse, ITERATIONS)
    if solution.success:
        yield Guess("a plan that chooses where it ends", solution.stages, previous=solution)


def _solve_elastic(search: TimeSearch, guesses: Guesses, replan: Replan | None) -> TimeSolution:
    """Solution from a motion of least violation; without one, the error that says why."""
    infeasible, shortfalls = list[list[Stage]](), list[Shortfall]()
    soft = search.soften()
    for guess in chain([guesses.nearest], islice(guesses.to_other_ends(), 1)):
        elastic = soft.solve(guess.stages)
        shortfalls = list_shortfalls(search, elastic.stages)
        if elastic.success and not shortfalls:
            # Phase 3 of leg 21 has a plan from there with the torque limit that is advised.
            solution = solve_guesses(search, [guess._replace(stages=elastic.stages)])
            if solution is not None:
                return solution
        elif elastic.success:
            infeasible.append(elastic.stages)
    if not infeasible:
        refuse_paths(search, [margin for margin, _ in guesses.paths])
    raise explain_stages(search, infeasible, replan, shortfalls)


def list_plans(search: TimeSearch, solution: TimeSolution) -> list[PhasePlan[TimeMotion]]:
    """The plan of each phase."""
    problem, plans, statistics = search.source, list[PhasePlan[TimeMotion]](), search.statistics
    least_force = problem.epsilon + problem.scene.scales.force * solution.margin
    stages = [to_si(stage, problem) for stage in solution.stages]
    motions = make_phase_motions(stages, search.scheme)
    for phase, motion in zip(search.phases, motions, strict=True):
        value = value_of(search.options, motion.duration, motion.torque, least_force)
        of_phase = [stage for stage in solution.stages if stage.phase == phase.index]
        plan = PhasePlan(motion, motion.torque, value, attempt=solution.attempt, stages=of_phase)
        plans.append(plan._replace(error=solution.error))
    plans[0] = plans[0]._replace(sequences=statistics.sequences, complete=statistics.complete)
    return plans


def plan_with_impacts(
    problem: Problem,
    block: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None,
    **arguments: Any,
) -> Plans:
    """Plans of a block with the impacts that are possible, or else with stops.

    `arguments` of `plan_phases`; with impacts `saturation`, `fastest` and `free_plans` count.
    """
    ends = [k + 1 for k, phase in enumerate(block) if phase.end is End.IMPACT]
    if not ends:
        return [*plan_phases(problem, block, z, options, duration, **arguments)]
    fastest: Sequence[PhasePlan[Motion]] = arguments["fastest"]
    common = {name: arguments[name] for name in ("saturation", "free_plans")}
    direct = partial(plan_part, problem, block, **common)
    with_stops = partial(plan_stops, partial(direct, thorough=True), [0, *ends, len(block)], z)
    rest_speed = REST_SPEED * problem.scene.scales.speed
    speeds = [measure_speed(problem.scene, end_of(fastest[k - 1])[1]) for k in ends if fastest]
    if duration is not None and fastest and max(speeds) < rest_speed:
        # Without an impact in least time there is none in a longer duration.
        return with_stops(options, duration)
    # A duration that is too short with stops may be long enough without them.
    time_options = options.for_least_time()
    stops, failure = list[int](), None
    try:
        stop_plans = with_stops(options if duration is None else time_options)
        impacts = [_impact_at_stop(block[k - 1], block[k], stop_plans[k - 1]) for k in ends]
        stops = [k for k, impact in zip(ends, impacts, strict=True) if impact.violations]
    except (InfeasibleError, SolverError) as error:
        # A motion may pass a place where none comes to rest: phase 3 of new polygon 22.
        failure = error
    if len(stops) < len(ends):
        with suppress(InfeasibleError, SolverError):
            return plan_stops(direct, [0, *stops, len(block)], z, options, duration)
    if failure is not None:
        raise failure
    return stop_plans if duration is None else with_stops(options, duration)


def plan_part(
    problem: Problem,
    block: Sequence[Phase],
    start: int,
    stop: int,
    z: Array,
    options: PlanOptions,
    duration: float | None,
    free_plans: Sequence[PhasePlan[Motion]] = (),
    thorough: bool = False,
    **arguments: Any,
) -> Plans:
    """Plan phases `start` to `stop` of a block, without the latter, by `plan_phases`."""
    arguments |= {"free_plans": free_plans[start:stop], "thorough": thorough}
    return [*plan_phases(problem, block[start:stop], z, options, duration, **arguments)]


def list_impacts(block: Sequence[Phase], plans: Sequence[PhasePlan[Motion]]) -> list[Transition]:
    """The impacts of a block, passed at speed or with a stop."""
    transitions = []
    for k, (phase, plan) in enumerate(zip(block, plans, strict=True), start=1):
        if phase.end is not End.IMPACT:
            continue
        (z, v), scene, reason = end_of(plan), phase.formation.scene, ""
        speed = measure_speed(scene, v)
        if speed < REST_SPEED * scene.scales.speed:
            speed, impact = 0.0, _impact_at_stop(phase, block[k], plan)
            reason = "no plan passes it at speed"
            if impact.violations:
                reason = impact.violations[0].describe(PER_SPEED)
        else:
            impact = compute_impact(phase.formation, block[k].formation, z, v / speed)
        ratio = measure_speed(scene, impact.v)
        transitions.append(make_transition(phase, impact, ratio, reason, speed))
    return transitions


def _impact_at_stop(phase: Phase, following: Phase, plan: PhasePlan[Motion]) -> Impact:
    """The impact at unit speed in the direction in which a phase comes to rest."""
    v = plan.motion.evaluate(np.array([plan.motion.duration * (1 - 1e-3)])).z_dot[0]
    v = v / measure_speed(phase.formation.scene, v)
    return compute_impact(phase.formation, following.formation, end_of(plan)[0], v)
