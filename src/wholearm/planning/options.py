"""Options of the planner: objective, discretization, verification."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from ..common.errors import InputError
from ..common.fields import declare, read_keys, read_options
from ..mechanics import UNIQUENESS


class Objective(Enum):
    """Objective of a plan."""

    TIME = "time"  # least duration
    EFFORT = "effort"  # least integral of tau^T tau, plus a weight on time
    MARGIN = "margin"  # largest least normal force within a given duration
    ELASTIC = "elastic"  # least shortfall of the limits, for the diagnosis without a plan
    RELAX = "relax"  # least relaxation of one limit, for advice


PLANNER = """\
--objective NAME    time, effort or margin = time among time|effort|margin
--accuracy          relative error of the objective below which refining ends = 1e-4 in 1e-8..0.1
--intervals         intervals of each phase along a curve (as many as the accuracy needs)
    in 10..5000
--duration          longest duration without dwells (settle), for margin [s] (twice the least time)
    in 1e-9..1e9
--time-weight       weight of time, for effort [(N m)^2] = 1 in 1e-30..1e30
--samples           rows per phase of the trajectory file = 201 in 2..100000
--transcription NAME  auto, or time for the time domain throughout = auto among auto|time
--opening           least acceleration of contacts that are let go, over gravity = 0.01 in 0.0..100
--clearance         least gap of contacts that were let go, over the radius of gyration
    = 5e-4 in 0.0..1
--time-intervals    intervals of a phase in the time domain (as many as the accuracy needs)
    in 4..1000
--degree            collocation points of an interval there = 3 in 2..6
--scheme NAME       radau or legendre points = radau among radau|legendre
--no-mode-search    keep the contact modes of the first plan that is found
--no-replay         return the plan without replaying it
--robust [FACTOR]   keep limits within the problem's ranges, [uncertainty], or FACTOR times these
    = 0 in 0.0..1000
--largest           also look for the largest factor with which there is a plan
--certify           bound the least time along curves from below, and print the gap
"""
"""Values beyond these ranges take memory or hours without use."""
_FIELDS = [option.field for option in read_options(PLANNER)]
_DEFAULTS: dict[str, Any] = {option.name: option.default for option in _FIELDS}
DEFAULT_ACCURACY: float = _DEFAULTS["accuracy"]
OPENING: float = _DEFAULTS["opening"]
CLEARANCE: float = _DEFAULTS["clearance"]


@declare(*_FIELDS, UNIQUENESS)
@dataclass(frozen=True)
class PlanOptions:
    """Options of the planner.

    `ranges` are the radii of a problem's ranges, by name, which `scale_ranges` fills in.

    Raises
    ------
    InputError  if an option is out of its range
    """

    objective: Objective | str = Objective.TIME
    intervals: int | None = _DEFAULTS["intervals"]
    time_weight: float = _DEFAULTS["time_weight"]
    duration: float | None = _DEFAULTS["duration"]
    samples: int = _DEFAULTS["samples"]
    transcription: str = _DEFAULTS["transcription"]
    time_intervals: int | None = _DEFAULTS["time_intervals"]
    opening: float = _DEFAULTS["opening"]
    clearance: float = _DEFAULTS["clearance"]
    degree: int = _DEFAULTS["degree"]
    scheme: str = _DEFAULTS["scheme"]
    replay: bool = _DEFAULTS["replay"]
    mode_search: bool = _DEFAULTS["mode_search"]
    certify: bool = _DEFAULTS["certify"]
    accuracy: float = _DEFAULTS["accuracy"]
    uniqueness_margin: float = UNIQUENESS.default
    robust: float = _DEFAULTS["robust"]
    largest: bool = _DEFAULTS["largest"]
    ranges: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        read_keys(self)
        object.__setattr__(self, "objective", Objective(self.objective))
        if self.duration is not None and self.objective is not Objective.MARGIN:
            raise InputError("", "duration", "is for the objective margin only")
        if self.time_weight != _DEFAULTS["time_weight"] and self.objective is not Objective.EFFORT:
            raise InputError("", "time_weight", "is for the objective effort only")
        if self.certify and self.objective in (Objective.EFFORT, Objective.MARGIN):
            raise InputError("", "certify", "is for the objective time only")
        if self.certify and self.robust:
            raise InputError("", "certify", "does not go with robust: its bounds know of no ranges")
        if self.largest and not self.robust:
            raise InputError("", "largest", "is for robust plans only")

    def scale_ranges(self, given: Mapping[str, float], factor: float | None = None) -> PlanOptions:
        """Copy with `factor` times a problem's ranges, by default `robust` times."""
        from ..problem.definition import PARAMETERS, read_widths

        if factor is None and self.ranges:
            text = "are those of the problem: problem.with_(uncertainty=...) changes them"
            raise InputError("", "ranges", text)
        factor = self.robust if factor is None else factor
        widths = read_widths(given) if factor else {}
        ranges = {name: factor * width for name, width in widths.items()}
        for name in (parameter.name for parameter in PARAMETERS if not parameter.unit):
            if ranges.get(name, 0.0) >= 1:
                text = f"{factor:g} makes the range of {name} {ranges[name]:g}"
                raise InputError("", "robust", f"{text}; a relative range is below 1")
        return replace(self, ranges=ranges)

    def roughen(self) -> PlanOptions:
        """Copy with low accuracy, for plans that only have to exist."""
        return replace(self, accuracy=max(self.accuracy, 1e-2))

    def for_least_time(self) -> PlanOptions:
        """Copy with the objective of least time."""
        weight: float = _DEFAULTS["time_weight"]
        return replace(self, objective=Objective.TIME, duration=None, time_weight=weight)

    @property
    def goal(self) -> Objective:
        """The objective as an enumeration member."""
        return Objective(self.objective)
