"""Solution curve z(s) of four constraints, by Chebyshev collocation and Newton, phase by phase.

Four constraints P(z) z' = 0 leave one direction. A panel has the Chebyshev-Lobatto nodes of the
projection on its first tangent. Newton's method solves for all its points at once, and the arc
length is integrated spectrally. No coordinate has to be monotonic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.polynomial import chebyshev

from ..common.arrays import Array, find_root
from ..common.errors import InputError, name_source
from ..common.sharing import exclusive
from ..contacts.formation import Formation, describe, find_touching
from ..mechanics.dynamics import find_freedoms, metric_weights
from ..problem.definition import End, Phase, Problem, Until
from ..problem.read import read_problem
from ..scene.model import TOUCHING, Scene
from .curve import Curve, Panel, border, describe_pose, refine

N_NODES = 17  # nodes of a panel
MAX_TAIL = 1e-13  # largest trailing Chebyshev coefficient of a panel, over the object's size
REDUCTION = 0.5  # factor on the length of a panel if Newton's method fails
END_TOL = 3e-5  # distance to `until` that counts as zero, in radii of gyration or rad
LIMIT_ERROR = 3e-10  # violation of a limit that counts as rounding, in radii of gyration
MAX_LENGTH = 60.0  # longest traced curve, in radii of gyration: several turns of the object


@exclusive
def load(path: str | Path) -> Problem:
    """Read a problem file and check its phases geometrically, or raise an `InputError`."""
    problem = read_problem(path)
    check_phases(problem)
    return problem


def check_phases(problem: Problem) -> None:
    """Raise an `InputError` if a formation does not touch, or an `until` is never reached.

    An `until` after a phase that may end at several places is not checked: the planner selects one.
    """
    from .path_guess import find_end

    curves = trace_phases(problem)
    z, chosen = curves[-1].end if curves else problem.start, False
    with name_source(problem.source):
        for phase in problem.phases[len(curves) :]:
            try:
                z = find_end(phase, z, problem.phases[phase.index + 1 :])
            except InputError as error:
                if chosen and error.key.endswith("until"):
                    return
                raise
            chosen = chosen or phase.formation.n_constraints + phase.until.conditions < 5


@lru_cache(maxsize=8)
def trace_phases(problem: Problem) -> tuple[Curve, ...]:
    """Trace the curves of all phases up to the first with more freedoms or a smooth end.

    Raises an `InputError` as `trace_phase`.
    """
    curves: list[Curve] = []
    z = problem.start
    with name_source(problem.source):
        for phase in problem.phases:
            if not runs_on_curve(phase):
                break
            curves.append(trace_phase(phase, z, problem.phases[phase.index + 1 :]))
            z = curves[-1].end
    return tuple(curves)


def runs_on_curve(phase: Phase) -> bool:
    """Whether a phase has one freedom and ends at rest or with an impact."""
    return phase.formation.n_constraints == 4 and phase.end is not End.SMOOTH


def split_blocks(problem: Problem) -> list[tuple[Phase, ...]]:
    """Blocks of phases that are planned together: joined smoothly or by impacts."""
    block_ends = [k + 1 for k, phase in enumerate(problem.phases) if phase.end is End.REST]
    return [problem.phases[start:stop] for start, stop in pairwise([0, *block_ends])]


def runs_on_curves(block: Sequence[Phase]) -> bool:
    """Whether a block runs along curves: one phase with one freedom, or several that slide."""
    if len(block) == 1:
        return runs_on_curve(block[0])
    return all(
        phase.formation.n_constraints == 4
        and not phase.formation.rolling
        and not phase.until.is_release
        for phase in block
    )


def trace_phase(phase: Phase, z: Array, later: Sequence[Phase] = ()) -> Curve:
    """Trace a one-freedom phase from `z`, (5,), to its `until`, or to its limits before a release.

    Before a release the direction is that towards the end of `later` phases. Raises an `InputError`
    if the contacts do not touch or the `until` is never reached.
    """
    require_touching(phase, z)
    formation, until, rho = phase.formation, phase.until, phase.formation.scene.scales.length
    key = f"phases[{phase.number}]"
    if until.is_release:
        ends = [*(p.until for p in later if not p.until.is_release), until]
        curves = [trace_curve(formation, z, v, until) for v in _headings(formation, z, ends[0])]
        curve, min_length = max(curves, key=lambda curve: curve.length), END_TOL * rho
        same_contacts = later and set(later[0].formation.contacts) == set(formation.contacts)
        if same_contacts and curves[0].length >= min_length:
            # Only modes change, at any place of the path to the next end of a phase.
            curve = curves[0]
        if curve.length < min_length:
            raise InputError("", f"{key}.contacts", f"cannot move: {curve.ending}")
        return curve
    if _is_reached(formation, until, z):
        raise InputError("", f"{key}.until", f"{until} holds already at the start of the phase")
    endings = []
    for heading in _headings(formation, z, until):
        curve = trace_curve(formation, z, heading, until)
        if curve.reached and until.measure_pins(curve.end, rho) < 3 * END_TOL and curve.is_regular:
            return curve
        endings.append(curve.ending)
    text = f"going one way {endings[0]}, going the other way {endings[1]}"
    text += "; one freedom leaves no choice" if until.pins else ""
    raise InputError("", f"{key}.until", f"{until} is never reached: {text}")


def require_touching(phase: Phase, z: Array) -> None:
    """Raise an `InputError` unless a phase's contacts touch at `z`, (5,), without overlap."""
    key = f"phases[{phase.number}].contacts"
    formation = phase.formation
    gaps = formation.evaluate(z[None], np.zeros((1, 5))).C[0]
    touching = formation.scene.touching
    if np.abs(gaps).max() > touching:
        missing = ", ".join(np.array(formation.names)[np.abs(gaps) > touching])
        when = f"at the end of phase {phase.index}" if phase.index else "at the start"
        others = describe(find_touching(formation.scene, z))
        raise InputError("", key, f"{missing} does not touch {when}; touching are {others}")
    limits = formation.evaluate_limits(z[None])[0]
    if limits.min() < -touching:
        text = formation.limits[int(limits.argmin())].text
        raise InputError("", key, f"cannot hold at {describe_pose(z)}: {text}")


