from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable

import pytest

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
def test_tasks_inside_tasks_are_not_shared() -> None:
    meet = Meeting()
    for own, *inner in share([lambda: (meet(), *share([os.getpid] * 2, 2))] * 2, 2):
        assert inner == [own, own]


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
