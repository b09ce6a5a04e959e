from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from plane import make_formation, make_scene
from planned import brake_less, change, plan, plan_landing
from rows import each
from scenes import PALM, box, measure_fingers, scale, slid, tipped
from shipped import BOX, HEPTAGON, part_of, plan_of, problem_of, verified
from wholearm import Formation, Friction, PlanOptions, Problem, Report, Scene, simulate
from wholearm.benchmark.stress import check_plan as check_again
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError, JammingError, ReplayError
from wholearm.geometry.tracing import trace_phases
from wholearm.planning import replay_check
from wholearm.planning import replay_check as self_check
from wholearm.planning.blocks import plan_blocks
from wholearm.planning.plan import solve
from wholearm.results.torque import TorqueProfile
from wholearm.results.trajectory import Motion, Samples, Trajectory
from wholearm.verification.newton_euler import CONE_TOLERANCE, Balance, balance
from wholearm.verification.verify import DEFICIT, Allowance, list_normal_forces, max_deficit, verify

CONTACTS = "v0-palm v1-finger1 v3-finger2 e2-tip1 v2-tip2"


def scene_of() -> Scene:
    scene = make_scene()
    right, left = (replace(link, viscous=0.02, dry=0.03) for link in scene.fingers)
    return replace(scene, fingers=(right, left), friction=Friction(0.3, 0.24, 0.18))


def check(formation: Formation, samples: Samples) -> Balance:
    return balance(formation.scene, formation.contacts, formation.rolling, samples)


def units(scene: Scene) -> Array:
    return np.array([scene.scales.force] * 2 + [scene.scales.torque] * 3)


def test_virtual_power() -> None:
    """Contacts do the power of c_n on gaps that open and of c_t on what slides, for any motion."""
    # States and forces obey no equation, but friction opposes the sliding.
    scene, rng, count = scene_of(), np.random.default_rng(5), 30
    formation = make_formation(scene, CONTACTS)
    z = rng.uniform(-1, 1, (count, 5)) * [0.05, 0.05, 1.0, 0.5, 0.5] + [0, 0.05, 0, 1.2, 1.9]
    v, a = rng.uniform(-1, 1, (count, 5)), rng.uniform(-5, 5, (count, 5))
    c_n = rng.uniform(0.1, 3.0, (count, formation.n_contacts))
    rows, tau = formation.evaluate(z, v), rng.uniform(-1, 1, (count, 2))
    v_t = np.einsum("nij,nj->ni", rows.A_t, v)
    c_t = -formation.friction * np.sign(v_t) * c_n
    found = check(formation, Samples(z, v, a, tau, c_n, c_t))
    np.testing.assert_allclose(found.gaps * scene.scales.length, rows.C, atol=1e-14)
    rates = np.einsum("nij,nj->ni", rows.A, v)
    np.testing.assert_allclose(found.rates * scene.scales.speed, rates, atol=1e-13)
    w = np.random.default_rng(6).uniform(-1, 1, z.shape)
    power = -(scene.mass_diagonal * a * w).sum(axis=1) + w @ scene.applied_force
    power += ((tau - scene.viscous[3:] * v[:, 3:]) * w[:, 3:]).sum(axis=1)
    power -= (scene.dry[3:] * np.sign(v[:, 3:]) * w[:, 3:]).sum(axis=1)
    power += (c_n * np.einsum("nij,nj->ni", rows.A, w)).sum(axis=1)
    power += (c_t * np.einsum("nij,nj->ni", rows.A_t, w)).sum(axis=1)
    expected = (found.forces * units(scene) * w).sum(axis=1)
    np.testing.assert_allclose(expected, power, rtol=1e-11, atol=1e-12)
    assert not found.wrong_sign.any()


def phases_of(problem: Problem, trajectory: Trajectory) -> list[tuple[Formation, Samples]]:
    places = np.linspace(0.0, 1.0, 301)[1:-1]
    pairs = zip(problem.phases, trajectory.motions, strict=True)
    return [(phase.formation, own.evaluate(own.duration * places)) for phase, own in pairs]


