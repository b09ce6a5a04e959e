"""A free simulation from its start to its end, event by event."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..simulation.events import EventKind
from .deciding import decide, stands
from .impacts import collide, jolt
from .motion import StuckError, move
from .rest import hold
from .state import ARMED, NO_PROGRESS, Run


def play(run: Run, touching: float, halt: Callable[[Run], bool] | None = None) -> None:
    """Simulate until the torques end.

    Parameters
    ----------
    run : Run
    touching : float, [m]
        Gap that counts as closed at the start.
    halt : callable, optional
        Asked at every event whether that is enough.
    """
    _close(run, touching)
    while run.t < run.end and not (halt is not None and halt(run)):
        if run.t >= run.stop:
            run.next_piece()
        found = collide(run)
        moved = not stands(run)
        rests = decide(run, found)
        if moved and stands(run):
            rests = decide(run)
        if not _advances(run):
            return
        if rests is None:
            if not jolt(run):
                run.note(EventKind.GIVEN_UP, "no motion obeys the laws of contact")
                if not run.records:
                    run.record(None)
                return
            continue
        run.resting = rests
        if rests:
            run.take_impulse(np.zeros(run.system.n))
            hold(run)
            continue
        try:
            move(run)
        except StuckError:
            # Forces grow without bound where the motion jams.
            if not jolt(run):
                run.note(EventKind.GIVEN_UP, "steps become too short")
                return


def _advances(run: Run) -> bool:
    """Count decisions without time passing; whether it goes on."""
    run.decisions = run.decisions + 1 if run.t == run.decided_at else 0
    run.decided_at = run.t
    if run.decisions > NO_PROGRESS:
        run.note(EventKind.GIVEN_UP, "decisions do not end")
        return False
    return True


def _close(run: Run, touching: float) -> None:
    """Move onto what touches at the start, the shortest way in the metric of masses."""
    system = run.system
    root = np.sqrt(system.mass)
    for _ in range(5):
        gaps, ranges = system.measure(run.z[None])
        near = np.flatnonzero((np.abs(gaps[0]) < touching) & (ranges[0] > -touching)).tolist()
        if not near:
            break
        rows = system.evaluate(run.z, run.v, near).A / root
        step = np.linalg.lstsq(rows, gaps[0, near], rcond=1e-9)[0]
        run.y[: system.n] -= step / root
    gaps, _ = system.measure(run.z[None])
    run.armed = gaps[0] > ARMED * system.scales.length
