from __future__ import annotations

import argparse

import numpy as np
import pytest

from shipped import HEPTAGON
from wholearm.benchmark.growth import SIZES, STUDY, WORK, fit_exponent, run_work
from wholearm.benchmark.study import Row
from wholearm.problem.read import read_problem
from wholearm.solvers.ipopt import record_runs

KEYS = ("grows", "work", "size")


def make_rows() -> list[Row]:
    """Times that grow with the square of sizes, and memory in proportion to them."""
    return [
        {"grows": grows, "work": work, "size": k, "seconds": 1e-3 * k**2, "memory": 0.1 * k}
        for grows, sizes in SIZES.items()
        for work in WORK[grows]
        for k in sizes
    ]


def test_exponents_are_those_of_powers_where_small_sizes_cost_the_same() -> None:
    sizes = [10, 20, 40, 80, 160, 320]
    for power in (0.5, 1.0, 2.0):
        costs = np.maximum(np.power(sizes, power), np.power(80.0, power)).tolist()
        assert fit_exponent(sizes, costs) == pytest.approx(power)


def test_the_table_has_every_measurement_and_exponent() -> None:
    text = STUDY.report(make_rows(), argparse.Namespace())[0]
    rows = iter(line for line in text.splitlines() if " [s] | " in line)
    for grows, sizes in SIZES.items():
        assert f"## {grows.capitalize()}" in text
        for work in WORK[grows]:
            row = next(rows)
            assert row.startswith(f"| {work} [s] | ") and row.endswith(" 2.00 |")
            assert row.count("|") == len(sizes) + 3
    assert text.count("[MB]") == text.count(" 1.00 |") == sum(map(len, WORK.values()))


def test_work_is_as_large_as_is_asked() -> None:
    table = dict(read_problem(str(HEPTAGON)).table)
    # Five nodes for each element of four intervals, of which there are more than switches.
    for size, nodes in ((40, 50), (80, 100)):
        with record_runs() as runs:
            run_work(table, "intervals", "least time", size)
        assert runs[0].unknowns == 3 * nodes - 2
    with record_runs() as runs:
        run_work(table, "intervals", "margin", 40)
    assert max(run.unknowns for run in runs) > 3 * 50 - 2
    for size in (5, 6):
        run_work(table, "vertices", "reading", size)


def test_what_is_drawn_and_listed_is_what_is_run() -> None:
    options = argparse.Namespace(problem=str(HEPTAGON))
    cases = list(STUDY.list_cases(options))
    assert [case[1:] for case in cases] == [tuple(map(row.get, KEYS)) for row in make_rows()]
    assert STUDY.alone and STUDY.columns == (*KEYS, "seconds", "memory")
