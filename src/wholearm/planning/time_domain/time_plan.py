"""Plans of phases in the time domain by direct collocation, from a list of initial guesses.

Phases joined in motion are one NLP, first solved on few intervals from each guess in turn, then by
mode search and refinement; the README says which guesses are compared. Where none leads to a plan,
the elastic problem (least violation of limits) gives another guess, or the reason.
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
from .guesses import AT_REST, GIVEN, NEAREST, Guess, Guesses, find_modes, list_stages
from .mode_search import (
    LEAST_INTERVALS,
    WORTH,
    adapt_ends,
    change_ends,
    drop_gone,
    drop_stops,
    improve,
    link,
    list_as_good,
    list_neighbours,
    sign_sequence,
)
from .solution import COSTLY, ITERATIONS, TimeSearch, TimeSolution, keep_within, refine_stages
from .stage import Scheme, Stage, resample, to_si
from .time_motion import TimeMotion, make_phase_motions

# Ratio of durations of a solution and its guess above which it may be another local optimum. Case:
# a pentagon, 0.369 s from the modes of a plan of 0.094 s (the test of given modes)
SLOWER = 1.2
OTHER_ENDS = 2  # most other modes at an end that are tried
_BRIEF = 1e-3  # duration, over a period, that counts as zero


def plan_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None = None,
    *,
    to_go: CostToGo | None = None,
    ample: float = math.inf,
    fastest: Sequence[PhasePlan[Motion]] = (),
    begun: Sequence[PhasePlan[Motion]] = (),
    free: Sequence[PhasePlan[Motion]] = (),
    only_begin: bool = False,
    thorough: bool = True,
) -> list[PhasePlan[TimeMotion]]:
    """Plan phases that are one NLP, from rest at `z` to rest.

    Parameters
    ----------
    phases, z : (5,)  all but the last phase end in motion
    duration : [s]    longest duration of all these phases, for `margin`
    to_go             cost-to-go at a free end
    ample : [N]       saturation of the objective `margin`, as other phases keep less anyway
    fastest           time-optimal plans from `z`, as guess for `margin`: it ends where these do if
                      phases follow
    begun             coarse plans (`only_begin`) from nearly the same `z`, to start from
    free              plans of the phases along curves or with free torques, to start from
    only_begin        whether to find modes on few intervals alone, without limits between points
    thorough          whether to try other guesses than the first one, and without a plan to look
                      for a change of the problem that makes one possible

    Raises
    ------
    InputError, InfeasibleError, SolverError  if a phase's contacts do not touch, its end cannot be
        reached, or there is no plan
    """
    search = TimeSearch(problem, options, phases, duration, to_go, ample, only_begin)
    guesses = Guesses(search, z)
    solution: TimeSolution | None = None
    if begun:
        coarse, guess = begun[0], guesses.resume(begun[0].attempt, list_stages(begun))
        if coarse.complete or coarse.sequences > 1:  # in modes that have been searched
            search.tried.sequences, search.tried.complete = coarse.sequences, coarse.complete
            solution = solve_guesses(replace(search, searched=True), [guess])
        else:
            solution = solve_guesses(search, [guess, guesses.nearest.by_homotopy()])
    stages, pinned = list_stages(fastest), phases[-1].index + 1 < len(problem.phases)

    def replan(parameter: Parameter, value: float) -> object:
        other = change_limit(problem, parameter.key, value)
        same = [other.phases[phase.index] for phase in phases]
        return plan_phases(other, same, z, options.roughen(), thorough=False)

    explanation = replan if thorough else None
    if solution is None and free:
        guess = guesses.along(free)
        if problem.scene.has_slow_motors or problem.scene.control_period:
            solution = change_torques(search, guess.from_rest(), stages if pinned else [])
        else:
            solution = solve_guesses(search, [guess.from_rest()])
            # One that costs 0.1 % more is another local optimum: a kite (0, 0), (80, 0), (95, 40),
            # (40, 85), (-10, 45) mm, 0.3 kg, of `wholearm new` that turns to edge 1 brakes before
            # its impact, in 0.1600 for 0.1508 s.
            compares = guess.rests and search.goal is not Objective.MARGIN
            plans = list_plans(search, solution) if solution and compares else []
            if solution and sum(p.value for p in plans) > 1.001 * sum(p.value for p in free):
                other = solve_guesses(search, [guesses.nearest])
                solution = other if other and other.cost < solution.cost else solution
    if solution is None:
        listed = iter([guesses.nearest])
        if thorough:
            others = guesses.on_finer_intervals()
            listed = chain(guesses.every(), _free_ends(search, guesses), others)
        if search.goal is Objective.MARGIN:
            listed = _list_slow(search, listed, stages, pinned, guesses.nearest)
        listed = chain(guesses.list_given(), listed)
        why = partial(refuse, search, guesses.nearest.stages, explanation)
        solution = solve_guesses(search, listed, why)
    if solution is None and _can_last(search, stages):
        raise SolverError(
            f"no plan for {name_phases(search.numbers)}: the solver did not converge for the "
            "largest margin, although the motion of least time keeps all limits; try another "
            "duration (--duration) or number of intervals per phase (--time-intervals)"
        )
    if solution is None:
        solution = _solve_elastic(search, guesses, explanation)
    plans = list_plans(search, solution)
    if problem.scene.control_period:
        kept = "error", "sequences", "complete"
        return [
            plan._replace(unheld=other.value, **{name: getattr(other, name) for name in kept})
            for plan, other in zip(plans, free, strict=True)
        ]
    return plans


def change_torques(search: TimeSearch, guess: Guess, fastest: Sequence[Stage]) -> TimeSolution:
    """The plan with the torques that motors and control periods allow, from one with free torques.

    It keeps the modes of that, and for `margin` ends where the stages `fastest` do, if any.
    """
    last = guess.stages[-1]
    if fastest and search.goal is Objective.MARGIN:
        guess = guess.end_at(fastest[-1].guess.nodes[-1, 0], search.problem)
    if search.to_go is not None:
        with suppress(WholearmError):
            search = replace(search, price=search.expand(last.guess.nodes[-1, 0])[1])
    stages = drop_stops(guess.stages)
    if search.source.scene.has_slow_motors:
        solution = reach_motors(search, stages)
        stages = solution.stages
    if search.source.scene.control_period:
        solution = hold_torques(search, stages)
    return solution._replace(attempt=guess.name)


def reach_motors(search: TimeSearch, free: Sequence[Stage]) -> TimeSolution:
    """The plan with the limits of motors from one with free torques, by continuation in these.

    Case: phases 6 and 7 of query 0 have a plan from motors 4 times as quick alone.

    Raises
    ------
    InfeasibleError  if that does not lead to the limits; it names those of the last plan
    """
    require_hold_at_ends(search, free)
    plans, tried = list[tuple[float, TimeSearch, TimeSolution]](), list[float]()
    stages = own = adapt_ends(free, search)

    def reaches(factor: float) -> bool:
        """Whether there is a solution with motors so many times as quick, from the last one."""
        nonlocal stages
        tried.append(factor)
        scene = search.source.scene.quicken(factor)
        quick = replace(search, source=replace(search.source, scene=scene))
        moved = link([stage.move_to(quick.problem.scene) for stage in stages])
        solution = quick.solve(moved, most=80)
        if solution.success:
            plans.append((factor, quick, solution))
            stages = solution.stages
        return solution.success

    def refine_last() -> TimeSolution:
        return plans[-1][2] if search.only_begins else refine_stages(search, plans[-1][2])

    # Cases of other modes at an end: phase 8 of query 24, where a contact rolls that hardly slides
    # with free torques, and phases 2 and 3 of query 0, where one slides back.
    for candidate in chain([own], islice(change_ends(own, search), OTHER_ENDS)):
        stages = [stage.stretch(1.3) for stage in candidate]
        if reaches(1.0) and (solution := refine_last()).success:
            return solution
    stages, step = [stage.stretch(1.3) for stage in own], 4.0
    if plans:
        reaches(step)
        # Case: the pentagon (0, 0), (90, 0), (100, 50), (60, 90), (0, 70) mm, 0.28 kg, of
        # `wholearm new` with 900 N m/s, phase 6 to edge 1.
        reaches(step**2)
    elif reaches(step) or reaches(step**2):
        while step > 1.1 and plans[-1][0] > 1:
            if not reaches(max(1.0, plans[-1][0] / step)):
                step = math.sqrt(step)
        if plans[-1][0] == 1 and (solution := refine_last()).success:
            return solution
    for factor, quick, solution in sorted(plans, key=lambda plan: plan[0]):
        rough = replace(quick, options=quick.options.roughen())
        if factor > 1 and refine_stages(rough, solution).success:
            break
    else:
        factor = math.inf
    scene = search.source.scene
    quick_scene = scene.quicken(factor) if math.isfinite(factor) else None
    most = f"motors {max(tried):g} times as quick"
    raise refuse_motors(scene, quick_scene, search.numbers, tried=most)


def try_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    goal: Array | None = None,
    further: bool = False,
    single_guess: bool = False,
    stopped: Sequence[PhasePlan[TimeMotion]] = (),
) -> list[PhasePlan[TimeMotion]] | None:
    """Coarse plans of phases (`only_begin` of `plan_phases`), without a mode search or reasons.

    Parameters
    ----------
    goal : (5,)   end of the first, straight guess of a single phase; otherwise its nearest end
    further       whether guesses after the first ones are tried
    single_guess  whether to solve from one guess alone
    stopped       plans of the phases, each from rest to rest, as the only guess
    """
    rough = replace(options, mode_search=False)
    search = TimeSearch(problem, rough, phases, only_begins=True)
    guesses = Guesses(search, z)
    listed: Iterable[Guess] = guesses.every(goal)
    if stopped:
        listed = [guesses.without_stops(stopped)]
    elif single_guess:
        # The nearest end is another guess than a straight path that limits exclude.
        single = guesses.nearest if goal is None else guesses.straight(goal)
        listed = [single] if single else []
    else:
        if not further:
            listed = takewhile(lambda guess: not guess.homotopy, listed)
        listed = chain(listed, _free_ends(search, guesses))
    # Many edges have no plan. From one with a stop query 10 takes 23 to 53 iterations, by rounding.
    solution = solve_guesses(search, listed, most=60 if stopped else 35)
    if solution is None:
        return None
    # Of six stages of phase 3 of goal 19 of the corpus three have vanished; no plan is found from
    # all of them.
    left = drop_gone(search, solution)._replace(attempt=solution.attempt)
    first, *others = list_plans(search, left)
    return [first._replace(complete=not options.mode_search), *others]


def solve_guesses(
    search: TimeSearch,
    guesses: Iterable[Guess],
    refuse: Callable[[], None] | None = None,
    most: int = ITERATIONS,
) -> TimeSolution | None:
    """The best plan from guesses that are tried in their order; None without any.

    If the first ones fail, `refuse` may raise an error that says why. At most `most` solver
    iterations are made from each in its modes.
    """
    coarse, lost, compared = list[TimeSolution](), list[TimeSolution](), False
    for guess in guesses:
        if coarse and not guess.homotopy:
            continue
        compared |= guess.homotopy
        solution = solve_coarse(search, guess, most)
        if solution.success and any(is_same(solution, other) for other in lost):
            continue
        if solution.success:
            coarse.append(solution)
        elif refuse and not coarse and guess.name == NEAREST:
            refuse()
        if coarse and (compared or not may_gain(search, guess, solution)):
            if best := _refine_best(search, coarse):
                return best
            lost, coarse = lost + coarse, []
    return _refine_best(search, coarse)


def solve_coarse(search: TimeSearch, guess: Guess, most: int) -> TimeSolution:
    """Solve from a guess in its modes, by `most` iterations at most, or those of the homotopy."""
    stages = guess.stages
    if guess.homotopy:
        solution = find_modes(search, stages)
        if not solution.success:
            return solution
        stages, most = solution.stages, 80  # most iterations in modes of the homotopy
    solution = search.solve(stages, guess.before, most)
    if solution.success and solution.margin < -5e-7:  # rounding
        # A motion that presses too little may be far from one that presses enough.
        return solution._replace(success=False, status="the largest c_n is below epsilon")
    return solution._replace(attempt=guess.name)


def is_same(one: TimeSolution, other: TimeSolution) -> bool:
    """Whether two solutions are the same but for rounding: their cost and their modes."""
    close = math.isclose(one.cost, other.cost, rel_tol=1e-6)
    return close and sign_sequence(one.stages) == sign_sequence(other.stages)


def may_gain(search: TimeSearch, guess: Guess, solution: TimeSolution) -> bool:
    """Whether a solution suggests other contact modes, or in given ones takes far longer."""
    if guess.name == GIVEN:
        duration = sum(stage.guess.duration for stage in guess.stages)
        return search.goal is Objective.TIME and solution.cost > SLOWER * duration
    if not search.options.mode_search or search.searched or search.has_ample(solution):
        return False
    sequence = sign_sequence(solution.stages)
    return any(sign_sequence(moved) != sequence for moved in list_neighbours(search, solution))


def _refine_best(search: TimeSearch, coarse: Sequence[TimeSolution]) -> TimeSolution | None:
    """The best of refined solutions, of which those are left out whose coarse ones cost more."""
    best: TimeSolution | None = None
    for rough in sorted(coarse, key=attrgetter("cost")):
        if best and best.cost < rough.cost:
            break
        solution = finish(search, rough)._replace(attempt=rough.attempt)
        if solution.success and (best is None or solution.cost < best.cost):
            best = solution
    return best


def finish(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Search modes, choose a free end, refine, and hold torques over control periods."""
    searched = solution
    if search.options.mode_search and not (search.searched or search.has_ample(solution)):
        searched = improve(search, solution)
    search, coarse = choose_end(search, searched)
    if search.only_begins:
        return coarse
    refined = refine_stages(search, coarse)
    if not refined.success and search.options.mode_search and refined.status != COSTLY:
        # Phase 2 of the route of query 10 has no solution in which a contact turns back without
        # resting; phase 1 of that of query 91, and phase 5 of that of goal 45, none where the mode
        # search leads.
        neighbours = list_as_good(search, coarse, list_neighbours(search, coarse))
        others = chain(neighbours, [solution] * (searched is not solution))
        solutions = (refine_stages(search, other) for other in others)
        refined = next((solution for solution in solutions if solution.success), refined)
    if not refined.success:
        return refined
    fewer = drop_gone(search, refined)
    if fewer is not refined:
        # Phase 3 of query 57 does not hold in its replay otherwise.
        fewer = refine_stages(search, fewer)
        if fewer.success and fewer.cost - refined.cost < WORTH * abs(refined.cost):
            refined = fewer
    return keep_within(search, refined) if search.options.ranges else refined


