"""Second opinions on refusals, by arguments that share nothing with the planner.

A motion with two freedoms from rest to the end of its phase follows some curve x(u), phi(u), and
whether any motion along a given curve keeps all limits is a linear programme, whatever its speeds
and forces (`slow_motion.fast_margin`). Cubic curves to many places of the end are drawn at random,
and those with the largest margins are bent further as long as these grow: a search for a plan that
shares neither transcription nor guesses with the planner.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...common.errors import InputError, WholearmError
from ...planning.plan import solve
from ...problem.definition import End, Phase, Problem
from ...scene.model import Scene
from ...verification.newton_euler import locate
from .event_tracing import Trace, clearances, constrain, follow, project, resample, weights
from .slow_motion import fast_margin, inertia_ratio, rest_margin, slow_margin

PLACES = 60  # places along a curve at which limits are looked at
CLEAR = 1e-3  # margin over the scene's weight, or a torque limit, from which a motion surely exists
Flags = NDArray[np.bool_]


class Verdict(NamedTuple):
    """What a second look says about a refusal."""

    # {"confirmed", "refuted", "close", "open"}: no motion exists; one does; it depends on rounding
    # or on the discretisation; or there is no second argument
    kind: str
    reason: str


def judge(problem: Problem, error: WholearmError, stops: list[tuple[float, float]]) -> Verdict:
    """Judge a refusal to plan a problem whose phases stop at the poses `stops` (x, phi).

    Phases after one with two freedoms begin where the least-time plan of the phases before ends.
    """
    match = re.search(r"phases? (\d+)|phases\[(\d+)\]", str(error))
    number = int(match[1] or match[2]) if match else None
    z = problem.start
    open_end = Verdict("open", "")
    planned = False
    for phase in problem.phases:
        concerned = number in (None, phase.number)
        if planned and not concerned:
            continue
        if phase.formation.n_constraints == 4 and not phase.until.is_release:
            # The shortest curve that reaches the phase's end, or the longer one if none does.
            trace = max(
                follow(problem.scene, phase, z),
                key=lambda own: (own.reached, -own.length if own.reached else own.length),
            )
            if trace.length < 0.001 * problem.scene.scales.length:
                return Verdict("close", f"phase {phase.number} has nothing to do")
            if not trace.reached:
                return Verdict("confirmed", f"phase {phase.number}: {trace.ending}")
            if concerned:
                verdict = _judge_curve(problem, phase, trace)
                if verdict.kind != "refuted" or number is not None:
                    return verdict
                open_end = verdict
            z = trace.end
            continue
        if concerned and phase.index < len(stops):
            return _judge_cell(problem, phase, z, stops[phase.index])
        before = None if concerned or number is None else _find_start(problem, number)
        if before is None:
            return Verdict("open", f"phase {phase.number} ends where the planner chooses")
        z, planned = before, True
    if isinstance(error, InputError) and not open_end.reason:
        return Verdict("refuted", "every phase reaches its until")
    return open_end


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
    scene, epsilon = problem.scene, problem.epsilon
    s, z, z_s = resample(scene, phase, trace, PLACES)
    slow = slow_margin(scene, phase, epsilon, z, z_s)
    free = float(inertia_ratio(scene, phase, z, z_s).min())
    at = f"phase {phase.number}"
    # Of the reduced inertia without friction.
    if free < 0.02:
        return Verdict("confirmed" if free < 0.0 else "close", f"{at}: inertia ratio {free:.3g}")
    if slow > CLEAR:
        return Verdict("refuted", f"{at}: a slow motion keeps all limits by {slow:.3g}")
    rests = (_stops_before(problem, phase), phase.end is End.REST)
    fast = fast_margin(scene, phase, epsilon, (s, z, z_s), rests)
    if fast < -1e-7:
        return Verdict("confirmed", f"{at}: no motion keeps all limits, {fast:.3g} short")
    if np.isnan(fast):
        return Verdict("open", f"{at}: the linear programme has no answer")
    if fast > CLEAR and not scene.viscous.any():
        return Verdict("refuted", f"{at}: a motion keeps all limits by {fast:.3g}")
    return Verdict("close", f"{at}: slow {slow:.3g}, fast {fast:.3g}")


def _stops_before(problem: Problem, phase: Phase) -> bool:
    return phase.index == 0 or problem.phases[phase.index - 1].end is End.REST


def _judge_cell(problem: Problem, phase: Phase, z: Array, stop: tuple[float, float]) -> Verdict:
    scene, epsilon, at = problem.scene, problem.epsilon, f"phase {phase.number}"
    if not _stops_before(problem, phase) or phase.end is not End.REST or phase.until.is_release:
        return Verdict("open", f"{at} does not go from rest to rest")
    begins = rest_margin(scene, phase, epsilon, z)
    if begins < -CLEAR:
        return Verdict("confirmed", f"{at}: no motion from rest at the start, {begins:.3g}")
    ends = list_ends(scene, phase, z, stop)
    if not len(ends):
        return Verdict("open", f"{at}: no place of its end was found")
    stopped = [-np.inf]
    for end in ends:
        stopped.append(rest_margin(scene, phase, epsilon, end, ends=True))
        if stopped[-1] > 0:
            break
    if max(stopped) < -CLEAR:
        reason = f"{at}: no motion comes to rest at any of {len(ends)} places, {max(stopped):.3g}"
        return Verdict("confirmed", reason)
    best = find_best(scene, phase, epsilon, z, ends)
    text = f"{at}: of {best.curves} curves to {best.ends} places the best has {best.margin:.3g}"
    if best.margin > CLEAR:
        return Verdict("refuted", text)
    text += f", {best.loose:.3g} if slow contacts may stick"
    least = max(best.margin, best.loose)
    # Where the best of many curves misses limits by so much, surely none keeps them.
    return Verdict("confirmed" if best.curves and least < -0.02 else "close", text)


class Best(NamedTuple):
    """The best of many curves."""

    margin: float  # as of `fast_margin`, without and with friction of slow contacts in their cones
    loose: float
    z: Array  # (n, 5): the curve that has the margin `margin`
    curves: int  # curves that were looked at
    ends: int  # places of the end that were looked at


def list_ends(scene: Scene, phase: Phase, z: Array, stop: tuple[float, float]) -> Array:
    """Places at which a phase with two freedoms ends, those near the pose `stop`, shape (n, 5)."""

    def project_end(z: Array) -> Array | None:
        return project(scene, z, lambda z: _end_equations(scene, phase, z))

    # A joint may turn far on the way there, so that contacts are followed step by step.
    line = z[[0, 2]] + np.linspace(0.0, 1.0, 4)[:, None] * (np.array(stop) - z[[0, 2]])
    first = project_end(bend(scene, phase, z, line[None])[0, -1])
    first = project_end(z) if first is None else first
    if first is None:
        return np.zeros((0, 5))
    scale = np.sqrt(weights(scene))
    found = [first]
    for way in (1.0, -1.0):
        here, ahead = first, None
        for step in 0.08 * scene.scales.length * 1.12 ** np.arange(16):
            rows = _end_equations(scene, phase, here)[1] / scale
            tangent = np.linalg.svd(rows)[2][-1] / scale
            if ahead is None:
                tangent = way * tangent
            elif (tangent * scale) @ (ahead * scale) < 0:
                tangent = -tangent
            after = project_end(here + step * tangent)
            if after is None or np.linalg.norm((after - here) * scale) > 3 * step:
                break
            here, ahead = after, tangent
            found.append(here)
    points = np.array(found)
    return points[inside(scene, phase, points)]


def find_best(scene: Scene, phase: Phase, epsilon: float, z: Array, ends: Array) -> Best:
    """Look for the curve from `z` to one of `ends` along which a motion keeps limits best.

    The search stops at a curve with the margin `CLEAR`.
    """
    rng = np.random.default_rng(0)
    start, size = z[[0, 2]], np.array([scene.scales.length, 1.0])
    goals = ends[:, [0, 2]]

    def draw(count: int, spread: float) -> Array:
        """Control points of cubic curves, shape (count, 4, 2), the first of them straight."""
        last = goals[rng.integers(len(goals), size=count)]
        points = start + np.linspace(0, 1, 4)[:, None] * (last - start)[:, None]
        width = spread * rng.uniform(size=(count, 1, 1)) * size
        points[:, 1:3] += width * rng.normal(size=(count, 2, 2))
        return points

    best: list[tuple[float, float, Array, Array]] = []
    count = 0

    def look(controls: Array, most: int) -> bool:
        nonlocal count, best
        curves = bend(scene, phase, z, controls)
        stays = inside(scene, phase, curves.reshape(-1, 5)).reshape(len(curves), -1)
        kept = np.flatnonzero(stays.all(axis=1))[:most]
        for k in kept:
            margins = _find_margins(scene, phase, epsilon, curves[k])
            best.append((*margins, controls[k], curves[k]))
        count += len(kept)
        best = sorted(best, key=lambda one: -max(one[0], one[1]))[:3]
        return any(one[0] > CLEAR for one in best)

    straight = np.linspace(0, 1, 4)[:, None] * (goals - start)[:, None] + start
    if not look(straight, len(straight)) and not look(draw(400, 0.5), 40):
        # The best curves are bent in six rounds, ten of them in each.
        for turn in range(6):
            if not best:
                break
            spread = 0.3 * 0.7**turn
            parents = np.array([best[k % len(best)][2] for k in range(40)])
            moves = spread * size * rng.normal(size=(len(parents), 3, 2))
            children = parents.copy()
            children[:, 1:3] += moves[:, :2]
            nearest = goals - (parents[:, 3] + moves[:, 2])[:, None]
            children[:, 3] = goals[(np.abs(nearest) / size).sum(axis=2).argmin(axis=1)]
            if look(children, 10):
                break
    if not best:
        return Best(-np.inf, -np.inf, z[None], 0, len(ends))
    best.sort(key=lambda one: -one[0])
    return Best(best[0][0], max(one[1] for one in best), best[0][3], count, len(ends))


def bend(scene: Scene, phase: Phase, z: Array, controls: Array) -> Array:
    """Configurations of cubic curves from `z`, forty along each, shape (n, 40, 5)."""
    u = np.linspace(0.0, 1.0, 40)[:, None]
    shares = np.hstack([(1 - u) ** 3, 3 * u * (1 - u) ** 2, 3 * u**2 * (1 - u), u**3])
    poses = np.einsum("uk,nkd->nud", shares, controls)
    curves = np.repeat(z[None], len(controls), axis=0)[:, None].repeat(len(u), axis=1)
    for k in range(1, len(u)):
        guess = curves[:, k - 1].copy()
        guess[:, [0, 2]] = poses[:, k]
        curves[:, k] = place(scene, phase, guess, curves[:, k - 1])
    return curves


def place(scene: Scene, phase: Phase, z: Array, before: Array) -> Array:
    """Configurations with the x and phi of `z` that keep the contacts, coming from `before`."""
    z = z.copy()
    z[:, [1, 3, 4]] = before[:, [1, 3, 4]]
    for _ in range(6):
        gaps, rows = constrain(scene, phase, z)
        rows = rows[:, :, [1, 3, 4]]
        flat = np.abs(np.linalg.det(rows)) < 1e-12 * scene.scales.length**2
        rows[flat] = np.eye(3)
        step = -np.linalg.solve(rows, gaps[..., None])[..., 0]
        z[:, [1, 3, 4]] += np.clip(step, -0.5, 0.5)
    return z


def inside(scene: Scene, phase: Phase, z: Array) -> Flags:
    """Whether contacts touch within their features at n configurations, and nothing overlaps.

    Up to 1e-4 of the radius of gyration.
    """
    least = 1e-4 * scene.scales.length
    good = np.isfinite(z).all(axis=1)
    for name in phase.formation.names:
        touch = locate(scene, name, z)
        good &= (np.abs(touch.gap) < 1e-8 * scene.scales.length) & (touch.low > -least)
        good &= touch.high > -least
    for gap in clearances(scene, z).values():
        good &= gap > -least
    return np.asarray(good)


def _find_margins(scene: Scene, phase: Phase, epsilon: float, z: Array) -> tuple[float, float]:
    runs = np.sqrt(np.diff(z, axis=0) ** 2 @ weights(scene))
    if runs.min() < 1e-6 * scene.scales.length:
        return -np.inf, -np.inf
    s = np.append(0.0, np.cumsum(runs))
    curve = s, z, np.gradient(z, s, axis=0, edge_order=2)
    plain = fast_margin(scene, phase, epsilon, curve)
    # What slides slowly may stick: nearby curves roll.
    loose = plain if plain > 0 else fast_margin(scene, phase, epsilon, curve, loose=0.01)
    return np.nan_to_num(plain, nan=-np.inf), np.nan_to_num(loose, nan=-np.inf)


def _end_equations(scene: Scene, phase: Phase, z: Array) -> tuple[Array, Array]:
    """What is missing to contacts and end at one configuration, and its rows."""
    (gaps,), (rows,) = constrain(scene, phase, z[None])
    until = phase.until
    if until.contact is not None:
        touch = locate(scene, until.contact.name, z[None])
        return np.append(gaps, touch.gap[0]), np.vstack([rows, touch.normal[0]])
    k = 2 if until.coordinate == "phi" else 0
    value = z[k] if until.value is None else until.value
    return np.append(gaps, z[k] - value), np.vstack([rows, np.eye(5)[k]])
