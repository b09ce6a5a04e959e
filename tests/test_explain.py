"""Why problems have no plan: shortfalls, advice, and second opinions."""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from refused import advising, ask_shoved
from rows import each
from scenes import PENTAGON, box, shove
from shipped import FOLDER, HEPTAGON, problem_of, tipping
from toys import plan_path
from wholearm import PlanOptions, Problem, load_trajectory, plots
from wholearm.benchmark import refusals
from wholearm.benchmark.refusals import judge
from wholearm.common import errors
from wholearm.geometry.curve import Curve
from wholearm.mechanics.limits import EPSILON
from wholearm.planning import explain
from wholearm.planning import explain as explanation
from wholearm.planning.explain import change_limit, explain_stages, find_changes, list_beyond
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.plan import solve
from wholearm.planning.time_domain.guesses import Guesses
from wholearm.planning.time_domain.solution import TimeSearch
from wholearm.planning.time_domain.time_motion import TimeMotion
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.problem.read import build_problem, read_problem

TORQUE = "fingers.1.torque_limit"
COARSE = PlanOptions(time_intervals=4)
LEAST = 0.35 * 0.2 * 9.81
"""Least c_n of the shoved square [N]: friction shifts 0.15 of its weight to the vertex ahead."""


def plan_all(problem: Problem, **options: Any) -> list[PhasePlan[TimeMotion]]:
    return plan_phases(problem, problem.phases, problem.start, COARSE, **options)


def why_not(plan: Callable[[], object]) -> str:
    with pytest.raises(errors.InfeasibleError) as caught:
        plan()
    return str(caught.value)


def search(problem: Problem) -> TimeSearch:
    return TimeSearch(problem, COARSE)


def test_an_object_on_the_palm_alone_stays_at_rest() -> None:
    table = dict(read_problem(str(FOLDER / "square.toml")).table)
    phase = {"contacts": ["v0-palm", "v1-palm"], "until": {"x": table["start"]["x"] - 0.01}}
    text = why_not(partial(plan_all, build_problem({**table, "phases": [phase]})))
    assert text.startswith("phase 1 is infeasible: no finger drives the object on v0-palm v1-palm")


TURNED = np.array([0.10451807, 0.05929573, -1.03431931, 0.53647701, 0.53647701])
"""Start of the last phase, at whose end no contact forces balance the weight."""


