"""What a plan within ranges costs, and how wide they may be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class RangeFigures(NamedTuple):
    """A plan that keeps its limits for all numbers within their ranges.

    Attributes
    ----------
    radii : mapping of str to float
        Half widths of the ranges by name, as they were planned with.
    nominal : float
        The objective without ranges.
    largest : float or None
        Factor on the problem's ranges up to which there is a plan; None if it was not looked for.
    phases : sequence of (float or None)
        The same for each phase, planned with those that impacts join it to; None in the time
        domain.
    capped : bool
        Whether the factor is as large as ranges make sense, and no limit stands against a larger
        one.
    held : tuple of int
        Numbers of phases whose start friction may hold, somewhere within the ranges.
    """

    radii: Mapping[str, float]
    nominal: float
    largest: float | None = None
    phases: tuple[float | None, ...] = ()
    capped: bool = False
    held: tuple[int, ...] = ()
