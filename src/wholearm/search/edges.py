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
from ..geometry.tracing import HELD, find_headings, trace_curve
from ..mechanics.dynamics import metric_weights, reduced_inertia
from ..mechanics.path_limits import PathLimits
from ..mechanics.speed_sweep import NoMotionError, find_duration, make_cosine_grid, speed_sweep
from ..mechanics.uniqueness import find_minors
from ..planning.blocks import BEND, compute_curve_impact
from ..planning.lower_bound import PathTerms, bound_least_time, find_limits
from ..problem.definition import End, Goal, Phase, Until
from .places import RoadmapPlace, make_place, measure_along

INTERVALS = 24  # intervals of the speed sweep along a border
FINE = 8  # times as many where it finds no motion
CHECKED = 12  # further places of each segment that are checked for jamming and uniqueness
INDEPENDENT = 1e-12  # least Gram determinant of unit rows of independent contacts
DEPENDENT = "its contacts depend on each other"
BARRED = 0.01  # violation of a limit a small step ahead, over the step, where a border ends
ROUGHLY = 0.999  # safety factor of coarse bounds; quadrature errors are up to 2e-5 in seven scenes
PARTED = 16  # intervals of the speed sweep along a part of a border


class Unstopped(str):
    """Reason why no motion along curves ends at rest; one that passes on may be possible."""


class BorderLimits(NamedTuple):
    """Limits of motions along a border or its first part; reasons are empty without one."""

    closed: str  # why nothing passes: friction jams it, or contact forces are not unique
    clear: float  # [m]: length of the first part that is not closed
    begins: str  # why no motion begins at rest at the start
    ends: str  # why no motion ends at rest at the end
    z: Array  # (n, 5): a place in each interval
    limits: PathLimits  # limits there, without the internal force
    steps: Array  # (n,) [m]: lengths of the intervals
    part: Array  # (n,): share of each interval before its place


def estimate_duration(borders: Sequence[BorderLimits], ratios: Sequence[float]) -> float | str:
    """Estimated duration [s] of a motion along borders from rest to rest, or why there is none.

    Speed sweep with the limits of one place in each interval. With speed `ratios` the speed is
    continuous where two borders meet.
    """
    scaled = [
        (*b.limits.scale(ratio), b.steps / ratio, b.part, b.z)
        for b, ratio in zip(borders, ratios, strict=True)
    ]
    rows, cap, steps, part, z = (np.concatenate(column) for column in zip(*scaled, strict=True))
    try:
        return float(find_duration(speed_sweep(PathLimits(rows, cap), steps, part).b, steps))
    except NoMotionError as error:
        return f"no motion keeps its limits at {describe_pose(z[min(error.interval, len(z) - 1)])}"


def _find_ambiguity(
    curve: Curve, s: Array, at: CurvePoint, owners: Numbers, least: float
) -> tuple[str, float]:
    """Why contact forces along a curve are not unique (else empty), and up to where they are [m].

    At places s, (n,), of segments `owners`, (n,); `least` is the uniqueness margin (P-matrix).
    """
    formation = curve.formation
    directions = directions_of(curve, owners)
    rows = at.kinematics.P / np.sqrt(metric_weights(formation.scene))
    rows = rows / np.linalg.norm(rows, axis=2, keepdims=True)
    volumes = np.linalg.det(rows @ rows.transpose(0, 2, 1))
    inertia = reduced_inertia(formation, at.kinematics, directions)
    minors = find_minors(formation, at.kinematics, directions.Xi)
    lost = ~(np.isfinite(inertia) & (volumes > INDEPENDENT))
    bad = lost | (inertia <= 0) | (minors.ratios < least)
    if not bad.any():
        return "", curve.length
    first = s[bad].min()
    least_place = int(np.where(bad, s, np.inf).argmin())
    clear = float(s[s < first].max(initial=0.0))
    if lost[s == first].any():
        z = at.z[least_place]
        values = formation.evaluate_limits(z[None])[0]
        met = [
            f": {limit.text}"
            for limit, value in zip(formation.limits, values, strict=True)
            if abs(value) < formation.scene.touching
        ]
        return f"{DEPENDENT} at {describe_pose(z)}{''.join(met[:1])}", clear
    if inertia[~lost].min() <= 0:
        return "friction jams it", clear
    ratio, names, row = minors.find_least()
    return f"{names} ambiguous: uniqueness margin {ratio:.2f} at {describe_pose(at.z[row])}", clear


class EdgeStep(NamedTuple):
    """One phase of an edge."""

    contacts: tuple[Contact, ...]
    until: Until
    end: End = End.REST


