"""Policies from plans: references along curves with robustness margins, and tables of all phases.

Torques and limits at places along a curve are coefficients of (1, s'', s'^2, s', lambda) of a
nominal motion. Its torques are applied: with other friction, mass or gains they lead to another s''
and internal force, and thus to other contact forces. Without ranges the margin of each limit is the
root sum square of what usual errors take away. Within ranges, limits hold in the worst corner
(`Corners`), both under nominal torques and with feedback that tracks the reference. The reference
is the fastest motion of the backward pass of `mechanics.speed_sweep` that keeps the largest least
share of the margins. Phases over time have a regulator (`regulator`).
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
from ..results.adopt import Moved, adopt_motion
from ..results.trajectory import Trajectory
from ..scene.model import Scene
from .curve_law import LoopSettings
from .playback import Policy
from .regulator import STILL, Planner, find_internal_force, hold_end, replan, tabulate_motion

COLUMNS = [ONE, B, V, A, LAMBDA]  # order of coefficients in the tables of a policy
PathMotion = tuple[Array, Array, Array]  # a, b and internal force at n places


@dataclass(frozen=True)
class ReferenceSettings:
    """Margins and accuracies of references."""

    late: float = 5e-4  # uncertainty of the delay without ranges [s]
    least: float = 0.02  # least margin of a normal force, over the scene's unit of force
    spare: float = 0.02  # margin of a torque for feedback, over its limit
    kept: float = 1.3  # margin of the reference's forces within ranges, over those of the law
    authority: float = 5.0  # margin of the reference's torques, over those of the law
    near: float = 1e-3  # time around a reversal in which friction may have either direction [s]
    touch: float = 3e-3  # speed s' at which contacts are made, over the scene's
    # Time constants of the approach to the end [s]: the second one where no slow motion keeps all
    # contacts and only braking presses them. Case: new polygon 16, phase 4.
    arrivals: tuple[float, float] = (6e-3, 2e-3)
    # Time at rest before the next phase begins [s]: contacts that errors open on arrival close
    # meanwhile. Case: heptagon_four_contacts, phase 3, where 12 ms are too short.
    dwell: float = 25e-3
    # Squared speeds over the plan's, tried until there is the margin: relative errors of torques
    # matter less where torques are small. Cases: square, phase 2; hexagon, phase 8; two flips,
    # phases 8 and 9.
    slower: tuple[float, ...] = (1.0, 0.5, 0.25)
    slowest: float = 0.1  # least b over the plan's of a motion with a margin: slow ones can stick
    # Shares of the margin that are tried, the largest first. Negative ones: limits of a plan hold
    # between its own nodes, so that at others they may be violated a little.
    shares: tuple[float, ...] = (*(0.8**k for k in range(12)), 0.04, 0.0, -0.1, -0.2, -0.4, -0.8)
    # Upper limits of the share of all intervals, if some interval has less, as a large share in one
    # interval can reduce that of another one. Case: square, 28 % slower without them.
    parts: tuple[float, ...] = (0.5, 0.2, 0.0)
    enough: float = 0.95  # least share that needs no slower motion
    widest: float = 0.9  # largest relative range


SETTINGS = ReferenceSettings()
UNLIMITED = np.array([1e9, 0.0, 0.0, 0.0, 0.0])
FIXED = np.array([1.0, 0.0, 1.0, 1.0, 0.0])
"""Columns that torques do not change: all but those of s'' and the internal force."""
CORNERS = ("mass", "inertia", *GROUPS["friction"])
"""Numbers whose ranges have corners; those of geometry and gains count to first order. The start is
measured, and a delay is in torques."""
DOUBTS = dict.fromkeys(CORNERS, 0.1) | {"mass": 0.05, "inertia": 0.05, "gain1": 0.01, "gain2": 0.01}
"""Relative uncertainties without ranges."""


class CurveLimitRows(NamedTuple):
    """Torques and limits at n places of a curve."""

    s: Array  # (n,) [m]
    torque: Array  # (n, 2, 5) [N m]
    # (n, m, 5): distances from limits over their margins: of forces with friction before, then
    # after the nearest reversal; of torques
    levels: Array
    presses: int  # how many of the m are of forces


def add_limits_beyond(rows: CurveLimitRows, after: Curve) -> CurveLimitRows:
    """Rows with the contact limits at the start of the curve `after`, under the last torques.

    Torques are held for a period. Where the contact passes from an edge to a vertex of a small
    radius, those of the old curve lose it. Case: query 9, phase 5.
    """
    formation, point, torque = after.formation, after.evaluate(np.zeros(1)), rows.torque[-1:]
    directions = directions_of(after, np.zeros(1, dtype=np.int64))
    forces = inverse(formation, point, directions)
    limits = split_limits(formation)[0]
    slack = measure_slack(limits, respond(forces, torque)[0], torque, point.z_s[:, 3:])
    beyond = np.tile(UNLIMITED, (len(rows.s), slack.shape[1], 1))
    beyond[-1] = slack[0] / (SETTINGS.least * limits.side_scales)[:, None]
    return rows._replace(levels=np.concatenate([rows.levels, beyond], axis=1))


def split_limits(formation: Formation) -> tuple[LimitSet, LimitSet]:
    """Limits with an epsilon of zero: those of contact forces, and those of torques alone.

    Speed limits are kept by the plan, and no motion of a policy is faster.
    """
    return make_limits(formation, 0.0).split(2)[0].split(4)


def find_torques(curve: Curve, s: Array, directions: Directions) -> Array:
    """Torques at n places, shape (n, 2, 5)."""
    point = curve.evaluate(np.clip(s, 0.0, curve.length))
    return inverse(curve.formation, point, directions).of_tau


def respond(forces: PathForces, torque: Array) -> tuple[Array, Array]:
    """Contact forces, (n, n_c + R, 5), a and internal force, (n, 2, 5), from torques (n, 2, 5)."""
    free = [A, LAMBDA]
    motion = np.linalg.solve(forces.of_tau[..., free], torque - FIXED * forces.of_tau)
    return np.asarray(forces.of_c[..., free] @ motion + FIXED * forces.of_c), np.asarray(motion)


def measure_slack(limits: LimitSet, c: Array, torque: Array, rates: Array) -> Array:
    """Slack of limits, (n, m, 5) [N, N m], from coefficients of c and torques; `rates` (n, 2)."""
    return limits.find_slack_rows(find_value_rows(limits, PathForces(c, torque), rates))


def level_torques(limits: LimitSet, torque: Array, rates: Array) -> Array:
    """Distances of torques, (n, 2, 5), from their limits over their margins, shape (n, m, 5)."""
    none = np.zeros((len(torque), limits.rows.shape[1] - 4, 5))
    slack = measure_slack(limits, none, torque, rates)
    return slack / (SETTINGS.spare * limits.side_scales)[:, None]


def of_forces(limits: LimitSet) -> Array:
    """Derivatives of the slack of limits by contact forces, shape (m, n_c + R)."""
    rows, signs, _ = limits.sides
    return np.asarray(signs[:, None] * limits.rows[rows, :-4])


def make_rows(curve: Curve, s: Array, motion: PathMotion) -> CurveLimitRows:
    """Rows at places of a curve, with margins for a motion (a, b, lambda)."""
    formation, point, speed = curve.formation, curve.evaluate(s), np.sqrt(motion[1])
    mean, *sides = blend_directions(curve, s, speed * SETTINGS.near)
    torque, late = (find_torques(curve, s - late * speed, mean) for late in (0.0, SETTINGS.late))
    (contact, joint), rates = split_limits(formation), point.z_s[:, 3:]
    levels = list[Array]()
    for side in sides:
        forces = inverse(formation, point, side)
        c = respond(forces, torque)[0]
        slack = measure_slack(contact, c, torque, rates)
        state = Sensitivity.of_curve(formation, point, side, forces)
        changes = np.array([*DOUBTS.values()])[:, None] * state.find_slopes(tuple(DOUBTS))
        delay = respond(forces, late)[0] - c
        changes = np.append(changes, delay[:, :, None], axis=2)
        errors = apply(changes, *motion)
        error = np.linalg.norm(of_forces(contact) @ errors, axis=2)
        levels.append(slack / (SETTINGS.least * contact.side_scales + error)[..., None])
    before, after = map(np.hstack, sides)
    levels[1][(before == after).all(axis=1)] = UNLIMITED
    levels.append(level_torques(joint, torque, rates))
    return CurveLimitRows(s, torque, np.concatenate(levels, axis=1), 2 * levels[0].shape[1])


def blend_directions(curve: Curve, s: Array, width: Array) -> list[Directions]:
    """Sliding directions blended over reversals of a width (n,) [m], and as before and after."""
    signs = [np.append(part.Xi, part.sigma) for part in curve.segments]
    blended = np.tile(signs[0], (3, len(s), 1))
    for before, (one, other) in zip(curve.segments, pairwise(signs), strict=False):
        near = max(float(np.interp(before.stop, s, width)), 1e-3 * curve.length)
        share = np.clip(0.5 + (s - before.stop) / (2 * near), 0.0, 1.0)[:, None]
        blended += np.stack([share, np.floor(share), np.ceil(share)]) * (other - one)
    return [Directions(*np.split(each, [-2], axis=1)) for each in blended]


class Corners(NamedTuple):
    """Levels of limits at n places in k corners, of the nominal (1, a, b, s', internal force)."""

    rows: Array  # (k, n, m, 5)
    moves: Array  # (k, n, 5): actual acceleration s''
    swings: Array  # (p, n, m, 5): first-order changes by each other range

    def pick(self, motion: PathMotion) -> Array:
        """The limits in the corner that is worst for a motion, shape (n, m, 5)."""
        values = stack_motion(*motion)
        worst = np.einsum("knmq,nq->knm", self.rows, values).argmin(axis=0)
        rows = np.take_along_axis(self.rows, worst[None, ..., None], axis=0)[0]
        signs = np.sign(np.einsum("pnmq,nq->pnm", self.swings, values))
        return np.asarray(rows - np.einsum("pnm,pnmq->nmq", signs, self.swings))

    def close(self, others: Array) -> Corners:
        """These and other limits, (n, l, 5), with feedback that makes s'' equal to a."""
        count = len(self.rows)
        rows = np.concatenate([self.rows, np.tile(others, (count, 1, 1, 1))], axis=2)
        rate, rest = self.moves[:, :, None, [A]], self.moves[:, :, None].copy()
        rest[..., A] = 0.0
        asked = rows[..., [A]] / rate
        closed = rows - asked * rest
        closed[..., [A]] = asked
        wider = ((0, 0), (0, 0), (0, others.shape[1]), (0, 0))
        return Corners(closed, self.moves, np.pad(self.swings, wider))


def find_corners(
    formation: Formation,
    point: CurvePoint,
    side: Directions,
    torques: tuple[Array, Array, Array],
    widths: Mapping[str, float],
    unit: Array,
) -> Corners:
    """Limits of forces over margins, `unit` (m,) [N], in the corners of ranges with half `widths`.

    Torques, (n, 2, 5) each, are the nominal ones, delayed ones, and the derivative by s.
    """
    rows, moves = list[Array](), list[Array]()
    torque, late, slope = torques
    for scene in list_scenes(formation.scene, widths):
        changed = replace(formation, scene=scene)
        c, motion = respond(inverse(changed, point, side), torque)
        rows.append(measure_slack(split_limits(changed)[0], c, torque, point.z_s[:, 3:]))
        moves.append(motion[:, 0])
    nominal = inverse(formation, point, side)
    swings = [respond(nominal, late)[0] - respond(nominal, torque)[0]]
    first_order = (*GROUPS["geometry"], *GROUPS["gain"])
    state = Sensitivity.of_curve(formation, point, side, nominal)
    for name in (other for other in first_order if widths.get(other, 0.0) > 0):
        slopes = state.find_slopes((name,))[:, :, 0]
        if name in GROUPS["geometry"]:
            # Torques depend on the apparent place.
            moved = torque + state.find_shifts(name)[:, None, None] * slope
            slopes = slopes + respond(nominal, moved)[0] - respond(nominal, torque)[0]
        swings.append(widths[name] * slopes)
    of_c, margin = of_forces(split_limits(formation)[0]), unit[:, None]
    return Corners(np.array(rows) / margin, np.array(moves), of_c / margin @ np.array(swings))


def list_scenes(scene: Scene, widths: Mapping[str, float]) -> tuple[Scene, ...]:
    """Scenes in the corners of ranges with half `widths`."""
    names = [name for name in CORNERS if widths.get(name, 0.0) > 0]
    return tuple(
        change_scene(scene, {n: k * widths[n] for n, k in zip(names, signs, strict=True)})
        for signs in product((-1, 1), repeat=len(names))
    )


class Within(NamedTuple):
    """Limits along a curve within ranges, at n places."""

    s: Array  # (n,) [m]
    torque: Array  # (n, 2, 5) [N m]
    left: Array  # (n, l, 5): levels of torques
    sides: tuple[Corners, Corners]  # with friction before and after the nearest reversal
    same: Array  # (n,): where these are equal

    def at(self, motion: PathMotion) -> tuple[CurveLimitRows, Array, Array]:
        """The law's limits near a motion; levels of the reference, and the least of each, (m,)."""
        # With its internal force, and with the least and largest one within torques.
        a, b, internal = motion
        ends = PathLimits(self.left, b).find_internal_force_range(a, b)
        low, high = (np.where(np.isfinite(end), end, internal) for end in ends)
        motions = [motion, (a, b, np.minimum(low, internal)), (a, b, np.maximum(high, internal))]
        forces = self._pick(self.sides, motions)
        closed = self._pick([side.close(self.left) for side in self.sides], motions)
        levels = np.concatenate([forces, self.left], axis=1)
        rows = CurveLimitRows(self.s, self.torque, levels, forces.shape[1])
        count, drives = self.sides[0].rows.shape[2], self.left.shape[1]
        press, drive = np.full(count, SETTINGS.kept), np.full(drives, SETTINGS.authority)
        again = np.tile(np.append(press, drive), 2 * len(motions))
        wanted = np.concatenate([np.tile(press, 2 * len(motions)), drive, again])
        return rows, np.concatenate([levels, closed], axis=1), wanted

    def _pick(self, sides: tuple[Corners, ...] | list[Corners], motions: list[PathMotion]) -> Array:
        """Limits on both sides of reversals in the worst corners of motions, (n, rows, 5)."""
        limits = [np.concatenate([side.pick(each) for each in motions], axis=1) for side in sides]
        limits[1][self.same] = UNLIMITED
        return np.concatenate(limits, axis=1)


def find_within(
    curve: Curve, s: Array, speed: Array, widths: Mapping[str, float], least: float
) -> Within:
    """Limits along a curve within ranges, with forces of at least so much [N]."""
    formation, point = curve.formation, curve.evaluate(s)
    # Limits are interpolated: nodes next to a reversal need both directions.
    gaps = np.pad(np.diff(s), 1)
    width = np.maximum(speed * SETTINGS.near, 1.01 * np.maximum(gaps[1:], gaps[:-1]))
    mean, *sides = blend_directions(curve, s, width)
    late = s - (SETTINGS.late + widths.get("delay", 0.0)) * speed
    nominal, step = find_torques(curve, s, mean), 1e-4 * curve.length
    before, after = (find_torques(curve, s + sign * step, mean) for sign in (-1, 1))
    torques = nominal, find_torques(curve, late, mean), (after - before) / (2 * step)
    contact, joint = split_limits(formation)
    unit = np.maximum(SETTINGS.least * contact.side_scales, least)
    corners = [find_corners(formation, point, side, torques, widths, unit) for side in sides]
    one, other = map(np.hstack, sides)
    left, same = level_torques(joint, nominal, point.z_s[:, 3:]), (one == other).all(axis=1)
    return Within(s, nominal, left, (corners[0], corners[1]), same)


class ReferencePiece(NamedTuple):
    """The reference of a phase along a curve."""

    curve: Curve
    rows: CurveLimitRows
    reach: ControllableSet
    share: float  # least share of the margin
    begins: float  # [m^2/s^2]: the plan's b at the start
    passes: float  # ratio of b after and before the end, passed in motion; zero at rest
    b: Array  # (n,) [m^2/s^2]: the reference

    @property
    def reserves(self) -> dict[str, float]:
        """Least level of each contact's normal force along the reference."""
        rows, names = self.rows, self.curve.formation.names
        a = np.diff(self.b) / (2 * np.diff(rows.s))
        a = np.append(a, a[-1])
        count = len(split_limits(self.curve.formation)[0].low)
        motion = stack_motion(a, self.b, find_internal_force(rows.levels, a, self.b)[1])
        levels = np.einsum("nmi,ni->nm", rows.levels[:, : rows.presses], motion)
        least = levels.min(axis=0).reshape(-1, count).min(axis=0)
        return dict(zip(names, least[: len(names)].tolist(), strict=True))


def scale_ranges(ranges: Mapping[str, float], size: float, delay: float) -> dict[str, float]:
    """Half widths of scaled ranges; of the delay its unknown part, with a known `delay` [s]."""
    widths = {name: size * width for name, width in ranges.items()}
    late = widths.get("delay", 0.0)
    # Torques may be early as well: a delay is anything from none to its range.
    return widths | {"delay": max(late - delay, delay) if late else 0.0}


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
    brief: bool = False,
) -> ReferencePiece:
    """A phase's curve, and the controllable motions along it that keep margins.

    `brief` is whether the shorter one of `SETTINGS.arrivals` is used.
    """
    rows_of_phase = np.flatnonzero((plan.phase == phase.index) & ~plan.held)
    curve = trace_phase(phase, plan.z[rows_of_phase[0]], problem.phases[phase.index + 1 :])
    places, *values = _follow(curve, plan, rows_of_phase)
    # Nodes of the table, with all reversals.
    s = curve.length * (1 - np.cos(np.pi * np.linspace(0, 1, 121))) / 2
    s = np.sort(np.concatenate([s, [part.stop for part in curve.segments[:-1]]]))
    s = s[np.diff(s, prepend=-1.0) > 1e-7 * curve.length]
    a, b, internal = (np.interp(s, places, value) for value in values)
    begins, passes, end = float(b[0]), 0.0, None
    impact = phase.end is End.IMPACT and b[-1] > touch**2
    if after is not None and (impact or phase.end is End.SMOOTH):
        passes = after.begins / float(b[-1]) if impact else 1.0
        end = float(after.reach.low[0] / passes), float(after.reach.high[0] / passes)
    else:
        b = np.minimum(b, (touch + (curve.length - s) / SETTINGS.arrivals[brief]) ** 2)
    if widths is not None and size:
        planned = a, b, internal
        within, share = retime_within(curve, s, planned, widths, problem.epsilon, end)
        if within is not None:
            return ReferencePiece(curve, *within, share, begins, passes, b)

    beyond = after.curve if after is not None and phase.end is End.SMOOTH else None

    def find_rows(motion: PathMotion) -> CurveLimitRows:
        rows = make_rows(curve, s, motion)
        return rows if beyond is None else add_limits_beyond(rows, beyond)

    best: tuple[CurveLimitRows, ControllableSet, float] | None = None
    for factor in SETTINGS.slower:
        motion = factor * a, factor * b
        rows = find_rows((*motion, internal))
        for _ in range(2 if factor < 1.0 else 0):
            rows = find_rows((*motion, find_internal_force(rows.levels, *motion)[1]))
        wanted = np.full(rows.levels.shape[1], size)
        wanted[rows.presses :] = SETTINGS.authority
        controllable_set = retime(s, rows.levels, wanted, motion[1], end)
        share = float(controllable_set.share.min())
        if best is not None and share <= best[2]:
            break
        best = rows, controllable_set, share
        if share >= SETTINGS.enough:
            break
    assert best is not None
    rows, controllable_set, share = best
    if share < 0.0 and end is None and not brief:
        return _trace(problem, phase, plan, size, widths, touch, after, brief=True)
    # Margins without ranges keep no share of ranges.
    share = share if widths is None else 0.0
    return ReferencePiece(curve, rows, controllable_set, share, begins, passes, b)


