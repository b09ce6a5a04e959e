"""Lower bound of the least time from rest to rest along curves, by weak duality, and its error.

A reachability sweep gives a nearly minimum-time profile, whose costate gives the bound. The grid is
refined where the bound loses most. Errors of the profile lower the bound in second order and leave
it a bound; only the quadrature has an error.

Places are given by an angle from 0 to pi: s = length (1 - cos angle) / 2. Near rest the speed is
proportional to the root of s, and so is the angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array, Numbers
from ..geometry.curve import Curve, CurvePoint, directions_of
from ..mechanics.dynamics import ONE, A, B, V, inverse
from ..mechanics.limits import make_limits
from ..mechanics.path_limits import PathLimits, find_range
from ..mechanics.speed_sweep import (
    NoMotionError,
    SpeedProfile,
    SweepMode,
    find_duration,
    join_caps,
    speed_sweep,
)

RELAXATION = 2.5e-7  # relaxation of limits over their scales: a plan may violate them as much
# Intervals on each side of a blocked one that are split, into how many, and how often; case: the
# border of an octagon's flip, passed at a tenth of the speed beside it.
_NEIGHBOURS, _PARTS, _ATTEMPTS = 2, 4, 4
# Shortfall of limits, over their scales, at the largest speed, beyond which that is too low; case:
# query 8, where a contact turns back at a speed of 75 % of the least one.
_SHORT = 5e-3
_RULES = tuple(np.polynomial.legendre.leggauss(count) for count in (2, 3))
# Left end, middle, right end and the nodes of both rules in an interval.
_PLACES = np.concatenate([[0.0, 0.5, 1.0], *((1 + nodes) / 2 for nodes, _ in _RULES)])


class PathGrid(NamedTuple):
    """Angles of N + 1 nodes, and the segment that each of the N intervals belongs to."""

    angles: Array
    owners: Numbers

    def split(self, parts: Numbers) -> PathGrid:
        """Split every interval into a number of parts, shape (N,)."""
        owner = np.repeat(np.arange(len(parts)), parts)
        place = np.arange(len(owner)) - (np.cumsum(parts) - parts)[owner]
        angles = self.angles[owner] + np.diff(self.angles)[owner] * (place / parts[owner])
        return PathGrid(np.append(angles, self.angles[-1]), self.owners[owner])


@dataclass(frozen=True, eq=False)
class PathTerms:
    """Curves that are run through one after the other at speed."""

    curves: Sequence[Curve]  # with speed ratios that make the speed continuous
    epsilon: float  # [N]

    @cached_property
    def offsets(self) -> Array:
        """Where each curve starts, and the length of all, shape (n + 1,) [m]."""
        return np.cumsum([0.0, *(curve.length for curve in self.curves)])

    @property
    def length(self) -> float:
        """Length of all curves [m]."""
        return float(self.offsets[-1])

    @cached_property
    def pieces(self) -> tuple[tuple[int, int, float, float], ...]:
        """Each segment: its curve, its number there, and its start and stop on the path [m]."""
        return tuple(
            (index, number, offset + part.start, offset + part.stop)
            for index, (curve, offset) in enumerate(zip(self.curves, self.offsets, strict=False))
            for number, part in enumerate(curve.segments)
        )

    def place(self, angles: Array) -> Array:
        """Places along the path at some angles [m]."""
        return np.asarray(self.length * np.sin(angles / 2) ** 2)

    def make_grid(self, intervals: int) -> PathGrid:
        """A grid of about so many intervals, with nodes wherever segments meet."""
        stops = np.array([0.0, *(stop for *_, stop in self.pieces)])
        ends = np.arccos(np.clip(1 - 2 * stops / self.length, -1, 1))
        counts = np.maximum(2, np.rint(np.diff(ends) / np.pi * intervals)).astype(np.int64)
        return PathGrid(ends, np.arange(len(counts))).split(counts)

    def evaluate(self, angles: Array, owners: Numbers) -> PathLimits:
        """Limits without lambda at angles (N, n), each row on the segment of its owner."""
        s, parts = self.place(angles), []
        owner, number, start, stop = np.array(self.pieces)[owners].T[..., None]
        for index, (curve, offset) in enumerate(zip(self.curves, self.offsets, strict=False)):
            selected = owner[:, 0] == index
            local = np.clip(s[selected], start[selected], stop[selected]) - offset
            point = curve.evaluate(np.clip(local.ravel(), 0.0, curve.length))
            segment = np.repeat(number[selected].astype(np.int64), angles.shape[1])
            parts.append(find_limits(curve, self.epsilon, point, segment))
        rows, cap = (np.concatenate(column) for column in zip(*parts, strict=True))
        return PathLimits(rows.reshape(*s.shape, *rows.shape[1:]), cap.reshape(s.shape))


def find_limits(curve: Curve, epsilon: float, point: CurvePoint, segment: Numbers) -> PathLimits:
    """Limits without lambda at n places of a curve, each as part of a segment; see `RELAXATION`."""
    forces = inverse(curve.formation, point, directions_of(curve, segment))
    limits = make_limits(curve.formation, epsilon)
    return PathLimits.of(limits, forces, point.z_s[:, 3:], RELAXATION).eliminate()


class LowerBound(NamedTuple):
    """Lower bound of the least time."""

    value: float  # [s]: the bound, less the estimate of its error
    error: float  # [s]: the estimate, by quadratures of two orders


def bound_least_time(
    curves: Sequence[Curve], epsilon: float, intervals: int = 100, grids: int = 16
) -> LowerBound | None:
    """Lower bound of the time along curves; None where no motion is found.

    Curves have speed ratios that make the speed continuous where two of them meet. The first one of
    the `grids`, at most, has so many `intervals`; losses fall by 64 a grid where speeds are very
    low.
    """
    path = PathTerms(curves, epsilon)
    grid, b_guess, bound, attempts = path.make_grid(intervals), None, None, 0
    for remaining in reversed(range(grids)):
        try:
            bound, losses, motion, time = _bound(path, grid, b_guess)
        except NoMotionError as error:
            attempts += 1
            if attempts > _ATTEMPTS or not remaining:
                break
            parts = np.ones(len(grid.owners), dtype=np.int64)
            parts[max(error.interval - _NEIGHBOURS, 0) : error.interval + _NEIGHBOURS + 1] = _PARTS
            grid, b_guess = grid.split(parts), None
            continue
        if not remaining:
            break
        excess = losses / (3e-8 * time)  # relative tolerance
        # Losses at switches and kinks fall with the square or the third power of the interval.
        parts = np.clip(np.ceil(np.cbrt(excess * len(excess))), 1, 8).astype(np.int64)
        # If not all can be split, those that lose most are.
        order = np.argsort(-excess)
        parts[order[np.cumsum(parts[order] - 1) > 1500 - len(parts)]] = 1  # most intervals
        # Where p falls although b has no bound nothing is bounded, on any grid.
        parts[np.isinf(excess) & (np.diff(grid.angles) < 1e-6)] = 1
        if excess.sum() < 1 or (parts == 1).all():
            break
        refined = grid.split(parts)
        middles = (refined.angles[1:] + refined.angles[:-1]) / 2
        b_guess = np.interp(path.place(middles), path.place(grid.angles), motion.b)
        grid = refined
    return bound


def sweep_time(curves: Sequence[Curve], epsilon: float, intervals: int) -> float:
    """Estimated least time along curves from rest to rest [s]; see `bound_least_time`.

    Limits are kept at one place of each interval of a coarse grid. NoMotionError without a motion,
    and where friction turns if no speed up to the largest one leaves an acceleration.
    """
    path = PathTerms(curves, epsilon)
    grid = path.make_grid(intervals)
    *_, motion, duration = _bound(path, grid, None)
    # Where segments meet, on both sides.
    last = np.flatnonzero(np.diff(grid.owners))
    ends, sides = np.repeat(last + 1, 2), np.stack([last, last + 1], axis=1).ravel()
    limits = path.evaluate(grid.angles[ends, None], grid.owners[sides]).pick((slice(None), 0))
    slack = limits.at(motion.b[ends] * np.linspace(0.0, 1.0, 5)[:, None])
    least, most = find_range(limits.rows[..., A], slack + _SHORT)
    if (blocked := (least > most).all(axis=0)).any():
        raise NoMotionError(int(ends[blocked.argmax()]))
    return duration


def _bound(
    path: PathTerms, grid: PathGrid, b_guess: Array | None
) -> tuple[LowerBound, Array, SpeedProfile, float]:
    """The bound on a grid, losses in its intervals, (N,) [s], the profile it is from, and its time.

    Viscous friction is linearised about b = `b_guess` in the intervals.
    """
    h = np.diff(grid.angles)[:, None]
    angles = grid.angles[:-1, None] + _PLACES * h
    rows = path.evaluate(angles, grid.owners)
    left, middle, right = (rows.pick((slice(None), k)) for k in range(3))
    s = path.place(grid.angles)
    part = (path.place(angles) - s[:-1, None]) / np.diff(s)[:, None]
    cap = join_caps(left.cap, right.cap)
    motion = speed_sweep(middle, np.diff(s), part[:, 1], cap, b_guess)
    b = motion.b[:-1, None] + part * np.diff(motion.b)[:, None]
    y, slopes = find_costate(path, grid, left, right, motion)
    shape = len(h), len(_PLACES) - 3
    p, slope = map(np.ravel, interpolate_costate(path, grid, y, slopes, _PLACES[3:]))
    inner = rows.pick((slice(None), slice(3, None)))
    inner = PathLimits(*(array.reshape(-1, *array.shape[2:]) for array in inner))
    least = find_least(inner, p, slope)
    excess = evaluate(inner, p, slope, b[:, 3:].ravel()) - least
    stretch = path.length / 2 * np.sin(angles[:, 3:])
    least, excess = least.reshape(shape) * stretch, excess.reshape(shape) * stretch
    # Along a limit of the speed nothing is lost, however b is interpolated.
    at_cap = motion.b == cap
    excess[at_cap[:-1] & at_cap[1:]] = 0.0
    coarse, fine = (
        h[:, 0] / 2 * (least[:, nodes] @ weights)
        for nodes, (_, weights) in zip((slice(2), slice(2, None)), _RULES, strict=True)
    )
    error = np.abs(fine - coarse)
    losses = error + np.abs(h[:, 0] / 2 * (excess[:, 2:] @ _RULES[1][1]))
    # Where p falls from one interval to the next.
    jumps = np.minimum((y[:-1, 1] - y[1:, 0]) / np.sin(grid.angles[1:-1]), 0.0)
    taken = np.zeros(len(jumps))
    k = np.flatnonzero(jumps)
    taken[k] = np.minimum(right.pick(k).find_largest_b(), left.pick(k + 1).find_largest_b())
    jump_losses = np.abs(jumps * (taken - motion.b[1:-1]))
    losses[:-1] += jump_losses
    losses[1:] += jump_losses
    total = float(fine.sum() + jumps @ taken)
    estimate = 2.0 * float(error.sum())  # both quadratures err alike at switches
    value = max(0.0, total - estimate) if np.isfinite(total) else 0.0
    time = float(find_duration(motion.b, np.diff(s)))
    return LowerBound(value, estimate), losses, motion, time


def find_costate(
    path: PathTerms, grid: PathGrid, left: PathLimits, right: PathLimits, motion: SpeedProfile
) -> tuple[Array, Array]:
    """The costate p of a profile, from the limits at the left and right ends of intervals.

    Returns y = p sin(angle) at the two ends of each interval, and its slopes there, (N, 2) each.
    """
    b, modes = motion.b, motion.modes
    pushes, brakes = (
        (left.extreme(b[:-1], largest), right.extreme(b[1:], largest)) for largest in (True, False)
    )
    y = np.zeros((len(modes), 2))
    # In an interval with a switch it is zero where a changes.
    k = np.flatnonzero(modes == SweepMode.SWITCH)
    pushed, braked, angles = pushes[0].a[k], brakes[1].a[k], grid.angles[k[:, None] + [0, 1]]
    h = np.diff(path.place(angles))[:, 0]
    x = np.clip((b[k + 1] - b[k] - 2 * braked * h) / (2 * (pushed - braked)), 0.0, h)
    rate = 0.5 * np.maximum(b[k] + 2 * pushed * x, np.maximum(b[k], b[k + 1])) ** -1.5
    y[k] = rate[:, None] * np.column_stack([x, x - h]) * np.sin(angles)
    # dy/dangle = force + rate y at both ends of the intervals.
    slope, switches = np.zeros((len(modes), 2)), modes == SweepMode.SWITCH
    for mode, extremes, switched in ((SweepMode.PUSH, pushes, 0), (SweepMode.BRAKE, brakes, 1)):
        for end in range(2):
            used = (modes == mode) | (switches if end == switched else False)
            slope[used, end] = extremes[end].slope[used]
    angles = np.column_stack([grid.angles[:-1], grid.angles[1:]])
    speed = np.sqrt(np.column_stack([b[:-1], b[1:]]))
    inner, forces, rates = speed > 0, np.zeros(slope.shape), np.zeros(slope.shape)
    sine, stretch = np.sin(angles), path.length / 2 * np.sin(angles)
    forces[inner] = -(stretch * sine)[inner] / (2 * speed[inner] ** 3)
    rates[inner] = 1 / np.tan(angles[inner]) - 2 * slope[inner] * stretch[inner]
    # From switches and speed limits, back where accelerating, forth where braking.
    steps, last = np.diff(grid.angles), len(modes) - 1
    ends = float(pushes[0].a[0]), float(brakes[1].a[-1])
    rest_values = [np.sign(a) / (2 * abs(a) * np.sqrt(abs(a) * path.length / 2)) for a in ends]
    for mode, order, near, far in (
        (SweepMode.PUSH, range(last, -1, -1), 1, 0),
        (SweepMode.BRAKE, range(last + 1), 0, 1),
    ):
        step = far - near
        for n in order:
            if modes[n] != mode:
                continue
            previous = n - step
            is_continued = 0 <= previous <= last and modes[previous] in (mode, SweepMode.SWITCH)
            y[n, near] = y[previous, far] if is_continued else 0.0
            if n == (last if far else 0):
                y[n, far] = rest_values[far]
            else:
                # Trapezoidal rule.
                half, of_y = step * steps[n] / 2, rates[n]
                start = y[n, near] * (1 + half * of_y[near]) + half * forces[n].sum()
                y[n, far] = start / (1 - half * of_y[far])
    slopes = np.where((modes == SweepMode.HELD)[:, None], 0.0, forces + rates * y)
    # At rest only the value is known.
    secant = np.diff(y, axis=1)[:, 0] / steps
    slopes[0, 0] = 2 * secant[0] - slopes[0, 1]
    slopes[-1, 1] = 2 * secant[-1] - slopes[-1, 0]
    return y, slopes


def interpolate_costate(
    path: PathTerms, grid: PathGrid, y: Array, slopes: Array, fractions: Array
) -> tuple[Array, Array]:
    """The costate p and p' = dp/ds at `fractions` of every interval, shape (N, n)."""
    t, h = fractions, np.diff(grid.angles)[:, None]
    (start, stop), (first, last) = y.T[..., None], h * slopes.T[..., None]
    rise = stop - start
    bow = first + last - 2 * rise
    y_t = first + t * (2 * (rise - first - bow) + 3 * t * bow)
    y = start + t * (first + t * (rise - first - bow + t * bow))
    angles = grid.angles[:-1, None] + t * h
    sine = np.sin(angles)
    p_angle = (y_t / h - y / np.tan(angles)) / sine
    return y / sine, p_angle / (path.length / 2 * sine)


