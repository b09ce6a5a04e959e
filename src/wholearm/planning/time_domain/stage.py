"""Stages: parts of a motion in the time domain with one formation and fixed contact modes.

Also their units, and interpolation on other intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import comb
from operator import is_not, mul
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import Array, Numbers, jacobi_nodes
from ...common.fields import keys_of
from ...contacts.formation import Formation
from ...mechanics.dynamics import Directions
from ...mechanics.limits import make_limits
from ...problem.definition import Phase, Problem, Until
from ...scene.model import Polygon, Scales, Scene
from ..options import CLEARANCE, OPENING, Objective


class Scheme(NamedTuple):
    """A collocation scheme on [0, 1]."""

    name: str
    points: Array  # (d,): increasing
    # (d, d) or (d + 1, d): each row integrates the interpolating polynomial from 0 to a point, the
    # last one to 1, whether that is a point or not
    rungs: Array
    order: int  # of the error at the end of an interval
    controls: int  # number of control points of the torques in an interval

    @property
    def degree(self) -> int:
        """Number of points d."""
        return len(self.points)

    @property
    def ends(self) -> bool:
        """Whether the last point is the end of the interval."""
        return bool(self.points[-1] == 1.0)

    def interpolate(self, places: Array) -> Array:
        """Values at `places`, shape (n,), from those at the points: a matrix of shape (n, d)."""
        powers = np.arange(self.degree)
        invert = np.linalg.inv(self.points[:, None] ** powers)
        return np.asarray(places[:, None] ** powers @ invert)


def blend(places: Array, count: int) -> Array:
    """Bernstein polynomials at `places`, shape (..., count): shares of the control points.

    A polynomial lies between its control points, the first and last of which are its ends.
    """
    k, n = np.arange(count), count - 1
    choices = np.array([comb(n, index) for index in k.tolist()], dtype=float)
    x = np.asarray(places)[..., None]
    return np.asarray(choices * x**k * (1 - x) ** (n - k))


def fit_controls(places: Array, values: Array, count: int) -> Array:
    """Control points of the polynomials nearest to values at places, shape (..., count, m)."""
    return np.asarray(np.linalg.pinv(blend(places, count)) @ values)


@lru_cache(maxsize=8)
def make_scheme(name: str, degree: int, controls: int = 2) -> Scheme:
    """Radau IIA points, order 2 d - 1, or Gauss-Legendre points, order 2 d.

    Zeros of P_d - P_d-1, 1 among them, or of P_d (E. Hairer and G. Wanner, Solving Ordinary
    Differential Equations II, section IV.5). `controls` are control points of torques.
    """
    radau, powers = name == "radau", np.arange(1, degree + 1)
    inner = jacobi_nodes(degree - 1, 1, 0) if radau else jacobi_nodes(degree)
    ends = np.append((inner + 1) / 2, 1.0)
    points = ends[:degree]
    rungs = (ends[:, None] ** powers / powers) @ np.linalg.inv(points[:, None] ** (powers - 1))
    return Scheme(name, points, rungs, 2 * degree - radau, controls)


class StagePoints(NamedTuple):
    """Motion and forces of a stage in K intervals with d points each."""

    h: Array  # (K,) [s]: durations of the intervals
    nodes: Array  # (K + 1, 2, 5): z and z' at the start of each interval and at the end of the last
    z: Array  # z, v, a (K, d, 5): z, z' and z'' at the collocation points
    v: Array
    a: Array
    forces: Array  # (K, d, n_c + R) [N]: c_n of all contacts, then c_t of the rolling ones
    tau: Array  # (K, m, 2) [N m]: control points of torques, of degree m - 1 in each interval
    impulses: Array  # (n_c + R,) [N s]: of the impact with which the stage ends, if it does

    @property
    def duration(self) -> float:
        """How long the stage lasts [s]."""
        return float(self.h.sum())

    @property
    def fractions(self) -> Array:
        """Share of the duration that each interval has, shape (K,)."""
        return np.asarray(self.h / self.duration)

    @property
    def breaks(self) -> Array:
        """Start of each interval and end of the last, as shares of the duration, shape (K + 1,)."""
        breaks = np.append(0.0, np.cumsum(self.fractions))
        breaks[-1] = 1.0
        return breaks

    def places(self, points: Array) -> Array:
        """Shares of the duration passed at `points` of every interval, shape (K, n)."""
        return np.asarray(self.breaks[:-1, None] + self.fractions[:, None] * points)


@dataclass(frozen=True, eq=False)
class Stage:
    """A part of a motion with one formation and fixed directions of friction."""

    phase: int  # index of its phase
    formation: Formation
    directions: Directions
    guess: StagePoints  # initial guess; its intervals are those of the NLP
    goal: Until | None = None  # what ends its phase; None for a release
    impact: bool = False  # whether its phase ends in one, before another phase
    until: Until | None = None  # reached at the end; None if it ends by a reversal or a release
    turns: tuple[int, ...] = ()  # rows of (contacts, joints) whose rate is zero at the end
    gained: Formation | None = None  # the next stage's, if a constraint of it is gained softly
    # contacts that the next stage releases, with 0, or lets slide, with their direction then
    fading: tuple[tuple[int, float], ...] = ()
    growing: tuple[int, ...] = ()  # contacts that the stage before does not have
    ends_in_impact: bool = False
    rests: bool = False  # whether everything stops at its end, before another phase or after all
    lands: bool = False  # whether the end has to be within the range of the contact gained there
    monitored: tuple[int, ...] = ()  # limits of the formation that are constraints at the points
    released: tuple[int, ...] = ()  # limits of the contacts released where the phase began
    opens: bool = False  # whether they are released at the start of this stage
    # least acceleration of their gaps, over gravity; None if an impact gives these a rate
    opening: float | None = OPENING
    clearance: float = CLEARANCE  # their least gap after a third of it, over the gyration radius
    apart: tuple[int, ...] = ()  # limits as clear at the end, as the next phase closes them
    # row of z, its value where the phase ends, and the side from which it comes there
    ahead: tuple[int, float, float] | None = None
    # (5,): coordinates of the given end of the last one of all stages, NaN for those that follow
    stop: Array | None = None
    periods: tuple[int, ...] = ()  # control period of each interval, if torques are held
    # duration of a control period, in the scene's unit; 0 if all are equal and of any duration
    period: float = 0.0
    onset: float = 0.0  # of the friction homotopy, tanh(rate / onset), if not 0

    @property
    def intervals(self) -> int:
        """Number of intervals K."""
        return len(self.guess.h)

    @property
    def ending(self) -> Formation:
        """The contacts at rest at the end: with several degrees of freedom also the one gained."""
        if self.formation.n_constraints >= 4 or self.until is None or self.until.contact is None:
            return self.formation
        return make_formation(self.formation.scene, (*self.formation.contacts, self.until.contact))

    def move_to(self, scene: Scene) -> Stage:
        """The same stage in a scene with other limits."""
        return replace(self, formation=make_formation(scene, *self.formation.equations[1:]))

    def stretch(self, factor: float) -> Stage:
        """The same stage with a guess that takes so many times as long."""
        part = self.guess
        nodes, v, a = part.nodes / [[1.0], [factor]], part.v / factor, part.a / factor**2
        return replace(self, guess=part._replace(h=factor * part.h, nodes=nodes, v=v, a=a))

    def begin_at(self, z: Array, v: Array) -> Stage:
        """The same stage with another state, (5,) each, where its guess begins."""
        nodes = self.guess.nodes.copy()
        nodes[0] = z, v
        return replace(self, guess=self.guess._replace(nodes=nodes))

    def list_clearances(self, places: Array, after: float) -> Array:
        """Least values of monitored limits at `places`, shape (n,), of the stage: (n, n_monitored).

        From the share `after` of the stage on, but for contacts released before it. With continuous
        torques gaps open with the third power of time.
        """
        slow = self.formation.scene.has_slow_motors
        late = (np.minimum(places / after, 1.0) ** 3 if slow else places > after)[:, None]
        released, apart = (np.isin(self.monitored, k) for k in (self.released, self.apart))
        opened = np.where(self.opens, late, 1.0)
        return np.asarray(self.clearance * np.maximum(released * opened, apart * late))

    def measure_senses(self, z: Array, v: Array) -> Array:
        """Rates of contacts and joints in the stage's directions, shape (n, n_c + 2) [rad/s].

        Those of contacts are over the radius of gyration; z and v have the shape (n, 5).
        """
        slip = np.einsum("nij,nj->ni", self.formation.evaluate(z, v).A_t, v)
        rates = np.hstack([slip / self.formation.scene.polygon.gyration_radius, v[:, 3:]])
        return np.asarray(rates * np.concatenate(self.directions))


class LimitMisses(NamedTuple):
    """Nonnegative amounts by which limits of one stage are missed between points, or raised."""

    held: Array  # (K, n_sides): of limits of forces, torques and speeds, over their scales
    gap: Array  # (K, n_limits): of the formation's limits that are monitored
    sense: Array  # (K, n_c + 2): of the rates of contacts and joints; zero for rolling contacts

    @staticmethod
    def none(stage: Stage) -> LimitMisses:
        """Nothing is missed."""
        formation = stage.formation
        sides = len(make_limits(formation, 0.0).sides[0])
        widths = (sides, len(formation.limits), formation.n_contacts + 2)
        return LimitMisses(*(np.zeros((stage.intervals, width)) for width in widths))

    def add(self, misses: LimitMisses, factors: Sequence[float]) -> LimitMisses:
        """The sum with other amounts times a factor for each kind."""
        triples = zip(self, misses, factors, strict=True)
        return LimitMisses(*(amounts + factor * more for amounts, more, factor in triples))

    def halve(self, times: Numbers) -> LimitMisses:
        """On intervals halved so many times, (K,); zero on those that are."""
        tables = (np.where(times[:, None] > 0, 0.0, amounts) for amounts in self)
        return LimitMisses(*(np.repeat(table, 2**times, axis=0) for table in tables))


make_formation = lru_cache(maxsize=128)(Formation)
"""A formation of a scene with contacts, some of which roll; the same object every time."""


@lru_cache(maxsize=16)
def in_own_units(problem: Problem) -> Problem:
    """The problem in its scene's own units; the same object every time."""
    scales, scene = problem.scene.scales, problem.scene
    body, units = scene.polygon, {"x": scales.length, "phi": 1.0}
    assert body.inertia is not None

    def scale(owner: Any) -> dict[str, Any]:
        keys = keys_of(owner).items()
        units = {name: getattr(scales, key.scale) for name, key in keys if key.scale}
        return {name: getattr(owner, name) / unit for name, unit in units.items()}

    sizes = body.vertices / scales.length, body.mass / scales.mass, body.inertia / scales.inertia
    right, left = (replace(finger, **scale(finger)) for finger in scene.fingers)
    scene = replace(scene, polygon=Polygon(*sizes), fingers=(right, left), **scale(scene))
    phases = list[Phase]()
    for phase in problem.phases:
        until, formation = phase.until, replace(phase.formation, scene=scene)
        if until.coordinate == "x" and until.value is not None:
            until = replace(until, value=until.value / scales.length)
        # With one freedom nothing is left for pins to say.
        pins = () if formation.n_constraints >= 4 else until.pins
        until = replace(until, pins=tuple((name, value / units[name]) for name, value in pins))
        phases.append(replace(phase, formation=formation, until=until))
    return replace(
        problem,
        scene=scene,
        epsilon=problem.epsilon / scales.force,
        start=problem.start / unit_lengths(scales),
        phases=tuple(phases),
    )


