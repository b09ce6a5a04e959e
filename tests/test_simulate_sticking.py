"""Contacts and joints that come to rest while the rest moves: they stick, and slip again."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from plane import make_formation, measure_slip, place_corners
from planned import plan_landing
from pushing import Push, Roll, evaluate, linear, pushed, rocking
from stepping import march
from test_simulate_rolling import fall
from tipping import constant, falling
from wholearm.problem.definition import Problem
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.events import EventKind, OutcomeKind, Simulation
from wholearm.simulation.simulate import simulate
from wholearm.simulation.sticking import balances

CHANGES = (EventKind.STICK, EventKind.SLIP, EventKind.REVERSAL)


def list_changes(simulation: Simulation) -> list[tuple[str, str]]:
    """What sticks, slips or turns back, in order, by kind and name; not the object as a whole."""
    return [(e.kind.value, e.contact) for e in simulation.events if e.kind in CHANGES and e.contact]


def assert_balanced(simulation: Simulation) -> None:
    energies = simulation.energies
    size = np.abs(energies.work).max() + np.ptp(energies.stored)
    assert np.abs(energies.residual).max() < 1e-9 * size


@pytest.mark.parametrize("mu, sign", [(0.25, 1.0), (0.36, 1.0), (0.6, -1.0)])
def test_a_falling_box_sticks_until_its_cone_is_left(mu: float, sign: float) -> None:
    """In closed form the vertex sticks as it would roll, then slips against its last force."""
    problem = falling(mu, 0.2)
    (phase,) = problem.phases
    slides = dataclasses.replace(phase.formation, rolling=())
    problem = dataclasses.replace(problem, phases=(dataclasses.replace(phase, formation=slides),))
    time, lean, c_t = fall(mu, 0.2)
    simulation = simulate(problem, constant((-0.01, 0.01), 1.0), tolerance=1e-12)
    slip = simulation.find(EventKind.SLIP)[0]
    assert (slip.contact, slip.text) == ("v1-palm", f"v1-palm slips at t = {time:.5g} s, phase 1")
    assert slip.time == pytest.approx(time, abs=1e-9)
    before, after = np.flatnonzero(simulation.t == slip.time)
    (start,) = (e for e in simulation.events if e.time < slip.time)
    assert start.kind is EventKind.START
    assert problem.start[2] - simulation.z[before, 2] == pytest.approx(lean - 0.2, abs=1e-9)
    assert simulation.c_t[before, 0] == pytest.approx(c_t, abs=1e-8)
    # The force goes on from one side of the jump to the other.
    assert simulation.c_t[after, 0] == pytest.approx(c_t, abs=1e-8)
    corner = np.array([place_corners(problem.scene, z)[1] for z in simulation.z])
    assert np.abs(corner - corner[0])[: before + 1].max() < 1e-13
    rows = slice(after + 1, None)
    slipping = [
        measure_slip(slides, z, v)[0]
        for z, v in zip(simulation.z[rows], simulation.z_dot[rows], strict=True)
    ]
    assert np.sign(c_t) == sign and (np.sign(slipping[:3]) == -sign).all()
    assert not simulation.energies.contact[: after + 1].any()
    assert simulation.energies.contact[-1] > 0
    assert_balanced(simulation)


def test_a_swinging_joint_is_held_while_its_dry_friction_allows() -> None:
    """Piecewise cubics: J theta'' = tau - D sgn(theta'), and rest where |tau| <= D."""
    problem = pushed(contacts="v0-palm v1-palm")
    scene = problem.scene
    swings = dataclasses.replace(scene.fingers[0], viscous=0.0)
    scene = dataclasses.replace(scene, fingers=(swings, scene.fingers[1]))
    (phase,) = problem.phases
    away = problem.start - 0.6 * np.eye(5)[3]
    phase = dataclasses.replace(phase, formation=make_formation(scene, "v0-palm v1-palm"))
    problem = dataclasses.replace(problem, scene=scene, start=away, phases=(phase,))
    D, J = swings.dry, swings.inertia
    torque = linear([0.0, 0.1, 0.3, 0.4], [0.0, 2 * D, -2 * D, -2 * D], [1e-3] * 4)
    simulation = simulate(problem, torque, tolerance=1e-12, times=[0.23, 0.24])
    # It starts at tau = D, is fastest when tau is D again, and is as slow when it has lost that.
    peak = 2 * 0.5 * D / J * 0.05
    stop = 0.15 + np.sqrt(2 * peak * J / (4 * D / 0.2))
    assert list_changes(simulation) == [
        ("slip", "joint 1"), ("stick", "joint 1"), ("slip", "joint 1"),
    ]  # fmt: skip
    times = [e.time for e in simulation.events if e.contact]
    assert times == pytest.approx([0.05, stop, 0.25], abs=1e-9)
    last = simulation.z_dot[-1, 3]
    assert last == pytest.approx(-D / J * (0.05 / 2 + 0.1), rel=1e-9)
    held = (simulation.t > stop + 1e-9) & (simulation.t < 0.25 - 1e-9)
    assert np.abs(simulation.z_dot[held, 3]).max() < 1e-14 and held.sum() > 1
    # Finger 2 moves and the box lies still all the time.
    theta = simulation.z[:, 4] - away[4]
    assert np.allclose(theta, 1e-3 / J * simulation.t**2 / 2, atol=1e-12, rtol=0)
    assert np.abs(simulation.z[:, :3] - away[:3]).max() < 1e-15
    assert simulation.energies.dry[-1] == pytest.approx(
        D * np.abs(np.diff(np.interp([*times, 0.4], simulation.t, simulation.z[:, 3]))).sum(),
        rel=1e-9,
    )
    assert_balanced(simulation)


def find_slipping_torque(problem: Problem) -> float:
    """Torque of finger 1 from which on nothing holds the box at rest, by linear programmes."""
    contacts = problem.phases[0].formation.contacts

    def holds(tau: float) -> bool:
        return balances(problem.scene, contacts, problem.start, np.array([tau, 0.0]))

    low, high = 0.0, 0.2
    assert holds(low) and not holds(high)
    while high - low > 1e-9:
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return high


def test_a_rising_push_slips_a_flush_edge_when_both_cones_are_left() -> None:
    problem = pushed()
    rate = 0.5
    # Finger 2 keeps moving, so that the box is stuck and not at rest.
    torque = linear([0.0, 1.0], [0.0, rate], [1e-3, 1e-3])
    simulation = simulate(problem, torque, tolerance=1e-11)
    slips = simulation.find(EventKind.SLIP)
    # The finger leans on the box, so that all of it starts to move at once.
    assert {e.contact for e in slips[:4]} == {"v0-palm", "v1-palm", "v2-finger1", "joint 1"}
    assert {e.time for e in slips[:4]} == {slips[0].time}
    assert slips[0].time * rate == pytest.approx(find_slipping_torque(problem), rel=1e-5)
    row = int(np.flatnonzero(simulation.t == slips[0].time)[0])
    c_n, c_t = simulation.c_n[row, :2], simulation.c_t[row, :2]
    assert np.abs(c_t).sum() == pytest.approx(0.3 * c_n.sum(), rel=1e-9)
    assert np.allclose(c_t / c_n, c_t.sum() / c_n.sum(), rtol=1e-12)
    assert_balanced(simulation)


def test_time_stepping_agrees_while_a_box_is_pushed_and_sticks() -> None:
    """Moreau's steps know no modes; their error falls with their length."""
    problem = pushed()
    simulation = simulate(problem, rocking(), tolerance=1e-12)
    changes = list_changes(simulation)
    order = ["slip", "stick", "slip", "stick"]
    for name in ("v0-palm", "v1-palm", "v2-finger1", "joint 1"):
        assert [kind for kind, own in changes if own == name] == order
    assert_balanced(simulation)
    moved = simulation.z[-1, 0] - problem.start[0]
    assert moved < -0.005
    errors = []
    for n in (150, 300, 600):
        z, _ = march(
            problem.phases[0].formation, problem.start, np.zeros(5),
            lambda t: evaluate(rocking(), t), 0.6, n,
        )  # fmt: skip
        errors.append(float(np.abs(z[-1] - simulation.z[-1]).max()))
    assert errors[2] < 0.65 * errors[1] < 0.42 * errors[0] < 0.02 * abs(moved)


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("off", [3e-9, -3e-9])
def test_a_planned_stop_and_start_are_kept_though_rounding_disturbs_them(
    soft: bool, off: float
) -> None:
    """Sliding ends by plan with v_t exactly zero where the torques step, or nearly so."""
    push = Push(soft)
    exact = push.fit()
    inner = np.where((exact.breaks > 0) & (exact.breaks < 0.5), off, 0.0)
    torque = TorqueProfile(exact.breaks + inner, exact.coefficients * (1 + off))
    simulation = simulate(push.problem, torque, tolerance=1e-10)
    palm = [e for e in simulation.events if e.contact == "v0-palm" and e.time < 0.4]
    # Where the acceleration vanishes, too, a speed of 1e-12 decides when it sticks.
    near = 1e-4 if soft else 1e-6
    for planned, kind in ((0.2, EventKind.STICK), (0.3, EventKind.SLIP)):
        here = [e.kind for e in palm if abs(e.time - planned) < near]
        assert here[-1] is kind
        palm = palm[len(here) :]
    assert not palm
    row = int(np.flatnonzero(simulation.t > 0.3 + near)[0])
    assert simulation.z_dot[row, 0] < 0
    assert simulation.z[-1, 0] == pytest.approx(push.problem.start[0] - 2 * push.run, abs=1e-7)
    assert_balanced(simulation)


def test_a_vertex_sticks_and_slips_in_a_landing_of_the_heptagon() -> None:
    """A squeeze that was planned for and then fails: palm friction stops the vertex twice."""
    problem, trajectory = plan_landing(squeeze=3.0)
    simulation = simulate(problem, trajectory.torque, tolerance=1e-11)
    assert simulation.outcome.kind is OutcomeKind.GOAL_REACHED
    palm = [e for e in simulation.events if e.contact == "v1-palm" and e.phase == 1]
    assert [e.kind.value for e in palm] == ["stick", "slip", "stick", "slip"]
    assert_balanced(simulation)
    (release,) = simulation.find(EventKind.RELEASE)
    row = int(np.flatnonzero(simulation.t == release.time)[-1])
    column = simulation.contacts.index("v1-palm")
    share = np.abs(simulation.c_t[row:, column] / simulation.c_n[row:, column]) / 0.1
    held = np.zeros(len(share), dtype=bool)
    for stuck, slipped in (palm[:2], palm[2:]):
        held |= (simulation.t[row:] > stuck.time) & (simulation.t[row:] < slipped.time)
    assert share[held].max() < 1 + 1e-9 and held.sum() > 5
    stop, errors = 0.55, []
    end = simulate(problem, trajectory.torque, tolerance=1e-11, times=[stop]).at(stop)
    formation = problem.phases[1].formation
    for n in (100, 200):
        z, _ = march(
            formation, simulation.z[row], simulation.z_dot[row],
            lambda t: evaluate(trajectory.torque, release.time + t), stop - release.time, n,
        )  # fmt: skip
        errors.append(float(np.abs(z[-1] - end[:5]).max()))
    assert errors[1] < 0.65 * errors[0] < 0.01


@pytest.mark.parametrize("share, late", [(0.3, -3e-10), (0.3, 3e-10), (-0.8, 0.0)])
def test_a_vertex_that_rolls_by_plan_in_a_sliding_phase(share: float, late: float) -> None:
    """It sticks where it comes to rest and the torques step, and slips where they step again."""
    problem, trajectory = plan_landing()
    last = problem.phases[1]
    start = trajectory.motions[1].evaluate(np.array([0.1])).z[0]
    roll = Roll(last.formation, start, share)
    phase = dataclasses.replace(last, index=0)
    problem = dataclasses.replace(problem, start=start, phases=(phase,))
    exact = roll.fit()
    inner = np.where((exact.breaks > 0) & (exact.breaks < 0.15), late, 0.0)
    torque = TorqueProfile(exact.breaks + inner, exact.coefficients)
    simulation = simulate(problem, torque, tolerance=1e-11, times=[0.08])
    palm = [e for e in simulation.events if e.contact == "v1-palm" and e.time < 0.14]
    for planned, kind in ((0.06, EventKind.STICK), (0.1, EventKind.SLIP)):
        here = [e.kind for e in palm if abs(e.time - planned) < 1e-6]
        assert here[-1] is kind
        palm = palm[len(here) :]
    assert not palm
    row = int(np.flatnonzero(simulation.t == 0.08)[0])
    column = simulation.contacts.index("v1-palm")
    taken = simulation.c_t[row, column] / simulation.c_n[row, column]
    assert taken == pytest.approx(-0.1 * share, abs=1e-4)
    # The object turns much farther than the joints: errors of the torques grow as much.
    assert np.allclose(simulation.z[-1], roll.move(0.15, 2)[0], atol=1e-5, rtol=0)
    assert_balanced(simulation)
