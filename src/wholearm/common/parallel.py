"""Independent tasks in parallel: by forked processes, or through an executor.

`run_tasks` forks child processes, which inherit all data computed before. Parent and children
take the next task from one queue (a pipe) until it is empty; children then send their results.
Side effects of a task are lost in a child: it has to be a pure function. The parent runs tasks
whose results are missing, because a child was killed or an exception was raised.

`run_all` uses an executor: spawned processes (`Processes`), a Dask scheduler (`connect`), or any
other. A `Journal` stores results of tasks, so that a study can be resumed.
"""

from __future__ import annotations

import ctypes
import gc
import json
import math
import multiprocessing as mp
import os
import signal
import stat
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from itertools import islice
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, BinaryIO, TypeVar

from .document import describe_differences, find_differences
from .errors import InputError, name_file
from .fields import Range
from .signals import beat, defer_signals

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

_T = TypeVar("_T")
Task = Callable[[], _T]

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_parallel = False


def count_cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_tasks(tasks: Sequence[Task[_T]], jobs: int | None) -> list[_T]:
    """Results of tasks, in their order.

    Processes are forked only on Linux, from a process that may have children and has a single
    thread (`can_fork`). Otherwise, and for tasks inside of tasks, tasks are run sequentially.

    Parameters
    ----------
    tasks  functions without arguments; their results have to be picklable
    jobs   largest number of processes, this one included; the number of cores if None
    """
    global _parallel
    limit = count_cores() if jobs is None else Range(1, 256).read(jobs, "jobs")
    count = min(limit, len(tasks)) - 1
    if count < 1 or _parallel or not can_fork():
        return [task() for task in tasks]
    _parallel, children = True, list[tuple[BaseProcess, Connection]]()
    source, sink = os.pipe()
    try:
        os.write(sink, b"".join(k.to_bytes(2, "big") for k in range(len(tasks))))
        os.close(sink)
        for _ in range(count):
            children.append(_fork_child(tasks, source))
        results = _take_tasks(tasks, source)
        for _, receiver in children:
            # A child that was killed, or raised an exception, sends nothing.
            with suppress(EOFError, OSError):
                while not receiver.poll(0.1):
                    beat()
                results |= receiver.recv()
        return [results[k] if k in results else task() for k, task in enumerate(tasks)]
    finally:
        _parallel = False
        os.close(source)
        for process, receiver in children:
            process.kill()
            process.join()
            process.close()
            receiver.close()


def can_fork() -> bool:
    """Whether this process may be forked."""
    return (
        sys.platform == "linux"
        and not mp.current_process().daemon
        and threading.active_count() == 1
    )


def _fork_child(tasks: Sequence[Task[Any]], source: int) -> tuple[BaseProcess, Connection]:
    """Fork a child that runs tasks; returns it and the pipe on which it sends results."""
    context = mp.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    arguments = tasks, source, sender, os.getpid()
    process = context.Process(target=_run_child, args=arguments, daemon=True)
    try:
        # Signals wait until the child has installed its handlers.
        with _block_signals(*_SIGNALS):
            process.start()
    finally:
        sender.close()
    return process, receiver


@contextmanager
def _block_signals(*numbers: signal.Signals) -> Iterator[None]:
    """Block signals in this context; processes started in it inherit the mask."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


def end_with_parent(parent: int) -> None:
    """Have the kernel kill this process when its parent ends (on Linux).

    A signal may end the parent before it has registered a child that it has just started.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(1)


def _run_child(tasks: Sequence[Task[Any]], source: int, sender: Connection, parent: int) -> None:
    """Run tasks until none is left, and send their results."""
    # Only the parent handles an interrupt; it kills its children.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    end_with_parent(parent)
    # Garbage collection of inherited objects would copy their pages.
    gc.freeze()
    try:
        results = _take_tasks(tasks, source)
    except KeyboardInterrupt:
        return  # The time limit is over; the parent reports it.
    with suppress(Exception):
        sender.send(results)


def _take_tasks(tasks: Sequence[Task[_T]], source: int) -> dict[int, _T]:
    """Results of tasks by number; numbers are read from a pipe that all processes share.

    Tasks that raise an exception have no result: the parent runs them again, in order, so that the
    exception of the first one is raised.
    """
    results = dict[int, _T]()
    while number := os.read(source, 2):
        index = int.from_bytes(number, "big")
        with suppress(Exception):
            results[index] = tasks[index]()
    return results