@dataclass(frozen=True, eq=False)
class Edge:
    """An edge of the roadmap: phases from rest at one place to rest at another.

    `estimate` orders the search, `bound` is below every plan.
    """

    start: RoadmapPlace
    stop: RoadmapPlace
    steps: tuple[EdgeStep, ...]
    estimate: float  # [s]: of its least time
    chain: Chain | None = None  # borders that it follows, if it leads through no cell
    onwards: bool = False  # whether motions may go on beyond its end without a stop; not at a goal
    left: Curve | None = None  # the border that it leaves for the cell
    share: float = 0.0  # the part of that which it follows

    @property
    def in_cell(self) -> bool:
        """Whether it leads through a cell, where the planner optimizes its end."""
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
        return max(ROUGHLY * self.bound, bound.value if bound else 0.0)

    @property
    def _path(self) -> tuple[list[Curve], float]:
        """Curves of the borders, and the least normal force [N]."""
        assert self.chain is not None
        pairs = zip(self.chain.borders, self.chain.ratios, strict=True)
        curves = [border.curve.with_speed_ratio(ratio) for border, ratio in pairs]
        return curves, self.chain.borders[0].epsilon


class Blocked(NamedTuple):
    """An edge without a feasible motion."""

    start: RoadmapPlace
    steps: tuple[EdgeStep, ...]
    reason: str
    stop: RoadmapPlace
    border: BorderEdge  # the first one, as far as it is to be followed


@dataclass(frozen=True, eq=False)
class BorderEdge:
    """A border followed from a place in one direction, as far as its formation holds."""

    start: RoadmapPlace
    curve: Curve
    epsilon: float  # [N]: least normal force
    uniqueness_margin: float  # the least one (P-matrix)

    def __getstate__(self) -> dict[str, Any]:
        # Limits are large, and soon computed again.
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
        met = values[1] < formation.scene.touching
        # A contact that is closed at the start, such as the end of a flush edge, is not gained.
        opened = values[0] > HELD * formation.scene.scales.length
        rows = [*np.flatnonzero(met & opened), *np.flatnonzero(met)]
        return next(filter(None, (formation.limits[k].gained for k in rows)), None)

    @cached_property
    def limits(self) -> BorderLimits:
        """Limits of motions along it, on the usual grid."""
        return self.find_limits(INTERVALS)

    def find_limits(self, intervals: int) -> BorderLimits:
        """Limits of motions along it, with arc length as parameter."""
        curve = self.curve
        terms = PathTerms((curve,), self.epsilon)
        grid = terms.make_grid(intervals)
        nodes, count = terms.place(grid.angles), len(grid.owners) + 2
        middles = terms.place((grid.angles[1:] + grid.angles[:-1]) / 2)
        last = len(curve.segments) - 1
        checked = [
            np.linspace(part.start, min(part.stop, curve.length), CHECKED)
            for part in curve.segments
        ]
        s = np.concatenate([[0.0, curve.length], middles, *checked])
        owners = np.concatenate([[0, last], grid.owners, np.repeat(np.arange(last + 1), CHECKED)])
        steps = np.diff(nodes)
        try:
            at = curve.evaluate(s)
            closed, clear = _find_ambiguity(curve, s, at, owners, self.uniqueness_margin)
            limits = find_limits(curve, self.epsilon, at.pick(slice(count)), owners[:count])
        except np.linalg.LinAlgError:
            z, none = np.zeros((len(steps), 5)), np.zeros(len(steps))
            limits = PathLimits(np.zeros((len(steps), 1, 4)), none)
            return BorderLimits(DEPENDENT, 0.0, "", "", z, limits, steps, none)
        reasons = list[str]()
        for k, sign, what in ((0, 1.0, "begins"), (1, -1.0, "ends")):
            here, reason = limits.pick(k), ""
            if not here.can_rest(sign):
                reason = f"no motion {what} at rest at {describe_pose(at.z[k])}"
            elif curve.formation.scene.has_slow_motors and not here.holds:
                reason = (
                    f"no torques hold the object on the verge of it at {describe_pose(at.z[k])}"
                )
            reasons.append(reason)
        begins, ends = reasons
        inner = slice(2, count)
        part = (middles - nodes[:-1]) / steps
        return BorderLimits(
            closed, clear, begins, ends, at.z[inner], limits.pick(inner), steps, part
        )

    @property
    def formation(self) -> Formation:
        """The formation along it."""
        return self.curve.formation


def follow_borders(
    place: RoadmapPlace, formation: Formation, epsilon: float, uniqueness_margin: float
) -> list[BorderEdge]:
    """The border of a formation from a place, in both directions."""
    headings, least = find_headings(formation, place.z), HELD * place.scene.scales.length
    if not headings:
        return []
    # Most borders end where they start: then a limit is violated a small step ahead.
    ahead = formation.evaluate_limits(place.z + least * np.array(headings)).min(axis=1)
    borders = []
    for heading, limit in zip(headings, ahead.tolist(), strict=True):
        if limit >= -BARRED * least:
            curve = trace_curve(formation, place.z, heading, Until())
            if curve.length > least and curve.is_regular:
                borders.append(BorderEdge(place, curve, epsilon, uniqueness_margin))
    return borders


