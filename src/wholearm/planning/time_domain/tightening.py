"""Mesh refinement of a solution, and limits between collocation points.

Intervals are halved until the relative cost of missed limits plus the gain of torques of any shape,
by the minimum principle with the costates of the solution, is below the accuracy, and until
collocation errors are small. Limits still missed between points are then tightened.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, find_minima
from ...mechanics.limits import PRESS, LimitSet, make_limits
from ..options import Objective
from .collocation import Scheme
from .equations import least_senses, price_sides
from .intersample import (
    CHECKS,
    GRAZE,
    CheckPlaces,
    IntersampleLimits,
    Raised,
    check_between,
    find_misses,
)
from .search import TimeSearch, TimeSolution
from .stage import Stage, bisect_intervals, monitor
from .time_motion import MotionResponse, StageMotion, make_motions

DEFECT = 2e-8  # largest collocation error of z and z' in an interval, in the scene's own units
DEAR = 1e-5  # largest relative cost of raised limits in an interval
AT_ONCE = 2  # most times that an interval is halved at once
_LESS = 4.0  # reduction by a halving of the gain of better torques
_CHEAPER = 3  # power of two of the reduction of the cost of missed limits
_PLACES = 7  # Gauss points of an interval at which torques are compared
_HELD = 3.0  # rate over the least one below which that bound is active
_CLOSE = 1e-6  # gap over the radius of gyration below which its limit is active
_STEP = 1e-6  # step of z for slopes of gaps, over accelerations of a torque of 1
_ROUNDING = 1e-9  # largest miss of a limit that counts as none, over its scale
ROUNDS = 24  # most iterates
STALLED = 5  # iterates of tightening that have to reduce misses to `_CREEPS` of what they were
_CREEPS = 0.3
REFINEMENTS = 8  # most refinements of the mesh because of misses
MOST = 64  # most intervals of a phase at the default accuracy, prop. to the root of its inverse
_BEYOND = 2  # largest number of intervals because of misses, over that
_USUAL = 1e-4  # default accuracy
_SPARE = 0.5  # error after a refinement, over the accuracy
PATIENCE = 80  # most solver iterations on finer intervals
_VAGUE = 20.0
"""Error over the accuracy above which a failure on finer intervals rejects the coarse plan: only
they show what moves the wrong way for an instant."""
_DEARER = 0.2  # largest relative cost increase accepted from tightening
DEARER = "a plan that keeps limits between points is much dearer"  # status if it is larger
_UNKNOWN = 0.01  # error with rate-limited torques where none is known
_SLOWLY = 0.5  # share of the error after a refinement with rate-limited torques
_HOPELESS = 1.0  # relative cost of missed limits above which the mesh is not refined
_COARSE = 0.1  # largest relative cost increase accepted from finer intervals


def enforce_between(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Refine a solution until it is accurate and keeps limits between points."""
    refined, first, coarse = 0, solution.cost, math.nan
    worsts: list[float] = []
    raised = [Raised.none(stage) for stage in solution.stages]
    for _ in range(ROUNDS):
        motions, checks = _check(search, solution)
        tables = [check.limits.reshape(-1, CHECKS, check.limits.shape[1]) for check in checks]
        lowest = [find_minima(table).min(axis=0) for table in tables]
        depth = GRAZE * search.problem.scene.scales.length
        extended = monitor(solution.stages, lowest, depth)
        if extended is not None:
            solution = search.solve(extended, solution, most=search.wait(PATIENCE))
            if not solution.success:
                return solution
            raised = [Raised.none(stage) for stage in solution.stages]
            continue
        misses = list_misses(search, solution, checks)
        worst = max(miss.worst for miss in misses)
        if _sum(price_misses(solution, misses)) > _HOPELESS:
            return solution._replace(status=DEARER, success=False)
        # While limits are being tightened the mesh stays.
        decided = worst <= 1 or not any(stage.limits.worst for stage in raised)
        gains = _find_gains(search, solution, motions, coarse) if decided else []
        halved = decided and refined < REFINEMENTS
        times = _choose_halvings(search, solution, motions, misses, gains) if halved else []
        if any(stage.any() for stage in times):
            refined += 1
            stages = bisect_intervals(solution.stages, search.scheme, times)
            finer = search.solve(stages, solution, most=search.wait(PATIENCE))
            if finer.success:
                if finer.cost - first > _COARSE * abs(first):
                    status = "a plan on finer intervals is much dearer"
                    return finer._replace(status=status, success=False)
                solution, coarse = finer, solution.cost
                raised = [Raised.none(stage) for stage in solution.stages]
                continue
            # Gain of better torques plus cost of misses.
            error = _sum((*gains, *price_misses(solution, misses)))
            if error > _VAGUE * search.options.accuracy:
                return finer
            refined = REFINEMENTS
        if worst <= 1:
            return solution._replace(error=_sum(gains))
        raised = [stage.further(miss) for stage, miss in zip(raised, misses, strict=True)]
        worsts.append(worst)
        limits = [stage.limits for stage in raised]
        tighter = search.run(
            solution.nlp, solution.stages, limits, solution.multipliers, solution.margin
        )
        stalled = len(worsts) >= STALLED and worst > _CREEPS * worsts[-STALLED]
        if not tighter.success or stalled:
            worsts.clear()
            tighter = _halve_missed(search, solution, misses)
            raised = [Raised.none(stage) for stage in tighter.stages]
        if not tighter.success:
            return tighter
        if tighter.cost - solution.cost > _DEARER * abs(solution.cost):
            return tighter._replace(status=DEARER, success=False)
        solution = tighter
    status = f"limits are still missed {worst:.2g} times what is allowed between points"
    return solution._replace(status=status, success=False)


