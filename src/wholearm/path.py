"""One-freedom formations: tracing the curve z(s) that the contacts leave free.

With four sliding contacts A(z) z' = 0 leaves one direction, so the motion runs along a curve. Its
parameter is the arc length s in metres, in the metric

    ds^2 = dx^2 + dy^2 + rho^2 (dphi^2 + dtheta_1^2 + dtheta_2^2),

rho being the object's radius of gyration. A curve is traced panel by panel: on each, the points
whose projection on the panel's first tangent is a Chebyshev-Lobatto node are solved for by Newton,
all at once, and the arc length is integrated spectrally. No coordinate is singled out, so places
where theta_1 (or any other) is stationary are nothing special.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from .contact import Contact
from .errors import InputError
from .formation import TOUCHING, Formation, Kinematics, describe, find_touching
from .model import Array, Scene
from .problem import Phase, Problem, Until, read_problem

NODES = 17
RESOLVED = 1e-13
"""Largest trailing Chebyshev coefficient of a resolved panel, relative to the object's size."""
REFINE = 3 * NODES
"""Points of a panel at which limits and reversals are looked for."""
LONGEST = 60.0
"""Longest curve that is traced, in radii of gyration: several turns of the object."""


class CurvePoint(NamedTuple):
    """A curve at n places: z, its unit tangent z_s and its curvature z_ss, each (n, 5).

    `kinematics` is the formation there.
    """

    z: Array
    z_s: Array
    z_ss: Array
    kinematics: Kinematics


@dataclass(frozen=True, eq=False)
class Panel:
    """A stretch of a curve, as the polynomial through its nodes.

    Attributes
    ----------
    s : ndarray, shape (NODES,), [m]
        Arc lengths of the nodes, increasing.
    z, z_s : ndarray, shape (NODES, 5)
        Configurations and unit tangents there.
    """

    s: Array
    z: Array
    z_s: Array

    @cached_property
    def _weights(self) -> Array:
        # Barycentric weights; on an interval of length 4 their products stay near 1.
        x = 4 * (self.s - self.s[0]) / (self.s[-1] - self.s[0])
        difference = x[:, None] - x[None, :]
        np.fill_diagonal(difference, 1.0)
        return np.asarray(1 / difference.prod(axis=1))

    def interpolate(self, s: Array) -> tuple[Array, Array]:
        """Return z and z_s at the arc lengths `s`, each of shape (n, 5)."""
        difference = s[:, None] - self.s[None, :]
        at_node = difference == 0
        difference[at_node] = 1.0
        terms = self._weights / difference
        rows = at_node.any(axis=1)
        terms[rows] = at_node[rows]
        terms /= terms.sum(axis=1, keepdims=True)
        return terms @ self.z, terms @ self.z_s


