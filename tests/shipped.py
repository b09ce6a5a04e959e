"""The problem files, their plans with every other option at its default, and a map, each once."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from once import once
from wholearm import FormationMap, Plan, Problem, Report, Trajectory, build_map, load, verify
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.plan import solve

FOLDER = Path(__file__).parents[1] / "problems"
HEPTAGON = FOLDER / "heptagon_four_contacts.toml"
"""Five phases along curves, joined at rest."""
IMPACTS = FOLDER / "heptagon_impact.toml"
"""The same with rough fingers, joined by impacts."""
LANDING = FOLDER / "heptagon.toml"
"""A slide, a flip and a landing; its last two phases are joined smoothly."""
HEXAGON = FOLDER / "hexagon.toml"
SQUARE = FOLDER / "square.toml"
"""Its links lie so low that a hundredth of a torque is much of a normal force."""
BOX = FOLDER / "box_rolling.toml"
"""A box that tips over a vertex that rolls."""


Edit = Callable[[dict[str, Any]], object]
"""A change of the tables of a problem file."""


@cache
def problem_of(path: Path) -> Problem:
    return load(str(path))


def part_of(problem: Problem, first: int, stop: int | None = None) -> Problem:
    """Phases `first` to `stop` of a problem, counted from 0, as a problem of their own."""
    phases = tuple(replace(phase, index=k) for k, phase in enumerate(problem.phases[first:stop]))
    start = trace_phases(problem)[first - 1].end if first else problem.start
    return replace(problem, start=start, phases=phases)


def text_of(path: Path = HEPTAGON, phases: int = 1) -> str:
    """A problem file with its first phases alone."""
    return "[[phases]]".join(path.read_text(encoding="utf-8").split("[[phases]]")[: phases + 1])


def table_of(path: Path = HEPTAGON) -> dict[str, Any]:
    """The tables of a problem file without its phases."""
    return tomllib.loads(text_of(path, 0))


def put(path: str, value: object) -> Edit:
    """An edit that sets a dotted key; numbers index lists."""

    def edit(table: Any) -> None:
        *parents, last = path.split(".")
        for key in parents:
            table = table[int(key)] if isinstance(table, list) else table[key]
        table[int(last) if isinstance(table, list) else last] = value

    return edit


def box_text() -> str:
    """The problem of the README: one slide of a box."""
    text = (FOLDER.parent / "README.md").read_text(encoding="utf-8")
    return text.split("```toml\n")[1].split("```")[0]


@once
def solved(path: Path, objective: str = "time") -> Plan:
    return solve(problem_of(path), objective)


@once
def chart() -> FormationMap:
    return build_map(problem_of(HEPTAGON), 60)


def plan_of(path: Path, objective: str = "time") -> Trajectory:
    return solved(path, objective).trajectory


@once
def verified(path: Path, objective: str = "time") -> Report:
    """The replay of a plan."""
    return verify(problem_of(path), plan_of(path, objective))


@cache
def tipping(degrees: float = 9.5) -> Problem:
    """The heptagon tips over its left vertex; to do so, it has to slide."""
    contacts = ["v0-palm", "v2-finger1", "v5-finger2"]
    phase = {"contacts": contacts, "until": {"phi_deg": degrees}}
    return problem_of(HEPTAGON).with_({"phases": [phase]})