def hold_torques(search: TimeSearch, free: list[Stage]) -> TimeSolution:
    """The plan with torques held over control periods, from one with free torques.

    How many periods each phase takes follows from the motion with as many periods of one duration
    that is free: that is solved again while it takes another number of given periods. The NLP then
    shortens the last period of each phase.

    Raises
    ------
    InfeasibleError  if none is found; it names a shorter period with which one is
    """
    scene = search.problem.scene
    controls = 2 if scene.control_hold == "linear" else 1
    held = replace(search, controls=controls)

    def solve(stages: list[Stage], period: float, stretch: float, equal: bool) -> TimeSolution:
        # Phases 2 to 4 of a pentagon take 70 at 2 ms. More than from a guess, so that a solve that
        # fails is made again: queries 38 and 45 at 2 ms.
        most = 150 if equal else 80
        return held.solve(cut_periods(stages, held.scheme, period, stretch, equal), most=most)

    def hold(period: float, most: int) -> TimeSolution | None:
        stages = free
        if most > 1 and sum(count_periods(free, period)) > 100:
            # A plan with periods twice as long is one with these: 2 to 4 of a pentagon at 1 ms.
            coarse = hold(2 * period, most)
            stages = coarse.stages if coarse else free
        for _ in range(4):  # most times that numbers of periods change
            solution = solve(stages, period, 1.0, equal=True)
            if not solution.success:
                break
            before, stages = stages, solution.stages
            if count_periods(before, period) == count_periods(stages, period):
                break
        stretch = 1.0
        for _ in range(most):  # durations
            solution = solve(stages, period, stretch, equal=False)
            while solution.success and (shorter := drop_periods(solution.stages)):
                fewer = held.solve(shorter, most=ITERATIONS)
                if not fewer.success or fewer.cost > solution.cost:
                    break
                solution = fewer
            solution = refine_stages(held, solution) if solution.success else solution
            if solution.success:
                return solution
            stretch += max(0.02, period / sum(stage.guess.duration for stage in stages))
        return None

    if solution := hold(scene.control_period, 6):  # phase 3 of query 0 takes 5 at 5 ms
        return solution
    # One duration each: six take two minutes more for phase 5 of query 1, and find nothing either.
    share = next((part for part in (0.5, 0.2) if hold(part * scene.control_period, 1)), None)
    scene = search.source.scene
    quick = replace(scene, control_period=share * scene.control_period) if share else None
    raise refuse_motors(scene, quick, search.numbers, tried="a fifth of the period")


