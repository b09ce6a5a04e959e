"""Replays of plans in physics engines, and what they show."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from importlib.metadata import version
from typing import NamedTuple

from ..common.brief import write_brief
from ..common.errors import InputError
from ..problem.definition import Problem
from ..results.narrow import Moved, adopt_motion, require_same_phases
from ..results.trajectory import Trajectory
from .applied import apply_friction
from .between import find_between
from .departure import Departure, compare
from .report_text import name_phases
from .stretch import Engine, Setting, Stretch, list_stretches


class Known(NamedTuple):
    """An engine that plans can be replayed in.

    Attributes
    ----------
    title, package : str
        What it is called, and the package that it is imported from.
    allowed : float
        Error of the pose that is allowed, over the scene's length and in rad.
    setting : Setting
    """

    title: str
    package: str
    allowed: float
    setting: Setting


ENGINES = {
    "mujoco": Known("MuJoCo", "mujoco", 3e-3, Setting(1.6e-4)),
    "drake": Known("Drake", "pydrake", 1.5e-3, Setting(1.6e-4)),
}
"""In the scenes of `problems/` 3e-3 are 0.1 mm and 0.17 degrees, and steps take 1e-5 s."""


class Level(NamedTuple):
    """A replay with one setting: a comparison for each stretch."""

    setting: Setting
    departures: tuple[Departure, ...]


class EngineReport(NamedTuple):
    """What replays in an engine have shown.

    Attributes
    ----------
    problem : Problem
    title : str
        The engine and its version.
    allowed : float
    stretches : tuple of Stretch
    levels : tuple of Level
        The first with the setting that was asked for, then finer ones.
    """

    problem: Problem
    title: str
    allowed: float
    stretches: tuple[Stretch, ...]
    levels: tuple[Level, ...]

    def __repr__(self) -> str:
        return write_brief(self)

    def to_text(self) -> str:
        """The report as lines of text."""
        from .report_text import write

        return write(self)

    @property
    def ok(self) -> bool:
        """Whether no stretch departs by more than is allowed."""
        return all(each.time is None for each in self.levels[0].departures)

    @property
    def converged(self) -> bool:
        """Whether every stretch that departs does so with the finer settings, too."""
        rows = zip(*(level.departures for level in self.levels), strict=True)
        return all(
            own.time is None or all(each.time is not None for each in finer) for own, *finer in rows
        )

    @property
    def exit_status(self) -> int:
        """Exit status of the command line."""
        return 0 if self.ok else 1


def require_engine(name: str) -> Engine:
    """The function that replays in an engine.

    Raises
    ------
    InputError
        If there is no such engine, or it is not installed.
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
    """Replay a plan open loop in an engine that is not told which contacts hold.

    Parameters
    ----------
    engine : {"mujoco", "drake"}
    problem : Problem
    plan : Plan or Trajectory
    whole : bool
        From the start to the end; otherwise phase by phase, each from its planned start.
    setting : Setting, optional
        Time step and softness of contacts; those of `ENGINES` when left out.
    allowed : float, optional
        Error of the pose that is allowed, over the scene's length and in rad.
    halvings : int
        How often the step is halved, with harder contacts and with the same.
    progress : callable, optional

    Raises
    ------
    InputError
        If the engine is unknown or not installed, the plan is of other phases, or a link has no
        thickness.
    """
    known, play = ENGINES.get(engine), require_engine(engine)
    assert known is not None
    problem, plan = adopt_motion(problem, plan)
    require_same_phases(problem, plan)
    setting = known.setting if setting is None else setting
    allowed = known.allowed if allowed is None else allowed
    plan = find_between(plan)
    torque, stretches = apply_friction(problem.scene, plan), list_stretches(plan, whole)
    levels = []
    for own in list_settings(setting, halvings):
        found = []
        for stretch in stretches:
            if progress is not None:
                progress(f"phase {name_phases(stretch)} in {known.title}, step {own.step:.3g}")
            run = play(problem, stretch, torque, own)
            found.append(compare(problem, plan, stretch, run, allowed))
        levels.append(Level(own, tuple(found)))
    title = f"{known.title} {version(engine)}"
    return EngineReport(problem, title, allowed, tuple(stretches), tuple(levels))


def list_settings(setting: Setting, halvings: int) -> list[Setting]:
    """A setting, finer ones, and finer steps alone, with contacts as they are at first."""
    finer = [setting._replace(step=setting.step / 2**k) for k in range(halvings + 1)]
    return finer + [
        own._replace(softness=setting.softness * 2**k) for k, own in enumerate(finer[1:], 1)
    ]
