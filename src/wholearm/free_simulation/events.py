"""What happens in a free simulation."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple


class FreeEventKind(Enum):
    """What happens at an instant."""

    START = "start"
    """A motion begins from rest."""
    REST = "rest"
    """Everything is held at rest."""
    TOUCH = "touch"
    """A contact is gained without an impact."""
    IMPACT = "impact"
    """A contact is gained at a speed, which it takes away."""
    CHATTER = "chatter"
    """Impacts that come ever faster are taken as done: the contact stays closed."""
    PART = "part"
    """A contact's normal force has fallen to zero, and it opens."""
    PASS = "pass"
    """A contact goes on as one of neighbouring features."""
    STICK = "stick"
    """Friction holds a contact or a joint."""
    SLIP = "slip"
    """Friction no longer holds it."""
    REVERSAL = "reversal"
    """Sliding or turning changes direction."""
    AMBIGUOUS = "ambiguous"
    """The laws of contact allow several motions; the one nearest to the last is taken."""
    INCONSISTENT = "inconsistent"
    """They allow none with finite forces: an impact without a collision."""
    GIVEN_UP = "given up"
    """Events come without time passing, or steps do not get anywhere: the simulation ends here."""


class FreeEvent(NamedTuple):
    """Something that happens at an instant.

    Attributes
    ----------
    time : float, [s]
    kind : FreeEventKind
    text : str
        What has happened, in words.
    contact : str
        The pair of features or joint concerned, if there is one.
    value : float
        Impact: the speed at which the gap closed [m/s]; part: the c_n that would be needed [N].
    """

    time: float
    kind: FreeEventKind
    text: str
    contact: str = ""
    value: float = math.nan
