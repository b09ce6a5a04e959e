"""One thread at a time: CasADi counts references, and keeps tables, without locks of its own.

Its wrapper lets other threads run during every call, even while an object is deleted. So whatever
uses CasADi holds one lock (`exclusive`), and what it leaves behind is never deleted outside of it:
what is built of an object is kept elsewhere (`stored`), and an error that leaves the package takes
no local variables along.
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

LOCK = RLock()  # held by whoever uses CasADi
KEPT = 512  # most values of a `stored` function; a route of a polygon with 12 corners takes 180

if hasattr(os, "register_at_fork"):
    # A child process must not start from the middle of another thread's call.
    os.register_at_fork(
        before=LOCK.acquire, after_in_parent=LOCK.release, after_in_child=LOCK.release
    )


def exclusive(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Make a function hold the lock; it may call others that do."""

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with LOCK:
            try:
                return function(*args, **kwargs)
            except BaseException as error:
                _drop_locals(error)
                raise

    return run


def stored(
    identify: Callable[..., Hashable], most: int = KEPT
) -> Callable[[Callable[..., _T]], Callable[..., _T]]:
    """Have a function keep what it builds of CasADi objects, `most` values that were used last.

    Arguments for which `identify` gives equal keys share one value.
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
            if len(values) > most:
                values.popitem(last=False)
            return values[key]

        return find

    return decorate


def _drop_locals(error: BaseException) -> None:
    """Delete the local variables of all finished calls that an error and its causes came through.

    They may hold CasADi objects, and the error is dropped where nobody holds the lock.
    """
    from traceback import clear_frames  # no plan needs it

    seen: set[int] = set()
    pending: list[BaseException | None] = [error]
    while pending:
        one = pending.pop()
        if one is None or id(one) in seen:
            continue
        seen.add(id(one))
        pending += [one.__cause__, one.__context__]
        clear_frames(one.__traceback__)


def bind(function: Expression, inputs: Sequence[Array], outputs: Sequence[Array]) -> Any:
    """A call of a CasADi function of dense arrays, which stay in place and live as long."""
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

    CasADi reads from and writes to arrays that stay in place, which is several times as fast as
    passing matrices in and out. Up to 5 points are calls of their own: one for 20 costs as much as
    half a dozen. More than 64 in a call need more memory at no gain. Inputs of the `function`,
    which is kept, are column vectors, outputs are dense.
    """

    sizes = (1, 20, 64)  # points of a call

    def __init__(self, function: Expression) -> None:
        self.function, most, inputs = function, self.sizes[-1], range(function.n_in())
        self._arguments = [np.zeros((most, function.size1_in(i))) for i in inputs]
        shapes = [function.size_out(i) for i in range(function.n_out())]
        self._results = [np.zeros((most, columns, rows)) for rows, columns in shapes]
        self._calls = []  # a number of points, and a call for as many
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
            start, left = stop, count - stop
            size, run = self._calls[0 if left <= 5 else 1 if left <= 60 else 2]
            stop = min(start + size, count)
            for store, argument in zip(self._arguments, arguments, strict=True):
                store[: stop - start] = argument[start:stop]
            run()
            for output, result in zip(outputs, self._results, strict=True):
                output[start:stop] = result[: stop - start]
        return [output.transpose(0, 2, 1) for output in outputs]

    @exclusive
    def at(self, *point: Array) -> list[Array]:
        """Evaluate at one point, with the least to do besides.

        Each input has a `point` of shape (rows,), each output is (columns, rows).
        """
        for store, argument in zip(self._arguments, point, strict=True):
            store[0] = argument
        self._calls[0][1]()
        return [result[0].copy() for result in self._results]
