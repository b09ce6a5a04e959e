from __future__ import annotations

import dataclasses
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wholearm
from planned import change
from shipped import FOLDER, HEPTAGON, HEXAGON, LANDING, problem_of
from tipping import box, tipped
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.problem.definition import Problem
from wholearm.results.report import Loss, Report
from wholearm.results.torque import TorqueProfile, read_notes
from wholearm.simulation.events import Event, EventKind, Simulation
from wholearm.simulation.simulate import simulate
from wholearm.tuning.tuner import FACTOR, Bench, TrialOutcome, TuningStep, split_passages
from wholearm.verification.torque_advice import find_approach
from wholearm.verification.verify import verify


def build_box() -> wholearm.Problem:
    """A box that two light fingers slide 10 mm to the left."""
    link: dict[str, Any] = {
        "length": 0.11,
        "radius": 0.0,
        "inertia": 1e-4,
        "viscous": 0.0,
        "dry": 0.0,
        "torque_limit": 1.0,
    }
    scene = wholearm.Scene(
        wholearm.Polygon([[-0.03, 0.0], [0.03, 0.0], [0.03, 0.06], [-0.03, 0.06]], mass=0.2),
        (wholearm.Finger(base=(0.1, -0.01), **link), wholearm.Finger(base=(-0.1, -0.01), **link)),
        wholearm.Friction(palm=0.1, finger1=0.1, finger2=0.1),
    )
    contacts = wholearm.read_formation(scene, ["v0-palm", "v1-palm", "v2-finger1", "v3-finger2"])
    slide = wholearm.Phase(0, contacts, wholearm.read_until(scene, {"x": -0.01}))
    start = wholearm.place_start(scene, flush=0, x=0.0)
    return wholearm.Problem("box", scene, 0.05, start, (slide,))


@lru_cache
def tune_box() -> wholearm.Tuning:
    return wholearm.tune(build_box(), brake=True)


def test_tuned_torques_hold_every_contact_and_end_at_rest() -> None:
    found = tune_box()
    assert found.ok and found.exit_status == 0 and found.report is not None
    whole = found.report.whole
    assert np.nanmin(whole.c_n) > 0 and whole.z[-1, 0] == pytest.approx(-0.01, abs=1e-6)
    assert not whole.z_dot[-1].any()
    assert found.simulations > len(found.phases[0].trials)


def test_torques_are_quasistatic_ones_in_steps_of_ten_percent() -> None:
    phase = tune_box().phases[0]
    assert phase.acting == 1, "the right finger pushes a slide to the left"
    for step in phase.steps[:2]:
        powers = np.log(np.array(step.tau) / phase.quasistatic) / np.log(FACTOR)
        assert powers == pytest.approx(np.round(powers), abs=1e-9)
    assert phase.steps[0].tau[0] > phase.quasistatic[0] > phase.steps[1].tau[0]
    drives = [trial for trial in phase.trials if len(trial.steps) == 1]
    raised = [trial.steps[0].tau[0] for trial in drives]
    assert np.array(raised[1:]) == pytest.approx(FACTOR * np.array(raised[:-1]))
    slides = [trial for trial in drives if trial.outcome is TrialOutcome.ARRIVES]
    times = [trial.time for trial in slides]
    assert times == sorted(times, reverse=True), "more torque brings it there sooner"
    assert drives[0].outcome is TrialOutcome.RESTS, "quasistatic torques set nothing in motion"


def test_the_table_is_what_was_judged(tmp_path: Path) -> None:
    found, path = tune_box(), tmp_path / "tuned.csv"
    path.write_text(found.to_csv())
    torque = wholearm.read_torque_csv(str(path))
    assert found.torque is not None
    assert np.array_equal(torque.breaks, found.torque.breaks)
    assert np.array_equal(torque.coefficients, found.torque.coefficients)
    assert read_notes(str(path))["simulations"] == str(found.simulations)
    assert f"{found.simulations} simulations" in found.to_text()
    assert found.to_dict()["phases"][0]["trials"][0]["outcome"] == "rests"


def test_constant_torques_do_not_come_to_rest() -> None:
    found = wholearm.tune(build_box())
    assert not found.ok and found.exit_status == 1 and found.torque is None
    assert found.reason.startswith("phase 1: x = -0.01 m is reached at ")
    with pytest.raises(ValueError, match="no torques"):
        found.to_csv()


@pytest.mark.parametrize(
    ("given", "wrong"),
    [
        ({"stops": 8, "brake": True}, "stops: 8 given; allowed are 0 to 7"),
        ({"stops": -1, "brake": True}, "allowed are 0 to 7"),
        ({"stops": 1.5, "brake": True}, "allowed are 0 to 7"),
        ({"stops": 1}, "without a brake"),
        ({"share": 2.0}, "share: 2.0 given; allowed are 0 to 1"),
    ],
)
def test_options_out_of_range_are_refused(given: dict[str, Any], wrong: str) -> None:
    with pytest.raises(InputError, match=wrong):
        wholearm.tune(build_box(), **given)