def retime(
    s: Array,
    levels: Array,
    reserve: Array,
    cap: Array,
    end: tuple[float, float] | None = None,
    parts: Sequence[float] = SETTINGS.parts,
) -> ControllableSet:
    """Controllable motions nowhere faster than a plan, with the largest least share of margins.

    Parameters
    ----------
    s : (n,) [m]          nodes
    levels : (n, m, 5)    limits at the nodes, as in `CurveLimitRows`
    reserve : (m,)        levels with a share of 1
    cap : (n,) [m^2/s^2]  largest b
    end : [m^2/s^2]       least and largest b at the last node; by default the last of `cap`
    parts                 upper limits of the share, tried where some interval has less
    """
    limits, floor, end = PathLimits(levels, cap), SETTINGS.slowest * cap, end or (cap[-1], cap[-1])
    best: ControllableSet | None = None
    for part in (1.0, *parts):
        shares = [part, *(share for share in SETTINGS.shares if share < part)]
        controllable_set = find_controllable(limits, reserve, np.diff(s), floor, end, shares)
        if best is None or controllable_set.share.min() > best.share.min():
            best = controllable_set
        if best.share.min() >= 0.8 * part:
            break
    assert best is not None
    return best


def retime_within(
    curve: Curve,
    s: Array,
    plan: PathMotion,
    widths: Mapping[str, float],
    least: float,
    end: tuple[float, float] | None = None,
) -> tuple[tuple[CurveLimitRows, ControllableSet] | None, float]:
    """The law's limits and the fastest motions that keep them within a share of ranges; the share.

    It is the largest feasible one. Fixed-point iteration between the worst corners of the ranges
    and the motion.

    Parameters
    ----------
    s : (n,) [m]  nodes
    plan : (n,)   a, b and internal force of a plan there; no motion is faster
    widths        half widths of the ranges; that of the delay is its unknown part
    least : [N]   least normal force within them
    end           as of `retime`
    """

    def find(share: float) -> tuple[CurveLimitRows, ControllableSet] | None:
        scaled = {name: min(share * width, SETTINGS.widest) for name, width in widths.items()}
        within, motion = find_within(curve, s, np.sqrt(plan[1]), scaled, least), plan
        for _ in range(3):
            rows, whole, wanted = within.at(motion)
            controllable_set = retime(s, whole, wanted, plan[1], end, ())
            b = controllable_set.run(float(controllable_set.high[0]))
            if controllable_set.share.min() < 0.5:
                return None
            a = np.gradient(b, s) / 2
            motion = a, b, find_internal_force(rows.levels, a, b)[1]
        return within.at(motion)[0], controllable_set

    low, high, best = 0.0, 1.0, find(1.0)
    if best is not None:
        return best, 1.0
    # Downwards first: most ranges are only a little too wide.
    while high - low > 0.03 * high and high > 0.02:
        share = 0.8 * high if best is None else (low + high) / 2
        candidate = find(share)
        if candidate is None:
            high = share
        else:
            low, best = share, candidate
    return best, low


