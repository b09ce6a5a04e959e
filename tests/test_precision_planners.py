from __future__ import annotations

import argparse
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from timed import landing
from tipping import box
from wholearm.benchmark.precision.phases import (
    SOLVED,
    Instance,
    Median,
    keep_curves,
    list_instances,
)
from wholearm.benchmark.precision.planners import (
    LEAST_TIME,
    NO_DRAG,
    PLANNERS,
    find_least_time,
    is_installed,
    run_planner,
)
from wholearm.benchmark.precision.precision_study import (
    METHODS,
    STUDY,
    Medians,
    draw_medians,
    format_report,
)
from wholearm.benchmark.precision.simulators import check_plan
from wholearm.cli.command import main
from wholearm.problem.definition import End, Problem
from wholearm.results.torque import TorqueProfile

FILES = (str(Path(__file__).parents[1] / "problems" / "heptagon_four_contacts.toml"),)
LEAST = {LEAST_TIME: 0.0666298, NO_DRAG: 0.0663431}
"""Least times of the fourth phase, within 1e-5."""
TRIED = {
    "wholearm, curve": "1e-3",
    "wholearm, time": "8 x 3",
    "yapss": "20",
    "toppra": "100",
}


@lru_cache
def phase(number: int, drag: bool = True) -> Instance:
    return list_instances(FILES, drag)[number - 1]


@pytest.mark.parametrize("method", TRIED)
def test_every_planner_comes_near_the_least_time(method: str) -> None:
    if not is_installed(method):
        pytest.skip(f"{method}: pip install 'wholearm[bench]'")
    (study, *_) = PLANNERS[method].studies
    found = run_planner(study, phase(4).name, method, TRIED[method], FILES)
    error, end, violation = found.errors
    assert found.outcome == SOLVED and abs(error) < 2e-2
    assert end < 1e-2 and violation < 2.6e-2
    least = find_least_time(phase(4, study != NO_DRAG))
    assert least == pytest.approx(LEAST[study], rel=1e-5)


def test_reversals_of_our_plan_are_those_of_its_torques() -> None:
    plan = PLANNERS["wholearm, curve"].build(phase(3), "1e-3")()
    assert len(plan.marks) == 1 and plan.marks[0] in plan.torque.breaks
    # Where torques and directions step together nothing is lost in the replay.
    assert check_plan(phase(3), plan).violation < 1e-5


def test_what_a_replay_does_not_keep_is_no_solution() -> None:
    plan = PLANNERS["wholearm, curve"].build(phase(4), "1e-3")()
    good = check_plan(phase(4), plan)
    assert good.outcome == SOLVED and good.end < 1e-8
    weak = TorqueProfile(plan.torque.breaks, 0.98 * plan.torque.coefficients)
    late = check_plan(phase(4), plan._replace(torque=weak))
    assert late.end > 1e-3
    none = np.zeros_like(plan.torque.coefficients)
    lost = check_plan(phase(4), plan._replace(torque=TorqueProfile(plan.torque.breaks, none)))
    assert "contact is lost" in lost.outcome and lost.violation > 0.02
    assert check_plan(phase(4), plan._replace(status="stopped")).outcome == "stopped"


def list_methods(study: str, **given: object) -> set[str]:
    options = {"problems": str(Path(FILES[0]).parent), "part": None, "peers": METHODS, "limit": 1.0}
    cases = STUDY.list_cases(argparse.Namespace(**(options | given)))
    return {case[2] for case in cases if case[0] == study}


def test_peers_that_are_missing_have_no_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    missing = PLANNERS["toppra"]._replace(module="no_such_module")
    monkeypatch.setitem(PLANNERS, "toppra", missing)
    assert list_methods(NO_DRAG) == {"wholearm, curve"}
    assert list_methods(LEAST_TIME, part="simulation") == set()
    assert list_methods(LEAST_TIME, peers=["wholearm, time"]) == {"wholearm, time"}


def test_methods_that_nobody_knows_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bench", "precision", "--problems", str(Path(FILES[0]).parent), "-o", "out"]
    assert main([*command, "--peers", "fastest"]) == 2
    assert "--peers: 'fastest' given; allowed are wholearm;" in capsys.readouterr().err


def test_tables_and_figure_compare_what_there_is() -> None:
    ours, theirs = Median(0.0, 0.1, (1e-5, 0.0, 0.0)), Median(0.5, 1.5, (-5e-5, 1e-5, 0.0))
    medians: Medians = {
        (LEAST_TIME, "a", "wholearm, curve", "20"): ours,
        (LEAST_TIME, "b", "wholearm, curve", "20"): ours,
        (LEAST_TIME, "a", "yapss", "20"): theirs,
        (LEAST_TIME, "b", "yapss", "20"): theirs._replace(outcome="a contact is lost"),
    }
    text = format_report(medians, 2.0)
    assert "| yapss | 2.0000 | 1 of 2 | 20 | 2.0000 | 1 of 2 | 20 | 2.0000 | 1 of 2 | 20 |" in text
    assert "| yapss | 20 | 1 of 2 | 5.0e-05 |" in text
    (panel, *_) = draw_medians(medians).axes
    legend = panel.get_legend()
    assert legend is not None
    assert [label.get_text() for label in legend.get_texts()] == ["wholearm, curve", "yapss"]


def test_peers_get_the_phases_that_they_know(heptagon: Problem) -> None:
    every = keep_curves(heptagon)
    assert every is not None and len(every.phases) == 5
    # The landing joins its last curve smoothly, and a phase without an end is no curve.
    kept = keep_curves(landing())
    assert kept is not None
    for got, own in zip(kept.phases, landing().phases[:4], strict=True):
        assert got.formation is own.formation
    assert {own.end for own in kept.phases} == {End.REST}
    slide = keep_curves(box())
    assert slide is not None and len(slide.phases) == 1
    first = box().phases[1]
    assert keep_curves(replace(box(), phases=(first,))) is None
