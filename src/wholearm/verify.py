"""Check torques by replaying them open loop: margins between nodes, goal, deviation and energy."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .cones import slip_margins
from .errors import InputError
from .model import Array
from .problem import End, Phase, Problem
from .report import (
    ContactMargin,
    Deviation,
    EnergyBalance,
    LeastImpulse,
    PhaseReport,
    Report,
    SlipMargin,
)
from .simulation.events import Event, EventKind, OutcomeKind, Simulation
from .simulation.jumps import SETTLING
from .simulation.simulate import simulate
from .torque import TorqueProfile
from .trajectory import Trajectory

MARGIN = 1e-6
"""How far below epsilon a normal force may fall by rounding [N]."""
STRAY = 2e-3
"""The same, over epsilon: an open-loop replay strays from its plan, and its forces with it."""
GOAL = 1e-5
"""Distance to the end of the last phase that counts as the goal [m or rad]."""
SHORTEST = 2 * SETTLING
"""Interval below which forces may jump, and rounding spoils a parabola [s]."""
STOPPED = 1e-3
"""Speed at a phase's end that passes for rest [m/s or rad/s]."""
_ENDS = (EventKind.ARRIVAL, EventKind.RELEASE)
SAMPLES = 2000
"""About how many instants normal forces are looked at, besides the simulation's own steps."""


def verify(
    problem: Problem, what: Trajectory | TorqueProfile, *, tolerance: float = 1e-9
) -> Report:
    """Replay a trajectory's torques, or given ones, open loop and report what happens.

    A trajectory has to keep every normal force above epsilon; torques alone only have to hold every
    contact, and a force below epsilon is a warning.

    Parameters
    ----------
    problem : Problem
    what : Trajectory or TorqueProfile
    tolerance : float
        Of the simulation.

    Raises
    ------
    InputError
        If the trajectory has other contacts than the problem.
    JammingError, SimulationError
        If the simulation cannot go on.
    """
    plan = what if isinstance(what, Trajectory) else None
    torque = what.torque if isinstance(what, Trajectory) else what
    names = {contact.name for contact in problem.contacts}
    if plan is not None and set(plan.contacts) != names:
        odd = ", ".join(sorted(set(plan.contacts) ^ names))
        raise InputError("", "contacts", f"trajectory and problem differ in {odd}")
    times = _choose_times(torque)
    if plan is not None:
        times = np.concatenate([times, plan.t])
    simulation = simulate(problem, torque, tolerance=tolerance, times=times)
    phases = tuple(
        _report_phase(problem, simulation, torque, plan, index)
        for index in range(int(simulation.phase[-1]) + 1)
    )
    # By rounding the last speeds fall to zero one after the other, so friction may hold a contact.
    reached = simulation.outcome.reached or (
        simulation.outcome.kind in (OutcomeKind.GOAL_MISSED, OutcomeKind.HELD)
        and len(phases) == len(problem.phases)
        and abs(simulation.missed_by) <= GOAL
    )
    failures = [] if reached else [simulation.outcome.text]
    thin = _describe_thin(problem, phases, simulation)
    warnings = _describe_torques(problem, torque) + _describe_stops(problem, simulation)
    return Report(
        name=problem.name,
        epsilon=problem.epsilon,
        outcome=simulation.outcome.text,
        reached=reached,
        missed_by=simulation.missed_by,
        failures=tuple(failures + (thin if plan is not None else [])),
        warnings=tuple(warnings + (thin if plan is None else [])),
        phases=phases,
        energy=_balance(problem, simulation),
        tolerance=tolerance,
        steps=simulation.steps,
    )


