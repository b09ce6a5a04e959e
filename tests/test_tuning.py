from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from planned import change
from shipped import HEPTAGON, problem_of
from tipping import box, tipped
from wholearm.common.arrays import Array
from wholearm.problem.definition import Problem
from wholearm.results.report import Report
from wholearm.results.torque import TorqueProfile
from wholearm.results.tuning_advice import Loss
from wholearm.simulation.events import EventKind, Simulation
from wholearm.simulation.simulate import simulate
from wholearm.verification.torque_advice import find_approach
from wholearm.verification.verify import verify

EARLY = 1 - 1e-6
"""Time of a step of the torques, over that of the loss which it is to mend."""


@cache
def first_phase() -> Problem:
    problem = problem_of(HEPTAGON)
    return dataclasses.replace(problem, phases=problem.phases[:1])


@cache
def let_go() -> Report:
    """Finger 2 is lowered until it lets go."""
    t, tau = np.array([0.0, 0.1]), np.array([[0.6, 0.17], [0.6, 0.3]])
    return verify(first_phase(), TorqueProfile.join_rows(t, tau))


def step(torque: TorqueProfile, time: float, by: Array) -> TorqueProfile:
    """Torques that change by `by`, shape (2,) [N m], from a time on."""
    before = torque.breaks[torque.breaks < time]
    after = torque.breaks[torque.breaks > time]
    parts = [np.append(before, time), np.append(time, after)]
    degree = torque.coefficients.shape[2] - 1
    early, late = (TorqueProfile.fit(part, torque.at, degree) for part in parts)
    late.coefficients[:, :, 0] += by
    joined = np.concatenate([early.coefficients, late.coefficients])
    return TorqueProfile(np.append(before, late.breaks), joined)


def forces_at_step(problem: Problem, report: Report, loss: Loss, by: Array) -> tuple[Array, Array]:
    """Normal forces before and after a step of the torques right before a loss, (n_c,) each."""
    assert isinstance(report.replay, Simulation)
    time = EARLY * loss.time
    simulation = simulate(problem, step(report.replay.torque, time, by))
    own = [simulation.contacts.index(force.contact) for force in loss.forces]
    before, after = np.flatnonzero(simulation.t == time)
    return simulation.c_n[before, own], simulation.c_n[after, own]


def test_sensitivities_are_those_of_the_simulation() -> None:
    report = let_go()
    (loss,) = (loss for loss in report.help.losses if loss.kind == "lost")
    assert loss.contact == "v5-finger2" and not loss.at_rest and loss.phase == 1
    assert loss.time == pytest.approx(report.replay.t[-1])  # type: ignore[union-attr]
    per_tau = np.array([force.per_tau for force in loss.forces])
    for by in np.array([[0.01, 0.0], [0.0, -0.01], [0.02, 0.003]]):
        before, after = forces_at_step(first_phase(), report, loss, by)
        assert after - before == pytest.approx(per_tau @ by, rel=1e-4, abs=1e-6)
        assert before == pytest.approx([force.c_n for force in loss.forces], abs=1e-4)


def test_following_the_advice_mends_the_loss() -> None:
    problem, report = first_phase(), let_go()
    (loss,) = (loss for loss in report.help.losses if loss.kind == "lost")
    names = [force.contact for force in loss.forces]
    good = [change for change in loss.changes if not change.but]
    assert good and loss.changes[0] is good[0]
    for mend in loss.changes:
        _, after = forces_at_step(problem, report, loss, np.array(mend.change))
        assert after[names.index(loss.contact)] == pytest.approx(problem.epsilon, rel=1e-3)
        assert (after.min() < 0.999 * problem.epsilon) == bool(mend.but)
        assert mend.to == pytest.approx(np.array(mend.change) + tau_at(report, loss))
    text = report.to_text()
    assert f"help: {loss.to_text()}" in text and good[0].to_text() in text
    assert "acceleration to v3-finger1" in text
    assert report.to_dict()["help"]["losses"][0]["changes"][0]["but"] == ""


