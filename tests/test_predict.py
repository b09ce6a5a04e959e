"""What torques do before they are planned, tuned and compared."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

import wholearm
from planned import change, plan
from rows import each
from scenes import box, constant, tipped
from shipped import BOX, FOLDER, HEPTAGON, HEXAGON, LANDING, box_text, problem_of, text_of
from wholearm import InputError, Problem, Trajectory, compare, load_trajectory, simulate, verify
from wholearm.analysis import slow_speeds
from wholearm.analysis.tuning import RATIO, TrialOutcome, split_passages
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.figures import plots
from wholearm.figures.result_figures import draw_comparison, draw_prediction
from wholearm.mechanics.dynamics import force_rows
from wholearm.mechanics.limits import force_limit_rows
from wholearm.problem.read import build_problem, name_keys
from wholearm.problem.table import change_table
from wholearm.results.adopt import describe_origin, save
from wholearm.results.report import Loss, Report
from wholearm.results.torque import TorqueProfile, read_notes, read_torque_csv
from wholearm.simulation.events import EventKind, Simulation
from wholearm.verification.verify import find_approach


@cache
def first_phase() -> Problem:
    problem = problem_of(HEPTAGON)
    return dataclasses.replace(problem, phases=problem.phases[:1])


@cache
def predicted() -> slow_speeds.Prediction:
    return slow_speeds.predict(first_phase())


@cache
def road_of(path: Path, index: int = 0) -> slow_speeds.PathSamples:
    problem = problem_of(path)
    z, roads = problem.start, list[slow_speeds.PathSamples]()
    for phase in problem.phases[: index + 1]:
        road = slow_speeds.sample_path(phase, z, problem.phases[phase.index + 1 :])
        assert road is not None
        roads.append(road)
        z = road.point.z[-1]
    return roads[-1]


def find_least_by_lp(road: slow_speeds.PathSamples, row: int, a: float, b: float) -> float:
    """The largest epsilon at one place, by a linear programme in forces and torques."""
    formation, scene = road.phase.formation, road.phase.formation.scene
    G = force_rows(formation, road.point.kinematics, road.directions)[row]
    v, n = math.sqrt(b) * road.point.z_s[row], len(G)
    inertia = scene.mass_diagonal * (road.point.z_s[row] * a + road.point.z_ss[row] * b)
    load = inertia + scene.viscous * v - scene.applied_force
    load[3:] += scene.dry[3:] * road.directions.sigma[row]
    H = force_limit_rows(formation)
    weight = H[:, : formation.n_contacts].sum(axis=1)
    answer = linprog(
        [0.0] * (n + 2) + [-1.0],
        A_ub=np.hstack([-H, np.zeros((len(H), 2)), weight[:, None]]),
        b_ub=np.zeros(len(H)),
        A_eq=np.hstack([G.T, np.eye(5)[:, 3:], np.zeros((5, 1))]),
        b_eq=load,
        bounds=[(None, None)] * n + [(-most, most) for most in scene.torque_limit] + [(None, None)],
    )
    return -answer.fun if answer.status == 0 else -math.inf


@pytest.mark.parametrize(("path", "index"), [(HEPTAGON, 0), (BOX, 1)])
def test_the_best_squeeze_is_that_of_a_linear_programme(path: Path, index: int) -> None:
    road, random = road_of(path, index), np.random.default_rng(7)
    a, b = random.normal(0.0, 3.0, len(road.s)), random.uniform(0.0, 0.3, len(road.s))
    a[::3] = b[::3] = 0.0
    grasp = road.force_limits.find_best(a, b)
    rows = np.linspace(1, len(road.s) - 2, 12).astype(int)
    expected = [find_least_by_lp(road, k, a[k], b[k]) for k in rows.tolist()]
    assert grasp.least[rows] == pytest.approx(expected, rel=1e-6, abs=1e-7)
    known, force = np.isfinite(grasp.least), grasp.internal_force
    within = np.clip(force, *road.force_limits.find_span(a, b, grasp.least - 1e-3))
    np.testing.assert_allclose(within[known], force[known], rtol=1e-12)
    low, high = road.force_limits.find_span(a, b, grasp.least + 1e-3)
    assert (low > high)[known].all()


def test_forces_under_torques_are_those_of_inverse_dynamics() -> None:
    for road in (road_of(HEPTAGON), road_of(BOX, 1)):
        a, squeeze = np.sin(road.s), np.cos(road.s)
        b = np.full(len(road.s), 0.04)
        c = road.find_forces(road.forces.tau(a, b, squeeze), 0.2)
        assert c == pytest.approx(road.forces.c(a, b, squeeze), abs=1e-9)


def test_quasistatic_torques_balance_and_are_the_least() -> None:
    road, still = road_of(HEPTAGON), np.zeros(len(road_of(HEPTAGON).s))
    most = road.force_limits.find_best(still, still).least.min()
    for share in (0.0, 0.5, 1.0):
        torques = slow_speeds.find_torques(road, 0.05, share)
        assert torques is not None
        wanted = 0.05 + share * (most - 0.05)
        assert (torques.c_n.min(axis=1) >= wanted - 1e-9).all()
        assert torques.c_n == pytest.approx(road.find_forces(torques.tau, 0.0), abs=1e-9)
        low, high = road.force_limits.find_span(still, still, wanted)
        for part in (0.1, 0.9):
            other = road.forces.tau(still, still, low + part * (high - low))
            assert ((other**2).sum(axis=1) >= (torques.tau**2).sum(axis=1) - 1e-9).all()


def replay(speed: float) -> Simulation:
    """The first phase from rest to rest with the best squeeze."""
    road = road_of(HEPTAGON)
    x = road.s / road.length
    a, b = speed**2 * 2 * (1 - 2 * x) / road.length, speed**2 * 4 * x * (1 - x)
    tau = road.forces.tau(a, b, road.force_limits.find_best(a, b).internal_force)
    t = road.length / (2 * speed) * np.arccos(1 - 2 * x)
    return simulate(first_phase(), TorqueProfile.join_rows(np.column_stack([t, tau])))


def test_the_replay_holds_below_the_predicted_speed_and_not_above() -> None:
    (phase,) = predicted().phases
    own = phase.survivals[1]
    assert own.motion == "rest to rest" and own.speed is not None and own.lost is not None
    assert own.speed < own.lost
    assert own.duration == pytest.approx(np.pi / 2 * phase.length / own.speed)
    below = replay(0.98 * own.speed)
    assert not below.find(EventKind.CONTACT_LOST)
    assert phase.curves is not None
    expected = np.interp(0.98 * own.speed, phase.curves.speed, phase.curves.force[own.motion])
    assert np.nanmin(below.c_n) == pytest.approx(expected, abs=0.01)
    k = int(np.searchsorted(phase.curves.speed, own.speed))
    before, after = phase.curves.force[own.motion][k - 1 : k + 1]
    assert before >= 0.05 > after and np.ptp(phase.curves.speed[k - 1 : k + 1]) < 1e-6
    above = replay(1.02 * own.lost)
    (lost,) = above.find(EventKind.CONTACT_LOST)
    assert lost.contact in own.first.contacts


def test_the_straight_line_keeps_its_contacts_and_newtons_laws() -> None:
    table = {"contacts": ["v1-palm", "v2-finger1", "v5-finger2"], "until": {"phi_deg": -5.0}}
    problem = problem_of(HEPTAGON).with_({"phases": [table]})
    road = slow_speeds.sample_path(problem.phases[0], problem.start, ())
    assert road is not None and road.curve is None
    formation, scene = road.phase.formation, problem.scene
    assert np.abs(road.point.kinematics.C).max() < 1e-12
    x, phi = road.point.z[:, 0], road.point.z[:, 2]
    assert np.ptp((x - x[0]) * (phi[-1] - phi[0]) - (phi - phi[0]) * (x[-1] - x[0])) < 1e-12
    for function, slope in ((road.point.z, road.point.z_s), (road.point.z_s, road.point.z_ss)):
        quotient = (function[2:] - function[:-2]) / (road.s[2:] - road.s[:-2])[:, None]
        assert quotient[20:-20] == pytest.approx(slope[21:-21], rel=2e-2, abs=1e-2)
    a, b = np.full(len(x), 2.0), np.full(len(x), 0.3)
    c, tau = road.forces.c(a, b, 0 * a), road.forces.tau(a, b, 0 * a)
    G = force_rows(formation, road.point.kinematics, road.directions)
    inertia = scene.mass_diagonal * (road.point.z_s * a[:, None] + road.point.z_ss * b[:, None])
    rest = inertia + scene.viscous * road.point.z_s * math.sqrt(0.3) - scene.applied_force
    rest -= np.einsum("nij,ni->nj", G, c)
    rest[:, 3:] += scene.dry[3:] * road.directions.sigma - tau
    assert np.abs(rest).max() < 1e-10


def test_what_is_left_out_is_named() -> None:
    table = {"contacts": ["v1-palm", "v2-finger1"], "until": {"x": 0.04}}
    problem = problem_of(HEPTAGON).with_({"phases": [table]})
    text = slow_speeds.predict(problem).to_text()
    assert "left out" in text and "has neither one nor two freedoms" in text


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, table, figure = (tmp_path / name for name in ("one.toml", "slow.csv", "slow.svg"))
    file.write_text(text_of(), encoding="utf-8")
    arguments = ["predict", str(file), "-o", str(figure), "--torques", str(table), "--json"]
    assert main(arguments) == 0
    values = json.loads(capsys.readouterr().out)
    (phase,), (own,) = values["phases"], predicted().phases
    speed = phase["survivals"][1]["speed"]
    assert phase["is_kept"] and speed == pytest.approx(own.survivals[1].speed)
    assert "<svg" in figure.read_text(encoding="utf-8")
    assert slow_speeds.make_torques(predicted(), 0.05).duration == pytest.approx(own.length / 0.05)
    assert table.read_text(encoding="utf-8").startswith("t,tau1,tau2\n")
    printed = predicted().to_text()
    for survival in own.survivals:
        assert f"{survival.motion}" in printed and survival.first.name in printed
    assert slow_speeds.OWN_TORQUES in printed and "all along" in printed
    # Forces that are known from some speed on alone are drawn.
    late = slow_speeds.Curves(np.array([0.1, 0.2, 0.3]), {"steady": np.array([-np.inf, 5, 6])})
    phases = (dataclasses.replace(own, curves=late, survivals=own.survivals[:1]),)
    drawn = draw_prediction(dataclasses.replace(predicted(), phases=phases))
    assert drawn.axes[0].get_ylim() == pytest.approx((-1.75, 11.0))
    assert main(["predict", str(file), "--squeeze", "2"]) == 2
    assert main(["predict", str(file), "--speed", "1"]) == 2
    with pytest.raises(InputError, match="squeeze"):
        slow_speeds.predict(first_phase(), squeeze=math.nan)


def test_without_quasistatic_torques_the_table_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Torques too weak to hold the object; the file begins with a byte order mark.
    file, table = tmp_path / "weak.toml", tmp_path / "a.csv"
    file.write_text(re.sub("torque_limit = .*", "torque_limit = 0.02", text_of()), "utf-8-sig")
    assert main(["predict", str(file), "--torques", str(table)]) == 1
    out, err = capsys.readouterr()
    assert "keeps epsilon to" in out and "torque of finger 2 and finger 2" not in out
    assert err.startswith("wholearm: no quasistatic torques to write: phase 1")
    assert not table.exists()


@cache
def light_box() -> Problem:
    """The box of the README, with weaker fingers."""
    return build_problem(tomllib.loads(box_text())).with_(torque_limit=1.0)


@cache
def tune_box() -> wholearm.Tuning:
    return wholearm.tune(light_box(), brake=True)


def test_tuned_torques_hold_every_contact_end_at_rest_and_are_written(tmp_path: Path) -> None:
    found = tune_box()
    assert found.ok and found.exit_status == 0 and found.report is not None
    whole = found.report.whole
    assert np.nanmin(whole.c_n) > 0 and whole.z[-1, 0] == pytest.approx(-0.01, abs=1e-6)
    assert not whole.z_dot[-1].any()
    assert found.simulations > len(found.phases[0].trials)
    path = tmp_path / "tuned.csv"
    path.write_text(found.to_csv())
    torque = wholearm.read_torque_csv(str(path))
    assert found.torque is not None
    assert np.array_equal(torque.breaks, found.torque.breaks)
    assert np.array_equal(torque.coefficients, found.torque.coefficients)
    assert read_notes(str(path))["simulations"] == str(found.simulations)
    assert f"{found.simulations} simulations" in found.to_text()
    small = dataclasses.replace(found.phases[0], quasistatic=(1.23456e-4, -2e-5))
    assert "0.00012346 -0.00002000" in dataclasses.replace(found, phases=(small,)).to_text()
    assert found.to_dict()["phases"][0]["trials"][0]["outcome"] == "rests"


def test_torques_are_quasistatic_ones_in_steps_of_ten_percent() -> None:
    phase = tune_box().phases[0]
    assert phase.acting == 1, "the right finger pushes a slide to the left"
    for step in phase.steps[:2]:
        powers = np.log(np.array(step.tau) / phase.quasistatic) / np.log(RATIO)
        assert powers == pytest.approx(np.round(powers), abs=1e-9)
    assert phase.steps[0].tau[0] > phase.quasistatic[0] > phase.steps[1].tau[0]
    drives = [trial for trial in phase.trials if len(trial.steps) == 1]
    raised = [trial.steps[0].tau[0] for trial in drives]
    assert np.array(raised[1:]) == pytest.approx(RATIO * np.array(raised[:-1]))
    slides = [trial for trial in drives if trial.outcome is TrialOutcome.ARRIVES]
    times = [trial.time for trial in slides]
    assert times == sorted(times, reverse=True), "more torque brings it there sooner"
    assert drives[0].outcome is TrialOutcome.RESTS, "quasistatic torques set nothing in motion"


def test_constant_torques_do_not_come_to_rest() -> None:
    found = wholearm.tune(light_box())
    assert not found.ok and found.exit_status == 1 and found.torque is None
    assert found.reason.startswith("phase 1: x = -0.01 m is reached at ")
    with pytest.raises(wholearm.WholearmError, match="no torques"):
        found.to_csv()


@each(
    "given, wrong",
    [
        ({"stops": 8, "brake": True}, "stops: 8 given; allowed are whole numbers from 0 to 7"),
        ({"stops": 1.5, "brake": True}, "from 0 to 7"),
        ({"stops": 1}, "without a brake"),
        ({"share": 2.0}, "share: 2.0 given; allowed are 0 to 1"),
    ],
)
def test_options_out_of_range_are_refused(given: dict[str, Any], wrong: str) -> None:
    with pytest.raises(InputError, match=wrong):
        wholearm.tune(light_box(), **given)


def test_stops_are_no_more_than_allowed() -> None:
    """Fingers too weak to move the box: each part is tried once, none is carried."""
    stuck = light_box().with_(friction_palm=0.9, torque_limit=0.05)
    alone = wholearm.tune(stuck, brake=True)
    found = wholearm.tune(stuck, brake=True, stops=3)
    assert not alone.ok and not found.ok and "phase 1" in found.reason
    parts = 3  # whole, its first half, and the first half of that
    assert found.simulations == parts * alone.simulations


def test_phases_that_nothing_stops_are_tuned_as_one() -> None:
    for path, parts in ((LANDING, [[4], [5, 6]]), (HEXAGON, [[8], [9, 10, 11]])):
        own = [[phase.number for phase in part.phases] for part in split_passages(problem_of(path))]
        assert own == [[number] for number in range(1, parts[0][0])] + parts


@each(
    "path, torques", [(HEPTAGON, "heptagon"), (LANDING, "heptagon_landing"), (HEXAGON, "hexagon")]
)
def test_shipped_torques_hold_every_contact(path: Path, torques: str) -> None:
    problem = problem_of(path)
    torque = wholearm.read_torque_csv(str(FOLDER / "torques" / f"{torques}_tuned.csv"))
    report = wholearm.verify_free(problem, torque)
    assert report.ok, report.reason
    assert [phase.reached for phase in report.phases] == [True] * len(problem.phases)
    assert not any(phase.losses for phase in report.phases)
    # What is let go ends at zero.
    assert np.nanmin(report.whole.c_n) > -1e-8 * problem.scene.scales.force
    assert not report.whole.z_dot[-1].any()


@cache
def let_go() -> Report:
    """Finger 2 is lowered until it lets go."""
    t, tau = np.array([0.0, 0.1]), np.array([[0.6, 0.17], [0.6, 0.3]])
    return verify(first_phase(), TorqueProfile.join_rows(np.column_stack([t, tau])))


def step(torque: TorqueProfile, time: float, by: Array) -> TorqueProfile:
    """Torques that change by `by`, shape (2,) [N m], from a time on."""
    early, late = torque.cut(0.0, time), torque.cut(time, torque.duration)
    late.coefficients[:, :, 0] += by
    joined = np.concatenate([early.coefficients, late.coefficients])
    return TorqueProfile(np.append(early.breaks[:-1], late.breaks), joined)


def forces_at_step(
    problem: Problem, torque: TorqueProfile, loss: Loss, by: Array
) -> tuple[Array, Array]:
    """Normal forces before and after a step of the torques right before a loss, (n_c,) each."""
    time = (1 - 1e-6) * loss.time
    simulation = simulate(problem, step(torque, time, by))
    own = [simulation.contacts.index(force.contact) for force in loss.forces]
    before, after = np.flatnonzero(simulation.t == time)
    return simulation.c_n[before, own], simulation.c_n[after, own]


def test_sensitivities_are_those_of_the_simulation_and_advice_mends_the_loss() -> None:
    problem, report = first_phase(), let_go()
    (loss,) = (loss for loss in report.help.losses if loss.kind == "lost")
    assert loss.contact == "v5-finger2" and not loss.at_rest and loss.phase == 1
    assert isinstance(report.replay, Simulation)
    assert loss.time == pytest.approx(report.replay.t[-1])
    per_tau = np.array([force.per_tau for force in loss.forces])
    for by in np.array([[0.01, 0.0], [0.0, -0.01], [0.02, 0.003]]):
        before, after = forces_at_step(problem, report.replay.torque, loss, by)
        assert after - before == pytest.approx(per_tau @ by, rel=1e-4, abs=1e-6)
        assert before == pytest.approx([force.c_n for force in loss.forces], abs=1e-4)
    names = [force.contact for force in loss.forces]
    good = [change for change in loss.changes if not change.but]
    assert good and loss.changes[0] is good[0]
    (tau,) = report.replay.torque.at(np.array([loss.time]))
    for mend in loss.changes:
        _, after = forces_at_step(problem, report.replay.torque, loss, np.array(mend.change))
        assert after[names.index(loss.contact)] == pytest.approx(problem.epsilon, rel=1e-3)
        assert (after.min() < 0.999 * problem.epsilon) == bool(mend.but)
        assert mend.to == pytest.approx(np.array(mend.change) + tau)
    text = report.to_text()
    assert f"help: {loss.to_text()}" in text and good[0].to_text() in text
    assert "acceleration to v3-finger1" in text
    assert report.to_dict()["help"]["losses"][0]["changes"][0]["but"] == ""


@pytest.mark.parametrize("tau", [(0.05, 0.05), (-0.2, 0.0), (0.9, 0.1), (-0.2, 0.2)])
def test_advice_at_rest_lets_the_object_start_or_rest(tau: tuple[float, float]) -> None:
    problem = first_phase()
    report = verify(problem, constant(tau, 1e-3))
    (loss,) = report.help.losses
    assert loss.at_rest and loss.time == 0.0 and loss.changes
    for mend in loss.changes:
        assert not mend.but
        simulation = simulate(problem, constant(mend.to, 1e-3))
        assert not simulation.find(EventKind.CONTACT_LOST)
        assert bool(simulation.find(EventKind.START)) != mend.holds
        if not mend.holds:
            # Towards v3-finger1 is to the left.
            assert simulation.z[-1, 0] < simulation.z[0, 0]


@pytest.mark.parametrize(("kind", "first", "second"), [("slips", 0.9, 1.0), ("lost", 0.5, 0.5)])
def test_a_rolling_contact_is_mended(kind: str, first: float, second: float) -> None:
    """Torques fall to shares while the box tips; what is lost is out of its cone as well."""
    problem, late = box(), tipped().phase_starts[1] + 0.1
    shares = np.array([[first], [second]])
    eased = change(tipped().torque, lambda t, c: np.where((t > late)[:, None, None], shares * c, c))
    report = verify(problem, eased)
    (loss,) = (loss for loss in report.help.losses if loss.kind == kind)
    k = [force.contact for force in loss.forces].index(loss.contact)
    mu = problem.phases[loss.phase - 1].formation.friction[k]
    # It slips at the edge of its cone, or beyond.
    assert abs(loss.forces[k].c_t) > mu * loss.forces[k].c_n * (1 - 1e-6)
    mend = loss.changes[0]
    assert not mend.but and isinstance(report.replay, Simulation)
    simulation = simulate(problem, step(report.replay.torque, loss.time, np.array(mend.change)))
    after = np.flatnonzero(simulation.t == loss.time)[-1]  # torques step here already
    assert simulation.t[-1] > loss.time
    column = simulation.contacts.index(loss.contact)
    c_n, c_t = simulation.c_n[after, column], simulation.c_t[after, column]
    assert abs(c_t) <= mu * (c_n - 0.999 * problem.epsilon)


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
        problem=first_phase(),
        t=np.append(replay.t, 2 * replay.t[-1] - replay.t[-2::-1]),
        z=np.vstack([replay.z, replay.z[-2::-1]]),
        z_dot=np.vstack([replay.z_dot, -replay.z_dot[-2::-1]]),
        phase=np.zeros(2 * len(replay.t) - 1, dtype=np.int64),
    )
    found = find_approach(back)
    assert found is not None and found.distance == pytest.approx(approach.distance, abs=1e-9)
    assert found.time == pytest.approx(replay.t[-1], abs=1e-6)
    assert list(found.turns) == pytest.approx([replay.t[-1]], abs=1e-9)
    assert "turns back at" in found.to_text()


PUSH = constant((0.3, 0.0), 0.5)
"""They drive the first phase through its end."""


def write(folder: Path) -> list[str]:
    """A replay of `PUSH`, its torques with a note, torques that let go, and such that hold."""
    weak, none = constant((0.05, 0.05), 0.5), constant((0.0, 0.0), 0.5)
    moved, *others = [folder / name for name in ("moved.npz", "noted.csv", "lost.csv", "still.csv")]
    save(simulate(first_phase(), PUSH), moved)
    for path, torque in zip(others, (PUSH, weak, none), strict=True):
        save(torque, path)
    text = others[0].read_text(encoding="utf-8")
    others[0].write_text("# simulations = 37\n" + text, encoding="utf-8")
    return [str(path) for path in (moved, *others)]


def test_figures_are_those_of_verify(tmp_path: Path) -> None:
    problem, paths = first_phase(), write(tmp_path)
    found = compare(problem, paths)
    moved, noted, lost, still = found.contenders
    energy = (report := verify(problem, PUSH)).energy
    assert moved.name == "moved.npz" and noted.simulations == 37 and moved.simulations is None
    for own in (moved, noted):
        assert own.reason == report.reason and own.ok == report.ok
        assert own.duration == pytest.approx(report.phases[0].arrival, abs=1e-7)
        assert own.lasts == pytest.approx([own.duration], abs=1e-7)
        assert own.effort == pytest.approx(0.09 * 0.5) and own.peaks == pytest.approx((0.3, 0.0))
        least = min(report.phases[0].contacts, key=lambda margin: margin.least)
        assert own.margin == pytest.approx(least.margin, abs=1e-6) and own.contact == least.contact
        dissipated = energy.viscous + energy.dry + energy.contact + energy.impact
        assert own.lost == pytest.approx(dissipated, abs=1e-6)
    assert lost.verdict == "FAILED" and "v5-finger2" in lost.reason and lost.duration == 0.5
    assert still.margin is None and "short of v3-finger1" in still.reason
    assert found.exit_status == 1
    text = found.to_text()
    assert "37" in text and "noted.csv" in text and lost.reason in text
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False)) == found.to_dict()
    figure = draw_comparison(found)
    assert len(figure.axes) == 3  # nothing has moved in lost.csv


def test_what_does_not_fit_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    problem, (moved, *_) = first_phase(), write(tmp_path)
    for other, text in (
        (problem.with_(mass=0.3), r"object\.mass \(0\.\d+ in the trajectory, 0\.\d+ here\)"),
        (problem_of(HEPTAGON), r"phases \(1 entries in the trajectory, 5 here\)"),
        (problem.with_({"phases[1].until": {"x": 0.02}}), r"phases\[1\]\.until"),
    ):
        with pytest.raises(InputError, match=text) as caught:
            compare(other, [moved])
        assert caught.value.source == moved
    json.dumps(compare(problem.with_(epsilon=0.01, name="other"), [Path(moved)] * 2).to_dict())
    assert main(["compare", str(HEPTAGON), moved]) == 2
    assert "moved.npz: made for another problem: phases (1 entries" in capsys.readouterr().err
    odd = tmp_path / "odd.csv"
    odd.write_text("# simulations = many\nt,tau1,tau2\n0,0,0\n1,0,0\n", encoding="utf-8")
    with pytest.raises(InputError, match="'many' given"):
        compare(problem, [str(odd)])


def test_what_differs_from_the_problem_of_a_plan_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem, (moved, *_) = first_phase(), write(tmp_path)
    meta = load_trajectory(moved).meta
    assert describe_origin(problem, meta) == ""
    other = problem.with_(mass=0.3, length1=problem.scene.fingers[0].length * 1.01)
    text = describe_origin(other, meta)
    assert text.startswith("made for another problem: object.mass (0.2 in the plan, 0.3 here)")
    assert "fingers.1.length" in text
    body = problem.table["object"]
    chipped = body | {"vertices": body["vertices"][:-1]}
    for senseless, key in (
        ({"length1": problem.scene.fingers[0].length * 1.5}, "fingers.1.length"),
        ({"base2": [-0.5, 0.1]}, "fingers.2.base"),
    ):
        table = change_table(meta["problem"], senseless, name_keys())
        with pytest.raises(InputError, match=f"{key}.*another hand"):
            describe_origin(problem, {"problem": table})
    with pytest.raises(InputError, match=r"object\.vertices: 6 entries in the plan, 7 here"):
        describe_origin(problem, {"problem": meta["problem"] | {"object": chipped}})
    own = tmp_path / "own.toml"
    own.write_text(re.sub(r"(?m)^mass = .*", "mass = 0.21", text_of()), encoding="utf-8")
    for options in ([], ["--json"]):
        main(["verify", str(own), moved, *options])
        out = capsys.readouterr().out
        notes = json.loads(out)["notes"] if options else out.splitlines()[:1]
        assert notes == ["made for another problem: object.mass (0.2 in the plan, 0.21 here)"]


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    """Torques as they come from a table carry the heptagon through with steps."""
    return simulate(problem_of(HEPTAGON), plan()[1].torque, times=np.linspace(0, 2, 301))


def test_a_replay_is_a_trajectory_and_loads_again(simulation: Simulation, tmp_path: Path) -> None:
    found, torque = simulation.trajectory, plan()[1].torque
    assert isinstance(found, Trajectory) and found.torque is torque
    assert found.contacts == simulation.contacts and len(found.motions) == 5
    assert found.duration == simulation.t[-1]
    inside = (np.diff(found.phase) == 0) & (np.diff(found.t) > 0)
    assert (np.diff(found.t)[inside] > 0).all() and (np.diff(found.t) >= 0).all()
    for t in np.linspace(0, 1.99, 57):
        # What was recorded at instants asked for is there between them, too.
        near = np.abs(found.t - t).argmin()
        assert found.at(found.t[near]).z[0] == pytest.approx(found.z[near], abs=1e-12)
    times = np.linspace(0.01, 1.95, 41)
    replay = simulate(simulation.problem, torque, times=times)
    assert found.at(times).z == pytest.approx(np.array([*map(replay.at, times)])[:, :5], abs=1e-8)
    save(simulation, tmp_path / "a.npz")
    loaded = load_trajectory(tmp_path / "a.npz")
    for name in ("t", "tau", "c_n", "phase", "z", "z_ddot"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(found, name))
    assert loaded.meta == found.meta and loaded.meta["status"] == "replayed"
    report = verify(simulation.problem, loaded)
    assert report.ok and report.phases[-1].deviation is not None
    assert report.phases[-1].deviation.position < 1e-8


def test_a_replay_that_fails_is_drawn_and_saved(tmp_path: Path) -> None:
    """It loses a contact on its way; another never moves, so that no force is known."""
    problem, trajectory = plan()
    weak = TorqueProfile(trajectory.torque.breaks, trajectory.torque.coefficients * 0.9)
    for report in (verify(problem, weak), verify(problem, constant((0.3, -0.8), 0.1))):
        assert not report.ok and report.finger_gap is not None
        figure = plots.force_margins(report)
        title = " ".join(figure.texts[-1].get_text().split())
        assert f"{1e3 * report.finger_gap.least:.3g} mm {report.outcome}" in title
        assert "replayed" in title
        report.trajectory.save(tmp_path / "a.npz")
        figure = plots.force_margins(load_trajectory(tmp_path / "a.npz"))
    plots.save(figure, tmp_path / "a.png")
    # Torques step to what loses contacts: crosses are where their forces fall to.
    torque = TorqueProfile.chain([trajectory.torque.cut(0.0, 0.1), constant((-9.0, 9.0), 0.1)])
    simulation = simulate(problem, torque)
    lines = plots.force_margins(simulation).axes[-2].lines
    crosses = [np.asarray(line.get_ydata())[0] for line in lines if line.get_marker() == "x"]
    assert min(crosses) == pytest.approx(np.nanmin(simulation.c_n[-1]) - problem.epsilon)


def test_saving_goes_by_the_ending(simulation: Simulation, tmp_path: Path) -> None:
    save(simulation, tmp_path / "a.csv")
    torque = read_torque_csv(str(tmp_path / "a.csv"))
    t = np.linspace(0.001, 1.999, 301)
    np.testing.assert_allclose(torque.at(t), simulation.torque.at(t), atol=1e-5)
    save(torque, tmp_path / "b.csv")
    with pytest.raises(InputError, match="torques alone have no motion"):
        save(torque, tmp_path / "b.npz")
    with pytest.raises(InputError, match="ending"):
        save(simulation, tmp_path / "a.mat")
    with pytest.raises(InputError, match="no motion to draw"):
        plots.force_margins(torque)


def test_verify_writes_what_plot_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(plan()[1].torque, tmp_path / "a.csv")
    out = str(tmp_path / "a.npz")
    assert main(["verify", str(HEPTAGON), str(tmp_path / "a.csv"), "-o", out]) == 0
    assert capsys.readouterr().out.endswith(f"wrote {out}\n")
    assert main(["plot", out, "--simulate", "-o", str(tmp_path / "a.svg")]) == 0
    assert capsys.readouterr().out == f"wrote {tmp_path / 'a.svg'}\n"
    drawn = (tmp_path / "a.svg").read_bytes()
    assert drawn.startswith(b"<?xml") and len(drawn) > 1e4
    assert main(["verify", str(HEPTAGON), out]) == 0
    wrong = str(tmp_path / "a.mat")
    assert main(["verify", str(HEPTAGON), out, "-o", wrong]) == 2