@pytest.mark.parametrize("case", [plan, plan_landing, lambda: (box(), tipped())])
def test_motions_with_their_forces_balance(case: object) -> None:
    """By inverse dynamics along curves and with three contacts, and a plan with a rolling one."""
    assert callable(case)
    for formation, samples in phases_of(*case()):
        found = check(formation, samples)
        assert not found.wrong_sign.any()
        size, _, text = found.find_worst()
        # Configurations of the landing are closed to 1e-12.
        assert size < 1e-9, text


def test_friction_the_wrong_way_is_named() -> None:
    formation, samples = phases_of(*plan())[1]
    column = formation.names.index("v3-finger1")
    c_t = samples.c_t.copy()
    c_t[100:110, column] *= -1
    found = check(formation, samples._replace(c_t=c_t))
    assert found.wrong_sign[100:110, column].all() and found.wrong_sign.sum() == 10
    # Friction is taken from the velocities, so that what balances is still the motion itself.
    assert found.find_worst()[0] < 1e-9


def test_at_rest_friction_may_be_anything_in_its_cone() -> None:
    """An object that lies on the palm between two fingers that press it sideways."""
    scene = scene_of()
    formation = make_formation(scene, "v0-palm v1-palm")
    rest = np.zeros((3, 5))
    z = np.tile([0.0, 0.03, 0.0, 0.5, 2.6], (3, 1))
    weight = scene.polygon.mass * scene.gravity
    c_n = np.full((3, 2), weight / 2)
    push = np.array([0.0, 0.9, 1.1]) * 0.3 * weight / 2
    # One vertex is pushed one way and the other one the other way, as far as the cone and farther.
    c_t = np.column_stack([push, -push])
    tau = np.array([[0.03, -0.03], [-0.02, 0.0], [0.04, 0.0]])
    found = check(formation, Samples(z, rest, rest, tau, c_n, c_t))
    left = found.forces * units(scene)
    np.testing.assert_allclose(left[:2], 0.0, atol=1e-13)
    # Beyond the dry friction of joint 1, which is 0.03 N m.
    np.testing.assert_allclose(left[2], [0, 0, 0, 0.01, 0], atol=1e-13)
    uneven = np.column_stack([push, 0 * push])
    forces = check(formation, Samples(z, rest, rest, 0 * tau, c_n, uneven)).forces
    # As far beyond as plans may miss limits.
    cone = 0.3 * weight / 2 + CONE_TOLERANCE * scene.scales.force
    np.testing.assert_allclose(forces[:, 0] * scene.scales.force, np.minimum(push, cone))


def test_rolling_contacts_that_slip_are_named() -> None:
    formation, samples = phases_of(box(), tipped())[1]
    assert formation.rolling
    v = samples.z_dot.copy()
    v[50, 0] += 0.01 * formation.scene.scales.speed
    found = check(formation, samples._replace(z_dot=v))
    column = formation.names.index("v1-palm")
    assert abs(found.rates[50, column]) == pytest.approx(0.01, rel=1e-6)
    assert np.abs(np.delete(found.rates, 50, axis=0)).max() < 1e-9


def alter(motion: Motion, field: str, change: Array | float) -> Any:
    """A motion with one of its fields altered."""

    def evaluate(t: Array) -> Samples:
        rows = motion.evaluate(t)
        return rows._replace(**{field: getattr(rows, field) + change})

    return SimpleNamespace(duration=motion.duration, contacts=motion.contacts, evaluate=evaluate)


