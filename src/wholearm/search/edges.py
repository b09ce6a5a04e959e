"""Links between places: phases along borders, and through cells, with about how long they take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..geometry.arcs import find_on, join, take
from ..geometry.curve import Curve
from ..geometry.tracing import HELD, trace_curve
from ..mechanics.metric import metric_weights
from ..planning.lower_bound.lower_bound import bound_least_time, bound_roughly
from ..planning.lower_bound.rows import PathLimitRows, evaluate_rows
from ..problem.definition import End, Until
from .border_limits import INTERVALS, Ground, Unstopped, sketch, survey
from .places import RoadmapPlace, make_place
from .travel_times import find_durations

BARRED = 0.01
"""By how much limits are missed a little way on, over that way, where no border leads on."""
ROUGHLY = 0.999
"""Share of a bound on a coarse grid that is one: its quadrature errs by 2e-5 at most, measured over
the borders of seven scenes."""
PARTED = 16  # Intervals on which the fastest motion along a part of a border is looked for


class Terms(NamedTuple):
    """What motions have to keep: the least normal force [N], and the least ratio of minors."""

    epsilon: float
    uniqueness_margin: float


class EdgeStep(NamedTuple):
    """One phase of a link."""

    contacts: tuple[Contact, ...]
    until: Until
    end: End = End.REST


@dataclass(frozen=True, eq=False)
class Link:
    """A way from one place to another, from rest to rest."""

    start: RoadmapPlace
    stop: RoadmapPlace
    steps: tuple[EdgeStep, ...]
    duration: float  # [s]: about how long it takes
    # whether it leads through a cell. Then the planner chooses where it ends, the duration is that
    # of straight ways, and nothing bounds it from below.
    in_cell: bool = False
    left: Curve | None = None  # the border that it leaves for the cell
    share: float = 0.0  # which part of that it follows
    borders: tuple[BorderEdge, ...] = ()  # those that it follows, if it leads through no cell
    # their speed ratios, with which the speed is the same on both sides of where two meet
    ratios: tuple[float, ...] = ()

    @cached_property
    def bound(self) -> float:
        """How long it takes at least [s]."""
        if self.in_cell:
            return 0.0
        own = zip(self.borders, self.ratios, strict=True)
        curves = [border.curve.with_speed_ratio(ratio) for border, ratio in own]
        return max(0.0, bound_roughly(curves, self.borders[0].terms.epsilon, INTERVALS))

    @cached_property
    def fine_bound(self) -> float:
        """The same on a grid that is refined: no more than the least time, but by rounding [s]."""
        own = zip(self.borders, self.ratios, strict=True)
        curves = [border.curve.with_speed_ratio(ratio) for border, ratio in own]
        found = bound_least_time(curves, self.borders[0].terms.epsilon)
        return max(ROUGHLY * self.bound, found.value if found else 0.0)

    @property
    def signature(self) -> tuple[tuple[str, ...], ...]:
        """The contacts of its phases, by which routes differ."""
        return tuple(tuple(sorted(c.name for c in step.contacts)) for step in self.steps)


class Blocked(NamedTuple):
    """A link that no motion can take."""

    start: RoadmapPlace
    steps: tuple[EdgeStep, ...]
    reason: str
    stop: RoadmapPlace


@dataclass(frozen=True, eq=False)
class BorderEdge:
    """A border followed one way from a place, as far as its formation holds."""

    start: RoadmapPlace
    curve: Curve
    gained: Contact | None  # what is gained at its end; None where it ends at an obstacle
    terms: Terms

    def __getstate__(self) -> dict[str, Any]:
        # What is seen of a border is large, and soon seen again.
        return {name: value for name, value in self.__dict__.items() if name != "ground"}

    @cached_property
    def stop(self) -> RoadmapPlace:
        """Where it ends."""
        return make_place(self.formation.scene, self.curve.end)

    @cached_property
    def ground(self) -> Ground:
        """What motions along it may do."""
        return survey(self.curve, *self.terms)

    @property
    def formation(self) -> Formation:
        """The contacts that touch along it."""
        return self.curve.formation


def follow_borders(
    place: RoadmapPlace, formation: Formation, terms: Terms, known: list[Curve]
) -> list[BorderEdge]:
    """The border of a formation from a place, one way and the other, as far as it leads on.

    Parameters
    ----------
    known  whole borders of these contacts, to which those that are traced are added
    """
    least = HELD * place.scene.scales.length
    for whole in known:
        s = find_on(whole, place.z)
        if s is not None:
            ends = (whole.length, 0.0) if find_headings(whole.formation, place.z) else ()
            curves = [take(whole, s, end) for end in ends if abs(end - s) > least]
            break
    else:
        curves = _trace(formation, place.z, known)
    return [BorderEdge(place, curve, _find_gained(curve), terms) for curve in curves]


def _trace(formation: Formation, z: Array, known: list[Curve]) -> list[Curve]:
    """The curves of a formation from a place; the whole of them is added to those known."""
    headings = find_headings(formation, z)
    if not headings:
        return []
    least, ways = HELD * formation.scene.scales.length, list[Curve | None]()
    # Most end where they begin, which limits a little way on tell.
    ahead = formation.evaluate_limits(z + least * np.array(headings)).min(axis=1)
    for heading, limit in zip(headings, ahead.tolist(), strict=True):
        barred = limit < -BARRED * least
        curve = None if barred else trace_curve(formation, z, heading, Until())
        ways.append(curve if curve is not None and curve.length > least else None)
    curves = [curve for curve in ways if curve is not None and _is_regular(curve)]
    if curves and len(curves) == 2 - ways.count(None):
        known.append(join(*ways[::-1]))
    return curves


def find_headings(formation: Formation, z: Array) -> tuple[Array, ...]:
    """Both unit tangents of a formation's curve at `z`; none where it has more than one."""
    metric = np.sqrt(metric_weights(formation.scene))
    P = formation.evaluate(z[None], np.zeros((1, 5))).P[0] / metric
    _, values, right = np.linalg.svd(P)
    if values[-1] < 1e-7 * values[0]:
        return ()
    null = right[-1] / metric
    return null, -null


