"""Contact modes of replays, rolling, sticking and sliding: closed forms and time stepping."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from held import balances
from plane import convex_polygon, make_formation, make_scene, measure_slip, place_corners
from planned import plan_landing
from pushing import Push, Roll, evaluate, linear, pushed, rocking
from stepping import march
from tipping import POINTS, box, constant, falling, ramp, roll, tipped
from wholearm import End, Friction, Phase, Problem, Scene, TorqueProfile, Until, simulate, verify
from wholearm.common.arrays import Array
from wholearm.contacts.closing import close_finger, place_flush
from wholearm.contacts.formation import Formation, find_touching
from wholearm.simulation.events import EventKind, OutcomeKind, Simulation


def test_replay_keeps_the_vertex_where_it_is() -> None:
    plan = tipped()
    simulation = simulate(box(), plan.torque, tolerance=1e-10, times=plan.t)
    assert simulation.outcome.reached and not simulation.find(EventKind.SLIP)
    rows = simulation.phase == 1
    corners = np.array([place_corners(box().scene, z)[1] for z in simulation.z[rows]])
    # Neither drift nor a jump on entering the phase.
    assert np.ptp(corners[:, 0]) < 1e-14 and np.abs(corners[:, 1]).max() < 1e-14
    assert simulation.energies.residual == pytest.approx(0.0, abs=1e-9)
    last = np.abs(simulation.z[-1] - plan.z[-1])
    assert last.max() < 1e-7


def fall(mu: float, lean: float) -> tuple[float, float, float]:
    """When and how far a box that falls from rest about its vertex has leant when that slips.

    Returns the time [s], the lean [rad] and the tangential force [N] from the conservation of
    energy: l is the distance of the centroid from the vertex.
    """
    body = make_scene(POINTS).polygon
    assert body.inertia is not None
    length = float(np.hypot(*body.vertices[1]))
    about = body.inertia + body.mass * length**2
    pull = body.mass * 9.81 * length / about

    def forces(angle: float) -> tuple[float, float]:
        turning, rate = pull * np.sin(angle), 2 * pull * (np.cos(lean) - np.cos(angle))
        side = length * (turning * np.cos(angle) - rate * np.sin(angle))
        up = -length * (turning * np.sin(angle) + rate * np.cos(angle))
        return body.mass * (9.81 + up), body.mass * side

    def margin(angle: float) -> float:
        c_n, c_t = forces(angle)
        return mu * c_n - abs(c_t)

    grid = np.linspace(lean, 1.5, 2000)
    slips = int(np.argmax([margin(angle) < 0 for angle in grid]))
    end = brentq(margin, grid[slips - 1], grid[slips], xtol=1e-14)

    def slowness(u: float) -> float:
        # The angle is lean + u^2: the rate at rest is a square root.
        angle = lean + u**2
        if u == 0:
            return float(2 / np.sqrt(2 * pull * np.sin(lean)))
        return float(2 * u / np.sqrt(2 * pull * (np.cos(lean) - np.cos(angle))))

    time = quad(slowness, 0, np.sqrt(end - lean), epsabs=1e-13, epsrel=1e-12)[0]
    return time, end, forces(end)[1]


@pytest.mark.parametrize("mu, sign", [(0.25, 1.0), (0.36, 1.0), (0.6, -1.0)])
def test_a_falling_box_slips_when_its_friction_cone_is_left(mu: float, sign: float) -> None:
    """Closed form; on rough ground the vertex slips forwards, on smooth ground backwards."""
    problem = falling(mu, 0.2)
    time, lean, c_t = fall(mu, 0.2)
    assert np.sign(c_t) == sign
    simulation = simulate(problem, constant((-0.01, 0.01), 2.0), tolerance=1e-12)
    assert simulation.outcome.kind is OutcomeKind.SLIPS
    event = simulation.events[-1]
    assert event.kind is EventKind.SLIP and event.contact == "v1-palm"
    assert event.time == pytest.approx(time, abs=1e-9)
    assert problem.start[2] - simulation.z[-1, 2] == pytest.approx(lean - 0.2, abs=1e-9)
    assert simulation.c_t[-1, 0] == pytest.approx(c_t, abs=1e-8)
    bound = mu * simulation.c_n[-1, 0]
    assert simulation.outcome.text == (
        f"v1-palm slips: |c_t| = {abs(c_t):.5g} N reaches mu c_n = {bound:.5g} N "
        f"at t = {time:.5g} s, phase 1"
    )
    corner = np.array([place_corners(problem.scene, z)[1] for z in simulation.z])
    assert np.abs(corner - corner[0]).max() < 1e-14


def test_a_box_cannot_start_to_roll_without_enough_friction() -> None:
    """From rest: c_t / c_n is known, and friction below that lets the vertex slip at once."""
    about = falling(1.0, 0.2)
    start = simulate(about, constant((-0.01, 0.01), 0.01))
    row = int(np.flatnonzero(~np.isnan(start.c_n[:, 0]))[0])
    needed = float(start.c_t[row, 0] / start.c_n[row, 0])
    assert 0.1 < needed < 0.4
    enough = simulate(falling(1.01 * needed, 0.2), constant((-0.01, 0.01), 0.01))
    assert enough.outcome.kind is OutcomeKind.GOAL_MISSED and enough.find(EventKind.START)
    short = simulate(falling(0.99 * needed, 0.2), constant((-0.01, 0.01), 0.01))
    assert short.outcome.kind is OutcomeKind.SLIPS and not short.find(EventKind.START)
    assert "exceeds mu c_n" in short.outcome.text and short.events[-1].time == 0.0


def push_box(mu: float) -> tuple[Problem, Array]:
    """A box that finger 1 pushes to the left while vertex 0 holds it; finger 2 is far off."""
    scene = make_scene([[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]], base=0.1)
    left = dataclasses.replace(scene.fingers[1], base=[-0.5, -0.01], viscous=0.0, dry=0.0)
    friction = Friction(mu, 0.1, 0.1)
    scene = Scene(scene.polygon, (scene.fingers[0], left), friction)
    q = place_flush(scene, 0, 0.0)
    z = np.array([*q, close_finger(scene, q, 0), np.pi / 2])
    formation = roll(make_formation(scene, "v0-palm v1-palm v2-finger1"), "v0-palm")
    phase = Phase(0, formation, Until(coordinate="x", value=-0.2))
    return Problem("pushed box", scene, 0.0, z, (phase,)), z


def test_a_rising_push_slips_a_box_when_statics_say_so() -> None:
    """The box does not move until then, so its forces follow from the torque by statics."""
    mu, rate = 0.3, 0.2
    problem, z = push_box(mu)
    scene = problem.scene
    corner = place_corners(scene, z)[2]
    run = np.sqrt(np.sum((corner - scene.fingers[0].base) ** 2) - scene.fingers[0].radius ** 2)
    n = np.array([-np.sin(z[3]), np.cos(z[3])])
    weight = scene.polygon.mass * scene.gravity
    # For a push f: f n_x + c_t = 0; both upward forces carry the weight less f n_y; moments about
    # vertex 0. All are linear in f, and so is the margin mu c_n + c_t.
    lever, high = 0.06, 0.06

    def margin(f: float) -> float:
        right = weight / 2 - (lever * n[1] - high * n[0]) * f / lever
        left = weight - f * n[1] - right
        assert right > 0
        return float(mu * left - abs(f * n[0]))

    push = margin(0.0) / (margin(0.0) - margin(1.0))
    torque = ramp((0.0, 0.001), (rate, 0.0), 3.0)
    simulation = simulate(problem, torque, tolerance=1e-11)
    assert simulation.outcome.kind is OutcomeKind.SLIPS
    assert simulation.events[-1].contact == "v0-palm"
    assert simulation.events[-1].time == pytest.approx(push * run / rate, rel=1e-9)
    np.testing.assert_allclose(simulation.z[-1, :4], z[:4], atol=1e-14)


def test_a_sliding_vertex_is_stopped_where_the_next_phase_lets_it_roll() -> None:
    """What the impact takes is the difference of both kinetic energies; the cone then decides."""
    problem = falling(0.1, 0.2)
    scene, (last,) = problem.scene, problem.phases
    slides = dataclasses.replace(last.formation, rolling=())
    until = Until(coordinate="phi", value=float(problem.start[2]) - 0.4)
    phases = Phase(0, slides, until, End.SMOOTH), dataclasses.replace(last, index=1)
    two = dataclasses.replace(problem, phases=phases)
    simulation = simulate(two, constant((-0.01, 0.01), 1.0), tolerance=1e-11)
    before = int(np.flatnonzero(simulation.phase == 0)[-1])
    z, v = simulation.z[before], simulation.z_dot[before]
    assert measure_slip(slides, z, v)[0] < -0.1
    after = simulation.z_dot[before + 1]
    assert abs(measure_slip(slides, z, after)[0]) < 1e-14
    lost = 0.5 * scene.mass_diagonal @ (v**2 - after**2)
    assert simulation.energies.impact[-1] == pytest.approx(lost) and lost > 1e-4
    assert simulation.energies.residual == pytest.approx(0.0, abs=1e-9)
    assert simulation.outcome.kind is OutcomeKind.SLIPS and simulation.events[-1].phase == 1
    assert simulation.events[-1].time == simulation.t[before]


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
    formation = problem.phases[0].formation

    def holds(tau: float) -> bool:
        return balances(formation, problem.start, np.array([tau, 0.0]))

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


def divide(problem: Problem, formations: Sequence[Formation]) -> Problem:
    """The problem's last phase in several, of which all but the last have no end of their own."""
    last = problem.phases[-1]
    first = [Phase(k, one, Until(), End.SMOOTH) for k, one in enumerate(formations[:-1])]
    final = dataclasses.replace(last, index=len(first), formation=formations[-1])
    return dataclasses.replace(problem, phases=(*first, final))


