"""Stages, parts of a motion with one formation and fixed contact modes; schemes, units."""

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
    # (d, d) or (d + 1, d), integration matrix: each row integrates the interpolating polynomial
    # from 0 to a point, the last one to 1, also if that is no point
    weights: Array
    order: int  # of the error at the end of an interval
    controls: int  # number of control points of the torques in an interval

    @property
    def degree(self) -> int:
        """Number of points d."""
        return len(self.points)

    @property
    def has_end(self) -> bool:
        """Whether the last point is the end of the interval."""
        return bool(self.points[-1] == 1.0)

    def interpolate(self, x: Array) -> Array:
        """Lagrange basis of the points at `x`, shape (n,): a matrix of shape (n, d)."""
        powers = np.arange(self.degree)
        inverse = np.linalg.inv(self.points[:, None] ** powers)
        return np.asarray(x[:, None] ** powers @ inverse)


def bernstein(places: Array, count: int) -> Array:
    """Bernstein polynomials at `places`, shape (..., count): weights of the control points.

    A polynomial lies within the hull of its control points, and begins and ends at the outer ones.
    """
    k, n = np.arange(count), count - 1
    choices = np.array([comb(n, index) for index in k.tolist()], dtype=float)
    x = np.asarray(places)[..., None]
    return np.asarray(choices * x**k * (1 - x) ** (n - k))


def fit_controls(places: Array, values: Array, count: int) -> Array:
    """Control points of least-squares polynomials through values, shape (..., count, m)."""
    return np.asarray(np.linalg.pinv(bernstein(places, count)) @ values)


@lru_cache(maxsize=8)
def make_scheme(name: str, degree: int, controls: int = 2) -> Scheme:
    """Radau IIA points, order 2 d - 1, or Gauss-Legendre points, order 2 d.

    Zeros of P_d - P_d-1, which include 1, or of P_d (E. Hairer and G. Wanner, Solving Ordinary
    Differential Equations II, section IV.5). `controls` is the number of control points of torques.
    """
    radau, powers = name == "radau", np.arange(1, degree + 1)
    inner = jacobi_nodes(degree - 1, 1, 0) if radau else jacobi_nodes(degree)
    ends = np.append((inner + 1) / 2, 1.0)
    points = ends[:degree]
    weights = (ends[:, None] ** powers / powers) @ np.linalg.inv(points[:, None] ** (powers - 1))
    return Scheme(name, points, weights, 2 * degree - radau, controls)


class StagePoints(NamedTuple):
    """Motion and forces of a stage in K intervals with d points each."""

    h: Array  # (K,) [s]: durations of the intervals
    nodes: Array  # (K + 1, 2, 5): z and z' at the start of each interval and at the end of the last
    z: Array  # z, v, a (K, d, 5): z, z' and z'' at the collocation points
    v: Array
    a: Array
    forces: Array  # (K, d, n_c + R) [N]: c_n of all contacts, then c_t of the rolling ones
    tau: Array  # (K, m, 2) [N m]: control points of torques, of degree m - 1 in each interval
    impulses: Array  # (n_c + R,) [N s]: of the impact at the end of the stage; (0,) without one

    @property
    def duration(self) -> float:
        """Duration of the stage [s]."""
        return float(self.h.sum())

    @property
    def fractions(self) -> Array:
        """Durations of the intervals over that of the stage, shape (K,)."""
        return np.asarray(self.h / self.duration)

    @property
    def breaks(self) -> Array:
        """Starts of the intervals and end of the last, fractions of the duration, (K + 1,)."""
        breaks = np.append(0.0, np.cumsum(self.fractions))
        breaks[-1] = 1.0
        return breaks

    def places(self, points: Array) -> Array:
        """Times of `points` of every interval, fractions of the duration, shape (K, n)."""
        return np.asarray(self.breaks[:-1, None] + self.fractions[:, None] * points)


