"""A result says what it is as data; text, HTML, Markdown and plain values follow from that."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from enum import Enum
from html.parser import HTMLParser
from typing import NamedTuple

import numpy as np
import pytest

from wholearm.common.arrays import Array
from wholearm.common.document import Document, Result, Table, fixed, show
from wholearm.common.plain import plain, restore


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
