"""Rate limits and lag of motors, held torques, and ends held by constant torques."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from independent import balances
from once import once
from rows import each
from shipped import HEPTAGON, HEXAGON, part_of, problem_of, solved
from toys import LIMIT, Toy, constant
from wholearm import Formation, InputError, Problem, simulate, simulate_free, solve
from wholearm.common.arrays import Array
from wholearm.contacts.elemental import parse_contact
from wholearm.mechanics.statics import Statics
from wholearm.planning import dwell
from wholearm.planning.blocks import Planning, plan_block, plan_free
from wholearm.planning.dwell import settle_plans
from wholearm.planning.options import PlanOptions
from wholearm.planning.phase_plan import PhasePlan, Plans
from wholearm.planning.replay_check import make_table
from wholearm.planning.result import Plan, describe_plan, load_plan, write_meta
from wholearm.problem.read import build_problem, read_stored_problem
from wholearm.problem.table import describe_scene
from wholearm.results.dwell_record import assemble, change_torques, find_change_times
from wholearm.results.torque import TorqueProfile, read_torque_csv
from wholearm.simulation.events import EventKind, OutcomeKind, Simulation
from wholearm.simulation.modes import A_MIN, Rest, find_standstill, maximise_margin, require_closed
from wholearm.simulation.system import REST_WINDOW
from wholearm.verification.verify import describe_motors, find_commands, verify

HELD = (0.019, 0.01, 0.01, 0.01, 0.0)
"""For how long ends are held here [s]."""
PERIOD = 0.011


def hold(changes: dict[str, Any], count: int = 5) -> tuple[Problem, Plans]:
    """Plans of the first phases with their ends held, without planning them again."""
    plain = solved(HEPTAGON)
    problem, trajectory = plain.problem.with_(changes), plain.trajectory
    problem = replace(problem, phases=problem.phases[:count])
    cuts = [trajectory.torque.cut(*ends) for ends in pairwise(trajectory.phase_starts.tolist())]
    parts = [TorqueProfile(own.breaks - own.breaks[0], own.coefficients) for own in cuts]
    pairs = zip(trajectory.motions[:count], parts, strict=False)
    plans = [PhasePlan(motion, torque, 0.0) for motion, torque in pairs]
    return problem, settle_plans(problem, plans)


@once
def settled() -> Plan:
    """The plan of the four contacts with its ends held."""
    plain = solved(HEPTAGON)
    changes = {"settle": HELD[1], "phases[1].settle": HELD[0], "phases[5].settle": HELD[-1]}
    problem, found = hold(changes)
    torque = TorqueProfile.chain([plan.torque for plan in found])
    motion = assemble([plan.motion for plan in found], torque, plain.trajectory.meta, 201)
    both = zip(plain.phases, found, strict=True)
    phases = tuple(phase._replace(settling=own.settling) for phase, own in both)
    plan = replace(plain, problem=problem, trajectory=motion, phases=phases)
    return replace(plan, trajectory=replace(motion, meta=write_meta(plan)))


def test_a_share_of_the_duration_is_spread_over_the_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole then ends where it was planned to, also from starts that are off by the gap."""
    # The planner has simulated what it returns from these starts, among others.
    runs = list[Simulation]()

    def simulate(*given: Any, **more: Any) -> Simulation:
        runs.append(simulate_free(*given, **more))
        return runs[-1]

    monkeypatch.setattr(dwell, "simulate_free", simulate)
    problem, found = hold({"settle": "10 %", "phases[2].settle": 0.002}, 3)
    times = [own.settling.duration if own.settling else 0.0 for own in found]
    plan = solved(HEPTAGON).trajectory
    duration = plan.phase_starts[3]
    assert times[1] == 0.002 and min(times) > 0
    assert sum(times) == pytest.approx(0.002 + 0.1 * duration, rel=1e-12)
    torque = TorqueProfile.chain([plan.torque for plan in found])
    for off in (problem.gap, -problem.gap):
        start = dwell.move_start(problem, off)
        assert start is not None
        (run,) = (
            own
            for own in runs
            if np.array_equal(own.torque.coefficients, torque.coefficients)
            and np.allclose(own.z[0], start, rtol=0, atol=1e-9)
        )
        away = np.abs(run.z[-1] - plan.z[plan.phase == 2][-1])
        assert max(away[:2].max(), problem.scene.scales.length * away[2:].max()) < problem.gap


