"""What a motion is short of where there is no plan, and what would make one possible, as data."""

from __future__ import annotations

from typing import NamedTuple


class Parameter(NamedTuple):
    """A number that sets limits, and may be changed to let a motion be planned.

    Attributes
    ----------
    name : str
    value : float
        As it is.
    unit : str
    sign : int
        1 if limits give way as it grows, -1 if as it falls (not below zero).
    key : str
        Key of it in a problem, for `Problem.with_`; `duration` is an option.
    mirrored : str
        Key of what has minus this value, such as the base of the other finger.
    """

    name: str
    value: float
    unit: str
    sign: int
    key: str = ""
    mirrored: str = ""

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


class Place(NamedTuple):
    """Where in a motion something is.

    Attributes
    ----------
    phase : int
        Number of the phase.
    time : float, [s]
        From the start of the first of the phases that have no plan.
    text : str
        Both in words, or the pose.
    """

    phase: int
    time: float
    text: str


class Shortfall(NamedTuple):
    """A limit that cannot be kept.

    Attributes
    ----------
    kind : str
        What it limits: `press`, `cone`, `torque`, `speed`.
    part : str
        The contact or finger concerned.
    limit : str
        The limit in words, with its value.
    amount : float
        By how much it is missed at worst.
    unit : str
    place : Place
        Where that is.
    share : float
        The amount over what is much for such a limit, which shortfalls are ranked by.
    """

    kind: str
    part: str
    limit: str
    amount: float
    unit: str
    place: Place
    share: float

    def __str__(self) -> str:
        return f"{self.limit} is {self.amount:.3g} {self.unit} short at {self.place.text}"