@dataclass(frozen=True, eq=False)
class Stage:
    """A part of a motion with one formation and fixed directions of friction."""

    phase: int  # index of its phase
    formation: Formation
    directions: Directions
    guess: StagePoints  # initial guess, on the intervals of the NLP
    goal: Until | None = None  # end of its phase; None for a release
    impact: bool = False  # whether its phase ends in an impact, before another phase
    until: Until | None = None  # end of the stage; None if it ends by a reversal or a release
    reversals: tuple[int, ...] = ()  # rows of (contacts, joints) whose rate is zero at the end
    next_formation: Formation | None = None  # of the next stage, if it has new constraints
    # contacts released by the next stage, with 0, or starting to slide, with their direction
    ending_constraints: tuple[tuple[int, float], ...] = ()
    new_contacts: tuple[int, ...] = ()  # contacts that the previous stage does not have
    ends_in_impact: bool = False
    ends_at_rest: bool = False  # before another phase, or after the last one
    ends_in_range: bool = False  # whether it ends within the range of the contact gained there
    monitored: tuple[int, ...] = ()  # limits of the formation that are constraints at the points
    released: tuple[int, ...] = ()  # limits of the contacts released at the start of the phase
    opens: bool = False  # whether they are released at the start of this stage
    # least acceleration of their gaps, over gravity; None after an impact, which gives them a rate
    opening: float | None = OPENING
    clearance: float = CLEARANCE  # their least gap after 1/3 of the stage, over the gyration radius
    clear_at_end: tuple[int, ...] = ()  # limits with that gap at the end: the next phase's
    # row of z, its value at the end of the phase, and the sign of its approach
    approach: tuple[int, float, float] | None = None
    # (5,): prescribed end of the last stage, NaN for coordinates that follow from the others
    end_pose: Array | None = None
    periods: tuple[int, ...] = ()  # control period of each interval, if torques are held
    # duration of a control period, in the scene's unit; 0: the same unknown for all periods
    period: float = 0.0
    smoothing: float = 0.0  # of the friction homotopy, tanh(rate / smoothing); 0: Coulomb friction

    @property
    def intervals(self) -> int:
        """Number of intervals K."""
        return len(self.guess.h)

    @property
    def ending(self) -> Formation:
        """Formation at rest at the end: with two or more freedoms it has the gained contact."""
        if self.formation.n_constraints >= 4 or self.until is None or self.until.contact is None:
            return self.formation
        return make_formation(self.formation.scene, (*self.formation.contacts, self.until.contact))

    def move_to(self, scene: Scene) -> Stage:
        """Copy in a scene with other limits."""
        return replace(self, formation=make_formation(scene, *self.formation.equations[1:]))

    def stretch(self, factor: float) -> Stage:
        """Copy whose guess takes `factor` times as long."""
        part = self.guess
        nodes, v, a = part.nodes / [[1.0], [factor]], part.v / factor, part.a / factor**2
        return replace(self, guess=part._replace(h=factor * part.h, nodes=nodes, v=v, a=a))

    def begin_at(self, z: Array, v: Array) -> Stage:
        """Copy with another initial state of the guess, (5,) each."""
        nodes = self.guess.nodes.copy()
        nodes[0] = z, v
        return replace(self, guess=self.guess._replace(nodes=nodes))

    def list_clearances(self, places: Array, after: float) -> Array:
        """Lower bounds of monitored limits at `places`, (n,), of the stage: (n, n_monitored).

        The clearance counts from the fraction `after` of the stage on; for contacts released before
        the stage it counts throughout. With continuous torques gaps open with the cube of time.
        """
        continuous = self.formation.scene.has_slow_motors
        late = (np.minimum(places / after, 1.0) ** 3 if continuous else places > after)[:, None]
        released, clear = (np.isin(self.monitored, k) for k in (self.released, self.clear_at_end))
        opened = np.where(self.opens, late, 1.0)
        return np.asarray(self.clearance * np.maximum(released * opened, clear * late))

    def measure_rates(self, z: Array, v: Array) -> Array:
        """Rates of contacts and joints in the stage's directions, shape (n, n_c + 2) [rad/s].

        Sliding velocities are divided by the radius of gyration; z and v have the shape (n, 5).
        """
        slip = np.einsum("nij,nj->ni", self.formation.evaluate(z, v).A_t, v)
        rates = np.hstack([slip / self.formation.scene.polygon.gyration_radius, v[:, 3:]])
        return np.asarray(rates * np.concatenate(self.directions))


