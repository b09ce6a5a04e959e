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
    from .analysis.comparison import Comparison, compare
    from .analysis.robustness import Robustness, Uncertainty, assess_robustness
    from .analysis.slow_speeds import Prediction, predict
    from .analysis.tuning import Tuning, tune
    from .common.errors import (
        AmbiguityError,
        Change,
        InfeasibleError,
        InputError,
        JammingError,
        ReplayError,
        Shortfall,
        SimulationError,
        SolverError,
        WholearmError,
    )
    from .contacts.elemental import Contact
    from .contacts.formation import Formation
    from .design.hand import Design, design_hand
    from .design.sensitivities import Sensitivities, find_sensitivities
    from .design.sweep import Sweep, sweep
    from .engines.engine_replay import EngineReport, PolicyReport, play_policy, replay_in
    from .engines.mujoco import write_mjcf
    from .figures import plots
    from .figures.map_figure import draw_map
    from .figures.result_figures import draw_sweep
    from .geometry.tracing import load
    from .mapping.formation_list import format_route, list_formations
    from .mapping.formation_map import FormationMap, build_map
    from .planning.options import Objective, PlanOptions
    from .planning.result import Plan, Status, load_plan
    from .policy.make import make_policy
    from .policy.playback import Policy
    from .problem.definition import End, Goal, Phase, Problem, Until
    from .problem.read import place_start, read_formation, read_until
    from .results.adopt import save
    from .results.report import Report
    from .results.torque import TorqueProfile, read_torque_csv
    from .results.trajectory import Trajectory, load_trajectory
    from .scene.model import Finger, Friction, Polygon, Scene
    from .search import solve
    from .search.find_route import Answer, find_route
    from .simulation.events import FreeSimulation, Simulation
    from .simulation.simulate import simulate, simulate_free
    from .verification.free import FreeReport, find_policy, verify_free, verify_policy
    from .verification.verify import verify

__version__ = "0.1.0"

_NAMES = {
    "common.errors": "AmbiguityError Change InfeasibleError InputError JammingError ReplayError "
    "Shortfall SimulationError SolverError WholearmError",
    "analysis.comparison": "Comparison compare",
    "contacts.elemental": "Contact",
    "contacts.formation": "Formation",
    "design.hand": "Design design_hand",
    "design.sensitivities": "Sensitivities find_sensitivities",
    "design.sweep": "Sweep sweep",
    "engines.engine_replay": "EngineReport PolicyReport play_policy replay_in",
    "engines.mujoco": "write_mjcf",
    "figures.map_figure": "draw_map",
    "figures.result_figures": "draw_sweep",
    "geometry.tracing": "load",
    "mapping.formation_list": "format_route list_formations",
    "mapping.formation_map": "FormationMap build_map",
    "planning.options": "Objective PlanOptions",
    "planning.result": "Plan Status load_plan",
    "policy.make": "make_policy",
    "policy.playback": "Policy",
    "problem.definition": "End Goal Phase Problem Until",
    "problem.read": "place_start read_formation read_until",
    "analysis.slow_speeds": "Prediction predict",
    "results.adopt": "save",
    "results.report": "Report",
    "results.torque": "TorqueProfile read_torque_csv",
    "results.trajectory": "Trajectory load_trajectory",
    "analysis.robustness": "Robustness Uncertainty assess_robustness",
    "scene.model": "Finger Friction Polygon Scene",
    "search.find_route": "Answer find_route",
    "search": "solve",
    "simulation.events": "FreeSimulation Simulation",
    "simulation.simulate": "simulate simulate_free",
    "analysis.tuning": "Tuning tune",
    "verification.free": "FreeReport find_policy verify_free verify_policy",
    "verification.verify": "verify",
}
"""Public names by their modules."""
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "AmbiguityError", "Answer", "Change", "Comparison", "Contact", "Design", "End",
    "EngineReport", "Finger", "Formation", "FormationMap", "FreeReport", "FreeSimulation",
    "Friction", "Goal", "InfeasibleError", "InputError", "JammingError", "Objective",
    "Phase", "Plan", "PlanOptions", "Policy", "PolicyReport", "Polygon", "Prediction",
    "Problem", "ReplayError", "Report", "Robustness", "Scene", "Sensitivities", "Shortfall",
    "Simulation", "SimulationError", "SolverError", "Status", "Sweep", "TorqueProfile",
    "Trajectory", "Tuning", "Uncertainty", "Until", "WholearmError", "__version__",
    "assess_robustness", "build_map", "compare", "design_hand", "draw_map", "draw_sweep",
    "find_policy", "find_route", "find_sensitivities", "format_route", "list_formations",
    "load", "load_plan", "load_trajectory", "make_policy", "place_start", "play_policy",
    "plots", "predict", "read_formation", "read_torque_csv", "read_until", "replay_in",
    "save", "simulate", "simulate_free", "solve", "sweep", "tune", "verify", "verify_free",
    "verify_policy", "write_mjcf",
]  # fmt: skip


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
