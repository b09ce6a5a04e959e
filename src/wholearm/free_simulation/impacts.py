"""Impacts of everything that touches at an instant, and impacts without a collision.

Impulses obey the laws of contact for the velocities after the impact. Restitution is Poisson's: the
impulses of a plastic impact come back e-fold, and friction is found anew. Where that would gain
energy, which the law allows with friction, less comes back.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..common.arrays import Array
from ..simulation.events import EventKind
from .contact_problem import (
    APART,
    BACK,
    FORTH,
    STICKS,
    Answer,
    ContactProblem,
    read,
    solve,
    try_modes,
)
from .deciding import Closed, Pattern, find_closed
from .state import AHEAD, STANDING, Run

CHATTER_PAUSE = 1e-3
"""Time in which the end of the impacts of a pair is told once, relative to the scene's time."""
SLIDES = 1e-3
"""Least sliding of what slides on, relative to that before and to the speed of the impact."""
ROUNDS = 30
"""Most impacts at one instant; what is left after them is plastic."""


def collide(run: Run) -> Closed:
    """Change the velocity where closed gaps still close; what is closed after that."""
    limit = STANDING * run.system.scales.speed
    for turn in range(ROUNDS + 1):
        found = find_closed(run)
        rates = found.rows.A @ run.v
        if not (rates < -limit).any():
            return found
        bouncing = -rates.min() > run.chatter and turn < ROUNDS
        _collide(run, found, rates, run.restitution if bouncing else 0.0, bouncing)
    return find_closed(run)


def _collide(run: Run, found: Closed, rates: Array, restitution: float, bouncing: bool) -> None:
    problem = _pose(run, found, run.v)
    answer = _slide_on(problem) or solve(problem)
    if answer is None:
        raise ArithmeticError("the plastic impact has no solution")
    run.residual = max(run.residual, answer.residual)
    v = run.v + answer.change
    if restitution:
        v = _expand(run, found, answer, v, restitution)
    for k, pair in enumerate(found.pairs):
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


def _slide_on(p: ContactProblem) -> Answer | None:
    """The impact after which everything slides on as before, if there is one.

    Of several it is the nearest to what was; and without what may stick the problem is small.
    """
    k, none = len(p.b_n), np.zeros(0)
    ways, pushes = np.sign(p.b_t), p.A.copy()
    pushes[p.owner] -= (p.mu * ways)[:, None] * p.T
    slides = ContactProblem(p.lift, p.A, pushes, p.b_n, p.T[:0], none, p.owner[:0], none, none)
    answer = solve(slides) if k and slides.is_unique and ways.all() else None
    if answer is None:
        return None
    rates = p.b_t + p.T @ answer.change
    least = SLIDES * np.maximum(np.abs(p.b_t), np.abs(p.b_n).max())
    if ((rates * ways <= least) & (answer.c_n[p.owner] > 0)).any():
        return None
    return read(p, answer.c_n, -p.mu * ways * answer.c_n[p.owner], answer.residual)


def _is_told(run: Run, name: str) -> bool:
    """Whether it has just been said that the impacts of a pair are over."""
    brief = CHATTER_PAUSE * run.system.scales.time
    own = [e for e in run.events if (e.kind, e.contact) == (EventKind.CHATTER, name)]
    return bool(own) and run.t - own[-1].time < brief


def _pose(run: Run, found: Closed, v: Array) -> ContactProblem:
    """The contact problem of velocities: whatever has friction may stick."""
    system, rows = run.system, found.rows
    mu = system.friction[list(found.pairs)]
    rubs = np.flatnonzero(mu > 0)
    T = rows.A_t[rubs]
    none = np.zeros(len(rubs))
    return ContactProblem(
        1 / system.mass, rows.A, rows.A, rows.A @ v, T, T @ v, rubs, mu[rubs], none
    )


def _expand(run: Run, found: Closed, plastic: Answer, v: Array, restitution: float) -> Array:
    """The velocity after the impulses of compression have come back."""
    system = run.system
    before = float(run.v**2 @ system.mass)
    while restitution > 1e-3:
        given = restitution * plastic.c_n
        problem = _pose(run, found, v)
        pushed = v + problem.lift * (problem.A.T @ given)
        bound = problem.mu * given[problem.owner]
        problem = replace(_pose(run, found, pushed), bound=bound)
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
    found = find_closed(run)
    pattern = Pattern(run, found)
    later = AHEAD * scales.time
    free = system.push(run.v, run.tau(run.t), pattern.sigma) / system.mass
    answer = solve(_pose(run, found, run.v + later * free))
    if answer is None:
        return False
    # With the modes that it ends in, the impact at the instant itself is linear.
    problem = _pose(run, found, run.v)
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
