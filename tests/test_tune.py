from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wholearm
from wholearm.cli.command import main
from wholearm.results.torque import read_notes
from wholearm.tuning.rule import FACTOR
from wholearm.tuning.trial import Outcome, Step, make_rows


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
    slides = [trial for trial in drives if trial.outcome is Outcome.ARRIVES]
    times = [trial.time for trial in slides]
    assert times == sorted(times, reverse=True), "more torque brings it there sooner"
    assert drives[0].outcome is Outcome.RESTS, "quasistatic torques set nothing in motion"


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


def test_steps_hold_until_the_next() -> None:
    rows = make_rows([Step(0.0, (1.0, -1.0)), Step(0.5, (2.0, 0.0))], 2.0)
    assert rows.tolist() == [[0, 1, -1], [0.5, 1, -1], [0.5, 2, 0], [2, 2, 0]]


def test_only_csv_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["tune", "problems/heptagon.toml", "-o", str(tmp_path / "tuned.npz")]
    assert main(given) == 2
    assert "tuned.npz" in capsys.readouterr().err
