"""The report of replays in an engine, as text and as plain data."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.arrays import Array
from ..results.report_text import align
from .departure import PRESS, Departure

if TYPE_CHECKING:
    from .replay import EngineReport
    from .stretch import Stretch

PARTS = 5
"""Equal parts of a stretch at whose ends the error is listed."""


def write(report: EngineReport) -> str:
    """The report as lines of text; lengths in mm and angles in degrees."""
    scales, departures = report.problem.scene.scales, report.levels[0].departures
    setting = report.levels[0].setting
    millimetres, degrees = report.allowed * scales.length * 1e3, math.degrees(report.allowed)
    worst = max(float(np.max(each.position)) for each in departures) * 1e3
    turned = math.degrees(max(float(np.max(each.angle)) for each in departures))
    verdict = "ok" if report.ok else "DEPARTS" if report.converged else "NOT CONVERGED"
    says = "departs" if report.converged else "departs with some settings only, here"
    lost = [
        f"phase {name_phases(stretch)} {says} at t = {found.time:.5g} s: {found.reason}"
        for stretch, found in zip(report.stretches, departures, strict=True)
        if found.time is not None
    ]
    lines = [
        f"{report.problem.name} in {report.title}: "
        f"{verdict}: within {worst:.4f} mm and {turned:.4f} degrees of "
        f"the plan (allowed {millimetres:.4g} mm, {degrees:.3g} degrees)",
        *lost,
        f"steps of up to {setting.step * scales.time:.3g} s, softness {setting.softness:g}; "
        "torques contain the dry friction of the joints, with its planned signs",
        "",
        *_write_errors(report),
        "",
        *_write_forces(report),
    ]
    if len(report.levels) > 1:
        lines += ["", *_write_levels(report)]
    return "\n".join(lines)


def _write_errors(report: EngineReport) -> list[str]:
    """Errors of the pose, at worst and over time."""
    shares = [f"{k / PARTS:.0%}" for k in range(1, PARTS + 1)]
    header = ["phase", "duration [s]", "largest [mm]", "[deg]", *(f"{s} [mm]" for s in shares)]
    rows = []
    for stretch, found in zip(report.stretches, report.levels[0].departures, strict=True):
        at = np.linspace(stretch.start, stretch.stop, PARTS + 1)[1:]
        over = np.interp(at, found.t, found.position * 1e3)
        figures = [np.max(found.position) * 1e3, math.degrees(float(np.max(found.angle))), *over]
        duration = f"{stretch.stop - stretch.start:.6f}"
        rows.append([name_phases(stretch), duration, *(f"{value:.4f}" for value in figures)])
    return align(header, rows, set())


def _write_forces(report: EngineReport) -> list[str]:
    """Averages of normal forces."""
    header = ["phase", "contact", "planned mean c_n [N]", "found [N]", "off [%]"]
    least = PRESS * report.problem.scene.scales.force
    forces = [force for found in report.levels[0].departures for force in found.forces]
    rows = [
        [
            str(force.phase),
            force.contact,
            f"{force.planned:.4f}",
            f"{force.found:.4f}",
            f"{100 * force.off:+.2f}" if force.planned > least else "-",
        ]
        for force in forces
    ]
    return align(header, rows, {1})


def _write_levels(report: EngineReport) -> list[str]:
    """Largest errors of the position with finer settings."""
    time = report.problem.scene.scales.time
    header = ["step [s]", "softness", *(f"{name_phases(s)} [mm]" for s in report.stretches)]
    rows = [
        [
            f"{level.setting.step * time:.3g}",
            f"{level.setting.softness:g}",
            *(f"{np.max(found.position) * 1e3:.4f}" for found in level.departures),
        ]
        for level in report.levels
    ]
    return align(header, rows, set())


def name_phases(stretch: Stretch) -> str:
    """Numbers of the phases, first to last."""
    ends = dict.fromkeys((stretch.phases[0] + 1, stretch.phases[-1] + 1))
    return "-".join(map(str, ends))


def to_dict(report: EngineReport) -> dict[str, Any]:
    """The report for machines, in m, rad, s and N."""
    scales = report.problem.scene.scales
    levels = []
    for level in report.levels:
        parts = zip(report.stretches, level.departures, strict=True)
        levels.append(
            {
                "step": level.setting.step * scales.time,
                "softness": level.setting.softness,
                "stretches": [_describe(stretch, found) for stretch, found in parts],
            }
        )
    return {
        "problem": report.problem.name,
        "engine": report.title,
        "ok": report.ok,
        "converged": report.converged,
        "allowed": {"position": report.allowed * scales.length, "angle": report.allowed},
        "levels": levels,
    }


def _describe(stretch: Stretch, found: Departure) -> dict[str, Any]:
    largest = np.array([np.max(found.position), np.max(found.angle)])
    return {
        "phases": [index + 1 for index in stretch.phases],
        "start": stretch.start,
        "stop": stretch.stop,
        "largest": dict(zip(("position", "angle"), _list(largest), strict=True)),
        "departs": None if found.time is None else {"time": found.time, "reason": found.reason},
        "forces": [force._asdict() for force in found.forces],
        "t": found.t.tolist(),
        "position": _list(found.position),
        "angle": _list(found.angle),
    }


def _list(values: Array) -> list[float | None]:
    """Numbers for JSON, which has nothing but null for those of an engine that fails."""
    return [value if math.isfinite(value) else None for value in values.tolist()]
