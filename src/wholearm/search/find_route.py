"""Plans to goals: search over the roadmap, planning of the routes found, and lower bounds.

Where no route exists, single numbers of the problem are varied until one does.
"""

from __future__ import annotations

import hashlib
import json
import math
import pickle
import sys
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .. import __version__
from ..common.arrays import Array
from ..common.errors import (
    Change,
    InfeasibleError,
    InputError,
    Parameter,
    SolverError,
    WholearmError,
)
from ..common.files import write_whole
from ..common.sharing import exclusive
from ..common.signals import OutOfTime, Reporter, limited, yielding
from ..contacts.closing import close_fingers, describe_obstacle, name_reach
from ..contacts.formation import Formation
from ..planning.explain import unadvised
from ..planning.options import Objective, PlanOptions
from ..planning.plan import solve_with
from ..problem.definition import Goal, Phase, Problem
from ..problem.read import name_goal
from ..problem.table import describe_scene
from ..scene.model import Scene
from .astar import EAGER, RoadmapRoute, RouteSearch
from .cuts import Opening, list_cut_borders, list_openings, pass_cut
from .edges import Blocked, point_out
from .feasibility import ROUGH, SINGULAR
from .places import is_at, make_place
from .result import Alternative, Answer, describe_block
from .roadmap import Roadmap
from .route_choice import NEARBY, Chooser

LARGEST = 200_000_000  # Most bytes of a stored roadmap
_RECURSION = 20_000  # Depth of recursion that pickling a roadmap
NEAR = 1e-4  # How far beside a goal the hand may close instead, in radii of gyration
TRIED = 3  # Most numbers with which the goal is looked for
SYMMETRIC = 1e-9  # Relative difference of lengths and bases up to which the hand is symmetric
HANDS = (1.05, 0.95, 1.1, 0.9, 1.2, 0.8)
"""Lengths of fingers and distances of their bases that are tried, relative to the problem's."""
TIMES, AT_LEAST = 4.0, 20.0
"""Limit of processor time for other hands: over that of the search, and at least [s]."""
Try = Callable[[Change, Sequence[int], bool], tuple[float, Sequence[int]] | None]
"""Looks for the goal with a change, beyond some borders: about how long the route takes [s], which
is planned if that is asked for, and over which of the borders it leads."""
ROADMAPS = 4  # scenes whose roadmaps are kept in memory
_roadmaps: OrderedDict[object, Roadmap] = OrderedDict()


def find_route(
    problem: Problem,
    objective: str = "time",
    *,
    alternatives: int = 0,
    progress: Callable[[str], None] | None = None,
    cache: str | Path | None = None,
    jobs: int = 1,
    time_limit: float | None = None,
    **options: Any,
) -> Answer:
    """Find the contact formations that lead from a problem's start to its goals, and a plan.

    Parameters
    ----------
    problem : Problem
        With goals.
    objective : {"time", "effort", "margin"}
        Routes are looked for by their least time; plans along them are of this objective.
    alternatives : int
        How many routes of other formations are planned beside the best one.
    progress : callable, optional
        Told in a few words what is being done.
    cache : path-like, optional
        Folder where what is known of the scene is kept, for other processes. Its files are pickles:
        it has to be one that nobody else writes to.
    jobs : int
        Most processes at the same time; others than this one are forked. What is found does not
        depend on it.
    time_limit : float, optional, [s]
        Longest time that the search may take; then the best route so far is returned.
    **options
        As `wholearm.solve` takes them.

    Raises
    ------
    InputError       if the problem has no goals, or an option is out of its range
    InfeasibleError  if nothing leads to a goal; names what blocks the way
    SolverError      if the time is over before there is a plan; names what is missing
    """
    if jobs < 1:
        raise InputError("", "jobs", f"{jobs} given; allowed is 1 or more")
    chosen = PlanOptions(objective=objective, **options)
    folder = None if cache is None else Path(cache)
    return find_route_with(
        problem, chosen, alternatives, progress, folder, jobs, time_limit=time_limit
    )


