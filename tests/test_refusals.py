from __future__ import annotations

from dataclasses import replace

import pytest

from shipped import HEPTAGON
from wholearm.benchmark.stress import refusals
from wholearm.benchmark.stress.refusals import judge
from wholearm.common.errors import InfeasibleError, InputError, JammingError
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem, read_problem


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
