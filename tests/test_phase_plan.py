from __future__ import annotations

import pytest

from shipped import IMPACTS, problem_of
from wholearm.planning.options import Objective
from wholearm.planning.phase_plan import add_up, combine


def test_durations_add_up() -> None:
    phases = problem_of(IMPACTS).phases[:3]
    assert add_up(phases, [0.1, 0.2, 0.3, 9.0, 9.0]) == pytest.approx(0.6)
    assert add_up(phases, [None] * 5) is None


def test_the_least_margin_counts_and_the_sum_of_anything_else() -> None:
    assert combine(Objective.MARGIN, [0.3, 0.1, 0.2]) == 0.1
    assert combine(Objective.EFFORT, [0.3, 0.1, 0.2]) == pytest.approx(0.6)