@pytest.mark.parametrize("mu", [0.25, 0.36, 0.6])
def test_a_falling_box_rolls_until_it_slips_in_closed_form(mu: float) -> None:
    """The phase ends when the cone is left; then it is as if there had been one sliding phase."""
    problem = falling(mu, 0.2)
    rolling = problem.phases[0].formation
    sliding = dataclasses.replace(rolling, rolling=())
    torque, times = constant((-0.01, 0.01), 1.0), np.linspace(0.0, 0.2, 21)
    both, alone = (
        simulate(divide(problem, formations), torque, tolerance=1e-12, times=times)
        for formations in ([rolling, sliding], [sliding])
    )
    time = fall(mu, 0.2)[0]
    (end,) = both.find(EventKind.ARRIVAL)
    assert (end.phase, end.contact) == (0, "v1-palm")
    assert end.time == pytest.approx(time, abs=1e-9)
    assert end.text == f"v1-palm slips at t = {time:.5g} s, phase 1"
    assert both.outcome.kind is alone.outcome.kind is OutcomeKind.LIMIT_REACHED
    for t in times:
        np.testing.assert_allclose(both.at(t), alone.at(t), rtol=0, atol=1e-10)
    # It slides, and friction takes energy, from there on only.
    assert not both.energies.contact[both.phase == 0].any() and both.energies.contact[-1] > 0


