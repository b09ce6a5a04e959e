"""Second opinions on refusals, by arguments that share nothing with the planner.

Contacts and forces are those of bodies and points (`verification.newton_euler`), distances are by
separating axes; nothing is known of C-functions or limits of formations.

A phase of one freedom is followed as an ordinary differential equation (`follow`) up to its `until`
or to where a contact leaves its feature or bodies run into each other. Along a curve z(s) the speed
squared b = s'^2 and the acceleration a = s'' enter every force linearly, and so do the contact
forces: whether any motion keeps all limits is a linear programme, discretised in s. Two questions
are asked of it, each for the largest share `margin` by which all limits can be kept at once
(negative where they cannot):

* `slow_margin`: at b = a = 0. Positive, a slow enough motion exists.
* `fast_margin`: with b >= 0 free along the curve, at rest at its ends. Negative, none exists.
  Viscous friction is not linear in b; what stands in for sqrt(b) may be anything between its chord
  and its tangents, which can only allow more.

A motion with two freedoms from rest to the end of its phase follows some curve x(u), phi(u).
Cubic curves to many places of the end are straight or drawn at random, and the largest
`fast_margin` of them counts: a search for a plan that shares neither transcription nor guesses with
the planner.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import BPoly
from scipy.optimize import brentq, linprog

from ..common.arrays import Array, Expression, Flags
from ..common.errors import WholearmError
from ..contacts.formation import Formation
from ..mechanics import UNIQUENESS
from ..mechanics.dynamics import metric_weights, null_vector
from ..planning.plan import solve
from ..problem.definition import End, Phase, Problem
from ..scene.model import Scene
from ..verification.newton_euler import link_axis, locate, norm, place_object

OVERLAP = 1e-6
"""Overlap over the radius of gyration from which on two bodies count as running into each other."""


class Trace(NamedTuple):
    """A curve of configurations that keep a phase's contacts closed."""

    place: Callable[[Array], Array]  # configurations, shape (5, n), at arc lengths
    length: float  # [m]
    end: Array  # (5,)
    tangents: Callable[[Array], Array]  # unit tangents along the way, shape (n, 5), from (n, 5)
    ending: str  # what ends it
    reached: bool  # whether that is the phase's `until`


def follow(phase: Phase, z: Array) -> tuple[Trace, Trace]:
    """Follow a phase's contacts from `z`, shape (5,), both ways."""
    # The phase before ends where bodies overlap by `OVERLAP`.
    closed = project(phase, z)
    z = z if closed is None else closed
    return _march(phase, z, 1.0), _march(phase, z, -1.0)


def project(phase: Phase, z: Array, end: bool = False) -> Array | None:
    """Nearest configuration to `z` that closes a phase's contacts, at its `end` if that is asked.

    By Newton's method; None if there is none.
    """
    scene = phase.formation.scene
    scale, size = np.sqrt(metric_weights(scene)), scene.scales.length
    for _ in range(20):
        miss, rows = _find_misses(phase, z, end)
        step = -np.linalg.pinv(rows / scale, rcond=1e-10) @ miss / scale
        z = z + step
        if np.abs(step * scale).max() < 1e-13 * size:
            break
    return z if np.abs(_find_misses(phase, z, end)[0]).max() < 1e-9 * size else None


def _find_misses(phase: Phase, z: Array, end: bool) -> tuple[Array, Array]:
    """Gaps at one configuration, with `end` also what is missing to that, and their rows (m, 5)."""
    (gaps,), (rows,) = constrain(phase.formation, z[None])
    rows, contact = rows[: len(gaps)], phase.until.contact
    if not end:
        return gaps, rows
    if contact is not None:
        touch = locate(phase.formation.scene, contact.name, z[None])
        gaps, rows = np.append(gaps, touch.gap[0]), np.vstack([rows, touch.normal[0]])
    places = dict(phase.until.poses)
    missing = [z[k] - value for k, value in places.items()]
    return np.append(gaps, missing), np.vstack([rows, np.eye(5)[[*places]]])