def drop_periods(stages: Sequence[Stage]) -> list[Stage]:
    """Stages without the last periods of phases whose duration has vanished; none if none has.

    Case: `triangle.toml` at 10 ms takes 1.5 % longer without it.
    """
    dropped, changed = list(stages), False
    for k, (stage, coming) in enumerate(zip(stages, [*stages[1:], None], strict=True)):
        last = coming is None or coming.phase != stage.phase
        part, kept = stage.guess, stage.periods.index(stage.periods[-1])
        if last and kept and part.h[kept:].sum() < _BRIEF * stage.period:
            # The end of the interval before is that of the last.
            names = ("h", "z", "v", "a", "forces", "tau")
            tables = {name: getattr(part, name)[:kept] for name in names}
            guess = part._replace(**tables, nodes=np.vstack([part.nodes[:kept], part.nodes[-1:]]))
            dropped[k], changed = replace(stage, guess=guess, periods=stage.periods[:kept]), True
    return dropped if changed else []


def count_periods(stages: Sequence[Stage], period: float) -> list[int]:
    """How many periods each phase takes, the last of which may be shorter."""
    phases = groupby(stages, key=lambda stage: stage.phase)
    times = [sum(stage.guess.duration for stage in group) for _, group in phases]
    return [max(1, math.ceil(time / period - _BRIEF)) for time in times]


