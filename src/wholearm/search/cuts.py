"""Cut of the roadmap between reached places and goal, and changes of single numbers that open it.

Limits of the hand, friction and epsilon do not change the geometry: the curve of a border is kept.
The smallest opening change is bracketed by bisection. If no such number leads to the goal, other
lengths and bases of the fingers are tried by new searches.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import Change, InfeasibleError, InputError, Parameter, WholearmError
from ..common.signals import OutOfTime, Reporter
from ..contacts.closing import close_fingers
from ..contacts.formation import Formation, describe
from ..mechanics.limits import EPSILON, make_limits
from ..planning.explain import change_curve, find_changes, list_frictions, unadvised
from ..planning.options import PlanOptions
from ..planning.plan import solve_with
from ..problem.definition import Phase, Problem
from ..scene.model import Scene
from .astar import EAGER, Route, RoutePlanner, RouteSearch
from .edge_plans import coarsen
from .edges import DEPENDENT, Blocked, Chain, Edge, describe_steps, point_out
from .places import make_place, require_reach
from .roadmap import Roadmap

CUT = 16  # Most borders that are looked at with other numbers, those nearest to the goal
FARTHEST = 10.0  # Most times that a number is made larger or smaller; friction may go to zero
TRIED = 3  # Most numbers with which the goal is looked for
NEARBY = 30  # Most places that are looked at beyond borders that a number opens
SYMMETRIC = 1e-9  # Relative difference of lengths and bases up to which the hand is symmetric
HANDS = (1.05, 0.95, 1.1, 0.9, 1.2, 0.8)
"""Lengths of fingers and distances of their bases that are tried, relative to the problem's."""
TIMES, AT_LEAST = 4.0, 20.0
"""Limit of processor time for other hands: over that of the search, and at least [s]."""
LISTED, FAILED = 2, 1  # most reasons in a message, and most of routes without a plan


class Opening(NamedTuple):
    """Values of a number that open borders."""

    parameter: Parameter
    values: dict[int, float]  # by the border's number, of those that it opens

    def open_all(self, among: Collection[int]) -> Change:
        """The least change that opens all borders of some that the number can open."""
        values = [value for k, value in self.values.items() if k in among]
        return Change(self.parameter, max(values) if self.parameter.sign > 0 else min(values))


def list_cut(search: RouteSearch) -> list[Blocked]:
    """Blocked borders out of the reached places, the nearest to the goal first.

    Every route along borders takes one of them.
    """
    cut = {
        (blocked.start.key, blocked.steps): blocked
        for blocked in search.blocked
        if blocked.stop.key not in search.reached
    }

    def rank(blocked: Blocked) -> tuple[float, ...]:
        # Along a flush edge nothing turns but by rounding, and x says which end is nearer.
        turns = (round(search.measure(place), 9) for place in (blocked.stop, blocked.start))
        x = search.goal.x
        return *turns, 0.0 if x is None else abs(float(blocked.stop.z[0]) - x)

    return sorted(cut.values(), key=rank)


def list_openings(cuts: Sequence[Blocked]) -> list[Opening]:
    """Numbers that open some border, ordered by the nearest border that they open."""
    by_key = dict[str, Opening]()
    for index, cut in enumerate(cuts):
        formation, epsilon = cut.border.formation, cut.border.epsilon
        for number in (*make_limits(formation, epsilon).parameters, *list_frictions(formation)):
            friction = number.key.startswith("friction")
            tried = number.value, 0.0 if friction else number.value * FARTHEST**number.sign

            def opens(number: Parameter, value: float, cut: Blocked = cut) -> bool:
                return isinstance(edge_changed(cut, Change(number, value)), Edge)

            for change in find_changes([number], {number: tried}.__getitem__, opens):
                by_key.setdefault(number.key, Opening(number, {})).values[index] = change.value

    def rank(opening: Opening) -> tuple[int, float]:
        first = min(opening.values)
        return first, abs(opening.values[first] / opening.parameter.value - 1)

    return sorted(by_key.values(), key=rank)


