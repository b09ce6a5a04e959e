"""A report of a problem and its plans in one page, and a gallery of problems."""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import matplotlib
import numpy as np

from ..analysis.comparison import Contender, compare
from ..common.arrays import Array
from ..common.document import Document, Table, fixed, show, write_svg
from ..common.errors import WholearmError
from ..common.files import make_folder, number_same, require_writable, together, write_text
from ..common.sharing import exclusive
from ..contacts.closing import close_fingers
from ..contacts.elemental import Contact
from ..figures import plots
from ..figures.map_figure import BOX, PLACE, SIZE, draw_map, find_room, split_regions
from ..figures.style import STYLE
from ..geometry.curve import describe_pose
from ..geometry.tracing import load
from ..mapping.formation_map import Border, FormationMap, build_map, time_borders
from ..planning.result import Plan
from ..problem.definition import Problem
from ..results.trajectory import Trajectory
from ..search import solve
from ..verification.verify import verify
from . import page
from .movie import write_movie


def build_report(
    problem: Problem,
    paths: Sequence[str],
    text: str = "",
    progress: Callable[[str], None] = lambda text: None,
    sensitivities: bool = False,
) -> str:
    """One page of HTML with replays of the plans (.npz) and torques (.csv) at `paths`.

    It has the `text` of the problem file, a map, and, with `sensitivities`, the effects of 1 % more
    of each number.

    InputError if a file cannot be read, or is one of another problem; names the file.
    """
    from .. import __version__

    comparison = compare(problem, paths, progress)
    parts = [comparison.summary.to_html()]
    for contender in comparison.contenders:
        progress(f"writing {contender.name}")
        # With all motions a page has about 3 MB.
        parts += _describe(contender, 8000 // len(comparison.contenders))
    first = next(filter(None, (contender.planned for contender in comparison.contenders)), None)
    if sensitivities:
        from ..design.sensitivities import find_sensitivities
        from ..figures.result_figures import draw_sensitivities

        result = find_sensitivities(comparison.contenders[0].problem or problem, progress=progress)
        parts += ["<h2>What 1 % more of each number is worth</h2>"]
        parts += [write_svg(draw_sensitivities(result)), result.document.to_html()]
    progress("map")
    formation_map = build_map(problem, 90)
    machine = f"Python {platform.python_version()}, {platform.machine()}"
    parts += [
        "<h2>Contact formations</h2>",
        page.write_map(*describe_map(formation_map, first)),
        "<h2>Problem</h2>",
        page.fold(f"<pre>{escape(text or str(problem))}</pre>", "the problem file"),
        Document(f"wholearm {__version__}, {machine}").to_html(),
    ]
    return page.build_page(problem.name, parts)


def _describe(contender: Contender, most: int) -> list[str]:
    """The section of one plan or table of torques: player, verdict, phases and junctions.

    The player has about `most` samples.
    """
    problem, planned, report = contender.problem, contender.planned, contender.report
    parts = [f"<h2>{escape(contender.name)}</h2>"]
    parts.append(Document("", contender.verdict, contender.reason).to_html())
    replayed = contender.replayed
    motion = planned or replayed
    if motion is not None and problem is not None:
        ghost = replayed if planned is not None else None
        parts.append(page.write_player(page.describe_motion(motion, problem, ghost, most)))
        timings = motion.meta.get("timings")
        # Parts of routes are replayed before: steps of the whole then take no time.
        steps = timings.items() if isinstance(timings, dict) else ()
        durations = [(str(name), value) for name, value in steps if value and value >= 1e-3]
        tables = [list_phases(problem, motion), list_junctions(motion)]
        tables.append(Table(["planning took", "[s]:.4g"], durations))
        parts.append(Document("", parts=tables).to_html())
    if report is not None:
        parts.append(page.fold(report.document.to_html(), "what verify says"))
    return parts


def list_phases(problem: Problem, trajectory: Trajectory) -> Table:
    """A row for each phase that the motion enters."""
    rows = []
    for index, least in enumerate(trajectory.least_forces):
        phase, t = problem.phases[index], trajectory.t[trajectory.phase == index]
        contacts = " ".join(contact.name for contact in phase.formation.contacts)
        text = contacts, str(phase.until), phase.end.value
        rows.append((index + 1, *text, t[-1] - t[0], *least))
    force = fixed(problem.epsilon or 0.05)
    heads = ["phase:d", "contacts", "until", "end", "duration [s]:.6f", f"least c_n [N]:{force}"]
    return Table([*heads, "of"], rows)


def list_junctions(trajectory: Trajectory) -> Table:
    """A row for each junction of two phases."""
    rows, planar = [], np.hypot(*trajectory.q_dot[:, :2].T)
    force = fixed(min(float(np.nanmax(trajectory.c_n, initial=0.0)), 10.0), 5)
    speed = fixed(min(float(planar.max()), 0.5), 4)
    torque = fixed(min(float(np.abs(trajectory.tau).max()), 2.0), 5)
    for last in np.flatnonzero(np.diff(trajectory.phase)):
        # Before a step of torques a replay has a rest of zero duration, without forces.
        after = np.searchsorted(trajectory.t, trajectory.t[last + 1], side="right") - 1
        sides = [last, after]
        forces = [
            f"{name}: {show(before, force)} \u2192 {show(after, force)}"
            for name, before, after in zip(trajectory.contacts, *trajectory.c_n[sides], strict=True)
            if math.isfinite(before) or math.isfinite(after)
        ]
        x, _, phi = trajectory.q[after]
        place = trajectory.t[after], x, phi
        torques = trajectory.tau[sides].T.ravel()
        number = trajectory.phase[last] + 1
        rows.append((number, ", ".join(forces), *place, *planar[sides], *torques))
    heads = ["after phase:d", "c_n before \u2192 after [N]", "t [s]:.6f", "x [mm]:z.3f"]
    heads += ["phi [deg]:z.3f", f"speed before [m/s]:{speed}", f"after:{speed}"]
    heads += [f"tau1 before [N m]:{torque}", f"after:{torque}"]
    return Table([*heads, f"tau2 before:{torque}", f"after:{torque}"], rows)


@exclusive
def describe_map(chart: FormationMap, plan: Trajectory | None) -> tuple[str, dict[str, Any]]:
    """A map with a plan, or the problem's phases, as SVG, and data of its places for clicks.

    Returns
    -------
    drawing  with the ids of `figures.map_figure`
    places   "hand": the hand and the object; "places": `contacts`, a `text` and the poses `z` of
             the places, by their numbers in these ids; "axes": ranges of x [mm] and phi [deg], and
             their box in the drawing
    """
    scene = chart.problem.scene
    with matplotlib.rc_context(STYLE | {"svg.fonttype": "none"}):
        # Restrict its style to the map.
        drawing = write_svg(draw_map(chart, plan)).replace("*{", ".map *{")
    parts = list(split_regions(chart.cell))
    step = np.array([np.ptp(chart.phi) / len(chart.phi), np.ptp(chart.x) / len(chart.x)])
    centres = [find_room(region, step / np.ptp(chart.x)) for _, region in parts]
    middles = np.array([[chart.x[column], chart.phi[row]] for row, column, _ in centres])
    poses = close_fingers(scene, *middles.T).z

    def describe(contacts: Iterable[Contact], text: str, z: Array) -> dict[str, Any]:
        return {"contacts": [c.name for c in contacts], "text": text, "z": page.round_z(z, scene)}

    places = []
    for (index, _), point, z in zip(parts, middles, poses, strict=True):
        text = f"a cell, two freedoms; its middle is at {describe_pose(point)}"
        places.append(describe(chart.formations[index], text, z[None]) | {"wide": True})
    flush = [border for border in chart.borders if border.flush is not None]
    for border, times in zip(flush, time_borders(chart.problem, flush), strict=True):
        # Clicks cannot distinguish more than 40 points.
        rows = np.unique(np.linspace(0, len(border.z) - 1, 40).round().astype(int))
        places.append(describe(border.contacts, _describe_border(border, times), border.z[rows]))
    for crossing in chart.crossings:
        text = f"a crossing at {describe_pose(crossing.point)}"
        places.append(describe(crossing.contacts, text, crossing.z[None]))
    low, high = ([1e3 * float(chart.x[k]), math.degrees(chart.phi[k])] for k in (0, -1))
    axes = {"low": low, "high": high, "box": [72 * v for v in BOX], "tall": 72 * SIZE[1]}
    return drawing, {"id": PLACE, "hand": page.describe_hand(scene), "places": places, "axes": axes}


def _describe_border(border: Border, times: Array) -> str:
    """The range of a border, and possible motions along it in both directions."""
    directions = zip(("increasing", "decreasing"), (border.forth, border.back), times, strict=True)
    possible = []
    for direction, flags, time in directions:
        where = "all along" if flags.all() else "on parts" if flags.any() else "nowhere"
        least = f"least time about {time:.3f} s"
        text = least if math.isfinite(time) else "no motion from end to end"
        possible.append(f"{border.along} {direction}: {text}, slow motions {where}")
    (x, phi), (x_end, phi_end) = border.points[0], border.points[-1]
    return (
        f"a border, one freedom, x {1e3 * x:.1f} to {1e3 * x_end:.1f} mm, phi "
        f"{math.degrees(phi):.1f} to {math.degrees(phi_end):.1f} deg; {'; '.join(possible)}"
    )


def write_gallery(
    paths: Sequence[str], path: str, progress: Callable[[str], None] = lambda text: None
) -> list[str]:
    """Write a page of Markdown with time-optimal plans of problems; returns failures by file.

    Figures and movies, which last 2 s, are in a folder beside the page, with its name. Problems
    without a plan have a row with the reason.

    InputError if a problem cannot be read, or a file cannot be written; then no file is written.
    """
    problems, folder = [*map(load, paths)], os.path.splitext(path)[0]
    make_folder(os.path.dirname(path) or os.curdir)
    require_writable(path)
    plans, rows, pictures = list[Plan | str](), list[tuple[object, ...]](), list[str]()
    for source, problem in zip(paths, problems, strict=True):
        try:
            plans.append(solve(problem, progress=lambda text, s=source: progress(f"{s}: {text}")))
        except WholearmError as error:
            plans.append(str(error).removeprefix(f"{source}: "))
    stems = [Path(source).stem for source in paths]
    titles = stems if len({*stems}) == len(stems) else paths
    with together():
        make_folder(folder)
        for title, name, plan in zip(titles, number_same(stems), plans, strict=True):
            if isinstance(plan, str):
                rows.append((title, None, None, None, "", f"no plan: {plan}"))
                continue
            progress(f"{name}: figure and movie")
            stem = os.path.join(folder, name)
            plots.save(plots.force_margins(plan, width=8.0), f"{stem}.png", resolution=110)
            options: Any = {"speed": plan.duration / 2.0, "resolution": 50}
            write_movie(f"{stem}.gif", plan.problem, plan.trajectory, **options)
            report = verify(plan.problem, plan)
            gap = "" if report.finger_gap is None else report.finger_gap.least
            least = report.least_force
            verdict = "ok" if report.ok else "FAILED"
            rows.append((title, len(plan.phases), plan.value, least and least.value, gap, verdict))
            place = quote(f"{os.path.basename(folder)}/{name}")
            links = f"![{name} in motion]({place}.gif)\n\n![{name}]({place}.png)"
            heading = ": ".join(dict.fromkeys((title, plan.problem.name)))
            pictures.append(f"## {heading}\n\n{links}")
        text = (
            "Least-time plans, each shown in about 2 s: contact forces in their friction cones, "
            "and torques as arcs at the joints."
        )
        heads = ["problem", "phases:d", "least time [s]:.6f", "least c_n [N]:.4f"]
        table = Table([*heads, "finger gap [mm]:.1f", "replayed"], rows)
        write_text(path, Document("Gallery", parts=[text, table, *pictures]).to_markdown())
    return [f"{s}: {text}" for s, text in zip(paths, plans, strict=True) if isinstance(text, str)]