def unit_of(goal: Objective, scales: Scales) -> float:
    """Unit of an objective in SI units."""
    efforts = scales.torque**2 * scales.time
    return {Objective.TIME: scales.time, Objective.EFFORT: efforts}.get(goal, scales.force)


def unit_lengths(scales: Scales) -> Array:
    """Units of the coordinates of z in SI units, shape (5,)."""
    return np.array([scales.length, scales.length, 1.0, 1.0, 1.0])


def unit_points(scales: Scales) -> StagePoints:
    """Units of motion and forces in SI units."""
    z, unit, force = unit_lengths(scales), scales.time, scales.force
    nodes, torque, impulse = np.stack([z, z / unit]), scales.torque, force * unit
    units: Any = (unit, nodes, z, z / unit, z / unit**2, force, torque, impulse)
    return StagePoints(*units)


def to_si(stage: Stage, problem: Problem) -> Stage:
    """A stage in SI units, of the same problem in SI units."""
    points = StagePoints(*map(mul, stage.guess, unit_points(problem.scene.scales)))
    formation = problem.phases[stage.phase].formation
    rolling = stage.formation.rolling
    if set(rolling) != set(formation.rolling):
        rolling = tuple(contact for contact in formation.contacts if contact in rolling)
        formation = make_formation(formation.scene, formation.contacts, rolling)
    return replace(stage, formation=formation, guess=points, gained=None)


