"""Contact modes found with friction that sets in gradually with the rate of sliding.

Friction of a given direction asks for motions that keep to it, so that a solver has to find its way
with the modes that it was given. With tanh(rate / onset) in place of directions contacts and joints
may move either way, and stop. The motion that is best with such friction shows which way everything
moves when; its stages, each with the friction of its directions, are where the search starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...geometry.curve import find_tied
from .collocation import Scheme
from .mesh import resample
from .modes import LEAST_INTERVALS, Mode, in_mode, link, merge, mode_of
from .search import Search, Solution
from .stage import Stage

ONSETS = (0.1, 0.03)
"""Rates at which friction sets in, one after the other, in the scene's unit."""
PATIENCE = 50
"""Most iterations of the solver for each of them."""
MOST = 9
"""Turns beyond which modes are those of a motion that trembles."""
SLOW = 1e-5
"""Rate over the largest one at the same instant below which its sign says nothing."""
STILL = 1e-4
"""Largest rate at an instant, over that of all, below which none of them says anything."""
BRIEF = 0.02
"""Least share of its stage's duration that a piece of it has."""


def find_modes(search: Search, stages: Sequence[Stage]) -> Solution:
    """Solve with friction that sets in gradually; a solution has stages in the modes of that."""
    mode = [mode_of(next(own for own in stages if own.phase == stage.phase)) for stage in stages]
    plain = [in_mode(stage, own) for stage, own in zip(stages, mode, strict=True)]
    joined = link(merge(plain))
    before: Solution | None = None
    for onset in ONSETS:
        begun = joined if before is None else before.stages
        gradual = [replace(stage, onset=onset) for stage in begun]
        solution = search.solve(gradual, before, most=PATIENCE)
        if not solution.success:
            return solution
        before = solution
    settled = [replace(stage, onset=0.0) for stage in solution.stages]
    pieces = [piece for stage in settled for piece in split_by_senses(stage, search.scheme)]
    stages = link(merge(pieces))
    if len(stages) > MOST + len(settled):
        status = "with friction that sets in gradually things turn too often"
        return solution._replace(status=status, success=False)
    return solution._replace(stages=stages)


class _Turn(NamedTuple):
    """Rows of (contacts, joints) that turn, and at which share of the stage's duration."""

    place: float
    rows: tuple[int, ...]


def split_by_senses(stage: Stage, scheme: Scheme) -> list[Stage]:
    """Pieces of a stage in each of which everything moves one way, one turning after the other.

    They have to be linked.
    """
    part, given = stage.guess, np.array(mode_of(stage).signs)
    rates = stage.measure_senses(part.z.reshape(-1, 5), part.v.reshape(-1, 5))
    rates *= np.concatenate(stage.directions)
    signs, turns = _find_turns(stage, scheme, rates)
    signs[given == 0] = 0.0
    edges, pieces = _spread([turn.place for turn in turns]), list[Stage]()
    for k, (begin, stop) in enumerate(pairwise(edges)):
        count = max(LEAST_INTERVALS, round((stop - begin) * stage.intervals))
        guess = resample(part, scheme, np.linspace(0.0, 1.0, count + 1), begin, stop)
        opens = stage.opens and not pieces
        piece = replace(stage, guess=guess, until=None, ends_in_impact=False, opens=opens)
        pieces.append(in_mode(piece, Mode(tuple(signs.tolist()))))
        if k < len(turns):
            signs[list(turns[k].rows)] *= -1
    pieces[-1] = replace(pieces[-1], until=stage.until, ends_in_impact=stage.ends_in_impact)
    return pieces


def _find_turns(stage: Stage, scheme: Scheme, rates: Array) -> tuple[Array, list[_Turn]]:
    """The signs of rates, shape (n, n_c + 2), at first, and what turns after that, in its order.

    Of rates that are next to nothing beside others at the same instant the sign says nothing.
    """
    places, z = stage.guess.places(scheme.points).ravel(), stage.guess.z.reshape(-1, 5)
    sizes = np.abs(rates).max(axis=1)
    clear = (np.abs(rates) > SLOW * sizes[:, None]) & (sizes > STILL * sizes.max())[:, None]
    signs, found = np.concatenate(stage.directions), list[tuple[float, int]]()
    for row, own in enumerate(rates.T):
        known = np.flatnonzero(clear[:, row])
        if not len(known) or row in stage.formation.rolling_rows:
            continue
        signs[row] = np.sign(own[known[0]])
        for one, other in pairwise(known.tolist()):
            if own[one] * own[other] < 0:
                share = own[one] / (own[one] - own[other])
                found.append((float(places[one] + share * (places[other] - places[one])), row))
    turns, near = list[_Turn](), 2 * float(np.diff(places).max())
    for place, row in sorted(found):
        last = turns[-1] if turns else None
        at = int(np.abs(places - place).argmin())
        together = find_tied(stage.formation, z[at], row)
        if last and place - last.place < near and set(last.rows) & set(together) - {row}:
            turns[-1] = last._replace(rows=(*last.rows, row))
        else:
            turns.append(_Turn(place, (row,)))
    return signs, _join_stops(turns, near, rates.shape[1] - stage.formation.n_rolling)


def _join_stops(turns: list[_Turn], near: float, count: int) -> list[_Turn]:
    """The turns, those as one where all `count` rows turn `near` each other: there motion stops."""
    joined = list[_Turn]()
    while turns:
        own = [turn for turn in turns if turn.place < turns[0].place + near]
        rows = tuple(row for turn in own for row in turn.rows)
        if len(rows) == len(set(rows)) == count:
            joined.append(_Turn(own[len(own) // 2].place, rows))
            turns = turns[len(own) :]
        else:
            joined.append(turns[0])
            turns = turns[1:]
    return joined


def _spread(places: Sequence[float]) -> list[float]:
    """Ends of pieces between 0 and 1 that turn at `places`, moved apart where these coincide."""
    widths = np.maximum(np.diff([0.0, *places, 1.0]), min(BRIEF, 0.5 / (len(places) + 1)))
    return [0.0, *np.cumsum(widths / widths.sum())[:-1].tolist(), 1.0]
