"""Verification of plans by open-loop replay in physics engines."""

from __future__ import annotations

import importlib
import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np

from ..common.document import Document, Result, Table
from ..common.errors import InputError
from ..problem.definition import Problem
from ..results.adopt import Moved, adopt_motion, require_same_phases
from ..results.trajectory import Trajectory
from .departure import PRESS, Departure, compare
from .stretch import Engine, EngineStretch, Setting, apply_friction, find_between, list_stretches

PARTS = 5  # equal parts of a stretch at whose ends the error is listed


class EngineInfo(NamedTuple):
    """A physics engine."""

    title: str
    package: str  # that it is imported from
    allowed: float  # error of the pose, over the scene's length and in rad
    setting: Setting


ENGINES = {
    "mujoco": EngineInfo("MuJoCo", "mujoco", 3e-3, Setting(1.6e-4)),
    "drake": EngineInfo("Drake", "pydrake", 1.5e-3, Setting(1.6e-4)),
}
"""In the scenes of `problems/` 3e-3 are 0.1 mm and 0.17 degrees, and steps take 1e-5 s."""


class Level(NamedTuple):
    """A replay with one setting: a comparison for each stretch."""

    setting: Setting
    departures: tuple[Departure, ...]


@dataclass(frozen=True, eq=False, repr=False)
class EngineReport(Result):
    """Errors and forces of replays in an engine."""

    problem: Problem
    title: str  # the engine and its version
    allowed: float
    stretches: tuple[EngineStretch, ...]
    levels: tuple[Level, ...]  # the chosen setting, then finer ones

    @property
    def ok(self) -> bool:
        """Whether no stretch exceeds the allowed error."""
        return all(each.time is None for each in self.levels[0].departures)

    @property
    def converged(self) -> bool:
        """Whether every stretch that departs also does with finer settings."""
        rows = zip(*(level.departures for level in self.levels), strict=True)
        return all(
            first.time is None or all(each.time is not None for each in finer)
            for first, *finer in rows
        )

    @property
    def document(self) -> Document:
        """Errors and forces of each stretch."""
        scales, departures = self.problem.scene.scales, self.levels[0].departures
        setting = self.levels[0].setting
        millimetres, degrees = self.allowed * scales.length * 1e3, math.degrees(self.allowed)
        worst = max(float(np.max(each.position)) for each in departures) * 1e3
        turned = math.degrees(max(float(np.max(each.angle)) for each in departures))
        says = "departs" if self.converged else "departs with some settings only, here"
        pairs = list(zip(self.stretches, departures, strict=True))
        errors, forces, levels = list[list[Any]](), list[tuple[Any, ...]](), list[list[Any]]()
        for stretch, found in pairs:
            at = np.linspace(stretch.start, stretch.stop, PARTS + 1)[1:]
            sampled = np.interp(at, found.t, found.position)
            largest = np.max(found.position), np.max(found.angle)
            errors.append([stretch.name, stretch.duration, *largest, *sampled])
            for force in found.forces:
                off = force.off if force.planned > PRESS * scales.force else None
                forces.append((force.phase, force.contact, force.planned, force.found, off))
        for level in self.levels if len(self.levels) > 1 else ():
            farthest = [np.max(found.position) for found in level.departures]
            levels.append([level.setting.step * scales.time, level.setting.softness, *farthest])
        shares = [f"{k / PARTS:.0%} [mm]:.4f" for k in range(1, PARTS + 1)]
        names = [f"{stretch.name} [mm]:.4f" for stretch in self.stretches]
        heads = ["phase:d", "duration [s]:.6f", "largest [mm]:.4f", "[deg]:.4f", *shares]
        other = ["phase:d", "contact", "planned mean c_n [N]:.4f", "found [N]:.4f", "off [%]:+.2f"]
        lost = [
            f"phase {stretch.name} {says} at t = {found.time:.5g} s: {found.reason}"
            for stretch, found in pairs
            if found.time is not None
        ]
        settings = f"steps of up to {setting.step * scales.time:.3g} s, softness "
        settings += f"{setting.softness:g}; torques contain the dry friction of the joints, with "
        tables = Table(heads, errors), Table(other, forces)
        return Document(
            f"{self.problem.name} in {self.title}",
            "ok" if self.ok else "DEPARTS" if self.converged else "NOT CONVERGED",
            f"within {worst:.4f} mm and {turned:.4f} degrees of the plan "
            f"(allowed {millimetres:.4g} mm, {degrees:.3g} degrees)",
            [
                *lost,
                f"{settings}its planned signs",
                *tables,
                Table(["step [s]:.3g", "softness:g", *names], levels),
            ],
        )

    @property
    def values(self) -> dict[str, Any]:
        """The report for machines, in m, rad, s and N; null where an engine fails."""
        scales = self.problem.scene.scales
        return {
            "problem": self.problem.name,
            "engine": self.title,
            "ok": self.ok,
            "converged": self.converged,
            "allowed": {"position": self.allowed * scales.length, "angle": self.allowed},
            "levels": [
                {
                    "step": level.setting.step * scales.time,
                    "softness": level.setting.softness,
                    "stretches": list(map(_describe, self.stretches, level.departures)),
                }
                for level in self.levels
            ],
        }