def _is_reached(formation: Formation, until: Until, z: Array) -> bool:
    """Whether `until` holds at `z`; a contact has to be within the range of its edge and link."""
    if until.contact is None:
        return bool(EndDistance(formation.scene, until, z).measure(z[None])[0] < END_TOL)
    gaining = [k for k, limit in enumerate(formation.limits) if limit.gains(until.contact)]
    gaps = formation.evaluate_limits(z[None])[0, gaining] / formation.scene.scales.length
    return bool(len(gaps) and (np.abs(gaps) < END_TOL).all())


def _headings(formation: Formation, z: Array, until: Until) -> list[Array]:
    """Both unit tangents at `z`, the one that approaches `until` first."""
    null, opposite = find_headings(formation, z, 0.0)
    step = 1e-6 * formation.scene.polygon.gyration_radius
    places = np.array([z, z + step * null])
    distance, next_distance = np.abs(EndDistance(formation.scene, until, z).measure(places))
    return [null, opposite] if next_distance <= distance else [opposite, null]


def find_headings(formation: Formation, z: Array, min_ratio: float = 1e-7) -> tuple[Array, ...]:
    """Both unit tangents of a formation's curve at `z`; none where the curve is singular.

    That is where the ratio of singular values of P is below `min_ratio`.
    """
    P, metric = formation.evaluate(z[None], z[None]).P[0], metric_weights(formation.scene)
    freedoms = find_freedoms(P, metric, min_ratio).T
    return () if min_ratio and len(freedoms) > 1 else (freedoms[-1], -freedoms[-1])