def constrain(formation: Formation, z: Array) -> tuple[Array, Array]:
    """Gaps, shape (n, n_c), and rows of the constraints, (n, n_c + R, 5), at configurations."""
    touches = [locate(formation.scene, name, z) for name in formation.names]
    rows = [t.normal for t in touches] + [touches[k].tangent for k in formation.rolling_rows]
    return np.stack([touch.gap for touch in touches], axis=1), np.stack(rows, axis=1)


def _march(phase: Phase, z: Array, way: float) -> Trace:
    """Integrate the unit tangent up to the first event."""
    scene, until = phase.formation.scene, phase.until
    size, scale = scene.scales.length, np.sqrt(metric_weights(scene))
    near = OVERLAP * size

    def tangents(z: Array) -> Array:
        # By minors: unlike null vectors of an SVD they keep their sense.
        return np.asarray(way * null_vector(constrain(phase.formation, z)[1] / scale) / scale)

    def overlap(_: float, z: Array) -> float:
        return float(min(room[0] for room in find_room(phase.formation, z[None]).values())) + near

    def end(_: float, z: Array) -> float:
        if until.contact is not None or until.value is None:
            return 1.0
        return float(z[0 if until.coordinate == "x" else 2] - until.value)

    overlap.terminal, overlap.direction, end.terminal = True, -1.0, True  # type: ignore[attr-defined]
    run: Any = solve_ivp(
        lambda _, z: tangents(z[None])[0],
        (0.0, 60.0 * size),  # several turns of the object
        z,
        rtol=1e-9,
        atol=1e-10 * size / scale,
        max_step=0.02 * size,
        dense_output=True,
        events=(overlap, end),
    )
    last = run.y[:, -1]
    text = "nothing happens" if run.status == 0 else "the contacts become dependent"
    met = run.status == 1 and len(run.t_events[1]) > 0
    if run.status == 1 and not met:
        rooms = find_room(phase.formation, last[None])
        text = ", ".join(name for name, room in rooms.items() if room[0] < -near / 2)
        if until.contact is not None:
            touch = locate(scene, until.contact.name, last[None])
            met = bool(max(abs(touch.gap[0]), -touch.low[0], -touch.high[0]) <= 10 * near)
    return Trace(run.sol, float(run.t[-1]), last, tangents, str(until) if met else text, met)


def find_room(formation: Formation, z: Array) -> dict[str, Array]:
    """Room of n configurations to overlaps, and of contacts to the ends of features, (n,) [m]."""
    touches = {f"{name} leaves": locate(formation.scene, name, z) for name in formation.names}
    ends = {name: np.minimum(touch.low, touch.high) for name, touch in touches.items()}
    return clearances(formation.scene, z) | ends


def resample(formation: Formation, trace: Trace, count: int) -> tuple[Array, Array, Array]:
    """Arc lengths s, (n,) [m], z and unit tangents z_s, (n, 5), at even places of a curve.

    And also where a contact or a joint turns.
    """

    def slide(s: Array) -> Array:
        z = trace.place(s).T
        return slides(formation, z, trace.tangents(z))

    s = np.linspace(0.0, trace.length, count)
    rates = slide(s)
    rates[np.abs(rates) < 1e-9 * np.abs(rates).max()] = 0.0
    turns = [
        brentq(lambda x, row=row: slide(np.array([x]))[0, row], s[k], s[k + 1])
        for k, row in zip(*np.nonzero(rates[1:] * rates[:-1] < 0), strict=True)
    ]
    s = np.unique([*s, *turns])
    s = s[np.append(True, np.diff(s) > 1e-9 * formation.scene.scales.length)]
    z = trace.place(s).T
    return s, z, trace.tangents(z)


def slides(formation: Formation, z: Array, z_s: Array) -> Array:
    """Rates of sliding of the contacts and of the joints along z_s, shape (n, n_c + 2)."""
    rows = [(locate(formation.scene, n, z).tangent * z_s).sum(axis=1) for n in formation.names]
    return np.column_stack([*rows, z_s[:, 3:]])


