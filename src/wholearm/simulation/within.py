"""What is wanted within steps: states by the continuous extension, evaluated all at once.

A step ends where the integration or an event says so, not where somebody wants to look.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from .events import Section
from .replay import Replay
from .runge_kutta import interpolate
from .stepper import Stepper


def keep_wanted(run: Replay, stop: float) -> None:
    """Set aside the instants that are wanted within the step just made, which ends at `stop`.

    Its start is recorded already.
    """
    while run.wanted[run.next_wanted] <= run.t:
        run.next_wanted += 1
    if run.wanted[run.next_wanted] >= stop:
        return
    section = run.sections[-1]
    first, blank = len(section.times), np.full(section.to.size, np.nan)
    while run.wanted[run.next_wanted] < stop:
        section.times.append(run.wanted[run.next_wanted])
        section.rows.append(blank)
        section.impacts.append(run.impact)
        run.next_wanted += 1
    section.within.append((run.stepper.inputs.copy(), np.arange(first, len(section.times))))


def fill(sections: Iterable[tuple[Section, Stepper]]) -> bool:
    """Evaluate what has been set aside; whether nothing had happened there that steps missed."""
    calm = True
    for section, stepper in sections:
        if not section.within:
            continue
        at, compiled = stepper.at, stepper.compiled
        packed = np.array([inputs for inputs, _ in section.within])
        (terms,) = compiled.extend(packed)
        step = np.repeat(np.arange(len(packed)), [len(rows) for _, rows in section.within])
        rows = np.concatenate([rows for _, rows in section.within])
        times = np.array(section.times)[rows]
        x = (times - packed[step, at.t]) / packed[step, at.h]
        states = interpolate(packed[step, at.y], terms[step], x)
        (outputs,) = compiled.sample(packed[step], states, times[:, None])
        for row, values in zip(rows, outputs[:, :, 0], strict=True):
            section.rows[row] = values
        calm &= bool((outputs[:, stepper.to.worst] >= 0).all())
        section.within.clear()
    return calm
