"""From a solution to a plan: intervals as fine as the accuracy asks for, limits that hold between.

Intervals are halved for what better torques would gain and for what their misses of limits cost,
both over the cost, until the sum is below the accuracy, and for what collocation misses. What
limits then still miss between points is added to them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...mechanics.limits import PRESS, LimitSet, make_limits
from ..options import Objective
from .equations import least_senses
from .intersample import (
    CheckPlaces,
    IntersampleLimits,
    Raised,
    check_between,
    find_misses,
    monitor_missed,
)
from .search import TimeSearch, TimeSolution
from .stage import Stage
from .time_limits import price_sides
from .time_mesh import bisect_intervals, cap_halvings, count_halvings, spread_halvings
from .time_motion import MotionResponse, StageMotion, make_motions

_PLACES = 7  # gauss points of an interval at which torques are compared
_HELD = 3.0  # rate over the least one below which that holds it
_CLOSE = 1e-6  # gap over the radius of gyration below which it is held open
_STEP = 1e-6  # step of z by which slopes of gaps are found, over accelerations of a torque of 1
_ROUNDING = 1e-9  # largest miss of a limit that counts as none, over what is much for it
ROUNDS = 24  # most times that limits are tightened
STALLED = 5  # times of tightening in which it has to lead somewhere
_CREEPS = 0.3
"""Share of the miss that is left then if it does; otherwise finer intervals are tried instead."""
REFINEMENTS = 8  # most times that intervals are halved because of misses
MOST = 64
"""Intervals of each phase from which on none is halved, with the accuracy of the default; they go
with the root of its inverse."""
_BEYOND = 2
"""Largest number of intervals with which limits are looked for that are missed, over that."""
_USUAL = 1e-4  # the accuracy of the default
_SPARE = 0.5  # share of the accuracy that halving intervals is to leave
PATIENCE = 80  # most iterations of one solve on finer intervals, that starts from a solution
_VAGUE = 20.0
"""Error of a plan from which finer intervals lead nowhere, over the accuracy, from which on it is
no plan: that something moves the wrong way for an instant only finer intervals show."""
_DEARER = 0.2  # largest relative cost increase accepted from tightening
DEARER = "a plan that keeps limits between points is much dearer"
"""Status of solutions whose limits between points cannot be kept by tightening them."""
_UNKNOWN = 0.01  # error with limited rates where none is known
_SLOWLY = 0.5  # share of the error that intervals halved at once are to leave, with limited rates
_HOPELESS = 1.0
"""Price of all that limits miss, over the cost, from which on no finer intervals are tried."""
_COARSE = 0.1  # largest relative cost increase accepted from finer intervals


def enforce_between(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """Go on from a solution until it is accurate and limits hold between points too."""
    refined, first = 0, solution.cost
    tries: list[float] = []
    raised = [Raised.none(stage) for stage in solution.stages]
    coarse = math.nan
    for _ in range(ROUNDS):
        motions = make_motions(solution.stages, search.scheme)
        checks = [check_between(*pair) for pair in zip(solution.stages, motions, strict=True)]
        monitoring = monitor_missed(solution.stages, checks)
        if monitoring is not None:
            solution = search.solve(monitoring, solution, most=search.wait(PATIENCE))
            if not solution.success:
                return solution
            raised = [Raised.none(stage) for stage in solution.stages]
            continue
        misses = list_misses(search, solution, checks)
        worst = max(miss.worst for miss in misses)
        if sum(price.sum() for price in price_misses(solution, misses)) > _HOPELESS:
            return solution._replace(status=DEARER, success=False)
        # Limits that are being tightened are looked at for their misses first.
        decided = worst <= 1 or not any(own.limits.worst for own in raised)
        gains = _find_gains(search, solution, motions, coarse) if decided else []
        halved = decided and refined < REFINEMENTS
        times = _choose_halvings(search, solution, motions, misses, gains) if halved else []
        if any(mine.any() for mine in times):
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
            if measure_error(solution, misses, gains) > _VAGUE * search.options.accuracy:
                return finer
            # What finer intervals do not lead to now they will not lead to later.
            refined = REFINEMENTS
        if worst <= 1:
            return solution._replace(error=float(sum(own.sum() for own in gains)))
        raised = [own.further(miss) for own, miss in zip(raised, misses, strict=True)]
        tries.append(worst)
        limits = [own.limits for own in raised]
        # Where rates are limited a motion changes as a whole, and with it what is at its limit.
        known = solution.multipliers
        tighter = search.run(solution.nlp, solution.stages, limits, known, solution.margin)
        crept = len(tries) >= STALLED and worst > _CREEPS * tries[-STALLED]
        if not tighter.success or crept:
            tries.clear()
            tighter = _halve_missed(search, solution, misses)
            raised = [Raised.none(stage) for stage in tighter.stages]
        if not tighter.success:
            return tighter
        if tighter.cost - solution.cost > _DEARER * abs(solution.cost):
            return tighter._replace(status=DEARER, success=False)
        solution = tighter
    status = f"limits are still missed {worst:.2g} times what is allowed between points"
    return solution._replace(status=status, success=False)


def _find_gains(
    search: TimeSearch, solution: TimeSolution, motions: Sequence[StageMotion], coarse: float
) -> list[Array]:
    """What better torques would gain in each interval, over the objective, shape (K,) each.

    None of torques that are held over periods. With limited rates it is as much as halving some
    intervals has gained, from the cost that is `coarse`. Each interval has a share in it by how
    much its torques bend: there they would rather change their rate at once.
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
    return [own * (gain / max(sum(map(np.sum, shares)), 1e-300)) for own in shares]


