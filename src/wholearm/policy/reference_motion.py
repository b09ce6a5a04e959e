"""References along curves: a plan's motion, or a slower one, with robustness margins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..geometry.curve import Curve, directions_of
from ..geometry.tracing import trace_phase
from ..mechanics.dynamics import inverse, metric_weights
from ..mechanics.path_limits import PathLimits
from ..mechanics.speed_sweep import ControllableSet, find_controllable, find_duration
from ..problem.definition import End, Phase, Problem
from ..results.trajectory import Trajectory
from .curve_rows import (
    AUTHORITY,
    CurveLimitRows,
    Motion,
    find_internal_force,
    find_within,
    make_rows,
    measure_levels,
    split_limits,
)
from .regulator import find_planned_internal_force

INTERVALS = 120  # intervals of a curve's table, dense at its ends
PLACES = 400  # places of a curve at which the nearest one is searched first
NEWTON = 4  # iterations of that search
TOUCH = 3e-3  # speed along curves at which contacts are made, over the scene's
ARRIVAL = 3e-3  # time constant of the approach to the end [s]
# Squared speeds over the plan's that are tried until there is a margin, or less of it: relative
# errors of torques matter less where torques are small.
SLOWER = (1.0, 0.5, 0.25, 0.12, 0.06)
# Shares of the margin that are tried, the largest first. Negative ones: limits of a plan hold
# between its own nodes, so that at others they may be violated a little.
SHARES = (*(0.8**k for k in range(12)), 0.04, 0.0, -0.1, -0.2, -0.4, -0.8)
SLOWEST = 0.1  # least b over the plan's of a motion with a margin: slow motions can stick
PARTS = (0.5, 0.2, 0.0)  # upper limits of the share of all intervals, if some interval has less
NEAR, ENOUGH = 0.8, 0.4  # least share, over such a limit and in all, that needs no further one
REFINE = 2  # iterations between a slower motion's internal force and its margins
ROUNDS = 3  # iterations between worst corners and motion
LEAST_SHARE = 0.5  # least share of the margins within ranges; with less the ranges are too wide
LESS = 0.8  # factor by which ranges shrink while they are too wide
CLOSE, NONE = 0.03, 0.02  # relative accuracy of the widest ranges, and the least share of them
WIDEST = 0.9  # largest relative range


class ReferencePiece(NamedTuple):
    """The reference of a phase along a curve."""

    curve: Curve
    rows: CurveLimitRows
    reach: ControllableSet
    share: float  # least share of the margin
    begins: float  # [m^2/s^2]: the plan's b at the start
    passes: float  # ratio of b after and before the impact at the end; zero at rest
    b: Array  # (n,) [m^2/s^2]: the reference

    @property
    def duration(self) -> float:
        """Duration of the reference [s]."""
        return float(find_duration(self.b, np.diff(self.rows.s)))

    @property
    def reserves(self) -> dict[str, float]:
        """Least level of each contact's normal force along the reference."""
        rows, names = self.rows, self.curve.formation.names
        a = np.diff(self.b) / (2 * np.diff(rows.s))
        count = len(split_limits(self.curve.formation)[0].low)
        levels = measure_levels(rows, np.append(a, a[-1]), self.b)[:, : rows.presses]
        least = levels.min(axis=0).reshape(-1, count).min(axis=0)
        return dict(zip(names, least[: len(names)].tolist(), strict=True))


class Reserve(NamedTuple):
    """Margins as in `make_policy`, with the known delay of the torques [s]."""

    size: float
    ranges: Mapping[str, float] | None
    delay: float

    def scale(self) -> dict[str, float]:
        """Half widths of the scaled ranges; of the delay its unknown part."""
        widths = {name: self.size * width for name, width in (self.ranges or {}).items()}
        late = widths.get("delay", 0.0)
        # Torques may be early as well: a delay is anything from none to its range.
        return widths | {"delay": max(late - self.delay, self.delay) if late else 0.0}


def trace_pieces(
    problem: Problem, phases: Sequence[Phase | None], plan: Trajectory, reserve: Reserve
) -> list[ReferencePiece | None]:
    """References of phases along curves, with margins as large as possible; None for None."""
    pieces: list[ReferencePiece | None] = []
    for phase in reversed(phases):
        after = pieces[-1] if pieces else None
        pieces.append(None if phase is None else _trace(problem, phase, plan, reserve, after))
    pieces.reverse()
    before: ReferencePiece | None = None
    for k, piece in enumerate(pieces):
        if piece is not None:
            first = float(piece.reach.high[0])
            if before is not None and before.passes:
                first = float(before.b[-1]) * before.passes
            piece = pieces[k] = piece._replace(b=piece.reach.run(first))
        before = piece
    return pieces


