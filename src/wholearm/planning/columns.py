"""Columns of what an NLP and its kernels are given: declared once by name, found by that alone."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from ..common.arrays import Expression


class Columns:
    """Named blocks of a vector, one after the other.

    Parameters
    ----------
    **sizes : int
        How many entries each block has, in their order.
    """

    def __init__(self, **sizes: int) -> None:
        self.sizes = sizes
        ends = np.cumsum([0, *sizes.values()]).tolist()
        pairs = zip(sizes, ends[:-1], ends[1:], strict=True)
        self._slices = {name: slice(start, stop) for name, start, stop in pairs}
        self.count: int = ends[-1]

    def __getitem__(self, name: str) -> slice:
        return self._slices[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.sizes)

    def items(self) -> Iterator[tuple[str, slice]]:
        """Names and slices of all blocks."""
        return iter(self._slices.items())

    def make_symbols(self) -> tuple[SimpleNamespace, Expression]:
        """A column of symbols for each block, as attributes, and all of them in one."""
        symbols = {name: ca.SX.sym(name, size) for name, size in self.sizes.items()}
        return SimpleNamespace(**symbols), ca.vertcat(ca.SX(0, 1), *symbols.values())

    def write(self, **blocks: Expression) -> Expression:
        """One column of expressions, block by block."""
        self._check({name: int(block.numel()) for name, block in blocks.items()})
        return ca.vertcat(ca.SX(0, 1), *(ca.vec(blocks[name]) for name in self))

    def join(self, **blocks: Any) -> Any:
        """One array of shape (..., count) from those of the blocks, in whatever order.

        Their other axes are broadcast against one another.

        Raises
        ------
        ValueError
            If a block is missing, unknown or of another size.
        """
        tables = {name: np.asarray(block) for name, block in blocks.items()}
        self._check({name: table.shape[-1] for name, table in tables.items()})
        shape = np.broadcast_shapes(*(table.shape[:-1] for table in tables.values()))
        parts = [np.broadcast_to(tables[name], (*shape, self.sizes[name])) for name in self]
        return np.concatenate(parts, axis=-1)

    def _check(self, given: dict[str, int]) -> None:
        if given != self.sizes:
            raise ValueError(f"columns {given} are given where {self.sizes} are declared")
