"""How the least normal force of a plan changes with each number that may be off."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..common.errors import InputError, SimulationError
from ..free_simulation.result import FreeSimulation
from .trial import Trial, Window
from .uncertainty import change_torques

STEP = 1e-3
"""Step of the differences, over the half width of a range."""
APART = 0.01
"""How far from events the instant is at which a force is looked at, over the duration: where a
contact slides the other way forces step, at another time when numbers are off."""


class Sensitivity(NamedTuple):
    """Of one normal force, by central differences of free simulations.

    Attributes
    ----------
    name, unit : str
        The parameter, and the unit of its range; empty for a relative one.
    width : float
        Half width of its range.
    slope : float
        dc_n/d(parameter) [N per unit]; NaN where the contact is lost even for such a step.
    """

    name: str
    unit: str
    width: float
    slope: float

    @property
    def over_range(self) -> float:
        """What the half width changes, to first order [N]."""
        return self.slope * self.width


class Sensitivities(NamedTuple):
    """The least normal force of a motion, and what it depends on.

    Attributes
    ----------
    contact : str
    time : float, [s]
        When it is least, away from where forces step.
    c_n : float, [N]
    of : tuple of Sensitivity
        The largest over its range first.
    """

    contact: str
    time: float
    c_n: float
    of: tuple[Sensitivity, ...]


def measure_sensitivities(trial: Trial) -> Sensitivities:
    """Sensitivities of the least planned normal force to every parameter with a range.

    The least value of a smooth force changes like the force where it is least, whenever that is.
    """
    contact, time, least = find_least(trial.simulate({}, trial.torque), trial.windows)
    found = []
    for own in trial.uncertainty.varied if contact else ():
        width = trial.uncertainty.widths[own.name]
        step = STEP * width
        ends = (0.0, step) if own.name == "delay" else (-step, step)
        forces = [_find_force(trial, own.name, value, contact, time) for value in ends]
        slope = (forces[1] - forces[0]) / (ends[1] - ends[0])
        found.append(Sensitivity(own.name, own.unit, width, slope))
    known = [own for own in found if own.slope == own.slope]
    unknown = [own for own in found if own.slope != own.slope]
    known.sort(key=lambda own: -abs(own.over_range))
    return Sensitivities(contact, time, least, (*known, *unknown))


def find_least(simulation: FreeSimulation, windows: tuple[Window, ...]) -> tuple[str, float, float]:
    """The planned contact that presses least, when, and its c_n; none has no name."""
    t = simulation.t
    events = np.array([0.0, t[-1], *(own.time for own in simulation.events)])
    apart = np.abs(t[:, None] - events).min(axis=1) > APART * t[-1]
    found, start = ("", math.nan, math.nan), 0.0
    for window in windows:
        for name in window.contacts:
            c_n = simulation.c_n[:, simulation.contacts.index(name)]
            here = np.flatnonzero(apart & (t > start) & (t < window.stop) & (c_n == c_n))
            if len(here):
                row = here[c_n[here].argmin()]
                if not c_n[row] >= found[2]:
                    found = (name, float(t[row]), float(c_n[row]))
        start = window.stop
    return found


def _find_force(trial: Trial, name: str, change: float, contact: str, time: float) -> float:
    """A contact's c_n at an instant, by the clock of the torques; NaN where it is lost."""
    late = change if name == "delay" else 0.0
    torque = change_torques(trial.torque, {name: change}).cut(0.0, time + late)
    try:
        simulation = trial.simulate({name: change}, torque)
    except (InputError, SimulationError):
        return math.nan
    return float(simulation.c_n[-1, simulation.contacts.index(contact)])