def test_stops_are_no_more_than_allowed() -> None:
    """Fingers too weak to move the box: each part is tried once, none is carried."""
    stuck = build_box().with_(friction_palm=0.9, torque_limit=0.05)
    alone = wholearm.tune(stuck, brake=True)
    found = wholearm.tune(stuck, brake=True, stops=3)
    assert not alone.ok and not found.ok and "phase 1" in found.reason
    parts = 3  # whole, its first half, and the first half of that
    assert found.simulations == parts * alone.simulations


def test_a_contact_that_never_presses_is_lost() -> None:
    problem = build_box()
    (passage,) = split_passages(problem)
    bench = Bench(problem, passage, problem.start)
    # The left finger is pulled away.
    trial = bench.run([TuningStep(0.0, (0.1, 0.2))])
    assert trial.outcome is TrialOutcome.LOSES and trial.contact == "v3-finger2"
    assert trial.time == 0.0


def test_phases_that_nothing_stops_are_tuned_as_one() -> None:
    assert [p.title for p in split_passages(problem_of(LANDING))] == ["1", "2", "3", "4", "5-6"]
    found = split_passages(problem_of(HEXAGON))
    assert [p.title for p in found][-2:] == ["8", "9-11"] and len(found) == 9
    assert not any(p.passed for p in found), "each of them ends by closing a gap"
    first, second = found[-1].phases[:2]
    alone = dataclasses.replace(found[-1], phases=(first,), after=second)
    assert alone.passed == "e3-tip1"


def test_a_passage_follows_what_happens_from_phase_to_phase() -> None:
    passage = split_passages(problem_of(LANDING))[-1]
    release = Event(0.1, 0, EventKind.CONTACT_LOST, "", "v3-finger1")
    lands = Event(0.2, 0, EventKind.IMPACT, "", "v2-palm")
    gone = Event(0.15, 0, EventKind.CONTACT_LOST, "", "v4-finger1")
    assert passage.follow([release, lands]) == ([0.1, 0.2], None)
    assert passage.follow([release, gone, lands]) == ([0.1], gone)
    assert passage.follow([gone]) == ([], gone)
    assert "v3-finger1" not in passage.list_pressed(0)