class LimitViolations(NamedTuple):
    """Nonnegative violations of a stage's limits between points, or amounts of their tightening."""

    sides: Array  # (K, n_sides): of limits of forces, torques and speeds, over their scales
    gaps: Array  # (K, n_limits): of monitored limits of the formation
    rates: Array  # (K, n_c + 2): of least rates of contacts and joints; 0 for rolling contacts

    @staticmethod
    def none(stage: Stage) -> LimitViolations:
        """Zero violations."""
        formation = stage.formation
        n_sides = len(make_limits(formation, 0.0).sides[0])
        widths = (n_sides, len(formation.limits), formation.n_contacts + 2)
        return LimitViolations(*(np.zeros((stage.intervals, width)) for width in widths))

    def add(self, violations: LimitViolations, factors: Sequence[float]) -> LimitViolations:
        """Sum with other amounts, times a factor for each kind."""
        triples = zip(self, violations, factors, strict=True)
        return LimitViolations(*(amounts + factor * other for amounts, other, factor in triples))

    def halve(self, halvings: Numbers) -> LimitViolations:
        """On intervals halved that many times, (K,); zero on halved ones."""
        tables = (np.where(halvings[:, None] > 0, 0.0, amounts) for amounts in self)
        return LimitViolations(*(np.repeat(table, 2**halvings, axis=0) for table in tables))


make_formation = lru_cache(maxsize=128)(Formation)
"""A formation of a scene with contacts, some of which roll; the same object every time."""


@lru_cache(maxsize=16)
def in_scene_units(problem: Problem) -> Problem:
    """The problem in the units of its scene; the same object every time."""
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
        # With one freedom pins are redundant.
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
    """A stage in SI units, as a part of the problem in SI units."""
    points = StagePoints(*map(mul, stage.guess, unit_points(problem.scene.scales)))
    formation = problem.phases[stage.phase].formation
    rolling = stage.formation.rolling
    if set(rolling) != set(formation.rolling):
        rolling = tuple(contact for contact in formation.contacts if contact in rolling)
        formation = make_formation(formation.scene, formation.contacts, rolling)
    return replace(stage, formation=formation, guess=points, next_formation=None)


def resample(part: StagePoints, scheme: Scheme, breaks: Array) -> StagePoints:
    """Points on other intervals with `breaks`, (K + 1,), fractions of the duration."""
    lengths, (count, controls) = np.diff(breaks), part.tau.shape[:2]
    shape = (len(lengths), scheme.degree, -1)
    places = breaks[:-1, None] + lengths[:, None] * scheme.points
    points = _interpolate(part, scheme, places.ravel())
    nodes = np.stack(_interpolate(part, scheme, breaks)[:2], axis=1)
    z, v, a, forces = (table.reshape(shape) for table in points)
    # Each new interval takes the torque polynomial of the old interval at its middle.
    middles = (breaks[1:] + breaks[:-1]) / 2
    k = np.clip(np.searchsorted(part.breaks, middles, side="right") - 1, 0, count - 1)
    grid = np.linspace(0.0, 1.0, controls)
    places = breaks[:-1, None] + lengths[:, None] * grid
    x = np.clip((places - part.breaks[k, None]) / part.fractions[k, None], 0.0, 1.0)
    tau = fit_controls(grid, bernstein(x, controls) @ part.tau[k], controls)
    impulses = part.impulses if breaks[-1] == 1.0 else part.impulses[:0]
    return StagePoints(part.duration * lengths, nodes, z, v, a, forces, tau, impulses)