def _choose_times(torque: TorqueProfile) -> Array:
    """Instants inside every piece of the torques, at least one."""
    count = max(1, SAMPLES // len(torque.coefficients))
    share = np.arange(1, count + 1) / (count + 1)
    return np.asarray((torque.breaks[:-1, None] + np.diff(torque.breaks)[:, None] * share).ravel())


def _report_phase(
    problem: Problem,
    simulation: Simulation,
    torque: TorqueProfile,
    plan: Trajectory | None,
    index: int,
) -> PhaseReport:
    phase = problem.phases[index]
    rows = np.flatnonzero(simulation.phase == index)
    arrivals = [e for e in simulation.events if e.phase == index and e.kind in _ENDS]
    lost = {e.contact: e for e in simulation.find(EventKind.CONTACT_LOST) if e.phase == index}
    contacts = []
    for name in phase.formation.names:
        column = simulation.contacts.index(name)
        least, time = find_least(simulation.t[rows], simulation.c_n[rows, column], torque.breaks)
        if name in lost and not least <= lost[name].value:
            least, time = lost[name].value, lost[name].time
        contacts.append(ContactMargin(name, least, time, least - problem.epsilon))
    impacts = [e for e in simulation.find(EventKind.IMPACT) if e.phase == index]
    rolling = _report_rolling(phase, simulation, rows, torque)
    end = worst = None
    if plan is not None:
        # A motion that goes on is compared when its phase was planned to end, not when it did.
        end, worst = _compare(simulation, plan, index, bool(arrivals), phase.end is not End.REST)
    return PhaseReport(
        number=phase.number,
        until=_describe_end(arrivals, phase),
        end=phase.end.value,
        start=float(simulation.t[rows[0]]),
        contacts=tuple(contacts),
        rolling=rolling,
        arrival=arrivals[0].time if arrivals else None,
        arrival_rate=arrivals[0].value if arrivals and not phase.until.is_release else None,
        impact=LeastImpulse(impacts[0].contact, impacts[0].value) if impacts else None,
        end_deviation=end,
        deviation=worst,
    )


def _report_rolling(
    phase: Phase, simulation: Simulation, rows: NDArray[np.int64], torque: TorqueProfile
) -> tuple[SlipMargin, ...]:
    """Least margins to slipping in a phase, which the simulation has at `rows`."""
    formation = phase.formation
    columns = [simulation.contacts.index(name) for name in formation.names]
    c_n, c_t = simulation.c_n[rows][:, columns], simulation.c_t[rows][:, columns]
    slipped = {e.contact: e for e in simulation.find(EventKind.SLIP) if e.phase == phase.index}
    margins = []
    for row, values in zip(
        formation.rolling_rows, slip_margins(formation, c_n, c_t).T, strict=True
    ):
        name = formation.names[row]
        least, time = find_least(simulation.t[rows], values, torque.breaks)
        if name in slipped and not least <= slipped[name].value:
            least, time = slipped[name].value, slipped[name].time
        margins.append(SlipMargin(name, least, time))
    return tuple(margins)


def find_least(t: Array, values: Array, breaks: Array) -> tuple[float, float]:
    """Least value of a sampled function and where, refined by parabolas inside smooth stretches.

    Parameters
    ----------
    t : ndarray, shape (n,), [s]
        Never decreasing; a jump is there twice.
    values : ndarray, shape (n,)
        NaN where unknown.
    breaks : ndarray, [s]
        Where the function may have a kink: no parabola has one inside.

    Returns
    -------
    least, time : float
        NaN if no value is known.
    """
    if np.isnan(values).all():
        return math.nan, math.nan
    first = int(np.nanargmin(values))
    least, time = float(values[first]), float(t[first])
    left, right = np.diff(t)[:-1], np.diff(t)[1:]
    smooth = (left > SHORTEST) & (right > SHORTEST) & ~np.isin(t[1:-1], breaks)
    smooth &= ~np.isnan(values[:-2] + values[1:-1] + values[2:])
    left, right = left[smooth], right[smooth]
    middle = values[1:-1][smooth]
    fall = (values[1:-1] - values[:-2])[smooth] / left
    rise = (values[2:] - values[1:-1])[smooth] / right
    bend = (rise - fall) / (left + right)
    slope = (fall * right + rise * left) / (left + right)
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = -slope / (2 * bend)
    inside = (bend > 0) & (shift > -left) & (shift < right)
    if inside.any():
        lowest = middle[inside] + slope[inside] * shift[inside] / 2
        k = int(lowest.argmin())
        if lowest[k] < least:
            least, time = float(lowest[k]), float((t[1:-1][smooth] + shift)[inside][k])
    return least, time


def _compare(
    simulation: Simulation, plan: Trajectory, index: int, arrived: bool, passes: bool
) -> tuple[Deviation | None, Deviation | None]:
    """Difference from the plan at the end of a phase and at worst."""
    planned = np.flatnonzero(plan.phase == index)
    if not len(planned):
        return None, None
    at = np.searchsorted(simulation.t, plan.t[planned])
    at = np.minimum(at, len(simulation.t) - 1)
    known = simulation.t[at] == plan.t[planned]
    difference = np.abs(simulation.z[at] - plan.z[planned])[known]
    worst = Deviation(_largest(difference[:, :2]), _largest(difference[:, 2:]))
    if not arrived:
        return None, worst
    last = int(np.flatnonzero(simulation.phase == index)[-1])
    if passes and known[-1]:
        last = int(at[-1])
    difference = np.abs(simulation.z[last] - plan.z[planned[-1]])
    return Deviation(_largest(difference[:2]), _largest(difference[2:])), worst


def _largest(values: Array) -> float:
    return float(values.max()) if values.size else math.nan


def _describe_thin(
    problem: Problem, phases: tuple[PhaseReport, ...], simulation: Simulation
) -> list[str]:
    """Sentences on the normal forces below epsilon, but for contacts where they were lost.

    A contact that is let go without a jump of the torques passes epsilon on its way to zero.
    """
    let_go = {
        (e.phase + 1, n): e.time
        for e in simulation.find(EventKind.RELEASE)
        for n in e.contact.split(", ")
    }
    lost = {(e.phase + 1, e.contact) for e in simulation.find(EventKind.CONTACT_LOST)}
    return [
        f"c_n of {c.contact} falls to {c.least:.5g} N, below epsilon = {problem.epsilon:g} N, "
        f"at t = {c.time:.5g} s, phase {phase.number}"
        for phase in phases
        for c in phase.contacts
        if c.margin < -MARGIN - STRAY * problem.epsilon
        and (phase.number, c.contact) not in lost
        and abs(c.time - let_go.get((phase.number, c.contact), math.inf)) > SHORTEST
    ]


def _describe_stops(problem: Problem, simulation: Simulation) -> list[str]:
    """Sentences on phases with two or more freedoms that end at rest in one of them only."""
    texts = []
    for event in simulation.find(EventKind.ARRIVAL):
        phase = problem.phases[event.phase]
        last = int(np.flatnonzero(simulation.phase == event.phase)[-1])
        speed = float(np.abs(simulation.z_dot[last]).max())
        free = phase.formation.n_constraints < 4 and phase.end is End.REST
        if free and speed > STOPPED:
            texts.append(
                f"{phase.until} is reached while the object or a finger still moves, at up to "
                f"{speed:.3g} (m/s or rad/s), phase {phase.number}: it is taken to stop there"
            )
    return texts


def _describe_end(events: list[Event], phase: Phase) -> str:
    """What ends a phase, with the contacts released if there are."""
    released = [event.contact for event in events if event.kind is EventKind.RELEASE]
    return f"release of {released[0]}" if released else str(phase.until)


def _describe_torques(problem: Problem, torque: TorqueProfile) -> list[str]:
    """Sentences on torques beyond their limits."""
    powers = np.linspace(-1, 1, 9)[:, None] ** np.arange(torque.coefficients.shape[2])
    peaks = np.abs(torque.coefficients @ powers.T).max(axis=2)
    texts = []
    for joint, limit in enumerate(problem.scene.torque_limit):
        piece = int(peaks[:, joint].argmax())
        if peaks[piece, joint] > limit * (1 + 1e-6):
            texts.append(
                f"tau_{joint + 1} reaches {peaks[piece, joint]:.3g} N m, above its limit "
                f"{limit:g} N m, near t = {torque.breaks[piece]:.5g} s"
            )
    return texts


def _balance(problem: Problem, simulation: Simulation) -> EnergyBalance:
    scene, energies = problem.scene, simulation.energies
    ends = simulation.z_dot[[0, -1]]
    kinetic = float(np.diff(0.5 * ends**2 @ scene.mass_diagonal)[0])
    weight = scene.polygon.mass * scene.gravity
    potential = float(weight * (simulation.z[-1, 1] - simulation.z[0, 1]))
    losses = {
        name: float(getattr(energies, name)[-1]) for name in ("viscous", "dry", "contact", "impact")
    }
    work, residual = float(energies.work[-1]), float(energies.residual[-1])
    scale = abs(work) + abs(kinetic) + abs(potential) + sum(map(abs, losses.values()))
    relative = abs(residual) / scale if scale > 0 else 0.0
    return EnergyBalance(
        work=work,
        kinetic=kinetic,
        potential=potential,
        **losses,
        residual=residual,
        relative=relative,
    )


__all__ = ["Report", "verify"]
