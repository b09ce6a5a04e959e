"""A second motion under a planned one: what a simulator makes of its torques."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .progress import show_progress

if TYPE_CHECKING:
    from ..results.trajectory import Trajectory
    from ..simulation.events import Simulation


def overlay(simulator: str, trajectory: Trajectory) -> Simulation:
    """The motion of a trajectory simulated, with its contacts; `simulator` is told or free."""
    from ..problem.read import read_own_problem

    problem, say = read_own_problem(trajectory.meta), show_progress()
    if simulator == "free":
        from ..free_simulation.free_simulate import simulate_free

        if say is not None:
            say("simulating the whole")
        return simulate_free(problem, trajectory).show(trajectory.contacts)
    from ..simulation.simulate import simulate

    return simulate(problem, trajectory.torque, progress=say)
