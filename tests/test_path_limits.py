"""Limits along paths and speed sweeps, against linear programmes and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog

from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation
from wholearm.geometry.curve import Curve, directions_of
from wholearm.mechanics.dynamics import LAMBDA, ONE, A, B, V, build_forward, inverse, stack_motion
from wholearm.mechanics.limits import LimitSet, make_limits
from wholearm.mechanics.path_limits import PathLimits, find_speed_cap
from wholearm.planning.lower_bound.speed_sweep import (
    NoMotionError,
    SweepMode,
    find_duration,
    make_cosine_grid,
    speed_sweep,
)

EPSILON = 0.05
FREE = (None, None)


def limit_fast(formation: Formation) -> Formation:
    """The formation with limits of the joint speeds."""
    scene = formation.scene
    one, two = (replace(finger, speed_limit=3.0) for finger in scene.fingers)
    return replace(formation, scene=replace(scene, fingers=(one, two)))


@pytest.mark.parametrize("phase", [0, 2])
def test_slack_is_that_of_the_motion(curves: tuple[Curve, ...], phase: int) -> None:
    """Contact forces by forward dynamics under the torques of the coefficients."""
    curve, rng, count = curves[phase], np.random.default_rng(phase), 40
    formation = limit_fast(curve.formation)
    s = rng.uniform(0, curve.length, count)
    point, segment = curve.evaluate(s), np.searchsorted([p.stop for p in curve.segments[:-1]], s)
    a, b, internal = (rng.uniform(*ends, count) for ends in ((-9, 9), (0, 2), (0, 5)))
    directions = directions_of(curve, segment)
    forces = inverse(formation, *point[:3], directions, point.kinematics)
    tau, z_dot = forces.tau(a, b, internal), point.z_s * np.sqrt(b)[:, None]
    forward = build_forward(formation).map(count)
    signs = (part.T for part in directions)
    acceleration, c, _ = forward(point.z.T, z_dot.T, tau.T, *signs)
    z_ddot = point.z_s * a[:, None] + point.z_ss * b[:, None]
    np.testing.assert_allclose(acceleration.full().T, z_ddot, atol=1e-8)
    limits = make_limits(formation, EPSILON)
    values = np.hstack([c.full().T, tau, z_dot[:, 3:]]) @ limits.rows.T
    rows = limits.sides[0]
    slack = limits.find_slack(values) / limits.scales[rows]
    fast = np.isin(rows, limits.of("speed"))
    found = PathLimits.of(limits, forces, point.z_s[:, 3:])
    np.testing.assert_allclose(found.find_slack(a, b, internal), slack[:, ~fast], atol=1e-9)
    np.testing.assert_array_equal(b <= found.cap, (slack[:, fast] >= 0).all(axis=1))
    # At the places of the curve with half of its parameter.
    halved = found.scale(0.5)
    np.testing.assert_allclose(
        halved.find_slack(2 * a, 4 * b, internal), slack[:, ~fast], atol=1e-9
    )
    np.testing.assert_allclose(halved.cap, 4 * found.cap)


def test_a_limit_of_both_joint_speeds_bounds_the_speed() -> None:
    formation_rows = np.array([[0.0, 0.0, 0.0, 1.0, -1.0]])

    class Sum:
        rows, low, high = formation_rows, np.array([-3.0]), np.array([2.0])

    limits = LimitSet((Sum(),))  # type: ignore[arg-type]
    rates = np.array([[4.0, 2.0], [2.0, 5.0], [1.0, 1.0]])
    np.testing.assert_array_equal(find_speed_cap(limits, rates), [1.0, 1.0, np.inf])


def draw(rng: np.random.Generator, places: int, rows: int = 6) -> PathLimits:
    """Random limits, with room around rest."""
    table = rng.normal(size=(places, rows, 5))
    table[..., ONE] = rng.uniform(0.1, 1.0, (places, rows))
    table[:, 0, LAMBDA] = 0.0
    return PathLimits(table, np.full(places, np.inf))


def test_elimination_leaves_what_is_possible() -> None:
    limits, rng = draw(np.random.default_rng(4), 60), np.random.default_rng(5)
    left = limits.eliminate()
    a, b = rng.normal(size=60), rng.uniform(0, 2, 60)
    low, high = limits.find_internal_force_range(a, b)
    seen = set()
    for k, row in enumerate(limits.rows):
        fixed = row @ stack_motion(a[[k]], b[[k]], np.zeros(1))[0]
        found = linprog([1.0], A_ub=-row[:, [LAMBDA]], b_ub=fixed, bounds=[FREE])
        possible = found.status in (0, 3)
        motion = stack_motion(a[[k]], b[[k]], np.zeros(1))[0, :LAMBDA]
        assert bool((left.rows[k] @ motion >= 0).all()) == possible == bool(low[k] <= high[k])
        if found.status == 0:
            assert low[k] == pytest.approx(found.x[0], abs=1e-9)
        seen.add(possible)
    assert seen == {True, False}


@pytest.mark.parametrize("largest", [True, False])
def test_extremes_are_those_of_a_linear_programme(largest: bool) -> None:
    limits, b = draw(np.random.default_rng(6), 60), np.random.default_rng(7).uniform(0.01, 0.1, 60)
    left = limits.eliminate()
    found, step = left.extreme(b, largest), 1e-7
    slope = (left.extreme(b + step, largest).a - left.extreme(b - step, largest).a) / (2 * step)
    pairs = limits.pair(found.row)
    a, internal = limits.meet(b, pairs)
    checked = 0
    for k, row in enumerate(limits.rows):
        fixed = row[:, ONE] + row[:, B] * b[k] + row[:, V] * np.sqrt(b[k])
        sign = -1.0 if largest else 1.0
        best = linprog([sign, 0.0], A_ub=-row[:, [A, LAMBDA]], b_ub=fixed, bounds=[FREE, FREE])
        if best.status != 0:
            continue
        checked += 1
        assert found.a[k] == pytest.approx(best.x[0], abs=1e-8)
        assert found.slope[k] == pytest.approx(slope[k], rel=1e-5)
        assert a[k] == pytest.approx(best.x[0], abs=1e-7)
        # The first row alone, without lambda, leaves it a range.
        if 0 not in pairs[k]:
            assert internal[k] == pytest.approx(best.x[1], abs=1e-7)
        other = limits.meet(b, pairs, np.full((60, 2), 0.3))
        slack = limits.find_slack(other[0], b, other[1])[k, pairs[k]]
        assert slack == pytest.approx([0.3, 0.3], abs=1e-8)
    assert checked > 20


@pytest.mark.parametrize("largest", [True, False])
def test_rows_that_say_the_same_are_told_apart_by_their_order(largest: bool) -> None:
    """Not by rounding: where a limit has no internal force, all its pairs are one."""
    rng, sign = np.random.default_rng(0), 1.0 if largest else -1.0
    a, b, v, one = (np.tile(rng.uniform(1, 2, (50, 1)), 3) for _ in range(4))
    noise = 1 + 1e-14 * rng.uniform(-1, 1, one.shape)
    # The last one is farther away by a millionth.
    farther = np.array([1.0, 1.0, 1.0 + 1e-6])
    for factor, first in ((farther, 0), (2 - farther, 2)):
        rows = np.stack([(one * noise + 5.0) * factor, -sign * a, -b, v], axis=-1)
        limits = PathLimits(rows, np.full(50, np.inf))
        np.testing.assert_array_equal(limits.extreme(np.ones(50), largest).row, first)


def solve_sweep(limits: PathLimits, steps: Array, part: Array, cap: Array) -> Array | None:
    """The largest b at all nodes at once, from rest to rest; no row has viscous terms."""
    count, rows, right = len(steps), [], []
    for k, table in enumerate(limits.rows):
        for one, a, b, *_ in table:
            row = np.zeros(count + 1)
            row[k] = (1 - part[k]) * b - a / (2 * steps[k])
            row[k + 1] = part[k] * b + a / (2 * steps[k])
            rows.append(-row)
            right.append(one)
    bounds = [(0, 0), *((0, None if np.isinf(most) else most) for most in cap[1:-1]), (0, 0)]
    found = linprog(-np.ones(count + 1), A_ub=rows, b_ub=right, bounds=bounds)
    return np.asarray(found.x) if found.status == 0 else None


def test_sweeps_are_solutions_of_a_linear_programme() -> None:
    """The set of feasible b is closed under maxima: one profile is largest at all nodes."""
    rng, count, solved = np.random.default_rng(8), 12, 0
    steps, _, part = make_cosine_grid(count)
    every = []
    for _ in range(30):
        rows = rng.normal(size=(count, 5, 4)) * [0.0, 0.0, 0.3, 0.0]
        rows[..., ONE] = rng.uniform(0.3, 1.0, (count, 5))
        # With nearly no part of s'' two limits could trade b at one node for that at the next.
        rows[..., A] = rng.uniform(0.5, 1.5, (count, 5)) * [1.0, -1.0, 1.0, -1.0, 1.0]
        cap = np.array([np.inf, *rng.uniform(0.1, 1.0, count - 1), np.inf])
        limits = PathLimits(rows, np.full(count, np.inf))
        best = solve_sweep(limits, steps, part, cap)
        if best is None:
            continue
        found = speed_sweep(limits, steps, part, cap)
        assert found.b == pytest.approx(best, abs=1e-8)
        every.append((rows, cap, found))
        solved += 1
    assert solved > 15
    # Together they are the same as one by one.
    rows, cap = (np.stack([case[k] for case in every]) for k in range(2))
    whole = speed_sweep(PathLimits(rows, cap[:, 1:]), steps, part, cap)
    np.testing.assert_array_equal(whole.b, [case[2].b for case in every])
    np.testing.assert_array_equal(whole.modes, [case[2].modes for case in every])
    times = [float(find_duration(case[2].b, steps)) for case in every]
    assert whole.find_durations(steps) == pytest.approx(times, rel=1e-12)


LENGTH, COUNT = 2.0, 64
STEPS, PART = np.full(COUNT, LENGTH / COUNT), np.full(COUNT, 0.5)


def push() -> PathLimits:
    """|s''| <= 1 along a path."""
    rows = np.zeros((COUNT, 2, 4))
    rows[..., ONE], rows[..., A] = 1.0, [1.0, -1.0]
    return PathLimits(rows, np.full(COUNT, np.inf))


def test_half_the_path_is_for_speeding_up_and_half_for_braking() -> None:
    found = speed_sweep(push(), STEPS, PART)
    # With s'' the same in each interval this motion is on the grid, where intervals are even.
    assert find_duration(found.b, STEPS) == pytest.approx(2 * np.sqrt(LENGTH), rel=1e-9)
    assert {*found.modes[: COUNT // 2 - 1]} == {SweepMode.PUSH}
    assert {*found.modes[COUNT // 2 :]} == {SweepMode.BRAKE}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("drag", [0.0, 0.1])
def test_a_closed_place_lets_no_motion_pass(drag: float) -> None:
    limits, closed = push(), slice(0, COUNT // 4)
    limits.rows[..., V] = -drag
    limits.rows[closed, :, A], limits.rows[closed, :, ONE] = 0.0, -1.0
    both = PathLimits(np.stack([limits.rows, push().rows]), np.full((2, COUNT), np.inf))
    found = speed_sweep(both, STEPS, PART, sweeps=2).find_durations(STEPS)
    assert found[0] == np.inf and np.isfinite(found[1])
    with pytest.raises(NoMotionError):
        speed_sweep(limits, STEPS, PART)


@pytest.mark.parametrize("cap", [3.0, 5.0])
def test_a_motion_has_to_be_as_fast_as_the_end_asks_for(cap: float) -> None:
    """At the end s'' is -2, so that rest is reached over 1 m from b = 4, which the cap forbids."""
    rows = np.zeros((2, 2, 4))
    rows[..., A], rows[..., ONE] = [1.0, -1.0], [[10.0, 10.0], [2.0, -2.0]]
    sweep = PathLimits(rows, np.full(2, cap)), np.ones(2), np.full(2, 0.5)
    if cap < 4.0:
        with pytest.raises(NoMotionError):
            speed_sweep(*sweep)
    else:
        assert speed_sweep(*sweep).b == pytest.approx([0.0, 4.0, 0.0], abs=1e-12)


def test_rest_is_possible_where_some_acceleration_is() -> None:
    rows = np.zeros((4, 2, 4))
    rows[..., A] = [[1.0, -1.0], [1.0, -1.0], [1.0, -1.0], [0.0, 0.0]]
    rows[..., ONE] = [[1.0, 1.0], [3.0, -2.0], [-2.0, 3.0], [-1.0, 1.0]]
    limits = PathLimits(rows, np.full(4, np.inf))
    assert limits.can_rest().tolist() == [True, False, True, False]
    assert limits.can_rest(-1.0).tolist() == [True, True, False, False]
