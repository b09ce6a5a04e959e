"""What helps to tune torques by hand: why contacts are lost, and which torques would keep them."""

from __future__ import annotations

from typing import NamedTuple


class ForceAt(NamedTuple):
    """A contact's forces at an instant, and what torques change of them.

    Attributes
    ----------
    contact : str
    c_n, c_t : float, [N]
        NaN where they are not determined, at rest.
    per_tau : tuple of float, [N/(N m)]
        d c_n / d tau_1 and d c_n / d tau_2, at that state.
    """

    contact: str
    c_n: float
    c_t: float
    per_tau: tuple[float, float]


class TorqueChange(NamedTuple):
    """A change of the torques that mends a loss.

    Attributes
    ----------
    change, to : tuple of float, [N m]
        By how much both torques change, and what they then are.
    but : str
        What else it spoils, by name; empty if every limit is kept.
    holds : bool
        Whether the object then stays at rest.
    """

    change: tuple[float, float]
    to: tuple[float, float]
    but: str = ""
    holds: bool = False

    def to_text(self) -> str:
        """The change in words."""
        parts = [
            f"tau_{k + 1} {change:+.3g} N m (to {to:.4g})"
            for k, (change, to) in enumerate(zip(self.change, self.to, strict=True))
            if change
        ]
        text = " with ".join(parts)
        if self.but:
            return f"{text} would, but {self.but}"
        return f"{text} mends it" + ", but holds the object at rest" * self.holds


class Loss(NamedTuple):
    """A contact that is lost, slips or presses with less than epsilon, and what would mend that.

    Attributes
    ----------
    phase : int
        Number of the phase.
    contact : str
    kind : {"lost", "slips", "thin"}
    time : float, [s]
    at_rest : bool
        Whether the object was at rest; forces are those with which it would start to move.
    forces : tuple of ForceAt
        Of every contact of the formation.
    closing : tuple of float, [m/s^2 or rad/s^2]
        Acceleration towards the end of the phase, and what 1 N m of tau_1 and of tau_2 adds to it;
        empty for a phase that ends by a release, and where forces are not determined.
    changes : tuple of TorqueChange
        Of one torque alone, or where that spoils something of both, the best first.
    """

    phase: int
    contact: str
    kind: str
    time: float
    at_rest: bool
    forces: tuple[ForceAt, ...]
    closing: tuple[float, ...]
    changes: tuple[TorqueChange, ...]

    def to_text(self) -> str:
        """What would mend it, in a sentence."""
        what = {"lost": "is lost", "slips": "slips", "thin": "falls below epsilon"}[self.kind]
        text = f"{self.contact} {what} at t = {self.time:.5g} s, phase {self.phase}"
        ways = [change.to_text() for change in self.changes]
        if all(change.but for change in self.changes):
            when = "at this place" if self.at_rest else "in this state, so change them earlier"
            ways.append(f"no torques keep every limit {when}")
        return f"{text}: {'; '.join(ways)}"


class Approach(NamedTuple):
    """How near a motion that misses the end of a phase has come to it.

    Attributes
    ----------
    phase : int
        Number of the phase.
    until : str
        Its end.
    distance : float
        The least, [m] or [rad].
    unit : {"m", "rad"}
    time : float, [s]
        When.
    rate : float, [m/s or rad/s]
        How fast the distance was closing then.
    turns : tuple of float, [s]
        When the motion in this phase turned back: from closing that distance to opening it, or the
        other way.
    """

    phase: int
    until: str
    distance: float
    unit: str
    time: float
    rate: float
    turns: tuple[float, ...]

    def to_text(self) -> str:
        """All of it in a sentence."""
        text = (
            f"{self.until} was nearest at t = {self.time:.5g} s, {self.distance:.4g} {self.unit} "
            f"away, then closing at {self.rate:.2g} {self.unit}/s, phase {self.phase}"
        )
        turns = ", ".join(f"{time:.5g}" for time in self.turns)
        return f"{text}; the motion turns back at t = {turns} s" if turns else text


class TuningHelp(NamedTuple):
    """What helps to tune torques.

    Attributes
    ----------
    losses : tuple of Loss
        Those that end the replay first.
    approach : Approach or None
        None if the goal is reached, or the last phase ends by a release.
    """

    losses: tuple[Loss, ...] = ()
    approach: Approach | None = None
