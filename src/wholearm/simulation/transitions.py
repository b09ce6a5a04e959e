"""From one phase's formation to the next one's, at rest or with the velocity going on."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from ..common.arrays import Array
from ..common.errors import JammingError, SimulationError
from ..contacts.formation import Formation
from ..contacts.limits import takes_over
from ..mechanics.impact import ViolationKind, compute_impact, solve_impulses
from ..problem.definition import End, Phase
from .choosing import measure_rates
from .closing import close_contacts
from .events import EventKind, Outcome, OutcomeKind
from .jumps import Ending, look_again
from .modes import find_fixed, find_grips, list_units, share_mode
from .replay import Replay
from .starting import Departure
from .stepper import open_limits
from .tolerances import REACHED, STANDING, is_slower, measure_until

_OUTCOMES = {
    ViolationKind.PULL: OutcomeKind.CONTACT_LOST,
    ViolationKind.SLIP: OutcomeKind.SLIPS,
    ViolationKind.CLOSING: OutcomeKind.LIMIT_REACHED,
    ViolationKind.HELD: OutcomeKind.HELD,
}


def enter(run: Replay, phase: Phase, following: Phase | None) -> None:
    """Take the formation of `phase`; what it does not let the motion keep is lost to impact."""
    run.phase = phase
    before = run.stored
    run.y[:5] = _close(run, phase.formation)
    if run.moving:
        run.y[5:10] = project_velocity(phase.formation, run.y[:5], run.y[5:10])
        run.moving = not is_slower(run.problem.scene, run.y[5:10], STANDING)
    if not run.moving:
        run.y[5:10] = 0.0
    run.impact += before - run.stored
    until, run.side = phase.until, 1.0
    if until.value is not None:
        run.side = math.copysign(1.0, run.y[0 if until.coordinate == "x" else 2] - until.value)
    run.stuck = set()
    run.until_unit = measure_until(run.problem.scene, until)
    run.passes = _is_passed(phase)
    run.take()
    run.limits = [limit.text for limit in open_limits(phase.formation, until)]
    run.releasable = find_releasable(phase, following)
    run.resting, run.slipping = find_switching(phase, following)
    run.has_slid = False


def _is_passed(phase: Phase) -> bool:
    """Whether a motion may pass the end of a phase at any speed, without an impact.

    A contact can be gained so where it goes on for another one, and softly elsewhere.
    """
    gained, own = phase.until.contact, phase.formation
    smooth = phase.end is End.SMOOTH
    return smooth and (gained is None or takes_over(gained, own.scene, own.contacts))


def _close(run: Replay, formation: Formation) -> Array:
    """The present configuration with every contact of a formation closed."""
    try:
        return close_contacts(formation, run.y[:5], 10 * REACHED * run.problem.scene.scales.length)
    except SimulationError as error:
        raise SimulationError(f"{error} {run.where()}") from None


def collide(run: Replay, following: Phase) -> Outcome | None:
    """Throw the velocity onto the next formation; what ends the motion if that is not possible."""
    z = _close(run, following.formation)
    impact = compute_impact(run.phase.formation, following.formation, z, run.y[5:10])
    name, least = impact.least
    names = following.formation.names
    normal = impact.p[: len(names)]
    impulses = ", ".join(f"{p:.4g} on {n}" for n, p in zip(names, normal, strict=True))
    run.note(EventKind.IMPACT, f"impact {run.when()}, in N s {impulses}", name, least)
    if impact.violations:
        worst = impact.violations[0]
        text = f"{worst.describe()} in the impact {run.when()}"
        if worst.kind is ViolationKind.JAM:
            raise JammingError(text)
        return Outcome(_OUTCOMES[worst.kind], text)
    before = run.stored
    run.y[5:10] = impact.v
    run.impact += before - run.stored
    return None


def find_releasable(phase: Phase, following: Phase | None) -> tuple[str, ...]:
    """Names of the contacts whose release ends the phase."""
    if phase.end is End.REST or following is None or not phase.until.is_release:
        return ()
    kept = following.formation.names
    return tuple(name for name in phase.formation.names if name not in kept)


def find_switching(phase: Phase, following: Phase | None) -> tuple[frozenset[int], frozenset[int]]:
    """Contacts that come to rest, as they roll in the next phase, and that slip, as they slide.

    A phase without an `until` ends there; if it lets a contact go, then where that happens.
    """
    if phase.end is End.REST or following is None or not phase.until.is_release:
        return frozenset(), frozenset()
    own, coming = ({c.name for c in p.formation.rolling} for p in (phase, following))
    names, kept = phase.formation.names, following.formation.names
    rests = {k for k, name in enumerate(names) if name in coming - own}
    slips = {k for k, name in enumerate(names) if name in own - coming and name in kept}
    return frozenset() if set(names) - set(kept) else frozenset(rests), frozenset(slips)


def project_velocity(formation: Formation, z: Array, v: Array) -> Array:
    """Velocity nearest to `v` in the metric M5 that keeps every constraint, shape (5,)."""
    P = formation.evaluate(z[None], v[None]).P[0]
    return solve_impulses(formation.scene.mass_diagonal, P, P, v)[0]


def set_off(run: Replay, departure: Departure) -> None:
    """Give the stepper the directions of a motion that starts from rest."""
    formation = run.phase.formation
    grips = find_grips(formation, np.concatenate(departure.directions))
    if formation.n_constraints < 4:
        rows = formation.evaluate(run.y[None, :5], run.y[None, 5:10])
        fixed = find_fixed(share_mode(formation, grips), rows.A[0], rows.A_t[0])
        run.stuck = {row for u in list_units(formation) for row in u.rows if u.grips and fixed[row]}
    if grips != run.stepper.mode.grips:
        run.take(grips)
    s = run.stepper
    s.inputs[s.at.Xi], s.inputs[s.at.sigma] = departure.directions
    s.inputs[s.at.heading] = departure.heading
    run.record()


def go_on(run: Replay) -> Ending | None:
    """Give the stepper the directions of the present velocity; what ends the motion at once.

    Friction decides for what does not slide or turn here; with one freedom that takes the first
    direction that does not jam, as it has to go one way just after.
    """
    s = run.stepper
    y, formation = run.y, run.phase.formation
    s.inputs[s.at.y], s.inputs[s.at.t] = y, run.t
    v = y[5:10]
    mass = formation.scene.mass_diagonal
    s.inputs[s.at.heading] = v / np.sqrt(mass @ v**2)
    rates = np.concatenate([formation.evaluate(y[None, :5], v[None]).A_t[0] @ v, v[3:]])
    signs = np.where(rates < 0, -1.0, 1.0)
    for row, name in enumerate(formation.names):
        signs[row] = run.ways.get(name, signs[row])
    run.ways = {}
    signs[[row for row in range(len(signs)) if row not in _list_rows(formation)]] = 0.0
    _point(run, signs)
    if s.is_free:
        return look_again(run, enters=True)
    slow = STANDING * measure_rates(run.problem.scene, formation.n_contacts)
    still = np.flatnonzero((np.abs(rates) < slow) & (signs != 0)).tolist()
    for choice in product((1.0, -1.0), repeat=len(still)):
        tried = signs.copy()
        tried[still] *= choice
        _point(run, tried)
        if s.outputs[s.to.ratio] > 0:
            break
    else:
        _point(run, signs)
    return look_again(run)


def _list_rows(formation: Formation) -> set[int]:
    """Contacts and joints that may slide or turn."""
    return {row for unit in list_units(formation) for row in unit.rows}


def _point(run: Replay, signs: Array) -> None:
    """Look with the given directions of contacts and joints, shape (n_c + 2,)."""
    s = run.stepper
    s.inputs[s.at.Xi], s.inputs[s.at.sigma] = signs[:-2], signs[-2:]
    s.look()
