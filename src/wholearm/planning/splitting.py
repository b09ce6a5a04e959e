"""Which phases are planned together, and which of them along their curves."""

from __future__ import annotations

from collections.abc import Sequence

from ..geometry.tracing import runs_on_curve
from ..problem.definition import End, Phase, Problem
from .options import PlanOptions


def split_blocks(problem: Problem) -> list[tuple[Phase, ...]]:
    """Phases that have to be planned together: those joined smoothly or by impacts."""
    blocks: list[tuple[Phase, ...]] = []
    block: tuple[Phase, ...] = ()
    for phase in problem.phases:
        block = (*block, phase)
        if phase.end is End.REST:
            blocks.append(block)
            block = ()
    return blocks


def runs_along_curves(block: Sequence[Phase], options: PlanOptions) -> bool:
    """Whether phases are planned along their curves: a single one, or several that slide."""
    if options.transcription != "auto":
        return False
    if len(block) == 1:
        return runs_on_curve(block[0])
    return all(
        phase.formation.n_constraints == 4
        and not phase.formation.rolling
        and not phase.until.is_release
        for phase in block
    )


def leads_on(problem: Problem, block: Sequence[Phase], options: PlanOptions) -> bool:
    """Whether what follows a block in the time domain is planned there, too.

    Where it can begin is then known of the plans of least duration alone.
    """
    following = problem.phases[block[-1].index + 1 :]
    own = next((part for part in split_blocks(problem) if part[0] in following), None)
    return own is not None and not runs_along_curves(own, options)
