"""What a plan keeps of its replay."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from .report import Deviation


class LeastForce(NamedTuple):
    """The least normal force of a replay [N]: of which contact, in which phase, and when [s]."""

    value: float
    contact: str
    phase: int
    time: float


class ReplayedPhase(NamedTuple):
    """One phase of the replay.

    Attributes
    ----------
    arrival : float or None, [s]
        When its end was reached.
    end_speed : float or None, [m/s]
        What is left at an end at rest.
    end_deviation, deviation : Deviation or None
        From the plan, at the end of the phase and at worst.
    """

    arrival: float | None
    end_speed: float | None
    end_deviation: Deviation | None
    deviation: Deviation | None


class ReplayFigures(NamedTuple):
    """The replay of a whole plan.

    Attributes
    ----------
    least_c_n : LeastForce
    phases : tuple of ReplayedPhase
    residual : float
        What the samples leave of the equations of motion, in the scene's own units.
    refinements : tuple of int
        How often the intervals of each phase were doubled for the replay to hold; -1 for a plan
        without a search for contact modes.
    steps : int
        Of the simulation.
    simulations : int or None
        How many replays were made before one held, that one included; None where a file of an
        earlier version does not say.
    """

    least_c_n: LeastForce
    phases: tuple[ReplayedPhase, ...]
    residual: float
    refinements: tuple[int, ...]
    steps: int
    simulations: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        phases = [
            own._asdict()
            | {key: _write(getattr(own, key)) for key in ("end_deviation", "deviation")}
            for own in self.phases
        ]
        lists = {"phases": phases, "refinements": list(self.refinements)}
        return self._asdict() | {"least_c_n": self.least_c_n._asdict()} | lists

    @staticmethod
    def of(given: Mapping[str, Any]) -> ReplayFigures:
        """The figures that `to_dict` has written."""
        phases = [
            ReplayedPhase(
                own["arrival"],
                own["end_speed"],
                _read(own["end_deviation"]),
                _read(own["deviation"]),
            )
            for own in given["phases"]
        ]
        return ReplayFigures(
            LeastForce(**given["least_c_n"]),
            tuple(phases),
            float(given["residual"]),
            tuple(given["refinements"]),
            int(given["steps"]),
            given.get("simulations"),
        )


def _write(deviation: Deviation | None) -> dict[str, float | None] | None:
    if deviation is None:
        return None
    when = deviation.time if math.isfinite(deviation.time) else None
    return {"m": deviation.position, "rad": deviation.angle, "s": when}


def _read(given: Mapping[str, Any] | None) -> Deviation | None:
    if given is None:
        return None
    when = given.get("s")
    return Deviation(float(given["m"]), float(given["rad"]), math.nan if when is None else when)
