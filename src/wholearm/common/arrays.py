"""Types of arrays and of expressions, and what NumPy takes long for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Floating-point numbers."""
Expression = Any
"""What CasADi computes with: SX, MX, DM or Function, for which it has no types."""


def sort_unique(values: Array) -> Array:
    """Different values in increasing order, shape (n,), as `np.unique` has them.

    That imports masked arrays, unless it is asked for indices too: some 10 ms of a process.
    """
    ordered = np.sort(values, axis=None)
    return ordered[np.diff(ordered, prepend=-np.inf) > 0]
