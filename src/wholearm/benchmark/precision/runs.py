"""One setting of one method on one phase: how it is repeated and timed, and what its median is."""

from __future__ import annotations

import math
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

REPEATS = 3  # largest number of runs that a median is of
BUDGET = 0.3  # time after which a run is not repeated any more [s]
SHIFT = 0.01  # shift of the geometric means [s]
SHORT = 0.05  # time up to which something is done several times over, in about this time [s]
MOST = 200  # largest number of times
SOLVED = "solved"

_Answer = TypeVar("_Answer")


class Median(NamedTuple):
    """The runs of one setting: medians of their times [s], and the worst of the rest."""

    build: float  # build, solve [s]: time to build, and to simulate or solve
    solve: float
    # of the state, relative to the scene; of plans those of the phase time, of the replayed end
    # state, and the worst violation of a limit between nodes
    errors: tuple[float, ...]
    outcome: str = SOLVED  # `SOLVED`, or what failed

    def reaches(self, target: float, count: int | None = None) -> bool:
        """Whether it is solved and its errors, or the first few of them, are below a target."""
        return self.outcome == SOLVED and max(map(abs, self.errors[:count])) <= target


def measure(
    build: Callable[[], Callable[[], _Answer]],
    judge: Callable[[_Answer], tuple[tuple[float, ...], str]],
) -> Median:
    """Build and run as often as the time allows; `judge` gives the errors and the outcome."""
    builds, solves, errors, outcomes = [], [], [], []
    with warnings.catch_warnings():
        # Other people's libraries warn of their own affairs.
        warnings.simplefilter("ignore")
        began = time.process_time()
        for _ in range(REPEATS):
            built, run = _time(build)
            took, answer = _time(run)
            builds.append(built)
            solves.append(took)
            enough = time.process_time() - began > BUDGET
            found, outcome = judge(answer)
            errors.append(found)
            outcomes.append(outcome)
            if enough:
                break
    worst = tuple(max(column, key=abs) for column in zip(*errors, strict=True))
    failed = [outcome for outcome in outcomes if outcome != SOLVED]
    outcome = failed[0] if failed else SOLVED
    return Median(statistics.median(builds), statistics.median(solves), worst, outcome)


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


def find_mean(seconds: Sequence[float]) -> float:
    """Shifted geometric mean [s]."""
    logs = [math.log(value + SHIFT) for value in seconds]
    return math.exp(math.fsum(logs) / len(logs)) - SHIFT