def _follow(curve: Curve, plan: Trajectory, rows: Numbers) -> tuple[Array, Array, Array, Array]:
    """Places s, a, b and internal force of a plan's rows along a curve."""
    formation, metric = curve.formation, metric_weights(curve.formation.scene)
    z, grid = plan.z[rows], np.linspace(0.0, curve.length, 400)
    away = (z[:, None] - curve.evaluate(grid).z[None]) ** 2 @ metric
    s = grid[away.argmin(axis=1)]
    for _ in range(4):
        point = curve.evaluate(s)
        s = np.clip(s + ((z - point.z) * point.z_s) @ metric, 0.0, curve.length)
    point = curve.evaluate(s)
    v = (point.z_s * plan.z_dot[rows]) @ metric
    a = (point.z_s * plan.z_ddot[rows]) @ metric
    segment = np.searchsorted([part.stop for part in curve.segments[:-1]], s)
    forces = inverse(formation, point, directions_of(curve, segment))
    columns = [plan.contacts.index(name) for name in formation.names]
    rolls = [columns[row] for row in formation.rolling_rows]
    c = np.hstack([plan.c_n[rows][:, columns], plan.c_t[rows][:, rolls]])
    # The other parts of the forces are orthogonal to that of the internal force.
    return s, a, v**2, np.einsum("ni,ni->n", c, forces.of_c[..., LAMBDA])


