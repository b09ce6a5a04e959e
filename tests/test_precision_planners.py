from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from wholearm.benchmark.precision.check import check_plan
from wholearm.benchmark.precision.figure import draw_runs
from wholearm.benchmark.precision.implicit import STARTS
from wholearm.benchmark.precision.instances import Instance, find_files, list_instances
from wholearm.benchmark.precision.planning import (
    IMPLICIT,
    IMPLICIT_PHASE,
    LEAST_TIME,
    NO_DRAG,
    PLANNERS,
    PlanTask,
    is_installed,
    list_plan_tasks,
    run_planner,
)
from wholearm.benchmark.precision.report import INSTALL, format_report
from wholearm.benchmark.precision.runs import SOLVED, Run
from wholearm.benchmark.precision.study import StudyOptions, run_precision
from wholearm.common.errors import InputError
from wholearm.results.torque import TorqueProfile

FILES = (str(Path(__file__).parents[1] / "problems" / "heptagon_four_contacts.toml"),)
LEAST = {LEAST_TIME: 0.0666298, NO_DRAG: 0.0663431}
"""Least times of the fourth phase, within 1e-5."""
TRIED = {
    "wholearm, curve": "1e-3",
    "wholearm, time": "8 x 3",
    "Opti, tuned": "20",
    "rockit": "10",
    "yapss": "20",
    "toppra": "100",
}


@lru_cache
def phase(number: int, drag: bool = True) -> Instance:
    return list_instances(FILES, drag)[number - 1]


@pytest.mark.parametrize("method", TRIED)
def test_every_planner_comes_near_the_least_time(method: str) -> None:
    if not is_installed(method):
        pytest.skip(f"{method}: {INSTALL}")
    (study, *_) = PLANNERS[method].studies
    task = PlanTask(study, phase(4).name, method, TRIED[method], FILES, LEAST[study])
    (run, *_) = run_planner(task)
    assert run.outcome == SOLVED and abs(run.error) < 2e-2
    assert run.end < 1e-2 and run.violation < 2.6e-2


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


def test_random_starts_are_made_on_a_phase_that_there_is() -> None:
    instances = list_instances(find_files(str(Path(FILES[0]).parent)))
    tasks = [task for one in instances for task in list_plan_tasks(IMPLICIT, one, FILES)]
    assert len(tasks) == STARTS and {task.instance for task in tasks} == {IMPLICIT_PHASE}


def test_peers_that_are_missing_have_no_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    missing = PLANNERS["toppra"]._replace(module="no_such_module")
    monkeypatch.setitem(PLANNERS, "toppra", missing)
    methods = {task.method for task in list_plan_tasks(NO_DRAG, phase(4), FILES)}
    assert methods == {"wholearm, curve"}


def test_tables_and_figure_compare_what_there_is() -> None:
    ours = Run(LEAST_TIME, "a", "wholearm, curve", "20", 0, 0.0, 0.1, 1e-5, 0.0, 0.0)
    theirs = ours._replace(method="Opti", build=0.5, solve=1.5, error=-5e-5, end=1e-5)
    lost = theirs._replace(instance="b", outcome="a contact is lost between nodes")
    runs = [ours, ours._replace(instance="b"), theirs, lost]
    text = format_report(runs, 2.0)
    assert "| Opti | 2.0000 | 1 of 2 | 20 | 2.0000 | 1 of 2 | 20 | 2.0000 | 1 of 2 | 20 |" in text
    assert "| Opti | 20 | 1 of 2 | 5.0e-05 |" in text
    (panel, *_) = draw_runs(runs).axes
    legend = panel.get_legend()
    assert legend is not None
    assert [label.get_text() for label in legend.get_texts()] == ["wholearm, curve", "Opti"]


def test_methods_that_nobody_knows_are_named(tmp_path: Path) -> None:
    options = StudyOptions(methods=("fastest",))
    with pytest.raises(InputError, match="'fastest' given; allowed are wholearm;"):
        run_precision(options, str(tmp_path))