def cut_periods(
    stages: Sequence[Stage], scheme: Scheme, period: float, stretch: float, equal: bool
) -> list[Stage]:
    """Stages whose intervals are periods or parts of them, stretched in time.

    The duration of periods is then given, or only that they are `equal`.
    """
    cut, near = list[Stage](), _BRIEF * period
    for stages_of_phase in (list(group) for _, group in groupby(stages, key=attrgetter("phase"))):
        start = 0.0
        for stage in stages_of_phase:
            stop = start + stretch * stage.guess.duration
            within = stage is not stages_of_phase[-1]
            if within and stage.fading and stop - start > period / 2:
                # Forces step there, as torques do between periods: phase 9 of query 28 has no plan
                # in which a contact that rolls begins to slide within a period.
                stop = period * max(math.floor(start / period + 1 - _BRIEF), round(stop / period))
            ticks = period * np.arange(math.floor(start / period), math.ceil(stop / period) + 1)
            edges = np.array([start, *ticks[(ticks > start + near) & (ticks < stop - near)], stop])
            numbers = tuple(math.floor((a + b) / 2 / period) for a, b in pairwise(edges.tolist()))
            part = resample(stage.guess, scheme, (edges - start) / (stop - start))
            longer = replace(stage, guess=part).stretch((stop - start) / stage.guess.duration)
            cut.append(replace(longer, periods=numbers, period=0.0 if equal else period))
            start = stop
    return cut


