"""Report of a prediction: quasistatic motions, and the speeds up to which contacts hold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from ..common.arrays import Array
from ..common.document import Document, Result, Table, fixed


class Place(NamedTuple):
    """Where along a phase: arc length [m], x [m] and phi [rad]."""

    s: float
    x: float
    phi: float

    def to_text(self) -> str:
        """The pose in mm and degrees."""
        x, phi = round(1e3 * self.x, 6) + 0.0, round(math.degrees(self.phi), 6) + 0.0
        return f"x = {x:.4g} mm, phi = {phi:.4g} deg"


class Weakest(NamedTuple):
    """The limits that are missed first, and where."""

    # one, or two of which either does with another internal force; none where it is no contact
    contacts: tuple[str, ...]
    others: tuple[str, ...]  # torques or speeds of fingers that keep it from pressing more
    place: Place
    # [N]: the least normal force there; None where other limits than those of forces are missed
    force: float | None

    @property
    def name(self) -> str:
        """The limits in words."""
        parts = [" or ".join(self.contacts), " and ".join(self.others)]
        return ", by ".join(filter(None, parts)) or "jams"


class Survival(NamedTuple):
    """Up to which speed one kind of motion keeps every contact."""

    # "steady": at one speed, with the best internal force at each place; "rest to rest",
    # "from rest", "to rest": as a cosine of time, or with constant acceleration, likewise; "own
    # torques": at one speed, under the torques of the quasistatic motion
    motion: str
    # [m/s]: along the phase, its largest, from which on a contact presses with less than epsilon.
    # Zero where one does near rest, None where none does.
    speed: float | None
    duration: float | None  # [s]: of the phase at that speed
    lost: float | None  # [m/s]: likewise, from which on a contact is lost
    # [m/s]: where that is zero, the speed from which on contacts are kept after all
    again: float | None
    first: Weakest  # what gives way at `speed`


class QuasistaticTorques(NamedTuple):
    """Torques that balance a quasistatic motion, at n places of a phase."""

    s: Array  # (n,) [m]
    z: Array  # (n, 5)
    tau: Array  # (n, 2) [N m]
    c_n: Array  # (n, n_c) [N]


class Curves(NamedTuple):
    """The least normal force over speed."""

    speed: Array  # (n,) [m/s]
    # (n,) [N]: by the names of motions; minus infinity where other limits are missed
    force: dict[str, Array]


@dataclass(frozen=True, eq=False)
class PhasePrediction:
    """One phase."""

    number: int
    contacts: tuple[str, ...]
    until: str
    # {"curve", "line", "left out"}: whether it is looked at along its curve, or along a straight
    # line in (x, phi)
    path: str
    length: float  # [m]
    # what presses least in the quasistatic motion with the best internal force; None if left out
    slow: Weakest | None = None
    # stretches where the quasistatic motion keeps every contact
    kept: tuple[tuple[Place, Place], ...] = ()
    survivals: tuple[Survival, ...] = ()
    torques: QuasistaticTorques | None = None  # none where torques do not balance everywhere
    curves: Curves | None = None

    derived = ("is_kept",)

    @property
    def is_kept(self) -> bool:
        """Whether the quasistatic motion keeps every contact all along."""
        return len(self.kept) == 1 and self.kept[0][1].s - self.kept[0][0].s >= self.length


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Result):
    """What is predicted of a problem."""

    name: str
    epsilon: float  # [N]
    phases: tuple[PhasePrediction, ...]

    @property
    def document(self) -> Document:
        """Tables of quasistatic motions, and of the speeds at which they break."""
        bad = [phase.number for phase in self.phases if phase.slow and not phase.is_kept]
        verdict = "keeps every contact"
        if bad:
            verdict += f" but in phase{'s' * (len(bad) > 1)} {', '.join(map(str, bad))}"
        head = f"a quasistatic motion, epsilon = {self.epsilon:g} N, {verdict}"
        if all(phase.path == "left out" for phase in self.phases):
            head = "no phase has one or two freedoms"
        return Document(self.name, reason=head, parts=[self._list_slow(), self._list_speeds()])

    def _list_slow(self) -> Table:
        known = [abs(phase.slow.force) for phase in self.phases if phase.slow and phase.slow.force]
        rows, form = list[tuple[object, ...]](), fixed(self.epsilon or 1e-3 * max(known, default=0))
        for phase in self.phases:
            row = phase.number, phase.until, phase.path
            if phase.slow is None:
                rows.append((*row, None, None, "-", "-", "has not one or two freedoms"))
                continue
            parts = "; ".join(f"{a.to_text()} to {b.to_text()}" for a, b in phase.kept)
            kept, slow = "all along" if phase.is_kept else parts or "nowhere", phase.slow
            rows.append((*row, phase.length, slow.force, slow.name, slow.place.to_text(), kept))
        heads = ["phase:d", "until", "along", "length [m]:.4g", f"least c_n [N]:+{form}"]
        return Table([*heads, "of", "at", "kept"], rows)

    def _list_speeds(self) -> Table:
        rows = []
        for phase, survival in ((p, own) for p in self.phases for own in p.survivals):
            ends = survival.speed, survival.lost
            speed, lost = ("any speed" if v is None else f"{v:.4g}" for v in ends)
            if survival.again is not None:
                speed = f"0; from {survival.again:.4g} on"
            first = f"{survival.first.name} at {survival.first.place.to_text()}"
            first = "nothing gives way" if survival.speed is None else first
            rows.append((phase.number, survival.motion, speed, survival.duration, lost, first))
        heads = ["phase:d", "motion", "keeps epsilon to [m/s]:.4g", "lasting [s]:.4g"]
        return Table([*heads, "contacts to [m/s]:.4g", "first"], rows)