@exclusive
def find_route_with(
    problem: Problem,
    options: PlanOptions,
    alternatives: int = 0,
    progress: Callable[[str], None] | None = None,
    cache: Path | None = None,
    jobs: int = 1,
    *,
    time_limit: float | None = None,
    hurry: Callable[[], None] | None = None,
) -> Answer:
    """Find a route with `options` given as one object; see `find_route`.

    With `hurry` an interrupt ends the search alone: the best route so far is returned, or planned,
    which `hurry` is called before. Without it KeyboardInterrupt is raised.
    """
    with limited(time_limit):
        report = Reporter(progress)
        if not problem.goals:
            reason = "is missing; allowed is flush or phi_deg, and x"
            raise InputError(problem.source, "goal", reason)
        if cache is not None:
            require_folder(cache)
        roadmap, before = get_roadmap(problem, options, cache), list[RoadmapRoute]()
        for index, goal in enumerate(problem.goals):
            start = problem.start if not before else before[-1].links[-1].stop.z
            place = make_place(problem.scene, start)
            if is_at(place, goal):
                key = name_goal(problem.goals, index)
                reason = f"{goal} holds already where the motion starts"
                raise InputError(problem.source, key, reason)
            require_reach(problem.scene, goal, float(start[2]))
            search = RouteSearch(roadmap, place, goal)
            count = alternatives if index + 1 == len(problem.goals) else 0
            answer = _plan_to_goal(problem, before, search, options, count, report, jobs, hurry)
            before = [*before, answer.route]
        if cache is not None:
            try:
                store_roadmap(cache, describe_key(problem, options), roadmap)
            except InputError as error:
                # The result counts, with or without a copy for later searches.
                warnings.warn(str(error), stacklevel=2)
        return answer


def describe_key(problem: Problem, options: PlanOptions) -> str:
    """Everything that the roadmap of a problem depends on, as JSON."""
    key = describe_scene(problem.scene) | {"": (problem.epsilon, options.uniqueness_margin)}
    return json.dumps(key, sort_keys=True)


def get_roadmap(problem: Problem, options: PlanOptions, cache: Path | None = None) -> Roadmap:
    """The roadmap of a problem's scene, from memory, from a folder, or a new one."""
    key = describe_key(problem, options)
    roadmap = _roadmaps.pop(key, None)
    if roadmap is None and cache is not None:
        roadmap = load_roadmap(cache, key)
    _roadmaps[key] = roadmap = roadmap or Roadmap(problem, options.uniqueness_margin)
    while len(_roadmaps) > ROADMAPS:
        _roadmaps.popitem(last=False)
    return roadmap


def forget_roadmaps() -> None:
    """Empty the memory of roadmaps."""
    _roadmaps.clear()


def _plan_to_goal(
    problem: Problem,
    before: list[RoadmapRoute],
    search: RouteSearch,
    options: PlanOptions,
    alternatives: int,
    report: Reporter,
    jobs: int,
    hurry: Callable[[], None] | None,
) -> Answer:
    """Plan routes to one goal, with a lower bound of the best one."""
    start = time.process_time()
    chooser, complete = Chooser(problem, before, search, options, jobs), True
    try:
        with yielding():
            report("looking for routes")
            chooser.run(1 + alternatives, report)
    except OutOfTime:
        if not chooser.made:
            raise SolverError(_describe_missing(chooser, report.last)) from None
        complete = False
    except KeyboardInterrupt:
        if hurry is None or not (chooser.made or chooser.found):
            raise
        complete = False
        if not chooser.made:
            hurry()
            chooser.first_only = True
            chooser.plan(1, report)
    except np.linalg.LinAlgError:
        # Dependent contacts at a place that the search has reached.
        complete = False
        if not chooser.made:
            chooser.plan(1, report)
    made = chooser.made
    if not made:
        spent, failed = time.process_time() - start, chooser.failures
        opening, changes, reason = "", tuple[Change, ...](), partial(explain, problem, options)
        try:
            with yielding():
                opening, changes = find_opening(search, problem, options, spent, report)
                text = describe_block(search, failed, opening, reason)
        except KeyboardInterrupt as error:
            if hurry is None and not isinstance(error, OutOfTime):
                raise
            text = describe_block(search, failed, opening)
        raise InfeasibleError(text, changes=changes)
    sign = -1 if options.goal is Objective.MARGIN else 1
    made.sort(key=lambda pair: sign * pair[0].value)
    plan, route = made[0]
    bound = None
    if complete and not before:
        try:
            with yielding():
                bound = chooser.bound(plan.duration, route.in_cells)
        except KeyboardInterrupt as error:
            if hurry is None and not isinstance(error, OutOfTime):
                raise
            complete = False
    others = tuple(Alternative(other) for other, _ in made[1 : 1 + alternatives])
    failures, blocked = tuple(chooser.failures), tuple(search.blocked)
    return Answer(plan, route, bound, others, failures, blocked, search.settled, complete)


