"""Contact modes of stages: sliding directions, rotation of joints, rolling; splitting and merging.

Where the modes of successive stages differ, rates are zero in between (`link`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...contacts.elemental import Contact
from ...contacts.formation import Formation
from ...mechanics.dynamics import Directions, split_forces
from ...scene.model import Scene
from .collocation import Scheme
from .stage import Stage, StagePoints
from .stage_kernels import new_rows
from .time_mesh import resample

LEAST_INTERVALS = 3  # fewest intervals of a stage


class StageMode(NamedTuple):
    """Contact mode of a stage."""

    signs: tuple[float, ...]  # of the rates of (contacts, joints); zero for rolling contacts

    def changed(self, rows: Sequence[int], sign: float) -> StageMode:
        """The mode with another sign of tied rows, given for the first of them."""
        turn = sign * self.signs[rows[0]]
        return StageMode(
            tuple((turn * s or sign) if k in rows else s for k, s in enumerate(self.signs))
        )


def mode_of(stage: Stage) -> StageMode:
    """The mode of a stage."""
    signs = np.concatenate(stage.directions)
    signs[list(stage.formation.rolling_rows)] = 0.0
    return StageMode(tuple(signs.tolist()))


def sign_sequence(stages: Sequence[Stage]) -> tuple[tuple[int, StageMode], ...]:
    """Phase and mode of each stage."""
    return tuple((stage.phase, mode_of(stage)) for stage in stages)


@lru_cache(maxsize=64)
def _roll(scene: Scene, contacts: tuple[Contact, ...], rows: tuple[int, ...]) -> Formation:
    """The formation with rolling contacts."""
    return Formation(scene, contacts, tuple(contacts[k] for k in rows))


def in_mode(stage: Stage, mode: StageMode) -> Stage:
    """A stage in another mode, with its tangential forces."""
    if mode == mode_of(stage):
        return stage
    formation, part = stage.formation, stage.guess
    n_c = formation.n_contacts
    signs = np.array(mode.signs)
    rows = tuple(k for k in range(n_c) if signs[k] == 0)
    directions = Directions(np.where(signs[:n_c] == 0, 1.0, signs[:n_c]), signs[n_c:])
    if rows != formation.rolling_rows:
        c_n, c_t = split_forces(formation, part.forces, stage.directions.Xi)
        part = part._replace(forces=np.concatenate([c_n, c_t[..., list(rows)]], axis=-1))
        formation = _roll(formation.scene, formation.contacts, rows)
    return replace(stage, formation=formation, directions=directions, guess=part)


def link(stages: Sequence[Stage]) -> list[Stage]:
    """Stages with ends that follow from their modes."""
    linked = list[Stage]()
    for stage, coming in zip(stages, [*stages[1:], None], strict=True):
        turns: tuple[int, ...] = ()
        gained, fading = None, tuple[tuple[int, float], ...]()
        growing = find_fresh(linked[-1], stage) if linked and not linked[-1].ends_in_impact else ()
        if coming is not None and not stage.ends_in_impact:
            turns, fading = find_turns(stage, coming), find_passing(stage, coming)
            fresh = new_rows(stage.formation, coming.formation)
            gained = coming.formation if fresh else None
        linked.append(replace(stage, gained=gained, growing=growing, fading=fading, turns=turns))
    return linked


def find_turns(stage: Stage, coming: Stage) -> tuple[int, ...]:
    """Rows of (contacts, joints) of a stage that reverse in the next one."""
    joints = ("joint 1", "joint 2")
    after = dict(zip((*coming.formation.names, *joints), mode_of(coming).signs, strict=True))
    rows = enumerate(zip((*stage.formation.names, *joints), mode_of(stage).signs, strict=True))
    return tuple(k for k, (name, sign) in rows if sign * after.get(name, 0.0) < 0)


def find_passing(stage: Stage, coming: Stage) -> tuple[tuple[int, float], ...]:
    """`Stage.fading`: contacts that the next stage releases, with 0, or lets slide, with a sign."""
    formation, passing = stage.formation, list[tuple[int, float]]()
    for k, contact in enumerate(formation.contacts):
        if contact not in coming.formation.contacts:
            passing.append((k, 0.0))
        elif contact in formation.rolling and contact not in coming.formation.rolling:
            row = coming.formation.contacts.index(contact)
            passing.append((k, float(coming.directions.Xi[row])))
    return tuple(passing)


def find_fresh(stage: Stage, coming: Stage) -> tuple[int, ...]:
    """Contacts of the coming stage that a stage does not have."""
    known = stage.formation.contacts
    return tuple(k for k, c in enumerate(coming.formation.contacts) if c not in known)


def split(stage: Stage, scheme: Scheme, begin: int, stop: int, mode: StageMode) -> list[Stage]:
    """Pieces of a stage with intervals `begin` to `stop` in another mode, to be linked."""
    own = mode_of(stage)
    pieces: list[Stage] = []
    for first, last, signs in ((0, begin, own), (begin, stop, mode), (stop, stage.intervals, own)):
        if last > first:
            guess = _cut(stage.guess, scheme, first, last)
            opens = stage.opens and not pieces
            piece = replace(stage, guess=guess, until=None, ends_in_impact=False, opens=opens)
            pieces.append(in_mode(piece, signs))
    pieces[-1] = replace(pieces[-1], until=stage.until, ends_in_impact=stage.ends_in_impact)
    return pieces


def merge(stages: Sequence[Stage]) -> list[Stage]:
    """Stages with successive ones of the same mode and phase merged."""
    merged: list[Stage] = [stages[0]]
    for stage in stages[1:]:
        before = merged[-1]
        if (before.phase, mode_of(before)) != (stage.phase, mode_of(stage)):
            merged.append(stage)
            continue
        monitored = tuple(sorted({*before.monitored, *stage.monitored}))
        guess = _join(before.guess, stage.guess)
        merged[-1] = replace(stage, guess=guess, opens=before.opens, monitored=monitored)
    return merged


def release_earlier(stages: Sequence[Stage], index: int) -> list[Stage] | None:
    """Stages with the last, but not only, one of a phase that ends by a release in the next phase.

    None if that cannot be; with continuous torques it gains nothing.
    """
    stage = stages[index]
    if stage.formation.scene.has_slow_motors:
        return None
    coming = stages[index + 1] if index + 1 < len(stages) else None
    before = stages[index - 1] if index else None
    if coming is None or before is None or before.phase != stage.phase:
        return None
    if coming.phase == stage.phase or not coming.opens or stage.until is not None:
        return None
    names = stage.formation.names
    if not set(coming.formation.names) < set(names) or coming.formation.rolling:
        return None
    rows = [names.index(name) for name in coming.formation.names]
    Xi, sigma = stage.directions
    guess = stage.guess._replace(forces=stage.guess.forces[..., rows])
    directions = Directions(Xi[rows], sigma)
    moved = replace(coming, directions=directions, guess=guess, until=None, ends_in_impact=False)
    return [*stages[:index], moved, replace(coming, opens=False), *stages[index + 2 :]]


def drop(stages: Sequence[Stage], index: int) -> list[Stage] | None:
    """Stages without one of them, or None if it is all that its phase has."""
    stage = stages[index]
    others = [k for k, other in enumerate(stages) if other.phase == stage.phase and k != index]
    if not others:
        return None
    left = list(stages)
    if stage.opens:
        left[index + 1] = replace(stages[index + 1], opens=True)
    if index > 0 and (index - 1 in others) and (index + 1 not in others):
        # The stage before ends the phase.
        before = stages[index - 1]
        guess = before.guess._replace(impulses=stage.guess.impulses)
        ends = stage.ends_in_impact
        left[index - 1] = replace(before, guess=guess, until=stage.until, ends_in_impact=ends)
    del left[index]
    return left


def _join(first: StagePoints, second: StagePoints) -> StagePoints:
    """Two successive parts of one stage as one."""
    total = first.duration + second.duration
    fractions = [part.fractions * (part.duration / total) for part in (first, second)]
    nodes = np.concatenate([first.nodes[:-1], second.nodes])
    pairs = zip(first[3:8], second[3:8], strict=True)
    z, v, a, forces, tau = (np.concatenate(pair) for pair in pairs)
    shares = np.concatenate(fractions)
    return StagePoints(total, shares, nodes, z, v, a, forces, tau, second.impulses)


def _cut(part: StagePoints, scheme: Scheme, begin: int, stop: int) -> StagePoints:
    """Intervals `begin` to `stop`, on at least the least number of them."""
    breaks = part.breaks[begin : stop + 1]
    shares = (breaks - breaks[0]) / (breaks[-1] - breaks[0])
    while len(shares) - 1 < LEAST_INTERVALS:
        shares = np.sort(np.append(shares, (shares[1:] + shares[:-1]) / 2))
    return resample(part, scheme, shares, float(breaks[0]), float(breaks[-1]))
