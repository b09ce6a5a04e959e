"""What errors of infeasible problems know beside their text, advice, and early refusals."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from refused import ask_shoved
from shipped import HEPTAGON, problem_of, tipping
from wholearm import Problem, load_trajectory, plots
from wholearm.benchmark.stress import refusals
from wholearm.benchmark.stress.refusals import judge
from wholearm.common.errors import (
    Change,
    InfeasibleError,
    InputError,
    JammingError,
    LimitPlace,
    Parameter,
    Shortfall,
)
from wholearm.mechanics.limits import EPSILON
from wholearm.planning.advice import (
    bracket,
    describe_changes,
    describe_shortfalls,
    find_changes,
    rank_shortfalls,
    round_outwards,
)
from wholearm.planning.plan import solve
from wholearm.problem.read import build_problem, read_problem


def refuse(problem: Problem, **options: Any) -> InfeasibleError:
    with pytest.raises(InfeasibleError) as caught:
        solve(problem, **options)
    return caught.value


def pressing(epsilon: float) -> Problem:
    whole = problem_of(HEPTAGON)
    return replace(whole, phases=whole.phases[:1]).with_(epsilon=epsilon)


@pytest.fixture(scope="module")
def along() -> InfeasibleError:
    return refuse(pressing(6.0), intervals=20)


@pytest.fixture(scope="module")
def within() -> InfeasibleError:
    """In the time domain, from where a motion may begin."""
    return ask_shoved(EPSILON, 1.0)


@pytest.mark.parametrize("which", ["along", "within"])
def test_data_say_what_the_text_says(which: str, request: pytest.FixtureRequest) -> None:
    error: InfeasibleError = request.getfixturevalue(which)
    assert error.shortfalls
    shares = [short.share for short in error.shortfalls]
    assert shares == sorted(shares, reverse=True)
    for short in error.shortfalls:
        assert str(short) in str(error) or f"{short.amount:.3g} {short.unit} short" in str(error)
        assert short.kind in ("press", "cone", "torque", "speed")
        assert short.part in short.limit and short.place.phase >= 1
    for change in error.changes:
        assert str(change) in str(error)


def test_a_change_can_be_made(along: InfeasibleError) -> None:
    """By the keys that `with_` takes."""
    assert along.changes
    for change in along.changes:
        own = change.parameter
        assert (
            solve(pressing(6.0).with_({own.key: change.value}), intervals=20, replay=False).value
            > 0
        )
        assert (change.value > own.value) == (own.sign > 0)


def test_the_motion_that_misses_least_is_there(along: InfeasibleError, tmp_path: Path) -> None:
    motion = along.motion
    # What it is short of most is short by that much in its samples.
    worst = max((s for s in along.shortfalls if s.kind == "press"), key=lambda s: s.amount)
    column = motion.contacts.index(worst.part)
    assert 6.0 - motion.c_n[:, column].min() == pytest.approx(worst.amount, rel=2e-2)
    at = motion.at(worst.place.time).c_n[0, column]
    assert 6.0 - at == pytest.approx(worst.amount, rel=1e-3)
    motion.save(tmp_path / "a.npz")
    figure = plots.force_margins(load_trajectory(tmp_path / "a.npz"))
    texts = [" ".join(text.get_text().split()) for text in figure.texts]
    assert any("misses limits least" in text for text in texts)


def test_errors_pickle_with_their_data(along: InfeasibleError) -> None:
    again = pickle.loads(pickle.dumps(along))
    assert str(again) == str(along) and again.changes == along.changes
    assert again.shortfalls == along.shortfalls
    np.testing.assert_array_equal(again.motion.c_n, along.motion.c_n)


def test_a_duration_that_is_too_short_is_a_change() -> None:
    error = refuse(pressing(0.05), objective="margin", duration=0.05, intervals=20)
    (change,) = error.changes
    assert change.parameter.key == "duration" and change.parameter.value == 0.05
    solve(pressing(0.05), "margin", duration=change.value, intervals=20)


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit that is short is so at more than one of sixty places."""
    monkeypatch.setattr(refusals, "PLACES", 8)


WEAK = {f"fingers.{k}.torque_limit": 0.01 for k in (1, 2)}


