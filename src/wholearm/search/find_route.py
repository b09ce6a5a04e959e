"""From a problem with goals to a plan: search, planning of what is found, and what bounds it."""

from __future__ import annotations

import hashlib
import json
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
from ..common.errors import InfeasibleError, InputError, SolverError, WholearmError
from ..common.files import write_whole
from ..common.sharing import exclusive
from ..common.shortfalls import Change, Parameter
from ..common.signals import OutOfTime, Reporter, limited, yielding
from ..contacts.closing import close_fingers, describe_obstacle, name_reach
from ..contacts.formation import Formation
from ..planning.advice import unadvised
from ..planning.options import Objective, PlanOptions
from ..planning.plan import solve_with
from ..problem.definition import Phase, Problem
from ..problem.goal import Goal, name_goal
from ..problem.table import describe_scene
from ..scene.model import Scene
from .astar import EAGER, RoadmapRoute, RouteSearch
from .candidates import FailedCandidate
from .cuts import Gate, Opening, list_gates, list_openings, pass_gate
from .edges import Blocked, point_out
from .feasibility import ROUGH, SINGULAR
from .goals import is_at
from .places import make_place
from .result import Alternative, Answer, describe_block
from .roadmap import Roadmap
from .route_choice import NEARBY, Chooser

LARGEST = 200_000_000  # Most bytes that a chart is written with
_RECURSION = 20_000  # Depth of recursion that pickling a chart may take
NEAR = 1e-4  # How far beside a goal the hand may close instead, in radii of gyration
TRIED = 3  # Most numbers with which the goal is looked for
HANDS = (1.05, 0.95, 1.1, 0.9, 1.2, 0.8)
"""Lengths of fingers and distances of their bases that are tried, over those given."""
TIMES, AT_LEAST = 4.0, 20.0
"""Processor time up to which other hands are begun, over that of the search, and at least [s]."""
Try = Callable[[Change, Sequence[int], bool], tuple[float, Sequence[int]] | None]
"""Looks for the goal with a change, beyond some borders: about how long the route takes [s], which
is planned if that is asked for, and over which of the borders it leads."""
CHARTS = 4  # Scenes whose charts are kept
_charts: OrderedDict[object, Roadmap] = OrderedDict()


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
    own = PlanOptions(objective=objective, **options)
    folder = None if cache is None else Path(cache)
    given = problem, own, alternatives, progress, folder, jobs
    return find_route_with(*given, time_limit=time_limit)


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
        return _find(problem, options, alternatives, Reporter(progress), cache, jobs, hurry)


def _find(
    problem: Problem,
    options: PlanOptions,
    alternatives: int,
    report: Reporter,
    cache: Path | None,
    jobs: int,
    hurry: Callable[[], None] | None,
) -> Answer:
    """Find a route from goal to goal."""
    if not problem.goals:
        raise InputError(problem.source, "goal", "is missing; allowed is flush or phi_deg, and x")
    if cache is not None:
        require_folder(cache)
    chart, before = get_chart(problem, options, cache), list[RoadmapRoute]()
    for index, goal in enumerate(problem.goals):
        start = problem.start if not before else before[-1].links[-1].stop.z
        place = make_place(problem.scene, start)
        if is_at(place, goal):
            key = name_goal(problem.goals, index, problem.table)
            raise InputError(problem.source, key, f"{goal} holds already where the motion starts")
        require_reach(problem.scene, goal, float(start[2]))
        search = RouteSearch(chart, place, goal)
        wanted = alternatives if index + 1 == len(problem.goals) else 0
        answer = _choose(problem, before, search, options, wanted, report, jobs, hurry)
        before = [*before, answer.route]
    if cache is not None:
        try:
            store_chart(cache, key_chart(problem, options), chart)
        except InputError as error:
            # What was found counts, with or without a copy for later searches.
            warnings.warn(str(error), stacklevel=2)
    return answer


def key_chart(problem: Problem, options: PlanOptions) -> str:
    """What a chart depends on, in words."""
    known = describe_scene(problem.scene) | {"": (problem.epsilon, options.uniqueness_margin)}
    return json.dumps(known, sort_keys=True)


def get_chart(problem: Problem, options: PlanOptions, cache: Path | None = None) -> Roadmap:
    """The chart of a problem's scene, kept from one search to the next, in a folder if asked."""
    key = key_chart(problem, options)
    chart = _charts.pop(key, None)
    if chart is None and cache is not None:
        chart = load_chart(cache, key)
    chart = chart or Roadmap(problem, options.uniqueness_margin)
    _charts[key] = chart
    while len(_charts) > CHARTS:
        _charts.popitem(last=False)
    return chart


def forget_charts() -> None:
    """Forget what is known of scenes."""
    _charts.clear()