def is_hopeless(search: TimeSearch, solution: TimeSolution) -> bool:
    """Whether limits are missed between points by so much that finer intervals are of no use."""
    motions = make_motions(solution.stages, search.scheme)
    checks = [check_between(*pair) for pair in zip(solution.stages, motions, strict=True)]
    prices = price_misses(solution, list_misses(search, solution, checks))
    return bool(sum(price.sum() for price in prices) > _HOPELESS)


def list_misses(
    search: TimeSearch, solution: TimeSolution, checks: Sequence[CheckPlaces]
) -> list[IntersampleLimits]:
    """What each stage misses between its points."""
    return [
        find_misses(stage, check, search.problem.epsilon, solution.margin)
        for stage, check in zip(solution.stages, checks, strict=True)
    ]


def list_gains(
    search: TimeSearch, solution: TimeSolution, motions: Sequence[StageMotion]
) -> list[Array]:
    """What better torques would gain in each interval, over the objective, shape (K,) each."""
    epsilon, square = search.problem.epsilon, float(search.goal is Objective.EFFORT)
    size = measure_cost(search, solution)
    found = []
    for k, (stage, motion) in enumerate(zip(solution.stages, motions, strict=True)):
        rows = solution.nlp.rows_of[k]
        worth = solution.multipliers["lam_g0"][rows.states].sum(axis=2)
        costate = np.einsum("kdf,ksf->ksd", rows.bases, worth)
        limits = make_limits(stage.formation, epsilon)
        found.append(find_gains(stage, motion, costate, limits, solution.margin, square) / size)
    return found


def measure_cost(search: TimeSearch, solution: TimeSolution) -> float:
    """What gains count over."""
    return abs(solution.cost) + search.problem.epsilon * (search.goal is Objective.MARGIN)


def price_misses(solution: TimeSolution, misses: Sequence[IntersampleLimits]) -> list[Array]:
    """What raising limits by their misses would cost in each interval, over the cost, (K,)."""
    on_x, on_g = (np.abs(solution.multipliers[key]) for key in ("lam_x0", "lam_g0"))
    prices = []
    for k, miss in enumerate(misses):
        layout, rows = solution.nlp.layouts[k], solution.nlp.rows_of[k].limits
        price = price_sides(rows, layout, on_x, on_g)
        spans = rows.limits.scales[rows.limits.sides[0]]
        cost = (price * miss.held * spans).sum(axis=1)
        prices.append(np.asarray(cost / max(abs(solution.cost), 1e-300)))
    return prices


def measure_error(
    solution: TimeSolution, misses: Sequence[IntersampleLimits], gains: Sequence[Array]
) -> float:
    """What better torques would gain and misses cost in all intervals, over the cost."""
    return float(sum(own.sum() for own in (*gains, *price_misses(solution, misses))))


