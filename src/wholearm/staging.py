"""Which stages a motion has: from outlines, and revised where friction would rather turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from .collocation import Scheme
from .dynamics import Directions
from .formation import Formation
from .model import Array
from .outline import Outline, outline_phase
from .problem import End, Phase, Problem
from .stage import Stage, StagePoints
from .timenlp import SLIDING

_STALLED = 1e-6
"""Rate over the largest one at which a direction of friction counts as held back."""
_LEAST_INTERVALS = 3


def outline_stages(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    scheme: Scheme,
    intervals: int,
    pace: float,
) -> list[Stage]:
    """Stages of phases that are joined smoothly, with a first guess.

    The guessed duration is `pace` times that of a fall over the length of the outlines.
    """
    parts: list[tuple[Phase, Outline, bool]] = []
    for phase in phases:
        outlines = outline_phase(problem, phase, z)
        if parts:
            outlines = [*_turn_first(outlines[0], parts[-1][1]), *outlines[1:]]
        parts += [(phase, outline, outline is outlines[-1]) for outline in outlines]
        z = outlines[-1].z[-1]
    lengths = np.array([outline.length for _, outline, _ in parts])
    gravity = problem.scene.gravity or 9.81
    total = pace * float(np.sqrt(lengths.sum() / gravity))
    ends = np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    # The guess runs as (1 - cos) over all stages, so each has its own share of the time.
    clock = np.arccos(1 - 2 * np.clip(ends, 0.0, 1.0)) / np.pi
    longest = {phase.index: lengths[[p is phase for p, _, _ in parts]].sum() for phase in phases}
    stages: list[Stage] = []
    for k, (phase, outline, last) in enumerate(parts):
        share = lengths[k] / longest[phase.index]
        count = max(_LEAST_INTERVALS, round(share * intervals))
        inner = (np.arange(count)[:, None] + scheme.points).ravel() / count
        times = clock[k] + np.append(0.0, inner) * (clock[k + 1] - clock[k])
        place = ((1 - np.cos(np.pi * times)) / 2 - ends[k]) / max(ends[k + 1] - ends[k], 1e-12)
        knots = np.linspace(0.0, 1.0, len(outline.z))
        guess = np.column_stack([np.interp(place, knots, column) for column in outline.z.T])
        stages.append(
            Stage(
                phase.index,
                phase.formation,
                outline.directions,
                guess,
                total * float(clock[k + 1] - clock[k]),
                until=phase.until if last and not phase.until.is_release else None,
                turns=outline.turns,
                gained=_gains(problem, phase) if last else None,
                watched=_choose_watched(phase, outline),
                follows=k > 0 and parts[k - 1][0] is not phase,
            )
        )
    return stages


def _turn_first(outline: Outline, before: Outline) -> list[Outline]:
    """Split an outline so that it starts with the directions of the one that it goes on from.

    Velocities are continuous, so what slides the other way in the outline has to turn on the way.
    """
    names = before.formation.names
    known = dict(zip(names, before.directions.Xi, strict=True))
    own = np.concatenate(outline.directions)
    n_c = outline.formation.n_contacts
    signs = own.copy()
    signs[n_c:] = before.directions.sigma
    for k, name in enumerate(outline.formation.names):
        signs[k] = known.get(name, signs[k])
    turns = np.flatnonzero(signs != own).tolist()
    pieces = []
    cuts = np.linspace(0, len(outline.z) - 1, len(turns) + 2).astype(int)
    for k, (begin, stop) in enumerate(pairwise(cuts)):
        turn = (turns[k],) if k < len(turns) else outline.turns
        directions = Directions(signs[:n_c].copy(), signs[n_c:].copy())
        z = outline.z[begin : stop + 1]
        pieces.append(replace(outline, z=z, directions=directions, turns=turn))
        if k < len(turns):
            signs[turns[k]] = own[turns[k]]
    return pieces


def _gains(problem: Problem, phase: Phase) -> Formation | None:
    """The next phase's formation, if this phase gains a contact of it softly."""
    if phase.end is End.REST or phase.until.contact is None:
        return None
    return problem.phases[phase.index + 1].formation