def clearances(scene: Scene, z: Array) -> dict[str, Array]:
    """Signed distances [m] of every solid pair at n configurations, each of shape (n,).

    Exact where a pair overlaps by a little or faces flat to vertex; elsewhere a lower bound of the
    distance, with the right sign. The palm does not stop a link.
    """
    corners, bones = place_object(scene, z), list[Array]()
    apart = {"object and palm": corners[..., 1].min(axis=1)}
    for finger, link in enumerate(scene.fingers):
        base = np.broadcast_to(np.asarray(link.base), (len(z), 2))
        bones.append(np.stack([base, base + link.length * link_axis(z, finger)], axis=1))
        gap = separate(corners, bones[finger]) - link.radius
        apart[f"object and finger {finger + 1}"] = gap
    if scene.fingers_collide:
        thick = sum(link.radius for link in scene.fingers)
        apart["finger 1 and finger 2"] = separate(*bones) - thick
    return apart


def separate(first: Array, second: Array) -> Array:
    """Signed distance of convex polygons or segments, shape (n, k, 2) and (n, m, 2), as (n,).

    Positive: the distance. Negative: minus the depth of the overlap. It is the largest gap of their
    projections: along the lines from corner to corner, or along the normals of edges.
    """
    lines = first[:, :, None] - second[:, None]
    sides = [np.roll(body, -1, axis=1) - body for body in (first, second)]
    normals = np.concatenate([sides[0], -sides[1]], axis=1)[..., ::-1] * np.array([-1.0, 1.0])
    along = np.concatenate([lines.reshape(len(first), -1, 2), normals], axis=1)
    size, (one, other) = norm(along), (along @ body.swapaxes(1, 2) for body in (first, second))
    gap = one.min(axis=2) - other.max(axis=2)
    # Where corners coincide there is no line.
    return np.asarray(np.where(size > 0, gap / np.maximum(size, 1e-300), -np.inf).max(axis=1))


Bounds = list[tuple[float | None, float | None]]


def slow_margin(formation: Formation, epsilon: float, z: Array, z_s: Array) -> float:
    """Least margin of all places, each at its best, for vanishing speed."""
    curve = np.arange(1.0 * len(z)), z, z_s
    margin = _solve_along(formation, epsilon, curve, np.zeros(len(z)))
    return float(np.nan_to_num(margin, nan=-np.inf))


def fast_margin(
    formation: Formation,
    epsilon: float,
    curve: tuple[Array, Array, Array],
    rests: tuple[bool, bool] = (True, True),
) -> float:
    """Margin of the best motion along a curve.

    The curve (s, z, z_s) is as of `resample`; `rests` says whether the motion is at rest at its
    start and at its end.
    """
    z_s = curve[2]
    with np.errstate(divide="ignore"):
        joints = ((formation.scene.speed_limit / np.abs(z_s[:, 3:])) ** 2).min(axis=1)
    top = np.minimum(1e6, joints / formation.scene.scales.speed**2)
    top[[0, -1]] *= ~np.array(rests)
    return _solve_along(formation, epsilon, curve, top)