def test_held_ends_balance_with_all_that_touches() -> None:
    plan = settled()
    problem, motion = plan.problem, plan.trajectory
    assert [own.settling.duration if own.settling else 0 for own in plan.phases] == [*HELD]
    for phase, own in zip(problem.phases, plan.phases, strict=True):
        if own.settling is None:
            continue
        z = motion.z[np.flatnonzero(motion.phase == phase.index)[-1]]
        touching = find_standstill(problem, phase, z).touching
        tau = np.array(own.settling.tau)
        assert balances(touching, z, tau, problem.epsilon)
        assert (np.abs(tau) <= problem.scene.torque_limit * (1 + 1e-9)).all()


def test_they_drive_on_towards_what_is_still_open() -> None:
    """By the simulator's rows at rest, which are set up on their own, from the largest gap on."""
    plan = settled()
    problem, motion = plan.problem, plan.trajectory
    for phase, own in zip(problem.phases, plan.phases, strict=True):
        settling = own.settling
        if phase.until.contact is None or settling is None:
            continue
        z = motion.z[np.flatnonzero(motion.phase == phase.index)[-1]]
        gained = Formation(problem.scene, (phase.until.contact,))
        normal = gained.evaluate(z[None], np.zeros((1, 5))).A[0][0]
        first = Rest(phase.formation, z).sliding[0]
        assert first.heading is not None
        back = settling.gap / (normal @ first.heading) * first.heading
        z = require_closed(phase.formation, z + back)
        gap = float(gained.evaluate(z[None], np.zeros((1, 5))).C[0, 0])
        assert gap == pytest.approx(settling.gap, rel=0.02)
        tau, (one, two) = np.array(settling.tau), Rest(phase.formation, z).sliding
        assert one.heading is not None and two.heading is not None
        way = one if normal @ one.heading < 0 else two
        closing = -float(normal @ way.heading) * way.drive(tau)
        assert closing >= 0.99 * A_MIN * problem.scene.scales.acceleration
        assert settling.speed == pytest.approx(np.sqrt(2 * gap * closing), rel=0.02)
        assert not balances(phase.formation, z, tau)


def test_the_whole_ends_where_it_was_planned_to() -> None:
    plan = settled()
    problem, motion = plan.problem, plan.trajectory
    report = verify(problem, plan)
    assert report.ok and not report.warnings
    run = simulate_free(problem, plan)
    away = np.abs(run.z[-1] - motion.z[-1])
    assert away[:2].max() < 1e-7 and away[2:].max() < 1e-6
    assert motion.duration == pytest.approx(solved(HEPTAGON).duration + sum(HELD), rel=1e-12)
    assert f"held for {sum(HELD):.6g} s in all" in describe_plan(plan, "plan.npz").to_text()


def test_a_start_that_is_short_makes_little_difference() -> None:
    """No more than the 0.1 mm that it is off to the right, and 0.1 degrees."""
    plan = settled()
    assert plan.duration < 1.1 * solved(HEPTAGON).duration
    start = dwell.move_start(plan.problem, 1e-4)
    away = simulate_free(plan.problem, plan.trajectory, start=start).z[-1] - plan.trajectory.z[-1]
    assert np.hypot(*away[:2]) < 1e-4 and abs(away[2]) < np.radians(0.1)


def test_held_ends_are_written_and_read(tmp_path: Path) -> None:
    plan = settled()
    plan.save(tmp_path / "plan.npz")
    read = load_plan(tmp_path / "plan.npz")
    assert [own.settling for own in read.phases] == [own.settling for own in plan.phases]
    assert read.problem.settle == HELD[1] and read.problem.gap == plan.problem.gap
    ends, held = plan.trajectory.phase_starts[1:5], HELD[1]
    for t in (*(ends - held / 3), *(ends - 2.5 * held)):
        one, two = read.trajectory.at(t), plan.trajectory.at(t)
        np.testing.assert_allclose(one.z, two.z, atol=1e-7)
        np.testing.assert_allclose(one.tau, two.tau, atol=1e-3)
        np.testing.assert_array_equal(np.isnan(one.c_n), np.isnan(two.c_n))
    rest = read.trajectory.at(ends - held / 3)
    # Interpolated from samples that are the same but for rounding.
    np.testing.assert_allclose(rest.z_dot, 0.0, atol=1e-9)
    assert np.isnan(rest.c_n).all()


