"""Rate limits and lag of motors, held torques, and pauses where phases meet."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from held import balances
from shipped import HEPTAGON, problem_of
from toys import LIMIT, Toy, constant
from wholearm import InputError, Plan, Problem, load_plan, simulate, solve, verify
from wholearm.planning.table_check import make_table
from wholearm.problem.read import read_own_problem
from wholearm.problem.table import describe_scene
from wholearm.results.dwell_record import change_torques, find_change_times
from wholearm.results.torque import TorqueProfile, read_torque_csv
from wholearm.simulation.events import EventKind, OutcomeKind
from wholearm.simulation.tolerances import REST_WINDOW
from wholearm.verification.verify import describe_motors, find_commands


@pytest.fixture(scope="module")
def heptagon() -> Problem:
    problem = problem_of(HEPTAGON)
    return replace(problem, phases=problem.phases[:2])


@pytest.fixture(scope="module")
def slow(heptagon: Problem) -> tuple[Problem, Plan]:
    problem = heptagon.with_(torque_rate_limit=500.0, actuator_lag2=1e-3)
    return problem, solve(problem, replay=False)


def fastest(rate: float) -> float:
    """Least time over one metre from rest to rest, for a' <= rate and a <= LIMIT."""
    ramp = math.cbrt(1 / (2 * rate))
    if rate * ramp <= LIMIT:
        return 4 * ramp
    return LIMIT / rate + math.sqrt((LIMIT / rate) ** 2 + 4 / LIMIT)


@pytest.mark.parametrize("rate", [4.0, 20.0])
def test_a_point_moves_in_the_least_time_that_its_torque_rate_allows(rate: float) -> None:
    plan = Toy(constant(1.0), rate_limit=(rate, rate)).plan()
    assert fastest(rate) * (1 - 1e-6) < plan.motion.duration < fastest(rate) * (1 + 2e-4)
    torque = plan.torque
    t = np.linspace(0, torque.duration, 2001)
    rates = find_commands(torque, np.ones(2)).at(t) - torque.at(t)
    assert np.abs(rates).max() < rate * (1 + 1e-3)
    assert np.abs(torque.at(np.array([0.0, torque.duration]))[:, 0]).max() < 1e-6 * LIMIT


def test_commands_of_motors_that_lag_stay_within_the_torque_limits() -> None:
    plan = Toy(constant(1.0), lag=(0.05, 0.0)).plan()
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


def test_breaks_just_before_the_end_of_a_phase_do_not_end_it(slow: tuple[Problem, Plan]) -> None:
    problem, plan = slow
    torque, first = plan.trajectory.torque, float(plan.trajectory.phase_starts[1])
    breaks = np.unique([*torque.breaks, *np.linspace(first - 1e-3, first, 41)[:-1]])
    dense = TorqueProfile.fit(breaks, torque.at, torque.coefficients.shape[2] - 1)
    found = simulate(problem, dense)
    assert found.outcome.kind is OutcomeKind.GOAL_REACHED
    came = next(event.time for event in found.events if event.kind is EventKind.ARRIVAL)
    assert came == pytest.approx(first, abs=REST_WINDOW * problem.scene.scales.time)


def test_a_phase_that_ends_early_keeps_its_torques_until_it_was_to_end(
    slow: tuple[Problem, Plan],
) -> None:
    problem, plan = slow
    # With less mass the first phase ends a millisecond early, on torques that still brake.
    lighter = problem.with_(mass=(1 - 3e-4) * problem.scene.polygon.mass)
    torque, first = plan.trajectory.torque, float(plan.trajectory.phase_starts[1])
    found = simulate(lighter, torque)
    assert found.outcome.kind is OutcomeKind.GOAL_REACHED
    came = next(event.time for event in found.events if event.kind is EventKind.ARRIVAL)
    assert came < first - 2e-4


def test_what_a_motor_cannot_follow_is_reported(heptagon: Problem) -> None:
    rows = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.0], [0.1, 0.5]])
    torque = TorqueProfile.join_rows(np.array([0.0, 0.02, 0.04, 0.04 + 1e-2]), rows)
    assert describe_motors(heptagon, torque) == []
    slow = heptagon.with_(torque_rate_limit1=4.0, torque_rate_limit2=60.0)
    (t, text), *others = describe_motors(slow, torque)
    assert not others and t < 0.02 and "tau_1 changes at 5 N m/s" in text
    lagging = heptagon.with_(actuator_lag2=0.04)
    assert "takes a command of 2.5 N m" in describe_motors(lagging, torque)[0][1]
    stepping = TorqueProfile.join_rows(
        np.array([0.0, 0.02, 0.02, 0.05]), rows * [[1], [1], [5], [5]]
    )
    assert "tau_1 steps by 0.4 N m at t = 0.02 s" in describe_motors(slow, stepping)[0][1]
    assert any("steps" in text for text in verify(slow, stepping).warnings)