def _solve_along(
    formation: Formation, epsilon: float, curve: tuple[Array, Array, Array], top: Array
) -> float:
    """Largest margin along a curve (s, z, z_s), b being at most `top` at its n places.

    Unknowns: b and v, which stands for sqrt(b), at the places, contact forces c_n and c_t(rolling)
    at both ends of every interval, and the margin. Forces are over the scene's weight, torques over
    their limits, and lengths over the radius of gyration.
    """
    (s, z, z_s), z_ss = curve, np.gradient(curve[2], curve[0], axis=0)
    scene, n_c, rolling = formation.scene, formation.n_contacts, list(formation.rolling_rows)
    length, force, speed = scene.scales.length, scene.scales.force, scene.scales.speed
    n, mass, signs = len(s), scene.mass_diagonal * speed**2, _signs(formation, z, z_s)
    count = formation.n_constraints * (n - 1)
    unknowns = ca.MX.sym("x", 2 * n + 2 * count + 1)
    *parts, margin = ca.vertsplit(unknowns, np.cumsum([0, n, n, count, count, 1]).tolist())
    b, v = (part.T for part in parts[:2])
    a = (b[1:] - b[:-1]) @ ca.diag(length / (2 * np.diff(s)))
    unit = 1 / np.append(force * np.array([1.0, 1.0, length]), scene.torque_limit)
    dry = np.pad(scene.dry[3:] * signs[:, n_c:], ((0, 0), (3, 0)))
    mu = ca.diag(formation.friction[rolling])
    equal, kept = list[Expression](), list[Expression]()
    for at, part in zip((slice(0, n - 1), slice(1, n)), parts[2:], strict=True):
        c, push = ca.reshape(part, -1, n - 1), _push(formation, z[at], signs)
        terms = [(mass * z_s[at] / length, a), (mass * z_ss[at], b[at])]
        terms += [(scene.viscous * z_s[at] * speed, v[at])]
        terms += [(-force * push[:, :, k], c[k, :]) for k in range(formation.n_constraints)]
        # What is left of Newton's and Euler's laws: for the joints, torques.
        law = ((dry - scene.applied_force) * unit).T
        law = law + sum((rates * unit).T @ ca.diag(each) for rates, each in terms)
        press = c[:n_c, :] - epsilon / force
        grip, most = c[n_c:, :], mu @ press[rolling, :]
        equal.append(law[:3, :])
        kept += [press, most - grip, most + grip, 1 - law[3:, :], 1 + law[3:, :]]
    # v is below the tangents of sqrt(b), and above its chord.
    moving = np.flatnonzero(top)
    root, between = np.sqrt(top[moving])[None], v[moving]
    chord = b[moving] / root
    bent = [(x * root + chord / x) / 2 - between for x in np.geomspace(1e-3, 1.0, 13)]
    bent.append(between - chord)
    upper = [*(rows - margin for rows in kept), *bent]
    (A_ub, b_ub), (A_eq, b_eq) = (_split(parts, unknowns) for parts in (upper, equal))
    least = np.repeat([0.0, -np.inf], [2 * n, 2 * count + 1])
    most = [*top, *np.where(top > 0, np.inf, 0.0), *np.full(2 * count, np.inf), 1.0]
    return maximise(-A_ub, b_ub, A_eq, -b_eq, [*zip(least, most, strict=True)])


def _split(parts: Sequence[Expression], unknowns: Expression) -> tuple[Any, Array]:
    """Coefficients of all entries, which are linear in the unknowns, and what is left of them."""
    A, rest = map(ca.evalf, ca.linear_coeff(ca.vertcat(*map(ca.vec, parts)), unknowns))
    return A.sparse(), rest.full()[:, 0]


def uniqueness_ratio(formation: Formation, z: Array, z_s: Array) -> Array:
    """Least ratio of a principal minor to that without friction, on both sides, shape (n,).

    A contact that does not slide sticks, or slips either way. Forces are not unique at 0 and below.
    """
    touches = [locate(formation.scene, name, z) for name in formation.names]
    normals = np.stack([touch.normal for touch in touches], axis=1)
    tangents = np.stack([touch.tangent for touch in touches], axis=1)
    rates = np.abs(slides(formation, z, z_s)[:, : len(touches)]).max(axis=0)
    rates[list(formation.rolling_rows)] = 0.0
    # None: a contact is open; 0, 1, -1: one sticks or slips; NaN: one slides as along the curve.
    options = [(None, 0.0, 1.0, -1.0) if rate < 1e-9 else (None, np.nan) for rate in rates]
    signs, ratios = _signs(formation, z, z_s)[:, : len(touches)], [np.ones(len(z))]
    for side in (np.vstack([signs[:1], signs]), np.vstack([signs, signs[-1:]])):
        for choice in product(*options):
            closed, given = [sense is not None for sense in choice], np.array(choice, dtype=float)
            senses, stuck = np.where(np.isnan(given), side, given), tangents[:, given == 0]
            friction = (formation.friction * senses)[..., None] * tangents
            rows = np.concatenate([normals[:, closed], stuck], axis=1)
            forces = np.concatenate([(normals - friction)[:, closed], stuck], axis=1)
            light = rows / formation.scene.mass_diagonal
            smooth = light @ rows.transpose(0, 2, 1)
            below, minor = np.linalg.det(smooth), np.linalg.det(light @ forces.transpose(0, 2, 1))
            independent = below > 1e-12 * np.einsum("nii->ni", smooth).prod(axis=1)
            ratios.append(np.divide(minor, below, out=np.ones_like(below), where=independent))
    return np.asarray(np.min(ratios, axis=0))


