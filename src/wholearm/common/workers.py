"""Independent tasks in parallel, by forked processes.

Children are forked where tasks are shared out, so that they have all that is known by then. Each
process takes the next task for as long as there is one, and children send what has come of theirs.
What a task leaves behind besides its result is lost in a child: it has to be a pure function. What
a child does not send, as it was ended or met an error, its parent does itself.
"""

from __future__ import annotations

import ctypes
import gc
import io
import multiprocessing as mp
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, TypeVar

from .signals import WATCHER

_T = TypeVar("_T")
Task = Callable[[], _T]

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_sharing = False
_starting = threading.Lock()


def count_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def share(tasks: Sequence[Task[_T]], jobs: int, known: Sequence[object] = ()) -> list[_T]:
    """Results of tasks, in their order.

    Processes are forked on Linux alone, where libraries bear it, if this one may have children and
    no other thread could be in the middle of something. Otherwise, and for tasks inside of tasks,
    one is done after the other.

    Parameters
    ----------
    tasks  without arguments. What they return has to be picklable.
    jobs   most processes, this one included
    known  what results may refer to: they then have these very objects
    """
    global _sharing
    count = min(jobs, len(tasks)) - 1
    if count < 1 or _sharing or not can_fork():
        return [task() for task in tasks]
    _sharing = True
    try:
        return _share(tasks, count, {id(own): k for k, own in enumerate(known)}, known)
    finally:
        _sharing = False


def can_fork() -> bool:
    """Whether this process may have children that go on from where it is."""
    mine = (threading.current_thread().name, WATCHER)
    return (
        sys.platform == "linux"
        and not mp.current_process().daemon
        and all(thread.name in mine for thread in threading.enumerate())
    )


def _share(
    tasks: Sequence[Task[_T]], count: int, numbers: dict[int, int], known: Sequence[object]
) -> list[_T]:
    """Results of tasks, done by this process and `count` others."""
    source, sink = os.pipe()
    os.write(sink, b"".join(k.to_bytes(2, "big") for k in range(len(tasks))))
    os.close(sink)
    children = list[tuple[BaseProcess, Connection]]()
    try:
        for _ in range(count):
            children.append(_start(tasks, source, numbers))
        results = _take(tasks, source)
        for _, answers in children:
            # A child that was ended, or met an error, sends nothing.
            with suppress(EOFError, OSError):
                answer = io.BytesIO(answers.recv_bytes())
                results |= _Unpickler(answer, known).load()
        return [results[k] if k in results else task() for k, task in enumerate(tasks)]
    finally:
        os.close(source)
        for process, answers in children:
            process.kill()
            process.join()
            process.close()
            answers.close()


def _start(
    tasks: Sequence[Task[Any]], source: int, numbers: dict[int, int]
) -> tuple[BaseProcess, Connection]:
    """Fork a child that takes tasks, and sends its answers."""
    context = mp.get_context("fork")
    answers, far = context.Pipe(duplex=False)
    given = tasks, source, (answers, far), numbers, os.getpid()
    process = context.Process(target=_serve, args=given, daemon=True)
    try:
        # No signal may meet the child before it has said what it does about it.
        with _blocked(*_SIGNALS), warnings.catch_warnings():
            # Of other threads there is the one that waits for signals, and holds nothing.
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
    finally:
        far.close()
    return process, answers


@contextmanager
def _blocked(*numbers: signal.Signals) -> Iterator[None]:
    """Have signals wait, and for good in processes that are started meanwhile."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Spawned(SpawnProcess):
    """A process that a Ctrl-C in its terminal leaves to its parent, from the first moment on.

    The script that started this process is not imported in it, which would run it again.
    """

    def start(self) -> None:
        # The first process starts this one, too, which would unblock SIGINT.
        if sys.platform != "win32":
            resource_tracker.ensure_running()
        with _starting, _blocked(signal.SIGINT):
            main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
            try:
                super().start()
            finally:
                sys.modules["__main__"] = main


def end_with_parent(parent: int) -> None:
    """Have this process killed when its parent ends, however that comes about (on Linux).

    A signal may end the parent before it knows of a child that it has just started.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(1)


class Spawning(SpawnContext):
    """Starts processes anew, not forked, in which SIGINT is blocked."""

    Process = _Spawned


def _serve(
    tasks: Sequence[Task[Any]],
    source: int,
    ends: tuple[Connection, Connection],
    numbers: dict[int, int],
    parent: int,
) -> None:
    """Take tasks for as long as there are any, and send what has come of them."""
    # The parent alone answers an interrupt, and ends its children.
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    end_with_parent(parent)
    near, far = ends
    # Nobody would read what is sent if the parent were gone.
    near.close()
    # What there is by now is not looked at for garbage, which would copy its pages.
    gc.freeze()
    try:
        results = _take(tasks, source)
    except KeyboardInterrupt:
        return  # The time is over, as its parent finds out and says.
    with suppress(Exception):
        far.send_bytes(_pickle(results, numbers))


def _take(tasks: Sequence[Task[_T]], source: int) -> dict[int, _T]:
    """Results of tasks by their numbers, which whoever reads them has taken from a pipe.

    Tasks that raise an error have none: they are done again in the end, so that the first of them
    raises it, whoever has met it.
    """
    results = dict[int, _T]()
    while number := os.read(source, 2):
        index = int.from_bytes(number, "big")
        with suppress(Exception):
            results[index] = tasks[index]()
    return results


class _Pickler(pickle.Pickler):
    """Pickles with numbers in place of objects that both sides know."""

    def __init__(self, stream: io.BytesIO, numbers: dict[int, int]) -> None:
        super().__init__(stream, pickle.HIGHEST_PROTOCOL)
        self._numbers = numbers

    def persistent_id(self, obj: object) -> int | None:
        return self._numbers.get(id(obj))


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: io.BytesIO, known: Sequence[object]) -> None:
        super().__init__(stream)
        self._known = known

    def persistent_load(self, pid: int) -> object:
        return self._known[pid]


def _pickle(value: object, numbers: dict[int, int]) -> bytes:
    stream = io.BytesIO()
    deepest = sys.getrecursionlimit()
    sys.setrecursionlimit(max(deepest, 20_000))
    try:
        _Pickler(stream, numbers).dump(value)
    finally:
        sys.setrecursionlimit(deepest)
    return stream.getvalue()
