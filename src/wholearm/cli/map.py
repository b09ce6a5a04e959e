"""The command ``wholearm map``: contact formations over (x, phi), and those along a route."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from ..common.errors import InputError
from .output import require_output, tell_origin
from .progress import clear_progress, show_progress


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
    from ..results.trajectory_file import load_trajectory

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


def protect(given: Sequence[str]) -> list[str]:
    """Keep argparse from taking pairs of numbers that start with a minus for options.

    Of several pairs it would take one alone after an equals sign.
    """
    texts = list[str]()
    for text in given:
        texts += ["--list", text[7:]] if text.startswith("--list=") else [text]
    return [f" {text}" if _is_pair(text) else text for text in texts]


def _is_pair(text: str) -> bool:
    return text[:1] == "-" and text[1:2] in tuple(".0123456789") and "," in text
