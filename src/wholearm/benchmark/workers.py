"""Tasks in worker processes, each bounded in time; a worker that hangs or dies is replaced."""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

MEMORY = 6 * 2**30
"""Address space that a worker may take [byte]: a claim beyond it fails instead of swapping."""


class Answer(NamedTuple):
    """What came of a task.

    Attributes
    ----------
    task : object
    ended : {"done", "raised", "late", "died"}
        Whether it returned, raised an exception, was stopped at its time bound or lost its process.
    result : object
        What was returned, or the traceback, or the signal or status that the process ended with.
    printed : str
        What it wrote to stdout and stderr, libraries included.
    seconds : float
        By the wall clock.
    """

    task: Any
    ended: str
    result: Any
    printed: str
    seconds: float


class _Worker:
    """A process that runs tasks one after the other."""

    def __init__(self, context: Any, run: Callable[[Any], Any]) -> None:
        self.pipe, far = context.Pipe()
        self.process = context.Process(target=_serve, args=(far, run), daemon=True)
        self.process.start()
        far.close()
        self.task: Any = None
        self.busy, self.started = False, 0.0

    def give(self, task: Any) -> None:
        self.task, self.busy, self.started = task, True, time.monotonic()
        self.pipe.send(task)

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def run_tasks(
    run: Callable[[Any], Any], tasks: Sequence[Any], jobs: int, bound: float
) -> Iterator[Answer]:
    """Run tasks in worker processes and give their answers as they come.

    Parameters
    ----------
    run : callable
        A function of a module: workers import it by name. Warnings are errors in there.
    tasks : sequence
        What `run` is called with; has to be picklable.
    jobs : int
        Number of workers.
    bound : float, [s]
        How long a task may take by the wall clock.
    """
    context = mp.get_context("spawn")
    waiting = list(reversed(tasks))
    workers: list[_Worker] = []
    try:
        for _ in range(min(jobs, len(tasks))):
            workers.append(_Worker(context, run))
            workers[-1].give(waiting.pop())
        while any(worker.busy for worker in workers):
            for k, worker in enumerate(workers):
                answer = _look(worker, bound) if worker.busy else None
                if answer is None:
                    continue
                if answer.ended in ("late", "died"):
                    worker.stop()
                    workers[k] = worker = _Worker(context, run)
                worker.busy = False
                if waiting:
                    worker.give(waiting.pop())
                yield answer
            wait([worker.pipe for worker in workers if worker.busy], timeout=0.2)
    finally:
        for worker in workers:
            worker.stop()


def _look(worker: _Worker, bound: float) -> Answer | None:
    """The answer of a worker, if it has one or can have none any more."""
    seconds = time.monotonic() - worker.started
    try:
        if worker.pipe.poll():
            return Answer(worker.task, *worker.pipe.recv(), seconds)
    except (EOFError, OSError):
        worker.process.join()
        return Answer(worker.task, "died", worker.process.exitcode, "", seconds)
    if seconds > bound:
        return Answer(worker.task, "late", None, "", seconds)
    return None


def _serve(pipe: Connection, run: Callable[[Any], Any]) -> None:
    """Run what comes through the pipe until it closes."""
    # The parent alone answers an interrupt, and takes its workers with it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _limit_memory()
    with tempfile.TemporaryFile() as printed:
        for stream in (1, 2):
            os.dup2(printed.fileno(), stream)
        warnings.simplefilter("error")
        while True:
            try:
                task = pipe.recv()
            except (EOFError, OSError):
                return
            try:
                outcome = "done", run(task)
            except Exception:
                outcome = "raised", traceback.format_exc()
            sys.stdout.flush()
            sys.stderr.flush()
            printed.seek(0)
            text = printed.read().decode(errors="replace")
            printed.seek(0)
            printed.truncate()
            try:
                pipe.send((*outcome, text))
            except (BrokenPipeError, OSError):
                return


def _limit_memory() -> None:
    try:
        import resource
    except ImportError:
        return
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    soft = MEMORY if hard == resource.RLIM_INFINITY else min(MEMORY, hard)
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
