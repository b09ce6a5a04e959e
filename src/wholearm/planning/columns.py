"""Named blocks of the vectors of an NLP and its kernels."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from ..common.arrays import Expression


class Columns:
    """Named blocks of a vector, one after the other, by their sizes."""

    def __init__(self, **sizes: int) -> None:
        self.sizes = sizes
        ends = np.cumsum([0, *sizes.values()]).tolist()
        self.slices = dict(zip(sizes, map(slice, ends[:-1], ends[1:]), strict=True))
        self.count: int = ends[-1]

    def __getitem__(self, name: str) -> slice:
        return self.slices[name]

    def make_symbols(self, **known: Expression) -> Symbols:
        """A column of symbols for each block that is not `known`."""
        symbols = {name: ca.SX.sym(name, size) for name, size in self.sizes.items()} | known
        return Symbols(self, symbols)

    def write(self, **blocks: Expression) -> Expression:
        """One column of expressions, block by block."""
        self._check({name: int(block.numel()) for name, block in blocks.items()})
        return ca.vertcat(ca.SX(0, 1), *(ca.vec(blocks[name]) for name in self.sizes))

    def join(self, **blocks: Any) -> Any:
        """One array of shape (..., count) from those of all blocks, broadcast in other axes."""
        tables = {name: np.asarray(block) for name, block in blocks.items()}
        self._check({name: table.shape[-1] for name, table in tables.items()})
        shape = np.broadcast_shapes(*(table.shape[:-1] for table in tables.values()))
        parts = [np.broadcast_to(tables[name], (*shape, self.sizes[name])) for name in self.sizes]
        return np.concatenate(parts or [np.zeros(0)], axis=-1)

    def _check(self, given: dict[str, int]) -> None:
        if given != self.sizes:
            raise ValueError(f"columns {given} are given where {self.sizes} are declared")


class Symbols(SimpleNamespace):
    """Columns of symbols as attributes, by the names of `columns`; `every` is all in one."""

    def __init__(self, columns: Columns, symbols: dict[str, Expression]) -> None:
        super().__init__(**symbols)
        self.columns = columns
        self.every = columns.write(**symbols)