def point_out(contacts: Sequence[Contact], z: Array) -> Until:
    """The coordinate that changes along a border, as the end of a phase there."""
    if sum(contact.finger is None for contact in contacts) == 2:
        return Until(coordinate="x", value=float(z[0]))
    return Until(coordinate="phi", value=float(z[2]))


def describe_steps(steps: Sequence[EdgeStep]) -> str:
    """Phases of an edge in words."""
    return ", then ".join(
        f"{' '.join(c.name for c in step.contacts)} until {step.until}" for step in steps
    )


def time_parts(border: BorderEdge, shares: Array) -> Array:
    """Estimated least times along first parts of a border, from rest to rest, shape (n,) [s].

    Infinite where there is no motion, or contact forces are not unique. Lengths of the parts over
    that of the border are `shares`, increasing.
    """
    curve, times = border.curve, np.full(len(shares), np.inf)
    lengths = shares * curve.length
    lengths = lengths[lengths <= border.limits.clear]
    if not len(lengths) or border.limits.begins:
        return times
    steps, places, part = make_cosine_grid(PARTED)
    s = lengths[:, None] * places
    stops = np.array([each.stop for each in curve.segments[:-1]])
    point, segment = curve.evaluate(s.ravel()), np.searchsorted(stops, s.ravel())
    rows, cap = find_limits(curve, border.epsilon, point, segment)
    limits = PathLimits(rows.reshape(*s.shape, *rows.shape[1:]), cap.reshape(s.shape))
    # With the share of each part as path parameter.
    motion = speed_sweep(limits.scale(lengths[:, None]), steps, part, sweeps=2)
    times[: len(lengths)] = motion.find_durations(steps)
    return times


@dataclass(frozen=True, eq=False)
class Chain:
    """Borders that are followed to their ends in motion, and one after them."""

    borders: tuple[BorderEdge, ...]
    steps: tuple[EdgeStep, ...] = ()  # phases along all but the last one
    ratios: tuple[float, ...] = (1.0,)  # speed ratios of all borders: the speed is continuous

    def can_enter(self, formation: Formation) -> bool:
        """Whether a formation keeps the gained contact and has no others that are new."""
        last = self.borders[-1]
        contacts, held = set(formation.contacts), set(last.formation.contacts)
        return last.gained in contacts and contacts <= {*held, last.gained}

    def extend(self, following: BorderEdge) -> Chain | None:
        """The chain with another border entered in motion; None if impossible."""
        last, gained = self.borders[-1], self.borders[-1].gained
        if not self.can_enter(following.formation):
            return None
        (v,) = last.curve.interpolate(np.array([last.curve.length]))[1]
        (heading,) = following.curve.interpolate(np.zeros(1))[1]
        continues = v * metric_weights(last.formation.scene) @ heading > 1 - 2 * BEND
        ends = (End.SMOOTH, End.IMPACT) if continues else (End.IMPACT,)
        for end in ends:
            phase = Phase(0, last.formation, Until(contact=gained), end)
            join = compute_curve_impact(phase, last.curve, following.curve)
            if join.possible and np.isfinite(join.ratio):
                steps = (*self.steps, EdgeStep(last.formation.contacts, phase.until, end))
                ratios = (*self.ratios, self.ratios[-1] * join.ratio)
                return Chain((*self.borders, following), steps, ratios)
        return None

    @cached_property
    def edge(self) -> Edge | Blocked | None:
        """The edge along all of it; None where the last border ends at an obstacle."""
        gained = self.borders[-1].gained
        return None if gained is None else self.stop_at(Until(contact=gained), onwards=True)

    def end_at(self, goal: Goal) -> Edge | Blocked | None:
        """The edge to a goal on the last border; None if there is none."""
        *before, last = self.borders
        place = measure_along(last.curve, goal)
        if place is None:
            return None
        curve = replace(last.curve, length=place[0], ending="", reached=True)
        chain = replace(self, borders=(*before, replace(last, curve=curve)))
        return chain.stop_at(place[1])

    def stop_at(self, until: Until, onwards: bool = False) -> Edge | Blocked:
        """The edge to rest at the end of the last border, without a stop between.

        Motions can pass all borders but the last one.
        """
        first, last = self.borders[0], self.borders[-1]
        steps = (*self.steps, EdgeStep(last.formation.contacts, until))
        reason = last.limits.closed or first.limits.begins or Unstopped(last.limits.ends)
        # Where motions hardly pass, a coarse grid may let none pass.
        for intervals in () if reason else (INTERVALS, FINE * INTERVALS):
            fine = intervals != INTERVALS
            limits = [b.find_limits(intervals) if fine else b.limits for b in self.borders]
            duration = estimate_duration(limits, self.ratios)
            if not isinstance(duration, str):
                return Edge(first.start, last.stop, steps, duration, self, onwards)
            reason = Unstopped(duration)
        return Blocked(first.start, steps, reason, last.stop, first)
