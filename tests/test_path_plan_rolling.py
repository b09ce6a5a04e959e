from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from plane import measure_slip, place_corners, unbalance
from tipping import box, tip
from wholearm.common.arrays import Array
from wholearm.common.errors import InfeasibleError, SolverError
from wholearm.contacts.formation import Formation
from wholearm.geometry.curve import Curve
from wholearm.mechanics.dynamics import split_forces
from wholearm.planning.lower_bound.lower_bound import bound_least_time
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.path_motion import PathMotion
from wholearm.planning.path_domain.path_plan import plan_curves, plan_path
from wholearm.planning.phase_plan import PhasePlan
from wholearm.results.trajectory import Samples
from wholearm.scene.model import Friction, Scene

EPSILON = 0.05
LIMIT = float(box().scene.torque_limit.max())
ANY = -1.0
"""Least uniqueness margin that cones are looked at with, unique or not."""
OBJECTIVES = ["time", "effort", "margin"]


@cache
def tip_on(mu: float) -> Curve:
    """The box tipping over vertex 1 on a palm of friction `mu`; the curve does not depend on it."""
    curve = tip()
    scene, old = curve.formation.scene, curve.formation
    friction = Friction(mu, scene.friction.finger1, scene.friction.finger2)
    other = Scene(scene.polygon, scene.fingers, friction, scene.gravity)
    return replace(curve, formation=Formation(other, old.contacts, old.rolling))


@cache
def plan(objective: str = "time", mu: float = 0.5, intervals: int = 40) -> PhasePlan[PathMotion]:
    options = PlanOptions(objective=objective, intervals=intervals, uniqueness_margin=ANY)
    return plan_path(tip_on(mu), EPSILON, options, 2, 0.4 if objective == "margin" else None)


def sample(chosen: PhasePlan[PathMotion], count: int) -> Samples:
    rng = np.random.default_rng(count)
    return chosen.motion.evaluate(np.sort(rng.uniform(0, chosen.motion.duration, count)))


def margin(samples: Samples, mu: float) -> Array:
    """Of vertex 1 to slipping [N]."""
    return np.asarray(mu * samples.c_n[:, 0] - np.abs(samples.c_t[:, 0]))


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_forces_stay_inside_the_friction_cone(objective: str) -> None:
    chosen = plan(objective, 0.5, 10)
    samples = sample(chosen, 4000)
    assert margin(samples, 0.5).min() >= 0.5 * EPSILON - 1e-6
    assert samples.c_n.min() >= EPSILON - 1e-6
    assert np.abs(samples.tau).max() <= LIMIT + 1e-6
    # The margin that is planned for is that of the normal forces alone.
    if objective == "margin":
        assert samples.c_n.min() >= chosen.value - 1e-6 > EPSILON
        assert samples.c_n.min() == pytest.approx(chosen.value, abs=1e-2)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_planned_forces_balance_every_body(objective: str) -> None:
    """Newton and Euler at random instants, with the vertex where it was."""
    samples = sample(plan(objective), 200)
    formation = tip_on(0.5).formation
    place = place_corners(formation.scene, tip().start)[1]
    missing, size = unbalance(formation, samples, np.sign(samples.z_dot[:, 3:]))
    assert (np.abs(missing).max(axis=1) < 1e-10 * size.max(axis=1)).all()
    assert np.abs(place_corners(formation.scene, samples.z)[:, 1] - place).max() < 1e-14
    slip = measure_slip(formation, samples.z, samples.z_dot)
    assert np.abs(slip[:, 0]).max() < 1e-13
    # The other two slide, and friction opposes that.
    law = -formation.friction[1:] * np.sign(slip[:, 1:]) * samples.c_n[:, 1:]
    np.testing.assert_allclose(samples.c_t[:, 1:], law, rtol=1e-12)


def test_velocities_and_accelerations_are_derivatives() -> None:
    motion, h = plan().motion, 1e-6
    # Between the nodes, at which accelerations have kinks.
    times = (motion.times[1:] + motion.times[:-1])[motion.grid.steps > 0] / 2
    before, here, after = (motion.evaluate(times + k) for k in (-h, 0.0, h))
    for rate, value in (("z_dot", "z"), ("z_ddot", "z_dot")):
        expected = (getattr(after, value) - getattr(before, value)) / (2 * h)
        found = getattr(here, rate)
        # Rounding 1e-16 over h, and the third derivatives times h^2.
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7 * np.abs(found).max())


def test_least_time_comes_near_its_lower_bound() -> None:
    bound = bound_least_time([tip_on(0.5)], EPSILON)
    assert bound is not None
    assert -1e-7 < plan("time", 0.5, 80).value / bound.value - 1 < 2e-4


def test_the_cone_is_what_holds_the_fastest_motion_back() -> None:
    """It is touched on both sides; on a rougher palm the box tips faster."""
    samples = sample(plan(), 4000)
    near = margin(samples, 0.5) < 0.5 * EPSILON + 1e-3
    assert (near & (samples.c_t[:, 0] > 0)).any() and (near & (samples.c_t[:, 0] < 0)).any()
    times = [plan("time", mu, 20).value for mu in (0.45, 0.5, 0.8)]
    assert (np.diff(times) < -1e-3).all()
    assert (margin(sample(plan("time", 0.8, 20), 4000), 0.5) < 0).any()


@pytest.mark.usefixtures("unadvised")
def test_a_slippery_palm_is_named() -> None:
    with pytest.raises(InfeasibleError, match="friction cone of v1-palm") as caught:
        plan("time", 0.1, 20)
    text = str(caught.value)
    assert text.startswith("phase 2 is infeasible: ") and "|c_t| <= 0.1 (c_n - 0.05 N), is " in text
    assert " N short at t = " in text


def test_an_epsilon_that_cones_allow_is_advised() -> None:
    """Rolling contacts need c_n >= epsilon and a cone that is narrower by mu epsilon."""
    options, mu, epsilon = PlanOptions(intervals=15, uniqueness_margin=ANY), 0.8, 0.7
    with pytest.raises(InfeasibleError) as caught:
        plan_path(tip_on(mu), epsilon, options, 2)
    _, found, advised = str(caught.value).rpartition("epsilon = ")
    assert found and advised.endswith(f" N instead of {epsilon:g}")
    value = float(advised.split()[0])
    assert plan_path(tip_on(mu), value, options, 2).value > plan("time", mu, 20).value
    with pytest.raises(SolverError):
        plan_curves((tip_on(mu),), 1.03 * value, options, (2,), explained=False)


def test_forces_are_told_apart() -> None:
    formation = tip_on(0.5).formation
    c = np.arange(1.0, 9.0).reshape(2, 4)
    c_n, c_t = split_forces(formation, c, np.array([0.0, 1.0, -1.0]))
    np.testing.assert_array_equal(c_n, c[:, :3])
    np.testing.assert_allclose(c_t, [[4.0, -0.2, 0.3], [8.0, -0.6, 0.7]])
