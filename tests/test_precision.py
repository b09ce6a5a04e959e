from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from wholearm.benchmark.precision.phases import (
    SHORT,
    SOLVED,
    Instance,
    Median,
    list_instances,
    measure,
)
from wholearm.benchmark.precision.planners import (
    LEAST_TIME,
    NO_DRAG,
    PLANNERS,
    find_least_time,
    run_planner,
)
from wholearm.benchmark.precision.precision_study import Medians, PeerComparison, find_times
from wholearm.benchmark.precision.reference import Course, measure_error
from wholearm.benchmark.precision.simulators import FEW, SIMULATORS, check_plan, make_course
from wholearm.cli.command import main
from wholearm.results.torque import TorqueProfile

FILES = (str(Path(__file__).parents[1] / "problems" / "heptagon_four_contacts.toml"),)
LEAST = {LEAST_TIME: 0.0666298, NO_DRAG: 0.0663431}
"""Least times of the fourth phase, within 1e-5."""
TRIED = {"wholearm, curve": "1e-3", "wholearm, time": "8 x 3", "yapss": "20", "toppra": "100"}


@lru_cache
def phase(number: int, drag: bool = True) -> Instance:
    return list_instances(FILES, drag)[number - 1]


@pytest.mark.parametrize("method", TRIED)
def test_every_planner_comes_near_the_least_time(method: str) -> None:
    if not PLANNERS[method].is_installed:
        pytest.skip(f"{method}: pip install 'wholearm[bench]'")
    (study, *_) = PLANNERS[method].choices
    found = run_planner(study, phase(4).name, method, TRIED[method], FILES)
    error, end, violation = found.errors
    assert found.outcome == SOLVED and abs(error) < 2e-2
    assert end < 1e-2 and violation < 2.6e-2
    least = find_least_time(phase(4, study != NO_DRAG))
    assert least == pytest.approx(LEAST[study], rel=1e-5)


def test_what_a_replay_does_not_keep_is_no_solution() -> None:
    plan = PLANNERS["wholearm, curve"].build(phase(4), "1e-3")()
    good = check_plan(phase(4), plan)
    assert good.outcome == SOLVED and good.end < 1e-8
    weak = TorqueProfile(plan.torque.breaks, 0.98 * plan.torque.coefficients)
    late = check_plan(phase(4), plan._replace(torque=weak))
    assert late.end > 1e-3
    none = np.zeros_like(plan.torque.coefficients)
    lost = check_plan(phase(4), plan._replace(torque=TorqueProfile(plan.torque.breaks, none)))
    assert "contact is lost" in lost.outcome and lost.violation > 0.02
    assert check_plan(phase(4), plan._replace(status="stopped")).outcome == "stopped"


def test_methods_that_nobody_knows_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bench", "precision", "--problems", str(Path(FILES[0]).parent), "-o", "out"]
    assert main([*command, "--peers", "fastest"]) == 2
    assert "--peers: 'fastest' given; allowed are wholearm;" in capsys.readouterr().err


PROBLEMS = Path(__file__).parents[1] / "problems"
FLIPS = str(PROBLEMS / "heptagon_four_contacts.toml")


@lru_cache
def course() -> Course:
    """The heptagon's first phase, with a reversal on its way."""
    (first, *_) = list_instances((FLIPS,))
    found = make_course(first, FEW)
    assert found is not None
    return found


def test_reference_is_exact_and_meets_the_reversal() -> None:
    assert course().own_error < 1e-12
    directions = {tuple(np.append(span.Xi, span.sigma)) for span in course().spans}
    assert len(directions) == 2
    ends = [span.stop for span in course().spans]
    assert [span.start for span in course().spans] == [0.0, *ends[:-1]]


@pytest.mark.parametrize("method", SIMULATORS)
def test_every_simulator_converges_to_the_reference(method: str) -> None:
    errors = [
        measure_error(
            course().problem, SIMULATORS[method].build(course(), tolerance)(), course().end
        )
        for tolerance in ("1e-5", "1e-9")
    ]
    assert errors[1] < 2e-7 and errors[1] < max(0.3 * errors[0], 1e-10)


FINE = Median(0.5, 0.3, (-3e-7,))
MEDIANS: Medians = {
    ("study", "phase 1", "a, b", "1e-6"): FINE,
    ("study", "phase 1", "a, b", "1e-3"): FINE._replace(solve=0.1, errors=(1e-4,)),
    ("study", "phase 2", "a, b", "1e-6"): Median(0.5, 60.0, (math.nan,), "time limit"),
}


def test_some_errors_count_or_all() -> None:
    median = Median(0.5, 0.2, (1e-4, 1e-2, 0.0))
    assert median.reaches(1e-3, 1) and not median.reaches(1e-3) and median.reaches(1e-2)
    assert FINE.reaches(3e-7) and not FINE.reaches(2e-7)
    assert not median._replace(outcome="a contact is lost").reaches(1.0)


def test_medians_keep_the_worst_error_and_the_first_failure() -> None:
    errors, outcomes = iter([1e-7, -3e-7, 2e-7]), iter([SOLVED, "lost", "late"])
    found = measure(lambda: lambda: 7, lambda _: ((next(errors),), next(outcomes)))
    assert found.errors == (-3e-7,) and found.outcome == "lost"
    assert 0 <= found.solve < SHORT and 0 <= found.build < SHORT


def test_the_soonest_setting_counts_and_failures_never_do() -> None:
    own = PeerComparison("study", "title", "a, b", (1e-3, 1e-6), False, None)
    assert find_times(MEDIANS, "a, b", own, 1e-3) == {"phase 1": 0.1, "phase 2": math.inf}
    assert find_times(MEDIANS, "a, b", own, 1e-6) == {"phase 1": 0.3, "phase 2": math.inf}
    built = own._replace(building=True)
    assert find_times(MEDIANS, "a, b", built, 1e-6) == {"phase 1": 0.8, "phase 2": math.inf}
