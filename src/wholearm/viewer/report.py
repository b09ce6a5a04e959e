"""A report of a problem and its plans in one page."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence

from ..common.document import Document, Table
from ..comparison.compare import compare
from ..comparison.side_by_side import Contender
from ..mapping.formation_map import FormationMap, build_map, choose_window
from ..problem.definition import Problem
from . import page
from .chart import describe_map
from .motion import describe_motion
from .tables import list_joints, list_phases

_SAMPLES = 8000
"""Of all motions in a page, which they leave at some 3 MB."""
_RESOLUTION = 90
"""Grid of the map: its borders are exact, only cells are drawn by it."""


def build_report(
    problem: Problem,
    paths: Sequence[str],
    text: str = "",
    progress: Callable[[str], None] = lambda text: None,
    chart: FormationMap | None = None,
) -> str:
    """Put plans and torques for a problem, replayed, into one page of HTML.

    Parameters
    ----------
    problem : Problem
    paths : sequence of str
        Trajectory files (.npz) and torques (.csv).
    text : str
        The problem file as it stands.
    progress : callable
        Called with what is being done.
    chart : FormationMap, optional
        The map of the problem, if it is there already.

    Raises
    ------
    InputError
        If a file cannot be read, or is one of another problem; names the file.
    """
    comparison = compare(problem, paths, progress)
    parts = [comparison.summary.to_html()]
    for contender in comparison.contenders:
        progress(f"writing {contender.name}")
        parts += _describe(contender, _SAMPLES // len(comparison.contenders))
    first = next((own.planned for own in comparison.contenders if own.planned is not None), None)
    progress("map")
    chart = chart or build_map(problem, _RESOLUTION, choose_window(problem, None))
    parts += [
        page.write_heading("Contact formations"),
        page.write_chart(*describe_map(chart, first)),
    ]
    parts += [
        page.write_heading("Problem"),
        page.write_text(text or str(problem), "the problem file"),
    ]
    parts += [Document(_name_versions()).to_html()]
    return page.build_page(problem.name, parts)


def _describe(contender: Contender, most: int) -> list[str]:
    """The section of one plan or table of torques: player, verdict, phases and joints.

    Of its motion `most` samples are taken, about.
    """
    problem, planned = contender.problem, contender.planned
    parts = [page.write_heading(contender.name)]
    parts.append(Document("", contender.verdict, contender.reason).to_html())
    replayed = None if contender.report is None else contender.report.trajectory
    shown = planned or replayed
    if shown is None or problem is None:
        return parts
    ghost = replayed if planned is not None else None
    parts.append(page.write_player(describe_motion(shown, problem, ghost, most)))
    timings = shown.meta.get("timings")
    # Routes are planned from parts that are replayed before: then nothing is left of a step.
    known = timings.items() if isinstance(timings, dict) else ()
    took = [(str(name), value) for name, value in known if value and value >= 1e-3]
    tables = [list_phases(problem, shown), list_joints(shown)]
    tables.append(Table(["planning took", "[s]:.4g"], took))
    parts.append(Document("", parts=tables).to_html())
    if contender.report is not None:
        parts.append(page.fold(contender.report.document.to_html(), "what verify says"))
    return parts


def _name_versions() -> str:
    from .. import __version__

    return f"wholearm {__version__}, Python {platform.python_version()}, {platform.machine()}"
