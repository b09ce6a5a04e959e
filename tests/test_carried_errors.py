"""How far torques by the clock carry an error on, and whether friction may hold a contact open."""

from __future__ import annotations

import numpy as np
import pytest

from shipped import HEPTAGON, solved
from wholearm.benchmark import carried
from wholearm.contacts.formation import Formation
from wholearm.free_simulation.simulate import simulate_free
from wholearm.mechanics.arrival import Standstill, find_opening
from wholearm.mechanics.wedging import find_static_torques
from wholearm.planning.path_domain.motion import PathMotion
from wholearm.planning.settling import list_touching
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.closing import close_contacts
from wholearm.simulation.starting import RestDirection
from wholearm.simulation.sticking import find_rest


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


def test_no_torques_that_hold_close_a_contact_sooner() -> None:
    """By the simulator's rows at rest, which are set up on their own, at torques all over."""
    plan = solved(HEPTAGON)
    problem, rng, gap = plan.problem, np.random.default_rng(5), 1e-4
    phase, motion = problem.phases[0], plan.trajectory.motions[0]
    assert isinstance(motion, PathMotion) and phase.until.contact is not None
    touching, end = list_touching(problem, phase), motion.curve.end
    place = Standstill(end, phase.formation, phase.until.contact, touching)
    least = carried.find_least_closing(place, problem.epsilon, gap)
    opening = find_opening(place)
    assert opening is not None
    z = close_contacts(phase.formation, end + gap * opening)
    normal = Formation(problem.scene, (phase.until.contact,)).evaluate(z[None], np.zeros((1, 5))).A
    ways = [way for way in find_rest(phase.formation, z).ways if isinstance(way, RestDirection)]
    way = next(way for way in ways if normal[0, 0] @ way.heading < 0)
    held = find_static_torques([touching], end, problem.epsilon)
    tau = rng.uniform(-1.0, 1.0, (20000, 2)) * problem.scene.torque_limit
    tau = tau[held.measure(tau) <= 0]
    swiftest = max(way.drive(own) for own in tau) * -float(normal[0, 0] @ way.heading)
    assert len(tau) > 500
    assert 0.8 < least / np.sqrt(2 * gap / swiftest) < 1.01
