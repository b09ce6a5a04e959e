from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from shipped import FOLDER, HEPTAGON, problem_of
from wholearm.common.errors import InputError
from wholearm.problem.definition import Problem
from wholearm.results.torque import read_notes, read_torque_csv
from wholearm.tuning.tune import tune
from wholearm.tuning.tuned import Tuned
from wholearm.verification.verify import verify


def first_phase() -> Problem:
    problem = problem_of(HEPTAGON)
    return dataclasses.replace(problem, phases=problem.phases[:1])


@cache
def tuned() -> Tuned:
    return tune(first_phase())


def test_raised_quasistatic_torques_carry_the_slide(tmp_path: Path) -> None:
    found, problem = tuned(), first_phase()
    assert found.ok and len(found.phases) == 1
    for own in found.phases:
        (_, run), (_, brake) = own.steps
        # The right finger pushes to the left.
        assert own.finger == 1 and own.raises > 0
        assert run == pytest.approx(own.quasistatic * [1.1**own.raises, 1.0])
        assert brake == pytest.approx(own.quasistatic * [1.1**-own.brake, 1.0])
        assert own.outcome.least >= problem.epsilon and own.free < 1e-6
    file = tmp_path / "tuned.csv"
    file.write_text(found.to_csv(), encoding="utf-8")
    report = verify(problem, read_torque_csv(str(file)))
    assert report.ok
    assert min(c.margin for phase in report.phases for c in phase.contacts) > 0
    assert read_notes(str(file))["simulations"] == str(found.simulations)
    values = found.to_dict()
    assert values["ok"] and values["phases"][0]["steps"][1][0] == found.phases[0].steps[1][0]
    assert f"{found.simulations} simulations" in found.to_text()


def test_where_nothing_balances_it_says_so() -> None:
    found = tune(first_phase().with_(epsilon=5.0))
    assert not found.ok and found.torque is None
    assert "phase 1 has no quasistatic torques all along" in found.to_text()
    with pytest.raises(InputError, match="share"):
        tune(first_phase(), share=np.nan)


def test_the_shipped_torques_hold() -> None:
    path = FOLDER / "torques" / "heptagon_four_contacts_tuned.csv"
    report = verify(problem_of(HEPTAGON), read_torque_csv(str(path)))
    assert report.ok