@pytest.mark.parametrize("share, late", [(0.3, -3e-10), (-0.8, 3e-10)])
def test_phases_end_where_a_vertex_comes_to_rest_and_slips_by_plan(
    share: float, late: float
) -> None:
    """By inverse dynamics it rests from 0.06 to 0.1 s, though the torques step by a hair off."""
    problem, trajectory = plan_landing()
    last = problem.phases[1]
    start = trajectory.motions[1].evaluate(np.array([0.1])).z[0]
    plan, sliding = Roll(last.formation, start, share), last.formation
    rolling = roll(sliding, "v1-palm")
    problem = divide(dataclasses.replace(problem, start=start), [sliding, rolling, sliding])
    exact = plan.fit()
    inner = np.where((exact.breaks > 0) & (exact.breaks < 0.15), late, 0.0)
    torque = TorqueProfile(exact.breaks + inner, exact.coefficients)
    simulation = simulate(problem, torque, tolerance=1e-11)
    ends = simulation.find(EventKind.ARRIVAL)
    assert [e.text.split(" at ")[0] for e in ends] == ["v1-palm comes to rest", "v1-palm slips"]
    assert [e.phase for e in ends] == [0, 1]
    np.testing.assert_allclose([e.time for e in ends], [0.06, 0.1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(simulation.z[-1], plan.move(0.15, 2)[0], rtol=0, atol=1e-5)
    report = verify(problem, torque)
    assert [phase.until for phase in report.phases] == ["change of v1-palm"] * 2 + ["v2-palm"]
    sticks = [change for change in report.changes if change.time < 0.14]
    assert [(change.what, change.kind, change.phase) for change in sticks] == [
        ("v1-palm", "sticks", 1)
    ]
    line = ["1", "v1-palm", "sticks", f"{sticks[0].time:.5f}"]
    assert line in [text.split() for text in report.to_text().splitlines()]
    assert report.to_dict()["changes"][0]["what"] == "v1-palm"


def test_what_sticks_as_it_slips_again_and_rests_ends_one_phase_each() -> None:
    """Between two slips the box sticks; what is stuck from the start has not come to rest."""
    problem = falling(0.36, 0.2)
    rolling = problem.phases[0].formation
    sliding = dataclasses.replace(rolling, rolling=())
    torque = constant((-0.01, 0.01), 1.0)
    alone = simulate(divide(problem, [sliding]), torque, tolerance=1e-12)
    changes = [e for e in alone.events if e.contact == "v1-palm"]
    assert [e.kind for e in changes] == [EventKind.SLIP, EventKind.STICK, EventKind.SLIP]
    parts = simulate(divide(problem, [sliding, rolling, sliding]), torque, tolerance=1e-12)
    ends = [e.time for e in parts.find(EventKind.ARRIVAL)]
    np.testing.assert_allclose(ends, [e.time for e in changes[1:]], rtol=0, atol=1e-9)


def draw(rng: np.random.Generator) -> tuple[Problem, TorqueProfile] | None:
    """An object over one vertex on the palm, and squeezing torques; None if a tip touches it."""
    scene = make_scene(convex_polygon(rng, int(rng.integers(3, 8)), 0.045), base=0.1)
    links = [
        dataclasses.replace(
            link, dry=float(10 ** rng.uniform(-4, -1.5)), inertia=float(10 ** rng.uniform(-4, -2))
        )
        for link in scene.fingers
    ]
    scene = dataclasses.replace(
        scene,
        friction=Friction(*rng.uniform(0.02, 0.5, 3)),
        fingers=(links[0], links[1]),
        fingers_collide=False,
    )
    phi = rng.uniform(-np.pi, np.pi)
    low = (scene.polygon.vertices @ [np.sin(phi), np.cos(phi)]).min()
    q = np.array([rng.uniform(-0.03, 0.03), -low, phi])
    z = np.array([*q, *(close_finger(scene, q, k) for k in (0, 1))])
    contacts = find_touching(scene, z)
    if any(contact.surface == "tip" for contact in contacts) or len(contacts) > 3:
        return None
    phase = Phase(0, Formation(scene, contacts), Until(coordinate="x", value=-5.0))
    tau = 10 ** rng.uniform(-1.5, 0.2) * np.abs(rng.normal(size=(2, 6)))
    torque = linear(np.linspace(0.0, 0.3, 6), tau[0], (-tau[1]).tolist())
    return Problem("random", scene, 0.0, z, (phase,)), torque


@pytest.mark.parametrize("seed", [32, 79, 93])
def test_agrees_with_time_stepping(seed: int) -> None:
    drawn = draw(np.random.default_rng(seed))
    assert drawn is not None
    problem, torque = drawn
    whole = simulate(problem, torque, tolerance=1e-10)
    stop = 0.999 * float(whole.t[-1])
    end = simulate(problem, torque, tolerance=1e-10, times=[stop]).at(stop)
    moved, errors = np.abs(end[:5] - problem.start).max(), []
    assert moved > 1e-4
    for n in (100, 400):
        z, _ = march(
            problem.phases[0].formation, problem.start, np.zeros(5),
            lambda t: evaluate(torque, t), stop, n,
        )  # fmt: skip
        errors.append(float(np.abs(z[-1] - end[:5]).max() / moved))
    assert errors[1] < 0.5 * errors[0] or errors[1] < 1e-4
    assert errors[1] < 0.02
    assert np.abs(whole.energies.residual).max() < 1e-8 * np.abs(whole.energies.work).max()
