from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from wholearm.common.arrays import Array
from wholearm.geometry.curve import Curve, Segment
from wholearm.planning.path_domain.motion import (
    Grid,
    PathMotion,
    Profile,
    arctanh_ratio,
    cosh_ratio,
    make_grid,
    redistribute_nodes,
    sinh_ratio,
)

SEEDS = range(6)


def stub_curve(length: float, breaks: list[float]) -> Curve:
    ends = [0.0, *breaks, length]
    stub: Any = SimpleNamespace(
        length=length,
        segments=tuple(Segment(a, b, np.ones(4), np.ones(2)) for a, b in pairwise(ends)),
        formation=SimpleNamespace(names=("v0-palm",)),
    )
    curve: Curve = stub
    return curve


def random_motion(seed: int) -> PathMotion:
    """From rest to rest over a random grid, with a jump of a where two segments meet."""
    rng = np.random.default_rng(seed)
    length, break_at = rng.uniform(0.02, 0.5), rng.uniform(0.2, 0.8)
    curve = stub_curve(length, [break_at * length])
    grid = make_grid(curve, 24)
    x = grid.s / length
    waves = rng.uniform(-0.4, 0.4, 2)
    a = (1 - 2 * x) * (1 + waves[0] * np.sin(5 * x)) + 0.3 * waves[1] * grid.segment
    a = rng.uniform(0.5, 20.0) * (a - np.dot(grid.steps, a[1:] + a[:-1]) / (2 * length))
    b = np.concatenate([[0.0], np.cumsum(grid.steps * (a[1:] + a[:-1]))])
    b[-1] = 0.0
    assert (b[1:-1] > 0).all()
    return PathMotion(curve, grid, Profile(a, b, rng.uniform(0, 1, len(a))))


