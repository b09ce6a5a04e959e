"""How phases share the duration that the objective `margin` may take."""

from __future__ import annotations

from collections.abc import Sequence

from ..common.errors import InfeasibleError
from ..common.shortfalls import Change, Parameter
from ..problem.definition import Phase
from ..results.trajectory import Motion
from .phase_plan import PhasePlan


def share_again(
    allowed: list[float | None],
    block: Sequence[Phase],
    least: Sequence[PhasePlan[Motion]],
    fastest: Sequence[PhasePlan[Motion]],
) -> None:
    """Give a block its share for another least duration, at the cost of the phases after it."""
    later = range(block[-1].index + 1, len(allowed))
    rest = sum(allowed[k] or 0.0 for k in later)
    if not rest:
        return
    gain = 0.0
    for phase, plan in zip(block, fastest, strict=True):
        own = allowed[phase.index]
        if own is not None:
            ratio = plan.motion.duration / least[phase.index].motion.duration
            gain += own * (ratio - 1)
            allowed[phase.index] = own * ratio
    for k in later:
        own = allowed[k]
        allowed[k] = None if own is None else own * (1 - gain / rest)


def share_duration(
    least: Sequence[PhasePlan[Motion]], duration: float | None
) -> list[float | None]:
    """Longest duration of each phase [s]: the whole, shared in proportion to the least times."""
    times = [plan.motion.duration for plan in least]
    total = 2 * sum(times) if duration is None else duration
    if total <= sum(times):
        from .advice import describe_changes, round_outwards

        # The least-time plan shows it; a little more leaves something to choose.
        own = Parameter("duration", total, "s", 1, "duration")
        enough = Change(own, round_outwards(1.005 * sum(times), 1))
        raise InfeasibleError(
            f"duration = {total:g} s is not longer than the least time, {sum(times):.6g} s; "
            f"{describe_changes([enough])}",
            changes=[enough],
        )
    return [total / sum(times) * own for own in times]
