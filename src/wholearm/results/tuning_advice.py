"""Advice for tuning by hand: forces at contact losses, and torques that prevent them."""

from __future__ import annotations

from typing import NamedTuple


class ForceAt(NamedTuple):
    """A contact's forces at an instant, and what torques change of them."""

    contact: str
    c_n: float  # c_n, c_t [N]: naN where they are not determined, at rest
    c_t: float
    per_tau: tuple[float, float]  # [N/(N m)]: d c_n / d tau_1 and d c_n / d tau_2, at that state


class TorqueAdvice(NamedTuple):
    """A change of the torques that mends a loss."""

    # change, to [N m]: by how much both torques change, and what they then are
    change: tuple[float, float]
    to: tuple[float, float]
    but: str = ""  # what else it spoils, by name; empty if every limit is kept
    holds: bool = False  # whether the object then stays at rest

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
    """A contact that is lost, slips or presses with less than epsilon, and what would mend that."""

    phase: int  # number of the phase
    contact: str
    kind: str  # {"lost", "slips", "thin"}
    time: float  # [s]
    # whether the object was at rest; forces are those with which it would start to move
    at_rest: bool
    forces: tuple[ForceAt, ...]  # of every contact of the formation
    # [m/s^2 or rad/s^2]: acceleration towards the end of the phase, and what 1 N m of tau_1 and of
    # tau_2 adds to it; empty for a phase that ends by a release, and where forces are not
    # determined
    closing: tuple[float, ...]
    # of one torque alone, or where that spoils something of both, the best first
    changes: tuple[TorqueAdvice, ...]

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
    """How near a motion that misses the end of a phase has come to it."""

    phase: int  # number of the phase
    until: str  # its end
    distance: float  # the least, [m] or [rad]
    unit: str  # {"m", "rad"}
    time: float  # [s]: when
    rate: float  # [m/s or rad/s]: how fast the distance was closing then
    # [s]: when the motion in this phase turned back: from closing that distance to opening it, or
    # the other way
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
    """What helps to tune torques."""

    losses: tuple[Loss, ...] = ()  # those that end the replay first
    # none if the goal is reached, or the last phase ends by a release
    approach: Approach | None = None
