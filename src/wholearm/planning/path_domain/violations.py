"""What limits miss between the nodes of a solution, and how they are tightened by that."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from .elements import DEGREE, Grid, Profile
from .path_data import PhaseData
from .path_motion import PathMotion
from .path_nlp import PathNLP, Tightening, Units
from .rate_terms import find_hurry

MISS = 2.5e-7
"""Largest miss of a limit between nodes.

Over the scene's force for contact forces, relative for torques, the square of speeds and time.
"""
HURRIED = 1e-4
"""Largest relative miss of the torques' rates and of commands between nodes."""
ROUNDS = 40
"""Most times that the NLP is solved for one phase."""
OVER = 1.05
"""Factor on the miss by which a limit is tightened."""
_NEAR = 1e-3
"""Least miss of a start that plans do not have, over what is much."""


class PathSolution(NamedTuple):
    """What the solver has found, or where it is to start."""

    profile: Profile
    margin: float  # [N]: over epsilon
    multipliers: dict[str, Array]
    cost: float = np.inf  # in the units of the NLP
    lasts: float = 0.0  # [s]: what the NLP takes the duration for, where that has a bound


class Misses(NamedTuple):
    """What limits miss between nodes: see `PhaseData.misses`; and the duration, relatively.

    And motors, see `find_hurry`.
    """

    short: Array
    speeding: Array
    spare: Array
    late: float
    hurry: Array

    @staticmethod
    def of(
        data: PhaseData,
        solution: PathSolution,
        motions: Sequence[PathMotion],
        duration: float | None,
    ) -> Misses:
        """Misses of a solution, which is one motion for each phase."""
        late = 0.0
        if duration:
            late = max(0.0, sum(motion.duration for motion in motions) / duration - 1)
        hurry = find_hurry(data, solution.profile, motions)
        return Misses(*data.misses(solution.profile, solution.margin), late, hurry)

    def find_worst(self, data: PhaseData) -> float:
        """The largest, over what is much."""
        hurried = self.hurry.max() * (MISS / HURRIED)
        return float(max((self.short / data.spans).max(), self.speeding.max(), self.late, hurried))

    def tighten(
        self, data: PhaseData, tightening: Tightening, solution: PathSolution
    ) -> Tightening:
        """Limits that are tightened by somewhat more than they miss."""
        reach = data.slack_at_neighbours(solution.profile, solution.margin, self.short)
        short, speeding = data.spread_to_nodes(self.short), data.spread_to_nodes(self.speeding)
        if data.grid.held:
            short = _taper(short, data.grid)
        return tightening.by(
            data.spread_to_nodes(reach),
            OVER * short,
            OVER * speeding,
            OVER * self.late,
            OVER * data.spread_to_nodes(self.hurry),
        )

    def find_spare(self, data: PhaseData) -> Array:
        """How far each side is from being missed about each node, shape (n, n_sides)."""
        return -data.spread_to_nodes(-self.spare, -np.inf)

    def describe(self, data: PhaseData) -> str:
        """What is still missed after all solves."""
        worst = int((self.short / data.spans).max(axis=0).argmax())
        limits = data.limits
        unit = limits.limits[limits.owners[limits.sides[0][worst]]].unit
        missed = f"limits are still missed by {self.short[:, worst].max():.2g} {unit} between nodes"
        if (self.short / data.spans).max() <= MISS:
            over = max(self.speeding.max(), self.late)
            missed = f"the speed limit or the duration is still exceeded by {over:.2g} of it"
            if over <= MISS:
                over = self.hurry.max()
                missed = f"the torque rate limit is still exceeded by {over:.2g} of it"
        return f"after {ROUNDS} solves {missed}; plan with more intervals"


def _taper(short: Array, grid: Grid) -> Array:
    """Misses at nodes, shape (n, n_sides), so that they are the same where two elements meet.

    Torques are, too, and a polynomial that is held back at one end alone would swing.
    """
    table = short.reshape(-1, DEGREE + 1, short.shape[1])
    ends = np.zeros((len(table) + 1, short.shape[1]))
    ends[:-1], ends[1:] = table[:, 0], np.maximum(ends[1:], table[:, -1])
    ends[:-1] = np.maximum(ends[:-1], table[:, 0])
    y = np.linspace(0, 1, DEGREE + 1)[:, None]
    along = ends[:-1, None] * (1 - y) + ends[1:, None] * y
    return np.asarray(np.maximum(table, along).reshape(short.shape))


def anticipate(data: PhaseData, start: PathSolution, tightening: Tightening) -> Tightening:
    """Tighten by what a start misses, but for speeds and what it alone misses."""
    short, speeding, spare = data.misses(start.profile, start.margin)
    short = np.where(short < _NEAR * data.spans, short, 0.0)
    hurry = np.zeros((len(short), 2, 2))
    return Misses(short, 0 * speeding, spare, 0.0, hurry).tighten(data, tightening, start)


def price(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    solution: PathSolution,
    tightened: tuple[Array, Array, Array],
) -> Array:
    """What tightening costs at each node, to first order, in the NLP's units, shape (n,).

    That is multipliers times by how much limits, (n, n_sides), b, (n,), and motors, (n, 2, 2), are
    `tightened`.
    """
    rows, signs, _ = data.limits.sides
    on_limits = solution.multipliers["lam_g0"][nlp.columns.g["limits"]].reshape(
        len(data.grid.s), -1
    )
    on_sides = np.maximum(-signs * on_limits[:, rows], 0.0) / units.of(data.limits)[rows]
    on_b = np.zeros(nlp.free.shape)
    on_b[nlp.free] = solution.multipliers["lam_x0"]
    on_b = np.maximum(on_b[:, 0], 0.0) * solution.profile.b / data.grid.sizes / units.profile[0]
    found = (on_sides * tightened[0]).sum(axis=1) + on_b * tightened[1]
    for kind, (name, joints) in enumerate(nlp.shape.motors._asdict().items()):
        on_rows = solution.multipliers["lam_g0"][nlp.columns.g[name]]
        on_rows = np.abs(on_rows).reshape(len(joints), len(data.grid.s)).T
        found += (on_rows * tightened[2][:, kind, list(joints)]).sum(axis=1)
    return np.asarray(found)