def test_margins_are_those_of_the_linear_programme() -> None:
    scene, rng = problem_of(HEPTAGON).scene, np.random.default_rng(3)
    unit = scene.scales.torque
    for _ in range(40):
        rows = rng.normal(size=(12, 3)) / [1.0, unit, unit]
        bounds = rng.normal(size=(2, 3)) / [1.0, unit, unit]
        sides = np.vstack([rows, bounds])
        count = np.repeat([1.0, 0.0], [12, 2])
        answer = linprog(
            [0.0, 0.0, -1.0],
            A_ub=np.column_stack([-sides[:, 1:] * unit, count]),
            b_ub=sides[:, 0],
            bounds=[*((-most / unit, most / unit) for most in scene.torque_limit), (None, 1e3)],
        )
        found = maximise_margin(scene.torque_limit, rows, bounds)
        assert (found is None) == (answer.status != 0)
        if found is not None:
            assert found[1] == pytest.approx(answer.x[2], abs=1e-6)
            assert (rows @ [1.0, *found[0]]).min() == pytest.approx(found[1], abs=1e-6)


def test_keys_are_checked_and_kept() -> None:
    plain = problem_of(HEPTAGON)
    assert plain.settle == 0 and plain.settles(plain.phases[0]) == 0
    assert 9e-5 < plain.gap < 1.1e-4
    problem = plain.with_({"settle": 0.01, "settle_gap": 5e-5, "phases[2].settle": 0})
    assert [problem.settles(phase) for phase in problem.phases] == [0.01, 0, 0.01, 0.01, 0.01]
    assert problem.gap == 5e-5 and problem.table["phases"][1]["settle"] == 0
    shared = plain.with_({"settle": "10 %", "phases[2].settle": 0.01})
    assert shared.settle_share == pytest.approx(0.1) and shared.table["settle"] == "10 %"
    assert [shared.settles(phase) for phase in shared.phases] == [None, 0.01, None, None, None]
    again = replace(problem, settle=0.02)
    assert again.table["settle"] == 0.02 and again.table["phases"][1]["settle"] == 0


@each(
    "changes, key, allowed",
    [
        ({"settle": -1}, "settle", ">= 0"),
        ({"settle": 1e9}, "settle", "allowed are"),
        ({"settle": "ten"}, "settle", "100 %"),
        ({"settle": "0 %"}, "settle", "100 %"),
        ({"settle_gap": 1.0}, "settle_gap", "allowed are"),
        ({"phases[1].settle": "x"}, "phases[1].settle", ">= 0"),
        ({"phases[1].settle": 0.01, "phases[1].end": "smooth"}, "phases[1].settle", "smooth"),
        ({"torque_rate_limit1": -1.0}, "fingers.1.torque_rate_limit", "-1"),
        ({"actuator_lag": 1e6}, "fingers.1.actuator_lag", "allowed"),
        ({"control_period": -1.0}, "control_period", "-1"),
        ({"control_period": PERIOD, "control_hold": "cubic"}, "control_hold", "'constant' and 'l"),
    ],
)
def test_wrong_keys_are_named(changes: dict[str, object], key: str, allowed: str) -> None:
    with pytest.raises(InputError, match=allowed) as raised:
        problem_of(HEPTAGON).with_(changes)
    assert raised.value.key == key


@pytest.fixture(scope="module")
def heptagon() -> Problem:
    return part_of(problem_of(HEPTAGON), 0, 2)


@pytest.fixture(scope="module")
def slow(heptagon: Problem) -> tuple[Problem, Plan]:
    problem = heptagon.with_(torque_rate_limit=500.0, actuator_lag2=1e-3)
    return problem, solve(problem, replay=False, intervals=40)


