"""Whether a refusal is right, by arguments that share nothing with the planner."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from ..errors import InputError, WholearmError
from ..model import Array, Scene
from ..problem import End, Phase, Problem
from .lpmotion import fast_margin, inertia_ratio, rest_margin, slow_margin
from .newton import locate
from .overlap import clearances
from .tracing import OVERLAP, Trace, close, follow, spread, weights

PLACES = 60
"""Places along a curve at which limits are looked at."""
CLEAR = 1e-3
"""Margin over the scene's weight, or a torque limit, from which a motion surely exists."""
UNABLE = -1e-7
"""Margin below which none exists."""
FREE = 0.02
"""Reduced inertia over that without friction above which nothing jams."""

HELD = 1e-3
"""Length of a phase over the radius of gyration below which it may count as nothing to do."""


class Verdict(NamedTuple):
    """What a second look says about a refusal.

    Attributes
    ----------
    kind : {"confirmed", "refuted", "close", "open"}
        No motion exists; one does; it depends on rounding or on the discretisation; or there is no
        second argument.
    reason : str
    """

    kind: str
    reason: str


def judge(problem: Problem, error: WholearmError, stops: list[tuple[float, float]]) -> Verdict:
    """Judge a refusal to plan a problem whose phases stop at the poses `stops` (x, phi)."""
    number = _find_phase(str(error))
    z = problem.start
    open_end = Verdict("open", "")
    for phase in problem.phases:
        stop = stops[phase.index] if phase.index < len(stops) else None
        own = number in (None, phase.number)
        if phase.formation.n_constraints == 4 and not phase.until.is_release:
            trace = _reach(problem.scene, phase, z)
            if (
                len(trace.z) < 3
                and _length(problem.scene, trace) < HELD * problem.scene.scales.length
            ):
                return Verdict("close", f"phase {phase.number} has nothing to do")
            if not trace.reached:
                return Verdict("confirmed", f"phase {phase.number}: {trace.ending}")
            if own:
                verdict = _judge_curve(problem, phase, trace)
                if verdict.kind != "refuted" or number is not None:
                    return verdict
                open_end = verdict
            z = trace.z[-1]
            continue
        if stop is None:
            return Verdict("open", f"phase {phase.number} ends where the planner chooses")
        path = _straight(problem.scene, phase, z, stop)
        if own:
            return _judge_cell(problem, phase, z, path)
        if path is None:
            return Verdict("open", f"phase {phase.number} is not a straight leg")
        z = path[-1]
    if isinstance(error, InputError) and not open_end.reason:
        return Verdict("refuted", "every phase reaches its until")
    return open_end


def _length(scene: Scene, trace: Trace) -> float:
    steps = np.diff(trace.z, axis=0)
    return float(np.sqrt(steps**2 @ weights(scene)).sum())


def _find_phase(text: str) -> int | None:
    match = re.search(r"phases? (\d+)|phases\[(\d+)\]", text)
    return int(match[1] or match[2]) if match else None


def _reach(scene: Scene, phase: Phase, z: Array) -> Trace:
    """The way that reaches the phase's end, or the longer one if none does."""
    ways = follow(scene, phase, z)
    reached = [way for way in ways if way.reached]
    return min(reached or ways, key=lambda way: len(way.z) if way.reached else -len(way.z))


def _judge_curve(problem: Problem, phase: Phase, trace: Trace) -> Verdict:
    scene, epsilon = problem.scene, problem.epsilon
    s, z, z_s = spread(scene, phase, trace, PLACES)
    slow, place = slow_margin(scene, phase, epsilon, z, z_s)
    free = float(inertia_ratio(scene, phase, z, z_s).min())
    at = f"phase {phase.number}, place {place} of {len(z)}"
    if free < FREE:
        return Verdict("confirmed" if free < 0.0 else "close", f"{at}: inertia ratio {free:.3g}")
    if slow > CLEAR:
        return Verdict("refuted", f"{at}: a slow motion keeps all limits by {slow:.3g}")
    rests = (_stops_before(problem, phase), phase.end is End.REST)
    fast = fast_margin(scene, phase, epsilon, (s, z, z_s), rests)
    if fast < UNABLE:
        return Verdict("confirmed", f"{at}: no motion keeps all limits, {fast:.3g} short")
    if np.isnan(fast):
        return Verdict("open", f"{at}: the linear programme has no answer")
    if fast > CLEAR and not scene.viscous.any():
        return Verdict("refuted", f"{at}: a motion keeps all limits by {fast:.3g}")
    return Verdict("close", f"{at}: slow {slow:.3g}, fast {fast:.3g}")


def _stops_before(problem: Problem, phase: Phase) -> bool:
    return phase.index == 0 or problem.phases[phase.index - 1].end is End.REST


def _straight(scene: Scene, phase: Phase, z: Array, stop: tuple[float, float]) -> Array | None:
    """Configurations on the straight leg of (x, phi) from `z`, shape (n, 5); None if it breaks."""
    points = [z]
    scale = np.sqrt(weights(scene))
    for share in np.linspace(0.0, 1.0, PLACES)[1:]:
        goal = points[0][[0, 2]] + share * (np.array(stop) - points[0][[0, 2]])
        guess = points[-1].copy()
        for _ in range(8):
            guess[[0, 2]] = goal
            closer = close(scene, phase, guess, points[-1])
            if closer is None:
                return None
            change = np.abs((closer - guess) * scale).max()
            guess = closer
            if change < 1e-12 * scene.scales.length:
                break
        for name in phase.formation.names:
            touch = locate(scene, name, guess[None])
            if min(touch.low[0], touch.high[0]) < -OVERLAP * scene.scales.length:
                return None
        apart = clearances(scene, guess[None])
        if min(gap[0] for gap in apart.values()) < -OVERLAP * scene.scales.length:
            return None
        points.append(guess)
    return np.array(points)


def _judge_cell(problem: Problem, phase: Phase, z: Array, path: Array | None) -> Verdict:
    scene, epsilon = problem.scene, problem.epsilon
    at = f"phase {phase.number}"
    if path is not None:
        steps = np.gradient(path, axis=0)
        z_s = steps / np.sqrt(steps**2 @ weights(scene))[:, None]
        slow, _ = slow_margin(scene, phase, epsilon, path, z_s)
        free = float(inertia_ratio(scene, phase, path, z_s).min())
        if slow > CLEAR and free > FREE:
            return Verdict("refuted", f"{at}: a slow motion straight on keeps limits by {slow:.3g}")
        for end, name in ((path[0], "start"), (path[-1], "end")):
            rest = rest_margin(scene, phase, epsilon, end)
            if rest < UNABLE:
                return Verdict("confirmed", f"{at}: no motion to or from rest at the {name}")
        return Verdict("open", f"{at}: straight on, {slow:.3g}")
    rest = rest_margin(scene, phase, epsilon, z)
    if rest < UNABLE:
        return Verdict("confirmed", f"{at}: no motion from rest at the start, {rest:.3g}")
    return Verdict("open", f"{at}: not a straight leg")