def _choose_halvings(
    search: TimeSearch,
    solution: TimeSolution,
    motions: Sequence[StageMotion],
    misses: Sequence[IntersampleLimits],
    gains: Sequence[Array],
) -> list[NDArray[np.int64]]:
    """How often to halve each interval; none if there are many.

    With a number of intervals that was asked for, gains do not count.
    """
    options, most = search.options, _count_most(search, solution)
    if sum(stage.intervals for stage in solution.stages) >= most:
        return []
    prices = price_misses(solution, misses)
    times = [
        count_halvings(price, motion.defects, search.scheme)
        for price, motion in zip(prices, motions, strict=True)
    ]
    shares = [gain + price for gain, price in zip(gains, prices, strict=True)]
    fixed = options.time_intervals is not None
    slow = _SLOWLY * search.problem.scene.has_slow_motors
    if not fixed and sum(own.sum() for own in shares) > options.accuracy:
        left = max(_SPARE * options.accuracy, slow * sum(own.sum() for own in shares))
        more = spread_halvings(shares, left)
        times = [np.maximum(*pair) for pair in zip(times, more, strict=True)]
    return cap_halvings(times, most)


def _count_most(search: TimeSearch, solution: TimeSolution) -> int:
    """Intervals of all phases from which on none is halved for its gain or its price."""
    share = MOST * max(1.0, math.sqrt(_USUAL / search.options.accuracy))
    return math.ceil(share) * len({stage.phase for stage in solution.stages})


def _halve_missed(
    search: TimeSearch, solution: TimeSolution, misses: Sequence[IntersampleLimits]
) -> TimeSolution:
    """Go on from a plan with twice the intervals where it misses limits, which then is less.

    There is no plan with many more than are halved for other reasons: such solves take long, and
    limits that so many still miss they go on to miss.
    """
    times = [miss.list_missed().astype(np.int64) for miss in misses]
    count = sum(stage.intervals for stage in solution.stages) + sum(int(own.sum()) for own in times)
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
    """What better torques would gain in each interval of a stage, in the unit of the cost, (K,).

    Parameters
    ----------
    costate : (K, 2, 5)  of z and z' at the start of each interval
    margin               what c_n but no friction cone has to exceed its least value by
    square               weight of tau^T tau in the cost
    """
    x, weights = np.polynomial.legendre.leggauss(_PLACES)
    x, lengths = (x + 1) / 2, np.diff(motion.breaks)
    t = motion.breaks[:-1, None] + lengths[:, None] * x
    found = motion.respond(np.append(t, motion.breaks[:-1]))
    here, n = MotionResponse(*(part[: t.size] for part in found)), t.size
    worth = np.einsum("kd,kdj->kj", costate[:, 1], found.a_by_torque[n:])
    worth = _interpolate(motion.breaks, worth, int(stage.opens), x)
    slope = 2 * square * here.y[:, -4:-2] - worth
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
    """Rows of accelerations by torque that limits of rates and gaps hold, shape (n, m, 2).

    A row is nothing at places where it is not held.
    """
    formation, z, v, by_torque = stage.formation, here.z, here.v, here.a_by_torque
    least = least_senses(stage, places).reshape(len(z), -1)
    least[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = -np.inf
    senses = np.concatenate([formation.evaluate(z, v).A_t @ by_torque, by_torque[:, 3:]], axis=1)
    slow = (stage.measure_senses(z, v) < _HELD * least) & (least > 0)
    monitored, size = list(stage.monitored), formation.scene.scales.length
    gaps = formation.evaluate_limits(z)[:, monitored]
    ahead = (
        formation.evaluate_limits(z + _STEP * by_torque[..., j])[:, monitored] for j in range(2)
    )
    slopes = np.stack([(after - gaps) / _STEP for after in ahead], axis=-1)
    close = gaps < _CLOSE * size
    first = np.repeat(np.arange(len(places)) == 0, places.shape[1])
    close |= first[:, None] & (np.isin(monitored, stage.released) & stage.opens)
    held = np.concatenate([slow, close], axis=1)[..., None] * np.concatenate(
        [senses, slopes], axis=1
    )
    return np.asarray(held[:, np.flatnonzero(held.any(axis=(0, 2)))])


def _interpolate(breaks: Array, values: Array, first: int, x: Array) -> Array:
    """Cubic interpolation of values at starts of K intervals, at `x` of each, shape (K n, 2).

    Both ends, before the value number `first` and after the last, are as those beside them go on.
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
    """Least value of slope^T u + square u^T u over u in the plane with rows u + slack >= 0, (n,).

    It is taken at a corner, or else on an edge or inside, or at u = 0, which counts as allowed.

    Parameters
    ----------
    slope, rows, slack : (n, 2), (n, m, 2), (n, m)
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
