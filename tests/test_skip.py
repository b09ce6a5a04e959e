from __future__ import annotations

import argparse

import pytest

from shipped import FOLDER
from wholearm.benchmark.skip import STUDY, SkipPair, list_pairs, spend
from wholearm.benchmark.study import Row

INTERVALS, TIME_INTERVALS, POINTS, CONTACTS = 12, 4, 3, 4
ABSENT = ("friction of joints", "speed limits that never bind")
"""Parts that are coefficients and bounds, where they are."""


@pytest.fixture(scope="module")
def pairs() -> dict[str, SkipPair]:
    every = list_pairs(
        str(FOLDER), intervals=INTERVALS, time_intervals=TIME_INTERVALS, mode_search=False
    )
    return {pair.part: pair for pair in every}


def assert_bare(cost: Row, contacts: int, rolling: int) -> None:
    """Along a curve from rest to rest nothing but what each node needs.

    Unknowns are speed, acceleration and squeeze, but for the speed at both ends, where it is 0.
    Rows are how the speed goes on, and at each node contact forces, both sides of the cones of
    rolling contacts, and torques.
    """
    nodes, rest = divmod(cost["unknowns"] + 2, 3)
    # Five nodes for each element of four intervals, of which switches may ask for more.
    assert rest == nodes % 5 == 0 and nodes >= 5 * INTERVALS // 4
    assert cost["rows"] == nodes - 1 + (contacts + 2 * rolling + 2) * nodes


@pytest.mark.parametrize("part", ["friction of contacts", *ABSENT])
def test_friction_and_limits_are_free_along_curves(pairs: dict[str, SkipPair], part: str) -> None:
    pair = pairs[f"{part}, along curves"]
    for case in (pair.without, pair.having):
        assert_bare(spend(case), CONTACTS, 0)


def test_over_time_friction_adds_a_sense_for_each_contact_and_point(
    pairs: dict[str, SkipPair],
) -> None:
    own = [pairs[f"{part}, over time"] for part in ("friction of contacts", *ABSENT)]
    full, smooth, free, limited = (
        spend(case) for case in (own[0].having, own[0].without, own[1].without, own[2].having)
    )
    # What else there is, are coefficients and bounds.
    assert {own["unknowns"] for own in (full, free, limited)} == {smooth["unknowns"]}
    assert {own["rows"] for own in (full, free, limited)} == {full["rows"]}
    intervals, rest = divmod(full["rows"] - smooth["rows"], CONTACTS * POINTS)
    # Where a direction turns, a stage ends and an interval is divided.
    assert TIME_INTERVALS <= intervals < 2 * TIME_INTERVALS and rest == 0


def test_a_rolling_contact_has_two_rows_more_than_a_sliding_one_along_a_curve(
    pairs: dict[str, SkipPair],
) -> None:
    tip = pairs["a second freedom"].without
    (phase,) = tip.problem.phases
    assert (phase.formation.n_contacts, phase.formation.n_rolling) == (3, 1)
    assert_bare(spend(tip), 3, 1)


def test_the_table_has_a_row_for_each_part(pairs: dict[str, SkipPair]) -> None:
    pair = pairs["a figure"]
    rows = [
        {"case": ["anywhere", pair.part, having, 0], **spend(plan)}
        for having, plan in ((False, pair.without), (True, pair.having))
    ]
    *_, row = STUDY.report(rows, argparse.Namespace())[0].splitlines()
    name, *cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert name == "a figure" and len(cells) == 8
    assert cells[0] == cells[1] and cells[2] == cells[3]
    # Drawing costs, and nothing of it is run where no figure is wanted.
    assert int(cells[5]) > int(cells[4])