def trace_curve(formation: Formation, z: Array, heading: Array, until: Until) -> Curve:
    """Trace a curve with four constraints from `z` along `heading`, (5,), to `until` or its end."""
    rho = formation.scene.polygon.gyration_radius
    names = [limit.text for limit in formation.limits] + [str(replace(until, pins=()))]
    targets = [k for k, limit in enumerate(formation.limits) if limit.gains(until.contact)]
    # A limit that is zero at the start does not end the phase. Case: the end of a flush edge that
    # the link does not reach yet.
    closed = np.abs(formation.evaluate_limits(z[None])[0]) / rho < END_TOL
    targets = [k for k in targets if not closed[k]] or targets
    targets = [len(names) - 1] if until.contact is None else targets
    end_distance = EndDistance(formation.scene, until, z)

    panels: list[Panel] = []
    offset = np.zeros(len(formation.limits))  # limits below zero where the curve begins [rho]

    def margins(points: Array) -> Array:
        # A gained contact is one of the limits.
        distance = end_distance.measure(points) if until.contact is None else np.ones(len(points))
        return np.column_stack([formation.evaluate_limits(points) / rho - offset, distance])

    def end(s: float, text: str, reached: bool = False) -> Curve:
        return Curve(formation, tuple(panels), s, text, reached)

    slip = formation.evaluate_slip(z[None])[0]
    step, start, tangent = 0.5 * rho, 0.0, heading
    while start < MAX_LENGTH * rho:
        panel, factor = build_panel(formation, slip, z, tangent, start, step)
        step *= factor
        if panel is None:
            if step < 1e-6 * rho:
                return end(start, f"the contacts become dependent at {describe_pose(z)}")
            continue
        panels.append(panel)
        if len(panels) == 1:
            # A plan ends within its tolerance: small violations at the start are subtracted. Case:
            # phase 5 of `heptagon.toml` with periods of 5 ms, v0-finger2 at -9e-10.
            values = formation.evaluate_limits(panel.z[:1])[0] / rho
            offset = np.clip(values, -TOUCHING, 0.0)
        crossing = find_crossing(panel, margins)
        if crossing is not None:
            s, active = crossing
            place = describe_pose(panel.interpolate(np.array([s]))[0][0])
            reached = [k for k in active if k in targets]
            return end(s, f"{names[(reached or active)[0]]} at {place}", bool(reached))
        start, z, tangent = panel.s[-1], panel.z[-1], panel.z_s[-1]
    return end(start, f"nothing happens up to {describe_pose(z)}")


class EndDistance:
    """Distance to the end of a phase that begins at `start`, (5,); NaN for a release [m or rad]."""

    def __init__(self, scene: Scene, until: Until, start: Array) -> None:
        contact = until.contact
        self.formation = None if contact is None else Formation(scene, (contact,))
        self.unit = "rad" if until.coordinate == "phi" else "m"
        self.scale = 1.0 if self.unit == "rad" else scene.scales.length
        self.row, value = until.poses[0] if until.value is not None else (0, math.nan)
        self.value, self.side = value, math.copysign(1.0, start[self.row] - value)

    @staticmethod
    def to_leading(scene: Scene, until: Until, start: Array) -> EndDistance:
        """Distance to the end by the coordinate that is farthest from it at the start."""
        return EndDistance(scene, until.lead(start, scene.scales.length), start)

    def evaluate(self, z: Array, v: Array) -> tuple[Array, Array, Array]:
        """Distance d at n states, (n,), its gradient, (n, 5), and its quadratic term, (n,).

        d'' = gradient @ z'' + quadratic term in z'.
        """
        if self.formation is not None:
            kinematics = self.formation.evaluate(z, v)
            return kinematics.C[:, 0], kinematics.A[:, 0], kinematics.P_dot_v[:, 0]
        gradient = np.zeros(z.shape)
        gradient[:, self.row] = self.side
        return self.side * (z[:, self.row] - self.value), gradient, np.zeros(len(z))

    def measure(self, z: Array) -> Array:
        """Distance at n configurations, (n,), in radii of gyration or rad; one for a release."""
        distances = self.evaluate(z, z)[0] / self.scale
        return np.where(np.isnan(distances), 1.0, distances)


def find_crossing(
    panel: Panel, margins: Callable[[Array], Array]
) -> tuple[float, list[int]] | None:
    """First arc length at which margins [rho or rad] fall below zero, and which ones do so."""
    grid = refine(panel.s, panel.s[-1])
    values = margins(panel.interpolate(grid)[0])
    for _ in range(4):
        inner = _refine_dips(grid, values)
        if not len(inner):
            break
        values = np.vstack([values, margins(panel.interpolate(inner)[0])])
        grid = np.append(grid, inner)
        order = grid.argsort()
        grid, values = grid[order], values[order]
    # A contact that was just released has to open; smaller violations are rounding.
    violated = values < -LIMIT_ERROR
    if not violated.any():
        return None
    row = int(violated.any(axis=1).argmax())
    roots = {}

    def margin(k: int, s: float) -> float:
        return float(margins(panel.interpolate(np.array([s]))[0])[0, k])

    for k in np.flatnonzero(violated[row]):
        if row == 0 or values[row - 1, k] <= 10 * LIMIT_ERROR:
            roots[int(k)] = float(grid[max(row - 1, 0)])
        else:
            roots[int(k)] = find_root(partial(margin, int(k)), grid[row - 1], grid[row])
    first = min(roots.values())
    closed = np.abs(margins(panel.interpolate(np.array([first]))[0])[0]) < TOUCHING
    active = {*np.flatnonzero(closed).tolist(), *(k for k in roots if roots[k] == first)}
    return first, sorted(active)