def _check(
    search: TimeSearch, solution: TimeSolution
) -> tuple[list[StageMotion], list[CheckPlaces]]:
    """Motions of the stages, and their limits between the points."""
    motions = make_motions(solution.stages, search.scheme)
    return motions, [check_between(*pair) for pair in zip(solution.stages, motions, strict=True)]


def _sum(tables: Iterable[NDArray[Any]]) -> float:
    return float(sum(table.sum() for table in tables))


def _find_gains(
    search: TimeSearch, solution: TimeSolution, motions: Sequence[StageMotion], coarse: float
) -> list[Array]:
    """Relative gain of better torques in each interval, shape (K,) each.

    Zero for held torques. For rate-limited ones it is the gain of the last refinement, from the
    cost `coarse`, distributed by the second differences of the control points.
    """
    if solution.stages[0].periods:
        return [np.zeros(stage.intervals) for stage in solution.stages]
    if not search.problem.scene.has_slow_motors:
        return list_gains(search, solution, motions)
    limit, shares = search.problem.scene.torque_limit, list[Array]()
    for stage in solution.stages:
        part = stage.guess
        bends = np.abs(np.diff(part.tau, 2, axis=1) / limit).max(axis=(1, 2), initial=0.0)
        shares.append(part.duration * part.fractions * bends)
    gain = abs(coarse - solution.cost) / measure_cost(search, solution)
    gain = _UNKNOWN if math.isnan(gain) else gain
    return [share * (gain / max(_sum(shares), 1e-300)) for share in shares]


def is_hopeless(search: TimeSearch, solution: TimeSolution) -> bool:
    """Whether limits missed between points cost too much for a refinement."""
    misses = list_misses(search, solution, _check(search, solution)[1])
    return _sum(price_misses(solution, misses)) > _HOPELESS


def list_misses(
    search: TimeSearch, solution: TimeSolution, checks: Sequence[CheckPlaces]
) -> list[IntersampleLimits]:
    """Misses of each stage between its points."""
    return [
        find_misses(stage, check, search.problem.epsilon, solution.margin)
        for stage, check in zip(solution.stages, checks, strict=True)
    ]


def list_gains(
    search: TimeSearch, solution: TimeSolution, motions: Sequence[StageMotion]
) -> list[Array]:
    """Relative gain of free torques in each interval, shape (K,) each."""
    epsilon, square = search.problem.epsilon, float(search.goal is Objective.EFFORT)
    size, gains = measure_cost(search, solution), []
    for k, (stage, motion) in enumerate(zip(solution.stages, motions, strict=True)):
        rows = solution.nlp.rows_of[k]
        lam = solution.multipliers["lam_g0"][rows.states].sum(axis=2)
        costate = np.einsum("kdf,ksf->ksd", rows.bases, lam)
        limits = make_limits(stage.formation, epsilon)
        gains.append(find_gains(stage, motion, costate, limits, solution.margin, square) / size)
    return gains


