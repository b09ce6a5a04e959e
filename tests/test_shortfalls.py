"""What errors of infeasible problems know beside their text, and early refusals."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from refused import ask_shoved
from shipped import HEPTAGON, problem_of
from wholearm.benchmark.stress import refusals
from wholearm.benchmark.stress.refusals import judge
from wholearm.common.errors import InfeasibleError, InputError, JammingError
from wholearm.figures import plots
from wholearm.mechanics.limits import EPSILON
from wholearm.planning.plan import solve
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem, read_problem
from wholearm.results.trajectory_file import load_trajectory


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
    table = dict(read_problem(str(HEPTAGON)).table)
    contacts = ["v0-palm", "v2-finger1", "v5-finger2"]
    problem = build_problem(
        {**table, "phases": [{"contacts": contacts, "until": {"phi_deg": 9.5}}]}
    ).with_(changes)
    stop = (float(problem.start[0]) + x, float(problem.start[2]) + 0.2)
    verdict = judge(problem, InfeasibleError("phase 1 is infeasible"), [stop])
    assert verdict.kind == kind


def test_a_leg_into_the_palm_has_no_end(heptagon: Problem) -> None:
    table = dict(read_problem(str(HEPTAGON)).table)
    contacts = ["v0-palm", "v2-finger1", "v5-finger2"]
    problem = build_problem(
        {**table, "phases": [{"contacts": contacts, "until": {"phi_deg": -13.0}}]}
    )
    stop = (float(problem.start[0]) + 0.01, float(problem.start[2]) - 0.2)
    verdict = judge(problem, InfeasibleError("phase 1 is infeasible"), [stop])
    assert verdict.kind == "open" and "no place of its end" in verdict.reason
