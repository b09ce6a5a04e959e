"""Contact modes of a phase: what slides which way and what rolls, from when to when."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

ROLLS = "rolls"
"""Mode of a contact that rolls; one that slides has the sign of its direction."""


class ModeSpan(NamedTuple):
    """A stretch of a phase in which every contact keeps its mode.

    Attributes
    ----------
    start, stop : float, [s]
        From the start of the phase.
    contacts : mapping of str
        ``"+"``, ``"-"`` or ``"rolls"`` by the name of the contact.
    joints : (str, str)
        Which way each joint turns, ``"+"`` or ``"-"``.
    """

    start: float
    stop: float
    contacts: Mapping[str, str]
    joints: tuple[str, ...]