def _is_regular(curve: Curve) -> bool:
    try:
        return bool(curve.segments)
    except np.linalg.LinAlgError:
        return False


def _find_gained(curve: Curve) -> Contact | None:
    """The contact that is gained at the end of a curve."""
    formation = curve.formation
    values = np.abs(formation.evaluate_limits(np.array([curve.start, curve.end])))
    met = values[1] < formation.scene.touching
    # What is closed from the start, such as the end of a flush edge, is not what is waited for.
    opened = values[0] > HELD * formation.scene.scales.length
    for rows in (met & opened, met):
        for k in np.flatnonzero(rows):
            if formation.limits[k].gained is not None:
                return formation.limits[k].gained
    return None


def point_out(contacts: Sequence[Contact], z: Array) -> Until:
    """A place on a border by the coordinate that changes along it."""
    if sum(contact.finger is None for contact in contacts) == 2:
        return Until(coordinate="x", value=float(z[0]))
    return Until(coordinate="phi", value=float(z[2]))


def leave_at(link: Link, share: float) -> tuple[EdgeStep, ...]:
    """The phases of a link that leaves a border, with the border left somewhere else."""
    assert link.left is not None
    z = link.left.evaluate(np.array([share * link.left.length])).z[0]
    first, *rest = link.steps
    return (first._replace(until=point_out(first.contacts, z)), *rest)


def describe_steps(steps: Sequence[EdgeStep]) -> str:
    """Phases of a link in words."""
    return ", then ".join(
        f"{' '.join(c.name for c in step.contacts)} until {step.until}" for step in steps
    )


def cut_curve(curve: Curve, length: float) -> Curve:
    """The first part of a curve."""
    return replace(curve, length=length, ending="", reached=True)


def time_parts(border: BorderEdge, shares: Array) -> Array:
    """About the least times along first parts of a border, from rest to rest, shape (n,) [s].

    Infinite where no motion keeps the limits, none begins at rest, or contact forces are not the
    only ones.

    Parameters
    ----------
    shares : (n,)  lengths of the parts, increasing, over that of the border
    """
    curve, times = border.curve, np.full(len(shares), np.inf)
    lengths = shares * curve.length
    lengths = lengths[lengths <= border.ground.clear]
    if not len(lengths) or border.ground.begins:
        return times
    nodes = (1 - np.cos(np.linspace(0, np.pi, PARTED + 1))) / 2
    places, steps = (nodes[1:] + nodes[:-1]) / 2, np.diff(nodes)
    s, size = lengths[:, None] * places, lengths[:, None]
    stops = np.array([part.stop for part in curve.segments[:-1]])
    rows = evaluate_rows(curve, border.terms.epsilon, s.ravel(), np.searchsorted(stops, s.ravel()))
    # By the share of each part that is behind, not by its length.
    a, b, v, one, cap = (part.reshape(*s.shape, *part.shape[1:]) for part in rows)
    scale = size[..., None]
    scaled = PathLimitRows(scale * a, scale**2 * b, scale * v, one, cap / size**2)
    times[: len(lengths)] = find_durations(scaled, steps, (places - nodes[:-1]) / steps)
    return times


def link_along(
    borders: tuple[BorderEdge, ...],
    ratios: tuple[float, ...],
    steps: tuple[EdgeStep, ...],
    stop: RoadmapPlace,
) -> Link | Blocked:
    """The link along borders that are passed without a stop, at rest at the end of the last one.

    Parameters
    ----------
    borders  those before the last one are known to let motions pass
    ratios   their speed ratios, with which the speed is the same on both sides of where two meet
    """
    start, last = borders[0].start, borders[-1].ground
    reason = last.closed or ("" if len(borders) > 1 else last.begins)
    if reason:
        return Blocked(start, steps, reason, stop)
    grounds = zip(borders, ratios, strict=True)
    found = last.ends or sketch([own.ground.with_speed_ratio(ratio) for own, ratio in grounds])
    if isinstance(found, str):
        return Blocked(start, steps, Unstopped(found), stop)
    return Link(start, stop, steps, found, borders=borders, ratios=ratios)


def link_border(border: BorderEdge) -> Link | Blocked | None:
    """The link along the whole of a border; None where it ends at an obstacle."""
    if border.gained is None:
        return None
    steps = (EdgeStep(border.formation.contacts, Until(contact=border.gained)),)
    return link_along((border,), (1.0,), steps, border.stop)
