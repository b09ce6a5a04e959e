"""Types of arrays and of expressions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Floating-point numbers."""
Expression = Any
"""What CasADi computes with: SX, MX, DM or Function, for which it has no types."""