def edge_changed(blocked: Blocked, change: Change) -> Edge | Blocked:
    """The edge along a border of the changed problem, or why no motion follows it."""
    border, key = blocked.border, change.parameter.key
    if key == EPSILON:
        border = replace(border, epsilon=change.value)
    else:
        border = replace(border, curve=change_curve(border.curve, key, change.value))
    return Chain((border,)).stop_at(blocked.steps[0].until)


def find_opening(planner: RoutePlanner, seconds: float) -> tuple[str, tuple[Change, ...]]:
    """The change of a single number with which the goal is reached, in words and as such.

    It is looked for on the borders that are shut, and tried by a search beyond those that it opens;
    then among other lengths and places of the fingers. The search of the `planner`, which did not
    reach the goal, has taken `seconds` of processor time.
    """
    planner.report("looking for a number that opens the way")
    search, tried = planner.search, list[str]()
    cuts = list_cut(search)[:CUT]

    def find(opening: Opening, change: Change, planned: bool) -> tuple[float, Sequence[int]] | None:
        """About how long a route beyond opened borders takes [s], and which of them it crosses."""
        try:
            changed = planner.problem.with_(change.values)
        except InputError:
            return None
        lasts, sources = dict[int, Edge](), list[Route]()
        for k, value in opening.values.items():
            if opening.parameter.sign * (change.value - value) < 0:
                continue
            before = search.reached.get(cuts[k].start.key)
            edge = edge_changed(cuts[k], change)
            if before is not None and isinstance(edge, Edge):
                lasts[k] = edge
                sources.append(before.extend(edge))
        if not sources:
            return None
        result = _search_changed(planner, changed, search.start.z, planned, sources)
        return result and (result[1], [k for k, edge in lasts.items() if edge in result[0].edges])

    for opening in list_openings(cuts)[:TRIED]:
        most = opening.open_all(opening.values)
        route = find(opening, most, False)
        # Borders beyond those that the route crosses may need the larger change.
        least = most if route is None else opening.open_all(route[1])
        for change in dict.fromkeys((least, most)) if route else ():
            reached = find(opening, change, True)
            if reached is not None:
                return _describe_reached(change, reached[0]), (change,)
        tried.append(str(most))
    text, changes = find_hand(planner, seconds)
    if tried and not changes:
        text = f"the goal is not reached with {', nor with '.join(tried)}; {text}"
    return text, changes


def _describe_reached(change: Change, duration: float) -> str:
    return f"with {change} the goal is reached, in about {duration:.3g} s"


def _search_changed(
    planner: RoutePlanner,
    changed: Problem,
    z: Array,
    planned: bool,
    sources: Sequence[Route] = (),
    most: int = NEARBY,
) -> tuple[Route, float] | None:
    """Look for any route from `z` in a changed scene, and about how long it takes [s]."""
    changed, options = replace(changed, start=z), planner.options
    roadmap, start = Roadmap(changed, options.uniqueness_margin), make_place(changed.scene, z)
    search = RouteSearch(roadmap, start, planner.search.goal, sources=sources)
    rough = replace(coarsen(options), robust=0.0, mode_search=False, replay=False)
    planner = RoutePlanner(changed, None, search, rough, Reporter(None), first_only=True)
    try:
        planner.look_by(EAGER._replace(most=most))
        if not planned:
            return (planner.found[0], planner.found[0].estimate) if planner.found else None
        planner.plan()
    except np.linalg.LinAlgError:
        return None
    return (planner.made[0][1], planner.made[0][0].duration) if planner.made else None


def find_hand(planner: RoutePlanner, seconds: float) -> tuple[str, tuple[Change, ...]]:
    """The least change of `list_hands` with which the goal is reached from the same pose."""
    search, tried, ended = planner.search, 0, "; the time for such trials is over"
    stop = time.process_time() + max(TIMES * seconds, AT_LEAST)
    with suppress(OutOfTime):
        for change in list_hands(planner.problem.scene):
            if time.process_time() > stop:
                break
            planner.report(f"looking for routes with {change}")
            tried += 1
            try:
                changed = planner.problem.with_(change.values)
                require_reach(changed.scene, search.goal, float(search.start.z[2]))
            except InputError:
                continue
            closed = close_fingers(changed.scene, *search.start.z[[0, 2], None])
            if closed.obstacle.any():
                continue
            result = _search_changed(planner, changed, closed.z[0], True, most=EAGER.most)
            if result is not None:
                return _describe_reached(change, result[1]), (change,)
        else:
            ended = ""
    most = f"{100 * (max(HANDS) - 1):.0f} %"
    hands = f"{tried} other hand{'s'[: tried != 1]} (lengths or bases of the fingers"
    return f"the goal is not reached with {hands}, up to {most} off){ended}", ()


