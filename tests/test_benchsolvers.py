from __future__ import annotations

from dataclasses import replace

import pytest

from wholearm.benchmark.benchreport import format_markdown
from wholearm.benchmark.benchsolvers import measure_solvers
from wholearm.path import trace_phases
from wholearm.problem import Problem


@pytest.fixture(scope="module")
def last_but_one(heptagon: Problem) -> Problem:
    """Phase 4 of the heptagon alone."""
    start = trace_phases(heptagon)[3].start
    return replace(heptagon, start=start, phases=(replace(heptagon.phases[3], index=0),))


def test_both_solvers_are_measured(last_but_one: Problem) -> None:
    rows = measure_solvers(last_but_one)
    assert [(row.method, row.setting) for row in rows] == [
        ("Ipopt", "phase 1, time"),
        ("fatrop", "phase 1, time"),
        ("Ipopt", "phase 1, effort"),
        ("fatrop", "phase 1, effort"),
    ]
    assert all(row.seconds > 0 for row in rows)
    ipopt, fatrop, *effort = rows
    assert ipopt.error is None and fatrop.error is not None and abs(fatrop.error) < 1e-6
    assert ("faster" in ipopt.note) + ("faster" in fatrop.note) == 1
    assert (fatrop.seconds < ipopt.seconds) == ("faster" in fatrop.note)
    # Least effort of this phase is beyond fatrop's numerics.
    assert effort[1].error is None and effort[1].note.startswith("does not converge: ")
    assert "faster" not in effort[0].note + effort[1].note
    assert "## Solvers" in format_markdown("heptagon", rows)
