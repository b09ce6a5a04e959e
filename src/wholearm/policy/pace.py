"""What the laws of all phases have in common."""

from __future__ import annotations

from typing import NamedTuple


class Pace(NamedTuple):
    """What the laws of all phases have in common.

    Attributes
    ----------
    period : float, [s]
        Of the control loop.
    delay : float, [s]
        Time from measuring to when torques take effect, as far as it is known.
    touch : float, [m/s]
        Speed s' at which contacts are made.
    still : float, [m/s]
        Speed s' that counts as none.
    dwell : float, [s]
        How long the joints stand still before the next phase begins.
    most : float, [m/s^2]
        Largest a of the integral.
    limit : tuple of two float, [N m]
        Of the torques.
    """

    period: float
    delay: float
    touch: float
    still: float
    dwell: float
    most: float
    limit: tuple[float, float]