def _describe_missing(chooser: Chooser, doing: str) -> str:
    """What a search that is out of time has found, and its last step."""
    text = f"the time limit is over, and there is no plan yet: {chooser.search.settled} places"
    text += " looked at"
    if chooser.found:
        best = min(chooser.found, key=chooser.estimate)
        count = sum(len(link.steps) for link in best.links)
        text += f", a route of {count} phases found, of about {chooser.estimate(best):.3g} s"
    return f"{text}; what it was at: {doing}"


def find_opening(
    search: RouteSearch,
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
    search         which did not reach the goal
    seconds : [s]  processor time that this has taken
    """
    report("looking for a number that opens the way")
    cuts = list_cut_borders(search)

    def find(
        change: Change, beyond: Sequence[int], planned: bool
    ) -> tuple[float, Sequence[int]] | None:
        try:
            changed = problem.with_(change.values)
        except InputError:
            return None
        routes = {k: pass_cut(search, cuts[k], change) for k in beyond}
        sources = [route for route in routes.values() if route is not None]
        if not sources:
            return None
        found = _search_changed(changed, search.start.z, search.goal, options, planned, sources)
        if found is None:
            return None
        last = {k: route.links[-1] for k, route in routes.items() if route}
        return found[1], [k for k, link in last.items() if link in found[0].links]

    text, changes = choose_opening(list_openings(cuts), find)
    if changes:
        return text, changes
    hands, changes = find_hand(search, problem, options, seconds, report)
    return hands if changes or not text else f"{text}; {hands}", changes


def choose_opening(openings: Sequence[Opening], find: Try) -> tuple[str, tuple[Change, ...]]:
    """The first number with which the goal is reached, and the least change of it that does."""
    tried = list[str]()
    for opening in openings[:TRIED]:
        most = opening.open_all()
        route = find(most, opening.list_open(most), False)
        # Borders beyond those that the route crosses may need the larger change.
        least = most if route is None else opening.open_all(route[1])
        for change in dict.fromkeys((least, most)) if route else ():
            found = find(change, opening.list_open(change), True)
            if found is not None:
                return _describe_reached(change, found[0]), (change,)
        tried.append(str(most))
    return f"the goal is not reached with {', nor with '.join(tried)}" if tried else "", ()


def _describe_reached(change: Change, duration: float) -> str:
    return f"with {change} the goal is reached, in about {duration:.3g} s"


def _search_changed(
    changed: Problem,
    z: Array,
    goal: Goal,
    options: PlanOptions,
    planned: bool,
    sources: Sequence[RoadmapRoute] = (),
    most: int = NEARBY,
) -> tuple[RoadmapRoute, float] | None:
    """Look for any route from `z` in a changed scene, and about how long it takes [s]."""
    changed = replace(changed, start=z)
    roadmap = Roadmap(changed, options.uniqueness_margin)
    search = RouteSearch(roadmap, make_place(changed.scene, z), goal, sources=sources)
    rough = replace(options, objective=Objective.TIME, duration=None, accuracy=ROUGH, robust=0.0)
    rough = replace(rough, mode_search=False, certify=False, replay=False)
    chooser = Chooser(changed, [], search, rough, first_only=True)
    try:
        route = chooser.find_first(lambda _: None, most)
        if route is None:
            return None
        if not planned:
            return route, route.duration
        chooser.plan(1, lambda _: None)
    except np.linalg.LinAlgError:
        return None
    return (chooser.made[0][1], chooser.made[0][0].duration) if chooser.made else None


def find_hand(
    search: RouteSearch,
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
            try:
                changed = problem.with_(change.values)
                require_reach(changed.scene, search.goal, float(search.start.z[2]))
            except (InputError, InfeasibleError):
                continue
            closed = close_fingers(changed.scene, *search.start.z[[0, 2], None])
            if closed.obstacle.any():
                continue
            z, goal = closed.z[0], search.goal
            found = _search_changed(changed, z, goal, options, True, most=EAGER.most)
            if found is not None:
                return _describe_reached(change, found[1]), (change,)
    most = f"{100 * (max(HANDS) - 1):.0f} %"
    text = f"the goal is not reached with {tried} other lengths or bases of the fingers"
    return f"{text}, up to {most} off", ()


def list_hands(scene: Scene) -> list[Change]:
    """Lengths and bases of the fingers that are tried: of both alike where they are, by size."""
    right, left = scene.fingers
    (first, _), (second, _) = np.asarray(right.base).tolist(), np.asarray(left.base).tolist()
    half, base = (first - second) / 2, "fingers.{}.base[1]"
    given: list[tuple[str, float, float, tuple[str, ...]]]
    # Bases first: they have decided more often than lengths.
    if math.isclose(first, -second, rel_tol=SYMMETRIC):
        keys = base.format(1), base.format(2)
        given = [("x of base 1, mirrored for base 2,", first, half, keys)]
    else:
        given = [
            ("x of base 1", first, half, (base.format(1),)),
            ("x of base 2", second, -half, (base.format(2),)),
        ]
    if math.isclose(right.length, left.length, rel_tol=SYMMETRIC):
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
            return SINGULAR
        break
    return blocked.reason


def require_reach(scene: Scene, goal: Goal, near: float) -> None:
    """Check that both fingers close on an object that lies at a goal.

    Parameters
    ----------
    near : [rad]  angle of the object before

    Raises
    ------
    InfeasibleError  if they do not; says where they would
    """
    if goal.x is None:
        return
    phi = goal.find_angle(scene, near)
    x = goal.x + NEAR * scene.scales.length * np.array([0.0, -1.0, 1.0])
    closed = close_fingers(scene, x, np.full(3, phi))
    if (closed.obstacle > 0).any(axis=1).all():
        why, where = describe_obstacle(closed), name_reach(scene, phi)
        raise InfeasibleError(f"nothing leads to {goal}: {why} there; {where}")


def require_folder(folder: Path) -> None:
    """Make a folder for roadmaps; InputError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("", "--cache", f"{folder}: {error.strerror}") from None


def load_roadmap(folder: Path, key: str) -> Roadmap | None:
    """The stored roadmap of a scene; None where there is none, or the file is damaged.

    Files are pickles, which can execute code: a folder that others write to is not safe.
    """
    try:
        content = _name_file(folder, key).read_bytes()
        digest, body = content[:32], content[32:]
        roadmap = pickle.loads(body) if hashlib.sha256(body).digest() == digest else None
    except Exception:
        return None  # A file that cannot be read counts as missing.
    return roadmap if isinstance(roadmap, Roadmap) else None


def store_roadmap(folder: Path, key: str, roadmap: Roadmap) -> None:
    """Write the roadmap of a scene in place of the one before."""
    depth = sys.getrecursionlimit()
    sys.setrecursionlimit(max(depth, _RECURSION))
    try:
        body = pickle.dumps(roadmap, protocol=pickle.HIGHEST_PROTOCOL)
    finally:
        sys.setrecursionlimit(depth)
    if len(body) <= LARGEST:
        digest = hashlib.sha256(body).digest()
        write_whole(_name_file(folder, key), lambda stream: stream.write(digest + body))


def _name_file(folder: Path, key: str) -> Path:
    """The file of a scene: another one for other versions."""
    versions = f"{__version__} {ca.__version__} {np.__version__} {sys.version}"
    return folder / f"{hashlib.sha256(f'{versions} {key}'.encode()).hexdigest()[:32]}.chart"