def _describe(stretch: EngineStretch, found: Departure) -> dict[str, Any]:
    departs = {"time": found.time, "reason": found.reason}
    return {
        "phases": stretch.numbers,
        "start": stretch.start,
        "stop": stretch.stop,
        "largest": {"position": found.position.max(), "angle": found.angle.max()},
        "departs": None if found.time is None else departs,
        **{name: getattr(found, name) for name in ("forces", "t", "position", "angle")},
    }


def require_engine(name: str) -> Engine:
    """The function that replays in an engine.

    InputError if there is no such engine, or it is not installed.
    """
    if name not in ENGINES:
        raise InputError("", "--engine", f"{name!r} given; allowed are {', '.join(ENGINES)}")
    if importlib.util.find_spec(ENGINES[name].package) is None:
        text = f"{name} is not installed; pip install 'wholearm[{name}]'"
        raise InputError("", "--engine", text)
    try:
        importlib.import_module(ENGINES[name].package)
    except ImportError as error:
        # MuJoCo 4 without mujoco-core, for one.
        raise InputError("", "--engine", f"{name}: {' '.join(str(error).split())}") from None
    engine: Engine = importlib.import_module(f".{name}", __package__).play
    return engine


def replay_in(
    engine: str,
    problem: Problem,
    plan: Trajectory | Moved,
    *,
    whole: bool = False,
    setting: Setting | None = None,
    allowed: float | None = None,
    halvings: int = 0,
    progress: Callable[[str], None] | None = None,
) -> EngineReport:
    """Replay a plan open loop in an engine that does not know the contact sequence.

    Parameters
    ----------
    engine : {"mujoco", "drake"}
    whole      from start to end; otherwise phase by phase, each from its planned start
    setting    time step and softness of contacts; by default those of `ENGINES`
    allowed    error of the pose, over the scene's length and in rad; by default that of `ENGINES`
    halvings   number of halvings of the step, with harder contacts and with the same

    Raises
    ------
    InputError  if the engine is unknown or not installed, the plan is of other phases, or a link
                has no thickness
    """
    play = require_engine(engine)
    info = ENGINES[engine]
    problem, plan = adopt_motion(problem, plan)
    require_same_phases(problem, plan)
    setting = info.setting if setting is None else setting
    allowed = info.allowed if allowed is None else allowed
    plan = find_between(plan)
    torque, stretches = apply_friction(problem.scene, plan), list_stretches(plan, whole)
    levels = []
    for level in list_settings(setting, halvings):
        found = []
        for stretch in stretches:
            if progress is not None:
                progress(f"phase {stretch.name} in {info.title}, step {level.step:.3g}")
            run = play(problem, stretch, torque, level)
            found.append(compare(problem, plan, stretch, run, allowed))
        levels.append(Level(level, tuple(found)))
    title = f"{info.title} {version(engine)}"
    return EngineReport(problem, title, allowed, tuple(stretches), tuple(levels))


def list_settings(setting: Setting, halvings: int) -> list[Setting]:
    """A setting, finer ones, and finer steps alone, with contacts as they are at first."""
    finer = [setting._replace(step=setting.step / 2**k) for k in range(halvings + 1)]
    return finer + [
        level._replace(softness=setting.softness * 2**k) for k, level in enumerate(finer[1:], 1)
    ]
