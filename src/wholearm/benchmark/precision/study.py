"""``wholearm bench precision``: which runs are made, where they are kept, and what is missing."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from ...common.errors import InputError
from ...common.files import make_folder, require_writable, together, write_text
from ...common.journal import locked
from ...figures.plots import save
from ..stress.workers import Answer, run_tasks
from .figure import draw_runs
from .instances import Instance, find_files, list_instances
from .planning import (
    IMPLICIT,
    LEAST_TIME,
    NO_DRAG,
    PLANNERS,
    find_least_time,
    list_plan_tasks,
    run_planner,
)
from .report import format_report
from .runs import LIMIT, Key, Run, format_runs, read_runs
from .simulation import (
    DRIFT,
    FEW,
    MANY,
    SWING_TIME,
    list_tasks,
    make_course,
    make_swing,
    run_simulator,
)
from .simulators import SIMULATORS

METHODS = [*SIMULATORS, *PLANNERS]
"""Names of all methods, in the order of the tables."""

PARTS = ("simulation", "planning")
SWING_FILE = "heptagon_four_contacts.toml"
"""Problem file whose object swings."""
KEPT_EVERY = 5.0
"""Time after which runs are written to their file [s]."""


@dataclass(frozen=True)
class StudyOptions:
    """What is measured.

    Attributes
    ----------
    folder : str
        Of the problem files.
    parts : tuple of str
    methods : tuple of str
        Those that are measured; empty for all.
    limit : float, [s]
        Processor time that one setting of a method may take on one phase.
    fresh : bool
        Whether to measure again what the file of runs has.
    """

    folder: str = "problems"
    parts: tuple[str, ...] = PARTS
    methods: tuple[str, ...] = ()
    limit: float = LIMIT
    fresh: bool = False


def run_precision(
    options: StudyOptions, output: str, progress: Callable[[str], None] | None = None
) -> list[str]:
    """Measure what the file of runs does not have yet; returns the files written.

    Raises
    ------
    InputError
        If there is no problem file, a method is not known, or files cannot be written.
    """
    make_folder(output)
    paths = [os.path.join(output, f"bench_precision.{ending}") for ending in ("csv", "md", "png")]
    for path in paths:
        require_writable(path)
    _require_known(options)
    say = progress or (lambda _: None)
    files = find_files(options.folder)
    if not files:
        raise InputError("", "--problems", f"{options.folder} has no problem files (*.toml)")
    with locked(output):
        return _run(options, files, paths, say)


def _run(
    options: StudyOptions, files: tuple[str, ...], paths: list[str], say: Callable[[str], None]
) -> list[str]:
    """Measure what the file of runs, the first of `paths`, does not have yet."""
    runs = read_runs(paths[0])
    if options.fresh:
        runs = [run for run in runs if not _is_chosen(options, run.method)]
    done = {run.key for run in runs}
    kept = time.monotonic()
    for answer in _measure(options, files, done, say):
        runs += _read_answer(answer)
        say(f"{answer.task.study}: {answer.task.method}, {answer.task.instance}")
        if time.monotonic() > kept + KEPT_EVERY:
            write_text(paths[0], format_runs(runs))
            kept = time.monotonic()
    runs.sort(key=lambda run: (run.study, METHODS.index(run.method), run.instance))
    with together():
        write_text(paths[0], format_runs(runs))
        write_text(paths[1], format_report(runs, options.limit))
        save(draw_runs(runs), paths[2])
    return paths


def _require_known(options: StudyOptions) -> None:
    for method in options.methods:
        if method not in METHODS:
            allowed = "; ".join(METHODS)
            raise InputError("", "--peers", f"{method!r} given; allowed are {allowed}")


def _is_chosen(options: StudyOptions, method: str) -> bool:
    part = "simulation" if method in SIMULATORS else "planning"
    return part in options.parts and (not options.methods or method in options.methods)


def _measure(
    options: StudyOptions,
    files: tuple[str, ...],
    done: set[Key],
    say: Callable[[str], None],
) -> Iterator[Answer]:
    """Answers of all tasks that are chosen and not done."""
    say("tracing phases")
    instances = list_instances(files)
    if "simulation" in options.parts:
        yield from _simulate(options, instances, done, say)
    if "planning" in options.parts:
        for study in (LEAST_TIME, NO_DRAG, IMPLICIT):
            given = list_instances(files, study != NO_DRAG)
            yield from _plan(options, study, given, files, done, say)


def _simulate(
    options: StudyOptions,
    instances: Sequence[Instance],
    done: set[Key],
    say: Callable[[str], None],
) -> Iterator[Answer]:
    """Simulators on all courses; references are found where something is left to do."""
    makers: list[tuple[str, str, Callable[[], Any]]] = [
        (study, instance.name, partial(make_course, instance, study))
        for study in (FEW, MANY)
        for instance in instances
    ]
    swing = os.path.join(options.folder, SWING_FILE)
    if os.path.exists(swing):
        makers.insert(0, (DRIFT, f"swing of {SWING_TIME:g} s", partial(make_swing, swing)))
    for study, name, make in makers:
        tasks = [
            task
            for task in list_tasks(study, name)
            if _is_chosen(options, task.method) and task.key not in done
        ]
        if tasks:
            say(f"reference of {name}, {study}")
            course = make()
            if course is None:
                continue
            given = [task._replace(course=course) for task in tasks]
            yield from run_tasks(run_simulator, given, 1, options.limit, lambda _: 0)


def _plan(
    options: StudyOptions,
    study: str,
    instances: Sequence[Instance],
    files: tuple[str, ...],
    done: set[Key],
    say: Callable[[str], None],
) -> Iterator[Answer]:
    """Planners on all phases; least times are found where something is left to do."""
    given = []
    for instance in instances:
        tasks = [
            task
            for task in list_plan_tasks(study, instance, files)
            if _is_chosen(options, task.method) and task.key not in done
        ]
        if tasks:
            say(f"least time of {instance.name}, {study}")
            least = find_least_time(instance)
            given += [task._replace(least=least) for task in tasks]
    # One process for each method: what it imports is imported once.
    given.sort(key=lambda task: METHODS.index(task.method))
    yield from run_tasks(run_planner, given, 1, options.limit, lambda task: task.method)


def _read_answer(answer: Answer) -> list[Run]:
    """Runs of a task, or one that failed."""
    if answer.ended == "done":
        return list(answer.result)
    nothing = float("nan")
    reason = {"late": "time limit", "died": "process ended"}.get(answer.ended, "")
    reason = reason or str(answer.result).strip().splitlines()[-1]
    key: Key = answer.task.key
    return [Run(*key, 0, nothing, answer.seconds, nothing, nothing, nothing, reason)]
