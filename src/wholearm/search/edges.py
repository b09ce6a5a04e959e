"""Edges between places: phases along borders and through cells, with estimated durations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array, Numbers
from ..contacts.elemental import Contact
from ..contacts.formation import CurvePoint, Formation
from ..geometry.curve import Curve, describe_pose, directions_of
from ..geometry.tracing import END_TOL, find_headings, trace_curve
from ..mechanics.dynamics import metric_weights, reduced_inertia
from ..mechanics.path_limits import PathLimits
from ..mechanics.speed_sweep import NoMotionError, find_duration, make_cosine_grid, speed_sweep
from ..mechanics.uniqueness import find_minors
from ..planning.blocks import BEND, compute_curve_impact
from ..planning.lower_bound import PathTerms, bound_least_time, find_limits
from ..problem.definition import End, Goal, Phase, Until
from .places import RoadmapPlace, locate_goal, make_place

INTERVALS = 24  # intervals of the speed sweep along a border
REFINEMENT = 8  # factor of the number of intervals if the first sweep finds no motion
SAMPLES = 12  # further places of each segment at which jamming and uniqueness are checked
INDEPENDENT = 1e-12  # least Gram determinant of unit rows of independent contacts
DEPENDENT = "its contacts depend on each other"
MAX_VIOLATION = 0.01  # violation of a limit after a small step, over the step, at a border's end
SAFETY = 0.999  # safety factor of coarse bounds; quadrature errors are up to 2e-5 in seven scenes
PART_INTERVALS = 16  # intervals of the speed sweep along a part of a border


class NoStop(str):
    """Reason why no motion along curves ends at rest; a motion that continues may be possible."""


class BorderLimits(NamedTuple):
    """Limits of motions along a border; reasons are empty if there is none."""

    obstruction: str  # why no motion passes: jamming, or contact forces are not unique
    free_length: float  # [m]: length of the first part without obstruction
    no_start: str  # why no motion begins at rest at the start
    no_stop: str  # why no motion ends at rest at the end
    z: Array  # (n, 5): configuration at a place in each interval
    limits: PathLimits  # limits there, without the internal force
    steps: Array  # (n,) [m]: lengths of the intervals
    offsets: Array  # (n,): relative position of the place in its interval


def estimate_duration(borders: Sequence[BorderLimits], ratios: Sequence[float]) -> float | str:
    """Estimated duration [s] of a motion along borders from rest to rest, or why there is none.

    Speed sweep with the limits of one place in each interval. Speeds are scaled by `ratios`, so
    that they are continuous where two borders meet.
    """
    scaled = [
        (*b.limits.scale(ratio), b.steps / ratio, b.offsets, b.z)
        for b, ratio in zip(borders, ratios, strict=True)
    ]
    rows, cap, steps, offsets, z = (np.concatenate(column) for column in zip(*scaled, strict=True))
    try:
        return float(find_duration(speed_sweep(PathLimits(rows, cap), steps, offsets).b, steps))
    except NoMotionError as error:
        return f"no motion keeps its limits at {describe_pose(z[min(error.interval, len(z) - 1)])}"


def _find_ambiguity(
    curve: Curve, s: Array, point: CurvePoint, owners: Numbers, margin: float
) -> tuple[str, float]:
    """Why contact forces along a curve are not unique (else empty), and the length before [m].

    Checked at places s, (n,), of segments `owners`, (n,); `margin` is the least uniqueness margin.
    """
    formation = curve.formation
    directions = directions_of(curve, owners)
    rows = point.kinematics.P / np.sqrt(metric_weights(formation.scene))
    rows = rows / np.linalg.norm(rows, axis=2, keepdims=True)
    volumes = np.linalg.det(rows @ rows.transpose(0, 2, 1))
    inertia = reduced_inertia(formation, point.kinematics, directions)
    minors = find_minors(formation, point.kinematics, directions.Xi)
    dependent = ~(np.isfinite(inertia) & (volumes > INDEPENDENT))
    invalid = dependent | (inertia <= 0) | (minors.ratios < margin)
    if not invalid.any():
        return "", curve.length
    first = s[invalid].min()
    first_row = int(np.where(invalid, s, np.inf).argmin())
    free = float(s[s < first].max(initial=0.0))
    if dependent[s == first].any():
        z = point.z[first_row]
        values = formation.evaluate_limits(z[None])[0]
        touching = [
            f": {limit.text}"
            for limit, value in zip(formation.limits, values, strict=True)
            if abs(value) < formation.scene.touching
        ]
        return f"{DEPENDENT} at {describe_pose(z)}{''.join(touching[:1])}", free
    if inertia[~dependent].min() <= 0:
        return "friction jams it", free
    ratio, names, k = minors.find_least()
    return f"{names} ambiguous: uniqueness margin {ratio:.2f} at {describe_pose(point.z[k])}", free


class EdgeStep(NamedTuple):
    """One phase of an edge."""

    contacts: tuple[Contact, ...]
    until: Until
    end: End = End.REST


@dataclass(frozen=True, eq=False)
class Edge:
    """An edge of the roadmap: phases from rest at one place to rest at another.

    `estimate` orders the search; `bound` is a lower bound of the duration of all plans.
    """

    start: RoadmapPlace
    stop: RoadmapPlace
    steps: tuple[EdgeStep, ...]
    estimate: float  # [s]: estimated least time
    chain: Chain | None = None  # borders that it follows; None if it leads through a cell
    continues: bool = False  # whether motions may pass its end without a stop; not at a goal
    curve: Curve | None = None  # border that it follows before the cell
    fraction: float = 0.0  # part of this border that it follows, over its length

    @property
    def in_cell(self) -> bool:
        """Whether it leads through a cell; then the planner optimizes its end."""
        return self.chain is None

    @cached_property
    def bound(self) -> float:
        """Lower bound of the duration on a coarse grid [s]."""
        bound = bound_least_time(*self._path, INTERVALS, grids=1)
        return bound.value if bound else 0.0

    @cached_property
    def fine_bound(self) -> float:
        """Lower bound on a refined grid, up to rounding [s]."""
        bound = bound_least_time(*self._path)
        return max(SAFETY * self.bound, bound.value if bound else 0.0)

    @property
    def _path(self) -> tuple[list[Curve], float]:
        """Curves of the borders, and the least normal force [N]."""
        assert self.chain is not None
        pairs = zip(self.chain.borders, self.chain.ratios, strict=True)
        curves = [border.curve.with_speed_ratio(ratio) for border, ratio in pairs]
        return curves, self.chain.borders[0].epsilon


class BlockedEdge(NamedTuple):
    """An edge without a feasible motion."""

    start: RoadmapPlace
    steps: tuple[EdgeStep, ...]
    reason: str
    stop: RoadmapPlace
    border: BorderEdge  # the first one, up to the end of the edge


@dataclass(frozen=True, eq=False)
class BorderEdge:
    """A border from a place in one direction, up to the end of its formation."""

    start: RoadmapPlace
    curve: Curve
    epsilon: float  # [N]: least normal force
    uniqueness_margin: float  # the least one (P-matrix)

    def __getstate__(self) -> dict[str, Any]:
        # Limits are not stored: they are large, and quickly recomputed.
        return {name: value for name, value in self.__dict__.items() if name != "limits"}

    @cached_property
    def stop(self) -> RoadmapPlace:
        """The place at its end."""
        return make_place(self.formation.scene, self.curve.end)

    @cached_property
    def gained(self) -> Contact | None:
        """The contact that is gained at its end; None at an obstacle."""
        formation = self.formation
        values = np.abs(formation.evaluate_limits(np.array([self.curve.start, self.curve.end])))
        touching = values[1] < formation.scene.touching
        # A contact that is closed at the start, such as the end of a flush edge, is not gained.
        was_open = values[0] > END_TOL * formation.scene.scales.length
        rows = [*np.flatnonzero(touching & was_open), *np.flatnonzero(touching)]
        return next(filter(None, (formation.limits[k].gained for k in rows)), None)

    @cached_property
    def limits(self) -> BorderLimits:
        """Limits of motions along it, on the default grid."""
        return self.find_limits(INTERVALS)

    def find_limits(self, intervals: int) -> BorderLimits:
        """Limits of motions along it, with arc length as parameter."""
        curve = self.curve
        terms = PathTerms((curve,), self.epsilon)
        grid = terms.make_grid(intervals)
        nodes, count = terms.place(grid.angles), len(grid.owners) + 2
        middles = terms.place((grid.angles[1:] + grid.angles[:-1]) / 2)
        last = len(curve.segments) - 1
        samples = [
            np.linspace(segment.start, min(segment.stop, curve.length), SAMPLES)
            for segment in curve.segments
        ]
        s = np.concatenate([[0.0, curve.length], middles, *samples])
        owners = np.concatenate([[0, last], grid.owners, np.repeat(np.arange(last + 1), SAMPLES)])
        steps = np.diff(nodes)
        try:
            point = curve.evaluate(s)
            obstruction, free = _find_ambiguity(curve, s, point, owners, self.uniqueness_margin)
            limits = find_limits(curve, self.epsilon, point.pick(slice(count)), owners[:count])
        except np.linalg.LinAlgError:
            z, zeros = np.zeros((len(steps), 5)), np.zeros(len(steps))
            limits = PathLimits(np.zeros((len(steps), 1, 4)), zeros)
            return BorderLimits(DEPENDENT, 0.0, "", "", z, limits, steps, zeros)
        reasons = list[str]()
        for k, sign, verb in ((0, 1.0, "begins"), (1, -1.0, "ends")):
            place_limits, reason = limits.pick(k), ""
            if not place_limits.can_rest(sign):
                reason = f"no motion {verb} at rest at {describe_pose(point.z[k])}"
            elif curve.formation.scene.has_slow_motors and not place_limits.holds:
                reason = (
                    f"no torques hold the object on the verge of it at {describe_pose(point.z[k])}"
                )
            reasons.append(reason)
        no_start, no_stop = reasons
        inner = slice(2, count)
        offsets = (middles - nodes[:-1]) / steps
        return BorderLimits(
            obstruction, free, no_start, no_stop, point.z[inner], limits.pick(inner), steps, offsets
        )

    @property
    def formation(self) -> Formation:
        """The formation of the border."""
        return self.curve.formation


def follow_borders(
    place: RoadmapPlace, formation: Formation, epsilon: float, uniqueness_margin: float
) -> list[BorderEdge]:
    """The border of a formation from a place, in both directions."""
    headings, step = find_headings(formation, place.z), END_TOL * place.scene.scales.length
    if not headings:
        return []
    # Most borders end at their start: a limit is violated after a small step.
    next_limits = formation.evaluate_limits(place.z + step * np.array(headings)).min(axis=1)
    borders = []
    for heading, limit in zip(headings, next_limits.tolist(), strict=True):
        if limit >= -MAX_VIOLATION * step:
            curve = trace_curve(formation, place.z, heading, Until())
            if curve.length > step and curve.is_regular:
                borders.append(BorderEdge(place, curve, epsilon, uniqueness_margin))
    return borders


def end_at_pose(contacts: Sequence[Contact], z: Array) -> Until:
    """Terminal condition at z, (5,), on the coordinate that changes along a border."""
    if sum(contact.finger is None for contact in contacts) == 2:
        return Until(coordinate="x", value=float(z[0]))
    return Until(coordinate="phi", value=float(z[2]))


def describe_steps(steps: Sequence[EdgeStep]) -> str:
    """Phases of an edge in words."""
    return ", then ".join(
        f"{' '.join(c.name for c in step.contacts)} until {step.until}" for step in steps
    )


def time_parts(border: BorderEdge, fractions: Array) -> Array:
    """Estimated least times along first parts of a border, from rest to rest, shape (n,) [s].

    Infinite if there is no motion, or contact forces are not unique. `fractions`, increasing, are
    lengths of the parts over that of the border.
    """
    curve, times = border.curve, np.full(len(fractions), np.inf)
    lengths = fractions * curve.length
    lengths = lengths[lengths <= border.limits.free_length]
    if not len(lengths) or border.limits.no_start:
        return times
    steps, places, offsets = make_cosine_grid(PART_INTERVALS)
    s = lengths[:, None] * places
    stops = np.array([part.stop for part in curve.segments[:-1]])
    point, segment = curve.evaluate(s.ravel()), np.searchsorted(stops, s.ravel())
    rows, cap = find_limits(curve, border.epsilon, point, segment)
    limits = PathLimits(rows.reshape(*s.shape, *rows.shape[1:]), cap.reshape(s.shape))
    # The path parameter is s over the length of the part.
    motion = speed_sweep(limits.scale(lengths[:, None]), steps, offsets, sweeps=2)
    times[: len(lengths)] = motion.find_durations(steps)
    return times


@dataclass(frozen=True, eq=False)
class Chain:
    """A sequence of borders that are passed without a stop, up to the last one."""

    borders: tuple[BorderEdge, ...]
    steps: tuple[EdgeStep, ...] = ()  # phases along all but the last one
    ratios: tuple[float, ...] = (1.0,)  # factors of the speeds, for which the speed is continuous

    def can_enter(self, formation: Formation) -> bool:
        """Whether a formation has the gained contact, and no other new one."""
        last = self.borders[-1]
        contacts, previous = set(formation.contacts), set(last.formation.contacts)
        return last.gained in contacts and contacts <= {*previous, last.gained}

    def extend(self, following: BorderEdge) -> Chain | None:
        """The chain with another border, entered without a stop; None if that is not possible."""
        last, gained = self.borders[-1], self.borders[-1].gained
        if not self.can_enter(following.formation):
            return None
        (v,) = last.curve.interpolate(np.array([last.curve.length]))[1]
        (heading,) = following.curve.interpolate(np.zeros(1))[1]
        same_direction = v * metric_weights(last.formation.scene) @ heading > 1 - 2 * BEND
        ends = (End.SMOOTH, End.IMPACT) if same_direction else (End.IMPACT,)
        for end in ends:
            phase = Phase(0, last.formation, Until(contact=gained), end)
            impact = compute_curve_impact(phase, last.curve, following.curve)
            if impact.possible and np.isfinite(impact.ratio):
                steps = (*self.steps, EdgeStep(last.formation.contacts, phase.until, end))
                ratios = (*self.ratios, self.ratios[-1] * impact.ratio)
                return Chain((*self.borders, following), steps, ratios)
        return None

    @cached_property
    def edge(self) -> Edge | BlockedEdge | None:
        """The edge along all borders; None if the last one ends at an obstacle."""
        gained = self.borders[-1].gained
        return None if gained is None else self.stop_at(Until(contact=gained), continues=True)

    def end_at(self, goal: Goal) -> Edge | BlockedEdge | None:
        """The edge to a goal on the last border; None if there is none."""
        *before, last = self.borders
        place = locate_goal(last.curve, goal)
        if place is None:
            return None
        curve = replace(last.curve, length=place[0], ending="", reached=True)
        chain = replace(self, borders=(*before, replace(last, curve=curve)))
        return chain.stop_at(place[1])

    def stop_at(self, until: Until, continues: bool = False) -> Edge | BlockedEdge:
        """The edge to rest at the end of the last border, without a stop before.

        Motions can pass all borders but the last one.
        """
        first, last = self.borders[0], self.borders[-1]
        steps = (*self.steps, EdgeStep(last.formation.contacts, until))
        reason = last.limits.obstruction or first.limits.no_start or NoStop(last.limits.no_stop)
        # If limits are tight, there may be no motion on a coarse grid, but one on a fine grid.
        for intervals in () if reason else (INTERVALS, REFINEMENT * INTERVALS):
            refined = intervals != INTERVALS
            limits = [b.find_limits(intervals) if refined else b.limits for b in self.borders]
            duration = estimate_duration(limits, self.ratios)
            if not isinstance(duration, str):
                return Edge(first.start, last.stop, steps, duration, self, continues)
            reason = NoStop(duration)
        return BlockedEdge(first.start, steps, reason, last.stop, first)
