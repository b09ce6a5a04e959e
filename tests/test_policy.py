"""Torques as a function of the joints, and reserves where ranges are known."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are
from scipy.optimize import linprog

import wholearm
from scenes import PENTAGON
from shipped import HEPTAGON, HEXAGON, IMPACTS, LANDING, part_of, plan_of, problem_of
from wholearm import InputError, Plan, Policy, Problem, TorqueProfile, Trajectory, Uncertainty
from wholearm.analysis.robustness import make_trial
from wholearm.cli.command import main
from wholearm.geometry.tracing import trace_phase
from wholearm.mapping.formation_list import write_template
from wholearm.mechanics.dynamics import Directions, forward
from wholearm.mechanics.limits import force_limit_rows
from wholearm.policy import curve_law, make, regulator
from wholearm.policy.curve_law import CurveLaw, LoopSettings, TimeLaw, choose_internal_force
from wholearm.policy.regulator import DAMPING, RATE, Linear, hold_end, regulate, tabulate_motion
from wholearm.problem.definition import End
from wholearm.problem.read import build_problem
from wholearm.results.dwell_record import assemble
from wholearm.simulation.simulate import simulate_free
from wholearm.verification import free
from wholearm.verification.free import FreeReport, find_losses, list_aliases, verify_policy


@pytest.fixture(scope="module")
def problem() -> Problem:
    """The first two slides of the heptagon."""
    return part_of(problem_of(HEPTAGON), 0, 2).with_(epsilon=0.2)


@pytest.fixture(scope="module")
def plan(problem: Problem) -> Plan:
    return wholearm.solve(problem, replay=False)


@pytest.fixture(scope="module")
def policy(problem: Problem, plan: Plan) -> Policy:
    return make.make_policy(problem, plan.trajectory)


def test_pressing_against_a_new_contact_lifts_no_light_object() -> None:
    corners = np.array([[0.0, 0.0], [0.07, 0.0], [0.09, 0.04], [0.05, 0.08], [0.01, 0.06]])
    table = tomllib.loads(write_template("pentagon", vertices=corners, mass=0.3))
    table["phases"][1]["until"] = "v0-finger2"
    third = {"contacts": ["v0-palm", "v1-palm", "v2-finger1", "v0-finger2"], "until": {"x": 0.0263}}
    problem = build_problem({**table, "phases": [*table["phases"], third]})
    plan = wholearm.solve(problem, replay=False).trajectory
    assert not verify_policy(problem, plan, make.make_policy(problem, plan)).failures


def test_the_squeeze_has_the_largest_least_level() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        values, press = rng.normal(size=(2, 8))
        level, squeeze = choose_internal_force(np.column_stack([values, press]).tolist())
        assert level == pytest.approx((values + press * squeeze).min(), abs=1e-12)
        rows = np.column_stack([np.ones(8), -press])
        best = linprog([-1, 0], A_ub=rows, b_ub=values, bounds=[(None, None)] * 2)
        assert level == pytest.approx(-best.fun, abs=1e-9)


def test_limits_that_the_squeeze_does_not_change_leave_it_where_it_is(policy: Policy) -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        lines = rng.normal(size=(8, 2)).tolist()
        level, squeeze = choose_internal_force(lines)
        assert choose_internal_force([*lines, (level - 1.0, 0.0)]) == (level - 1.0, squeeze)
    # A coefficient that is 0 but for rounding counts as 0.
    tables, levels = dict(policy.tables[0]), []
    for rounding in (0.0, 5e-15, -2e-17):
        tables["levels"] = policy.tables[0]["levels"].copy()
        tables["levels"][0, 0, 0, 4] = rounding
        levels.append(CurveLaw(tables, policy.settings).slack)
    assert levels[0] == levels[1] == levels[2]


def test_the_fastest_motion_between_limits_of_the_acceleration() -> None:
    # |s''| <= 2 from rest to rest over a length of 1: halfway 2 sqrt(1 / 2) long, peak b = 2.
    s = np.linspace(0.0, 1.0, 21)
    limits = np.array([[2.0, -1.0, 0, 0, 0], [2.0, 1.0, 0, 0, 0]])
    slack = np.tile(limits, (21, 1, 1))
    cap = 12 * np.minimum(s, 1 - s)
    b = make.retime(s, slack, np.zeros((21, 2)), cap).run(0.0)
    assert b == pytest.approx(4 * np.minimum(s, 1 - s), abs=1e-9)
    # Half of it is kept in reserve.
    b = make.retime(s, slack, np.ones((21, 2)), b).run(0.0)
    assert b == pytest.approx(2 * np.minimum(s, 1 - s), abs=1e-9)


def test_the_joints_show_an_impact() -> None:
    problem = part_of(problem_of(IMPACTS), 0, 2).with_({"phases[2].end": "rest"})
    plan = wholearm.solve(problem, replay=False).trajectory
    policy = make.make_policy(problem, plan)
    first, second = policy.laws
    assert isinstance(first, CurveLaw) and isinstance(second, CurveLaw)
    # The reference goes on as fast as the impact of the plan leaves it.
    k = int(np.flatnonzero(plan.phase == 1)[0])
    ratio = np.linalg.norm(plan.theta_dot[k]) / np.linalg.norm(plan.theta_dot[k - 1])
    before, after = (
        np.sqrt(law.b[k]) * np.hypot(*law.chords[k]) / law.steps[k]
        for law, k in ((first, -1), (second, 0))
    )
    assert after / before == pytest.approx(ratio, rel=0.02)
    report = verify_policy(problem, plan, policy)
    assert report.ok, report.failures
    made = min(own.start for own in report.whole.stretches if own.contact == "v3-finger1")
    assert made <= report.phases[1].start <= made + 1.01 * policy.settings.period


def test_without_a_reserve_it_is_as_fast_as_the_plan(
    problem: Problem, plan: Plan, policy: Policy
) -> None:
    own = make.make_policy(problem, plan.trajectory, reserve=0.0).about["phases"]
    for phase, with_reserve in zip(own, policy.about["phases"], strict=True):
        assert phase["plan"] <= phase["duration"] < with_reserve["duration"]
        assert with_reserve["duration"] < 1.5 * phase["plan"]


def test_contacts_are_made_more_slowly_where_some_are_lost_otherwise(
    problem: Problem, plan: Plan, policy: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At half the speed, after times at rest that are four times as long."""
    usual = policy.settings

    def verify(problem: Problem, plan: Trajectory, policy: Policy, **options: Any) -> FreeReport:
        report = verify_policy(problem, plan, policy, **options)
        lost = ("v1-palm is lost",) if policy.settings.touch == usual.touch else ()
        return replace(report, failures=(*report.failures, *lost))

    monkeypatch.setattr(free, "verify_policy", verify)
    slower, report = free.find_policy(problem, plan.trajectory)
    assert report.ok and report.warnings[-1].endswith("otherwise v1-palm is lost")
    assert slower.settings.touch == pytest.approx(usual.touch / 2)
    stops = 3 * usual.dwell * sum(not law.passes for law in policy.laws)
    assert stops < slower.duration - policy.duration < 1.5 * stops
    assert not free.find_policy(problem, plan.trajectory, contact_speed=1.0)[1].ok


