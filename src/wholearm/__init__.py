"""Plans joint-torque trajectories for dynamic whole-arm manipulation in the plane.

>>> problem = wholearm.load("problems/heptagon.toml")
>>> trajectory = wholearm.solve(problem, objective="time")
>>> report = wholearm.verify(problem, trajectory)
>>> figure = wholearm.plots.force_margins(trajectory)

Everything is imported when it is first used, so that a program pays only for what it needs.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import plots
    from .errors import (
        InfeasibleError,
        InputError,
        JammingError,
        SimulationError,
        SolverError,
        WholearmError,
    )
    from .outline import load
    from .plan import solve
    from .simulation.simulate import simulate
    from .torque import TorqueProfile, read_torque_csv
    from .trajectory import Trajectory, load_trajectory
    from .verify import verify

__version__ = "0.1.0"

_HOMES = {
    "InfeasibleError": "errors",
    "InputError": "errors",
    "JammingError": "errors",
    "SimulationError": "errors",
    "SolverError": "errors",
    "TorqueProfile": "torque",
    "Trajectory": "trajectory",
    "WholearmError": "errors",
    "load": "outline",
    "load_trajectory": "trajectory",
    "read_torque_csv": "torque",
    "simulate": "simulation.simulate",
    "solve": "plan",
    "verify": "verify",
}

__all__ = [
    "InfeasibleError",
    "InputError",
    "JammingError",
    "SimulationError",
    "SolverError",
    "TorqueProfile",
    "Trajectory",
    "WholearmError",
    "__version__",
    "load",
    "load_trajectory",
    "plots",
    "read_torque_csv",
    "simulate",
    "solve",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name == "plots":
        return import_module(".plots", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """Keeps `simulate` and `verify` functions when the modules of the same name are imported."""

    def __setattr__(self, name: str, value: object) -> None:
        if name in _HOMES and isinstance(value, ModuleType):
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
