"""What a plan within ranges costs, and how wide they may be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class RangeFigures(NamedTuple):
    """A plan that keeps its limits for all numbers within their ranges."""

    radii: Mapping[str, float]  # half widths of the ranges by name, as they were planned with
    nominal: float  # the objective without ranges
    # factor on the problem's ranges up to which there is a plan; None if it was not looked for
    largest: float | None = None
    # the same for each phase, planned with those that impacts join it to; None in the time domain
    phases: tuple[float | None, ...] = ()
    # whether the factor is as large as ranges make sense, and no limit stands against a larger one
    capped: bool = False
    # numbers of phases whose start friction may hold, somewhere within the ranges
    held: tuple[int, ...] = ()
