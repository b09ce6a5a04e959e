from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from wholearm.common.crowd import DiedError, run_all


def square(number: int) -> int:
    if number == 13:
        raise ValueError("thirteen")
    return number**2


def die_of(task: tuple[str, int]) -> int:
    """Ends its process: of -1 always, of multiples of 40 the first time."""
    folder, number = task
    if number == -1:
        os._exit(3)
    marker = Path(folder) / str(number)
    if number % 40 == 0 and not marker.exists():
        marker.touch()
        os._exit(3)
    return number**2


def test_every_task_is_answered_once() -> None:
    answers = list(run_all(square, range(200), partial(ThreadPoolExecutor, 3)))
    assert sorted(task for task, _ in answers) == list(range(200))
    for task, answer in answers:
        if task == 13:
            assert isinstance(answer, ValueError)
        else:
            assert answer == task**2


def test_tasks_are_given_a_few_at_a_time() -> None:
    given: list[int] = []

    def draw(count: int) -> Any:
        for number in range(count):
            given.append(number)
            yield number

    answers = run_all(square, draw(1000), partial(ThreadPoolExecutor, 1), ahead=4)
    for _ in range(5):
        next(answers)
    assert len(given) <= 5 + 4


class Breaking(Executor):
    """Runs tasks at once, and breaks with every one that is deadly, as a pool of processes does."""

    def __init__(self, deadly: Callable[[int], bool]) -> None:
        self.deadly, self.broken = deadly, False
        self.waiting: list[tuple[Future[Any], Any, int]] = []

    def submit(self, fn: Any, task: Any, /) -> Future[Any]:  # type: ignore[override]
        if self.broken:
            raise BrokenProcessPool
        future: Future[Any] = Future()
        if self.deadly(task):
            self.broken = True
            future.set_exception(BrokenProcessPool())
        else:
            future.set_result(fn(task))
        return future


@pytest.mark.parametrize("ahead", [1, 7])
def test_what_workers_die_of_is_found(ahead: int) -> None:
    """Of 20 always, of 5 once; the others are answered, once each."""
    often = {5: 1}

    def deadly(task: int) -> bool:
        often[task] = often.get(task, 0) - 1
        return task == 20 or often[task] >= 0

    answers = list(run_all(abs, range(30), lambda: Breaking(deadly), ahead))
    assert sorted(task for task, _ in answers) == list(range(30))
    died = [task for task, answer in answers if isinstance(answer, DiedError)]
    assert died == [20]


def test_processes_that_die_are_replaced(tmp_path: Path) -> None:
    numbers = [*range(60), -1]
    pool = partial(ProcessPoolExecutor, 2, get_context("forkserver"))
    answers = dict(run_all(die_of, [(str(tmp_path), number) for number in numbers], pool))
    died = [number for (_, number), answer in answers.items() if isinstance(answer, DiedError)]
    assert died == [-1] and len(answers) == 61
    assert all(answers[str(tmp_path), number] == number**2 for number in range(60))
