"""Policies from plans: references along curves with robustness margins, and tables of all phases.

Torques and limits at places along a curve are coefficients of (1, s'', s'^2, s', lambda) of a
nominal motion. Its torques are applied: with other friction, mass or gains they lead to another s''
and internal force, and thus to other contact forces. Without ranges the margin of each limit is the
root sum square of its changes by usual errors. Within ranges, limits hold in the worst corner
(`Corners`), both under nominal torques and with feedback that tracks the reference. Slack over this
margin is the normalized slack. The reference is the fastest motion of the backward pass of
`mechanics.speed_sweep` that keeps the largest least fraction of the margins. Phases over time have
a regulator (`regulator`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array, Numbers
from ..common.errors import InputError, require_number
from ..contacts.contact_limits import list_renamed
from ..contacts.formation import Formation
from ..geometry.curve import Curve, CurvePoint, directions_of
from ..geometry.tracing import runs_on_curves, split_blocks, trace_phase
from ..mechanics.dynamics import (
    LAMBDA,
    ONE,
    A,
    B,
    Directions,
    PathForces,
    V,
    apply,
    inverse,
    metric_weights,
    stack_motion,
)
from ..mechanics.limits import LimitSet, make_limits
from ..mechanics.path_limits import PathLimits, find_value_rows
from ..mechanics.sensitivity import Sensitivity
from ..mechanics.speed_sweep import ControllableSet, find_controllable, find_duration
from ..problem.definition import GROUPS, PARAMETERS, End, Phase, Problem, change_scene
from ..results.adopt import MotionLike, adopt_motion
from ..results.trajectory import Trajectory
from ..scene.model import Scene
from .curve_law import LoopSettings
from .playback import Policy
from .regulator import REST_SPEED, Planner, find_internal_force, hold_end, replan, tabulate_motion

COLUMNS = [ONE, B, V, A, LAMBDA]  # order of coefficients in the tables of a policy
PathMotion = tuple[Array, Array, Array]  # a, b and internal force at n places


@dataclass(frozen=True)
class ReferenceSettings:
    """Margins and accuracies of references."""

    delay: float = 5e-4  # uncertainty of the delay without ranges [s]
    force_margin: float = 0.02  # least margin of a normal force, over the scene's unit of force
    torque_margin: float = 0.02  # margin of a torque for feedback, over its limit
    reference_force: float = 1.3  # force margin of the reference within ranges, over the law's
    reference_torque: float = 5.0  # torque margin of the reference, over the law's
    reversal_time: float = 1e-3  # around a reversal, in which friction may have either sign [s]
    touch: float = 3e-3  # speed s' at which contacts are made, over the scene's
    # Time constants of the approach to the end [s]: the second one where no slow motion keeps all
    # contacts and only braking presses them. Case: new polygon 16, phase 4.
    arrivals: tuple[float, float] = (6e-3, 2e-3)
    # Time at rest before the next phase begins [s]: contacts that errors open on arrival close
    # meanwhile. Case: heptagon_four_contacts, phase 3, where 12 ms are too short.
    dwell: float = 25e-3
    # Factors on the squared speed of the plan, tried until the margin is kept: relative errors of
    # torques matter less if torques are small. Cases: square, phase 2; hexagon, phase 8; two flips,
    # phases 8 and 9.
    speed_factors: tuple[float, ...] = (1.0, 0.5, 0.25)
    least_b: float = 0.1  # least b of a motion with a margin, over the plan's: slow ones can stick
    # Fractions of the margin that are tried, the largest first. Negative ones: a plan keeps limits
    # at its own nodes and may violate them a little at others.
    fractions: tuple[float, ...] = (*(0.8**k for k in range(12)), 0.04, 0.0, -0.1, -0.2, -0.4, -0.8)
    # Upper limits of the fraction, if some interval has less: a large fraction in one interval can
    # reduce that of another one. Case: square, 28 % slower without them.
    caps: tuple[float, ...] = (0.5, 0.2, 0.0)
    sufficient: float = 0.95  # least fraction that needs no slower motion
    max_range: float = 0.9  # largest relative range


SETTINGS = ReferenceSettings()
UNLIMITED = np.array([1e9, 0.0, 0.0, 0.0, 0.0])
FIXED = np.array([1.0, 0.0, 1.0, 1.0, 0.0])
"""1 for columns that torques do not change, 0 for those of s'' and the internal force."""
CORNERS = ("mass", "inertia", *GROUPS["friction"])
"""Numbers whose ranges have corners. Those of geometry and gains are treated to first order, delays
by delayed torques; the start is measured."""
ERRORS = dict.fromkeys(CORNERS, 0.1) | {"mass": 0.05, "inertia": 0.05, "gain1": 0.01, "gain2": 0.01}
"""Relative uncertainties without ranges."""


class CurveLimitRows(NamedTuple):
    """Torques and limits at n places of a curve."""

    s: Array  # (n,) [m]
    torque: Array  # (n, 2, 5) [N m]
    # (n, m, 5): normalized slack: of forces with friction before, then after the nearest reversal;
    # of torques
    slack: Array
    n_force: int  # number of force limits among the m


def add_limits_beyond(rows: CurveLimitRows, after: Curve) -> CurveLimitRows:
    """Rows with the contact limits at the start of the curve `after`, under the last torques.

    Torques are held for a period. Where the contact passes from an edge to a vertex of a small
    radius, the torques of the old curve open the contact. Case: query 9, phase 5.
    """
    formation, point, torque = after.formation, after.evaluate(np.zeros(1)), rows.torque[-1:]
    directions = directions_of(after, np.zeros(1, dtype=np.int64))
    forces = inverse(formation, point, directions)
    limits = split_limits(formation)[0]
    slack = measure_slack(limits, find_response(forces, torque)[0], torque, point.z_s[:, 3:])
    beyond = np.tile(UNLIMITED, (len(rows.s), slack.shape[1], 1))
    beyond[-1] = slack[0] / (SETTINGS.force_margin * limits.side_scales)[:, None]
    return rows._replace(slack=np.concatenate([rows.slack, beyond], axis=1))


def split_limits(formation: Formation) -> tuple[LimitSet, LimitSet]:
    """Limits with an epsilon of zero: those of contact forces, and those of torques alone.

    Speed limits are kept by the plan, and no motion of a policy is faster.
    """
    return make_limits(formation, 0.0).split(2)[0].split(4)


def find_torques(curve: Curve, s: Array, directions: Directions) -> Array:
    """Torques at n places, shape (n, 2, 5)."""
    point = curve.evaluate(np.clip(s, 0.0, curve.length))
    return inverse(curve.formation, point, directions).of_tau


def find_response(forces: PathForces, torque: Array) -> tuple[Array, Array]:
    """Contact forces, (n, n_c + R, 5), a and internal force, (n, 2, 5), from torques (n, 2, 5)."""
    free = [A, LAMBDA]
    motion = np.linalg.solve(forces.of_tau[..., free], torque - FIXED * forces.of_tau)
    return np.asarray(forces.of_c[..., free] @ motion + FIXED * forces.of_c), np.asarray(motion)


def measure_slack(limits: LimitSet, c: Array, torque: Array, rates: Array) -> Array:
    """Slack of limits, (n, m, 5) [N, N m], from coefficients of c and torques; `rates` (n, 2)."""
    return limits.find_slack_rows(find_value_rows(limits, PathForces(c, torque), rates))


def scale_torque_slack(limits: LimitSet, torque: Array, rates: Array) -> Array:
    """Normalized slack of torque limits, shape (n, m, 5), from torques (n, 2, 5)."""
    none = np.zeros((len(torque), limits.rows.shape[1] - 4, 5))
    slack = measure_slack(limits, none, torque, rates)
    return slack / (SETTINGS.torque_margin * limits.side_scales)[:, None]


def force_gradients(limits: LimitSet) -> Array:
    """Derivatives of the slack of limits by contact forces, shape (m, n_c + R)."""
    rows, signs, _ = limits.sides
    return np.asarray(signs[:, None] * limits.rows[rows, :-4])


def make_rows(curve: Curve, s: Array, motion: PathMotion) -> CurveLimitRows:
    """Torques and limits at places of a curve, with margins for a motion (a, b, lambda)."""
    formation, point, speed = curve.formation, curve.evaluate(s), np.sqrt(motion[1])
    mean, *sides = blend_directions(curve, s, speed * SETTINGS.reversal_time)
    torque, lagged = (find_torques(curve, s - lag * speed, mean) for lag in (0.0, SETTINGS.delay))
    (contact, joint), rates = split_limits(formation), point.z_s[:, 3:]
    levels = list[Array]()
    for directions in sides:
        forces = inverse(formation, point, directions)
        c = find_response(forces, torque)[0]
        slack = measure_slack(contact, c, torque, rates)
        state = Sensitivity.of_curve(formation, point, directions, forces)
        changes = np.array([*ERRORS.values()])[:, None] * state.find_slopes(tuple(ERRORS))
        delay_change = find_response(forces, lagged)[0] - c
        changes = np.append(changes, delay_change[:, :, None], axis=2)
        errors = apply(changes, *motion)
        error = np.linalg.norm(force_gradients(contact) @ errors, axis=2)
        levels.append(slack / (SETTINGS.force_margin * contact.side_scales + error)[..., None])
    before, after = map(np.hstack, sides)
    levels[1][(before == after).all(axis=1)] = UNLIMITED
    levels.append(scale_torque_slack(joint, torque, rates))
    return CurveLimitRows(s, torque, np.concatenate(levels, axis=1), 2 * levels[0].shape[1])


def blend_directions(curve: Curve, s: Array, widths: Array) -> list[Directions]:
    """Sliding directions: blended over reversals of `widths` (n,) [m], before, and after them."""
    signs = [np.append(part.Xi, part.sigma) for part in curve.segments]
    blended = np.tile(signs[0], (3, len(s), 1))
    for before, (first, second) in zip(curve.segments, pairwise(signs), strict=False):
        width = max(float(np.interp(before.stop, s, widths)), 1e-3 * curve.length)
        fraction = np.clip(0.5 + (s - before.stop) / (2 * width), 0.0, 1.0)[:, None]
        blended += np.stack([fraction, np.floor(fraction), np.ceil(fraction)]) * (second - first)
    return [Directions(*np.split(each, [-2], axis=1)) for each in blended]


class Corners(NamedTuple):
    """Normalized slack at n places in k corners, of the nominal (1, a, b, s', internal force)."""

    rows: Array  # (k, n, m, 5)
    s_ddot: Array  # (k, n, 5): actual acceleration s''
    changes: Array  # (p, n, m, 5): first-order changes by each other range

    def pick(self, motion: PathMotion) -> Array:
        """Slack in the corner that is worst for a motion, shape (n, m, 5)."""
        values = stack_motion(*motion)
        worst = np.einsum("knmq,nq->knm", self.rows, values).argmin(axis=0)
        rows = np.take_along_axis(self.rows, worst[None, ..., None], axis=0)[0]
        signs = np.sign(np.einsum("pnmq,nq->pnm", self.changes, values))
        return np.asarray(rows - np.einsum("pnm,pnmq->nmq", signs, self.changes))

    def close(self, torque_slack: Array) -> Corners:
        """Slack of these and of torque limits, (n, l, 5), if feedback makes s'' equal to a."""
        count = len(self.rows)
        rows = np.concatenate([self.rows, np.tile(torque_slack, (count, 1, 1, 1))], axis=2)
        rate, rest = self.s_ddot[:, :, None, [A]], self.s_ddot[:, :, None].copy()
        rest[..., A] = 0.0
        by_a = rows[..., [A]] / rate
        closed = rows - by_a * rest
        closed[..., [A]] = by_a
        padding = ((0, 0), (0, 0), (0, torque_slack.shape[1]), (0, 0))
        return Corners(closed, self.s_ddot, np.pad(self.changes, padding))


def find_corners(
    formation: Formation,
    point: CurvePoint,
    directions: Directions,
    torques: tuple[Array, Array, Array],
    widths: Mapping[str, float],
    unit: Array,
) -> Corners:
    """Slack of forces over margins `unit` (m,) [N], in the corners of ranges with half `widths`.

    `torques`, (n, 2, 5) each, are the nominal ones, delayed ones, and the derivative by s.
    """
    rows, s_ddot = list[Array](), list[Array]()
    torque, delayed, slope = torques
    for scene in list_scenes(formation.scene, widths):
        changed = replace(formation, scene=scene)
        c, motion = find_response(inverse(changed, point, directions), torque)
        rows.append(measure_slack(split_limits(changed)[0], c, torque, point.z_s[:, 3:]))
        s_ddot.append(motion[:, 0])
    nominal = inverse(formation, point, directions)
    changes = [find_response(nominal, delayed)[0] - find_response(nominal, torque)[0]]
    first_order = (*GROUPS["geometry"], *GROUPS["gain"])
    state = Sensitivity.of_curve(formation, point, directions, nominal)
    for name in (other for other in first_order if widths.get(other, 0.0) > 0):
        slopes = state.find_slopes((name,))[:, :, 0]
        if name in GROUPS["geometry"]:
            # Torques depend on the apparent place.
            shifted = torque + state.find_shifts(name)[:, None, None] * slope
            slopes = slopes + find_response(nominal, shifted)[0] - find_response(nominal, torque)[0]
        changes.append(widths[name] * slopes)
    of_c, margin = force_gradients(split_limits(formation)[0]), unit[:, None]
    return Corners(np.array(rows) / margin, np.array(s_ddot), of_c / margin @ np.array(changes))


def list_scenes(scene: Scene, widths: Mapping[str, float]) -> tuple[Scene, ...]:
    """Scenes in the corners of ranges with half `widths`."""
    names = [name for name in CORNERS if widths.get(name, 0.0) > 0]
    return tuple(
        change_scene(scene, {n: k * widths[n] for n, k in zip(names, signs, strict=True)})
        for signs in product((-1, 1), repeat=len(names))
    )


class RangeLimits(NamedTuple):
    """Limits along a curve within ranges, at n places."""

    s: Array  # (n,) [m]
    torque: Array  # (n, 2, 5) [N m]
    torque_slack: Array  # (n, l, 5): normalized slack of torques
    sides: tuple[Corners, Corners]  # with friction before and after the nearest reversal
    no_reversal: Array  # (n,): where these are equal

    def at(self, motion: PathMotion) -> tuple[CurveLimitRows, Array, Array]:
        """The law's limits near a motion; slack of the reference, and its lower bounds, (m,)."""
        # With its internal force, and with the least and largest one within torque limits.
        a, b, internal = motion
        bounds = PathLimits(self.torque_slack, b).find_internal_force_range(a, b)
        low, high = (np.where(np.isfinite(end), end, internal) for end in bounds)
        motions = [motion, (a, b, np.minimum(low, internal)), (a, b, np.maximum(high, internal))]
        force_slack = self._pick(self.sides, motions)
        closed_loop = self._pick([side.close(self.torque_slack) for side in self.sides], motions)
        slack = np.concatenate([force_slack, self.torque_slack], axis=1)
        rows = CurveLimitRows(self.s, self.torque, slack, force_slack.shape[1])
        n, k = self.sides[0].rows.shape[2], self.torque_slack.shape[1]
        force_floor = np.full(n, SETTINGS.reference_force)
        torque_floor = np.full(k, SETTINGS.reference_torque)
        floors = np.tile(np.append(force_floor, torque_floor), 2 * len(motions))
        required = np.concatenate([np.tile(force_floor, 2 * len(motions)), torque_floor, floors])
        return rows, np.concatenate([slack, closed_loop], axis=1), required

    def _pick(self, sides: tuple[Corners, ...] | list[Corners], motions: list[PathMotion]) -> Array:
        """Limits on both sides of reversals in the worst corners of motions, (n, rows, 5)."""
        limits = [np.concatenate([side.pick(each) for each in motions], axis=1) for side in sides]
        limits[1][self.no_reversal] = UNLIMITED
        return np.concatenate(limits, axis=1)


def find_range_limits(
    curve: Curve, s: Array, speed: Array, widths: Mapping[str, float], least: float
) -> RangeLimits:
    """Limits along a curve within ranges, with forces of at least `least` [N]."""
    formation, point = curve.formation, curve.evaluate(s)
    # Limits are interpolated: nodes next to a reversal need both directions.
    gaps = np.pad(np.diff(s), 1)
    width = np.maximum(speed * SETTINGS.reversal_time, 1.01 * np.maximum(gaps[1:], gaps[:-1]))
    mean, *sides = blend_directions(curve, s, width)
    delayed = s - (SETTINGS.delay + widths.get("delay", 0.0)) * speed
    nominal, step = find_torques(curve, s, mean), 1e-4 * curve.length
    before, after = (find_torques(curve, s + sign * step, mean) for sign in (-1, 1))
    torques = nominal, find_torques(curve, delayed, mean), (after - before) / (2 * step)
    contact, joint = split_limits(formation)
    unit = np.maximum(SETTINGS.force_margin * contact.side_scales, least)
    corners = [find_corners(formation, point, side, torques, widths, unit) for side in sides]
    before, after = map(np.hstack, sides)
    torque_slack = scale_torque_slack(joint, nominal, point.z_s[:, 3:])
    no_reversal = (before == after).all(axis=1)
    return RangeLimits(s, nominal, torque_slack, (corners[0], corners[1]), no_reversal)


class ReferencePiece(NamedTuple):
    """The reference of a phase along a curve."""

    curve: Curve
    rows: CurveLimitRows
    reach: ControllableSet
    share: float  # least fraction of the margin
    start_b: float  # [m^2/s^2]: the plan's b at the start
    passes: float  # ratio of b after and before the end, passed in motion; zero at rest
    b: Array  # (n,) [m^2/s^2]: the reference

    @property
    def reserves(self) -> dict[str, float]:
        """Least normalized slack of each contact's normal force along the reference."""
        rows, names = self.rows, self.curve.formation.names
        a = np.diff(self.b) / (2 * np.diff(rows.s))
        a = np.append(a, a[-1])
        count = len(split_limits(self.curve.formation)[0].low)
        motion = stack_motion(a, self.b, find_internal_force(rows.slack, a, self.b)[1])
        slack = np.einsum("nmi,ni->nm", rows.slack[:, : rows.n_force], motion)
        least = slack.min(axis=0).reshape(-1, count).min(axis=0)
        return dict(zip(names, least[: len(names)].tolist(), strict=True))


def scale_ranges(ranges: Mapping[str, float], size: float, delay: float) -> dict[str, float]:
    """Half widths of scaled ranges; that of the delay is its deviation from `delay` [s]."""
    widths = {name: size * width for name, width in ranges.items()}
    delay_range = widths.get("delay", 0.0)
    # Torques may be early as well: a delay is anything from none to its range.
    return widths | {"delay": max(delay_range - delay, delay) if delay_range else 0.0}


def trace_pieces(
    problem: Problem,
    plan: Trajectory,
    size: float,
    widths: Mapping[str, float] | None,
    contact_speed: float = 1.0,
) -> dict[int, ReferencePiece]:
    """References of the phases along curves, by index, with margins as large as possible.

    Margins are `size` times those of usual errors or, where there are half `widths` of ranges, such
    that limits are kept within these. `contact_speed` is that of `make_policy`.
    """
    pieces: dict[int, ReferencePiece] = {}
    touch = contact_speed * SETTINGS.touch * problem.scene.scales.speed
    for block in filter(runs_on_curves, split_blocks(problem)):
        for phase in reversed(block):
            after = pieces.get(phase.index + 1)
            pieces[phase.index] = _trace(problem, phase, plan, size, widths, touch, after)
        for phase in block:
            piece, before = pieces[phase.index], pieces.get(phase.index - 1)
            first = float(piece.reach.high[0])
            if before is not None and before.passes:
                first = float(before.b[-1]) * before.passes
            pieces[phase.index] = piece._replace(b=piece.reach.run(first))
    return pieces


def _trace(
    problem: Problem,
    phase: Phase,
    plan: Trajectory,
    size: float,
    widths: Mapping[str, float] | None,
    touch: float,
    after: ReferencePiece | None,
    short_arrival: bool = False,
) -> ReferencePiece:
    """A phase's curve, and the controllable motions along it that keep margins.

    `short_arrival` selects the shorter time constant of `SETTINGS.arrivals`.
    """
    rows_of_phase = np.flatnonzero((plan.phase == phase.index) & ~plan.held)
    curve = trace_phase(phase, plan.z[rows_of_phase[0]], problem.phases[phase.index + 1 :])
    plan_s, *values = _project(curve, plan, rows_of_phase)
    # Nodes of the table, with all reversals.
    s = curve.length * (1 - np.cos(np.pi * np.linspace(0, 1, 121))) / 2
    s = np.sort(np.concatenate([s, [part.stop for part in curve.segments[:-1]]]))
    s = s[np.diff(s, prepend=-1.0) > 1e-7 * curve.length]
    a, b, internal = (np.interp(s, plan_s, value) for value in values)
    start_b, passes, end = float(b[0]), 0.0, None
    impact = phase.end is End.IMPACT and b[-1] > touch**2
    if after is not None and (impact or phase.end is End.SMOOTH):
        passes = after.start_b / float(b[-1]) if impact else 1.0
        end = float(after.reach.low[0] / passes), float(after.reach.high[0] / passes)
    else:
        b = np.minimum(b, (touch + (curve.length - s) / SETTINGS.arrivals[short_arrival]) ** 2)
    if widths is not None and size:
        plan_motion = a, b, internal
        solution, fraction = retime_in_ranges(curve, s, plan_motion, widths, problem.epsilon, end)
        if solution is not None:
            return ReferencePiece(curve, *solution, fraction, start_b, passes, b)

    next_curve = after.curve if after is not None and phase.end is End.SMOOTH else None

    def find_rows(motion: PathMotion) -> CurveLimitRows:
        rows = make_rows(curve, s, motion)
        return rows if next_curve is None else add_limits_beyond(rows, next_curve)

    best: tuple[CurveLimitRows, ControllableSet, float] | None = None
    for factor in SETTINGS.speed_factors:
        motion = factor * a, factor * b
        rows = find_rows((*motion, internal))
        for _ in range(2 if factor < 1.0 else 0):
            rows = find_rows((*motion, find_internal_force(rows.slack, *motion)[1]))
        required = np.full(rows.slack.shape[1], size)
        required[rows.n_force :] = SETTINGS.reference_torque
        controllable_set = retime(s, rows.slack, required, motion[1], end)
        fraction = float(controllable_set.fraction.min())
        if best is not None and fraction <= best[2]:
            break
        best = rows, controllable_set, fraction
        if fraction >= SETTINGS.sufficient:
            break
    assert best is not None
    rows, controllable_set, fraction = best
    if fraction < 0.0 and end is None and not short_arrival:
        return _trace(problem, phase, plan, size, widths, touch, after, short_arrival=True)
    # The fraction of ranges is 0 if margins are those without ranges.
    fraction = fraction if widths is None else 0.0
    return ReferencePiece(curve, rows, controllable_set, fraction, start_b, passes, b)


def retime(
    s: Array,
    slack: Array,
    required: Array,
    cap: Array,
    end: tuple[float, float] | None = None,
    caps: Sequence[float] = SETTINGS.caps,
) -> ControllableSet:
    """Controllable motions nowhere faster than a plan, with the largest least fraction of margins.

    Parameters
    ----------
    s : (n,) [m]          nodes
    slack : (n, m, 5)     at the nodes, as in `CurveLimitRows`
    required : (m,)       slack at a fraction of 1
    cap : (n,) [m^2/s^2]  largest b
    end : [m^2/s^2]       least and largest b at the last node; by default the last of `cap`
    caps                  upper limits of the fraction, tried if some interval has less
    """
    limits, floor, end = PathLimits(slack, cap), SETTINGS.least_b * cap, end or (cap[-1], cap[-1])
    best: ControllableSet | None = None
    for limit in (1.0, *caps):
        fractions = [limit, *(fraction for fraction in SETTINGS.fractions if fraction < limit)]
        controllable_set = find_controllable(limits, required, np.diff(s), floor, end, fractions)
        if best is None or controllable_set.fraction.min() > best.fraction.min():
            best = controllable_set
        if best.fraction.min() >= 0.8 * limit:
            break
    assert best is not None
    return best


def retime_in_ranges(
    curve: Curve,
    s: Array,
    plan: PathMotion,
    widths: Mapping[str, float],
    least: float,
    end: tuple[float, float] | None = None,
) -> tuple[tuple[CurveLimitRows, ControllableSet] | None, float]:
    """The law's limits, the fastest motions that keep them in scaled ranges, and the scale.

    The scale is the largest feasible one up to 1 (bisection). For each scale the worst corners of
    the ranges and the motion are found by fixed-point iteration.

    Parameters
    ----------
    s : (n,) [m]  nodes
    plan : (n,)   a, b and internal force of a plan there; no motion is faster
    widths        half widths of the ranges; that of the delay as of `scale_ranges`
    least : [N]   least normal force within them
    end           as of `retime`
    """

    def find(fraction: float) -> tuple[CurveLimitRows, ControllableSet] | None:
        scaled = {name: min(fraction * width, SETTINGS.max_range) for name, width in widths.items()}
        limits, motion = find_range_limits(curve, s, np.sqrt(plan[1]), scaled, least), plan
        for _ in range(3):
            rows, slack, required = limits.at(motion)
            controllable_set = retime(s, slack, required, plan[1], end, ())
            b = controllable_set.run(float(controllable_set.high[0]))
            if controllable_set.fraction.min() < 0.5:
                return None
            a = np.gradient(b, s) / 2
            motion = a, b, find_internal_force(rows.slack, a, b)[1]
        return limits.at(motion)[0], controllable_set

    low, high, best = 0.0, 1.0, find(1.0)
    if best is not None:
        return best, 1.0
    # Downwards first: most ranges are only a little too wide.
    while high - low > 0.03 * high and high > 0.02:
        fraction = 0.8 * high if best is None else (low + high) / 2
        candidate = find(fraction)
        if candidate is None:
            high = fraction
        else:
            low, best = fraction, candidate
    return best, low


def _project(curve: Curve, plan: Trajectory, rows: Numbers) -> tuple[Array, Array, Array, Array]:
    """Places s, a, b and internal force of a plan's rows along a curve."""
    formation, metric = curve.formation, metric_weights(curve.formation.scene)
    z, grid = plan.z[rows], np.linspace(0.0, curve.length, 400)
    distances = (z[:, None] - curve.evaluate(grid).z[None]) ** 2 @ metric
    s = grid[distances.argmin(axis=1)]
    for _ in range(4):
        point = curve.evaluate(s)
        s = np.clip(s + ((z - point.z) * point.z_s) @ metric, 0.0, curve.length)
    point = curve.evaluate(s)
    v = (point.z_s * plan.z_dot[rows]) @ metric
    a = (point.z_s * plan.z_ddot[rows]) @ metric
    segment = np.searchsorted([part.stop for part in curve.segments[:-1]], s)
    forces = inverse(formation, point, directions_of(curve, segment))
    columns = [plan.contacts.index(name) for name in formation.names]
    rolling = [columns[row] for row in formation.rolling_rows]
    c = np.hstack([plan.c_n[rows][:, columns], plan.c_t[rows][:, rolling]])
    # Forces without internal force are orthogonal to the column of the internal force.
    return s, a, v**2, np.einsum("ni,ni->n", c, forces.of_c[..., LAMBDA])


def _tabulate_curve(pieces: Sequence[ReferencePiece], push: Array, holds: bool) -> dict[str, Array]:
    """Arrays of `CurveLaw` for phases in which a contact only changes its name.

    Slack, torques and normal forces are at both ends of intervals.
    """
    starts = np.cumsum([0.0, *(piece.rows.s[-1] for piece in pieces)])
    n_rows, parts = max(piece.rows.slack.shape[1] for piece in pieces), list[dict[str, Array]]()
    for piece, start in zip(pieces, starts, strict=False):
        rows, curve, formation = piece.rows, piece.curve, piece.curve.formation
        point = curve.evaluate(rows.s)
        mean = blend_directions(curve, rows.s, np.sqrt(piece.b) * SETTINGS.reversal_time)[0]
        forces = inverse(formation, point, mean)
        slack = np.tile(UNLIMITED, (len(rows.s), n_rows, 1))
        slack[:, : rows.slack.shape[1]] = rows.slack
        node_tables = slack, rows.torque, forces.of_c[:, : formation.n_contacts]
        slack, torque, c_n = (np.stack([table[:-1], table[1:]], axis=1) for table in node_tables)
        # Of equal limits of an interval all but one are left out.
        equal = (slack[:, :, :, None] == slack[:, :, None]).all(axis=(1, 4))
        slack.swapaxes(1, 2)[np.tril(equal, -1).any(axis=2)] = UNLIMITED
        # The last node of the piece before is the first one.
        skip = int(bool(parts))
        nodes = {"s": start + rows.s, "theta": point.z[:, 3:], "b": piece.b}
        spans = {"levels": slack, "torque": torque, "forces": c_n}
        parts.append({name: table[skip:] for name, table in nodes.items()})
        parts[-1] |= {name: table[..., COLUMNS] for name, table in spans.items()}
    return {
        **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
        "starts": starts[:-1],
        "push": push,
        "passes": np.array([pieces[-1].passes]),
        "keeps": np.array([float(holds)]),
    }


def _find_push(
    problem: Problem, plan: Trajectory, phase: Phase, pieces: Mapping[int, ReferencePiece]
) -> tuple[Array, bool]:
    """Torques at the end of a phase along a curve, and whether they are held until the next one."""
    last = int(np.flatnonzero(plan.phase == phase.index)[-1])
    push, hold = plan.tau[last], None
    if not np.isnan(plan.c_n[last]).all():
        hold = hold_end(problem, phase, pieces[phase.index].curve.end)
        push = push if hold is None else hold
    # Friction of the joints decides on rest if torques are not much larger than it.
    holds = bool((np.abs(push) < 10 * problem.scene.dry[3:]).all())
    if hold is not None and phase.index + 1 in pieces:
        # Also if torques of the next motion press too little at rest at its start.
        # Case: new polygon 34, phase 10.
        slack, still = pieces[phase.index + 1].rows.slack[:1], np.zeros(1)
        holds |= not find_internal_force(slack, still, still)[0][0] > 0
    return push, holds


def find_ranges(problem: Problem, plan: Trajectory) -> Mapping[str, float] | None:
    """Half widths of the ranges of a plan, or else of its problem, or None."""
    stored = plan.meta.get("ranges")
    if stored:
        return dict(stored["radii"])
    return None if problem.uncertainty is None else problem.ranges


def join_renamed(problem: Problem) -> Problem:
    """The problem without stops where phases along curves only rename a contact.

    Such an end does not stop the joints: they would go on far beyond it. Case: hexagon, phase 10,
    which is shorter than that distance.
    """
    phases = list[Phase]()
    for block in split_blocks(problem):
        before = phases[-1:]
        contacts = [phase.formation.contacts for phase in (*before, block[0])]
        if before and runs_on_curves((*before, *block)) and list_renamed(problem.scene, *contacts):
            phases[-1] = replace(phases[-1], end=End.SMOOTH)
        phases += block
    return replace(problem, phases=tuple(phases))


def make_policy(
    problem: Problem,
    plan: Trajectory | MotionLike,
    *,
    reserve: float | None = None,
    period: float = 1e-3,
    delay: float = 5e-4,
    contact_speed: float = 1.0,
    torque_limit: float | None = None,
    planner: Planner | None = None,
) -> Policy:
    """Make a policy that carries out a plan by feedback from the joints.

    Parameters
    ----------
    reserve               margin of normal forces. With ranges of numbers in plan or problem: factor
                          on these ranges (1). Otherwise in units of the root sum square of the
                          changes by masses that are 5 %, friction that is 10 % and torques that are
                          1 % off (2.5). If the plan has less, the motion is slower; 0: as the plan
    period : [s]          of the control loop
    delay : [s]           expected time from measuring to applying torques
    contact_speed         factor on the speed at which contacts are made; times at rest before the
                          next phase begins are longer by its inverse square
    torque_limit : [N m]  of both fingers, if the plan was made with less than the hand has
    planner               replans phases with more degrees of freedom that leave no margin, unless
                          `reserve` is 0

    InputError if a number is out of its range, or the plan is of another problem.
    """
    problem, plan = adopt_motion(problem, plan)
    ranges = find_ranges(problem, plan)
    reserve = (2.5 if ranges is None else 1.0) if reserve is None else reserve
    reserve = require_number(reserve, "reserve", nonnegative=True)
    period = require_number(period, "period", positive=True)
    delay = require_number(delay, "delay", nonnegative=True)
    contact_speed = require_number(contact_speed, "contact_speed", positive=True)
    scales, limit = problem.scene.scales, problem.scene.torque_limit.tolist()
    if torque_limit is not None:
        limit = [require_number(torque_limit, "torque_limit", positive=True)] * 2
    settings = LoopSettings(
        period=period,
        delay=delay,
        touch=contact_speed * SETTINGS.touch * scales.speed,
        still=REST_SPEED * scales.speed,
        dwell=SETTINGS.dwell / contact_speed**2,
        most=0.5 * scales.acceleration,
        limit=(limit[0], limit[1]),
    )
    durations, table, phases = np.diff(plan.phase_starts), problem.table, problem.phases
    if reserve and planner is not None:
        problem, plan = replan(planner, problem, plan)
    problem = join_renamed(problem)
    widths = None if ranges is None else scale_ranges(ranges, reserve, delay)
    pieces = trace_pieces(problem, plan, reserve, widths, contact_speed)
    tables, entries = list[dict[str, Array]](), list[dict[str, Any]]()
    for block in split_blocks(problem):
        entries += [{"number": p.number, "plan": float(durations[p.index])} for p in block]
        block_entries = entries[-len(block) :]
        if block[0].index in pieces:
            run = list[ReferencePiece]()
            for phase, entry in zip(block, block_entries, strict=True):
                piece = pieces[phase.index]
                run.append(piece)
                if phase.end is not End.SMOOTH:
                    tables.append(_tabulate_curve(run, *_find_push(problem, plan, phase, pieces)))
                    run = []
                seconds = float(find_duration(piece.b, np.diff(piece.rows.s)))
                seconds += 0.0 if piece.passes else settings.dwell + delay
                entry |= {"duration": seconds, "share": piece.share, "reserves": piece.reserves}
                # The policy stops at an end that the plan passes in motion.
                planned_end = phases[phase.index].end
                entry["stops"] = phase.end is End.REST and planned_end is not End.REST
                entry["gained"] = "" if phase.until.contact is None else phase.until.contact.name
        else:
            tables.append(tabulate_motion(problem, block, plan, period))
            ends = [*tables[-1]["starts"], tables[-1]["step"][0] * (len(tables[-1]["theta"]) - 1)]
            ends[-1] += settings.dwell + delay
            for entry, seconds in zip(block_entries, np.diff(ends).tolist(), strict=True):
                entry |= {"duration": seconds, "share": 0.0}
    duration = sum(phase["duration"] for phase in entries)
    about = {"name": problem.name, "duration": duration, "phases": entries, "problem": table}
    if ranges is not None and reserve:
        about.update(ranges=dict(ranges), reserve=reserve)
    return Policy(tables, settings, about)


def find_largest_factors(problem: Problem, plan: Trajectory, delay: float) -> dict[int, float]:
    """The largest factor on the ranges of each phase along a curve, by its number.

    It is at most 64, and no relative range exceeds `SETTINGS.largest_range`. `delay` [s] is the
    expected one of the torques. InputError if neither plan nor problem have ranges.
    """
    ranges = find_ranges(problem, plan)
    if ranges is None:
        raise InputError("", "uncertainty", "is missing; without ranges none is the widest")
    relative = max(ranges.get(p.name, 0.0) for p in PARAMETERS if not p.unit)
    factor = min(SETTINGS.max_range / relative, 64.0) if relative > 0 else 64.0
    pieces = trace_pieces(join_renamed(problem), plan, factor, scale_ranges(ranges, factor, delay))
    return {index + 1: factor * piece.share for index, piece in pieces.items()}
