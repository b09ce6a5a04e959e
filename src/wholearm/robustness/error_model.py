"""Error model of a scene and its actuators: parametric ranges, sample-and-hold, gains, delay."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ..common.arrays import Array
from ..common.errors import require_number
from ..common.fields import Field
from ..problem.definition import Problem
from ..problem.uncertainty import PARAMETERS, change_scene, read_widths
from ..results.torque import TorqueProfile
from ..scene.model import Scene

REACHED = 0.03
"""How far from the planned place a goal counts as reached, over the scene's length: 1 mm of 33."""


@dataclass(frozen=True)
class Uncertainty:
    """Half widths of the ranges, by name of the parameter, and how torques are carried out.

    Raises
    ------
    InputError  if a name is unknown, or a width is not a number from zero to what makes sense:
                below one for relative ones
    """

    # those that are left out have their defaults; zero leaves a parameter as it is
    widths: Mapping[str, float] = field(default_factory=dict)
    # [Hz]: of a sample-and-hold of the torques, whose first sample is anywhere in a period; None
    # for torques as planned
    sample_rate: float | None = 1000.0
    # of the simulations of samples, relative to the scene: far below what counts as the goal
    tolerance: float = 1e-6
    # [m]: how far from the planned place a goal counts as reached; `REACHED` of the scene's length
    # if left out
    distance: float | None = None
    angle: float = math.radians(1.0)  # [rad]: how far from the planned angle

    def __post_init__(self) -> None:
        object.__setattr__(self, "widths", read_widths(self.widths, "range of {}"))
        if self.sample_rate is not None:
            require_number(self.sample_rate, "sample rate", positive=True)
        if self.distance is not None:
            require_number(self.distance, "goal distance", positive=True)
        require_number(self.angle, "goal angle", positive=True)

    def find_distance(self, scene: Scene) -> float:
        """How far from the planned place a goal counts as reached [m]."""
        return REACHED * scene.scales.length if self.distance is None else self.distance

    @property
    def varied(self) -> tuple[Field, ...]:
        """The parameters with a range."""
        return tuple(own for own in PARAMETERS if self.widths[own.name] > 0)

    def draw(self, count: int, seed: int | tuple[int, int]) -> Array:
        """Samples of a Latin hypercube, shape (count, len(varied) + 1).

        Each parameter has one sample in each of `count` slices of its range, so that its effect
        does not drown in that of the others. The last column is where in a period of the
        sample-and-hold the torques begin, in [0, 1).
        """
        generator = np.random.default_rng(seed)
        slices = generator.permuted(
            np.tile(np.arange(count)[:, None], len(self.varied) + 1), axis=0
        )
        shares = (slices + generator.random(slices.shape)) / count
        centred = 2 * shares[:, :-1] - 1
        delay = [own.name == "delay" for own in self.varied]
        centred[:, delay] = shares[:, :-1][:, delay]
        widths = np.array([self.widths[own.name] for own in self.varied])
        return np.column_stack([centred * widths, shares[:, -1]])


def change_problem(problem: Problem, changes: Mapping[str, float]) -> Problem:
    """The problem in the scene that `change_scene` makes; its start is left as it is."""
    return replace(problem, scene=change_scene(problem.scene, changes))


def change_torques(
    torque: TorqueProfile,
    changes: Mapping[str, float],
    sample_rate: float | None = None,
    offset: float = 0.0,
) -> TorqueProfile:
    """Torques as they are carried out: sampled and held, late, and of the wrong size.

    Parameters
    ----------
    changes             `gain1`, `gain2` relative, and `delay` [s], during which the first torques
                        hold
    sample_rate : [Hz]
    offset              share of a period by which the first sample is early, in [0, 1)
    """
    breaks, coefficients = torque.breaks, torque.coefficients
    if sample_rate is not None:
        start, stop = torque.breaks[0], torque.breaks[-1]
        ticks = np.arange(1, np.ceil((stop - start) * sample_rate) + 1) - offset
        inner = start + ticks / sample_rate
        inner = inner[(inner > start) & (inner < stop)]
        breaks = np.concatenate([[start], inner, [stop]])
        coefficients = torque.at(breaks[:-1])[:, :, None]
    gains = 1 + np.array([changes.get("gain1", 0.0), changes.get("gain2", 0.0)])
    coefficients = coefficients * gains[:, None]
    delay = changes.get("delay", 0.0)
    if delay > 0:
        first = np.zeros((1, *coefficients.shape[1:]))
        first[0, :, 0] = torque.at(torque.breaks[:1])[0] * gains
        breaks = np.concatenate([breaks[:1], breaks + delay])
        coefficients = np.concatenate([first, coefficients])
    return TorqueProfile(breaks, coefficients)