@pytest.mark.parametrize(
    ("field", "change", "words"),
    [
        ("tau", np.array([0.01, 0.0]), "equation of motion of finger 1 misses"),
        ("c_n", np.array([0.01, 0.0, 0.0, 0.0]), "equation of motion of the object along y misses"),
        ("c_t", np.array([0.0, 0.0, 1e-3, 0.0]), "v6-finger2 is not Coulomb's for its sliding"),
        ("c_t", np.array([0.0, 0.0, 10.0, 0.0]), "v6-finger2 is not Coulomb's for its sliding"),
        ("z", np.array([0.0, -1e-5, 0.0, 0.0, 0.0]), "object and palm overlap"),
        ("z", np.array([0.0, 1e-5, 0.0, 0.0, 0.0]), "equation of motion of finger 1 misses"),
        ("z_dot", np.array([0.01, 0.0, 0.0, 0.0, 0.0]), "z and its rate differ"),
        ("z_ddot", np.array([1.0, 0.0, 0.0, 0.0, 0.0]), "z' and its rate differ"),
        ("c_n", -0.2, "short of epsilon"),
        ("tau", 5.0, "exceeds its limit"),
    ],
)
def test_what_is_altered_is_named(
    heptagon: Problem, trajectory: Trajectory, field: str, change: Array | float, words: str
) -> None:
    motions = list(trajectory.motions)
    motions[3] = alter(motions[3], field, change)
    found = check_again(heptagon, replace(trajectory, motions=tuple(motions)))
    assert any(words in text and "phase 4" in text for text in found), found


def test_other_torques_and_ends_than_the_motion_s_are_named(
    heptagon: Problem, trajectory: Trajectory
) -> None:
    assert check_again(heptagon, trajectory) == []
    own = trajectory.torque
    other = TorqueProfile(own.breaks, own.coefficients * 1.01)
    found = check_again(heptagon, replace(trajectory, torque=other))
    assert any("torque profile" in text for text in found)
    elsewhere = heptagon.with_({"phases[5].until": {"phi_deg": -50.0 + math.degrees(1e-3)}})
    assert any("ends 0.001 from phi" in text for text in check_again(elsewhere, trajectory))


@cache
def replayed() -> Report:
    """The replay of a motion by inverse dynamics."""
    return verify(*plan())


def test_a_good_plan_passes() -> None:
    report = replayed()
    assert report.ok and report.reached and report.exit_status == 0
    assert report.failures == report.warnings == ()
    assert report.missed_by == 0.0 and len(report.phases) == 5
    for phase in report.phases:
        assert phase.arrival is not None and phase.arrival_rate is not None
        assert phase.arrival == pytest.approx(0.4 * phase.number, abs=1e-5)
        assert abs(phase.arrival_rate) < 1e-4
        for deviation in (phase.end_deviation, phase.deviation):
            assert deviation is not None
            # The interpolated torques are good to about 1e-11.
            assert deviation.position < 1e-9 and deviation.angle < 1e-9
    assert report.energy.relative < 1e-9


def test_least_forces_are_those_of_inverse_dynamics() -> None:
    (problem, trajectory), report = plan(), replayed()
    for phase, motion in zip(report.phases, trajectory.motions, strict=True):
        turns = motion.turns  # type: ignore[attr-defined]
        t = np.concatenate([np.linspace(a, b - 1e-12, 4001) for a, b in pairwise(turns)])
        c_n = motion.evaluate(t).c_n
        for margin in phase.contacts:
            column = motion.contacts.index(margin.contact)
            # 4001 samples miss a minimum by less than 1e-7 N, the parabola by less than 1e-6 N.
            assert margin.least == pytest.approx(c_n[:, column].min(), abs=2e-6)
            assert margin.margin == pytest.approx(margin.least - problem.epsilon)


def test_a_thin_margin_fails_a_plan_but_not_torques() -> None:
    """The verdict and its reason come first in a report."""
    problem, trajectory = plan()
    strict, good = replace(problem, epsilon=0.25), replayed()
    thin = verify(strict, trajectory)
    assert thin.exit_status == 1 and thin.reached
    (text,) = thin.failures
    margin = thin.phases[0].contacts[3]
    assert text == (
        f"c_n of v5-finger2 falls to {margin.least:.5g} N, below epsilon = 0.25 N, "
        f"at t = {margin.time:.5g} s, phase 1"
    )
    for report, verdict in (good, "ok"), (thin, "FAILED"):
        lines = report.to_text().splitlines()
        assert lines[0] == f"{problem.name}: {verdict}: {report.reason}"
        assert report.to_dict()["reason"] == report.reason
    assert good.reason == good.outcome and thin.reason == text != thin.outcome
    assert f"end of the replay: {thin.outcome}" in thin.to_text()
    assert good.to_text().count(good.outcome) == thin.to_text().count(thin.outcome) == 1
    relaxed = verify(strict, trajectory.torque)
    assert relaxed.ok and relaxed.warnings == thin.failures
    assert relaxed.phases[0].deviation is None