def find_least(limits: PathLimits, p: Array, slope: Array) -> Array:
    """H at n places, from p and p' there."""
    least = _find_least(limits, p, slope)
    unbounded = np.flatnonzero(~np.isfinite(least))
    if len(unbounded):
        bounded = limits.pick(unbounded)
        bounded = bounded._replace(cap=bounded.find_largest_b())
        least[unbounded] = _find_least(bounded, p[unbounded], slope[unbounded])
    return least


def _find_least(limits: PathLimits, p: Array, slope: Array) -> Array:
    weight, cap, rows = _weigh(limits, p), limits.cap[:, None], limits.rows
    with np.errstate(over="ignore", invalid="ignore"):
        c, g = weight * rows[..., B] - slope[:, None], weight * rows[..., V]
        least = _minimise(c, g, cap) + weight * rows[..., ONE]
    least = np.where((weight < 0) & ~np.isnan(least), least, -np.inf).max(axis=1)
    return np.where(p == 0, _minimise(-slope[:, None], np.zeros((len(p), 1)), cap)[:, 0], least)


def evaluate(rows: PathLimits, p: Array, slope: Array, b: Array) -> Array:
    """The integrand at n places for some b and the best a."""
    weight, slack = _weigh(rows, p), rows.at(b)
    largest = np.where(weight < 0, weight * slack, -np.inf).max(axis=1)
    return np.asarray(1 / np.sqrt(b) - slope * b + np.where(p == 0, 0.0, largest))