def fastest(rate: float) -> float:
    """Least time over one metre from rest to rest, for a' <= rate and a <= LIMIT."""
    ramp = math.cbrt(1 / (2 * rate))
    if rate * ramp <= LIMIT:
        return 4 * ramp
    return LIMIT / rate + math.sqrt((LIMIT / rate) ** 2 + 4 / LIMIT)


@pytest.mark.parametrize("rate", [4.0, 20.0])
def test_a_point_moves_in_the_least_time_that_its_torque_rate_allows(rate: float) -> None:
    accuracy = 2e-4
    plan = Toy(constant(1.0), rate_limit=(rate, rate)).plan(accuracy=accuracy)
    assert fastest(rate) * (1 - 1e-6) < plan.motion.duration < fastest(rate) * (1 + accuracy)
    torque = plan.torque
    t = np.linspace(0, torque.duration, 2001)
    rates = torque.slopes.at(t)
    assert np.abs(rates).max() < rate * (1 + 1e-3)
    assert np.abs(torque.at(np.array([0.0, torque.duration]))[:, 0]).max() < 1e-6 * LIMIT


def test_commands_of_motors_that_lag_stay_within_the_torque_limits() -> None:
    plan = Toy(constant(1.0), lag=(0.05, 0.0)).plan(intervals=40)
    commands = find_commands(plan.torque, np.array([0.05, 0.0]))
    most = np.abs(commands.at(np.linspace(0, commands.duration, 2001))[:, 0]).max()
    assert most < LIMIT * (1 + 1e-3)
    inner = plan.torque.breaks[1:-1]
    steps = plan.torque.at(inner + 1e-12) - plan.torque.at(inner - 1e-12)
    assert np.abs(steps[:, 0]).max() < 1e-6 * LIMIT
    assert plan.motion.duration > 2 / np.sqrt(LIMIT)


def test_torques_of_a_plan_never_step_and_hold_the_object_between_phases(
    slow: tuple[Problem, Plan], tmp_path: Path
) -> None:
    problem, plan = slow
    torque, scene = plan.trajectory.torque, problem.scene
    assert describe_motors(problem, torque) == []
    start = plan.trajectory.phase_starts[1]
    for t in (0.0, start):
        tau, z = torque.at(np.array([t]))[0], plan.at(t).z[0]
        assert balances(problem.phases[int(t > 0)].formation, z, tau)
    assert verify(problem, plan).ok
    path = tmp_path / "torques.csv"
    make_table(problem, plan.trajectory, replay=False).save(path)
    t, tau1, tau2, command1, command2 = np.loadtxt(path, delimiter=",", skiprows=2).T
    # Rows of torques are a fit of lines.
    np.testing.assert_allclose(command1, tau1, atol=1e-3 * scene.torque_limit[0])
    ahead = np.gradient(tau2, t) * 1e-3
    assert np.median(np.abs(command2 - tau2 - ahead)) < 1e-2 * np.abs(ahead).max()
    assert read_torque_csv(str(path)).duration == t[-1]


def test_quick_motors_cost_little_of_the_largest_margin(heptagon: Problem) -> None:
    problems = heptagon, heptagon.with_(torque_rate_limit=5000.0)
    free, quick = (solve(p, "margin", duration=0.42, accuracy=1e-3).value for p in problems)
    assert 0.99 * free < quick < free * (1 + 2e-3)  # two accuracies


@pytest.mark.parametrize("motors", [{"actuator_lag": 2e-3}, {"torque_rate_limit": 500.0}])
def test_limited_torques_change_into_dwells(heptagon: Problem, motors: dict[str, float]) -> None:
    problem = heptagon.with_(motors | {"settle": 0.01, "speed_limit": 50.0})
    plan = solve(problem, intervals=40)
    torque, starts = plan.trajectory.torque, plan.trajectory.phase_starts
    # Neither steps, rates nor commands beyond the limits, and the replay reaches the goal.
    assert describe_motors(problem, torque) == []
    assert f"{0.02 / plan.value:.1%} of the motion's {plan.value:.6f} s; torq" in plan.to_text()
    report = verify(problem, plan)
    held = [own.wedged for own in plan.phases] + [own.wedged for own in report.phases]
    assert report.ok and max(time or 0.0 for time in held) < 1e-4
    # Each phase ends with the torques of its dwell, for as long as that lasts.
    for phase, end in zip(plan.phases, starts[1:], strict=True):
        assert phase.settling is not None and phase.settling.duration == 0.01
        t = np.linspace(end - 0.01 + 1e-9, end - 1e-9, 5)
        np.testing.assert_allclose(torque.at(t), [phase.settling.tau] * 5, rtol=1e-6)


