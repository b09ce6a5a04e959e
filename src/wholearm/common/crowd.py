"""Independent tasks through an executor: spawned processes, a Dask scheduler, or any other."""

from __future__ import annotations

import math
import os
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from itertools import islice
from multiprocessing.connection import Connection
from typing import Any

from .errors import InputError
from .workers import Spawning, end_with_parent

_CPU = getattr(signal, "SIGPROF", 27)  # signal that ends a process whose processor time is used up


class DiedError(Exception):
    """A task has lost its process, each time that it was tried; `late` if its time was up."""

    def __init__(self, text: str, late: bool = False) -> None:
        super().__init__(text)
        self.late = late


def run_all(
    run: Callable[[Any], Any], tasks: Iterable[Any], executor: Executor, ahead: int = 64
) -> Iterator[tuple[Any, Any]]:
    """Each task and what `run` returns for it, or the exception that it raises, as they end.

    Parameters
    ----------
    run       of a module, as workers import it by name
    tasks     arguments of `run`; have to be picklable
    executor  shut down at the end
    ahead     largest number of tasks that are submitted at a time
    """
    waiting, pending = iter(tasks), dict[Future[Any], Any]()
    try:
        while True:
            for task in islice(waiting, ahead - len(pending)):
                pending[executor.submit(run, task)] = task
            if not pending:
                return
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                task, error = pending.pop(future), future.exception()
                yield task, future.result() if error is None else error
    finally:
        # Not every executor can be told at once to do nothing more.
        for future in pending:
            future.cancel()
        executor.shutdown(wait=False)


class Processes(ThreadPoolExecutor):
    """Spawned processes, each led by a thread. One that dies or hangs costs its own task alone.

    Futures raise `DiedError` where a task loses its process three times, or its time is up.

    Parameters
    ----------
    jobs   number of processes; as many as cores if left out
    limit  processor time that a task may take [s]. By the wall clock it may take 20 times that, as
           others may run too.
    alone  whether each task has a new process, where nothing is kept from others
    """

    def __init__(
        self,
        jobs: int | None = None,
        limit: Callable[[Any], float] = lambda task: math.inf,
        alone: bool = False,
    ) -> None:
        super().__init__(jobs or os.cpu_count())
        self._context, self._limit, self._alone = Spawning(), limit, alone
        self._idle, self._workers = list[_Worker](), set[_Worker]()
        self._closed = False

    def submit(  # type: ignore[override]
        self, run: Callable[[Any], Any], task: Any, /
    ) -> Future[Any]:
        """Have a process compute `run(task)`."""
        return super().submit(self._lead, run, task)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:
        """End all processes, whatever they do, and their threads."""
        self._closed = True
        super().shutdown(wait=False, cancel_futures=True)
        for worker in list(self._workers):
            worker.process.kill()
        super().shutdown()
        while self._idle:
            self._idle.pop().end()

    def _lead(self, run: Callable[[Any], Any], task: Any) -> Any:
        """The result of a task, by a process that this thread has for itself meanwhile."""
        for chance in (1, 2, 3):
            worker = self._idle.pop() if self._idle else _Worker(self._context)
            self._workers.add(worker)
            reusable = False
            try:
                if self._closed:
                    raise DiedError("the executor is shut down")
                succeeded, result = worker.ask(run, task, self._limit(task))
                reusable = not self._alone
                break
            except DiedError as error:
                if error.late or self._closed or chance == 3:
                    raise
            finally:
                if reusable:
                    self._idle.append(worker)
                else:
                    self._workers.remove(worker)
                    worker.end()
        if succeeded:
            return result
        raise result


class _Worker:
    """A process that computes what comes through a pipe."""

    def __init__(self, context: Spawning) -> None:
        self.pipe, far = context.Pipe()
        self.process = context.Process(target=_serve, args=(far, os.getpid()), daemon=True)
        self.process.start()
        far.close()

    def ask(self, run: Callable[[Any], Any], task: Any, limit: float) -> tuple[bool, Any]:
        """Whether a task succeeded, and its result or its exception."""
        begun, late = time.monotonic(), False
        try:
            self.pipe.send((run, task, limit))
            if self.pipe.poll(20.0 * limit if math.isfinite(limit) else None):
                succeeded, result = self.pipe.recv()
                return succeeded, result
            late = True
        except (EOFError, OSError):
            self.process.join()
            late = self.process.exitcode == -_CPU
        kind, elapsed = "time limit" if late else "crash", time.monotonic() - begun
        raise DiedError(f"{kind} after {elapsed:.0f} s: exit status {self.process.exitcode}", late)

    def end(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _serve(pipe: Connection, parent: int) -> None:
    """Compute what comes through the pipe until it closes."""
    end_with_parent(parent)
    try:
        import resource

        # A claim beyond 6 GB fails instead of swapping.
        most, hard = 6 * 2**30, resource.getrlimit(resource.RLIMIT_AS)[1]
        soft = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    except ImportError:  # on Windows
        pass
    while True:
        try:
            run, task, limit = pipe.recv()
        except (EOFError, OSError):
            return
        if hasattr(signal, "setitimer") and math.isfinite(limit):
            # A limit of the whole process would drift; this one idles between tasks.
            signal.setitimer(signal.ITIMER_PROF, limit)
        try:
            answer = True, run(task)
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = False, error
        try:
            pipe.send(answer)
        except OSError:
            return


def connect(address: str, patience: float = 10.0) -> Executor:
    """An executor on the workers of a Dask scheduler.

    Parameters
    ----------
    address         such as ``tcp://10.0.0.1:8786``
    patience : [s]  how long to wait for an answer

    Raises
    ------
    InputError  if Dask is not installed, or no scheduler answers there
    """
    try:
        from distributed import Client
    except ImportError:
        text = "Dask is not installed; pip install 'wholearm[cluster]' brings it"
        raise InputError("", "--scheduler", text) from None
    try:
        client = Client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError("", "--scheduler", f"{address}: {error}") from None
    executor: Executor = client.get_executor(pure=False)
    return executor
