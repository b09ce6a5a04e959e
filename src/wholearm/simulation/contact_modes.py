"""Choice of contact modes: the solution of the contact problem that changes the fewest modes.

Modes are evaluated a short time later, at the state that present accelerations lead to. The last
modes are tried first, then Lemke's method.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from .contact_problem import (
    APART,
    BACK,
    FORTH,
    MODES,
    SAME,
    STICKS,
    ContactAnswer,
    ContactProblem,
    is_clear,
    list_answers,
    solve,
    try_modes,
)
from .events import EventKind, describe_change
from .free_run import AHEAD, CLOSED, SUNK, FreeRun
from .stepper import Modes
from .system import ContactRows, System
from .tolerances import STANDING, STILL

CLEAR = 1e-3  # forces and rates, over the largest, that do not vanish within `AHEAD`
DEPENDENT = 1e-7  # share of a row that others leave, below which it is no constraint of its own
_NONE = np.zeros(0)
_NOTHING = (_NONE, np.zeros(0, dtype=np.int64), _NONE, _NONE)


class ClosedContacts(NamedTuple):
    """Pairs that touch and do not part, each constraint once, and their rows at present."""

    pairs: tuple[int, ...]
    rows: ContactRows


def find_closed(run: FreeRun) -> ClosedContacts:
    """Look for what is closed."""
    system, unit = run.system, run.system.scales.length
    gaps, faces = run.face(run.z, run.v)
    touching = ((gaps < CLOSED * unit) & (gaps > -SUNK * unit) & faces).nonzero()[0].tolist()
    rows = system.evaluate(run.z, run.v, touching)
    if not touching:
        return ClosedContacts((), rows)
    slow = (rows.A @ run.v < run.chatter).tolist()
    own = [[True]]
    if len(touching) > 1:
        lines = rows.A / np.sqrt(system.mass)
        lines /= np.sqrt((lines**2).sum(axis=1))[:, None]
        own = (np.abs(lines[:, None] - lines).max(axis=2) > DEPENDENT).tolist()
    chosen: list[int] = []
    for k in sorted(range(len(touching)), key=lambda k: touching[k] not in run.modes.kept):
        if slow[k] and all(own[k][j] for j in chosen):
            chosen.append(k)
    if len(chosen) == len(touching):
        return ClosedContacts(tuple(touching), rows)
    chosen.sort()
    return ClosedContacts(
        tuple(touching[k] for k in chosen), ContactRows(*(part[chosen] for part in rows))
    )


class Pattern:
    """Closed pairs and coordinates at rest, and sliding signs of the others."""

    def __init__(self, run: FreeRun, found: ClosedContacts) -> None:
        system = run.system
        self.system, self.closed, self.rows = system, *found
        v_t = self.rows.A_t @ run.v
        self.mu = system.friction[list(self.closed)]
        rubs = self.mu > 0
        slow = np.abs(v_t) < STANDING * system.scales.speed
        self.Xi = np.where(rubs & ~slow, np.sign(v_t), 0.0)
        self.rub = (self.mu * self.Xi)[:, None]
        self.standing = (rubs & slow).nonzero()[0]
        slow = np.abs(run.v) < STANDING * system.units[system.n :]
        self.sigma = np.where((system.dry > 0) & ~slow, np.sign(run.v), 0.0)
        self.joints = ((system.dry > 0) & slow).nonzero()[0]

    def pose(self, free: Array, rows: ContactRows) -> ContactProblem:
        """Contact problem of rows, from accelerations without contacts, `free` (n,)."""
        system, lift = self.system, 1 / self.system.mass
        G, b_n = rows.A - self.rub * rows.A_t, rows.A @ free + rows.bend
        if not len(self.standing) and not len(self.joints):
            return ContactProblem(lift, rows.A, G, b_n, np.zeros((0, system.n)), *_NOTHING)
        joints = np.eye(system.n)[self.joints]
        return ContactProblem(
            lift,
            rows.A,
            G,
            b_n,
            np.vstack([rows.A_t[self.standing], joints]),
            np.concatenate([rows.A_t[self.standing] @ free + rows.bend_t[self.standing],
                            free[self.joints]]),
            np.concatenate([self.standing, np.full(len(joints), -1)]).astype(int),
            np.concatenate([self.mu[self.standing], np.zeros(len(joints))]),
            np.concatenate([np.zeros(len(self.standing)), system.dry[self.joints]]),
        )  # fmt: skip

    def recall(self, modes: Modes) -> list[int]:
        """Modes as `try_modes` has them."""
        choice = []
        for k, pair in enumerate(self.closed):
            if pair not in modes.kept:
                choice.append(APART)
                continue
            Xi = modes.Xi[modes.kept.index(pair)] if k in self.standing else 0.0
            choice.append(FORTH if Xi > 0 else BACK if Xi < 0 else STICKS)
        for joint in self.joints:
            sigma = modes.sigma[joint]
            choice.append(FORTH if sigma > 0 else BACK if sigma < 0 else STICKS)
        return choice

    def describe(self, answer: ContactAnswer) -> list[int]:
        """Modes of an answer as `try_modes` has them."""
        choice = [STICKS if c > 0 else APART for c in answer.c_n]
        signs = [MODES[sign] for sign in answer.sign.tolist()]
        for k, mode in zip(self.standing, signs, strict=False):
            if choice[k] != APART:
                choice[k] = mode
        return choice + signs[len(self.standing) :]


def decide(run: FreeRun, closed: ClosedContacts | None = None) -> bool | None:
    """Set the contact modes; whether everything rests, None where no modes are consistent."""
    system, lift = run.system, 1 / run.system.mass
    closed = closed or find_closed(run)
    if (np.abs(closed.rows.A @ run.v) > STANDING * system.scales.speed).any():
        # What is closed and parts more slowly than chatter is closed at rest, all at once.
        pairs, rows = closed
        sticks = np.abs(rows.A_t @ run.v) < run.chatter
        sticks &= system.friction[list(pairs)] > 0
        run.project_velocity(np.vstack([rows.A, rows.A_t[sticks]]))
        closed = ClosedContacts(pairs, system.evaluate(run.z, run.v, pairs))
    pattern = Pattern(run, closed)
    later = AHEAD * system.scales.time
    coming = free = lift * system.push(run.v, run.tau(run.t), pattern.sigma)
    problem, rows = pattern.pose(free, pattern.rows), pattern.rows
    answer = first = _answer(run, problem, pattern.recall(run.modes))
    if first is None:
        return None
    acceleration = free + first.change
    run.unique = problem.is_unique
    if not run.unique or not is_clear(problem, first, CLEAR):
        v = run.v + later * acceleration
        rows = system.evaluate(run.z + later * (run.v + v) / 2, v, pattern.closed)
        coming = lift * system.push(v, run.tau(run.t + later), pattern.sigma)
        answer = _choose(run, pattern, pattern.pose(coming, rows), coming)
    if answer is None:
        return None
    # What rests leaves its last modes by rounding, before it takes others in which it rests.
    still = run.resting or _is_still(run, acceleration)
    rests = stands(run) and still and _is_still(run, coming + answer.change)
    modes = _make_modes(run, pattern, answer, rows)
    _note_changes(run, pattern.closed, modes, rests)
    run.modes = modes
    # Rounding of speeds that are zero.
    kept = [k for k, pair in enumerate(pattern.closed) if pair in modes.kept]
    joints = np.eye(system.n)[pattern.joints]
    at_rest = [pattern.rows.A[kept], pattern.rows.A_t[pattern.standing], joints]
    run.project_velocity(np.vstack(at_rest))
    return rests


def stands(run: FreeRun) -> bool:
    """Whether nothing moves."""
    return bool((np.abs(run.v) < STANDING * run.system.units[run.system.n :]).all())


def _is_still(run: FreeRun, acceleration: Array) -> bool:
    system = run.system
    still = STILL * system.units[system.n :] / system.scales.time
    return bool((np.abs(acceleration) < still).all())


def _answer(run: FreeRun, problem: ContactProblem, last: Sequence[int]) -> ContactAnswer | None:
    """An answer: the last one where it still holds."""
    answer = None if problem.is_unique else try_modes(problem, last)
    if answer is None:
        answer = solve(problem, [mode != APART for mode in last[: len(problem.b_n)]])
        if answer is None:
            return next(iter(list_answers(problem) or ()), None)
        run.residual = max(run.residual, answer.residual)
    return answer


def _choose(
    run: FreeRun, pattern: Pattern, problem: ContactProblem, free: Array
) -> ContactAnswer | None:
    """The answer nearest to the last one; what rests stays at rest if possible.

    `free` has the accelerations without contacts, shape (n,).
    """
    last = pattern.recall(run.modes)
    run.unique = problem.is_unique
    answers = [] if run.unique else list_answers(problem) or []
    if len(answers) > 1:
        modes = [pattern.describe(answer) for answer in answers]
        if run.modes.kept or len(problem.b_n):
            _note_ambiguity(run, pattern, modes)
        starts = [run.resting and not _is_still(run, free + a.change) for a in answers]
        away = [sum(a != b for a, b in zip(one, last, strict=True)) for one in modes]
        return answers[min(range(len(answers)), key=lambda k: (starts[k], away[k]))]
    return _answer(run, problem, last)


def _make_modes(run: FreeRun, pattern: Pattern, answer: ContactAnswer, rows: ContactRows) -> Modes:
    """Independent constraints that give the answer's motion."""
    system, closed = run.system, pattern.closed
    still = SAME * max(float(np.abs(answer.r_n).max(initial=0.0)), system.scales.acceleration)
    still *= 1e-3
    presses = answer.c_n > 0
    if run.unique and (presses | (answer.r_n > still)).all():
        # What presses is independent then, and nothing stands.
        own = np.flatnonzero(presses).tolist()
        slides, turns = tuple(pattern.Xi[own].tolist()), tuple(pattern.sigma.tolist())
        return Modes(tuple(closed[k] for k in own), (), (), slides, turns)
    order = sorted(range(len(closed)), key=lambda k: -answer.c_n[k])
    root = np.sqrt(system.mass)
    basis: list[Array] = []

    def adds(row: Array) -> bool:
        """Whether a row is a constraint of its own; it counts from then on."""
        row = row / root
        size, rest = float(np.linalg.norm(row)), row.copy()
        for _ in range(2):
            for other in basis:
                rest = rest - (other @ rest) * other
        left = float(np.linalg.norm(rest))
        if left <= DEPENDENT * size:
            return False
        basis.append(rest / left)
        return True

    kept = {k for k in order if presses[k] and adds(rows.A[k])}
    count = len(pattern.standing)
    stuck, Xi = [], pattern.Xi.copy()
    held, sigma = [], pattern.sigma.copy()
    sigma[pattern.joints] = answer.sign[count:]
    # Of what sticks as one, as the contacts of a flush edge do, what has to hold comes first.
    for j in np.argsort(-answer.shares, kind="stable").tolist():
        sign = answer.sign[j]
        if j >= count:
            joint = int(pattern.joints[j - count])
            if sign == 0 and adds(np.eye(system.n)[joint]):
                held.append(joint)
        elif (k := int(pattern.standing[j])) in kept:
            Xi[k] = sign
            if sign == 0 and adds(rows.A_t[k]):
                stuck.append(k)
    # What touches without a force stays, for as long as it needs none.
    kept |= {k for k in order if not presses[k] and answer.r_n[k] <= still and adds(rows.A[k])}
    kept_pairs = sorted(kept)
    return Modes(
        tuple(closed[k] for k in kept_pairs),
        tuple((pair,) for pair in sorted(closed[k] for k in stuck)),
        tuple(sorted(held)),
        tuple(float(Xi[k]) for k in kept_pairs),
        tuple(sigma.tolist()),
    )