def tau_at(report: Report, loss: Loss) -> Array:
    assert isinstance(report.replay, Simulation)
    return np.asarray(report.replay.torque.at(np.array([loss.time]))[0])


@pytest.mark.parametrize("tau", [(0.05, 0.05), (-0.2, 0.0), (0.9, 0.1), (-0.2, 0.2)])
def test_advice_at_rest_lets_the_object_start_or_rest(tau: tuple[float, float]) -> None:
    problem = first_phase()
    report = verify(problem, TorqueProfile(np.array([0.0, 1e-3]), np.array([tau])[..., None]))
    (loss,) = report.help.losses
    assert loss.at_rest and loss.time == 0.0 and loss.changes
    for mend in loss.changes:
        assert not mend.but
        again = TorqueProfile(np.array([0.0, 1e-3]), np.array([mend.to])[..., None])
        simulation = simulate(problem, again)
        assert not simulation.find(EventKind.CONTACT_LOST)
        assert bool(simulation.find(EventKind.START)) != mend.holds
        if not mend.holds:
            # Towards v3-finger1 is to the left.
            assert simulation.z[-1, 0] < simulation.z[0, 0]


@pytest.mark.parametrize(("kind", "first", "second"), [("slips", 0.9, 1.0), ("lost", 0.5, 0.5)])
def test_a_rolling_contact_is_mended(kind: str, first: float, second: float) -> None:
    """One that is lost is out of its cone as well; both are mended."""
    problem, report = box(), ease((first, second))
    (loss,) = (loss for loss in report.help.losses if loss.kind == kind)
    k = [force.contact for force in loss.forces].index(loss.contact)
    mu = problem.phases[loss.phase - 1].formation.friction[k]
    # It slips at the edge of its cone, or beyond.
    assert abs(loss.forces[k].c_t) > mu * loss.forces[k].c_n * (1 - 1e-6)
    mend = loss.changes[0]
    assert not mend.but
    assert isinstance(report.replay, Simulation)
    # The torques step here already.
    torque = step(report.replay.torque, loss.time, np.array(mend.change))
    simulation = simulate(problem, torque)
    after = np.flatnonzero(simulation.t == loss.time)[-1]
    assert simulation.t[-1] > loss.time
    column = simulation.contacts.index(loss.contact)
    c_n, c_t = simulation.c_n[after, column], simulation.c_t[after, column]
    assert abs(c_t) <= mu * (c_n - 0.999 * problem.epsilon)


def ease(shares: tuple[float, float]) -> Report:
    """The box tips over a vertex that rolls, with shares of its torques from some time on."""
    problem, trajectory = box(), tipped()

    def scale(starts: Array, c: Array) -> Array:
        c[starts > trajectory.phase_starts[1] + 0.1] *= np.array(shares)[:, None]
        return c

    return verify(problem, change(trajectory.torque, scale))


def test_the_closest_approach_and_a_motion_that_turns_back() -> None:
    report = let_go()
    replay = report.replay
    assert isinstance(replay, Simulation) and report.help.approach is not None
    approach = report.help.approach
    assert approach.distance == pytest.approx(replay.missed_by) and approach.turns == ()
    assert approach.time == replay.t[-1] and approach.rate > 0
    # The same there and back.
    back = dataclasses.replace(
        replay,
        t=np.append(replay.t, 2 * replay.t[-1] - replay.t[-2::-1]),
        z=np.vstack([replay.z, replay.z[-2::-1]]),
        z_dot=np.vstack([replay.z_dot, -replay.z_dot[-2::-1]]),
        phase=np.zeros(2 * len(replay.t) - 1, dtype=np.int64),
    )
    found = find_approach(first_phase(), back)
    assert found is not None and found.distance == pytest.approx(approach.distance, abs=1e-9)
    assert found.time == pytest.approx(replay.t[-1], abs=1e-6)
    assert list(found.turns) == pytest.approx([replay.t[-1]], abs=1e-9)
    assert "turns back at" in found.to_text()
