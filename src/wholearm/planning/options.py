"""What to plan for, and how finely."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from ..common.bounds import PLANNER
from ..common.errors import InputError
from ..mechanics.uniqueness import UNIQUENESS_MARGIN, require_uniqueness_margin
from ..problem.uncertainty import PARAMETERS, read_widths


class Objective(Enum):
    """What a plan makes best."""

    TIME = "time"
    """Least duration."""
    EFFORT = "effort"
    """Least integral of tau^T tau, plus a weight on time."""
    MARGIN = "margin"
    """Largest least normal force within a given duration."""
    ELASTIC = "elastic"
    """Least shortfall of the limits; used to explain why there is no plan."""
    RELAX = "relax"
    """Least relaxation of one limit; used to say what would make a plan possible."""


CHOICES = tuple(
    choice.value for choice in Objective if choice not in (Objective.ELASTIC, Objective.RELAX)
)
"""Objectives that a user can ask for."""

_LEFT_OUT = ("intervals", "time_intervals", "duration")
"""Options that the planner chooses where they are not given."""
DEFAULT_ACCURACY = 1e-4
"""The error that is asked for by default."""
OPENING = 0.01
"""Least acceleration of a gap that opens, over gravity."""
CLEARANCE = 5e-4
"""Least gap of a contact that has been let go, over the radius of gyration."""


@dataclass(frozen=True)
class PlanOptions:
    """Options of the planner, each as `wholearm.solve` documents it.

    `ranges` are the radii of a problem's ranges, by name, which `scale_ranges` fills in.

    Raises
    ------
    InputError
        If an option is out of its range.
    """

    objective: Objective | str = Objective.TIME
    intervals: int | None = None
    time_weight: float = 1.0
    duration: float | None = None
    samples: int = 201
    transcription: str = "auto"
    time_intervals: int | None = None
    opening: float = OPENING
    clearance: float = CLEARANCE
    degree: int = 3
    scheme: str = "radau"
    replay: bool = True
    mode_search: bool = True
    certify: bool = False
    accuracy: float = DEFAULT_ACCURACY
    uniqueness_margin: float = UNIQUENESS_MARGIN
    robust: float = 0.0
    largest: bool = False
    ranges: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        given = self.objective
        if given not in CHOICES and given not in [Objective(choice) for choice in CHOICES]:
            raise InputError("", "objective", f"{given!r} given; allowed are {', '.join(CHOICES)}")
        object.__setattr__(self, "objective", Objective(given))
        for key, bounds in PLANNER.items():
            value = getattr(self, key)
            if value is not None or key not in _LEFT_OUT:
                if isinstance(value, np.number):
                    value = value.item()
                bounds.check(key, value)
                object.__setattr__(self, key, value if bounds.whole else float(value))
        if self.scheme not in ("radau", "legendre"):
            given = self.scheme
            raise InputError("", "scheme", f"{given!r} given; allowed are radau and legendre")
        if self.transcription not in ("auto", "time"):
            given = self.transcription
            raise InputError("", "transcription", f"{given!r} given; allowed are auto and time")
        for key in ("replay", "mode_search", "certify", "largest"):
            if not isinstance(value := getattr(self, key), bool):
                raise InputError("", key, f"{value!r} given; allowed are true and false")
        object.__setattr__(
            self, "uniqueness_margin", require_uniqueness_margin(self.uniqueness_margin)
        )
        if self.duration is not None and self.objective is not Objective.MARGIN:
            raise InputError("", "duration", "is for the objective margin only")
        if self.certify and self.objective in (Objective.EFFORT, Objective.MARGIN):
            raise InputError("", "certify", "is for the objective time only")
        if self.certify and self.robust:
            raise InputError("", "certify", "does not go with robust: its bounds know of no ranges")
        if self.largest and not self.robust:
            raise InputError("", "largest", "is for robust plans only")

    def scale_ranges(self, given: Mapping[str, float], factor: float | None = None) -> PlanOptions:
        """The same with ranges of so many times a problem's own, or as many as `robust` says."""
        factor = self.robust if factor is None else factor
        ranges = (
            {key: factor * width for key, width in read_widths(given).items()} if factor else {}
        )
        for own in PARAMETERS:
            if not own.unit and ranges.get(own.name, 0.0) >= 1:
                text = f"{factor:g} makes the range of {own.name} {ranges[own.name]:g}; a relative "
                raise InputError("", "robust", text + "range is below 1")
        return replace(self, ranges=ranges)

    @property
    def goal(self) -> Objective:
        """The objective as an enumeration member."""
        return Objective(self.objective)