@dataclass(frozen=True, eq=False)
class Segment:
    """A stretch of a curve without a reversal.

    Attributes
    ----------
    start, stop : float, [m]
        Arc lengths of its ends.
    Xi : ndarray, shape (n_c,)
        Sliding directions of the contacts for motion along +s.
    sigma : ndarray, shape (2,)
        Directions of the joints for motion along +s.
    """

    start: float
    stop: float
    Xi: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class Curve:
    """The curve z(s) of a one-freedom formation, for s from 0 to `length`.

    Attributes
    ----------
    formation : Formation
    panels : tuple of Panel
    length : float, [m]
    ending : str
        What happens at the end, in words.
    reached : bool
        Whether that is what the curve was traced for.
    """

    formation: Formation
    panels: tuple[Panel, ...]
    length: float
    ending: str
    reached: bool

    def evaluate(self, s: Array) -> CurvePoint:
        """Return z, the unit tangent z_s and the curvature z_ss at arc lengths `s`, shape (n,)."""
        z, tangent = self._interpolate(np.asarray(s, dtype=float))
        formation = self.formation
        kinematics = formation.evaluate(z, tangent)
        metric = metric_weights(formation.scene)
        z_s, z_ss = _solve_tangent(kinematics.A, kinematics.A_dot_v, tangent, metric)
        return CurvePoint(z, z_s, z_ss, kinematics)

    def _interpolate(self, s: Array) -> tuple[Array, Array]:
        starts = np.array([panel.s[0] for panel in self.panels])
        owner = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, None)
        z, tangent = np.empty((len(s), 5)), np.empty((len(s), 5))
        for index, panel in enumerate(self.panels):
            mine = owner == index
            if mine.any():
                z[mine], tangent[mine] = panel.interpolate(s[mine])
        return z, tangent

    @property
    def start(self) -> Array:
        """Configuration at s = 0, shape (5,)."""
        return np.asarray(self.panels[0].z[0])

    @cached_property
    def end(self) -> Array:
        """Configuration at s = length, shape (5,)."""
        return np.asarray(self._interpolate(np.array([self.length]))[0][0])

    def sliding(self, s: Array) -> Array:
        """Sliding rates A_t z_s of the contacts and rates of the joints, shape (n, n_c + 2)."""
        point = self.evaluate(s)
        rho = self.formation.scene.polygon.gyration_radius
        slip = np.einsum("nij,nj->ni", point.kinematics.A_t, point.z_s)
        return np.hstack([slip, rho * point.z_s[:, 3:]])

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """The curve split wherever a contact's sliding or a joint reverses."""
        grids = [_refine(panel.s, self.length) for panel in self.panels]
        grid = np.concatenate([grid[index > 0 :] for index, grid in enumerate(grids)])
        rates = self.sliding(grid)
        rates[np.abs(rates) < 1e-9] = 0.0
        breaks = []
        for column in range(rates.shape[1]):
            moving = np.flatnonzero(rates[:, column])
            flips = np.flatnonzero(np.diff(np.sign(rates[moving, column])))
            for flip in flips:
                low, high = grid[moving[flip]], grid[moving[flip + 1]]

                def rate(s: float, k: int = column) -> float:
                    return float(self.sliding(np.array([s]))[0, k])

                breaks.append(find_root(rate, low, high))
        margin = 1e-7 * self.length
        inner = [s for s in sorted(breaks) if margin < s < self.length - margin]
        ends = [0.0, *(s for i, s in enumerate(inner) if i == 0 or s > inner[i - 1] + margin)]
        segments = []
        for start, stop in zip(ends, [*ends[1:], self.length], strict=True):
            within = rates[(grid > start) & (grid < stop)]
            if not len(within):
                within = self.sliding(np.array([(start + stop) / 2]))
            signs = np.sign(within[np.abs(within).argmax(axis=0), range(rates.shape[1])])
            segments.append(Segment(start, stop, signs[:-2], signs[-2:]))
        return tuple(segments)


def load(path: str) -> Problem:
    """Read a problem file and check that every phase can be carried out geometrically.

    Raises
    ------
    InputError
        If the file is malformed, a formation does not touch, or an `until` is never reached.
    """
    problem = read_problem(path)
    trace_phases(problem)
    return problem


@lru_cache(maxsize=8)
def trace_phases(problem: Problem) -> tuple[Curve, ...]:
    """Trace the curve of every phase, each from the end of the one before.

    Raises
    ------
    InputError
        If a phase's contacts do not touch at its start, or its `until` is never reached.
    """
    curves: list[Curve] = []
    z = problem.start
    for phase in problem.phases:
        _require_touching(problem, phase, z, curves[-1] if curves else None)
        curves.append(_trace_phase(problem, phase, z))
        z = curves[-1].end
    return tuple(curves)


def _require_touching(problem: Problem, phase: Phase, z: Array, before: Curve | None) -> None:
    key = f"phases[{phase.number}].contacts"
    formation = phase.formation
    if formation.n_contacts != 4:
        raise InputError(
            problem.source, key, f"{formation.n_contacts} contacts given; a phase takes 4"
        )
    gaps = formation.evaluate(z[None], np.zeros((1, 5))).C[0]
    if np.abs(gaps).max() > TOUCHING:
        missing = [
            c.name for c, gap in zip(formation.contacts, gaps, strict=True) if abs(gap) > TOUCHING
        ]
        when = "at the start" if before is None else f"at the end of phase {phase.index}"
        touching = describe(find_touching(problem.scene, z))
        raise InputError(
            problem.source,
            key,
            f"{', '.join(missing)} does not touch {when}; touching are {touching}",
        )


def _trace_phase(problem: Problem, phase: Phase, z: Array) -> Curve:
    formation, until = phase.formation, phase.until
    reason = []
    for heading in _headings(formation, z, until):
        curve = trace_curve(formation, z, heading, until)
        if curve.reached:
            return curve
        reason.append(curve.ending)
    raise InputError(
        problem.source,
        f"phases[{phase.number}].until",
        f"{until} is never reached: going one way {reason[0]}, going the other way {reason[1]}",
    )


