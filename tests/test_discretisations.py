from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from wholearm import load
from wholearm.benchmark.discretisations import SCHEMES, WIDE, measure_spread, plan_each

PROBLEMS = Path(__file__).parents[1] / "problems"


def test_answers_hardly_depend_on_the_scheme() -> None:
    whole, lines = load(str(PROBLEMS / "square.toml")), list[str]()
    problem = replace(whole, phases=whole.phases[:1])
    values = plan_each(problem, "time", lines.append, intervals=(10,), degrees=(3,))
    assert len(lines) == len(values) == len(SCHEMES)
    assert measure_spread(values, "time").width <= WIDE


def test_spreads_are_relative_to_the_best() -> None:
    assert measure_spread([2.0, 2.1, 2.0], "time") == (2.0, (2.1 - 2.0) / 2.0, 0)
    assert measure_spread([2.0, 1.9], "margin") == (2.0, (2.0 - 1.9) / 2.0, 0)


def test_what_has_no_plan_is_counted() -> None:
    assert measure_spread([2.0, None], "time") == (2.0, math.inf, 1)
    assert math.isnan(measure_spread([None], "time").best)
