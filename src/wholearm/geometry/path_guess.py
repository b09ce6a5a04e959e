"""Initial guess of a path from geometry alone, for the time-domain planner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..contacts.contact_limits import build_limits
from ..contacts.formation import Formation
from ..mechanics.dynamics import Directions, metric_weights
from ..problem.definition import Phase
from .curve import Curve, tangent_basis
from .explore import Ending, close_all, close_contacts, explore
from .tracing import require_touching, runs_on_curve, trace_phase

POINTS = 25  # configurations along a guess
RELEASE_AT = 0.8  # share of a curve at which a release is guessed


def find_end(phase: Phase, z: Array, later: Sequence[Phase] = ()) -> Array:
    """Configuration in which a phase from `z` ends, shape (5,); see `guess_phase`."""
    if runs_on_curve(phase):
        return trace_phase(phase, z, later).end
    return np.asarray(guess_phase(phase, z, later)[-1].z[-1])


@dataclass(frozen=True, eq=False)
class PathGuess:
    """Configurations along a part of a phase without reversal."""

    formation: Formation
    z: Array  # (n, 5): with all contacts closed, evenly spread
    directions: Directions
    # rows of (contacts, joints) whose rate is zero at the end of the stretch, where it reverses
    turns: tuple[int, ...] = ()

    @property
    def length(self) -> float:
        """Arc length in the metric of curves [m]."""
        steps = np.diff(self.z, axis=0)
        return float(np.sqrt(steps**2 @ metric_weights(self.formation.scene)).sum())


def guess_curve(curve: Curve, share: float = 1.0) -> list[PathGuess]:
    """Path guesses along a curve, or the first `share` of it, split at its reversals."""
    stop = share * curve.length
    parts = [part for part in curve.segments if part.start < stop]
    guesses = []
    signs = [np.concatenate([part.Xi, part.sigma]) for part in parts]
    for part, here, there in zip(parts, signs, [*signs[1:], signs[-1]], strict=True):
        s = np.linspace(part.start, min(part.stop, stop), POINTS)
        turns, directions = np.flatnonzero(here != there).tolist(), Directions(part.Xi, part.sigma)
        guesses.append(PathGuess(curve.formation, curve.evaluate(s).z, directions, tuple(turns)))
    return guesses


def guess_phase(phase: Phase, z: Array, later: Sequence[Phase] = ()) -> list[PathGuess]:
    """Path guesses of a phase from `z`, (5,), to its end; an `InputError` if there is none.

    A phase that ends by a release heads for the end of `later` ones, at the share `RELEASE_AT`.
    """
    formation = phase.formation
    require_touching(phase, z)
    freedoms = count_freedoms(formation, z)
    if freedoms == 0:
        key = f"phases[{phase.number}].contacts"
        raise InputError("", key, "the contacts leave no freedom to move")
    if freedoms == 1:
        curve = trace_phase(phase, z, later)
        return guess_curve(curve, RELEASE_AT if phase.until.is_release else 1.0)
    goal = _find_goal(phase, z, later)
    return [connect(formation, z, goal)]


def count_freedoms(formation: Formation, z: Array) -> int:
    """Freedoms that a formation leaves at `z`: 5 less the rank of P."""
    return int(tangent_basis(formation, z).shape[1])


def _find_goal(phase: Phase, z: Array, later: Sequence[Phase]) -> Array:
    """Nearest configuration at which the phase ends."""
    key = f"phases[{phase.number}].until"
    if phase.until.is_release:
        ends = [own.until for own in later if not own.until.is_release]
        if not ends:
            raise InputError("", key, "is missing; only one freedom needs none")
        # On the way to where a phase ends next, as far as this one's contacts lead there.
        ahead = _find_goal(replace(phase, until=ends[0]), z, later)
        slip = phase.formation.evaluate_slip(z[None])[0]
        middle = close_contacts(phase.formation, (z + ahead) / 2, slip)
        return ahead if middle is None else middle
    slip, reasons, goals = phase.formation.evaluate_slip(z[None])[0], [], []
    endings = list_ends(phase)
    for end in endings:
        goal, reason = _project(end, z, slip)
        reasons.append(reason)
        goals += [goal] if goal is not None else []
    metric = metric_weights(phase.formation.scene)

    def distance(goal: Array) -> float:
        return float(metric @ (goal - z) ** 2)

    if not goals:
        goal = explore(phase.formation, z, slip, endings)
        goals = [goal] if goal is not None else []
    if goals:
        return min(goals, key=distance)
    text = f"{phase.until} cannot be reached with these contacts{reasons[0]}"
    raise InputError("", key, text)


def list_ends(phase: Phase) -> list[Ending]:
    """What has to hold where a phase ends; a contact may be gained in more than one way."""
    formation, until = phase.formation, phase.until
    if until.contact is None:
        return [Ending(formation, until.poses)]
    own = sum(len(build_limits(c, formation.scene)) for c in formation.contacts)
    gaining = [k for k, limit in enumerate(formation.limits) if limit.gains(until.contact)]
    # Where a contact changes its name its gap has no slope, but the end of its range has.
    ends = [Ending(formation, until.poses, (k,)) for k in gaining if k < own]
    if not ends or any(k >= own for k in gaining):
        ends.append(Ending(formation.add(until.contact), until.poses))
    return ends


def _project(end: Ending, z: Array, slip: Array) -> tuple[Array | None, str]:
    """Nearest end by an active-set method with up to two limits, or what blocks it."""
    formation, active, reason = end.formation, end.active, ""
    goal = close_contacts(formation, z, slip, end.fixed, active)
    while goal is not None:
        limits = formation.evaluate_limits(goal[None])[0]
        if limits.min() > -formation.scene.touching:
            return goal, ""
        worst = int(limits.argmin())
        reason = f": {formation.limits[worst].text} first"
        if worst in active or len(active) == 2 + len(end.active):
            break
        active = (*active, worst)
        goal = close_contacts(formation, goal, slip, end.fixed, active)
    return None, reason


def connect(formation: Formation, start: Array, goal: Array) -> PathGuess:
    """Straight line projected onto the contacts, with the signs of its mean rates."""
    slip = formation.evaluate_slip(start[None])[0]
    places = start + np.linspace(0.0, 1.0, POINTS)[1:, None] * (goal - start)
    z = np.vstack([start, close_all(formation, places, slip)])
    # Where contacts do not close, the path waits.
    last = np.maximum.accumulate(np.where(np.isfinite(z).all(axis=1), np.arange(len(z)), 0))
    z = z[last]
    speed = np.gradient(z, axis=0)
    slip = np.einsum("nij,nj->ni", formation.evaluate(z, speed).A_t, speed)
    rates = np.hstack([slip, speed[:, 3:]]).sum(axis=0)
    signs = np.where(rates < 0, -1.0, 1.0)
    return PathGuess(formation, z, Directions(signs[:-2], signs[-2:]))