def resample(part: StagePoints, scheme: Scheme, breaks: Array) -> StagePoints:
    """Part of a stage on other intervals with `breaks`, (K + 1,), shares of its duration."""
    lengths, (count, controls) = np.diff(breaks), part.tau.shape[:2]
    shape = (len(lengths), scheme.degree, -1)
    places = breaks[:-1, None] + lengths[:, None] * scheme.points
    points = _interpolate(part, scheme, places.ravel())
    nodes = np.stack(_interpolate(part, scheme, breaks)[:2], axis=1)
    z, v, a, forces = (table.reshape(shape) for table in points)
    # Torques of each new interval are those of the old one at its middle.
    middles = (breaks[1:] + breaks[:-1]) / 2
    k = np.clip(np.searchsorted(part.breaks, middles, side="right") - 1, 0, count - 1)
    at = np.linspace(0.0, 1.0, controls)
    places = breaks[:-1, None] + lengths[:, None] * at
    x = np.clip((places - part.breaks[k, None]) / part.fractions[k, None], 0.0, 1.0)
    tau = fit_controls(at, blend(x, controls) @ part.tau[k], controls)
    impulses = part.impulses if breaks[-1] == 1.0 else part.impulses[:0]
    return StagePoints(part.duration * lengths, nodes, z, v, a, forces, tau, impulses)


