from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from plane import with_speed_limit
from wholearm.common.arrays import Array, find_minima
from wholearm.common.errors import JammingError
from wholearm.contacts.formation import Formation
from wholearm.geometry.curve import Curve
from wholearm.mechanics.dynamics import PathForces, inverse
from wholearm.planning.lower_bound.rows import directions_of
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.elements import Profile
from wholearm.planning.path_domain.interpolation import fit_torque
from wholearm.planning.path_domain.path_data import PhaseData, choose_sampling, prepare
from wholearm.planning.path_domain.path_mesh import Mesh
from wholearm.planning.path_domain.path_plan import plan_path
from wholearm.scene.model import Friction, Scene

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
    data = prepare(curves[phase], EPSILON, Mesh().make_grid(curves[phase], intervals // 4), 1)
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


def test_looks_are_dense_enough(curves: tuple[Curve, ...]) -> None:
    for intervals, least in ((12, 33), (40, 33), (80, 15), (800, 15)):
        data = prepare(curves[0], EPSILON, Mesh().make_grid(curves[0], intervals // 4), 1)
        angles = np.arccos(1 - 2 * data.sampling.checks) / np.pi
        for places in (data.sampling.knots, angles):
            assert places[0] == 0.0 and places[-1] == pytest.approx(1.0)
            np.testing.assert_allclose(np.diff(places), 1 / (len(places) - 1), rtol=1e-12)
        assert len(data.sampling.checks) >= least


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
    data = prepare(curves[0], EPSILON, Mesh().make_grid(curves[0], 5), 1)
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
    data = prepare(curves[phase], EPSILON, Mesh().make_grid(curves[phase], 21), 1)
    motion = plan_path(curves[phase], EPSILON, PlanOptions(intervals=81), 1).motion
    data = prepare(curves[phase], EPSILON, motion.grid, 1)
    short, speeding, spare = data.misses(motion.profile, 0.0)
    assert short.max() <= 5e-7 and speeding.max() == 0.0
    assert spare.min() >= 0.0 and not (spare * short).any()
    row = min(row, len(data.checks.rates) - 1)
    here = data.slack(data.checks, data.interpolate(motion.profile, data.sampling.checks))[
        row, contact
    ]
    C0 = data.checks.forces.C0.copy()
    C0[row, contact] -= here + 0.25
    planted = data._replace(checks=data.checks._replace(forces=data.checks.forces._replace(C0=C0)))
    short, *_ = planted.misses(motion.profile, 0.0)
    interval = row // len(data.sampling.checks)
    # A parabola through the place and its neighbours may dip a little beyond it.
    assert 0.25 - 1e-9 <= short[interval, contact] <= 0.25 + 0.04
    short[:, contact] = 0.0
    assert short.max() <= 5e-7


def test_misses_of_the_margin_and_of_torques(curves: tuple[Curve, ...]) -> None:
    data = prepare(curves[2], EPSILON, Mesh().make_grid(curves[2], 20), 1)
    profile = random_profile(data, 2)
    low, high = data.misses(profile, 0.0)[0], data.misses(profile, 10.0)[0]
    both = (low[:, :4] > 0) & (high[:, :4] > 0)
    assert both.any()
    np.testing.assert_allclose((high - low)[:, :4][both], 10.0, rtol=1e-12)
    np.testing.assert_array_equal(low[:, 4:], high[:, 4:])
    checks = data.slack(data.checks, data.interpolate(profile, data.sampling.checks))
    worst = np.maximum(-checks, 0).reshape(len(data.nonempty), -1, 8).max(axis=1)
    assert (low >= worst).all()
    np.testing.assert_allclose(low, worst, rtol=0, atol=1e-3)


def test_spread_is_exact_at_nodes_and_between(curves: tuple[Curve, ...]) -> None:
    data = prepare(curves[0], EPSILON, Mesh().make_grid(curves[0], 8), 1)
    profile, k, h = random_profile(data, 3), data.nonempty, data.grid.steps[data.nonempty]
    ends = data.interpolate(profile, np.array([0.0, 1.0]))
    # b' = 2 a has been integrated with the same rule, but for the rounding of powers of degree 4.
    for found, exact in zip(ends, profile, strict=True):
        pairs = np.column_stack([exact[k], exact[k + 1]]).ravel()
        np.testing.assert_allclose(found, pairs, rtol=0, atol=1e-12 * np.abs(exact).max())
    part = data.interpolate(profile, np.array([0.4, 0.4 + 1e-4]))
    slope = np.diff(part.b.reshape(-1, 2))[:, 0] / (1e-4 * h)
    middle = part.a.reshape(-1, 2).mean(axis=1)
    np.testing.assert_allclose(slope, 2 * middle, rtol=0, atol=1e-6)


def test_beside_takes_the_larger_neighbour(curves: tuple[Curve, ...]) -> None:
    data = prepare(curves[0], EPSILON, Mesh().make_grid(curves[0], 8), 1)
    inside = np.random.default_rng(4).uniform(0, 1, (len(data.nonempty), 3))
    nodes = data.spread_to_nodes(inside)
    for node in range(len(data.grid.s)):
        near = [inside[i] for i, k in enumerate(data.nonempty) if node in (k, k + 1)]
        np.testing.assert_array_equal(nodes[node], np.max(near, axis=0))


def test_speed_limits_bound_b(curves: tuple[Curve, ...]) -> None:
    free = prepare(curves[1], EPSILON, Mesh().make_grid(curves[1], 5), 1)
    assert np.isposinf(free.largest_b(free.nodes)).all()
    data = prepare(with_speed_limit(curves[1], (1.5, np.inf)), EPSILON, free.grid, 1)
    largest = data.largest_b(data.nodes)
    np.testing.assert_allclose(np.abs(data.nodes.rates[:, 0]) * np.sqrt(largest), 1.5, rtol=1e-12)
    profile = random_profile(data, 5)
    _, speeding, _ = data.misses(profile, 0.0)
    b = data.interpolate(profile, data.sampling.checks).b.reshape(len(data.nonempty), -1)
    rates = data.checks.rates[:, 0].reshape(b.shape)
    over = np.maximum(b * rates**2 / 1.5**2 - 1, 0.0).max(axis=1)
    # Parabolas see a little more than places do.
    np.testing.assert_allclose(speeding, over, rtol=0, atol=1e-4)
    assert over.max() > 0.1


@pytest.mark.parametrize("phase", PHASES)
def test_torque_polynomials_follow_inverse_dynamics(curves: tuple[Curve, ...], phase: int) -> None:
    curve, rng = curves[phase], np.random.default_rng(phase)
    plan = plan_path(curve, EPSILON, PlanOptions(), 1)
    t = np.sort(rng.uniform(0.0, plan.motion.duration, 400))
    exact = plan.motion.evaluate(t).tau
    found = plan.torque.at(t)
    # Quartic interpolation of torques up to 2 N m over intervals of 1/80: (1/80)^5 is 3e-10, times
    # the derivatives that the slow ends bring.
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-6)
    assert plan.torque.breaks[0] == 0.0
    assert plan.torque.breaks[-1] == plan.motion.duration


@pytest.mark.parametrize("phase", PHASES)
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


def test_jamming_is_named(curves: tuple[Curve, ...]) -> None:
    scene = curves[0].formation.scene
    rough = Scene(scene.polygon, scene.fingers, Friction(1.5, 1.5, 1.5), scene.gravity)
    curve = replace(curves[0], formation=Formation(rough, curves[0].formation.contacts))
    with pytest.raises(JammingError, match=r"phase 7: v0-palm v1-palm .* jams at x = .* inertia -"):
        prepare(curve, EPSILON, Mesh().make_grid(curve, 5), 7)


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
