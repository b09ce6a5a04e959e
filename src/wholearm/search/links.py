"""Links between places: phases along borders, and through cells, with about how long they take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..geometry.curve import Curve, describe_pose
from ..geometry.tracing import HELD, trace_curve
from ..mechanics.dynamics import Directions, reduced_inertia
from ..mechanics.metric import metric_weights
from ..mechanics.uniqueness import find_minors
from ..planning.lower_bound.lower_bound import Outlook, look_along
from ..planning.lower_bound.rows import Rows, evaluate_rows
from ..planning.lower_bound.sweep import NoMotionError
from ..problem.definition import End, Until
from .places import Place, make_place
from .sweep import find_durations

INTERVALS = 24
"""Intervals of the grid on which the fastest motion along curves is looked for."""
PARTED = 16
"""The same of parts of a curve, many at once."""
CHECKED = 12
"""Places of a segment at which jamming and ambiguous forces are looked for."""


class Unstopped(str):
    """Why no motion along curves ends at rest, though one that goes on beyond them may be."""


class Step(NamedTuple):
    """One phase of a link."""

    contacts: tuple[Contact, ...]
    until: Until
    end: End = End.REST


@dataclass(frozen=True, eq=False)
class Link:
    """A way from one place to another, from rest to rest.

    Attributes
    ----------
    start, stop : Place
    steps : tuple of Step
    duration, bound : float, [s]
        About how long it takes, and at least.
    in_cell : bool
        Whether it leads through a cell. Then the planner chooses where it ends, the duration is
        that of straight ways, and nothing bounds it from below.
    left : Curve or None
        The border that it leaves for the cell.
    share : float
        Which part of that it follows.
    """

    start: Place
    stop: Place
    steps: tuple[Step, ...]
    duration: float
    bound: float
    in_cell: bool = False
    left: Curve | None = None
    share: float = 0.0

    @property
    def signature(self) -> tuple[tuple[str, ...], ...]:
        """The contacts of its phases, by which routes differ."""
        return tuple(tuple(sorted(c.name for c in step.contacts)) for step in self.steps)


class Blocked(NamedTuple):
    """A link that no motion can take.

    Attributes
    ----------
    start : Place
    steps : tuple of Step
    reason : str
    stop : Place
    """

    start: Place
    steps: tuple[Step, ...]
    reason: str
    stop: Place


@dataclass(frozen=True, eq=False)
class Border:
    """A border followed one way from a place, as far as its formation holds.

    Attributes
    ----------
    start : Place
    curve : Curve
    gained : Contact or None
        What is gained at its end; None where it ends at an obstacle.
    """

    start: Place
    curve: Curve
    gained: Contact | None

    @property
    def formation(self) -> Formation:
        """The contacts that touch along it."""
        return self.curve.formation


def follow_borders(place: Place, formation: Formation) -> list[Border]:
    """The border of a formation from a place, one way and the other, as far as it leads on."""
    found, least = [], HELD * place.scene.scales.length
    for heading in find_headings(formation, place.z):
        curve = trace_curve(formation, place.z, heading, Until())
        if curve.length > least and _is_regular(curve):
            found.append(Border(place, curve, _find_gained(curve)))
    return found


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


def leave_at(link: Link, share: float) -> tuple[Step, ...]:
    """The phases of a link that leaves a border, with the border left somewhere else."""
    assert link.left is not None
    z = link.left.evaluate(np.array([share * link.left.length])).z[0]
    first, *rest = link.steps
    return (first._replace(until=point_out(first.contacts, z)), *rest)


def describe_steps(steps: Sequence[Step]) -> str:
    """Phases of a link in words."""
    return ", then ".join(
        f"{' '.join(c.name for c in step.contacts)} until {step.until}" for step in steps
    )


def cut_curve(curve: Curve, length: float) -> Curve:
    """The first part of a curve."""
    return replace(curve, length=length, ending="", reached=True)


def look_at(
    curves: Sequence[Curve], epsilon: float, least_minor: float, known: int = 0
) -> Outlook | str:
    """About how long motions along curves take, or why there are none, in words.

    Of the first `known` curves it is known that motions begin there and forces are the only ones.
    """
    for curve in curves[known:]:
        reason = _find_ambiguity(curve, least_minor)
        if reason:
            return reason
    if not known and (reason := _find_held(curves[0], epsilon, 0.0)):
        return reason
    if reason := _find_held(curves[-1], epsilon, curves[-1].length):
        return Unstopped(reason)
    try:
        return look_along(curves, epsilon, INTERVALS)
    except NoMotionError as error:
        part = (error.interval + 0.5) / INTERVALS
        length = sum(curve.length for curve in curves)
        s = length * (1 - np.cos(np.pi * min(part, 1.0))) / 2
        for curve in curves:
            if s <= curve.length:
                break
            s -= curve.length
        place = curve.evaluate(np.array([min(s, curve.length)])).z[0]
        return Unstopped(f"no motion keeps its limits at {describe_pose(place)}")


def time_parts(curve: Curve, shares: Array, epsilon: float, least_minor: float) -> Array:
    """About the least times along first parts of a curve, from rest to rest, shape (n,) [s].

    Infinite where no motion keeps the limits, none begins at rest, or contact forces are not the
    only ones.

    Parameters
    ----------
    curve : Curve
    shares : ndarray, shape (n,)
        Lengths of the parts, increasing, over that of the curve.
    epsilon : float, [N]
    least_minor : float
    """
    times, lengths = np.full(len(shares), np.inf), shares * curve.length
    if _find_held(curve, epsilon, 0.0):
        return times
    while len(lengths) and _find_ambiguity(cut_curve(curve, lengths[-1]), least_minor):
        lengths = lengths[:-1]
    if not len(lengths):
        return times
    nodes = (1 - np.cos(np.linspace(0, np.pi, PARTED + 1))) / 2
    places, steps = (nodes[1:] + nodes[:-1]) / 2, np.diff(nodes)
    s, size = lengths[:, None] * places, lengths[:, None]
    stops = np.array([part.stop for part in curve.segments[:-1]])
    rows = evaluate_rows(curve, epsilon, s.ravel(), np.searchsorted(stops, s.ravel()))
    # By the share of each part that is behind, not by its length.
    a, b, v, one, cap = (part.reshape(*s.shape, *part.shape[1:]) for part in rows)
    scale = size[..., None]
    scaled = Rows(scale * a, scale**2 * b, scale * v, one, cap / size**2)
    times[: len(lengths)] = find_durations(scaled, steps, (places - nodes[:-1]) / steps)
    return times


def _find_held(curve: Curve, epsilon: float, s: float) -> str:
    """Why a motion along a curve cannot begin or end at rest at a place; empty if it can."""
    segment = 0 if s == 0 else len(curve.segments) - 1
    rows = evaluate_rows(curve, epsilon, np.array([s]), np.array([segment]))
    a, one = rows.a[0], rows.one[0]
    if s > 0:
        a = -a
    with np.errstate(divide="ignore", invalid="ignore"):
        least = np.where(a > 0, -one / a, 0.0).max()
        most = np.where(a < 0, -one / a, np.inf).min()
    if max(least, 0.0) <= most and not ((a == 0) & (one < 0)).any():
        return ""
    what = "begins" if s == 0 else "ends"
    return f"no motion {what} at rest at {describe_pose(curve.evaluate(np.array([s])).z[0])}"


def _find_ambiguity(curve: Curve, least: float) -> str:
    """Why contact forces along a curve are not the only ones; empty where they are."""
    formation = curve.formation
    for part in curve.segments:
        s = np.linspace(part.start, min(part.stop, curve.length), CHECKED)
        at = curve.evaluate(s)
        inertia = reduced_inertia(formation, at.kinematics, Directions(part.Xi, part.sigma))
        if not np.isfinite(inertia).all():
            return "its contacts depend on each other"
        if inertia.min() <= 0:
            return "friction jams it"
        ratio, names, row = find_minors(formation, at.kinematics, part.Xi).find_least()
        if ratio < least:
            return f"{names} ambiguous: minor {ratio:.2f} at {describe_pose(at.z[row])}"
    return ""


def link_border(border: Border, epsilon: float, least_minor: float) -> Link | Blocked | None:
    """The link along the whole of a border; None where it ends at an obstacle."""
    if border.gained is None:
        return None
    steps = (Step(border.formation.contacts, Until(contact=border.gained)),)
    found = look_at((border.curve,), epsilon, least_minor)
    stop = make_place(border.formation.scene, border.curve.end)
    if isinstance(found, str):
        return Blocked(border.start, steps, found, stop)
    return Link(border.start, stop, steps, found.duration, found.bound)