def choose_end(search: TimeSearch, solution: TimeSolution) -> tuple[TimeSearch, TimeSolution]:
    """Add the cost-to-go at the end, expanded to first order, and solve again while that gains.

    Also returns the search with the price of the last end.
    """
    best, least = (search, solution), None
    if search.to_go is None:
        return best
    for _ in range(4):  # most expansions of the cost-to-go
        try:
            value, price = search.expand(solution.end)
        except WholearmError:
            break
        total = solution.cost + value
        if search.price is not None:
            total -= float(search.price.gradient @ (solution.end - search.price.origin))
        if least is not None and total > least - 1e-4 * abs(least):
            break
        least, best = total, (search, solution)
        search = replace(search, price=price)
        solution = search.solve(solution.stages, solution)
        if not solution.success:
            break
    return best


def _list_slow(
    search: TimeSearch, guesses: Iterator[Guess], fastest: list[Stage], pinned: bool, first: Guess
) -> Iterator[Guess]:
    """Guesses for the largest margin: time-optimal stages, and others, `pinned` to their end.

    Phase 5 of `heptagon.toml` keeps 0.57 N instead of 0.68 N without the former.
    """
    if _can_last(search, fastest):
        # On as few intervals as the first guess has.
        coarse = list[Stage]()
        count = sum(stage.intervals for stage in first.stages) / len({s.phase for s in fastest})
        for stage in fastest:
            phase = sum(each.guess.duration for each in fastest if each.phase == stage.phase)
            intervals = max(LEAST_INTERVALS, round(count * stage.guess.duration / phase))
            breaks = np.linspace(0.0, 1.0, intervals + 1)
            coarse.append(replace(stage, guess=resample(stage.guess, search.scheme, breaks)))
        guesses = chain(islice(guesses, 1), [Guess("a motion of least time", coarse)], guesses)
    if not (pinned and fastest):
        return guesses
    end = fastest[-1].guess.nodes[-1, 0]
    return (guess.end_at(end, search.problem) for guess in guesses)