def _interpolate(part: StagePoints, scheme: Scheme, places: Array) -> tuple[Array, ...]:
    """z, z', z'' and forces at `places`, by the collocation polynomials of the intervals."""
    count, degree = len(part.h), scheme.degree
    # z'' and forces may step after the last point of an interval.
    k = np.clip(np.searchsorted(part.breaks, places - 1e-12) - 1, 0, count - 1)
    x = (places - part.breaks[k]) / part.fractions[k]
    powers = np.arange(degree + 1)
    full = x[:, None] ** powers @ np.linalg.inv(np.append(0.0, scheme.points)[:, None] ** powers)
    z, v = (
        np.einsum("nj,njd->nd", full, np.concatenate([first[k, None], table[k]], axis=1))
        for first, table in ((part.nodes[:-1, 0], part.z), (part.nodes[:-1, 1], part.v))
    )
    basis = scheme.interpolate(x)
    a, forces = (np.einsum("nj,njd->nd", basis, table[k]) for table in (part.a, part.forces))
    return z, v, a, forces


def with_controls(part: StagePoints, count: int) -> StagePoints:
    """Points with another number of control points of the torques."""
    controls = part.tau.shape[1]
    grid = np.linspace(0.0, 1.0, max(count, controls))
    return part._replace(tau=fit_controls(grid, bernstein(grid, controls) @ part.tau, count))


def bisect_intervals(
    stages: Sequence[Stage], scheme: Scheme, times: Sequence[Numbers]
) -> list[Stage]:
    """Stages with halved intervals; `times` are numbers of halvings, (K,) for each stage."""
    bisected = list[Stage]()
    for stage, counts in zip(stages, times, strict=True):
        if counts.any():
            breaks, periods = stage.guess.breaks, stage.periods
            parts = zip(breaks[:-1], breaks[1:], 2**counts, strict=True)
            pieces = [np.linspace(a, b, count, endpoint=False) for a, b, count in parts]
            guess = resample(stage.guess, scheme, np.append(np.concatenate(pieces), 1.0))
            periods = tuple(np.repeat(periods, 2 ** counts[: len(periods)]).tolist())
            stage = replace(stage, guess=guess, periods=periods)
        bisected.append(stage)
    return bisected


def monitor(stages: list[Stage], least: Sequence[Array], tolerance: float) -> list[Stage]:
    """Stages that also monitor the limits whose least values, (n_limits,), are below -tolerance.

    The range of a contact gained at the end counts, too. The same list if nothing changes.
    """
    extended = list[Stage]()
    for stage, values in zip(stages, least, strict=True):
        violated = np.flatnonzero(values < -tolerance).tolist()
        monitored = tuple(sorted({*stage.monitored, *violated}))
        ends_in_range = stage.ends_in_range or _find_excess(stage) > tolerance
        if monitored != stage.monitored or ends_in_range != stage.ends_in_range:
            stage = replace(stage, monitored=monitored, ends_in_range=ends_in_range)
        extended.append(stage)
    return extended if any(map(is_not, extended, stages)) else stages


def _find_excess(stage: Stage) -> float:
    """Distance of a stage's end outside of the range of the contact gained there; 0 within it.

    Case: without it goal 52 of the corpus lands past a fingertip, and takes 6 % longer.
    """
    until, formation = stage.until, stage.formation
    pins = 0 if until is None else len(until.pins)
    if until is None or until.contact is None or 5 - formation.n_constraints - pins < 2:
        return 0.0
    names, gained = {limit.text for limit in formation.limits}, formation.add(until.contact)
    values = gained.evaluate_limits(stage.guess.nodes[-1:, 0])[0].tolist()
    pairs = zip(gained.limits, values, strict=True)
    return max([0.0, *(-float(value) for limit, value in pairs if limit.text not in names)])