def test_an_end_at_rest_reached_at_speed_fails() -> None:
    """Constant torques that drive the first phase through its end."""
    problem, _ = plan()
    one = replace(problem, phases=problem.phases[:1])
    push = TorqueProfile(np.array([0.0, 5.0]), np.array([[[0.3], [0.0]]]))
    simulation = simulate(one, push)
    speed = float(np.hypot(*simulation.z_dot[-1, :2]))
    left = float(0.5 * simulation.z_dot[-1] ** 2 @ one.scene.mass_diagonal)
    report = verify(one, push)
    assert report.exit_status == 1 and report.reached
    assert report.failures == (report.reason,)
    rate = report.phases[0].arrival_rate
    assert rate == pytest.approx(0.27, abs=0.005) and left == pytest.approx(0.125, abs=0.001)
    assert report.reason == (
        f"phase 1 does not end at rest: v3-finger1 is reached at {rate:.3g} m/s at t = "
        f"{simulation.t[-1]:.5g} s, while the object moves at {speed:.3g} m/s, "
        f"with {left:.3g} J left"
    )
    assert report.phases[0].end_speed == pytest.approx(speed)
    scale = one.scene.scales.speed
    assert verify(one, push, rest_speed=1.01 * speed / scale).ok
    assert not verify(one, push, rest_speed=0.99 * speed / scale).ok


def test_a_replay_far_from_its_plan_fails() -> None:
    """The plan of another motion: the torques carry the object, but elsewhere."""
    problem, trajectory = plan()
    elsewhere = trajectory.z.copy()
    shift = np.where(trajectory.phase == 2, 4e-4 * np.sin(trajectory.t), 0.0)
    elsewhere[:, 0] += shift
    report = verify(problem, replace(trajectory, z=elsewhere))
    (text,) = report.failures
    worst = float(np.abs(shift).max())
    time = float(trajectory.t[np.abs(shift).argmax()])
    length = problem.scene.scales.length
    assert text.startswith(f"phase 3 departs from the plan, by {worst:.2g} m and ")
    assert f" at t = {time:.5g} s; {1e-3 * length:.2g} m and 0.001 rad are allowed" in text
    assert verify(problem, replace(trajectory, z=elsewhere), departure=0.02).ok


@each("key", ["departure", "rest_speed"])
@each("value", [0.0, -1.0, math.nan, math.inf])
def test_tolerances_are_positive(key: str, value: float) -> None:
    problem, trajectory = plan()
    with pytest.raises(InputError) as caught:
        verify(problem, trajectory, **cast(Any, {key: value}))
    assert caught.value.key == key


def test_epsilon_on_the_edge_is_kept() -> None:
    problem, trajectory = plan()
    least = min(c.least for p in replayed().phases for c in p.contacts)
    touching = replace(problem, epsilon=1.0015 * least)
    assert verify(touching, trajectory).ok
    # Beyond rounding and the 0.2 % that an open-loop replay may stray.
    over = replace(problem, epsilon=1.0025 * least)
    assert not verify(over, trajectory).ok


def test_a_lost_contact_fails() -> None:
    problem, trajectory = plan()
    report = verify(problem, change(trajectory.torque, brake_less))
    assert report.exit_status == 1 and not report.reached
    # Phase 1 is reached at a speed, too, but what ends the replay comes first.
    assert report.failures[0] == report.outcome
    assert report.outcome.startswith("c_n of ") and report.outcome.endswith("phase 2")
    worst = min(report.phases[-1].contacts, key=lambda c: c.least if c.least < math.inf else 1.0)
    assert worst.contact in report.outcome and worst.least < 0
    assert f"failure: {report.outcome}" not in report.to_text()
    assert report.to_text().splitlines()[0] == f"{problem.name}: FAILED: {report.outcome}"
    assert report.reason == report.to_dict()["reason"] == report.outcome


