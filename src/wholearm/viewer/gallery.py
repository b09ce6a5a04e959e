"""A gallery of problems: figure, movie and a line of figures for each."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from ..common.document import Table
from ..common.files import make_folder, write_text
from ..figures import plots
from ..geometry.tracing import load
from ..search.solve import solve
from ..verification.verify import verify
from .movie import Movie, write_movie


def write_gallery(
    paths: Sequence[str], page: str, progress: Callable[[str], None] = lambda text: None
) -> None:
    """Plan the least time of problems and write them to a page of Markdown.

    Figures and movies, which last 2 s, go to a folder beside the page that has its name.

    Raises
    ------
    WholearmError  if a problem cannot be read or planned; the page is written only if all are
    """
    folder = os.path.splitext(page)[0]
    make_folder(folder)
    rows, pictures = list[tuple[object, ...]](), list[str]()
    for path in paths:
        name = os.path.splitext(os.path.basename(path))[0]
        progress(name)
        plan = solve(load(path), progress=lambda text, name=name: progress(f"{name}: {text}"))
        progress(f"{name}: figure and movie")
        stem = os.path.join(folder, name)
        plots.save(plots.force_margins(plan, width=8.0), f"{stem}.png", resolution=110)
        movie = Movie(plan.problem, plan.trajectory, speed=plan.duration / 2.0, resolution=50)
        write_movie(movie, f"{stem}.gif")
        report = verify(plan.problem, plan)
        gap = "" if report.finger_gap is None else report.finger_gap.least
        forces = (contact.least for phase in report.phases for contact in phase.contacts)
        least = min(force for force in forces if force == force)
        verdict = "ok" if report.ok else "FAILED"
        rows.append((name, len(plan.phases), plan.value, least, gap, verdict))
        place = f"{os.path.basename(folder)}/{name}"
        links = f"![{name} in motion]({place}.gif)\n\n![{name}]({place}.png)"
        pictures.append(f"## {plan.problem.name}\n\n{links}")
    text = (
        "Least-time plans, each slowed down to 2 s: contact forces in their friction cones, and "
        "torques as arcs at the joints."
    )
    heads = ["problem", "phases:d", "least time [s]:.6f", "least c_n [N]:.4f"]
    table = Table([*heads, "finger gap [mm]:.1f", "replayed"], rows).to_markdown()
    write_text(page, "\n\n".join(["# Gallery", text, table, *pictures]) + "\n")
