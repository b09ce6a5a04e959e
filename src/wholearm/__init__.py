"""Plans joint-torque trajectories for dynamic whole-arm manipulation in the plane.

>>> problem = wholearm.load("problems/heptagon.toml")
>>> trajectory = wholearm.solve(problem, objective="time")
>>> report = wholearm.verify(problem, trajectory)
>>> figure = wholearm.plots.force_margins(trajectory)

Everything is imported when it is first used, so that a program pays only for what it needs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .common.errors import (
        InfeasibleError,
        InputError,
        JammingError,
        SimulationError,
        SolverError,
        WholearmError,
    )
    from .figures import plots
    from .geometry.path_guess import load
    from .planning.plan import solve
    from .results.torque import TorqueProfile, read_torque_csv
    from .results.trajectory import Trajectory, load_trajectory
    from .simulation.simulate import simulate
    from .verification.verify import verify

__version__ = "0.1.0"

_HOMES = {
    "InfeasibleError": "common.errors",
    "InputError": "common.errors",
    "JammingError": "common.errors",
    "SimulationError": "common.errors",
    "SolverError": "common.errors",
    "TorqueProfile": "results.torque",
    "Trajectory": "results.trajectory",
    "WholearmError": "common.errors",
    "load": "geometry.path_guess",
    "load_trajectory": "results.trajectory",
    "read_torque_csv": "results.torque",
    "simulate": "simulation.simulate",
    "solve": "planning.plan",
    "verify": "verification.verify",
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
        return import_module(".figures.plots", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
