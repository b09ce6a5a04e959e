"""Phases that are tuned as one motion, from rest to rest.

Where a contact goes on as one of a neighbouring feature of the same finger nothing is hit, and
there is nothing to stop for: such phases are passed in motion, as are those whose end says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..contacts.elemental import Contact
from ..problem.definition import End, Phase, Problem, Until
from ..simulation.events import Event, EventKind

_GAINS = (EventKind.GAINED, EventKind.IMPACT, EventKind.PASS)


@dataclass(frozen=True, eq=False)
class Passage:
    """Phases that are carried in one motion.

    Attributes
    ----------
    phases : tuple of Phase
    after : Phase or None
        The one that follows; None after the last.
    """

    phases: tuple[Phase, ...]
    after: Phase | None

    @property
    def until(self) -> Until:
        """What ends it."""
        return self.phases[-1].until

    @property
    def title(self) -> str:
        """The numbers of its phases, for people."""
        return name_numbers(self.phases[0].number, self.phases[-1].number)

    @property
    def passed(self) -> str:
        """The contact that goes on as the one which ends it, empty if none does."""
        return _find_predecessor(self.phases[-1], self.after)

    def list_pressed(self, index: int) -> list[str]:
        """The contacts of a phase that press to its end: without those that it releases."""
        phase, after = self.phases[index], (*self.phases[1:], self.after)[index]
        leaving = _list_leaving(phase, after) if phase.until.is_release else set()
        return [name for name in phase.formation.names if name not in leaving]

    def follow(self, events: Sequence[Event]) -> tuple[list[float], Event | None]:
        """When its phases end [s], as far as they do, and the first loss of a contact before."""
        ends: list[float] = []
        following = (*self.phases[1:], self.after)
        for event in events:
            phase, after = self.phases[len(ends)], following[len(ends)]
            if _is_end(phase, after, event):
                ends.append(event.time)
                if len(ends) == len(self.phases):
                    break
            elif event.kind is EventKind.CONTACT_LOST and event.contact in phase.formation.names:
                return ends, event
        return ends, None


def split_passages(problem: Problem) -> list[Passage]:
    """The phases of a problem, those together that are carried in one motion."""
    found: list[Passage] = []
    own: list[Phase] = []
    for phase, after in zip(problem.phases, (*problem.phases[1:], None), strict=True):
        own.append(phase)
        moves = after is not None and bool(_find_predecessor(phase, after))
        if after is None or (phase.end is End.REST and not moves):
            found.append(Passage(tuple(own), after))
            own = []
    return found


def name_numbers(first: int, last: int) -> str:
    """Numbers of phases, such as 3 or 9-11."""
    return f"{first}" if first == last else f"{first}-{last}"


def _is_end(phase: Phase, after: Phase | None, event: Event) -> bool:
    """Whether an event ends a phase; a coordinate that does is none."""
    until = phase.until
    if until.contact is not None:
        return event.kind in _GAINS and event.contact == until.contact.name
    gone = event.kind is EventKind.CONTACT_LOST
    return until.is_release and gone and event.contact in _list_leaving(phase, after)


def _list_leaving(phase: Phase, after: Phase | None) -> set[str]:
    kept = () if after is None else after.formation.names
    return set(phase.formation.names) - set(kept)


def _find_predecessor(phase: Phase, after: Phase | None) -> str:
    gained = phase.until.contact
    if gained is None or gained.finger is None:
        return ""
    count = phase.formation.scene.polygon.n_vertices
    kept = () if after is None else after.formation.contacts
    for contact in phase.formation.contacts:
        near = contact.finger == gained.finger and contact not in kept
        if near and (_adjoins(contact, gained, count) or _adjoins(gained, contact, count)):
            return contact.name
    return ""


def _adjoins(first: Contact, second: Contact, count: int) -> bool:
    """Whether a vertex on the arc of a tip is next to a contact with its side, or with an edge."""
    if (first.feature, first.surface) != ("v", "tip"):
        return False
    if second.surface == "finger":
        return first.index == second.index
    return second.feature == "e" and first.index in (second.index, (second.index + 1) % count)