def test_torques_near_the_end_of_a_phase_do_not_move_it(slow: tuple[Problem, Plan]) -> None:
    problem, plan = slow
    torque, first = plan.trajectory.torque, float(plan.trajectory.phase_starts[1])
    breaks = np.unique([*torque.breaks, *np.linspace(first - 1e-3, first, 41)[:-1]])
    dense = TorqueProfile.fit(breaks, torque.at, torque.coefficients.shape[2] - 1)
    # With less mass the first phase ends a millisecond early, on torques that still brake.
    lighter = problem.with_(mass=(1 - 6e-4) * problem.scene.polygon.mass)
    only_2 = problem.with_(torque_rate_limit1=None, actuator_lag2=0.0)  # Steps early in phase 2.
    runs = simulate(problem, dense), simulate(lighter, torque), simulate(only_2, solve(only_2))
    assert all(run.outcome.kind is OutcomeKind.GOAL_REACHED for run in runs)
    timely, early = (run.find(EventKind.ARRIVAL)[0].time for run in runs[:2])
    assert timely == pytest.approx(first, abs=REST_WINDOW * problem.scene.scales.time)
    assert early < first - 2e-4


def test_what_a_motor_cannot_follow_is_reported(heptagon: Problem) -> None:
    rows = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.0], [0.1, 0.5]])
    torque = TorqueProfile.join_rows(np.column_stack([[0.0, 0.02, 0.04, 0.04 + 1e-2], rows]))
    assert describe_motors(heptagon, torque) == []
    slow = heptagon.with_(torque_rate_limit1=4.0, torque_rate_limit2=60.0)
    (t, text), *others = describe_motors(slow, torque)
    assert not others and t < 0.02 and "tau_1 changes at 5 N m/s" in text
    # Within a microsecond the same rate gains next to nothing on its limit.
    brief = TorqueProfile.join_rows(np.array([[0.0, 0.0, 0.0], [1e-6, 5e-6, 0.0], [1.0, 0.0, 0.0]]))
    assert describe_motors(slow, brief) == []
    lagging = heptagon.with_(actuator_lag2=0.04)
    assert "takes a command of 2.5 N m" in describe_motors(lagging, torque)[0][1]
    steps = np.column_stack([[0.0, 0.02, 0.02, 0.05], rows * [[1], [1], [5], [5]]])
    stepping = TorqueProfile.join_rows(steps)
    assert "tau_1 steps by 0.4 N m at t = 0.02 s" in describe_motors(slow, stepping)[0][1]
    assert any("steps" in text for text in verify(slow, stepping).warnings)


def test_phases_over_time_take_as_long_as_along_their_curves(heptagon: Problem) -> None:
    problem = part_of(heptagon.with_(torque_rate_limit=50.0), 0, 1)
    along = solve(problem, replay=False, intervals=40)
    options: dict[str, Any] = {"mode_search": False, "time_intervals": 6}
    over = solve(problem, replay=False, transcription="time", **options)
    assert over.duration == pytest.approx(along.duration, rel=1e-2)
    assert describe_motors(problem, over.trajectory.torque) == []
    torque = over.trajectory.torque
    for t in (0.0, over.duration):
        tau, z = torque.at(np.array([t]))[0], over.at(t).z[0]
        assert balances(problem.phases[0].formation, z, tau)
        ends, middle = (np.abs(over.at(time).z_ddot[0]).max() for time in (t, over.duration / 3))
        assert ends < 1e-5 * middle