@pytest.mark.parametrize("rate", [500.0, 1e4])
def test_torques_that_may_not_step_have_to_hold_the_end(tmp_path: Path, rate: float) -> None:
    (tmp_path / "pent.toml").write_text(PENTAGON)
    problem = read_problem(str(tmp_path / "pent.toml"))
    last = problem.phases[-1:]
    alone = replace(search(problem), phases=last)
    stages = Guesses(alone, TURNED).nearest.stages
    explain.refuse(alone, stages, None)
    slow = problem.with_(torque_rate_limit=rate)
    message = why_not(
        lambda: explain.require_hold_at_ends(replace(search(slow), phases=slow.phases[-1:]), stages)
    )
    # With the contact that is gained there the object can be held, but not while it slows down.
    assert "none that bring it to rest at its end, x = 88.04 mm" in message
    assert "hold the object there on v1-palm v2-finger1 v0-finger2 v3-finger1; end it" in message
    assert "elsewhere (they can for x of 69.5 to 81." in message


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Advice takes the time that it needs, however slow the machine is."""
    monkeypatch.setattr(explanation, "ADVICE", np.inf)


def test_a_force_that_weight_limits_has_its_closed_form() -> None:
    text = str(ask_shoved(EPSILON, 1.0))
    found = re.fullmatch(
        r"phases 1 and 2 are infeasible: c_n of v1-palm >= epsilon = 1 N is (\S+) N short at "
        r"t = \S+ s, phase 2; feasible with epsilon = (\S+) N instead of 1",
        text,
    )
    assert found, text
    # Pushed hard enough it begins; what it weighs there is all that presses while it slows down.
    assert float(found[1]) == pytest.approx(1 - LEAST, rel=1e-3)
    # Advice is meant to be within 2 % of what is needed.
    assert 0.98 * LEAST < float(found[2]) < LEAST


def test_there_is_a_plan_with_what_is_advised_and_none_with_less() -> None:
    problem, text = shove()[0], str(ask_shoved(TORQUE, 0.3))
    wanted = r"; feasible with torque limit of finger 1 = (\S+) N m instead of 0.3$"
    advised = re.search(wanted, text)
    assert advised, text
    enough = float(advised[1])
    assert enough > 0.3
    elastic = change_limit(problem, TORQUE, enough)
    for plan in plan_all(elastic, thorough=False):
        t = np.linspace(0.0, plan.motion.duration, 101)
        samples = plan.motion.evaluate(t)
        assert samples.c_n.min() > elastic.epsilon - 1e-6
        assert (np.abs(samples.tau) < elastic.scene.torque_limit + 1e-6).all()
    # Advice is meant to be within 2 % of what is needed.
    closer = change_limit(problem, TORQUE, 0.97 * enough)
    short = why_not(lambda: plan_all(closer, thorough=False))
    assert " short at t = " in short and "feasible with" not in short


def test_advice_is_that_along_the_curve(heptagon: Problem, curves: tuple[Curve, ...]) -> None:
    """Two formulations with different unknowns, one of them convex but for viscous friction."""
    problem, phase = change_limit(heptagon, EPSILON, 1.0), heptagon.phases[1]
    start = curves[0].end
    options, coarse = PlanOptions(time_intervals=4), PlanOptions(intervals=20)
    with advising(lambda own: own.key == EPSILON):
        texts = [
            why_not(lambda: plan_phases(problem, (problem.phases[1],), start, options)),
            why_not(lambda: plan_path(curves[1], problem.epsilon, coarse, phase.number)),
        ]
    shape = r"phase 2 is infeasible: .*c_n of v1-palm >= epsilon = 1 N is \S+ N short at "
    assert all(re.match(shape, text) for text in texts), texts
    within, along = (float(text.split("epsilon = ")[-1].split()[0]) for text in texts)
    assert within == pytest.approx(along, rel=0.02)


def test_failures_that_no_limit_explains_are_the_solvers() -> None:
    problem, _ = shove()
    place = errors.LimitPlace(1, 0.1, "t = 0.1 s, phase 1")
    missed = [errors.Shortfall("press", "v1-palm", "c_n", 2.0, "N", place, k) for k in (0.1, 0.2)]
    failed = explain_stages(search(problem), [], None, missed)
    assert isinstance(failed, errors.SolverError)
    assert "; where it stopped, c_n is 2 N short at t = 0.1 s, phase 1; try" in str(failed)
    text = str(failed)
    assert text.startswith("no plan for phases 1 and 2 (") and "found neither a plan nor" in text
    assert all(name in text for name in problem.phases[0].formation.names)
    assert text.endswith("intervals per phase (--time-intervals)") and "\n" not in text
    slide, own = box(), replace(COARSE, transcription="time")
    failed = explain_stages(TimeSearch(slide, own, slide.phases[:1]), [], None)
    assert "leave out --transcription time" in str(failed)


def ask_plan(problem: Problem, **options: Any) -> errors.InfeasibleError:
    with pytest.raises(errors.InfeasibleError) as caught:
        solve(problem, **options)
    return caught.value


def pressing(epsilon: float) -> Problem:
    whole = problem_of(HEPTAGON)
    return replace(whole, phases=whole.phases[:1]).with_(epsilon=epsilon)


@pytest.fixture(scope="module")
def along() -> errors.InfeasibleError:
    return ask_plan(pressing(6.0), intervals=20)


@pytest.fixture(scope="module")
def within() -> errors.InfeasibleError:
    """In the time domain, from where a motion may begin."""
    return ask_shoved(EPSILON, 1.0)


@pytest.mark.parametrize("which", ["along", "within"])
def test_data_say_what_the_text_says(which: str, request: pytest.FixtureRequest) -> None:
    error: errors.InfeasibleError = request.getfixturevalue(which)
    assert error.shortfalls
    shares = [short.share for short in error.shortfalls]
    assert shares == sorted(shares, reverse=True)
    for short in error.shortfalls:
        assert str(short) in str(error) or f"{short.amount:.3g} {short.unit} short" in str(error)
        assert short.kind in ("press", "cone", "torque", "speed")
        assert short.part in short.limit and short.place.phase >= 1
    for change in error.changes:
        assert str(change) in str(error)


def test_a_change_can_be_made() -> None:
    """By the keys that `with_` takes, and within ranges."""
    changes = ask_plan(pressing(6.0), intervals=20, robust=1.0).changes
    assert changes
    for own, value in changes:
        changed = pressing(6.0).with_({own.key: value})
        assert solve(changed, intervals=20, robust=1.0, replay=False).value > 0
        assert (value > own.value) == (own.sign > 0)


def test_the_motion_missing_least_is_there(along: errors.InfeasibleError, tmp_path: Path) -> None:
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


def test_errors_pickle_with_their_data(along: errors.InfeasibleError) -> None:
    again = pickle.loads(pickle.dumps(along))
    assert str(again) == str(along) and again.changes == along.changes
    assert again.shortfalls == along.shortfalls
    np.testing.assert_array_equal(again.motion.c_n, along.motion.c_n)


def test_a_duration_that_is_too_short_is_a_change() -> None:
    error = ask_plan(pressing(0.05), objective="margin", duration=0.05, intervals=20)
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
    verdict = judge(weak, errors.InfeasibleError("phase 1 is infeasible"), [])
    assert verdict.kind == "confirmed" and "no motion keeps all limits" in verdict.reason


def test_a_refusal_of_what_a_slow_motion_does_is_refuted(slide: Problem) -> None:
    verdict = judge(slide, errors.InfeasibleError("phase 1 is infeasible"), [])
    assert verdict.kind == "refuted" and "slow motion" in verdict.reason


def test_jamming_is_confirmed_by_the_determinant(slide: Problem) -> None:
    rough = slide.with_({f"friction.{part}": 2.5 for part in ("palm", "finger1", "finger2")})
    verdict = judge(rough, errors.JammingError("phase 1 jams at x = ..."), [])
    assert verdict.kind == "confirmed" and "uniqueness -" in verdict.reason


@pytest.mark.parametrize(("until", "kind"), [("v4-palm", "confirmed"), ("v3-finger1", "refuted")])
def test_the_event_that_ends_a_curve(until: str, kind: str) -> None:
    table = dict(read_problem(str(HEPTAGON)).table)
    phases = [{**table["phases"][0], "until": until}]
    problem = build_problem({**table, "phases": phases})
    verdict = judge(problem, errors.InputError("", "phases[1].until", "is never reached"), [])
    assert verdict.kind == kind


@pytest.mark.parametrize(
    ("x", "changes", "kind"),
    [(-0.01, {}, "refuted"), (-0.01, WEAK | {"epsilon": 1.0}, "confirmed")],
)
def test_a_leg_through_a_cell(x: float, changes: dict[str, float], kind: str) -> None:
    """The object tips over its left vertex while it slides by `x`."""
    problem = tipping().with_(changes)
    stop = (float(problem.start[0]) + x, float(problem.start[2]) + 0.2)
    verdict = judge(problem, errors.InfeasibleError("phase 1 is infeasible"), [stop])
    assert verdict.kind == kind


def test_a_leg_into_the_palm_has_no_end() -> None:
    problem = tipping(-13.0)
    stop = (float(problem.start[0]) + 0.01, float(problem.start[2]) - 0.2)
    verdict = judge(problem, errors.InfeasibleError("phase 1 is infeasible"), [stop])
    assert verdict.kind == "open" and "no place of its end" in verdict.reason


STRONGEST = errors.Parameter("torque limit of finger 2", 2.0, "N m", 1)
PRESSING = errors.Parameter("epsilon", 0.05, "N", -1)


def test_only_confirmed_changes_are_found() -> None:
    """One works at its rounded value, one needs some room, one cannot, one is never enough."""
    parameters = [STRONGEST, PRESSING, *(STRONGEST._replace(key=key) for key in ("2", "3"))]
    least = dict(zip(parameters, [2.341, 0.012, math.nan, 3.0], strict=True))

    def can_plan(parameter: errors.Parameter, value: float) -> bool:
        return parameter == STRONGEST or (parameter == PRESSING and value < 0.012)

    def list_values(parameter: errors.Parameter) -> list[float]:
        return [] if math.isnan(least[parameter]) else list_beyond(parameter, least[parameter])

    changes = find_changes(parameters, list_values, can_plan)
    assert changes == [errors.Change(STRONGEST, 2.35), errors.Change(PRESSING, 0.0119)]
    assert find_changes([PRESSING], lambda _: [math.nan, -0.01], lambda *_: True) == []


@each("limit, values", [(STRONGEST, [3.0]), (PRESSING, [0.04]), (STRONGEST, []), (PRESSING, [])])
@each("needed", [0.0, 0.013, 0.1, 0.49])
def test_more_than_the_least_is_found_closely(
    limit: errors.Parameter, values: list[float], needed: float
) -> None:
    """Plans may need more than what limits at the nodes ask for, or nothing is known of them."""
    least = values[0] if values else limit.value
    border = least * (1 + limit.sign * needed)
    tried = list_beyond(limit, least) if values else [limit.value, least * (1 + limit.sign * 0.9)]

    def can_plan(_: errors.Parameter, value: float) -> bool:
        return limit.sign * (value - border) >= 0

    (change,) = find_changes([limit], lambda _: tried, can_plan)
    assert -1e-12 < limit.sign * (change.value / border - 1) <= 0.03