def test_a_policy_keeps_contacts_where_numbers_are_off(
    problem: Problem, plan: Plan, policy: Policy
) -> None:
    off = problem.with_(mass=0.21, friction=0.09, speed_limit=0.5, torque_rate_limit=1.0)
    report = verify_policy(off, plan.trajectory, policy.with_sensor())
    assert report.ok and [phase.number for phase in report.phases] == [1, 2], report.reason
    assert all(text in str(report.warnings) for text in ("tau_2 steps by", "1 = 0.5 rad/s is"))
    end = report.phases[-1].deviation
    assert end is not None and end.position < 1e-3


def draw(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The accelerations of two coordinates in proportion to their state and to both torques."""
    rng = np.random.default_rng(seed)
    B, rates = rng.normal(size=(2, 2)), rng.normal(size=(2, 4))
    return np.vstack([np.eye(2, 4, 2), rates]), B


def test_gains_are_those_of_the_riccati_equation() -> None:
    A, B = draw(6)
    cost, N = np.diag([1.0, 2.0]), np.vstack([np.zeros((3, 2)), np.eye(2)])
    step = 1e-4
    gains = regulate([Linear([3, 4], N, np.eye(2), A, B, cost)] * 50, step) * (1 + DAMPING**2)
    inputs, Q = np.vstack([np.zeros((2, 2)), B]), np.diag([RATE**4] * 2 + [2 * RATE**2] * 2)
    P = solve_continuous_are(A, inputs, Q, cost)
    best = np.linalg.solve(cost, inputs.T @ P)
    # Torques are held for a step.
    assert gains[0] == pytest.approx(best, rel=0.1)
    assert np.linalg.eigvals(A - inputs @ gains[0]).real.max() < -0.3 * RATE


def test_joints_that_hardly_move_with_the_object_cause_no_large_torques() -> None:
    A, B = draw(7)

    def find_gains(seen: float) -> np.ndarray:
        # The joints move as (1, 0) and `seen` times (0, 1).
        N = np.vstack([np.eye(3, 2), np.diag([1.0, seen])])
        return np.asarray(regulate([Linear([0, 1], N, np.eye(2), A, B, np.eye(2))] * 2, 1e-4)[0])

    whole, none, little = (find_gains(seen) for seen in (1.0, 0.0, 1e-3))
    assert np.abs(none[:, [1, 3]]).max() < 1e-9 * np.abs(whole).max()
    assert np.abs(little).max() < 1.01 * np.abs(whole).max()
    assert little[:, [0, 2]] == pytest.approx(whole[:, [0, 2]], rel=1e-6)


def test_speeds_along_a_curve_are_right_between_and_at_its_nodes(policy: Policy) -> None:
    # Joint angles (s, s^2) at a speed of 1: chords alone are 5 % off at their ends.
    s = np.linspace(0.0, 1.0, 11)
    tables = dict(policy.tables[0])
    tables |= {"s": s, "theta": np.column_stack([s, s**2]), "b": np.ones(11)}
    tables |= {name: tables[name][:10] for name in ("levels", "torque", "forces")}
    law = CurveLaw(tables, policy.settings)
    for place in (0.401, 0.45, 0.499):
        law._measure((place, place**2), (1.0, 2 * place))
        assert law.v == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("approach", [0.1, 0.0])
def test_a_landing_goes_on_until_its_contact_stops_the_joints(approach: float) -> None:
    # Without a slow motion that presses all contacts, torques at the end close the new one.
    settings = LoopSettings(1e-3, 0.0, 1e-3, 1e-3, 5e-3, 1.0, (1.0, 1.0))
    theta = np.linspace([0.0, 0.0], [0.01, 0.0], 11)
    tables = {
        "starts": np.zeros(1), "step": np.array([1e-3]), "theta": theta,
        "rates": np.zeros((11, 2)), "tau": np.full((11, 2), 0.1),
        "gain": np.tile([[50, 0, 1, 0], [0, 50, 0, 1]], (11, 1, 1)), "push": np.full(2, 0.5),
        "still": np.array([0.02]), "ways": np.array([[0.0, 1.0]]),
        "approach": np.array([approach, 0.0]),
    }  # fmt: skip
    law = TimeLaw(tables, settings)
    angle, ends = np.zeros(2), 0.012  # the contact is 2 mrad beyond the end
    for step in range(200):
        beyond = min(max(1e-3 * (step - 10), 0.0) * 0.1, ends - 0.01)
        angle[:] = 0.01 * min(step / 10, 1.0) + beyond, 0.0
        speed = 0.1 if angle[0] < ends - 1e-9 else 0.0
        torques = law.step(angle.tolist(), [speed, 0.0], None)
        if law.finished:
            break
        assert law.contact_made <= (angle[0] > ends - 1e-9)
        if not approach and 12 < step < 28:
            assert torques == pytest.approx((0.5 - speed, 0.5))
    # It is held with the torques that press, without a spring across what the contact leaves free.
    assert law.contact_made and step < 80 and torques == pytest.approx((0.5, 0.5))


def test_a_contact_presses_under_the_name_of_the_neighbour_that_it_goes_on_from() -> None:
    own = problem_of(HEXAGON)
    aliases = [list_aliases(own, own.phases[index]) for index in (8, 9, 10)]
    assert aliases[1]["v4-tip1"] == {"e3-tip1", "v4-finger1"}
    # Over the vertex as well, within one period of a policy.
    assert aliases[0]["e3-tip1"] == {"v4-tip1", "v4-finger1"}
    assert aliases[2]["v4-finger1"] == {"v4-tip1", "e3-tip1"}
    assert not aliases[1]["v1-palm"]


def test_ends_that_a_plan_holds_are_held_with_its_torques(problem: Problem) -> None:
    own = part_of(problem, 0, 1).with_(settle=0.01)
    plan = wholearm.solve(own, replay=False).trajectory
    assert plan.held.any()
    (law,) = make.make_policy(own, plan).laws
    assert law.push == pytest.approx(plan.tau[-1].tolist())


def test_contacts_that_change_their_names_are_one_law(tmp_path: Path) -> None:
    # A link passes with its side, over its tip, to an edge.
    problem = part_of(build_problem(tomllib.loads(PENTAGON)), 0, 4)
    plan = wholearm.solve(problem, replay=False).trajectory
    policy = make.make_policy(problem, plan)
    assert [len(law.starts) for law in policy.laws] == [1, 3]
    policy.save(tmp_path / "policy.npz")
    report = verify_policy(problem, plan, Policy.load(tmp_path / "policy.npz"))
    assert report.ok and [phase.number for phase in report.phases] == [1, 2, 3, 4], report.reason
    end = report.phases[-1].deviation
    assert end is not None and end.position < 5e-5 and end.angle < np.radians(0.05)
    # Torques of one side of a border are held up to half a period beyond it: they press there, too.
    law = policy.laws[1]
    assert isinstance(law, CurveLaw)
    for phase, k in zip(problem.phases[2:], law.borders, strict=True):
        row, speed = np.flatnonzero(plan.phase == phase.index)[0], float(np.sqrt(law.b[k]))
        z, chord = plan.z[row], np.array(law.chords[k]) / law.steps[k]
        v = plan.z_dot[row] * speed * np.linalg.norm(chord) / np.linalg.norm(plan.z_dot[row, 3:])
        a = (law.b[k] - law.b[k - 1]) / (2 * law.steps[k - 1])
        tables = law.slack[k - 1], law.torque[k - 1]
        levels, torques = (curve_law._evaluate(table, 1.0, speed) for table in tables)
        tau = np.array(torques) @ [1.0, a, curve_law._choose_at(levels, a)[1]]
        at = phase.formation.evaluate(z[None], v[None])
        c = forward(phase.formation, at, v[None], tau[None], Directions.of(at, v[None]))[1]
        assert c.min() > -0.03 * problem.scene.scales.force  # -0.5 with limits of one side alone


def test_a_stop_where_a_contact_changes_its_name_is_passed() -> None:
    # Nothing stops the joints there: they would go on to well beyond the border.
    problem = part_of(build_problem(tomllib.loads(PENTAGON)), 0, 3)
    phases = tuple(replace(phase, end=End.REST) for phase in problem.phases)
    problem = replace(problem, phases=phases)
    plan = wholearm.solve(problem, replay=False).trajectory
    policy = make.make_policy(problem, plan)
    assert [len(law.starts) for law in policy.laws] == [1, 2]
    report = verify_policy(problem, plan, policy)
    assert report.ok and not report.phases[2].losses
    row = np.flatnonzero(report.trajectory.phase == 2)[0]
    speed = np.abs(report.trajectory.z_dot[row, 3:]).max()
    assert speed > 0.1 * make.SETTINGS.touch * problem.scene.scales.rate


def test_a_contact_may_be_open_for_a_moment_where_a_phase_begins(problem: Problem) -> None:
    phase, rho = problem.phases[0], problem.scene.scales.length
    t, name = np.linspace(0.0, 0.1, 101), "v0-palm"
    lifted = np.tile(problem.start + np.array([0.0, 0.01 * rho, 0.0, 0.0, 0.0]), (101, 1))
    for pauses, first in (([(0.0, 0.004), (0.05, 0.06)], 0.05), ([(0.0, 0.004)], 0.0)):
        lists = {name: pauses}
        stub: Any = SimpleNamespace(
            problem=problem, t=t, z=lifted, list_pauses=lambda name, *_, of=lists: of.get(name, [])
        )
        (loss,) = find_losses(stub, phase, 0.0, 0.1, 1e-3, 0.005)
        assert (loss.contact, loss.time, loss.closes) == (name, first, pauses[-1][1])
        assert loss.gap == pytest.approx(0.01 * rho)
        assert not find_losses(stub, phase, 0.0, 0.1, 0.02, 0.005)


def test_files(tmp_path: Path, problem: Problem, plan: Plan, policy: Policy) -> None:
    path = tmp_path / "policy.npz"
    plan.save(tmp_path / "plan.npz")
    assert main(["policy", str(tmp_path / "plan.npz"), "-o", str(path)]) == 0
    loaded = Policy.load(path)
    with pytest.raises(InputError, match=r"policy\.npz: t: array is missing; this is a policy"):
        wholearm.load_trajectory(path)
    theta, rates = problem.start[3:].tolist(), [0.0, 0.0]
    policy.reset()
    assert loaded.step(theta, rates) == pytest.approx(policy.step(theta, rates), rel=1e-13)
    code = (
        "import sys; from wholearm.policy.playback import Policy; "
        f"p = Policy.load({str(path)!r}); p.reset(); p.step({theta}, {rates}); "
        "assert not {'casadi', 'scipy'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(InputError, match="phase: 3 given"):
        policy.reset(3)
    with pytest.raises(InputError, match="theta_dot: nan, 0 given"):
        policy.step(theta, [np.nan, 0.0])
    for value, words in (([], r"float64 of shape \(0,\) given"), ([np.nan], "not finite")):
        np.savez(path, **{**np.load(path), "keeps_1": np.array(value)})
        with pytest.raises(InputError, match=f"keeps_1: .*{words}"):
            Policy.load(path)


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str], plan: Plan) -> None:
    file = tmp_path / "plan.npz"
    plan.save(file)
    assert main(["verify", str(HEPTAGON), str(file), "--policy", str(file)]) == 2
    assert "--policy: needs --free" in capsys.readouterr().err
    assert main(["verify", str(HEPTAGON), str(file), "--free", "--policy", str(file)]) == 2
    assert "meta: is not that of a policy" in capsys.readouterr().err
    assert main(["policy", str(file), "--reserve", "-1", "-o", str(tmp_path / "p.npz")]) == 2
    assert "--reserve: -1.0 given; allowed are 0 to 1000" in capsys.readouterr().err
    assert not (tmp_path / "p.npz").exists()


def test_no_policy_is_written_that_does_not_carry_out_its_plan(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    problem: Problem,
    plan: Plan,
    policy: Policy,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan.save(tmp_path / "plan.npz")
    # Torques that let go where the second phase begins.
    first, last = policy.tables
    weak = Policy([first, {**last, "torque": 0.2 * last["torque"]}], policy.settings)
    weak.about = policy.about
    monkeypatch.setattr(free, "make_policy", lambda *_, **__: weak)
    report = verify_policy(problem, plan.trajectory, weak)
    monkeypatch.setattr(free, "verify_policy", lambda *_, **__: report)
    output = tmp_path / "policy.npz"
    command = ["policy", str(tmp_path / "plan.npz"), "-o", str(output)]
    assert main(command) == 1
    said = capsys.readouterr().err
    assert "no policy is written" in said and "phase 2, and opens by" in said
    tried = "--contact-speed 0.5, --contact-speed 0.25, --period 0.0002 --delay 0, --reserve 1.25"
    tried += ", a plan with epsilon = 0.4 N"
    assert f"{tried} would not do either; --write-anyway" in said
    assert not output.exists()
    assert main([*command, "--write-anyway"]) == 0
    assert "phase 2, and opens by" in capsys.readouterr().err
    assert any("opens by" in text for text in Policy.load(output).about["failures"])


def test_an_end_without_a_gained_contact_is_held(problem: Problem) -> None:
    own = part_of(problem, 0, 1).with_({"phases[1].until": {"x": 0.01}})
    tau = hold_end(own, own.phases[0], own.start)
    assert tau is not None
    torque = TorqueProfile(np.array([0.0, 0.05]), tau[None, :, None])
    held = simulate_free(own, torque)
    assert held.z[-1] == pytest.approx(own.start, abs=1e-9)


def test_a_contact_that_rolls_does_not_slip_at_another_speed() -> None:
    until = {"contact": "v1-finger2", "x": -0.08567}
    flip = {"contacts": ["v1-palm", "v3-finger1", "v0-finger2"], "until": until}
    problem = problem_of(HEXAGON).with_({"x": -0.07004, "phases": [flip]})
    plan = wholearm.solve(problem, replay=False).trajectory
    stretches = regulator.split_modes(problem.phases[0], plan, np.linspace(0, plan.duration, 30))
    rolling = [part for part in stretches if part.formation.rolling]
    assert rolling
    for part, b in product(rolling, (1.0, 0.5)):
        _, c, tau = part.scale(b)
        # With the internal force of the plan |c_t| is 2.2 mu c_n at half of its squared speed.
        assert (force_limit_rows(part.formation) @ c.T).min() > 0.0
        assert np.abs(tau).max() < 2.0 + 1e-6


def test_a_landing_without_a_reserve_is_planned_anew(tmp_path: Path) -> None:
    # The last two phases alone.
    whole, known = problem_of(LANDING), plan_of(LANDING)
    phases = tuple(replace(phase, index=k) for k, phase in enumerate(whole.phases[4:]))
    own = known.torque.cut(known.phase_starts[4], known.duration)
    torque = TorqueProfile(own.breaks - own.breaks[0], own.coefficients)
    meta = {key: known.meta[key][4:] for key in ("modes", "rolling")}
    plan = assemble(known.motions[4:], torque, dict(known.meta) | meta, 201)
    problem = replace(whole, start=plan.z[0], phases=phases)

    def planner(own: Problem) -> Trajectory:
        return wholearm.solve(own, time_intervals=4, replay=False).trajectory

    # Between its samples a file does not show where modes change.
    plan.save(tmp_path / "plan.npz")
    loaded = wholearm.load_trajectory(tmp_path / "plan.npz")
    tables = [tabulate_motion(problem, phases, each, 1e-3) for each in (plan, loaded)]
    for name in ("theta", "rates", "tau"):
        array = tables[0][name]
        assert tables[1][name] == pytest.approx(array, abs=5e-3 * np.abs(array).max()), name
    policy = make.make_policy(problem, plan, planner=planner)
    law = policy.laws[-1]
    assert isinstance(law, TimeLaw)
    # The plan's torques are at their limit, the policy's leave some of it to feedback.
    assert np.abs(plan.tau).max() == pytest.approx(2.0, rel=1e-6)
    assert np.abs(law.tau).max() < 1.85
    # It ends where the plan does: the new landing is pinned to the plan's.
    assert law.theta[-1] == pytest.approx(plan.z[-1, 3:], abs=regulator.END_TOLERANCE)
    # What friction holds a little beside it is held with the same torques ever after.
    law.begin(at_end=True)
    held = [law.step([one + 1e-4 for one in law.theta[-1]], [0.0, 0.0], None) for _ in range(900)]
    assert law.finished and held[-1] == held[100]
    report = verify_policy(problem, plan, policy)
    assert report.ok, report.failures


RANGES = {"mass": 0.1, "inertia": 0.1, "friction": 0.2, "start_x": 5e-4}
RANGES |= dict.fromkeys(("geometry", "gain", "delay"), 0.0)


@pytest.fixture(scope="module")
def ranged() -> Problem:
    """The first slide of the heptagon."""
    return part_of(problem_of(HEPTAGON), 0, 1).with_(uncertainty=RANGES)


@pytest.fixture(scope="module")
def ranged_plan(ranged: Problem) -> Trajectory:
    return wholearm.solve(ranged, replay=False).trajectory


def test_limits_are_the_forces_in_the_worst_corner(ranged: Problem) -> None:
    widths = dict.fromkeys(("friction_palm", "friction_finger1", "friction_finger2"), 0.2)
    widths |= {"mass": 0.1, "inertia": 0.1}
    curve = trace_phase(ranged.phases[0], ranged.start, ())
    s = curve.length * np.array([0.1, 0.2, 0.3])
    within = make.find_range_limits(curve, s, np.zeros(3), widths, ranged.epsilon)
    a, b, squeeze = np.array([3.0, 0.0, -4.0]), np.array([0.1, 0.2, 0.1]), np.full(3, 2.0)
    known = np.column_stack([np.ones(3), a, b, np.sqrt(b), squeeze])
    tau = np.einsum("nfq,nq->nf", within.torque, known)
    point, part = curve.evaluate(s), curve.segments[0]
    assert part.stop > s[-1]
    z_dot = point.z_s * np.sqrt(b)[:, None]
    directions = Directions(part.Xi, part.sigma)
    least, scenes = np.full((3, 4), np.inf), make.list_scenes(ranged.scene, widths)
    assert len(scenes) == 32
    for scene in scenes:
        formation = replace(curve.formation, scene=scene)
        at = formation.evaluate(point.z, z_dot)
        least = np.minimum(least, forward(formation, at, z_dot, tau, directions)[1])
    rows, _, _ = within.at((a, b, squeeze))
    unit = max(make.SETTINGS.force_margin * ranged.scene.scales.force, ranged.epsilon)
    found = unit * np.einsum("nmq,nq->nm", rows.slack[:, : rows.n_force], known).reshape(3, -1, 4)
    assert found[:, 0] == pytest.approx(least, abs=1e-9)
    # Other rows are of corners that are worst at other squeezes.
    assert (found > least[:, None] - 1e-9).all()


def test_contacts_are_kept_in_corners_of_ranges(ranged: Problem, ranged_plan: Trajectory) -> None:
    policy = make.make_policy(ranged, ranged_plan)
    assert policy.about["phases"][0]["share"] == 1.0
    assert policy.duration < 1.6 * ranged_plan.duration
    trial = make_trial(ranged, ranged_plan, Uncertainty(RANGES, None), None, policy)
    # The start is before that of the policy's table.
    off = {"mass": 0.1, "inertia": -0.1, "friction_palm": -0.2, "friction_finger1": 0.2}
    record = trial.change(off | {"start_x": 5e-4})
    assert record["reached"] and record["kept"], (record["lost"], record["time"])


def test_ranges_too_wide_are_kept_in_part(ranged: Problem, ranged_plan: Trajectory) -> None:
    curve = trace_phase(ranged.phases[0], ranged.start, ())
    s = np.linspace(0.0, curve.length, 11)
    b = 0.05 * (4 * s * (curve.length - s) / curve.length**2)
    motion = np.gradient(b, s) / 2, b, np.ones(11)
    found, share = make.retime_in_ranges(curve, s, motion, {"mass": 0.5, "friction_palm": 1.0}, 0.2)
    assert 0.0 < share < 1.0 and found is not None
    assert (found[1].run(0.0) <= b + 1e-12).all()
    with pytest.raises(InputError, match="uncertainty: is missing"):
        make.find_largest_factors(replace(ranged, uncertainty=None), ranged_plan, 0.0)


def test_geometry_and_gains_count_to_first_order(ranged: Problem) -> None:
    curve = trace_phase(ranged.phases[0], ranged.start, ())
    s, motion = np.array([0.1 * curve.length]), (np.ones(1), np.full(1, 0.1), np.full(1, 2.0))
    known = np.array([1.0, 1.0, 0.1, np.sqrt(0.1), 2.0])

    def measure(widths: dict[str, float]) -> np.ndarray:
        rows, _, _ = make.find_range_limits(curve, s, np.zeros(1), widths, 0.05).at(motion)
        return np.asarray(rows.slack[0, :4] @ known)

    # Forces are affine in torques: what a gain takes away is in proportion to it.
    exact, off = measure({}), measure({"gain1": 0.02})
    assert (off < exact).all()
    assert exact - measure({"gain1": 0.01}) == pytest.approx((exact - off) / 2, abs=1e-12)
    both = exact - measure({"gain1": 0.02, "base1_x": 2e-4})
    assert both == pytest.approx(2 * exact - off - measure({"base1_x": 2e-4}), abs=1e-9)