def test_keys_of_motors_are_kept(heptagon: Problem) -> None:
    other = heptagon.with_(torque_rate_limit2=30.0, actuator_lag1=0.01)
    known = describe_scene(other.scene)
    assert known["fingers.2.torque_rate_limit"] == pytest.approx(30.0)
    assert known["fingers.1.actuator_lag"] == pytest.approx(0.01)
    assert other.with_(torque_rate_limit2=None).scene.fingers[1].torque_rate_limit == np.inf


@each("seed", range(8))
def test_one_motor_is_at_its_rate_or_its_command_throughout(heptagon: Problem, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rates, lags = 10 ** rng.uniform(1, 4, 2), 10 ** rng.uniform(-4, -1, 2) * [seed > 2, seed > 5]
    limits = {f"torque_rate_limit{k}": rate for k, rate in enumerate(rates, 1)}
    delays = {f"actuator_lag{k}": lag for k, lag in enumerate(lags, 1)}
    scene = heptagon.with_(limits | delays).scene
    before, after = rng.uniform(-0.98, 0.98, (2, 2)) * scene.torque_limit
    change = change_torques(scene, before, after)
    t = np.linspace(0.0, change.duration, 4001)
    tau = change.torque.at(t)
    np.testing.assert_allclose(tau[[0, -1]], [before, after], atol=1e-6)
    rate = np.gradient(tau, t, axis=0)
    command = np.abs(tau + lags * rate) / scene.torque_limit * (lags > 0)
    load = np.maximum(np.abs(rate) / rates, command).max(axis=1)[5:-5]
    assert load.max() < 1 + 1e-4
    assert load.min() > 1 - 1e-2
    assert find_change_times(scene, before, after) == pytest.approx(change.duration, rel=1e-12)


def test_a_torque_at_its_limit_is_reached_in_a_finite_time(heptagon: Problem) -> None:
    scene = heptagon.with_(torque_rate_limit=200.0, actuator_lag=0.002).scene
    limit = scene.torque_limit
    times = find_change_times(scene, 0.1 * limit, np.stack([0.1 * limit, 0.9 * limit, limit]))
    assert times[0] == 0
    assert times[1] < times[2] < 10 * 0.002 + 2 * limit.max() / 200.0


@pytest.mark.parametrize("hold", ["constant", "linear"])
def test_torques_are_held_from_period_to_period(hold: str, tmp_path: Path) -> None:
    problem = part_of(problem_of(HEPTAGON), 0, 1).with_(control_period=PERIOD, control_hold=hold)
    plan = solve(problem, accuracy=1e-2, mode_search=False, replay=False)
    assert verify(problem, plan).ok
    torque, spans = plan.trajectory.torque, np.arange(0.0, plan.duration, PERIOD)
    inside = np.linspace(0.01, 0.99, 8)
    for start in spans:
        span = min(PERIOD, plan.duration - start)
        tau = torque.at(start + span * inside)
        order = 2 if hold == "linear" else 1
        assert np.abs(np.diff(tau, order, axis=0)).max() < 1e-5
    before, after = torque.at(spans[1:] - 1e-9), torque.at(spans[1:] + 1e-9)
    steps = np.abs(after - before).max()
    assert steps < 1e-3 if hold == "linear" else steps > 0.1
    (free,) = [phase.unheld for phase in plan.phases]
    assert free is not None and free < plan.value < 1.05 * free
    path = str(tmp_path / "held.npz")
    plan.save(path)
    known = load_plan(path)
    assert known.phases[0].unheld == free
    scene = read_stored_problem(known.trajectory.meta, path).scene
    assert scene.control_period == pytest.approx(PERIOD) and scene.control_hold == hold


def test_a_landing_begins_where_held_torques_have_led() -> None:
    contacts = ["v0-palm", "v1-palm", "v3-finger1", "v0-finger2"]
    slide = {"contacts": contacts, "until": {"x": -0.07}}
    flip = {"contacts": contacts[1:], "until": {"contact": "v1-finger2", "x": -0.08567}}
    changes = {"x": -0.065, "phases": [slide, flip], "control_period": PERIOD}
    problem = problem_of(HEXAGON).with_(changes)
    plan = solve(problem, accuracy=1e-2, mode_search=False, replay=False).trajectory
    first = plan.torque.cut(0.0, plan.phase_starts[1])
    end = simulate(replace(problem, phases=problem.phases[:1]), first).z[-1]
    # What a replay and a plan differ by, up to 1e-8 rad here, a landing multiplies.
    assert plan.motions[1].evaluate(np.zeros(1)).z[0] == pytest.approx(end, abs=1e-13)


TURNED = np.array([-0.05469906, 0.0494152, -2.18382371, 2.38529929, 2.03754111])
"""Start of the last phase of the turn, on three contacts."""
TURN = (
    {
        "contacts": ["v3-palm", "v5-finger1", "v1-finger2"],
        "until": {"contact": "v6-finger1", "x": -0.05466183792},
    },
    {"contacts": ["v3-palm", "v5-finger1", "v6-finger1", "v1-finger2"], "until": "v2-finger2"},
    {
        "contacts": ["v3-palm", "v6-finger1", "v1-finger2"],
        "until": {"contact": "v4-palm", "x": 0.00791478646},
    },
)


def turn(changes: dict[str, Any]) -> tuple[Problem, Formation, Array]:
    """A turn of the heptagon with its last phase's formation and start."""
    table = {**problem_of(HEPTAGON).table, "start": {"flush": 2, "x": -0.0597}, "phases": [*TURN]}
    problem = build_problem(table).with_(changes)
    formation = problem.phases[-1].formation
    return problem, formation, require_closed(formation, TURNED)


def test_continuous_torques_begin_on_the_verge_of_a_mode() -> None:
    """The modes that statics list press by a balance of their own, with friction of sliding."""
    problem, own, z = turn({})
    epsilon = problem.epsilon
    scene, kinematics = problem.scene, own.evaluate(z[None], np.zeros((1, 5)))
    A, A_t = kinematics.A[0], kinematics.A_t[0]
    listed = Statics(own, z).list_continuous(epsilon)
    assert listed is not None
    modes = {signs for _, signs in listed}
    pressed = dict[tuple[float, ...], bool]()
    for signs in product((-1.0, 1.0), repeat=5):
        Xi, sigma = np.split(np.array(signs), [3])
        push = A - (own.friction * Xi)[:, None] * A_t
        load = -scene.applied_force + scene.dry * np.append(np.zeros(3), sigma)
        x = np.linalg.solve(np.vstack([push, np.eye(5)[3:]]).T, load)
        pressed[signs] = bool(
            (x[:3] >= epsilon).all() and (np.abs(x[3:]) < scene.torque_limit).all()
        )
    assert all(pressed[signs] for signs in modes if all(signs))
    # The turn by itself cannot begin so; while its first contact with finger 2 rolls it can.
    fast = (1.0, -1.0, -1.0, -1.0, -1.0)
    assert not pressed[fast] and (1.0, -1.0, 0.0, -1.0, -1.0) in modes


def test_a_turn_begins_and_ends_in_other_modes_under_rate_limits() -> None:
    rate, options = 500.0, PlanOptions(accuracy=1e-2, mode_search=False)
    problem, formation, z = turn({"torque_rate_limit": rate})
    planning = Planning(problem, (), options, ())
    (free,) = plan_free(planning, problem.phases[2:], z)
    ((plan,), _) = plan_block(planning, problem.phases[2:], z)
    assert free.value < plan.value < 1.05 * free.value
    torque, t = plan.torque, np.linspace(0.0, plan.motion.duration, 2001)
    steps = np.abs(np.diff(torque.at(t), axis=0)) / np.diff(t)[:, None]
    assert steps.max() < rate * (1 + 1e-3)
    ends, landed = plan.motion.evaluate(t[[0, -1]]).z, parse_contact("v4-palm", problem.scene)
    for touching, place, tau in zip(
        (formation, formation.add(landed)), ends, plan.end_torques, strict=True
    ):
        assert Statics(touching, place).torque_polygon().measure(tau[None])[0] < 1e-6


def test_torques_that_are_held_cannot_be_limited_in_their_rate() -> None:
    slide = part_of(problem_of(HEPTAGON), 0, 1)
    with pytest.raises(InputError, match=r"control_period: 0.011 given; .*hold them linear"):
        solve(slide.with_(control_period=PERIOD, torque_rate_limit=100.0))
