"""What changes as other contact modes are taken, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..simulation.events import EventKind
from .contact_problem import APART, BACK, FORTH, STICKS
from .state import CLOSED, Run
from .stepper import Modes
from .system import System


class Standing(Protocol):
    """Closed pairs, and which of them and of the joints stand still."""

    closed: tuple[int, ...]
    standing: NDArray[np.int64]
    joints: NDArray[np.int64]


def _name(system: System, joint: int) -> str:
    known = joint in system.driven
    return f"joint {system.driven.index(joint) + 1}" if known else f"coordinate {joint + 1}"


def tell_changes(run: Run, closed: Sequence[int], modes: Modes, rests: bool) -> None:
    """Record what changes."""
    if rests and run.resting:
        # Other forces that hold the same rest are no event.
        return
    system, before = run.system, run.modes
    names = system.names
    gone = [pair for pair in before.kept if pair not in modes.kept]
    new = [pair for pair in modes.kept if pair not in before.kept]
    gaps, ranges = system.look(run.z) if gone else np.zeros((2, 0))
    near = CLOSED * system.scales.length
    for pair in gone:
        # What still touches, at the end of its range, is a neighbour's from there on.
        heirs = [p for p in new if names[p][-1:] == names[pair][-1:]]
        if heirs and abs(gaps[pair]) < near and ranges[pair] < near:
            text = f"{names[pair]} goes on as {names[heirs[0]]}"
            run.note(EventKind.PASS, text, names[heirs[0]])
            new.remove(heirs[0])
        elif pair not in closed or run.records:
            run.note(EventKind.CONTACT_LOST, f"{names[pair]} is lost", names[pair])
    for pair in new if run.records else ():
        run.note(EventKind.GAINED, f"{names[pair]} presses", names[pair])
    for pair in modes.kept:
        if pair not in before.kept or not run.records:
            continue
        old = before.Xi[before.kept.index(pair)]
        now = modes.Xi[modes.kept.index(pair)]
        _tell_change(run, names[pair], old, now, "slides", system.friction[pair] > 0)
    for joint in np.flatnonzero(system.dry > 0) if run.records else ():
        old, now = before.sigma[joint], modes.sigma[joint]
        _tell_change(run, _name(system, int(joint)), old, now, "turns", True)
    if rests:
        run.note(EventKind.REST, "everything rests")
    elif run.resting:
        run.note(EventKind.START, "the motion begins")


def _tell_change(run: Run, name: str, old: float, now: float, verb: str, rubs: bool) -> None:
    if old == now or not rubs:
        return
    contact = verb == "slides"
    if now == 0:
        text = f"{name} sticks" if contact else f"friction holds {name}"
        run.note(EventKind.STICK, text, name)
    elif old == 0:
        text = f"{name} slips" if contact else f"{name} starts to turn"
        run.note(EventKind.SLIP, text, name)
    else:
        run.note(EventKind.REVERSAL, f"{name} {verb} the other way", name)


def tell_ambiguity(run: Run, pattern: Standing, answers: Sequence[Sequence[int]]) -> None:
    """Record that there are several answers, once for each set of contacts."""
    names = [run.system.names[pair] for pair in pattern.closed]
    words = {APART: "parts", STICKS: "presses", FORTH: "slides +", BACK: "slides -"}
    standing = set(pattern.standing.tolist())
    texts = []
    for answer in answers:
        parts = [
            f"{name} {'sticks' if mode == STICKS and k in standing else words[mode]}"
            for k, (name, mode) in enumerate(zip(names, answer, strict=False))
            if any(other[k] != mode for other in answers)
        ]
        parts += [
            f"{_name(run.system, int(joint))} "
            f"{ {STICKS: 'is held', FORTH: 'turns +', BACK: 'turns -'}[mode] }"
            for joint, mode in zip(pattern.joints, answer[len(names) :], strict=True)
        ]
        texts.append(", ".join(parts) or "the rest accelerates otherwise")
    text = f"{len(answers)} motions are possible with {', '.join(names) or 'no contact'} closed ("
    text += "; or ".join(texts) + ")"
    last = [event for event in run.events if event.kind is EventKind.AMBIGUOUS]
    if not last or last[-1].text.split(" at t =")[0] != text:
        run.note(EventKind.AMBIGUOUS, text, " ".join(names))