def _interpolate(part: StagePoints, scheme: Scheme, places: Array) -> tuple[Array, ...]:
    """z, z', z'' and forces at shares of the duration, by the polynomials of the intervals."""
    count, degree = len(part.h), scheme.degree
    # z'' and forces may step after the last point of an interval.
    k = np.clip(np.searchsorted(part.breaks, places - 1e-12) - 1, 0, count - 1)
    x = (places - part.breaks[k]) / part.fractions[k]
    powers = np.arange(degree + 1)
    wide = x[:, None] ** powers @ np.linalg.inv(np.append(0.0, scheme.points)[:, None] ** powers)
    z, v = (
        np.einsum("nj,njd->nd", wide, np.concatenate([first[k, None], table[k]], axis=1))
        for first, table in ((part.nodes[:-1, 0], part.z), (part.nodes[:-1, 1], part.v))
    )
    narrow = scheme.interpolate(x)
    a, forces = (np.einsum("nj,njd->nd", narrow, table[k]) for table in (part.a, part.forces))
    return z, v, a, forces


def with_controls(part: StagePoints, count: int) -> StagePoints:
    """A stage's points with another number of control points of torques."""
    old = part.tau.shape[1]
    at = np.linspace(0.0, 1.0, max(count, old))
    return part._replace(tau=fit_controls(at, blend(at, old) @ part.tau, count))


def bisect_intervals(
    stages: Sequence[Stage], scheme: Scheme, times: Sequence[Numbers]
) -> list[Stage]:
    """Stages with intervals halved so many times, each of shape (K,)."""
    halved = list[Stage]()
    for stage, mine in zip(stages, times, strict=True):
        if mine.any():
            breaks, periods = stage.guess.breaks, stage.periods
            parts = zip(breaks[:-1], breaks[1:], 2**mine, strict=True)
            pieces = [np.linspace(a, b, count, endpoint=False) for a, b, count in parts]
            guess = resample(stage.guess, scheme, np.append(np.concatenate(pieces), 1.0))
            periods = tuple(np.repeat(periods, 2 ** mine[: len(periods)]).tolist())
            stage = replace(stage, guess=guess, periods=periods)
        halved.append(stage)
    return halved


def monitor(stages: list[Stage], least: Sequence[Array], depth: float) -> list[Stage]:
    """Stages with the limits added whose least values, (n_limits,), are below -depth.

    So are those of the range of a contact with which a phase ends. The same list if there are none.
    """
    changed = list[Stage]()
    for stage, values in zip(stages, least, strict=True):
        broken = np.flatnonzero(values < -depth).tolist()
        watched = tuple(sorted({*stage.monitored, *broken}))
        lands = stage.lands or _find_excess(stage) > depth
        if watched != stage.monitored or lands != stage.lands:
            stage = replace(stage, monitored=watched, lands=lands)
        changed.append(stage)
    return changed if any(map(is_not, changed, stages)) else stages


def _find_excess(stage: Stage) -> float:
    """By how much a stage ends outside of the range of the contact that it gains there, if so.

    Goal 52 of the corpus lands past a fingertip without it, and takes 6 % longer.
    """
    until, formation = stage.until, stage.formation
    pins = 0 if until is None else len(until.pins)
    if until is None or until.contact is None or 5 - formation.n_constraints - pins < 2:
        return 0.0
    texts, gained = {limit.text for limit in formation.limits}, formation.add(until.contact)
    values = gained.evaluate_limits(stage.guess.nodes[-1:, 0])[0].tolist()
    pairs = zip(gained.limits, values, strict=True)
    return max([0.0, *(-float(value) for limit, value in pairs if limit.text not in texts)])