def _signs(formation: Formation, z: Array, z_s: Array) -> Array:
    """Signs of sliding of contacts and joints on each interval, shape (n - 1, n_c + 2)."""
    rates = slides(formation, z, z_s)
    return np.asarray(np.sign(rates[1:] + rates[:-1]))


def _push(formation: Formation, z: Array, signs: Array) -> Array:
    """What the forces c_n and c_t(rolling) push with, shape (n, 5, n_c + R)."""
    rolling = formation.rolling_rows
    touches = [locate(formation.scene, name, z) for name in formation.names]
    pushes = [
        touch.normal - (0.0 if k in rolling else touch.friction) * signs[:, [k]] * touch.tangent
        for k, touch in enumerate(touches)
    ]
    return np.stack([*pushes, *(touches[k].tangent for k in rolling)], axis=2)


def maximise(A_ub: Any, b_ub: Any, A_eq: Any, b_eq: Any, bounds: Bounds) -> float:
    """Largest value of the last unknown; -inf where infeasible, NaN where nothing is known."""
    cost = -np.eye(1, len(bounds), len(bounds) - 1)[0]
    options = {"time_limit": 20.0}
    answer = linprog(cost, A_ub, b_ub, A_eq, b_eq, bounds, method="highs", options=options)
    return float(-answer.fun) if answer.status == 0 else -np.inf if answer.status == 2 else np.nan


PLACES = 60  # places along a curve at which limits are looked at
CLEAR = 1e-3  # margin over the scene's weight, or a torque limit, from which a motion surely exists


class Verdict(NamedTuple):
    """What a second look says about a refusal."""

    # {"confirmed", "refuted", "close", "open"}: no motion exists; one does; it depends on rounding
    # or on the discretisation; or there is no second argument
    kind: str
    reason: str


def judge(problem: Problem, error: WholearmError, stops: list[tuple[float, float]]) -> Verdict:
    """Judge a refusal to plan a problem whose phases stop at the poses `stops` (x, phi).

    Phases after one with two freedoms begin where the least-time plan of the phases before ends. A
    refusal of several is confirmed by that of any, and refuted by a motion of all.
    """
    match = re.search(r"phases?[ \[](\d+)(?: and (\d+)| to (\d+))?", str(error))
    numbers = [int(number) for number in match.groups() if number] if match else [1]
    first, phases = numbers[0], problem.phases[: numbers[-1] if match else None]
    z, index, verdict = problem.start, 0, Verdict("open", "")
    while index < len(phases):
        phase = phases[index]
        concerned, index = phase.number >= first, phase.number
        if phase.formation.n_constraints == 4 and not phase.until.is_release:
            # The shortest curve that reaches the phase's end, or the longer one if none does.
            trace = max(
                follow(phase, z),
                key=lambda trace: (trace.reached, -trace.length if trace.reached else trace.length),
            )
            if trace.length < 0.001 * problem.scene.scales.length:
                return Verdict("close", f"phase {phase.number} has nothing to do")
            if not trace.reached:
                return Verdict("confirmed", f"phase {phase.number}: {trace.ending}")
            verdict = _judge_curve(problem, phase, trace) if concerned else verdict
            if concerned and verdict.kind != "refuted":
                break
            z = trace.end
            continue
        if concerned and phase.index < len(stops):
            return _judge_cell(problem, phase, z, stops[phase.index])
        before = None if concerned else _find_start(problem, first)
        if before is None:
            return Verdict("open", f"phase {phase.number} ends where the planner chooses")
        z, index = before, first - 1
    return verdict


