"""Calling CasADi functions on many points at once without converting matrices."""

from __future__ import annotations

import numpy as np

from .arrays import Array, Expression
from .sharing import exclusive

SIZE = 64  # most points per call. More need more memory at no gain; fewer, more calls.
SOME = 20  # points of a smaller call
FEW = 5
"""Points up to which each is a call of its own: one for `SOME` costs as much as half a dozen."""


class Batch:
    """A CasADi function of column vectors, called on rows of NumPy arrays.

    CasADi reads from and writes to arrays that stay in place, which is several times as fast as
    passing matrices in and out.

    Parameters
    ----------
    function  inputs are column vectors, outputs dense
    """

    def __init__(self, function: Expression) -> None:
        self._arguments = [np.zeros((SIZE, function.size1_in(i))) for i in range(function.n_in())]
        shapes = [function.size_out(i) for i in range(function.n_out())]
        self._results = [np.zeros((SIZE, columns, rows)) for rows, columns in shapes]
        # Buffers keep raw pointers into the same arrays, so they have to live as long.
        self._calls = [self._prepare(function, size) for size in (1, SOME, SIZE)]

    def _prepare(self, function: Expression, size: int) -> tuple[int, Expression, Expression]:
        """A number of points, the buffer of a call for as many, and what runs it."""
        buffer, run = (function if size == 1 else function.map(size)).buffer()
        for i, argument in enumerate(self._arguments):
            buffer.set_arg(i, argument[:size].data)
        for i, result in enumerate(self._results):
            buffer.set_res(i, result[:size].data)
        return size, buffer, run

    @exclusive
    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate at n points.

        Parameters
        ----------
        *arguments : (n, rows)  one per input

        Returns
        -------
        list of ndarray, shape (n, rows, columns)
            One per output.
        """
        count = len(arguments[0])
        outputs = [np.empty((count, *result.shape[1:])) for result in self._results]
        size, _, run = self._calls[0 if count <= FEW else 1 if count <= SOME else 2]
        for start in range(0, count, size):
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

        Parameters
        ----------
        *point : (rows,)  one per input

        Returns
        -------
        list of ndarray, shape (columns, rows)
            One per output.
        """
        for store, argument in zip(self._arguments, point, strict=True):
            store[0] = argument
        self._calls[0][2]()
        return [result[0].copy() for result in self._results]
