"""Impacts of everything that touches at an instant, and impacts without a collision.

Impulses obey the laws of contact for the velocities after the impact. Restitution is Poisson's: the
impulses of a plastic impact come back e-fold, and friction is found anew. Where that would gain
energy, which the law allows with friction, less comes back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..common.arrays import Array
from ..simulation.events import EventKind
from .contact_problem import APART, BACK, FORTH, STICKS, Answer, ContactProblem, solve, try_modes
from .deciding import Pattern, find_closed
from .state import AHEAD, STANDING, Run

CHATTER_PAUSE = 1e-3
"""Time in which the end of the impacts of a pair is told once, relative to the scene's time."""
ROUNDS = 30
"""Most impacts at one instant; what is left after them is plastic."""


def collide(run: Run) -> bool:
    """Change the velocity where closed gaps still close; whether it did."""
    hit = False
    for turn in range(ROUNDS + 1):
        closed = find_closed(run)
        rows = run.system.evaluate(run.z, run.v, closed)
        rates = rows.A @ run.v
        limit = STANDING * run.system.scales.speed
        if not (rates < -limit).any():
            break
        hit = True
        bouncing = -rates.min() > run.chatter and turn < ROUNDS
        _collide(run, closed, rates, run.restitution if bouncing else 0.0, bouncing)
    return hit


def _collide(
    run: Run, closed: Sequence[int], rates: Array, restitution: float, bouncing: bool
) -> None:
    problem = _pose(run, closed, run.v)
    answer = solve(problem)
    if answer is None:
        raise ArithmeticError("the plastic impact has no solution")
    run.residual = max(run.residual, answer.residual)
    v = run.v + answer.change
    if restitution:
        v = _expand(run, closed, answer, v, restitution)
    for k, pair in enumerate(closed):
        if rates[k] >= -STANDING * run.system.scales.speed or answer.c_n[k] <= 0:
            continue
        name, text = run.system.names[pair], run.system.structure.pairs[pair].text
        if bouncing:
            note = f"{text or name} at {-rates[k]:.4g} m/s"
            run.note(EventKind.IMPACT, note, name, float(-rates[k]))
        elif not _is_told(run, name):
            note = f"the impacts of {name} come ever closer and are over"
            run.note(EventKind.CHATTER, note, name, float(-rates[k]))
    run.take_impulse(v)


def _is_told(run: Run, name: str) -> bool:
    """Whether it has just been said that the impacts of a pair are over."""
    brief = CHATTER_PAUSE * run.system.scales.time
    own = [e for e in run.events if (e.kind, e.contact) == (EventKind.CHATTER, name)]
    return bool(own) and run.t - own[-1].time < brief


def _pose(run: Run, closed: Sequence[int], v: Array) -> ContactProblem:
    """The contact problem of velocities: whatever has friction may stick."""
    system = run.system
    rows = system.evaluate(run.z, v, closed)
    mu = system.friction[list(closed)]
    rubs = np.flatnonzero(mu > 0)
    T = rows.A_t[rubs]
    none = np.zeros(len(rubs))
    return ContactProblem(
        1 / system.mass, rows.A, rows.A, rows.A @ v, T, T @ v, rubs, mu[rubs], none
    )


def _expand(
    run: Run, closed: Sequence[int], plastic: Answer, v: Array, restitution: float
) -> Array:
    """The velocity after the impulses of compression have come back."""
    system = run.system
    before = float(run.v**2 @ system.mass)
    while restitution > 1e-3:
        given = restitution * plastic.c_n
        problem = _pose(run, closed, v)
        pushed = v + problem.lift * (problem.A.T @ given)
        bound = problem.mu * given[problem.owner]
        problem = replace(_pose(run, closed, pushed), bound=bound)
        answer = solve(problem)
        if answer is not None:
            after = pushed + answer.change
            if float(after**2 @ system.mass) <= before * (1 + 1e-12):
                return np.asarray(after)
        restitution /= 2
    return v


def jolt(run: Run) -> bool:
    """An impact without a collision, where no finite forces keep contacts closed; whether it was.

    It is the limit of time stepping: the impulses of a short time that do not vanish with it.
    """
    system, scales = run.system, run.system.scales
    pattern = Pattern(run, find_closed(run))
    later = AHEAD * scales.time
    free = system.push(run.v, run.tau(run.t), pattern.sigma) / system.mass
    answer = solve(_pose(run, pattern.closed, run.v + later * free))
    if answer is None:
        return False
    # With the modes that it ends in, the impact at the instant itself is linear.
    problem = _pose(run, pattern.closed, run.v)
    ways = {0.0: STICKS, 1.0: FORTH, -1.0: BACK}
    choice = [STICKS if c > 0 else APART for c in answer.c_n]
    for own, way in zip(problem.owner, answer.way, strict=True):
        choice[own] = ways[float(way)] if choice[own] != APART else APART
    exact = try_modes(problem, choice)
    units = system.units[system.n :]
    if exact is None or (np.abs(exact.change) < STANDING * units).all():
        return False
    names = " ".join(system.names[pair] for pair in pattern.closed)
    run.note(
        EventKind.INCONSISTENT,
        f"no finite forces keep {names} closed: an impact without a collision",
        names,
    )
    run.take_impulse(run.v + exact.change)
    return True
