"""Least normal forces, slip margins and link gaps of a replay, refined by parabolas in time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..contacts.cones import slip_margins
from ..contacts.links import evaluate_finger_gap
from ..mechanics.limits import CONE, PRESS, TORQUE, make_limits
from ..problem.definition import Phase, Problem
from ..results.report import ContactMargin, FingerGap, SlipMargin
from ..results.torque import TorqueProfile
from ..scene.model import Scene
from ..simulation.events import EventKind, Simulation
from ..simulation.tolerances import SETTLING

_RATE_MISS = 1e-3  # largest relative miss of a torque's rate, or of a command, that is not reported
STEPPED = 1e-5  # largest step of a torque that is none, over its limit
_LOOKS = 33  # instants of each piece of the torques that are looked at
SHORTEST = 2 * SETTLING
"""Interval below which forces may jump, and rounding spoils a parabola, relative to the scene's
time."""
MISSED = 1e-6  # miss of a limit, over what is much for it, from which on it is reported


class Parabolas(NamedTuple):
    """Parabolas through three successive samples each whose vertex lies between the outer ones."""

    start: Array  # start, stop, time (n,) [s]: the outer samples, and the vertex
    stop: Array
    time: Array
    lowest: Array  # (n,): value there
    dips: NDArray[np.bool_]  # (n,): whether the middle sample is the least of the three


def list_normal_forces(
    problem: Problem, simulation: Simulation, phase: Phase, rows: NDArray[np.int64]
) -> dict[str, Array]:
    """Normal forces by contact in a phase, which the simulation has at `rows` [N].

    A contact that is let go without a jump of the torques passes epsilon on its way to zero: what
    it has below epsilon on that way is NaN.
    """
    gone = {
        name
        for event in simulation.find(EventKind.RELEASE)
        if event.phase == phase.index
        for name in event.contact.split(", ")
    }
    forces = {}
    for name in phase.formation.names:
        values = simulation.c_n[rows, simulation.contacts.index(name)]
        pressed = np.flatnonzero(values >= problem.epsilon)
        if name in gone and len(pressed) and values[-1] < problem.epsilon / 2:
            values[pressed[-1] + 1 :] = math.nan
        forces[name] = values
    return forces


def list_slips(simulation: Simulation, phase: Phase, rows: NDArray[np.int64]) -> dict[str, Array]:
    """Margins to slipping by rolling contact in a phase, which the simulation has at `rows` [N]."""
    formation = phase.formation
    columns = [simulation.contacts.index(name) for name in formation.names]
    c_n, c_t = simulation.c_n[rows][:, columns], simulation.c_t[rows][:, columns]
    names = [formation.names[row] for row in formation.rolling_rows]
    return dict(zip(names, slip_margins(formation, c_n, c_t).T, strict=True))


def list_contact_margins(
    problem: Problem, simulation: Simulation, rows: NDArray[np.int64], phase: Phase, breaks: Array
) -> tuple[ContactMargin, ...]:
    """Least normal forces in a phase, which the simulation has at `rows`."""
    forces = list_normal_forces(problem, simulation, phase, rows)
    least = _find_least(phase, simulation, rows, breaks, forces, EventKind.CONTACT_LOST)
    return tuple(ContactMargin(name, c_n, t, c_n - problem.epsilon) for name, c_n, t in least)


def list_slip_margins(
    phase: Phase, simulation: Simulation, rows: NDArray[np.int64], breaks: Array
) -> tuple[SlipMargin, ...]:
    """Least margins to slipping in a phase, which the simulation has at `rows`."""
    slips = list_slips(simulation, phase, rows)
    least = _find_least(phase, simulation, rows, breaks, slips, EventKind.SLIP)
    return tuple(SlipMargin(*margin) for margin in least)


def _find_least(
    phase: Phase,
    simulation: Simulation,
    rows: NDArray[np.int64],
    breaks: Array,
    series: dict[str, Array],
    kind: EventKind,
) -> Iterator[tuple[str, float, float]]:
    """Least value of each contact and its time; that of an event of its loss where it is less."""
    events = {e.contact: e for e in simulation.find(kind) if e.phase == phase.index}
    shortest = SHORTEST * phase.formation.scene.scales.time
    for name, values in series.items():
        least, time = find_lowest(simulation.t[rows], values, breaks, shortest)
        if name in events and not least <= events[name].value:
            least, time = events[name].value, events[name].time
        yield name, least, time


def describe_misses(
    phase: Phase, simulation: Simulation, rows: NDArray[np.int64], torque: TorqueProfile
) -> list[str]:
    """Sentences on limits that a phase exceeds, other than those of forces and torques alone."""
    formation, t = phase.formation, simulation.t[rows]
    limits = make_limits(formation, 0.0).without(PRESS, CONE, TORQUE)
    if not limits.limits:
        return []
    columns = [simulation.contacts.index(name) for name in formation.names]
    rolling = [columns[row] for row in formation.rolling_rows]
    c = [simulation.c_n[rows][:, columns], simulation.c_t[rows][:, rolling]]
    y = np.nan_to_num(np.hstack([*c, torque.at(t), simulation.z_dot[rows, 3:]]))
    short = limits.fold(-limits.find_slack(y @ limits.rows.T))
    texts = []
    for k, limit in enumerate(limits.limits):
        amounts = short[:, limits.owners == k].max(axis=1)
        worst = int(amounts.argmax())
        if amounts[worst] > MISSED * limit.scale:
            over = f"{amounts[worst]:.3g} {limit.unit}"
            texts.append(
                f"{limit.text} is exceeded by {over} at t = {t[worst]:.5g} s, phase {phase.number}"
            )
    return texts


def find_finger_gap(scene: Scene, simulation: Simulation, breaks: Array) -> FingerGap | None:
    """Least gap between the links in a replay; None if they pass each other."""
    if not scene.fingers_collide:
        return None
    gaps, shortest = evaluate_finger_gap(scene, simulation.z), SHORTEST * scene.scales.time
    return FingerGap(*find_lowest(simulation.t, gaps, breaks, shortest))


def find_lowest(
    t: Array, values: Array, breaks: Array, shortest: float = 0.0
) -> tuple[float, float]:
    """Least value of a sampled function and where, refined by parabolas inside smooth stretches.

    Parameters
    ----------
    t, values, breaks, shortest  as of `fit_parabolas`

    Returns
    -------
    least, time  naN if no value is known
    """
    if np.isnan(values).all():
        return math.nan, math.nan
    first = int(np.nanargmin(values))
    least, time = float(values[first]), float(t[first])
    parabolas = fit_parabolas(t, values, breaks, shortest)
    # Where the middle is not the least of three, a curve that flattens out would seem to dip.
    lowest = np.where(parabolas.dips, parabolas.lowest, math.inf)
    if len(lowest) and lowest.min() < least:
        k = int(lowest.argmin())
        least, time = float(lowest[k]), float(parabolas.time[k])
    return least, time


def fit_parabolas(t: Array, values: Array, breaks: Array, shortest: float = 0.0) -> Parabolas:
    """Parabolas with a vertex below their samples, inside smooth stretches of a sampled function.

    Parameters
    ----------
    t : (n,) [s]    never decreasing; a jump is there twice
    values : (n,)   naN where unknown
    breaks : [s]    where the function may have a kink: no parabola has one inside
    shortest : [s]  interval below which the function may jump
    """
    left, right = np.diff(t)[:-1], np.diff(t)[1:]
    smooth = (left > shortest) & (right > shortest) & ~np.isin(t[1:-1], breaks)
    smooth &= ~np.isnan(values[:-2] + values[1:-1] + values[2:])
    left, right, time, middle = left[smooth], right[smooth], t[1:-1][smooth], values[1:-1][smooth]
    fall = (values[1:-1] - values[:-2])[smooth] / left
    rise = (values[2:] - values[1:-1])[smooth] / right
    bend = (rise - fall) / (left + right)
    slope = (fall * right + rise * left) / (left + right)
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = -slope / (2 * bend)
    inside = (bend > 0) & (shift > -left) & (shift < right)
    left, right, time, shift = left[inside], right[inside], time[inside], shift[inside]
    lowest = middle[inside] + slope[inside] * shift / 2
    dips = (fall[inside] <= 0) & (rise[inside] >= 0)
    return Parabolas(time - left, time + right, time + shift, lowest, dips)


def find_commands(torque: TorqueProfile, lag: Array) -> TorqueProfile:
    """Commands that motors with some lags, shape (2,) [s], make torques of: tau + lag tau'."""
    order = np.arange(1, torque.coefficients.shape[2])
    slopes = np.zeros_like(torque.coefficients)
    slopes[..., :-1] = torque.coefficients[..., 1:] * order
    slopes *= (2 / np.diff(torque.breaks))[:, None, None]
    return TorqueProfile(torque.breaks, torque.coefficients + lag[:, None] * slopes)


