"""Violations of limits between the nodes of a solution, and the tightening that removes them."""

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

MISS = 2.5e-7  # largest violation between nodes, over the limits' scales; relative for b and time
_RATE_MISS = 1e-4  # the same, relative, for torque rates and commands
SOLVES = 40  # most solves while limits are tightened
OVER = 1.05  # tightening over the violation
_NEAR = 1e-3  # violations of a start beyond this are its own, not those of a plan, over the scales


class PathSolution(NamedTuple):
    """A solution of the NLP, or the point to start from."""

    profile: Profile
    margin: float  # [N]: over epsilon
    multipliers: dict[str, Array]
    cost: float = np.inf  # in the units of the NLP
    duration: float = 0.0  # [s]: by the quadrature of the NLP, where it is bounded


class Misses(NamedTuple):
    """Violations between nodes."""

    short: Array  # short, speeding, spare: see `PhaseData.misses`
    speeding: Array
    spare: Array
    late: float  # of the duration, relative
    hurry: Array  # see `find_hurry`

    @staticmethod
    def of(
        data: PhaseData,
        solution: PathSolution,
        motions: Sequence[PathMotion],
        duration: float | None,
    ) -> Misses:
        """Violations of a solution, one motion for each phase."""
        late = 0.0
        if duration:
            late = max(0.0, sum(motion.duration for motion in motions) / duration - 1)
        hurry = find_hurry(data, solution.profile, motions)
        return Misses(*data.misses(solution.profile, solution.margin), late, hurry)

    def find_worst(self, data: PhaseData) -> float:
        """The largest, over the scales."""
        hurried = self.hurry.max() * (MISS / _RATE_MISS)
        return float(max((self.short / data.spans).max(), self.speeding.max(), self.late, hurried))

    def tighten(
        self, data: PhaseData, tightening: Tightening, solution: PathSolution
    ) -> Tightening:
        """Limits tightened by somewhat more than their violations."""
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
        """Slack of each side in the intervals about each node, shape (n, n_sides)."""
        return -data.spread_to_nodes(-self.spare, -np.inf)

    def describe(self, data: PhaseData) -> str:
        """Violations that remain after all solves, for a message."""
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
        return f"after {SOLVES} solves {missed}; plan with more intervals"


def _taper(short: Array, grid: Grid) -> Array:
    """Violations at nodes, (n, n_sides), made continuous where two elements meet, as torques are.

    A polynomial tightened at one end alone would oscillate.
    """
    table = short.reshape(-1, DEGREE + 1, short.shape[1])
    ends = np.zeros((len(table) + 1, short.shape[1]))
    ends[:-1], ends[1:] = table[:, 0], np.maximum(ends[1:], table[:, -1])
    ends[:-1] = np.maximum(ends[:-1], table[:, 0])
    y = np.linspace(0, 1, DEGREE + 1)[:, None]
    along = ends[:-1, None] * (1 - y) + ends[1:, None] * y
    return np.asarray(np.maximum(table, along).reshape(short.shape))


def anticipate(data: PhaseData, start: PathSolution, tightening: Tightening) -> Tightening:
    """Tighten by the violations of a start, but for those of speeds and those beyond `_NEAR`."""
    short, speeding, spare = data.misses(start.profile, start.margin)
    short = np.where(short < _NEAR * data.spans, short, 0.0)
    hurry = np.zeros((len(short), 2, 2))
    return Misses(short, 0 * speeding, spare, 0.0, hurry).tighten(data, tightening, start)


def price(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    solution: PathSolution,
    limits: Array,
    speed_share: Array,
    motors: Array,
) -> Array:
    """First-order cost of tightening at each node, in the NLP's units, shape (n,).

    The sum of multipliers times the tightening of limits, (n, n_sides), b, (n,), and torque rates
    and commands, (n, 2, 2).
    """
    rows, signs, _ = data.limits.sides
    on_g, count = solution.multipliers["lam_g0"], len(data.grid.s)
    on_limits = on_g[nlp.columns.g["limits"]].reshape(count, -1)
    on_sides = np.maximum(-signs * on_limits[:, rows], 0.0) / units.of(data.limits)[rows]
    on_b = np.zeros(nlp.free.shape)
    on_b[nlp.free] = solution.multipliers["lam_x0"]
    on_b = np.maximum(on_b[:, 0], 0.0) * solution.profile.b / data.grid.sizes / units.profile[0]
    costs = (on_sides * limits).sum(axis=1) + on_b * speed_share
    for kind, (name, joints) in enumerate(nlp.shape.motors._asdict().items()):
        on_rows = np.abs(on_g[nlp.columns.g[name]]).reshape(len(joints), count).T
        costs += (on_rows * motors[:, kind, list(joints)]).sum(axis=1)
    return np.asarray(costs)
