from __future__ import annotations

import math
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from wholearm import Objective, PlanOptions, Problem
from wholearm.common.arrays import Array, find_minima
from wholearm.geometry.arcs import CostToGo
from wholearm.geometry.curve import Curve, Segment, directions_of
from wholearm.geometry.tracing import trace_phase, trace_phases
from wholearm.mechanics.dynamics import ONE, PathForces, inverse, metric_weights
from wholearm.planning.lower_bound.lower_bound import bound_least_time
from wholearm.planning.path_domain.elements import (
    DEGREE,
    FROM_REST,
    INSIDE,
    TO_REST,
    Profile,
    find_basis,
    lay_out,
)
from wholearm.planning.path_domain.path_data import PhaseData, choose_sampling, prepare
from wholearm.planning.path_domain.path_mesh import halve, make_grid
from wholearm.planning.path_domain.path_motion import PathMotion, fit_torque
from wholearm.planning.path_domain.path_plan import plan_path

PHASES = range(5)
EPSILON = 0.05


def direct_forces(curve: Curve, s: Array, segment: NDArray[np.int64]) -> PathForces:
    point = curve.evaluate(s)
    return inverse(curve.formation, *point[:3], directions_of(curve, segment))


def spots(data: PhaseData, fractions: Array) -> tuple[Array, NDArray[np.int64]]:
    """Arc lengths and segments of `fractions` of every solid interval."""
    s = data.grid.s[data.nonempty, None] + fractions * data.grid.steps[data.nonempty, None]
    return s.ravel(), np.repeat(data.grid.segment[data.nonempty], len(fractions))


def random_profile(data: PhaseData, seed: int) -> Profile:
    rng = np.random.default_rng(seed)
    shape = data.grid.s / data.curve.length
    a = 2.0 * (1 - 2 * shape) + rng.uniform(-0.1, 0.1, len(shape))
    a -= data.grid.integrate(a)[-1] / (2 * data.curve.length)
    b = np.maximum(data.grid.integrate(a), 0.0)
    b[-1] = 0.0
    return Profile(a, b, rng.uniform(1, 5, len(shape)))


