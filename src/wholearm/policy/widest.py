"""How wide ranges may be within which a policy has references that keep contacts."""

from __future__ import annotations

from ..common.errors import InputError
from ..geometry.tracing import runs_on_curve
from ..problem.definition import Problem
from ..problem.uncertainty import PARAMETERS
from ..results.trajectory import Trajectory
from .make import find_ranges, split
from .reference import Reserve, trace_pieces
from .within import WIDEST

MOST = 64.0
"""Largest factor that is tried."""


def find_widest(problem: Problem, plan: Trajectory, delay: float) -> dict[int, float]:
    """The largest factor on the ranges of each phase along a curve, by its number.

    It is at most `MOST`, and ends where a relative range would reach `within.WIDEST`. Its error is
    that of `within.retime_within`.

    Parameters
    ----------
    problem : Problem
    plan : Trajectory
    delay : float, [s]
        Of the torques, as far as it is known.

    Raises
    ------
    InputError
        If neither plan nor problem have ranges.
    """
    ranges = find_ranges(problem, plan)
    if ranges is None:
        raise InputError("", "uncertainty", "is missing; without ranges none is the widest")
    relative = max(ranges.get(own.name, 0.0) for own in PARAMETERS if not own.unit)
    most = min(WIDEST / relative, MOST) if relative > 0 else MOST
    blocks = split(problem.phases)
    along = [own[0] if len(own) == 1 and runs_on_curve(own[0]) else None for own in blocks]
    pieces = trace_pieces(problem, along, plan, Reserve(most, ranges, delay))
    return {
        phase.number: most * piece.share
        for phase, piece in zip(along, pieces, strict=True)
        if phase is not None and piece is not None
    }