def test_a_missed_goal_fails() -> None:
    problem, trajectory = plan()
    torque = trajectory.torque
    keep = int(np.searchsorted(torque.breaks, 1.9))
    report = verify(problem, TorqueProfile(torque.breaks[: keep + 1], torque.coefficients[:keep]))
    assert not report.ok and not report.reached
    assert "short of phi = -50 deg" in report.failures[0]
    last = trajectory.motions[4].evaluate(np.array([torque.breaks[keep] - 1.6]))
    assert report.missed_by == pytest.approx(abs(last.z[0, 2] - math.radians(-50)), abs=1e-9)
    assert report.phases[-1].arrival is None


def test_torques_for_nothing() -> None:
    problem, _ = plan()
    report = verify(problem, TorqueProfile(np.array([0.0, 0.1]), np.zeros((1, 2, 1))))
    assert not report.ok
    assert all(math.isnan(c.least) for c in report.phases[0].contacts)
    assert report.energy.work == report.energy.relative == 0.0
    values = report.to_dict()
    assert values["phases"][0]["contacts"][0]["least"] is None
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert "-" in report.to_text()


def test_torques_and_speeds_beyond_their_limits_are_warnings_or_failures_of_a_plan() -> None:
    problem, trajectory = plan()
    report = verify(weak := problem.with_(torque_limit=1.0), trajectory.torque)
    assert report.ok and any("above its limit 1 N m" in text for text in report.warnings)
    assert any("above its limit 1 N m" in text for text in verify(weak, trajectory).failures)
    rates = np.abs(trajectory.theta_dot[:, 0])
    limit = float(f"{0.9 * rates.max():.4g}")
    report = verify(slow := problem.with_(speed_limit1=limit), trajectory.torque)
    assert report.ok and not verify(slow, trajectory).ok
    (text,) = (text for text in report.warnings if text.startswith("speed limit of finger 1 = "))
    over, when = re.findall(r"exceeded by (\S+) rad/s at t = (\S+) s, phase \d$", text)[0]
    assert float(over) == pytest.approx(rates.max() - limit, rel=5e-3)
    assert float(when) == pytest.approx(trajectory.t[rates.argmax()], abs=0.01)
    assert not verify(problem.with_(speed_limit1=1.2 * limit), trajectory.torque).warnings


def test_another_problem_is_refused() -> None:
    problem, trajectory = plan()
    shorter = replace(problem, phases=problem.phases[:2])
    with pytest.raises(InputError, match="v6-finger2"):
        verify(shorter, trajectory)


def test_margins_to_slipping_are_those_of_inverse_dynamics() -> None:
    report = verified(BOX)
    assert report.ok and [len(phase.rolling) for phase in report.phases] == [0, 1, 0]
    (margin,) = report.phases[1].rolling
    motion = tipped().motions[1]
    t = np.linspace(0, motion.duration, 20001)
    samples = motion.evaluate(t)
    expected = PALM * samples.c_n[:, 0] - np.abs(samples.c_t[:, 0])
    assert margin.contact == "v1-palm"
    assert margin.least == pytest.approx(expected.min(), abs=1e-5)
    near = np.abs(t + report.phases[1].start - margin.time).argmin()
    assert expected[near] == pytest.approx(margin.least, abs=1e-4)
    text = report.to_text()
    assert "rolling  least mu c_n - |c_t| [N]" in text and "2  v1-palm" in text
    plain = json.loads(json.dumps(report.to_dict()))
    assert plain["phases"][1]["rolling"] == [
        {"contact": "v1-palm", "least": margin.least, "time": margin.time}
    ]
    assert "rolling" not in replayed().to_text()


@pytest.mark.parametrize("later", [0.0, 0.5])
def test_a_slip_fails(later: float) -> None:
    """A finger that pushes harder than planned, from rest or while the box tips."""
    starts = tipped().phase_starts
    start = starts[1] + later * (starts[2] - starts[1])
    report = verify(box(), scale(0, 0.9 if later else 0.95, start, starts[2]))
    assert report.exit_status == 1 and not report.reached and len(report.phases) == 2
    (text,) = report.failures
    (margin,) = report.phases[1].rolling
    assert text.startswith("v1-palm slips: |c_t| = ") and " mu c_n = " in text
    assert text.endswith(f"at t = {margin.time:.5g} s, phase 2")
    assert margin.least < 1e-9 and start - 1e-5 <= margin.time < starts[2]


