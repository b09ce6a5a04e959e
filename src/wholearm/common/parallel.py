"""Independent tasks in parallel: by forked processes, or through an executor.

`share` forks children where tasks are shared out, so that they have all that is known by then. Each
process takes the next task for as long as there is one, and children send what has come of theirs.
What a task leaves behind besides its result is lost in a child: it has to be a pure function. What
a child does not send, as it was ended or met an error, its parent does itself.

`run_all` goes through an executor: spawned processes (`Processes`), a Dask scheduler (`connect`),
or any other. A `Journal` keeps what comes of tasks, to resume from.
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
from .signals import beat, held

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

_T = TypeVar("_T")
Task = Callable[[], _T]

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_sharing = False


def count_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def share(tasks: Sequence[Task[_T]], jobs: int | None) -> list[_T]:
    """Results of tasks, in their order.

    Processes are forked on Linux alone, where libraries bear it, if this one may have children and
    no other thread could be in the middle of something. Otherwise, and for tasks inside of tasks,
    one is done after the other.

    Parameters
    ----------
    tasks  without arguments. What they return has to be picklable.
    jobs   most processes, this one included; as many as cores if None
    """
    global _sharing
    most = count_cores() if jobs is None else Range(1, 256).read(jobs, "jobs")
    count = min(most, len(tasks)) - 1
    if count < 1 or _sharing or not can_fork():
        return [task() for task in tasks]
    _sharing, children = True, list[tuple[BaseProcess, Connection]]()
    source, sink = os.pipe()
    try:
        os.write(sink, b"".join(k.to_bytes(2, "big") for k in range(len(tasks))))
        os.close(sink)
        for _ in range(count):
            children.append(_start(tasks, source))
        results = _take(tasks, source)
        for _, answers in children:
            # A child that was ended, or met an error, sends nothing.
            with suppress(EOFError, OSError):
                while not answers.poll(0.1):
                    beat()
                results |= answers.recv()
        return [results[k] if k in results else task() for k, task in enumerate(tasks)]
    finally:
        _sharing = False
        os.close(source)
        for process, answers in children:
            process.kill()
            process.join()
            process.close()
            answers.close()


def can_fork() -> bool:
    """Whether this process may have children that go on from where it is."""
    return (
        sys.platform == "linux"
        and not mp.current_process().daemon
        and threading.active_count() == 1
    )


def _start(tasks: Sequence[Task[Any]], source: int) -> tuple[BaseProcess, Connection]:
    """Fork a child that takes tasks, and sends its answers."""
    context = mp.get_context("fork")
    answers, far = context.Pipe(duplex=False)
    arguments = tasks, source, far, os.getpid()
    process = context.Process(target=_serve, args=arguments, daemon=True)
    try:
        # No signal may meet the child before it has said what it does about it.
        with _blocked(*_SIGNALS):
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


def end_with_parent(parent: int) -> None:
    """Have this process killed when its parent ends, however that comes about (on Linux).

    A signal may end the parent before it knows of a child that it has just started.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(1)