def _weigh(limits: PathLimits, p: Array) -> Array:
    """Weight of a row's slack in the integrand if the row alone bounds p a; 0 if it cannot."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        weight = 2 * p[:, None] / limits.rows[..., A]
        return np.where((weight < 0) & np.isfinite(weight), weight, 0.0)


def _minimise(c: Array, g: Array, cap: Array) -> Array:
    """Least 1/v + g v + c v^2 over 0 < v <= sqrt(cap).

    The derivative vanishes where x = 1/v has x^3 = g x + 2 c. The largest root is the minimum, or
    there is none and the largest v is best.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        root = np.cbrt(2 * np.maximum(c, 0))
        if g.any():
            # Newton's method falls monotonically from above the largest root.
            x = np.where(g > 0, root + np.sqrt(np.abs(g)), np.minimum(root, root**3 / np.abs(g)))
            for _ in range(12):
                x = x - (x**3 - g * x - 2 * c) / (3 * x**2 - g)
            root = np.where(g == 0, root, x)
        v = np.sqrt(cap)
        inner = np.where(root > 0, np.minimum(1 / root, v), v)
        leading = np.where(c == 0, g, c)
        limit = np.where(leading == 0, 0.0, np.copysign(np.inf, leading))
        values = [np.where(np.isfinite(x), 1 / x + g * x + c * x**2, limit) for x in (inner, v)]
        return np.where(c > 0, values[0], np.minimum(*values))