def test_the_least_gap_of_the_fingers_is_reported() -> None:
    problem, plan_ = slid().problem, slid().trajectory
    report = verify(problem, plan_)
    assert report.ok and report.finger_gap is not None
    motions = zip(plan_.motions, plan_.phase_starts, strict=False)
    instants = [(start + np.linspace(0, m.duration, 4001), m) for m, start in motions]
    z = np.concatenate([m.evaluate(t - t[0]).z for t, m in instants])
    gaps = measure_fingers(problem.scene, z)
    assert report.finger_gap.least == pytest.approx(gaps.min(), abs=1e-7) and gaps.min() > 1e-3
    when = np.concatenate([t for t, _ in instants])[gaps.argmin()]
    assert report.finger_gap.time == pytest.approx(when, abs=1e-3)
    assert f"least gap of the fingers: {gaps.min():.4f}" in report.to_text()
    values = json.loads(json.dumps(report.to_dict()))["finger_gap"]
    assert values == {"least": report.finger_gap.least, "time": report.finger_gap.time}


def test_the_scalar_equation_holds_along_a_replay() -> None:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    report = verify(problem, plan, reduced=True)
    assert {row.phase for row in report.reduced} == {1, 2, 3, 4, 5}
    for row in report.reduced:
        # Rounding: accelerations come from matrices of condition 1e4.
        assert abs(row.residual) < 1e-9 * (abs(row.Phi_1 * row.theta_1_ddot) + abs(row.Phi_3))
        assert plan.phase_starts[row.phase - 1] <= row.time <= plan.phase_starts[row.phase] + 1e-6
    text = report.to_text()
    assert "Phi_1 [kg m^2]" in text and len(report.to_dict()["reduced"]) == len(report.reduced)


def test_a_phase_with_a_rolling_contact_may_have_four_constraints() -> None:
    problem = problem_of(BOX)
    report = verify(problem, plan_of(BOX), reduced=True)
    four = {p.number for p in problem.phases if p.formation.n_constraints == 4}
    assert {row.phase for row in report.reduced} == four
    for row in report.reduced:
        assert row.residual == pytest.approx(0.0, abs=1e-9 * abs(row.Phi_3))


def test_a_contact_let_go_softly_counts_until_it_passes_epsilon() -> None:
    problem, trajectory = plan_landing()
    simulation, low = simulate(problem, trajectory), problem.epsilon / 2
    rows, column = np.flatnonzero(simulation.phase == 0), simulation.contacts.index("v3-finger1")
    c_n = simulation.c_n.copy()
    c_n[rows, column] = 2 * problem.epsilon
    c_n[rows[[3, -2, -1]], column] = low, low, 0.0
    given = replace(simulation, c_n=c_n)
    forces = list_normal_forces(given, problem.phases[0])["v3-finger1"]
    assert np.isnan(forces[-2:]).all() and np.nanmin(forces) == forces[3] == low


def wiggle(torque: TorqueProfile, piece: int, size: float) -> TorqueProfile:
    """Torques with a wiggle in one piece that vanishes at both of its ends and in its middle."""
    coefficients = np.pad(torque.coefficients, ((0, 0), (0, 0), (0, 3)))
    coefficients[piece, 0, [1, 3]] += size * np.array([1.0, -1.0])
    return replace(torque, coefficients=coefficients)


