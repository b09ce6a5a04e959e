from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from wholearm.common.crowd import Processes, run_all
from wholearm.common.workers import can_fork, count_cores, share

PARENT = os.getpid()
needs_fork = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux")


class Meeting:
    """Tasks of two processes that wait for each other, so that each does one of them."""

    def __init__(self, act: Callable[[], object] = object) -> None:
        self.barrier = multiprocessing.get_context("fork").Barrier(2)
        self.act, self.met = act, False

    def __call__(self) -> int:
        if not self.met:
            self.met = True
            self.barrier.wait(30)
        self.act()
        return os.getpid()


def in_child(act: Callable[[], object]) -> Callable[[], object]:
    return lambda: act() if os.getpid() != PARENT else None


def stop() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fail() -> None:
    raise ValueError("only here")


@needs_fork
def test_tasks_are_done_by_two_processes_at_the_same_time() -> None:
    assert can_fork() and count_cores() >= 1
    one, other = share([Meeting()] * 2, 2)
    assert PARENT in (one, other) and one != other
    assert not multiprocessing.active_children()


@needs_fork
def test_results_are_in_order_and_have_what_is_known() -> None:
    known, meet = object(), Meeting()

    def task(k: int) -> Callable[[], object]:
        return lambda: (meet() and k, known)

    assert share([task(k) for k in range(1, 5)], 2, [known]) == [(k, known) for k in range(1, 5)]


@needs_fork
@pytest.mark.parametrize("act", [stop, fail])
def test_what_a_child_does_not_finish_is_done_here(act: Callable[[], object]) -> None:
    assert share([Meeting(in_child(act))] * 2, 2) == [PARENT, PARENT]


@needs_fork
def test_the_first_error_is_raised_whoever_meets_it() -> None:
    meet = Meeting()

    def task(text: str) -> Callable[[], object]:
        def act() -> object:
            meet()
            raise ValueError(text)

        return act

    with pytest.raises(ValueError, match="one"):
        share([task("one"), task("two")], 2)


@needs_fork
def test_an_interrupt_ends_children() -> None:
    def interrupt() -> None:
        if os.getpid() == PARENT:
            raise KeyboardInterrupt
        signal.pause()

    with pytest.raises(KeyboardInterrupt):
        share([Meeting(interrupt)] * 2, 2)
    assert not multiprocessing.active_children()


@needs_fork
def test_other_threads_keep_it_in_one_process() -> None:
    over = threading.Event()
    thread = threading.Thread(target=over.wait)
    thread.start()
    try:
        found = share([os.getpid] * 2, 2)
    finally:
        over.set()
        thread.join()
    assert found == [PARENT, PARENT]


def square(number: int) -> int:
    if number == 13:
        raise ValueError("thirteen")
    return number**2


def test_every_task_is_answered_once() -> None:
    answers = list(run_all(square, range(200), ThreadPoolExecutor(3)))
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

    answers = run_all(square, draw(1000), ThreadPoolExecutor(1), ahead=4)
    for _ in range(5):
        next(answers)
    assert len(given) <= 5 + 4


def die_once(path: str) -> str:
    """Die of the first task at a path."""
    if not os.path.exists(path):
        open(path, "x").close()
        stop()
    return path


def test_a_process_that_is_killed_loses_and_doubles_no_task(tmp_path: Path) -> None:
    paths = [str(tmp_path / f"{k}") for k in range(4)]
    assert sorted(run_all(die_once, paths, Processes(2))) == [(path, path) for path in paths]
    assert not multiprocessing.active_children()
