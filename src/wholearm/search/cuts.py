"""Cut of the roadmap between reached places and goal; parameter changes that open it.

Limits of the hand, friction and epsilon do not change the geometry: the curve of a border is kept.
The smallest change that opens a border is found by bisection. If no such change leads to the goal,
other lengths and bases of the fingers are tested by new searches.
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
from .astar import GREEDY, Route, RoutePlanner, RouteSearch
from .edge_plans import coarsen
from .edges import DEPENDENT, BlockedEdge, Chain, Edge, describe_steps, end_at_pose
from .places import make_place, require_reach
from .roadmap import Roadmap

MAX_CUT = 16  # number of borders (nearest to the goal) that are tested with changed parameters
MAX_FACTOR = 10.0  # largest factor of a parameter; friction may go to zero
MAX_TRIALS = 3  # number of parameters with which the search is continued
MAX_PLACES = 30  # number of places expanded behind opened borders
SYMMETRY = 1e-9  # relative difference of lengths and bases up to which the hand is symmetric
HANDS = (1.05, 0.95, 1.1, 0.9, 1.2, 0.8)
"""Tested factors of the lengths of fingers and of the distance of their bases."""
TIME_FACTOR, MIN_TIME = 4.0, 20.0
"""Limit of processor time for other hands: over that of the search, and at least [s]."""
MAX_REASONS, MAX_FAILURES = 2, 1  # reasons in a message, and those of routes without a plan


class Opening(NamedTuple):
    """Values of a parameter that open borders."""

    parameter: Parameter
    values: dict[int, float]  # value that opens a border, by the number of the border

    def open_all(self, borders: Collection[int]) -> Change:
        """The smallest change that opens all of some borders which the parameter can open."""
        values = [value for k, value in self.values.items() if k in borders]
        return Change(self.parameter, max(values) if self.parameter.sign > 0 else min(values))


def list_cut(search: RouteSearch) -> list[BlockedEdge]:
    """Blocked borders from reached to other places, the nearest to the goal first.

    Every route along borders contains one of them.
    """
    cut = {
        (blocked.start.key, blocked.steps): blocked
        for blocked in search.blocked
        if blocked.stop.key not in search.reached
    }

    def rank(blocked: BlockedEdge) -> tuple[float, ...]:
        # With a flush edge on the palm angles differ by rounding; then x decides.
        angles = (round(search.measure(place), 9) for place in (blocked.stop, blocked.start))
        x = search.goal.x
        return *angles, 0.0 if x is None else abs(float(blocked.stop.z[0]) - x)

    return sorted(cut.values(), key=rank)


def list_openings(cuts: Sequence[BlockedEdge]) -> list[Opening]:
    """Parameters that open a border, ordered by the nearest border that they open."""
    by_key = dict[str, Opening]()
    for index, cut in enumerate(cuts):
        formation, epsilon = cut.border.formation, cut.border.epsilon
        for number in (*make_limits(formation, epsilon).parameters, *list_frictions(formation)):
            friction = number.key.startswith("friction")
            bounds = number.value, 0.0 if friction else number.value * MAX_FACTOR**number.sign

            def opens(number: Parameter, value: float, cut: BlockedEdge = cut) -> bool:
                return isinstance(change_edge(cut, Change(number, value)), Edge)

            for change in find_changes([number], {number: bounds}.__getitem__, opens):
                by_key.setdefault(number.key, Opening(number, {})).values[index] = change.value

    def rank(opening: Opening) -> tuple[int, float]:
        first = min(opening.values)
        return first, abs(opening.values[first] / opening.parameter.value - 1)

    return sorted(by_key.values(), key=rank)


def change_edge(blocked: BlockedEdge, change: Change) -> Edge | BlockedEdge:
    """The edge along a border with a changed parameter, or the blocked edge."""
    border, key = blocked.border, change.parameter.key
    if key == EPSILON:
        border = replace(border, epsilon=change.value)
    else:
        border = replace(border, curve=change_curve(border.curve, key, change.value))
    return Chain((border,)).stop_at(blocked.steps[0].until)


def find_opening(planner: RoutePlanner, seconds: float) -> tuple[str, tuple[Change, ...]]:
    """Message and change of a single parameter with which the goal is reached.

    Changes that open borders of the cut are tested by a search behind these borders; then other
    lengths and bases of the fingers are tested. The search of the `planner`, which did not reach
    the goal, has taken `seconds` of processor time.
    """
    planner.report("looking for a number that opens the way")
    search, failed = planner.search, list[str]()
    cuts = list_cut(search)[:MAX_CUT]

    def find(opening: Opening, change: Change, planned: bool) -> tuple[float, Sequence[int]] | None:
        """Estimated duration of a route through opened borders [s], and which of them it passes."""
        try:
            changed = planner.problem.with_(change.values)
        except InputError:
            return None
        edges, sources = dict[int, Edge](), list[Route]()
        for k, value in opening.values.items():
            if opening.parameter.sign * (change.value - value) < 0:
                continue
            reached_route = search.reached.get(cuts[k].start.key)
            edge = change_edge(cuts[k], change)
            if reached_route is not None and isinstance(edge, Edge):
                edges[k] = edge
                sources.append(reached_route.extend(edge))
        if not sources:
            return None
        result = _search_changed(planner, changed, search.start.z, planned, sources)
        return result and (result[1], [k for k, edge in edges.items() if edge in result[0].edges])

    for opening in list_openings(cuts)[:MAX_TRIALS]:
        largest = opening.open_all(opening.values)
        route = find(opening, largest, False)
        # Borders after those may need the larger change.
        smallest = largest if route is None else opening.open_all(route[1])
        for change in dict.fromkeys((smallest, largest)) if route else ():
            solution = find(opening, change, True)
            if solution is not None:
                return _describe_reached(change, solution[0]), (change,)
        failed.append(str(largest))
    text, changes = find_hand(planner, seconds)
    if failed and not changes:
        text = f"the goal is not reached with {', nor with '.join(failed)}; {text}"
    return text, changes


def _describe_reached(change: Change, duration: float) -> str:
    return f"with {change} the goal is reached, in about {duration:.3g} s"


def _search_changed(
    planner: RoutePlanner,
    problem: Problem,
    z: Array,
    planned: bool,
    sources: Sequence[Route] = (),
    limit: int = MAX_PLACES,
) -> tuple[Route, float] | None:
    """Some route from `z` in a changed problem, and its (estimated) duration [s]; or None."""
    problem, options = replace(problem, start=z), planner.options
    roadmap, start = Roadmap(problem, options.uniqueness_margin), make_place(problem.scene, z)
    search = RouteSearch(roadmap, start, planner.search.goal, sources=sources)
    coarse_options = replace(coarsen(options), robust=0.0, mode_search=False, replay=False)
    planner = RoutePlanner(problem, None, search, coarse_options, Reporter(None), first_only=True)
    try:
        planner.collect_routes(GREEDY._replace(max_places=limit))
        if not planned:
            return (planner.routes[0], planner.routes[0].estimate) if planner.routes else None
        planner.plan()
    except np.linalg.LinAlgError:
        return None
    return (planner.plans[0][1], planner.plans[0][0].duration) if planner.plans else None


def find_hand(planner: RoutePlanner, seconds: float) -> tuple[str, tuple[Change, ...]]:
    """The first change of `list_hands` with which the goal is reached from the same pose."""
    search, count, ending = planner.search, 0, "; the time for such trials is over"
    stop = time.process_time() + max(TIME_FACTOR * seconds, MIN_TIME)
    with suppress(OutOfTime):
        for change in list_hands(planner.problem.scene):
            if time.process_time() > stop:
                break
            planner.report(f"looking for routes with {change}")
            count += 1
            try:
                changed = planner.problem.with_(change.values)
                require_reach(changed.scene, search.goal, float(search.start.z[2]))
            except InputError:
                continue
            closed = close_fingers(changed.scene, *search.start.z[[0, 2], None])
            if closed.obstacle.any():
                continue
            result = _search_changed(planner, changed, closed.z[0], True, limit=GREEDY.max_places)
            if result is not None:
                return _describe_reached(change, result[1]), (change,)
        else:
            ending = ""
    largest = f"{100 * (max(HANDS) - 1):.0f} %"
    hands = f"{count} other hand{'s'[: count != 1]} (lengths or bases of the fingers"
    return f"the goal is not reached with {hands}, up to {largest} off){ending}", ()


def list_hands(scene: Scene) -> list[Change]:
    """Tested changes of lengths and bases: of both fingers if the hand is symmetric, by size."""
    right, left = scene.fingers
    (first, _), (second, _) = np.asarray(right.base).tolist(), np.asarray(left.base).tolist()
    offset, keys = (first - second) / 2, ("fingers.1.base[1]", "fingers.2.base[1]")
    numbers: list[tuple[str, float, float, tuple[str, ...]]]
    # Bases first: they open routes more often than lengths.
    numbers = [("x of base 1", first, offset, keys[:1]), ("x of base 2", second, -offset, keys[1:])]
    if math.isclose(first, -second, rel_tol=SYMMETRY):
        numbers = [("x of base 1, mirrored for base 2,", first, offset, keys)]
    if math.isclose(right.length, left.length, rel_tol=SYMMETRY):
        numbers.append(("length of both fingers", right.length, right.length, ("length",)))
    else:
        for k, length in ((1, right.length), (2, left.length)):
            numbers.append((f"length of finger {k}", length, length, (f"fingers.{k}.length",)))
    return [
        Change(Parameter(name, value, "m", 1 if scale > 1 else -1, *keys), float(f"{changed:.3g}"))
        for scale in HANDS
        for name, value, size, keys in numbers
        for changed in (value + (scale - 1) * size,)
    ]


def explain_block(problem: Problem, options: PlanOptions, blocked: BlockedEdge) -> str:
    """The violated limit of a motion along a border of the cut, in words."""
    (step,) = blocked.steps
    # A contact may touch at the start already, or be gained both ways; a coordinate is unique.
    for until in (step.until, end_at_pose(step.contacts, blocked.stop.z)):
        phase = Phase(0, Formation(problem.scene, step.contacts), until)
        single = replace(problem, start=blocked.start.z, phases=(phase,), goals=())
        try:
            with unadvised():
                solve_with(single, replace(options, replay=False))
        except InputError:
            continue
        except InfeasibleError as error:
            if error.shortfalls:
                shortfall = error.shortfalls[0]
                return f"{shortfall.limit} is {shortfall.amount:.3g} {shortfall.unit} short"
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
    explain: Callable[[BlockedEdge], str] = lambda blocked: blocked.reason,
) -> str:
    """Message without a route to a goal: the cut, its violated limits, the change that opens it."""
    cut, count = list_cut(search), len(search.reached)
    text = f"nothing leads from {search.start} to {search.goal}: {count} place{'s'[: count != 1]}"
    text += f" reached, touching {describe(search.start.contacts)} at the start; "
    if not cut:
        text += "no border leads on from there, and no way through a cell"
    else:
        plural = len(cut) != 1
        text += f"{len(cut)} border{'s'[:plural]} lead{'s'[plural:]} on from there, "
        text += "all of them blocked" if plural else "and is blocked"
    # After the first part, reasons give advice on the plan.
    reasons = list(dict.fromkeys(reason.split("; ")[0] for reason in failures))[:MAX_FAILURES]
    reasons += [f"{describe_border(b)}: {explain(b)}" for b in cut[: MAX_REASONS - len(reasons)]]
    return "; ".join([text, *reasons, *([opening] if opening else [])])


def describe_border(blocked: BlockedEdge) -> str:
    """A blocked border in words."""
    return f"{describe_steps(blocked.steps)} from {blocked.start}"
