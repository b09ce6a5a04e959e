"""Validation of problems, from files or made of objects; messages name the key of a file."""

from __future__ import annotations

import math
from itertools import zip_longest

import numpy as np

from ..common.errors import InputError, require_number, require_vector
from ..common.fields import keys_of
from ..common.sharing import exclusive
from ..contacts.closing import name_reach
from ..contacts.contact_limits import evaluate_finger_gap
from ..contacts.formation import Formation, describe, find_touching
from ..scene.model import TURN, Scene, check_place, check_ranges
from .definition import ROWS, End, Phase, Problem
from .goal import check_goal, name_goal
from .uncertainty import spread_widths


@exclusive
def check_problem(problem: Problem) -> None:
    """Check a problem; whether each phase can be reached is not checked here.

    Raises
    ------
    InputError  for the first thing that is wrong
    """
    check_ranges(problem.scene)
    for attribute, own in keys_of(Problem).items():
        value = own.read(getattr(problem, attribute), own.name)
        own.check(value, own.name, problem.scene)
    spread_widths(problem.uncertainty or {}, "uncertainty.{}")
    check_place(problem.scene, "start.x", float(require_vector(problem.start, "start", 5)[0]))
    if problem.scene.actuator_lag.any() and problem.is_settled:
        text = "what holds an end may take all of a torque limit: with actuator_lag allowed is 0"
        raise InputError("", "settle", text)
    for index, phase in enumerate(problem.phases):
        if phase.index != index:
            text = f"has the index {phase.index}; phases count up from 0, which makes it {index}"
            raise InputError("", f"phases[{index + 1}]", text)
        _check_formation(phase.formation, f"phases[{index + 1}].contacts")
        _check_until(problem.scene, phase, f"phases[{index + 1}].until")
        key, declared = f"phases[{index + 1}].settle", keys_of(Phase)["settle"]
        declared.check(declared.read(phase.settle, key), key, problem.scene)
        if phase.settle and phase.end is End.SMOOTH:
            text = f"{phase.settle:g} given, but the phase has end = 'smooth'"
            raise InputError("", key, text)
    for phase, following in zip_longest(problem.phases, problem.phases[1:]):
        _check_end(phase, following)
    for index, goal in enumerate(problem.goals):
        key = name_goal(problem.goals, index, problem.table)
        check_goal(problem.scene, goal, key)
        if problem.phases:
            raise InputError("", key, "given with [[phases]]; allowed is one of the two")
    _check_fingers(problem)
    _check_first_formation(problem)


def require_phases(problem: Problem) -> None:
    """Check that there is something to plan or to replay: a problem for a map needs no phases.

    Raises
    ------
    InputError  if the problem has no phases
    """
    if not problem.phases:
        text = "is missing, and so is [goal], from which wholearm finds them; "
        text += "`wholearm map FILE --list X,PHI ...` lists [[phases]] along a route"
        if problem.goals:
            text = "is missing; `wholearm route FILE` finds the [[phases]] that lead to the goal"
        raise InputError(problem.source, "phases", text)


def _check_formation(formation: Formation, key: str) -> None:
    """Check that contacts are there once, and that those that roll can."""
    contacts = formation.contacts
    if not contacts:
        raise InputError("", key, "[] is not a list of contact names")
    twice = {contact.name for contact in contacts if contacts.count(contact) > 1}
    if twice:
        raise InputError("", key, f"{', '.join(sorted(twice))} is given twice")
    for row in formation.rolling_rows:
        if formation.friction[row] == 0:
            finger = contacts[row].finger
            part = "palm" if finger is None else f"finger{finger + 1}"
            text = f"{contacts[row]} cannot roll without friction, and friction.{part} is 0"
            raise InputError("", key, text)
    if formation.rolling and formation.n_constraints > 4:
        text = (
            f"{len(contacts)} contacts of which {formation.n_rolling} roll leave no freedom to "
            f"move: a rolling one counts twice, which makes {formation.n_constraints}; allowed are "
            "up to 4"
        )
        raise InputError("", key, text)