def _name(system: System, joint: int) -> str:
    known = joint in system.driven
    return f"joint {system.driven.index(joint) + 1}" if known else f"coordinate {joint + 1}"


def _note_changes(run: FreeRun, closed: Sequence[int], modes: Modes, rests: bool) -> None:
    """Record what changes."""
    if rests and run.resting:
        # Other forces that hold the same rest are no event.
        return
    system, before = run.system, run.modes
    names = system.names
    gone = [pair for pair in before.kept if pair not in modes.kept]
    new = [pair for pair in modes.kept if pair not in before.kept]
    gaps, ranges = system.look(run.z) if gone else np.zeros((2, 0))
    near = CLOSED * system.scales.length
    for pair in gone:
        # What still touches, at the end of its range, is a neighbour's from there on.
        heirs = [p for p in new if names[p][-1:] == names[pair][-1:]]
        if heirs and abs(gaps[pair]) < near and ranges[pair] < near:
            text = f"{names[pair]} goes on as {names[heirs[0]]}"
            run.note_at(EventKind.PASS, text, names[heirs[0]])
            new.remove(heirs[0])
        elif pair not in closed or run.records:
            run.note_at(EventKind.CONTACT_LOST, f"{names[pair]} is lost", names[pair])
    for pair in new if run.records else ():
        run.note_at(EventKind.GAINED, f"{names[pair]} presses", names[pair])
    if not run.records:
        before = modes
    changes = [
        (names[pair], before.Xi[before.kept.index(pair)], Xi, "slides")
        for pair, Xi in zip(modes.kept, modes.Xi, strict=True)
        if pair in before.kept and system.friction[pair] > 0
    ]
    joints = zip(before.sigma, modes.sigma, strict=True)
    changes += [(_name(system, k), old, new, "turns") for k, (old, new) in enumerate(joints)]
    for name, old, now, verb in changes:
        if old != now:
            run.note_at(*describe_change(name, old, now, verb), name)
    if rests:
        run.note_at(EventKind.REST, "everything rests")
    elif run.resting:
        run.note_at(EventKind.START, "the motion begins")