def _headings(formation: Formation, z: Array, until: Until) -> list[Array]:
    """Both unit tangents at `z`, the one that approaches `until` first."""
    metric = metric_weights(formation.scene)
    A = formation.evaluate(z[None], np.zeros((1, 5))).A[0]
    null = np.linalg.svd(A / np.sqrt(metric))[2][-1] / np.sqrt(metric)
    step = 1e-6 * formation.scene.polygon.gyration_radius
    distances = until_distance(formation, until, np.array([z, z + step * null]))
    forward = null if abs(distances[1]) <= abs(distances[0]) else -null
    return [forward, -forward]


def trace_curve(formation: Formation, z: Array, heading: Array, until: Until) -> Curve:
    """Trace a formation's curve from `z` along `heading` to `until` or to where it ends early.

    Parameters
    ----------
    formation : Formation
        With four contacts.
    z : ndarray, shape (5,)
        Start, with all contacts closed.
    heading : ndarray, shape (5,)
        Which way to go.
    until : Until
        What to trace for.
    """
    scene = formation.scene
    metric = metric_weights(scene)
    rho = scene.polygon.gyration_radius
    names = [limit.text for limit in formation.limits] + [str(until)]
    wanted = [k for k, limit in enumerate(formation.limits) if limit.gained == until.contact]
    wanted = [len(names) - 1] if until.contact is None else wanted

    def margins(points: Array) -> Array:
        values = formation.evaluate_limits(points)
        if until.contact is not None:
            return np.hstack([values, np.ones((len(points), 1))])
        return np.hstack([values, until_distance(formation, until, points)[:, None] * side])

    side = 1.0
    if until.contact is None:
        side = float(np.sign(until_distance(formation, until, z[None])[0])) or 1.0
    panels: list[Panel] = []
    step, start = rho, 0.0
    tangent = heading
    while start < LONGEST * rho:
        panel = _build_panel(formation, z, tangent, start, step, metric)
        if panel is None:
            step /= 2
            if step < 1e-6 * rho:
                text = f"the contacts become dependent at {describe_pose(z)}"
                return Curve(formation, tuple(panels), start, text, False)
            continue
        panels.append(panel)
        crossing = _first_crossing(panel, margins)
        if crossing is not None:
            s, active = crossing
            place = describe_pose(panel.interpolate(np.array([s]))[0][0])
            reached = [k for k in active if k in wanted]
            text = f"{names[(reached or active)[0]]} at {place}"
            return Curve(formation, tuple(panels), s, text, bool(reached))
        start, z, tangent = panel.s[-1], panel.z[-1], panel.z_s[-1]
        step *= 1.6
    text = f"nothing happens up to {describe_pose(z)}"
    return Curve(formation, tuple(panels), start, text, False)


def until_distance(formation: Formation, until: Until, z: Array) -> Array:
    """How far each configuration is from `until`, shape (n,): a gap [m], metres or radians."""
    if until.contact is not None:
        return formation.evaluate_gap(until.contact, z)
    assert until.value is not None
    return np.asarray(z[:, 0 if until.coordinate == "x" else 2] - until.value)


def _first_crossing(
    panel: Panel, margins: Callable[[Array], Array]
) -> tuple[float, list[int]] | None:
    """Where on the panel a margin first falls below zero, and which ones do so there."""
    grid = _refine(panel.s, panel.s[-1])
    values = margins(panel.interpolate(grid)[0])
    # What starts closed (the contact just given up) has to open; rounding is not closing.
    broken = values < -1e-11
    if not broken.any():
        return None
    row = int(broken.any(axis=1).argmax())
    roots = {}
    for k in np.flatnonzero(broken[row]):
        if row == 0 or values[row - 1, k] <= TOUCHING * 1e-3:
            roots[int(k)] = float(grid[max(row - 1, 0)])
        else:

            def margin(s: float, k: int = int(k)) -> float:
                return float(margins(panel.interpolate(np.array([s]))[0])[0, k])

            roots[int(k)] = find_root(margin, grid[row - 1], grid[row])
    first = min(roots.values())
    closed = np.abs(margins(panel.interpolate(np.array([first]))[0])[0]) < TOUCHING
    return first, sorted(
        set(np.flatnonzero(closed).tolist()) | {k for k in roots if roots[k] == first}
    )