def _check_until(scene: Scene, phase: Phase, key: str) -> None:
    until = phase.until
    if until.is_release and phase.end is not End.SMOOTH:
        raise InputError("", key, "is missing; only a phase with end = 'smooth' has none")
    if until.contact is not None and until.contact in phase.formation.contacts:
        raise InputError("", key, f"{until} is already in the phase's contacts")
    ends = until.pins if until.value is None else ((until.coordinate, until.value), *until.pins)
    for coordinate, value in ends:
        check_coordinate(scene, coordinate, value, key)
    freedoms = 5 - phase.formation.n_constraints
    if len({name for name, _ in ends}) < len(ends):
        raise InputError("", key, f"{until} gives a coordinate twice")
    if freedoms > 1 and (given := len(ends) + (until.contact is not None)) > freedoms:
        text = f"{until} gives {given} conditions; allowed are {freedoms}, as the contacts leave"
        raise InputError("", key, f"{text} {freedoms} freedoms")


def check_coordinate(scene: Scene, coordinate: str, given: float, key: str) -> None:
    """Check a coordinate of the pose where a phase ends, and its value.

    Raises
    ------
    InputError  if there is no such coordinate, or its value is out of its range
    """
    if coordinate not in ROWS:
        raise InputError("", key, f"{coordinate!r} given; allowed are 'x' and 'phi'")
    value = require_number(given, key)
    if coordinate == "x":
        check_place(scene, key, value)
    else:
        # Rounding in radians is no matter at the end of the range.
        TURN.check(key, round(math.degrees(value), 9), "degrees")


def _check_end(phase: Phase, following: Phase | None) -> None:
    """Check that a phase passes into the next one as its `end` says."""
    if phase.end is End.REST:
        return
    key, until = f"phases[{phase.number}].end", phase.until
    given = f"{phase.end.value!r} given"
    if following is None:
        raise InputError("", key, f"{given}, but the last phase ends at rest")
    contacts = following.formation.contacts
    if phase.end is End.IMPACT and until.contact is None:
        raise InputError("", key, f"{given}, but until is {until}, not a contact that is gained")
    if phase.end is End.IMPACT and until.contact not in contacts:
        raise InputError("", key, f"{given}, but phase {following.number} does not have {until}")
    before = {*phase.formation.contacts, until.contact}
    extra = [c.name for c in contacts if c not in before]
    if extra:
        text = f"{given}, but phase {following.number} has {', '.join(extra)} too"
        raise InputError("", key, text)
    same = set(contacts) == set(phase.formation.contacts)
    same = same and set(following.formation.rolling) == set(phase.formation.rolling)
    if until.is_release and same:
        text = f"phase {following.number} releases no contact, and none rolls or slides anew"
        raise InputError("", key, text)


def _check_fingers(problem: Problem) -> None:
    """Check that the fingers do not overlap at the start."""
    scene = problem.scene
    if not scene.fingers_collide:
        return
    gap = float(evaluate_finger_gap(scene, problem.start[None])[0])
    if gap < -scene.touching:
        text = (
            f"{problem.start[0]:g} closes the fingers into each other: their gap is {gap:.4g} m; "
            "allowed is 0 or more, unless fingers_collide = false; "
        )
        raise InputError("", "start.x", text + name_reach(scene, float(problem.start[2])))


def _check_first_formation(problem: Problem) -> None:
    """Check that what the first phase names touches; it may let go what else does."""
    if not problem.phases:
        return
    formation, z = problem.phases[0].formation, problem.start[None]
    missed = max(np.abs(formation.evaluate(z, z).C).max(), -formation.evaluate_limits(z).min())
    if missed < problem.scene.touching:
        return
    # Only what a message may need looks at every other contact.
    touching = find_touching(problem.scene, problem.start)
    first = formation.contacts
    if not set(first) <= set(touching):
        text = f"{describe(first)} given, but the closed fingers touch {describe(touching)}"
        raise InputError("", "phases[1].contacts", text)