def _note_ambiguity(run: FreeRun, pattern: Pattern, answers: Sequence[Sequence[int]]) -> None:
    """Record that there are several answers, once for each set of contacts."""
    names = [run.system.names[pair] for pair in pattern.closed]
    words = {APART: "parts", STICKS: "presses", FORTH: "slides +", BACK: "slides -"}
    standing = set(pattern.standing.tolist())
    texts = []
    for answer in answers:
        parts = [
            f"{name} {'sticks' if mode == STICKS and k in standing else words[mode]}"
            for k, (name, mode) in enumerate(zip(names, answer, strict=False))
            if any(other[k] != mode for other in answers)
        ]
        parts += [
            f"{_name(run.system, int(joint))} "
            f"{ {STICKS: 'is held', FORTH: 'turns +', BACK: 'turns -'}[mode] }"
            for joint, mode in zip(pattern.joints, answer[len(names) :], strict=True)
        ]
        texts.append(", ".join(parts) or "the rest accelerates otherwise")
    text = f"{len(answers)} motions are possible with {', '.join(names) or 'no contact'} closed ("
    text += "; or ".join(texts) + ")"
    last = [event for event in run.events if event.kind is EventKind.AMBIGUOUS]
    if not last or last[-1].text.split(" at t =")[0] != text:
        run.note_at(EventKind.AMBIGUOUS, text, " ".join(names))