@pytest.mark.parametrize(("piece", "size"), [(11, 0.08), (67, -0.08)])
def test_a_dip_between_instants_is_found(piece: int, size: float) -> None:
    """The lowest dip of all, by a thousandth of epsilon lower than allowed, and then higher."""
    problem, trajectory = plan()
    torque = wiggle(trajectory.torque, piece, size)
    start, stop = torque.breaks[piece : piece + 2]
    fine = simulate(problem, torque, times=np.linspace(start, stop, 400))
    least = np.nanmin(fine.c_n)
    lowest = int(np.where(np.isnan(fine.c_n), np.inf, fine.c_n).min(axis=1).argmin())
    assert least > 0.0 and start < fine.t[lowest] < stop
    rounding = max_deficit(problem) - DEFICIT * problem.epsilon
    for more, fails in (1e-3, True), (-1e-3, False):
        epsilon = (least + rounding) / (1 - DEFICIT - more)
        texts = verify(problem.with_(epsilon=epsilon), torque).warnings
        assert any(" falls to " in text for text in texts) is fails


def test_a_table_holds_like_its_plan() -> None:
    problem, trajectory = plan()
    table = replay_check.make_table(problem, trajectory)
    report = verify(problem, TorqueProfile.join_rows(table.rows))
    assert report.ok and report.warnings == ()
    figures = table.figures
    assert figures["rows"] == len(table.rows) and figures["replay"]["ok"]
    for row, phase in zip(figures["replay"]["phases"], report.phases, strict=True):
        assert row["planned_arrival"] == pytest.approx(0.4 * phase.number)
        assert row["arrival"] == pytest.approx(row["planned_arrival"], abs=1e-5)
        least = min(margin.least for margin in phase.contacts)
        assert row["least_c_n"] == pytest.approx(least, abs=1e-3)
        assert row["planned_least_c_n"] == pytest.approx(least, abs=1e-3)


def test_a_table_that_loses_a_contact_is_an_error() -> None:
    problem, trajectory = plan()
    weak = replace(trajectory, torque=change(trajectory.torque, brake_less))
    with pytest.raises(ReplayError, match=r"do not hold in their replay: c_n of .* phase 2"):
        replay_check.make_table(problem, weak)
    assert replay_check.make_table(problem, weak, replay=False).figures["replay"] is None


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_samples_at_a_rate_are_reported(interpolation: str) -> None:
    """The closer the samples, the nearer arrivals and forces are to those of the plan."""
    problem, trajectory = plan()
    fine = replay_check.make_table(problem, trajectory, True, 8000.0, interpolation).figures
    coarse = replay_check.make_table(problem, trajectory, True, 60.0, interpolation).figures
    assert (fine["sample_rate"], fine["interpolation"]) == (8000.0, interpolation)
    assert not coarse["replay"]["ok"] and " phase " in coarse["replay"]["reason"]

    def find_errors(figures: dict[str, Any]) -> Array:
        first = figures["replay"]["phases"][0]
        arrival = np.inf if first["arrival"] is None else first["arrival"]
        off = arrival - first["planned_arrival"], first["least_c_n"] - first["planned_least_c_n"]
        return np.abs(off)

    # What is d off at its end arrives sqrt(2 d / a) early: half a period of delay takes 4 ms.
    assert (find_errors(fine) < [0.02, 0.02]).all()
    assert find_errors(coarse).sum() > 2 * find_errors(fine).sum()
    unplayed = replay_check.make_table(problem, trajectory, False, 60.0, interpolation)
    assert unplayed.figures["replay"] is None


def test_a_plan_that_holds_and_torques_that_do_not_carry_the_motion() -> None:
    problem, trajectory = plan()
    check = replay_check.check_plan(problem, trajectory, Allowance())
    harsh = replay_check.check_plan(problem, trajectory, Allowance(departure=1e-15))
    assert harsh.failure is not None and " departs from the plan, by " in harsh.failure[1]
    assert check.failure is None and check.residual.size < 1e-9
    assert isinstance(check.report, Report)
    # Every piece is a step, and few end elsewhere.
    assert check.report.steps < 2 * len(trajectory.torque.coefficients) + 150
    weak = replace(trajectory, torque=change(trajectory.torque, brake_less))
    check = replay_check.check_plan(problem, weak, Allowance())
    assert check.failure is not None and check.failure == (2, verify(problem, weak).reason)
    # The first phase departs by the braking that it lacks.
    assert check.find_culprit(problem.scene.scales, Allowance(departure=1e-5), trajectory) == 1