def describe_motors(problem: Problem, torque: TorqueProfile) -> list[tuple[float, str]]:
    """What misses cannot follow, with the time of the worst place of each kind [s]."""
    scene = problem.scene
    if not scene.has_slow_motors:
        return []
    x = np.linspace(-1, 1, _LOOKS)
    values, ones = torque.at_places(x), find_commands(torque, np.ones(2)).at_places(x)
    rates, commands = ones - values, values + scene.actuator_lag[:, None] * (ones - values)
    steps = np.abs(values[1:, :, 0] - values[:-1, :, -1])
    misses = list[tuple[float, str]]()
    limits = zip(scene.torque_limit, scene.torque_rate_limit, scene.actuator_lag, strict=True)
    for joint, (limit, fastest, lag) in enumerate(limits):
        name = f"tau_{joint + 1}"
        if np.isinf(fastest) and not lag:
            continue
        worst = int(steps[:, joint].argmax()) if len(steps) else 0
        if len(steps) and steps[worst, joint] > STEPPED * limit:
            t = float(torque.breaks[worst + 1])
            text = f"{name} steps by {steps[worst, joint]:.3g} N m at t = {t:.5g} s"
            why = (
                f"its rate limit is {fastest:g} N m/s" if np.isfinite(fastest) else "its motor lags"
            )
            misses.append((t, f"{text}, where {why}"))
        kinds = (
            (rates[:, joint], fastest, "changes at {:.4g} N m/s, above its rate limit {:g} N m/s"),
            (commands[:, joint], limit, "takes a command of {:.4g} N m, above its limit {:g} N m"),
        )
        for of, most, text in kinds:
            size = np.abs(of)
            piece, look = np.unravel_index(int(size.argmax()), size.shape)
            if size[piece, look] > most * (1 + _RATE_MISS):
                start, stop = torque.breaks[[piece, piece + 1]]
                t = float(start + (stop - start) * look / (_LOOKS - 1))
                said = text.format(size[piece, look], most)
                misses.append((t, f"{name} {said}, at t = {t:.5g} s"))
    return misses
