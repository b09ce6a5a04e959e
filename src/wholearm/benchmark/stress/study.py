"""The stress study: generated scenes, changed problems and damaged files, counted by kind."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

from ... import __version__
from ...common.errors import InputError
from ...common.files import make_folder, write_text
from ...common.journal import Journal
from .files import run_file
from .plans import OBJECTIVES, run_scene
from .problems import compare_values, list_trials, run_trial
from .report import format_summary, stamp_machine
from .workers import Answer, run_tasks

SCENE_BOUND, FILE_BOUND, TRIAL_BOUND = 30.0, 20.0, 60.0
"""Processor time that a scene and an objective (two plans), a file and a trial may take [s]."""
_ENDINGS = {"raised": "traceback", "late": "hang", "died": "crash"}


@dataclass(frozen=True)
class StressOptions:
    """What to run.

    Attributes
    ----------
    scenes, files : int
        How many of each.
    problems : tuple of str
        Problem files for trials with noise and with other masses and forces.
    seed : int
    only : int, optional
        The one scene to run.
    jobs : int
        Worker processes.
    fresh : bool
        Begin anew, instead of going on with the records in the folder.
    again : bool
        Run again what had findings.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    scenes: int = 1000
    files: int = 0
    problems: tuple[str, ...] = ()
    seed: int = 0
    only: int | None = None
    jobs: int = 1
    fresh: bool = False
    again: bool = False

    def __post_init__(self) -> None:
        for key, least in (("scenes", 0), ("files", 0), ("seed", 0), ("only", 0), ("jobs", 1)):
            value = getattr(self, key)
            if value is not None and value < least:
                raise InputError("", f"--{key}", f"{value} given; allowed are {least} and more")


def run_stress(
    options: StressOptions, folder: str, progress: Callable[[str], None] | None = None
) -> tuple[str, str, int]:
    """Run the study, or what is left of it.

    Returns
    -------
    text : str
        The summary.
    path : str
        The file that it was written to.
    count : int
        How many findings there are.
    """
    make_folder(folder)
    stem = os.path.join(folder, "bench_stress")
    stamp = {"study": "stress", "seed": options.seed, "version": __version__}
    report = progress or (lambda _: None)
    scenes = _scenes(options)
    with Journal(f"{stem}.jsonl", stamp, options.fresh, options.again) as journal:
        _run_part(journal, "scene", run_scene, scenes, SCENE_BOUND, options, report, _find_scene)
        _run_part(journal, "file", run_file, _files(options), FILE_BOUND, options, report)
        trials = {tuple(trial): trial for trial in list_trials(list(options.problems))}
        _run_part(journal, "problem", run_trial, trials, TRIAL_BOUND, options, report)
    records = _select(journal.records, options)
    noise = compare_values([record for record in records if "problem" in record])
    text, count = format_summary(records, noise, {**stamp, **stamp_machine(options.jobs)})
    path = f"{stem}.md"
    write_text(path, text)
    return text, path, count


def run_only(options: StressOptions) -> list[dict[str, Any]]:
    """Run one scene in workers of its own and return its records."""
    assert options.only is not None
    tasks = [(options.seed, options.only, objective) for objective in OBJECTIVES]
    answers = run_tasks(run_scene, tasks, options.jobs, SCENE_BOUND, _find_scene)
    return [_record("scene", list(answer.task[1:]), answer) for answer in answers]


def _scenes(options: StressOptions) -> dict[Any, Any]:
    numbers = range(options.scenes)
    return {(k, goal): (options.seed, k, goal) for k in numbers for goal in OBJECTIVES}


def _find_scene(task: tuple[int, int, str]) -> int:
    """Number of a task's scene: a worker that goes on with it need not draw it again."""
    return task[1]


def _files(options: StressOptions) -> dict[Any, Any]:
    return {k: (options.seed, k) for k in range(options.files)}


def _run_part(
    journal: Journal,
    key: str,
    run: Callable[[Any], dict[str, Any]],
    tasks: dict[Any, Any],
    bound: float,
    options: StressOptions,
    report: Callable[[str], None],
    *kind: Callable[[Any], Any],
) -> None:
    """Run the tasks that have no record yet."""
    names = {task: name for name, task in tasks.items()}
    done = journal.done(key, lambda name: tuple(name) if isinstance(name, list) else name)
    left = [task for name, task in tasks.items() if name not in done]
    found = sum(len(record["findings"]) for record in journal.records if key in record)
    show = partial(_draw_bar, key, len(tasks), time.monotonic(), len(left))
    if left:
        report(show(0, found))
    for count, answer in enumerate(run_tasks(run, left, options.jobs, bound, *kind), start=1):
        record = _record(key, names[answer.task], answer)
        found += len(record["findings"])
        journal.add(record)
        report(show(count, found))


def _record(key: str, name: Any, answer: Answer) -> dict[str, Any]:
    """What is kept of an answer; what a task printed is a finding, as it is not meant to print."""
    record = answer.result if answer.ended == "done" else {key: name, "findings": []}
    findings = list(record["findings"])
    if answer.ended != "done":
        text = f"after {answer.seconds:.0f} s: {str(answer.result or '')[-1500:]}"
        findings.append([_ENDINGS[answer.ended], text])
    if answer.printed.strip():
        findings.append(["warning", f"printed: {answer.printed.strip()[:500]}"])
    return {
        **record,
        key: list(name) if isinstance(name, tuple) else name,
        "findings": findings,
        "elapsed": round(answer.seconds, 3),
    }


def _draw_bar(key: str, total: int, started: float, left: int, count: int, found: int) -> str:
    done = total - left + count
    filled = 20 * done // total
    text = (
        f"stress [{'#' * filled}{'.' * (20 - filled)}] {done} of {total} {key}s, {found} findings"
    )
    if count:
        ahead = (time.monotonic() - started) / count * (left - count)
        text += f", {ahead / 60:.0f} min left"
    return text


def _select(records: Iterable[dict[str, Any]], options: StressOptions) -> list[dict[str, Any]]:
    """Records of what was asked for; there may be those of a longer run too."""
    kept = []
    for record in records:
        scene = "scene" in record and record["scene"][0] < options.scenes
        file = "file" in record and record["file"] < options.files
        if scene or file or ("problem" in record and record["problem"][0] in options.problems):
            kept.append(record)
    return kept
