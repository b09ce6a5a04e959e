"""Calling CasADi functions on many points at once without converting matrices."""

from __future__ import annotations

import numpy as np

from .arrays import Array, Expression
from .sharing import exclusive

SIZE = 64
"""Points per call. Larger needs more memory at no gain; smaller, more calls."""
FEW = 10
"""Points up to which each is a call of its own: one for all of `SIZE` costs as much as a dozen."""


class Batch:
    """A CasADi function of column vectors, called on rows of NumPy arrays.

    CasADi reads from and writes to arrays that stay in place, which is several times as fast as
    passing matrices in and out.

    Parameters
    ----------
    function : casadi.Function
        Inputs are column vectors, outputs dense.
    """

    def __init__(self, function: Expression) -> None:
        mapped = function.map(SIZE)
        self._arguments = [np.zeros((SIZE, function.size1_in(i))) for i in range(function.n_in())]
        shapes = [function.size_out(i) for i in range(function.n_out())]
        self._results = [np.zeros((SIZE, columns, rows)) for rows, columns in shapes]
        # Both buffers keep raw pointers into the same arrays, so they have to live as long.
        self._many, self._run_many = mapped.buffer()
        self._one, self._run_one = function.buffer()
        for i, argument in enumerate(self._arguments):
            self._many.set_arg(i, argument.data)
            self._one.set_arg(i, argument[0].data)
        for i, result in enumerate(self._results):
            self._many.set_res(i, result.data)
            self._one.set_res(i, result[0].data)

    @exclusive
    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate at n points.

        Parameters
        ----------
        *arguments : ndarray, shape (n, rows)
            One per input.

        Returns
        -------
        list of ndarray, shape (n, rows, columns)
            One per output.
        """
        count = len(arguments[0])
        outputs = [np.empty((count, *result.shape[1:])) for result in self._results]
        size, run = (1, self._run_one) if count <= FEW else (SIZE, self._run_many)
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
        *point : ndarray, shape (rows,)
            One per input.

        Returns
        -------
        list of ndarray, shape (columns, rows)
            One per output.
        """
        for store, argument in zip(self._arguments, point, strict=True):
            store[0] = argument
        self._run_one()
        return [result[0].copy() for result in self._results]