def _refine_dips(grid: Array, values: Array) -> Array:
    """Samples around minima that may be negative, bounded by half the second difference."""
    left, middle, right = values[:-2], values[1:-1], values[2:]
    dips = (middle <= left) & (middle <= right) & (middle > LIMIT_ERROR)
    rows = np.flatnonzero((dips & (middle < left - 2 * middle + right)).any(axis=1))
    if not len(rows):
        return rows.astype(float)
    fractions = np.linspace(0.0, 1.0, 14)[1:-1]
    low, high = grid[rows, None], grid[rows + 2, None]
    return np.setdiff1d(low + (high - low) * fractions, grid)


def build_panel(
    formation: Formation, slip: Array, z: Array, heading: Array, start: float, step: float
) -> tuple[Panel | None, float]:
    """Panel of about `step` metres, None without convergence, and factor on the next step.

    Rolling contacts keep the slip coordinates `slip`, shape (R,) [m].
    """
    unit, integral, inverse = _chebyshev()
    metric = metric_weights(formation.scene)
    projection = heading * metric
    u = step * unit
    points, rho = z + u[:, None] * heading, formation.scene.polygon.gyration_radius
    kinematics, size = formation.evaluate(points, points), np.inf
    for count in range(12):
        slip_error = formation.evaluate_slip(points) - slip
        residual = np.column_stack([kinematics.C, slip_error, (points - z) @ projection - u])
        matrix = border(kinematics.P, projection)
        try:
            change = np.linalg.solve(matrix, -residual[..., None])[..., 0]
        except np.linalg.LinAlgError:
            return None, REDUCTION
        points = points + change
        kinematics = formation.evaluate(points, points)
        last_size, size = size, np.abs(change * np.sqrt(metric)).max()
        # Quadratic convergence: the next change is about the square of this one.
        if size < 3e-8 * rho or size > 10 * rho or (count > 2 and size > last_size / 2):
            break
    if not size < 3e-8 * rho:
        return None, REDUCTION
    z_u = np.linalg.solve(border(kinematics.P, projection), np.eye(5)[:, 4:])[..., 0]
    speed = np.sqrt(z_u**2 @ metric)
    scaled = np.column_stack([(points - z) * np.sqrt(metric) / rho, speed])
    tail = np.abs(inverse @ scaled)[-2:].max()
    # Target: trailing coefficients of 0.3 `MAX_TAIL`.
    factor = (0.3 * MAX_TAIL / max(tail, 1e-3 * MAX_TAIL)) ** (1 / (N_NODES - 1))
    if speed.max() > 1.5 or tail > MAX_TAIL:
        return None, max(min(factor, 0.8), REDUCTION**2)
    return Panel(start + step * (integral @ speed), points, z_u / speed[:, None]), factor


@lru_cache(maxsize=1)
def _chebyshev() -> tuple[Array, Array, Array]:
    """Lobatto nodes on [0, 1], the matrix of integrals from 0, and that of coefficients."""
    x = -np.cos(np.pi * np.arange(N_NODES) / (N_NODES - 1))
    inverse = np.asarray(np.linalg.inv(chebyshev.chebvander(x, N_NODES - 1)), dtype=float)
    integral = chebyshev.chebvander(x, N_NODES) @ chebyshev.chebint(np.eye(N_NODES), lbnd=-1)
    return (1 + x) / 2, (integral - integral[0]) @ inverse / 2, inverse


@dataclass(frozen=True, eq=False)
class CostToGo:
    """Cost of the later phases, the first of them with one freedom."""

    phase: Phase  # the first later phase; the earlier motion may end anywhere on its curve
    # least cost from a configuration z, shape (5,); raises a `WholearmError` if none has a plan
    value: Callable[[Array], float]

    def expand(self, z: Array) -> tuple[float, Array]:
        """The cost from `z`, shape (5,), and its gradient along the curve, shape (5,)."""
        curve = trace_phase(self.phase, z)
        step = 1e-2 * curve.length
        point = curve.evaluate(np.array([0.0, step]))
        value, next_value = (self.value(place) for place in point.z)
        slope = (next_value - value) / step
        return value, slope * metric_weights(self.phase.formation.scene) * point.z_s[0]
