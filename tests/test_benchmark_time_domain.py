from __future__ import annotations

import re
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from thrown import shove
from timed import flip
from wholearm.benchmark import time_domain
from wholearm.benchmark.report import Row, format_markdown
from wholearm.benchmark.time_domain import measure_blocks, measure_order
from wholearm.planning.plan import solve

ORDERS = {("radau", 3): 5, ("legendre", 3): 6}


def test_collocation_converges_with_the_order_of_theory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_domain, "SCHEMES", tuple(ORDERS))
    monkeypatch.setattr(time_domain, "ORDER_INTERVALS", (8, 16, 32))
    rows = measure_order(flip())
    assert [row.study for row in rows] == 6 * ["time domain: order"]
    assert [row.method for row in rows] == 3 * ["radau 3"] + 3 * ["legendre 3"]
    assert [row.setting for row in rows] == 2 * ["8 intervals", "16 intervals", "32 intervals"]
    for own, theory in zip((rows[:3], rows[3:]), ORDERS.values(), strict=True):
        errors = [row.error or np.nan for row in own]
        observed = [float(np.log2(before / after)) for before, after in pairwise(errors)]
        assert min(observed) > theory - 0.6, observed
        assert errors[-1] < 1e-9
        notes = [f"order {order:.2f} observed, {theory} in theory" for order in observed]
        assert [row.note for row in own] == ["", *notes]


def test_replays_that_end_early_have_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors that are not known leave no order, neither theirs nor the next one's."""
    errors = iter([np.nan, 1e-3, 1e-4])
    monkeypatch.setattr(time_domain, "SCHEMES", (("radau", 2),))
    monkeypatch.setattr(time_domain, "ORDER_INTERVALS", (4, 8, 16))
    monkeypatch.setattr(time_domain, "find_end_error", lambda *_: next(errors))
    rows = measure_order(flip())
    assert [row.error for row in rows] == [None, 1e-3, 1e-4]
    assert [row.note for row in rows] == [
        "the replay ends early", "", "order 3.32 observed, 3 in theory"
    ]  # fmt: skip


def test_whole_plans_are_measured_where_phases_need_the_time_domain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(time_domain, "solve", partial(solve, time_intervals=4))
    assert measure_blocks(flip()) == []
    rows = measure_blocks(shove()[0])
    assert [row.method for row in rows] == ["time", "effort", "margin"]
    note = r"\d+ iterations in \d+ solves from phase 1; building is \d+% of planning"
    for row in rows:
        assert re.fullmatch(note, row.note), row.note
        # What is asked of a phase: 1e-5 [m, rad].
        assert row.error is not None and 0 < row.error < 1e-5


def test_each_study_has_its_table() -> None:
    rows = [
        Row(f"time domain: {study}", "a", "b", 0.1, error)
        for study, error in (("order", 1e-3), ("whole plans", None))
    ]
    text = format_markdown("heptagon", rows)
    assert "## Time domain: order" in text and "## Time domain: whole plans" in text
    assert "| a | b | 0.1000 | 1.00e-03 |  |" in text and "| a | b | 0.1000 |  |  |" in text