@pytest.fixture
def slide(heptagon: Problem) -> Problem:
    """The first phase alone."""
    return replace(heptagon, phases=heptagon.phases[:1])


def test_a_hand_that_is_too_weak_is_confirmed(slide: Problem) -> None:
    weak = slide.with_(WEAK)
    verdict = judge(weak, InfeasibleError("phase 1 is infeasible"), [])
    assert verdict.kind == "confirmed" and "no motion keeps all limits" in verdict.reason


def test_a_refusal_of_what_a_slow_motion_does_is_refuted(slide: Problem) -> None:
    verdict = judge(slide, InfeasibleError("phase 1 is infeasible"), [])
    assert verdict.kind == "refuted" and "slow motion" in verdict.reason


def test_jamming_is_confirmed_by_the_determinant(slide: Problem) -> None:
    rough = slide.with_({f"friction.{part}": 2.5 for part in ("palm", "finger1", "finger2")})
    verdict = judge(rough, JammingError("phase 1 jams at x = ..."), [])
    assert verdict.kind == "confirmed" and "inertia ratio -" in verdict.reason


@pytest.mark.parametrize(("until", "kind"), [("v4-palm", "confirmed"), ("v3-finger1", "refuted")])
def test_the_event_that_ends_a_curve(until: str, kind: str) -> None:
    table = dict(read_problem(str(HEPTAGON)).table)
    phases = [{**table["phases"][0], "until": until}]
    problem = build_problem({**table, "phases": phases})
    verdict = judge(problem, InputError("", "phases[1].until", "is never reached"), [])
    assert verdict.kind == kind


@pytest.mark.parametrize(
    ("x", "changes", "kind"),
    [(-0.01, {}, "refuted"), (0.0, {}, "refuted"), (-0.01, WEAK | {"epsilon": 1.0}, "confirmed")],
)
def test_a_leg_through_a_cell(x: float, changes: dict[str, float], kind: str) -> None:
    """The object tips over its left vertex while it slides by `x`."""
    problem = tipping().with_(changes)
    stop = (float(problem.start[0]) + x, float(problem.start[2]) + 0.2)
    verdict = judge(problem, InfeasibleError("phase 1 is infeasible"), [stop])
    assert verdict.kind == kind


def test_a_leg_into_the_palm_has_no_end() -> None:
    problem = tipping(-13.0)
    stop = (float(problem.start[0]) + 0.01, float(problem.start[2]) - 0.2)
    verdict = judge(problem, InfeasibleError("phase 1 is infeasible"), [stop])
    assert verdict.kind == "open" and "no place of its end" in verdict.reason


TORQUE = Parameter("torque limit of finger 2", 2.0, "N m", 1)
PRESSING = Parameter("epsilon", 0.05, "N", -1)


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
    parameters = [TORQUE, PRESSING, *(TORQUE._replace(key=key) for key in ("2", "3"))]
    least = dict(zip(parameters, [2.341, 0.012, None, 3.0], strict=True))
    asked: list[tuple[int, float]] = []

    def can_plan(parameter: Parameter, value: float) -> bool:
        index = parameters.index(parameter)
        asked.append((index, value))
        return index == 0 or (index == 1 and value < 0.012)

    found = find_changes(parameters, least.__getitem__, can_plan)
    assert found == [Change(TORQUE, 2.35), Change(PRESSING, 0.0119)]
    # The rest of what was asked goes outwards, and not far.
    assert [value for index, value in asked if index == 1] == [0.012, 0.0119]
    beyond = [value for index, value in asked if index == 3]
    assert beyond == sorted(set(beyond)) and 3.0 == beyond[0] and beyond[-1] <= 4.5
    assert not any(index == 2 for index, _ in asked)


@pytest.mark.parametrize("limit, least", [(TORQUE, 3.0), (PRESSING, 0.04)])
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
    assert find_changes([PRESSING], lambda _: -0.01, lambda *_: True) == []
    assert find_changes([PRESSING], lambda _: 0.0, lambda *_: True) == [Change(PRESSING, 0.0)]


def test_changes_in_words() -> None:
    changes = [Change(TORQUE, 2.4), Change(PRESSING, 0.012)]
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