def list_hands(scene: Scene) -> list[Change]:
    """Lengths and bases of the fingers that are tried: of both alike where they are, by size."""
    right, left = scene.fingers
    (first, _), (second, _) = np.asarray(right.base).tolist(), np.asarray(left.base).tolist()
    half, keys = (first - second) / 2, ("fingers.1.base[1]", "fingers.2.base[1]")
    numbers: list[tuple[str, float, float, tuple[str, ...]]]
    # Bases first: they have decided more often than lengths.
    numbers = [("x of base 1", first, half, keys[:1]), ("x of base 2", second, -half, keys[1:])]
    if math.isclose(first, -second, rel_tol=SYMMETRIC):
        numbers = [("x of base 1, mirrored for base 2,", first, half, keys)]
    if math.isclose(right.length, left.length, rel_tol=SYMMETRIC):
        numbers.append(("length of both fingers", right.length, right.length, ("length",)))
    else:
        for k, length in ((1, right.length), (2, left.length)):
            numbers.append((f"length of finger {k}", length, length, (f"fingers.{k}.length",)))
    return [
        Change(Parameter(name, value, "m", 1 if scale > 1 else -1, *keys), float(f"{moved:.3g}"))
        for scale in HANDS
        for name, value, size, keys in numbers
        for moved in (value + (scale - 1) * size,)
    ]


def explain_block(problem: Problem, options: PlanOptions, blocked: Blocked) -> str:
    """The violated limit of a motion along a border of the cut, in words."""
    (step,) = blocked.steps
    # A contact may touch at the start already, or be gained both ways; a coordinate is unique.
    for until in (step.until, point_out(step.contacts, blocked.stop.z)):
        phase = Phase(0, Formation(problem.scene, step.contacts), until)
        single = replace(problem, start=blocked.start.z, phases=(phase,), goals=())
        try:
            with unadvised():
                solve_with(single, replace(options, replay=False))
        except InputError:
            continue
        except InfeasibleError as error:
            if error.shortfalls:
                short = error.shortfalls[0]
                return f"{short.limit} is {short.amount:.3g} {short.unit} short"
        except WholearmError:
            break
        except np.linalg.LinAlgError:
            return DEPENDENT
        break
    return blocked.reason


def describe_block(
    search: RouteSearch,
    failures: Sequence[str],
    opening: str,
    explain: Callable[[Blocked], str] = lambda blocked: blocked.reason,
) -> str:
    """Why nothing leads to a goal: the cut, its violated limits, and the change that opens it."""
    cut, count = list_cut(search), len(search.reached)
    text = f"nothing leads from {search.start} to {search.goal}: {count} place{'s'[: count != 1]}"
    text += f" reached, touching {describe(search.start.contacts)} at the start; "
    if not cut:
        text += "no border leads on from there, and no way through a cell"
    else:
        many = len(cut) != 1
        text += f"{len(cut)} border{'s'[:many]} lead{'s'[many:]} on from there, "
        text += "all of them blocked" if many else "and is blocked"
    # After the first part, reasons give advice on the plan.
    reasons = list(dict.fromkeys(reason.split("; ")[0] for reason in failures))[:FAILED]
    reasons += [f"{describe_border(b)}: {explain(b)}" for b in cut[: LISTED - len(reasons)]]
    return "; ".join([text, *reasons, *([opening] if opening else [])])


def describe_border(blocked: Blocked) -> str:
    """A blocked border in words."""
    return f"{describe_steps(blocked.steps)} from {blocked.start}"
