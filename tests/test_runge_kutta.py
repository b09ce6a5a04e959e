"""Equations of motion that formations share, against those solved with NumPy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import wholearm
from planned import plan
from wholearm.simulation import runge_kutta
from wholearm.simulation.layout import STATE
from wholearm.simulation.modes import Grips, Mode, ModeRows, respond
from wholearm.simulation.stepper import build_stepper, share_mechanics


def test_rows_sum_to_nodes() -> None:
    sums = [sum(row.values()) for row in runge_kutta.ROWS]
    # The coefficients are rounded to 16 digits and reach 44.
    assert np.allclose(sums, runge_kutta.NODES, atol=2e-14, rtol=0)


@pytest.mark.parametrize("power", range(8))
def test_weights_integrate_polynomials(power: int) -> None:
    nodes = np.array(runge_kutta.NODES)
    total = sum(w * nodes[j] ** power for j, w in runge_kutta.WEIGHTS.items())
    assert total == pytest.approx(1 / (power + 1), abs=1e-14)


@pytest.mark.parametrize("weights", [runge_kutta.ERROR_5, runge_kutta.ERROR_3])
def test_error_weights_cancel(weights: dict[int, float]) -> None:
    assert sum(weights.values()) == pytest.approx(0, abs=1e-14)


def test_order_on_a_known_solution() -> None:
    """Two unknowns that move, and the integral of the rate of half the square of the first."""
    y, t, h = ca.SX.sym("y", 3), ca.SX.sym("t"), ca.SX.sym("h")

    def rate(state: ca.SX, time: ca.SX) -> ca.SX:
        assert state.shape == (2, 1)
        return ca.vertcat(state[1], -state[0], state[0] * state[1]) * ca.cos(time)

    step = ca.Function("step", [y, t, h], [runge_kutta.build_step(rate, y, t, h, 2)[0]])
    errors = []
    for count in (8, 16):
        state = np.array([0.0, 1.0, 0.0])
        for k in range(count):
            state = step(state, 3 * k / count, 3 / count).full()[:, 0]
        exact = np.sin(np.sin(3.0)), np.cos(np.sin(3.0)), np.sin(np.sin(3.0)) ** 2 / 2
        errors.append(np.abs(state - exact).max())
    assert np.log2(errors[0] / errors[1]) > 7.5


def test_error_estimate_bounds_the_error() -> None:
    y, t, h = ca.SX.sym("y", 1), ca.SX.sym("t"), ca.SX.sym("h")
    end, fifth, third = runge_kutta.build_step(lambda s, _: -s, y, t, h, 1)
    tolerance = 1e-6
    error = runge_kutta.build_error(fifth, third, y, 1.0, tolerance)
    step = ca.Function("step", [y, t, h], [end, error])
    for length in (0.2, 0.5, 1.0):
        state, estimate = (float(value) for value in step(1.0, 0.0, length))
        assert abs(state - np.exp(-length)) < float(estimate) * 2 * tolerance


def test_order_on_the_real_dynamics() -> None:
    _, trajectory = plan()
    motion = trajectory.motions[1]
    phase = plan()[0].phases[1]
    # One smooth piece for the whole phase, so that only the steps limit the error.
    torque = motion.fit(1, 24)  # type: ignore[attr-defined]
    s = build_stepper(phase.formation, phase.until, 1.0, 24)
    segment = motion.curve.segments[0]  # type: ignore[attr-defined]

    def integrate(count: int) -> np.ndarray:
        inputs, at = s.inputs, s.at
        start = motion.evaluate(np.array([0.05]))
        inputs[at.y] = [*start.z[0], *start.z_dot[0], *np.zeros(STATE - 10)]
        inputs[at.Xi], inputs[at.sigma] = segment.Xi, segment.sigma
        inputs[at.piece], inputs[at.torque] = torque.breaks, torque.coefficients.ravel()
        inputs[at.tolerance], inputs[at.heading] = 1e-9, start.z_dot[0]
        inputs[at.h] = 0.3 / count
        for k in range(count):
            inputs[at.t] = 0.05 + 0.3 * k / count
            s.step()
            inputs[at.y] = s.outputs[s.to.y]
        return np.array(s.outputs[s.to.y])

    fine = integrate(64)
    errors = [np.abs(integrate(count) - fine).max() for count in (3, 6)]
    # Errors stay above 1e-12, well clear of rounding.
    assert errors[1] > 1e-13
    assert np.log2(errors[0] / errors[1]) > 7.5
    exact = motion.evaluate(np.array([0.35]))
    # A single polynomial of degree 24 follows the torques to about 1e-8.
    assert np.allclose(fine[:10], np.hstack([exact.z[0], exact.z_dot[0]]), atol=1e-7, rtol=0)


@pytest.mark.parametrize("grips", [Grips(), Grips(contacts=((1,),)), Grips(joints=(0,))])
def test_rates_are_those_of_the_formations_own_rows(grips: Grips) -> None:
    problem = wholearm.load("problems/heptagon.toml")
    free = problem.phases[2].formation
    formations = [free] if len(grips) else [phase.formation for phase in problem.phases[:2]]
    rng = np.random.default_rng(3)
    shared = [share_mechanics(Mode(formation, grips), 1) for formation in formations]
    assert all(one is shared[0] for one in shared)
    for formation in formations:
        mode, at = Mode(formation, grips), shared[0].at
        state = np.zeros(STATE)
        state[:5] = problem.start + 0.01 * rng.standard_normal(5)
        state[5:10] = rng.standard_normal(5)
        signs = rng.choice([-1.0, 1.0], formation.n_contacts + 2)
        signs[[row for rows in grips.contacts for row in rows]] = 0.0
        signs[[formation.n_contacts + joint for joint in grips.joints]] = 0.0
        tau = rng.standard_normal(2)
        packed = np.zeros(at.size)
        packed[at.Xi], packed[at.sigma] = signs[:-2], signs[-2:]
        packed[at.piece], packed[at.torque] = (0.0, 2.0), [tau[0], 0.0, tau[1], 0.0]
        _, P, bend, A_t = mode.build_constraints(state[:5], state[5:10])
        rates, least, c_n = shared[0].stage(state[:10], 0.7, packed, P, bend, A_t)
        v = state[5:10]
        known = formation.evaluate(state[None, :5], v[None])
        turn = 1e-7 * v
        ahead, back = (formation.evaluate((state[:5] + k * turn)[None], v[None]) for k in (1, -1))
        bends = (ahead.A_t[0] - back.A_t[0]) @ v / 2e-7
        rows = ModeRows(known.A[0], known.A_t[0], known.A_dot_v[0], bends)
        response = respond(mode, signs, rows, v)
        assert response is not None
        load = np.array([1.0, *tau])
        expected = response.acceleration @ load
        assert np.asarray(rates)[5:10, 0] == pytest.approx(expected, rel=1e-6)
        held = response.force_limits @ load
        assert float(least) == pytest.approx((held / mode.force_limit_units).min(), rel=1e-6)
        assert np.asarray(c_n)[:, 0] == pytest.approx(held[: formation.n_contacts], rel=1e-6)