def _trace(
    problem: Problem, phase: Phase, plan: Trajectory, reserve: Reserve, after: ReferencePiece | None
) -> ReferencePiece:
    """A phase's curve, and the controllable motions along it that keep margins."""
    rows_of_phase = np.flatnonzero((plan.phase == phase.index) & ~plan.held)
    curve = trace_phase(phase, plan.z[rows_of_phase[0]], problem.phases[phase.index + 1 :])
    places, *values = _follow(curve, plan, rows_of_phase)
    s = _place_nodes(curve)
    a, b, internal = (np.interp(s, places, value) for value in values)
    touch, begins, passes, end = TOUCH * problem.scene.scales.speed, float(b[0]), 0.0, None
    if phase.end is End.IMPACT and after is not None and b[-1] > touch**2:
        passes = after.begins / float(b[-1])
        end = float(after.reach.low[0] / passes), float(after.reach.high[0] / passes)
    else:
        b = np.minimum(b, (touch + (curve.length - s) / ARRIVAL) ** 2)
    if reserve.ranges is not None and reserve.size:
        planned = a, b, internal
        within, share = retime_within(curve, s, planned, reserve.scale(), problem.epsilon, end)
        if within is not None:
            return ReferencePiece(curve, *within, share, begins, passes, b)
    best: tuple[CurveLimitRows, ControllableSet, float] | None = None
    for factor in SLOWER:
        motion = factor * a, factor * b
        rows = make_rows(curve, s, (*motion, internal))
        for _ in range(REFINE if factor < 1.0 else 0):
            rows = make_rows(curve, s, (*motion, find_internal_force(rows, *motion)))
        wanted = reserve.size * rows.unit
        wanted[:, rows.presses :] = AUTHORITY * rows.unit[:, rows.presses :]
        found = retime(s, rows.slack, wanted, motion[1], end)
        share = float(found.share.min())
        if best is not None and share <= best[2]:
            break
        best = rows, found, share
        if share >= ENOUGH:
            break
    assert best is not None
    rows, found, share = best
    # Margins without ranges keep no share of ranges.
    share = share if reserve.ranges is None else 0.0
    return ReferencePiece(curve, rows, found, share, begins, passes, b)


def retime(
    s: Array,
    slack: Array,
    reserve: Array,
    cap: Array,
    end: tuple[float, float] | None = None,
    parts: Sequence[float] = PARTS,
) -> ControllableSet:
    """Controllable motions nowhere faster than a plan, with the largest least share of margins.

    Parameters
    ----------
    s : (n,) [m]          nodes
    slack : (n, m, 5)     limits at the nodes, as in `CurveLimitRows`
    reserve : (n, m)      their margins
    cap : (n,) [m^2/s^2]  largest b
    end : [m^2/s^2]       least and largest b at the last node; by default the last of `cap`
    parts                 upper limits of the share, tried where some interval has less
    """
    limits, floor, end = PathLimits(slack, cap), SLOWEST * cap, end or (cap[-1], cap[-1])
    best: ControllableSet | None = None
    for part in (1.0, *parts):
        # A large share in one interval can reduce that of another one.
        shares = [part, *(share for share in SHARES if share < part)]
        found = find_controllable(limits, reserve, np.diff(s), floor, end, shares)
        if best is None or found.share.min() > best.share.min():
            best = found
        if best.share.min() >= min(NEAR * part, ENOUGH):
            break
    assert best is not None
    return best


def retime_within(
    curve: Curve,
    s: Array,
    plan: Motion,
    widths: Mapping[str, float],
    least: float,
    end: tuple[float, float] | None = None,
) -> tuple[tuple[CurveLimitRows, ControllableSet] | None, float]:
    """The fastest motion that keeps its limits within the largest feasible share of ranges.

    Fixed-point iteration between the worst corners of the ranges and the motion.

    Parameters
    ----------
    s : (n,) [m]  nodes
    plan : (n,)   a, b and internal force of a plan there; no motion is faster
    widths        half widths of the ranges; that of the delay is its unknown part
    least : [N]   least normal force within them
    end           as of `retime`

    Returns
    -------
    tuple  the law's limits and the motions, None if there are none; and the share of the ranges
    """

    def find(share: float) -> tuple[CurveLimitRows, ControllableSet] | None:
        scaled = {name: min(share * width, WIDEST) for name, width in widths.items()}
        within, motion = find_within(curve, s, np.sqrt(plan[1]), scaled, least), plan
        for _ in range(ROUNDS):
            rows, whole, wanted = within.at(motion)
            found = retime(s, whole, wanted, plan[1], end, ())
            b = found.run(float(found.high[0]))
            if found.share.min() < LEAST_SHARE:
                return None
            a = np.gradient(b, s) / 2
            motion = a, b, find_internal_force(rows, a, b)
        return within.at(motion)[0], found

    low, high, best = 0.0, 1.0, find(1.0)
    if best is not None:
        return best, 1.0
    # Downwards first: most ranges are only a little too wide.
    while high - low > CLOSE * high and high > NONE:
        share = LESS * high if best is None else (low + high) / 2
        found = find(share)
        if found is None:
            high = share
        else:
            low, best = share, found
    return best, low


def _follow(
    curve: Curve, plan: Trajectory, rows: NDArray[np.int64]
) -> tuple[Array, Array, Array, Array]:
    """Places s, a, b and internal force of a plan's rows along a curve."""
    formation, metric = curve.formation, metric_weights(curve.formation.scene)
    z, grid = plan.z[rows], np.linspace(0.0, curve.length, PLACES)
    away = (z[:, None] - curve.evaluate(grid).z[None]) ** 2 @ metric
    s = grid[away.argmin(axis=1)]
    for _ in range(NEWTON):
        point = curve.evaluate(s)
        s = np.clip(s + ((z - point.z) * point.z_s) @ metric, 0.0, curve.length)
    point = curve.evaluate(s)
    v = (point.z_s * plan.z_dot[rows]) @ metric
    a = (point.z_s * plan.z_ddot[rows]) @ metric
    segment = np.searchsorted([part.stop for part in curve.segments[:-1]], s)
    forces = inverse(formation, *point[:3], directions_of(curve, segment), point.kinematics)
    c_n, c_t = plan.c_n[rows], plan.c_t[rows]
    return s, a, v**2, find_planned_internal_force(formation, forces, plan, c_n, c_t)


def _place_nodes(curve: Curve) -> Array:
    """Nodes of a table, with all reversals."""
    s = curve.length * (1 - np.cos(np.pi * np.linspace(0, 1, INTERVALS + 1))) / 2
    s = np.sort(np.concatenate([s, [part.stop for part in curve.segments[:-1]]]))
    return np.asarray(s[np.diff(s, prepend=-1.0) > 1e-7 * curve.length])
