"""Goals of a problem: poses at rest that the object is to reach, in place of phases."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..common.errors import InputError, require_number
from ..common.fields import NUMBER, declare, key, leave
from ..scene.model import PLACE, TURN, Scene, check_place

INDEX = leave({"type": "integer", "minimum": 0})  # number of an edge
_ALLOWED = "allowed is a table with flush or phi_deg, and x"


@declare(
    key("flush", "The edge that shall lie on the palm.", INDEX),
    key(
        "phi_deg",
        "The angle that the object shall have instead [degrees].",
        *(NUMBER, "", TURN),
        attribute="phi",
    ),
    key("x", "Of the centroid [m]; anywhere if it is left out.", NUMBER, "length", PLACE),
)
@dataclass(frozen=True)
class Goal:
    """Where the object shall come to rest: with an edge on the palm or at an angle, phi [rad]."""

    flush: int | None = None
    phi: float | None = None
    x: float | None = None

    def __str__(self) -> str:
        if self.flush is not None:
            text = f"edge {self.flush} on the palm"
        else:
            text = f"phi = {math.degrees(self.phi or 0.0):g} deg"
        return text if self.x is None else f"{text} at x = {self.x:g} m"

    def find_angle(self, scene: Scene, near: float) -> float:
        """The angle that the object shall have [rad], of all turns the nearest to one."""
        if self.flush is None:
            assert self.phi is not None
            return self.phi
        angle = scene.polygon.flush_angle(self.flush)
        return angle + 2 * math.pi * round((near - angle) / (2 * math.pi))

    def to_table(self) -> dict[str, Any]:
        """The goal as the table of a problem file."""
        pose = {"flush": self.flush} if self.phi is None else {"phi_deg": math.degrees(self.phi)}
        return {**pose, **({} if self.x is None else {"x": self.x})}


def check_goal(scene: Scene, goal: Goal, key: str) -> None:
    """Check a goal; `key` is where it stands in a file.

    Raises
    ------
    InputError  if it is not one
    """
    if (goal.flush is None) == (goal.phi is None):
        both = "flush and phi_deg are both" if goal.phi is not None else "neither flush nor phi_deg"
        raise InputError("", key, f"{both} given; allowed is one of the two")
    count = scene.polygon.n_vertices
    if goal.phi is not None:
        TURN.check(f"{key}.phi_deg", round(math.degrees(goal.phi), 9), "degrees")
    elif not isinstance(goal.flush, int) or isinstance(goal.flush, bool):
        raise InputError("", f"{key}.flush", f"{goal.flush!r} is not an edge; allowed are integers")
    elif not 0 <= goal.flush < count:
        text = f"{goal.flush!r} is not an edge; allowed are 0 to {count - 1}"
        raise InputError("", f"{key}.flush", text)
    if goal.x is not None:
        check_place(scene, f"{key}.x", goal.x)


def read_goals(table: Mapping[str, Any]) -> tuple[Goal, ...]:
    """The goals of a problem file, in the order in which they are visited.

    Raises
    ------
    InputError  if what is given is neither a table nor a list of tables, or a key is unknown
    """
    given = table.get("goal", [])
    several = isinstance(given, list)
    return tuple(
        _read_goal(entry, f"goal[{index}]" if several else "goal")
        for index, entry in enumerate(given if several else [given], start=1)
    )


def name_goal(goals: tuple[Goal, ...], index: int, table: Mapping[str, Any]) -> str:
    """The key of a goal, by its index from 0, as its file has it."""
    alone = len(goals) == 1 and not isinstance(table.get("goal"), list)
    return "goal" if alone else f"goal[{index + 1}]"


def match_goals(goals: tuple[Goal, ...], table: Mapping[str, Any]) -> Any:
    """What a table has to say of goals, the same as it says already where that is them."""
    given = table.get("goal")
    try:
        if given is not None and read_goals(table) == goals:
            return given
    except InputError:
        pass
    written = [goal.to_table() for goal in goals]
    return written[0] if len(written) == 1 else written


def _read_goal(entry: object, key: str) -> Goal:
    if not isinstance(entry, Mapping):
        raise InputError("", key, f"{entry!r} given; {_ALLOWED}")
    for name in entry:
        if name not in ("flush", "phi_deg", "x"):
            raise InputError("", f"{key}.{name}", f"unknown key; {_ALLOWED}")
    phi, x = entry.get("phi_deg"), entry.get("x")
    return Goal(
        entry.get("flush"),
        None if phi is None else math.radians(require_number(phi, f"{key}.phi_deg")),
        None if x is None else require_number(x, f"{key}.x"),
    )
