"""Contact modes and transitions of replays, against closed forms and time stepping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import bisect, brentq

from independent import balances, integrate_phase, march
from once import once
from plane import convex_polygon, make_formation, make_scene, measure_slip, place_corners
from planned import CosineMotion, LandingMotion, change, choose_squeeze, fit, forward, plan_landing
from pushing import Push, Roll, pushed, rocking
from scenes import POINTS, box, constant, falling, ramp, roll, tipped
from shipped import HEXAGON, problem_of
from wholearm import Contact, End, Friction, Phase, Problem, TorqueProfile, Until, simulate, verify
from wholearm.contacts.closing import close_finger
from wholearm.contacts.formation import Formation, find_touching
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import Directions
from wholearm.mechanics.impact import solve_impulses
from wholearm.planning.plan import solve
from wholearm.problem.read import build_problem
from wholearm.simulation import modes
from wholearm.simulation.events import EventKind, OutcomeKind, Simulation


def test_replay_keeps_the_vertex_where_it_is() -> None:
    plan = tipped()
    simulation = simulate(box(), plan.torque, tolerance=1e-10, times=plan.t)
    assert simulation.outcome.reached and not simulation.find(EventKind.SLIP)
    rows = simulation.phase == 1
    corners = place_corners(box().scene, simulation.z[rows])[:, 1]
    # Neither drift nor a jump on entering the phase.
    assert np.ptp(corners[:, 0]) < 1e-14 and np.abs(corners[:, 1]).max() < 1e-14
    assert simulation.energies.residual == pytest.approx(0.0, abs=1e-9)
    last = np.abs(simulation.z[-1] - plan.z[-1])
    assert last.max() < 1e-7


def fall(mu: float, lean: float) -> tuple[float, float, float]:
    """When and how far a box that falls from rest about its vertex has leant when that slips."""
    # Returns the time [s], the lean [rad] and the tangential force [N] from the conservation of
    # energy: l is the distance of the centroid from the vertex.
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
def test_a_falling_box_keeps_its_vertex_until_its_cone_is_left(mu: float, sign: float) -> None:
    """In closed form, whether the vertex has to roll, may slide, or does one after the other."""
    # On rough ground it slips forwards, on smooth ground backwards.
    problem = falling(mu, 0.2)
    rolling = problem.phases[0].formation
    sliding = replace(rolling, rolling=())
    torque, times = constant((-0.01, 0.01), 1.0), np.linspace(0.0, 0.2, 21)
    rolls, sticks, both = (
        simulate(divide(problem, formations), torque, tolerance=1e-12, times=times)
        for formations in ([rolling], [sliding], [rolling, sliding])
    )
    time, lean, c_t = fall(mu, 0.2)
    assert np.sign(c_t) == sign
    end, slip = rolls.events[-1], sticks.find(EventKind.SLIP)[0]
    (arrival,) = both.find(EventKind.ARRIVAL)
    for simulation, event in ((rolls, end), (sticks, slip), (both, arrival)):
        assert event.contact == "v1-palm" and event.time == pytest.approx(time, abs=1e-9)
        row = int(np.flatnonzero(simulation.t == event.time)[0])
        assert problem.start[2] - simulation.z[row, 2] == pytest.approx(lean - 0.2, abs=1e-9)
        assert simulation.c_t[row, 0] == pytest.approx(c_t, abs=1e-8)
        corners = place_corners(problem.scene, simulation.z[: row + 1])[:, 1]
        assert np.abs(corners - corners[0]).max() < 1e-13
        assert not simulation.energies.contact[: row + 1].any()
        assert_balanced(simulation)
    bound = mu * rolls.c_n[-1, 0]
    assert rolls.outcome.kind is OutcomeKind.SLIPS and end.kind is EventKind.SLIP
    assert rolls.outcome.text == (
        f"v1-palm slips: |c_t| = {abs(c_t):.5g} N reaches mu c_n = {bound:.5g} N "
        f"at t = {time:.5g} s, phase 1"
    )
    assert slip.text == arrival.text == f"v1-palm slips at t = {time:.5g} s, phase 1"
    # The force goes on from one side of the jump to the other, and sliding is against it.
    after = int(np.flatnonzero(sticks.t == slip.time)[1])
    assert sticks.c_t[after, 0] == pytest.approx(c_t, abs=1e-8)
    rows = slice(after + 1, after + 4)
    slipping = measure_slip(sliding, sticks.z[rows], sticks.z_dot[rows])[:, 0]
    assert (np.sign(slipping) == -sign).all() and sticks.energies.contact[-1] > 0
    # A phase that ends there makes no difference to what follows.
    assert both.outcome.kind is sticks.outcome.kind is OutcomeKind.LIMIT_REACHED
    for t in times:
        np.testing.assert_allclose(both.at(t), sticks.at(t), rtol=0, atol=1e-10)


def test_a_box_cannot_start_to_roll_without_enough_friction() -> None:
    """From rest: c_t / c_n is known, and friction below that lets the vertex slip at once."""
    torque = constant((-0.01, 0.01), 0.01)
    start = simulate(falling(1.0, 0.2), torque)
    row = int(np.flatnonzero(~np.isnan(start.c_n[:, 0]))[0])
    needed = float(start.c_t[row, 0] / start.c_n[row, 0])
    assert 0.1 < needed < 0.4
    enough, short = (simulate(falling(mu * needed, 0.2), torque) for mu in (1.01, 0.99))
    assert enough.outcome.kind is OutcomeKind.GOAL_MISSED and enough.find(EventKind.START)
    assert short.outcome.kind is OutcomeKind.SLIPS and not short.find(EventKind.START)
    assert "exceeds mu c_n" in short.outcome.text and short.events[-1].time == 0.0


def test_a_rising_push_slips_a_box_when_statics_say_so() -> None:
    """The box does not move until then, so its forces follow from the torque by statics."""
    mu, rate = 0.3, 0.2
    problem = pushed(mu)
    (phase,) = problem.phases
    phase = replace(phase, formation=roll(phase.formation, "v0-palm"))
    problem, scene, z = replace(problem, phases=(phase,)), problem.scene, problem.start
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
    slides = replace(last.formation, rolling=())
    until = Until(coordinate="phi", value=float(problem.start[2]) - 0.4)
    phases = Phase(0, slides, until, End.SMOOTH), replace(last, index=1)
    two = replace(problem, phases=phases)
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


def test_a_swinging_joint_is_held_while_its_dry_friction_allows() -> None:
    """Piecewise cubics: J theta'' = tau - D sgn(theta'), and rest where |tau| <= D."""
    problem = pushed(contacts="v0-palm v1-palm")
    scene = problem.scene
    swings = replace(scene.fingers[0], viscous=0.0)
    scene = replace(scene, fingers=(swings, scene.fingers[1]))
    (phase,) = problem.phases
    away = problem.start - 0.6 * np.eye(5)[3]
    phase = replace(phase, formation=make_formation(scene, "v0-palm v1-palm"))
    problem = replace(problem, scene=scene, start=away, phases=(phase,))
    D, J = swings.dry, swings.inertia
    rows = [[0.0, 0.1, 0.3, 0.4], [0.0, 2 * D, -2 * D, -2 * D], 4 * [1e-3]]
    torque = TorqueProfile.join_rows(np.array(rows).T)
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
    turned = np.abs(np.diff(np.interp([*times, 0.4], simulation.t, simulation.z[:, 3]))).sum()
    assert simulation.energies.dry[-1] == pytest.approx(D * turned, rel=1e-9)
    assert_balanced(simulation)


def test_a_rising_push_slips_a_flush_edge_when_both_cones_are_left() -> None:
    problem = pushed()
    rate = 0.5
    # Finger 2 keeps moving, so that the box is stuck and not at rest.
    torque = ramp((0.0, 1e-3), (rate, 0.0), 1.0)
    simulation = simulate(problem, torque, tolerance=1e-11)
    slips = simulation.find(EventKind.SLIP)
    # The finger leans on the box, so that all of it starts to move at once.
    assert {e.contact for e in slips[:4]} == {"v0-palm", "v1-palm", "v2-finger1", "joint 1"}
    assert {e.time for e in slips[:4]} == {slips[0].time}

    def hold(tau: float) -> float:
        """Whether anything holds the box at rest, by a linear programme: 1/2, or else -1/2."""
        return balances(problem.phases[0].formation, problem.start, np.array([tau, 0.0])) - 0.5

    largest = bisect(hold, 0.0, 0.2, xtol=1e-9)
    assert slips[0].time * rate == pytest.approx(largest, rel=1e-5)
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
        z, _ = march(problem.phases[0].formation, problem.start, np.zeros(5), rocking(), 0.6, n)
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
    column = simulation.contacts.index("v1-palm")
    share = np.abs(simulation.c_t[:, column] / simulation.c_n[:, column]) / 0.1
    held = np.zeros(len(share), dtype=bool)
    for stuck, slipped in (palm[:2], palm[2:]):
        held |= (simulation.t > stuck.time) & (simulation.t < slipped.time)
    assert share[held].max() < 1 + 1e-9 and held.sum() > 5


def divide(problem: Problem, formations: Sequence[Formation]) -> Problem:
    """The problem's last phase in several, of which all but the last have no end of their own."""
    last = problem.phases[-1]
    first = [Phase(k, one, Until(), End.SMOOTH) for k, one in enumerate(formations[:-1])]
    final = replace(last, index=len(first), formation=formations[-1])
    return replace(problem, phases=(*first, final))


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
    problem = divide(replace(problem, start=start), [sliding, rolling, sliding])
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
    sliding = replace(rolling, rolling=())
    torque = constant((-0.01, 0.01), 1.0)
    alone = simulate(divide(problem, [sliding]), torque, tolerance=1e-12)
    changes = [e for e in alone.events if e.contact == "v1-palm"]
    assert [e.kind for e in changes] == [EventKind.SLIP, EventKind.STICK, EventKind.SLIP]
    parts = simulate(divide(problem, [sliding, rolling, sliding]), torque, tolerance=1e-12)
    ends = [e.time for e in parts.find(EventKind.ARRIVAL)]
    np.testing.assert_allclose(ends, [e.time for e in changes[1:]], rtol=0, atol=1e-9)


def draw(rng: np.random.Generator) -> tuple[Problem, TorqueProfile]:
    """An object over one vertex on the palm, and squeezing torques."""
    scene = make_scene(convex_polygon(rng, int(rng.integers(3, 8)), 0.045), base=0.1)
    right, left = (
        replace(link, dry=10 ** rng.uniform(-4, -1.5), inertia=10 ** rng.uniform(-4, -2))
        for link in scene.fingers
    )
    friction = Friction(*rng.uniform(0.02, 0.5, 3))
    scene = replace(scene, friction=friction, fingers=(right, left), fingers_collide=False)
    phi = rng.uniform(-np.pi, np.pi)
    low = (scene.polygon.vertices @ [np.sin(phi), np.cos(phi)]).min()
    q = np.array([rng.uniform(-0.03, 0.03), -low, phi])
    z = np.array([*q, *(close_finger(scene, q, k) for k in (0, 1))])
    phase = Phase(0, Formation(scene, find_touching(scene, z)), Until(coordinate="x", value=-5.0))
    assert phase.formation.n_contacts == 3
    tau = 10 ** rng.uniform(-1.5, 0.2) * np.abs(rng.normal(size=(2, 6)))
    rows = np.column_stack([np.linspace(0.0, 0.3, 6), tau[0], -tau[1]])
    torque = TorqueProfile.join_rows(rows)
    return Problem("random", scene, 0.0, z, (phase,)), torque


@pytest.mark.parametrize("seed", [32, 79, 93])
def test_agrees_with_time_stepping(seed: int) -> None:
    problem, torque = draw(np.random.default_rng(seed))
    whole = simulate(problem, torque, tolerance=1e-10)
    stop = 0.999 * float(whole.t[-1])
    end = simulate(problem, torque, tolerance=1e-10, times=[stop]).at(stop)
    moved, errors = np.abs(end[:5] - problem.start).max(), []
    assert moved > 1e-4
    for n in (100, 400):
        z, _ = march(problem.phases[0].formation, problem.start, np.zeros(5), torque, stop, n)
        errors.append(float(np.abs(z[-1] - end[:5]).max() / moved))
    assert errors[1] < 0.5 * errors[0] or errors[1] < 1e-4
    assert errors[1] < 0.02
    assert np.abs(whole.energies.residual).max() < 1e-8 * np.abs(whole.energies.work).max()


RELEASE = 0.5
"""When `plan_landing` lets vertex 3 go [s]."""


def landing_of() -> LandingMotion:
    motion = plan_landing()[1].motions[1]
    assert isinstance(motion, LandingMotion)
    return motion


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


def test_releases_and_lands_as_planned() -> None:
    problem, trajectory = plan_landing()
    simulation = simulate(problem, trajectory.torque, times=trajectory.t)
    assert simulation.outcome.reached
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
    passing = replace(problem, phases=(replace(first, until=until), last))
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
    going = replace(last, end=End.SMOOTH)
    after = Phase(2, flat, Until(coordinate="x", value=1.0))
    passing = replace(problem, phases=(first, going, after))
    # The landing brakes less near its end.
    torque = change(trajectory.torque, lambda t, c: c * np.where(t > 0.66, 0.97, 1)[:, None, None])
    simulation = simulate(passing, torque)
    arrival = next(e for e in simulation.events if e.kind is EventKind.ARRIVAL)
    before = int(np.flatnonzero(simulation.phase == 1)[-1])
    assert simulation.t[before] == simulation.t[before + 1] == arrival.time
    z, z_dot = simulation.z[before], simulation.z_dot[before]
    rate = Formation(problem.scene, (gained,)).evaluate(z[None], z_dot[None]).A[0, 0] @ z_dot
    assert arrival.value == pytest.approx(-rate, rel=1e-9) and arrival.value > 1e-3
    goes_on = simulation.z_dot[before + 1]
    mass, P = problem.scene.mass_diagonal, flat.evaluate(z[None], z_dot[None]).P[0]
    nearest = solve_impulses(mass, P, P, z_dot)[0]
    assert np.allclose(goes_on, nearest, atol=1e-12, rtol=0)
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


def landing_from_rest() -> Problem:
    """The second half of the landing alone, from rest halfway."""
    problem, _ = plan_landing()
    start = landing_of().evaluate(np.array([0.1])).z[0]
    return replace(problem, start=start, phases=(replace(problem.phases[1], index=0),))


def test_start_with_two_freedoms() -> None:
    moving, rng = landing_from_rest(), np.random.default_rng(3)
    (phase,), z = moving.phases, moving.start
    rest, seen = modes.Rest(phase.formation, z), 0
    assert len(rest.sliding) == 2**5
    # One more constraint at most leaves a freedom to move in.
    assert len(list(rest.list_modes())) == 2**5 + 5 * 2**4
    while seen < 3:
        tau = np.array([1.0, -1.0]) * rng.uniform(0.0, 2.0, size=2)
        change_of_state = rest.wait(tau[:, None], -1.0)
        if not isinstance(change_of_state, modes.StartDeparture):
            continue
        directions = Directions(*np.split(change_of_state.mode.signs, [-2]))
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
    still, tau = landing_from_rest(), np.array([0.4, -0.4])
    (phase,), z = still.phases, still.start
    simulation = simulate(still, constant(tau, 0.01))
    assert simulation.events[0].kind is EventKind.START
    row = np.flatnonzero(~np.isnan(simulation.c_n[:, 0]))[0]
    reserve = phase.formation.friction * simulation.c_n[row] - np.abs(simulation.c_t[row])
    assert phase.formation.names[int(reserve.argmax())] == "v6-finger2"
    assert reserve.max() > 0.1 and np.sort(reserve)[1] < 1e-12
    moved = simulation.z[-1] - z
    errors = []
    for n in (20, 40):
        marched, _ = march(phase.formation, z, np.zeros(5), constant(tau, 0.01), 0.01, n)
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


def test_a_start_shows_once_its_acceleration_exceeds_rounding() -> None:
    """Balance is lost a little earlier: the palm's contact is on the verge of sliding, too."""
    corners = [[0.0499, -0.0031], [0.0268, 0.0422], [-0.0236, 0.0441]]
    corners += [[-0.049, 0.0098], [-0.0252, -0.0432], [0.0316, -0.0387]]
    phases = [{"contacts": ["v1-palm", "v2-finger1", "v5-finger2"], "until": {"x": 0.07}}]
    start = {"flush": 1, "x": 0.0658}
    problem = problem_of(HEXAGON).with_({"vertices": corners, "start": start, "phases": phases})
    torques = [[0.1185525643378136, 0.04320277349437667, -0.00030286699521259175]]
    torques += [[-1.1310188153889746, -0.5855907965602957, 7.361256049165377e-11]]
    rest = modes.Rest(problem.phases[0].formation, problem.start)
    departure = rest.wait(np.array(torques), -1.0)
    assert isinstance(departure, modes.StartDeparture) and departure.x < -1 + 1e-5


def test_what_is_beyond_the_end_of_a_link_does_not_touch() -> None:
    problem = problem_of(HEXAGON)
    phase = replace(problem.phases[0], until=Until(Contact("v", 3, "finger", 1)))
    place = modes.find_standstill(problem, phase, problem.start)
    assert set(place.touching.names) == {*phase.formation.names, "v2-finger1"}
    assert modes.maximise_margin(np.ones(2), np.array([[-np.inf, 1.0, 0.0]])) is None


@pytest.mark.parametrize("early", (1e-7, 5e-7))
def test_of_breaks_near_each_other_a_phase_ends_at_the_nearest(early: float) -> None:
    problem, torque, end = plan_passing(0.066)
    parts = torque.cut(0.0, end - early), torque.cut(end - early, torque.duration)
    breaks = np.append(parts[0].breaks, parts[1].breaks[1:])
    coefficients = np.concatenate([part.coefficients for part in parts])
    simulation = simulate(problem, TorqueProfile(breaks, coefficients))
    arrival = simulation.find(EventKind.ARRIVAL)[0]
    assert arrival.phase == 0 and arrival.time == pytest.approx(end, rel=1e-12)


@pytest.mark.parametrize("until", ["e4-tip2", "e5-tip2"])
def test_a_pointed_tip_gains_either_edge_at_a_vertex(until: str) -> None:
    """The hexagon slides until v5 is at the tip of a short finger 2, and back."""
    # Both edges touch the tip there, and the motion back opens both.
    contacts = ["v0-palm", "v1-palm", "v3-finger1", "v5-finger2"]
    phases = [{"contacts": contacts, "until": end} for end in (until, {"x": -0.025})]
    changes = {"length1": 0.18, "length2": 0.057, "radius": 0.0, "x": -0.03, "phases": phases}
    problem = problem_of(HEXAGON).with_(changes)
    curves = trace_phases(problem)
    # Finger 2 holds v5 in reach on both sides of the place above its joint.
    corner = np.array([curves[0].end[0] - 0.05, 0.0433]) - problem.scene.fingers[1].base
    assert np.hypot(*corner) == pytest.approx(0.057, rel=1e-9)
    motions = [CosineMotion(c, 0.4, choose_squeeze(c, 0.4, 0.2, 2.0)) for c in curves]
    simulation = simulate(
        problem, TorqueProfile.chain([fit(motion, 20, 7) for motion in motions]), times=[0.2]
    )
    assert simulation.outcome.reached
    halfway = motions[0].evaluate(np.array([0.2])).z[0]
    np.testing.assert_allclose(simulation.at(0.2)[:5], halfway, atol=1e-9)
    first = simulation.z[simulation.phase == 0][-1]
    np.testing.assert_allclose(first, curves[0].end, atol=1e-9)
    np.testing.assert_allclose(simulation.z[-1], curves[1].end, atol=1e-9)