def test_friction_the_wrong_way_is_found_by_the_residual() -> None:
    problem, trajectory = plan()
    tau, rows = trajectory.tau.copy(), np.flatnonzero(trajectory.phase == 2)[90:100]
    dry = problem.scene.dry[4]
    tau[rows, 1] -= 2 * dry * np.sign(trajectory.theta_dot[rows, 1])
    found = replay_check.find_residual(problem, wrong := replace(trajectory, tau=tau))
    size = 2 * dry / problem.scene.scales.torque
    assert found.phase == 3 and found.size == pytest.approx(size, rel=1e-6)
    assert "finger 2" in found.text and "as joint 2 moves against the sense" in found.text
    assert any(found.text.endswith(f" {t:.5g} s, phase 3") for t in trajectory.t[rows])
    check = replay_check.check_plan(problem, wrong, Allowance())
    assert check.failure == (3, found.text)


def test_a_contact_that_falls_a_little_short_is_pressed_more() -> None:
    """The plan is one for a smaller epsilon."""
    short, options = 1e-3, PlanOptions(intervals=20)
    slide = part_of(problem_of(HEPTAGON), 0, 1)
    easy = replace(slide, epsilon=slide.epsilon - short)
    planning = plan_blocks(easy, trace_phases(easy), options, lambda _: None)
    held, figures = replay_check.replay_plan(replace(planning, problem=slide), lambda _: None)
    assert figures.least_c_n.value > slide.epsilon
    assert (rise := held.extra_epsilon) == {0: pytest.approx(self_check.INCREASE * short, rel=0.05)}
    loss = 1 - planning.plans[0].value / held.plans[0].value
    assert 1e-3 < loss < held.plans[0].error < 2.5 * loss
    assert np.nanmin(held.trajectory.c_n) == pytest.approx(slide.epsilon + rise[0], abs=1e-5)


def test_a_plan_that_jams_in_its_replay_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    error = JammingError("v1-palm jams in phase 2 at t = 0.1 s")
    error.phase, check_plan = 2, replay_check.check_plan
    monkeypatch.setattr(self_check, "check_plan", lambda *a: check_plan(*a)._replace(report=error))
    with pytest.raises(ReplayError) as caught:
        solve(part_of(problem_of(HEPTAGON), 0, 2), intervals=10)
    text = str(caught.value)
    assert text.startswith("the plan of phase 2 does not hold in its replay: v1-palm jams in phase")
    assert " at t = 0.1 s; it is planned to end at t = 0.2" in text and "--no-replay" in text


def test_meta_keeps_the_figures(heptagon: Problem, trajectory: Trajectory) -> None:
    figures = trajectory.meta["replay"]
    report = verified(HEPTAGON)
    margins = [(c.least, c.contact, p.number) for p in report.phases for c in p.contacts]
    # Parabolas through other instants dip a little differently.
    assert figures["least_c_n"]["value"] == pytest.approx(min(margins)[0], abs=1e-5)
    assert (figures["least_c_n"]["contact"], figures["least_c_n"]["phase"]) in [
        margin[1:] for margin in margins if margin[0] < min(margins)[0] + 1e-6
    ]
    for own, phase in zip(figures["phases"], report.phases, strict=True):
        assert own["arrival"] == pytest.approx(phase.arrival, abs=1e-9)
        for key in ("end_deviation", "deviation"):
            assert max(own[key]["m"], own[key]["rad"]) < Allowance().departure
        assert own["end_speed"] < Allowance().rest_speed * heptagon.scene.scales.speed
    assert figures["residual"] < replay_check.RESIDUAL


def test_a_contact_that_is_let_go_counts_until_then() -> None:
    """In an instant after the torques step, the formation given up would have it pull."""
    problem, trajectory = plan_landing()
    phase = verify(problem, trajectory).phases[0]
    assert phase.until == "release of v3-finger1"
    margins = {margin.contact: margin for margin in phase.contacts}
    assert margins["v3-finger1"].least > problem.epsilon - max_deficit(problem)
    contact, least, time, _ = min(phase.contacts, key=lambda margin: margin.least)
    assert phase.least_force == (least, contact, 1, time)
    assert phase._replace(contacts=()).least_force is None
