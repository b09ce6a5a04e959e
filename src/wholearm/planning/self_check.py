"""What `solve` checks of its own plan, and how it refines what does not hold.

The plan is replayed in the simulator, which is told the torques and nothing else, and the equations
of motion are written out anew for its samples (`verification.newton_euler`). The replay is looked
at in few instants, since those are what it costs: the plan keeps its limits in between by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import (
    InfeasibleError,
    JammingError,
    ReplayError,
    SimulationError,
    SolverError,
)
from ..problem.definition import Problem
from ..results.replay_figures import LeastForce, ReplayedPhase, ReplayFigures
from ..results.report import Report
from ..results.torque import TorqueProfile
from ..results.trajectory import Samples, Trajectory, assemble
from ..scene.model import Scales
from ..verification.newton_euler import balance
from ..verification.verdict import Allowance, find_least_force, measure_departure
from ..verification.verify import CLOSER, SAMPLES, choose_times, inspect
from .blocks import PLAIN, BlockPlan, Planning, plan_alone, refine_block

REFINEMENTS = 3
"""Most doublings of the intervals of a block."""
ROUGH = 2
"""Most doublings in the time domain, before contact modes are left as they come: a plan that hangs
on a contact that comes to rest need not hold, however fine it is."""
STRICT = 0.5
"""Share of what `verify` allows that a plan may use: `verify` looks at more instants."""
RESIDUAL = 1e-8
"""Largest residual of the equations of motion, relative to the scene's force or torque, length or
speed: rounding leaves 1e-13."""
ROWS = 8
"""Parts of a phase at whose ends replay and plan are compared."""
PIECES = 40
"""Parts of a phase at whose ends normal forces are looked at."""
_CLOSER = 4
"""Factor on the number of parts, if a parabola through few instants dips too low."""
DENSE = 201
"""Rows per phase for the equations of motion, if the trajectory has not half as many."""


class Residual(NamedTuple):
    """What the equations of motion miss at worst.

    Attributes
    ----------
    size : float
        Relative to the scene's force or torque, length or speed.
    phase : int
        Number of the phase.
    text : str
        Where, and of what.
    """

    size: float
    phase: int
    text: str


class Check(NamedTuple):
    """A plan's own replay and its residual.

    Attributes
    ----------
    report : Report, JammingError or SimulationError
        What the replay has shown, or what it has ended with, since it cannot go on.
    residual : Residual
    """

    report: Report | JammingError | SimulationError
    residual: Residual

    @property
    def failure(self) -> tuple[int, str] | None:
        """Number of the phase that fails, and the reason; None if the plan holds."""
        if self.residual.size > RESIDUAL:
            return self.residual.phase, self.residual.text
        if not isinstance(self.report, Report):
            return self.report.phase or 1, str(self.report)
        if self.report.ok:
            return None
        assert self.report.failed_phase is not None
        return self.report.failed_phase, self.report.reason

    @property
    def is_final(self) -> bool:
        """Whether it fails however many instants are looked at, and whatever is allowed."""
        if self.residual.size > RESIDUAL or not isinstance(self.report, Report):
            return True
        return not self.report.reached

    def find_culprit(self, scales: Scales, allowance: Allowance, durations: Array) -> int:
        """Number of the phase to refine: the first that departs or does not stop, or that fails.

        What is left of the speed at a stop must not carry the phase that follows away, either.

        Parameters
        ----------
        scales : Scales
        allowance : Allowance
        durations : ndarray, shape (n_phases,), [s]
        """
        assert self.failure is not None
        following = dict(enumerate(durations[1:].tolist(), start=1))
        for phase in self.report.phases if isinstance(self.report, Report) else ():
            departs = (
                phase.deviation is not None
                and measure_departure(phase.deviation, scales.length) > allowance.departure
            )
            speed = phase.end_speed or 0.0
            carried = speed * following.get(phase.number, 0.0)
            fast = speed > allowance.rest_speed * scales.speed
            if departs or fast or carried > allowance.departure * scales.length:
                return min(phase.number, self.failure[0])
        return self.failure[0]


def replay_plan(
    planning: Planning,
    trajectory: Trajectory,
    build: Callable[[Planning], Trajectory],
    report: Callable[[str], None],
) -> tuple[Planning, Trajectory, ReplayFigures]:
    """Replay a plan, refine the blocks that do not hold, and return what does, with its figures.

    Parameters
    ----------
    planning : Planning
    trajectory : Trajectory
        That of `planning`.
    build : callable
        Gives the trajectory of another planning.
    report : callable
        Told in a few words what is being done.

    Raises
    ------
    ReplayError
        If a block does not hold with finer intervals either.
    """
    problem = planning.problem
    usual, strict = Allowance(), Allowance().scale(STRICT)
    while True:
        report("replaying the plan")
        every = choose_times(trajectory.torque, trajectory, CLOSER * SAMPLES)
        for times in (None, pick_times(trajectory, _CLOSER * PIECES), every):
            check = check_plan(problem, trajectory, strict, times)
            if check.failure is None or check.is_final:
                break
        if check.failure is None:
            break
        accepted = check if check.is_final else check_plan(problem, trajectory, usual, every)
        durations = np.diff(trajectory.phase_starts)
        number = check.find_culprit(problem.scene.scales, strict, durations)
        better = _improve(planning, number, accepted.failure is not None, report)
        if better is None and accepted.failure is None:
            check = accepted
            break
        if better is None:
            block = planning.blocks[planning.find_block(number)]
            raise ReplayError(_describe(block, number, accepted))
        planning, trajectory = better, build(better)
    return planning, trajectory, _collect_figures(planning, check)


def _improve(
    planning: Planning, number: int, fails: bool, report: Callable[[str], None]
) -> Planning | None:
    """Another plan of the block with phase `number`, if any; `fails`: the plan is not accepted."""
    alone = plan_alone(planning, report) if fails else None
    if alone is not None:
        # Short phases that a landing leaves magnify what is left of the speed at its stop.
        return alone
    index = planning.find_block(number)
    block, refined = planning.blocks[index], None
    most = (REFINEMENTS if block.chain else ROUGH) if fails else 1
    if PLAIN != block.finer < most and not block.is_finest:
        refined = _refine(planning, index, report)
    if refined is None and fails and block.has_searched and block.finer != PLAIN:
        refined = _refine(planning, index, report, plain=True)
    return refined


def check_plan(
    problem: Problem, trajectory: Trajectory, allowance: Allowance, times: Array | None = None
) -> Check:
    """Replay a plan, and see what its samples leave of the equations of motion.

    It is looked at in few instants, or at `times`, shape (n,) [s].
    """
    times = pick_times(trajectory) if times is None else times
    residual = find_residual(problem, trajectory)
    try:
        replayed = inspect(problem, trajectory.torque, trajectory, times, allowance, 1e-9)
    except (JammingError, SimulationError) as error:
        return Check(error, residual)
    return Check(replayed, residual)


def pick_times(trajectory: Trajectory, pieces: int = PIECES) -> Array:
    """Few instants to look at: some rows of each phase, and some in long pieces of the torques.

    Parameters
    ----------
    trajectory : Trajectory
    pieces : int
        Into how many parts of a phase its torques are divided at least.
    """
    times: list[Array] = []
    for index in range(len(trajectory.motions)):
        rows = np.flatnonzero(trajectory.phase == index)
        picked = np.linspace(0, len(rows) - 1, ROWS + 1).round().astype(int)
        times.append(trajectory.t[rows[picked]])
    starts = trajectory.phase_starts
    times.append(divide_pieces(trajectory.torque, starts, np.diff(starts) / pieces))
    return np.concatenate(times)


def divide_pieces(torque: TorqueProfile, starts: Array, longest: Array) -> Array:
    """Instants that divide the pieces of torques into parts of the `longest` length of a phase [s].

    Parameters
    ----------
    torque : TorqueProfile
    starts : ndarray, shape (n_phases + 1,), [s]
        When phases start, and when the last one ends.
    longest : ndarray, shape (n_phases,), [s]
    """
    middle = (torque.breaks[1:] + torque.breaks[:-1]) / 2
    owner = np.clip(np.searchsorted(starts, middle, side="right") - 1, 0, len(longest) - 1)
    counts = np.floor(np.diff(torque.breaks) / longest[owner]).astype(int)
    parts = [
        start + (stop - start) * np.arange(1, count + 1) / (count + 1)
        for start, stop, count in zip(torque.breaks[:-1], torque.breaks[1:], counts, strict=True)
        if count
    ]
    return np.concatenate([np.zeros(0), *parts])


def find_residual(problem: Problem, trajectory: Trajectory) -> Residual:
    """What the samples of a trajectory leave of the equations of motion, at worst."""
    if len(trajectory.t) < DENSE / 2 * len(trajectory.motions):
        trajectory = assemble(trajectory.motions, trajectory.torque, {}, DENSE)
    worst = Residual(0.0, 1, "")
    for phase in problem.phases:
        rows = trajectory.phase == phase.index
        formation, motion = phase.formation, trajectory.motions[phase.index]
        columns = [trajectory.contacts.index(name) for name in motion.contacts]
        contacts = {contact.name: contact for contact in formation.contacts}
        samples = Samples(
            trajectory.z[rows],
            trajectory.z_dot[rows],
            trajectory.z_ddot[rows],
            trajectory.tau[rows],
            trajectory.c_n[rows][:, columns],
            trajectory.c_t[rows][:, columns],
        )
        own = [contacts[name] for name in motion.contacts]
        left = balance(problem.scene, own, formation.rolling, samples)
        size, row, text = left.find_worst()
        if not size <= worst.size:
            when = f"at t = {trajectory.t[rows][row]:.5g} s, phase {phase.number}"
            worst = Residual(size, phase.number, f"{text} {when}")
    return worst


def _refine(
    planning: Planning, index: int, report: Callable[[str], None], plain: bool = False
) -> Planning | None:
    """The planning with another plan of a block; None if there is none."""
    try:
        return refine_block(planning, index, report, plain)
    except (InfeasibleError, SolverError):
        return None


def _describe(block: BlockPlan, number: int, check: Check) -> str:
    """The error for a plan that does not hold, from phase `number` of a block on."""
    assert check.failure is not None
    reason = check.failure[1]
    finer = f", with {2**block.finer} times the intervals" if block.finer > 0 else ""
    return (
        f"the plan of phase {number} does not hold in its replay{finer}: {reason}; other intervals "
        "or another objective may do, and --no-replay (replay=False) leaves the check out"
    )


def _collect_figures(planning: Planning, check: Check) -> ReplayFigures:
    """What a plan keeps of its replay."""
    assert isinstance(check.report, Report)
    scene = planning.problem.scene
    found = [(find_least_force(scene, phase), phase.number) for phase in check.report.phases]
    known = [(least, number) for least, number in found if least is not None]
    least, number = min(known, key=lambda pair: pair[0].least)
    return ReplayFigures(
        LeastForce(least.least, least.contact, number, least.time),
        tuple(
            ReplayedPhase(own.arrival, own.end_speed, own.end_deviation, own.deviation)
            for own in check.report.phases
        ),
        check.residual.size,
        tuple(block.finer for block in planning.blocks for _ in block.phases),
        check.report.steps,
    )
