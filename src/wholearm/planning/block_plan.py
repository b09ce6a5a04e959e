"""Blocks of phases as they are planned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

from ..common.arrays import Array
from ..geometry.curve import Curve
from ..problem.definition import Phase, Problem
from .options import PlanOptions
from .path_domain.impact_sequence import ImpactSequence
from .phase_plan import Settled
from .stops import Plans, end_of

PLAIN = -1
"""Number of doublings that stands for as many intervals as at first, and no search for modes."""
BEGUN = -2  # the same for plans that are only begun: they may miss limits between points
FINEST = 64  # most intervals of a phase in the time domain that refining asks for


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """A block as it is planned."""

    phases: tuple[Phase, ...]
    start: Array  # (5,): where it starts
    finer: int  # how often its intervals are doubled, or `PLAIN` or `BEGUN`
    duration: float | None  # [s]: its longest duration, for the objective `margin`
    fastest: Plans  # plans of least duration from this start, if they were made for it
    plans: Plans  # one for each of its phases
    chain: ImpactSequence | None  # its curves; None if it is planned in the time domain

    @property
    def end(self) -> Array:
        """Where the block ends, shape (5,)."""
        if self.chain is not None:
            return self.chain.curves[-1].end
        return end_of(self.plans[-1])[0]

    @property
    def intervals(self) -> int:
        """Most intervals of a phase in the time domain: each is a piece of the torques."""
        return max(len(plan.torque.coefficients) for plan in self.plans)

    @property
    def has_searched(self) -> bool:
        """Whether more than one sequence of contact modes was tried."""
        return any(plan.sequences > 1 for plan in self.plans)

    @property
    def is_finest(self) -> bool:
        """Whether it is planned in the time domain with all the intervals that it may have."""
        return self.chain is None and self.intervals >= FINEST


@dataclass(frozen=True, eq=False)
class Planning:
    """The plans of all phases of a problem."""

    problem: Problem
    # those of the first phases: as far as geometry alone says where phases end
    curves: tuple[Curve, ...]
    options: PlanOptions
    blocks: tuple[BlockPlan, ...]
    # shares, allowed [s]: the longest duration of each phase, for the objective `margin`: in
    # proportion to plans of least duration, and as used, where a block turned out to start from
    # somewhere else
    shares: list[float | None]
    allowed: list[float | None]
    # those plans of least duration; empty for other objectives
    least: Plans = field(default_factory=list)
    pinned: bool = False  # whether blocks end where those plans do
    # whether blocks end with regard to what follows them. Plans that durations are shared out by do
    # not, as blocks for the objective `margin` cannot.
    ahead: bool = True
    # whether least times of what follows a block are those of a sweep, where it ends by them
    sketches: bool = False
    # [N]: by how much normal forces of blocks, by their indices, have to exceed epsilon, if at all
    more: dict[int, float] = field(default_factory=dict)

    @property
    def plans(self) -> Plans:
        """One for each phase."""
        return [plan for block in self.blocks for plan in block.plans]

    @cached_property
    def settled(self) -> Settled:
        """The plans with their ends held, where the problem asks for that."""
        plans, phases = self.plans, self.problem.phases
        if not self.problem.is_settled:
            return Settled(plans, (None,) * len(phases))
        from .dwell import settle_plans

        return settle_plans(self.problem, plans)

    def find_block(self, number: int) -> int:
        """Index of the block with the phase of a number, counted from 1."""
        ends = [block.phases[-1].number for block in self.blocks]
        return next(k for k, end in enumerate(ends) if number <= end)

    def find_curve_before(self, phases: Sequence[Phase]) -> Curve | None:
        """The curve that ends at rest where some phases begin, if there is one."""
        known = [block for block in self.blocks if block.phases[-1].index + 1 == phases[0].index]
        chain = known[0].chain if known else None
        return chain.curves[-1] if chain else None

    def find_curve_after(self, phases: Sequence[Phase]) -> Curve | None:
        """The curve that begins at rest where some phases end, if that is known."""
        index = phases[-1].index + 1
        return self.curves[index] if index < len(self.curves) else None
