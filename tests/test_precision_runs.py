from __future__ import annotations

import math

import pytest

from wholearm.benchmark.precision.phases import SHIFT, SHORT, SOLVED, Median, find_mean, measure
from wholearm.benchmark.precision.precision_study import Medians, PeerComparison, find_times

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


def test_means_are_geometric_but_for_their_shift() -> None:
    assert find_mean([0.0, 3 * SHIFT]) == pytest.approx(SHIFT)
    assert find_mean([1e6, 1e2]) == pytest.approx(1e4, rel=1e-3)
