"""Equations of motion that formations share, against those solved with NumPy."""

import numpy as np
import pytest

import wholearm
from wholearm.simulation.layout import STATE
from wholearm.simulation.modes import Grips, Mode, ModeRows, respond
from wholearm.simulation.stepper import share_mechanics


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
