"""How far torques by the clock carry an error on, and whether friction may hold a contact open."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from shipped import HEPTAGON, solved
from wholearm.benchmark import carried
from wholearm.contacts.formation import Formation
from wholearm.free_simulation.simulate import simulate_free
from wholearm.mechanics.arrival import Standstill
from wholearm.mechanics.wedging import find_static_torques
from wholearm.planning.path_domain.motion import PathMotion
from wholearm.planning.settling import list_touching
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.closing import close_contacts


@pytest.mark.parametrize("number", [3, 5])
def test_errors_grow_as_in_a_free_simulation(number: int) -> None:
    plan = solved(HEPTAGON)
    motion, starts = plan.trajectory.motions[number - 1], plan.trajectory.phase_starts
    assert isinstance(motion, PathMotion)
    cut = plan.trajectory.torque.cut(*starts[number - 1 : number + 1].tolist())
    torque = TorqueProfile(cut.breaks - cut.breaks[0], cut.coefficients)
    curve, off = motion.curve, 1e-6
    first, last = curve.evaluate(np.array([0.0, curve.length])).z_s
    way = 1.0 if number == 5 else -1.0
    z = close_contacts(curve.formation, curve.start + way * off * first)
    run = simulate_free(plan.problem, torque, start=z)
    moved = (run.z[-1] - curve.end) @ last / (last @ last)
    assert carried.measure_growth(motion) == pytest.approx(moved / (way * off), rel=2e-3)


def test_the_least_growth_is_no_more_than_a_plan_s(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = solved(HEPTAGON)
    motion = plan.trajectory.motions[1]
    assert isinstance(motion, PathMotion) and len(motion.curve.segments) == 1
    monkeypatch.setattr(carried, "INTERVALS", 30)
    time = motion.duration + 0.02 * plan.duration
    least = carried.find_least_growth(motion.curve, plan.problem.epsilon, time, 0.5)
    assert 0 < least < 1.02 * carried.measure_growth(motion)


def test_torques_that_leave_nothing_open_are_found() -> None:
    """By the polygons themselves, at torques all over the first."""
    plan = solved(HEPTAGON)
    problem, rng = plan.problem, np.random.default_rng(5)
    for phase in problem.phases[:1]:
        z = plan.trajectory.motions[phase.index].curve.end  # type: ignore[attr-defined]
        touching = list_touching(problem, phase)
        place = Standstill(z, phase.formation, phase.until.contact, touching)
        most = carried.find_clearance(place, problem.epsilon)
        tau = rng.uniform(-1.0, 1.0, (20000, 2)) * problem.scene.torque_limit
        tau = tau[find_static_torques([touching], z, problem.epsilon).measure(tau) <= 0]
        stuck = [
            find_static_torques([Formation(problem.scene, kept)], z).measure(tau)
            for kept in combinations(touching.contacts, 4)
        ]
        found = float(np.min([own for own in stuck if np.isfinite(own).all()], axis=0).max())
        assert len(tau) > 500 and found <= most + 1e-12
        assert most - found < 0.3 * problem.scene.scales.torque
