"""Parts of traced curves: location of a configuration, cutting, reversing and joining."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import Array
from ..mechanics.dynamics import metric_weights
from ..problem.definition import Phase
from .curve import Curve, Panel, Segment
from .tracing import trace_phase


def find_on(curve: Curve, z: Array) -> float | None:
    """Where a configuration, shape (5,), is on a curve [m]; None if it is not on it."""
    rho, weights = curve.formation.scene.scales.length, metric_weights(curve.formation.scene)
    near = 1e-9 * rho
    nodes = np.concatenate([panel.z for panel in curve.panels])
    away = (nodes - z) ** 2 @ weights
    first = int(away.argmin())
    if away[first] > (0.2 * rho) ** 2:
        return None
    s = float(np.concatenate([panel.s for panel in curve.panels])[first])
    for _ in range(8):
        s = min(max(s, 0.0), curve.length)
        at, tangent = curve.interpolate(np.array([s]))
        change = float((z - at[0]) * weights @ tangent[0])
        if abs(change) < near / 100:
            break
        s += change
    off = float(np.sqrt((z - at[0]) ** 2 @ weights))
    return s if off < near else None


def take(curve: Curve, start: float, stop: float) -> Curve:
    """The part of a curve between two places [m], run from the first one to the second one."""
    low, high = min(start, stop), max(start, stop)
    back, length = start > stop, high - low
    panels = []
    for panel in curve.panels:
        first, last = max(float(panel.s[0]), low), min(float(panel.s[-1]), high)
        # What is missing at an end is extrapolated.
        if last - first < 1e-9 * length:
            continue
        own = panel if (first, last) == (panel.s[0], panel.s[-1]) else _cut(panel, first, last)
        columns = (high - own.s)[::-1], own.z[::-1], -own.z_s[::-1]
        panels.append(Panel(*columns) if back else Panel(own.s - low, own.z, own.z_s))
    sign = -1.0 if back else 1.0
    segments = []
    for part in curve.segments:
        ends = max(part.start, low), min(part.stop, high)
        if ends[1] - ends[0] > 1e-7 * length:
            first, last = sorted(sign * (end - start) for end in ends)
            # Zero has no sign.
            segments.append(Segment(first, last, sign * part.Xi + 0.0, sign * part.sigma + 0.0))
    step = -1 if back else 1
    return _make(curve, panels[::step], segments[::step], length)


def join(back: Curve | None, forth: Curve | None) -> Curve:
    """One curve of two that lead away from a place, run back first; of one if there is one."""
    if forth is None:
        assert back is not None
        return take(back, back.length, 0.0)
    if back is None:
        return forth
    first, offset = take(back, back.length, 0.0), back.length
    moved_panels = (Panel(offset + panel.s, panel.z, panel.z_s) for panel in forth.panels)
    panels = [*first.panels, *moved_panels]
    segments = list(first.segments)
    for part in forth.segments:
        moved = replace(part, start=offset + part.start, stop=offset + part.stop)
        last = segments[-1]
        if (last.Xi == moved.Xi).all() and (last.sigma == moved.sigma).all():
            segments[-1] = replace(last, stop=moved.stop)
        else:
            segments.append(moved)
    return _make(forth, panels, segments, offset + forth.length)


def _cut(panel: Panel, first: float, last: float) -> Panel:
    """The same polynomial through nodes between two places."""
    nodes = (1 - np.cos(np.linspace(0, np.pi, len(panel.s)))) / 2
    s = first + (last - first) * nodes
    s[-1] = last
    return Panel(s, *panel.interpolate(s))


def _make(curve: Curve, panels: list[Panel], segments: list[Segment], length: float) -> Curve:
    segments[0] = replace(segments[0], start=0.0)
    segments[-1] = replace(segments[-1], stop=length)
    part = Curve(curve.formation, tuple(panels), length, "", False, curve.speed_ratio)
    # Reversals are where they were.
    part.__dict__["segments"] = tuple(segments)
    return part


@dataclass(frozen=True, eq=False)
class CostToGo:
    """The cost of the phases that follow, the first of them with one freedom."""

    phase: Phase  # the first of them. Its curve is where the motion before it may end.
    # their least cost from a configuration z, shape (5,). Raises a `WholearmError` without a plan
    # from there.
    value: Callable[[Array], float]

    def expand(self, z: Array) -> tuple[float, Array]:
        """The cost from `z`, shape (5,), and its gradient along the curve, shape (5,)."""
        curve = trace_phase(self.phase, z)
        step = 1e-2 * curve.length
        point = curve.evaluate(np.array([0.0, step]))
        here, ahead = (self.value(place) for place in point.z)
        slope = (ahead - here) / step
        return here, slope * metric_weights(self.phase.formation.scene) * point.z_s[0]
