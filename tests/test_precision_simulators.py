from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from wholearm.benchmark.precision.phases import Instance, list_instances
from wholearm.benchmark.precision.reference import Course, measure_error
from wholearm.benchmark.precision.simulators import FEW, SIMULATORS, make_course

PROBLEMS = Path(__file__).parents[1] / "problems"
FLIPS = str(PROBLEMS / "heptagon_four_contacts.toml")


@lru_cache
def course() -> Course:
    """The heptagon's first phase, with a reversal on its way."""
    (first, *_) = list_instances((FLIPS,))
    found = make_course(first, FEW)
    assert found is not None
    return found


def test_files_share_phases() -> None:
    twice = str(PROBLEMS / "heptagon_twice.toml")
    names = [instance.name for instance in list_instances((FLIPS, twice))]
    assert names == [f"heptagon_four_contacts {number}" for number in range(1, 6)]


def test_reference_is_exact_and_meets_the_reversal() -> None:
    assert course().own_error < 1e-13
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
        for tolerance in (1e-5, 1e-9)
    ]
    assert errors[1] < 2e-7 and errors[1] < max(0.3 * errors[0], 1e-10)


def test_phases_that_allow_no_slow_motion_have_no_course() -> None:
    rough = list_instances((str(PROBLEMS / "heptagon_impact.toml"),))
    assert [make_course(instance, FEW) is None for instance in rough[3:4]] == [True]


def test_a_phase_alone_starts_where_its_curve_does() -> None:
    for instance in list_instances((FLIPS,)):
        assert isinstance(instance, Instance)
        assert np.array_equal(instance.problem.start, instance.curve.start)