def _build_panel(
    formation: Formation, z: Array, heading: Array, start: float, step: float, metric: Array
) -> Panel | None:
    """Trace one panel of about `step` metres, or return None when that is too far."""
    unit, integrate, analyse = _chebyshev()
    projection = heading * metric
    u = step * unit
    points = z + u[:, None] * heading
    rho = formation.scene.polygon.gyration_radius
    kinematics = formation.evaluate(points, points)
    for _ in range(12):
        residual = np.column_stack([kinematics.C, (points - z) @ projection - u])
        matrix = _border(kinematics.A, projection)
        try:
            change = np.linalg.solve(matrix, -residual[..., None])[..., 0]
        except np.linalg.LinAlgError:
            return None
        points = points + change
        kinematics = formation.evaluate(points, points)
        size = np.abs(change * np.sqrt(metric)).max()
        if size < 1e-10 * rho or size > 10 * rho:
            break
    if not size < 1e-10 * rho:
        return None
    z_u = np.linalg.solve(_border(kinematics.A, projection), np.eye(5)[:, 4:])[..., 0]
    speed = np.sqrt(z_u**2 @ metric)
    scaled = np.column_stack([points * np.sqrt(metric) / rho, speed])
    tail = np.abs(analyse @ scaled)[-2:].max()
    if speed.max() > 1.5 or tail > RESOLVED:
        return None
    return Panel(start + step * (integrate @ speed), points, z_u / speed[:, None])


def _solve_tangent(A: Array, A_dot_v: Array, tangent: Array, metric: Array) -> tuple[Array, Array]:
    """Unit null vector of A nearest to `tangent`, and the curvature orthogonal to it."""
    matrix = _border(A, tangent * metric)
    right = np.zeros((len(A), 5, 2))
    right[:, 4, 0] = 1.0
    right[:, :4, 1] = -A_dot_v
    solution = np.linalg.solve(matrix, right)
    z_s, z_ss = solution[..., 0], solution[..., 1]
    z_s = z_s / np.sqrt(z_s**2 @ metric)[:, None]
    z_ss = z_ss - ((z_ss * z_s) @ metric)[:, None] * z_s
    return z_s, z_ss


def _border(A: Array, last: Array) -> Array:
    last = np.broadcast_to(last, (len(A), 5))
    return np.concatenate([A, last[:, None, :]], axis=1)


def metric_weights(scene: Scene) -> Array:
    """Diagonal of the metric of arc length, shape (5,): 1 for lengths, rho^2 for angles."""
    rho = scene.polygon.gyration_radius
    return np.array([1.0, 1.0, rho**2, rho**2, rho**2])


@lru_cache(maxsize=1)
def _chebyshev() -> tuple[Array, Array, Array]:
    """Lobatto nodes on [0, 1], the matrix of integrals from 0, and that of coefficients."""
    n = NODES - 1
    angles = np.pi * np.arange(NODES) / n
    unit = (1 - np.cos(angles)) / 2
    vandermonde = np.cos(np.outer(np.pi - angles, np.arange(NODES + 1)))
    analyse = np.linalg.inv(vandermonde[:, :NODES])
    integral = np.zeros((NODES, NODES))
    x = 2 * unit - 1
    integral[:, 0] = x + 1
    integral[:, 1] = (x**2 - 1) / 2
    for k in range(2, NODES):
        above, below = vandermonde[:, k + 1] / (k + 1), vandermonde[:, k - 1] / (k - 1)
        term = (above - below) / 2
        integral[:, k] = term - term[0]
    return unit, integral @ analyse / 2, analyse


def _refine(s: Array, stop: float) -> Array:
    grid = np.interp(np.linspace(0, NODES - 1, REFINE), np.arange(NODES), s)
    return np.append(grid[grid < stop], min(stop, s[-1]))


def find_root(function: Callable[[float], float], low: float, high: float) -> float:
    """Root of a scalar function between a sign change, to rounding (the Illinois method)."""
    f_low, f_high = function(low), function(high)
    for _ in range(60):
        middle = high - f_high * (high - low) / (f_high - f_low)
        f_middle = function(middle)
        if f_middle == 0.0 or abs(high - low) < 1e-15 * max(1.0, abs(low)):
            return float(middle)
        if f_middle * f_high < 0:
            low, f_low = high, f_high
        else:
            f_low /= 2
        if abs(middle - high) < 1e-15:
            return float(middle)
        high, f_high = middle, f_middle
    return float(high)


def describe_pose(z: Array) -> str:
    """Pose of the object in words."""
    return f"x = {1e3 * z[0]:.4g} mm, phi = {np.degrees(z[2]):.4g} deg"


__all__ = [
    "Contact",
    "Curve",
    "CurvePoint",
    "Panel",
    "Segment",
    "load",
    "trace_curve",
    "trace_phases",
]