def test_phases_over_time_take_as_long_as_along_their_curves(heptagon: Problem) -> None:
    problem = replace(heptagon.with_(torque_rate_limit=50.0), phases=heptagon.phases[:1])
    along = solve(problem, replay=False, accuracy=1e-2)
    over = solve(problem, replay=False, accuracy=1e-2, transcription="time", mode_search=False)
    assert over.duration == pytest.approx(along.duration, rel=1e-2)
    assert describe_motors(problem, over.trajectory.torque) == []
    torque = over.trajectory.torque
    for t in (0.0, over.duration):
        tau, z = torque.at(np.array([t]))[0], over.at(t).z[0]
        assert balances(problem.phases[0].formation, z, tau)
        assert (
            np.abs(over.at(t).z_ddot[0]).max()
            < 1e-5 * np.abs(over.at(over.duration / 3).z_ddot[0]).max()
        )


def test_torques_ramp_into_what_holds_an_end_and_out_of_it(heptagon: Problem) -> None:
    problem = replace(heptagon, settle=0.01).with_(torque_rate_limit=500.0)
    plan = solve(problem, replay=False, accuracy=1e-2)
    torque = plan.trajectory.torque
    assert describe_motors(problem, torque) == []
    for phase in plan.phases:
        assert phase.settling is not None and phase.settling.duration == 0.01
        end = plan.trajectory.phase_starts[phase.number] - 1e-9
        held = torque.at(np.array([end - 0.009, end]))
        np.testing.assert_allclose(held, [phase.settling.tau] * 2, atol=1e-9)
    assert simulate(problem, torque).outcome.kind is OutcomeKind.GOAL_REACHED


@pytest.mark.parametrize(("key", "value"), [("torque_rate_limit1", -1.0), ("actuator_lag", 1e6)])
def test_keys_are_checked_and_kept(heptagon: Problem, key: str, value: float) -> None:
    with pytest.raises(InputError, match=key.rstrip("1")):
        heptagon.with_({key: value})
    other = heptagon.with_(torque_rate_limit2=30.0, actuator_lag1=0.01)
    known = describe_scene(other.scene)
    assert known["fingers.2.torque_rate_limit"] == pytest.approx(30.0)
    assert known["fingers.1.actuator_lag"] == pytest.approx(0.01)
    assert other.with_(torque_rate_limit2=None).scene.fingers[1].torque_rate_limit == np.inf


@pytest.mark.parametrize("seed", range(8))
def test_one_motor_is_at_its_rate_or_its_command_throughout(heptagon: Problem, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rates, lags = 10 ** rng.uniform(1, 4, 2), 10 ** rng.uniform(-4, -1, 2) * [seed > 2, seed > 5]
    scene = heptagon.with_(
        torque_rate_limit1=rates[0],
        torque_rate_limit2=rates[1],
        actuator_lag1=lags[0],
        actuator_lag2=lags[1],
    ).scene
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


PERIOD = 0.011


@pytest.fixture(scope="module")
def slide() -> Problem:
    problem = problem_of(HEPTAGON)
    return replace(problem, phases=problem.phases[:1])


@pytest.mark.parametrize("hold", ["constant", "linear"])
def test_torques_are_held_from_period_to_period(slide: Problem, hold: str, tmp_path: Path) -> None:
    problem = slide.with_(control_period=PERIOD, control_hold=hold)
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
    scene = read_own_problem(known.trajectory.meta, path).scene
    assert scene.control_period == pytest.approx(PERIOD) and scene.control_hold == hold


def test_keys_are_checked(slide: Problem) -> None:
    with pytest.raises(InputError, match="control_period"):
        slide.with_(control_period=-1.0)
    with pytest.raises(InputError, match="'constant' and 'linear'"):
        slide.with_(control_period=PERIOD, control_hold="cubic")
    with pytest.raises(InputError, match=r"control_period: 0.011 given; .*hold them linear"):
        solve(slide.with_(control_period=PERIOD, torque_rate_limit=100.0))