_CPU = getattr(signal, "SIGPROF", 27)  # signal at the limit of processor time


class DiedError(Exception):
    """The process of a task died in every attempt; `timed_out` if it exceeded its time limit."""

    def __init__(self, text: str, timed_out: bool = False) -> None:
        super().__init__(text)
        self.timed_out = timed_out


def run_all(
    run: Callable[[Any], Any], tasks: Iterable[Any], executor: Executor, max_pending: int = 64
) -> Iterator[tuple[Any, Any]]:
    """Pairs of a task and the result of `run`, or its exception, in the order of completion.

    `run` is a function of a module, as workers import it by name; tasks have to be picklable. At
    most `max_pending` tasks are submitted at a time. The executor is shut down at the end.
    """
    remaining, pending = iter(tasks), dict[Future[Any], Any]()
    try:
        while True:
            for task in islice(remaining, max_pending - len(pending)):
                pending[executor.submit(run, task)] = task
            if not pending:
                return
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                task, error = pending.pop(future), future.exception()
                yield task, future.result() if error is None else error
    finally:
        # Not every executor cancels pending futures at its shutdown.
        for future in pending:
            future.cancel()
        executor.shutdown(wait=False)


class Processes(ThreadPoolExecutor):
    """Executor of spawned processes, each with a thread; a crash or a hang affects one task only.

    There are `jobs` processes, or as many as cores. A task may take `limit(task)` of processor time
    [s] and 20 times as much wall-clock time. With `fresh`, each task has a new process. Futures
    raise `DiedError` if the process of a task dies three times, or its time limit is exceeded.
    """

    def __init__(
        self,
        jobs: int | None = None,
        limit: Callable[[Any], float] = lambda task: math.inf,
        fresh: bool = False,
    ) -> None:
        super().__init__(jobs or os.cpu_count())
        self._limit, self._fresh = limit, fresh
        self._idle, self._workers = list[_Worker](), set[_Worker]()
        self._closed = False

    def submit(  # type: ignore[override]
        self, run: Callable[[Any], Any], task: Any, /
    ) -> Future[Any]:
        """Submit `run(task)` to a process."""
        return super().submit(self._run_task, run, task)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:
        """Kill all processes and end their threads."""
        self._closed = True
        super().shutdown(wait=False, cancel_futures=True)
        for worker in list(self._workers):
            worker.process.kill()
        super().shutdown()
        while self._idle:
            self._idle.pop().end()

    def _run_task(self, run: Callable[[Any], Any], task: Any) -> Any:
        """The result of a task, computed in an idle or a new process; up to three attempts."""
        for attempt in (1, 2, 3):
            worker = self._idle.pop() if self._idle else _Worker()
            self._workers.add(worker)
            reusable = False
            try:
                if self._closed:
                    raise DiedError("the executor is shut down")
                succeeded, result = worker.ask(run, task, self._limit(task))
                reusable = not self._fresh
                break
            except DiedError as error:
                if error.timed_out or self._closed or attempt == 3:
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


class _SpawnedProcess(SpawnProcess):
    """A spawned process that ignores Ctrl-C in its terminal from the start; its parent handles it.

    The main script is not imported, as this would run it again.
    """

    def start(self) -> None:
        # The first start would also start the resource tracker, which unblocks SIGINT.
        if sys.platform != "win32":
            resource_tracker.ensure_running()
        # A signal handler has to know the process; and one process is started at a time.
        with defer_signals(), _block_signals(signal.SIGINT):
            main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
            try:
                super().start()
            finally:
                sys.modules["__main__"] = main


