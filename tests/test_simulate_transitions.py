"""The simulation of phases with two freedoms, and of what joins phases without a stop."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from integrated import integrate_phase
from once import once
from planned import LandingMotion, change, plan_landing
from pushed import forward
from shipped import HEXAGON, problem_of
from stepping import march
from wholearm.common.arrays import Array
from wholearm.common.errors import SimulationError
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation
from wholearm.mechanics.dynamics import Directions
from wholearm.planning.plan import solve
from wholearm.problem.definition import End, Phase, Problem, Until
from wholearm.problem.read import build_problem
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.events import EventKind, OutcomeKind
from wholearm.simulation.simulate import project_velocity, simulate
from wholearm.simulation.start_modes import StartDeparture
from wholearm.simulation.sticking import find_rest
from wholearm.verification.verify import verify

RELEASE = 0.5
"""When `plan_landing` lets vertex 3 go [s]."""


def landing_of(duration: float = 0.2) -> LandingMotion:
    motion = plan_landing(duration)[1].motions[1]
    assert isinstance(motion, LandingMotion)
    return motion


def constant(tau: Array, duration: float) -> TorqueProfile:
    return TorqueProfile(np.array([0.0, duration]), tau.reshape(1, 2, 1))


def brake_less(starts: Array, c: Array) -> Array:
    """Near the end of the landing."""
    c[starts > 0.66] *= 0.97
    return c


@once
def plan_passing(x: float) -> tuple[Problem, TorqueProfile, float]:
    """The hexagon slides from `x` until vertex 4 goes round the tip of finger 2, and when."""
    table = {**problem_of(HEXAGON).table, "start": {"flush": 0, "x": x}}
    held = ["v0-palm", "v1-palm", "v1-finger1"]
    table["phases"] = [
        {"contacts": [*held, "v4-finger2"], "until": "v4-tip2", "end": "smooth"},
        {"contacts": [*held, "v4-tip2"], "until": "e4-tip2"},
    ]
    problem = build_problem(table)
    trajectory = solve(problem, replay=False).trajectory
    return problem, trajectory.torque, float(trajectory.t[trajectory.phase == 1][0])


def replace_phases(problem: Problem, *phases: Phase) -> Problem:
    return dataclasses.replace(problem, phases=phases)


def test_releases_and_lands_as_planned() -> None:
    problem, trajectory = plan_landing()
    simulation = simulate(problem, trajectory.torque, times=trajectory.t)
    assert simulation.outcome.kind is OutcomeKind.GOAL_REACHED
    for index, motion in enumerate(trajectory.motions):
        rows = np.flatnonzero(simulation.phase == index)
        end = motion.evaluate(np.array([motion.duration]))
        # The curve is good to 1e-12; open loop such errors grow about e^50 times a second, in
        # 0.3 s to 3e-6.
        assert np.allclose(simulation.z[rows[-1]], end.z[0], atol=3e-6, rtol=0)
        assert np.allclose(simulation.z_dot[rows[-1]], end.z_dot[0], atol=2e-4, rtol=0)
        names = [simulation.contacts.index(name) for name in motion.contacts]
        local = simulation.t[rows] - trajectory.phase_starts[index]
        inner = np.abs(local[:, None] - motion.turns).min(axis=1) > 1e-6  # type: ignore[attr-defined]
        samples = motion.evaluate(local[inner])
        c_n = simulation.c_n[np.ix_(rows[inner], names)]
        assert np.allclose(c_n, samples.c_n, atol=1e-3, rtol=0)
    energies = simulation.energies
    assert np.abs(energies.residual).max() < 1e-9 * energies.work[-1]
    # What is left of the speed at the landing is lost, and no more. A landing at rest loses
    # nothing but rounding, of either sign.
    assert abs(energies.impact[-1]) < 1e-12


def test_release_is_an_event_with_the_forces_twice() -> None:
    problem, trajectory = plan_landing()
    simulation = simulate(problem, trajectory.torque)
    (release,) = simulation.find(EventKind.RELEASE)
    assert (release.time, release.phase, release.contact) == (RELEASE, 0, "v3-finger1")
    assert release.text == "v3-finger1 released at t = 0.5 s, phase 1"
    assert release.value < 0
    before, after = np.flatnonzero(simulation.t == RELEASE)
    assert list(simulation.phase[[before, after]]) == [0, 1]
    # Projected on the new contacts the state changes by rounding.
    assert np.allclose(simulation.z[after], simulation.z[before], atol=1e-13, rtol=0)
    assert np.allclose(simulation.z_dot[after], simulation.z_dot[before], atol=1e-13, rtol=0)
    let_go = simulation.contacts.index("v3-finger1")
    assert simulation.c_n[before, let_go] > problem.epsilon
    assert np.isnan(simulation.c_n[after:, let_go]).all()
    gaps = problem.phases[0].formation.evaluate(simulation.z, simulation.z_dot).C[:, 1]
    assert (gaps[after + 1 :] > 0).all()


def test_contacts_stay_closed_with_two_freedoms() -> None:
    problem, trajectory = plan_landing()
    simulation = simulate(problem, trajectory.torque)
    rows = simulation.phase == 1
    kinematics = problem.phases[1].formation.evaluate(simulation.z[rows], simulation.z_dot[rows])
    rates = np.einsum("nij,nj->ni", kinematics.A, simulation.z_dot[rows])
    # Each step is projected, which leaves rounding.
    assert np.abs(kinematics.C).max() < 1e-15
    assert np.abs(rates).max() < 1e-13


def test_finds_the_reversal_and_the_landing() -> None:
    problem, trajectory = plan_landing()
    simulation = simulate(problem, trajectory.torque)
    reversal = simulation.find(EventKind.REVERSAL)[-1]
    assert (reversal.contact, reversal.phase) == ("v1-palm", 1)
    assert reversal.time == pytest.approx(RELEASE + landing_of().turns[1], abs=1e-8)
    (arrival,) = simulation.find(EventKind.ARRIVAL)
    assert arrival.time == pytest.approx(RELEASE + 0.2, abs=1e-6)
    assert abs(arrival.value) < 1e-6


def test_agrees_with_the_baseline() -> None:
    problem, trajectory = plan_landing()
    motion, stop = landing_of(), 0.58
    start = motion.evaluate(np.array([0.0]))
    signs = motion.signs(np.array([0.01]))[0]
    begun, directions = np.hstack([start.z[0], start.z_dot[0]]), Directions(signs[:-2], signs[-2:])
    run = integrate_phase(problem, 1, trajectory.torque, begun, directions, (RELEASE, stop))
    state = simulate(problem, trajectory.torque, tolerance=1e-12, times=[stop]).at(stop)
    # Errors of 1e-12 at the release grow about e^4 times until then.
    assert np.allclose(state, run.state, atol=1e-9, rtol=0)


@pytest.mark.parametrize("off", [-1e-9, 0.0, 1e-9])
def test_a_coordinate_may_be_passed_at_speed(off: float) -> None:
    problem, trajectory = plan_landing()
    first, last = problem.phases
    value = float(landing_of().start[2]) + off
    until = Until(coordinate="phi", value=value)
    passing = replace_phases(problem, dataclasses.replace(first, until=until), last)
    simulation = simulate(passing, trajectory.torque)
    assert simulation.outcome.reached
    arrival = simulation.find(EventKind.ARRIVAL)[0]
    # By rounding it comes before or after the step of the torques that goes with it.
    assert arrival.time == RELEASE
    assert arrival.value == pytest.approx(-landing_of().start_dot[2], rel=1e-6)
    end = landing_of().evaluate(np.array([0.2])).z[0]
    assert np.allclose(simulation.z[-1], end, atol=1e-7, rtol=0)


def test_a_contact_gained_at_speed_and_kept() -> None:
    problem, trajectory = plan_landing()
    first, last = problem.phases
    gained = last.until.contact
    assert gained is not None
    flat = Formation(problem.scene, (*last.formation.contacts, gained))
    going = dataclasses.replace(last, end=End.SMOOTH)
    after = Phase(2, flat, Until(coordinate="x", value=1.0))
    passing = replace_phases(problem, first, going, after)
    torque = change(trajectory.torque, brake_less)
    simulation = simulate(passing, torque)
    arrival = next(e for e in simulation.events if e.kind is EventKind.ARRIVAL)
    before = int(np.flatnonzero(simulation.phase == 1)[-1])
    assert simulation.t[before] == simulation.t[before + 1] == arrival.time
    z, z_dot = simulation.z[before], simulation.z_dot[before]
    rate = Formation(problem.scene, (gained,)).evaluate(z[None], z_dot[None]).A[0, 0] @ z_dot
    assert arrival.value == pytest.approx(-rate, rel=1e-9) and arrival.value > 1e-3
    goes_on = simulation.z_dot[before + 1]
    assert np.allclose(goes_on, project_velocity(flat, z, z_dot), atol=1e-12, rtol=0)
    mass = problem.scene.mass_diagonal
    lost = 0.5 * (z_dot**2 - goes_on**2) @ mass
    assert simulation.energies.impact[before + 1] == pytest.approx(lost, rel=1e-6)
    assert np.abs(simulation.energies.residual).max() < 1e-9 * simulation.energies.work.max()


def test_landing_too_fast_stops_and_is_reported() -> None:
    problem, trajectory = plan_landing()
    torque = change(trajectory.torque, brake_less)
    simulation = simulate(problem, torque)
    assert simulation.outcome.reached
    arrival = simulation.events[-1]
    assert arrival.time < RELEASE + 0.2 and arrival.value > 1e-3
    kinetic = 0.5 * simulation.z_dot[-1] ** 2 @ problem.scene.mass_diagonal
    assert kinetic > 0
    report = verify(problem, torque)
    assert report.phases[1].arrival_rate == pytest.approx(arrival.value, rel=1e-6)
    assert not report.ok and any("does not end at rest" in text for text in report.failures)


def test_a_release_that_never_comes() -> None:
    problem, trajectory = plan_landing()
    torque = trajectory.torque
    count = int(np.searchsorted(torque.breaks, RELEASE - 1e-9))
    short = TorqueProfile(torque.breaks[: count + 1], torque.coefficients[:count])
    simulation = simulate(problem, short)
    assert simulation.outcome.kind is OutcomeKind.GOAL_MISSED
    assert simulation.outcome.text == (
        "the torques end at t = 0.5 s, phase 1, before v3-finger1 is released"
    )
    assert np.isnan(simulation.missed_by)
    report = verify(problem, short)
    assert not report.ok and report.to_dict()["missed_by"] is None
    assert report.phases[0].arrival is None


def test_another_contact_lost_is_no_release() -> None:
    problem, trajectory = plan_landing()
    first, _ = problem.phases
    kept = tuple(c for c in first.formation.contacts if c.name != "v4-finger1")
    last = Phase(1, Formation(problem.scene, kept), Until(coordinate="x", value=1.0))
    simulation = simulate(replace_phases(problem, first, last), trajectory.torque)
    assert simulation.outcome.kind is OutcomeKind.CONTACT_LOST
    lost = simulation.events[-1]
    assert (lost.contact, lost.time, lost.phase) == ("v3-finger1", RELEASE, 0)
    assert not simulation.find(EventKind.RELEASE)


def test_a_release_as_the_squeeze_fades_and_a_contact_that_sticks() -> None:
    problem, trajectory = plan_landing(squeeze=4.0)
    simulation = simulate(problem, trajectory.torque)
    (release,) = simulation.find(EventKind.RELEASE)
    assert release.time < RELEASE
    # The torques do not jump, so the force is zero there.
    assert abs(release.value) < 1e-9
    departing = trajectory.motions[0].evaluate(np.array([release.time])).c_n[0]
    assert abs(departing[1]) < 1e-8 and np.delete(departing, 1).min() > 1.0
    # Palm friction then stops the vertex, which the phase plans as sliding, while the object turns.
    stuck = next(e for e in simulation.events if e.contact == "v1-palm")
    assert stuck.kind is EventKind.STICK and stuck.phase == 1
    assert stuck.text == f"v1-palm sticks at t = {stuck.time:.5g} s, phase 2"
    row = int(np.flatnonzero(simulation.t == stuck.time)[-1])
    formation = problem.phases[1].formation
    v_t = formation.evaluate(simulation.z[row:], simulation.z_dot[row:]).A_t[:, 0]
    slipping = [e.time for e in simulation.find(EventKind.SLIP)]
    until = min(slipping, default=np.inf)
    held = simulation.t[row:] < until
    assert held.sum() > 2
    assert np.abs(np.einsum("nj,nj->n", v_t, simulation.z_dot[row:])[held]).max() < 1e-12
    assert np.abs(simulation.z_dot[row:, 2][held]).min() > 0.01
    assert np.abs(simulation.energies.residual).max() < 1e-9 * simulation.energies.work.max()


def test_start_with_two_freedoms() -> None:
    problem, _ = plan_landing()
    phase = Phase(0, problem.phases[1].formation, problem.phases[1].until)
    z = landing_of().evaluate(np.array([0.1])).z[0]
    rng = np.random.default_rng(3)
    moving = replace_phases(dataclasses.replace(problem, start=z), phase)
    rest, seen = find_rest(phase.formation, z), 0
    assert len(rest.sliding) == 2**5
    # One more constraint at most leaves a freedom to move in.
    assert len(rest.modes) == 2**5 + 5 * 2**4
    while seen < 3:
        tau = np.array([1.0, -1.0]) * rng.uniform(0.0, 2.0, size=2)
        change_of_state = rest.wait(tau[:, None], -1.0)
        if not isinstance(change_of_state, StartDeparture):
            continue
        directions = change_of_state.directions
        if not all(map(np.all, directions)):
            continue
        seen += 1
        acceleration, c_n = forward(phase.formation, z, np.zeros(5), tau, directions)
        A_t = phase.formation.evaluate(z[None], np.zeros((1, 5))).A_t[0]
        assert (directions.Xi * (A_t @ acceleration) > 0).all()
        assert (directions.sigma * acceleration[3:] > 0).all() and (c_n > 0).all()
        torque, stop = constant(tau, 0.01), 0.005
        simulation = simulate(moving, torque, tolerance=1e-12, times=[stop])
        assert simulation.events[0].kind is EventKind.START and simulation.events[0].time == 0
        state = np.append(z, np.zeros(5))
        run = integrate_phase(moving, 0, torque, state, directions, (0.0, stop))
        assert np.allclose(simulation.at(stop), run.state, atol=1e-10, rtol=0)


def test_rest_with_two_freedoms() -> None:
    problem, _ = plan_landing()
    phase = Phase(0, problem.phases[1].formation, problem.phases[1].until)
    z = landing_of().evaluate(np.array([0.1])).z[0]
    still = replace_phases(dataclasses.replace(problem, start=z), phase)
    squeezed = simulate(still, constant(np.array([2.0, -2.8]), 0.01))
    assert [e.kind for e in squeezed.events] == [EventKind.STICK, EventKind.END]
    assert not squeezed.z_dot.any() and "short of v2-palm" in squeezed.outcome.text
    pulled = simulate(still, constant(np.array([-0.3, 0.3]), 0.01))
    assert pulled.outcome.kind is OutcomeKind.CONTACT_LOST and pulled.events[-1].value < 0


def test_start_with_a_contact_that_sticks() -> None:
    """Neither balance nor sliding everywhere; time stepping is not told what sticks."""
    problem, _ = plan_landing()
    phase = Phase(0, problem.phases[1].formation, problem.phases[1].until)
    z = landing_of().evaluate(np.array([0.1])).z[0]
    still = replace_phases(dataclasses.replace(problem, start=z), phase)
    tau = np.array([0.4, -0.4])
    simulation = simulate(still, constant(tau, 0.01))
    assert simulation.events[0].kind is EventKind.START
    row = np.flatnonzero(~np.isnan(simulation.c_n[:, 0]))[0]
    reserve = phase.formation.friction * simulation.c_n[row] - np.abs(simulation.c_t[row])
    assert phase.formation.names[int(reserve.argmax())] == "v6-finger2"
    assert reserve.max() > 0.1 and np.sort(reserve)[1] < 1e-12
    moved = simulation.z[-1] - z
    errors = []
    for n in (20, 40):
        marched, _ = march(phase.formation, z, np.zeros(5), lambda t: tau, 0.01, n)
        errors.append(float(np.abs(marched[-1] - z - moved).max()))
    assert errors[1] < 0.6 * errors[0] < 0.06 * np.abs(moved).max()


def test_a_formation_without_freedom_cannot_start() -> None:
    problem, _ = plan_landing()
    names = ("v1-palm", "v3-finger1", "v4-finger1", "v6-finger2", "v0-finger2")
    contacts = tuple(parse_contact(name, problem.scene) for name in names)
    with pytest.raises(SimulationError, match="leaves 0 freedoms"):
        find_rest(Formation(problem.scene, contacts), problem.start)


def test_verify_reports_the_release() -> None:
    problem, trajectory = plan_landing()
    report = verify(problem, trajectory)
    assert report.ok and report.failures == ()
    first, last = report.phases
    assert (first.until, first.end, first.arrival) == ("release of v3-finger1", "smooth", RELEASE)
    assert first.arrival_rate is None
    assert (last.until, last.end) == ("v2-palm", "rest")
    for phase in report.phases:
        for deviation in (phase.end_deviation, phase.deviation):
            assert deviation is not None
            assert deviation.position < 1e-8 and deviation.angle < 1e-8
    assert report.energy.relative < 1e-9
    assert "release of v3-finger1  smooth" in report.to_text()


def test_directions_that_stand_still_follow_the_acceleration() -> None:
    problem, trajectory = plan_landing()
    motion = landing_of()
    turn = float(motion.turns[1])
    # Begin the second phase just where a contact reverses: its speed there is zero.
    first, last = problem.phases
    torque = trajectory.torque
    samples = motion.evaluate(np.array([turn]))
    until = Until(coordinate="phi", value=float(samples.z[0, 2]))
    middle = Phase(1, last.formation, until, End.SMOOTH)
    again = replace_phases(problem, first, middle, dataclasses.replace(last, index=2))
    simulation = simulate(again, torque)
    assert simulation.outcome.reached
    whole = simulate(problem, torque)
    assert np.allclose(simulation.z[-1], whole.z[-1], atol=1e-7, rtol=0)
    directions = Directions(*np.split(motion.signs(np.array([turn + 1e-3]))[0], [3]))
    row = int(np.flatnonzero(simulation.phase == 2)[1])
    slides = simulation.c_t[row][~np.isnan(simulation.c_t[row])]
    assert (np.sign(slides) == -directions.Xi).all()


@pytest.mark.parametrize("early", (1e-7, 1e-9, 1e-11, 0.0, -1e-11, -1e-9))
def test_a_vertex_goes_on_from_link_to_tip_at_speed(early: float) -> None:
    """By rounding the torques step just before it does, or just after."""
    problem, torque, passed = plan_passing(0.066)
    breaks = torque.breaks.copy()
    breaks[np.abs(breaks - passed).argmin()] -= early
    simulation = simulate(problem, TorqueProfile(breaks, torque.coefficients))
    assert simulation.outcome.reached
    # Torques that are off for so short a time have turned nothing by more than that at 10 rad/s.
    assert np.allclose(simulation.z[-1], simulate(problem, torque).z[-1], atol=1e-6, rtol=0)


def test_a_slow_motion_passes_long_before_the_torques_step() -> None:
    """At 0.03 m/s an error of 0.1 um comes to 4 us, for which the contact before goes on."""
    problem, torque, passed = plan_passing(0.0726)
    breaks = torque.breaks.copy()
    breaks[np.abs(breaks - passed).argmin()] += 4e-6
    simulation = simulate(problem, TorqueProfile(breaks, torque.coefficients))
    assert simulation.outcome.reached
    least = np.nanmin(simulation.c_n[simulation.phase == 1])
    # What a few microseconds change of speed and place changes less of forces than that.
    assert least > 0.99 * problem.epsilon
