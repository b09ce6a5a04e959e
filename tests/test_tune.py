from __future__ import annotations

import dataclasses
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wholearm
from shipped import FOLDER, HEPTAGON, HEXAGON, LANDING, problem_of
from wholearm.common.errors import InputError
from wholearm.results.torque import read_notes
from wholearm.simulation.events import Event, EventKind
from wholearm.tuning.trial import Bench, TrialOutcome, TuningStep, split_passages
from wholearm.tuning.tuner import FACTOR


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
