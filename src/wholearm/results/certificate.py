"""Lower bounds of the durations of a plan, and how near it comes to them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TimeBound:
    """A lower bound of the time of phases that are planned together."""

    phases: tuple[int, ...]  # their numbers
    duration: float  # [s]: what the plan takes for them
    bound: float | None  # [s]: no motion along their curves takes less; None where nothing is known
    error: float | None  # [s]: estimate of the bound's own error, which it is lowered by
    reason: str = ""  # why there is no bound, or empty

    derived = ("gap",)

    @property
    def gap(self) -> float | None:
        """How much longer than the bound the plan takes at most, relative to the bound."""
        return None if self.bound is None else self.duration / self.bound - 1


@dataclass(frozen=True)
class Certificate:
    """Lower bounds of the durations of all phases of a plan."""

    parts: tuple[TimeBound, ...]

    derived = ("total",)

    @property
    def gaps(self) -> dict[int, float]:
        """The gap of each phase that has a bound, by its number; zero where the plan is below."""
        return {
            phase: max(part.gap, 0.0)
            for part in self.parts
            if part.gap is not None
            for phase in part.phases
        }

    @property
    def total(self) -> TimeBound | None:
        """The bound of all phases that have one, together; None without any."""
        known = [part for part in self.parts if part.bound is not None]
        if not known:
            return None
        return TimeBound(
            tuple(phase for part in known for phase in part.phases),
            sum(part.duration for part in known),
            sum(part.bound or 0.0 for part in known),
            sum(part.error or 0.0 for part in known),
        )
