"""A gallery of problems: figure, movie and a line of figures for each."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial

from ..common.document import Table
from ..common.files import make_folder, write_text
from ..figures import plots
from ..geometry.tracing import load
from ..planning.result import Plan
from ..search.solve import solve
from ..verification.verify import verify
from .movie import Movie, write_movie

_WIDTH, _DOTS = 8.0, 110  # of figures [in] and [dots per inch]
_LASTS, _RESOLUTION = 2.0, 50  # of movies [s] and [dots per inch]
_HEADS = ["problem", "phases:d", "least time [s]:.6f", "least c_n [N]:.4f", "finger gap [mm]:.1f"]


def write_gallery(
    paths: Sequence[str], page: str, progress: Callable[[str], None] = lambda text: None
) -> None:
    """Plan the least time of problems and write them to a page of Markdown.

    Figures and movies go to a folder beside the page that has its name.

    Raises
    ------
    WholearmError  if a problem cannot be read or planned; the page is written only if all are
    """
    folder = os.path.splitext(page)[0]
    make_folder(folder)
    rows, pictures = [], list[str]()
    for path in paths:
        name = os.path.splitext(os.path.basename(path))[0]
        progress(name)
        plan = solve(load(path), progress=partial(_say, progress, name))
        progress(f"{name}: figure and movie")
        _draw(plan, os.path.join(folder, name))
        rows.append(_list_figures(name, plan))
        place = f"{os.path.basename(folder)}/{name}"
        links = f"![{name} in motion]({place}.gif)\n\n![{name}]({place}.png)"
        pictures.append(f"## {plan.problem.name}\n\n{links}")
    text = (
        f"Least-time plans, each slowed down to {_LASTS:g} s: contact forces in their friction "
        "cones, and torques as arcs at the joints."
    )
    table = Table([*_HEADS, "replayed"], rows).to_markdown()
    write_text(page, "\n\n".join(["# Gallery", text, table, *pictures]) + "\n")


def _say(progress: Callable[[str], None], name: str, text: str) -> None:
    progress(f"{name}: {text}")


def _draw(plan: Plan, stem: str) -> None:
    """Write the figure and the movie of a plan."""
    plots.save(plots.force_margins(plan, width=_WIDTH), f"{stem}.png", resolution=_DOTS)
    speed = plan.duration / _LASTS
    movie = Movie(plan.problem, plan.trajectory, speed=speed, resolution=_RESOLUTION)
    write_movie(movie, f"{stem}.gif")


def _list_figures(name: str, plan: Plan) -> tuple[object, ...]:
    """A row of the table: what the plan comes to, and what a replay says."""
    report = verify(plan.problem, plan)
    gap = "" if report.finger_gap is None else report.finger_gap.least
    least = min(
        contact.least
        for phase in report.phases
        for contact in phase.contacts
        if contact.least == contact.least
    )
    verdict = "ok" if report.ok else "FAILED"
    return name, len(plan.phases), plan.value, least, gap, verdict
