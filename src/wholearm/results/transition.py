"""What became of an impact that a problem asks for."""

from __future__ import annotations

from typing import NamedTuple


class Transition(NamedTuple):
    """An impact that a problem asks for, and what became of it."""

    phase: int  # number of the phase that ends
    gained: str  # its `until`
    possible: bool  # whether the motion passes it at speed
    reason: str  # why not, or empty
    velocity_ratio: float  # speed after over speed before; NaN where nothing says
    least_impulse: float  # [N s per m/s]: for unit speed before
    least_impulse_contact: str
    speed: float  # [m/s]: before; zero if the motion stops there
    # [s], [(N m)^2 s] or [N]: how much better the objective is than with a stop instead, of the
    # phases that are planned together: less time or effort, or more margin. NaN if the impact is
    # not possible, or there is no plan with a stop.
    saves: float

    @property
    def stop(self) -> str:
        """Why the motion stops there; empty if it does not."""
        return "" if self.possible else f"stops: {self.reason}"