def _tabulate_curve(pieces: Sequence[ReferencePiece], push: Array, keeps: bool) -> dict[str, Array]:
    """Arrays of `CurveLaw` for phases in which contacts go on under other names.

    Levels, torques and normal forces are at both ends of intervals.
    """
    starts = np.cumsum([0.0, *(piece.rows.s[-1] for piece in pieces)])
    most, parts = max(piece.rows.levels.shape[1] for piece in pieces), list[dict[str, Array]]()
    for piece, start in zip(pieces, starts, strict=False):
        rows, curve, formation = piece.rows, piece.curve, piece.curve.formation
        point = curve.evaluate(rows.s)
        mean = blend_directions(curve, rows.s, np.sqrt(piece.b) * SETTINGS.near)[0]
        forces = inverse(formation, point, mean)
        levels = np.tile(UNLIMITED, (len(rows.s), most, 1))
        levels[:, : rows.levels.shape[1]] = rows.levels
        tables = levels, rows.torque, forces.of_c[:, : formation.n_contacts]
        levels, torque, c_n = (np.stack([one[:-1], one[1:]], axis=1) for one in tables)
        # Of equal limits of an interval one is enough.
        equal = (levels[:, :, :, None] == levels[:, :, None]).all(axis=(1, 4))
        levels.swapaxes(1, 2)[np.tril(equal, -1).any(axis=2)] = UNLIMITED
        # The last node of the piece before is the first one.
        first = int(bool(parts))
        nodes = {"s": start + rows.s, "theta": point.z[:, 3:], "b": piece.b}
        spans = {"levels": levels, "torque": torque, "forces": c_n}
        parts.append({name: table[first:] for name, table in nodes.items()})
        parts[-1] |= {name: table[..., COLUMNS] for name, table in spans.items()}
    return {
        **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
        "starts": starts[:-1],
        "push": push,
        "passes": np.array([pieces[-1].passes]),
        "keeps": np.array([float(keeps)]),
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
    # Friction of the joints decides on rest where torques are not much larger.
    keeps = bool((np.abs(push) < 10 * problem.scene.dry[3:]).all())
    if hold is not None and phase.index + 1 in pieces:
        # Or if torques of the next motion press too little with no speed wanted at its start.
        # Case: new polygon 34, phase 10.
        levels, still = pieces[phase.index + 1].rows.levels[:1], np.zeros(1)
        keeps |= not find_internal_force(levels, still, still)[0][0] > 0
    return push, keeps


def find_ranges(problem: Problem, plan: Trajectory) -> Mapping[str, float] | None:
    """Half widths of the ranges of a plan, or else of its problem, or None."""
    figures = plan.meta.get("ranges")
    if figures:
        return dict(figures["radii"])
    return None if problem.uncertainty is None else problem.ranges


def pass_renamed(problem: Problem) -> Problem:
    """The problem without stops where phases along curves only rename a contact.

    Such an end does not stop the joints: they would go on to well beyond it. Case: hexagon, phase
    10, which is shorter than that.
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
    plan: Trajectory | Moved,
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
                          on these ranges (1). Otherwise in units of the errors from masses that are
                          5 %, friction that is 10 % and torques that are 1 % off, root sum square
                          (2.5). Where the plan leaves less, the motion is slower; 0: as the plan
    period : [s]          of the control loop
    delay : [s]           from measuring to applying torques, as far as known
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
        still=STILL * scales.speed,
        dwell=SETTINGS.dwell / contact_speed**2,
        most=0.5 * scales.acceleration,
        limit=(limit[0], limit[1]),
    )
    durations, given, phases = np.diff(plan.phase_starts), problem.table, problem.phases
    if reserve and planner is not None:
        problem, plan = replan(planner, problem, plan)
    problem = pass_renamed(problem)
    widths = None if ranges is None else scale_ranges(ranges, reserve, delay)
    pieces = trace_pieces(problem, plan, reserve, widths, contact_speed)
    tables, about = list[dict[str, Array]](), list[dict[str, Any]]()
    for block in split_blocks(problem):
        about += [{"number": p.number, "plan": float(durations[p.index])} for p in block]
        entries = about[-len(block) :]
        if block[0].index in pieces:
            run = list[ReferencePiece]()
            for phase, entry in zip(block, entries, strict=True):
                piece = pieces[phase.index]
                run.append(piece)
                if phase.end is not End.SMOOTH:
                    tables.append(_tabulate_curve(run, *_find_push(problem, plan, phase, pieces)))
                    run = []
                lasts = float(find_duration(piece.b, np.diff(piece.rows.s)))
                lasts += 0.0 if piece.passes else settings.dwell + delay
                entry |= {"duration": lasts, "share": piece.share, "reserves": piece.reserves}
                # The plan goes on in motion there.
                planned_end = phases[phase.index].end
                entry["stops"] = phase.end is End.REST and planned_end is not End.REST
                entry["gained"] = "" if phase.until.contact is None else phase.until.contact.name
        else:
            tables.append(tabulate_motion(problem, block, plan, period))
            ends = [*tables[-1]["starts"], tables[-1]["step"][0] * (len(tables[-1]["theta"]) - 1)]
            ends[-1] += settings.dwell + delay
            for entry, lasts in zip(entries, np.diff(ends).tolist(), strict=True):
                entry |= {"duration": lasts, "share": 0.0}
    duration = sum(phase["duration"] for phase in about)
    whole = {"name": problem.name, "duration": duration, "phases": about, "problem": given}
    if ranges is not None and reserve:
        whole.update(ranges=dict(ranges), reserve=reserve)
    return Policy(tables, settings, whole)


def find_widest(problem: Problem, plan: Trajectory, delay: float) -> dict[int, float]:
    """The largest factor on the ranges of each phase along a curve, by its number.

    It is at most 64, and no relative range exceeds `SETTINGS.widest`. The delay [s] is
    that of the torques, as far as known. InputError if neither plan nor problem have ranges.
    """
    ranges = find_ranges(problem, plan)
    if ranges is None:
        raise InputError("", "uncertainty", "is missing; without ranges none is the widest")
    relative = max(ranges.get(p.name, 0.0) for p in PARAMETERS if not p.unit)
    most = min(SETTINGS.widest / relative, 64.0) if relative > 0 else 64.0
    pieces = trace_pieces(pass_renamed(problem), plan, most, scale_ranges(ranges, most, delay))
    return {index + 1: most * piece.share for index, piece in pieces.items()}
