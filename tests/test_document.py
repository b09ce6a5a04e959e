"""Results as data, and as text, HTML, Markdown and plain values that follow from that."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field, replace
from enum import Enum
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from shipped import HEPTAGON, IMPACTS, problem_of
from wholearm.common.arrays import Array
from wholearm.common.document import Document, Result, Table, fixed, plain, restore, show
from wholearm.common.errors import InputError
from wholearm.planning.options import PlanOptions
from wholearm.planning.plan import solve
from wholearm.planning.result import Plan, Status, describe_plan, load_plan, write_meta
from wholearm.problem.definition import Problem
from wholearm.solvers.ipopt import Solver, SolverStatistics, book, charge, open_ledger
from wholearm.verification.verify import verify


class Grade(Enum):
    GOOD = "good"


class Place(NamedTuple):
    x: float
    name: str = ""


class Visit(NamedTuple):
    number: int
    place: Place | None
    pair: tuple[float, float]
    time: float


@dataclass(frozen=True, eq=False, repr=False)
class Tour(Result):
    """A result of its own: all that it has is a document."""

    name: str
    visits: tuple[Visit, ...]
    samples: Array = field(repr=False)
    grade: Grade = Grade.GOOD

    derived = ("ok",)

    @property
    def ok(self) -> bool:
        return all(own.place is not None for own in self.visits)

    @property
    def document(self) -> Document:
        columns = {"number": "phase:d", "place.name": "place", "place.x": "x [mm]:.1f"}
        columns |= {"pair": "tau [N m]:.2f", "time": "t [s]:.3f"}
        table = Table.of(self.visits, columns, "visits")
        return self.judge(self.name, "a <reason>", ["a line", "", table, "the end"])


TOUR = Tour(
    "tour",
    (
        Visit(1, Place(0.0125, "edge & tip"), (1.0, -2.0), 0.5),
        Visit(20, None, (0.25, 0.125), math.nan),
    ),
    np.zeros(3),
)


def test_text_is_lines_and_aligned_tables() -> None:
    assert TOUR.to_text().splitlines() == [
        "tour: FAILED: a <reason>",
        "a line",
        "",
        "visits",
        "phase  place       x [mm]   tau [N m]  t [s]",
        "    1  edge & tip    12.5  1.00 -2.00  0.500",
        "   20  -                -   0.25 0.12      -",
        "",
        "the end",
    ]
    assert repr(TOUR) == "Tour(tour: FAILED: a <reason>)" and TOUR.exit_status == 1


def test_plain_values_are_json() -> None:
    values = TOUR.to_dict()
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert values["ok"] is False and values["grade"] == "good" and "samples" not in values
    assert values["visits"][0]["place"] == {"x": 0.0125, "name": "edge & tip"}
    assert values["visits"][1] == {"number": 20, "place": None, "pair": [0.25, 0.125], "time": None}


def test_what_is_made_plain_is_read_back() -> None:
    again = restore(tuple[Visit, ...], json.loads(json.dumps(plain(TOUR.visits))))
    assert again[0] == TOUR.visits[0] and again[1][:3] == TOUR.visits[1][:3]
    assert math.isnan(again[1].time)
    # What is missing is as by default; what is of another kind is an error.
    assert restore(Place | None, {"x": 1}) == Place(1.0)
    for kind, value in ((Place, {"x": "far"}), (Place, 3), (Place, {}), (tuple[Place, ...], 1)):
        with pytest.raises((TypeError, ValueError, AttributeError)):
            restore(kind, value)


def test_html_has_the_same_cells_and_names_escaped() -> None:
    cells, tags = list[str](), list[str]()

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attrs: object) -> None:
            tags.append(tag)

        def handle_data(self, data: str) -> None:
            cells.extend([data] if data.strip() else [])

    Reader().feed(TOUR._repr_html_())
    table = TOUR.document.parts[2]
    assert isinstance(table, Table)
    rows = [cell for row in (table.heads, *table.cells) for cell in row]
    assert cells == ["tour: FAILED: a <reason>", "a line", "visits", *rows, "the end"]
    assert tags.count("tr") == 3 and "reason" not in tags


def test_long_tables_are_cut_as_text_and_have_a_rule_as_markdown() -> None:
    table = Table(["n:d", "a:b:.1f", "word"], [(k, k / 2, "w") for k in range(5)], most=2)
    text = table.to_text().splitlines()
    assert text[0].split() == ["n", "a:b", "word"] and len(text) == 4
    assert text[-1] == "... and 3 more, see --json"
    lines = table.to_markdown().splitlines()
    assert lines[:3] == ["| n | a:b | word |", "| ---: | ---: | --- |", "| 0 | 0.0 | w |"]
    assert len(lines) == 2 + 5


def test_numbers_are_written_with_significant_digits() -> None:
    assert show(0.0123456, fixed(0.05)) == "0.0123" and show(-1e-9, fixed(0.05)) == "0.0000"
    assert show(None, ".1f") == show(math.nan, ".1f") == "-"
    assert show(0.25, ".0f", 100.0) == "25"


NOT_IN_0_1_0 = (
    "rolling", "modes", "sequences", "complete", "attempts", "transcription", "duration",
    "time_intervals", "degree", "scheme", "opening", "clearance", "samples", "mode_search",
    "build_times",
    "solve_times", "transitions", "replay", "certify", "certificate",
)  # fmt: skip


def two_phases(path: Path = HEPTAGON) -> Problem:
    """The first two phases of a problem, the last one ending at rest."""
    whole = problem_of(path)
    first, second = whole.phases[:2]
    return replace(whole, phases=(first, replace(second, end=whole.phases[-1].end)))


@pytest.fixture(scope="module")
def made() -> Plan:
    return solve(two_phases(), "effort", intervals=20, samples=21, time_weight=2.0)


@pytest.fixture(scope="module")
def within() -> Plan:
    """A plan in the time domain."""
    whole = two_phases()
    first = replace(whole, phases=whole.phases[:1])
    return solve(first, transcription="time", time_intervals=4, certify=True)


@pytest.fixture(scope="module")
def certified() -> Plan:
    return solve(two_phases(), intervals=20, samples=5, replay=False, certify=True)


def change_meta(plan: Plan, path: Path, changed: dict[str, Any], gone: tuple[str, ...] = ()) -> str:
    meta = {key: value for key, value in plan.meta.items() if key not in gone} | changed
    replace(plan.trajectory, meta=meta).save(path)
    return str(path)


@pytest.mark.parametrize("which", ["made", "within", "certified"])
def test_a_plan_comes_back_from_its_file(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    plan: Plan = request.getfixturevalue(which)
    plan.save(tmp_path / "a.npz")
    loaded = load_plan(tmp_path / "a.npz")
    for name in (
        "options",
        "status",
        "value",
        "phases",
        "transitions",
        "timings",
        "versions",
        "certificate",
    ):
        assert getattr(loaded, name) == getattr(plan, name), name
    assert loaded.replay == plan.replay
    assert loaded.meta == plan.meta == write_meta(loaded)
    assert loaded.problem.table == plan.problem.table
    np.testing.assert_array_equal(loaded.trajectory.tau, plan.trajectory.tau)


def test_a_plan_says_what_it_is(made: Plan) -> None:
    assert repr(made).startswith("Plan('heptagon") and "\n" not in repr(made)
    assert made.options == PlanOptions("effort", intervals=20, samples=21, time_weight=2.0)
    assert made.unit == "(N m)^2 s" and made.status is Status.SOLVED
    assert made.value == pytest.approx(sum(phase.value for phase in made.phases))
    assert made.duration == pytest.approx(sum(phase.duration for phase in made.phases))
    assert made.at(0.0).z[0] == pytest.approx(made.problem.start, abs=1e-9)
    report = verify(made.problem, made)
    assert report.ok and made.replay is not None
    arrivals = [phase.arrival for phase in made.replay.phases]
    assert arrivals == pytest.approx([phase.arrival for phase in report.phases])


def test_a_file_of_0_1_0_loads(made: Plan, tmp_path: Path) -> None:
    path = change_meta(made, tmp_path / "a.npz", {}, NOT_IN_0_1_0)
    loaded = load_plan(path)
    assert loaded.value == made.value and loaded.phases[0].duration == made.phases[0].duration
    assert loaded.options == replace(
        PlanOptions("effort"), intervals=20, time_weight=2.0, replay=False
    )
    assert loaded.replay is None and loaded.transitions == ()
    assert loaded.statistics.solves == made.statistics.solves


def test_a_certificate_has_every_phase_and_all_together(certified: Plan) -> None:
    certificate = certified.certificate
    assert certificate is not None and certificate.total is not None
    assert [part.phases for part in certificate.parts] == [(1,), (2,)]
    for part, phase in zip(certificate.parts, certified.phases, strict=True):
        assert part.bound is not None and part.error is not None and part.gap is not None
        assert part.duration == phase.duration and part.error < 1e-7 * part.bound
        # Twenty intervals are coarse. The bound is good to its error.
        assert -1e-7 < part.gap < 1e-2
    total = certificate.total
    assert total.phases == (1, 2) and total.duration == pytest.approx(certified.duration)
    assert total.bound == pytest.approx(sum(part.bound or 0 for part in certificate.parts))
    assert certified.meta["certificate"]["total"]["gap"] == total.gap
    text = describe_plan(certified, "a.npz").to_text()
    (table,) = (part for part in text.split("\n\n") if "lower bounds" in part)
    rows = [line.split() for line in table.splitlines()[1:]]
    assert [row[0] for row in rows] == ["1", "2", "all"]
    assert float(rows[2][2]) == pytest.approx(total.bound, abs=1e-8)


@pytest.mark.parametrize("error, said", [(1.4e-4, False), (1.6e-4, True), (2e-6, False)])
def test_an_accuracy_that_is_not_reached_is_said(certified: Plan, error: float, said: bool) -> None:
    """Where the error as it is printed, to one digit, is larger."""
    phases = tuple(own._replace(error=error) for own in certified.phases)
    options = dataclasses.replace(certified.options, accuracy=1e-4)
    plan = dataclasses.replace(certified, phases=phases, options=options)
    last = describe_plan(plan, "a.npz").to_text().splitlines()[-1]
    assert f"(to {error:.0e}" in last
    assert ("; accuracy 0.0001 not reached)" in last) == said


def test_what_is_planned_over_time_is_not_certified(within: Plan) -> None:
    certificate = within.certificate
    assert certificate is not None and certificate.total is None
    (part,) = certificate.parts
    assert part.bound is None and part.gap is None and part.phases == (1,)
    assert "  not certified: planned over time" in describe_plan(within, "a.npz").to_text()


@pytest.mark.parametrize(
    ("changed", "gone", "text"),
    [
        ({"status": "replayed"}, (), "'replayed' is not a valid Status"),
        ({"objective": "fast"}, (), "meta.objective: 'fast' given"),
        ({"phase_values": [1.0]}, (), "meta.phase_values: 1 values given, 2 needed"),
        ({"iterations": ["a", "b"]}, (), "does not describe a plan"),
        ({"transitions": [3]}, (), "does not describe a plan"),
        ({"replay": {}}, (), "does not describe a plan"),
        ({"certificate": {"parts": [3]}}, (), "does not describe a plan"),
        ({"timings": {"plan": "long"}}, (), "does not describe a plan"),
        ({}, ("value",), "does not describe a plan"),
        ({}, ("problem",), "does not hold its problem's tables"),
    ],
)
def test_what_is_no_plan_is_an_error(
    made: Plan, tmp_path: Path, changed: dict[str, Any], gone: tuple[str, ...], text: str
) -> None:
    path = change_meta(made, tmp_path / "a.npz", changed, gone)
    with pytest.raises(InputError, match=text) as caught:
        load_plan(path)
    assert str(caught.value).startswith(path)


@pytest.mark.parametrize(
    ("case", "options"), [("slides", {"objective": "margin"}), ("impacts", {"objective": "time"})]
)
def test_every_solve_is_counted_once(
    monkeypatch: pytest.MonkeyPatch, case: str, options: dict[str, Any]
) -> None:
    """Those of plans with stops, of least time, refined ones and what impacts save as well."""
    calls = []
    run = Solver.__call__

    def count(self: Solver, **arguments: Any) -> Any:
        result = run(self, **arguments)
        calls.append(self.stats()["iter_count"])
        return result

    monkeypatch.setattr(Solver, "__call__", count)
    problem = two_phases(IMPACTS if case == "impacts" else HEPTAGON)
    plan = solve(problem, intervals=20, samples=5, **options)
    assert plan.statistics.solves == len(calls) > len(problem.phases)
    assert plan.statistics.iterations == sum(calls)
    assert plan.timings.solve == pytest.approx(plan.statistics.solve_time)
    assert json.loads(json.dumps(plan.meta["solves"])) == [
        phase.statistics.solves for phase in plan.phases
    ]


def test_costs_are_booked_to_the_innermost_phase_and_every_ledger() -> None:
    cost = SolverStatistics(3, 1, 0.5, 0.25)
    book(cost)
    with open_ledger() as outer:
        book(cost)
        with charge(2), open_ledger() as inner:
            book(cost)
            with charge(5):
                book(cost)
    assert (outer.of(0), outer.of(2), outer.of(5)) == (cost, cost, cost)
    assert inner.of(0) == SolverStatistics() and inner.of(5) == cost
    assert cost + cost == SolverStatistics(6, 2, 1.0, 0.5)
