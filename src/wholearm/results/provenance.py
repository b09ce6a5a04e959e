"""Provenance of plans and policies: differences of the problem that they were made for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ..common.errors import InputError
from ..common.journal import Difference, describe_differences, find_differences
from ..problem.definition import Problem

_FREE = (".name", ".epsilon", ".settle_gap", ".uncertainty", ".goal", "settle")
"""Keys of a problem in which its plans may differ from it; those with a dot at the top only."""
_OTHER_HAND = 0.1
"""Change of a link, over its length, from which on it is another hand: no error of measurement."""


def require_made_for(problem: Problem, meta: Mapping[str, Any]) -> None:
    """Check that the plan with this `meta` was made for a problem.

    Raises
    ------
    InputError  if it was not, by the first key that differs, or does not say what it was made for
    """
    own = meta.get("problem")
    if not isinstance(own, Mapping):
        raise InputError("", "meta.problem", "the trajectory does not hold its problem's tables")
    found = next(_find(own, problem), None)
    if found is not None:
        text = f"{found.one} in the trajectory, {found.other} in the problem"
        raise InputError("", found.key, f"{text}; it is one of another problem")


def describe_origin(problem: Problem, meta: Mapping[str, Any], what: str = "plan") -> str:
    """What differs from the problem that a plan or a policy was made for, in one line.

    Parameters
    ----------
    problem  what it is used for
    meta     with the tables of its own `problem`. Without them there is nothing to say.

    Returns
    -------
    str  empty if nothing does

    Raises
    ------
    InputError  if it makes no sense for the problem: the object has other vertices, by number, or
                the hand is another one, a base or a length being off by more than a tenth of the
                link
    """
    own = meta.get("problem")
    if not isinstance(own, Mapping):
        return ""
    for found in _find(own, problem):
        _require_sense(found, problem, what)
    text = describe_differences(_find(own, problem), f"in the {what}", "here")
    return f"made for another problem: {text}" if text else ""


def _find(own: Mapping[str, Any], problem: Problem) -> Iterator[Difference]:
    # Phases take the place of goals in plans.
    free = (*_FREE, ".phases") if "goal" in problem.table else _FREE
    return find_differences(own, problem.table, free)


def _require_sense(found: Difference, problem: Problem, what: str) -> None:
    other = ""
    if found.key == "object.vertices":
        other = "its contacts are those of another polygon"
    for finger in problem.scene.fingers:
        if found.key.startswith((f"{finger.name}.base", f"{finger.name}.length")):
            try:
                change = abs(float(found.one) - float(found.other))
            except ValueError:
                continue
            if change > _OTHER_HAND * finger.length:
                other = "it is one of another hand"
    if other:
        text = f"{found.one} in the {what}, {found.other} here; {other}"
        raise InputError("", found.key, text)
