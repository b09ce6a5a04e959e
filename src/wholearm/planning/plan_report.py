"""Report of a plan: phases, replay, bounds, ranges and torque table."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from ..common.document import Document, Table, fixed
from ..problem.uncertainty import PARAMETERS
from .phase_plan import combine

if TYPE_CHECKING:
    from .result import Plan

_LEAST_ERROR = 1e-9  # least relative error that is printed: limits are kept to more than that


def describe_plan(plan: Plan, output: str = "", table: Mapping[str, Any] | None = None) -> Document:
    """Report of a plan, its trajectory file `output`, and the figures of its torque `table`."""
    figure = f"{plan.value:.6f}" if abs(plan.value) >= 1e-2 else f"{plan.value:.6g}"
    value = f"{plan.status.value}: {plan.options.goal.value} = {figure} {plan.unit}"
    if not math.isnan(plan.error):
        # Compared as printed, with one digit.
        error = f"{max(plan.error, _LEAST_ERROR):.0e}"
        missed = float(error) > plan.options.accuracy
        text = f"; accuracy {plan.options.accuracy:g} not reached" if missed else ""
        value += f" (to {error}{text})"
    wrote = f"; wrote {output}" if output else ""
    parts = [
        _list_phases(plan),
        _list_modes(plan),
        _list_transitions(plan),
        *_list_settlings(plan),
        *_describe_held(plan),
        _describe_replay(plan),
        _list_bounds(plan),
        *_describe_ranges(plan),
        *(() if table is None else _list_table(table)),
        _describe_uniqueness(plan),
        f"{value}, {plan.duration:.6f} s in all{wrote}",
    ]
    return Document("", parts=parts)


def _list_phases(plan: Plan) -> Table:
    forces = fixed(plan.problem.epsilon or 0.05, 5)
    torques = fixed(float(plan.problem.scene.torque_limit.max()), 7)
    rows = []
    for index, phase in enumerate(plan.phases):
        own = plan.trajectory.phase == index
        c_n = plan.trajectory.c_n[own]
        torque = abs(plan.trajectory.tau[own]).max()
        rows.append((phase.number, phase.duration, c_n[c_n == c_n].min(), torque))
    heads = ["phase:d", "duration [s]:.6f", f"least c_n [N]:{forces}"]
    return Table([*heads, f"largest |tau| [N m]:{torques}"], rows)


def _list_modes(plan: Plan) -> Table:
    """Contact modes of the phases that were planned in the time domain."""
    words = {"+": " slides +", "-": " slides -", "rolls": " rolls"}
    rows = []
    for phase in plan.phases:
        for mode in phase.modes:
            contacts = ", ".join(name + words[how] for name, how in mode.contacts.items())
            text = f"{contacts}; joints turn {' '.join(mode.joints)}"
            if phase.sequences and mode is phase.modes[-1]:
                text += f"; best of {phase.sequences} sequences of modes"
            rows.append((phase.number, mode.start, mode.stop, text))
    heads = ["phase:d", "from [s]:.4f", "to [s]:.4f", "contact modes"]
    return Table(heads, rows, "modes, from the start of each phase")


def _list_transitions(plan: Plan) -> Table:
    """The impacts that a problem asks for."""
    columns = {
        "phase": "after phase:d", "velocity_ratio": "velocity ratio:.6f",
        "least_impulse": "least impulse [N s per m/s]:.6f", "least_impulse_contact": "of",
        "speed": "speed [m/s]:.6f", "saves": f"saves [{plan.unit}]:.6f", "stop": "",
    }  # fmt: skip
    return Table.of(plan.transitions, columns)


def _list_settlings(plan: Plan) -> Iterator[str | Table]:
    """The dwells of phases, and their duration."""
    known = [phase.settling for phase in plan.phases if phase.settling is not None]
    if not known:
        return
    rows = []
    for own in known:
        closing = (own.gap, own.closes, own.left, own.speed, ", ".join(own.parts) or "-")
        row = (own.phase, own.duration, own.tau, own.contact or "-")
        rows.append(row + (closing if own.contact else ("",) * 5))
    heads = ["phase:d", "held [ms]:.3g", "tau [N m]:8.4f", "closes", "from [mm]:.3g"]
    heads += ["in [ms]:.3g", "left [mm]:.2g", "at [mm/s]:.3g", "parts for a moment"]
    yield Table(heads, rows)
    held = sum(own.duration for own in known)
    yield from (f"warning: {own.warning}" for own in known if own.warning)
    yield f"held for {held:.6g} s in all, {held / (plan.duration - held):.1%} of the motion"


def _describe_held(plan: Plan) -> Iterator[str]:
    """Relative cost of torques held over control periods."""
    scene, free = plan.problem.scene, [own.unheld for own in plan.phases if own.unheld is not None]
    if len(free) == len(plan.phases):
        value = combine(plan.options.goal, free)
        text = f"torques {scene.control_hold} over {1e3 * scene.control_period:g} ms each:"
        more = f"{plan.value / value - 1:+.2%} of the {plan.options.goal.value}"
        yield f"{text} {more} with free ones, {value:.6f} {plan.unit}"


def _describe_replay(plan: Plan) -> str:
    """Least normal force and final errors of the replay."""
    replay, epsilon = plan.replay, plan.problem.epsilon
    if replay is None:
        return "the plan was not replayed"
    ends = [phase.end_deviation for phase in replay.phases if phase.end_deviation]
    least, finer = replay.least_c_n, max(replay.refinements)
    short = epsilon - least.value
    below = f", {short:.1e} N below epsilon between samples" if short > 1e-6 * least.value else ""
    text = (
        f"replayed: least c_n {least.value:{fixed(epsilon or 0.05, 5)}} N on "
        f"{least.contact}{below}, off by at most "
        f"{max((end.position for end in ends), default=0.0):.1e} m and "
        f"{max((end.angle for end in ends), default=0.0):.1e} rad at the ends of phases"
    )
    return text + (f", with up to {2**finer} times the intervals" if finer > 0 else "")


def _list_bounds(plan: Plan) -> Table:
    """Lower bounds of the durations, and their sum."""
    rows, certificate = list[tuple[Any, ...]](), plan.certificate
    for part in certificate.parts if certificate else ():
        ends = dict.fromkeys((part.phases[0], part.phases[-1]))
        known = part.bound, part.error, part.gap
        text = f"not certified: {part.reason}" if part.bound is None else ""
        rows.append(("-".join(map(str, ends)), part.duration, *known, text))
    if certificate and (total := certificate.total):
        text = "of those with a bound" if any(row[-1] for row in rows) else ""
        rows.append(("all", total.duration, total.bound, total.error, total.gap, text))
    heads = ["phases:d", "planned [s]:.8f", "at least [s]:.8f", "error [s]:.1e", "gap:.1e"]
    return Table([*heads, "lower bounds of the least time"], rows)


def _describe_ranges(plan: Plan) -> Iterator[str]:
    """Relative cost of ranges, and the largest feasible ones."""
    ranges = plan.ranges
    if ranges is None:
        return
    units = {own.name: own.unit for own in PARAMETERS}
    radii = [
        f"{name} {1e3 * radius:g} mm" if units[name] == "m" else f"{name} {100 * radius:g} %"
        for name, radius in ranges.radii.items()
        if radius and units[name] != "s"
    ]
    yield f"within ranges of {', '.join(radii)}"
    more = f"{100 * (plan.value / ranges.nominal - 1):+.1f} % of the {plan.options.goal.value}"
    yield f"{more} without ranges, {ranges.nominal:.6f} {plan.unit}"
    if ranges.held:
        numbers = " and ".join(map(str, ranges.held))
        yield f"friction within the ranges may hold the start of phase {numbers}"
    if ranges.largest is not None:
        each = ", ".join("-" if own is None else f"{own:.3g}" for own in ranges.phases)
        text = f"a plan exists for ranges {ranges.largest:.3g} times as wide as the problem's"
        capped = ", as wide as they make sense" if ranges.capped else ""
        yield f"{text}{capped}; phase by phase {each}"


def _list_table(table: Mapping[str, Any]) -> Iterator[str | Table]:
    """The torque table, and the phases of its replay if it has samples at a rate."""
    sampled, replay = "sample_rate" in table, table["replay"]
    rate = f", {table['interpolation']} at {table['sample_rate']:g} Hz" if sampled else ""
    text = f"wrote {table['file']}: {table['rows']} rows{rate}"
    if replay is not None:
        verdict = "holds" if replay["ok"] else "does not hold"
        text += f"; its replay {verdict}: {replay['reason']}"
    yield text
    if sampled and replay is not None:
        keys = ("phase", "arrival", "planned_arrival", "least_c_n", "planned_least_c_n")
        rows = [(*(row[key] for key in keys), row["contact"] or "-") for row in replay["phases"]]
        heads = ["phase:d", "arrival [s]:.6f", "planned [s]:.6f", "least c_n [N]:.6f"]
        yield Table([*heads, "planned [N]:.6f", "contact"], rows)


def _describe_uniqueness(plan: Plan) -> str:
    """Uniqueness margin of contact forces, and for how long phases are possibly stuck."""
    margins = [(own.uniqueness_margin, own.number) for own in plan.phases if own.uniqueness_margin]
    if not margins:
        return ""
    least, number = min(margins)
    text = f"contact forces unique: margin {least.value:.2f} (1 without friction, 0 ambiguous)"
    wedged = [
        f"; phase {phase.number} may stay wedged for {1e3 * phase.wedged:.3g} ms"
        for phase in plan.phases
        if phase.wedged
    ]
    return "".join([text, f", least in phase {number}", *wedged])