def _can_last(search: TimeSearch, stages: Sequence[Stage]) -> bool:
    """Whether stages, if any, keep the longest duration."""
    lasts = sum(stage.guess.duration for stage in stages) * search.source.scene.scales.time
    return bool(stages) and search.duration is not None and lasts <= search.duration


def _free_ends(search: TimeSearch, guesses: Guesses) -> Iterator[Guess]:
    """A coarse plan that chooses where phases end, moved to where they are pinned.

    Goal 12 of the corpus takes 1.16 s instead of 0.68 s without it.
    """
    pinned = [phase.until.pins for phase in search.phases if phase.formation.n_constraints < 4]
    if not any(pinned):
        return
    free = tuple(replace(p, until=replace(p.until, pins=())) for p in search.source.phases)
    problem, phases = replace(search.source, phases=free), [free[p.index] for p in search.phases]
    free_search = replace(search, source=problem, phases=phases, to_go=None, only_begins=True)
    coarse = solve_guesses(free_search, Guesses(free_search, guesses.z).every())
    if coarse is None:
        return
    own = search.problem.phases
    stages = [replace(each, goal=each.goal and own[each.phase].until) for each in coarse.stages]
    moved = search.solve(link(stages), coarse, ITERATIONS)
    if moved.success:
        yield Guess("a plan that chooses where it ends", moved.stages, before=moved)


def _solve_elastic(search: TimeSearch, guesses: Guesses, replan: Replan | None) -> TimeSolution:
    """Plan from motions of least violation, or the error that says why there is none."""
    short, missed = list[list[Stage]](), list[Shortfall]()
    soft = search.soften()
    for guess in chain([guesses.nearest], islice(guesses.to_others(), 1)):
        elastic = soft.solve(guess.stages)
        missed = list_shortfalls(search, elastic.stages)
        if elastic.success and not missed:
            # Phase 3 of leg 21 has a plan from there with the torque limit that is advised.
            solution = solve_guesses(search, [guess._replace(stages=elastic.stages)])
            if solution is not None:
                return solution
        elif elastic.success:
            short.append(elastic.stages)
    if not short:
        refuse_paths(search, [margin for margin, _ in guesses.paths])
    raise explain_stages(search, short, replan, missed)