def _find_start(problem: Problem, number: int) -> Array | None:
    """Where the least-time plan of the phases before one ends at rest; None if there is none."""
    before = problem.phases[: number - 1]
    if not before or before[-1].end is not End.REST:
        return None
    try:
        plan = solve(replace(problem, phases=before), replay=False)
    except WholearmError:
        return None
    motion = plan.trajectory.motions[-1]
    return np.asarray(motion.evaluate(np.array([motion.duration])).z[0])


def _judge_curve(problem: Problem, phase: Phase, trace: Trace) -> Verdict:
    formation, epsilon = phase.formation, problem.epsilon
    s, z, z_s = resample(formation, trace, PLACES)
    slow = slow_margin(formation, epsilon, z, z_s)
    free = float(uniqueness_ratio(formation, z, z_s).min())
    at = f"phase {phase.number}"
    if free < UNIQUENESS.default:
        return Verdict("confirmed" if free < 0.0 else "close", f"{at}: uniqueness {free:.3g}")
    if slow > CLEAR:
        return Verdict("refuted", f"{at}: a slow motion keeps all limits by {slow:.3g}")
    rests = (_stops_before(problem, phase), phase.end is End.REST)
    fast = fast_margin(formation, epsilon, (s, z, z_s), rests)
    if fast < -1e-7:
        return Verdict("confirmed", f"{at}: no motion keeps all limits, {fast:.3g} short")
    if np.isnan(fast):
        return Verdict("open", f"{at}: the linear programme has no answer")
    if fast > CLEAR and not problem.scene.viscous.any():
        return Verdict("refuted", f"{at}: a motion keeps all limits by {fast:.3g}")
    return Verdict("close", f"{at}: slow {slow:.3g}, fast {fast:.3g}")


def _stops_before(problem: Problem, phase: Phase) -> bool:
    return phase.index == 0 or problem.phases[phase.index - 1].end is End.REST


def _judge_cell(problem: Problem, phase: Phase, z: Array, stop: tuple[float, float]) -> Verdict:
    at = f"phase {phase.number}"
    if not _stops_before(problem, phase) or phase.end is not End.REST or phase.until.is_release:
        return Verdict("open", f"{at} does not go from rest to rest")
    ends = list_ends(phase, z, stop)
    if not len(ends):
        return Verdict("open", f"{at}: no place of its end was found")
    margin, curve, count = find_best(phase.formation, problem.epsilon, z, ends)
    text = f"{at}: of {count} curves to {len(ends)} places the best has {margin:.3g}"
    if margin > CLEAR:
        unique = uniqueness_ratio(phase.formation, curve, np.gradient(curve, axis=0)).min()
        return Verdict("close" if unique < UNIQUENESS.default else "refuted", text)
    # Where the best of many curves misses limits by so much, surely none keeps them.
    return Verdict("confirmed" if count and margin < -0.02 else "close", text)


def list_ends(phase: Phase, z: Array, stop: tuple[float, float]) -> Array:
    """Places at which a phase with two freedoms ends, those near the pose `stop`, shape (n, 5)."""
    scene, formation = phase.formation.scene, phase.formation
    # A joint may turn far on the way there, so that contacts are followed step by step.
    line = z[[0, 2]] + np.linspace(0.0, 1.0, 4)[:, None] * (np.array(stop) - z[[0, 2]])
    first = project(phase, bend(formation, z, line[None])[0, -1], end=True)
    first = project(phase, z, end=True) if first is None else first
    if first is None:
        return np.zeros((0, 5))
    scale, far = np.sqrt(metric_weights(scene)), 0.08 * scene.scales.length * 1.12 ** np.arange(16)
    tangent = np.linalg.svd(_find_misses(phase, first, end=True)[1] / scale)[2][-1] / scale
    steps = () if phase.until.pins else np.outer((1.0, -1.0), far.cumsum()).ravel()
    others = [project(phase, first + step * tangent, end=True) for step in steps]
    points = np.array([first, *(end for end in others if end is not None)])
    return points[inside(formation, points)]


