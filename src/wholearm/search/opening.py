"""What keeps a search from its goal, in words, and the change of one number that opens the way.

Numbers that leave the geometry as it is are looked at along borders of the cut, see `gates`.
Lengths and bases of the fingers change the formation map: each value takes a search of its own, so
that they are tried when none of the others helps, up to some times what the search took.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..common.arrays import Array
from ..common.errors import InfeasibleError, InputError, WholearmError
from ..common.pulse import OutOfTime
from ..common.shortfalls import Change, Parameter
from ..contacts.closing import close_fingers
from ..contacts.formation import Formation
from ..planning.advice import unadvised
from ..planning.options import Objective, PlanOptions
from ..planning.plan import solve_with
from ..problem.definition import Phase, Problem
from ..problem.goal import Goal
from ..scene.model import Scene
from .chart import Chart
from .choosing import NEARBY, Chooser
from .find import EAGER, Route, Search
from .gates import Gate, Opening, list_gates, list_openings, pass_gate
from .links import Blocked, point_out
from .measure import ROUGH, SINGULAR
from .places import make_place
from .reach import require_reach

TRIED = 3
"""Most numbers with which the goal is looked for."""
HANDS = (1.05, 0.95, 1.1, 0.9, 1.2, 0.8)
"""Lengths of fingers and distances of their bases that are tried, over those given."""
TIMES, AT_LEAST = 4.0, 20.0
"""Processor time up to which other hands are begun, over that of the search, and at least [s]."""

Try = Callable[[Change, Sequence[int], bool], tuple[float, Sequence[int]] | None]
"""Looks for the goal with a change, beyond some borders: about how long the route takes [s], which
is planned if that is asked for, and over which of the borders it leads."""


def find_opening(
    search: Search,
    problem: Problem,
    options: PlanOptions,
    seconds: float,
    report: Callable[[str], None],
) -> tuple[str, tuple[Change, ...]]:
    """The change of a single number with which the goal is reached, in words and as such.

    It is looked for on the borders that are shut, and tried by a search beyond those that it opens;
    then among other lengths and places of the fingers.

    Parameters
    ----------
    search : Search
        Which did not reach the goal.
    problem : Problem
    options : PlanOptions
    seconds : float, [s]
        Processor time that this has taken.
    report : callable
    """
    report("looking for a number that opens the way")
    gates = list_gates(search)

    def find(
        change: Change, beyond: Sequence[int], planned: bool
    ) -> tuple[float, Sequence[int]] | None:
        own = {k: gates[k] for k in beyond}
        return _look_beyond(search, problem, options, change, own, planned)

    text, changes = choose_opening(list_openings(gates), find)
    if changes:
        return text, changes
    shut, changes = find_hand(search, problem, options, seconds, report)
    return shut if changes or not text else f"{text}; {shut}", changes


def choose_opening(openings: Sequence[Opening], find: Try) -> tuple[str, tuple[Change, ...]]:
    """The first number with which the goal is reached, and the least change of it that does."""
    tried = list[str]()
    for opening in openings[:TRIED]:
        most = opening.open_all()
        beyond = opening.list_open(most)
        seen = find(most, beyond, False)
        # What else it opens may be needed beyond those borders over which the way leads.
        least = most if seen is None else opening.open_all(seen[1])
        for change in dict.fromkeys((least, most)) if seen else ():
            found = find(change, opening.list_open(change), True)
            if found is not None:
                return _describe_reached(change, found[0]), (change,)
        tried.append(str(most))
    return f"the goal is not reached with {', nor with '.join(tried)}" if tried else "", ()


def _describe_reached(change: Change, duration: float) -> str:
    return f"with {change} the goal is reached, in about {duration:.3g} s"


def _look_beyond(
    search: Search,
    problem: Problem,
    options: PlanOptions,
    change: Change,
    gates: dict[int, Gate],
    planned: bool,
) -> tuple[float, list[int]] | None:
    """Look for the goal in a changed scene, beyond borders that are open there."""
    try:
        changed = problem.with_(change.values)
    except InputError:
        return None
    ways = {k: pass_gate(search, gate, change) for k, gate in gates.items()}
    sources = [way for way in ways.values() if way is not None]
    if not sources:
        return None
    found = _look_in(changed, search.start.z, search.goal, options, planned, sources)
    if found is None:
        return None
    route, duration = found
    return duration, [k for k, way in ways.items() if way and way.links[-1] in route.links]


def _look_in(
    changed: Problem,
    z: Array,
    goal: Goal,
    options: PlanOptions,
    planned: bool,
    sources: Sequence[Route] = (),
    most: int = NEARBY,
) -> tuple[Route, float] | None:
    """Look for any route from `z` in a changed scene, and about how long it takes [s]."""
    changed = replace(changed, start=z)
    chart = Chart(changed, options.uniqueness_margin)
    search = Search(chart, make_place(changed.scene, z), goal, sources=sources)
    rough = replace(options, objective=Objective.TIME, duration=None, accuracy=ROUGH, robust=0.0)
    rough = replace(rough, mode_search=False, certify=False, replay=False)
    chooser = Chooser(changed, [], search, rough, hurried=True)
    try:
        route = chooser.glance(lambda _: None, most)
        if route is None:
            return None
        if not planned:
            return route, route.duration
        chooser.plan(1, lambda _: None)
    except np.linalg.LinAlgError:
        return None
    return (chooser.made[0][1], chooser.made[0][0].duration) if chooser.made else None


def find_hand(
    search: Search,
    problem: Problem,
    options: PlanOptions,
    seconds: float,
    report: Callable[[str], None],
) -> tuple[str, tuple[Change, ...]]:
    """The least change of `list_hands` with which the goal is reached from the same pose."""
    tried, stop = 0, time.process_time() + max(TIMES * seconds, AT_LEAST)
    with suppress(OutOfTime):
        for change in list_hands(problem.scene):
            if time.process_time() > stop:
                break
            report(f"looking for routes with {change}")
            tried += 1
            duration = _look_with(search, problem, options, change)
            if duration is not None:
                return _describe_reached(change, duration), (change,)
    most = f"{100 * (max(HANDS) - 1):.0f} %"
    text = f"the goal is not reached with {tried} other lengths or bases of the fingers"
    return f"{text}, up to {most} off", ()


def _look_with(
    search: Search, problem: Problem, options: PlanOptions, change: Change
) -> float | None:
    """About how long a planned route to the goal takes with another hand [s], if there is one."""
    try:
        changed = problem.with_(change.values)
        require_reach(changed.scene, search.goal, float(search.start.z[2]))
    except (InputError, InfeasibleError):
        return None
    closed = close_fingers(changed.scene, *search.start.z[[0, 2], None])
    if closed.obstacle.any():
        return None
    found = _look_in(changed, closed.z[0], search.goal, options, True, most=EAGER.most)
    return found and found[1]


def list_hands(scene: Scene) -> list[Change]:
    """Lengths and bases of the fingers that are tried: of both alike where they are, by size."""
    right, left = scene.fingers
    (first, _), (second, _) = np.asarray(right.base).tolist(), np.asarray(left.base).tolist()
    half, base = (first - second) / 2, "fingers.{}.base[1]"
    given: list[tuple[str, float, float, tuple[str, ...]]]
    # Where fingers stand has decided more often than how long they are.
    if first == -second:
        keys = base.format(1), base.format(2)
        given = [("x of base 1, mirrored for base 2,", first, half, keys)]
    else:
        given = [
            ("x of base 1", first, half, (base.format(1),)),
            ("x of base 2", second, -half, (base.format(2),)),
        ]
    if right.length == left.length:
        given.append(("length of both fingers", right.length, right.length, ("length",)))
    else:
        given.append(("length of finger 1", right.length, right.length, ("fingers.1.length",)))
        given.append(("length of finger 2", left.length, left.length, ("fingers.2.length",)))
    return [
        Change(Parameter(name, value, "m", 1 if scale > 1 else -1, *keys), float(f"{moved:.3g}"))
        for scale in HANDS
        for name, value, size, keys in given
        for moved in (value + (scale - 1) * size,)
    ]


def explain(problem: Problem, options: PlanOptions, blocked: Blocked) -> str:
    """What a motion along a border of the cut is short of, in words."""
    (step,) = blocked.steps
    # A contact may touch at the start already, or be gained both ways; a place says which is meant.
    for until in (step.until, point_out(step.contacts, blocked.stop.z)):
        phase = Phase(0, Formation(problem.scene, step.contacts), until)
        own = replace(problem, start=blocked.start.z, phases=(phase,), goals=())
        try:
            with unadvised():
                solve_with(own, replace(options, replay=False))
        except InputError:
            continue
        except InfeasibleError as error:
            if error.shortfalls:
                short = error.shortfalls[0]
                return f"{short.limit} is {short.amount:.3g} {short.unit} short"
        except WholearmError:
            break
        except np.linalg.LinAlgError:
            return SINGULAR
        break
    return blocked.reason
