"""Contact modes of a phase: what slides which way and what rolls, from when to when."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

ROLLS = "rolls"  # mode of a contact that rolls; one that slides has the sign of its direction


class ModeSpan(NamedTuple):
    """A stretch of a phase in which every contact keeps its mode."""

    start: float  # start, stop [s]: from the start of the phase
    stop: float
    contacts: Mapping[str, str]  # ``"+"``, ``"-"`` or ``"rolls"`` by the name of the contact
    joints: tuple[str, ...]  # which way each joint turns, ``"+"`` or ``"-"``