@pytest.mark.parametrize("intervals", [20, 80])
@pytest.mark.parametrize("phase", PHASES)
def test_forces_between_nodes_are_carried_there(
    curves: tuple[Curve, ...], phase: int, intervals: int
) -> None:
    data = prepare(curves[phase], EPSILON, make_grid(curves[phase], np.zeros(0), intervals // 4), 1)
    for places, fractions in (
        (data.knots, data.sampling.knots),
        (data.checks, data.sampling.checks),
    ):
        s, segment = spots(data, fractions)
        expected = direct_forces(curves[phase], s, segment)
        for found, exact in zip(places.forces, expected, strict=True):
            np.testing.assert_allclose(found, exact, rtol=0, atol=1e-9 * np.abs(exact).max())
        rates = curves[phase].evaluate(s).z_s[:, 3:]
        np.testing.assert_allclose(places.rates, rates, rtol=0, atol=1e-9 * np.abs(rates).max())
    nodes = direct_forces(curves[phase], data.grid.s, data.grid.segment)
    for found, exact in zip(data.nodes.forces, nodes, strict=True):
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-13 * np.abs(exact).max())


def test_least_values_between_looks() -> None:
    x = np.linspace(0.0, 1.0, 17)
    rng = np.random.default_rng(6)
    places, heights = rng.uniform(0.1, 0.9, 50), rng.uniform(-1, 1, 50)
    parabolas = 3 * (x - places[:, None]) ** 2 + heights[:, None]
    least = find_minima(parabolas[:, :, None])[:, 0]
    np.testing.assert_allclose(least, heights, rtol=0, atol=1e-14)
    # Without a dip it is the lesser end; a kink is met at least where it was looked at.
    lines = np.outer(rng.uniform(-1, 1, 50), x)
    np.testing.assert_array_equal(find_minima(lines[:, :, None])[:, 0], lines.min(axis=1))
    kinks = np.abs(x - places[:, None])
    assert (find_minima(kinks[:, :, None])[:, 0] <= kinks.min(axis=1)).all()


def test_slack_is_in_its_order(curves: tuple[Curve, ...]) -> None:
    data = prepare(curves[0], EPSILON, make_grid(curves[0], np.zeros(0), 5), 1)
    profile = random_profile(data, 1)
    slack = data.slack(data.nodes, profile, margin=0.3)
    forces = direct_forces(curves[0], data.grid.s, data.grid.segment)
    c_n, tau = forces.c(*profile), forces.tau(*profile)
    np.testing.assert_allclose(slack[:, :4], c_n - EPSILON - 0.3, atol=1e-11)
    np.testing.assert_allclose(slack[:, 4:6], tau + 2.0, atol=1e-11)
    np.testing.assert_allclose(slack[:, 6:], 2.0 - tau, atol=1e-11)


@pytest.mark.parametrize("phase, contact, row", [(0, 0, 37), (1, 3, 500), (3, 1, 0), (4, 2, 1199)])
def test_a_planted_miss_is_found(
    curves: tuple[Curve, ...], phase: int, contact: int, row: int
) -> None:
    data = prepare(curves[phase], EPSILON, make_grid(curves[phase], np.zeros(0), 21), 1)
    motion = plan_path(curves[phase], EPSILON, PlanOptions(intervals=81), 1).motion
    data = prepare(curves[phase], EPSILON, motion.grid, 1)
    short, speeding = data.misses(motion.profile, 0.0)
    assert short.max() <= 5e-7 and speeding.max() == 0.0
    row = min(row, len(data.checks.rates) - 1)
    here = data.slack(data.checks, data.interpolate(motion.profile, data.sampling.checks))[
        row, contact
    ]
    C = data.checks.forces.of_c.copy()
    C[row, contact, ONE] -= here + 0.25
    planted = data._replace(checks=data.checks._replace(forces=data.checks.forces._replace(of_c=C)))
    short, _ = planted.misses(motion.profile, 0.0)
    interval = row // len(data.sampling.checks)
    # A parabola through the place and its neighbours may dip a little beyond it.
    assert 0.25 - 1e-9 <= short[interval, contact] <= 0.25 + 0.04
    short[:, contact] = 0.0
    assert short.max() <= 5e-7


@pytest.mark.parametrize("phase", [1, 4])
def test_effort_is_the_integral_of_squared_torque(curves: tuple[Curve, ...], phase: int) -> None:
    curve = curves[phase]
    motion = plan_path(curve, EPSILON, PlanOptions(objective="effort"), 1).motion
    _, squares = fit_torque(prepare(curve, EPSILON, motion.grid, 1), motion)

    # tau has a kink at every node, so the rule is for single intervals.
    x, weights = np.polynomial.legendre.leggauss(12)
    h = np.diff(motion.times)[:, None]
    t = motion.times[:-1, None] + h * (x + 1) / 2
    power = (motion.evaluate(t.ravel()).tau ** 2).sum(axis=1).reshape(t.shape)
    assert squares == pytest.approx((h / 2 * weights * power).sum(), rel=1e-7)


@pytest.mark.parametrize("nodes", [11, 81])
@pytest.mark.parametrize("deepest", [3e-3, 0.01, 0.05])
def test_dips_next_to_rest_are_found(nodes: int, deepest: float) -> None:
    """Viscous friction goes with the root of the way: x - 2 sqrt(deepest x) is least there."""
    x = choose_sampling(nodes).checks
    values = x - 2 * np.sqrt(deepest * x)
    for sampled in (values, values[::-1]):
        least = find_minima(sampled[None, :, None])[0, 0]
        # A look next to the dip, and the parabola through it, miss little of it.
        assert least == pytest.approx(-deepest, rel=0.1)


SEEDS = range(4)


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
    grid = make_grid(curve, np.zeros(0), 6)
    x = grid.s / length
    waves = rng.uniform(-0.4, 0.4, 2)
    a = (1 - 2 * x) * (1 + waves[0] * np.sin(5 * x)) + 0.3 * waves[1] * grid.segment
    a = rng.uniform(0.5, 20.0) * (a - grid.integrate(a)[-1] / (2 * length))
    b = grid.integrate(a)
    b[-1] = 0.0
    assert (b[1:-1] > 0).all()
    return PathMotion(curve, grid, Profile(a, b, rng.uniform(0, 1, len(a))))


def acceleration(motion: PathMotion, element: int, s: Array) -> Array:
    """S'' at places of an element, by an interpolation of its own."""
    grid = motion.grid
    start, stop = grid.edges[element]
    share = np.clip((s - start) / (stop - start), 0.0, 1.0)
    kind = int(grid.kinds[element])
    y = {INSIDE: share, FROM_REST: np.sqrt(share), TO_REST: np.sqrt(1 - share)}[kind]
    nodes = find_basis().y[kind]
    own = motion.profile.a[element * (DEGREE + 1) : (element + 1) * (DEGREE + 1)]
    return np.polyval(np.polyfit(nodes, own, DEGREE), y)


@pytest.mark.parametrize("seed", SEEDS)
def test_motion_integrates_its_acceleration(seed: int) -> None:
    """S'' is that of the elements, s' its integral over time, and s that of s'."""
    motion = random_motion(seed)
    length, nodes, weights = motion.curve.length, *np.polynomial.legendre.leggauss(20)
    speed, place = 0.0, 0.0
    for k in motion.grid.nonempty.tolist():
        start, stop = motion.times[k], motion.times[k + 1]
        t = start + (1 + nodes) / 2 * (stop - start)
        s, _, here = motion.locate(t)
        expected = acceleration(motion, k // (DEGREE + 1), s)
        scale = np.abs(motion.profile.a).max()
        np.testing.assert_allclose(here.a, expected, rtol=0, atol=1e-9 * scale)
        place += (stop - start) / 2 * float(weights @ np.sqrt(here.b))
        speed += (stop - start) / 2 * float(weights @ here.a)
        assert place == pytest.approx(motion.grid.s[k + 1], abs=1e-10 * length)
        top = math.sqrt(motion.profile.b.max())
        assert speed == pytest.approx(math.sqrt(motion.profile.b[k + 1]), abs=1e-9 * top)


def test_interval_of_length_zero_takes_no_time_and_jumps() -> None:
    motion = random_motion(0)
    (gap,) = np.flatnonzero(np.diff(motion.grid.segment))
    assert motion.grid.steps[gap] == 0.0 and motion.times[gap] == motion.times[gap + 1]
    instant = 1e-9 * motion.duration
    _, segment, here = motion.locate(motion.times[gap] + np.array([-instant, instant]))
    assert segment.tolist() == [0, 1]
    np.testing.assert_allclose(here.a, motion.profile.a[[gap, gap + 1]], rtol=1e-6)
    assert abs(here.a[1] - here.a[0]) > 1e-3 * abs(here.a[0])
    np.testing.assert_allclose(here.lam, motion.profile.lam[[gap, gap + 1]], rtol=1e-5)


def test_a_stall_is_seen() -> None:
    """The speed all but vanishes in the middle of an element, though not at its nodes."""
    edges = np.array([[0.0, 0.4], [0.4, 0.6], [0.6, 1.0]])
    grid = lay_out(edges, np.zeros(3, dtype=np.int64), (True, True))
    dip = np.where((grid.s >= 0.4) & (grid.s <= 0.6), 0.9, 0.0)
    y = np.clip((grid.s - 0.4) / 0.2, 0.0, 1.0)
    b = np.where(dip > 0, (y - 0.3) ** 2 + 1e-12, grid.s * (1 - grid.s))
    a = np.where(dip > 0, (y - 0.3) / 0.2, 0.5 - grid.s)
    smooth = np.where(dip > 0, 0.24, b)
    stalled, moving = (
        PathMotion(stub_curve(1.0, []), grid, Profile(own_a, own_b, own_a))
        for own_a, own_b in ((a, b), (np.where(dip > 0, 0.0, a), smooth))
    )
    assert stalled.stalls and not moving.stalls


@pytest.mark.parametrize("elements", [6, 7, 37])
@pytest.mark.parametrize("breaks", [[], [0.4], [0.01, 0.02], [0.3, 0.300001, 0.9], [1 - 1e-6]])
def test_grid_has_its_elements_and_breaks(elements: int, breaks: list[float]) -> None:
    length = 0.037
    curve = stub_curve(length, [length * part for part in breaks])
    switches = length * np.array([0.123, 0.777])
    grid = make_grid(curve, switches, elements)
    assert len(grid.s) == len(grid.segment) == elements * (DEGREE + 1)
    assert grid.s[0] == 0.0 and grid.s[-1] == length
    assert (np.diff(grid.s) >= 0).all() and (np.diff(grid.segment) >= 0).all()
    # Of length zero are exactly the intervals between elements.
    gaps = np.flatnonzero(np.diff(grid.s) == 0)
    np.testing.assert_array_equal(gaps, DEGREE + (DEGREE + 1) * np.arange(elements - 1))
    assert set(switches) <= set(grid.edges[:, 0])
    for index, segment in enumerate(curve.segments):
        mine = grid.s[grid.segment == index]
        assert len(mine) >= 2 and mine[0] == segment.start and mine[-1] == segment.stop
    assert grid.kinds.tolist() == [FROM_REST, *[INSIDE] * (elements - 2), TO_REST]


def test_a_margin_takes_the_duration_that_is_allowed(curves: tuple[Curve, ...]) -> None:
    least = bound_least_time([curves[0]], EPSILON)
    assert least is not None
    allowed = 1.5 * least.value
    options = PlanOptions(objective=Objective.MARGIN)
    plan = plan_path(curves[0], EPSILON, options, 1, allowed)
    assert plan.value > EPSILON
    # With that margin no motion is faster.
    bound = bound_least_time([curves[0]], plan.value)
    assert bound is not None
    assert bound.value == pytest.approx(allowed, rel=1e-3)


def test_a_margin_that_a_place_limits_does_not_grow_with_the_duration(
    curves: tuple[Curve, ...],
) -> None:
    """At the start of this phase no contact can press harder, however long a motion takes."""
    curve = curves[2]
    bound = bound_least_time([curve], EPSILON)
    assert bound is not None
    at_once, at_leisure = (
        plan_path(
            curve, EPSILON, PlanOptions(objective=Objective.MARGIN), 3, ratio * bound.value
        ).value
        for ratio in (2.0, 3.0)
    )
    assert at_leisure == pytest.approx(at_once, rel=5e-4)


def test_what_costs_most_is_halved() -> None:
    edges = np.array([[0.0, 1.0], [1.0, 2.0], [2.0, 4.0]])
    costs = np.repeat([1.0, 0.1, 100.0], DEGREE + 1)
    # A half costs a 64th: of the last one, once halved, either more than the first.
    np.testing.assert_allclose(halve(edges, costs, 1), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(halve(edges, costs, 4), [0.5, 1.0, 2.0, 2.5, 3.0, 3.5])


def test_the_gradient_of_a_linear_cost_is_its_part_along_the_curve(heptagon: Problem) -> None:
    phase = heptagon.phases[1]
    curve = trace_phases(heptagon)[1]
    slope = np.random.default_rng(4).normal(size=5)
    value, gradient = CostToGo(phase, lambda z: float(slope @ z)).expand(curve.start)
    tangent = curve.evaluate(np.zeros(1)).z_s[0]
    assert value == pytest.approx(slope @ curve.start)
    # A quotient of differences over a hundredth of a curve that bends.
    assert gradient @ tangent == pytest.approx(slope @ tangent, rel=0, abs=0.1)
    # In the metric of curves it has no part across.
    across = gradient / metric_weights(heptagon.scene) - (gradient @ tangent) * tangent
    np.testing.assert_allclose(across, 0.0, atol=1e-12 * np.abs(gradient).max())


def test_less_way_costs_less_time(heptagon: Problem) -> None:
    phase, curve = heptagon.phases[1], trace_phases(heptagon)[1]
    options = PlanOptions(intervals=40)

    def least_time(z: Array) -> float:
        return plan_path(trace_phase(phase, z), heptagon.epsilon, options, 1).value

    value, gradient = CostToGo(phase, least_time).expand(curve.start)
    tangent = curve.evaluate(np.zeros(1)).z_s[0]
    # Forwards, and with steps of another length: what is left is the bend of the time.
    ahead = 0.02 * curve.length
    slope = (least_time(curve.evaluate(np.array([ahead])).z[0]) - value) / ahead
    assert slope < 0
    assert gradient @ tangent == pytest.approx(slope, rel=0.05)
