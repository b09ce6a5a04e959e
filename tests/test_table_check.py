from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from planned import change, plan
from wholearm.common.arrays import Array
from wholearm.common.errors import ReplayError
from wholearm.planning.table_check import make_table, sample_table
from wholearm.results.torque_table import read_rows
from wholearm.verification.verify import verify


def brake_less(starts: Array, c: Array) -> Array:
    c[(starts > 0.3) & (starts < 0.4 - 1e-9)] *= 0.97
    return c


def test_a_table_holds_like_its_plan() -> None:
    problem, trajectory = plan()
    table = make_table(problem, trajectory)
    report = verify(problem, read_rows(table.rows))
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
        make_table(problem, weak)
    assert make_table(problem, weak, replay=False).figures["replay"] is None


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_samples_at_a_rate_are_reported(interpolation: str) -> None:
    """The closer the samples, the nearer arrivals and forces are to those of the plan."""
    problem, trajectory = plan()
    fine = sample_table(problem, trajectory, 8000.0, interpolation).figures
    coarse = sample_table(problem, trajectory, 60.0, interpolation).figures
    assert (fine["sample_rate"], fine["interpolation"]) == (8000.0, interpolation)
    assert not coarse["replay"]["ok"] and " phase " in coarse["replay"]["reason"]

    def find_errors(figures: dict[str, object]) -> Array:
        replay = figures["replay"]
        assert isinstance(replay, dict)
        first = replay["phases"][0]
        arrival = np.inf if first["arrival"] is None else first["arrival"]
        return np.array(
            [
                abs(arrival - first["planned_arrival"]),
                abs(first["least_c_n"] - first["planned_least_c_n"]),
            ]
        )

    # What is d off at its end arrives sqrt(2 d / a) early: half a period of delay takes 4 ms.
    assert (find_errors(fine) < [0.02, 0.02]).all()
    assert find_errors(coarse).sum() > 2 * find_errors(fine).sum()
    unplayed = sample_table(problem, trajectory, 60.0, interpolation, replay=False)
    assert unplayed.figures["replay"] is None