def measure_cost(search: TimeSearch, solution: TimeSolution) -> float:
    """Size of the cost that gains are relative to."""
    return abs(solution.cost) + search.problem.epsilon * (search.goal is Objective.MARGIN)


def price_misses(solution: TimeSolution, misses: Sequence[IntersampleLimits]) -> list[Array]:
    """Relative cost of raising limits by their misses in each interval, (K,), by multipliers."""
    on_x, on_g = (np.abs(solution.multipliers[key]) for key in ("lam_x0", "lam_g0"))
    prices = []
    for k, miss in enumerate(misses):
        layout, rows = solution.nlp.layouts[k], solution.nlp.rows_of[k].limits
        scales = rows.limits.scales[rows.limits.sides[0]]
        cost = (price_sides(rows, layout, on_x, on_g) * miss.held * scales).sum(axis=1)
        prices.append(np.asarray(cost / max(abs(solution.cost), 1e-300)))
    return prices


def _choose_halvings(
    search: TimeSearch,
    solution: TimeSolution,
    motions: Sequence[StageMotion],
    misses: Sequence[IntersampleLimits],
    gains: Sequence[Array],
) -> list[NDArray[np.int64]]:
    """How often to halve each interval; gains do not count with a given number of intervals."""
    options, most = search.options, _count_most(search, solution)
    if sum(stage.intervals for stage in solution.stages) >= most:
        return []
    prices = price_misses(solution, misses)
    times = [
        count_halvings(price, motion.defects, search.scheme)
        for price, motion in zip(prices, motions, strict=True)
    ]
    shares = [gain + price for gain, price in zip(gains, prices, strict=True)]
    slow = _SLOWLY * search.problem.scene.has_slow_motors
    if options.time_intervals is None and _sum(shares) > options.accuracy:
        more = spread_halvings(shares, max(_SPARE * options.accuracy, slow * _sum(shares)))
        times = [np.maximum(*pair) for pair in zip(times, more, strict=True)]
    wanted = sum(int((2**mine).sum()) for mine in times)
    return times if wanted <= most else [np.minimum(mine, 1) for mine in times]


def _count_most(search: TimeSearch, solution: TimeSolution) -> int:
    """Most intervals of all phases."""
    share = MOST * max(1.0, math.sqrt(_USUAL / search.options.accuracy))
    return math.ceil(share) * len({stage.phase for stage in solution.stages})


def _halve_missed(
    search: TimeSearch, solution: TimeSolution, misses: Sequence[IntersampleLimits]
) -> TimeSolution:
    """Solve with twice the intervals where limits are missed, unless they become too many."""
    times = [miss.list_missed().astype(np.int64) for miss in misses]
    count = sum(stage.intervals for stage in solution.stages) + int(_sum(times))
    if count > _BEYOND * _count_most(search, solution):
        status = f"limits between points are missed with {count} intervals, too"
        return solution._replace(status=status, success=False)
    stages = bisect_intervals(solution.stages, search.scheme, times)
    return search.solve(stages, solution, most=search.wait(PATIENCE))


def find_gains(
    stage: Stage,
    motion: StageMotion,
    costate: Array,
    limits: LimitSet,
    margin: float,
    square: float,
) -> Array:
    """Gain of free torques in each interval by minimising the Hamiltonian, in units of cost, (K,).

    Parameters
    ----------
    costate : (K, 2, 5)  of z and z' at the start of each interval
    margin               of c_n, but not of friction cones
    square               weight of tau^T tau in the cost
    """
    x, weights = np.polynomial.legendre.leggauss(_PLACES)
    x, lengths = (x + 1) / 2, np.diff(motion.breaks)
    t = motion.breaks[:-1, None] + lengths[:, None] * x
    response, n = motion.respond(np.append(t, motion.breaks[:-1])), t.size
    here = MotionResponse(*(part[:n] for part in response))
    switching = np.einsum("kd,kdj->kj", costate[:, 1], response.a_by_torque[n:])
    switching = _interpolate(motion.breaks, switching, int(stage.opens), x)
    slope = 2 * square * here.y[:, -4:-2] - switching
    values = here.y @ limits.rows.T
    values[:, limits.of(PRESS)] -= margin
    own, signs, _ = limits.sides
    size = limits.scales[own]
    slack = np.maximum(limits.find_slack(values) / size, 0.0)
    rows = np.einsum("mi,nij->nmj", limits.rows, here.y_by_torque)[:, own] * (signs / size)[:, None]
    held = _find_held(stage, here, stage.guess.places(x))
    rows = np.concatenate([rows, held, -held], axis=1)
    slack = np.hstack([slack, np.zeros((n, 2 * held.shape[1]))])
    gains = -find_least(slope, square, rows, slack).reshape(t.shape) @ weights / 2 * lengths
    return np.asarray(gains + np.abs(np.einsum("ksd,ksd->k", costate, motion.defects)))