@pytest.mark.parametrize(
    ("path", "torques"),
    [(HEPTAGON, "heptagon"), (LANDING, "heptagon_landing"), (HEXAGON, "hexagon")],
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


EARLY = 1 - 1e-6
"""Time of a step of the torques, over that of the loss which it is to mend."""


@cache
def first_phase() -> Problem:
    problem = problem_of(HEPTAGON)
    return dataclasses.replace(problem, phases=problem.phases[:1])


@cache
def let_go() -> Report:
    """Finger 2 is lowered until it lets go."""
    t, tau = np.array([0.0, 0.1]), np.array([[0.6, 0.17], [0.6, 0.3]])
    return verify(first_phase(), TorqueProfile.join_rows(t, tau))


def step(torque: TorqueProfile, time: float, by: Array) -> TorqueProfile:
    """Torques that change by `by`, shape (2,) [N m], from a time on."""
    before = torque.breaks[torque.breaks < time]
    after = torque.breaks[torque.breaks > time]
    parts = [np.append(before, time), np.append(time, after)]
    degree = torque.coefficients.shape[2] - 1
    early, late = (TorqueProfile.fit(part, torque.at, degree) for part in parts)
    late.coefficients[:, :, 0] += by
    joined = np.concatenate([early.coefficients, late.coefficients])
    return TorqueProfile(np.append(before, late.breaks), joined)


def forces_at_step(problem: Problem, report: Report, loss: Loss, by: Array) -> tuple[Array, Array]:
    """Normal forces before and after a step of the torques right before a loss, (n_c,) each."""
    assert isinstance(report.replay, Simulation)
    time = EARLY * loss.time
    simulation = simulate(problem, step(report.replay.torque, time, by))
    own = [simulation.contacts.index(force.contact) for force in loss.forces]
    before, after = np.flatnonzero(simulation.t == time)
    return simulation.c_n[before, own], simulation.c_n[after, own]


def test_sensitivities_are_those_of_the_simulation() -> None:
    report = let_go()
    (loss,) = (loss for loss in report.help.losses if loss.kind == "lost")
    assert loss.contact == "v5-finger2" and not loss.at_rest and loss.phase == 1
    assert loss.time == pytest.approx(report.replay.t[-1])  # type: ignore[union-attr]
    per_tau = np.array([force.per_tau for force in loss.forces])
    for by in np.array([[0.01, 0.0], [0.0, -0.01], [0.02, 0.003]]):
        before, after = forces_at_step(first_phase(), report, loss, by)
        assert after - before == pytest.approx(per_tau @ by, rel=1e-4, abs=1e-6)
        assert before == pytest.approx([force.c_n for force in loss.forces], abs=1e-4)


def test_following_the_advice_mends_the_loss() -> None:
    problem, report = first_phase(), let_go()
    (loss,) = (loss for loss in report.help.losses if loss.kind == "lost")
    names = [force.contact for force in loss.forces]
    good = [change for change in loss.changes if not change.but]
    assert good and loss.changes[0] is good[0]
    for mend in loss.changes:
        _, after = forces_at_step(problem, report, loss, np.array(mend.change))
        assert after[names.index(loss.contact)] == pytest.approx(problem.epsilon, rel=1e-3)
        assert (after.min() < 0.999 * problem.epsilon) == bool(mend.but)
        assert mend.to == pytest.approx(np.array(mend.change) + tau_at(report, loss))
    text = report.to_text()
    assert f"help: {loss.to_text()}" in text and good[0].to_text() in text
    assert "acceleration to v3-finger1" in text
    assert report.to_dict()["help"]["losses"][0]["changes"][0]["but"] == ""


def tau_at(report: Report, loss: Loss) -> Array:
    assert isinstance(report.replay, Simulation)
    return np.asarray(report.replay.torque.at(np.array([loss.time]))[0])


@pytest.mark.parametrize("tau", [(0.05, 0.05), (-0.2, 0.0), (0.9, 0.1), (-0.2, 0.2)])
def test_advice_at_rest_lets_the_object_start_or_rest(tau: tuple[float, float]) -> None:
    problem = first_phase()
    report = verify(problem, TorqueProfile(np.array([0.0, 1e-3]), np.array([tau])[..., None]))
    (loss,) = report.help.losses
    assert loss.at_rest and loss.time == 0.0 and loss.changes
    for mend in loss.changes:
        assert not mend.but
        again = TorqueProfile(np.array([0.0, 1e-3]), np.array([mend.to])[..., None])
        simulation = simulate(problem, again)
        assert not simulation.find(EventKind.CONTACT_LOST)
        assert bool(simulation.find(EventKind.START)) != mend.holds
        if not mend.holds:
            # Towards v3-finger1 is to the left.
            assert simulation.z[-1, 0] < simulation.z[0, 0]


@pytest.mark.parametrize(("kind", "first", "second"), [("slips", 0.9, 1.0), ("lost", 0.5, 0.5)])
def test_a_rolling_contact_is_mended(kind: str, first: float, second: float) -> None:
    """One that is lost is out of its cone as well; both are mended."""
    problem, report = box(), ease((first, second))
    (loss,) = (loss for loss in report.help.losses if loss.kind == kind)
    k = [force.contact for force in loss.forces].index(loss.contact)
    mu = problem.phases[loss.phase - 1].formation.friction[k]
    # It slips at the edge of its cone, or beyond.
    assert abs(loss.forces[k].c_t) > mu * loss.forces[k].c_n * (1 - 1e-6)
    mend = loss.changes[0]
    assert not mend.but
    assert isinstance(report.replay, Simulation)
    # The torques step here already.
    torque = step(report.replay.torque, loss.time, np.array(mend.change))
    simulation = simulate(problem, torque)
    after = np.flatnonzero(simulation.t == loss.time)[-1]
    assert simulation.t[-1] > loss.time
    column = simulation.contacts.index(loss.contact)
    c_n, c_t = simulation.c_n[after, column], simulation.c_t[after, column]
    assert abs(c_t) <= mu * (c_n - 0.999 * problem.epsilon)


def ease(shares: tuple[float, float]) -> Report:
    """The box tips over a vertex that rolls, with shares of its torques from some time on."""
    problem, trajectory = box(), tipped()

    def scale(starts: Array, c: Array) -> Array:
        c[starts > trajectory.phase_starts[1] + 0.1] *= np.array(shares)[:, None]
        return c

    return verify(problem, change(trajectory.torque, scale))


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
        t=np.append(replay.t, 2 * replay.t[-1] - replay.t[-2::-1]),
        z=np.vstack([replay.z, replay.z[-2::-1]]),
        z_dot=np.vstack([replay.z_dot, -replay.z_dot[-2::-1]]),
        phase=np.zeros(2 * len(replay.t) - 1, dtype=np.int64),
    )
    found = find_approach(first_phase(), back)
    assert found is not None and found.distance == pytest.approx(approach.distance, abs=1e-9)
    assert found.time == pytest.approx(replay.t[-1], abs=1e-6)
    assert list(found.turns) == pytest.approx([replay.t[-1]], abs=1e-9)
    assert "turns back at" in found.to_text()
