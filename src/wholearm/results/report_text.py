"""The report of a replay as text: the verdict with its reason, then aligned tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .report import Report


def write(report: Report) -> str:
    """The report as lines of text."""
    parts = [f"{report.name}: {'ok' if report.ok else 'FAILED'}: {report.reason}"]
    parts += [f"failure: {text}" for text in report.failures[1:]]
    if report.outcome not in (*report.failures, report.reason):
        parts.append(f"end of the replay: {report.outcome}")
    parts += [f"warning: {text}" for text in report.warnings]
    help = report.help
    parts += [f"help: {loss.to_text()}" for loss in help.losses]
    parts += [f"help: {help.approach.to_text()}"] if help.approach is not None else []
    if report.finger_gap is not None:
        gap = report.finger_gap
        parts.append(f"least gap of the fingers: {gap.least:.5g} m at t = {gap.time:.5g} s")
    tables = [_loss_table, _contact_table, _rolling_table, _phase_table, _sure_table]
    tables += [_change_table, _reduced_table, _energy_table]
    parts += [line for table in tables for line in _after_blank(table(report))]
    return "\n".join(parts)


def _force_form(report: Report) -> str:
    """How forces are written: epsilon with three digits, or what is a thousandth of the largest."""
    known = [c.least for p in report.phases for c in p.contacts if not math.isnan(c.least)]
    return fixed(report.epsilon or 1e-3 * max(known, default=0.0))


def _contact_table(report: Report) -> list[str]:
    form = _force_form(report)
    rows = [
        [str(p.number), c.contact, show(c.least, form), show(c.margin, f"+{form}"),
         show(c.time, ".5f")]
        for p in report.phases
        for c in p.contacts
    ]  # fmt: skip
    return align(["phase", "contact", "least c_n [N]", "margin [N]", "at t [s]"], rows, {1})


def _loss_table(report: Report) -> list[str]:
    """Forces where contacts are lost or slip, and what torques change of them."""
    rows = []
    for loss in report.help.losses:
        if loss.kind == "thin":
            continue
        when = show(loss.time, ".5f")
        for own in loss.forces:
            figures = [show(value, f"+{_force_form(report)}") for value in (own.c_n, own.c_t)]
            figures += [show(value, "+.3f") for value in own.per_tau]
            rows.append([when, f"c_n of {own.contact}", *figures])
        if loss.closing:
            value, *per_tau = (show(value, "+.3f") for value in loss.closing)
            until = report.phases[loss.phase - 1].until
            rows.append([when, f"acceleration to {until}", value, "", *per_tau])
    header = ["at t [s]", "where lost", "c_n [N]", "c_t [N]", "per N m of tau_1", "of tau_2"]
    return align(header, rows, {1}) if rows else []


def _rolling_table(report: Report) -> list[str]:
    """Margins to slipping; nothing if no contact rolls."""
    rows = [
        [str(p.number), r.contact, show(r.least, f"+{_force_form(report)}"), show(r.time, ".5f")]
        for p in report.phases
        for r in p.rolling
    ]
    header = ["phase", "rolling", "least mu c_n - |c_t| [N]", "at t [s]"]
    return align(header, rows, {1}) if rows else []


def _phase_table(report: Report) -> list[str]:
    header = ["phase", "until", "end", "arrival [s]", "rate [m/s, rad/s]", "left [m/s]"]
    planned = any(p.deviation is not None for p in report.phases)
    impacts = any(p.end == "impact" for p in report.phases)
    header += ["least impulse [N s]", "on"] if impacts else []
    header += ["end dev. [m]", "[rad]", "largest dev. [m]", "[rad]"] if planned else []
    rows = []
    for p in report.phases:
        row = [
            str(p.number),
            p.until,
            p.end,
            show(p.arrival, ".5f"),
            show(p.arrival_rate, ".1e"),
            show(p.end_speed, ".1e"),
        ]
        if impacts:
            row += [show(p.impact.impulse, ".4g"), p.impact.contact] if p.impact else ["-", "-"]
        for deviation in (p.end_deviation, p.deviation) if planned else ():
            pair = (deviation.position, deviation.angle) if deviation else (None, None)
            row += [show(value, ".1e") for value in pair]
        rows.append(row)
    return align(header, rows, {1, 2, 7} if impacts else {1, 2})


def _sure_table(report: Report) -> list[str]:
    """Whether contact forces are the only ones, and for how long phases may stay at rest."""
    rows = [
        [
            str(p.number),
            show(p.uniqueness_margin and p.uniqueness_margin.value, ".4f"),
            p.uniqueness_margin.contacts if p.uniqueness_margin else "-",
            show(p.uniqueness_margin and p.uniqueness_margin.time, ".5f"),
            show(None if p.wedged is None else 1e3 * p.wedged, ".1f"),
        ]
        for p in report.phases
    ]
    header = ["phase", "uniqueness margin", "least of", "at t [s]", "wedged [ms]"]
    return align(header, rows, {2})


def _change_table(report: Report) -> list[str]:
    """Changes of mode; nothing if there are none."""
    rows = [[str(c.phase), c.what, c.kind, show(c.time, ".5f")] for c in report.changes]
    return align(["phase", "mode of", "", "at t [s]"], rows, {1, 2}) if rows else []


def _reduced_table(report: Report) -> list[str]:
    """The paper's scalar equation; nothing if it was not asked for."""
    header = ["phase", "at t [s]", "Phi_1 [kg m^2]", "Phi_2 [N m s]", "Phi_3 [N m]"]
    header += ["theta_1' [rad/s]", "theta_1'' [rad/s^2]", "residual [N m]"]
    rows = []
    for r in report.reduced:
        figures = r.Phi_1, r.Phi_2, r.Phi_3, r.theta_1_dot, r.theta_1_ddot
        texts = [show(value, ".6g") for value in figures]
        rows.append([str(r.phase), show(r.time, ".5f"), *texts, show(r.residual, ".1e")])
    return align(header, rows, set()) if rows else []


def _energy_table(report: Report) -> list[str]:
    energy = report.energy
    rows = [
        ["work of the torques", energy.work],
        ["change of kinetic energy", energy.kinetic],
        ["change of potential energy", energy.potential],
        ["viscous joint friction", energy.viscous],
        ["dry joint friction", energy.dry],
        ["sliding friction", energy.contact],
        ["contacts gained", energy.impact],
        ["residual", energy.residual],
    ]
    return align(["energy", "[J]"], [[str(n), f"{v: .6e}"] for n, v in rows], {0})


def _after_blank(lines: list[str]) -> list[str]:
    return ["", *lines] if lines else []


def fixed(size: float, digits: int = 3) -> str:
    """The format that gives a value of this size so many significant digits; no zero is minus."""
    places = digits - 1 - math.floor(math.log10(size)) if size > 0 else digits
    return f"z.{min(max(places, 0), 15)}f"


def show(value: float | None, form: str) -> str:
    """A number in some format; a dash where there is none."""
    return "-" if value is None or math.isnan(value) else format(value, form)


def align(header: Sequence[str], rows: Sequence[Sequence[str]], left: set[int]) -> list[str]:
    """Lines of a table with aligned columns; those in `left` are flush left."""
    widths = [max(len(cell) for cell in column) for column in zip(header, *rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if k in left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (header, *rows)
    ]