def list_plans(search: TimeSearch, solution: TimeSolution) -> list[PhasePlan[TimeMotion]]:
    """The plan of each phase."""
    problem, plans, first = search.source, list[PhasePlan[TimeMotion]](), search.tried
    least = problem.epsilon + problem.scene.scales.force * solution.margin
    stages = [to_si(stage, problem) for stage in solution.stages]
    motions = make_phase_motions(stages, search.scheme)
    for phase, motion in zip(search.phases, motions, strict=True):
        value = value_of(search.options, motion.duration, motion.torque, least)
        of_phase = [stage for stage in solution.stages if stage.phase == phase.index]
        plan = PhasePlan(motion, motion.torque, value, attempt=solution.attempt, stages=of_phase)
        plans.append(plan._replace(error=solution.error))
    plans[0] = plans[0]._replace(sequences=first.sequences, complete=first.complete)
    return plans


def plan_with_impacts(
    problem: Problem,
    block: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None,
    **given: Any,
) -> Plans:
    """Plan a block with the impacts that are possible, or else with stops.

    The arguments are those of `plan_phases`; with impacts `ample`, `fastest` and `free` count.
    """
    ends = [k + 1 for k, phase in enumerate(block) if phase.end is End.IMPACT]
    if not ends:
        return [*plan_phases(problem, block, z, options, duration, **given)]
    fastest: Sequence[PhasePlan[Motion]] = given["fastest"]
    direct = partial(plan_part, problem, block, ample=given["ample"], free=given["free"])
    thorough = partial(direct, thorough=True)
    with_stops = partial(plan_stops, thorough, [0, *ends, len(block)], z)
    slow = AT_REST * problem.scene.scales.speed
    speeds = [measure_speed(problem.scene, end_of(fastest[k - 1])[1]) for k in ends if fastest]
    if duration is not None and fastest and max(speeds) < slow:
        # Without an impact in least time there is none in a longer duration.
        return with_stops(options, duration)
    # A duration that is too short for stops need not be so without them.
    fast = replace(options, objective=Objective.TIME, duration=None)
    blocked, failure = list[int](), None
    try:
        stopped = with_stops(options if duration is None else fast)
        impacts = [_impact_at_stop(block[k - 1], block[k], stopped[k - 1]) for k in ends]
        blocked = [k for k, impact in zip(ends, impacts, strict=True) if impact.violations]
    except (InfeasibleError, SolverError) as error:
        # No motion may come to rest where one passes at speed: phase 3 of new polygon 22.
        failure = error
    if len(blocked) < len(ends):
        with suppress(InfeasibleError, SolverError):
            return plan_stops(direct, [0, *blocked, len(block)], z, options, duration)
    if failure is not None:
        raise failure
    return stopped if duration is None else with_stops(options, duration)


def plan_part(
    problem: Problem,
    block: Sequence[Phase],
    start: int,
    stop: int,
    *given: Any,
    free: Sequence[PhasePlan[Motion]] = (),
    thorough: bool = False,
    **others: Any,
) -> Plans:
    """Plan phases `start` to `stop` of a block, without the latter; as of `plan_phases`."""
    phases, others = block[start:stop], others | {"free": free[start:stop], "thorough": thorough}
    return [*plan_phases(problem, phases, *given, **others)]


def list_impacts(block: Sequence[Phase], plans: Sequence[PhasePlan[Motion]]) -> list[Transition]:
    """The impacts of a block, at speed or with a stop."""
    transitions = []
    for k, (phase, plan) in enumerate(zip(block, plans, strict=True), start=1):
        if phase.end is not End.IMPACT:
            continue
        (z, v), scene, reason = end_of(plan), phase.formation.scene, ""
        speed = measure_speed(scene, v)
        if speed < AT_REST * scene.scales.speed:
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
    """The impact for unit speed in the direction in which a phase comes to its stop."""
    v = plan.motion.evaluate(np.array([plan.motion.duration * (1 - 1e-3)])).z_dot[0]
    v = v / measure_speed(phase.formation.scene, v)
    return compute_impact(phase.formation, following.formation, end_of(plan)[0], v)