def _refuse(
    problem: Problem,
    search: RouteSearch,
    options: PlanOptions,
    failures: list[FailedCandidate],
    seconds: float,
    report: Reporter,
    hurry: Callable[[], None] | None,
) -> InfeasibleError:
    """Why nothing leads to a goal, which took so many seconds to see, and what opens the way."""
    opening, changes, why = "", tuple[Change, ...](), partial(explain, problem, options)
    try:
        with yielding():
            opening, changes = find_opening(search, problem, options, seconds, report)
            text = describe_block(search, failures, opening, why)
    except KeyboardInterrupt as error:
        if hurry is None and not isinstance(error, OutOfTime):
            raise
        # That nothing leads there is known; what would help, and why, is not looked for any more.
        text = describe_block(search, failures, opening)
    return InfeasibleError(text, changes=changes)


def _describe_missing(chooser: Chooser, doing: str) -> str:
    """What a search that is out of time has found, and what it was at."""
    text = f"the time limit is over, and there is no plan yet: {chooser.search.settled} places"
    text += " looked at"
    if chooser.found:
        best = min(chooser.found, key=chooser.estimate)
        count = sum(len(link.steps) for link in best.links)
        text += f", a route of {count} phases found, of about {chooser.estimate(best):.3g} s"
    return f"{text}; what it was at: {doing}"


def _choose(
    problem: Problem,
    before: list[RoadmapRoute],
    search: RouteSearch,
    options: PlanOptions,
    alternatives: int,
    report: Reporter,
    jobs: int,
    hurry: Callable[[], None] | None,
) -> Answer:
    """Plan routes to one goal, and say how good the best one is."""
    begun = time.process_time()
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
            chooser.hurried = True
            chooser.plan(1, report)
    except np.linalg.LinAlgError:
        # Contacts depend on each other at a place that the search came to.
        complete = False
        if not chooser.made:
            chooser.plan(1, report)
    made, margin = chooser.made, options.goal is Objective.MARGIN
    if not made:
        spent = time.process_time() - begun
        raise _refuse(problem, search, options, chooser.failures, spent, report, hurry)
    made.sort(key=lambda own: -own[0].value if margin else own[0].value)
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
    return Answer(
        plan,
        plan.problem,
        route,
        bound,
        tuple(Alternative(own[0], own[0].problem) for own in made[1 : 1 + alternatives]),
        tuple(chooser.failures),
        tuple(search.blocked),
        search.settled,
        complete,
    )


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
    search: RouteSearch,
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
    sources: Sequence[RoadmapRoute] = (),
    most: int = NEARBY,
) -> tuple[RoadmapRoute, float] | None:
    """Look for any route from `z` in a changed scene, and about how long it takes [s]."""
    changed = replace(changed, start=z)
    chart = Roadmap(changed, options.uniqueness_margin)
    search = RouteSearch(chart, make_place(changed.scene, z), goal, sources=sources)
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
            duration = _look_with(search, problem, options, change)
            if duration is not None:
                return _describe_reached(change, duration), (change,)
    most = f"{100 * (max(HANDS) - 1):.0f} %"
    text = f"the goal is not reached with {tried} other lengths or bases of the fingers"
    return f"{text}, up to {most} off", ()


def _look_with(
    search: RouteSearch, problem: Problem, options: PlanOptions, change: Change
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
    """Check that charts can be kept in a folder, which is made if it is not there.

    Raises
    ------
    InputError  if not
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("", "--cache", f"{folder}: {error.strerror}") from None


def load_chart(folder: Path, key: str) -> Roadmap | None:
    """The chart of a scene, by the key of this; None where there is none, or the file is damaged.

    Files are pickles, which can do anything when they are read: a folder that others write to is
    not safe.
    """
    try:
        written = _name(folder, key).read_bytes()
        digest, body = written[:32], written[32:]
        if hashlib.sha256(body).digest() != digest:
            return None
        chart = pickle.loads(body)
    except Exception:
        # A file of whatever kind that cannot be read is one that is not there.
        return None
    return chart if isinstance(chart, Roadmap) else None


def store_chart(folder: Path, key: str, chart: Roadmap) -> None:
    """Write the chart of a scene, in place of what was there; the last one who writes it wins."""
    deepest = sys.getrecursionlimit()
    sys.setrecursionlimit(max(deepest, _RECURSION))
    try:
        body = pickle.dumps(chart, protocol=pickle.HIGHEST_PROTOCOL)
    finally:
        sys.setrecursionlimit(deepest)
    if len(body) <= LARGEST:
        digest = hashlib.sha256(body).digest()
        write_whole(_name(folder, key), lambda stream: stream.write(digest + body))


def _name(folder: Path, key: str) -> Path:
    """The file of a scene: another one for other versions."""
    versions = f"{__version__} {ca.__version__} {np.__version__} {sys.version}"
    return folder / f"{hashlib.sha256(f'{versions} {key}'.encode()).hexdigest()[:32]}.chart"