def find_best(
    formation: Formation, epsilon: float, z: Array, ends: Array
) -> tuple[float, Array, int]:
    """The largest `fast_margin` of curves from `z` to `ends`, the curve, (n, 5), and their number.

    The search stops at a curve with the margin `CLEAR`.
    """
    rng = np.random.default_rng(0)
    start, size = z[[0, 2]], np.array([formation.scene.scales.length, 1.0])
    goals = ends[:, [0, 2]]
    # Control points of cubic curves, shape (n, 4, 2): straight ones, and 400 that bend.
    share = np.linspace(0, 1, 4)[:, None]
    straight = share * (goals - start)[:, None] + start
    drawn = straight[rng.integers(len(goals), size=400)]
    width = 0.5 * rng.uniform(size=(400, 1, 1)) * size
    drawn[:, 1:3] += width * rng.normal(size=(400, 2, 2))
    margins, tried = [-np.inf], [z[None]]
    for controls, most in ((straight, len(straight)), (drawn, 40)):
        curves = bend(formation, z, controls)
        stays = inside(formation, curves.reshape(-1, 5)).reshape(len(curves), -1)
        kept = curves[stays.all(axis=1)][:most]
        margins += [_find_margin(formation, epsilon, curve) for curve in kept]
        tried += [*kept]
        if max(margins) > CLEAR:
            break
    best = int(np.argmax(margins))
    return margins[best], tried[best], len(tried) - 1


def bend(formation: Formation, z: Array, controls: Array) -> Array:
    """Configurations of cubic curves from `z`, forty along each, shape (n, 40, 5)."""
    poses = BPoly(controls.swapaxes(0, 1)[:, None], [0.0, 1.0])(np.linspace(0.0, 1.0, 40))
    curves = [np.tile(z, (len(controls), 1))]
    for pose in poses[1:]:
        # Newton's method for y and the joints, from the place before.
        place = curves[-1].copy()
        place[:, [0, 2]] = pose
        for _ in range(6):
            gaps, rows = constrain(formation, place)
            rows = rows[:, :, [1, 3, 4]]
            flat = np.abs(np.linalg.det(rows)) < 1e-12 * formation.scene.scales.length**2
            rows[flat] = np.eye(3)
            step = -np.linalg.solve(rows, gaps[..., None])[..., 0]
            place[:, [1, 3, 4]] += np.clip(step, -0.5, 0.5)
        curves.append(place)
    return np.stack(curves, axis=1)


def inside(formation: Formation, z: Array) -> Flags:
    """Whether contacts touch within their features at n configurations, and nothing overlaps.

    Up to 1e-4 of the radius of gyration.
    """
    (gaps, _), size = constrain(formation, z), formation.scene.scales.length
    good = np.isfinite(z).all(axis=1) & (np.abs(gaps) < 1e-8 * size).all(axis=1)
    for room in find_room(formation, z).values():
        good &= room > -1e-4 * size
    return np.asarray(good)


def _find_margin(formation: Formation, epsilon: float, z: Array) -> float:
    runs = np.sqrt(np.diff(z, axis=0) ** 2 @ metric_weights(formation.scene))
    if runs.min() < 1e-6 * formation.scene.scales.length:
        return -np.inf
    s = np.append(0.0, np.cumsum(runs))
    margin = fast_margin(formation, epsilon, (s, z, np.gradient(z, s, axis=0, edge_order=2)))
    return float(np.nan_to_num(margin, nan=-np.inf))
