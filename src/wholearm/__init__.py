"""Plans joint-torque trajectories for dynamic whole-arm manipulation in the plane.

>>> problem = wholearm.load("problems/heptagon.toml")
>>> plan = wholearm.solve(problem, objective="time")
>>> report = wholearm.verify(problem, plan)
>>> figure = wholearm.plots.force_margins(plan)

Everything is imported when it is first used, so that a program pays only for what it needs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .common.errors import (
        AmbiguityError,
        InfeasibleError,
        InputError,
        JammingError,
        ReplayError,
        SimulationError,
        SolverError,
        WholearmError,
    )
    from .common.shortfalls import Change, Shortfall
    from .comparison.compare import compare
    from .contacts.elemental import Contact
    from .contacts.formation import Formation
    from .figures import plots
    from .free_simulation.result import FreeSimulation
    from .free_simulation.simulate import simulate_free
    from .geometry.path_guess import load
    from .planning.options import Objective, PlanOptions
    from .planning.result import Plan, Status
    from .planning.saved import load_plan
    from .policy.make import make_policy
    from .policy.policy import Policy
    from .problem.definition import End, Phase, Problem, Until
    from .problem.goal import Goal
    from .problem.read import place_start, read_formation, read_until
    from .quasistatic.predict import predict
    from .results.narrow import save
    from .results.report import Report
    from .results.torque import TorqueProfile, read_torque_csv
    from .results.trajectory import Trajectory
    from .results.trajectory_file import load_trajectory
    from .scene.model import Finger, Friction, Scene
    from .scene.polygon import Polygon
    from .search.result import Answer
    from .search.route import find_route
    from .search.solve import solve
    from .simulation.events import Simulation
    from .simulation.simulate import simulate
    from .tuning.result import Tuning
    from .tuning.tune import tune
    from .verification.free import verify_free
    from .verification.free_report import FreeReport
    from .verification.policy import verify_policy
    from .verification.verify import verify

__version__ = "0.1.0"

_HOMES = {
    "Answer": "search.result",
    "Change": "common.shortfalls",
    "Contact": "contacts.elemental",
    "End": "problem.definition",
    "Finger": "scene.model",
    "Formation": "contacts.formation",
    "Friction": "scene.model",
    "FreeReport": "verification.free_report",
    "FreeSimulation": "free_simulation.result",
    "Goal": "problem.goal",
    "InfeasibleError": "common.errors",
    "InputError": "common.errors",
    "AmbiguityError": "common.errors",
    "JammingError": "common.errors",
    "Objective": "planning.options",
    "Phase": "problem.definition",
    "Plan": "planning.result",
    "PlanOptions": "planning.options",
    "Policy": "policy.policy",
    "Polygon": "scene.polygon",
    "Problem": "problem.definition",
    "ReplayError": "common.errors",
    "Report": "results.report",
    "Scene": "scene.model",
    "Simulation": "simulation.events",
    "Shortfall": "common.shortfalls",
    "SimulationError": "common.errors",
    "SolverError": "common.errors",
    "Status": "planning.result",
    "TorqueProfile": "results.torque",
    "Tuning": "tuning.result",
    "Trajectory": "results.trajectory",
    "Until": "problem.definition",
    "WholearmError": "common.errors",
    "compare": "comparison.compare",
    "find_route": "search.route",
    "load": "geometry.path_guess",
    "load_plan": "planning.saved",
    "load_trajectory": "results.trajectory_file",
    "make_policy": "policy.make",
    "place_start": "problem.read",
    "predict": "quasistatic.predict",
    "read_formation": "problem.read",
    "read_torque_csv": "results.torque",
    "read_until": "problem.read",
    "save": "results.narrow",
    "simulate": "simulation.simulate",
    "simulate_free": "free_simulation.simulate",
    "solve": "search.solve",
    "tune": "tuning.tune",
    "verify": "verification.verify",
    "verify_free": "verification.free",
    "verify_policy": "verification.policy",
}

__all__ = [
    "AmbiguityError",
    "Answer",
    "Change",
    "Contact",
    "End",
    "Finger",
    "Formation",
    "FreeReport",
    "FreeSimulation",
    "Friction",
    "Goal",
    "InfeasibleError",
    "InputError",
    "JammingError",
    "Objective",
    "Phase",
    "Plan",
    "PlanOptions",
    "Policy",
    "Polygon",
    "Problem",
    "ReplayError",
    "Report",
    "Scene",
    "Shortfall",
    "Simulation",
    "SimulationError",
    "SolverError",
    "Status",
    "TorqueProfile",
    "Trajectory",
    "Tuning",
    "Until",
    "WholearmError",
    "__version__",
    "compare",
    "find_route",
    "load",
    "load_plan",
    "load_trajectory",
    "make_policy",
    "place_start",
    "plots",
    "predict",
    "read_formation",
    "read_torque_csv",
    "read_until",
    "save",
    "simulate",
    "simulate_free",
    "solve",
    "tune",
    "verify",
    "verify_free",
    "verify_policy",
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
