"""Tasks through any executor, each answered once, with retries where workers die."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from itertools import islice
from typing import Any

AHEAD = 64  # tasks that are given to the executor before the first is answered
CHANCES = 3
"""Times that a task may be under way when workers die, before it is taken for the reason."""


class DiedError(Exception):
    """The workers die of this task."""


def run_all(
    run: Callable[[Any], Any],
    tasks: Iterable[Any],
    start: Callable[[], Executor],
    ahead: int = AHEAD,
) -> Iterator[tuple[Any, Any]]:
    """Give each task and what `run` returns for it, in the order in which they end.

    Parameters
    ----------
    run    of a module, as workers import it by name
    tasks  arguments of `run`; have to be picklable
    start  makes an executor. It is called again when its workers have died; what they have not
           answered is given to the next one, task by task until it is known who was the reason.
    ahead  tasks that are under way at most

    Yields
    ------
    task, answer  the answer is an exception, not raised, where `run` raised it, and `DiedError`
                  where the workers died of the task
    """
    waiting, deaths = iter(tasks), 0
    # What workers died with is run alone, so that it is known which task they die of.
    orphans: deque[Any] = deque()
    executor, pending = start(), dict[Future[Any], Any]()
    try:
        while True:
            given = islice(waiting, 0 if orphans else ahead - len(pending))
            for task in given if pending or not orphans else [orphans.popleft()]:
                pending[_submit(executor, run, task)] = task
            if not pending:
                return
            done, _ = wait(pending, return_when=FIRST_COMPLETED)
            broken, alone = [], len(pending) == 1
            for future in done:
                task, error = pending.pop(future), future.exception()
                if isinstance(error, BrokenExecutor):
                    broken.append(task)
                else:
                    deaths = 0 if alone else deaths
                    yield task, future.result() if error is None else error
            if not broken:
                continue
            _leave(executor, pending)
            executor = start()
            orphans.extendleft([*broken, *pending.values()])
            pending = {}
            deaths += alone
            if deaths >= CHANCES:
                deaths = 0
                yield orphans.popleft(), DiedError("its worker died each time")
    finally:
        _leave(executor, pending)


def _submit(executor: Executor, run: Callable[[Any], Any], task: Any) -> Future[Any]:
    """A future of the task, broken where the executor takes none any more."""
    try:
        return executor.submit(run, task)
    except BrokenExecutor as error:
        future: Future[Any] = Future()
        future.set_exception(error)
        return future


def _leave(executor: Executor, pending: Iterable[Future[Any]]) -> None:
    """Have nothing more done. Not every executor can be told so at once."""
    for future in pending:
        future.cancel()
    executor.shutdown(wait=False)
