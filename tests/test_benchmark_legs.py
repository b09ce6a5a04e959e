from __future__ import annotations

import numpy as np

from shipped import HEPTAGON
from wholearm.benchmark.legs import (
    KINDS,
    Leg,
    Outcome,
    Task,
    draw_leg,
    name_argument,
    run_leg,
    run_legs,
    summarise,
)
from wholearm.problem.read import build_problem, read_problem

PROBLEMS = HEPTAGON.parent


def test_legs_slide_and_pass_through_cells_from_rest_to_rest() -> None:
    leg, again = (draw_leg(0, 2, PROBLEMS) for _ in range(2))
    assert leg is not None and again is not None and leg.stops == again.stops
    phases = leg.problem.phases
    assert len(phases) == len(leg.stops)
    assert {len(phase.formation.contacts) for phase in phases} == {3, 4}
    start, (x, phi) = leg.problem.start, leg.stops[-1]
    assert phi < start[2] and np.isfinite(x)


def test_a_slide_is_planned() -> None:
    table = dict(read_problem(str(HEPTAGON)).table)
    contacts = table["phases"][0]["contacts"]
    x = float(build_problem(table).start[0]) - 0.01
    problem = build_problem({**table, "phases": [{"contacts": contacts, "until": {"x": x}}]})
    outcome = run_leg(Leg("heptagon", problem, [(x, float(problem.start[2]))]), "time")
    assert outcome.kind == "planned", outcome.text


def test_what_kind_of_argument_refuses() -> None:
    assert name_argument("from rest at its start, no motion begins") == "rest at the start"
    assert name_argument("at its end, no motion comes to rest") == "rest at the end"
    assert name_argument("c_n of v1-palm is 0.3 N short at t = 0") == "least shortfalls"


def test_legs_are_run_in_worker_processes() -> None:
    lines: list[str] = []
    (outcome,) = run_legs([Task(0, 0, "time", PROBLEMS)], 1, lines.append)
    assert outcome.kind in KINDS and outcome.kind != "traceback", outcome.text
    assert len(lines) == 1 and lines[0].startswith("0 time heptagon ")


def test_the_table_counts_every_kind() -> None:
    outcomes = [Outcome("planned", "", "", 1.0), Outcome("refused, open", "other", "", 9.0)]
    text = summarise(outcomes)
    assert all(kind in text for kind in KINDS)
    assert "other 1" in text and "1 over 5 s" in text