def _choose_watched(phase: Phase, outline: Outline) -> tuple[int, ...]:
    """Limits that are near zero along the outline but for the phase's own end."""
    values = outline.formation.evaluate_limits(outline.z)
    near = values.min(axis=0) < 0.02 * outline.formation.scene.polygon.gyration_radius
    gained = [limit.gained == phase.until.contact for limit in outline.formation.limits]
    mine = np.array(gained) & (phase.until.contact is not None)
    return tuple(np.flatnonzero(near | mine).tolist())


def revise(
    stages: Sequence[Stage], points: Sequence[StagePoints], scheme: Scheme
) -> list[Stage] | None:
    """Stages with a direction of friction turned where the solution holds it back, or None."""
    for k, (stage, part) in enumerate(zip(stages, points, strict=True)):
        kinematics = stage.formation.evaluate(part.z, part.v)
        slip = np.einsum("nij,nj->ni", kinematics.A_t, part.v)
        rho = stage.formation.scene.polygon.gyration_radius
        signs = np.concatenate(stage.directions)
        senses = np.hstack([slip / rho, part.v[:, 3:]]) * signs
        fast = np.abs(part.v[:, 2:]).max()
        held = senses < 1.01 * SLIDING + _STALLED * fast
        held &= (np.abs(senses).max(axis=1) > 1e-3 * fast)[:, None]
        # What turns at an end of the stage has both its directions already.
        turning = set(stage.turns) | (set(stages[k - 1].turns) if k else set())
        held[:, sorted(turning)] = False
        runs = [(_longest_run(column), row) for row, column in enumerate(held.T)]
        (first, last), row = max(runs, key=lambda run: run[0][1] - run[0][0])
        if last - first < scheme.degree:
            continue
        turned = signs.copy()
        turned[row] *= -1
        other = Directions(turned[: len(signs) - 2], turned[len(signs) - 2 :])
        cuts = [0, first // scheme.degree, -(-last // scheme.degree), len(part.z) // scheme.degree]
        pieces: list[Stage] = []
        for piece in range(3):
            begin, stop = cuts[piece], cuts[piece + 1]
            if stop <= begin:
                continue
            known = _cut(part, stage.z[0], begin, stop, scheme)
            pieces.append(
                replace(
                    stage,
                    directions=other if piece == 1 else stage.directions,
                    z=np.vstack([known[0], known[1].z]),
                    duration=known[1].duration,
                    until=None,
                    gained=None,
                    turns=(row,),
                    follows=stage.follows and not pieces,
                    known=known[1],
                )
            )
        pieces[-1] = replace(pieces[-1], until=stage.until, gained=stage.gained, turns=stage.turns)
        return [*stages[:k], *pieces, *stages[k + 1 :]]
    return None


def _longest_run(flags: Array) -> tuple[int, int]:
    """First and past-the-last index of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    starts, stops = edges[::2], edges[1::2]
    if not len(starts):
        return 0, 0
    best = int((stops - starts).argmax())
    return int(starts[best]), int(stops[best])


def _cut(
    part: StagePoints, first: Array, begin: int, stop: int, scheme: Scheme
) -> tuple[Array, StagePoints]:
    """A solution from interval `begin` to `stop`, on at least the least number of intervals.

    Returns z at its start and the points.
    """
    count = max(_LEAST_INTERVALS, stop - begin)
    total = len(part.z) // scheme.degree
    given = np.append(0.0, (np.arange(total)[:, None] + scheme.points).ravel())
    wanted = begin + (np.arange(count)[:, None] + scheme.points).ravel() * (stop - begin) / count
    z = np.vstack([first, part.z])

    def pick(table: Array) -> Array:
        table = table if len(table) == len(given) else np.vstack([table[:1], table])
        return np.column_stack([np.interp(wanted, given, column) for column in table.T])

    start = np.array([np.interp(begin, given, column) for column in z.T])
    duration = part.duration * (stop - begin) / total
    tables = (part.v, part.a, part.c_n, part.tau)
    return start, StagePoints(duration, pick(z), *(pick(table) for table in tables))
