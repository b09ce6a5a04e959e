"""Limits that an infeasible motion misses, and changes of parameters that make one feasible."""

from __future__ import annotations

from typing import NamedTuple


class Parameter(NamedTuple):
    """A number that sets limits, and may be changed to let a motion be planned."""

    name: str
    value: float  # as it is
    unit: str
    sign: int  # 1 if limits give way as it grows, -1 if as it falls (not below zero)
    key: str = ""  # key of it in a problem, for `Problem.with_`; `duration` is an option
    mirrored: str = ""  # key of what has minus this value, such as the base of the other finger

    @property
    def is_speed(self) -> bool:
        """Whether it is a speed, of which motions know the square."""
        return self.unit == "rad/s"


class Change(NamedTuple):
    """A parameter and another value of it that a plan was found with."""

    parameter: Parameter
    value: float

    @property
    def values(self) -> dict[str, float]:
        """What changes, as `Problem.with_` takes it."""
        own = self.parameter
        return {own.key: self.value} | ({own.mirrored: -self.value} if own.mirrored else {})

    def __str__(self) -> str:
        own = self.parameter
        value = f"{self.value:g} {own.unit}".rstrip()
        return f"{own.name} = {value} instead of {own.value:g}"


class LimitPlace(NamedTuple):
    """Where in a motion something is."""

    phase: int  # number of the phase
    time: float  # [s]: from the start of the first of the phases that have no plan
    text: str  # both in words, or the pose


class Shortfall(NamedTuple):
    """A limit that cannot be kept."""

    kind: str  # what it limits: `press`, `cone`, `torque`, `speed`
    part: str  # the contact or finger concerned
    limit: str  # the limit in words, with its value
    amount: float  # by how much it is missed at worst
    unit: str
    place: LimitPlace  # where that is
    share: float  # the amount over what is much for such a limit, which shortfalls are ranked by

    def __str__(self) -> str:
        return f"{self.limit} is {self.amount:.3g} {self.unit} short at {self.place.text}"