def _find_held(stage: Stage, here: MotionResponse, places: Array) -> Array:
    """Accelerations by torque of rates and gaps at their bounds, (n, m, 2); zero elsewhere."""
    formation, z, v, by_torque = stage.formation, here.z, here.v, here.a_by_torque
    least = least_senses(stage, places).reshape(len(z), -1)
    least[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = -np.inf
    senses = np.concatenate([formation.evaluate(z, v).A_t @ by_torque, by_torque[:, 3:]], axis=1)
    slow = (stage.measure_senses(z, v) < _HELD * least) & (least > 0)
    monitored, size = list(stage.monitored), formation.scene.scales.length
    gaps = formation.evaluate_limits(z)[:, monitored]
    moved = [formation.evaluate_limits(z + _STEP * by_torque[..., j]) for j in range(2)]
    slopes = np.stack([(after[:, monitored] - gaps) / _STEP for after in moved], axis=-1)
    close = gaps < _CLOSE * size
    first = np.repeat(np.arange(len(places)) == 0, places.shape[1])
    close |= first[:, None] & (np.isin(monitored, stage.released) & stage.opens)
    active = np.concatenate([slow, close], axis=1)
    held = active[..., None] * np.concatenate([senses, slopes], axis=1)
    return np.asarray(held[:, np.flatnonzero(held.any(axis=(0, 2)))])


def _interpolate(breaks: Array, values: Array, first: int, x: Array) -> Array:
    """Cubic Hermite interpolation of values at starts of K intervals, at `x` of each, (K n, 2).

    The ends, before value number `first` and after the last, are extrapolated by parabolas.
    """
    known = np.arange(min(first, len(values) - 1), len(values))
    for end, near in ((0, known[:3]), (len(values), known[-3:])):
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
        own = slack[:, first, None] * other - slack[:, second, None] * one
        u = np.stack([-own[..., 1], own[..., 0]], axis=-1) / across[..., None]
        if square:
            free = (-slope / (2 * square))[:, None]
            beyond = (np.einsum("nmj,noj->nm", rows, free) + slack)[..., None]
            edges = free - rows * beyond / (rows**2).sum(axis=2, keepdims=True)
            u = np.concatenate([u, edges, free], axis=1)
        over = np.einsum("nmj,nuj->num", rows, u) + slack[:, None]
        value = np.einsum("nj,nuj->nu", slope, u) + square * (u**2).sum(axis=2)
    allowed = (over >= -_ROUNDING).all(axis=2) & np.isfinite(value)
    return np.asarray(np.where(allowed, value, 0.0).min(axis=1, initial=0.0))


def count_halvings(prices: Array, defects: Array, scheme: Scheme) -> NDArray[np.int64]:
    """How often to halve each interval, by its relative cost of misses and collocation error, (K,).

    Errors of collocation decrease with the scheme's order, costs to less than a tenth.
    """
    price = np.maximum(prices / DEAR, 1.0)
    error = np.maximum(np.abs(defects).max(axis=(1, 2)) / DEFECT, 1.0)
    times = np.maximum(np.log2(price) / _CHEAPER, np.log2(error) / scheme.order)
    return np.asarray(np.clip(np.ceil(times), 0, AT_ONCE), dtype=np.int64)


def spread_halvings(shares: Sequence[Array], most: float) -> list[NDArray[np.int64]]:
    """How often to halve intervals, (K,) each, the largest first, until errors sum up to `most`."""
    left, times = np.concatenate(shares), np.zeros(sum(map(len, shares)), dtype=np.int64)
    even = most / len(left)
    while left.sum() > most:
        worst = int(np.where(times < AT_ONCE, left, 0.0).argmax())
        if times[worst] == AT_ONCE or left[worst] <= even:
            break
        left[worst] /= _LESS
        times[worst] += 1
    return np.split(times, np.cumsum([len(own) for own in shares])[:-1])
