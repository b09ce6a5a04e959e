"""The commands ``route`` and ``map``: formations that lead to a goal, or hold over (x, phi)."""

from __future__ import annotations

import argparse
import json
import os
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from ..common.errors import InputError
from .output import clear_progress, require_output, show_progress, tell_origin

if TYPE_CHECKING:
    from ..planning.options import PlanOptions
    from ..problem.definition import Problem
    from ..search.result import Answer


MOST_JOBS = 2
"""Most processes of a search if nothing else is asked for: there is seldom more to share out."""


def route(options: argparse.Namespace) -> int:
    """Find a route, print its phases, and draw it if that is asked for."""
    from ..planning.options import PlanOptions
    from ..problem.read import read_problem

    require_output(options.output)
    problem = read_problem(options.problem)
    own = PlanOptions(objective=options.objective)
    answer = find(
        problem, own, options.alternatives, options.cache, options.jobs, options.time_limit
    )
    clear_progress()
    print(json.dumps(answer.to_dict(), indent=2) if options.json else answer.to_text(), end="")
    if options.json:
        print()
    if options.output is not None:
        _draw(answer, options.output)
        print(f"wrote {options.output}", file=sys.stderr)
    return 0


def find(
    problem: Problem,
    options: PlanOptions,
    alternatives: int = 0,
    cache: str | None = None,
    jobs: int | None = None,
    time_limit: float | None = None,
) -> Answer:
    """Find a route, with a progress line."""
    from ..common.errors import WholearmError
    from ..common.workers import count_cores
    from ..search.find_route import find_route_with

    count = min(MOST_JOBS, count_cores()) if jobs is None else jobs
    try:
        folder = None if cache is None else Path(cache)
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = _warn
            return find_route_with(
                problem,
                options,
                alternatives,
                show_progress(),
                folder,
                count,
                time_limit=time_limit,
                hurry=hasten,
            )
    except WholearmError:
        clear_progress()
        raise


def _warn(message: Warning | str, *_: object, **__: object) -> None:
    clear_progress()
    print(f"wholearm: warning: {message}", file=sys.stderr, flush=True)


def hasten() -> None:
    """Say that the best route so far is being planned; raises where the command was terminated."""
    from ..common.signals import check

    # After SIGTERM nothing is planned any more.
    check()
    clear_progress()
    print("wholearm: planning the best route; again to stop", file=sys.stderr, flush=True)


def _draw(answer: Answer, output: str) -> None:
    from ..figures import plots
    from ..figures.map_figure import draw_map
    from ..mapping.formation_map import build_map, choose_window

    problem = answer.problem
    chart = build_map(problem, window=choose_window(problem), progress=show_progress())
    plots.save(draw_map(chart, answer.plan.trajectory), output)
    clear_progress()


def draw(options: argparse.Namespace) -> int:
    """Draw the map, or list the formations along a route, or both."""
    from ..problem.read import read_problem

    route = [_read_pair(text, "--list", "X,PHI in m and degrees") for text in options.list or ()]
    phi = options.phi and _read_pair(options.phi, "--phi", "LOW,HIGH in degrees")
    if phi and not 0 < phi[1] - phi[0] <= 360:
        raise InputError("", "--phi", f"{options.phi!r} given; LOW < HIGH <= LOW + 360 is needed")
    if route:
        from math import radians

        from ..mapping.formation_list import format_route, list_formations

        poses = [(x, radians(angle)) for x, angle in route]
        print(format_route(list_formations(read_problem(options.problem), *poses)), end="")
        if options.output is None:
            return 0
    return _draw_map(options, phi)


def _draw_map(options: argparse.Namespace, phi: tuple[float, float] | None) -> int:
    from ..figures import plots
    from ..figures.map_figure import draw_map
    from ..mapping.formation_map import build_map, choose_window
    from ..problem.read import read_problem
    from ..results.trajectory import load_trajectory

    output = options.output or f"map_{os.path.splitext(os.path.basename(options.problem))[0]}.png"
    require_output(output)
    problem = read_problem(options.problem)
    plan = None if options.plan is None else load_trajectory(options.plan)
    if plan is not None:
        tell_origin(problem, (options.plan, plan), silent=bool(options.list))
    window = choose_window(problem, phi)
    margin = options.uniqueness_margin
    limit = {} if margin is None else {"uniqueness_margin": margin}
    known = build_map(problem, window=window, progress=show_progress(), **limit)
    plots.save(draw_map(known, plan), output)
    clear_progress()
    print(f"wrote {output}", file=sys.stderr if options.list else sys.stdout)
    return 0


def _read_pair(text: str, key: str, allowed: str) -> tuple[float, float]:
    from ..common.errors import require_number

    parts = text.split(",")
    try:
        first, second = (require_number(float(part), key) for part in parts)
    except ValueError:
        raise InputError("", key, f"{text.strip()!r} given; allowed is {allowed}") from None
    return first, second
