"""Constraints of an NLP under construction: linear rows, and rows that are kernels' outputs."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...common.arrays import Array
from .assembly import Block, Indices, Kernel, Triplets


class Rows:
    """Constraints in the order in which they are added, with their bounds."""

    def __init__(self) -> None:
        self.blocks: list[Block] = []
        self._count = 0
        self._low: list[Array] = []
        self._high: list[Array] = []
        self._linear: list[Indices] = []
        self._entries: list[tuple[Array, Array, Array]] = []

    def __getstate__(self) -> dict[str, Any]:
        # Which rows there are, and their bounds: kernels belong to CasADi.
        return self.__dict__ | {"blocks": [], "_entries": []}

    def nonlinear(self, *shape: int, low: Any = 0.0, high: Any = 0.0) -> Indices:
        """Rows of a kernel, equal to zero unless bounds are given."""
        own = self._count + np.arange(int(np.prod(shape))).reshape(shape)
        self._count += own.size
        for bounds, given in ((self._low, low), (self._high, high)):
            bounds.append(np.broadcast_to(np.asarray(given, dtype=float), shape).ravel())
        return own

    def linear(self, *shape: int, low: Any = 0.0, high: Any = 0.0) -> Indices:
        """Rows that are sums of unknowns, equal to zero unless bounds are given."""
        own = self.nonlinear(*shape, low=low, high=high)
        self._linear.append(own.ravel())
        return own

    def add_entries(self, rows: Any, columns: Any, values: Any) -> None:
        """Add entries to linear rows; the three are broadcast against one another."""
        parts = np.broadcast_arrays(rows, columns, np.asarray(values, dtype=float))
        self._entries.append((parts[0].ravel(), parts[1].ravel(), parts[2].ravel()))

    def add_copies(
        self, kernel: Kernel, columns: Indices, rows: Indices, parameters: Array | None = None
    ) -> None:
        """Say which rows are copies of a kernel, one for all but the last axis of `columns`."""
        table = columns.reshape(-1, columns.shape[-1])
        given = np.zeros((len(table), 0)) if parameters is None else parameters
        own = rows.reshape(len(table), -1)
        self.blocks.append(Block(kernel, table, own, given.reshape(len(table), -1)))

    def add_cost(self, kernel: Kernel, columns: Indices, parameters: Array | None = None) -> None:
        """Add copies of a kernel to the cost."""
        self.add_copies(kernel, columns, np.zeros((len(columns), 0), dtype=np.int64), parameters)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all rows."""
        return np.concatenate(self._low), np.concatenate(self._high)

    @property
    def linear_rows(self) -> Indices:
        """Which rows are linear."""
        return np.concatenate(self._linear)

    @property
    def triplets(self) -> Triplets:
        """Entries of the linear rows."""
        return Triplets(*(np.concatenate(part) for part in zip(*self._entries, strict=True)))
