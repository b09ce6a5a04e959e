"""Single runs of a study, how they are repeated, kept and summed up."""

from __future__ import annotations

import csv
import io
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeVar

from ...common.errors import InputError

REPEATS = 3
"""Largest number of runs that a median is of."""
BUDGET = 0.3
"""Time after which a run is not repeated any more [s]."""
LIMIT = 60.0
"""Processor time that one setting of a method may take on one phase [s]."""
SHIFT = 0.01
"""Shift of the geometric means [s]."""
SHORT = 0.05
"""Time up to which something is done several times over, in about this time [s]."""
MOST = 200
"""Largest number of times."""
SOLVED = "solved"

Key = tuple[str, str, str, str]
"""Study, instance, method and setting: what one median is of."""
_Answer = TypeVar("_Answer")


class Run(NamedTuple):
    """One run.

    Attributes
    ----------
    study, instance, method, setting : str
        What was measured, on which phase, with what.
    repeat : int
        Which of the runs of this setting, from 0.
    build, solve : float, [s]
        Time to build, and to simulate or solve.
    error : float
        Of the state, relative to the scene, or of the phase time, relative.
    end : float
        Error of the replayed end state of a plan, relative to the scene.
    violation : float
        Worst violation of a limit between nodes, over the scene's force and the torque limits.
    outcome : str
        `SOLVED`, or what failed.
    """

    study: str
    instance: str
    method: str
    setting: str
    repeat: int
    build: float
    solve: float
    error: float
    end: float = math.nan
    violation: float = math.nan
    outcome: str = SOLVED

    @property
    def key(self) -> Key:
        """What one median is of."""
        return self[:4]


class Median(NamedTuple):
    """The runs of one setting: medians of their times, and the worst of the rest."""

    build: float
    solve: float
    errors: tuple[float, ...]
    outcome: str

    def reaches(self, target: float, count: int | None = None) -> bool:
        """Whether it is solved and its errors, or the first few of them, are below a target."""
        return self.outcome == SOLVED and max(map(abs, self.errors[:count])) <= target


def repeat(build: Callable[[], Callable[[], _Answer]]) -> Iterator[tuple[float, float, _Answer]]:
    """Build and run until there is enough for a median: times of both, and what came of it."""
    began = time.process_time()
    for _ in range(REPEATS):
        built, run = _time(build)
        took, answer = _time(run)
        yield built, took, answer
        if time.process_time() - began > BUDGET:
            break


def _time(work: Callable[[], _Answer]) -> tuple[float, _Answer]:
    """Processor time that something takes [s], and its answer.

    Other work on the machine hardly changes it. What is too short for its clock is done several
    times over.
    """
    wall, processor = time.perf_counter(), time.process_time()
    answer = work()
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    if wall > SHORT:
        return processor, answer
    count = math.ceil(SHORT / max(wall, SHORT / MOST))
    processor = time.process_time()
    for _ in range(count):
        work()
    return (time.process_time() - processor) / count, answer


def find_medians(runs: Sequence[Run]) -> dict[Key, Median]:
    """Medians of every setting, by study, instance, method and setting."""
    grouped: dict[Key, list[Run]] = {}
    for run in runs:
        grouped.setdefault(run.key, []).append(run)
    return {key: _find_median(group) for key, group in grouped.items()}


def _find_median(runs: Sequence[Run]) -> Median:
    errors = tuple(
        max(column, key=abs)
        for column in zip(*((run.error, run.end, run.violation) for run in runs), strict=True)
        if not all(map(math.isnan, column))
    )
    failed = [run.outcome for run in runs if run.outcome != SOLVED]
    build = statistics.median(run.build for run in runs)
    solve = statistics.median(run.solve for run in runs)
    return Median(build, solve, errors or (math.inf,), failed[0] if failed else SOLVED)


def find_mean(seconds: Sequence[float]) -> float:
    """Shifted geometric mean [s]."""
    logs = [math.log(value + SHIFT) for value in seconds]
    return math.exp(math.fsum(logs) / len(logs)) - SHIFT


def format_runs(runs: Sequence[Run]) -> str:
    """Every run as CSV."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([Run._fields, *runs])
    return stream.getvalue()


def read_runs(path: str) -> list[Run]:
    """Runs of an earlier study, none without a file.

    Raises
    ------
    InputError
        If the file holds anything else.
    """
    if not os.path.exists(path):
        return []
    try:
        with open(path, newline="", encoding="utf-8") as stream:
            head, *rows = csv.reader(stream)
        if head != list(Run._fields):
            raise ValueError
        return [_read_run(*row) for row in rows]
    except (ValueError, TypeError, IndexError):
        text = "holds no runs of this study; move it away, or choose another folder with -o"
        raise InputError(path, "", text) from None


def _read_run(study: str, instance: str, method: str, setting: str, repeat: str, *rest: str) -> Run:
    build, solve, error, end, violation = map(float, rest[:5])
    key = study, instance, method, setting
    return Run(*key, int(repeat), build, solve, error, end, violation, rest[5])
