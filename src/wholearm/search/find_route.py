"""Plans to goals: search over the roadmap, planning of routes, and lower bounds.

If no route exists, single parameters of the problem are varied to find a change that opens one.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import sys
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ..common.document import Document, Result, Table
from ..common.errors import Change, InfeasibleError, InputError, SolverError, name_source
from ..common.fields import Range
from ..common.files import digest_package, make_folder, write_whole
from ..common.sharing import exclusive
from ..common.signals import OutOfTime, Reporter, interrupt_at_beat, interruptible, limit_time
from ..geometry.tracing import END_TOL
from ..planning.options import Objective, PlanOptions
from ..planning.result import Plan
from ..problem.definition import Problem
from ..problem.read import name_goal
from ..problem.table import DIGITS, describe_phase, describe_scene, write_toml
from .astar import CAUTIOUS, BorderBound, Route, RoutePlanner, RouteSearch
from .cuts import describe_block, describe_border, explain_block, find_opening
from .edge_plans import coarsen
from .edges import BlockedEdge
from .places import is_at, make_place, require_reach
from .roadmap import MAX_BORDERS, Roadmap

MAX_BYTES = 200_000_000  # largest size of a stored roadmap [byte]
ROADMAPS = 4  # number of roadmaps kept in memory
_roadmaps: OrderedDict[object, Roadmap] = OrderedDict()


@exclusive
def find_route(
    problem: Problem,
    objective: str = "time",
    *,
    alternatives: int = 0,
    progress: Callable[[str], None] | None = None,
    cache: str | Path | None = None,
    jobs: int = 1,
    time_limit: float | None = None,
    hurry: Callable[[], None] | None = None,
    **options: Any,
) -> Answer:
    """Find the contact formations that lead from a problem's start to its goals, and a plan.

    Parameters
    ----------
    problem : Problem
        With goals.
    objective : {"time", "effort", "margin"}
        Objective of the plans; the search for routes minimizes time.
    alternatives : int
        Number of further routes that are planned; they differ in formations or stops.
    progress : callable, optional
        Called with short messages about the current step.
    cache : path-like, optional
        Folder in which the roadmap of the scene is stored, for other processes. Its files are
        pickles: nobody else may have write access.
    jobs : int
        Largest number of processes; child processes are forked. The result does not depend on it.
    time_limit : float, optional, [s]
        Time limit of the search; at the limit the best route so far is returned.
    hurry : callable, optional
        With it an interrupt ends only the search: the best route so far is returned, or planned if
        it has no plan; `hurry` is called before. Without it KeyboardInterrupt is raised.
    **options
        Options of `wholearm.solve`.

    Raises
    ------
    InputError       if the problem has no goals, one is out of reach, or an option out of its range
    InfeasibleError  if no route leads to a goal; names the blocked borders
    SolverError      if there is no plan at the time limit; names the missing part
    """
    for name, number, low in (("jobs", jobs, 1), ("alternatives", alternatives, 0)):
        Range(low, 256).read(number, name)
    settings = PlanOptions(objective=objective, **options)
    with interruptible(), limit_time(time_limit):
        report = Reporter(progress)
        if not problem.goals:
            reason = "is missing; allowed is flush or phi_deg, and x"
            raise InputError(problem.source, "goal", reason)
        if cache is not None:
            make_folder(str(cache), "cache")
        key, roadmap = get_roadmap(problem, settings, cache)
        answers, start, elapsed = list[Answer](), problem.start, 0.0
        for index, entry in enumerate(problem.goals):
            goal = entry.with_edge(problem.scene, END_TOL)
            place = make_place(problem.scene, start)
            if is_at(place, goal):
                reason = f"{goal} holds already where the motion starts"
                raise InputError(problem.source, name_goal(problem.goals, index), reason)
            with name_source(problem.source, f"{name_goal(problem.goals, index)}."):
                require_reach(problem.scene, goal, float(start[2]))
            search, prior = RouteSearch(roadmap, place, goal), answers[-1].plan if answers else None
            n_plans = 1 + (alternatives if index + 1 == len(problem.goals) else 0)
            planner = RoutePlanner(
                problem, prior, search, settings, report, n_plans, jobs, time_before=elapsed
            )
            answers.append(_plan_to_goal(planner, hurry))
            start, elapsed = answers[-1].route.stop.z, planner.estimate(answers[-1].route)
        if cache is not None:
            try:
                store_roadmap(Path(cache), key, roadmap)
            except InputError as error:
                # The result is valid without the stored roadmap.
                warnings.warn(str(error), stacklevel=2)
        return answers[-1]


def get_roadmap(
    problem: Problem, options: PlanOptions, cache: str | Path | None
) -> tuple[str, Roadmap]:
    """Key and roadmap of a problem's scene: from memory, from a folder, or a new one.

    The key is JSON of all that the roadmap depends on: scene, epsilon, options of coarse plans.
    """
    numbers = problem.epsilon, repr(coarsen(options))
    key = json.dumps(describe_scene(problem.scene) | {"": numbers}, sort_keys=True)
    roadmap = _roadmaps.pop(key, None)
    if roadmap is None and cache is not None:
        roadmap = load_roadmap(Path(cache), key)
    _roadmaps[key] = roadmap = roadmap or Roadmap(problem, options.uniqueness_margin)
    while len(_roadmaps) > ROADMAPS:
        _roadmaps.popitem(last=False)
    return key, roadmap


def forget_roadmaps() -> None:
    """Empty the memory of roadmaps."""
    _roadmaps.clear()


def _plan_to_goal(planner: RoutePlanner, hurry: Callable[[], None] | None) -> Answer:
    """Plan routes to one goal, with a lower bound of the best one."""
    start, complete, search, plans = time.process_time(), False, planner.search, planner.plans
    try:
        with interrupt_at_beat():
            planner.report("looking for routes")
            planner.run()
        complete = True
    except OutOfTime:
        if not plans:
            text = f"the time limit is over, and there is no plan yet: {len(search.reached)} places"
            text += " looked at"
            if planner.routes:
                best = min(planner.routes, key=planner.estimate)
                count = sum(len(edge.steps) for edge in best.edges)
                duration = planner.estimate(best)
                text += f", a route of {count} phases found, of about {duration:.3g} s"
            raise SolverError(f"{text}; what it was at: {planner.report.last}") from None
    except KeyboardInterrupt:
        if hurry is None or not (plans or planner.routes):
            raise
        if not plans:
            hurry()
            planner.first_only, planner.n_plans = True, 1
            planner.plan()
    except np.linalg.LinAlgError:
        # The contacts at a reached place are linearly dependent.
        if not plans:
            planner.n_plans = 1
            planner.plan()
    if not plans:
        raise _explain(planner, time.process_time() - start, hurry)
    sign = -1 if planner.options.goal is Objective.MARGIN else 1
    plans.sort(key=lambda pair: sign * pair[0].value)
    plan, route = plans[0]
    bound = None
    if complete and not planner.previous:
        complete = False
        with _limit_interrupt(hurry):
            bound = planner.bound(plan.duration, route.in_cells)
            complete = True
    others = tuple(Alternative(other) for other, _ in plans[1 : planner.n_plans])
    failures, blocked = tuple(planner.failures), tuple(search.blocked)
    return Answer(plan, route, bound, others, failures, blocked, len(search.reached), complete)


@contextmanager
def _limit_interrupt(hurry: Callable[[], None] | None) -> Iterator[None]:
    """Context that a time limit or (with `hurry`) an interrupt ends, without raising it."""
    try:
        with interrupt_at_beat():
            yield
    except KeyboardInterrupt as error:
        if hurry is None and not isinstance(error, OutOfTime):
            raise


def _explain(
    planner: RoutePlanner, seconds: float, hurry: Callable[[], None] | None
) -> InfeasibleError:
    """Error of a goal without a route, after a search of `seconds` of processor time."""
    search, opening, changes, text = planner.search, "", tuple[Change, ...](), ""
    with _limit_interrupt(hurry):
        opening, changes = find_opening(planner, seconds)
        explain = partial(explain_block, planner.problem, planner.options)
        text = describe_block(search, planner.failures, opening, explain)
    text = text or describe_block(search, planner.failures, opening)
    return InfeasibleError(text, changes=changes)


def load_roadmap(folder: Path, key: str) -> Roadmap | None:
    """The stored roadmap of a scene; None if there is none, or the file is damaged.

    Files are pickles, which can execute code: a folder with write access for others is not safe.
    """
    try:
        content = _name_file(folder, key).read_bytes()
        digest, body = content[:32], content[32:]
        roadmap = pickle.loads(body) if hashlib.sha256(body).digest() == digest else None
    except Exception:
        return None  # A file that cannot be read counts as missing.
    return roadmap if isinstance(roadmap, Roadmap) else None


def store_roadmap(folder: Path, key: str, roadmap: Roadmap) -> None:
    """Write the roadmap of a scene, in place of a stored one."""
    body = pickle.dumps(roadmap, pickle.HIGHEST_PROTOCOL)
    if len(body) <= MAX_BYTES:
        digest = hashlib.sha256(body).digest()
        write_whole(_name_file(folder, key), lambda stream: stream.write(digest + body))


def _name_file(folder: Path, key: str) -> Path:
    """Path of the file of a scene; it depends on versions and on the code of the package."""
    versions = f"{digest_package()} {ca.__version__} {np.__version__} {sys.version}"
    return folder / f"{hashlib.sha256(f'{versions} {key}'.encode()).hexdigest()[:32]}.chart"


NOT_CONSIDERED = (
    "not considered: rolling contacts, formations without the palm or without one of the fingers, "
    f"more than {MAX_BORDERS} borders passed without a stop, impacts out of or into cells, motions "
    "through cells that no straight way from rest shows to be possible, and what is further than "
    f"{CAUTIOUS.max_places} places; phases may be as many as it takes"
)


@dataclass(frozen=True, eq=False, repr=False)
class Alternative(Result):
    """A route with its plan."""

    plan: Plan

    @property
    def problem(self) -> Problem:
        """The problem with phases, the route, in place of its goals."""
        return self.plan.problem

    @property
    def headline(self) -> str:
        """Value, duration and number of phases, in a line."""
        return f"{self.plan.headline}, phases: {len(self.problem.phases)}"

    @property
    def document(self) -> Document:
        """The lines of `describe`, and the phases of the route."""
        rows = [
            (phase.number, ", ".join(phase.formation.names), str(phase.until), phase.end.value)
            for phase in self.problem.phases
        ]
        route = Table(["phase:d", "contacts", "until", "end"], rows)
        return Document("", parts=[*self.describe(), route])

    def describe(self) -> list[str]:
        """Phases, value and duration, in lines."""
        plan, count = self.plan, len(self.problem.phases)
        value = f"{plan.options.goal.value} = {plan.value:.6f} {plan.unit}"
        return [f"{count} phase{'s'[: count != 1]}, {value}, {plan.duration:.6f} s in all"]

    @property
    def values(self) -> dict[str, Any]:
        """The content of JSON files."""
        phases = list(self.problem.table.get("phases", []))
        return {"value": self.plan.value, "duration": self.plan.duration, "phases": phases}


@dataclass(frozen=True, eq=False, repr=False)
class Answer(Alternative):
    """The best route to the goals, with its plan."""

    route: Route  # to the last goal
    # lower bound of routes along borders; None with several goals or an interrupted search
    bound: BorderBound | None
    alternatives: tuple[Alternative, ...]
    failures: tuple[str, ...]  # why routes have no plan
    blocked: tuple[BlockedEdge, ...]  # borders that no motion can follow
    settled: int  # number of expanded places
    complete: bool  # whether the search ended without interrupt and time limit

    @property
    def gap(self) -> float | None:
        """Relative gap of the duration to the bound.

        None without a bound, for routes through cells, and for other objectives.
        """
        timed = self.plan.options.goal is Objective.TIME
        if self.bound is None or self.bound.value <= 0 or self.route.in_cells or not timed:
            return None
        return max(0.0, self.plan.duration / self.bound.value - 1.0)

    def to_text(self) -> str:
        """The route as ``[[phases]]``, with value, bound and statistics as comments."""
        lines = [f"# {line}" for line in self.describe()]
        lines += ["", format_phases(self.problem).rstrip()]
        for number, other in enumerate(self.alternatives, start=2):
            lines += [
                "",
                f"# alternative {number}: {other.describe()[0]}",
                *(f"# {line}".rstrip() for line in format_phases(other.problem).splitlines()),
            ]
        return "\n".join(lines).rstrip() + "\n"

    def describe(self) -> list[str]:
        """Value, bound and statistics of the search, in lines."""
        lines = super().describe()
        if not self.complete:
            lines.append("the search ended early: the best route so far")
        if self.bound is not None:
            text = "no route along borders, with stops or impacts, "
            # The bound is at most the duration of the plan.
            exceeded = self.route.in_cells and self.bound.value >= self.plan.duration
            text += "is faster" if exceeded else f"takes less than {self.bound.value:.6f} s"
            text += "" if self.gap is None else f": gap {100 * self.gap:.2g} %"
            ending = "" if self.bound.complete else " (the search for such routes ended early)"
            lines.append(text + ending)
        if self.route.in_cells:
            lines.append("this one leads through cells, where nothing bounds times from below")
        counts = f"places looked at: {self.settled}, ways blocked: {len(self.blocked)}"
        lines.append(f"{counts}, routes without a plan: {len(self.failures)}")
        return [*lines, NOT_CONSIDERED]

    @property
    def values(self) -> dict[str, Any]:
        """The content of JSON files."""
        return {
            **super().values,
            "unit": self.plan.unit,
            "bound": None if self.bound is None else self.bound.value,
            "gap": self.gap,
            "complete": self.complete,
            "in_cells": self.route.in_cells,
            "alternatives": [other.values for other in self.alternatives],
            "failures": list(self.failures),
            "blocked": [f"{describe_border(b)}: {b.reason}" for b in self.blocked],
            "not_considered": NOT_CONSIDERED,
        }


def format_phases(problem: Problem) -> str:
    """The phases of a problem as `[[phases]]` of a problem file."""
    return write_toml({"phases": [describe_phase(phase, DIGITS) for phase in problem.phases]})[1:]
