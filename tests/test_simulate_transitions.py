"""Replays with two freedoms, joins of phases without a stop, and what else touches."""

from __future__ import annotations

import dataclasses
import tomllib

import numpy as np
import pytest

from crossing import make_way
from integrated import integrate_phase
from once import once
from plane import make_formation
from planned import CosineMotion, LandingMotion, change, choose_squeeze, join, plan_landing
from pushed import forward
from shipped import HEXAGON, problem_of
from stepping import march
from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.plan import solve
from wholearm.problem.definition import End, Phase, Problem, Until
from wholearm.problem.read import build_problem
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.events import EventKind, OutcomeKind
from wholearm.simulation.prescribed import project_velocity
from wholearm.simulation.rest import StartDeparture, Touching, find_rest
from wholearm.simulation.simulate import simulate
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


@pytest.mark.parametrize("early", (1e-7, 5e-7))
def test_of_breaks_near_each_other_a_phase_ends_at_the_nearest(early: float) -> None:
    problem, torque, end = plan_passing(0.066)
    parts = torque.cut(0.0, end - early), torque.cut(end - early, torque.duration)
    breaks = np.append(parts[0].breaks, parts[1].breaks[1:])
    coefficients = np.concatenate([part.coefficients for part in parts])
    simulation = simulate(problem, TorqueProfile(breaks, coefficients))
    arrival = simulation.find(EventKind.ARRIVAL)[0]
    assert arrival.phase == 0 and arrival.time == pytest.approx(end, rel=1e-12)


def slide_to_the_tip(until: str) -> Problem:
    """The hexagon slides until v5 is at the pointed tip of a short finger 2, and back."""
    table = tomllib.loads(HEXAGON.read_text(encoding="utf-8"))
    for key, length in ("1", 0.18), ("2", 0.057):
        table["fingers"][key] |= {"length": length, "radius": 0.0}
    table["start"]["x"] = -0.03
    contacts = ["v0-palm", "v1-palm", "v3-finger1", "v5-finger2"]
    ends: list[object] = [until, {"x": -0.025}]
    return build_problem(table | {"phases": [{"contacts": contacts, "until": u} for u in ends]})


@pytest.mark.parametrize("until", ["e4-tip2", "e5-tip2"])
def test_a_pointed_tip_gains_either_edge_at_a_vertex(until: str) -> None:
    """Both edges touch the tip there, and the motion back opens both."""
    problem = slide_to_the_tip(until)
    curves = trace_phases(problem)
    # Finger 2 holds v5 in reach on both sides of the place above its joint.
    corner = np.array([curves[0].end[0] - 0.05, 0.0433]) - problem.scene.fingers[1].base
    assert np.hypot(*corner) == pytest.approx(0.057, rel=1e-9)
    motions = [CosineMotion(c, 0.4, choose_squeeze(c, 0.4, 0.2, 2.0)) for c in curves]
    simulation = simulate(problem, join([motion.fit(20, 7) for motion in motions]), times=[0.2])
    assert simulation.outcome.reached
    halfway = motions[0].evaluate(np.array([0.2])).z[0]
    np.testing.assert_allclose(simulation.at(0.2)[:5], halfway, atol=1e-9)
    first = simulation.z[simulation.phase == 0][-1]
    np.testing.assert_allclose(first, curves[0].end, atol=1e-9)
    np.testing.assert_allclose(simulation.z[-1], curves[1].end, atol=1e-9)


@pytest.mark.parametrize("until", ["e4-tip2", "e5-tip2"])
def test_two_freedoms_start_from_a_pointed_tip(until: str) -> None:
    """Finger 2 pushes v5 to the right, off its tip or away from it, while finger 1 swings."""
    problem = slide_to_the_tip(until)
    formation = make_formation(problem.scene, "v0-palm v1-palm v5-finger2")
    curve = trace_phases(problem)[0]
    z = curve.end - np.array([0.0, 0.0, 0.0, 0.3, 0.0])
    rest = find_rest(formation, z)
    assert rest.near.sum() == 2  # the end of the link, and an edge at its tip
    back, onwards = (sign * (curve.end - curve.start) for sign in (-1e-3, 1e-3))
    touching = Touching(formation, z, rest.near)
    (edge,) = touching.kinked
    assert formation.limits[edge].text.endswith("touches the tip of finger 2")
    # Along the line of the link the edge parts from the tip both ways.
    assert touching.opens(back) and touching.opens(onwards)
    departs = rest.wait(np.array([[-0.05], [-0.2]]), -1.0)
    right = until == "e5-tip2"
    assert (isinstance(departs, StartDeparture) and departs.heading[0] > 0) == right


def test_a_link_that_is_free_may_graze_what_starts_to_move() -> None:
    """Links of a plan may close by the little that its nodes do not see, but not press."""
    problem = make_way(solid=True)
    rest = find_rest(problem.phases[0].formation, problem.start)
    assert rest.near.sum() == 1  # v3 on finger 1
    tau = np.array([-0.287, -0.98])
    way = next(way for way in rest.sliding if way.moves(tau))
    touch = make_formation(problem.scene, "v3-finger1")
    A = touch.evaluate(problem.start[None], np.zeros((1, 5))).A[0, 0]
    lever = A[3] / problem.scene.fingers[0].inertia
    opens = A @ way.depart(-1.0, tau).heading * way.drive(tau)
    # The torque of finger 1 with which the gap has no acceleration.
    even = tau - np.array([opens / lever, 0.0])
    for closing, starts in (-1e-3, True), (2e-5, True), (1.0, False):
        load = even - np.array([closing / lever, 0.0])
        begun = rest.wait(load[:, None], -1.0)
        assert (isinstance(begun, StartDeparture) and begun.x == -1.0) == starts
