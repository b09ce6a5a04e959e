"""Data of planned blocks of phases."""

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

PLAIN = -1  # refinement level: first number of intervals, no search for modes
BEGUN = -2  # refinement level: coarse plans, which may miss limits between points
FINEST = 64  # most intervals of a phase in the time domain after refinement


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """A planned block."""

    phases: tuple[Phase, ...]
    start: Array  # (5,)
    finer: int  # refinement level: doublings of its intervals, or `PLAIN` or `BEGUN`
    duration: float | None  # [s]: longest, for the objective `margin`
    fastest: Plans  # time-optimal plans from this start, if they were made for it
    plans: Plans  # one for each of its phases
    chain: ImpactSequence | None  # its curves; None in the time domain

    @property
    def end(self) -> Array:
        """Where the block ends, shape (5,)."""
        if self.chain is not None:
            return self.chain.curves[-1].end
        return end_of(self.plans[-1])[0]

    @property
    def intervals(self) -> int:
        """Most intervals of a phase in the time domain."""
        return max(len(plan.torque.coefficients) for plan in self.plans)

    @property
    def has_searched(self) -> bool:
        """Whether more than one sequence of contact modes was tried."""
        return any(plan.sequences > 1 for plan in self.plans)

    @property
    def is_finest(self) -> bool:
        """Whether it is planned in the time domain on the finest intervals."""
        return self.chain is None and self.intervals >= FINEST


@dataclass(frozen=True, eq=False)
class Planning:
    """The plans of all phases of a problem."""

    problem: Problem
    curves: tuple[Curve, ...]  # of the first phases, as far as ends follow from geometry alone
    options: PlanOptions
    blocks: tuple[BlockPlan, ...]
    # shares, allowed [s]: longest duration of each phase, for the objective `margin`: in proportion
    # to time-optimal plans, and as used after blocks turned out to start elsewhere
    shares: list[float | None]
    allowed: list[float | None]
    least: Plans = field(default_factory=list)  # these time-optimal plans
    pinned: bool = False  # whether blocks end where those plans do
    ahead: bool = True  # whether blocks end by the cost-to-go, which `margin` and `least` do not
    sketches: bool = False  # whether least times-to-go are those of a speed sweep
    # [N]: by how much c_n of blocks, by their indices, have to exceed epsilon, if at all
    more: dict[int, float] = field(default_factory=dict)

    @property
    def plans(self) -> Plans:
        """One for each phase."""
        return [plan for block in self.blocks for plan in block.plans]

    @cached_property
    def settled(self) -> Settled:
        """The plans with dwells at their ends, where the problem asks for these."""
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
        before = [own for own in self.blocks if own.phases[-1].index + 1 == phases[0].index]
        chain = before[0].chain if before else None
        return chain.curves[-1] if chain else None
