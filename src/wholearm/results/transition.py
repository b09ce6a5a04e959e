"""What became of an impact that a problem asks for."""

from __future__ import annotations

from typing import NamedTuple


class Transition(NamedTuple):
    """An impact that a problem asks for, and what became of it.

    Attributes
    ----------
    phase : int
        Number of the phase that ends.
    gained : str
        Its `until`.
    possible : bool
        Whether the motion passes it at speed.
    reason : str
        Why not, or empty.
    velocity_ratio : float
        Speed after over speed before; NaN where nothing says.
    least_impulse : float, [N s per m/s]
        For unit speed before.
    least_impulse_contact : str
    speed : float, [m/s]
        Before; zero if the motion stops there.
    saves : float, [s], [(N m)^2 s] or [N]
        How much better the objective is than with a stop instead, of the phases that are planned
        together: less time or effort, or more margin. NaN if the impact is not possible, or there
        is no plan with a stop.
    """

    phase: int
    gained: str
    possible: bool
    reason: str
    velocity_ratio: float
    least_impulse: float
    least_impulse_contact: str
    speed: float
    saves: float

    @property
    def stop(self) -> str:
        """Why the motion stops there; empty if it does not."""
        return "" if self.possible else f"stops: {self.reason}"
