from __future__ import annotations

import math

import pytest

from wholearm.common.shortfalls import Change, LimitPlace, Parameter, Shortfall
from wholearm.planning.advice import (
    bracket,
    describe_changes,
    describe_shortfalls,
    find_changes,
    rank_shortfalls,
    round_outwards,
)

TORQUE = Parameter("torque limit of finger 2", 2.0, "N m", 1)
EPSILON = Parameter("epsilon", 0.05, "N", -1)


@pytest.mark.parametrize(
    "value, sign, rounded",
    [
        (2.3412, 1, 2.35),
        (2.3412, -1, 2.34),
        (2.34, 1, 2.34),
        (0.1 + 0.2, 1, 0.3),
        (0.1 + 0.2, -1, 0.3),
        (0.01234, -1, 0.0123),
        (0.01234, 1, 0.0124),
        (99.91, 1, 100.0),
        (12345.0, 1, 12400.0),
        (12345.0, -1, 12300.0),
        (-0.01234, -1, -0.0124),
        (0.0, 1, 0.0),
        (math.inf, 1, math.inf),
    ],
)
def test_rounding_goes_outwards(value: float, sign: int, rounded: float) -> None:
    assert round_outwards(value, sign) == rounded


def test_only_confirmed_changes_are_found() -> None:
    """Limit 0 works at its rounded value, 1 needs some room, 2 cannot, 3 is never enough."""
    parameters = [TORQUE, EPSILON, *(TORQUE._replace(key=key) for key in ("2", "3"))]
    least = dict(zip(parameters, [2.341, 0.012, None, 3.0], strict=True))
    asked: list[tuple[int, float]] = []

    def can_plan(parameter: Parameter, value: float) -> bool:
        index = parameters.index(parameter)
        asked.append((index, value))
        return index == 0 or (index == 1 and value < 0.012)

    found = find_changes(parameters, least.__getitem__, can_plan)
    assert found == [Change(TORQUE, 2.35), Change(EPSILON, 0.0119)]
    # The rest of what was asked goes outwards, and not far.
    assert [value for index, value in asked if index == 1] == [0.012, 0.0119]
    beyond = [value for index, value in asked if index == 3]
    assert beyond == sorted(set(beyond)) and 3.0 == beyond[0] and beyond[-1] <= 4.5
    assert not any(index == 2 for index, _ in asked)


@pytest.mark.parametrize("limit, least", [(TORQUE, 3.0), (EPSILON, 0.04)])
@pytest.mark.parametrize("needed", [0.0, 0.004, 0.013, 0.06, 0.1, 0.3, 0.49])
def test_more_than_the_least_is_found_closely(
    limit: Parameter, least: float, needed: float
) -> None:
    """Plans may need more than what limits at the nodes ask for."""
    border = least * (1 + limit.sign * needed)

    def can_plan(_: Parameter, value: float) -> bool:
        return limit.sign * (value - border) >= 0

    (change,) = find_changes([limit], lambda _: least, can_plan)
    assert -1e-12 < limit.sign * (change.value / border - 1) <= 0.03


def test_nothing_falls_below_zero() -> None:
    assert find_changes([EPSILON], lambda _: -0.01, lambda *_: True) == []
    assert find_changes([EPSILON], lambda _: 0.0, lambda *_: True) == [Change(EPSILON, 0.0)]


def test_changes_in_words() -> None:
    changes = [Change(TORQUE, 2.4), Change(EPSILON, 0.012)]
    assert describe_changes(changes) == (
        "feasible with torque limit of finger 2 = 2.4 N m instead of 2, "
        "or epsilon = 0.012 N instead of 0.05"
    )
    assert describe_changes([]) == "no single limit makes it feasible"


def test_shortfalls_are_ranked() -> None:
    late, early = LimitPlace(2, 0.1, "t = 0.1000 s, phase 2"), LimitPlace(1, 0.0, "t = 0.0000 s")
    limit = "torque limit of finger 1 = 2 N m"
    small = Shortfall("torque", "finger 1", limit, 0.4, "N m", late, 0.2)
    limit = "c_n of v3-finger1 >= epsilon = 0.05 N"
    large = Shortfall("press", "v3-finger1", limit, 0.81234, "N", early, 0.4)
    assert rank_shortfalls([small, large]) == [large, small]
    assert describe_shortfalls([large, small]) == (
        "c_n of v3-finger1 >= epsilon = 0.05 N is 0.812 N short at t = 0.0000 s; "
        "torque limit of finger 1 = 2 N m is 0.4 N m short at t = 0.1000 s, phase 2"
    )


@pytest.mark.parametrize("sign, farthest, edge", [(-1, 0.0, 0.2), (1, 2.0, 0.7)])
def test_bracket_comes_near_to_the_edge(sign: int, farthest: float, edge: float) -> None:
    limit = Parameter("friction of palm", 0.5, "", sign)
    value = bracket(limit, farthest, lambda value: sign * (value - edge) >= 0)
    assert value is not None and sign * (value - edge) >= 0
    assert abs(value - edge) <= abs(farthest - 0.5) / 30
    assert bracket(limit, farthest, lambda _: False) is None
    assert bracket(limit, 0.5, lambda _: True) is None
