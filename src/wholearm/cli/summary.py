"""What `solve` prints of a plan, its replay and its torque table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..planning.phase_plan import combine
from ..problem.uncertainty import PARAMETERS
from ..results.report_text import fixed

if TYPE_CHECKING:
    from ..planning.result import Plan
    from ..problem.definition import Problem
    from ..results.certificate import Certificate
    from ..results.range_figures import RangeFigures
    from ..results.replay_figures import ReplayFigures


_LEAST_ERROR = 1e-9
"""Least estimate of a relative error that is printed: limits are kept to more than that."""


def summarise(plan: Plan, output: str, table: Mapping[str, Any] | None = None) -> str:
    """What has been planned, as text.

    Parameters
    ----------
    plan : Plan
    output : str
        The trajectory file.
    table : mapping, optional
        Name and figures of the torque table, if one is written; see `planning.table_check`.
    """
    trajectory = plan.trajectory
    lines = [
        f"{'phase':>5}  {'duration [s]':>12}  {'least c_n [N]':>13}  {'largest |tau| [N m]':>19}"
    ]
    # Six decimals of what is some hundredths of a newton, and of some newton metres.
    forces = fixed(plan.problem.epsilon or 0.05, 5)
    torques = fixed(float(plan.problem.scene.torque_limit.max()), 7)
    for index, phase in enumerate(plan.phases):
        rows = trajectory.phase == index
        c_n = trajectory.c_n[rows]
        least = c_n[c_n == c_n].min()
        torque = abs(trajectory.tau[rows]).max()
        figures = f"{format(least, forces):>13}  {format(torque, torques):>19}"
        lines.append(f"{phase.number:>5}  {phase.duration:>12.6f}  {figures}")
    lines += _list_modes(plan)
    lines += _list_transitions(plan)
    lines += _list_settlings(plan)
    lines += _describe_held(plan)
    lines += [_describe_replay(plan.replay, plan.problem)]
    lines += [] if plan.certificate is None else _list_bounds(plan.certificate)
    lines += [] if plan.ranges is None else _describe_ranges(plan, plan.ranges)
    lines += _list_table(table) if table is not None else []
    lines += _describe_sureness(plan)
    figure = f"{plan.value:.6f}" if abs(plan.value) >= 1e-2 else f"{plan.value:.6g}"
    value = f"{plan.status.value}: {plan.options.goal.value} = {figure} {plan.unit}"
    if not math.isnan(plan.error):
        # By the figure that is printed: one digit of an estimate.
        error = f"{max(plan.error, _LEAST_ERROR):.0e}"
        missed = float(error) > plan.options.accuracy
        text = f"; accuracy {plan.options.accuracy:g} not reached" if missed else ""
        value += f" (to {error}{text})"
    return "\n".join([*lines, f"{value}, {plan.duration:.6f} s in all; wrote {output}"])


def _describe_held(plan: Plan) -> list[str]:
    """What it costs to hold torques over control periods."""
    scene, free = plan.problem.scene, [own.unheld for own in plan.phases if own.unheld is not None]
    if len(free) < len(plan.phases):
        return []
    value = combine(plan.options.goal, free)
    text = f"torques {scene.control_hold} over {1e3 * scene.control_period:g} ms each:"
    more = f"{plan.value / value - 1:+.2%} of the {plan.options.goal.value}"
    return [f"{text} {more} with free ones, {value:.6f} {plan.unit}"]


def _describe_replay(replay: ReplayFigures | None, problem: Problem) -> str:
    """What the replay of the plan has shown, in a line."""
    if replay is None:
        return "the plan was not replayed"
    ends = [phase.end_deviation for phase in replay.phases if phase.end_deviation]
    least, finer = replay.least_c_n, max(replay.refinements)
    short = problem.epsilon - least.value
    below = f", {short:.1e} N below epsilon between samples" if short > 1e-6 * least.value else ""
    text = (
        f"replayed: least c_n {least.value:{fixed(problem.epsilon or 0.05, 5)}} N on "
        f"{least.contact}{below}, off by at most "
        f"{max((end.position for end in ends), default=0.0):.1e} m and "
        f"{max((end.angle for end in ends), default=0.0):.1e} rad at the ends of phases"
    )
    return text + (f", with up to {2**finer} times the intervals" if finer > 0 else "")


def _describe_sureness(plan: Plan) -> list[str]:
    """Whether contact forces are the only ones, and for how long phases may stay wedged."""
    known = [
        (own.uniqueness_margin, own.number)
        for own in plan.phases
        if own.uniqueness_margin is not None
    ]
    if not known:
        return []
    least, number = min(known)
    text = f"contact forces unique: margin {least.value:.2f} (1 without friction, 0 ambiguous)"
    text += f", least in phase {number}"
    wedged = [
        f"; phase {phase.number} may stay wedged for {1e3 * phase.wedged:.3g} ms"
        for phase in plan.phases
        if phase.wedged
    ]
    return ["".join([text, *wedged])]


def _describe_ranges(plan: Plan, ranges: RangeFigures) -> list[str]:
    """What ranges cost, and how wide they may be."""
    units = {own.name: own.unit for own in PARAMETERS}
    radii = [
        f"{name} {1e3 * radius:g} mm" if units[name] == "m" else f"{name} {100 * radius:g} %"
        for name, radius in ranges.radii.items()
        if radius and units[name] != "s"
    ]
    more = 100 * (plan.value / ranges.nominal - 1)
    lines = [
        f"within ranges of {', '.join(radii)}",
        f"{more:+.1f} % of the {plan.options.goal.value} without ranges, {ranges.nominal:.6f} "
        f"{plan.unit}",
    ]
    if ranges.held:
        numbers = " and ".join(map(str, ranges.held))
        lines.append(f"friction within the ranges may hold the start of phase {numbers}")
    if ranges.largest is not None:
        each = ", ".join("-" if own is None else f"{own:.3g}" for own in ranges.phases)
        text = f"a plan exists for ranges {ranges.largest:.3g} times as wide as the problem's"
        more_text = ", as wide as they make sense" if ranges.capped else ""
        lines.append(f"{text}{more_text}; phase by phase {each}")
    return lines


def _list_bounds(certificate: Certificate) -> list[str]:
    """Table of lower bounds of the durations, and of all that have one together."""
    header = (
        f"{'phases':>8}  {'planned [s]':>12}  {'at least [s]':>12}  {'error [s]':>9}  {'gap':>8}"
    )
    lines, total = ["", f"{header}  lower bounds of the least time"], certificate.total
    for part in (*certificate.parts, *([total] if total is not None else [])):
        ends = dict.fromkeys((part.phases[0], part.phases[-1]))
        row = f"{'all' if part is total else '-'.join(map(str, ends)):>8}  {part.duration:>12.8f}"
        if part.bound is None:
            lines.append(f"{row}  not certified: {part.reason}")
            continue
        lines.append(f"{row}  {part.bound:>12.8f}  {part.error:>9.1e}  {part.gap:>8.1e}")
    missing = [part for part in certificate.parts if part.bound is None]
    if total is not None and missing:
        lines[-1] += "  of those with a bound"
    return [*lines, ""]


def _list_table(table: Mapping[str, Any]) -> list[str]:
    """The torque table, and what its replay does to the phases if it has samples at a rate."""
    what = f"{table['rows']} rows"
    if "sample_rate" in table:
        what += f", {table['interpolation']} at {table['sample_rate']:g} Hz"
    lines, replay = [f"wrote {table['file']}: {what}"], table["replay"]
    if replay is None:
        return lines
    verdict = "holds" if replay["ok"] else "does not hold"
    lines[0] += f"; its replay {verdict}: {replay['reason']}"
    if "sample_rate" not in table:
        return lines
    header = ("phase", "arrival [s]", "planned [s]", "least c_n [N]", "planned [N]")
    lines.append("  ".join([*header, "contact"]))
    for row in replay["phases"]:
        keys = ("arrival", "planned_arrival", "least_c_n", "planned_least_c_n")
        cells = [str(row["phase"]), *(_show(row[key]) for key in keys)]
        padded = [cell.rjust(len(name)) for cell, name in zip(cells, header, strict=True)]
        lines.append("  ".join([*padded, row["contact"] or "-"]))
    return lines


def _list_modes(plan: Plan) -> list[str]:
    """Contact modes of the phases that were planned in the time domain; empty if none was."""
    lines: list[str] = []
    words = {"+": " slides +", "-": " slides -", "rolls": " rolls"}
    for phase in plan.phases:
        for mode in phase.modes:
            contacts = ", ".join(name + words[how] for name, how in mode.contacts.items())
            span = f"{mode.start:.4f} to {mode.stop:.4f} s"
            joints = " ".join(mode.joints)
            lines.append(f"{phase.number:>5}  {span}: {contacts}; joints turn {joints}")
        if phase.sequences:
            lines[-1] += f"; best of {phase.sequences} sequences of modes"
    return ["", "modes, from the start of each phase", *lines, ""] if lines else []


def _list_transitions(plan: Plan) -> list[str]:
    """Table of the impacts that a problem asks for; empty if it has none."""
    if not plan.transitions:
        return []
    saves = f"saves [{plan.unit}]"
    width = len(saves)
    lines = [
        "",
        f"{'after phase':>11}  {'velocity ratio':>14}  {'least impulse [N s per m/s]':>27}  "
        f"{'speed [m/s]':>11}  {saves}",
    ]
    for row in plan.transitions:
        impulse = f"{_show(row.least_impulse)} {row.least_impulse_contact}"
        lines.append(
            f"{row.phase:>11}  {_show(row.velocity_ratio):>14}  {impulse:>27}  "
            f"{_show(row.speed):>11}  {_show(row.saves):>{width}}"
            + ("" if row.possible else f"  stops: {row.reason}")
        )
    return [*lines, ""]


def _list_settlings(plan: Plan) -> list[str]:
    """Table of the ends of phases that are held, and what that costs; empty if there are none."""
    known = [phase.settling for phase in plan.phases if phase.settling is not None]
    if not known:
        return []
    header = "phase  held [ms]  tau [N m]          closes         from [mm]  in [ms]  left [mm]"
    lines = ["", f"{header}  at [mm/s]  parts for a moment"]
    for own in known:
        tau = " ".join(f"{value:8.4f}" for value in own.tau)
        row = f"{own.phase:>5}  {1e3 * own.duration:>9.3g}  {tau}  {own.contact or '-':<13}"
        if own.contact:
            closes = "-" if own.closes is None else f"{1e3 * own.closes:.3g}"
            row += f"  {1e3 * own.gap:>9.3g}  {closes:>7}  {1e3 * own.left:>9.2g}"
            row += f"  {1e3 * own.speed:>9.3g}  {', '.join(own.parts) or '-'}"
        lines.append(row)
    held = sum(own.duration for own in known)
    cost = held / (plan.duration - held)
    lines += [f"warning: {own.warning}" for own in known if own.warning]
    return [*lines, f"held for {held:.6g} s in all, {cost:.1%} of the motion", ""]


def _show(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.6f}"
