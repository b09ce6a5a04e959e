"""A lock around CasADi, whose reference counts and tables are not thread-safe.

Its wrapper releases Python's lock during every call, even while an object is deleted. Functions
that use CasADi hold a lock of the package (`exclusive`), and CasADi objects are deleted only under
this lock: expressions and functions are stored in caches (`stored`), and local variables are
removed from the tracebacks of errors.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from functools import wraps
from threading import RLock
from typing import Any, ParamSpec, TypeVar

import numpy as np

from .arrays import Array, Expression

_T = TypeVar("_T")
_P = ParamSpec("_P")

LOCK = RLock()  # held during every use of CasADi
MAX_STORED = 512  # entries of a cache; a route of a polygon with 12 corners takes 180

if hasattr(os, "register_at_fork"):
    # A child process must not be forked during a call of another thread.
    os.register_at_fork(
        before=LOCK.acquire, after_in_parent=LOCK.release, after_in_child=LOCK.release
    )


def exclusive(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Decorator: the function holds the lock, which is reentrant."""

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with LOCK:
            try:
                return function(*args, **kwargs)
            except BaseException as error:
                _clear_locals(error)
                raise

    return run


def stored(
    identify: Callable[..., Hashable], max_size: int = MAX_STORED
) -> Callable[[Callable[..., _T]], Callable[..., _T]]:
    """Decorator: cache the `max_size` values of a function of CasADi objects that were used last.

    The key of a value is `identify` of the arguments.
    """

    def decorate(build: Callable[..., _T]) -> Callable[..., _T]:
        values: OrderedDict[Hashable, _T] = OrderedDict()

        @wraps(build)
        @exclusive
        def find(*owners: Any) -> _T:
            key = identify(*owners)
            if key not in values:
                values[key] = build(*owners)
            values.move_to_end(key)
            if len(values) > max_size:
                values.popitem(last=False)
            return values[key]

        return find

    return decorate


def _clear_locals(error: BaseException) -> None:
    """Delete the local variables in the tracebacks of an error and its causes.

    They may hold CasADi objects, which would be deleted with the error without the lock.
    """
    from traceback import clear_frames  # no plan needs it

    visited: set[int] = set()
    pending: list[BaseException | None] = [error]
    while pending:
        current = pending.pop()
        if current is None or id(current) in visited:
            continue
        visited.add(id(current))
        pending += [current.__cause__, current.__context__]
        clear_frames(current.__traceback__)


def bind(function: Expression, inputs: Sequence[Array], outputs: Sequence[Array]) -> Any:
    """A call of a CasADi function on fixed buffers: dense arrays, which the call keeps alive."""
    buffer, call = function.buffer()
    for k, values in enumerate(inputs):
        buffer.set_arg(k, values.data)
    for k, values in enumerate(outputs):
        buffer.set_res(k, values.data)
    # Buffers keep raw pointers into the arrays.
    call.kept = buffer, inputs, outputs
    return call


class Batch:
    """A CasADi function of column vectors, called on rows of NumPy arrays.

    CasADi reads from and writes to fixed buffers, which is several times as fast as passing
    matrices. Up to 5 points are evaluated one by one: a call for 20 takes as long as six. Calls
    for more than 64 need more memory without a gain. Inputs of the `function` are column vectors,
    outputs are dense.
    """

    sizes = (1, 20, 64)  # points of a call

    def __init__(self, function: Expression) -> None:
        self.function, size_limit, inputs = function, self.sizes[-1], range(function.n_in())
        self._arguments = [np.zeros((size_limit, function.size1_in(i))) for i in inputs]
        shapes = [function.size_out(i) for i in range(function.n_out())]
        self._results = [np.zeros((size_limit, columns, rows)) for rows, columns in shapes]
        self._calls = []  # pairs of a number of points and a call for as many
        for size in self.sizes:
            inner, outer = ([x[:size] for x in y] for y in (self._arguments, self._results))
            call = bind(function if size == 1 else function.map(size), inner, outer)
            self._calls.append((size, call))

    @exclusive
    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate at n points.

        Each input has `arguments` of shape (n, rows), each output is (n, rows, columns).
        """
        count = len(arguments[0])
        outputs = [np.empty((count, *result.shape[1:])) for result in self._results]
        stop = 0
        while stop < count:
            start, remaining = stop, count - stop
            size, run = self._calls[0 if remaining <= 5 else 1 if remaining <= 60 else 2]
            stop = min(start + size, count)
            for store, argument in zip(self._arguments, arguments, strict=True):
                store[: stop - start] = argument[start:stop]
            run()
            for output, result in zip(outputs, self._results, strict=True):
                output[start:stop] = result[: stop - start]
        return [output.transpose(0, 2, 1) for output in outputs]

    @exclusive
    def at(self, *point: Array) -> list[Array]:
        """Evaluate at one point, with the least overhead.

        Each input has a `point` of shape (rows,), each output is (columns, rows).
        """
        for store, argument in zip(self._arguments, point, strict=True):
            store[0] = argument
        self._calls[0][1]()
        return [result[0].copy() for result in self._results]