class _Worker:
    """A process that runs tasks that it receives through a pipe."""

    def __init__(self) -> None:
        self.pipe, remote = mp.Pipe()
        self.process = _SpawnedProcess(target=_work, args=(remote, os.getpid()), daemon=True)
        self.process.start()
        remote.close()

    def ask(self, run: Callable[[Any], Any], task: Any, limit: float) -> tuple[bool, Any]:
        """Whether a task succeeded, and its result or its exception."""
        start_time, timed_out = time.monotonic(), False
        try:
            self.pipe.send((run, task, limit))
            if self.pipe.poll(20.0 * limit if math.isfinite(limit) else None):
                succeeded, result = self.pipe.recv()
                return succeeded, result
            timed_out = True
        except (EOFError, OSError):
            self.process.join()
            timed_out = self.process.exitcode == -_CPU
        cause, elapsed = "time limit" if timed_out else "crash", time.monotonic() - start_time
        raise DiedError(
            f"{cause} after {elapsed:.0f} s: exit status {self.process.exitcode}", timed_out
        )

    def end(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _work(pipe: Connection, parent: int) -> None:
    """Run tasks received through the pipe until it closes."""
    end_with_parent(parent)
    try:
        import resource

        # Allocations beyond 6 GB fail instead of swapping.
        max_bytes, hard = 6 * 2**30, resource.getrlimit(resource.RLIMIT_AS)[1]
        soft = max_bytes if hard == resource.RLIM_INFINITY else min(max_bytes, hard)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    except ImportError:  # on Windows
        pass
    while True:
        try:
            run, task, limit = pipe.recv()
        except (EOFError, OSError):
            return
        if hasattr(signal, "setitimer") and math.isfinite(limit):
            # A timer per task: a limit of the process would sum over its tasks.
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
    """An executor on the workers of a Dask scheduler, such as ``tcp://10.0.0.1:8786``.

    An `InputError` if Dask is not installed, or no scheduler answers within `patience` [s].
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


class Journal:
    """A file with one JSON object per line; the first line, the stamp, identifies the study.

    Records are kept unless `fresh` or `again` is set: `fresh` starts an empty file, `again` drops
    records with findings, so that their tasks are run again. The file is locked while the journal
    exists. `os.devnull` stands for no file. The key `study` of the stamp is the kind of study.
    Records of a stamp with another `source` are dropped.

    InputError if the file holds something else, another study of the same kind included, is being
    written by another run, or cannot be written.
    """

    def __init__(
        self, path: str, stamp: dict[str, Any], fresh: bool = False, again: bool = False
    ) -> None:
        self.path, self._stamp = path, json.loads(json.dumps(stamp))
        self.records: list[dict[str, Any]] = []
        try:
            self._stream: BinaryIO = open(path, "ab+", buffering=0)
            try:
                if stat.S_ISREG(os.fstat(self._stream.fileno()).st_mode):
                    if fcntl is not None:
                        # Locks the file until it is closed, or this process ends.
                        fcntl.flock(self._stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
                    self._stream.seek(0)
                    self._begin(b"" if fresh else self._stream.read(), again)
            except BaseException:
                self._stream.close()
                raise
        except BlockingIOError:
            text = "another run is writing to it; wait for its end, or choose another with -o"
            raise InputError(path, "", text) from None
        except OSError as error:
            raise InputError(path, "", f"cannot be written: {error.strerror}") from None

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def add(self, record: dict[str, Any]) -> None:
        """Append a record; an `InputError` if it cannot be written."""
        self.records.append(record)
        with name_file(self.path, failure="cannot be written"):
            self._write((json.dumps(record) + "\n").encode())

    def _begin(self, content: bytes, again: bool) -> None:
        """Read the records, and truncate the file to the stamp and complete lines."""
        head = (json.dumps(self._stamp) + "\n").encode()
        lines_kept, other, kind = head, _parse(content.split(b"\n", 1)[0]), self._stamp["study"]
        if other.get("study") == kind and other.get("source") != self._stamp.get("source"):
            content = b""
        # A full disk may leave a part of the first line.
        if not head.startswith(content):
            differences = find_differences(other, self._stamp)
            if text := describe_differences(differences, "in the file", "now"):
                same = other.get("study") == kind
                what = f"another study: {text}" if same else f"no {kind} study"
                text = f"holds {what}; --fresh begins anew, or choose another with -o"
                raise InputError(self.path, "", text)
            first, *lines = content[: content.rfind(b"\n") + 1].splitlines(keepends=True)
            entries = [(line, _parse(line)) for line in lines]
            selected = [entry for entry in entries if not (again and entry[1].get("findings"))]
            self.records = [record for _, record in selected if record]
            lines_kept = b"".join([first, *(line for line, _ in selected)])
        with defer_signals():
            if content.startswith(lines_kept):
                self._stream.truncate(len(lines_kept))
            else:
                self._stream.truncate(0)
                self._write(lines_kept)

    def _write(self, line: bytes) -> None:
        remaining = memoryview(line)
        while remaining:
            remaining = remaining[self._stream.write(remaining) :]


def _parse(line: bytes) -> dict[str, Any]:
    """The record of a line; empty if the line is no JSON object."""
    try:
        record = json.loads(line)
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}