@pytest.mark.parametrize("seed", SEEDS)
def test_motion_integrates_its_acceleration(seed: int) -> None:
    motion = random_motion(seed)
    grid, (a, _, _) = motion.grid, motion.profile
    state = np.zeros(2)
    for k in np.flatnonzero(grid.steps > 0):
        slope = (a[k + 1] - a[k]) / grid.steps[k]

        def rate(t: float, y: Array, k: int = int(k), slope: float = slope) -> list[float]:
            return [y[1], a[k] + slope * (y[0] - grid.s[k])]

        span = (motion.times[k], motion.times[k + 1])
        inner = np.linspace(*span, 7)
        result = solve_ivp(rate, span, state, t_eval=inner, method="DOP853", rtol=1e-13, atol=1e-16)
        s, _, here = motion.locate(inner[1:-1])
        # Each interval adds the integrator's 1e-13 relative.
        length = motion.curve.length
        np.testing.assert_allclose(s, result.y[0, 1:-1], rtol=0, atol=1e-12 * length)
        speed = np.sqrt(motion.profile.b.max())
        np.testing.assert_allclose(np.sqrt(here.b), result.y[1, 1:-1], rtol=0, atol=1e-11 * speed)
        state = result.y[:, -1]
    np.testing.assert_allclose(state, [motion.curve.length, 0.0], rtol=0, atol=1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_duration_is_the_integral_of_slowness(seed: int) -> None:
    motion = random_motion(seed)
    grid, (a, b, _) = motion.grid, motion.profile
    total = 0.0
    for k in np.flatnonzero(grid.steps > 0):
        h = grid.steps[k]

        def slowness(run: float, k: int = int(k), h: float = h) -> float:
            rise = (a[k + 1] - a[k]) / h
            return 1 / math.sqrt(b[k] + run * (2 * a[k] + rise * run))

        def from_end(run: float, k: int = int(k), h: float = h) -> float:
            rise = (a[k + 1] - a[k]) / h
            return 1 / math.sqrt(run * (-2 * a[k + 1] + rise * run))

        # At rest the integrand is singular; run = u^2 removes that.
        if b[k] == 0:
            part = quad(lambda u: 2 * u * slowness(u * u), 0, math.sqrt(h), epsabs=0)[0]
        elif b[k + 1] == 0:
            part = quad(lambda u: 2 * u * from_end(u * u), 0, math.sqrt(h), epsabs=0)[0]
        else:
            part = quad(slowness, 0, h, epsabs=0)[0]
        total += part
        assert motion.times[k + 1] - motion.times[k] == pytest.approx(part, rel=1e-10)
    assert motion.duration == pytest.approx(total, rel=1e-11)


@pytest.mark.parametrize("seed", SEEDS)
def test_profile_holds_the_derivatives_of_s(seed: int) -> None:
    motion = random_motion(seed)
    rng = np.random.default_rng(100 + seed)
    k = rng.choice(np.flatnonzero(motion.grid.steps > 0), 40)
    start, stop = motion.times[k], motion.times[k + 1]
    t = start + rng.uniform(0.2, 0.8, 40) * (stop - start)
    # Inside an interval s is smooth; the step trades 1e-16 / h^2 against h^2.
    h = 0.02 * (stop - start)
    before, (s, segment, here), after = (motion.locate(t + d) for d in (-h, 0 * h, h))
    speed, fastest = (after[0] - before[0]) / (2 * h), np.sqrt(motion.profile.b.max())
    np.testing.assert_allclose(np.sqrt(here.b), speed, rtol=0, atol=2e-4 * fastest)
    bend = (after[0] - 2 * s + before[0]) / h**2
    np.testing.assert_allclose(here.a, bend, rtol=0, atol=2e-4 * np.abs(motion.profile.a).max())
    np.testing.assert_array_equal(segment, motion.grid.segment[k])


@pytest.mark.parametrize("seed", SEEDS)
def test_nodes_are_passed_at_their_times(seed: int) -> None:
    motion = random_motion(seed)
    s, segment, here = motion.locate(motion.times[1:-1])
    # Slow ends: a time known to 1e-16 fixes s to the square root of nothing worse than this.
    np.testing.assert_allclose(s, motion.grid.s[1:-1], rtol=1e-12)
    later = np.append(motion.grid.steps[1:] > 0, True)[:-1]
    np.testing.assert_array_equal(segment[later], motion.grid.segment[1:-1][later])
    np.testing.assert_allclose(here.b, motion.profile.b[1:-1], rtol=1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_rest_at_both_ends_and_beyond(seed: int) -> None:
    motion = random_motion(seed)
    s, _, here = motion.locate(np.array([-1.0, 0.0, motion.duration, motion.duration + 1.0]))
    length = motion.curve.length
    np.testing.assert_allclose(s, [0, 0, length, length], rtol=0, atol=1e-13 * length)
    np.testing.assert_allclose(here.b, 0.0, atol=1e-12 * motion.profile.b.max())
    ends = motion.profile.a[[0, 0, -1, -1]]
    np.testing.assert_allclose(here.a, ends, rtol=1e-9)


def test_interval_of_length_zero_takes_no_time_and_jumps() -> None:
    motion = random_motion(0)
    (gap,) = np.flatnonzero(motion.grid.steps == 0)
    assert motion.times[gap] == motion.times[gap + 1]
    instant = 1e-9 * motion.duration
    _, segment, here = motion.locate(motion.times[gap] + np.array([-instant, instant]))
    assert segment.tolist() == [0, 1]
    np.testing.assert_allclose(here.a, motion.profile.a[[gap, gap + 1]], rtol=1e-6)
    assert abs(here.a[1] - here.a[0]) > 1e-3 * abs(here.a[0])
    np.testing.assert_allclose(here.squeeze, motion.profile.squeeze[[gap, gap + 1]], rtol=1e-5)


def test_a_run_out_of_near_rest() -> None:
    """Speed grows almost exponentially where a starts near zero; the time is known then."""
    tiny, slope = 1e-9, 4.0
    grid = Grid(np.array([0.0, 1.0]), np.zeros(2, dtype=np.int64))
    a = np.array([tiny, tiny + slope])
    motion = PathMotion(stub_curve(1.0, []), grid, Profile(a, np.array([0.0, a.sum()]), a))
    # s'' = tiny + slope s from rest: s = tiny / slope (cosh(sqrt(slope) t) - 1).
    exact = math.acosh(1 + slope / tiny) / math.sqrt(slope)
    # artanh near 1 loses half the digits of the distance to 1.
    assert motion.duration == pytest.approx(exact, rel=1e-6)


SERIES: dict[Any, Callable[[int], float]] = {
    sinh_ratio: lambda n: 1 / math.factorial(2 * n + 1),
    cosh_ratio: lambda n: 1 / math.factorial(2 * n + 2),
    arctanh_ratio: lambda n: 1 / (2 * n + 1),
}


@pytest.mark.parametrize("ratio", SERIES)
def test_ratios_match_their_series(ratio: Any) -> None:
    sizes = np.concatenate([[0.0], np.geomspace(1e-16, 0.4, 60), [1e-4, 1e-6]])
    x = np.concatenate([sizes, -sizes])
    expected = [math.fsum(SERIES[ratio](n) * v**n for n in range(60)) for v in x.tolist()]
    np.testing.assert_allclose(ratio(x), expected, rtol=4e-15)


def test_ratios_away_from_zero() -> None:
    root = np.linspace(0.7, 6.0, 50)
    np.testing.assert_allclose(sinh_ratio(root**2), np.sinh(root) / root, rtol=1e-14)
    np.testing.assert_allclose(sinh_ratio(-(root**2)), np.sin(root) / root, atol=1e-15)
    np.testing.assert_allclose(cosh_ratio(root**2), (np.cosh(root) - 1) / root**2, rtol=1e-14)
    np.testing.assert_allclose(cosh_ratio(-(root**2)), (1 - np.cos(root)) / root**2, atol=1e-15)
    np.testing.assert_allclose(arctanh_ratio(-(root**2)), np.arctan(root) / root, rtol=1e-14)
    part = np.linspace(0.7, 0.9999, 50)
    np.testing.assert_allclose(np.tanh(part * arctanh_ratio(part**2)), part, rtol=1e-13)


@pytest.mark.parametrize("intervals", [10, 11, 37, 80, 801])
@pytest.mark.parametrize("breaks", [[], [0.4], [0.01, 0.02], [0.3, 0.300001, 0.9], [1 - 1e-6]])
def test_grid_has_its_intervals_and_breaks(intervals: int, breaks: list[float]) -> None:
    length = 0.037
    curve = stub_curve(length, [length * part for part in breaks])
    grid = make_grid(curve, intervals)
    assert len(grid.s) == len(grid.segment) == intervals + 1
    assert grid.s[0] == 0.0 and grid.s[-1] == length
    assert (np.diff(grid.s) >= 0).all() and (np.diff(grid.segment) >= 0).all()
    # Of length zero are exactly the intervals between segments, at exactly their ends.
    np.testing.assert_array_equal(np.diff(grid.s) == 0, np.diff(grid.segment) == 1)
    ends = [segment.stop for segment in curve.segments]
    for index, segment in enumerate(curve.segments):
        mine = grid.s[grid.segment == index]
        assert len(mine) >= 2 and mine[0] == segment.start and mine[-1] == ends[index]


def test_grid_is_fine_towards_the_ends() -> None:
    steps = make_grid(stub_curve(1.0, []), 80).steps
    # Even in the angle of s = (1 - cos) / 2.
    expected = (np.cos(np.pi * np.arange(80) / 80) - np.cos(np.pi * np.arange(1, 81) / 80)) / 2
    np.testing.assert_allclose(steps, expected, rtol=1e-12)


def test_nodes_are_drawn_to_where_misses_are() -> None:
    curve = stub_curve(1.0, [0.4])
    grid = make_grid(curve, 60)
    nonempty = np.flatnonzero(grid.steps > 0)
    misses = np.zeros(len(nonempty))
    middle = (grid.s[nonempty] + grid.s[nonempty + 1]) / 2
    bad = np.abs(middle - 0.7) < 0.05
    misses[bad] = 9.0
    drawn = redistribute_nodes(grid, nonempty, misses)
    np.testing.assert_array_equal(drawn.segment, grid.segment)
    for segment in (0, 1):
        mine = grid.segment == segment
        assert drawn.s[mine][0] == grid.s[mine][0] and drawn.s[mine][-1] == grid.s[mine][-1]
        assert (np.diff(drawn.s[mine]) > 0).all()
    # A miss of 9 asks for three parts of such intervals; the other segment stays as it is.
    first = grid.segment == 0
    np.testing.assert_allclose(drawn.s[first], grid.s[first], rtol=0, atol=1e-15)
    within = [int((np.abs(s - 0.7) < 0.05).sum()) for s in (grid.s, drawn.s)]
    assert 1.5 * within[0] < within[1] <= 3 * within[0]


def test_drawing_together_is_capped_and_leaves_even_misses_alone() -> None:
    grid = make_grid(stub_curve(1.0, []), 40)
    nonempty = np.arange(40)
    even = redistribute_nodes(grid, nonempty, np.full(40, 7.0))
    np.testing.assert_allclose(even.s, grid.s, rtol=0, atol=1e-15)
    spike, beyond = np.zeros(40), np.zeros(40)
    spike[20], beyond[20] = 16.0, 1e9
    np.testing.assert_array_equal(
        redistribute_nodes(grid, nonempty, spike).s, redistribute_nodes(grid, nonempty, beyond).s
    )
