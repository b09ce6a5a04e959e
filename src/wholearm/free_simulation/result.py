"""Results of a free simulation: states, forces and periods in which pairs press."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np

from ..common.errors import InputError
from ..contacts.elemental import parse_contact
from ..problem.definition import Problem
from ..simulation.events import Energies, EventKind, Outcome, OutcomeKind, Simulation
from .state import FreeRun, Record


class FreeStretch(NamedTuple):
    """Some time in which a contact presses."""

    contact: str
    start: float  # start, stop [s]:
    stop: float
    # [N]: its least c_n then; NaN where everything rests, as forces are indeterminate there
    least: float
    time: float  # [s]: when


def list_pauses(
    stretches: Sequence[FreeStretch], contact: str, start: float, stop: float
) -> list[tuple[float, float]]:
    """When a contact does not press between two times [s], in their order."""
    pauses, at = [], start
    for first, last in sorted((own.start, own.stop) for own in stretches if own.contact == contact):
        if first > at:
            pauses.append((at, min(first, stop)))
        at = max(at, last)
        if at >= stop:
            return pauses
    return [*pauses, (at, stop)]


@dataclass(frozen=True, eq=False, repr=False)
class FreeSimulation(Simulation):
    """A simulated motion without prescribed contacts, at every step.

    As of `Simulation`, but phases are those of a plan's clock, `contacts` has others that pressed,
    forces are NaN where a contact does not press, events are there twice, and `missed_by` is NaN.
    """

    # when each pair of features pressed, by the order of their start
    stretches: tuple[FreeStretch, ...]
    residual: float  # largest residual of a contact problem, relative to its largest rate

    def show(self, contacts: Sequence[str]) -> FreeSimulation:
        """The same with other columns of forces, NaN where a contact never pressed."""
        forces = np.full((2, len(self.t), len(contacts)), np.nan)
        for column, name in enumerate(contacts):
            if name in self.contacts:
                own = self.contacts.index(name)
                forces[:, :, column] = self.c_n[:, own], self.c_t[:, own]
        return replace(self, contacts=tuple(contacts), c_n=forces[0], c_t=forces[1])


def collect(run: FreeRun, problem: Problem, starts: Sequence[float]) -> FreeSimulation:
    """The result of a run; `starts` are the starts of the phases by the clock [s]."""
    rows, n, names = run.records, run.system.n, run.system.names
    y, t = np.array([row.y for row in rows]), np.array([row.t for row in rows])
    planned = [contact.name for contact in problem.contacts]
    used = dict.fromkeys(pair for kept in dict.fromkeys(row.kept for row in rows) for pair in kept)
    others = [names[pair] for pair in used if names[pair] not in planned]
    contacts = (*planned, *(name for name in others if _is_named(name, problem)))
    columns = {name: column for column, name in enumerate(contacts)}
    forces = np.full((2, len(rows), len(contacts)), np.nan)
    groups = [list(group) for _, group in groupby(rows, lambda row: row.kept)]
    first = 0
    for group in groups:
        own = [k for k, pair in enumerate(group[0].kept) if names[pair] in columns]
        at = [columns[names[group[0].kept[k]]] for k in own]
        known = np.array([(row.c_n, row.c_t) for row in group])
        forces[:, first : first + len(group), at] = known[:, :, own].transpose(1, 0, 2)
        first += len(group)
    given_up = next((e for e in run.events if e.kind is EventKind.GIVEN_UP), None)
    outcome = Outcome(OutcomeKind.ENDED, f"the simulation ends at t = {run.t:.5g} s")
    if given_up is not None:
        outcome = Outcome(OutcomeKind.GIVEN_UP, given_up.text)
    clock = np.asarray(starts)
    owners = np.searchsorted(clock, [event.time for event in run.events], side="right") - 1
    # Of two rows at a boundary the first one ends the phase before.
    twice = np.append(np.diff(t) == 0, False) & np.isin(t, clock[1:])
    phases = np.maximum(np.searchsorted(clock, t, side="right") - 1 - twice, 0)
    stored = run.system.stored(y[:, :n], y[:, n : 2 * n])
    impact = np.array([row.impact for row in rows])
    return FreeSimulation(
        t=t,
        z=y[:, :n],
        z_dot=y[:, n : 2 * n],
        z_ddot=np.array([row.acceleration for row in rows]),
        tau=np.array([row.tau for row in rows]),
        phase=phases,
        contacts=contacts,
        c_n=forces[0],
        c_t=forces[1],
        problem=problem,
        torque=run.torque,
        events=tuple(
            event._replace(phase=max(int(owner), 0))
            for event, owner in zip(run.events, owners, strict=True)
        ),
        stretches=_list_stretches(groups, names),
        energies=Energies(stored, y[:, 10], y[:, 11], y[:, 12], y[:, 13], impact),
        outcome=outcome,
        missed_by=math.nan,
        residual=run.residual,
        steps=run.steps,
        rejected=run.rejected,
    )


def _is_named(name: str, problem: Problem) -> bool:
    """Whether a pair is a contact that problem files know."""
    try:
        parse_contact(name, problem.scene)
    except InputError:
        return False
    return True


def _list_stretches(
    groups: Sequence[Sequence[Record]], names: Sequence[str]
) -> tuple[FreeStretch, ...]:
    """When each pair pressed, without a pause; each group of records has the same pairs."""
    found: list[FreeStretch] = []
    for pair in dict.fromkeys(pair for group in groups for pair in group[0].kept):
        for presses, own in groupby(groups, lambda group: pair in group[0].kept):  # noqa: B023
            if presses:
                rows = [row for group in own for row in group]
                c_n = np.array([row.c_n[row.kept.index(pair)] for row in rows])
                known = np.flatnonzero(c_n == c_n)
                at = int(known[c_n[known].argmin()]) if len(known) else 0
                ends = rows[0].t, rows[-1].t
                found.append(FreeStretch(names[pair], *ends, float(c_n[at]), rows[at].t))
    return tuple(sorted(found, key=lambda stretch: (stretch.start, stretch.contact)))
