"""Initial guess of a path from geometry alone: ends of phases, points between.

Ends of phases are found by an active-set method on the limits, and globally where palm and both
fingers touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..contacts.closing import close_fingers, find_reach, lower
from ..contacts.contact_limits import build_limits
from ..contacts.formation import Formation
from ..mechanics.dynamics import Directions, Fixed, close_all, close_contacts, metric_weights
from ..problem.definition import Phase
from .curve import tangent_basis
from .tracing import require_touching, runs_on_curve, trace_phase

GRID_SIZE = (120, 60)  # samples of x and phi of a formation
MIN_DISTANCE = 1e-4  # distance from the start that counts as zero, in radii of gyration
N_POINTS = 25  # configurations along a guess
RELEASE_PLACE = 0.8  # fraction of a curve at which a release is guessed


def is_inside(formation: Formation, z: Array) -> bool:
    """Whether a configuration, shape (5,), keeps all limits of a formation."""
    return bool(formation.evaluate_limits(z[None]).min() > -formation.scene.touching)


@dataclass(frozen=True, eq=False)
class Ending:
    """Conditions at the end of a phase."""

    formation: Formation  # contacts that are closed
    fixed: Fixed = ()  # rows of z and their prescribed values
    active: tuple[int, ...] = ()  # limits of the formation that are zero

    def measure(self, z: Array) -> Array:
        """Distance of configurations with closed contacts from the end, (n,) [m]."""
        metric = metric_weights(self.formation.scene)
        distance = np.abs(self.formation.evaluate(z, z).C).max(axis=1)
        for row, value in self.fixed:
            distance = np.maximum(distance, np.abs(z[:, row] - value) * np.sqrt(metric[row]))
        if self.active:
            limits = self.formation.evaluate_limits(z)[:, list(self.active)]
            distance = np.maximum(distance, np.abs(limits).max(axis=1))
        return np.asarray(distance)


def multistart(formation: Formation, z: Array, slip: Array, ends: list[Ending]) -> Array | None:
    """Nearest of several ends of a phase from z, (5,), by a multistart over the formation, or None.

    Only with palm and both fingers touching, where (x, phi) determines the configuration.
    """
    parts = [contact.finger for contact in formation.contacts]
    if len(parts) != 3 or set(parts) != {None, 0, 1} or formation.rolling:
        return None
    metric = metric_weights(formation.scene)
    places = _list_places(formation, z)
    nearest, min_distance = None, np.inf
    for end in ends:
        for k in np.argsort(end.measure(places))[:24]:
            goal = close_contacts(end.formation, places[k], slip, end.fixed, end.active)
            if goal is None or not is_inside(end.formation, goal):
                continue
            distance = float(np.sqrt(metric @ (goal - z) ** 2))
            # Ends at the start do not count.
            if MIN_DISTANCE * formation.scene.scales.length < distance < min_distance:
                nearest, min_distance = goal, distance
    return nearest


def _list_places(formation: Formation, z: Array) -> Array:
    """Grid of configurations of a formation of palm and both fingers, shape (n, 5)."""
    scene = formation.scene
    angles = z[2] + np.linspace(-np.pi, np.pi, 721)
    (lowest,) = (c.index for c in formation.contacts if c.finger is None)
    angles = angles[lower(scene, angles)[1] == lowest]
    x_range = np.linspace(*find_reach(scene), GRID_SIZE[0])
    x, phi = np.meshgrid(x_range, np.linspace(angles.min(), angles.max(), GRID_SIZE[1]))
    closed = close_fingers(scene, x.ravel(), phi.ravel()).z
    closed = np.vstack([z, closed[np.isfinite(closed).all(axis=1)]])
    gaps = np.abs(formation.evaluate(closed, closed).C).max(axis=1)
    inside = formation.evaluate_limits(closed).min(axis=1) > -scene.touching
    return np.asarray(closed[inside & (gaps < scene.touching)])


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
    reversals: tuple[int, ...] = ()

    @property
    def length(self) -> float:
        """Arc length in the metric of curves [m]."""
        steps = np.diff(self.z, axis=0)
        return float(np.sqrt(steps**2 @ metric_weights(self.formation.scene)).sum())


def guess_phase(phase: Phase, z: Array, later: Sequence[Phase] = ()) -> list[PathGuess]:
    """Path guesses of a phase from `z`, (5,), to its end; an `InputError` if there is none.

    A phase before a release goes to the fraction `RELEASE_PLACE` of the path to a later end.
    """
    formation = phase.formation
    require_touching(phase, z)
    freedoms = count_freedoms(formation, z)
    if freedoms == 0:
        key = f"phases[{phase.number}].contacts"
        raise InputError("", key, "the contacts leave no freedom to move")
    if freedoms == 1:
        curve = trace_phase(phase, z, later)
        stop = (RELEASE_PLACE if phase.until.is_release else 1.0) * curve.length
        parts, guesses = [part for part in curve.segments if part.start < stop], []
        signs = [np.append(part.Xi, part.sigma) for part in parts]
        for part, sign, next_sign in zip(parts, signs, [*signs[1:], signs[-1]], strict=True):
            places = curve.evaluate(np.linspace(part.start, min(part.stop, stop), N_POINTS)).z
            reversals = tuple(np.flatnonzero(sign != next_sign).tolist())
            guesses.append(PathGuess(formation, places, Directions(part.Xi, part.sigma), reversals))
        return guesses
    return [connect(formation, z, _find_goal(phase, z, later))]


def count_freedoms(formation: Formation, z: Array) -> int:
    """Freedoms that a formation leaves at `z`: 5 less the rank of P."""
    return int(tangent_basis(formation, z).shape[1])


def _find_goal(phase: Phase, z: Array, later: Sequence[Phase]) -> Array:
    """Nearest configuration at which the phase ends."""
    key = f"phases[{phase.number}].until"
    if phase.until.is_release:
        ends = [after.until for after in later if not after.until.is_release]
        if not ends:
            raise InputError("", key, "is missing; only one freedom needs none")
        # Halfway to the next end of a phase, projected onto this phase's contacts.
        next_end = _find_goal(replace(phase, until=ends[0]), z, later)
        slip = phase.formation.evaluate_slip(z[None])[0]
        middle = close_contacts(phase.formation, (z + next_end) / 2, slip)
        return next_end if middle is None else middle
    slip, endings = phase.formation.evaluate_slip(z[None])[0], list_ends(phase)
    projected = [_project(end, z, slip) for end in endings]
    goals = [goal for goal, _ in projected if goal is not None]
    if not goals and (goal := multistart(phase.formation, z, slip, endings)) is not None:
        goals = [goal]
    if goals:
        metric = metric_weights(phase.formation.scene)
        return min(goals, key=lambda goal: float(metric @ (goal - z) ** 2))
    text = f"{phase.until} cannot be reached with these contacts{projected[0][1]}"
    raise InputError("", key, text)


def list_ends(phase: Phase) -> list[Ending]:
    """Alternative end conditions of a phase; a contact may be gained in more than one way."""
    formation, until = phase.formation, phase.until
    if until.contact is None:
        return [Ending(formation, until.poses)]
    count = sum(len(build_limits(c, formation.scene)) for c in formation.contacts)
    gaining = [k for k, limit in enumerate(formation.limits) if limit.gains(until.contact)]
    # The gap of a renamed contact has zero gradient there; the end of its range has not.
    ends = [Ending(formation, until.poses, (k,)) for k in gaining if k < count]
    if not ends or any(k >= count for k in gaining):
        ends.append(Ending(formation.add(until.contact), until.poses))
    return ends


def _project(end: Ending, z: Array, slip: Array) -> tuple[Array | None, str]:
    """Nearest end by an active-set method with up to two limits, or the blocking limit."""
    formation, active, reason = end.formation, end.active, ""
    for _ in range(3):
        goal = close_contacts(formation, z, slip, end.fixed, active)
        if goal is None or is_inside(formation, goal):
            return goal, reason
        worst = int(formation.evaluate_limits(goal[None])[0].argmin())
        reason = f": {formation.limits[worst].text} first"
        z, active = goal, (*active, worst)
    return None, reason


def connect(formation: Formation, start: Array, goal: Array) -> PathGuess:
    """Straight line projected onto the contacts, with the signs of its mean rates."""
    slip = formation.evaluate_slip(start[None])[0]
    places = start + np.linspace(0.0, 1.0, N_POINTS)[1:, None] * (goal - start)
    z = np.vstack([start, close_all(formation, places, slip)])
    # Points at which contacts do not close repeat the point before.
    last = np.maximum.accumulate(np.where(np.isfinite(z).all(axis=1), np.arange(len(z)), 0))
    z = z[last]
    speed = np.gradient(z, axis=0)
    slip = np.einsum("nij,nj->ni", formation.evaluate(z, speed).A_t, speed)
    signs = np.where(np.hstack([slip, speed[:, 3:]]).sum(axis=0) < 0, -1.0, 1.0)
    return PathGuess(formation, z, Directions(signs[:-2], signs[-2:]))
