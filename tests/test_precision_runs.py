from __future__ import annotations

import math
from pathlib import Path

import pytest

from wholearm.benchmark.precision.report import Comparison, find_times
from wholearm.benchmark.precision.runs import (
    REPEATS,
    SHIFT,
    SHORT,
    Run,
    find_mean,
    find_medians,
    format_runs,
    read_runs,
    repeat,
)
from wholearm.common.errors import InputError

FINE = Run("study", "phase 1", "a, b", "1e-6", 0, 0.5, 0.2, 1e-7)
RUNS = [
    FINE,
    FINE._replace(repeat=1, build=0.1, solve=0.4, error=-3e-7),
    FINE._replace(repeat=2, solve=0.3),
    FINE._replace(setting="1e-3", solve=0.1, error=1e-4),
    FINE._replace(instance="phase 2", solve=60.0, error=math.nan, outcome="time limit"),
]


def test_runs_are_read_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "runs.csv"
    assert read_runs(str(path)) == []
    path.write_text(format_runs(RUNS))
    assert list(map(str, read_runs(str(path)))) == list(map(str, RUNS))


@pytest.mark.parametrize("given", ["", "a,b\n1,2\n", "\0", "study,instance\n"])
def test_no_other_file_is_taken_for_runs(given: str, tmp_path: Path) -> None:
    path = tmp_path / "runs.csv"
    path.write_text(given)
    with pytest.raises(InputError, match="holds no runs of this study"):
        read_runs(str(path))


def test_some_errors_count_or_all() -> None:
    plan = FINE._replace(error=1e-4, end=1e-2, violation=0.0)
    (median,) = find_medians([plan]).values()
    assert median.reaches(1e-3, 1) and not median.reaches(1e-3) and median.reaches(1e-2)


def test_medians_keep_the_worst_error() -> None:
    median = find_medians(RUNS)["study", "phase 1", "a, b", "1e-6"]
    assert (median.build, median.solve, median.errors) == (0.5, 0.3, (-3e-7,))
    assert median.reaches(3e-7) and not median.reaches(2e-7)


def test_the_soonest_setting_counts_and_failures_never_do() -> None:
    medians = find_medians(RUNS)
    own = Comparison("study", "title", "a, b", (1e-3, 1e-6), False, None)
    assert find_times(medians, "a, b", own, 1e-3) == {"phase 1": 0.1, "phase 2": math.inf}
    assert find_times(medians, "a, b", own, 1e-6) == {"phase 1": 0.3, "phase 2": math.inf}
    built = own._replace(building=True)
    assert find_times(medians, "a, b", built, 1e-6) == {"phase 1": 0.8, "phase 2": math.inf}


def test_means_are_geometric_but_for_their_shift() -> None:
    assert find_mean([0.0, 3 * SHIFT]) == pytest.approx(SHIFT)
    assert find_mean([1e6, 1e2]) == pytest.approx(1e4, rel=1e-3)


def test_what_is_quick_is_run_several_times() -> None:
    found = list(repeat(lambda: lambda: 7))
    assert found and {answer for _, _, answer in found} == {7} and len(found) <= REPEATS
    assert max(took for _, took, _ in found) < SHORT
