"""Tasks in worker processes, each bounded in time; a worker that hangs or dies is replaced."""

from __future__ import annotations

import math
import os
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple

from ..common.workers import Spawning

MEMORY = 6 * 2**30
"""Address space that a worker may take [byte]: a claim beyond it fails instead of swapping."""

PATIENCE = 20.0
"""Wall-clock time that a task may take over its bound of processor time: others may run too."""
_CPU = getattr(signal, "SIGPROF", 27)  # signal that ends a process whose processor time is used up

Limit = Callable[[Any], float]
"""Processor time that a task may take [s]."""


class CaseAnswer(NamedTuple):
    """What came of a task."""

    task: Any
    # {"done", "raised", "late", "died"}: whether it returned, raised an exception, was stopped at
    # its time bound or lost its process
    ended: str
    # what was returned, or the traceback, or the signal or status that the process ended with
    result: Any
    printed: str  # what it wrote to stdout and stderr, libraries included
    elapsed: float  # elapsed, seconds: by the wall clock, and processor time of the worker
    seconds: float = math.nan
    memory: float = math.nan  # [MB]: by which the task has raised the worker's peak of memory


class _Worker:
    """A process that runs tasks one after the other."""

    def __init__(self, context: Any, run: Callable[[Any], Any], limit: Limit, strict: bool) -> None:
        self.pipe, far = context.Pipe()
        self.process = context.Process(target=_serve, args=(far, run, limit, strict), daemon=True)
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


class _Queue:
    """Tasks that wait: a worker takes those that are alike, before it begins with others."""

    def __init__(self, tasks: Sequence[Any], kind: Callable[[Any], Any]) -> None:
        self.bundles: dict[Any, list[Any]] = {}
        for task in tasks:
            self.bundles.setdefault(kind(task), []).append(task)
        self.kind = kind
        self.begun: set[Any] = set()

    def __bool__(self) -> bool:
        return bool(self.bundles)

    def take(self, before: Any = None) -> Any:
        """The next task of a worker that has done another, or none, before."""
        own = None if before is None else self.kind(before)
        new = (kind for kind in self.bundles if kind not in self.begun)
        kind = own if own in self.bundles else next(new, next(iter(self.bundles)))
        self.begun.add(kind)
        task = self.bundles[kind].pop(0)
        if not self.bundles[kind]:
            del self.bundles[kind]
        return task


def run_tasks(
    run: Callable[[Any], Any],
    tasks: Sequence[Any],
    jobs: int,
    limit: Limit,
    kind: Callable[[Any], Any] = lambda task: task,
    strict: bool = True,
    alone: bool = False,
) -> Iterator[CaseAnswer]:
    """Run tasks in worker processes and give their answers as they come.

    Parameters
    ----------
    run     a function of a module: workers import it by name
    tasks   what `run` is called with; has to be picklable
    jobs    number of workers
    limit   processor time that a task may take [s]. By the wall clock it may take `PATIENCE` times
            that.
    kind    of a task: one worker runs those of one kind, as far as others have something else to do
    strict  whether warnings are errors in there
    alone   whether each task has a process of its own, where nothing is kept from others
    """
    context = Spawning()
    waiting = _Queue(tasks, kind)
    workers: list[_Worker] = []
    try:
        for _ in range(min(jobs, len(tasks))):
            workers.append(_Worker(context, run, limit, strict))
            workers[-1].give(waiting.take())
        while any(worker.busy for worker in workers):
            for k, worker in enumerate(workers):
                answer = _look(worker, limit(worker.task)) if worker.busy else None
                if answer is None:
                    continue
                if alone or answer.ended in ("late", "died"):
                    worker.stop()
                    workers[k] = worker = _Worker(context, run, limit, strict)
                worker.busy = False
                if waiting:
                    worker.give(waiting.take(answer.task))
                yield answer
            wait([worker.pipe for worker in workers if worker.busy], timeout=0.2)
    finally:
        for worker in workers:
            worker.stop()


def _look(worker: _Worker, bound: float) -> CaseAnswer | None:
    """The answer of a worker, if it has one or can have none any more."""
    seconds = time.monotonic() - worker.started
    try:
        if worker.pipe.poll():
            ended, result, printed, *spent = worker.pipe.recv()
            return CaseAnswer(worker.task, ended, result, printed, seconds, *spent)
    except (EOFError, OSError):
        worker.process.join()
        code = worker.process.exitcode
        return CaseAnswer(worker.task, "late" if code == -_CPU else "died", code, "", seconds)
    if seconds > PATIENCE * bound:
        return CaseAnswer(worker.task, "late", None, "", seconds)
    return None


def _serve(pipe: Connection, run: Callable[[Any], Any], limit: Limit, strict: bool) -> None:
    """Run what comes through the pipe until it closes."""
    _limit_memory()
    with tempfile.TemporaryFile() as printed:
        for stream in (1, 2):
            os.dup2(printed.fileno(), stream)
        if strict:
            warnings.simplefilter("error")
        while True:
            try:
                task = pipe.recv()
            except (EOFError, OSError):
                return
            if hasattr(signal, "setitimer"):
                # A limit of the whole process would drift; this one idles between tasks.
                signal.setitimer(signal.ITIMER_PROF, limit(task))
            before, begun = find_peak(), time.process_time()
            try:
                outcome = "done", run(task)
            except Exception:
                outcome = "raised", traceback.format_exc()
            spent = time.process_time() - begun, find_peak() - before
            sys.stdout.flush()
            sys.stderr.flush()
            printed.seek(0)
            text = printed.read().decode(errors="replace")
            printed.seek(0)
            printed.truncate()
            try:
                pipe.send((*outcome, text, *spent))
            except (BrokenPipeError, OSError):
                return


def find_peak() -> float:
    """Peak of the memory that this process has had in use [MB]."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        import resource

        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
    # Where there is `/proc`, the other figure starts from that of the parent.
    (peak,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return int(peak) * 1024 / 1e6


def _limit_memory() -> None:
    try:
        import resource
    except ImportError:
        return
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    soft = MEMORY if hard == resource.RLIM_INFINITY else min(MEMORY, hard)
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
