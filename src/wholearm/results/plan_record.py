"""What a plan records beside its motion: contact modes, lower bounds, impacts, ranges, replay."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

DEPARTURE = 1e-3  # largest `Deviation` from a plan, over the scene's length, and in rad
ROLLS = "rolls"  # mode of a contact that rolls; one that slides has the sign of its direction


class Deviation(NamedTuple):
    """Largest difference between planned and simulated state."""

    position: float  # [m]: of the coordinates x and y
    angle: float  # [rad]: of phi and the joint angles
    time: float  # [s]: when the larger of the two was, positions counting over the scene's length

    def measure(self, length: float) -> float:
        """Its size, over the scene's `length` [m] and in rad; zero where none is known."""
        sizes = self.position / length, self.angle
        return max((size for size in sizes if not math.isnan(size)), default=0.0)


class ModeSpan(NamedTuple):
    """A stretch of a phase in which every contact keeps its mode."""

    start: float  # start, stop [s]: from the start of the phase
    stop: float
    contacts: Mapping[str, str]  # ``"+"``, ``"-"`` or ``"rolls"`` by the name of the contact
    joints: tuple[str, ...]  # which way each joint turns, ``"+"`` or ``"-"``


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
        bounded_parts = [part for part in self.parts if part.bound is not None]
        if not bounded_parts:
            return None
        return TimeBound(
            tuple(phase for part in bounded_parts for phase in part.phases),
            sum(part.duration for part in bounded_parts),
            sum(part.bound or 0.0 for part in bounded_parts),
            sum(part.error or 0.0 for part in bounded_parts),
        )


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
    # [s], [(N m)^2 s] or [N]: how much better than with a stop the objective is of phases planned
    # together; NaN if the impact is not possible, or there is no plan with a stop
    saves: float

    @property
    def stop(self) -> str:
        """Why the motion stops there; empty if it does not."""
        return "" if self.possible else f"stops: {self.reason}"


class RangeFigures(NamedTuple):
    """A plan that keeps its limits for all numbers within their ranges."""

    radii: Mapping[str, float]  # half widths of the ranges by name, as they were planned with
    nominal: float  # the objective without ranges
    largest: float | None = None  # factor on the ranges up to which there is a plan, if looked for
    # the same for each phase, planned with those that impacts join it to; None in the time domain
    phases: tuple[float | None, ...] = ()
    capped: bool = False  # whether the factor is as large as ranges make sense
    held: tuple[int, ...] = ()  # numbers of phases whose start friction may hold within the ranges


class LeastForce(NamedTuple):
    """The least normal force of a replay [N]: of which contact, in which phase, and when [s]."""

    value: float
    contact: str
    phase: int
    time: float


class ReplayedPhase(NamedTuple):
    """One phase of the replay."""

    arrival: float | None  # [s]: when its end was reached
    end_speed: float | None  # [m/s]: what is left at an end at rest
    # end_deviation, deviation: from the plan, at the end of the phase and at worst
    end_deviation: Deviation | None
    deviation: Deviation | None


class ReplayFigures(NamedTuple):
    """The replay of a whole plan."""

    least_c_n: LeastForce
    phases: tuple[ReplayedPhase, ...]
    residual: float  # what the samples leave of the equations of motion, in the scene's own units
    steps: int  # of the simulation
    simulations: int | None = None  # replays up to the one that held; None in earlier versions