def _serve(tasks: Sequence[Task[Any]], source: int, far: Connection, parent: int) -> None:
    """Take tasks for as long as there are any, and send what has come of them."""
    # The parent alone answers an interrupt, and ends its children.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    end_with_parent(parent)
    # What there is by now is not looked at for garbage, which would copy its pages.
    gc.freeze()
    try:
        results = _take(tasks, source)
    except KeyboardInterrupt:
        return  # The time is over, as its parent finds out and says.
    with suppress(Exception):
        far.send(results)


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

    `run` is of a module, as workers import it by name; tasks have to be picklable. The executor is
    shut down at the end. No more than `ahead` tasks are submitted at a time.
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

    There are as many as `jobs`, or cores. A task may take `limit` of processor time [s], and 20
    times that by the wall clock, as others may run too. Tasks that run `alone` have new processes.
    Futures raise `DiedError` where a task loses its process three times, or its time is up.
    """

    def __init__(
        self,
        jobs: int | None = None,
        limit: Callable[[Any], float] = lambda task: math.inf,
        alone: bool = False,
    ) -> None:
        super().__init__(jobs or os.cpu_count())
        self._limit, self._alone = limit, alone
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
            worker = self._idle.pop() if self._idle else _Worker()
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


class _Spawned(SpawnProcess):
    """A process that a Ctrl-C in its terminal leaves to its parent, from the first moment on.

    The script that started this process is not imported in it, which would run it again.
    """

    def start(self) -> None:
        # The first process starts this one, too, which would unblock SIGINT.
        if sys.platform != "win32":
            resource_tracker.ensure_running()
        # What a signal ends has to be known by then; and one is started at a time.
        with held(), _blocked(signal.SIGINT):
            main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
            try:
                super().start()
            finally:
                sys.modules["__main__"] = main


class _Worker:
    """A process that computes what comes through a pipe."""

    def __init__(self) -> None:
        self.pipe, far = mp.Pipe()
        self.process = _Spawned(target=_work, args=(far, os.getpid()), daemon=True)
        self.process.start()
        far.close()

    def ask(self, run: Callable[[Any], Any], task: Any, limit: float) -> tuple[bool, Any]:
        """Whether a task succeeded, and its result or its exception."""
        start_time, late = time.monotonic(), False
        try:
            self.pipe.send((run, task, limit))
            if self.pipe.poll(20.0 * limit if math.isfinite(limit) else None):
                succeeded, result = self.pipe.recv()
                return succeeded, result
            late = True
        except (EOFError, OSError):
            self.process.join()
            late = self.process.exitcode == -_CPU
        kind, elapsed = "time limit" if late else "crash", time.monotonic() - start_time
        raise DiedError(f"{kind} after {elapsed:.0f} s: exit status {self.process.exitcode}", late)

    def end(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _work(pipe: Connection, parent: int) -> None:
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
    """A file of one JSON object per line, begun by a line that says what the study is.

    Nothing in the file is lost unless that is asked for. While the journal exists nobody else can
    have one of the same file. Only a regular file has records: `os.devnull` stands for none. The
    `stamp` is what the records belong to, its `study` their kind. A `fresh` file is begun anew,
    whatever it holds; with `again`, records with findings are dropped, so that their tasks are run
    again. Where the stamp has a `source` records of another one are none.

    InputError if the file holds something else, another study of the same kind included, or is
    being written by another run, or cannot be written.
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
                        # Keeps others from the file until it is closed, or this process ends.
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
        """Keep a record; an `InputError` if it cannot be written."""
        self.records.append(record)
        with name_file(self.path, failure="cannot be written"):
            self._write((json.dumps(record) + "\n").encode())

    def _begin(self, given: bytes, again: bool) -> None:
        """Take the records that are there, and leave whole lines, begun by the stamp."""
        head = (json.dumps(self._stamp) + "\n").encode()
        whole, other, kind = head, _parse(given.split(b"\n", 1)[0]), self._stamp["study"]
        if other.get("study") == kind and other.get("source") != self._stamp.get("source"):
            given = b""
        # Half of the first line is what a full disk leaves.
        if not head.startswith(given):
            differences = find_differences(other, self._stamp)
            if text := describe_differences(differences, "in the file", "now"):
                same = other.get("study") == kind
                what = f"another study: {text}" if same else f"no {kind} study"
                text = f"holds {what}; --fresh begins anew, or choose another with -o"
                raise InputError(self.path, "", text)
            first, *lines = given[: given.rfind(b"\n") + 1].splitlines(keepends=True)
            entries = [(line, _parse(line)) for line in lines]
            kept = [entry for entry in entries if not (again and entry[1].get("findings"))]
            self.records = [record for _, record in kept if record]
            whole = b"".join([first, *(line for line, _ in kept)])
        with held():
            if given.startswith(whole):
                self._stream.truncate(len(whole))
            else:
                self._stream.truncate(0)
                self._write(whole)

    def _write(self, line: bytes) -> None:
        left = memoryview(line)
        while left:
            left = left[self._stream.write(left) :]


def _parse(line: bytes) -> dict[str, Any]:
    """The record of a line; empty if it is none."""
    try:
        record = json.loads(line)
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}
