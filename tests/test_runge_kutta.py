from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from planned import plan
from wholearm.simulation import runge_kutta
from wholearm.simulation.layout import STATE
from wholearm.simulation.stepper import build_stepper


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
